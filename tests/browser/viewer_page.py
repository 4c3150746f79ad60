"""A page that stands for Foxglove and Lichtblick: the extension's panels over messages of a real log."""

from __future__ import annotations

import base64
import json
import math
import zipfile
from collections.abc import Iterator
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

HERE = Path(__file__).parent
EXTENSION = "spatial-replay.foxe"
_WIDE = (FieldDescriptor.CPPTYPE_INT64, FieldDescriptor.CPPTYPE_UINT64)


def extension_files() -> dict[str, bytes]:
    """The files of the extension that the package has."""
    content = files("spatial_replay.annotate").joinpath(EXTENSION).read_bytes()
    with zipfile.ZipFile(BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_viewer_page(log: Path, page: Path, *, prefixes: tuple[str, ...] = ("/spatial/", "/plan/")) -> None:
    """Write a page with the messages of a log, decoded by the libraries for MCAP as viewers decode them."""
    scripts = [HERE / "react" / "react.production.min.js", HERE / "react" / "react-dom.production.min.js"]
    code = extension_files()["dist/extension.js"].decode()
    parts = [
        "<!doctype html><meta charset=utf-8><style>html, body { margin: 0; height: 100%; }</style>",
        '<div id="panel" style="height: 100%"></div>',
        *(f"<script>{path.read_text('utf-8')}</script>" for path in (*scripts, HERE / "viewer.js")),
        f"<script>const CODE = {_text(code)};",
        f"const MESSAGES = [{','.join(_events(log, prefixes))}];</script>",
    ]
    page.write_text("\n".join(parts), "utf-8")


def _events(log: Path, prefixes: tuple[str, ...]) -> Iterator[str]:
    wanted = {
        f"{prefix}{name}"
        for prefix in prefixes
        for name in ("specification", "robustness", "automaton", "events", "decision", "gradient_map")
    }
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=sorted(wanted)):
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
