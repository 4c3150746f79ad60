"""What a scenario leaves open never leaves the interval of a verdict."""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from spatial_replay import Footprint, Sample, Trace, evaluate, parse_specification, read_trace

LENGTHS = st.floats(0.1, 5)
PLACES = st.floats(-10, 10)
SHARES = st.floats(0, 1)
SPECIFICATION = parse_specification(
    "region gate = box(-1, -2, 3, 2)\n"
    "spec near = F (car dist gate <= 1)\n"
    "spec within = F (car enclosedin gate)\n"
    "spec left = F (car leftof gate)\n"
)


def rectangle(length: float, width: float, x: float, y: float, angle: float) -> Footprint:
    along, across = (
        (cos(angle) * length / 2, sin(angle) * length / 2),
        (-sin(angle) * width / 2, cos(angle) * width / 2),
    )
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return Footprint.polygon(
        [(x + a * along[0] + b * across[0], y + a * along[1] + b * across[1]) for a, b in corners]
    )


def read(shape: str, state: str) -> Trace:
    obstacle = f'<dynamicObstacle id="car"><type>car</type><shape>{shape}</shape>{state}</dynamicObstacle>'
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.xml"
        path.write_text(f'<commonRoad timeStepSize="0.1">{obstacle}</commonRoad>')
        return read_trace(path)


def assert_within(scenario: Trace, truth: Footprint) -> None:
    possible = evaluate(SPECIFICATION, scenario)
    actual = evaluate(SPECIFICATION, Trace.from_samples([Sample(0, {"car": truth})]))
    for open_result, result in zip(possible.results, actual.results, strict=True):
        assert open_result.lower - 1e-6 <= result.robustness <= open_result.upper + 1e-6


@examples(60)
@given(
    LENGTHS,
    LENGTHS,
    PLACES,
    PLACES,
    st.floats(0, 3),
    st.floats(-pi, pi),
    st.floats(0, 2 * pi),
    SHARES,
    SHARES,
    SHARES,
)
def test_an_open_position_and_orientation_widen_the_interval(
    length: float,
    width: float,
    x: float,
    y: float,
    radius: float,
    low: float,
    turn: float,
    share: float,
    far: float,
    way: float,
) -> None:
    region = f"<circle><radius>{radius}</radius><center><x>{x}</x><y>{y}</y></center></circle>"
    angle = f"<intervalStart>{low}</intervalStart><intervalEnd>{low + turn}</intervalEnd>"
    scenario = read(
        f"<rectangle><length>{length}</length><width>{width}</width></rectangle>",
        f"<initialState><position>{region}</position><orientation>{angle}</orientation>"
        "<time><exact>0</exact></time></initialState>",
    )
    away, where = far * radius, way * 2 * pi
    truth = rectangle(length, width, x + away * cos(where), y + away * sin(where), low + share * turn)
    assert_within(scenario, truth)


@examples(60)
@given(LENGTHS, LENGTHS, PLACES, st.floats(-pi, pi), st.floats(0, 2 * pi), SHARES, st.floats(0, pi), SHARES)
def test_an_open_angle_of_the_hitch_widens_the_interval(
    front: float, hitch: float, x: float, low: float, bend: float, share: float, turn: float, way: float
) -> None:
    """The truck is a point between the position and the hitch."""
    truck = (
        "<truckShape><truckDims><length>0</length><width>0</width><wheelbase>1</wheelbase>"
        "<distFromRearToRearAxle>0</distFromRearToRearAxle><cabinLength>1</cabinLength>"
        f"<distFromRearAxleToHitch>{hitch}</distFromRearAxleToHitch></truckDims>"
        f"<originXShift>{-hitch}</originXShift></truckShape>"
    )
    trailer = (
        "<trailerDims><length>8</length><width>2</width><wheelbase>5</wheelbase>"
        f"<distFromFrontToHitch>{front}</distFromFrontToHitch></trailerDims>"
    )
    interval = "<{0}><intervalStart>{1}</intervalStart><intervalEnd>{2}</intervalEnd></{0}>".format
    scenario = read(
        f"<semiTrailerTruckShape>{truck}{trailer}</semiTrailerTruckShape>",
        f"<initialState><position><point><x>{x}</x><y>0</y></point></position>"
        + interval("orientation", low, low + turn)
        + interval("hitchAngle", low, low + bend)
        + "<time><exact>0</exact></time></initialState>",
    )
    angle, hitch_angle = low + way * turn, low + share * bend
    ahead, behind = 2 * hitch, front - 4
    truth = rectangle(
        8,
        2,
        x + ahead * cos(angle) + behind * cos(angle + hitch_angle),
        ahead * sin(angle) + behind * sin(angle + hitch_angle),
        angle + hitch_angle,
    )
    tip = Footprint.disc(x + hitch * cos(angle), hitch * sin(angle), 0)
    assert_within(scenario, Footprint.union([tip, truth]))


@examples(60)
@given(LENGTHS, LENGTHS, PLACES, PLACES, SHARES, SHARES, SHARES, SHARES)
def test_an_obstacle_anywhere_in_an_occupancy_is_within_the_interval(
    length: float, width: float, x: float, y: float, long: float, wide: float, along: float, across: float
) -> None:
    region = (
        f"<rectangle><length>{length}</length><width>{width}</width>"
        f"<center><x>{x}</x><y>{y}</y></center></rectangle>"
    )
    scenario = read(
        "<circle><radius>1</radius></circle>",
        f"<occupancySet><occupancy><shape>{region}</shape><time><exact>0</exact></time></occupancy></occupancySet>",
    )
    inner, outer = (long * length, wide * width), (length, width)
    left, low = (
        middle - size / 2 + share * (size - part)
        for middle, size, part, share in zip((x, y), outer, inner, (along, across), strict=True)
    )
    truth = Footprint.box(left, low, left + inner[0], low + inner[1])
    assert_within(scenario, truth)
