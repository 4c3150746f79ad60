"""Read CommonRoad scenarios, XML files of obstacles, as samples.

A file with a document type is refused, because its entities could fetch other files or expand without bound.
The size of the file is limited, and so are the depth and the number of elements.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import cos, fsum, hypot, isfinite, nan, pi, sin
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

from spatial_replay.errors import GeometryError, LogError, UsageError
from spatial_replay.geometry.footprint import Concave, Footprint
from spatial_replay.logs.formats.tracks import ObjectReport, ReportedSample, iter_traces, open_text
from spatial_replay.logs.read_options import FaultList
from spatial_replay.trace.trace import LATEST_NS, Trace

LARGEST_FILE = 512 * 2**20
"""Largest file, decompressed, bytes."""
MOST_ELEMENTS = 500_000
"""Maximum number of elements inside one obstacle."""
DEEPEST = 64
LONGEST_TEXT = 4096
_PIECE = 2**16


@dataclass(slots=True)
class Element:
    """An element with its content.

    Attributes:
        line: line of the start tag, from 1.
        text: text of the element without its children; a text longer than `LONGEST_TEXT` is cut.
    """

    name: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def child(self, name: str) -> Element | None:
        """Return the first child with a name; None if no child has the name."""
        return next(self.all(name), None)

    def all(self, name: str) -> Iterator[Element]:
        """Iterate over the children with a name."""
        return (child for child in self.children if child.name == name)


def iter_elements(path: Path, faults: FaultList, wanted: frozenset[str]) -> Iterator[Element]:
    """Yield the root without its content, then the root's children whose names are `wanted`.

    A damaged file yields the children before the damage. The damage goes to `faults`.

    Raises:
        LogError: the file has no root, declares a document type, or exceeds a limit of this module.
    """
    collector = _Collector(path.name, wanted)
    with open_text(path) as stream:
        has_element = False
        for problem in _parse(stream, collector):
            for element in collector.take():
                has_element = True
                yield element
            if problem is not None:
                fault = f"{path.name}:{collector.line}: {problem}"
                if not has_element:
                    raise LogError(f"{fault}; give a well-formed XML file")
                faults.add(f"{fault}; what follows is left out")


def _parse(stream: BinaryIO, collector: _Collector) -> Iterator[str | None]:
    """Parse the file in pieces; yield None after each piece, or the fault that ends the parsing."""
    read_bytes = 0
    while True:
        try:
            piece = stream.read(_PIECE)
            read_bytes += len(piece)
            if read_bytes > LARGEST_FILE:
                raise LogError(f"{collector.name} is larger than {LARGEST_FILE >> 20} MiB; split it")
            collector.parser.Parse(piece, not piece)
        except expat.ExpatError as error:
            yield f"the XML is broken ({expat.ErrorString(error.code)})"
            return
        except (EOFError, zlib.error, LookupError, ValueError) as error:
            # broken compression, or an unknown encoding
            yield f"the file cannot be read ({error})"
            return
        yield None
        if not piece:
            return


class _Collector:
    """Builds elements from the events of a parser."""

    def __init__(self, name: str, element_names: frozenset[str]) -> None:
        self.name = name
        self._element_names = element_names
        self._open_elements: list[Element] = []
        self._depth = self._inner_count = 0
        self._finished: list[Element] = []
        self.parser = expat.ParserCreate()
        # one event for a text with line breaks:
        # https://docs.python.org/3/library/pyexpat.html#xml.parsers.expat.xmlparser.buffer_text
        self.parser.buffer_text = True
        # entities are dangerous: https://docs.python.org/3/library/xml.html
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text

    @property
    def line(self) -> int:
        return self.parser.CurrentLineNumber

    def take(self) -> list[Element]:
        """Return the elements that were finished since the last call."""
        elements, self._finished = self._finished, []
        return elements

    def _doctype(self, *declared: object) -> None:
        raise LogError(
            f"{self.name}:{self.line}: the file declares a document type, whose entities are not trusted;"
            " remove <!DOCTYPE …>"
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            place = f"{self.name}:{self.line}"
            raise LogError(f"{place}: elements are nested deeper than {DEEPEST}; flatten them")
        if self._depth == 1:
            self._finished.append(Element(name, attributes, self.line))
        elif self._open_elements or (self._depth == 2 and name in self._element_names):
            self._begin(Element(name, attributes, self.line))

    def _begin(self, element: Element) -> None:
        self._inner_count = self._inner_count + 1 if self._open_elements else 0
        if self._inner_count > MOST_ELEMENTS:
            outer_element = self._open_elements[0]
            raise LogError(
                f"{self.name}:{outer_element.line}: <{outer_element.name}> has more than {MOST_ELEMENTS}"
                " elements; split it"
            )
        if self._open_elements:
            self._open_elements[-1].children.append(element)
        self._open_elements.append(element)

    def _end(self, name: str) -> None:
        self._depth -= 1
        if self._open_elements:
            element = self._open_elements.pop()
            element.text = element.text.strip()
            if not self._open_elements:
                self._finished.append(element)

    def _text(self, text: str) -> None:
        if self._open_elements and len(self._open_elements[-1].text) < LONGEST_TEXT:
            self._open_elements[-1].text += text[:LONGEST_TEXT]


Points = list[tuple[float, float]]

ReportFault = Callable[[int, str], None]
"""Receiver of faults: (line, text)."""

_LONGEST_STEP = 15
"""Maximum number of digits of a time step."""
_LONGEST_INTERVAL = 100_000
"""Longest interval, time steps."""
_SHAPES = "<rectangle>, <circle> or <polygon>"
_TRUCK_LENGTHS = ("wheelbase", "distFromRearToRearAxle", "cabinLength", "distFromRearAxleToHitch")


class ScenarioError(Exception):
    """A part of a scenario that cannot be understood; the text says why and what to give instead."""


@dataclass(frozen=True, slots=True)
class OutlinePart:
    """A polygon, or a disc with one vertex and a radius, in metres.

    Attributes:
        hitch_x: distance of a trailer's hitch ahead of the origin; a trailer's vertices are relative to the
            hitch. None for other parts.
    """

    vertices: Points
    radius: float = 0.0
    hitch_x: float | None = None

    def turn(self, hitch_angle: float) -> Points:
        """Return the vertices in the obstacle's frame; `hitch_angle` is in radians."""
        if self.hitch_x is None:
            return self.vertices
        cosine, sine = cos(hitch_angle), sin(hitch_angle)
        return [(self.hitch_x + cosine * x - sine * y, sine * x + cosine * y) for x, y in self.vertices]


@dataclass(frozen=True, slots=True)
class ObstacleState:
    """Pose of an obstacle at a time step.

    Attributes:
        x, y: position, metres.
        angle: rotation of the outline, radians.
        hitch_angle: angle of the trailer, radians; 0 without a trailer.
        oriented: whether `angle` is the obstacle's orientation; False if the orientation is unknown.
        uncertainty: largest distance between the true and the stated outline, metres.
        region: outline in the world frame, which replaces the obstacle's outline.
        known: whether the position is known; False if only the presence of the obstacle is known.
    """

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    hitch_angle: float = 0.0
    oriented: bool = False
    uncertainty: float = 0.0
    region: tuple[OutlinePart, ...] | None = None
    known: bool = True

    def report(self, name: str, class_name: str | None, outline: Sequence[OutlinePart]) -> ObjectReport:
        """Return the report of the obstacle in this state; `outline` is relative to the obstacle's centre."""
        if not self.known:
            return ObjectReport(name, class_name, [nan, nan], [1], [0.0], invalid=True)
        parts = self.region if self.region is not None else outline
        cosine, sine = cos(self.angle), sin(self.angle)
        vertices: list[float] = []
        for x, y in (vertex for part in parts for vertex in part.turn(self.hitch_angle)):
            vertices += (self.x + cosine * x - sine * y, self.y + sine * x + cosine * y)
        counts, radii = [len(part.vertices) for part in parts], [part.radius for part in parts]
        yaw = self.angle if self.oriented else nan
        return ObjectReport(name, class_name, vertices, counts, radii, yaw, self.uncertainty)


UNKNOWN = ObstacleState(known=False)


_OBSTACLES = frozenset(
    # versions before 2020a write static and dynamic obstacles as `obstacle` with a role inside
    ["staticObstacle", "dynamicObstacle", "obstacle", "environmentObstacle", "phantomObstacle"]
)

_BLOCK_REPORTS = 2**14
"""Number of obstacle reports at which a block is closed."""


@dataclass(slots=True)
class _Obstacle:
    """One obstacle of a scenario.

    Attributes:
        parts: outline, relative to the obstacle's centre.
        moving_states: states by time step.
        fixed_state: state at every time step; None for a moving obstacle.
    """

    name: str
    class_name: str | None
    parts: list[OutlinePart]
    moving_states: dict[int, ObstacleState] = field(default_factory=dict)
    fixed_state: ObstacleState | None = None


def iter_scenario(path: Path, faults: FaultList, *, concave: Concave = "decompose") -> Iterator[Trace]:
    """Yield the time steps of a CommonRoad scenario in blocks.

    Each time step with a state of a moving obstacle is a sample. Static obstacles are in every sample. Roads,
    planning problems and goals are not objects. Errors go to `faults`.

    Raises:
        LogError: the file is not a scenario.
        UsageError: a scenario without obstacles.
    """
    elements = iter_elements(path, faults, _OBSTACLES)
    step_s = _step_size(path, next(elements))
    obstacles = list(_iter_obstacles(path, faults, elements))
    # a scenario with only static obstacles has one sample, at time step 0
    time_steps = sorted({time_step for obstacle in obstacles for time_step in obstacle.moving_states}) or (
        [0] if obstacles else []
    )
    if not obstacles and not len(faults):
        raise UsageError(f"{path.name} is a scenario without obstacles; give one that has some")
    samples = _iter_samples(path, faults, obstacles, time_steps, step_s)
    yield from iter_traces(samples, faults, concave, most_reports=_BLOCK_REPORTS)


def _iter_samples(
    path: Path, faults: FaultList, obstacles: Sequence[_Obstacle], time_steps: Sequence[int], step_s: Fraction
) -> Iterator[ReportedSample]:
    for time_step in time_steps:
        time_ns = round(time_step * step_s * 10**9)
        if time_ns > LATEST_NS:
            faults.add(f"{path.name}: time step {time_step} lies beyond what a time can be; it is left out")
            continue
        states = (
            (obstacle, obstacle.fixed_state or obstacle.moving_states.get(time_step))
            for obstacle in obstacles
        )
        reports = [
            state.report(obstacle.name, obstacle.class_name, obstacle.parts)
            for obstacle, state in states
            if state is not None
        ]
        yield ReportedSample(time_ns, f"{path.name}: time step {time_step}", reports, {})


def _step_size(path: Path, root: Element) -> Fraction:
    if root.name != "commonRoad":
        raise LogError(f"{path.name} is XML, but not a scenario: its root is <{root.name}>, not <commonRoad>")
    text = root.attributes.get("timeStepSize", "")
    try:
        step_size_s = float(text)
    except ValueError:
        step_size_s = 0.0
    if not 1e-9 <= step_size_s <= 1e9:
        place = f"{path.name}:{root.line}"
        raise LogError(f"{place}: timeStepSize is {text[:60]!r}; give seconds from 1e-9 to 1e9")
    # the fraction equals the written decimal: 0.1 s is exactly 100 ms
    return Fraction(repr(step_size_s))


def _iter_obstacles(path: Path, faults: FaultList, elements: Iterator[Element]) -> Iterator[_Obstacle]:
    used_names = set[str]()
    for element in elements:
        name = element.attributes.get("id", "")
        place = f"{path.name}:{element.line}: <{element.name}>"

        def report(line: int, fault: str, obstacle: str = name) -> None:
            faults.add(f"{path.name}:{line}: obstacle {obstacle}: {fault}")

        try:
            if not name or name in used_names:
                raise ScenarioError(f"id is {name[:60]!r}; give each obstacle one of its own")
            place = f"{path.name}:{element.line}: obstacle {name}"
            obstacle = _obstacle(name, element, report)
        except ScenarioError as error:
            faults.add(f"{place}: {error}; it is left out")
            continue
        used_names.add(name)
        yield obstacle


def _obstacle(name: str, element: Element, report: ReportFault) -> _Obstacle:
    type_element = element.child("type")
    class_name = (type_element.text or None) if type_element is not None else None
    if element.name == "phantomObstacle":
        # a phantom may be present or not, so it is an object of unknown place in every open group
        return _Obstacle(name, class_name, [], dict.fromkeys(_moving_states(element, [], report), UNKNOWN))
    outline = _outline_of(_required_child(element, "shape"))
    if element.name == "environmentObstacle":
        return _Obstacle(name, class_name, outline, fixed_state=ObstacleState())
    role = element.child("role")
    if element.name == "staticObstacle" or (role is not None and role.text == "static"):
        initial_state = _required_child(element, "initialState")
        return _Obstacle(
            name, class_name, outline, fixed_state=_state_or_unknown(initial_state, outline, report)
        )
    return _Obstacle(name, class_name, outline, _moving_states(element, outline, report))


def _moving_states(
    obstacle: Element, outline: Sequence[OutlinePart], report: ReportFault
) -> dict[int, ObstacleState]:
    """Return the states of a moving obstacle by time step.

    Args:
        report: receiver of the faults of single states.
    """
    states: dict[int, ObstacleState] = {}
    initial, trajectory = obstacle.child("initialState"), obstacle.child("trajectory")
    state_elements = [*([initial] if initial else []), *(trajectory.all("state") if trajectory else ())]
    for state_element in state_elements:
        try:
            time_step = _step(_required_child(state_element, "time"))
        except ScenarioError as error:
            report(state_element.line, f"{error}; the state is left out")
            continue
        if time_step in states:
            report(state_element.line, f"time step {time_step} is there twice; the first state counts")
            continue
        states[time_step] = _state_or_unknown(state_element, outline, report)
    occupancy_set = obstacle.child("occupancySet")
    for occupancy in occupancy_set.all("occupancy") if occupancy_set else ():
        for time_step, state in _occupied_states(occupancy, report):
            # an exact state is better than an occupancy of the same time step
            states.setdefault(time_step, state)
    return states


def _state_or_unknown(element: Element, outline: Sequence[OutlinePart], report: ReportFault) -> ObstacleState:
    """Return a state; for an invalid state, report the fault and return `UNKNOWN`."""
    try:
        return _state(element, outline)
    except ScenarioError as error:
        report(element.line, f"{error}; the obstacle is unknown there")
        return UNKNOWN


def _outline_of(shape: Element) -> list[OutlinePart]:
    """Return the outline of an obstacle, relative to the position of its states.

    Raises:
        ScenarioError: the shape is empty or unknown.
    """
    if not shape.children:
        raise ScenarioError(
            f"<{shape.name}> is empty; give {_SHAPES}, <truckShape> or <semiTrailerTruckShape>"
        )
    return [part for child in shape.children for part in _outline_parts(child)]


def _outline_parts(element: Element) -> list[OutlinePart]:
    if element.name == "rectangle":
        return [_rectangle(element, origin_x_shift=_number_or_zero(element, "originXShift"))]
    if element.name == "truckShape":
        return [_truck(element)]
    if element.name == "semiTrailerTruckShape":
        _refuse_unknown(element, "truckShape", "trailerDims")
        truck = _required_child(element, "truckShape")
        return [_truck(truck), _trailer(_required_child(element, "trailerDims"), _hitch_x(truck))]
    return [_part(element)]


def _truck(element: Element) -> OutlinePart:
    _refuse_unknown(element, "truckDims", "originXShift")
    dimensions = _required_child(element, "truckDims")
    _refuse_unknown(dimensions, "length", "width", *_TRUCK_LENGTHS)
    length, width = _size(dimensions, "length"), _size(dimensions, "width")
    return OutlinePart(_corners(length, width, (-_number(element, "originXShift"), 0.0)))


def _hitch_x(truck: Element) -> float:
    """Return the distance of a truck's hitch ahead of the origin, in metres."""
    dimensions = _required_child(truck, "truckDims")
    rear_axle = _size(dimensions, "distFromRearToRearAxle") - _size(dimensions, "length") / 2
    return _number(dimensions, "distFromRearAxleToHitch") + rear_axle - _number(truck, "originXShift")


def _trailer(dimensions: Element, hitch_x: float) -> OutlinePart:
    _refuse_unknown(dimensions, "length", "width", "wheelbase", "distFromFrontToHitch")
    length, width = _size(dimensions, "length"), _size(dimensions, "width")
    center = (_number(dimensions, "distFromFrontToHitch") - length / 2, 0.0)
    return OutlinePart(_corners(length, width, center), hitch_x=hitch_x)


def _parts_of(region: Element) -> list[OutlinePart]:
    """Return the rectangles, circles and polygons of a region in the world frame.

    Raises:
        ScenarioError: the region is empty, or has another shape.
    """
    if not region.children:
        raise ScenarioError(f"<{region.name}> is empty; give {_SHAPES}")
    return [_part(child) for child in region.children]


def _part(element: Element) -> OutlinePart:
    if element.name == "polygon":
        _refuse_unknown(element, "point")
        vertices = [_point(point) for point in element.all("point")]
        if not vertices:
            raise ScenarioError("<polygon> has no <point>; give at least one")
        return OutlinePart(vertices)
    if element.name == "circle":
        _refuse_unknown(element, "radius", "center")
        return OutlinePart([_center(element)], _size(element, "radius"))
    if element.name == "rectangle":
        if element.child("originXShift") is not None:
            raise ScenarioError("a region has no originXShift; give the rectangle its <center>")
        return _rectangle(element)
    raise ScenarioError(f"<{element.name}> is not a shape; give {_SHAPES}")


def _rectangle(element: Element, origin_x_shift: float = 0.0) -> OutlinePart:
    _refuse_unknown(element, "length", "width", "center", "orientation", "originXShift")
    length, width = _size(element, "length"), _size(element, "width")
    angle = _number_or_zero(element, "orientation")
    x, y = _center(element)
    center = (x - origin_x_shift * cos(angle), y - origin_x_shift * sin(angle))
    return OutlinePart(_corners(length, width, center, angle))


def _corners(length: float, width: float, center: tuple[float, float], angle: float = 0.0) -> Points:
    x, y = center
    half_cosine, half_sine = cos(angle) / 2, sin(angle) / 2
    corners = ((-length, -width), (length, -width), (length, width), (-length, width))
    return [(x + a * half_cosine - b * half_sine, y + a * half_sine + b * half_cosine) for a, b in corners]


def _center(element: Element) -> tuple[float, float]:
    center = element.child("center")
    return _point(center) if center is not None else (0.0, 0.0)


def _refuse_unknown(element: Element, *names: str) -> None:
    """Refuse children with other names, because such children could move the outline."""
    for child in element.children:
        if child.name not in names:
            children = ", ".join(f"<{name}>" for name in names)
            raise ScenarioError(f"<{element.name}> has an unknown <{child.name}>; give {children} only")


def _state(element: Element, outline: Sequence[OutlinePart]) -> ObstacleState:
    """Return a state, whose position is a point or a region; each angle is exact or an interval."""
    position = _required_child(element, "position")
    point = position.child("point")
    place_uncertainty = 0.0
    if point is not None:
        x, y = _point(point)
    elif position.child("lanelet") is not None:
        # the position is somewhere on a lane, and roads are not read
        return UNKNOWN
    else:
        x, y, place_uncertainty = _around(_parts_of(position))
    low_angle, high_angle = _angle(element, "orientation", (-pi, pi))
    low_hitch, high_hitch = _angle(element, "hitchAngle", (0.0, 0.0))
    hitch_angle = (low_hitch + high_hitch) / 2
    trailers = [part for part in outline if part.hitch_x is not None]
    turn_uncertainty = _turn_shift([part.turn(hitch_angle) for part in outline], high_angle - low_angle)
    turn_uncertainty += _turn_shift([trailer.vertices for trailer in trailers], high_hitch - low_hitch)
    if not all(map(isfinite, (x, y, low_angle, high_angle, place_uncertainty, hitch_angle))):
        return UNKNOWN
    return ObstacleState(
        x,
        y,
        (low_angle + high_angle) / 2,
        hitch_angle,
        low_angle == high_angle,
        uncertainty=place_uncertainty + turn_uncertainty,
    )


def _turn_shift(outlines: Sequence[Points], angle: float) -> float:
    """Return the largest shift of a vertex if outlines turn by up to half of `angle` in either direction."""
    # a turn by h moves a vertex at a distance r from the origin by 2 r sin(h / 2), and h is angle / 2
    reach = max((hypot(*vertex) for outline in outlines for vertex in outline), default=0.0)
    return 2 * reach * sin(min(angle, 2 * pi) / 4)


def _angle(state: Element, name: str, default: tuple[float, float]) -> tuple[float, float]:
    """Return the interval of an angle, in radians; both ends are equal for an exact angle."""
    angle_element = state.child(name)
    if angle_element is None:
        return default
    if angle_element.child("exact") is not None:
        exact_angle = _number(angle_element, "exact")
        return exact_angle, exact_angle
    low, high = _number(angle_element, "intervalStart"), _number(angle_element, "intervalEnd")
    if low > high:
        raise ScenarioError(f"{name} is from {low:g} to {high:g}; give its start before its end")
    return low, high


def _occupied_states(occupancy: Element, report: ReportFault) -> Iterator[tuple[int, ObstacleState]]:
    """Yield each time step of an occupancy, with the state of an obstacle somewhere in the region."""
    try:
        time_steps = _steps(_required_child(occupancy, "time"))
        parts = _parts_of(_required_child(occupancy, "shape"))
        # the true outline is inside the region, so a diameter of the region limits the error of its points
        region = _hull(parts)
        _, _, reach = _around([region])
        state = ObstacleState(uncertainty=2 * reach, region=(region,)) if isfinite(reach) else UNKNOWN
    except ScenarioError as error:
        report(occupancy.line, f"{error}; the occupancy is left out")
        return
    for time_step in time_steps:
        yield time_step, state


def _hull(parts: Sequence[OutlinePart]) -> OutlinePart:
    # the hull of several parts is no polygon if one of the parts is a disc
    if len(parts) > 1 and any(part.radius for part in parts):
        x, y, radius = _around(parts)
        return OutlinePart([(x, y)], radius)
    if len(parts) == 1 and parts[0].radius:
        return parts[0]
    try:
        hull = Footprint.polygon([vertex for part in parts for vertex in part.vertices], concave="hull")
    except GeometryError as error:
        raise ScenarioError(str(error)) from None
    return OutlinePart([(float(x), float(y)) for x, y in hull.parts[0].vertices])


def _around(parts: Sequence[OutlinePart]) -> tuple[float, float, float]:
    """Return a disc around all parts: x, y, radius."""
    vertices = [vertex for part in parts for vertex in part.vertices]
    x, y = (fsum(vertex[axis] for vertex in vertices) / len(vertices) for axis in (0, 1))
    return x, y, max(hypot(a - x, b - y) + part.radius for part in parts for a, b in part.vertices)


def _steps(time: Element) -> range:
    """Return the time steps of an exact time or an interval."""
    if time.child("intervalStart") is None:
        step = _step(time)
        return range(step, step + 1)
    first_step, last_step = (_whole(_required_child(time, name)) for name in ("intervalStart", "intervalEnd"))
    if not 0 <= last_step - first_step <= _LONGEST_INTERVAL:
        remedy = f"give an interval of 0 to {_LONGEST_INTERVAL}"
        raise ScenarioError(f"time is from step {first_step} to {last_step}; {remedy}")
    return range(first_step, last_step + 1)


def _step(time: Element) -> int:
    if time.child("intervalStart") is not None:
        raise ScenarioError("time is an interval; give <exact> for a state")
    return _whole(_required_child(time, "exact"))


def _whole(element: Element) -> int:
    text = element.text
    # `int` also accepts signs, spaces, underscores and digits of other scripts
    if not (len(text) <= _LONGEST_STEP and text.isascii() and text.isdecimal()):
        raise ScenarioError(f"a time step is {text[:60]!r}; give an integer from 0 on")
    return int(text)


def _point(element: Element) -> tuple[float, float]:
    return _number(element, "x"), _number(element, "y")


def _size(element: Element, name: str) -> float:
    size = _number(element, name)
    if size < 0:
        raise ScenarioError(f"{name} is {size:g}; give a size of at least 0")
    return size


def _number(element: Element, name: str) -> float:
    text = _required_child(element, name).text
    try:
        return float(text)
    except ValueError:
        raise ScenarioError(f"{name} is {text[:60]!r}; give a number") from None


def _number_or_zero(element: Element, name: str) -> float:
    return _number(element, name) if element.child(name) is not None else 0.0


def _required_child(element: Element, name: str) -> Element:
    child = element.child(name)
    if child is None:
        raise ScenarioError(f"<{element.name}> has no <{name}>; give it one")
    return child
