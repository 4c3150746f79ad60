"""Foreign logs: reading and mapping against the bare libraries, and a window of a large log."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from spatial_replay.mapping.evidence import Arrivals, TopicEvidence
from spatial_replay.sources.open_log import open_source

SECOND = 1_000_000_000
START_NS = 1_700_000_000 * SECOND
STEP_NS = SECOND // 100
COUNT = int(os.environ.get("SPATIAL_REPLAY_BENCH_MESSAGES", "100000"))
SHARE = 0.6
"""Required speed, fraction of the speed of the bare libraries."""

POSE = "geometry_msgs/msg/PoseStamped"
ROS_MAPPING = "topics:\n  /a: {shape: {box: [4, 2]}}\n  /b: {shape: {disc: 0.5}}\n"
PROTOBUF_MAPPING = "topics:\n  /poses: {shape: {disc: 0.5}}\n"
LARGE_MAPPING = "topics:\n  /a: {position: [x, y], shape: {disc: 0.5}}\n"


def _poses(store: Any, count: int, *, has_sequence: bool) -> Iterator[tuple[str, int, Any]]:
    """Yield the poses of two robots at 100 Hz each."""
    types = store.types
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    for index in range(count // 2):
        time_ns = START_NS + index * STEP_NS
        stamp = types["builtin_interfaces/msg/Time"](time_ns // SECOND, time_ns % SECOND)
        header = types["std_msgs/msg/Header"](*([index] if has_sequence else []), stamp, "map")
        for topic, y in (("/a", 0.0), ("/b", 3.0)):
            point = types["geometry_msgs/msg/Point"](0.001 * index, y, 0.0)
            yield topic, time_ns, types[POSE](header, types["geometry_msgs/msg/Pose"](point, turn))


def _write_ros1(path: Path, count: int = COUNT) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        connections = {topic: writer.add_connection(topic, POSE, typestore=store) for topic in ("/a", "/b")}
        for topic, time_ns, pose in _poses(store, count, has_sequence=True):
            writer.write(connections[topic], time_ns, bytes(store.serialize_ros1(pose, POSE)))
    return path


def _write_ros2(path: Path, plugin: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {topic: writer.add_connection(topic, POSE, typestore=store) for topic in ("/a", "/b")}
        for topic, time_ns, pose in _poses(store, COUNT, has_sequence=False):
            writer.write(connections[topic], time_ns, bytes(store.serialize_cdr(pose, POSE)))
    return path


def _write_protobuf(path: Path) -> Path:
    schema = build_file_descriptor_set(PosesInFrame).SerializeToString()
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        number = writer.register_schema("foxglove.PosesInFrame", "protobuf", schema)
        channel = writer.register_channel("/poses", "protobuf", number)
        poses = PosesInFrame(frame_id="map")
        for _ in range(6):
            poses.poses.add().orientation.w = 1.0
        for index in range(COUNT // 4):
            for place, pose in enumerate(poses.poses):
                pose.position.x, pose.position.y = 0.001 * index, float(place)
            time_ns = START_NS + index * STEP_NS
            writer.add_message(channel, time_ns, poses.SerializeToString(), time_ns)
        writer.finish()
    return path


def _bare_ros(path: Path) -> int:
    count = 0
    with AnyReader([path]) as reader:
        for connection, _, payload in reader.messages():
            reader.deserialize(payload, connection.msgtype)
            count += 1
    return count


def _bare_protobuf(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(
            1 for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        )


def _mapped(path: Path, mapping: Path) -> int:
    return sum(len(block.trace) for block in open_source(path, mapping=mapping).iter_blocks())


def _median_s(run: Callable[[], int]) -> float:
    """Return the median time per message in seconds."""
    run()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        count = run()
        times.append((time.perf_counter() - start) / count)
    return statistics.median(times)


def bench_foreign_reading(measure: Any) -> None:
    """Reading and mapping: at least 60 % of the speed of iterating and decoding the same topics."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ros, protobuf = folder / "ros.yaml", folder / "protobuf.yaml"
        ros.write_text(ROS_MAPPING)
        protobuf.write_text(PROTOBUF_MAPPING)
        logs = (
            ("ROS 1 bag", _write_ros1(folder / "a.bag"), ros, _bare_ros),
            ("ROS 2 MCAP", _write_ros2(folder / "mcap", StoragePlugin.MCAP), ros, _bare_ros),
            ("ROS 2 SQLite", _write_ros2(folder / "sqlite", StoragePlugin.SQLITE3), ros, _bare_ros),
            ("protobuf MCAP", _write_protobuf(folder / "a.mcap"), protobuf, _bare_protobuf),
        )
        for kind, path, mapping, bare in logs:
            bare_s = _median_s(lambda bare=bare, path=path: bare(path))  # type: ignore[misc]
            measure(
                f"{kind}, poses",
                lambda _, path=path, mapping=mapping: _mapped(path, mapping),
                per=bare(path),
                unit="message",
                runs=5,
                limit_s=bare_s / SHARE,
                reference_s=bare_s,
            )


@contextmanager
def _unmeasured() -> Iterator[None]:
    """Read without evidence: its methods do nothing."""
    methods = [(Arrivals, "add"), (Arrivals, "add_stamps")]
    methods += [(TopicEvidence, name) for name in ("add_objects", "add_signals", "settle")]
    replaced = [(owner, name, getattr(owner, name)) for owner, name in methods]
    try:
        for owner, name in methods:
            setattr(owner, name, lambda *_: None)
        yield
    finally:
        for owner, name, method in replaced:
            setattr(owner, name, method)


def bench_foreign_evidence(measure: Any) -> None:
    """Reading with evidence against reading without, in processor time: the median ratio of pairs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ros, protobuf = folder / "ros.yaml", folder / "protobuf.yaml"
        ros.write_text(ROS_MAPPING)
        protobuf.write_text(PROTOBUF_MAPPING)
        logs = (
            ("ROS 2 MCAP, poses", _write_ros2(folder / "mcap", StoragePlugin.MCAP), ros),
            ("protobuf MCAP, lists", _write_protobuf(folder / "a.mcap"), protobuf),
        )
        for kind, path, mapping in logs:
            _mapped(path, mapping)
            ratios = []
            for _ in range(7):
                with _unmeasured():
                    without_s = _processor_s(path, mapping)
                ratios.append(_processor_s(path, mapping) / without_s)
            measure.ratio(kind, statistics.median(ratios), 1.1)


def _processor_s(path: Path, mapping: Path) -> float:
    start = time.process_time()
    _mapped(path, mapping)
    return time.process_time() - start


def _write_large(path: Path, size: int) -> Path:
    """Write a log of about `size` bytes, with poses and with pictures that no mapping reads."""
    picture = os.urandom(2**20)
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=2**22, compression=CompressionType.NONE)
        writer.start()
        pose, pictures = (writer.register_channel(topic, "json", 0) for topic in ("/a", "/pictures"))
        for index in range(size // 2**20):
            for step in range(10):
                time_ns = START_NS + index * SECOND // 10 + step * STEP_NS
                writer.add_message(pose, time_ns, b'{"x": 1.5, "y": 2.5}', time_ns)
            writer.add_message(pictures, time_ns, picture, time_ns)
        writer.finish()
    return path


def _bytes_read() -> int:
    counters = Path("/proc/self/io").read_text().splitlines()
    return int(next(line.split()[1] for line in counters if line.startswith("rchar")))


def bench_foreign_window(measure: Any) -> None:
    """Two seconds of a 1 GB log with an index: time, and bytes read."""
    with tempfile.TemporaryDirectory() as name:
        mapping = Path(name) / "large.yaml"
        mapping.write_text(LARGE_MAPPING)
        log = _write_large(Path(name) / "large.mcap", 10**9)
        begin = START_NS + 50 * SECOND

        def window(_: object) -> int:
            blocks = open_source(log, mapping=mapping).iter_blocks(begin, begin + 2 * SECOND)
            return sum(len(block.trace) for block in blocks)

        before = _bytes_read()
        if window(None) != 200:
            raise RuntimeError("the window does not hold its samples")
        share = (_bytes_read() - before) / log.stat().st_size
        measure("2 s of 1 GB", window, runs=5, limit_s=1.0)
        print(f"{'':20} read {share:.1%} of the file, limit 10 %")


_PEAK = """
import resource, sys
from spatial_replay.sources import open_source
for block in open_source(sys.argv[1], mapping=sys.argv[2]).iter_blocks():
    pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def _peak_bytes(log: Path, mapping: Path) -> int:
    done = subprocess.run(
        [sys.executable, "-c", _PEAK, str(log), str(mapping)], capture_output=True, check=True, text=True
    )
    return 1024 * int(done.stdout)


def bench_foreign_memory(measure: Any) -> None:
    """Peak memory of reading a log, and of reading a log of four times its length."""
    with tempfile.TemporaryDirectory() as name:
        mapping = Path(name) / "ros.yaml"
        mapping.write_text(ROS_MAPPING)
        peaks: list[int] = []
        for times in (1, 4):
            count = times * COUNT
            log = _write_ros1(Path(name) / f"{times}.bag", count)
            measure(
                f"{count:,} messages, own process",
                lambda _, log=log: peaks.append(_peak_bytes(log, mapping)),
                runs=1,
                warmups=0,
            )
    print(f"{'':20} peak memory {peaks[0] / 1e6:,.0f} MB, at four times the length {peaks[1] / 1e6:,.0f} MB")
