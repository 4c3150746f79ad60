"""One camera: its pictures to tags, the plane that it sees, and poses of objects in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.frame import Detection, Frame
from spatial_replay.perception.object_poses import ObjectPose, pose_in_space, poses_on_plane
from spatial_replay.perception.opencv import TagDetector
from spatial_replay.perception.plane import CameraPlane, Fit, Plane, given_plane, plane_from_references
from spatial_replay.perception.tags_file import LEAST_REFERENCES, TagsFile
from spatial_replay.text import counted

_MOST_AVERAGED: Final = 30
"""Detections of a reference tag that are averaged."""

_MOST_NAMED: Final = 8

_MOVED: Final = 2.0
"""Pixels beyond which a reference tag is no longer where it was: the camera has moved."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one camera shows in one frame.

    Attributes:
        frame: it.
        detections: all tags, those that no one mapped, too.
        plane: None as long as reference tags are missing.
    """

    frame: Frame
    detections: tuple[Detection, ...]
    plane: Plane | None


class CameraView:
    """One camera, which stands still; a process for one run.

    Attributes:
        name: of its video or topic; "" of the only one.
        tags: what the tags file says for it.
        fit: how the reference tags fit; None without any.
        seen: in how many frames each tag was.
        twice: in how many it was more than once.
        moved: how often the camera has moved.
        frames: how many there were.
    """

    def __init__(self, name: str, tags: TagsFile) -> None:
        """Prepare the detector.

        Raises:
            UsageError: OpenCV is not installed.
        """
        self.name, self.tags = name, tags
        self.fit: Fit | None = None
        self.seen: Counter[int] = Counter()
        self.twice: Counter[int] = Counter()
        self.frames = self.moved = 0
        self._parallax = 0.0
        self._detector = TagDetector(tags.family)
        self._plane: Plane | None = None
        self._size: tuple[int, int] | None = None
        self._averages: dict[int, tuple[Floats, int]] = {}

    def look(self, frame: Frame) -> tuple[View, dict[int, ObjectPose]]:
        """Return what a frame shows, and the pose that each tag gives its object.

        Raises:
            UsageError: the camera is calibrated for another size, or the reference tags do not fit.
        """
        self.frames += 1
        if frame.detections is None:
            detections = self._detector.detect(frame.image)
            height, width = frame.image.shape[:2]
        else:
            detections = [each for each in frame.detections if each.family in ("", self.tags.family)]
            width, height = self._size_without_image()
        usable = self._single(detections)
        if self._size != (width, height):
            self._size, self._plane = (width, height), given_plane(self.tags, (width, height))
            self._averages.clear()
        self._refer(usable)
        poses = {} if self._plane is None else self._poses(self._plane, usable)
        return View(frame, tuple(detections), self._plane), poses

    def _size_without_image(self) -> tuple[int, int]:
        """Return the size (width, height) of images that are not there; (0, 0) where it does not matter."""
        if self.tags.is_image:
            raise UsageError(
                f"{self.tags.name}: plane: image counts from the lower edge of the image, and detections do"
                " not say where that is; give reference tags, or map the topic (docs/mapping.md) for pixels"
            )
        return (0, 0) if self.tags.camera is None else self.tags.camera.size

    def _single(self, detections: Iterable[Detection]) -> dict[int, Floats]:
        """Return the corners of the tags that are in the image once: of two, no one knows which it is."""
        times = Counter(each.id for each in detections)
        self.seen.update(times.keys())
        self.twice.update(number for number, count in times.items() if count > 1)
        return {each.id: each.corners for each in detections if times[each.id] == 1}

    def _refer(self, corners: Mapping[int, Floats]) -> None:
        """Take in the reference tags, and fit the plane again while their averages still change."""
        if not self.tags.references or self.tags.pose is not None:
            return
        present = {each.id: corners[each.id] for each in self.tags.references if each.id in corners}
        before = {number: self._averages[number] for number in present if number in self._averages}
        off = [float(np.linalg.norm(present[n] - mean, axis=1).mean()) for n, (mean, _) in before.items()]
        if off and float(np.median(off)) > _MOVED:
            self.moved += 1
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
            means = {number: mean for number, (mean, _) in self._averages.items()}
            self.fit = plane_from_references(self.tags, means, self._size or (0, 0))
            self._plane = self.fit.plane
        except UsageError:
            # what fitted before does not while the camera or a tag moves
            if self.fit is None:
                raise
            self._plane = None

    def _poses(self, plane: Plane, corners: Mapping[int, Floats]) -> dict[int, ObjectPose]:
        """Return the pose of its object by each tag that is in the image."""
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
        self._parallax = max(self._parallax, *(pose.parallax for pose in poses.values()), 0.0)
        return poses

    def remarks(self) -> list[str]:
        """Return what is worth knowing: that the camera saw nothing, not the plane, or has moved."""
        frames, lines = counted(self.frames, "frame"), []
        of_it = f" of {self.name}" if self.name else ""
        if self.frames and not self.seen:
            lines.append(
                f"no tag of family {self.tags.family} is in any of {frames}{of_it}; check the family, the"
                " light, that tags are 20 pixels or larger, with a white rim, and that the camera looks"
                " from above"
            )
            return lines
        if self.frames and self.tags.references and self._plane is None:
            absent = [str(each.id) for each in self.tags.references if each.id not in self.seen]
            lines.append(
                f"the plane{of_it} is not known: fewer than {LEAST_REFERENCES} reference tags were seen;"
                f" {tags_listed(absent)} {'was' if len(absent) == 1 else 'were'} not"
            )
        for number, count in sorted(self.twice.items()):
            lines.append(
                f"tag {number} is in {counted(count, 'frame')}{of_it} more than once, and left out there"
            )
        if self._parallax:
            above = max((tag.z for _, tag in self.tags.by_id.values() if tag.id in self.seen), key=abs)
            lines.append(
                f"tags on objects are up to {1e3 * abs(above):.3g} mm {'above' if above > 0 else 'below'} the"
                f" reference tags, and no camera{of_it} is calibrated: outlines are up to"
                f" {1e3 * self._parallax:.3g} mm less certain; calibrate the camera (tags calibrate), or fix"
                " the reference tags as high as the others and give their height (plane: height: …)"
            )
        if self.moved:
            who = self.name or "the camera"
            lines.append(f"{who} has moved {counted(self.moved, 'time')}: places are uncertain while it does")
        return lines


def tags_listed(numbers: list[str]) -> str:
    """Return tags as a sentence lists them, the first of many."""
    shown = numbers[:_MOST_NAMED] + (["…"] if len(numbers) > _MOST_NAMED else [])
    return f"tag{'s' if len(numbers) > 1 else ''} {', '.join(shown)}"
