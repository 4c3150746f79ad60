"""Small recorded runs to replay, and sources that hand them over in pieces."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from spatial_replay import ConvexPart, Footprint, Sample, Trace, TrackedObject
from spatial_replay.logs.messages import Block
from spatial_replay.logs.source import Source
from spatial_replay.recording.source_recording import record_source
from spatial_replay.trace.trace import within

STEP_NS = 250_000_000
SPECIFICATION = """\
region goal = box(4, -1, 9, 2)
spec reach = F (cube enclosedin goal)
spec apart = G (cube dist "cup 物" >= 0.5)
"""
PAST = "spec moving = G (cube moved[0.1] cube[-1])\n"


def sample(index: int) -> Sample:
    """A cube that moves to the right, past a cup of two parts, which is not always in sight."""
    cup = Footprint((ConvexPart([(3, 3)], 0.25), ConvexPart([(3, 3), (4, 3), (4, 4)])))
    objects: dict[str, TrackedObject | Footprint] = {
        "cube": TrackedObject(
            Footprint.box(index / 2, 0, index / 2 + 1, 1), class_name="Block", height=(0, 1), uncertainty=0.01
        )
    }
    if index % 5 != 3:
        objects["cup 物"] = TrackedObject(cup, class_name="dish", yaw=0.5)
    return Sample(index * STEP_NS, objects, {"battery": 1 - index / 100})


def run(count: int = 12) -> Trace:
    return Trace.from_samples(map(sample, range(count)))


@dataclass(frozen=True)
class PiecewiseSource(Source):
    """A trace handed over in blocks of a chosen size."""

    trace: Trace
    size: int
    name: str = "run"
    kind: str = "memory"

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        window = within(self.trace, start_ns, end_ns)
        for begin in range(0, max(1, len(window)), self.size):
            block = window.slice(begin, begin + self.size)
            yield Block(block if begin == 0 else replace(block, faults=()))


def record(trace: Trace, output: Path) -> Path:
    """The trace as a log that the recorder wrote."""
    record_source(PiecewiseSource(trace, 5), output)
    return output


def write_tracks(trace: Trace, path: Path) -> Path:
    """The trace as a track file."""
    path.write_text("".join(f"{json.dumps(_line(each))}\n" for each in trace.samples()), encoding="utf-8")
    return path


def _line(of: Sample) -> dict[str, Any]:
    return {
        "time_ns": of.time_ns,
        "objects": [_entry(name, each) for name, each in of.objects.items()],
        "signals": dict(of.signals),
    }


def _entry(name: str, each: TrackedObject | Footprint) -> dict[str, Any]:
    tracked = each if isinstance(each, TrackedObject) else TrackedObject(each)
    return {
        "name": name,
        "class": tracked.class_name,
        "parts": [
            {"vertices": part.vertices.tolist(), "radius": part.radius} for part in tracked.footprint.parts
        ],
        "yaw": tracked.yaw,
        "height": None if tracked.height is None else list(tracked.height),
        "uncertainty": tracked.uncertainty,
    }


@dataclass(frozen=True)
class Content:
    """What the library of the format itself finds in a log.

    Attributes:
        messages: topic, log time, publish time, sequence and bytes of each.
        metadata, attachments: name and content of each.
    """

    messages: list[tuple[str, int, int, int, bytes]]
    metadata: list[tuple[str, dict[str, str]]]
    attachments: list[tuple[str, bytes]]

    def topics(self) -> set[str]:
        return {topic for topic, *_ in self.messages}

    def of(self, *topics: str) -> list[tuple[str, int, int, int, bytes]]:
        return [message for message in self.messages if message[0] in topics]


def content_of(path: Path) -> Content:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return Content(
            [
                (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
                for _, channel, message in reader.iter_messages()
            ],
            [(record.name, record.metadata) for record in reader.iter_metadata()],
            [(record.name, record.data) for record in reader.iter_attachments()],
        )
