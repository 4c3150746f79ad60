"""The scene of a run as an animation: outlines, colours and the worst violation, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.annotate.scene.scene_frames import (
    SHADES,
    DrawnEntity,
    DrawnViolation,
    SceneFrame,
    SceneFrames,
)
from spatial_replay.annotate.scene.scene_template import REGION
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.report.compact import Packing

MOST_FRAMES: Final = 3_000
"""Frames of a page, at most."""
MOST_CORNERS: Final = 2_000_000
"""Corners of the outlines in all frames together, at most."""
MOST_ARROWS: Final = 30_000
"""Arrows in all frames together, at most: of so many results, the worst first, as may have one in each."""
_ABSENT: Final = 65_535
_STEPS: Final = 65_535
"""Steps of a coordinate along each side of the scene: 16 bits, finer than any screen."""


@dataclass(frozen=True, eq=False)
class ReportedScene:
    """Frames of a scene.

    Attributes:
        times_ns: (F,) int64.
        stride: every how many messages there is a frame.
    """

    times_ns: Integers
    frames: tuple[SceneFrame, ...]
    stride: int

    def at(self, times_ns: Integers) -> ReportedScene:
        """Return the scene with its frames at some times only."""
        is_kept = np.isin(self.times_ns, times_ns).tolist()
        frames = tuple(frame for frame, kept in zip(self.frames, is_kept, strict=True) if kept)
        return replace(self, times_ns=self.times_ns[is_kept], frames=frames)


class SceneCollector:
    """Collects frames as they come; if there are too many, it drops every other one."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, SceneFrame]] = []
        self._count, self._stride, self._corners = 0, 1, 0
        self._last_ns: int | None = None

    def add(self, frames: SceneFrames) -> None:
        """Take in what the next messages show."""
        # no others have a place
        chosen = np.arange(-self._count % self._stride, len(frames.times_ns), self._stride)
        is_again = len(frames.times_ns) > 0 and int(frames.times_ns[0]) == self._last_ns
        frames = replace(frames, chosen=np.union1d(chosen, [0]) if is_again else chosen)
        for index, time_ns in enumerate(frames.times_ns.tolist()):
            self.add_frame(time_ns, partial(frames.frame, index))

    def add_frame(self, time_ns: int, frame_of: Callable[[], SceneFrame]) -> None:
        """Take in the next frame, which is made only if it has a place.

        One of the same time as the frame before, that of the finished log, is the last and replaces it.
        """
        if time_ns == self._last_ns:
            while self._frames and self._frames[-1][0] == time_ns:
                self._frames.pop()
            self._frames.append((time_ns, frame_of()))
            return
        self._last_ns = time_ns
        if self._count % self._stride == 0:
            frame = frame_of()
            self._frames.append((time_ns, frame))
            self._corners += frame.corners
        self._count += 1
        while len(self._frames) > MOST_FRAMES or (self._corners > MOST_CORNERS and len(self._frames) > 2):
            self._frames = self._frames[::2]
            self._stride *= 2
            self._corners = sum(frame.corners for _, frame in self._frames)

    @property
    def scene(self) -> ReportedScene:
        """The frames so far."""
        times_ns = np.array([time_ns for time_ns, _ in self._frames], np.int64)
        return ReportedScene(times_ns, tuple(frame for _, frame in self._frames), self._stride)


class _Box(NamedTuple):
    """The part of the plane that everything lies in: its lower left corner, and its size, above 0."""

    low: Floats
    size: Floats

    def steps(self, points: Floats) -> Floats:
        """Return points (n, 2) in steps of the box."""
        return np.asarray(np.round((points - self.low) / self.size * _STEPS))


def scene_value(
    scene: ReportedScene, first_ns: int, places: Mapping[tuple[int, int], tuple[int, int]], packing: Packing
) -> Mapping[str, Any]:
    """Return the scene as the page reads it; coordinates are in steps of the box that everything lies in.

    Args:
        places: of results and their nodes, where the page has them.
    """
    entities = _entities(scene.frames)
    # of one result there is one arrow in a frame
    results = dict(sorted((result, place) for (result, _), (place, _) in places.items()))
    listed = sorted(results, key=results.__getitem__)
    most = max(1, MOST_ARROWS // max(len(scene.frames), 1))
    shown = [
        (number, arrow)
        for number, frame in enumerate(scene.frames)
        for result, place in results.items()
        if place < most and (arrow := frame.violation(result)) is not None
    ]
    arrows = [arrow for _, arrow in shown]
    box = _box(entities, arrows)
    return {
        "times": packing.add((scene.times_ns - first_ns) / 1e9, "f8"),
        "stride": scene.stride,
        "shades": packing.add(SHADES, "u1"),
        "low": box.low.tolist(),
        "high": (box.low + box.size).tolist(),
        "entities": [
            _entity_value(identifier, shown, len(scene.frames), listed, box, packing)
            for identifier, shown in sorted(entities.items(), key=_drawing_order)
        ],
        "violations": {
            "frames": packing.add(np.array([number for number, _ in shown]), "i4"),
            "points": packing.add(box.steps(_joined([each.ends for each in arrows])), "u2"),
            "labels": [each.label for each in arrows],
            "atoms": [each.atom for each in arrows],
            "robustness": packing.add(np.array([each.robustness for each in arrows]), "f8"),
            "holds": packing.add(np.array([each.holds for each in arrows]), "u1"),
            # of those about an earlier sample
            "moments": [
                None if each.moment_ns is None else (each.moment_ns - first_ns) / 1e9 for each in arrows
            ],
            # the result and the node of the page, -1 where the page leaves the node out
            "places": packing.add(
                np.array(
                    [places.get((each.result, each.node), (results[each.result], -1)) for each in arrows]
                ),
                "i4",
            ),
        },
    }


def _drawing_order(item: tuple[str, Any]) -> tuple[bool, str]:
    """Order regions before objects, which are drawn over them."""
    return not item[0].startswith(REGION), item[0]


def _entities(frames: Sequence[SceneFrame]) -> Mapping[str, dict[int, DrawnEntity]]:
    """Return what is drawn, by entity and frame."""
    found: dict[str, dict[int, DrawnEntity]] = {}
    for number, frame in enumerate(frames):
        for identifier, drawn in frame.entities.items():
            found.setdefault(identifier, {})[number] = drawn
    return found


def _box(entities: Mapping[str, Mapping[int, DrawnEntity]], arrows: Sequence[DrawnViolation]) -> _Box:
    rings = [ring for shown in entities.values() for each in shown.values() for ring in each.rings]
    everything = _joined([*rings, *(each.ends for each in arrows)])
    if not len(everything):
        return _Box(np.zeros(2), np.ones(2))
    low, size = everything.min(axis=0), np.ptp(everything, axis=0)
    return _Box(low, np.where(size > 0.0, size, 1.0))


def _joined(points: Sequence[Floats]) -> Floats:
    """Return all points, (n, 2)."""
    return np.concatenate([np.empty((0, 2)), *points])


def _entity_value(
    identifier: str,
    shown: Mapping[int, DrawnEntity],
    frames: int,
    results: Sequence[int],
    box: _Box,
    packing: Packing,
) -> Mapping[str, Any]:
    """Return one entity: its form in each frame, and its points and colours in the frames that have it.

    Args:
        results: those of the page, which it has shades for in this order.
    """
    forms: dict[tuple[int, ...], int] = {}
    of_frame = np.full(frames, _ABSENT, np.int64)
    for number, each in shown.items():
        form = tuple(len(ring) for ring in each.rings)
        of_frame[number] = forms.setdefault(form, len(forms))
    kind, _, name = identifier.partition("/")
    rings = [ring for each in shown.values() for ring in each.rings]
    has_shades = all(each.shades for each in shown.values())
    shades = [np.frombuffer(each.shades, np.uint8)[list(results)] for each in shown.values() if has_shades]
    return {
        "kind": kind,
        "name": name,
        "forms": list(forms),
        "form": packing.add(of_frame, "u2"),
        "points": packing.add(box.steps(_joined(rings)), "u2"),
        "colours": packing.add(np.array([each.colour for each in shown.values()]), "u1"),
        "shades": packing.add(np.array(shades), "u1") if has_shades else None,
    }
