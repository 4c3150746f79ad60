"""CommonRoad scenarios: traffic, as outlines that move from one time step to the next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from math import isfinite
from pathlib import Path

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.block import BLOCK_SAMPLES
from spatial_replay.logs.commonroad_states import (
    UNKNOWN,
    Part,
    ScenarioError,
    State,
    Tell,
    moving_states,
    parts_of,
    state_of,
)
from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.reports import Report, ReportColumns
from spatial_replay.logs.tracks import finished_block
from spatial_replay.logs.xml_elements import Element, iter_elements
from spatial_replay.trace.times import LATEST_NS
from spatial_replay.trace.trace import Trace

_OBSTACLES = frozenset(
    # `obstacle`, with its role inside, is how versions before 2020a write the first two
    ["staticObstacle", "dynamicObstacle", "obstacle", "environmentObstacle", "phantomObstacle"]
)

_BLOCK_REPORTS = 2**14
"""A block is closed when it holds this many obstacles, however few its time steps are."""


@dataclass(slots=True)
class _Obstacle:
    """One obstacle of a scenario.

    Attributes:
        parts: its outline, around its own centre.
        moving: where it is, by time step.
        standing: where it is at every time step, if it does not move.
    """

    name: str
    class_name: str | None
    parts: list[Part]
    moving: dict[int, State] = field(default_factory=dict)
    standing: State | None = None

    def report(self, step: int) -> Report | None:
        """The obstacle at a time step; None if it is not there."""
        state = self.standing or self.moving.get(step)
        return None if state is None else state.report(self.name, self.class_name, self.parts)


def is_scenario(head: bytes) -> bool:
    """Whether a file begins as an XML file does."""
    return (
        head.removeprefix(b"\xef\xbb\xbf")
        .lstrip()
        .startswith((b"<?xml", b"<!--", b"<!DOCTYPE", b"<commonRoad"))
    )


def iter_scenario(path: Path, faults: FaultList, *, concave: Concave = "decompose") -> Iterator[Trace]:
    """The time steps of a CommonRoad scenario in blocks.

    A sample is a time step that some moving obstacle has a state for; obstacles that do not move are in each
    of them. The road, planning problems and their goals are no objects. What is wrong goes to `faults`.

    Raises:
        LogError: the file is no scenario.
        UsageError: a scenario without obstacles.
    """
    elements = iter_elements(path, faults, _OBSTACLES)
    step_s = _step_size(path, next(elements))
    obstacles = list(_iter_obstacles(path, faults, elements))
    steps = sorted({step for each in obstacles for step in each.moving}) or ([0] if obstacles else [])
    if not obstacles and not len(faults):
        raise UsageError(f"{path.name} is a scenario without obstacles; give one that has some")
    columns = ReportColumns()
    held = 0
    for step in steps:
        time_ns = round(step * step_s * 10**9)
        if time_ns > LATEST_NS:
            faults.add(f"{path.name}: time step {step} lies beyond what a time can be; it is left out")
            continue
        reports = [report for each in obstacles if (report := each.report(step)) is not None]
        columns.add(time_ns, f"{path.name}: time step {step}", reports, {})
        held += len(reports)
        if len(columns) == BLOCK_SAMPLES or held >= _BLOCK_REPORTS:
            yield finished_block(columns, faults, concave)
            columns, held = ReportColumns(), 0
    if len(columns):
        yield finished_block(columns, faults, concave)


def _step_size(path: Path, root: Element) -> Fraction:
    if root.name != "commonRoad":
        raise LogError(f"{path.name} is XML, but no scenario: its root is <{root.name}>, not <commonRoad>")
    text = root.attributes.get("timeStepSize", "")
    try:
        size = float(text)
    except ValueError:
        size = 0.0
    if not (isfinite(size) and 1e-9 <= size <= 1e9):
        raise LogError(
            f"{path.name}:{root.line}: timeStepSize is {text[:60]!r}; give seconds from 1e-9 to 1e9"
        )
    # as it is written: 0.1 s are 100 ms to the nanosecond
    return Fraction(repr(size))


def _iter_obstacles(path: Path, faults: FaultList, elements: Iterator[Element]) -> Iterator[_Obstacle]:
    names = set[str]()
    for element in elements:
        name = element.attributes.get("id", "")
        place = f"{path.name}:{element.line}: <{element.name}>"
        try:
            if not name or name in names:
                raise ScenarioError(f"id is {name[:60]!r}; give each obstacle one of its own")
            place = f"{path.name}:{element.line}: obstacle {name}"
            obstacle = _obstacle(name, element, partial(_tell, faults, path.name, name))
        except ScenarioError as error:
            faults.add(f"{place}: {error}; it is left out")
            continue
        names.add(name)
        yield obstacle


def _tell(faults: FaultList, file: str, obstacle: str, line: int, what: str) -> None:
    faults.add(f"{file}:{line}: obstacle {obstacle}: {what}")


def _obstacle(name: str, element: Element, tell: Tell) -> _Obstacle:
    kind = element.child("type")
    class_name = (kind.text or None) if kind is not None else None
    if element.name == "phantomObstacle":
        # it may be there or not: a member of every open group that nothing is known about
        return _Obstacle(name, class_name, [], dict.fromkeys(moving_states(element, [], tell), UNKNOWN))
    shape = element.child("shape")
    if shape is None:
        raise ScenarioError("it has no <shape>; give it one")
    outline = parts_of(shape)
    if element.name == "environmentObstacle":
        return _Obstacle(name, class_name, outline, standing=State())
    if _stands(element):
        initial = element.child("initialState")
        if initial is None:
            raise ScenarioError("it has no <initialState>; give it one")
        return _Obstacle(name, class_name, outline, standing=state_of(initial, outline, tell))
    return _Obstacle(name, class_name, outline, moving_states(element, outline, tell))


def _stands(element: Element) -> bool:
    role = element.child("role")
    return element.name == "staticObstacle" or (role is not None and role.text == "static")
