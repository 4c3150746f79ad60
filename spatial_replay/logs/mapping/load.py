"""Mapping files: from text to values, with all faults at once."""

from __future__ import annotations

import hashlib
import json
from decimal import Decimal
from os import PathLike
from pathlib import Path
from typing import Any

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.logs.mapping.build import topic_mapping_from_values
from spatial_replay.logs.mapping.document import LARGEST_TEXT, Document, Place, document_from_text
from spatial_replay.logs.mapping.hints import nearest_hint
from spatial_replay.logs.mapping.model import Mapping, Sampling
from spatial_replay.logs.mapping.numbers import age_ns, duration_ns
from spatial_replay.logs.mapping.schema import schema_faults

_MOST_FAULTS = 100


def load_mapping(path: str | PathLike[str]) -> Mapping:
    """The mapping in a file.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is no mapping; all its faults are listed.
    """
    try:
        with Path(path).open("rb") as stream:
            data = stream.read(LARGEST_TEXT + 1)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    name = Path(path).name
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UsageError(f"{name}:{line}: a byte is not UTF-8; give a text file") from None
    return parse_mapping(text, name)


def parse_mapping(text: str, name: str = "mapping") -> Mapping:
    """The mapping that a text holds.

    Raises:
        UsageError: it is no mapping; all its faults are listed.
    """
    document = document_from_text(text)
    faults = list(document.faults)
    if not faults:
        told = dict([*schema_faults(document.value), *_contradictions(document)])
        faults = [
            (document.line_of(place), f"{_text_from_place(place)}{what}") for place, what in told.items()
        ]
    if faults:
        raise UsageError(_listed(name, faults))
    try:
        return _mapping(document, name)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None


def _mapping(document: Document, name: str) -> Mapping:
    value: Any = document.value
    shapes = value.get("shapes") or {}
    sample = value.get("sample", {})
    canonical = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=True)
    fixed_frame = value.get("fixed_frame")
    return Mapping(
        name=name,
        sha256=hashlib.sha256(canonical.encode("utf-8", "surrogatepass")).hexdigest(),
        topics=tuple(
            topic_mapping_from_values(topic, entry or {}, shapes) for topic, entry in value["topics"].items()
        ),
        fixed_frame=None if fixed_frame is None else fixed_frame.removeprefix("/"),
        clock=value.get("clock", "log"),
        sampling=Sampling(sample.get("topic"), duration_ns(sample["every"]) if "every" in sample else None),
        max_age_ns=age_ns(value["max_age"]) if "max_age" in value else None,
    )


def _contradictions(document: Document) -> list[tuple[Place, str]]:
    """What the schema cannot say: names of shapes that are not there, keys that exclude each other."""
    value = document.value
    if not isinstance(value, dict) or not isinstance(value.get("topics"), dict):
        return []
    listed = value.get("shapes")
    shapes = list(listed) if isinstance(listed, dict) else []
    faults: list[tuple[Place, str]] = []
    topics: Any = value["topics"]
    for topic, entry in topics.items():
        if not isinstance(entry, dict):
            continue
        shape = entry.get("shape")
        if isinstance(shape, str) and shape not in shapes:
            hint = nearest_hint(shape, shapes) or f"shapes are {', '.join(shapes) or 'none'}"
            faults.append((("topics", topic, "shape"), f"there is no shape {shape[:60]!r}; {hint}"))
        for one, other in (("polygon", "shape"), ("orientation", "yaw")):
            if one in entry and other in entry:
                faults.append((("topics", topic, other), f"there is {one!r} already; give one of the two"))
    for place, text in _durations(value):
        if isinstance(text, str) and text[:1].isdigit() and Decimal(0) == _leading_number(text):
            faults.append((place, f"{text!r} is no time; give a duration above 0"))
    return faults


def _durations(value: Any) -> list[tuple[Place, Any]]:
    sample = value.get("sample")
    found: list[tuple[Place, Any]] = [(("max_age",), value.get("max_age"))]
    if isinstance(sample, dict):
        found.append((("sample", "every"), sample.get("every")))
    for topic, entry in value["topics"].items():
        if isinstance(entry, dict):
            found.append((("topics", topic, "max_age"), entry.get("max_age")))
    return found


def _leading_number(text: str) -> Decimal | None:
    digits = text.rstrip("nums")
    return Decimal(digits) if digits.replace(".", "", 1).isdigit() else None


def _text_from_place(place: Place) -> str:
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f"{'.' if text else ''}{step[:80]}"
    return f"{text}: " if text else ""


def _listed(name: str, faults: list[tuple[int, str]]) -> str:
    lines = [f"{name}:{line}: {what}" for line, what in sorted(faults)]
    more = len(lines) - _MOST_FAULTS
    return "\n".join(lines[:_MOST_FAULTS] + ([f"… and {more} more"] if more > 0 else []))
