"""The plane that objects are on: pixels to places in it, and how far a place may be wrong.

Three ways lead there: a homography of reference tags; a calibrated camera whose pose is given or follows
from reference tags; or the image itself. Each keeps the covariance of what it was measured from, so that a
place far from all reference tags is known to be less certain.
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

LEAST_CORNER_ERROR: Final = 0.1
"""Standard deviation of a corner in pixels that is assumed at least, however well reference tags fit."""

USUAL_CORNER_ERROR: Final = 0.3
"""The same where nothing measures it."""

_WORST_RESIDUAL: Final = 3.0
"""Pixels by which a reference tag may be off; more is no noise but a wrong place."""

_LEAST_SLANT: Final = math.sin(math.radians(8.0))
"""A plane that is seen at less than this, the sine of an angle, is seen edge-on; further down, no tags are
found."""

_WIDEST: Final = 1.0
"""Half of the image's diagonal, in focal lengths, of a camera that is not calibrated: 90 degrees from corner
to corner."""

_STEP: Final = 1e-6


class Plane(Protocol):
    """Map from pixels to places."""

    @property
    def corner_error(self) -> float:
        """Standard deviation of a corner in pixels."""

    def places(self, pixels: Floats, z: Floats) -> Floats:
        """Return the places (…, 2) of pixels (…, 2) at heights (…) above the plane."""

    def covariance(self, pixels: Floats, z: Floats) -> Floats:
        """Return the covariance (N, 2, 2) of the places of pixels (N, 2) that comes from the plane itself."""

    def pixels(self, places: Floats) -> Floats:
        """Return where places (N, 3) appear, (N, 2)."""


class Fit(NamedTuple):
    """How reference tags fit.

    Attributes:
        rms: of the distances of their corners, in pixels.
        worst: the tag that is off most, and by how many pixels on average.
    """

    plane: Plane
    rms: float
    worst: tuple[int, float]


@dataclass(frozen=True, slots=True, eq=False)
class ImagePlane:
    """The image itself, y up: the outer corner of its lowest pixel on the left is (0, 0)."""

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
    """A plane seen without a calibrated camera: heights above it cannot be resolved.

    Attributes:
        pixel_from_plane: (3, 3), its last entry 1.
        spread: (8, 8), the covariance of its other entries.
        size: (width, height) of the images in pixels; zeros where it is not known.
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

        A ray at the angle t to the plane's normal gains |z| tan t on its way from the height z to the plane.
        The map from the plane to the image is A B. B, to the sphere around the camera, has the singular
        values (1, cos t) / d at the distance d. A, from the sphere to the image, has f / cos p and f / cos² p
        at the angle p to the optical axis. So cos t is at least cos p times the ratio of those of A B, and d
        at least f divided by the greater one.

        Returns:
            How far places may be off, and by which share lengths may appear too large, (N,) each.
        """
        matrix, places = self.pixel_from_plane, self.places(pixels, z)
        depth = places @ matrix[2, :2] + matrix[2, 2]
        local = (matrix[:2, :2] - pixels[:, :, None] * matrix[2, :2]) / depth[:, None, None]
        greater, lesser = np.linalg.svd(local, compute_uv=False).T
        size = np.array(self.size, np.float64)
        half = float(np.linalg.norm(size)) / 2
        # detections without images: the image reaches at least as far as they do
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
        spread: (6, 6), its covariance.
    """

    camera: Camera
    pose: Floats
    spread: Floats
    corner_error: float

    @property
    def rotation(self) -> Floats:
        """(3, 3), from the plane's frame to the camera's."""
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
        size: (width, height) of the images in pixels; zeros where it is not known.
        corners: (4, 2) of each reference tag that was detected, at least `LEAST_REFERENCES`.

    Raises:
        UsageError: they do not fit, or the plane is seen edge-on.
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
    rms = float(np.sqrt(np.square(off).sum() / max(2 * len(off) - unknowns, 1)))
    by_tag = off.reshape(-1, 4).mean(axis=1)
    place = int(by_tag.argmax())
    worst = references[place].id, float(by_tag[place])
    _refuse_misfit(tags, references, by_tag, seen, known_corners)
    error = tags.corner_error or max(rms, LEAST_CORNER_ERROR)
    flat_derivative = derivative.reshape(-1, unknowns)
    # a place that is wrong by some length moves the tag's corners by that many pixels
    per_pixel = _pixels_per_unit(seen, known_corners)
    variance = error**2 + (tags.reference_error * per_pixel) ** 2
    spread = np.asarray(variance * np.linalg.pinv(flat_derivative.T @ flat_derivative), np.float64)
    plane: Plane
    if tags.camera is None:
        plane = HomographyPlane(solution, spread, error, size)
    else:
        plane = CameraPlane(tags.camera, solution, spread, error)
    _refuse_edge_on(tags, seen, known_corners)
    return Fit(plane, rms, worst)


def given_plane(tags: TagsFile, size: tuple[int, int]) -> Plane | None:
    """Return the plane that a tags file determines alone; None if reference tags have to be seen first.

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
    """Return points (…, 2) moved by a homography."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        moved: Floats = homogeneous[..., :2] / homogeneous[..., 2:]
    return moved


def _cast(directions: Floats, rotation: Floats, shift: Floats, z: Floats) -> Floats:
    """Return where rays (…, 2) from a camera meet the heights (…) above the plane; NaN behind the camera."""
    eye = -rotation.T @ shift
    rays = np.concatenate([directions, np.ones((*directions.shape[:-1], 1))], axis=-1) @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (z - eye[2]) / rays[..., 2]
    places = eye[:2] + np.where(distance > 0, distance, np.nan)[..., None] * rays[..., :2]
    return np.asarray(places)


def _homography_jacobian(matrix: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return where points (N, 2) go, and the derivative (N, 2, 8) by the matrix without its last entry."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    u, v, w = homogeneous.T
    x, y = points.T
    zero, ones = np.zeros_like(x), np.ones_like(x)
    first = np.stack([x, y, ones, zero, zero, zero, -u / w * x, -u / w * y], axis=1) / w[:, None]
    second = np.stack([zero, zero, zero, x, y, ones, -v / w * x, -v / w * y], axis=1) / w[:, None]
    return homogeneous[:, :2] / w[:, None], np.stack([first, second], axis=1)


def _pixels_per_unit(seen: Floats, known: Floats) -> float:
    """Return how many pixels a unit of the plane takes at most, from the edges of tags."""
    edges = [np.diff(corners.reshape(-1, 4, 2), axis=1).reshape(-1, 2) for corners in (seen, known)]
    lengths = [np.linalg.norm(edge, axis=1) for edge in edges]
    return float((lengths[0] / lengths[1]).max())


def _refuse_misfit(
    tags: TagsFile, references: Sequence[MountedTag], off: Floats, seen: Floats, known: Floats
) -> None:
    """Check that no tag is off (K,) by more pixels than noise and `error` explain."""
    limit = _WORST_RESIDUAL + 2 * tags.reference_error * _pixels_per_unit(seen, known)
    if off.max() <= limit:
        return
    first = references[0]
    for turns in (2, 1, 3):
        # the corners of all tags, each counted from another one
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
    """Return the place of the tag without which the others fit best, its offset from where they place it, and
    their greatest offset, in pixels."""
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
    """Return the homography (3, 3), or with a camera its pose (6,), with which places appear at pixels."""
    if camera is not None:
        return fit_pose(_flat(known), seen, camera)
    homography = fit_homography(known, seen)
    return (
        None
        if homography is None or abs(homography[2, 2]) < 1e-12
        else np.asarray(homography / homography[2, 2])
    )


def _appearing(known: Floats, found: Floats, camera: Camera | None) -> tuple[Floats, Floats]:
    """Return where places appear, and the derivative by what was found."""
    return _homography_jacobian(found, known) if camera is None else projection(_flat(known), found, camera)


def _off_by_tag(known: Floats, seen: Floats, found: Floats, camera: Camera | None) -> Floats:
    """Return by how many pixels the corners of each tag are off on average, (K,)."""
    off = np.linalg.norm(_appearing(known, found, camera)[0] - seen, axis=1)
    return np.asarray(off.reshape(-1, 4).mean(axis=1))


def _flat(places: Floats) -> Floats:
    return np.concatenate([places, np.zeros((len(places), 1))], axis=1)


def _refuse_edge_on(tags: TagsFile, seen: Floats, known: Floats) -> None:
    """Check that the tags are not seen as lines."""
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
