"""Virtual cameras: videos of simulated runs, whose true positions are known, and their tags file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.errors import OutputError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.output_file import refuse_inputs
from spatial_replay.perception.calibration import camera_text
from spatial_replay.perception.opencv import (
    Camera,
    Frame,
    Image,
    blur,
    enlarge,
    fit_homography,
    pose_looking_at,
    reduce,
    rotations,
    tag_cells,
    warp,
)
from spatial_replay.perception.video import VideoWriter
from spatial_replay.simulation.tabletop import SAMPLES_PER_S, Tabletop
from spatial_replay.simulation.world import Body, Box, Pose
from spatial_replay.trace.trace import Sample

# -------------------------------------------------------------------------------------------------- rendering

_BLACK, _WHITE = 30, 220
_OVERSAMPLED: Final = 4
"""Number of averaged samples along each edge of a pixel."""

_BEHIND: Final = 3e-3
"""Tolerance of a plate's depth behind the surface that carries the plate, footprint units."""


class Plate(NamedTuple):
    """A tag in the scene, on a white plate with a margin of one cell.

    Attributes:
        centre: (3,), centre of the face.
        axes: (2, 3), unit vectors to the right and to the top of the tag.
        size: edge length of the black square.
    """

    id: int
    centre: Floats
    axes: Floats
    size: float


class Backdrop(NamedTuple):
    """Image of the scene without plates.

    Attributes:
        image: (height, width) in grey, or (height, width, 3) in colour.
        depth: (height, width), distances along the camera's axis.
    """

    image: Image
    depth: Floats


def render(
    family: str,
    instants: Sequence[Sequence[Plate]],
    camera: Camera,
    pose: Floats,
    *,
    noise: float = 2.0,
    blur_px: float = 0.6,
    seed: Sequence[int] = (0,),
    backdrop: Backdrop | None = None,
) -> Image:
    """Return an image of plates in grey or, with a coloured backdrop, in colour.

    Args:
        instants: the plates at some instants of the exposure; plates that move are blurred.
        pose: (6,), rotation vector and translation from the scene's frame to the camera's frame.
        noise: standard deviation of a pixel's brightness, from 0 to 255.
        blur_px: standard deviation of the lens blur, pixels.
        seed: seed of the noise.
        backdrop: the rest of the scene, whose nearer parts hide plates.
    """
    width, height = camera.size
    background = np.full((height, width), 120, np.uint8) if backdrop is None else backdrop.image
    depth = None if backdrop is None else backdrop.depth
    # plates at rest, which are most plates, are drawn once
    is_plate_moved = [
        any(
            (plate.centre != plates[0].centre).any() or (plate.axes != plates[0].axes).any()
            for plate in plates
        )
        for plates in zip(*instants, strict=True)
    ]
    plates_at_rest = [
        plate for plate, is_moved in zip(instants[0], is_plate_moved, strict=True) if not is_moved
    ]
    image = _expose(family, plates_at_rest, camera, pose, background, depth)
    if any(is_plate_moved):
        image_sum = np.zeros(image.shape, np.uint16)
        for plates in instants:
            moving_plates = [
                plate for plate, is_moved in zip(plates, is_plate_moved, strict=True) if is_moved
            ]
            image_sum += _expose(family, moving_plates, camera, pose, image, depth)
        image = ((image_sum + len(instants) // 2) // len(instants)).astype(np.uint8)
    image = blur(image, blur_px)
    # noise of the brightness, so it is equal in all colour channels
    normal_noise = np.random.default_rng(list(seed)).standard_normal(image.shape[:2], np.float32)
    brightness_noise = np.rint(normal_noise * noise).astype(np.int16)
    image = np.clip(image + (brightness_noise if image.ndim == 2 else brightness_noise[..., None]), 0, 255)
    return np.ascontiguousarray(image.astype(np.uint8))


def _expose(
    family: str,
    plates: Sequence[Plate],
    camera: Camera,
    pose: Floats,
    background: Image,
    depth: Floats | None,
) -> Image:
    image = background.copy()
    rotation = rotations(pose[None, :3])[0]
    # far plates are drawn first, so that near plates cover them
    depths = [float((rotation @ plate.centre + pose[3:])[2]) for plate in plates]
    for plate_index in np.argsort(depths)[::-1].tolist():
        _draw(
            image,
            _tile(family, plates[plate_index].id),
            plates[plate_index],
            camera,
            rotation,
            pose[3:],
            depth,
        )
    return image


def _draw(
    image: Image,
    tile: Image,
    plate: Plate,
    camera: Camera,
    rotation: Floats,
    translation: Floats,
    depth: Floats | None,
) -> None:
    cell_count = tile.shape[0]
    # the tile has a margin of one cell around the black square
    half_edge = plate.size / 2 * cell_count / (cell_count - 2)
    right, up = plate.axes * half_edge
    corners = np.stack([plate.centre + i * right + j * up for i, j in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
    vertices = corners @ rotation.T + translation
    # a plate behind the camera, or seen from its back, is not drawn
    if (vertices[:, 2] <= 0).any() or np.dot(
        np.cross(vertices[1] - vertices[0], vertices[3] - vertices[0]), vertices[0]
    ) <= 0:
        return
    pixels = camera.pixels(vertices)
    low_px = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    high_px = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, np.array(camera.size))
    if (high_px <= low_px).any():
        return
    width, height = (high_px - low_px).tolist()
    # coordinates count from the centre of the first pixel, so the outer corner of this pixel is at -0.5
    tile_edge = cell_count - 0.5
    tile_corners = np.array([(-0.5, -0.5), (tile_edge, -0.5), (tile_edge, tile_edge), (-0.5, tile_edge)])
    matrix = fit_homography(tile_corners, _OVERSAMPLED * (pixels - low_px + 0.5) - 0.5)
    if matrix is None:
        return
    size = (width * _OVERSAMPLED, height * _OVERSAMPLED)
    tile_pixels = reduce(warp(tile, matrix, size), _OVERSAMPLED).astype(np.float64)
    opacity = reduce(warp(np.full_like(tile, 255), matrix, size), _OVERSAMPLED) / 255.0
    if depth is not None:
        pixel_rows, pixel_columns = np.mgrid[low_px[1] : high_px[1], low_px[0] : high_px[0]]
        rays = camera.directions(np.stack([pixel_columns, pixel_rows], axis=-1).astype(np.float64))
        normal = np.cross(vertices[1] - vertices[0], vertices[3] - vertices[0])
        ray_normals = rays @ normal[:2] + normal[2]
        opacity = opacity * (
            float(normal @ vertices[0]) / ray_normals
            <= depth[low_px[1] : high_px[1], low_px[0] : high_px[0]] + _BEHIND
        )
        tile_pixels = tile_pixels * (opacity > 0)
    image_part = image[low_px[1] : high_px[1], low_px[0] : high_px[0]]
    if image.ndim == 3:
        tile_pixels, opacity = tile_pixels[..., None], opacity[..., None]
    # `tile_pixels` is already weighted: outside the tile it was averaged with black
    image_part[:] = np.clip(image_part * (1 - opacity) + tile_pixels, 0, 255).round().astype(np.uint8)


@cache
def _tile(family: str, number: int) -> Image:
    cells = tag_cells(family, number)
    tile = np.full((cells.shape[0] + 2, cells.shape[1] + 2), _WHITE, np.uint8)
    tile[1:-1, 1:-1] = np.where(cells > 0, _WHITE, _BLACK)
    return tile


# ---------------------------------------------------------------------------------------------------- filming

FAMILY: Final = "36h11"
_FIRST_REFERENCE: Final = 100
_EXPOSURE: Final = 0.25
"""Exposure time as a share of the frame interval, centred on a sample's time."""

_FASTEST: Final[Mapping[str, float]] = MappingProxyType({"push": 0.12, "place": 0.5})
"""Speed limit of hidden movable objects for each skill, m/s; slightly above the robot's speed."""

_NUDGED: Final = 0.01
"""Speed limit of hidden objects that the robot only touches, m/s."""

_HOLD: Final = "10s"
"""Hold time of hidden objects; a long time is safe, because a very uncertain object counts as unknown."""


class _Look(NamedTuple):
    """Position of a camera, and the point in the middle of its picture, metres."""

    eye: tuple[float, float, float]
    look_at: tuple[float, float, float]

    @property
    def pose(self) -> Floats:
        """(6,), rotation vector and translation from the scene's frame to the camera's frame."""
        return pose_looking_at(np.array(self.eye), np.array(self.look_at), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class _Views:
    """The cameras of a scenario, which differ only in their poses, and the tags that they see.

    Attributes:
        size: width and height of a picture, pixels.
        coarse: scale from the simulator's picture to the camera's picture, along each edge. A coarse picture
            saves time, because the simulator's rendering takes most of the time.
        focal: focal length, pixels; the principal point is in the middle.
        looks: pose of each camera; a second camera sees objects that the arm hides from the first camera.
        tag: edge length of the tags on objects, metres.
        reference: edge length of the tags on the table, metres.
        places: positions (x, y) of the tags on the table, metres.
    """

    size: tuple[int, int]
    coarse: int
    focal: float
    looks: tuple[_Look, ...]
    tag: float
    reference: float
    places: tuple[tuple[float, float], ...]

    @property
    def camera(self) -> Camera:
        """The camera without its pose."""
        width, height = self.size
        return Camera((self.focal, self.focal), ((width - 1) / 2, (height - 1) / 2), self.size)


_WHOLE_TABLE: Final = _Views(
    (1280, 960),
    4,
    1150.0,
    (_Look((0.9, 0.0, 1.5), (0.27, 0.0, 0.0)),),
    0.05,
    0.08,
    ((0.8, -0.4), (0.8, 0.4), (-0.3, -0.75), (-0.3, 0.75), (0.3, -0.7), (0.3, 0.7)),
)
_PUSHED: Final = _Views(
    (800, 600),
    2,
    850.0,
    (_Look((0.95, 0.0, 0.8), (0.48, 0.0, 0.0)),),
    0.032,
    0.05,
    ((0.28, -0.27), (0.68, -0.25), (0.68, 0.25), (0.28, 0.27), (0.3, 0.18)),
)
_WHOLE_TABLE_TWICE: Final = replace(
    _WHOLE_TABLE, looks=(*_WHOLE_TABLE.looks, _Look((-0.3, -1.05, 1.35), (0.27, 0.0, 0.0)))
)
# one camera cannot measure the height of a lifted object; both cameras see each object after its release
_SET_TWICE: Final = replace(
    _WHOLE_TABLE,
    looks=(_Look((1.51, -0.33, 1.0), (0.27, 0.0, 0.0)), _Look((-0.37, -1.11, 1.0), (0.27, 0.0, 0.0))),
)
# positions from a search with rays from the tags: the arm never hides a block from both cameras
_PUSHED_TWICE: Final = replace(
    _PUSHED,
    size=(1280, 960),
    coarse=4,
    focal=1680.0,
    looks=(_Look((1.15, 0.67, 0.5), (0.48, 0.0, 0.0)), _Look((-0.06, 0.77, 0.5), (0.48, 0.0, 0.0))),
)
_VIEWS: Final[Mapping[str, tuple[_Views, ...]]] = MappingProxyType(
    {
        "push": (_PUSHED, _PUSHED_TWICE),
        "pick-place": (_WHOLE_TABLE, _WHOLE_TABLE_TWICE),
        "table-setting": (_WHOLE_TABLE, _SET_TWICE),
    }
)
"""Cameras of each scenario: one camera, and two cameras."""

MOST_CAMERAS: Final = 2
"""Maximum number of cameras of a run."""


class Film:
    """Cameras above a simulated world, for one run.

    Every object has a tag on its top, and every support has two tags. Further tags lie on the table. The
    pictures have lens blur, motion blur and noise. The arm hides objects from the cameras.
    """

    def __init__(self, world: Tabletop, writers: Sequence[VideoWriter], seed: int) -> None:
        """Begin before the first sample.

        Args:
            writers: writers of one or two videos.
            seed: seed of the noise.
        """
        self._world, self._writers, self._seed = world, writers, seed
        self._views = _VIEWS[world.name][len(writers) - 1]
        self._previous_poses: dict[str, Pose] | None = None
        self._frame_count = 0

    def take(self, sample: Sample) -> None:
        """Add a frame of the current state of the world to each video.

        Args:
            sample: sample of the current state.
        """
        for writer, frame in zip(self._writers, self.frames(sample.time_ns), strict=True):
            writer.write(frame)

    def frames(self, time_ns: int) -> Iterator[Frame]:
        """Yield each camera's picture of the current state of the world."""
        scene, views = self._world.scene, self._views
        poses = {name: scene.pose(name) for name in scene.bodies}
        instants = [self._plates(poses, 0.0)]
        if self._previous_poses is not None:
            instants = [self._plates(poses, share) for share in (-_EXPOSURE / 2, 0.0, _EXPOSURE / 2)]
        self._previous_poses = poses
        self._frame_count += 1
        size = (views.size[0] // views.coarse, views.size[1] // views.coarse)
        for camera_index, look in enumerate(views.looks):
            colours, depth = scene.engine.picture(size, views.focal / views.coarse, look.eye, look.look_at)
            # inverse depth can be interpolated: on a plane it is linear in the pixel coordinates
            inverse_depth = 1 / depth
            # the simulator gives the depths at the lower edges of pixels
            inverse_depth[1:] = (inverse_depth[1:] + inverse_depth[:-1]) / 2
            image = render(
                FAMILY,
                instants,
                views.camera,
                look.pose,
                # the first camera's noise does not depend on the number of cameras
                seed=(self._seed, self._frame_count, *([camera_index] if camera_index else [])),
                # OpenCV orders colours as blue, green, red
                backdrop=Backdrop(
                    enlarge(colours[..., ::-1], views.coarse), 1 / enlarge(inverse_depth, views.coarse)
                ),
            )
            yield Frame(time_ns, image)

    def _plates(self, poses: Mapping[str, Pose], interval_share: float) -> list[Plate]:
        """Return all tags, displaced by a share of their motion since the previous frame."""
        plates = [
            Plate(_FIRST_REFERENCE + index, np.array([x, y, 0.0]), np.eye(3)[:2], self._views.reference)
            for index, (x, y) in enumerate(self._views.places)
        ]
        for first_tag, body in _bodies_with_tags(self._world):
            pose = poses[body.name]
            displacement = np.zeros(3)
            if self._previous_poses is not None:
                displacement = interval_share * (pose.position - self._previous_poses[body.name].position)
            for index, (x, y) in enumerate(_spots(body)):
                centre = (
                    pose.rotation @ np.array([x, y, body.shape.height / 2]) + pose.position + displacement
                )
                plates.append(Plate(first_tag + index, centre, pose.rotation.T[:2], self._views.tag))
        return plates


def tags_of_film(videos: Sequence[Path]) -> Path:
    """Return the path of a film's tags file."""
    return videos[0].with_suffix(".tags.yaml")


def tags_text(world: Tabletop, cameras: int = 1) -> str:
    """Return the tags file of a world at rest, for one or two cameras."""
    view = _VIEWS[world.name][cameras - 1]
    lines = [f"family: {FAMILY}", f"size: {view.tag:g}", "objects:"]
    for first_tag, body in _bodies_with_tags(world):
        shape = body.shape
        # adding 0.0 turns -0.0 into 0.0, which has no sign in the text
        bottom, top = (round(height, 4) + 0.0 for height in world.scene.height(body.name))
        outline = (
            f"box: [{shape.length:g}, {shape.width:g}]"
            if isinstance(shape, Box)
            else f"disc: {shape.radius:g}"
        )
        tags = [
            f"{{id: {first_tag + index}, at: [{x:g}, {y:g}], z: {top:g}}}"
            for index, (x, y) in enumerate(_spots(body))
        ]
        entries = [f"class: {body.class_name}", outline, f"tags: [{', '.join(tags)}]"]
        if not body.support:
            entries.append(f"height: [{bottom:g}, {top:g}]")
        if world.skill == "place" and body.movable:
            entries.append("lifted: true")
        entries.append(f"fastest: {_FASTEST[world.skill] if body.movable else _NUDGED:g}")
        lines.append(f"  {body.name}: {{{', '.join(entries)}}}")
    lines += ["plane:", f"  size: {view.reference:g}", "  tags:"]
    lines += [f"    {_FIRST_REFERENCE + index}: [{x:g}, {y:g}]" for index, (x, y) in enumerate(view.places)]
    lines.append(f"hold: {_HOLD}")
    return "\n".join(lines) + "\n" + camera_text(view.camera)


def _bodies_with_tags(world: Tabletop) -> list[tuple[int, Body]]:
    """Return the bodies, each with the number of its first tag; a body has up to two tags."""
    return [(2 * index, body) for index, body in enumerate(world.bodies)]


def _spots(body: Body) -> list[tuple[float, float]]:
    """Return the positions of tags on a body: in the middle, or near the edges of a support."""
    if not body.support:
        return [(0.0, 0.0)]
    if isinstance(body.shape, Box):
        x, y = body.shape.length / 2 - 0.03, body.shape.width / 2 - 0.03
        return [(x, y), (-x, -y)]
    edge_distance = body.shape.radius - 0.03
    return [(edge_distance, 0.0), (-edge_distance, 0.0)]


@contextmanager
def open_film(world: Tabletop, videos: Sequence[Path], *, seed: int) -> Iterator[Film | None]:
    """Open one or two videos of a world, and write the tags file next to the first video.

    Yields None without videos.

    Raises:
        UsageError: the extra `vision` is not installed, there are more than two cameras, two videos have the
            same name, or a name has no suffix of a video.
        OutputError: a file cannot be written.
    """
    if not videos:
        yield None
        return
    if len(videos) > MOST_CAMERAS:
        raise UsageError(f"{len(videos)} cameras: a run is filmed by one or two; leave out the others")
    for video in videos:
        if video.suffix.lower() not in (".mp4", ".mkv", ".mov", ".ts"):
            raise UsageError(f"{video}: a film is a video; name it {video.stem}.mp4")
    if len({video.resolve() for video in videos}) < len(videos):
        raise UsageError(f"{videos[0]} is the film of two cameras; give each a name of its own")
    tags_path = tags_of_film(videos)
    with ExitStack() as stack:
        try:
            for video in videos:
                refuse_inputs(video, ())
            writers = [stack.enter_context(VideoWriter(video, SAMPLES_PER_S)) for video in videos]
            tags_path.write_text(tags_text(world, len(videos)), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{tags_path}: {(error.strerror or str(error)).lower()}") from None
        yield Film(world, writers, seed)
