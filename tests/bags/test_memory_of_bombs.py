"""Small logs that decompress to gigabytes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import spatial_replay as sr
from bags.bag_files import (
    MAPPING,
    POINT,
    SECOND,
    START_NS,
    TEXT,
    Sent,
    point,
    text,
    write_json_mcap,
    write_ros2,
)
from cli.program import environment
from spatial_replay.logs.topics import OBJECTS

MOST_MIB = 900
STEPS = 50
LONG = "a" * (20 * 2**20)

PEAK = """
import json, re, sys
from pathlib import Path
import spatial_replay as sr
try:
    sr.replay_log(*sys.argv[1:3], output=sys.argv[3], mapping=sys.argv[4] or None)
    said = ""
except sr.SpatialReplayError as error:
    said = str(error)
peak_kib = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print(json.dumps([said, int(peak_kib) // 1024]))
"""


def sent(order: Callable[[int], int] = lambda number: number) -> Iterator[Sent]:
    """Two points that move, with a long and simple text at each step."""
    for number in range(STEPS):
        time_ns = START_NS + number * SECOND
        yield Sent("/a", POINT, time_ns, point(0.1 * number, 1.0))
        yield Sent("/b", POINT, time_ns + 1_000, point(5.0, 0.1 * number))
        yield Sent("/words", TEXT, START_NS + order(number) * SECOND + 2_000, text(LONG))


def write_overlapping(folder: Path) -> Path:
    """Each text is logged before all those of the chunks that begin earlier."""
    as_json = (
        (topic, time_ns, {"data": content.data} if topic == "/words" else {"x": content.x, "y": content.y})
        for topic, _, time_ns, content in sent(lambda number: STEPS - number)
    )
    return write_json_mcap(folder / "run.mcap", as_json)


def write_messages(folder: Path) -> Path:
    return write_ros2(folder / "bag", sent(), storage="sqlite3", compression="message")


def write_own(folder: Path) -> Path:
    """A log of ours with a chunk for each text."""
    with sr.Recorder(folder / "own.mcap") as recorder:
        boxes = {name: sr.Footprint.box(x, 0, x + 1, 1) for name, x in (("a", 0), ("b", 3))}
        recorder.write(sr.Sample(START_NS, boxes))
    with (folder / "own.mcap").open("rb") as own, (folder / "run.mcap").open("wb") as stream:
        ((schema, channel, message),) = make_reader(own).iter_messages(topics=[OBJECTS])
        assert schema is not None
        writer = Writer(stream, chunk_size=1_000)
        writer.start()
        known = writer.register_schema(schema.name, schema.encoding, schema.data)
        samples = writer.register_channel(channel.topic, channel.message_encoding, known)
        words = writer.register_channel("/words", "json", 0)
        for number in range(STEPS):
            time_ns = START_NS + number * SECOND
            writer.add_message(samples, time_ns, message.data, time_ns)
            writer.add_message(words, time_ns, LONG.encode(), time_ns)
        writer.finish()
    return folder / "run.mcap"


@pytest.mark.parametrize("write", [write_overlapping, write_messages, write_own])
def test_a_small_log_that_decompresses_to_gigabytes_takes_bounded_memory(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    log = write(tmp_path)
    (tmp_path / "far.spatial").write_text("spec far = G (a dist b >= 0)")
    (tmp_path / "map.yaml").write_text(MAPPING)
    arguments = [str(log), *(str(tmp_path / name) for name in ("far.spatial", "out.mcap"))]
    arguments.append("" if write is write_own else str(tmp_path / "map.yaml"))
    done = subprocess.run(
        [sys.executable, "-c", PEAK, *arguments],
        # a compiler at work would take memory of its own
        env=environment(SPATIAL_REPLAY_KERNELS="interpreted"),
        capture_output=True,
        text=True,
        check=True,
    )
    said, peak_mib = json.loads(done.stdout)
    assert peak_mib < MOST_MIB, said
    assert ("overlap in time" in said) == (write is write_overlapping), said
