"""When a recorder writes a clip: the conditions of its trigger, as texts and as functions of updates."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.monitor.monitor import Update
from spatial_replay.spec.formula import Specification, iter_nodes
from spatial_replay.text import nearest_hint

MOST_BYTES: Final = 256 * 2**20
"""The most bytes that a ring holds by default."""

EVENT: Final = "event"
"""The condition that any event fulfils."""

MANUAL: Final = "manual"
"""The condition that nothing fulfils: such a trigger fires by hand."""

_VERDICTS: Final = ("violated", "satisfied")
_BELOW: Final = re.compile(r"(?P<name>.+?)\s*<=?\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)$")

Condition: TypeAlias = Callable[[Sequence[Update], bool], str | None]


@dataclass(frozen=True, slots=True)
class Trigger:
    """When a recorder writes a clip, and how much of what it holds.

    Attributes:
        when: "violated" or "satisfied" for any spec, "NAME violated" for one; "NAME < 0.2" when its
            robustness falls below a number; "event" for any change of a verdict, or of a sign that lasts;
            "manual" for `Recorder.trigger` alone, which always fires. Several are given as a sequence.
            Names are checked by the recorder, which has the specifications.
        before_s, after_s: how much time is kept, on the clock of the samples.
        most_bytes: how much memory the ring takes; when that does not hold `before_s`, it is reported.
    """

    when: str | Sequence[str] = "violated"
    before_s: float = 10.0
    after_s: float = 5.0
    most_bytes: int = MOST_BYTES

    def __post_init__(self) -> None:
        for name in ("before_s", "after_s"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value >= 0):
                raise UsageError(f"{name} is {value!r}; give seconds, 0 or more")
        if self.most_bytes < 2**20:
            raise UsageError(f"most_bytes is {self.most_bytes}; a ring takes 1 MB (1048576) or more")
        for text in self.texts:
            _refuse_unknown(text)

    @property
    def texts(self) -> list[str]:
        """Its conditions; one is enough."""
        return [each.strip() for each in ([self.when] if isinstance(self.when, str) else self.when)]


def condition_of(text: str, files: Sequence[Specification]) -> Condition:
    """Return a function of the updates with a sample that says why a trigger holds, or None.

    Raises:
        UsageError: it is none, or names no spec.
    """
    words = text.strip()
    if words == MANUAL:
        return lambda updates, has_changed: None
    if words == EVENT:
        return lambda updates, has_changed: EVENT if has_changed else None
    names = {
        node.name
        for file in files
        for spec in file.results
        for _, _, node in iter_nodes(spec.formula)
        if node.name is not None
    } | {spec.name for file in files for spec in file.results}
    if not files:
        raise UsageError(f"the trigger {text!r} waits for a spec, but there is none; give a specification")
    if words in _VERDICTS:
        return lambda updates, _: next(
            (
                f"{spec.spec.name} {words}"
                for update in updates
                for spec in update.specs
                if str(spec.verdict) == words
            ),
            None,
        )
    name, _, verdict = words.rpartition(" ")
    if verdict in _VERDICTS:
        name = _known(name.strip(), names, text)
        return lambda updates, _: f"{name} {verdict}" if _verdict(updates, name) == verdict else None
    if (found := _BELOW.match(words)) is not None:
        with suppress(ValueError):
            number = float(found["number"])
            name = _known(found["name"], names, text)
            return lambda updates, _: f"{name} below {number:g}" if _value(updates, name) < number else None
    raise _not_understood(text)


def _refuse_unknown(text: str) -> None:
    """Check what can be checked of a condition before its specifications are there."""
    name, _, verdict = text.rpartition(" ")
    if text in (*_VERDICTS, EVENT, MANUAL) or (name and verdict in _VERDICTS):
        return
    with suppress(ValueError, TypeError):
        float(_BELOW.match(text)["number"])  # type: ignore[index]
        return
    raise _not_understood(text)


def _not_understood(text: str) -> UsageError:
    hint = nearest_hint(text, [*_VERDICTS, EVENT, MANUAL])
    return UsageError(
        f"the trigger {text!r} is not understood; {f'{hint}; ' if hint else ''}write 'violated',"
        " 'NAME violated', 'NAME satisfied', 'NAME < 0.2', 'event' or 'manual'"
    )


def _known(name: str, names: set[str], text: str) -> str:
    if name not in names:
        hint = nearest_hint(name, names) or f"the specs are {', '.join(sorted(names))}"
        raise UsageError(f"the trigger {text!r} names no spec: {name!r}; {hint}")
    return name


def _verdict(updates: Sequence[Update], name: str) -> str:
    for update in updates:
        for spec in update.specs:
            if spec.spec.name == name:
                return str(spec.verdict)
        if name in update.places and update.specs[update.places[name][0]].numbers is not None:
            return str(update.node(name).verdict)
    return ""


def _value(updates: Sequence[Update], name: str) -> float:
    for update in updates:
        for spec in update.specs:
            if spec.spec.name == name and spec.numbers is not None:
                return float(spec.numbers[0, 0])
        if name in update.places and update.specs[update.places[name][0]].numbers is not None:
            return float(update.node(name).value)
    return math.nan
