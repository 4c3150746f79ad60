"""The part of viewers' message paths that layouts use, read and followed as they do it.

A topic, then any number of filters `{field==literal}`, fields `.name` and slices `[1]`, `[:]`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

_PARTS = re.compile(
    r"\.(?P<field>\w+)"
    r"|\[(?P<slice>\d+|:)\]"
    r'|\{(?P<key>\w+(?:\.\w+)*)==(?P<literal>-?\d+|true|false|"(?:[^"\\]|\\.)*")\}'
)


def split(path: str) -> tuple[str, list[re.Match[str]]]:
    """The topic and the parts of a path; raises ValueError for anything else."""
    topic = re.match(r"(/\w+)+", path)
    if topic is None:
        raise ValueError(f"{path!r} begins with no topic")
    parts, at = [], topic.end()
    while at < len(path):
        found = _PARTS.match(path, at)
        if found is None:
            raise ValueError(f"{path[at:]!r} in {path!r} is no part of a path")
        parts.append(found)
        at = found.end()
    return topic.group(), parts


def values(log: Path, path: str) -> list[Any]:
    """What a path finds in a log, message after message."""
    topic, parts = split(path)
    return [value for message in _decoded(log, topic) for value in _follow([message], parts)]


def newest(log: Path, path: str) -> list[Any]:
    """What a path finds in the last message of its topic."""
    topic, parts = split(path)
    return list(_follow(_decoded(log, topic)[-1:], parts))


def _decoded(log: Path, topic: str) -> list[Any]:
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [each.decoded_message for each in reader.iter_decoded_messages(topics=[topic])]


def _follow(items: list[Any], parts: list[re.Match[str]]) -> Iterator[Any]:
    for part in parts:
        if part["field"]:
            items = [getattr(item, part["field"]) for item in items]
        elif part["slice"] == ":":
            items = [inner for item in items for inner in item]
        elif part["slice"]:
            items = [item[int(part["slice"])] for item in items if len(item) > int(part["slice"])]
        else:
            items = [item for item in items if getattr(item, part["key"]) == json.loads(part["literal"])]
    yield from items
