"""Two seconds of a large log of images behind a slow network, against the mcap library over fsspec."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
from mcap.reader import make_reader

import spatial_replay as sr
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Channel, Schema, messages_of
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.sources.open_log import open_source

LATENCY_S = 0.03
PERIOD_NS = 50_000_000
IMAGE_BYTES = 200_000
WINDOW_NS = 20 * 10**9, 22 * 10**9
IMAGE = Channel("/camera/image", "protobuf", Schema("foxglove.CompressedImage", "protobuf", b""))


class Traffic:
    """The traffic of a server: bytes, requests, and rounds of requests that overlap in time."""

    def __init__(self) -> None:
        self.sent = self.requests = self.rounds = self._active = 0
        self._lock = threading.Lock()

    @contextmanager
    def request(self, size: int) -> Iterator[None]:
        with self._lock:
            self.rounds += not self._active
            self._active += 1
            self.requests += 1
            self.sent += size
        try:
            time.sleep(LATENCY_S)
            yield
        finally:
            with self._lock:
                self._active -= 1


@contextmanager
def _behind_latency(path: Path) -> Iterator[tuple[str, Traffic]]:
    """Serve ranges of a file, each after a latency."""
    traffic, size = Traffic(), path.stat().st_size

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            first, _, last = self.headers["Range"].removeprefix("bytes=").partition("-")
            begin = int(first) if first else max(0, size - int(last))
            end = min(int(last) + 1, size) if first else size
            with traffic.request(end - begin), path.open("rb") as stream:
                stream.seek(begin)
                self.send_response(206)
                self.send_header("Content-Length", str(end - begin))
                self.send_header("Content-Range", f"bytes {begin}-{end - 1}/{size}")
                self.send_header("ETag", '"1"')
                self.end_headers()
                self.wfile.write(stream.read(end - begin))

        def log_message(self, *arguments: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        daemon_threads = True
        request_queue_size = 64

    with Server(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/run.mcap", traffic
        finally:
            server.shutdown()


def _write(path: Path, size: int) -> None:
    """Write samples and images at 20 Hz until the log has a size."""
    random = np.random.default_rng(1)
    objects = protobuf_channel(OBJECTS, ObjectStates)
    count = size // IMAGE_BYTES
    trace = sr.Trace.from_samples(
        sr.Sample(
            i * PERIOD_NS,
            {"cup": sr.Footprint.box(i / count, 0, 1, 1), "plate": sr.Footprint.box(5, 0, 6, 1)},
        )
        for i in range(count)
    )
    with path.open("wb") as stream, LogWriter(stream) as writer:
        for index, payload in enumerate(encode_objects(trace)):
            writer.write_messages(messages_of(objects, trace.times_ns[index : index + 1], [payload], index))
            writer.write(IMAGE, index * PERIOD_NS + 1, random.bytes(IMAGE_BYTES), sequence=index)


def _needed(path: Path) -> int:
    """Return the bytes in the chunks of the window."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    start_ns, end_ns = WINDOW_NS
    chunks = summary.chunk_indexes if summary else []
    inside = [c for c in chunks if c.message_start_time < end_ns and c.message_end_time >= start_ns]
    return sum(chunk.chunk_length for chunk in inside)


def _by_fsspec(address: str, size: int) -> int:
    """Read the window with the mcap library over a file of fsspec, with its defaults."""
    from fsspec.spec import AbstractBufferedFile, AbstractFileSystem

    class File(AbstractBufferedFile):
        def _fetch_range(self, start: int, end: int) -> bytes:
            # ranges in HTTP include the last byte: RFC 9110, section 14.1.2
            with urlopen(Request(address, headers={"Range": f"bytes={start}-{end - 1}"})) as answer:
                return bytes(answer.read())

    with File(AbstractFileSystem(), address, size=size) as stream:
        messages = make_reader(stream).iter_messages(start_time=WINDOW_NS[0], end_time=WINDOW_NS[1])
        return sum(1 for _ in messages)


def bench_remote(measure: Any) -> None:
    """A window of two seconds in 200 MB, or in 1 GB with --full: time, rounds and bytes."""
    try:
        import fsspec  # noqa: F401
        import obstore  # noqa: F401
    except ImportError as error:
        measure.remark(f"not measured: {error.name} is not installed")
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        _write(path, 10**9 if measure.full else 2 * 10**8)
        size, needed = path.stat().st_size, _needed(path)
        spec = sr.parse_specification("G (cup dist plate >= 0.1)")
        start_ns, end_ns = WINDOW_NS
        ways = {
            "mcap over fsspec": lambda address: _by_fsspec(address, size),
            "all topics": lambda address: sum(
                len(block.messages) for block in open_source(address).iter_blocks(start_ns, end_ns)
            ),
            "replay": lambda address: sr.replay_log(address, spec, start_ns=start_ns, end_ns=end_ns).samples,
        }
        reference_s, runs = None, 3
        for name, read in ways.items():
            with _behind_latency(path) as (address, traffic):
                counts = set[int]()
                figure = measure(
                    f"2 s of {size / 1e6:,.0f} MB, {name}",
                    lambda _, read=read, address=address, counts=counts: counts.add(read(address)),
                    runs=runs,
                    reference_s=reference_s,
                )
                reference_s = reference_s or figure.median_s
                rounds, sent = traffic.rounds / (runs + 1), traffic.sent / (runs + 1)
                measure.remark(
                    f"{name}: {rounds:.1f} rounds, {sent / 1e6:.2f} MB, {counts} messages or samples"
                )
                if name != "mcap over fsspec":
                    measure.ratio(f"rounds, {name}", rounds, 3.0)
                if name == "all topics":
                    measure.ratio("bytes over those of chunks", sent / needed, 1.1)
