"""Messages of samples that share no layout, and such as other encoders may write."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from spatial_replay import ConvexPart, Footprint, Sample, Trace, TrackedObject
from spatial_replay.logs.objects import decode_objects, encode_objects
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates


def regular_polygon(corners, x, y):
    angles = [2 * math.pi * corner / corners for corner in range(corners)]
    return Footprint((ConvexPart(np.array([(x + math.cos(a), y + math.sin(a)) for a in angles])),))


@pytest.fixture
def motley():
    """200 samples, hardly two of them with the same objects, corners and signals."""
    dice = random.Random(7)
    samples = []
    for index in range(200):
        objects = {
            name: TrackedObject(
                regular_polygon(dice.randint(3, 12), dice.random(), dice.random()),
                yaw=dice.choice([None, dice.random()]),
            )
            for name in dice.sample("abcdefgh", 6)
        }
        signals = {name: dice.random() for name in dice.sample(["u", "v", "w"], 2)}
        samples.append(Sample(index, objects, signals))
    return Trace.from_samples(samples)


def test_every_sample_may_have_its_own_layout(motley):
    assert decode_objects(encode_objects(motley), motley.times_ns) == (motley, [])


@pytest.mark.parametrize(
    ("extra", "reported"),
    [
        (ObjectStates(time_ns=150), None),
        (ObjectStates(time_ns=3), "time_ns is 3"),
        (b"\x12\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff", "not an ObjectStates"),
        (b"\x12\x02\xff\xff", "not an ObjectStates"),
        (b"\x12\x80", "not an ObjectStates"),
        (b"\x09\x00", "not an ObjectStates"),
        (ObjectStates(signals=[{"name": "u"}, {"name": "u"}]), "signal"),
        (ObjectStates(objects=[{}]), "no name"),
        (b"\xa2\x06\x01x", None),
    ],
)
def test_bytes_appended_to_one_message_affect_only_that_message(motley, extra, reported):
    """Among messages of one layout or of many; a message may come in pieces, and the last one counts."""
    uniform = Trace.from_samples(
        Sample(i, {"a": Footprint.box(i, 0, i + 1, 1)}, {"u": 1.0, "v": 2.0, "w": 3.0}) for i in range(200)
    )
    for trace in (motley, uniform):
        payloads = list(encode_objects(trace))
        payloads[150] += extra if isinstance(extra, bytes) else extra.SerializeToString()
        decoded, faults = decode_objects(payloads, trace.times_ns)
        if reported is None:
            assert (decoded, faults) == (trace, [])
        else:
            assert decoded == trace.take(np.delete(np.arange(200), 150))
            (fault,) = faults
            assert fault.startswith("sample at 0.000 s: ")
            assert reported in fault


def test_a_message_without_time_among_many_is_a_fault(motley):
    payloads = list(encode_objects(motley))
    message = ObjectStates.FromString(payloads[42])
    message.ClearField("time_ns")
    payloads[42] = message.SerializeToString()
    assert decode_objects(payloads, motley.times_ns)[1] == ["sample at 0.000 s: the message has no time_ns"]


def test_numbers_that_a_message_leaves_out_have_their_defaults():
    message = ObjectStates(time_ns=0)
    message.objects.add(name="a").parts.add(coordinates=[1, 2])
    message.objects[0].height.SetInParent()
    (sample,) = decode_objects([message.SerializeToString()], np.zeros(1, np.int64))[0].samples()
    assert sample.objects["a"] == TrackedObject(Footprint.disc(1, 2, 0), height=(0, 0))


def test_no_messages_make_an_empty_trace():
    assert decode_objects([], np.zeros(0, np.int64)) == (Trace.from_samples([]), [])
