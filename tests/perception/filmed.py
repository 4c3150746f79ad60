"""Tables that a camera looks at: rendered frames whose truth is known, for the tests of perception."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from spatial_replay.perception import Frame, TagsFile, open_frames, parse_tags
from spatial_replay.perception.opencv import Camera, pose_looking_at
from spatial_replay.perception.video import VideoWriter
from spatial_replay.runs.virtual_camera import Plate, render

PERIOD_NS = 40_000_000
CAMERA = "camera: {size: [480, 360], focal: [640, 640]}"
REFERENCES = "plane: {tags: {10: [0.3, -0.17], 11: [0.65, -0.17], 12: [0.65, 0.17], 13: [0.3, 0.17]}}"
BLOCKS = """
size: 48mm
objects:
  red: {tag: 0, class: block, box: [50mm, 50mm], height: [0, 40mm]}
  blue: {tag: 1, class: block, box: [50mm, 50mm], height: [0, 40mm]}
"""
TABLE = f"{BLOCKS}\n{REFERENCES}\n{CAMERA}\n"

LENS = Camera((640.0, 640.0), (239.5, 179.5), (480, 360))
FROM_THE_SIDE = pose_looking_at(
    np.array([0.9, 0.04, 0.78]), np.array([0.49, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
)
FROM_THE_OTHER = pose_looking_at(
    np.array([0.45, 0.42, 0.78]), np.array([0.47, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
)

Poses = Mapping[int, tuple[float, float, float]]
"""x, y and yaw of the object with each tag."""


def plate(number: int, x: float, y: float, z: float, yaw: float, size: float = 0.048) -> Plate:
    """Return a tag that lies flat."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return Plate(number, np.array([x, y, z]), np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0]]), size)


def plates(tags: TagsFile, poses: Poses, top: float = 0.04) -> list[Plate]:
    """Return the reference tags of a file, and tags on objects as high as `top`."""
    flat = [plate(each.id, each.x, each.y, 0.0, each.yaw) for each in tags.references]
    return flat + [plate(number, x, y, top, yaw) for number, (x, y, yaw) in poses.items()]


def picture(
    scene: Sequence[Plate],
    *,
    seed: int = 0,
    lens: Camera = LENS,
    pose: np.ndarray = FROM_THE_SIDE,
    **flaws: float,
) -> np.ndarray:
    """Return what a camera sees, the one from the side unless another is given."""
    return render("36h11", [scene], lens, pose, seed=(seed,), **flaws)


def film(poses_at: Callable[[int], Poses], count: int, text: str = TABLE) -> Iterator[Frame]:
    """Yield frames of a table whose objects move."""
    tags = parse_tags(text)
    for index in range(count):
        yield Frame(index * PERIOD_NS, picture(plates(tags, poses_at(index)), seed=index))


def circling(time: float) -> Poses:
    """Return where red and blue are at a time in frames: both move by up to 9 pixels a frame, and turn."""
    angle = 0.12 * time
    return {
        0: (0.4 + 0.05 * math.sin(angle), -0.09 + 0.02 * math.cos(angle), 0.3 * angle),
        1: (0.5, 0.07 + 0.06 * math.sin(angle + 1), 0.4),
    }


def compressed(frames: Sequence[Frame], crf: int, path: Path) -> Iterator[Frame]:
    """Yield frames as they come out of a video, H.264 with the usual settings of its encoder."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width = frames[0].image.shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": f"{crf}"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="gray")))
        container.mux(stream.encode(None))
    yield from open_frames(path)


def approaching(count: int) -> Callable[[int], Poses]:
    """Return where red and blue are: red comes from afar, to 1.5 cm from blue."""

    def poses_at(index: int) -> Poses:
        return {0: (0.4, -0.12 + 0.1 * index / (count - 1), 0.0), 1: (0.4, 0.045, 0.0)}

    return poses_at


def write_approach(folder: Path, count: int = 12, name: str = "table.mp4") -> Path:
    """Write a video of the approach and the tags file, and return the video's path."""
    (folder / "tags.yaml").write_text(TABLE)
    (folder / "apart.spatial").write_text("spec apart = G (red dist blue >= 0.04)\n")
    with VideoWriter(folder / name, 25) as writer:
        for frame in film(approaching(count), count):
            writer.write(frame)
    return folder / name
