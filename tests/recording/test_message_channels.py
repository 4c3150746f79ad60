"""The caller's own messages in a recording: written as they are, in order, counted, and kept by a replay."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.struct_pb2 import Struct
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

import spatial_replay as sr
from examples import examples
from replay.runs import SPECIFICATION, content_of, sample
from spatial_replay.cli import run
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.sources import open_source

SPEC = sr.parse_specification(SPECIFICATION, filename="blocks.spatial")
JOINTS = {"type": "object", "title": "JointStates", "properties": {"position": {"type": "array"}}}


def _read(path: Path) -> dict[str, list[tuple[int, int, bytes]]]:
    """Sequence, time and bytes of the messages on each topic, as the stock library reads them."""
    read = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            read[channel.topic].append((message.sequence, message.log_time, message.data))
    return read


def _record(path: Path, **options: Any) -> Path:
    """A recording of 12 samples with a topic of each kind of its own."""
    with sr.Recorder(path, specifications=SPEC, **options) as recorder:
        joints = recorder.channel("/joint_states", schema=JOINTS)
        clock = recorder.channel("/clock", schema=Timestamp)
        camera = recorder.channel(
            "/camera", encoding="cdr", schema="uint8[] data", schema_name="sensor_msgs/msg/Image"
        )
        for index in range(12):
            now = sample(index)
            joints.write(now.time_ns, {"position": [index, 0.5], "note": "grün"})
            clock.write(now.time_ns + 1, Timestamp(seconds=index))
            recorder.write(now)
            camera.write(now.time_ns, bytes([index]) * 1000)
    return path


def test_the_stock_library_decodes_what_a_channel_was_given(tmp_path: Path) -> None:
    path = _record(tmp_path / "run.mcap")
    read = _read(path)
    assert [json.loads(data) for *_, data in read["/joint_states"]] == [
        {"position": [index, 0.5], "note": "grün"} for index in range(12)
    ]
    assert read["/camera"] == [(index, sample(index).time_ns, bytes([index]) * 1000) for index in range(12)]
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [message for *_, message in reader.iter_decoded_messages(topics=["/clock"])]
        summary = reader.get_summary()
    assert [message.seconds for message in decoded] == list(range(12))
    assert summary is not None
    schemas = {
        channel.topic: (summary.schemas[channel.schema_id], channel.message_encoding)
        for channel in summary.channels.values()
        if not channel.topic.startswith("/spatial/")
    }
    assert {
        topic: (schema.name, schema.encoding, encoding) for topic, (schema, encoding) in schemas.items()
    } == {
        "/joint_states": ("JointStates", "jsonschema", "json"),
        "/clock": ("google.protobuf.Timestamp", "protobuf", "protobuf"),
        "/camera": ("sensor_msgs/msg/Image", "ros2msg", "cdr"),
    }
    assert json.loads(schemas["/joint_states"][0].data) == JOINTS


def test_an_annotated_copy_keeps_the_messages_and_both_logs_verify(tmp_path: Path) -> None:
    path = _record(tmp_path / "run.mcap")
    run_replay(open_source(path), [SPEC], output=tmp_path / "again.mcap")
    before, after = _read(path), _read(tmp_path / "again.mcap")
    for topic in ("/joint_states", "/clock", "/camera", "/spatial/objects"):
        assert after[topic] == before[topic]
        assert len(after[topic]) == 12
    for each in ("run.mcap", "again.mcap"):
        assert verify_certificate(open_source(tmp_path / each)).differences == ()


def test_the_certificate_covers_the_messages(tmp_path: Path) -> None:
    hashes = set()
    for number, data in enumerate((b"1", b"2")):
        path = tmp_path / f"{number}.mcap"
        with sr.Recorder(path) as recorder:
            recorder.write(sample(0))
            recorder.channel("/note").write(0, data)
        hashes.add(dict(content_of(path).metadata)["spatial_replay_certificate"]["messages_sha256"])
    assert len(hashes) == 2


def test_the_ending_counts_the_messages_and_info_lists_their_topics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _record(tmp_path / "run.mcap")
    assert dict(content_of(path).metadata)["spatial_replay_ending"] == {
        "samples": "12",
        "dropped": "0",
        "interrupted": "false",
        "messages": "36",
        "messages_dropped": "0",
    }
    assert run(["info", str(path)]) == 0
    listed = capsys.readouterr().out
    for topic in ("/joint_states", "/clock", "/camera"):
        assert topic in listed


@examples(25)
@given(
    st.lists(
        st.tuples(st.sampled_from(["/a", "/b", "sample"]), st.integers(0, 2**63 - 1), st.binary(max_size=20)),
        max_size=30,
    )
)
def test_whatever_the_times_of_topics_are_to_each_other_the_log_verifies(
    tmp_path_factory: pytest.TempPathFactory, entries: list[tuple[str, int, bytes]]
) -> None:
    path = tmp_path_factory.mktemp("law") / "run.mcap"
    written = defaultdict(list)
    last = defaultdict(lambda: -1)
    with sr.Recorder(path) as recorder:
        recorder.write(sr.Sample(0))
        last["sample"] = 0
        for topic, time_ns, data in entries:
            if topic == "sample" and time_ns > last["sample"]:
                recorder.write(sr.Sample(time_ns))
            elif topic != "sample" and time_ns >= last[topic]:
                recorder.channel(topic).write(time_ns, data)
                written[topic].append((len(written[topic]), time_ns, data))
            last[topic] = max(last[topic], time_ns)
    read = _read(path)
    assert {topic: read[topic] for topic in written} == written
    assert verify_certificate(open_source(path)).differences == ()


def test_several_threads_write_on_one_channel_and_on_their_own(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with sr.Recorder(path, waiting=16) as recorder:
        recorder.write(sample(0))
        shared = recorder.channel("/shared")

        def write(number: int) -> None:
            own = recorder.channel(f"/own/{number}")
            for index in range(300):
                own.write(index, b"%d" % index)
                shared.write(0, b"%d %d" % (number, index))

        threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (shared.written, shared.dropped) == (1200, 0)
    read = _read(path)
    for number in range(4):
        assert read[f"/own/{number}"] == [(index, index, b"%d" % index) for index in range(300)]
    assert [sequence for sequence, *_ in read["/shared"]] == list(range(1200))
    for number in range(4):
        ours = [data for *_, data in read["/shared"] if data.startswith(b"%d " % number)]
        assert ours == [b"%d %d" % (number, index) for index in range(300)]


def test_a_loop_that_may_not_wait_drops_messages_but_no_samples_for_them(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with sr.Recorder(path, waiting=2, block=False) as recorder:
        camera = recorder.channel("/camera")
        recorder.write(sample(0))
        for index in range(2000):
            camera.write(index, b"frame")
    assert camera.written + camera.dropped == 2000
    assert (camera.dropped > 0, recorder.dropped) == (True, 0)
    assert len(_read(path)["/camera"]) == camera.written
    ending = dict(content_of(path).metadata)["spatial_replay_ending"]
    assert (ending["messages"], ending["messages_dropped"]) == (str(camera.written), str(camera.dropped))


def test_bytes_of_a_full_queue_are_bounded_and_one_large_message_passes(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    large = bytes(80 * 2**20)
    with sr.Recorder(path) as recorder:
        recorder.write(sample(0))
        recorder.channel("/map").write(0, large)
        for index in range(20):
            recorder.channel("/camera").write(index, large[: 8 * 2**20])
    read = _read(path)
    assert [len(data) for *_, data in read["/map"]] == [80 * 2**20]
    assert len(read["/camera"]) == 20


_LOOP = """
import sys, time
from spatial_replay import Footprint, Recorder, Sample
with Recorder("run.mcap") as recorder:
    joints = recorder.channel("/joint_states", schema={"type": "object"})
    while True:
        now_ns = time.monotonic_ns()
        recorder.write(Sample(now_ns, {"cube": Footprint.box(0, 0, 1, 1)}))
        joints.write(now_ns, {"position": [0.1] * 6, "at": now_ns})
        print(now_ns, flush=True)
        time.sleep(0.01)
"""


def test_messages_older_than_a_second_survive_a_kill(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _LOOP], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline())]
        while written[-1] - written[0] < 2 * 10**9:
            written.append(int(process.stdout.readline()))
        killed_ns = time.monotonic_ns()
        process.kill()
        process.communicate(timeout=300)
    safe = {time_ns for time_ns in written if time_ns < killed_ns - 10**9}
    read = {}
    for block in open_source(tmp_path / "run.mcap").iter_blocks():
        messages = block.messages
        for number, time_ns, data in zip(
            messages.channel.tolist(), messages.log_time_ns.tolist(), messages.payloads, strict=True
        ):
            if messages.channels[number].topic == "/joint_states":
                read[time_ns] = json.loads(data)["at"]
    assert safe
    assert safe <= set(read)
    assert all(time_ns == at for time_ns, at in read.items())


NODES = build_file_descriptor_set(Struct).SerializeToString()


@pytest.mark.parametrize(
    ("topic", "options", "said"),
    [
        ("/spatial/objects", {}, "/spatial/objects is a topic that spatial-replay writes itself"),
        ("/spatial/mine", {}, "give your messages another one"),
        ("/plan/decision", {}, "/plan/decision is a topic that spatial-replay writes"),
        ("", {}, "a topic is named ''; give a text"),
        (
            "/a",
            {"encoding": "xml"},
            r"/a: the encoding is 'xml'; known encodings are json, protobuf, ros1, cdr",
        ),
        ("/a", {"schema": {"type": "array"}}, 'give a JSON schema with "type": "object"'),
        ("/a", {"schema": "{"}, "/a: the schema is not JSON"),
        ("/a", {"schema": 3}, r"the schema of json messages is 3 \(int\); give a JSON schema, as a dict"),
        ("/a", {"schema": Timestamp, "encoding": "json"}, "give encoding='protobuf'"),
        ("/a", {"encoding": "protobuf"}, "protobuf messages cannot be decoded without a schema"),
        ("/a", {"encoding": "protobuf", "schema": {}}, "give the message class, or the bytes"),
        (
            "/a",
            {"encoding": "protobuf", "schema": b"\xff", "schema_name": "a.B"},
            "is not a FileDescriptorSet",
        ),
        (
            "/a",
            {"encoding": "protobuf", "schema": NODES, "schema_name": "a.B"},
            "the schema has no message 'a.B'; it has google.protobuf.Struct",
        ),
        ("/a", {"encoding": "cdr", "schema": "float64 x"}, "give schema_name, the type of the messages"),
        ("/a", {"encoding": "ros1", "schema": "x", "schema_encoding": "ros2idl"}, "ros1 messages is ros1msg"),
    ],
)
def test_a_channel_that_cannot_be_decoded_is_refused(
    tmp_path: Path, topic: str, options: dict[str, Any], said: str
) -> None:
    with sr.Recorder(tmp_path / "run.mcap") as recorder, pytest.raises(sr.UsageError, match=said):
        recorder.channel(topic, **options)


@pytest.mark.parametrize(
    ("time_ns", "data", "said"),
    [
        (-1, b"", r"/a is -1; give integer nanoseconds from 0 to 2\*\*63 - 1"),
        (2**63, b"", "/a is 9223372036854775808; give integer nanoseconds"),
        (1.5, b"", r"/a is 1\.5; give integer"),
        (4, b"", r"at 0.000 s \(4 ns\) follows one at 0.000 s \(5 ns\); give times that do not decrease"),
        (5, "text", "/a has json messages, and 'text' is str; give a dict or bytes"),
        (5, {"x": float("nan")}, "cannot be written as JSON"),
        (5, {"x": object()}, "cannot be written as JSON"),
        (5, Timestamp(), "is Timestamp; give a dict or bytes"),
    ],
)
def test_a_message_that_does_not_fit_is_refused_and_the_next_one_is_taken(
    tmp_path: Path, time_ns: Any, data: Any, said: str
) -> None:
    path = tmp_path / "run.mcap"
    with sr.Recorder(path) as recorder:
        recorder.write(sample(0))
        channel = recorder.channel("/a")
        channel.write(5, b"{}")
        with pytest.raises(sr.UsageError, match=said):
            channel.write(time_ns, data)
        channel.write(5, b"{}")
    assert _read(path)["/a"] == [(0, 5, b"{}"), (1, 5, b"{}")]


def test_a_message_of_another_protobuf_type_is_refused(tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        clock = recorder.channel("/clock", schema=Timestamp)
        said = r"/clock has messages of google\.protobuf\.Timestamp; this one is a google\.protobuf\.Struct"
        with pytest.raises(sr.UsageError, match=said):
            clock.write(0, Struct())


def test_a_topic_opened_again_is_the_same_channel_unless_it_differs(tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        first = recorder.channel("/a", schema=JOINTS)
        assert recorder.channel("/a", schema=JOINTS) is first
        with pytest.raises(sr.UsageError, match="/a is open already with another encoding or schema"):
            recorder.channel("/a")


def test_a_closed_recorder_takes_no_messages(tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        channel = recorder.channel("/a")
    with pytest.raises(sr.UsageError, match=r"run\.mcap is closed; open another recorder"):
        channel.write(0, b"")
    with pytest.raises(sr.UsageError, match=r"run\.mcap is closed"):
        recorder.channel("/b")


def test_a_full_disk_is_raised_by_the_channel() -> None:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    with pytest.raises(sr.OutputError, match="no space left"), sr.Recorder("/dev/full") as recorder:
        channel = recorder.channel("/a")
        for index in range(10**6):
            channel.write(index, b"x" * 1000)
