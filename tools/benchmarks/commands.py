"""Whole commands with warm kernel caches."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from mcap.writer import Writer


def _run(*arguments: str, cache: str | None = None) -> None:
    environment = os.environ if cache is None else os.environ | {"SPATIAL_REPLAY_CACHE": cache}
    command = [sys.executable, "-m", "spatial_replay", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    if done.returncode not in (0, 1, 4):
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr.decode()}")


def bench_help(measure: Any) -> None:
    """`spatial-replay --help`."""
    measure("--help", lambda _: _run("--help"), limit_s=0.3)


def bench_short_replay(measure: Any) -> None:
    """`spatial-replay replay` of 300 samples, and the first replay on a machine, without compiled code."""
    recordings = Path(__file__).resolve().parents[2] / "recordings"
    with tempfile.TemporaryDirectory() as folder:
        log = f"{folder}/table.mcap"
        _run("record", "tracks", str(recordings / "table.jsonl"), "-o", log)
        command = ("replay", log, "--spec", str(recordings / "table.spatial"))
        measure("warm cache", lambda _: _run(*command), limit_s=0.7)
        measure(
            "no cache",
            lambda cache: _run(*command, cache=cache),
            prepare=lambda: tempfile.mkdtemp(dir=folder),
            limit_s=8.0,
        )


def bench_replay_command(measure: Any) -> None:
    """`spatial-replay replay` of the blocks recording, 1579 samples."""
    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        return
    with tempfile.TemporaryDirectory() as folder:
        log, spec = f"{folder}/run.mcap", Path(folder) / "blocks.spatial"
        spec.write_text(json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"])
        _run("record", "tracks", str(data / "blocks_moving_passage.jsonl.gz"), "-o", log)
        measure("verdict only", lambda _: _run("replay", log, "--spec", str(spec)), limit_s=1.5)
        annotated = f"{folder}/annotated.mcap"
        measure("with -o", lambda _: _run("replay", log, "--spec", str(spec), "-o", annotated), limit_s=1.5)


def bench_template(measure: Any) -> None:
    """A template for each of 125 tracks that come and go in an external log of 600 samples."""
    with tempfile.TemporaryDirectory() as folder:
        log, mapping, spec = (f"{folder}/{name}" for name in ("tracks.mcap", "tracks.yaml", "calm.spatial"))
        _write_tracks(Path(log))
        Path(mapping).write_text(
            "topics:\n  /tracks: {objects: 'tracks[*]', name: 'person_{id}', class: person,"
            " position: [x, y], shape: {disc: 0.3}, complete: true}\n"
        )
        Path(spec).write_text('spec calm(ego) = G (ego dist (class "person" except ego) >= 0.5)\n')
        options = (log, "--mapping", mapping, "--spec", spec, "--each", "ego=class:person")
        measure(
            "replay --json --series",
            lambda _: _run("replay", *options, "--json", "-", "--series"),
            limit_s=6.0,
        )
        measure("explain", lambda _: _run("explain", *options), limit_s=3.5)


def _write_tracks(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("Tracks", "jsonschema", b"{}")
        channel = writer.register_channel("/tracks", "json", schema)
        for tick in range(600):
            there = [each for each in range(125) if 0 <= tick - 4 * each < 80 + each]
            tracks = [
                {"id": each, "x": each % 12 * 5.0 + 0.02 * tick, "y": each // 12 * 5.0 - 0.01 * tick}
                for each in there
            ]
            time_ns = 1_700_000_000_000_000_000 + tick * 10**8
            writer.add_message(channel, time_ns, json.dumps({"tracks": tracks}).encode(), time_ns)
        writer.finish()
