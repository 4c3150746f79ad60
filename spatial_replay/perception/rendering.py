"""Images of tags whose places are known: what a camera would see, for tests and simulated runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.camera_pose import rotations
from spatial_replay.perception.frame import Image
from spatial_replay.perception.opencv import Camera, blur, fit_homography, reduce, tag_cells, warp

_BLACK, _WHITE = 30, 220
_OVERSAMPLED: Final = 4
"""Pixels along each edge of a pixel that are averaged, as on a sensor."""

_BEHIND: Final = 3e-3
"""By how much a plate may lie behind a surface that it is glued on, in footprint units."""


class Plate(NamedTuple):
    """A tag in the scene, on a white plate one cell wider.

    Attributes:
        centre: (3,), of its face.
        axes: (2, 3), unit vectors to the tag's right and to its top.
        size: edge of its black square.
    """

    id: int
    centre: Floats
    axes: Floats
    size: float


class Backdrop(NamedTuple):
    """What is behind the plates, and in front of them.

    Attributes:
        image: (height, width) grey, or (height, width, 3).
        depth: (height, width), distances along the camera's axis.
    """

    image: Image
    depth: Floats


@dataclass(frozen=True, slots=True)
class Flaws:
    """What makes an image worse.

    Attributes:
        noise: standard deviation of a pixel's brightness, of 255.
        blur: standard deviation of the lens's blur, in pixels.
    """

    noise: float = 2.0
    blur: float = 0.6


def render(
    family: str,
    instants: Sequence[Sequence[Plate]],
    camera: Camera,
    pose: Floats,
    *,
    flaws: Flaws | None = None,
    seed: Sequence[int] = (0,),
    backdrop: Backdrop | None = None,
) -> Image:
    """Return the image of plates, grey or, with a coloured backdrop, in colour.

    Args:
        instants: the plates at some instants of the exposure; what moves between them is blurred.
        pose: (6,), rotation vector and translation from the scene's frame to the camera's.
        seed: of the noise.
        backdrop: what else is seen; a plate is hidden by what is nearer.
    """
    flaws = flaws or Flaws()
    width, height = camera.size
    base = np.full((height, width), 120, np.uint8) if backdrop is None else backdrop.image
    depth = None if backdrop is None else backdrop.depth
    # most plates stand still, and are drawn once
    moves = [
        any((each.centre != same[0].centre).any() or (each.axes != same[0].axes).any() for each in same)
        for same in zip(*instants, strict=True)
    ]
    still = [plate for plate, is_moved in zip(instants[0], moves, strict=True) if not is_moved]
    image = _exposed(family, still, camera, pose, base, depth)
    if any(moves):
        total = np.zeros(image.shape, np.uint16)
        for plates in instants:
            moving = [plate for plate, is_moved in zip(plates, moves, strict=True) if is_moved]
            total += _exposed(family, moving, camera, pose, image, depth)
        image = ((total + len(instants) // 2) // len(instants)).astype(np.uint8)
    if flaws.blur:
        image = blur(image, flaws.blur)
    if flaws.noise:
        # of the brightness: the same in all colours
        drawn = np.random.default_rng(list(seed)).standard_normal(image.shape[:2], np.float32)
        noise = np.rint(drawn * flaws.noise).astype(np.int16)
        image = np.clip(image + (noise if image.ndim == 2 else noise[..., None]), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(image)


def _exposed(
    family: str, plates: Sequence[Plate], camera: Camera, pose: Floats, base: Image, depth: Floats | None
) -> Image:
    image = base.copy()
    turn = rotations(pose[None, :3])[0]
    # those far away first
    nearness = [float((turn @ plate.centre + pose[3:])[2]) for plate in plates]
    for index in np.argsort(nearness)[::-1].tolist():
        _draw(image, _tile(family, plates[index].id), plates[index], camera, turn, pose[3:], depth)
    return image


def _draw(
    image: Image, tile: Image, plate: Plate, camera: Camera, turn: Floats, shift: Floats, depth: Floats | None
) -> None:
    """Draw one plate into an image, where nothing is in front of it."""
    cells = tile.shape[0]
    # the black square is one cell inside of the tile on each side
    half = plate.size / 2 * cells / (cells - 2)
    right, up = plate.axes * half
    corners = np.stack([plate.centre + i * right + j * up for i, j in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
    seen = corners @ turn.T + shift
    if (seen[:, 2] <= 0).any() or np.dot(np.cross(seen[1] - seen[0], seen[3] - seen[0]), seen[0]) <= 0:
        return
    pixels = camera.pixels(seen)
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, np.array(camera.size))
    if (high <= low).any():
        return
    width, height = (high - low).tolist()
    edge = cells - 0.5
    outer = np.array([(-0.5, -0.5), (edge, -0.5), (edge, edge), (-0.5, edge)])
    matrix = fit_homography(outer, _OVERSAMPLED * (pixels - low + 0.5) - 0.5)
    if matrix is None:
        return
    size = (width * _OVERSAMPLED, height * _OVERSAMPLED)
    drawn = reduce(warp(tile, matrix, size), _OVERSAMPLED).astype(np.float64)
    share = reduce(warp(np.full_like(tile, 255), matrix, size), _OVERSAMPLED) / 255.0
    if depth is not None:
        rows, columns = np.mgrid[low[1] : high[1], low[0] : high[0]]
        rays = camera.directions(np.stack([columns, rows], axis=-1).astype(np.float64))
        normal = np.cross(seen[1] - seen[0], seen[3] - seen[0])
        along = rays @ normal[:2] + normal[2]
        share = share * (
            float(normal @ seen[0]) / along <= depth[low[1] : high[1], low[0] : high[0]] + _BEHIND
        )
        drawn = drawn * (share > 0)
    part = image[low[1] : high[1], low[0] : high[0]]
    if image.ndim == 3:
        drawn, share = drawn[..., None], share[..., None]
    # what is drawn is averaged with black beyond the tile, by the share that the tile has
    part[:] = np.clip(part * (1 - share) + drawn, 0, 255).round().astype(np.uint8)


@cache
def _tile(family: str, number: int) -> Image:
    cells = tag_cells(family, number)
    tile = np.full((cells.shape[0] + 2, cells.shape[1] + 2), _WHITE, np.uint8)
    tile[1:-1, 1:-1] = np.where(cells > 0, _WHITE, _BLACK)
    return tile
