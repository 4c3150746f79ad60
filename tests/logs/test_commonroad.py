"""CommonRoad scenarios: obstacles as objects, and untrusted files."""

from __future__ import annotations

import random
from collections.abc import Callable
from math import pi
from pathlib import Path

import pytest

from spatial_replay import Footprint, LogError, Sample, SpatialReplayError, UsageError, read_trace
from spatial_replay.sources import open_source

Write = Callable[..., Path]

BOX = "<rectangle><length>4</length><width>2</width></rectangle>"


def scenario(*obstacles: str, step: str = "0.1") -> str:
    return (
        f'<?xml version="1.0"?>\n<commonRoad timeStepSize="{step}">\n'
        + "\n".join(obstacles)
        + "\n</commonRoad>\n"
    )


def point(x: float, y: float) -> str:
    return f"<point><x>{x}</x><y>{y}</y></point>"


def exact(value: object) -> str:
    return f"<exact>{value}</exact>"


def state(step: object, position: str = point(0, 0), angle: str = exact(0.0), name: str = "state") -> str:
    orientation = f"<orientation>{angle}</orientation>" if angle else ""
    return f"<{name}><position>{position}</position>{orientation}<time>{exact(step)}</time></{name}>"


def car(number: int, *states: str, shape: str = BOX, kind: str = "dynamicObstacle", inside: str = "") -> str:
    first = (
        states[0].replace("<state>", "<initialState>").replace("</state>", "</initialState>")
        if states
        else ""
    )
    rest = f"<trajectory>{''.join(states[1:])}</trajectory>" if len(states) > 1 else ""
    return f'<{kind} id="{number}"><type>car</type><shape>{shape}</shape>{inside}{first}{rest}</{kind}>'


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(text: str | bytes, name: str = "scenario.xml") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def samples(path: Path) -> list[Sample]:
    return list(read_trace(path).samples())


def test_a_time_step_is_a_sample(write: Write) -> None:
    moving = car(42, state(0), state(1, point(1, 0)), state(2, point(2, 5), exact(pi / 2)))
    standing = car(43, state(0, point(9, 9)), kind="staticObstacle")
    found = samples(write(scenario(moving, standing)))
    assert [sample.time_ns for sample in found] == [0, 100_000_000, 200_000_000]
    assert found[0].objects["42"].footprint == Footprint.box(-2, -1, 2, 1)
    (part,) = found[2].objects["42"].footprint.parts
    assert part.vertices.round(9).tolist() == [[3, 3], [3, 7], [1, 7], [1, 3]]
    assert found[2].objects["42"].yaw == pi / 2
    assert found[2].objects["42"].class_name == "car"
    assert read_trace(write(scenario(moving, standing))).units == {"": "m"}
    assert all(sample.objects["43"].footprint == Footprint.box(7, 8, 11, 10) for sample in found)


def test_an_obstacle_is_there_for_its_own_time_steps(write: Write) -> None:
    found = samples(write(scenario(car(1, state(2), state(3)), car(2, state(3), state(5)))))
    assert [sample.time_ns // 10**8 for sample in found] == [2, 3, 5]
    assert [sorted(sample.objects) for sample in found] == [["1"], ["1", "2"], ["2"]]


def test_shapes_are_unions_around_the_centre(write: Write) -> None:
    disc = "<circle><radius>0.5</radius><center><x>1</x><y>0</y></center></circle>"
    size = "<length>2</length><width>4</width>"
    turned = f"<rectangle>{size}<orientation>1.5707963267948966</orientation></rectangle>"
    triangle = f"<polygon>{point(0, 0)}{point(0, 1)}{point(1, 0)}</polygon>"
    (found,) = samples(write(scenario(car(1, state(0, point(10, 0)), shape=disc + turned + triangle))))
    round_part, box, corner = found.objects["1"].footprint.parts
    assert (round_part.vertices.tolist(), round_part.radius) == ([[11, 0]], 0.5)
    assert sorted(box.vertices.round(9).tolist()) == [[8, -1], [8, 1], [12, -1], [12, 1]]
    assert sorted(corner.vertices.tolist()) == [[10, 0], [10, 1], [11, 0]]


def tags(**numbers: float) -> str:
    return "".join(f"<{name}>{number}</{name}>" for name, number in numbers.items())


TRUCK = (
    "<truckShape><truckDims>"
    + tags(
        length=6, width=2, wheelbase=4, distFromRearToRearAxle=1, cabinLength=2, distFromRearAxleToHitch=0.5
    )
    + "</truckDims><originXShift>-1</originXShift></truckShape>"
)
TRAILER = tags(length=10, width=2, wheelbase=7, distFromFrontToHitch=1)
SEMI_TRAILER = f"<semiTrailerTruckShape>{TRUCK}<trailerDims>{TRAILER}</trailerDims></semiTrailerTruckShape>"


def corners(footprint: Footprint) -> list[list[list[float]]]:
    return [sorted((part.vertices.round(9) + 0.0).tolist()) for part in footprint.parts]


def test_the_position_of_a_rectangle_is_shifted_from_its_centre(write: Write) -> None:
    shifted = f"<rectangle>{tags(length=4, width=2, originXShift=-1.5)}</rectangle>"
    first, turned = samples(
        write(scenario(car(1, state(0), state(1, point(5, 0), exact(pi / 2)), shape=shifted)))
    )
    assert first.objects["1"].footprint == Footprint.box(-0.5, -1, 3.5, 1)
    assert corners(turned.objects["1"].footprint) == [[[4, -0.5], [4, 3.5], [6, -0.5], [6, 3.5]]]


def test_a_rectangle_without_an_orientation_is_uncertain_as_far_as_its_corners_turn(write: Write) -> None:
    shifted = f"<rectangle>{tags(length=4, width=2, originXShift=-1.5)}</rectangle>"
    (found,) = samples(write(scenario(car(1, state(0, angle=""), shape=shifted))))
    assert found.objects["1"].uncertainty == pytest.approx(2 * (3.5**2 + 1) ** 0.5)


def test_a_truck_is_placed_by_its_own_shift(write: Write) -> None:
    (found,) = samples(write(scenario(car(1, state(0, point(7, 3)), shape=TRUCK))))
    assert found.objects["1"].footprint == Footprint.box(5, 2, 11, 4)


def test_a_trailer_turns_about_its_hitch(write: Write) -> None:
    """The truck's middle is 1 m ahead of its position, its rear axle 1 m behind, its hitch 0.5 m behind."""
    bent = state(1).replace("</state>", f"<hitchAngle>{exact(pi / 2)}</hitchAngle></state>")
    reversing = state(2, angle=exact(pi)).replace(
        "</state>", f"<hitchAngle>{exact(-pi / 2)}</hitchAngle></state>"
    )
    straight, turned, back = samples(write(scenario(car(1, state(0), bent, reversing, shape=SEMI_TRAILER))))
    truck = [[-2, -1], [-2, 1], [4, -1], [4, 1]]
    assert corners(straight.objects["1"].footprint) == [truck, [[-9.5, -1], [-9.5, 1], [0.5, -1], [0.5, 1]]]
    assert corners(turned.objects["1"].footprint) == [truck, [[-1.5, -9], [-1.5, 1], [0.5, -9], [0.5, 1]]]
    assert corners(back.objects["1"].footprint)[1] == [[-0.5, -9], [-0.5, 1], [1.5, -9], [1.5, 1]]


def test_a_scenario_of_standing_obstacles_is_one_sample(write: Write) -> None:
    building = f'<environmentObstacle id="7"><type>building</type><shape>{BOX}</shape></environmentObstacle>'
    (found,) = samples(write(scenario(building, car(8, state(0), kind="staticObstacle"))))
    assert found.time_ns == 0
    assert {name: each.class_name for name, each in found.objects.items()} == {"7": "building", "8": "car"}
    assert found.objects["7"].yaw is None


def test_obstacles_of_older_versions_are_read(write: Write) -> None:
    moving = car(1, state(0), state(1), kind="obstacle", inside="<role>dynamic</role>")
    standing = car(2, state(0), kind="obstacle", inside="<role>static</role>")
    assert [sorted(sample.objects) for sample in samples(write(scenario(moving, standing)))] == [
        ["1", "2"]
    ] * 2


def test_what_is_not_exact_is_uncertain(write: Write) -> None:
    region = "<circle><radius>0.5</radius><center><x>3</x><y>4</y></center></circle>"
    between = "<intervalStart>-0.2</intervalStart><intervalEnd>0.2</intervalEnd>"
    found = samples(
        write(scenario(car(1, state(0), state(1, region), state(2, angle=between), state(3, angle=""))))
    )
    certain, somewhere, turned, anyhow = (sample.objects["1"] for sample in found)
    assert certain.uncertainty == 0
    assert somewhere.footprint == Footprint.box(1, 3, 5, 5)
    assert somewhere.uncertainty == 0.5
    # the corners are the square root of 5 from the centre, and turn by up to 0.2
    assert turned.uncertainty == pytest.approx(2 * 5**0.5 * 0.0998334166)
    assert turned.yaw is None
    assert anyhow.uncertainty == pytest.approx(2 * 5**0.5)
    assert anyhow.yaw is None


def test_what_a_scenario_leaves_open_is_unknown(write: Write) -> None:
    occupancy = (
        f"<occupancySet><occupancy><shape>{BOX}</shape><time>{exact(1)}</time></occupancy></occupancySet>"
    )
    phantom = f'<phantomObstacle id="9">{occupancy}</phantomObstacle>'
    trace = read_trace(
        write(scenario(car(1, state(1, '<lanelet ref="3"/>'), state(2, point("nan", 0))), phantom))
    )
    assert trace.names == ("1", "9")
    assert trace.unreadable_count == 3
    assert trace.faults == ()


def test_an_occupancy_is_an_outline_that_the_obstacle_is_within(write: Write) -> None:
    region = "<rectangle><length>6</length><width>8</width><center><x>1</x><y>0</y></center></rectangle>"
    span = "<intervalStart>1</intervalStart><intervalEnd>3</intervalEnd>"
    occupied = (
        f"<occupancySet><occupancy><shape>{region}</shape><time>{span}</time></occupancy></occupancySet>"
    )
    obstacle = car(1, state(0)).replace("</initialState>", "</initialState>" + occupied)
    found = samples(write(scenario(obstacle)))
    assert [sample.time_ns // 10**8 for sample in found] == [0, 1, 2, 3]
    assert found[0].objects["1"].uncertainty == 0
    assert found[1].objects["1"].footprint == Footprint.box(-2, -4, 4, 4)
    assert found[1].objects["1"].uncertainty == 10


@pytest.mark.parametrize(
    ("bad", "reported"),
    [
        (car(2, state(1), state(2)).replace('id="2"', ""), "id is ''; give each obstacle one of its own"),
        (car(1, state(1)), "id is '1'"),
        (car(2, state(1)).replace("<shape>", "<form>").replace("</shape>", "</form>"), "no <shape>"),
        (car(2, state(1), shape=""), "<shape> is empty"),
        (car(2, state(1), shape="<sphere/>"), "<sphere> is not a shape"),
        (car(2, state(1), shape=BOX.replace("<width>", "<tilt>1</tilt><width>")), "unknown <tilt>"),
        (car(2, state(1), shape="<circle><radius>1</radius><arc/></circle>"), "unknown <arc>"),
        (car(2, state(1), shape=SEMI_TRAILER.replace("wheelbase", "axles")), "unknown <axles>"),
        (car(2, state(1), shape=TRUCK.replace("<originXShift>-1</originXShift>", "")), "no <originXShift>"),
        (
            car(2, state(1), state(2, BOX.replace("</rect", "<originXShift>1</originXShift></rect"))),
            "a region has no originXShift",
        ),
        (car(2, state(1), shape="<circle><radius>-1</radius></circle>"), "radius is -1"),
        (car(2, state(1), shape="<polygon/>"), "no <point>"),
        (car(2, kind="staticObstacle"), "no <initialState>"),
        (car(2, state(1), state("x")), "time step is 'x'"),
        (car(2, state(1), state("9" * 20)), "time step is '999"),
        (car(2, state(1), state(1)), "is there twice"),
        (car(2, state(1), "<state/>"), "<state> has no <time>"),
        (car(2, state(1), state(2, "")), "<position> is empty"),
        (car(2, state(1), state(2, point(1, 2).replace("y>", "z>"))), "no <y>"),
        (car(2, state(1), state(2, angle=exact("north"))), "exact is 'north'"),
        (
            car(2, state(1), state(2, angle="<intervalStart>1</intervalStart><intervalEnd>0</intervalEnd>")),
            "start",
        ),
    ],
)
def test_an_impossible_obstacle_is_reported(write: Write, bad: str, reported: str) -> None:
    path = write(scenario(car(1, state(0), state(1), state(2)), bad))
    trace = read_trace(path, allow_damage=True)
    assert len(trace) == 3
    (fault,) = trace.faults
    assert fault.startswith("scenario.xml:4: ")
    assert reported in fault
    with pytest.raises(LogError, match=r"scenario\.xml:4: "):
        read_trace(path)


def test_an_impossible_outline_is_reported(write: Write) -> None:
    crossing = f"<polygon>{point(0, 0)}{point(2, 2)}{point(2, 0)}{point(0, 1)}</polygon>"
    with pytest.raises(LogError, match=r"holds no sample: .*time step 0: .*cross"):
        read_trace(write(scenario(car(1, state(0), shape=crossing))))


BOMB = (
    '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;&b;">]><commonRoad timeStepSize="0.1">&c;</commonRoad>'
)
OUTSIDE = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hosts">]><commonRoad>&b;</commonRoad>'
)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (BOMB, "document type"),
        (OUTSIDE, "document type"),
        ('<!DOCTYPE commonRoad SYSTEM "commonroad.dtd"><commonRoad/>', "document type"),
        ('<?xml version="1.0"?><svg/>', "its root is <svg>"),
        ('<?xml version="1.0"?>', "broken"),
        ('<?xml version="1.0" encoding="klingon"?><commonRoad/>', "klingon"),
        ("<commonRoad/>", "timeStepSize is ''"),
        ('<commonRoad timeStepSize="0"/>', "timeStepSize is '0'"),
        ('<commonRoad timeStepSize="1e999"/>', "timeStepSize"),
        ('<commonRoad timeStepSize="0.1">' + "<a>" * 1000, "nested deeper"),
        ('<commonRoad timeStepSize="0.1"><obstacle>' + "<a/>" * 500_002, "more than 500000 elements"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(write: Write, text: str, reported: str) -> None:
    with pytest.raises(LogError, match=reported):
        read_trace(write(text))


def test_a_scenario_without_obstacles_has_nothing_to_evaluate(write: Write) -> None:
    with pytest.raises(UsageError, match="without obstacles"):
        read_trace(write(scenario()))


def test_what_comes_before_the_damage_is_read(write: Write) -> None:
    text = scenario(car(1, state(0), state(1)), car(2, state(0), state(1)))
    trace = read_trace(write(text[: text.index('id="2"') + 40]), allow_damage=True)
    assert trace.names == ("1",)
    (fault,) = trace.faults
    assert fault.startswith("scenario.xml:4: the XML is broken")


def test_damage_anywhere_is_reported_or_harmless(write: Write) -> None:
    """Cut or changed anywhere, a file gives what can be read and says what cannot, or is refused."""
    content = scenario(car(1, state(0), state(1)), car(2, state(0), state(1), shape=BOX + BOX)).encode()
    chance = random.Random(7)
    for _ in range(300):
        damaged = bytearray(content)
        if chance.random() < 0.5:
            del damaged[chance.randrange(len(damaged)) :]
        else:
            damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        try:
            trace = read_trace(write(bytes(damaged)), allow_damage=True)
        except SpatialReplayError:
            continue
        assert trace.names or trace.faults


def test_published_scenarios_are_read(data_folder: Path) -> None:
    folder = data_folder / "commonroad"
    source = open_source(folder / "ZAM_Tutorial-1_2_T-1.xml")
    assert source.kind == "CommonRoad scenario"
    trace = read_trace(folder / "ZAM_Tutorial-1_2_T-1.xml")
    assert (len(trace), trace.names, trace.times_ns[-1]) == (41, ("42", "43", "44"), 4 * 10**9)
    assert set(trace.classes) == {"car", "parkedVehicle"}
    assert (trace.rows >= 0).all()
    with pytest.raises(UsageError, match="without obstacles"):
        read_trace(folder / "DEU_Starnberg-1_1_T-1.xml")
