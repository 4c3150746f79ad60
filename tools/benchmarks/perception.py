"""A camera: frames per second from picture to verdict, and coverage of the stated uncertainty."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

import spatial_replay as sr
from spatial_replay.perception import Frame, TagObserver, load_tags, observe_cameras, open_frames, parse_tags
from spatial_replay.perception.opencv import Camera, pose_looking_at
from spatial_replay.runs.virtual_camera import Plate, render
from spatial_replay.simulation.tabletop import SCENARIOS, default_specification

TAGS = """
size: 45mm
objects:
  a: {tag: 0, class: block, box: [50mm, 50mm], height: [0, 40mm]}
  b: {tag: 1, class: block, box: [50mm, 50mm], height: [0, 40mm]}
  c: {tag: 2, class: block, box: [50mm, 50mm], height: [0, 40mm]}
  d: {tag: 3, class: block, box: [50mm, 50mm], height: [0, 40mm]}
plane: {tags: {10: [0.28, -0.2], 11: [0.66, -0.2], 12: [0.66, 0.2], 13: [0.28, 0.2]}}
"""
SPEC = """
spec apart = G (a dist b >= 0.01 and c dist d >= 0.01)
spec meets = F (a dist c <= 0.06)
"""
OPPOSITE = {("satisfied", "violated"), ("violated", "satisfied")}
_FRAMES = 60
_SEED, _BEGINNING_NS = 12, 10**9


def bench_camera_speed(measure: Any) -> None:
    """Eight tags in each frame, four of them on objects, on one thread: detection to verdict."""
    for (width, height), focal, per_second in (((640, 480), 800.0, 30.0), ((1280, 720), 1300.0, 12.0)):
        camera = Camera((focal, focal), ((width - 1) / 2, (height - 1) / 2), (width, height))
        text = f"{TAGS}\ncamera: {{size: [{width}, {height}], focal: [{focal}, {focal}]}}\n"
        frames = [Frame(k * 33_333_333, _picture(camera, text, k)) for k in range(_FRAMES)]
        specification = sr.parse_specification(SPEC)

        def run(made: tuple[TagObserver, sr.Monitor], frames: list[Frame] = frames) -> None:
            observer, monitor = made
            for frame in frames:
                monitor.update(observer.observe(frame).sample)

        def prepare(text: str = text, specification: Any = specification) -> tuple[TagObserver, sr.Monitor]:
            return TagObserver(parse_tags(text)), sr.Monitor(specification)

        name = f"{width} x {height}, to the verdict"
        measure(name, run, prepare=prepare, per=_FRAMES, unit="frame", runs=5, limit_s=1 / per_second)


def _picture(camera: Camera, text: str, index: int) -> np.ndarray:
    pose = pose_looking_at(np.array([0.9, 0.0, 0.8]), np.array([0.47, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    plates = [Plate(n, np.array([x, y, z]), _axes(yaw), 0.045) for n, x, y, z, yaw in _scene(text, index)]
    return render("36h11", [plates], camera, pose, seed=(index,))


def _scene(text: str, index: int) -> Iterator[tuple[int, float, float, float, float]]:
    for each in parse_tags(text).references:
        yield each.id, each.x, each.y, 0.0, each.yaw
    for number in range(4):
        turn = 0.02 * index + number
        yield number, 0.38 + 0.06 * number + 0.01 * math.sin(turn), 0.1 * math.cos(turn), 0.04, turn


def _axes(yaw: float) -> np.ndarray:
    return np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0]])


def bench_camera_truth(measure: Any) -> None:
    """Runs of all simulated worlds, filmed from two sides: with --full whole ones, by script and planned.

    Without --full, only their beginnings. The figures are how often the truth is outside the stated
    uncertainty, and how often verdicts of named specs are unknown or opposite to the true ones. The seeds
    differ from the seeds that chose the least corner error.
    """
    try:
        import pybullet  # noqa: F401
    except ImportError:
        measure.remark("camera_truth: PyBullet is not installed")
        return
    from spatial_replay.runs.planned import record_plan
    from spatial_replay.runs.scripted import record_script

    totals: dict[str, _Comparison] = {}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        videos = [Path(folder) / "left.mp4", Path(folder) / "right.mp4"]
        for world in SCENARIOS:
            record_script(
                world, log, seed=_SEED, cameras=videos, duration_ns=None if measure.full else _BEGINNING_NS
            )
            totals[world] = compared(world, log, videos)
            if measure.full:
                record_plan(world, log, seed=_SEED, cameras=videos)
                totals[f"{world}, planned"] = compared(world, log, videos)
    for name, total in totals.items():
        measure.ratio(f"{name}: outlines outside", total.outside / total.outlines, 0.01)
        measure.ratio(f"{name}: robustness outside", total.beyond / total.values, 0.0)
        measure.ratio(f"{name}: opposite verdicts", total.opposite / total.verdicts, 0.0)
    if measure.full:
        every = sum(totals.values(), _Comparison())
        unknown = f"unknown, of {every.verdicts} specs in {every.samples} frames"
        measure.ratio(unknown, every.unknown / every.verdicts, 0.05)


def bench_camera_codec(measure: Any) -> None:
    """Outlines of three moving blocks outside their radius, sharp or blurred, by strength of coding.

    The reference uncertainty follows from reference tags alone, with a corner error of 0.1 pixels.
    """
    if not measure.full:
        measure.remark("camera_codec: 50 frames for each figure, in two minutes; takes --full")
        return
    tags = f"{TAGS}\ncamera: {{size: [800, 600], focal: [850, 850]}}\n"
    for blur, share in (("sharp", 0.0), ("blurred", 0.5)):
        film = [_exposed(tags, number, share) for number in range(_MOVING_FRAMES)]
        for crf in (None, 23, 28, 32, 36):
            frames = film if crf is None else _coded(film, crf)
            outside, outlines, radius = _stated(tags, frames)
            before, _, least = _stated(f"{tags}corner_error: 0.1\n", frames)
            name = f"{blur}, {'not coded' if crf is None else f'crf {crf}'}"
            counts = f"{outside} of {outlines} outside ({before} by reference tags)"
            measure.ratio(f"{name}: {counts}", outside / outlines, 1 / 150)
            measure.ratio(
                f"{name}: radius, {1e3 * radius:.2f} mm", radius / least, 1.2 if crf is None else 6.0
            )


_MOVING_FRAMES: Final = 50
_INSTANTS: Final = 8
_PERIOD_NS: Final = 40_000_000


def _moving(time: float) -> dict[str, tuple[float, float, float]]:
    """Return x, y and yaw of the blocks at a time in frames: motions up to 8 pixels and 2° per frame."""
    turn = 0.08 * time
    return {
        "a": (0.42 + 0.06 * math.sin(turn), -0.11 + 0.015 * math.cos(1.3 * turn), 0.3 * turn),
        "b": (0.49 + 0.09 * math.sin(1.2 * turn + 1), 0.015 * math.sin(0.7 * turn), 0.3),
        "c": (0.46 + 0.05 * math.cos(1.4 * turn), 0.11 + 0.02 * math.sin(1.4 * turn), 1 - 0.4 * turn),
    }


def _exposed(text: str, number: int, share: float) -> Frame:
    """Return a frame that is exposed during a share of its period."""
    camera = Camera((850.0, 850.0), (399.5, 299.5), (800, 600))
    pose = pose_looking_at(np.array([0.9, 0.0, 0.8]), np.array([0.47, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    resting = [
        Plate(each.id, np.array([each.x, each.y, 0.0]), _axes(0.0), 0.045)
        for each in parse_tags(text).references
    ]
    instants = [
        number + share * ((index + 0.5) / _INSTANTS - 0.5) for index in range(_INSTANTS if share else 1)
    ]
    plates = [
        [
            *resting,
            *(
                Plate(tag, np.array([x, y, 0.04]), _axes(yaw), 0.045)
                for tag, (x, y, yaw) in enumerate(_moving(instant).values())
            ),
        ]
        for instant in instants
    ]
    return Frame(number * _PERIOD_NS, render("36h11", plates, camera, pose, seed=(number,)))


def _coded(frames: Sequence[Frame], crf: int) -> list[Frame]:
    """Return frames after encoding and decoding with H.264, with the usual settings of the encoder."""
    import av

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=10**9 // _PERIOD_NS)
            stream.height, stream.width = frames[0].image.shape[:2]
            stream.pix_fmt, stream.options = "yuv420p", {"crf": str(crf)}
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="gray")))
            container.mux(stream.encode(None))
        return list(open_frames(path))


def _stated(text: str, frames: Sequence[Frame]) -> tuple[int, int, float]:
    """Return the number of outlines outside their radius, the number of all, and the median radius."""
    outside, radii = 0, []
    for seen in observe_cameras([frames], parse_tags(text)):
        truth = _moving(seen.sample.time_ns / _PERIOD_NS)
        for name, tracked in seen.sample.objects.items():
            x, y, yaw = truth[name]
            corners = 0.025 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ _axes(yaw)[:, :2] + [x, y]
            (part,) = tracked.footprint.parts
            off = np.linalg.norm(corners[:, None] - part.vertices, axis=2).min(axis=1).max()
            outside += bool(off > tracked.uncertainty)
            radii.append(tracked.uncertainty)
    return outside, len(radii), float(np.median(radii))


class _Comparison(NamedTuple):
    """Counts over some runs.

    They are of samples; of all and of wrong outlines; of all robustness values and of values beyond their
    bounds; of all, of opposite and of unknown verdicts of named specs.
    """

    samples: int = 0
    outlines: int = 0
    outside: int = 0
    values: int = 0
    beyond: int = 0
    verdicts: int = 0
    opposite: int = 0
    unknown: int = 0

    def __add__(self, other: Any) -> _Comparison:
        return _Comparison(*(one + more for one, more in zip(self, other, strict=True)))


def compared(world: str, log: Path, videos: Sequence[Path]) -> _Comparison:
    """Compare the samples from the videos of a world with the log of the run."""
    truth = sr.read_trace(log)
    tags = load_tags(videos[0].with_suffix(".tags.yaml"))
    cameras = [open_frames(video) for video in videos]
    seen = sr.Trace.from_samples([each.sample for each in observe_cameras(cameras, tags)])
    if seen.times_ns.tolist() != truth.times_ns.tolist():
        seen = _at_times(seen, truth)
    outlines = outside = 0
    for column, name in enumerate(truth.names):
        for sample, row in enumerate(seen.rows[:, list(seen.names).index(name)].tolist()):
            if row < 0:
                continue
            found = seen.footprints.select(np.array([row])).vertices
            there = truth.footprints.select(truth.rows[sample, [column]]).vertices
            off = max(np.linalg.norm(found - corner, axis=1).min() for corner in there)
            outlines += 1
            outside += bool(off > seen.uncertainty[row])
    values = beyond = verdicts = opposite = unknown = 0
    specification = default_specification(world)
    named = {each.name for each in specification.specs}
    real, read = sr.evaluate(specification, truth), sr.evaluate(specification, seen)
    for one, other in zip(real.results, read.results, strict=True):
        for node, its in zip(one.nodes, other.nodes, strict=True):
            known = ~np.isnan(node.value)
            # a yaw has no uncertainty in samples, so the bounds of `oriented` are as exact as the observation
            if "oriented" in node.text:
                known = known & False
            values += int(known.sum())
            beyond += int(((node.value < its.lower) | (node.value > its.upper))[known].sum())
            if node.name not in named:
                continue
            verdicts += 1
            opposite += (str(node.verdict), str(its.verdict)) in OPPOSITE
            unknown += str(its.verdict) == "unknown"
    return _Comparison(len(truth), outlines, outside, values, beyond, verdicts, opposite, unknown)


def _at_times(seen: sr.Trace, truth: sr.Trace) -> sr.Trace:
    """Return samples with the times of the truth. Times of a video differ from these by rounding."""
    if len(seen) != len(truth) or np.abs(seen.times_ns - truth.times_ns).max() > 10**6:
        raise ValueError("the video has not the frames of the run")
    return replace(seen, times_ns=truth.times_ns)
