"""Reads a report's page as a program would: its elements, its facts, its numbers."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay import Trace
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.source import MemorySource
from spatial_replay.replay.engine import load_files
from spatial_replay.replay.selection import ReplayOptions
from spatial_replay.report.write import write_report
from spatial_replay.sources import open_source

RECORDINGS = Path(__file__).parent.parent.parent / "recordings"
TYPES = {"f8": "<f8", "f4": "<f4", "i4": "<i4", "u2": "<u2", "u1": "u1"}


class Page(HTMLParser):
    """A page's elements in their order, and the text in each kind of them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self._open: list[str] = []
        self.texts: list[tuple[tuple[str, ...], str]] = []
        self.feed(text)
        self.close()
        self.facts = json.loads(self.script("facts"))
        self._numbers = zlib.decompress(base64.b64decode(self.script("numbers")))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag != "meta":
            self._open.append(f"{tag}#{dict(attrs).get('id', '')}")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop().startswith(f"{tag}#")

    def handle_data(self, data: str) -> None:
        self.texts.append((tuple(self._open), data))

    def tags(self, tag: str) -> list[dict[str, str | None]]:
        """The attributes of every element of a kind."""
        return [attributes for each, attributes in self.elements if each == tag]

    def script(self, identifier: str) -> str:
        return self.within(f"script#{identifier}")

    def within(self, element: str) -> str:
        """All text within elements of a kind and an id: "section#verdicts"."""
        return "".join(text for inside, text in self.texts if element in inside)

    def scripts(self) -> list[str]:
        """The scripts that a browser runs."""
        return [text for inside, text in self.texts if inside and inside[-1] == "script#"]

    def numbers(self, reference: dict[str, Any]) -> np.ndarray:
        kind, length, offset = (reference[name] for name in ("kind", "length", "offset"))
        size = np.dtype(TYPES[kind]).itemsize
        codes, code = [], 0
        for place in range(offset, offset + length):
            # of the difference, byte after byte, the lowest first
            code += sum(self._numbers[place + plane * length] << 8 * plane for plane in range(size))
            codes.append((code % 2 ** (8 * size)).to_bytes(size, "little"))
        return np.frombuffer(b"".join(codes), TYPES[kind])


def page_of(output: Path) -> Page:
    return Page(output.read_bytes().decode("utf-8"))


def report_of_samples(output: Path, samples: Iterable[sr.Sample], *texts: str, **options: Any) -> Page:
    """The page of some samples and specifications."""
    return report_of_trace(output, Trace.from_samples(samples), *texts, **options)


def report_of_trace(
    output: Path, trace: Trace, *texts: str, inputs: Sequence[Path] = (), **options: Any
) -> Page:
    """The page of a trace and specifications."""
    files = [sr.parse_specification(text) for text in texts]
    write_report(MemorySource(trace), files, output, ReplayOptions(**options), inputs=inputs)
    return page_of(output)


def two_discs(count: int) -> Trace:
    """A long run, at 100 Hz: disc a swings beside disc b, which rests."""
    times = np.arange(count)
    centres = np.stack([np.sin(times / 50), np.zeros(count), np.full(count, 3.0), np.zeros(count)], axis=1)
    observations = np.arange(2 * count)
    unknown = np.full(2 * count, np.nan)
    discs = FootprintBatch(
        part_start=np.arange(2 * count + 1),
        vertex_start=np.arange(2 * count + 1),
        vertices=centres.reshape(-1, 2),
        radius=np.ones(2 * count),
        bottom=unknown,
        top=unknown,
    )
    return Trace(
        times_ns=times * 10**7,
        names=("a", "b"),
        rows=observations.reshape(-1, 2),
        footprints=discs,
        yaw=unknown,
        uncertainty=np.zeros(2 * count),
        class_code=np.zeros(2 * count, np.int64),
        classes=(None,),
    )


def report_of_recording(output: Path, log: str, *specs: str, **options: Any) -> Page:
    """The page of a recording."""
    source = open_source(RECORDINGS / log)
    files = load_files([RECORDINGS / spec for spec in specs], source)
    write_report(source, files, output, ReplayOptions(**options))
    return page_of(output)
