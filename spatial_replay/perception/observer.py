"""Cameras to samples: places of objects, their uncertainty, and which objects are hidden."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
from spatial_replay.perception.opencv import Detection, Frame, TagDetector, rotations
from spatial_replay.perception.plane import (
    CameraPlane,
    Fit,
    HomographyPlane,
    Plane,
    given_plane,
    plane_from_references,
)
from spatial_replay.perception.tags_file import LEAST_REFERENCES, MountedTag, TaggedObject, TagsFile
from spatial_replay.text import listing, plural
from spatial_replay.trace.trace import Sample

_STEP: Final = 1e-3
"""Pixels by which corners are moved for derivatives."""

_SIZE_TOLERANCE: Final = 0.02
"""By what share a tag may appear larger or smaller beyond its noise: how well its size is measured."""

_LEANING: Final = math.radians(3.0)
"""Standard deviation of how much an object leans that is carried."""

_LEFT_OVER: Final = 4
"""Coordinates of a tag's corners, of eight, that place, yaw and size leave over."""

_SMALL: Final = 1e-6
_ITERATIONS: Final = 5


class ObjectPose(NamedTuple):
    """Where an object is, by one of its tags.

    Attributes:
        place: (3,): x, y and the height of its bottom above where it stands in the tags file.
        yaw: radians.
        spread: (4, 4), the covariance of x, y, z, yaw that comes from the corners.
        shared: (2, 2), the covariance of x, y that comes from the plane; all objects near have the same.
        parallax: how far the place may be off since the height of its tag cannot be resolved.
        doubt: why the pose cannot be right; None if nothing speaks against it.
        misfit: by how many pixels the corners miss the fitted tag, per coordinate left over by the fit.
    """

    place: Floats
    yaw: float
    spread: Floats
    shared: Floats
    parallax: float = 0.0
    doubt: str | None = None
    misfit: float = 0.0


def poses_on_plane(
    plane: Plane, corners: Floats, tags: Sequence[MountedTag], sigmas: float
) -> list[ObjectPose]:
    """Return the poses of objects on the plane.

    Args:
        corners: (N, 4, 2) in pixels, of one tag of each.
        tags: the N tags.
        sigmas: deviations beyond which a tag's size speaks against its place.
    """
    if not tags:
        return []
    z = np.array([tag.z for tag in tags])
    size = np.array([tag.size for tag in tags])
    offset = np.array([(tag.x, tag.y) for tag in tags])
    turn = np.array([tag.yaw for tag in tags])
    # each tag as it is, and with each of its eight coordinates moved up and down
    moves = np.concatenate([np.zeros((1, 8)), _STEP * np.eye(8), -_STEP * np.eye(8)]).reshape(17, 4, 2)
    places = plane.places(corners[:, None] + moves, np.broadcast_to(z[:, None, None], (len(tags), 17, 4)))
    centre = places.mean(axis=2)
    ahead = (places[:, :, 1] - places[:, :, 0]) + (places[:, :, 2] - places[:, :, 3])
    left = (places[:, :, 3] - places[:, :, 0]) + (places[:, :, 2] - places[:, :, 1])
    # a square: what is ahead of it and what is left of it, turned back, are the same
    along = ahead + np.stack([left[..., 1], -left[..., 0]], axis=-1)
    edge = np.linalg.norm(along, axis=-1) / 4
    yaw = np.arctan2(along[..., 1], along[..., 0]) - turn[:, None]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    shift = np.stack(
        [cosine * offset[:, :1] - sine * offset[:, 1:], sine * offset[:, :1] + cosine * offset[:, 1:]],
        axis=-1,
    )
    position = centre - shift
    numbers = np.concatenate([position, np.unwrap(yaw, axis=1)[..., None], edge[..., None]], axis=-1)
    derivative = (numbers[:, 1:9] - numbers[:, 9:]) / (2 * _STEP)
    variance = plane.corner_error**2
    spread = variance * np.einsum("nki,nkj->nij", derivative, derivative)
    shared = plane.covariance(corners.mean(axis=1), z)
    parallax, larger = np.zeros(len(tags)), np.zeros(len(tags))
    lifted = "its object is lifted or has tipped over"
    if isinstance(plane, HomographyPlane):
        bounds = plane.parallax(corners.reshape(-1, 2), np.repeat(z, 4))
        parallax, larger = (bounds_of_corner.reshape(-1, 4).max(axis=1) for bounds_of_corner in bounds)
        lifted += ", or the tag is higher above the reference tags than the file says"
    squares = _squares(centre[:, 0], along[:, 0] / 4)
    misfits = _misfits(plane, corners, squares, z)
    poses = []
    for index, tag in enumerate(tags):
        of_pose = np.zeros((4, 4))
        axes = [0, 1, 3]
        of_pose[np.ix_(axes, axes)] = spread[index, :3, :3]
        doubt = None
        if not np.isfinite(numbers[index]).all():
            doubt = f"tag {tag.id} is not in front of the camera"
        elif size[index] > 0:
            noise = sigmas * math.sqrt(spread[index, 3, 3]) / size[index]
            ratio = edge[index, 0] / size[index] - 1
            off = float(np.linalg.norm(places[index, 0] - squares[index], axis=1).max()) / size[index]
            beyond = abs(ratio) - (larger[index] if ratio * tag.z > 0 else 0.0)
            if beyond > _SIZE_TOLERANCE + noise or off > 2 * _SIZE_TOLERANCE + 2 * noise:
                doubt = (
                    f"tag {tag.id} appears {abs(ratio):.0%} {'larger' if ratio > 0 else 'smaller'} than it"
                    f" is, or leans: {lifted}"
                )
        place = np.array([*numbers[index, 0, :2], 0.0])
        yaw_of_object, off_by = float(numbers[index, 0, 2]), float(parallax[index])
        misfit = float(misfits[index])
        poses.append(ObjectPose(place, yaw_of_object, of_pose, shared[index], off_by, doubt, misfit))
    return poses


def _squares(centres: Floats, edges: Floats) -> Floats:
    """Return the corners (N, 4, 2) of squares around centres (N, 2), whose lower edges are (N, 2)."""
    half = edges[:, None] / 2
    across = np.stack([-half[..., 1], half[..., 0]], axis=-1)
    corners: Floats = np.concatenate([-half - across, half - across, half + across, -half + across], axis=1)
    return np.asarray(centres[:, None] + corners)


def _misfits(plane: Plane, corners: Floats, squares: Floats, z: Floats) -> Floats:
    """Return by how many pixels corners (N, 4, 2) miss squares at heights (N,), per coordinate left over."""
    places = np.concatenate([squares, np.repeat(z, 4).reshape(-1, 4, 1)], axis=2)
    off = corners.reshape(-1, 2) - plane.pixels(places.reshape(-1, 3))
    return np.asarray(np.linalg.norm(off.reshape(-1, 8), axis=1) / math.sqrt(_LEFT_OVER))


def pose_in_space(plane: CameraPlane, corners: Floats, tag: MountedTag, sigmas: float) -> ObjectPose | None:
    """Return the pose of an object that may be above the plane; None if none fits.

    Objects stand upright within a few degrees, in the robot's hand, too. The tilt of a small tag is hardly
    visible, and two poses that lean to opposite sides look alike.

    Args:
        corners: (4, 2) in pixels, of the tag.
    """
    half = tag.size / 2
    square = np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])
    start = _level_start(plane, corners, tag)
    if not np.isfinite(start).all():
        return None
    weight = np.array([1 / plane.corner_error] * 8 + [1 / _LEANING] * 2)
    upright = np.zeros((2, 6))
    upright[[0, 1], [3, 4]] = 1.0
    # x, y, z of the tag's centre, and the rotation vector by which it leans and has turned since the start
    state = np.concatenate([start[:3], np.zeros(3)])
    moves = np.concatenate([np.zeros((1, 6)), _SMALL * np.eye(6), -_SMALL * np.eye(6)])
    weighted, residual = np.zeros((10, 6)), np.zeros(10)
    for _ in range(_ITERATIONS):
        states = state + moves
        turns = rotations(states[:, 3:]) @ rotations(np.array([[0.0, 0.0, start[3]]]))
        points = np.einsum("kij,nj->kni", turns, square) + states[:, None, :3]
        pixels = plane.pixels(points.reshape(-1, 3)).reshape(13, 8)
        derivative = ((pixels[1:7] - pixels[7:]) / (2 * _SMALL)).T
        residual = np.concatenate([corners.ravel() - pixels[0], -state[3:5]])
        weighted = weight[:, None] * np.concatenate([derivative, upright])
        state = state + np.linalg.lstsq(weighted, weight * residual, rcond=None)[0]
    if not np.isfinite(state).all():
        return None
    spread = np.linalg.inv(weighted.T @ weighted)
    yaw = start[3] + state[5] - tag.yaw
    cosine, sine = math.cos(yaw), math.sin(yaw)
    shift = np.array([cosine * tag.x - sine * tag.y, sine * tag.x + cosine * tag.y, tag.z])
    # the place of the object's centre by the place of the tag and its yaw
    lever = np.eye(4)
    lever[:2, 3] = shift[1], -shift[0]
    axes = [0, 1, 2, 5]
    doubt = None
    off = float(np.sqrt(np.square(residual[:8]).sum() / 4))
    if off > sigmas * (2 * plane.corner_error) or np.linalg.norm(state[3:5]) > sigmas * _LEANING:
        doubt = f"tag {tag.id} does not look like an upright tag of its size: its object has tipped over"
    shared = plane.covariance(corners.mean(axis=0)[None], state[2:3])[0]
    return ObjectPose(
        state[:3] - shift,
        float(yaw),
        lever @ spread[np.ix_(axes, axes)] @ lever.T,
        shared,
        doubt=doubt,
        misfit=float(np.linalg.norm(residual[:8])) / math.sqrt(_LEFT_OVER),
    )


def _level_start(plane: CameraPlane, corners: Floats, tag: MountedTag) -> Floats:
    """Return x, y, z and yaw of a tag that is upright and appears as large as it is."""
    places = plane.places(corners, np.full(4, tag.z))
    along = (places[1] - places[0]) + (places[2] - places[3])
    left = (places[3] - places[0]) + (places[2] - places[1])
    along = along + np.array([left[1], -left[0]])
    eye = -plane.rotation.T @ plane.pose[3:]
    centre = np.append(places.mean(axis=0), tag.z)
    place = eye + (centre - eye) * (4 * tag.size / np.linalg.norm(along))
    return np.append(place, math.atan2(along[1], along[0]))


def fuse(poses: Sequence[ObjectPose]) -> ObjectPose:
    """Return one pose from those of several tags on one object, each weighted by its covariance."""
    if len(poses) == 1:
        return poses[0]
    first = poses[0].yaw
    states = np.array(
        [[*pose.place, first + math.remainder(pose.yaw - first, 2 * math.pi)] for pose in poses]
    )
    weights = [np.linalg.pinv(pose.spread, hermitian=True, rcond=1e-12) for pose in poses]
    spread = np.linalg.pinv(sum(weights, np.zeros((4, 4))), hermitian=True, rcond=1e-12)
    mean = spread @ sum((w @ x for w, x in zip(weights, states, strict=True)), np.zeros(4))
    # tags that contradict each other beyond their noise: what the file says of them is not exact
    off = states - mean
    excess = sum(float(x @ w @ x) for w, x in zip(weights, off, strict=True)) / max(3 * (len(poses) - 1), 1)
    shared = np.max([pose.shared for pose in poses], axis=0)
    parallax = max(pose.parallax for pose in poses)
    return ObjectPose(mean[:3], float(mean[3]), spread * max(excess, 1.0), shared, parallax)


def radius(pose: ObjectPose, outline: Floats, sigmas: float) -> float:
    """Return how far any point of an object may be from where its pose puts it.

    For the point v of the outline, the error is that of the place and that of the yaw, by which v swings:
    with A = [I | e_z x R v] its covariance is A C A^T, and its largest standard deviation the root of the
    largest eigenvalue. The radius is `sigmas` times that of the worst point, and the parallax.

    Args:
        outline: (K, 2), points of the footprint in its own frame.
    """
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    swing = np.stack(
        [-sine * outline[:, 0] - cosine * outline[:, 1], cosine * outline[:, 0] - sine * outline[:, 1]]
    )
    lever = np.zeros((outline.shape[0], 3, 4))
    lever[:, [0, 1, 2], [0, 1, 2]] = 1.0
    lever[:, :2, 3] = swing.T
    spread = lever @ pose.spread @ lever.transpose(0, 2, 1)
    spread[:, :2, :2] += pose.shared
    return pose.parallax + sigmas * math.sqrt(max(float(np.linalg.eigvalsh(spread)[:, -1].max()), 0.0))


# ----------------------------------------------------------------------------------------- frames of one time


def simultaneous(
    cameras: Sequence[Iterable[Frame]], offsets_ns: Sequence[int] = ()
) -> Iterator[tuple[Frame | None, ...]]:
    """Yield the frames of each time: of each camera one, or None where it has none then.

    Frames belong together if they are at most half a frame apart, half of the shortest time to the next frame
    of any camera. No more than two frames of a camera wait. When one camera ends, the others go on.

    Args:
        cameras: frames with increasing times.
        offsets_ns: what is added to the stamps of each camera; nothing unless given.
    """
    offsets = [*offsets_ns, *[0] * (len(cameras) - len(offsets_ns))]
    shifted = [_shift(frames, offset) for frames, offset in zip(cameras, offsets, strict=True)]
    if len(cameras) == 1:
        # nothing to wait for
        yield from ((frame,) for frame in shifted[0])
        return
    coming = [_Coming(frames) for frames in shifted]
    while present := [camera for camera in coming if camera.now is not None]:
        gaps = [camera.gap_ns for camera in present if camera.gap_ns]
        first_ns = min(camera.time_ns for camera in present)
        last_ns = first_ns + (min(gaps) // 2 if gaps else 0)
        yield tuple(
            camera.take() if camera.now is not None and camera.time_ns <= last_ns else None
            for camera in coming
        )


def _shift(frames: Iterable[Frame], offset_ns: int) -> Iterator[Frame]:
    return (replace(frame, time_ns=frame.time_ns + offset_ns) if offset_ns else frame for frame in frames)


class _Coming:
    """The frames of one camera, of which the next two are known."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._frames = frames
        self.now, self._later = next(frames, None), next(frames, None)

    @property
    def time_ns(self) -> int:
        """The time of the frame that comes next."""
        return 0 if self.now is None else self.now.time_ns

    @property
    def gap_ns(self) -> int:
        """The time from the frame that comes next to the one after it; 0 if there is none."""
        return 0 if self._later is None else self._later.time_ns - self.time_ns

    def take(self) -> Frame | None:
        """Return the frame that comes next, and go on."""
        frame, self.now = self.now, self._later
        self._later = next(self._frames, None)
        return frame


def camera_names(cameras: Sequence[Any]) -> list[str]:
    """Return the names of cameras: of a topic, or else of a video; "" of frames that have none.

    Raises:
        UsageError: there is no camera.
    """
    if not cameras:
        raise UsageError("there is no camera; give the frames of one or more")
    return [str(getattr(camera, "topic", "") or getattr(camera, "name", "")) for camera in cameras]


# ------------------------------------------------------------------------------------------------- one camera

_MOST_AVERAGED: Final = 30
"""Detections of a reference tag that are averaged."""

_MOST_NAMED: Final = 8

_LATE: Final = 8
"""Frames of a tag whose largest misfit counts: one has four coordinates left over, too few for a scatter."""

_SHARED: Final = 1.2
"""The error of a pose in misfits: a codec moves blocks of pixels, so that corners share errors. In films with
crf 23 to 36 a pose was off by up to 1.2 times the misfit per coordinate, root mean square."""

_BLURRED: Final = 2.0
"""How many times larger the error of a tag than that of the reference tags is worth a remark."""

_MOVED: Final = 2.0
"""Pixels beyond which a reference tag is no longer where it was: the camera has moved."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Observation of one camera in one frame.

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
        self._misfits: dict[int, deque[float]] = {}
        self._sharpness: Counter[str] = Counter()

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
            detections = [
                detection for detection in frame.detections if detection.family in ("", self.tags.family)
            ]
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
        times = Counter(detection.id for detection in detections)
        self.seen.update(times.keys())
        self.twice.update(number for number, count in times.items() if count > 1)
        return {detection.id: detection.corners for detection in detections if times[detection.id] == 1}

    def _refer(self, corners: Mapping[int, Floats]) -> None:
        """Take in the reference tags, and fit the plane again while their averages still change."""
        if not self.tags.references or self.tags.pose is not None:
            return
        present = {
            reference.id: corners[reference.id]
            for reference in self.tags.references
            if reference.id in corners
        }
        before = {number: self._averages[number] for number in present if number in self._averages}
        off = [float(np.linalg.norm(present[n] - mean, axis=1).mean()) for n, (mean, _) in before.items()]
        if off and float(np.median(off)) > _MOVED:
            self.moved += 1
            self._averages.clear()
        is_new = False
        for number, reference_corners in present.items():
            mean, count = self._averages.get(number, (reference_corners, 0))
            if count < _MOST_AVERAGED:
                is_new = True
                self._averages[number] = (mean + (reference_corners - mean) / (count + 1), count + 1)
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
                tagged, tag = self.tags.by_id[number]
                pose = pose_in_space(plane, corners[number], tag, sigmas) if tagged.is_lifted else None
                if pose is not None:
                    poses[number] = pose
        poses = {number: self._with_misfits(plane, number, pose) for number, pose in poses.items()}
        self._parallax = max(self._parallax, *(pose.parallax for pose in poses.values()), 0.0)
        return poses

    def _with_misfits(self, plane: Plane, number: int, pose: ObjectPose) -> ObjectPose:
        """Return the pose by a tag, whose spread covers how far the tag missed its fit of late.

        Reference tags rest, and a codec sharpens what rests: they say nothing of the error of tags that move.
        """
        if self.tags.corner_error is not None or pose.doubt is not None:
            return pose
        misfits = self._misfits.setdefault(number, deque(maxlen=_LATE))
        misfits.append(pose.misfit)
        larger = max(_SHARED * max(misfits) / plane.corner_error, 1.0)
        self._sharpness["fitted"] += 1
        self._sharpness["blurred"] += larger > _BLURRED
        return pose._replace(spread=pose.spread * larger**2)

    def _why_no_plane(self) -> str:
        if self.fit is not None:
            return "the reference tags stopped fitting each other, as the camera or a tag moved"
        absent = [str(tag.id) for tag in self.tags.references if tag.id not in self.seen]
        if len(self.tags.references) - len(absent) >= LEAST_REFERENCES:
            return (
                "enough reference tags were seen, but fewer than"
                f" {LEAST_REFERENCES} of them once in a frame while the camera stood still"
            )
        were = "was" if len(absent) == 1 else "were"
        return f"fewer than {LEAST_REFERENCES} reference tags were seen; {tags_text(absent)} {were} not"

    def remarks(self) -> list[str]:
        """Return what is worth knowing: that the camera saw nothing, not the plane, or has moved."""
        frames, lines = plural(self.frames, "frame"), []
        of_it = f" of {self.name}" if self.name else ""
        if self.frames and not self.seen:
            lines.append(
                f"no tag of family {self.tags.family} is in any of {frames}{of_it}; check the family, the"
                " light, that tags are 20 pixels or larger, with a white rim, and that the camera looks"
                " from above"
            )
            return lines
        if self.frames and self.tags.references and self._plane is None:
            lines.append(f"the plane{of_it} is not known: {self._why_no_plane()}")
        for number, count in sorted(self.twice.items()):
            lines.append(
                f"tag {number} is in {plural(count, 'frame')}{of_it} more than once, and left out there"
            )
        if self._parallax:
            above = max((tag.z for _, tag in self.tags.by_id.values() if tag.id in self.seen), key=abs)
            lines.append(
                f"tags on objects are up to {1e3 * abs(above):.3g} mm {'above' if above > 0 else 'below'} the"
                f" reference tags, and no camera{of_it} is calibrated: outlines are up to"
                f" {1e3 * self._parallax:.3g} mm less certain; calibrate the camera (tags calibrate), or fix"
                " the reference tags as high as the others and give their height (plane: height: …)"
            )
        fitted, blurred = self._sharpness["fitted"], self._sharpness["blurred"]
        if 2 * blurred > fitted:
            lines.append(
                f"the video{of_it} is blurred or strongly compressed: in {blurred} of {fitted} places,"
                f" objects are more than {_BLURRED:g} times less certain; expose shorter, or"
                " compress less (crf 18)"
            )
        if self.moved:
            who = self.name or "the camera"
            lines.append(f"{who} has moved {plural(self.moved, 'time')}: places are uncertain while it does")
        return lines


def tags_text(numbers: list[str]) -> str:
    """Return tags as a sentence lists them, the first of many."""
    return f"tag{'s' if len(numbers) > 1 else ''} {listing(numbers, _MOST_NAMED)}"


# ---------------------------------------------------------------------------------------------------- samples


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of the frames of one time.

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


class TagObserver:
    """Turns the frames of cameras, which stand still, into samples; a process for one run.

    An object is unknown if its tags are hidden from all cameras, or if its tag cannot be where it appears. A
    held hidden object stays where it was for a while, with an uncertainty that grows with its highest speed.

    Attributes:
        tags: the tags file.
        hold_ns: how long a hidden object is held.
        frames: how many samples were made.
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
        self._outlines = {tagged.name: _outline(tagged.footprint) for tagged in tags.objects}
        self._doubts: dict[str, tuple[str, int]] = {}
        self._apart: dict[str, tuple[float, int]] = {}
        self.frames = self._last_ns = 0

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
                f"{plural(len(self._cameras), 'camera')}: give a frame or None of each, not only None"
            )
        time_ns = next(frame.time_ns for frame in frames if frame is not None)
        if self.frames and time_ns <= self._last_ns:
            raise UsageError(
                f"a frame at {time_ns / 1e9:.3f} s follows one at {self._last_ns / 1e9:.3f} s; give frames"
                " with increasing times"
            )
        self.frames += 1
        self._last_ns = time_ns
        views: list[View | None] = []
        poses: list[tuple[int, Mapping[int, ObjectPose]]] = []
        for camera, frame in zip(self._cameras, frames, strict=True):
            view = None
            if frame is not None:
                try:
                    view, poses_by_tag = camera.look(frame)
                except UsageError as error:
                    raise UsageError(f"{camera.name}: {error}" if camera.name else str(error)) from None
                poses.append((abs(frame.time_ns - time_ns), poses_by_tag))
            views.append(view)
        objects = dict(self._locate(poses))
        held = self._hold(time_ns, objects)
        reported_ns = {name: self._last[name][0] for name in held}
        sample = Sample(time_ns, {**objects, **held}, unknown=self._hidden, reported_ns=reported_ns)
        return Observation(sample, tuple(views))

    # ------------------------------------------------------------------------------------- the objects

    def _locate(
        self, poses: Sequence[tuple[int, Mapping[int, ObjectPose]]]
    ) -> Iterator[tuple[str, TrackedObject]]:
        """Yield the objects whose tags are in an image, where nothing speaks against their places.

        Args:
            poses: of each camera that has a frame: by how much it is off in time, and the poses by tag.
        """
        for tagged in self.tags.objects:
            poses_of_object = [
                (off, poses_by_tag[tag.id])
                for off, poses_by_tag in poses
                for tag in tagged.tags
                if tag.id in poses_by_tag
            ]
            for _, pose in poses_of_object:
                if pose.doubt is not None:
                    text, count = self._doubts.get(tagged.name, (pose.doubt, 0))
                    self._doubts[tagged.name] = text, count + 1
            sound = [(off, pose) for off, pose in poses_of_object if pose.doubt is None]
            # frames that are off in time are taken where they make the object more certain
            found_at = [
                self._track(tagged, fuse([pose for off, pose in sound if off <= latest]), latest)
                for latest in sorted({off for off, _ in sound})
            ]
            self._compare(tagged, [pose for _, pose in sound])
            if found_at:
                yield tagged.name, min(found_at, key=lambda tracked: tracked.uncertainty)

    def _compare(self, tagged: TaggedObject, poses: Sequence[ObjectPose]) -> None:
        """Take note of tags that place an object further apart than it is large, beyond what is uncertain."""
        if len(poses) < 2:
            return
        outline = self._outlines[tagged.name]
        size = 2 * max(
            float(np.linalg.norm(outline, axis=1).max()), *(part.radius for part in tagged.footprint.parts)
        )
        unsure = 2 * max(radius(pose, outline, self.tags.sigmas) for pose in poses)
        apart = max(float(np.linalg.norm((poses[0].place - pose.place)[:2])) for pose in poses)
        if apart > size + unsure:
            most, count = self._apart.get(tagged.name, (0.0, 0))
            self._apart[tagged.name] = max(most, apart), count + 1

    def _track(self, tagged: TaggedObject, pose: ObjectPose, off_ns: int) -> TrackedObject:
        height = tagged.height
        if height is not None and tagged.is_lifted:
            height = height[0] + float(pose.place[2]), height[1] + float(pose.place[2])
        return TrackedObject(
            _move(tagged.footprint, float(pose.place[0]), float(pose.place[1]), pose.yaw),
            class_name=tagged.class_name,
            yaw=math.remainder(pose.yaw, 2 * math.pi),
            height=height,
            uncertainty=radius(pose, self._outlines[tagged.name], self.tags.sigmas)
            + tagged.fastest * off_ns / 1e9,
        )

    def _hold(self, time_ns: int, objects: Mapping[str, TrackedObject]) -> dict[str, TrackedObject]:
        """Return the hidden objects that are held; remember where the others are, and which are unknown."""
        held: dict[str, TrackedObject] = {}
        for tagged in self.tags.objects:
            if tagged.name in objects:
                self._last[tagged.name] = time_ns, objects[tagged.name]
                self._hidden.pop(tagged.name, None)
            elif tagged.name in self._last:
                since_ns, last = self._last[tagged.name]
                if time_ns - since_ns <= self.hold_ns:
                    grown = last.uncertainty + tagged.fastest * (time_ns - since_ns) / 1e9
                    # a yaw has no uncertainty: of what may have turned, it is unknown
                    yaw = None if tagged.fastest else last.yaw
                    held[tagged.name] = TrackedObject(
                        last.footprint, last.class_name, yaw, last.height, grown
                    )
                else:
                    self._hidden[tagged.name] = tagged.class_name
        return held

    # ------------------------------------------------------------------------------------- remarks

    def remarks(self) -> tuple[str, ...]:
        """Return what is worth knowing about the run: tags that are not in the file, objects never seen."""
        of_cameras = [line for camera in self._cameras for line in camera.remarks()]
        seen = sum((camera.seen for camera in self._cameras), Counter[int]())
        if not seen:
            return tuple(of_cameras)
        lines: list[str] = []
        unmapped = [number for number in sorted(seen) if number not in self.tags.ids]
        if unmapped:
            tag_texts = [f"{number} (in {plural(seen[number], 'frame')})" for number in unmapped]
            lines.append(f"{self.tags.name} has no {tags_text(tag_texts)}")
        missing = [tagged for tagged in self.tags.objects if not any(tag.id in seen for tag in tagged.tags)]
        frames = plural(sum(camera.frames for camera in self._cameras), "frame")
        lines += [
            f"{tagged.name} was never seen: no {tags_text([str(tag.id) for tag in tagged.tags])} in {frames}"
            for tagged in missing[:_MOST_NAMED]
        ]
        lines += of_cameras
        for object_name, (text, count) in sorted(self._doubts.items()):
            lines.append(f"{object_name} is unknown in {plural(count, 'frame')}: {text}")
        for object_name, (most, count) in sorted(self._apart.items()):
            where = f"in {plural(count, 'frame')}, by up to {most:.3g} {self.tags.unit}"
            lines.append(
                f"{object_name}: its tags contradict each other {where}; check their places on it, and of"
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


def _move(footprint: Footprint, x: float, y: float, yaw: float) -> Footprint:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    return Footprint(
        tuple(ConvexPart(part.vertices @ turn + np.array([x, y]), part.radius) for part in footprint.parts)
    )
