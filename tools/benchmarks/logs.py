"""Reading, replaying and writing logs of many samples: six moving quadrilaterals at 30 Hz."""

from __future__ import annotations

import gc
import os
import resource
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.reader import make_reader

from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.messages import Block
from spatial_replay.logs.source import Source
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.engine import run_replay
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec import parse_specification
from spatial_replay.trace.trace import Trace

OBJECTS = ("blue1", "blue2", "green1", "green2", "red1", "red2")
PERIOD_NS = 33_333_333
SPECIFICATION = """
use spatial_spec
region redGoal = box(50, 120, 250, 350)
region greenGoal = box(600, 500, 800, 730)
group reds = red1, red2
group greens = green1, green2
spec reach = (F (red1 enclosedin redGoal)) and (F (red2 enclosedin redGoal))
    and (F (green1 enclosedin greenGoal)) and (F (green2 enclosedin greenGoal))
spec passage = (G ((red1 closeto blue1) -> (red1 below blue1)))
    and (G ((red2 closeto blue2) -> (red2 above blue2)))
    and (G ((green1 closeto blue1) -> (green1 below blue1)))
    and (G ((green2 closeto blue2) -> (green2 above blue2)))
spec blocks = reach and passage
"""
_SQUARE = np.array([[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]])


@dataclass(frozen=True)
class Moving(Source):
    """A source of turning and drifting quadrilaterals, generated block by block."""

    samples: int
    name: str = "moving"
    kind: str = "generated"

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        for begin in range(0, self.samples, 16_384):
            yield Block(_moving(np.arange(begin, min(begin + 16_384, self.samples))))


def _moving(samples: np.ndarray[Any, Any]) -> Trace:
    count = len(samples) * len(OBJECTS)
    phase = samples[:, None] * 1e-3 + np.arange(len(OBJECTS))
    centre = 400.0 + 300.0 * np.stack([np.cos(phase), np.sin(1.3 * phase)], axis=-1)
    cos, sin = np.cos(3.0 * phase), np.sin(3.0 * phase)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    corners = centre[:, :, None, :] + np.einsum("tnij,kj->tnki", turn, _SQUARE)
    return Trace(
        times_ns=samples * PERIOD_NS,
        names=OBJECTS,
        rows=np.arange(count).reshape(len(samples), len(OBJECTS)),
        footprints=FootprintBatch(
            part_start=np.arange(count + 1),
            vertex_start=4 * np.arange(count + 1),
            vertices=corners.reshape(-1, 2),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        ),
        yaw=np.full(count, np.nan),
        uncertainty=np.zeros(count),
        class_code=np.zeros(count, np.int64),
        classes=("block",),
    )


def _peak_bytes(*arguments: str) -> int:
    """Return the peak memory of a command, which must be the largest child of this process so far."""
    done = subprocess.run(
        [sys.executable, "-m", "spatial_replay", *arguments], capture_output=True, check=False
    )
    if done.returncode not in (0, 1, 4):
        raise RuntimeError(f"{arguments} ended with {done.returncode}: {done.stderr.decode()}")
    return 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss


def bench_reading(measure: Any) -> None:
    """Reading all samples of our own log into columns."""
    count = 200_000
    with tempfile.TemporaryDirectory() as folder, _as_the_command_line():
        log = Path(folder) / "run.mcap"
        record_source(Moving(count), log)
        per_sample: Any = {"per": count, "unit": "sample", "runs": 5}
        records = _chunk_records(log)
        measure("decompressed, checked, no more", lambda _: _decompressed(records), **per_sample)

        def read(_: object) -> int:
            return sum(len(block.trace) for block in open_source(log).keeping().iter_blocks())

        measure("reading", read, limit_s=12e-6, **per_sample)


def _chunk_records(log: Path) -> list[tuple[bytes, int]]:
    """Return the compressed bytes of each chunk, with its decompressed size."""
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        found = []
        for chunk in summary.chunk_indexes if summary else ():
            stream.seek(chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size)
            found.append((stream.read(chunk.compressed_size), chunk.uncompressed_size))
    return found


def _decompressed(records: list[tuple[bytes, int]]) -> int:
    decompressor = zstandard.ZstdDecompressor()
    return sum(zlib.crc32(decompressor.decompress(data, max_output_size=size)) for data, size in records)


def bench_annotating(measure: Any) -> None:
    """`replay -o`: a log of 80 MB to an annotated one, next to bare zstd."""
    count = 100_000
    with tempfile.TemporaryDirectory() as folder, _as_the_command_line():
        log, annotated = Path(folder) / "run.mcap", Path(folder) / "annotated.mcap"
        record_source(Moving(count), log)
        files = [parse_specification(SPECIFICATION)]
        per_sample: Any = {"per": count, "unit": "sample", "runs": 5}

        def annotate(_: object) -> None:
            # replacing an existing file would wait for the disk
            annotated.unlink(missing_ok=True)
            run_replay(open_source(log), files, keep_leaves=True, output=annotated)

        annotate(None)
        chunks = _chunk_contents(annotated)
        measure("compressed, checksums, no more", lambda _: _compressed(chunks), **per_sample)
        measure("replay -o", annotate, limit_s=35e-6, **per_sample)


def bench_annotating_many(measure: Any) -> None:
    """`replay -o` with 100 results over 5,000 samples: time, and the peak memory of the whole command."""
    count = 5000
    with tempfile.TemporaryDirectory() as folder:
        log, spec, annotated = (Path(folder) / name for name in ("run.mcap", "many.spatial", "out.mcap"))
        pairs = (OBJECTS[number % 6] + " dist " + OBJECTS[(number + 1) % 6] for number in range(100))
        spec.write_text("\n".join(f"spec s{number} = G ({pair} >= 1)" for number, pair in enumerate(pairs)))
        record_source(Moving(count), log)
        peaks: list[int] = []
        measure(
            "100 results",
            lambda _: peaks.append(
                _peak_bytes("replay", str(log), "--spec", str(spec), "-o", str(annotated))
            ),
            per=count,
            unit="sample",
            runs=1,
        )
        measure.size("100 results: peak memory", max(peaks), 420_000_000)


@contextmanager
def _as_the_command_line() -> Iterator[None]:
    """Collect garbage as rarely as the command line does."""
    thresholds = gc.get_threshold()
    gc.set_threshold(50_000, 20, 20)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _chunk_contents(log: Path) -> list[bytes]:
    """Return the decompressed content of each chunk."""
    decompressor = zstandard.ZstdDecompressor()
    return [decompressor.decompress(data, max_output_size=size) for data, size in _chunk_records(log)]


def _compressed(chunks: list[bytes]) -> int:
    compressor = zstandard.ZstdCompressor(level=1)
    return sum(zlib.crc32(chunk) + len(compressor.compress(chunk)) for chunk in chunks)


def bench_replay_large(measure: Any) -> None:
    """`replay -o` of a large log: time of the whole command, and its peak memory."""
    count = int(os.environ.get("SPATIAL_REPLAY_BENCH_SAMPLES", "1000000"))
    with tempfile.TemporaryDirectory() as folder:
        log, spec, annotated = (
            Path(folder) / "run.mcap",
            Path(folder) / "blocks.spatial",
            f"{folder}/out.mcap",
        )
        spec.write_text(SPECIFICATION)
        record_source(Moving(count), log)
        peaks: list[int] = []
        measure(
            f"replay -o, {count:,} samples",
            lambda _: peaks.append(_peak_bytes("replay", str(log), "--spec", str(spec), "-o", annotated)),
            per=count,
            unit="sample",
            runs=1,
            warmups=0,
            limit_s=35e-6,
        )
        print(f"{'':20} peak memory {max(peaks) / 1e6:,.0f} MB, limit 1,500 MB")
