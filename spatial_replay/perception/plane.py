"""The plane of the objects: conversion of pixels to places, and the uncertainty of places.

A plane is a homography from reference tags, the view of a calibrated camera, or the image itself. The pose of
the camera is given or from reference tags. A plane from reference tags has a covariance, so that a place far
from all of them is less certain.
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

# with 0.1, 99.5 % of the outlines in 538 frames of a planned run held the truth; a larger value makes
# lifted objects too uncertain to judge
LEAST_CORNER_ERROR: Final = 0.1
"""Least standard deviation of a corner, pixels, however well reference tags fit."""

USUAL_CORNER_ERROR: Final = 0.3
"""Standard deviation of a corner if reference tags do not measure it, pixels."""

_WORST_RESIDUAL: Final = 3.0
"""Largest error of a reference tag from noise, pixels; a larger error is a wrong place."""

_LEAST_SLANT: Final = math.sin(math.radians(8.0))
"""Sine of the angle to the plane below which it is seen edge-on; at lower angles, no tags are found."""

_WIDEST: Final = 1.0
"""Half of the image's diagonal of an uncalibrated camera, focal lengths: 90 degrees between corners."""

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
        rms: root mean square error of their corners, pixels.
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
        spread: (8, 8), covariance of the other entries.
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
        moved = np.repeat(np.append(entries, 1.0)[None], 16, axis=0)
        moved[np.arange(8), np.arange(8)] += steps
        moved[np.arange(8, 16), np.arange(8)] -= steps
        inverse = np.linalg.inv(moved.reshape(16, 3, 3))
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        homogeneous_places = np.einsum("kij,nj->kni", inverse, homogeneous)
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
        the ratio of the singular values of A B, and d is at least f divided by the greater one.

        Returns:
            Largest errors of places, and largest relative errors of lengths, (N,) each.
        """
        matrix, places = self.pixel_from_plane, self.places(pixels, z)
        depth = places @ matrix[2, :2] + matrix[2, 2]
        local = (matrix[:2, :2] - pixels[:, :, None] * matrix[2, :2]) / depth[:, None, None]
        greater, lesser = np.linalg.svd(local, compute_uv=False).T
        size = np.array(self.size, np.float64)
        half = float(np.linalg.norm(size)) / 2
        # without images, the image is assumed to reach as far as the detections
        focal = (half or float(np.linalg.norm(pixels, axis=1).max()) / 2) / _WIDEST
        off_axis = np.linalg.norm(pixels - (size - 1) / 2, axis=1) / focal if half else _WIDEST
        cosine = lesser / greater / np.sqrt(1 + np.square(off_axis))
        above = focal / greater * cosine
        with np.errstate(divide="ignore"):
            larger = np.where(above > np.abs(z), np.abs(z) / (above - np.abs(z)), np.inf)
        return np.abs(z) * np.sqrt(1 / np.square(cosine) - 1), np.asarray(larger)


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
        places = []
        for sign in (1.0, -1.0):
            moved = self.pose + sign * _STEP * np.eye(6)
            turns = rotations(moved[:, :3])
            places.append([_cast(directions, turns[k], moved[k, 3:], z) for k in range(6)])
        derivative = (np.array(places[0]) - np.array(places[1])) / (2 * _STEP)
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
    seen = np.concatenate([corners[tag.id] for tag in references])
    solved = _solve(known_corners, seen, tags.camera)
    if solved is None:
        raise UsageError(f"{tags.name}: {_edge_on()}")
    solution, (fitted, derivative) = solved, _appearing(known_corners, solved, tags.camera)
    off = np.linalg.norm(fitted - seen, axis=1)
    unknowns = derivative.shape[-1]
    # per degree of freedom, so that few tags do not look exact
    rms = float(np.sqrt(np.square(off).sum() / max(2 * len(off) - unknowns, 1)))
    by_tag = off.reshape(-1, 4).mean(axis=1)
    place = int(by_tag.argmax())
    worst = references[place].id, float(by_tag[place])
    _refuse_misfit(tags, references, by_tag, seen, known_corners)
    error = tags.corner_error or max(rms, LEAST_CORNER_ERROR)
    flat_derivative = derivative.reshape(-1, unknowns)
    # an error of a tag's place moves its corners by this many pixels per unit
    per_pixel = _pixels_per_unit(seen, known_corners)
    variance = error**2 + (tags.reference_error * per_pixel) ** 2
    # covariance of a least squares fit: variance (J^T J)^-1
    spread = np.asarray(variance * np.linalg.pinv(flat_derivative.T @ flat_derivative), np.float64)
    plane: Plane
    if tags.camera is None:
        plane = HomographyPlane(solution, spread, error, size)
    else:
        plane = CameraPlane(tags.camera, solution, spread, error)
    _refuse_edge_on(tags, seen, known_corners)
    return Fit(plane, rms, worst)


def given_plane(tags: TagsFile, size: tuple[int, int]) -> Plane | None:
    """Return the plane that a tags file determines without images; None if that takes reference tags.

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
    error = tags.corner_error or USUAL_CORNER_ERROR
    if tags.is_image:
        return ImagePlane(size[1], error)
    if tags.pose is not None and tags.camera is not None:
        return CameraPlane(tags.camera, tags.pose, np.zeros((6, 6)), error)
    return None


def _through(matrix: Floats, points: Floats) -> Floats:
    """Map points (…, 2) by a homography."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        moved: Floats = homogeneous[..., :2] / homogeneous[..., 2:]
    return moved


def _cast(directions: Floats, rotation: Floats, shift: Floats, z: Floats) -> Floats:
    """Return the places of camera rays (…, 2) at heights (…) above the plane; NaN behind the camera."""
    eye = -rotation.T @ shift
    rays = np.concatenate([directions, np.ones((*directions.shape[:-1], 1))], axis=-1) @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (z - eye[2]) / rays[..., 2]
    places = eye[:2] + np.where(distance > 0, distance, np.nan)[..., None] * rays[..., :2]
    return np.asarray(places)


def _homography_jacobian(matrix: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Map points (N, 2); return them and their derivative (N, 2, 8) by the first eight entries."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    u, v, w = homogeneous.T
    x, y = points.T
    zero, ones = np.zeros_like(x), np.ones_like(x)
    first = np.stack([x, y, ones, zero, zero, zero, -u / w * x, -u / w * y], axis=1) / w[:, None]
    second = np.stack([zero, zero, zero, x, y, ones, -v / w * x, -v / w * y], axis=1) / w[:, None]
    return homogeneous[:, :2] / w[:, None], np.stack([first, second], axis=1)


def _pixels_per_unit(seen: Floats, known: Floats) -> float:
    """Return the largest number of pixels per unit of the plane, from the edges of tags."""
    edges = [np.diff(corners.reshape(-1, 4, 2), axis=1).reshape(-1, 2) for corners in (seen, known)]
    lengths = [np.linalg.norm(edge, axis=1) for edge in edges]
    return float((lengths[0] / lengths[1]).max())


def _refuse_misfit(
    tags: TagsFile, references: Sequence[MountedTag], off: Floats, seen: Floats, known: Floats
) -> None:
    """Check that no tag's error in `off` (K,), pixels, exceeds noise and the stated error of places."""
    limit = _WORST_RESIDUAL + 2 * tags.reference_error * _pixels_per_unit(seen, known)
    if off.max() <= limit:
        return
    first = references[0]
    # half a turn first, because OpenCV prints AprilTags upside down
    for turns in (2, 1, 3):
        # the corners of all tags in a turned order
        turned = np.roll(known.reshape(-1, 4, 2), -turns, axis=1).reshape(-1, 2)
        solved = _solve(turned, seen, tags.camera)
        if solved is not None and _off_by_tag(turned, seen, solved, tags.camera).max() <= limit:
            raise UsageError(
                f"{tags.name}: the reference tags fit each other only if all are turned by {90 * turns}"
                f" degrees, as other programs print them; write {first.id}: {{at: [{first.x:g}, {first.y:g}],"
                f" yaw: {90 * turns}deg}}, the others alike, and the same yaw for tags on objects"
            )
    alone = _off_alone(tags, seen, known)
    if alone is not None and alone[2] <= limit:
        place, away, _ = alone
        raise UsageError(
            f"{tags.name}: the reference tags do not fit each other: tag {references[place].id} is off by"
            f" {away:.1f} pixels from where the others place it; check its place, its yaw and its size"
        )
    worst = references[int(off.argmax())].id
    raise UsageError(
        f"{tags.name}: the reference tags do not fit each other: tag {worst} is off most, by"
        f" {off.max():.1f} pixels; check the places, the yaw and the size of the tags, or"
        " calibrate the camera if its lens bends straight lines (tags calibrate)"
    )


def _off_alone(tags: TagsFile, seen: Floats, known: Floats) -> tuple[int, float, float] | None:
    """Find the tag without which the other tags fit best; None if no fit exists.

    Returns:
        its index, its error in the fit of the others, and the largest error of the others, pixels.
    """
    candidates: list[tuple[float, int, float]] = []
    for place in range(len(known) // 4):
        others = np.arange(len(known)) // 4 != place
        solved = _solve(known[others], seen[others], tags.camera)
        if solved is not None:
            by_tag = _off_by_tag(known, seen, solved, tags.camera)
            candidates.append((float(np.delete(by_tag, place).max()), place, float(by_tag[place])))
    if not candidates:
        return None
    most, place, away = min(candidates)
    return place, away, most


def _solve(known: Floats, seen: Floats, camera: Camera | None) -> Floats | None:
    """Fit the homography (3, 3), or a camera's pose (6,), from places to pixels; None if there is none."""
    if camera is not None:
        return fit_pose(_flat(known), seen, camera)
    homography = fit_homography(known, seen)
    return (
        None
        if homography is None or abs(homography[2, 2]) < 1e-12
        else np.asarray(homography / homography[2, 2])
    )


def _appearing(known: Floats, found: Floats, camera: Camera | None) -> tuple[Floats, Floats]:
    """Return the pixels of places, and their derivative by the homography or the pose."""
    return _homography_jacobian(found, known) if camera is None else projection(_flat(known), found, camera)


def _off_by_tag(known: Floats, seen: Floats, found: Floats, camera: Camera | None) -> Floats:
    """Return the mean error of each tag's corners, (K,), pixels."""
    off = np.linalg.norm(_appearing(known, found, camera)[0] - seen, axis=1)
    return np.asarray(off.reshape(-1, 4).mean(axis=1))


def _flat(places: Floats) -> Floats:
    return np.concatenate([places, np.zeros((len(places), 1))], axis=1)


def _refuse_edge_on(tags: TagsFile, seen: Floats, known: Floats) -> None:
    """Check that tags are not seen edge-on."""
    areas = [np.abs(_areas(corners.reshape(-1, 4, 2))) for corners in (seen, known)]
    longest = np.linalg.norm(np.diff(seen.reshape(-1, 4, 2), axis=1), axis=2).max(axis=1)
    if float(np.median(areas[0] / longest**2)) < _LEAST_SLANT:
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
