"""Read YAML: text in, plain values with their line numbers out.

Size and depth are limited; tags, aliases and repeated keys are errors. Plain scalars follow YAML 1.2, so that
`no` and `12:30` are texts: a topic or a name never becomes a truth value or a number of minutes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    import yaml

Value: TypeAlias = "dict[str, Value] | list[Value] | str | int | float | bool | None"
Place: TypeAlias = tuple[str | int, ...]
"""Keys and indices from the top of a document to a value."""

LARGEST_TEXT = 256 * 1024
"""Bytes; mappings are written by hand, so a larger file is something else."""

_DEEPEST = 20
_INTEGER = re.compile(r"[-+]?[0-9]{1,300}", re.ASCII)
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", re.ASCII)
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None}
_TRUTHS = {word: word[0] in "tT" for word in ("true", "True", "TRUE", "false", "False", "FALSE")}
_SPECIAL = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


@dataclass(slots=True)
class Document:
    """The content of a YAML text.

    Attributes:
        value: mappings, lists, texts, numbers, truth values, None.
        lines: the line of each value, from 1; for the value of a key, the line of the key.
        faults: (line, text) of each error.
    """

    value: Value = None
    lines: dict[Place, int] = field(default_factory=dict)
    faults: list[tuple[int, str]] = field(default_factory=list)

    def line_of(self, place: Place) -> int:
        """Return the line of a value, or of the nearest one around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def document_from_text(text: str, what: str = "a mapping", largest: int = LARGEST_TEXT) -> Document:
    """Read a YAML text; errors are in `faults` of the document.

    Args:
        what: what the text is, for errors.
        largest: size in bytes.
    """
    import yaml

    document = Document()
    if len(text.encode("utf-8", "surrogatepass")) > largest:
        document.faults.append((1, f"the file is larger than {largest // 1024} KiB; {what} is not"))
        return document
    try:
        if fault := _unsupported(yaml.parse(text, Loader=yaml.SafeLoader), what):
            document.faults.append(fault)
            return document
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or "it cannot be read"
        document.faults.append((mark.line + 1 if mark else 1, f"this is not YAML: {what}"))
        return document
    except yaml.YAMLError as error:
        document.faults.append((1, f"this is not YAML: {str(error).splitlines()[0]}"))
        return document
    if node is not None:
        document.value = _value(node, (), document)
    return document


def _unsupported(events: Iterable[yaml.Event], what: str) -> tuple[int, str] | None:
    """Find the first feature that such files do not need and that could make a short text mean much."""
    import yaml

    depth = 0
    for event in events:
        line = event.start_mark.line + 1 if event.start_mark else 1
        if isinstance(event, yaml.AliasEvent):
            return line, f"*{event.anchor} repeats another part; write it out, or in quotes if it is a text"
        if (tag := getattr(event, "tag", None)) is not None:
            return line, f"the tag {tag} means nothing here; leave it out"
        if isinstance(event, yaml.ScalarEvent) and any("\ud800" <= sign <= "\udfff" for sign in event.value):
            return line, f"{event.value[:40]!r} holds half a character; write it whole"
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            return line, f"it is nested more than {_DEEPEST} deep; {what} is not"
    return None


def _value(node: yaml.Node, place: Place, document: Document) -> Value:
    import yaml

    document.lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        return [_value(each, (*place, index), document) for index, each in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode):
        return _table(node, place, document)
    return _scalar(node.value) if isinstance(node, yaml.ScalarNode) and node.style is None else node.value


def _table(node: yaml.MappingNode, place: Place, document: Document) -> dict[str, Value]:
    import yaml

    table: dict[str, Value] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            document.faults.append((line, "a key is a list or a mapping; give a text"))
            continue
        key = key_node.value
        if key in table:
            what = f"the key {key[:60]!r} appears twice; the first is in line {document.lines[(*place, key)]}"
            document.faults.append((line, what))
            continue
        document.lines[(*place, key)] = line
        table[key] = _value(value_node, (*place, key), document)
    return table


def _scalar(text: str) -> Value:
    if text in _WORDS:
        return None
    if text in _TRUTHS:
        return _TRUTHS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _SPECIAL.fullmatch(text):
        return float(text.lower().replace(".", ""))
    return text
