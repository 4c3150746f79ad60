"""MCAP logs: what other tools read in ours, and what ours says of damaged ones."""

from __future__ import annotations

import gc
import io
import os
import random
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from examples import examples
from spatial_replay import (
    Footprint,
    LogError,
    OutputError,
    Sample,
    Trace,
    TrackedObject,
    UsageError,
    read_trace,
)
from spatial_replay.cli import run
from spatial_replay.geometry.arrays import select
from spatial_replay.logs.mcap.read import McapSource, summarise_mcap
from spatial_replay.logs.mcap.write import CHUNK_BYTES, LogWriter
from spatial_replay.logs.messages import Channel, Messages, Schema
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.schemas.Robustness_pb2 import Robustness
from spatial_replay.logs.source import BLOCK_SAMPLES, MemorySource, read_ahead
from spatial_replay.logs.topics import OBJECTS, ROBUSTNESS, protobuf_channel
from spatial_replay.sources import open_source

SAMPLES = protobuf_channel(OBJECTS, ObjectStates)
JOINTS = Channel("/joints", "json", None)


def moving_cup(count, step_ns=400_000_000):
    return Trace.from_samples(
        Sample(i * step_ns, {"cup": TrackedObject(Footprint.box(i, 0, i + 1, 1), class_name="cup", yaw=0.1)})
        for i in range(count)
    )


def messages(channel, times_ns, payloads):
    count = len(payloads)
    times = np.asarray(times_ns, np.int64)
    return Messages({3: channel}, np.full(count, 3), np.arange(count), times, times, payloads)


def log_of(trace, *more):
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.add_metadata("spatial_replay", {"version": "1", "seed": "4"})
        writer.write_messages(messages(SAMPLES, trace.times_ns, encode_objects(trace)))
        for each in more:
            writer.write_messages(each)
        writer.add_attachment("recorded/goal.spatial", "text/plain", b"F (cup in goal)")
    return stream.getvalue()


@pytest.fixture
def log(tmp_path):
    def write(content):
        path = tmp_path / "run.mcap"
        path.write_bytes(content)
        return path

    return write


def test_the_mcap_library_reads_everything():
    trace = moving_cup(10)
    reader = make_reader(io.BytesIO(log_of(trace)), decoder_factories=[DecoderFactory()], validate_crcs=True)
    decoded = [(message.log_time, states) for _, _, message, states in reader.iter_decoded_messages()]
    assert [time_ns for time_ns, _ in decoded] == trace.times_ns.tolist()
    assert all(states.time_ns == time_ns for time_ns, states in decoded)
    state = decoded[4][1].objects[0]
    assert (state.name, state.class_name, state.yaw) == ("cup", "cup", 0.1)
    assert list(state.parts[0].coordinates) == [4, 0, 5, 0, 5, 1, 4, 1]
    assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [
        ("spatial_replay", {"version": "1", "seed": "4"})
    ]
    assert [(a.name, a.data) for a in reader.iter_attachments()] == [
        ("recorded/goal.spatial", b"F (cup in goal)")
    ]
    summary = reader.get_summary()
    assert summary.statistics.message_count == 10
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (0, 3_600_000_000)


def test_schemas_of_messages_are_those_that_the_mcap_library_makes():
    for message in (ObjectStates, SceneUpdate):
        theirs = build_file_descriptor_set(message).SerializeToString(deterministic=True)
        assert protobuf_channel("/a", message).schema.data == theirs


def test_chunks_end_by_size_or_after_a_second():
    slow = make_reader(io.BytesIO(log_of(moving_cup(10)))).get_summary().chunk_indexes
    assert all(chunk.message_end_time - chunk.message_start_time < 10**9 for chunk in slow)
    assert len(slow) == 4
    fast = make_reader(io.BytesIO(log_of(moving_cup(12_000, step_ns=1000)))).get_summary().chunk_indexes
    assert all(CHUNK_BYTES <= chunk.uncompressed_size < 2 * CHUNK_BYTES for chunk in fast[:-1])
    assert len(fast) > 2


def test_a_clock_closes_chunks_too():
    seconds = iter(np.arange(0, 1000, 0.3).tolist())
    stream = io.BytesIO()
    trace = moving_cup(20, step_ns=1)
    with LogWriter(stream, clock=lambda: next(seconds)) as writer:
        for i in range(20):
            one = trace.slice(i, i + 1)
            writer.write_messages(messages(SAMPLES, one.times_ns, encode_objects(one)))
    assert len(make_reader(io.BytesIO(stream.getvalue())).get_summary().chunk_indexes) > 2


def test_what_was_flushed_is_read_from_a_log_that_was_never_closed(log):
    trace = moving_cup(7)
    stream = io.BytesIO()
    writer = LogWriter(stream)
    writer.write_messages(messages(SAMPLES, trace.times_ns, encode_objects(trace)))
    writer.flush()
    part = read_trace(log(stream.getvalue()), allow_damage=True)
    writer.close()
    assert part == trace
    assert "interrupted" in part.faults[0]
    assert read_trace(log(stream.getvalue())) == trace


def test_a_full_disk_is_an_output_error():
    with Path("/dev/full").open("wb", buffering=0) as stream, pytest.raises(OutputError, match="/dev/full"):
        LogWriter(stream)


def test_a_log_that_fails_midway_raises_once():
    class Full(io.BytesIO):
        def write(self, data):
            if self.tell() > 500:
                raise OSError(28, "No space left on device")
            return super().write(data)

    trace = moving_cup(100)
    with pytest.raises(OutputError, match="no space"), LogWriter(Full()) as writer:
        writer.write_messages(messages(SAMPLES, trace.times_ns, encode_objects(trace)))
        writer.flush()


def test_garbage_collection_of_a_log_half_read_waits_for_no_thread(monkeypatch):
    # it may happen within the start of a thread, where waiting for another one never ends
    joined = []
    monkeypatch.setattr(Thread, "join", lambda thread, timeout=None: joined.append(thread.name))
    source = open_source(Path(__file__).parents[2] / "recordings" / "push.mcap")
    for blocks in (source.iter_blocks(), read_ahead(source.iter_blocks())):
        next(blocks)
        cycle = [blocks]
        cycle.append(cycle)
        del blocks, cycle
        gc.collect()
    assert not joined


def test_a_log_truncated_anywhere_gives_a_prefix(log):
    trace = moving_cup(5)
    content = log_of(trace)
    ends, lengths = [8], []
    while ends[-1] < len(content) - 8:
        ends.append(ends[-1] + 9 + int.from_bytes(content[ends[-1] + 1 : ends[-1] + 9], "little"))
    near = {end + beside for end in ends for beside in (-1, 0, 1, 9)}
    for stop in sorted(near.intersection(range(8, len(content))).union(range(8, len(content), 41))):
        try:
            part = Trace.concatenate([b.trace for b in open_source(log(content[:stop])).iter_blocks()])
        except LogError:
            part = trace.slice(0, 0)
        else:
            assert part.faults
        assert part == trace.slice(0, len(part))
        lengths.append(len(part))
    assert sorted(set(lengths)) == [0, 3, 5]
    assert lengths == sorted(lengths)


def test_a_damaged_chunk_costs_its_samples_only(log):
    trace = moving_cup(12)
    content = bytearray(log_of(trace))
    chunks = make_reader(io.BytesIO(bytes(content))).get_summary().chunk_indexes
    hit = sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)[1]
    content[hit.chunk_start_offset + hit.chunk_length - 5] ^= 1
    part = read_trace(log(bytes(content)), allow_damage=True)
    assert part == trace.take(np.array([0, 1, 2, 6, 7, 8, 9, 10, 11]))
    assert f"at byte {hit.chunk_start_offset}" in part.faults[0]
    first, last = (
        (each - trace.times_ns[0]) / 1e9 for each in (hit.message_start_time, hit.message_end_time)
    )
    assert f"between {first:.3f} s and {last:.3f} s" in part.faults[0]
    with pytest.raises(LogError, match="at byte"):
        read_trace(log(bytes(content)))


def test_no_broken_chunk_of_a_log_that_was_never_closed_costs_another(log):
    trace = moving_cup(40)
    beside = messages(
        Channel("/joints", "json", Schema("Joints", "jsonschema", b"{}")), trace.times_ns, [b"{}"] * 40
    )
    stream = io.BytesIO()
    writer = LogWriter(stream)
    writer.write_messages(messages(SAMPLES, trace.times_ns, encode_objects(trace)))
    writer.write_messages(beside)
    writer.flush()
    killed = stream.getvalue()
    writer.close()
    chunks = make_reader(io.BytesIO(stream.getvalue())).get_summary().chunk_indexes
    ours = sorted(
        (chunk for chunk in chunks if 1 in chunk.message_index_offsets), key=lambda c: c.message_start_time
    )
    assert len(ours) == 14
    for broken in (ours[:1], ours[:2], ours[6:8]):
        content = bytearray(killed)
        for chunk in broken:
            content[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 1
        part = read_trace(log(bytes(content)), allow_damage=True)
        lost = [*range(3 * ours.index(broken[0]), 3 * ours.index(broken[-1]) + 3)]
        assert part == trace.take(np.setdiff1d(np.arange(40), lost))
        for chunk in broken:
            assert any(f"at byte {chunk.chunk_start_offset}" in fault for fault in part.faults)
    # other readers, too, understand what follows a chunk that they leave out
    gap = slice(ours[0].chunk_start_offset, ours[0].chunk_start_offset + ours[0].chunk_length)
    without = io.BytesIO(killed[: gap.start] + killed[gap.stop :])
    times = []
    with suppress(EndOfFile):
        for record in StreamReader(without).records:
            times += [record.log_time] if isinstance(record, Message) and record.channel_id == 1 else []
    assert times == trace.times_ns[3:].tolist()


@pytest.mark.parametrize("cut", [0, 60])
def test_a_missing_checksum_in_a_log_of_ours_is_a_fault(log, cut):
    trace = moving_cup(12)
    content = bytearray(log_of(trace))
    chunks = make_reader(io.BytesIO(bytes(content))).get_summary().chunk_indexes
    # with a damaged end, too, where the log is read without its index
    content = content[: len(content) - cut]
    hit = sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)[1]
    checksum = hit.chunk_start_offset + 9 + 24
    content[checksum : checksum + 4] = bytes(4)
    part = read_trace(log(bytes(content)), allow_damage=True)
    assert part == trace.take(np.array([0, 1, 2, 6, 7, 8, 9, 10, 11]))
    assert any("the chunk has no checksum" in fault for fault in part.faults)
    # others may write none
    content[:100] = bytes(content[:100]).replace(b"spatial-replay", b"another_writer")
    whole = read_trace(log(bytes(content)), allow_damage=True)
    assert (len(whole), bool(whole.faults)) == (12, cut > 0)


def test_garbage_in_the_middle_of_a_log_without_summary_costs_what_it_hides(log):
    trace = moving_cup(12)
    content = log_of(trace)
    chunks = make_reader(io.BytesIO(content)).get_summary().chunk_indexes
    offsets = sorted(chunk.chunk_start_offset for chunk in chunks)
    cut = content[: offsets[1]] + bytes(50) + content[offsets[2] : offsets[3] + 10]
    part = read_trace(log(cut), allow_damage=True)
    assert part == trace.take(np.array([0, 1, 2, 6, 7, 8]))
    assert len(part.faults) == 2


def test_random_flips_never_invent_a_sample(log):
    trace = moving_cup(12)
    content = log_of(trace)
    dice = random.Random(4)
    for _ in range(300):
        flipped = bytearray(content)
        for _ in range(dice.randint(1, 4)):
            flipped[dice.randrange(8, len(content))] ^= dice.randint(1, 255)
        try:
            part = Trace.concatenate([b.trace for b in open_source(log(bytes(flipped))).iter_blocks()])
        except LogError:
            continue
        places = np.searchsorted(trace.times_ns, part.times_ns)
        assert part == trace.take(places)
        assert len(part) == len(trace) or part.faults


def test_an_index_lets_a_window_skip_the_rest(log):
    trace = moving_cup(40)
    content = bytearray(log_of(trace))
    chunks = make_reader(io.BytesIO(bytes(content))).get_summary().chunk_indexes
    first = min(chunks, key=lambda chunk: chunk.chunk_start_offset)
    content[first.chunk_start_offset + first.chunk_length - 5] ^= 1
    source = open_source(log(bytes(content)))
    part = Trace.concatenate([b.trace for b in source.iter_blocks(4 * 10**9, 8 * 10**9)])
    assert part == trace.slice(10, 20)
    assert not part.faults


# of each stretch of chunks, which channels have messages in it, and how many chunks it has
STRETCHES = st.lists(
    st.tuples(st.sets(st.integers(0, 3), min_size=1), st.sampled_from([1, 2, 3, 7, 130, 260])),
    min_size=1,
    max_size=6,
)


@given(STRETCHES, st.integers(0, 3))
@examples(25)
def test_of_many_chunks_those_with_a_topic_are_found(tmp_path_factory, stretches, wanted):
    channels = [Channel(f"/camera{number}", "json", None) for number in range(4)]
    path = tmp_path_factory.mktemp("stretches") / "run.mcap"
    with path.open("wb") as stream, LogWriter(stream, chunk_ns=10**9) as writer:
        writer.write_messages(messages(SAMPLES, [0], encode_objects(moving_cup(1))))
        seconds = iter(range(10_000))
        for numbers, count in stretches:
            for second in islice(seconds, count):
                for number in sorted(numbers):
                    times = [second * 10**9 + number * 10**8, second * 10**9 + 5 * 10**8 + number]
                    writer.write_messages(messages(channels[number], times, [b"{}", b"[]"]))
    topic = channels[wanted].topic
    with path.open("rb") as stream:
        expected = [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages([topic])]
    found = list[tuple[int, bytes]]()
    for block in McapSource(path, keep=(topic,)).iter_blocks():
        times = block.messages.log_time_ns
        found += [
            (int(times[place]), bytes(block.messages.payloads[place]))
            for place, number in enumerate(block.messages.channel.tolist())
            if block.messages.channels[number].topic == topic
        ]
    assert found == expected


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not say how many cores")
def test_what_is_read_and_written_does_not_depend_on_the_number_of_cores(log, tmp_path):
    joints = messages(JOINTS, list(range(0, 10**11, 10**8)), [b"{}" * n for n in range(1000)])
    path = log(log_of(moving_cup(250), joints))
    spec = tmp_path / "right.spatial"
    spec.write_text("region goal = box(3, 0, 400, 1)\nspec right = F (cup enclosedin goal)")
    cores = os.sched_getaffinity(0)
    outputs, traces = [], []
    for chosen in (cores, {min(cores)}):
        try:
            os.sched_setaffinity(0, chosen)
            assert run(["replay", str(path), "--spec", str(spec), "-o", str(tmp_path / "out.mcap")]) == 0
            traces.append(read_trace(path))
        finally:
            os.sched_setaffinity(0, cores)
        outputs.append((tmp_path / "out.mcap").read_bytes())
    assert outputs[0] == outputs[1]
    assert traces[0] == traces[1] == moving_cup(250)


def test_blocks_may_end_within_chunks_of_samples_that_others_overlap(tmp_path):
    trace, path = moving_cup(2_600, 10**7), tmp_path / "run.mcap"
    camera = messages(Channel("/camera", "json", None), trace.times_ns + 1, [b"0" * 30_000] * len(trace))
    with path.open("wb") as stream, LogWriter(stream) as writer:
        for begin in range(0, len(trace), 10):
            part = trace.slice(begin, begin + 10)
            writer.write_messages(messages(SAMPLES, part.times_ns, encode_objects(part)))
            writer.write_messages(select(camera, np.arange(begin, begin + 10)))
    blocks = list(open_source(path).iter_blocks())
    assert len(blocks) > 1
    assert Trace.concatenate([block.trace for block in blocks]) == trace
    assert sum(len(block.messages) for block in blocks) == 2 * len(trace)


def test_all_messages_but_derived_ones_are_copied_as_they_are(log):
    trace = moving_cup(3)
    camera = Channel("/camera", "json", None)
    derived = protobuf_channel(ROBUSTNESS, Robustness)
    times = [400_000_000, 0, 800_000_000]
    content = log_of(
        trace, messages(camera, times, [b"{}", b"[]", b"1"]), messages(derived, times, [b""] * 3)
    )
    (block,) = open_source(log(content)).iter_blocks()
    topics = [block.messages.channels[number].topic for number in block.messages.channel.tolist()]
    assert topics == [OBJECTS, "/camera"] * 3
    assert list(block.messages.payloads[1::2]) == [b"[]", b"{}", b"1"]
    assert block.messages.log_time_ns.tolist() == sorted(times * 2)
    assert ROBUSTNESS not in {channel.topic for channel in block.messages.channels.values()}
    assert list(block.messages.payloads[::2]) == list(encode_objects(trace))


def test_messages_of_others_on_our_topics_are_copied_to_other_topics(log):
    trace = moving_cup(3)
    theirs = messages(Channel(ROBUSTNESS, "json", None), trace.times_ns, [b"{}", b"[]", b"1"])
    *blocks, last = open_source(log(log_of(trace, theirs))).iter_blocks()
    copies = [topic for block in blocks for topic in block.messages.topics]
    assert sorted(copies) == [*["/original/spatial/robustness"] * 3, *[OBJECTS] * 3]
    assert "/spatial/robustness on /original/spatial/robustness" in last.remarks[0]


def test_samples_of_other_writers_are_read(log):
    """No chunks, no index, times out of order between channels."""
    trace = moving_cup(5)
    stream = io.BytesIO()
    writer = Writer(stream, use_chunking=False, index_types=IndexType.NONE, use_statistics=False)
    writer.start()
    schema = writer.register_schema(SAMPLES.schema.name, "protobuf", SAMPLES.schema.data)
    channel = writer.register_channel(OBJECTS, "protobuf", schema)
    for time_ns, payload in zip(trace.times_ns.tolist(), encode_objects(trace), strict=True):
        writer.add_message(channel, time_ns, payload, time_ns)
    writer.finish()
    assert read_trace(log(stream.getvalue())) == trace


@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_log_by_the_mcap_library_is_read(log, use_chunking):
    trace = moving_cup(50)
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=1000, use_chunking=use_chunking)
    writer.start()
    schema = writer.register_schema(SAMPLES.schema.name, "protobuf", SAMPLES.schema.data)
    channel = writer.register_channel(OBJECTS, "protobuf", schema)
    for time_ns, payload in zip(trace.times_ns.tolist(), encode_objects(trace), strict=True):
        writer.add_message(channel, time_ns, payload, time_ns)
    writer.finish()
    assert read_trace(log(stream.getvalue())) == trace


def test_times_that_repeat_or_disagree_are_faults(log):
    trace = moving_cup(3)
    payloads = list(encode_objects(trace))
    first, second, third = trace.times_ns.tolist()
    wrong = messages(
        SAMPLES, [first, first, second, third], [payloads[0], payloads[0], payloads[2], payloads[2]]
    )
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(wrong)
    part = read_trace(log(stream.getvalue()), allow_damage=True)
    assert part.times_ns.tolist() == [first, third]
    assert "at this time already" in part.faults[0]
    assert f"time_ns is {third}" in part.faults[1]


def test_a_copy_of_a_damaged_log_is_sound(log, tmp_path, capsys):
    trace = moving_cup(6)
    payloads, times = list(encode_objects(trace)), trace.times_ns.tolist()
    wrong = [payloads[0], payloads[0], payloads[1], payloads[1], b"\xff\xff", *payloads[3:]]
    beside = messages(JOINTS, [times[1]] * 2, [b"{}"] * 2)
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(messages(SAMPLES, [times[0], *times[:2], times[1], *times[2:]], wrong))
        writer.write_messages(beside)
    (tmp_path / "a.spatial").write_text("G (cup dist cup <= 1)")
    copy = tmp_path / "copy.mcap"
    command = ["replay", "--spec", str(tmp_path / "a.spatial")]
    assert run([*command, str(log(stream.getvalue())), "-o", str(copy)]) == 3
    assert capsys.readouterr().err.count("at this time already") == 2
    assert read_trace(copy) == trace.take(np.array([0, 1, 3, 4, 5]))
    assert run([*command, str(copy)]) == 0
    assert run(["verify", str(copy)]) == 0


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda m: m.objects[0].parts[0].coordinates.append(1), "odd number"),
        (lambda m: m.objects[0].parts[0].ClearField("coordinates"), "without vertices"),
        (lambda m: m.objects[0].ClearField("parts"), "no footprint"),
        (lambda m: setattr(m.objects[0].parts[0], "radius", -1), "negative radius"),
        (lambda m: setattr(m.objects[0], "uncertainty", -1), "negative uncertainty"),
        (lambda m: setattr(m.objects[0], "name", ""), "no name"),
        (lambda m: m.objects.add().CopyFrom(m.objects[0]), "twice"),
        (lambda m: m.ClearField("time_ns"), "no time_ns"),
        (lambda m: m.signals.add(value=1), "signal has no name"),
        (
            lambda m: m.objects[0].parts[0].coordinates.__setitem__(slice(0, 8), [0, 0, 2, 2, 2, 0, 0, 1]),
            "cross",
        ),
    ],
)
def test_a_message_that_is_not_a_sample_is_a_fault(log, change, reported):
    trace = moving_cup(3)
    payloads = list(encode_objects(trace))
    message = ObjectStates.FromString(payloads[1])
    change(message)
    payloads[1] = message.SerializeToString()
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(messages(SAMPLES, trace.times_ns, payloads))
    part = read_trace(log(stream.getvalue()), allow_damage=True)
    assert part == trace.take(np.array([0, 2]))
    (fault,) = part.faults
    assert fault.startswith("run.mcap: sample at 0.400 s: ")
    assert reported in fault


def test_bytes_that_are_not_a_message_are_a_fault(log):
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(messages(SAMPLES, [0, 1], [*encode_objects(moving_cup(1)), b"\xff\xff"]))
    assert "not an ObjectStates" in read_trace(log(stream.getvalue()), allow_damage=True).faults[0]


def test_a_log_without_samples_says_what_it_has(log):
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(messages(Channel("/tf", "cdr", None), [0], [b""]))
    with pytest.raises(UsageError, match=r"no topic '/spatial/objects' in run\.mcap; it has '/tf'"):
        read_trace(log(stream.getvalue()))
    # the content of a damaged one is unknown
    with pytest.raises(LogError, match=r"it has '/tf': run\.mcap: .*without its index"):
        read_trace(log(stream.getvalue()[:-30]))
    with pytest.raises(LogError, match="no message"):
        read_trace(log(b"\x89MCAP0\r\n"))


def test_an_attachment_that_is_damaged_is_a_fault(log):
    content = log_of(moving_cup(3)).replace(b"F (cup in goal)", b"F (cup in gaol)")
    path = log(content)
    assert McapSource(path).attachments() == ()
    (fault,) = read_trace(path, allow_damage=True).faults
    assert re.fullmatch(r"run\.mcap: at byte \d+: an attachment's checksum does not fit; .* lost", fault)
    summary = summarise_mcap(McapSource(path))
    assert (summary.attachments, summary.faults) == ((), (fault,))


def test_metadata_that_is_damaged_is_a_fault(log):
    path = log(log_of(moving_cup(3)).replace(b"version", b"versio\xff"))
    assert McapSource(path).metadata() == ()
    (fault,) = read_trace(path, allow_damage=True).faults
    assert "the metadata is lost" in fault
    assert summarise_mcap(McapSource(path)).faults == (fault,)


def test_a_topic_with_messages_of_another_kind_is_an_error(log):
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.write_messages(messages(Channel(OBJECTS, "json", None), [0], [b"{}"]))
    with pytest.raises(LogError, match="encoded as 'json'"):
        read_trace(log(stream.getvalue()))


def test_a_summary_lists_what_a_log_holds(log):
    content = log_of(moving_cup(8), messages(Channel("/tf", "cdr", None), [5, 6], [b"", b""]))
    path = log(content)
    whole = summarise_mcap(McapSource(path))
    assert whole.faults == ()
    assert [(each.channel.topic, each.messages) for each in whole.channels] == [(OBJECTS, 8), ("/tf", 2)]
    assert dict(whole.metadata)["spatial_replay"]["seed"] == "4"
    (attachment,) = whole.attachments
    assert (attachment.name, attachment.media_type, attachment.size) == (
        "recorded/goal.spatial",
        "text/plain",
        15,
    )
    assert McapSource(path).attachments()[0].data == b"F (cup in goal)"
    broken = summarise_mcap(McapSource(log(content[:-30])))
    assert broken.faults
    assert (broken.channels, broken.attachments) == (whole.channels, whole.attachments)


def test_a_source_in_memory_yields_blocks():
    trace = moving_cup(20_000, step_ns=10)
    blocks = [block.trace for block in MemorySource(trace).iter_blocks(start_ns=100, end_ns=190_000)]
    assert len(blocks) > 1 and max(map(len, blocks)) <= BLOCK_SAMPLES
    assert Trace.concatenate(blocks) == trace.slice(10, 19_000)
