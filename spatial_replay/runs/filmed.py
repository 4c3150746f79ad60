"""Simulated worlds through a camera: a video of a run whose truth is known, and its tags file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import OutputError, UsageError
from spatial_replay.logs.output_file import refuse_inputs
from spatial_replay.perception.frame import Frame
from spatial_replay.perception.opencv import Camera
from spatial_replay.perception.rendering import Backdrop, Flaws, Plate, render
from spatial_replay.perception.tags_file import camera_text, pose_looking_at
from spatial_replay.perception.video import VideoWriter
from spatial_replay.simulation.shapes import Box, Pose
from spatial_replay.simulation.tabletop import SAMPLES_PER_S, Tabletop
from spatial_replay.simulation.world import Body
from spatial_replay.trace.sample import Sample

_Number = TypeVar("_Number", np.uint8, np.float64)

FAMILY: Final = "36h11"
_FIRST_REFERENCE: Final = 100
_EXPOSURE: Final = 0.25
"""The share of the time between two frames in which light is gathered, half of it before a sample's time."""

_FASTEST: Final[Mapping[str, float]] = MappingProxyType({"push": 0.12, "place": 0.5})
"""Metres a second that the robot moves objects at most, and a little more: what it hides may be so fast."""

_NUDGED: Final = 0.01
"""The same of what it only bumps into."""

_HOLD: Final = "10s"
"""How long hidden objects are held: what has become too uncertain to matter is as good as unknown."""

_COARSE: Final = 2
"""Pixels along each edge that share one of the simulator's picture, which costs most of the time."""


@dataclass(frozen=True, slots=True)
class _View:
    """Where the camera of a scenario is, and the tags that it sees.

    Attributes:
        focal: in pixels; the principal point is in the middle.
        eye, look_at: in metres.
        tag: edge of the tags on objects, in metres.
        reference: edge of those on the table, at `places`.
    """

    size: tuple[int, int]
    focal: float
    eye: tuple[float, float, float]
    look_at: tuple[float, float, float]
    tag: float
    reference: float
    places: tuple[tuple[float, float], ...]

    @property
    def camera(self) -> Camera:
        """The camera without its pose."""
        width, height = self.size
        return Camera((self.focal, self.focal), ((width - 1) / 2, (height - 1) / 2), self.size)


_WHOLE_TABLE: Final = _View(
    (1280, 960),
    1150.0,
    (0.9, 0.0, 1.5),
    (0.27, 0.0, 0.0),
    0.05,
    0.08,
    ((0.8, -0.4), (0.8, 0.4), (-0.3, -0.75), (-0.3, 0.75), (0.3, -0.7), (0.3, 0.7)),
)
_VIEWS: Final[Mapping[str, _View]] = MappingProxyType(
    {
        "push": _View(
            (800, 600),
            850.0,
            (0.95, 0.0, 0.8),
            (0.48, 0.0, 0.0),
            0.032,
            0.05,
            ((0.28, -0.27), (0.68, -0.25), (0.68, 0.25), (0.28, 0.27), (0.3, 0.18)),
        ),
        "pick-place": _WHOLE_TABLE,
        "table-setting": _WHOLE_TABLE,
    }
)


class Film:
    """A camera above a simulated world, as a context manager; a process for one run.

    Every object carries a tag on a card on its top, those that things are put on two; further tags lie on the
    table. The picture has the blur of lens and motion, and noise; what the arm hides is hidden.
    """

    def __init__(self, world: Tabletop, video: Path, *, seed: int = 0, flaws: Flaws | None = None) -> None:
        """Open the video, and write the tags file beside it.

        Args:
            seed: of the noise.

        Raises:
            UsageError: the extra `vision` is not installed, or the name is not that of a video.
            OutputError: a file cannot be written.
        """
        refuse_inputs(video, ())
        self._world, self._seed, self._flaws = world, seed, flaws
        self._view = _VIEWS[world.name]
        eye, target = np.array(self._view.eye), np.array(self._view.look_at)
        self._pose = pose_looking_at(eye, target, np.array([0.0, 0.0, 1.0]))
        self._before: tuple[int, dict[str, Pose]] | None = None
        self._taken = 0
        self.tags = video.with_suffix(".tags.yaml")
        self._opened = ExitStack()
        self._writer = self._opened.enter_context(VideoWriter(video, SAMPLES_PER_S))
        try:
            self.tags.write_text(tags_text(world), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{self.tags}: {(error.strerror or str(error)).lower()}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def take(self, sample: Sample) -> None:
        """Add the frame of a sample, while the world is in its state."""
        self._writer.write(self.frame(sample.time_ns))

    def frame(self, time_ns: int) -> Frame:
        """Return the picture of the world as it is now."""
        scene = self._world.scene
        poses = {name: scene.pose(name) for name in scene.bodies}
        instants = [self._plates(poses, 0.0, time_ns)]
        if self._before is not None:
            shares = (-_EXPOSURE / 2, 0.0, _EXPOSURE / 2)
            instants = [self._plates(poses, share, time_ns) for share in shares]
        self._before = time_ns, poses
        self._taken += 1
        view = self._view
        size = (view.size[0] // _COARSE, view.size[1] // _COARSE)
        colours, depth = scene.engine.picture(size, view.focal / _COARSE, view.eye, view.look_at)
        backdrop = Backdrop(_enlarged(colours[..., ::-1]), _enlarged(depth))
        image = render(
            FAMILY,
            instants,
            view.camera,
            self._pose,
            flaws=self._flaws,
            seed=(self._seed, self._taken),
            backdrop=backdrop,
        )
        return Frame(time_ns, image)

    def _plates(self, poses: Mapping[str, Pose], share: float, time_ns: int) -> list[Plate]:
        """Return all tags, moved on by a share of the way since the frame before."""
        plates = [
            Plate(_FIRST_REFERENCE + index, np.array([x, y, 0.0]), np.eye(3)[:2], self._view.reference)
            for index, (x, y) in enumerate(self._view.places)
        ]
        for number, body in _numbered(self._world):
            pose = poses[body.name]
            moved = np.zeros(3)
            if self._before is not None:
                moved = share * (pose.position - self._before[1][body.name].position)
            for index, (x, y) in enumerate(_spots(body)):
                there = pose.rotation @ np.array([x, y, body.shape.height / 2]) + pose.position + moved
                plates.append(Plate(number + index, there, pose.rotation.T[:2], self._view.tag))
        return plates


def tags_text(world: Tabletop) -> str:
    """Return the tags file of a world that is at rest."""
    view = _VIEWS[world.name]
    lines = [f"family: {FAMILY}", f"size: {view.tag:g}", "objects:"]
    for number, body in _numbered(world):
        shape = body.shape
        # without a minus before nothing
        bottom, top = (round(each, 4) + 0.0 for each in world.scene.height(body.name))
        outline = (
            f"box: [{shape.length:g}, {shape.width:g}]"
            if isinstance(shape, Box)
            else f"disc: {shape.radius:g}"
        )
        tags = [
            f"{{id: {number + index}, at: [{x:g}, {y:g}], z: {top:g}}}"
            for index, (x, y) in enumerate(_spots(body))
        ]
        parts = [f"class: {body.class_name}", outline, f"tags: [{', '.join(tags)}]"]
        if not body.support:
            parts.append(f"height: [{bottom:g}, {top:g}]")
        if world.skill == "place" and body.movable:
            parts.append("lifted: true")
        parts.append(f"fastest: {_FASTEST[world.skill] if body.movable else _NUDGED:g}")
        lines.append(f"  {body.name}: {{{', '.join(parts)}}}")
    lines += ["plane:", f"  size: {view.reference:g}", "  tags:"]
    lines += [f"    {_FIRST_REFERENCE + index}: [{x:g}, {y:g}]" for index, (x, y) in enumerate(view.places)]
    lines.append(f"hold: {_HOLD}")
    return "\n".join(lines) + "\n" + camera_text(view.camera)


def _numbered(world: Tabletop) -> list[tuple[int, Body]]:
    """Return the bodies, each with the number of its first tag."""
    return [(2 * index, body) for index, body in enumerate(world.bodies)]


def _spots(body: Body) -> list[tuple[float, float]]:
    """Return where tags are on a body: of one that things are put on, where these leave them to be seen."""
    if not body.support:
        return [(0.0, 0.0)]
    if isinstance(body.shape, Box):
        x, y = body.shape.length / 2 - 0.03, body.shape.width / 2 - 0.03
        return [(x, y), (-x, -y)]
    r = body.shape.radius - 0.03
    return [(r, 0.0), (-r, 0.0)]


def _enlarged(picture: NDArray[_Number]) -> NDArray[_Number]:
    return np.ascontiguousarray(picture.repeat(_COARSE, axis=0).repeat(_COARSE, axis=1))


def open_film(world: Tabletop, video: Path | None, *, seed: int) -> AbstractContextManager[Film | None]:
    """Return a context of the film of a world; of None without a name for it.

    Raises:
        UsageError: the extra `vision` is not installed, or the name is not that of a video.
        OutputError: a file cannot be written.
    """
    if video is None:
        return nullcontext()
    if video.suffix.lower() not in (".mp4", ".mkv", ".mov", ".ts"):
        raise UsageError(f"{video}: a film is a video; name it {video.stem}.mp4")
    return Film(world, video, seed=seed)
