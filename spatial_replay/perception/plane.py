"""The plane of the objects: conversion of pixels to places, and the uncertainty of places.

A plane is a homography from reference tags, the view of a calibrated camera, or the image itself. The tags
file states the pose of a camera, or reference tags determine it. A plane from reference tags has a
covariance, so that a place far from all reference tags is less certain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.opencv import Camera, fit_homography, fit_pose, projection, rotations
from spatial_replay.perception.tags_file import MountedTag, TagsFile

# with 0.1, 99.5 % of the outlines in 538 frames of a planned run contained the true outline; a larger value
# makes lifted objects too uncertain to judge
LEAST_CORNER_ERROR: Final = 0.1
"""Least standard deviation of a corner, pixels, even if reference tags fit better."""

USUAL_CORNER_ERROR: Final = 0.3
"""Standard deviation of a corner if reference tags do not measure it, pixels."""

_WORST_RESIDUAL: Final = 3.0
"""Largest error of a reference tag from noise, pixels; a larger error means a wrong place."""

_LEAST_SLANT: Final = math.sin(math.radians(8.0))
"""Sine of the least angle between view and plane; at lower angles, no tags are detected."""

_WIDEST: Final = 1.0
"""Assumed half diagonal of an uncalibrated image, focal lengths: 90 degrees between opposite corners."""

_STEP: Final = 1e-6


class Plane(Protocol):
    """Map from pixels to places."""

    @property
    def corner_error(self) -> float:
        """Standard deviation of a corner in pixels."""

    def places(self, pixels: Floats, z: Floats) -> Floats:
        """Return the places (…, 2) of pixels (…, 2) at heights (…) above the plane."""

    def covariance(self, pixels: Floats, z: Floats) -> Floats:
        """Return the covariance (N, 2, 2) of the places of pixels (N, 2), from the error of the plane."""

    def pixels(self, places: Floats) -> Floats:
        """Return the pixels (N, 2) of places (N, 3)."""


class Fit(NamedTuple):
    """Fit of a plane to reference tags.

    Attributes:
        rms: root mean square error of the tags' corners, pixels.
        worst: tag with the largest error, and mean error of its corners, pixels.
    """

    plane: Plane
    rms: float
    worst: tuple[int, float]


@dataclass(frozen=True, slots=True, eq=False)
class ImagePlane:
    """The image itself, with y up; the outer corner of its lower left pixel is (0, 0)."""

    height: int
    corner_error: float = USUAL_CORNER_ERROR

    def places(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        return np.stack([pixels[..., 0] + 0.5, self.height - 0.5 - pixels[..., 1]], axis=-1)

    def covariance(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        return np.zeros((len(pixels), 2, 2))

    def pixels(self, places: Floats) -> Floats:
        """See `Plane`."""
        return np.stack([places[..., 0] - 0.5, self.height - 0.5 - places[..., 1]], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class HomographyPlane:
    """A plane seen by an uncalibrated camera, which does not resolve heights above the plane.

    Attributes:
        pixel_from_plane: (3, 3), homography with the last entry 1.
        spread: (8, 8), covariance of the other eight entries.
        size: (width, height) of the images, pixels; (0, 0) if it is not known.
    """

    pixel_from_plane: Floats
    spread: Floats
    corner_error: float
    size: tuple[int, int] = (0, 0)

    def places(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        return _through(np.asarray(np.linalg.inv(self.pixel_from_plane), np.float64), pixels)

    def covariance(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        entries = self.pixel_from_plane.ravel()[:8]
        steps = _STEP * np.maximum(np.abs(entries), 1e-3)
        # central differences by each entry
        moved_entries = np.repeat(np.append(entries, 1.0)[None], 16, axis=0)
        moved_entries[np.arange(8), np.arange(8)] += steps
        moved_entries[np.arange(8, 16), np.arange(8)] -= steps
        inverse_matrices = np.linalg.inv(moved_entries.reshape(16, 3, 3))
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        homogeneous_places = np.einsum("kij,nj->kni", inverse_matrices, homogeneous)
        places = homogeneous_places[..., :2] / homogeneous_places[..., 2:]
        derivative = (places[:8] - places[8:]) / (2 * steps)[:, None, None]
        return np.asarray(np.einsum("kni,kl,lnj->nij", derivative, self.spread, derivative), np.float64)

    def pixels(self, places: Floats) -> Floats:
        """See `Plane`."""
        return _through(self.pixel_from_plane, places[..., :2])

    def parallax(self, pixels: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Bound the error of reading pixels (N, 2) at heights (N,) as places in the plane.

        A ray at the angle t to the plane's normal shifts by |z| tan t between the height z and the plane. The
        map from the plane to the image is A B. B maps the plane to the sphere around the camera. At the
        distance d, its singular values are (1, cos t) / d. A maps the sphere to the image. At the angle p to
        the optical axis, its singular values are f / cos p and f / cos² p. So cos t is at least cos p times
        the ratio of the singular values of A B, and d is at least f divided by the greater singular value.

        Returns:
            Largest errors of places, and largest relative errors of lengths, (N,) each.
        """
        matrix, places = self.pixel_from_plane, self.places(pixels, z)
        depth = places @ matrix[2, :2] + matrix[2, 2]
        local_jacobians = (matrix[:2, :2] - pixels[:, :, None] * matrix[2, :2]) / depth[:, None, None]
        greater_singulars, lesser_singulars = np.linalg.svd(local_jacobians, compute_uv=False).T
        size_px = np.array(self.size, np.float64)
        half_diagonal_px = float(np.linalg.norm(size_px)) / 2
        # without images, the outermost detection is assumed to be in the image's corner
        focal_px = (half_diagonal_px or float(np.linalg.norm(pixels, axis=1).max()) / 2) / _WIDEST
        off_axis = (
            np.linalg.norm(pixels - (size_px - 1) / 2, axis=1) / focal_px if half_diagonal_px else _WIDEST
        )
        cosines = lesser_singulars / greater_singulars / np.sqrt(1 + np.square(off_axis))
        camera_heights = focal_px / greater_singulars * cosines
        with np.errstate(divide="ignore"):
            length_errors = np.where(
                camera_heights > np.abs(z), np.abs(z) / (camera_heights - np.abs(z)), np.inf
            )
        return np.abs(z) * np.sqrt(1 / np.square(cosines) - 1), np.asarray(length_errors)


@dataclass(frozen=True, slots=True, eq=False)
class CameraPlane:
    """A plane seen by a calibrated camera.

    Attributes:
        pose: (6,), rotation vector and translation from the plane's frame to the camera's.
        spread: (6, 6), covariance of the pose.
    """

    camera: Camera
    pose: Floats
    spread: Floats
    corner_error: float

    @property
    def rotation(self) -> Floats:
        """(3, 3), rotation from the plane's frame to the camera's."""
        return np.asarray(rotations(self.pose[None, :3])[0], np.float64)

    def places(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        return _cast(self.camera.directions(pixels), self.rotation, self.pose[3:], z)

    def covariance(self, pixels: Floats, z: Floats) -> Floats:
        """See `Plane`."""
        directions = self.camera.directions(pixels)
        places_by_sign = []
        for sign in (1.0, -1.0):
            moved_poses = self.pose + sign * _STEP * np.eye(6)
            moved_rotations = rotations(moved_poses[:, :3])
            places_by_sign.append(
                [_cast(directions, moved_rotations[k], moved_poses[k, 3:], z) for k in range(6)]
            )
        derivative = (np.array(places_by_sign[0]) - np.array(places_by_sign[1])) / (2 * _STEP)
        return np.asarray(np.einsum("kni,kl,lnj->nij", derivative, self.spread, derivative), np.float64)

    def pixels(self, places: Floats) -> Floats:
        """See `Plane`."""
        return self.camera.pixels(np.asarray(places @ self.rotation.T + self.pose[3:], np.float64))


def plane_from_references(tags: TagsFile, corners: Mapping[int, Floats], size: tuple[int, int]) -> Fit:
    """Fit the plane to reference tags.

    Args:
        size: (width, height) of the images, pixels; (0, 0) if it is not known.
        corners: (4, 2) corners of the detected reference tags, at least `LEAST_REFERENCES` tags.

    Raises:
        UsageError: the tags do not fit, or the plane is seen edge-on.
    """
    references = [tag for tag in tags.references if tag.id in corners]
    known_corners = np.concatenate([tag.corners for tag in references])
    seen_corners = np.concatenate([corners[tag.id] for tag in references])
    solution = _solve(known_corners, seen_corners, tags.camera)
    if solution is None:
        raise UsageError(f"{tags.name}: {_edge_on()}")
    fitted_corners, derivative = _appearing(known_corners, solution, tags.camera)
    corner_errors_px = np.linalg.norm(fitted_corners - seen_corners, axis=1)
    unknown_count = derivative.shape[-1]
    # error per degree of freedom, so that a fit of few tags does not look exact
    rms = float(
        np.sqrt(np.square(corner_errors_px).sum() / max(2 * len(corner_errors_px) - unknown_count, 1))
    )
    tag_errors_px = corner_errors_px.reshape(-1, 4).mean(axis=1)
    worst_index = int(tag_errors_px.argmax())
    worst_tag = references[worst_index].id, float(tag_errors_px[worst_index])
    _refuse_misfit(tags, references, tag_errors_px, seen_corners, known_corners)
    corner_error_px = tags.corner_error or max(rms, LEAST_CORNER_ERROR)
    flat_derivative = derivative.reshape(-1, unknown_count)
    # corners move by this many pixels for an error of one unit in a tag's place
    pixels_per_unit = _pixels_per_unit(seen_corners, known_corners)
    variance = corner_error_px**2 + (tags.reference_error * pixels_per_unit) ** 2
    # covariance of a least squares fit: variance (J^T J)^-1
    spread = np.asarray(variance * np.linalg.pinv(flat_derivative.T @ flat_derivative), np.float64)
    plane: Plane
    if tags.camera is None:
        plane = HomographyPlane(solution, spread, corner_error_px, size)
    else:
        plane = CameraPlane(tags.camera, solution, spread, corner_error_px)
    _refuse_edge_on(tags, seen_corners, known_corners)
    return Fit(plane, rms, worst_tag)


def given_plane(tags: TagsFile, size: tuple[int, int]) -> Plane | None:
    """Return the plane that a tags file determines without images; None if reference tags must determine it.

    Args:
        size: (width, height) of the images in pixels.

    Raises:
        UsageError: the camera was calibrated for images of another size.
    """
    if tags.camera is not None and tags.camera.size != size:
        width, height = tags.camera.size
        raise UsageError(
            f"{tags.name}: the camera is calibrated for images of {width} x {height}; these have"
            f" {size[0]} x {size[1]}; record with that size, or calibrate again (tags calibrate)"
        )
    corner_error_px = tags.corner_error or USUAL_CORNER_ERROR
    if tags.is_image:
        return ImagePlane(size[1], corner_error_px)
    if tags.pose is not None and tags.camera is not None:
        return CameraPlane(tags.camera, tags.pose, np.zeros((6, 6)), corner_error_px)
    return None


def _through(matrix: Floats, points: Floats) -> Floats:
    """Map points (…, 2) by a homography."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped_points: Floats = homogeneous[..., :2] / homogeneous[..., 2:]
    return mapped_points


def _cast(directions: Floats, rotation: Floats, shift: Floats, z: Floats) -> Floats:
    """Return the places of camera rays (…, 2) at heights (…) above the plane; NaN behind the camera."""
    camera_place = -rotation.T @ shift
    rays = np.concatenate([directions, np.ones((*directions.shape[:-1], 1))], axis=-1) @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (z - camera_place[2]) / rays[..., 2]
    places = camera_place[:2] + np.where(distances > 0, distances, np.nan)[..., None] * rays[..., :2]
    return np.asarray(places)


def _homography_jacobian(matrix: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return mapped points (N, 2), and their derivative (N, 2, 8) by the first eight matrix entries."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    u, v, w = homogeneous.T
    x, y = points.T
    zeros, ones = np.zeros_like(x), np.ones_like(x)
    u_derivative = np.stack([x, y, ones, zeros, zeros, zeros, -u / w * x, -u / w * y], axis=1) / w[:, None]
    v_derivative = np.stack([zeros, zeros, zeros, x, y, ones, -v / w * x, -v / w * y], axis=1) / w[:, None]
    return homogeneous[:, :2] / w[:, None], np.stack([u_derivative, v_derivative], axis=1)


def _pixels_per_unit(seen_corners: Floats, known_corners: Floats) -> float:
    """Return the largest number of pixels per unit of the plane, from the edges of tags."""
    edge_vectors = [
        np.diff(corners.reshape(-1, 4, 2), axis=1).reshape(-1, 2) for corners in (seen_corners, known_corners)
    ]
    edge_lengths = [np.linalg.norm(vectors, axis=1) for vectors in edge_vectors]
    return float((edge_lengths[0] / edge_lengths[1]).max())


def _refuse_misfit(
    tags: TagsFile,
    references: Sequence[MountedTag],
    tag_errors_px: Floats,
    seen_corners: Floats,
    known_corners: Floats,
) -> None:
    """Check that no error of a tag, (K,), exceeds noise plus the stated error of places."""
    limit_px = _WORST_RESIDUAL + 2 * tags.reference_error * _pixels_per_unit(seen_corners, known_corners)
    if tag_errors_px.max() <= limit_px:
        return
    first_tag = references[0]
    # half a turn is tried first, because OpenCV prints AprilTags upside down
    for turns in (2, 1, 3):
        # the corners of all tags in a turned order
        turned_corners = np.roll(known_corners.reshape(-1, 4, 2), -turns, axis=1).reshape(-1, 2)
        solution = _solve(turned_corners, seen_corners, tags.camera)
        if (
            solution is not None
            and _off_by_tag(turned_corners, seen_corners, solution, tags.camera).max() <= limit_px
        ):
            raise UsageError(
                f"{tags.name}: the reference tags fit each other only if all are turned by {90 * turns}"
                f" degrees, as other programs print them; write {first_tag.id}: {{at: [{first_tag.x:g},"
                f" {first_tag.y:g}], yaw: {90 * turns}deg}}, the others alike, and the same yaw"
                " for tags on objects"
            )
    outlier = _off_alone(tags, seen_corners, known_corners)
    if outlier is not None and outlier[2] <= limit_px:
        tag_index, error_px, _ = outlier
        raise UsageError(
            f"{tags.name}: the reference tags do not fit each other: tag {references[tag_index].id} is off by"
            f" {error_px:.1f} pixels from where the others place it; check its place, its yaw and its size"
        )
    worst_id = references[int(tag_errors_px.argmax())].id
    raise UsageError(
        f"{tags.name}: the reference tags do not fit each other: tag {worst_id} is off most, by"
        f" {tag_errors_px.max():.1f} pixels; check the places, the yaw and the size of the tags, or"
        " calibrate the camera if its lens bends straight lines (tags calibrate)"
    )


def _off_alone(
    tags: TagsFile, seen_corners: Floats, known_corners: Floats
) -> tuple[int, float, float] | None:
    """Find the tag whose removal gives the best fit of the other tags; None without any fit.

    Returns:
        index of the tag, its error in the fit of the other tags, and the largest error of the other tags,
        pixels.
    """
    candidates: list[tuple[float, int, float]] = []
    for tag_index in range(len(known_corners) // 4):
        is_other = np.arange(len(known_corners)) // 4 != tag_index
        solution = _solve(known_corners[is_other], seen_corners[is_other], tags.camera)
        if solution is not None:
            tag_errors_px = _off_by_tag(known_corners, seen_corners, solution, tags.camera)
            candidates.append(
                (float(np.delete(tag_errors_px, tag_index).max()), tag_index, float(tag_errors_px[tag_index]))
            )
    if not candidates:
        return None
    other_error_px, tag_index, error_px = min(candidates)
    return tag_index, error_px, other_error_px


def _solve(known_corners: Floats, seen_corners: Floats, camera: Camera | None) -> Floats | None:
    """Fit the homography (3, 3) from places to pixels, or a camera's pose (6,); None without a solution."""
    if camera is not None:
        return fit_pose(_flat(known_corners), seen_corners, camera)
    homography = fit_homography(known_corners, seen_corners)
    return (
        None
        if homography is None or abs(homography[2, 2]) < 1e-12
        else np.asarray(homography / homography[2, 2])
    )


def _appearing(known_corners: Floats, solution: Floats, camera: Camera | None) -> tuple[Floats, Floats]:
    """Return the pixels of places, and their derivative by the homography or the pose."""
    return (
        _homography_jacobian(solution, known_corners)
        if camera is None
        else projection(_flat(known_corners), solution, camera)
    )


def _off_by_tag(
    known_corners: Floats, seen_corners: Floats, solution: Floats, camera: Camera | None
) -> Floats:
    """Return the mean error of each tag's corners, (K,), pixels."""
    corner_errors_px = np.linalg.norm(_appearing(known_corners, solution, camera)[0] - seen_corners, axis=1)
    return np.asarray(corner_errors_px.reshape(-1, 4).mean(axis=1))


def _flat(places: Floats) -> Floats:
    return np.concatenate([places, np.zeros((len(places), 1))], axis=1)


def _refuse_edge_on(tags: TagsFile, seen_corners: Floats, known_corners: Floats) -> None:
    tag_areas = [np.abs(_areas(corners.reshape(-1, 4, 2))) for corners in (seen_corners, known_corners)]
    longest_edges = np.linalg.norm(np.diff(seen_corners.reshape(-1, 4, 2), axis=1), axis=2).max(axis=1)
    if float(np.median(tag_areas[0] / longest_edges**2)) < _LEAST_SLANT:
        raise UsageError(f"{tags.name}: {_edge_on()}")


def _edge_on() -> str:
    return (
        "the plane is seen edge-on, so that places in it cannot be distinguished; look at it from further"
        " above, and spread the reference tags, not on one line"
    )


def _areas(polygons: Floats) -> Floats:
    x, y = polygons[..., 0], polygons[..., 1]
    area: Floats = 0.5 * (x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)).sum(axis=-1)
    return area
