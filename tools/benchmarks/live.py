"""A monitored robot: latency from message to verdict, load of many messages, and a ring buffer."""

from __future__ import annotations

import asyncio
import resource
import subprocess
import sys
import tempfile
import time
from array import array
from contextlib import aclosing
from pathlib import Path
from typing import Any, NamedTuple

import spatial_replay as sr
from spatial_replay.live import LiveSession
from spatial_replay.mapping.mapping_file import parse_mapping

OBJECTS = 6
MAPPING = """
topics:
  /tracks: {objects: "objects[*]", name: "o{id}", position: [x, y], shape: {box: [0.3, 0.3]}}
"""
SPEC = """
spec apart = G (o1 dist o2 >= 0.1)
spec ordered = G (o3 leftof o4)
spec answers = G (o5 closeto[0.5] o6 -> F[0s, 1s] o1 dist o6 >= 1)
"""

SERVER = """
import json, sys, time
import foxglove

rate, topics, seconds = float(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
names = ["/tracks", *(f"/more{n}" for n in range(topics - 1))]
schema = {"type": "object", "title": "Tracks"}
channels = [foxglove.Channel(name, schema=schema, message_encoding="json") for name in names]
server = foxglove.start_server(name="robot", host="127.0.0.1", port=0)
print(server.port, flush=True)
while not channels[0].has_sinks():
    time.sleep(0.01)
time.sleep(0.5)
began = time.monotonic()
for tick in range(int(rate * seconds)):
    time.sleep(max(0.0, began + tick / rate - time.monotonic()))
    objects = [{"id": each, "x": each + 1e-3 * (tick % 50), "y": 0.0} for each in range(1, 7)]
    for number, channel in enumerate(channels):
        at_ns = time.monotonic_ns()
        fields = {"objects": objects} if not number else {"objects": [], "value": tick}
        channel.log(json.dumps(fields).encode(), log_time=at_ns)
time.sleep(1)
"""
_LONG_S = 600.0


def bench_live_latency(measure: Any) -> None:
    """Latency to the verdict from a message's arrival and from its sending, for six objects at 100 Hz."""
    run = _monitored(rate=100.0, topics=1, seconds=12.0)
    measure.quantile("arrival to verdict, median", run.delays_s, 0.5, limit_s=0.002)
    measure.quantile("arrival to verdict, 99 %", run.delays_s, 0.99, limit_s=0.010)
    measure.quantile("sending to verdict, median", run.since_sent_s, 0.5)
    measure.quantile("sending to verdict, 99 %", run.since_sent_s, 0.99)
    measure.quantile("processor time", [run.processor_s], 0.5)
    if run.session.status.dropped:
        measure.remark(f"{run.session.status.dropped} samples were dropped")


def bench_live_load(measure: Any) -> None:
    """1,000 messages a second of ten mapped topics; with --full for ten minutes."""
    run = _monitored(rate=100.0, topics=10, seconds=_LONG_S if measure.full else 20.0)
    middle, status = len(run.memory) // 2, run.session.status
    measure.size("memory gained, second half", max(0, run.memory[-1] - run.memory[middle]), 4 * 2**20)
    measure.ratio("dropped of 1,000 messages/s", status.messages_dropped + status.dropped, 0)
    measure.quantile("arrival to verdict, 99 %", run.delays_s, 0.99)
    measure.remark(f"{status.messages} messages, {status.samples} samples")


def bench_live_ring(measure: Any) -> None:
    """A stream of 20 MB/s into a ring of 60 s: the greatest speed, within the limit of bytes."""
    most_bytes, piece = (1_400 if measure.full else 350) * 2**20, 2**20
    seconds = 60 if measure.full else 15
    with tempfile.TemporaryDirectory() as folder:
        trigger = sr.Trigger("manual", before_s=seconds, after_s=0, most_bytes=most_bytes)
        recorder = sr.Recorder(
            Path(folder, "clips"), trigger=trigger, specifications=[sr.parse_specification(SPEC)]
        )
        before = _memory()
        with recorder:
            camera = recorder.channel("/camera", encoding="json")
            began = time.perf_counter()
            for tick in range(20 * seconds):
                camera.write(tick * 50_000_000, tick.to_bytes(4, "little") * (piece // 4))
                if tick % 20 == 0:
                    recorder.write(sr.Sample(tick * 50_000_000))
            while recorder.held_bytes < 20 * seconds * piece:
                time.sleep(0.01)
            taken_s = time.perf_counter() - began
            measure.size(f"ring of {seconds} s at 20 MB/s", _memory() - before, most_bytes)
            recorder.trigger("now")
        (clip,) = recorder.clips
        measure.ratio("seconds missing in its clip", seconds - clip.held_s, 0.1)
        measure.quantile("taking in 1 MB", [taken_s / (20 * seconds)], 0.5, unit="message", limit_s=0.05)


class _Monitored(NamedTuple):
    """Figures of a monitored server: delay of each sample, memory over time, processor time per sample."""

    delays_s: array[float]
    since_sent_s: array[float]
    memory: list[int]
    processor_s: float
    session: LiveSession


def _monitored(*, rate: float, topics: int, seconds: float) -> _Monitored:
    """Monitor a server that runs at the same time."""
    more = "".join(
        f"  /more{number}: {{signals: {{value{number}: value}}}}\n" for number in range(topics - 1)
    )
    mapping = parse_mapping(MAPPING + more, "bench.yaml")
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, str(rate), str(topics), str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    port = int(server.stdout.readline())
    # compact arrays, so that the memory of the measurement does not count
    delays_s, since_sent_s, processor_s = (array("d") for _ in range(3))
    memory: list[int] = []
    session = LiveSession(f"ws://127.0.0.1:{port}", sr.parse_specification(SPEC), mapping)

    async def watch() -> None:
        asyncio.get_running_loop().call_later(seconds + 1.5, session.stop)
        async with aclosing(session.updates()) as updates:
            async for update in updates:
                delays_s.append(update.delay_s)
                since_sent_s.append((time.monotonic_ns() - update.time_ns) / 1e9)
                processor_s.append(time.process_time())
                if len(delays_s) % 100 == 0:
                    memory.append(_memory())

    try:
        asyncio.run(watch())
    finally:
        server.kill()
        server.wait()
    # in the first second, the first samples load code
    first = int(rate)
    took_s = (processor_s[-1] - processor_s[first]) / (len(processor_s) - 1 - first)
    return _Monitored(delays_s[first:], since_sent_s[first:], memory, took_s, session)


def _memory() -> int:
    """Return the present memory of this process in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
