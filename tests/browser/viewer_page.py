"""A page that stands for Foxglove and Lichtblick: the extension's panels over messages of a real log."""

from __future__ import annotations

import base64
import json
import math
import random
import zipfile
from collections.abc import Iterator, Sequence
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from playwright.sync_api import Page

from spatial_replay.monitor.result import SpecResult

HERE = Path(__file__).parent
EXTENSION = "spatial-replay.foxe"
_WIDE = (FieldDescriptor.CPPTYPE_INT64, FieldDescriptor.CPPTYPE_UINT64)


def extension_files() -> dict[str, bytes]:
    """The files of the extension that the package has."""
    content = files("spatial_replay.annotate").joinpath(EXTENSION).read_bytes()
    with zipfile.ZipFile(BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


TOPICS = (
    "specification",
    "robustness",
    "automaton",
    "events",
    "recent_events",
    "decision",
    "gradient_map",
    "behaviour_tree",
)


def write_viewer_page(log: Path, page: Path, *, topics: Sequence[str] = TOPICS) -> None:
    """Write a page with the messages of a log, decoded by the libraries for MCAP as viewers decode them."""
    scripts = [HERE / "react" / "react.production.min.js", HERE / "react" / "react-dom.production.min.js"]
    code = extension_files()["dist/extension.js"].decode()
    parts = [
        "<!doctype html><meta charset=utf-8><style>html, body { margin: 0; height: 100%; }</style>",
        '<div id="panel" style="height: 100%"></div>',
        *(f"<script>{path.read_text('utf-8')}</script>" for path in (*scripts, HERE / "viewer.js")),
        f"<script>const CODE = {_text(code)};",
        f"const MESSAGES = [{','.join(_events(log, topics))}];</script>",
    ]
    page.write_text("\n".join(parts), "utf-8")


def _events(log: Path, topics: Sequence[str]) -> Iterator[str]:
    wanted = [f"/{folder}/{name}" for folder in ("spatial", "plan") for name in topics]
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=wanted):
            assert schema is not None
            sec, nsec = divmod(message.log_time, 10**9)
            yield (
                f"{{topic: {json.dumps(channel.topic)}, schemaName: {json.dumps(schema.name)}, "
                f"receiveTime: {{sec: {sec}, nsec: {nsec}}}, message: {literal(decoded)}}}"
            )


def literal(message: Message) -> str:
    """Return a message as a viewer has it: absent optional fields left out, 64-bit numbers as BigInt."""
    if message.DESCRIPTOR.full_name == Timestamp.DESCRIPTOR.full_name:
        stamp: Any = message
        return f"{{sec: {stamp.seconds}, nsec: {stamp.nanos}}}"
    fields = []
    for field in message.DESCRIPTOR.fields:
        is_optional = field.has_presence and field.message_type is None
        if is_optional and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if field.is_repeated:
            text = f"[{','.join(_scalar(field, each) for each in value)}]"
        elif field.message_type is not None and not message.HasField(field.name):
            text = "null"
        else:
            text = _scalar(field, value)
        fields.append(f"{field.name}: {text}")
    return f"{{{', '.join(fields)}}}"


def _scalar(field: FieldDescriptor, value: Any) -> str:
    if field.message_type is not None:
        return literal(value)
    if isinstance(value, bytes):
        return f'bytes("{base64.b64encode(value).decode()}")'
    if isinstance(value, float):
        return str(value).replace("inf", "Infinity") if not math.isnan(value) else "NaN"
    if field.cpp_type in _WIDE:
        return f"{value}n"
    return _text(value)


def _text(value: Any) -> str:
    # the end of a script in a text would end the page's
    return json.dumps(value).replace("</", "<\\/")


_MINUS = "\N{MINUS SIGN}"
_SEEK_ALL = """(times) => times.map(([sec, nsec]) => {
    viewer.seek({sec, nsec});
    return [...document.querySelectorAll(".tree .row")].map(
        (row) => [...row.querySelectorAll(".number")].map((each) => each.textContent));
})"""


def differences(page: Page, result: SpecResult, seeks: int, chosen: random.Random) -> list[str]:
    """Jump to random times in the panel of the specification; say where it does not show Python's numbers."""
    if page.locator("select").count():
        page.locator("select").select_option(label=result.title)
    page.evaluate("viewer.settled()")
    samples = [chosen.randrange(len(result.times_ns)) for _ in range(seeks)]
    # between samples it is the one before that counts
    times = [divmod(int(result.times_ns[sample]) + chosen.choice([0, 10**6]), 10**9) for sample in samples]
    found = []
    for sample, rows in zip(samples, page.evaluate(_SEEK_ALL, times), strict=True):
        if len(rows) != len(result.series):
            found.append(f"{len(rows)} rows for {len(result.series)} nodes")
            continue
        for node, (so_far, between, now) in enumerate(rows):
            value, present, lower, upper = result.series[node, :, sample].tolist()
            shown = [(now, present), *([(so_far, value)] if so_far else [])]
            if between:
                shown += zip(between.split(" … "), (lower, upper), strict=True)
            found += [
                f"{result.title}, node {node}, sample {sample}: {text} for {number}"
                for text, number in shown
                if not _is_shown(text, number)
            ]
    return found


def _is_shown(text: str, number: float) -> bool:
    """Return whether a text is a number in four digits, or three and an exponent; "?" if not determined."""
    if math.isnan(number) or text == "?":
        return math.isnan(number) and text == "?"
    share = 5.1e-3 if "e" in text else 5.1e-4
    return math.isclose(float(text.replace(_MINUS, "-").replace("∞", "inf")), number, rel_tol=share)
