"""Detections to samples: which objects are where, how certainly, and which are hidden."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
from spatial_replay.perception.frame import Frame
from spatial_replay.perception.object_poses import (
    ObjectPose,
    fused,
    pose_in_space,
    poses_on_plane,
    radius,
)
from spatial_replay.perception.opencv import Detection, TagDetector
from spatial_replay.perception.plane import CameraPlane, Fit, Plane, given_plane, plane_from_references
from spatial_replay.perception.tags_file import LEAST_REFERENCES, TaggedObject, TagsFile
from spatial_replay.text import counted
from spatial_replay.trace.sample import Sample

_MOST_AVERAGED: Final = 30
"""Detections of a reference tag that are averaged."""

_MOVED: Final = 2.0
"""Pixels beyond which a reference tag is no longer where it was: the camera has moved."""

_MOST_NAMED: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What one frame shows.

    Attributes:
        sample: the objects.
        frame: it.
        detections: all tags, those that no one mapped, too.
        plane: None as long as reference tags are missing.
    """

    sample: Sample
    frame: Frame
    detections: tuple[Detection, ...]
    plane: Plane | None


class TagObserver:
    """Turns the frames of one camera, which stands still, into samples; a process for one run.

    An object whose tags are hidden is unknown, and so is one whose tag cannot be where it appears; when held,
    a hidden one stays where it was for a while, with an uncertainty that grows by its highest speed.

    Attributes:
        tags: the tags file.
        hold_ns: how long a hidden object is held.
    """

    def __init__(self, tags: TagsFile, *, hold_ns: int | None = None) -> None:
        """Prepare the detector.

        Args:
            hold_ns: how long a hidden object is held; None for what the tags file says.

        Raises:
            UsageError: a time below 0; OpenCV is not installed.
        """
        hold_ns = tags.hold_ns if hold_ns is None else hold_ns
        if hold_ns < 0:
            raise UsageError(f"objects are held for {hold_ns} ns; give 0 or more")
        self.tags, self.hold_ns = tags, hold_ns
        self._detector = TagDetector(tags.family)
        self._plane: Plane | None = None
        self._size: tuple[int, int] | None = None
        self._fit: Fit | None = None
        self._averages: dict[int, tuple[Floats, int]] = {}
        self._last: dict[str, tuple[int, TrackedObject]] = {}
        self._hidden: dict[str, str | None] = {}
        self._outlines = {each.name: _outline(each.footprint) for each in tags.objects}
        self._seen: Counter[int] = Counter()
        self._twice: Counter[int] = Counter()
        self._doubts: dict[str, tuple[str, int]] = {}
        self._frames = self._moved = 0

    @property
    def fit(self) -> Fit | None:
        """How the reference tags fit; None without any."""
        return self._fit

    def observe(self, frame: Frame) -> Observation:
        """Return what a frame shows.

        Raises:
            UsageError: the camera is calibrated for another size, or the reference tags do not fit.
        """
        self._frames += 1
        detections = self._detector.detect(frame.image)
        usable = self._single(detections)
        height, width = frame.image.shape[:2]
        if self._size != (width, height):
            self._size, self._plane = (width, height), given_plane(self.tags, (width, height))
            self._averages.clear()
        self._refer(usable)
        objects: dict[str, TrackedObject] = {}
        plane = self._plane
        if plane is not None:
            objects = dict(self._located(plane, usable))
        sample = Sample(
            frame.time_ns, {**objects, **self._held(frame.time_ns, objects)}, unknown=self._hidden
        )
        return Observation(sample, frame, tuple(detections), plane)

    def _single(self, detections: Iterable[Detection]) -> dict[int, Floats]:
        """Return the corners of the tags that are in the image once: of two, no one knows which it is."""
        times = Counter(each.id for each in detections)
        self._seen.update(times.keys())
        self._twice.update(number for number, count in times.items() if count > 1)
        return {each.id: each.corners for each in detections if times[each.id] == 1}

    # ------------------------------------------------------------------------------------- the plane

    def _refer(self, corners: Mapping[int, Floats]) -> None:
        """Take in the reference tags, and fit the plane again while their averages still change."""
        if not self.tags.references or self.tags.pose is not None:
            return
        present = {each.id: corners[each.id] for each in self.tags.references if each.id in corners}
        before = {number: self._averages[number] for number in present if number in self._averages}
        off = [float(np.linalg.norm(present[n] - mean, axis=1).mean()) for n, (mean, _) in before.items()]
        if off and float(np.median(off)) > _MOVED:
            self._moved += 1
            self._averages.clear()
        is_new = False
        for number, each in present.items():
            mean, count = self._averages.get(number, (each, 0))
            if count < _MOST_AVERAGED:
                is_new = True
                self._averages[number] = (mean + (each - mean) / (count + 1), count + 1)
        if not is_new:
            return
        if len(self._averages) < LEAST_REFERENCES:
            self._plane = None
            return
        try:
            self._fit = plane_from_references(self.tags, {n: mean for n, (mean, _) in self._averages.items()})
            self._plane = self._fit.plane
        except UsageError:
            # what fitted before does not while the camera or a tag moves
            if self._fit is None:
                raise
            self._plane = None

    # ------------------------------------------------------------------------------------- the objects

    def _located(self, plane: Plane, corners: Mapping[int, Floats]) -> Iterator[tuple[str, TrackedObject]]:
        """Yield the objects whose tags are in the image, where nothing speaks against their places."""
        present = sorted(number for number in corners if number in self.tags.by_id)
        flat = [number for number in present if not self.tags.by_id[number][0].is_lifted]
        sigmas = self.tags.sigmas
        poses: dict[int, ObjectPose] = {}
        if flat:
            of_flat = np.stack([corners[number] for number in flat])
            mounted = [self.tags.by_id[number][1] for number in flat]
            poses |= zip(flat, poses_on_plane(plane, of_flat, mounted, sigmas), strict=True)
        if isinstance(plane, CameraPlane):
            for number in present:
                found, tag = self.tags.by_id[number]
                pose = pose_in_space(plane, corners[number], tag, sigmas) if found.is_lifted else None
                if pose is not None:
                    poses[number] = pose
        for each in self.tags.objects:
            own = [poses[tag.id] for tag in each.tags if tag.id in poses]
            sound = [pose for pose in own if pose.doubt is None]
            for pose in own:
                if pose.doubt is not None:
                    text, count = self._doubts.get(each.name, (pose.doubt, 0))
                    self._doubts[each.name] = text, count + 1
            if sound:
                yield each.name, self._tracked(each, fused(sound))

    def _tracked(self, each: TaggedObject, pose: ObjectPose) -> TrackedObject:
        height = each.height
        if height is not None and each.is_lifted:
            height = height[0] + float(pose.place[2]), height[1] + float(pose.place[2])
        return TrackedObject(
            _moved(each.footprint, float(pose.place[0]), float(pose.place[1]), pose.yaw),
            class_name=each.class_name,
            yaw=math.remainder(pose.yaw, 2 * math.pi),
            height=height,
            uncertainty=radius(pose, self._outlines[each.name], self.tags.sigmas),
        )

    def _held(self, time_ns: int, objects: Mapping[str, TrackedObject]) -> dict[str, TrackedObject]:
        """Return the hidden objects that are held; remember where the others are, and which are unknown."""
        held: dict[str, TrackedObject] = {}
        for each in self.tags.objects:
            if each.name in objects:
                self._last[each.name] = time_ns, objects[each.name]
                self._hidden.pop(each.name, None)
            elif each.name in self._last:
                since_ns, last = self._last[each.name]
                if time_ns - since_ns <= self.hold_ns:
                    grown = last.uncertainty + each.fastest * (time_ns - since_ns) / 1e9
                    # a yaw has no uncertainty: of what may have turned, it is unknown
                    yaw = None if each.fastest else last.yaw
                    held[each.name] = TrackedObject(last.footprint, last.class_name, yaw, last.height, grown)
                else:
                    self._hidden[each.name] = each.class_name
        return held

    # ------------------------------------------------------------------------------------- remarks

    @property
    def frames(self) -> int:
        """How many frames were observed."""
        return self._frames

    @property
    def has_tags(self) -> bool:
        """Whether any tag of the file was in any frame."""
        return any(number in self.tags.ids for number in self._seen)

    def remarks(self) -> tuple[str, ...]:
        """Return what is worth knowing about the run: tags that are not in the file, objects never seen."""
        lines: list[str] = []
        name, frames = self.tags.name, counted(self._frames, "frame")
        if self._frames and not self._seen:
            lines.append(
                f"no tag of family {self.tags.family} is in any of {frames}; check the family, the light,"
                " that tags are 20 pixels or larger, with a white rim, and that the camera looks from above"
            )
            return tuple(lines)
        unmapped = [number for number in sorted(self._seen) if number not in self.tags.ids]
        if unmapped:
            listed = [f"{number} (in {counted(self._seen[number], 'frame')})" for number in unmapped]
            lines.append(f"{name} has no {_tags(listed)}")
        missing = [each for each in self.tags.objects if not any(tag.id in self._seen for tag in each.tags)]
        lines += [
            f"{each.name} was never seen: no {_tags([str(tag.id) for tag in each.tags])} in {frames}"
            for each in missing[:_MOST_NAMED]
        ]
        if self._frames and self.tags.references and self._plane is None:
            absent = [str(each.id) for each in self.tags.references if each.id not in self._seen]
            lines.append(
                f"the plane is not known: fewer than {LEAST_REFERENCES} reference tags were seen; there was"
                f" no {_tags(absent)}"
            )
        for number, count in sorted(self._twice.items()):
            lines.append(f"tag {number} is in {counted(count, 'frame')} more than once, and left out there")
        for each_name, (text, count) in sorted(self._doubts.items()):
            lines.append(f"{each_name} is unknown in {counted(count, 'frame')}: {text}")
        if self._moved:
            lines.append(
                f"the camera has moved {counted(self._moved, 'time')}: places are uncertain while it does"
            )
        return tuple(lines)


def observe_frames(
    frames: Iterable[Frame], tags: TagsFile, *, hold_ns: int | None = None
) -> Iterator[Observation]:
    """Yield what frames show, one by one; see `TagObserver`."""
    observer = TagObserver(tags, hold_ns=hold_ns)
    for frame in frames:
        yield observer.observe(frame)


def _tags(numbers: list[str]) -> str:
    shown = numbers[:_MOST_NAMED] + (["…"] if len(numbers) > _MOST_NAMED else [])
    return f"tag{'s' if len(numbers) > 1 else ''} {', '.join(shown)}"


def _outline(footprint: Footprint) -> Floats:
    """Return the points of a footprint that move furthest when it turns, (K, 2): rounding turns in itself."""
    return np.concatenate([part.vertices for part in footprint.parts])


def _moved(footprint: Footprint, x: float, y: float, yaw: float) -> Footprint:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return Footprint(
        tuple(ConvexPart(part.vertices @ turn + np.array([x, y]), part.radius) for part in footprint.parts)
    )
