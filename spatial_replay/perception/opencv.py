"""Frames, detection of tags, camera poses and geometry; only this module imports OpenCV.

Pixel coordinates are as in OpenCV: the centre of the first pixel of an image is (0, 0), y points down.
In other AprilTag detectors, (0, 0) is the outer corner of that pixel, so coordinates are half a pixel larger.
`corners_from_apriltag` converts the corners of other detectors.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import LogError, UsageError, importing
from spatial_replay.geometry.arrays import Floats

Image = NDArray[np.uint8]
"""(height, width) grey or (height, width, 3) blue, green, red."""

LARGEST_PICTURE: Final = 64_000_000
"""Maximum number of pixels of one image; no camera has more, but a damaged header may claim more."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of the segments of a JPEG that hold its size."""


NO_IMAGE: Final[Image] = np.zeros((0, 0), np.uint8)
"""Image of a frame whose log stores only the tags."""
NO_IMAGE.setflags(write=False)


class Detection(NamedTuple):
    """A tag in an image.

    Attributes:
        id: number in its family.
        corners: (4, 2), corners of the black square, pixels: bottom left, bottom right, top right, top left
            of an upright tag.
        family: name of the family in tags files; "" for the family of the file.
    """

    id: int
    corners: Floats
    family: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a camera.

    Attributes:
        time_ns: stamp of the image, on the clock of the samples.
        image: (height, width) grey, or (height, width, 3) blue, green, red.
        data: H.264 in Annex B form from a video, or the message from a topic; b"" if neither can be copied.
        detections: tags that a robot detected, without their image; None to detect tags in `image`.

    Raises:
        UsageError: the image has another shape or type, or is empty.
    """

    time_ns: int
    image: Image
    data: bytes = field(default=b"", repr=False)
    detections: tuple[Detection, ...] | None = None

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if image.dtype != np.uint8 or not is_shaped or (self.detections is None and not image.size):
            raise UsageError(
                f"the image of a frame at {self.time_ns / 1e9:.3f} s is {image.dtype} {image.shape}; give"
                " uint8, (height, width) grey or (height, width, 3) blue, green, red"
            )


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in the header of a JPEG, PNG or WebP image; None for other data.

    The image is not decoded, so a too large image can be refused before it takes memory.
    """
    try:
        if data.startswith(_PNG):
            # the first chunk is IHDR: https://www.w3.org/TR/png/#11IHDR
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
    except (struct.error, IndexError):
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    offset = 2
    while data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:
            # fill bytes before a marker
            offset += 1
            continue
        if marker in _JPEG_FRAMES:
            # after marker, length and precision: https://www.w3.org/Graphics/JPEG/itu-t81.pdf, B.2.2
            height, width = struct.unpack_from(">HH", data, offset + 5)
            return width, height
        offset += 2 + int(struct.unpack_from(">H", data, offset + 2)[0])
    return None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    # https://developers.google.com/speed/webp/docs/riff_container
    chunk_type = data[12:16]
    if chunk_type == b"VP8X":
        width, height = (int.from_bytes(data[offset : offset + 3], "little") + 1 for offset in (24, 27))
        return width, height
    if chunk_type == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if chunk_type == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


# ----------------------------------------------------------------------------------------------- camera poses


def pose_looking_at(eye: Floats, target: Floats, up: Floats) -> Floats:
    """Return the pose (6,), rotation vector and translation from the plane's frame to a camera's.

    Args:
        eye, target: (3,), place of the camera, and a point in the middle of its image.
        up: (3,), direction that points up in the image.

    Raises:
        UsageError: the camera is at the target, or `up` is parallel to its view.
    """
    forward = target - eye
    right = np.cross(forward, up)
    if not np.linalg.norm(forward) > 0 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise UsageError(
            "the camera's pose is not determined: give another look_at than its position, and an up that is"
            " not where it looks, such as up: [0, 1, 0] for a camera that looks straight down"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation_vector, _ = _load().Rodrigues(rotation)
    return np.concatenate([np.asarray(rotation_vector, np.float64).ravel(), -rotation @ eye])


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3)."""
    angles = np.linalg.norm(vectors, axis=1)
    nonzero_angles = np.where(angles > 1e-12, angles, 1.0)
    x, y, z = (vectors / nonzero_angles[:, None]).T
    zeros = np.zeros_like(x)
    cross_matrices = np.stack([zeros, -z, y, z, zeros, -x, -y, x, zeros], axis=1).reshape(-1, 3, 3)
    sine, versine = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    matrices: Floats = np.eye(3) + sine * cross_matrices + versine * (cross_matrices @ cross_matrices)
    return matrices


# --------------------------------------------------------------------------- corners to a fraction of a pixel

_ALONG: Final = 24
"""Number of places along an edge at which the brightness step is located."""

_MARGIN: Final = 0.1
"""Fraction of an edge that is skipped at each end, next to the other edges."""

_APART: Final = 0.25
"""Distance of two samples across an edge, pixels."""

_CELLS: Final = 0.6
"""Search range across an edge, cells of the tag; other edges are further away."""

_WIDEST: Final = 3.0
"""Largest search range across an edge, pixels."""

_SECOND: Final = 0.5
"""Fraction of the search range in the second pass, which starts near the edge."""


def refined_corners(grey: Image, corners: Floats, cells: int) -> Floats:
    """Refine corners of tags. A tag whose edges are not found keeps its corners.

    Args:
        corners: (N, 4, 2), in pixels, in the order of a `Detection`, at most two pixels off.
        cells: number of cells along the edge of the black square.
    """
    if not len(corners):
        return corners
    for share in (1.0, _SECOND):
        corners = _refine(grey, corners, cells, share)
    return corners


def _refine(grey: Image, corners: Floats, cells: int, range_share: float) -> Floats:
    edge_vectors = np.roll(corners, -1, axis=1) - corners
    edge_lengths = np.linalg.norm(edge_vectors, axis=2)
    edge_directions = edge_vectors / edge_lengths[..., None]
    # y points down in images, so the normals point out of a tag with our order of corners
    outward_normals = np.stack([-edge_directions[..., 1], edge_directions[..., 0]], axis=-1)
    search_ranges = np.minimum(_CELLS * edge_lengths.min(axis=1) / cells, _WIDEST) * range_share
    edge_shares = np.linspace(_MARGIN, 1 - _MARGIN, _ALONG)
    edge_points = corners[:, :, None] + edge_shares[:, None] * edge_vectors[:, :, None]
    offsets = np.arange(-round(_WIDEST / _APART), round(_WIDEST / _APART) + 1) * _APART
    # the range has one pixel more on each side, because steps are differences
    wide_offsets = np.arange(offsets[0] - 1.0, offsets[-1] + 1.0 + _APART / 2, _APART)
    sample_points = edge_points[..., None, :] + wide_offsets[:, None] * outward_normals[:, :, None, None]
    brightness = _bilinear(grey, sample_points)
    window_size = round(2.0 / _APART)
    brightness_rise = brightness[..., window_size:] - brightness[..., :-window_size]
    step_weights = np.where(
        np.abs(offsets) <= search_ranges[:, None, None, None],
        np.square(np.maximum(brightness_rise, 0.0)),
        0.0,
    )
    total_weights = step_weights.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        step_offsets = (step_weights * offsets).sum(axis=-1) / total_weights
    total_weights = np.where(np.isfinite(step_offsets), total_weights, 0.0)
    # fit a line to the steps of each edge, offset = a + b * share; faint steps have little weight
    line_weights = np.minimum(total_weights, np.median(total_weights, axis=-1, keepdims=True))
    weight_moments = [(line_weights * edge_shares**power).sum(axis=-1) for power in range(3)]
    step_offsets = np.nan_to_num(step_offsets)
    offset_moments = [(line_weights * step_offsets * edge_shares**power).sum(axis=-1) for power in range(2)]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (weight_moments[0] * offset_moments[1] - weight_moments[1] * offset_moments[0]) / (
            weight_moments[0] * weight_moments[2] - weight_moments[1] ** 2
        )
        intercepts = (offset_moments[0] - slopes * weight_moments[1]) / weight_moments[0]
    line_starts = corners + intercepts[..., None] * outward_normals
    line_directions = edge_vectors + slopes[..., None] * outward_normals
    intersections = _meeting(
        np.roll(line_starts, 1, axis=1), np.roll(line_directions, 1, axis=1), line_starts, line_directions
    )
    is_accepted = np.isfinite(intersections).all(axis=(1, 2)) & (
        np.linalg.norm(intersections - corners, axis=2).max(axis=1) <= 2 * search_ranges + 1.0
    )
    return np.where(is_accepted[:, None, None], intersections, corners)


def _bilinear(grey: Image, points: Floats) -> Floats:
    """Interpolate an image between its pixels. Points beyond the border have the value at the border."""
    height, width = grey.shape
    # points are clipped to less than the last pixel, so that each pixel has a next pixel
    x = np.clip(points[..., 0], 0, width - 1.001)
    y = np.clip(points[..., 1], 0, height - 1.001)
    columns, rows = x.astype(np.int64), y.astype(np.int64)
    x_share, y_share = x - columns, y - rows
    flat_grey, flat_indices = grey.ravel(), rows * width + columns
    upper_values = (1 - x_share) * flat_grey[flat_indices] + x_share * flat_grey[flat_indices + 1]
    lower_values = (1 - x_share) * flat_grey[flat_indices + width] + x_share * flat_grey[
        flat_indices + width + 1
    ]
    values: Floats = (1 - y_share) * upper_values + y_share * lower_values
    return values


def _meeting(
    first_points: Floats, first_directions: Floats, second_points: Floats, second_directions: Floats
) -> Floats:
    """Return the intersections (…, 2) of lines, each given by a point and a direction."""
    cross_products = (
        first_directions[..., 0] * second_directions[..., 1]
        - first_directions[..., 1] * second_directions[..., 0]
    )
    point_offsets = second_points - first_points
    with np.errstate(divide="ignore", invalid="ignore"):
        first_shares = (
            point_offsets[..., 0] * second_directions[..., 1]
            - point_offsets[..., 1] * second_directions[..., 0]
        ) / cross_products
    intersections: Floats = first_points + first_shares[..., None] * first_directions
    return intersections


# ----------------------------------------------------------------------------------------------------- OpenCV

_Number = TypeVar("_Number", np.uint8, np.float64)

FAMILIES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "16h5": "DICT_APRILTAG_16h5",
        "25h9": "DICT_APRILTAG_25h9",
        "36h10": "DICT_APRILTAG_36h10",
        "36h11": "DICT_APRILTAG_36h11",
    }
)
"""AprilTag families and their names in OpenCV."""

FAMILY_SIZES: Final[Mapping[str, int]] = MappingProxyType(
    {"16h5": 30, "25h9": 35, "36h10": 2320, "36h11": 587}
)
"""Number of tags in each family."""

_OURS_FROM_OPENCV: Final = [1, 0, 3, 2]
"""Order of corners: OpenCV has AprilTags upside down, with corners clockwise from the top left."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Camera model: a pinhole with lens distortion, as OpenCV calibrates it.

    Attributes:
        focal: (fx, fy) in pixels.
        centre: (cx, cy), the principal point in pixels.
        distortion: k1, k2, p1, p2, k3, …; () for a pinhole.
        size: (width, height) of its images in pixels.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int]
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Floats:
        """The matrix K (3, 3)."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def directions(self, pixels: Floats) -> Floats:
        """Return the undistorted places of pixels (…, 2) on the plane at distance 1 from the camera."""
        if not self.distortion:
            return np.asarray((pixels - np.array(self.centre)) / np.array(self.focal), np.float64)
        flat_pixels = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        undistorted = _load().undistortPoints(flat_pixels, self.matrix, np.array(self.distortion))
        return np.asarray(undistorted, np.float64).reshape(pixels.shape)

    def pixels(self, points: Floats) -> Floats:
        """Return the pixels (N, 2) of points (N, 3) in the camera's frame."""
        zeros = np.zeros(3)
        flat_points = np.ascontiguousarray(points, np.float64)
        projected, _ = _load().projectPoints(
            flat_points, zeros, zeros, self.matrix, np.array(self.distortion)
        )
        return np.asarray(projected, np.float64).reshape(-1, 2)


class TagDetector:
    """Finds the tags of one family in images, in one thread; equal images give equal corners."""

    def __init__(self, family: str) -> None:
        """Prepare the dictionary of the family.

        Raises:
            UsageError: there is no such family, or OpenCV is not installed.
        """
        cv2 = _load()
        parameters = cv2.aruco.DetectorParameters()
        # OpenCV's own refinement is half a pixel off on small tags; see `refined_corners`
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        # at most two bits of a 36h11 tag are corrected (default three): a wrong tag is worse than a hidden
        # tag
        parameters.errorCorrectionRate = 0.4
        dictionary = _dictionary(family)
        self._cells = dictionary.markerSize + 2
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(self, image: Image) -> list[Detection]:
        """Return the tags in a grey or coloured image, sorted by id, then from left to right."""
        grey = image if image.ndim == 2 else _load().cvtColor(image, _load().COLOR_BGR2GRAY)
        grey = np.ascontiguousarray(grey)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return []
        ordered_corners = np.array(corners, np.float64).reshape(-1, 4, 2)[:, _OURS_FROM_OPENCV]
        corners_by_tag = refined_corners(grey, ordered_corners, self._cells)
        detections = [
            Detection(int(tag_id), tag_corners)
            for tag_id, tag_corners in zip(np.ravel(ids), corners_by_tag, strict=True)
        ]
        return sorted(detections, key=lambda tag: (tag.id, *tag.corners[0].tolist()))


def corners_from_apriltag(corners: Floats) -> Floats:
    """Convert corners (…, 2) of pupil-apriltags, pyapriltags or apriltag_ros to our pixels."""
    return corners - 0.5


def tag_cells(family: str, number: int) -> Image:
    """Return an image of an upright tag with its black border, 0 or 255, one pixel per cell.

    Raises:
        UsageError: there is no such family, or it has no such tag.
    """
    dictionary = _dictionary(family)
    tag_count = FAMILY_SIZES[family]
    if not 0 <= number < tag_count:
        raise UsageError(f"family {family} has no tag {number}; its tags are 0 to {tag_count - 1}")
    cell_count = dictionary.markerSize + 2
    picture = _load().aruco.generateImageMarker(dictionary, number, cell_count, borderBits=1)
    return np.ascontiguousarray(np.asarray(picture, np.uint8)[::-1, ::-1])


def fit_homography(source: Floats, target: Floats) -> Floats | None:
    """Fit the homography (3, 3) between points (N, 2) by least squares; None if there is none."""
    # 0: least squares over all points; `plane` refuses outliers
    matrix, _ = _load().findHomography(np.asarray(source), np.asarray(target), 0)
    return None if matrix is None or not np.isfinite(matrix).all() else np.asarray(matrix, np.float64)


def fit_pose(points: Floats, pixels: Floats, camera: Camera) -> Floats | None:
    """Fit the pose (6,) of a camera to points (N, 3) at pixels (N, 2); None if there is none.

    A pose is the rotation vector and the translation to the camera's frame.
    """
    cv2 = _load()
    matrix, distortion = camera.matrix, np.array(camera.distortion)
    is_solved, rotation_vector, translation = cv2.solvePnP(
        np.ascontiguousarray(points), np.ascontiguousarray(pixels), matrix, distortion
    )
    if not is_solved:
        return None
    rotation_vector, translation = cv2.solvePnPRefineLM(
        points, np.ascontiguousarray(pixels), matrix, distortion, rotation_vector, translation
    )
    pose = np.concatenate([rotation_vector.ravel(), translation.ravel()]).astype(np.float64)
    return pose if np.isfinite(pose).all() else None


def projection(points: Floats, pose: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return the pixels (N, 2) of points (N, 3), and their derivative (N, 2, 6) by a pose of `fit_pose`."""
    pixels, jacobian = _load().projectPoints(
        np.ascontiguousarray(points), pose[:3], pose[3:], camera.matrix, np.array(camera.distortion)
    )
    derivative = np.asarray(jacobian, np.float64)[:, :6].reshape(-1, 2, 6)
    return np.asarray(pixels, np.float64).reshape(-1, 2), derivative


class Calibration(NamedTuple):
    """A calibrated camera.

    Attributes:
        rms: root mean square error of reprojected points, pixels.
        deviations: standard deviations of fx, fy, cx, cy, pixels.
    """

    camera: Camera
    rms: float
    deviations: tuple[float, float, float, float]


def calibrate(points: list[Floats], pixels: list[Floats], size: tuple[int, int]) -> Calibration:
    """Calibrate a camera from views of known points (N, 3) at pixels (N, 2).

    Args:
        size: (width, height) of the images.
    """
    cv2 = _load()
    # k3 stays 0, because tags on a sheet seldom determine it
    rms, matrix, distortion, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        # OpenCV calibrates from float32 only
        [np.asarray(view, np.float32) for view in points],
        [np.asarray(view, np.float32).reshape(-1, 1, 2) for view in pixels],
        size,
        None,
        None,
        flags=cv2.CALIB_FIX_K3,
    )
    coefficients = tuple(round(float(coefficient), 8) for coefficient in np.ravel(distortion)[:4])
    camera = Camera(
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        size,
        coefficients,
    )
    fx, fy, cx, cy = np.ravel(deviations)[:4].tolist()
    return Calibration(camera, float(rms), (fx, fy, cx, cy))


# -------------------------------------------------------------------------------------------------- images


def convert(pixels: Image, conversion: str) -> Image:
    """Return pixels (height, width, bytes) as blue, green, red, by a conversion of OpenCV.

    Raises:
        LogError: the image is too small for the conversion, or has an odd width.
    """
    cv2 = _load()
    try:
        return np.asarray(
            cv2.cvtColor(np.ascontiguousarray(pixels), getattr(cv2, f"COLOR_{conversion}")), np.uint8
        )
    except cv2.error:
        height, width = pixels.shape[:2]
        raise LogError(f"an image of {width} x {height} cannot be converted ({conversion})") from None


def decode_image(data: bytes) -> Image:
    """Decode a JPEG, PNG or WebP image to blue, green, red.

    Raises:
        LogError: the image is damaged, of another format, or larger than `LARGEST_PICTURE`.
    """
    cv2 = _load()
    size = encoded_size(data)
    if size is None:
        raise LogError("an image is damaged, or neither JPEG nor PNG nor WebP")
    # the size is checked before decoding, because a few bytes may claim gigabytes
    if size[0] * size[1] > LARGEST_PICTURE:
        raise LogError(f"an image of {size[0]} x {size[1]} is too large")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise LogError("an image is damaged, or neither JPEG nor PNG nor WebP")
    return np.asarray(image, np.uint8)


def encode_jpeg(image: Image, width: int, quality: int = 70) -> bytes:
    """Return an image as JPEG, at most `width` pixels wide."""
    cv2 = _load()
    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)


def warp(image: Image, matrix: Floats, size: tuple[int, int]) -> Image:
    """Warp an image by a homography (3, 3) to a size (width, height); pixels without a source are 0."""
    cv2 = _load()
    return np.asarray(cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_NEAREST), np.uint8)


def reduce(image: Image, factor: int) -> Image:
    """Return an image with `factor` x `factor` pixels averaged into one."""
    cv2 = _load()
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def enlarge(picture: NDArray[_Number], factor: int) -> NDArray[_Number]:
    """Return a picture with `factor` times as many pixels along each edge, interpolated."""
    cv2 = _load()
    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_LINEAR))


def blur(image: Image, sigma: float) -> Image:
    """Blur an image by a Gaussian with `sigma` in pixels."""
    return np.asarray(_load().GaussianBlur(image, (0, 0), sigma), np.uint8)


def open_camera(number: int) -> Any:
    """Open a camera of this machine.

    Raises:
        UsageError: there is no such camera.
    """
    cv2 = _load()
    # OpenCV's warnings are muted, because the error below reports the failure
    opencv_log = cv2.utils.logging
    level = opencv_log.setLogLevel(opencv_log.LOG_LEVEL_ERROR)
    try:
        capture = cv2.VideoCapture(number)
    finally:
        opencv_log.setLogLevel(level)
    if not capture.isOpened():
        raise UsageError(
            f"camera {number} cannot be opened; check that it is plugged in (/dev/video{number}) and that no"
            " other program uses it"
        )
    return capture


@cache
def _dictionary(family: str) -> Any:
    cv2 = _load()
    if family not in FAMILIES:
        raise UsageError(f"there is no tag family {family!r}; known are {', '.join(FAMILIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))


@cache
def _load() -> Any:
    """Import OpenCV.

    Raises:
        UsageError: OpenCV is not installed.
    """
    with importing("cameras need OpenCV", extra="vision"):
        import cv2
    # one thread: results do not depend on the machine, and the caller's threads keep their cores
    cv2.setNumThreads(1)
    return cv2
