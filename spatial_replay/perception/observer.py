"""Convert frames of cameras to samples: places of objects, their uncertainty, and hidden objects."""

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
"""Step of corners in numerical derivatives, pixels."""

_SIZE_TOLERANCE: Final = 0.02
"""Allowed relative error of a tag's stated size, in addition to noise."""

_LEANING: Final = math.radians(3.0)
"""Standard deviation of the tilt of a carried object, radians."""

_LEFT_OVER: Final = 4
"""Degrees of freedom of a fitted tag: eight coordinates minus four unknowns (x, y, yaw, size)."""

_SMALL: Final = 1e-6
_ITERATIONS: Final = 5


class ObjectPose(NamedTuple):
    """Pose of an object from one of its tags.

    Attributes:
        place: (3,), x, y, and height above the resting height of the tags file.
        yaw: orientation, radians.
        spread: (4, 4), covariance of x, y, z, yaw from the errors of corners.
        shared: (2, 2), covariance of x, y from the plane's error, which nearby objects have in common.
        parallax: largest error of the place that the unknown height of the tag can cause.
        doubt: reason to distrust the pose, or None.
        misfit: distance of the corners from the fitted tag, pixels per degree of freedom.
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
        corners: (N, 4, 2), corners of one tag of each object, pixels.
        tags: the N tags.
        sigmas: largest deviation of a tag's size in the image without a doubt, standard deviations.
    """
    if not tags:
        return []
    z = np.array([tag.z for tag in tags])
    sizes = np.array([tag.size for tag in tags])
    tag_offsets = np.array([(tag.x, tag.y) for tag in tags])
    tag_yaws = np.array([tag.yaw for tag in tags])
    # 17 copies of each tag: unchanged, and with each of the eight coordinates moved by a step up or down
    corner_steps = np.concatenate([np.zeros((1, 8)), _STEP * np.eye(8), -_STEP * np.eye(8)]).reshape(17, 4, 2)
    corner_places = plane.places(
        corners[:, None] + corner_steps, np.broadcast_to(z[:, None, None], (len(tags), 17, 4))
    )
    centres = corner_places.mean(axis=2)
    ahead_sides = (corner_places[:, :, 1] - corner_places[:, :, 0]) + (
        corner_places[:, :, 2] - corner_places[:, :, 3]
    )
    left_sides = (corner_places[:, :, 3] - corner_places[:, :, 0]) + (
        corner_places[:, :, 2] - corner_places[:, :, 1]
    )
    # in a square, the left sides turned by -90 degrees equal the sides ahead, so their average has less noise
    edge_sums = ahead_sides + np.stack([left_sides[..., 1], -left_sides[..., 0]], axis=-1)
    # `edge_sums` adds the vectors of four edges
    edge_lengths = np.linalg.norm(edge_sums, axis=-1) / 4
    yaws = np.arctan2(edge_sums[..., 1], edge_sums[..., 0]) - tag_yaws[:, None]
    cosine, sine = np.cos(yaws), np.sin(yaws)
    centre_shifts = np.stack(
        [
            cosine * tag_offsets[:, :1] - sine * tag_offsets[:, 1:],
            sine * tag_offsets[:, :1] + cosine * tag_offsets[:, 1:],
        ],
        axis=-1,
    )
    positions = centres - centre_shifts
    # yaws are unwrapped, so that a step across 180 degrees is no large derivative
    states = np.concatenate([positions, np.unwrap(yaws, axis=1)[..., None], edge_lengths[..., None]], axis=-1)
    state_derivatives = (states[:, 1:9] - states[:, 9:]) / (2 * _STEP)
    variance = plane.corner_error**2
    state_spreads = variance * np.einsum("nki,nkj->nij", state_derivatives, state_derivatives)
    plane_spreads = plane.covariance(corners.mean(axis=1), z)
    parallaxes, length_errors = np.zeros(len(tags)), np.zeros(len(tags))
    lift_reason = "its object is lifted or has tipped over"
    if isinstance(plane, HomographyPlane):
        bounds = plane.parallax(corners.reshape(-1, 2), np.repeat(z, 4))
        parallaxes, length_errors = (corner_bounds.reshape(-1, 4).max(axis=1) for corner_bounds in bounds)
        lift_reason += ", or the tag is higher above the reference tags than the file says"
    squares = _squares(centres[:, 0], edge_sums[:, 0] / 4)
    misfits = _misfits(plane, corners, squares, z)
    poses = []
    for index, tag in enumerate(tags):
        pose_spread = np.zeros((4, 4))
        pose_axes = [0, 1, 3]
        pose_spread[np.ix_(pose_axes, pose_axes)] = state_spreads[index, :3, :3]
        doubt = None
        if not np.isfinite(states[index]).all():
            doubt = f"tag {tag.id} is not in front of the camera"
        elif sizes[index] > 0:
            size_noise = sigmas * math.sqrt(state_spreads[index, 3, 3]) / sizes[index]
            size_error = edge_lengths[index, 0] / sizes[index] - 1
            relative_misfit = (
                float(np.linalg.norm(corner_places[index, 0] - squares[index], axis=1).max()) / sizes[index]
            )
            # an uncalibrated camera shows a tag above the plane larger, and a tag below the plane smaller
            unexplained_error = abs(size_error) - (length_errors[index] if size_error * tag.z > 0 else 0.0)
            if (
                unexplained_error > _SIZE_TOLERANCE + size_noise
                or relative_misfit > 2 * _SIZE_TOLERANCE + 2 * size_noise
            ):
                doubt = (
                    f"tag {tag.id} appears {abs(size_error):.0%} {'larger' if size_error > 0 else 'smaller'}"
                    f" than it is, or leans: {lift_reason}"
                )
        place = np.array([*states[index, 0, :2], 0.0])
        yaw, pose_parallax = float(states[index, 0, 2]), float(parallaxes[index])
        misfit = float(misfits[index])
        poses.append(ObjectPose(place, yaw, pose_spread, plane_spreads[index], pose_parallax, doubt, misfit))
    return poses


def _squares(centres: Floats, edges: Floats) -> Floats:
    """Return the corners (N, 4, 2) of squares with centres (N, 2) and lower edges (N, 2)."""
    half = edges[:, None] / 2
    normal = np.stack([-half[..., 1], half[..., 0]], axis=-1)
    corners: Floats = np.concatenate(
        [
            -half - normal,
            half - normal,
            half + normal,
            -half + normal,
        ],
        axis=1,
    )
    return np.asarray(centres[:, None] + corners)


def _misfits(plane: Plane, corners: Floats, squares: Floats, heights: Floats) -> Floats:
    """Return the misfits (N,) of corners (N, 4, 2) to squares at heights (N,); see `ObjectPose.misfit`."""
    places = np.concatenate([squares, np.repeat(heights, 4).reshape(-1, 4, 1)], axis=2)
    pixel_errors = corners.reshape(-1, 2) - plane.pixels(places.reshape(-1, 3))
    return np.asarray(np.linalg.norm(pixel_errors.reshape(-1, 8), axis=1) / math.sqrt(_LEFT_OVER))


def pose_in_space(plane: CameraPlane, corners: Floats, tag: MountedTag, sigmas: float) -> ObjectPose | None:
    """Return the pose of an object that may be above the plane; None if no pose fits.

    Objects are assumed to be upright within a few degrees, also in the robot's hand. An image hardly shows
    the tilt of a small tag, and poses that lean to opposite sides look alike.

    Args:
        corners: (4, 2), corners of the tag, pixels.
    """
    half = tag.size / 2
    square = np.array(
        [
            (-half, -half, 0.0),
            (half, -half, 0.0),
            (half, half, 0.0),
            (-half, half, 0.0),
        ]
    )
    level_pose = _level_start(plane, corners, tag)
    if not np.isfinite(level_pose).all():
        return None
    residual_weights = np.array([1 / plane.corner_error] * 8 + [1 / _LEANING] * 2)
    tilt_derivative = np.zeros((2, 6))
    tilt_derivative[[0, 1], [3, 4]] = 1.0
    # Gauss-Newton on x, y, z of the tag's centre, and on the rotation vector of its tilt and turn
    state = np.concatenate([level_pose[:3], np.zeros(3)])
    state_steps = np.concatenate([np.zeros((1, 6)), _SMALL * np.eye(6), -_SMALL * np.eye(6)])
    weighted_derivative, residual = np.zeros((10, 6)), np.zeros(10)
    for _ in range(_ITERATIONS):
        moved_states = state + state_steps
        moved_rotations = rotations(moved_states[:, 3:]) @ rotations(np.array([[0.0, 0.0, level_pose[3]]]))
        points = np.einsum("kij,nj->kni", moved_rotations, square) + moved_states[:, None, :3]
        corner_pixels = plane.pixels(points.reshape(-1, 3)).reshape(13, 8)
        derivative = ((corner_pixels[1:7] - corner_pixels[7:]) / (2 * _SMALL)).T
        residual = np.concatenate([corners.ravel() - corner_pixels[0], -state[3:5]])
        weighted_derivative = residual_weights[:, None] * np.concatenate([derivative, tilt_derivative])
        state = state + np.linalg.lstsq(weighted_derivative, residual_weights * residual, rcond=None)[0]
    if not np.isfinite(state).all():
        return None
    state_spread = np.linalg.inv(weighted_derivative.T @ weighted_derivative)
    yaw = level_pose[3] + state[5] - tag.yaw
    cosine, sine = math.cos(yaw), math.sin(yaw)
    tag_offset = np.array([cosine * tag.x - sine * tag.y, sine * tag.x + cosine * tag.y, tag.z])
    # derivative of the object's pose by the tag's pose
    pose_derivative = np.eye(4)
    pose_derivative[:2, 3] = tag_offset[1], -tag_offset[0]
    pose_axes = [0, 1, 2, 5]
    doubt = None
    corner_error_px = float(np.sqrt(np.square(residual[:8]).sum() / 4))
    if corner_error_px > sigmas * (2 * plane.corner_error) or np.linalg.norm(state[3:5]) > sigmas * _LEANING:
        doubt = f"tag {tag.id} does not look like an upright tag of its size: its object has tipped over"
    plane_spread = plane.covariance(corners.mean(axis=0)[None], state[2:3])[0]
    return ObjectPose(
        state[:3] - tag_offset,
        float(yaw),
        pose_derivative @ state_spread[np.ix_(pose_axes, pose_axes)] @ pose_derivative.T,
        plane_spread,
        doubt=doubt,
        misfit=float(np.linalg.norm(residual[:8])) / math.sqrt(_LEFT_OVER),
    )


def _level_start(plane: CameraPlane, corners: Floats, tag: MountedTag) -> Floats:
    """Return x, y, z and yaw of an upright tag at the distance that follows from its size in the image."""
    places = plane.places(corners, np.full(4, tag.z))
    edge_sum = (places[1] - places[0]) + (places[2] - places[3])
    left_sides = (places[3] - places[0]) + (places[2] - places[1])
    edge_sum = edge_sum + np.array([left_sides[1], -left_sides[0]])
    camera_place = -plane.rotation.T @ plane.pose[3:]
    centre = np.append(places.mean(axis=0), tag.z)
    tag_place = camera_place + (centre - camera_place) * (4 * tag.size / np.linalg.norm(edge_sum))
    return np.append(tag_place, math.atan2(edge_sum[1], edge_sum[0]))


def fuse(poses: Sequence[ObjectPose]) -> ObjectPose:
    """Fuse the poses from several tags on an object, weighted by their covariances."""
    if len(poses) == 1:
        return poses[0]
    first_yaw = poses[0].yaw
    # yaws are unwrapped to within half a turn of the first yaw, so that their mean is valid
    pose_states = np.array(
        [[*pose.place, first_yaw + math.remainder(pose.yaw - first_yaw, 2 * math.pi)] for pose in poses]
    )
    # pseudo-inverses, because poses on the plane have no variance of z
    weights = [np.linalg.pinv(pose.spread, hermitian=True, rcond=1e-12) for pose in poses]
    spread = np.linalg.pinv(sum(weights, np.zeros((4, 4))), hermitian=True, rcond=1e-12)
    mean_state = spread @ sum((w @ x for w, x in zip(weights, pose_states, strict=True)), np.zeros(4))
    # if tags contradict each other beyond noise, the file misplaces them: the spread covers their distance
    deviations = pose_states - mean_state
    reduced_chi_square = sum(float(x @ w @ x) for w, x in zip(weights, deviations, strict=True)) / max(
        3 * (len(poses) - 1), 1
    )
    shared = np.max([pose.shared for pose in poses], axis=0)
    parallax = max(pose.parallax for pose in poses)
    return ObjectPose(
        mean_state[:3], float(mean_state[3]), spread * max(reduced_chi_square, 1.0), shared, parallax
    )


def radius(pose: ObjectPose, outline: Floats, sigmas: float) -> float:
    """Return the largest error of any point of an object's outline.

    The error of a point v combines the errors of place and yaw. With A = [I | e_z x R v], its covariance is
    A C A^T, and its largest standard deviation is the root of the largest eigenvalue. The radius is `sigmas`
    times the largest deviation of all points, plus the parallax.

    Args:
        outline: (K, 2), points of the footprint in the object's frame.
    """
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    yaw_derivatives = np.stack(
        [-sine * outline[:, 0] - cosine * outline[:, 1], cosine * outline[:, 0] - sine * outline[:, 1]]
    )
    point_derivatives = np.zeros((outline.shape[0], 3, 4))
    point_derivatives[:, [0, 1, 2], [0, 1, 2]] = 1.0
    point_derivatives[:, :2, 3] = yaw_derivatives.T
    point_spreads = point_derivatives @ pose.spread @ point_derivatives.transpose(0, 2, 1)
    point_spreads[:, :2, :2] += pose.shared
    return pose.parallax + sigmas * math.sqrt(max(float(np.linalg.eigvalsh(point_spreads)[:, -1].max()), 0.0))


# ----------------------------------------------------------------------------------------- frames of one time


def simultaneous(
    cameras: Sequence[Iterable[Frame]], offsets_ns: Sequence[int] = ()
) -> Iterator[tuple[Frame | None, ...]]:
    """Yield the frames of each time, one for each camera; None for a camera without a frame at that time.

    Frames within half of the cameras' shortest frame interval belong together. At most two frames of a camera
    are read ahead. When one camera ends, the other cameras continue.

    Args:
        cameras: frames of each camera, with increasing times.
        offsets_ns: offset that is added to the stamps of each camera; 0 by default.
    """
    camera_offsets_ns = [*offsets_ns, *[0] * (len(cameras) - len(offsets_ns))]
    shifted_cameras = [
        _shift(frames, offset_ns) for frames, offset_ns in zip(cameras, camera_offsets_ns, strict=True)
    ]
    if len(cameras) == 1:
        # a single camera needs no read-ahead
        yield from ((frame,) for frame in shifted_cameras[0])
        return
    read_ahead = [_ReadAhead(frames) for frames in shifted_cameras]
    while active_cameras := [camera for camera in read_ahead if camera.next_frame is not None]:
        gaps_ns = [camera.gap_ns for camera in active_cameras if camera.gap_ns]
        earliest_ns = min(camera.time_ns for camera in active_cameras)
        latest_ns = earliest_ns + (min(gaps_ns) // 2 if gaps_ns else 0)
        yield tuple(
            camera.take() if camera.next_frame is not None and camera.time_ns <= latest_ns else None
            for camera in read_ahead
        )


def _shift(frames: Iterable[Frame], offset_ns: int) -> Iterator[Frame]:
    return (replace(frame, time_ns=frame.time_ns + offset_ns) if offset_ns else frame for frame in frames)


class _ReadAhead:
    """The frames of one camera, with the next two frames read ahead."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._frames = frames
        self.next_frame, self._second_frame = next(frames, None), next(frames, None)

    @property
    def time_ns(self) -> int:
        """Time of the next frame."""
        return 0 if self.next_frame is None else self.next_frame.time_ns

    @property
    def gap_ns(self) -> int:
        """Time between the next two frames; 0 without a second frame."""
        return 0 if self._second_frame is None else self._second_frame.time_ns - self.time_ns

    def take(self) -> Frame | None:
        """Return the next frame, and read one more frame ahead."""
        frame, self.next_frame = self.next_frame, self._second_frame
        self._second_frame = next(self._frames, None)
        return frame


def camera_names(cameras: Sequence[Any]) -> list[str]:
    """Return the name of each camera: its topic, the name of its video, or "" for frames without a name.

    Raises:
        UsageError: there is no camera.
    """
    if not cameras:
        raise UsageError("there is no camera; give the frames of one or more")
    return [str(getattr(camera, "topic", "") or getattr(camera, "name", "")) for camera in cameras]


# ------------------------------------------------------------------------------------------------- one camera

_MOST_AVERAGED: Final = 30
"""Maximum number of detections of a reference tag that are averaged."""

_MOST_NAMED: Final = 8

_LATE: Final = 8
"""Number of latest frames whose largest misfit is used.

The misfit of a single frame is uncertain, because it has only four degrees of freedom.
"""

_SHARED: Final = 1.2
"""Ratio of a pose's error to its misfit; a codec moves blocks of pixels, so corners share errors.

In videos with crf 23 to 36, the root mean square error of a pose was up to 1.2 times the misfit.
"""

_BLURRED: Final = 2.0
"""Ratio of a tag's error to the reference tags' error; larger ratios give a remark."""

_MOVED: Final = 2.0
"""Largest median shift of the reference tags while the camera rests, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Observation of one camera in one frame.

    Attributes:
        frame: the frame.
        detections: all tags, also tags that are not in the tags file.
        plane: the plane; None while reference tags are missing.
    """

    frame: Frame
    detections: tuple[Detection, ...]
    plane: Plane | None


class CameraView:
    """One resting camera in one run.

    Attributes:
        name: name of its video or topic; "" for a single camera.
        tags: tags file of this camera.
        fit: fit of the reference tags; None without reference tags.
        seen: number of frames with each tag.
        twice: number of frames that show a tag more than once, by tag.
        moved: number of moves of the camera.
        frames: number of frames.
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
        """Return the view of a frame, and poses of objects by tag.

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
        corners_by_tag = self._single(detections)
        if self._size != (width, height):
            self._size, self._plane = (width, height), given_plane(self.tags, (width, height))
            self._averages.clear()
        self._refer(corners_by_tag)
        poses = {} if self._plane is None else self._poses(self._plane, corners_by_tag)
        return View(frame, tuple(detections), self._plane), poses

    def _size_without_image(self) -> tuple[int, int]:
        """Return the size (width, height) of images that are not stored; (0, 0) if it is not needed."""
        if self.tags.is_image:
            raise UsageError(
                f"{self.tags.name}: plane: image counts from the lower edge of the image, and detections do"
                " not say where that is; give reference tags, or map the topic (docs/mapping.md) for pixels"
            )
        return (0, 0) if self.tags.camera is None else self.tags.camera.size

    def _single(self, detections: Iterable[Detection]) -> dict[int, Floats]:
        """Return the corners of tags that are in the image exactly once; two equal tags are ambiguous."""
        tag_counts = Counter(detection.id for detection in detections)
        self.seen.update(tag_counts.keys())
        self.twice.update(tag_id for tag_id, count in tag_counts.items() if count > 1)
        return {detection.id: detection.corners for detection in detections if tag_counts[detection.id] == 1}

    def _refer(self, corners: Mapping[int, Floats]) -> None:
        """Average the reference tags, and fit the plane again while the averages change."""
        if not self.tags.references or self.tags.pose is not None:
            return
        seen_references = {
            reference.id: corners[reference.id]
            for reference in self.tags.references
            if reference.id in corners
        }
        earlier_averages = {
            tag_id: self._averages[tag_id] for tag_id in seen_references if tag_id in self._averages
        }
        shifts_px = [
            float(np.linalg.norm(seen_references[n] - mean_corners, axis=1).mean())
            for n, (mean_corners, _) in earlier_averages.items()
        ]
        if shifts_px and float(np.median(shifts_px)) > _MOVED:
            self.moved += 1
            self._averages.clear()
        is_changed = False
        for tag_id, tag_corners in seen_references.items():
            mean_corners, detection_count = self._averages.get(tag_id, (tag_corners, 0))
            if detection_count < _MOST_AVERAGED:
                is_changed = True
                self._averages[tag_id] = (
                    mean_corners + (tag_corners - mean_corners) / (detection_count + 1),
                    detection_count + 1,
                )
        if not is_changed:
            return
        if len(self._averages) < LEAST_REFERENCES:
            self._plane = None
            return
        try:
            corners_by_id = {tag_id: mean_corners for tag_id, (mean_corners, _) in self._averages.items()}
            self.fit = plane_from_references(self.tags, corners_by_id, self._size or (0, 0))
            self._plane = self.fit.plane
        except UsageError:
            # tags that fitted before do not fit while the camera or a tag moves
            if self.fit is None:
                raise
            self._plane = None

    def _poses(self, plane: Plane, corners: Mapping[int, Floats]) -> dict[int, ObjectPose]:
        """Return poses of objects by tag, from each tag in the image."""
        object_tag_ids = sorted(tag_id for tag_id in corners if tag_id in self.tags.by_id)
        flat_tag_ids = [tag_id for tag_id in object_tag_ids if not self.tags.by_id[tag_id][0].is_lifted]
        sigmas = self.tags.sigmas
        poses: dict[int, ObjectPose] = {}
        if flat_tag_ids:
            flat_corners = np.stack([corners[tag_id] for tag_id in flat_tag_ids])
            flat_tags = [self.tags.by_id[tag_id][1] for tag_id in flat_tag_ids]
            poses |= zip(flat_tag_ids, poses_on_plane(plane, flat_corners, flat_tags, sigmas), strict=True)
        if isinstance(plane, CameraPlane):
            for tag_id in object_tag_ids:
                tagged, tag = self.tags.by_id[tag_id]
                pose = pose_in_space(plane, corners[tag_id], tag, sigmas) if tagged.is_lifted else None
                if pose is not None:
                    poses[tag_id] = pose
        poses = {tag_id: self._with_misfits(plane, tag_id, pose) for tag_id, pose in poses.items()}
        self._parallax = max(self._parallax, *(pose.parallax for pose in poses.values()), 0.0)
        return poses

    def _with_misfits(self, plane: Plane, tag_id: int, pose: ObjectPose) -> ObjectPose:
        """Return the pose with a spread that covers the latest misfits of its tag.

        Reference tags rest, and a codec sharpens resting parts of a video. So the misfits of reference tags
        do not show the errors of moving tags.
        """
        if self.tags.corner_error is not None or pose.doubt is not None:
            return pose
        # with the error of the reference tags alone, 20 to 41 of 150 outlines were wrong at crf 36
        misfits = self._misfits.setdefault(tag_id, deque(maxlen=_LATE))
        misfits.append(pose.misfit)
        error_ratio = max(_SHARED * max(misfits) / plane.corner_error, 1.0)
        self._sharpness["fitted"] += 1
        self._sharpness["blurred"] += error_ratio > _BLURRED
        return pose._replace(spread=pose.spread * error_ratio**2)

    def _why_no_plane(self) -> str:
        if self.fit is not None:
            return "the reference tags stopped fitting each other, as the camera or a tag moved"
        unseen_ids = [str(tag.id) for tag in self.tags.references if tag.id not in self.seen]
        if len(self.tags.references) - len(unseen_ids) >= LEAST_REFERENCES:
            return (
                "enough reference tags were seen, but fewer than"
                f" {LEAST_REFERENCES} of them once in a frame while the camera stood still"
            )
        verb = "was" if len(unseen_ids) == 1 else "were"
        return f"fewer than {LEAST_REFERENCES} reference tags were seen; {tags_text(unseen_ids)} {verb} not"

    def remarks(self) -> list[str]:
        """Return remarks on the camera: no tag seen, no plane, uncertain places, or moves."""
        frames_text, lines = plural(self.frames, "frame"), []
        of_camera = f" of {self.name}" if self.name else ""
        if self.frames and not self.seen:
            lines.append(
                f"no tag of family {self.tags.family} is in any of {frames_text}{of_camera}; check the"
                " family, the light, that tags are 20 pixels or larger, with a white rim, and that the camera"
                " looks from above"
            )
            return lines
        if self.frames and self.tags.references and self._plane is None:
            lines.append(f"the plane{of_camera} is not known: {self._why_no_plane()}")
        for tag_id, frame_count in sorted(self.twice.items()):
            lines.append(
                f"tag {tag_id} is in {plural(frame_count, 'frame')}{of_camera} more than once, and left out"
                " there"
            )
        if self._parallax:
            largest_height = max(
                (tag.z for _, tag in self.tags.by_id.values() if tag.id in self.seen), key=abs
            )
            lines.append(
                f"tags on objects are up to {1e3 * abs(largest_height):.3g} mm"
                f" {'above' if largest_height > 0 else 'below'} the reference tags, and no"
                f" camera{of_camera} is calibrated: outlines are up to {1e3 * self._parallax:.3g} mm less"
                " certain; calibrate the camera (tags calibrate), or fix"
                " the reference tags as high as the others and give their height (plane: height: …)"
            )
        fitted_count, blurred_count = self._sharpness["fitted"], self._sharpness["blurred"]
        if 2 * blurred_count > fitted_count:
            lines.append(
                f"the video{of_camera} is blurred or strongly compressed: in {blurred_count} of"
                f" {fitted_count} places, objects are more than {_BLURRED:g} times less certain; expose"
                " shorter, or compress less (crf 18)"
            )
        if self.moved:
            camera_name = self.name or "the camera"
            lines.append(
                f"{camera_name} has moved {plural(self.moved, 'time')}: places are uncertain while it does"
            )
        return lines


def tags_text(numbers: list[str]) -> str:
    """Return a list of tags for a sentence; a long list is cut."""
    return f"tag{'s' if len(numbers) > 1 else ''} {listing(numbers, _MOST_NAMED)}"


# ---------------------------------------------------------------------------------------------------- samples


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of the frames of one time.

    Attributes:
        sample: objects of that time.
        views: view of each camera; None for a camera without a frame at that time.
    """

    sample: Sample
    views: tuple[View | None, ...]

    @property
    def first(self) -> View:
        """View of the first camera with a frame."""
        return next(view for view in self.views if view is not None)


class TagObserver:
    """Converts the frames of resting cameras to samples, in one run.

    An object is unknown if its tags are hidden from all cameras, or if its pose has a doubt. A hidden object
    is held at its last place for a while, with an uncertainty that grows at the object's highest speed.

    Attributes:
        tags: the tags file.
        hold_ns: time that a hidden object is held.
        frames: number of samples so far.
    """

    def __init__(self, tags: TagsFile, *, hold_ns: int | None = None, cameras: Sequence[str] = ("",)) -> None:
        """Prepare the detectors.

        Args:
            hold_ns: time that a hidden object is held; None for the time in the tags file.
            cameras: names of the cameras, such as the names of their videos; by default, one camera.

        Raises:
            UsageError: a negative time, a camera that the tags file lacks, or OpenCV is not installed.
        """
        hold_ns = tags.hold_ns if hold_ns is None else hold_ns
        if hold_ns < 0:
            raise UsageError(f"objects are held for {hold_ns} ns; give 0 or more")
        self.tags, self.hold_ns = tags, hold_ns
        camera_count = len(cameras)
        self._cameras = [
            CameraView(
                name if camera_count > 1 else "", tags.of_camera(name, camera_number, count=camera_count)
            )
            for camera_number, name in enumerate(cameras, 1)
        ]
        self._last_seen: dict[str, tuple[int, TrackedObject]] = {}
        self._unknown_classes: dict[str, str | None] = {}
        self._outlines = {tagged.name: _outline(tagged.footprint) for tagged in tags.objects}
        self._doubts: dict[str, tuple[str, int]] = {}
        self._tag_distances: dict[str, tuple[float, int]] = {}
        self.frames = self._last_ns = 0

    @property
    def fits(self) -> tuple[Fit | None, ...]:
        """Fit of the reference tags in each camera; None without reference tags."""
        return tuple(camera.fit for camera in self._cameras)

    def observe(self, *frames: Frame | None) -> Observation:
        """Return the observation of the frames of one time.

        The sample has the stamp of the first frame. Other frames may be earlier or later. If another
        frame locates an object, the object's possible motion between the stamps adds to its uncertainty.

        Args:
            frames: one frame or None for each camera; at least one frame.

        Raises:
            UsageError: a frame that is not later than the previous one, a camera that is calibrated for
                another size, or reference tags that do not fit.
        """
        if len(frames) != len(self._cameras) or all(frame is None for frame in frames):
            raise UsageError(
                f"{plural(len(self._cameras), 'camera')}: give a frame or None for each, at least one frame"
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
        poses_by_camera: list[tuple[int, Mapping[int, ObjectPose]]] = []
        for camera, frame in zip(self._cameras, frames, strict=True):
            view = None
            if frame is not None:
                try:
                    view, poses_by_tag = camera.look(frame)
                except UsageError as error:
                    raise UsageError(f"{camera.name}: {error}" if camera.name else str(error)) from None
                poses_by_camera.append((abs(frame.time_ns - time_ns), poses_by_tag))
            views.append(view)
        objects = dict(self._locate(poses_by_camera))
        held_objects = self._hold(time_ns, objects)
        reported_ns = {name: self._last_seen[name][0] for name in held_objects}
        sample = Sample(
            time_ns, {**objects, **held_objects}, unknown=self._unknown_classes, reported_ns=reported_ns
        )
        return Observation(sample, tuple(views))

    # ------------------------------------------------------------------------------------- the objects

    def _locate(
        self, poses_by_camera: Sequence[tuple[int, Mapping[int, ObjectPose]]]
    ) -> Iterator[tuple[str, TrackedObject]]:
        """Yield the objects that have a pose without a doubt.

        Args:
            poses_by_camera: time offset of the frame, ns, and poses by tag, of each camera with a frame.
        """
        for tagged in self.tags.objects:
            object_poses = [
                (offset_ns, poses_by_tag[tag.id])
                for offset_ns, poses_by_tag in poses_by_camera
                for tag in tagged.tags
                if tag.id in poses_by_tag
            ]
            for _, pose in object_poses:
                if pose.doubt is not None:
                    doubt_text, frame_count = self._doubts.get(tagged.name, (pose.doubt, 0))
                    self._doubts[tagged.name] = doubt_text, frame_count + 1
            usable_poses = [(offset_ns, pose) for offset_ns, pose in object_poses if pose.doubt is None]
            # frames with a time offset are used if they make the object more certain
            candidates = [
                self._track(
                    tagged,
                    fuse([pose for offset_ns, pose in usable_poses if offset_ns <= latest_offset_ns]),
                    latest_offset_ns,
                )
                for latest_offset_ns in sorted({offset_ns for offset_ns, _ in usable_poses})
            ]
            self._compare(tagged, [pose for _, pose in usable_poses])
            if candidates:
                yield tagged.name, min(candidates, key=lambda tracked: tracked.uncertainty)

    def _compare(self, tagged: TaggedObject, poses: Sequence[ObjectPose]) -> None:
        """Record an object whose tags give places further apart than its size plus their uncertainty."""
        if len(poses) < 2:
            return
        outline = self._outlines[tagged.name]
        diameter = 2 * max(
            float(np.linalg.norm(outline, axis=1).max()), *(part.radius for part in tagged.footprint.parts)
        )
        uncertainty = 2 * max(radius(pose, outline, self.tags.sigmas) for pose in poses)
        distance = max(float(np.linalg.norm((poses[0].place - pose.place)[:2])) for pose in poses)
        if distance > diameter + uncertainty:
            largest_distance, frame_count = self._tag_distances.get(tagged.name, (0.0, 0))
            self._tag_distances[tagged.name] = max(largest_distance, distance), frame_count + 1

    def _track(self, tagged: TaggedObject, pose: ObjectPose, offset_ns: int) -> TrackedObject:
        height = tagged.height
        if height is not None and tagged.is_lifted:
            height = height[0] + float(pose.place[2]), height[1] + float(pose.place[2])
        return TrackedObject(
            _move(tagged.footprint, float(pose.place[0]), float(pose.place[1]), pose.yaw),
            class_name=tagged.class_name,
            yaw=math.remainder(pose.yaw, 2 * math.pi),
            height=height,
            uncertainty=radius(pose, self._outlines[tagged.name], self.tags.sigmas)
            + tagged.fastest * offset_ns / 1e9,
        )

    def _hold(self, time_ns: int, objects: Mapping[str, TrackedObject]) -> dict[str, TrackedObject]:
        """Return the held objects; store the places of visible objects and the names of unknown objects."""
        held_objects: dict[str, TrackedObject] = {}
        for tagged in self.tags.objects:
            if tagged.name in objects:
                self._last_seen[tagged.name] = time_ns, objects[tagged.name]
                self._unknown_classes.pop(tagged.name, None)
            elif tagged.name in self._last_seen:
                last_seen_ns, last_object = self._last_seen[tagged.name]
                if time_ns - last_seen_ns <= self.hold_ns:
                    uncertainty = last_object.uncertainty + tagged.fastest * (time_ns - last_seen_ns) / 1e9
                    # a yaw has no uncertainty, so the yaw of an object that may have turned is unknown
                    yaw = None if tagged.fastest else last_object.yaw
                    held_objects[tagged.name] = TrackedObject(
                        last_object.footprint, last_object.class_name, yaw, last_object.height, uncertainty
                    )
                else:
                    self._unknown_classes[tagged.name] = tagged.class_name
        return held_objects

    # ------------------------------------------------------------------------------------- remarks

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on the run, such as tags that are not in the file and objects never seen."""
        camera_lines = [line for camera in self._cameras for line in camera.remarks()]
        frames_by_tag = sum((camera.seen for camera in self._cameras), Counter[int]())
        if not frames_by_tag:
            return tuple(camera_lines)
        lines: list[str] = []
        unmapped_ids = [tag_id for tag_id in sorted(frames_by_tag) if tag_id not in self.tags.ids]
        if unmapped_ids:
            tag_texts = [f"{tag_id} (in {plural(frames_by_tag[tag_id], 'frame')})" for tag_id in unmapped_ids]
            lines.append(f"{self.tags.name} has no {tags_text(tag_texts)}")
        unseen_objects = [
            tagged for tagged in self.tags.objects if not any(tag.id in frames_by_tag for tag in tagged.tags)
        ]
        frames_text = plural(sum(camera.frames for camera in self._cameras), "frame")
        lines += [
            f"{tagged.name} was never seen: no {tags_text([str(tag.id) for tag in tagged.tags])} in"
            f" {frames_text}"
            for tagged in unseen_objects[:_MOST_NAMED]
        ]
        lines += camera_lines
        for object_name, (doubt_text, frame_count) in sorted(self._doubts.items()):
            lines.append(f"{object_name} is unknown in {plural(frame_count, 'frame')}: {doubt_text}")
        for object_name, (largest_distance, frame_count) in sorted(self._tag_distances.items()):
            where = f"in {plural(frame_count, 'frame')}, by up to {largest_distance:.3g} {self.tags.unit}"
            lines.append(
                f"{object_name}: its tags contradict each other {where}; check their places on it, and of"
                " cameras the pose and the --offset"
            )
        return tuple(lines)


def observe_frames(
    frames: Iterable[Frame], tags: TagsFile, *, hold_ns: int | None = None
) -> Iterator[Observation]:
    """Yield the observation of each frame of a camera; see `TagObserver`."""
    return observe_cameras([frames], tags, hold_ns=hold_ns)


def observe_cameras(
    cameras: Sequence[Iterable[Frame]], tags: TagsFile, *, hold_ns: int | None = None
) -> Iterator[Observation]:
    """Yield one observation of several cameras for each time; see `TagObserver` and `simultaneous`.

    Raises:
        UsageError: no camera, or a camera that the tags file lacks.
    """
    observer = TagObserver(tags, hold_ns=hold_ns, cameras=camera_names(cameras))
    for frames in simultaneous(cameras):
        yield observer.observe(*frames)


def _outline(footprint: Footprint) -> Floats:
    """Return the vertices (K, 2) of a footprint, the points that a turn moves furthest."""
    return np.concatenate([part.vertices for part in footprint.parts])


def _move(footprint: Footprint, x: float, y: float, yaw: float) -> Footprint:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    return Footprint(
        tuple(
            ConvexPart(part.vertices @ rotation + np.array([x, y]), part.radius) for part in footprint.parts
        )
    )
