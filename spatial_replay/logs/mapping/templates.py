"""Names by template: `tag{id}`, `{ns|topic}_{id}`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from spatial_replay.errors import UsageError
from spatial_replay.logs.mapping.paths import PATTERN, Path

INDEX = "index"
TOPIC = "topic"

_ALTERNATIVES = rf"{PATTERN}(\|{PATTERN})*"
TEMPLATE_PATTERN = rf"([^{{}}]|\{{{_ALTERNATIVES}\}})+"
"""What a template looks like, as a regular expression."""

_PART = re.compile(r"\{([^{}]*)\}|([^{}]+)", re.ASCII)
_TEMPLATE = re.compile(TEMPLATE_PATTERN, re.ASCII)
_DROPPED_ENDS = frozenset(
    {"pose", "odom", "odometry", "state", "position", "location", "polygon", "footprint"}
)


@dataclass(frozen=True, slots=True)
class Template:
    """Literal text and fields in turn.

    Attributes:
        parts: a text, or the fields of which the first that is there and not empty is taken; the word `index`
            stands for an object's place in its list, `topic` for its topic, where no field is called so.
    """

    text: str
    parts: tuple[str | tuple[Path, ...], ...]

    @classmethod
    def of(cls, text: str) -> Template:
        """
        Raises:
            UsageError: the text is no template.
        """
        if not _TEMPLATE.fullmatch(text):
            raise UsageError(
                f"{text[:80]!r} is no name; write text with fields in braces: tag{{id}}, {{ns}}_{{id}}"
            )
        parts: list[str | tuple[Path, ...]] = []
        for found in _PART.finditer(text):
            fields, literal = found.groups()
            parts.append(literal if fields is None else tuple(Path.of(each) for each in fields.split("|")))
        return cls(text, tuple(parts))

    @property
    def is_constant(self) -> bool:
        """Whether every object gets the same name."""
        return all(isinstance(part, str) for part in self.parts)


def name_from_topic(topic: str) -> str:
    """What an object is called after its topic: `/turtle1/pose` → turtle1, `/pose` → pose."""
    words = [word for word in topic.split("/") if word]
    if len(words) > 1 and words[-1].lower() in _DROPPED_ENDS:
        words.pop()
    return "_".join(words) or "object"
