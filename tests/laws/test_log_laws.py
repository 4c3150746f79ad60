"""Laws of logs: what is written is read back, however it was divided, and damage only ever takes away."""

from __future__ import annotations

import io
import json
import math
import struct
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk

from examples import examples
from laws.strategies_trace import traces
from spatial_replay import LogError, Sample, Trace, read_trace
from spatial_replay.logs.mcap.read import McapSource, summarise_mcap
from spatial_replay.logs.mcap.write import CHUNK_BYTES, LogWriter
from spatial_replay.logs.messages import Channel, Messages
from spatial_replay.logs.objects import decode_objects, encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.logs.wire import WireTemplate
from spatial_replay.sources import open_source

CHANNEL = protobuf_channel(OBJECTS, ObjectStates)


def messages_of(trace, begin):
    count = len(trace)
    return Messages(
        {0: CHANNEL},
        np.zeros(count, np.int64),
        np.arange(begin, begin + count),
        trace.times_ns,
        trace.times_ns,
        encode_objects(trace),
    )


def write(traces):
    stream = io.BytesIO()
    with LogWriter(stream) as writer:
        writer.add_metadata("spatial_replay", {"version": "1"})
        begin = 0
        for trace in traces:
            writer.write_messages(messages_of(trace, begin))
            begin += len(trace)
        writer.add_attachment("recorded/goal.spatial", "text/plain", b"F (a closeto b)")
    return stream.getvalue()


def read(content):
    """What can be read of a log, or None if nothing can."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        path.write_bytes(content)
        try:
            summarise_mcap(McapSource(path))
            return Trace.concatenate([block.trace for block in open_source(path).iter_blocks()])
        except LogError:
            return None


@given(traces())
def test_messages_hold_the_trace(trace):
    decoded, faults = decode_objects(encode_objects(trace), trace.times_ns)
    assert (decoded, faults) == (trace, [])


@given(traces())
def test_messages_are_what_the_protobuf_library_writes(trace):
    for payload in encode_objects(trace):
        message = ObjectStates.FromString(payload)
        assert message.SerializeToString(deterministic=True) == payload
        assert [state.name for state in message.objects] == sorted(state.name for state in message.objects)


@given(traces(max_samples=3))
@examples(50)
def test_a_template_reads_what_the_protobuf_library_reads(trace):
    for payload in encode_objects(trace):
        message = ObjectStates.FromString(payload)
        template = WireTemplate.of(message)
        row = np.frombuffer(payload, np.uint8)[None]
        assert template.matches(row).all()
        assert template.fill(template.words(row)).tobytes() == payload
        numbers = [x for state in message.objects for part in state.parts for x in part.coordinates]
        read_numbers = template.words(row).view(np.float64)[0].tolist()
        assert all(x in read_numbers or math.isnan(x) for x in numbers)


@given(traces(max_samples=3), st.data())
@examples(50)
def test_fields_in_any_order_mean_the_same(trace, data):
    """Other encoders may write the fields of a message in another order."""
    payloads = []
    for payload in encode_objects(trace):
        message = ObjectStates.FromString(payload)
        pieces = [ObjectStates(time_ns=message.time_ns).SerializeToString()]
        pieces += [ObjectStates(objects=[state]).SerializeToString() for state in message.objects]
        pieces += [ObjectStates(signals=[signal]).SerializeToString() for signal in message.signals]
        payloads.append(b"".join(data.draw(st.permutations(pieces))))
    decoded, faults = decode_objects(payloads, trace.times_ns)
    assert (decoded, faults) == (trace, [])


@given(traces())
def test_a_log_holds_the_trace(trace):
    assert read(write([trace])) == (trace if len(trace) else None)


@given(traces(), st.lists(st.integers(0, 6), max_size=3))
def test_dividing_samples_among_calls_does_not_change_the_bytes(trace, cuts):
    bounds = [0, *sorted(min(cut, len(trace)) for cut in cuts), len(trace)]
    pieces = [trace.slice(begin, end) for begin, end in pairwise(bounds)]
    assert write(pieces) == write([trace])


@given(traces(), st.integers(0, 2**62), st.integers(0, 2**62))
@examples(50)
def test_a_window_of_a_log_is_a_window_of_its_trace(trace, one, other):
    times = trace.times_ns.tolist()
    start, end = sorted([one, other] if not times else [times[one % len(times)], times[other % len(times)]])
    expected = [block.trace for block in MemorySource(trace).iter_blocks(start, end)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        path.write_bytes(write([trace]))
        if times:
            found = [block.trace for block in open_source(path).iter_blocks(start, end)]
            assert Trace.concatenate(found) == Trace.concatenate(expected)


def is_prefix(part, whole):
    return part is None or part == whole.slice(0, len(part))


def is_subset(part, whole):
    if part is None:
        return True
    places = np.searchsorted(whole.times_ns, part.times_ns)
    return np.array_equal(whole.times_ns[places], part.times_ns) and part == whole.take(places)


@given(traces(max_samples=5), st.data())
@examples(40)
def test_a_truncated_log_gives_a_prefix_and_says_so(trace, data):
    content = write([trace])
    for end in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=5, max_size=5)):
        part = read(content[:end])
        assert is_prefix(part, trace)
        assert part is None or part.faults


@given(traces(max_samples=5), st.data())
@examples(60)
def test_flipped_bytes_only_take_samples_away(trace, data):
    content = write([trace])
    for _ in range(5):
        place = data.draw(st.integers(8, len(content) - 1))
        flipped = bytearray(content)
        flipped[place] ^= data.draw(st.integers(1, 255))
        part = read(bytes(flipped))
        assert is_subset(part, trace)
        if len(trace):
            assert part is None or part == trace or part.faults


@given(st.binary(max_size=300))
def test_any_bytes_after_the_magic_are_at_worst_an_error(content):
    read(b"\x89MCAP0\r\n" + content)


@given(traces(max_samples=3).filter(len), st.lists(st.integers(0, 4), min_size=1, max_size=9))
@examples(30)
def test_chunks_that_are_named_several_times_are_read_as_often(trace, named):
    first = next(trace.samples())
    samples = [replace(first, time_ns=k * 10**9, reported_ns={}) for k in range(5)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        path.write_bytes(write([Trace.from_samples(samples)]))
        with McapSource(path).open_walk() as walk:
            places = [walk.places[number] for number in named]
            found = [messages.payloads for _, messages in walk.iter_messages(places)]
    payloads = list(encode_objects(Trace.from_samples(samples)))
    assert [each for several in found for each in several] == [payloads[number] for number in named]


@given(traces())
def test_a_track_file_holds_the_trace(trace):
    trace = replace(trace, reported_ns=None, signals_reported_ns={}, lasting=frozenset())
    lines = [json.dumps(line) for line in json_lines(trace)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.jsonl")
        path.write_text("\n".join(lines), encoding="utf-8")
        if lines:
            assert read_trace(path) == trace


def json_lines(trace):
    """The samples of a trace as lines of a track file have them."""
    shapes = trace.footprints
    for index, time_ns in enumerate(trace.times_ns.tolist()):
        objects = []
        for name, marked in zip(trace.names, trace.rows[index].tolist(), strict=True):
            if marked == -1:
                continue
            row = marked if marked >= 0 else -2 - marked
            parts = [
                {
                    "vertices": shapes.vertices[shapes.vertex_start[p] : shapes.vertex_start[p + 1]].tolist(),
                    "radius": float(shapes.radius[p]),
                }
                for p in range(shapes.part_start[row], shapes.part_start[row + 1])
            ]
            entry = {"name": name, "parts": parts, "uncertainty": float(trace.uncertainty[row])}
            if (class_name := trace.classes[trace.class_code[row]]) is not None:
                entry["class"] = class_name
            if not math.isnan(shapes.bottom[row]) or not math.isnan(shapes.top[row]):
                entry["height"] = [float(shapes.bottom[row]), float(shapes.top[row])]
            if not math.isnan(trace.yaw[row]):
                entry["yaw"] = float(trace.yaw[row])
            elif marked < 0:
                entry["yaw"] = math.nan
            objects.append(entry)
        signals = {name: float(values[index]) for name, values in trace.signals.items()}
        yield {"time_ns": time_ns, "objects": objects, "signals": signals}


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.binary(max_size=40)), min_size=20, max_size=60),
)
def test_a_copy_has_each_message_where_the_index_says(written):
    channels = {number: Channel(f"/{name}", "json", None) for number, name in enumerate("abc")}
    numbers = np.array([ord(name) - ord("a") for name, _ in written], np.int64)
    times_ns = np.arange(len(written), dtype=np.int64) * 10**8
    payloads = [payload for _, payload in written]
    original, copy = io.BytesIO(), io.BytesIO()
    with LogWriter(original) as writer:
        writer.write_messages(messages_of(Trace.from_samples([Sample(0)]), 0))
        writer.write_messages(
            Messages(channels, numbers, np.arange(len(written)), times_ns, times_ns, payloads)
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        path.write_bytes(original.getvalue())
        with LogWriter(copy) as writer:
            for block in open_source(path).iter_blocks():
                writer.write_messages(block.messages)
    found = {name: [] for name in "abc"}
    for _, channel, message in make_reader(io.BytesIO(copy.getvalue())).iter_messages():
        if channel.topic in ("/a", "/b", "/c"):
            found[channel.topic[1:]].append((message.log_time, message.data))
    assert found == {
        name: [(k * 10**8, own) for k, (to, own) in enumerate(written) if to == name] for name in "abc"
    }
    content = b""
    for record in StreamReader(io.BytesIO(copy.getvalue()), emit_chunks=True).records:
        if isinstance(record, Chunk):
            content = zstandard.decompress(record.data, max_output_size=record.uncompressed_size)
        elif isinstance(record, MessageIndex):
            for time_ns, place in record.records:
                _, _, number, _, log_time_ns = struct.unpack_from("<BQHIQ", content, place)
                assert (number, log_time_ns) == (record.channel_id, time_ns)


@examples(30)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/spatial/a", "/spatial/b", "/camera"]),
            st.sampled_from([0, 10**7, 10**9 - 1, 10**9, -(10**9)]),
            st.sampled_from([0, 500, CHUNK_BYTES // 3, CHUNK_BYTES + 1000]),
        ),
        min_size=1,
        max_size=40,
    ),
    st.lists(st.integers(0, 40)),
)
def test_chunks_end_at_the_same_messages_however_these_are_divided_among_calls(given_ones, cuts):
    topics = sorted({topic for topic, _, _ in given_ones})
    channels = {number: Channel(topic, "json", None) for number, topic in enumerate(topics)}
    numbers = np.array([topics.index(topic) for topic, _, _ in given_ones])
    times_ns = np.maximum(np.cumsum([step for _, step, _ in given_ones]), 0)
    payloads = [bytes(size) for _, _, size in given_ones]
    whole, pieces = io.BytesIO(), io.BytesIO()
    for stream, ends in ((whole, []), (pieces, sorted(cut for cut in cuts if cut < len(payloads)))):
        with LogWriter(stream) as writer:
            for begin, end in pairwise([0, *ends, len(payloads)]):
                own = slice(begin, end)
                given_at = np.arange(begin, end), times_ns[own], times_ns[own], payloads[own]
                writer.write_messages(Messages(channels, numbers[own], *given_at))
    assert pieces.getvalue() == whole.getvalue()
    for record in StreamReader(io.BytesIO(whole.getvalue()), emit_chunks=True).records:
        if isinstance(record, Chunk):
            messages = [each for each in breakup_chunk(record) if isinstance(each, Message)]
            assert all(each.log_time < messages[0].log_time + 10**9 for each in messages)
            assert sum(len(each.data) + 31 for each in messages[:-1]) < CHUNK_BYTES
