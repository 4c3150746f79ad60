"""Cameras to samples: which objects are where, how certainly, and which are hidden."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
from spatial_replay.perception.camera_view import CameraView, View, tags_listed
from spatial_replay.perception.frame import Detection, Frame
from spatial_replay.perception.object_poses import ObjectPose, fused, radius
from spatial_replay.perception.plane import Fit, Plane
from spatial_replay.perception.simultaneous import camera_names, simultaneous
from spatial_replay.perception.tags_file import TaggedObject, TagsFile
from spatial_replay.text import counted
from spatial_replay.trace.sample import Sample

_MOST_NAMED: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What the frames of one time show.

    Attributes:
        sample: the objects.
        views: by camera; None of one that has no frame then.
    """

    sample: Sample
    views: tuple[View | None, ...]

    @property
    def first(self) -> View:
        """The view of the first camera that has one."""
        return next(view for view in self.views if view is not None)

    @property
    def frame(self) -> Frame:
        """The frame of that camera."""
        return self.first.frame

    @property
    def detections(self) -> tuple[Detection, ...]:
        """All its tags, those that no one mapped, too."""
        return self.first.detections

    @property
    def plane(self) -> Plane | None:
        """Its plane; None as long as reference tags are missing."""
        return self.first.plane


class TagObserver:
    """Turns the frames of cameras, which stand still, into samples; a process for one run.

    An object whose tags are hidden from all cameras is unknown, and so is one whose tag cannot be where it
    appears; when held, a hidden one stays where it was for a while, with an uncertainty that grows by its
    highest speed.

    Attributes:
        tags: the tags file.
        hold_ns: how long a hidden object is held.
    """

    def __init__(self, tags: TagsFile, *, hold_ns: int | None = None, cameras: Sequence[str] = ("",)) -> None:
        """Prepare the detectors.

        Args:
            hold_ns: how long a hidden object is held; None for what the tags file says.
            cameras: their names, as those of their videos; without any, there is one.

        Raises:
            UsageError: a time below 0, a camera that the tags file does not have; OpenCV is not installed.
        """
        hold_ns = tags.hold_ns if hold_ns is None else hold_ns
        if hold_ns < 0:
            raise UsageError(f"objects are held for {hold_ns} ns; give 0 or more")
        self.tags, self.hold_ns = tags, hold_ns
        count = len(cameras)
        self._cameras = [
            CameraView(name if count > 1 else "", tags.of_camera(name, number, count=count))
            for number, name in enumerate(cameras, 1)
        ]
        self._last: dict[str, tuple[int, TrackedObject]] = {}
        self._hidden: dict[str, str | None] = {}
        self._outlines = {each.name: _outline(each.footprint) for each in tags.objects}
        self._doubts: dict[str, tuple[str, int]] = {}
        self._apart: dict[str, tuple[float, int]] = {}
        self._frames = self._last_ns = 0

    @property
    def fits(self) -> tuple[Fit | None, ...]:
        """How the reference tags fit in each camera; None without any."""
        return tuple(camera.fit for camera in self._cameras)

    def observe(self, *frames: Frame | None) -> Observation:
        """Return what the frames of one time show.

        The sample has the stamp of the first of them. Frames of other cameras may be earlier or later: what
        only they show is as much less certain as it may have moved in between.

        Args:
            frames: one of each camera; None of one that has no frame then, but not of all.

        Raises:
            UsageError: a frame that is not after the one before, a camera that is calibrated for another
                size, reference tags that do not fit.
        """
        if len(frames) != len(self._cameras) or all(frame is None for frame in frames):
            raise UsageError(
                f"{counted(len(self._cameras), 'camera')}: give a frame or None of each, not only None"
            )
        time_ns = next(frame.time_ns for frame in frames if frame is not None)
        if self._frames and time_ns <= self._last_ns:
            raise UsageError(
                f"a frame at {time_ns / 1e9:.3f} s follows one at {self._last_ns / 1e9:.3f} s; give frames"
                " with increasing times"
            )
        self._frames += 1
        self._last_ns = time_ns
        views: list[View | None] = []
        poses: list[tuple[int, Mapping[int, ObjectPose]]] = []
        for camera, frame in zip(self._cameras, frames, strict=True):
            view = None
            if frame is not None:
                try:
                    view, found = camera.look(frame)
                except UsageError as error:
                    raise UsageError(f"{camera.name}: {error}" if camera.name else str(error)) from None
                poses.append((abs(frame.time_ns - time_ns), found))
            views.append(view)
        objects = dict(self._located(poses))
        sample = Sample(time_ns, {**objects, **self._held(time_ns, objects)}, unknown=self._hidden)
        return Observation(sample, tuple(views))

    # ------------------------------------------------------------------------------------- the objects

    def _located(
        self, poses: Sequence[tuple[int, Mapping[int, ObjectPose]]]
    ) -> Iterator[tuple[str, TrackedObject]]:
        """Yield the objects whose tags are in an image, where nothing speaks against their places.

        Args:
            poses: of each camera that has a frame: by how much it is off in time, and the poses by tag.
        """
        for each in self.tags.objects:
            own = [(off, found[tag.id]) for off, found in poses for tag in each.tags if tag.id in found]
            for _, pose in own:
                if pose.doubt is not None:
                    text, count = self._doubts.get(each.name, (pose.doubt, 0))
                    self._doubts[each.name] = text, count + 1
            sound = [(off, pose) for off, pose in own if pose.doubt is None]
            # frames that are off in time are taken where they make the object more certain
            found_at = [
                self._tracked(each, fused([pose for off, pose in sound if off <= latest]), latest)
                for latest in sorted({off for off, _ in sound})
            ]
            self._compare(each, [pose for _, pose in sound])
            if found_at:
                yield each.name, min(found_at, key=lambda tracked: tracked.uncertainty)

    def _compare(self, each: TaggedObject, poses: Sequence[ObjectPose]) -> None:
        """Take note of tags that place an object further apart than it is large, beyond what is uncertain."""
        if len(poses) < 2:
            return
        outline = self._outlines[each.name]
        size = 2 * max(
            float(np.linalg.norm(outline, axis=1).max()), *(part.radius for part in each.footprint.parts)
        )
        unsure = 2 * max(radius(pose, outline, self.tags.sigmas) for pose in poses)
        apart = max(float(np.linalg.norm((poses[0].place - pose.place)[:2])) for pose in poses)
        if apart > size + unsure:
            most, count = self._apart.get(each.name, (0.0, 0))
            self._apart[each.name] = max(most, apart), count + 1

    def _tracked(self, each: TaggedObject, pose: ObjectPose, off_ns: int) -> TrackedObject:
        height = each.height
        if height is not None and each.is_lifted:
            height = height[0] + float(pose.place[2]), height[1] + float(pose.place[2])
        return TrackedObject(
            _moved(each.footprint, float(pose.place[0]), float(pose.place[1]), pose.yaw),
            class_name=each.class_name,
            yaw=math.remainder(pose.yaw, 2 * math.pi),
            height=height,
            uncertainty=radius(pose, self._outlines[each.name], self.tags.sigmas)
            + each.fastest * off_ns / 1e9,
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
        """How many samples were made."""
        return self._frames

    @property
    def has_tags(self) -> bool:
        """Whether any tag of the file was in any frame."""
        return any(number in self.tags.ids for camera in self._cameras for number in camera.seen)

    def remarks(self) -> tuple[str, ...]:
        """Return what is worth knowing about the run: tags that are not in the file, objects never seen."""
        of_cameras = [line for camera in self._cameras for line in camera.remarks()]
        seen = sum((camera.seen for camera in self._cameras), Counter[int]())
        if not seen:
            return tuple(of_cameras)
        lines: list[str] = []
        unmapped = [number for number in sorted(seen) if number not in self.tags.ids]
        if unmapped:
            listed = [f"{number} (in {counted(seen[number], 'frame')})" for number in unmapped]
            lines.append(f"{self.tags.name} has no {tags_listed(listed)}")
        missing = [each for each in self.tags.objects if not any(tag.id in seen for tag in each.tags)]
        frames = counted(sum(camera.frames for camera in self._cameras), "frame")
        lines += [
            f"{each.name} was never seen: no {tags_listed([str(tag.id) for tag in each.tags])} in {frames}"
            for each in missing[:_MOST_NAMED]
        ]
        lines += of_cameras
        for each_name, (text, count) in sorted(self._doubts.items()):
            lines.append(f"{each_name} is unknown in {counted(count, 'frame')}: {text}")
        for each_name, (most, count) in sorted(self._apart.items()):
            where = f"in {counted(count, 'frame')}, by up to {most:.3g} {self.tags.unit}"
            lines.append(
                f"{each_name}: its tags contradict each other {where}; check their places on it, and of"
                " cameras the pose and the --offset"
            )
        return tuple(lines)


def observe_frames(
    frames: Iterable[Frame], tags: TagsFile, *, hold_ns: int | None = None
) -> Iterator[Observation]:
    """Yield what the frames of a camera show, one by one; see `TagObserver`."""
    return observe_cameras([frames], tags, hold_ns=hold_ns)


def observe_cameras(
    cameras: Sequence[Iterable[Frame]], tags: TagsFile, *, hold_ns: int | None = None
) -> Iterator[Observation]:
    """Yield what several cameras show, each time as one sample; see `TagObserver` and `simultaneous`.

    Raises:
        UsageError: no camera, or one that the tags file does not have.
    """
    observer = TagObserver(tags, hold_ns=hold_ns, cameras=camera_names(cameras))
    for frames in simultaneous(cameras):
        yield observer.observe(*frames)


def _outline(footprint: Footprint) -> Floats:
    """Return the points of a footprint that move furthest when it turns, (K, 2): rounding turns in itself."""
    return np.concatenate([part.vertices for part in footprint.parts])


def _moved(footprint: Footprint, x: float, y: float, yaw: float) -> Footprint:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return Footprint(
        tuple(ConvexPart(part.vertices @ turn + np.array([x, y]), part.radius) for part in footprint.parts)
    )
