"""Poses of objects from the corners of their tags, each with its covariance.

An object that stays on the plane is found where the rays through its tag's corners meet the tag's height. One
that may be lifted is found in space, by the size of its tag. Either way, the pose is a function of eight
coordinates in pixels; its covariance is that of a corner, taken through the function's derivative.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.opencv import rotations
from spatial_replay.perception.plane import CameraPlane, HomographyPlane, Plane
from spatial_replay.perception.tags_file import MountedTag

_STEP: Final = 1e-3
"""Pixels by which corners are moved for derivatives."""

_SIZE_TOLERANCE: Final = 0.02
"""By what share a tag may appear larger or smaller beyond its noise: how well its size is measured."""

_LEANING: Final = math.radians(3.0)
"""Standard deviation of how much an object leans that is carried."""

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
    """

    place: Floats
    yaw: float
    spread: Floats
    shared: Floats
    parallax: float = 0.0
    doubt: str | None = None


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
        [
            cosine * offset[:, :1] - sine * offset[:, 1:],
            sine * offset[:, :1] + cosine * offset[:, 1:],
        ],
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
        parallax, larger = (each.reshape(-1, 4).max(axis=1) for each in bounds)
        lifted += ", or the tag is higher above the reference tags than the file says"
    poses = []
    for index, tag in enumerate(tags):
        of_pose = np.zeros((4, 4))
        chosen = [0, 1, 3]
        of_pose[np.ix_(chosen, chosen)] = spread[index, :3, :3]
        doubt = None
        if not np.isfinite(numbers[index]).all():
            doubt = f"tag {tag.id} is not in front of the camera"
        elif size[index] > 0:
            noise = sigmas * math.sqrt(spread[index, 3, 3]) / size[index]
            ratio = edge[index, 0] / size[index] - 1
            square = along[index, 0] / 4
            off = _out_of_square(places[index, 0], centre[index, 0], square) / size[index]
            beyond = abs(ratio) - (larger[index] if ratio * tag.z > 0 else 0.0)
            if beyond > _SIZE_TOLERANCE + noise or off > 2 * _SIZE_TOLERANCE + 2 * noise:
                doubt = (
                    f"tag {tag.id} appears {abs(ratio):.0%} {'larger' if ratio > 0 else 'smaller'} than it"
                    f" is, or leans: {lifted}"
                )
        place = np.array([*numbers[index, 0, :2], 0.0])
        yaw_of_object, off_by = float(numbers[index, 0, 2]), float(parallax[index])
        poses.append(ObjectPose(place, yaw_of_object, of_pose, shared[index], off_by, doubt))
    return poses


def _out_of_square(corners: Floats, centre: Floats, along: Floats) -> float:
    """Return how far corners (4, 2) are at most from those of a square of any size."""
    half = along / 2
    across = np.array([-half[1], half[0]])
    ideal = centre + np.array([-half - across, half - across, half + across, -half + across])
    return float(np.linalg.norm(corners - ideal, axis=1).max())


def pose_in_space(plane: CameraPlane, corners: Floats, tag: MountedTag, sigmas: float) -> ObjectPose | None:
    """Return the pose of an object that may be above the plane; None if none fits.

    Objects stand upright within a few degrees, in the robot's hand, too: how a small tag leans can hardly be
    seen, and two poses that lean to opposite sides look alike.

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
    chosen = [0, 1, 2, 5]
    doubt = None
    off = float(np.sqrt(np.square(residual[:8]).sum() / 4))
    if off > sigmas * (2 * plane.corner_error) or np.linalg.norm(state[3:5]) > sigmas * _LEANING:
        doubt = f"tag {tag.id} does not look like an upright tag of its size: its object has tipped over"
    shared = plane.covariance(corners.mean(axis=0)[None], state[2:3])[0]
    return ObjectPose(
        state[:3] - shift, float(yaw), lever @ spread[np.ix_(chosen, chosen)] @ lever.T, shared, doubt=doubt
    )


def _level_start(plane: CameraPlane, corners: Floats, tag: MountedTag) -> Floats:
    """Return x, y, z and yaw of a tag that is upright and appears as large as it is."""
    places = plane.places(corners, np.full(4, tag.z))
    along = (places[1] - places[0]) + (places[2] - places[3])
    left = (places[3] - places[0]) + (places[2] - places[1])
    along = along + np.array([left[1], -left[0]])
    eye = -plane.rotation.T @ plane.pose[3:]
    centre = np.append(places.mean(axis=0), tag.z)
    there = eye + (centre - eye) * (4 * tag.size / np.linalg.norm(along))
    return np.append(there, math.atan2(along[1], along[0]))


def fused(poses: Sequence[ObjectPose]) -> ObjectPose:
    """Return one pose from those of several tags on one object, each weighted by its covariance."""
    if len(poses) == 1:
        return poses[0]
    first = poses[0].yaw
    states = np.array(
        [[*each.place, first + math.remainder(each.yaw - first, 2 * math.pi)] for each in poses]
    )
    weights = [np.linalg.pinv(each.spread, hermitian=True, rcond=1e-12) for each in poses]
    spread = np.linalg.pinv(sum(weights, np.zeros((4, 4))), hermitian=True, rcond=1e-12)
    mean = spread @ sum((w @ x for w, x in zip(weights, states, strict=True)), np.zeros(4))
    # tags that contradict each other beyond their noise: what the file says of them is not exact
    off = states - mean
    excess = sum(float(x @ w @ x) for w, x in zip(weights, off, strict=True)) / max(3 * (len(poses) - 1), 1)
    shared = np.max([each.shared for each in poses], axis=0)
    parallax = max(each.parallax for each in poses)
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
