"""Options for reading a log, and the list of faults that reading reports."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from os import PathLike, fspath
from reprlib import repr as shortened
from typing import Final, Literal, TypedDict, cast, get_args

from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.text import named_arguments
from spatial_replay.trace.trace import LATEST_NS

Lost = Literal["drop", "keep"]
"""Handling of rows that are marked as out of the picture."""

OnTimeJump = Literal["error", "split"]
"""Handling of a clock that jumps back, such as after a restart of a simulation: error, or end of the log."""

FASTEST_RATE = 10**9
"""Highest frame rate, Hz: above it, two frames would share a nanosecond."""

_CHOICES = {"lost": get_args(Lost), "on_time_jump": get_args(OnTimeJump), "concave": get_args(Concave)}


class Reading(TypedDict, total=False):
    """Options for reading a log, as keyword arguments; see `ReadOptions`."""

    mapping: str | PathLike[str] | None
    concave: Concave
    on_time_jump: OnTimeJump
    rate: float | None
    lost: Lost
    y_down: bool | None
    max_lateness: str
    max_gap: str | None


KEYS: Final = tuple(key for key in Reading.__annotations__ if key != "mapping")
"""Read options in suites and metadata, where `mapping` is a separate key."""


@named_arguments
@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options for reading a log; the defaults fit every log.

    Attributes:
        concave: how polygons that are not convex are handled: "decompose" or "hull".
        mapping: path of a mapping file, which assigns topics of an external log to objects.
        on_time_jump: "error", or "split" to end an external log where its clock jumps back.
        rate: frames per second of annotations whose times are frame numbers; 30 by default.
        lost: whether to "drop" or "keep" annotations that are marked as out of the picture.
        y_down: whether y points down in a file of tracks or annotations, as in images; samples have y up. By
            default, y points down in drone annotations, and up in all other files.
        max_lateness: largest lateness of messages in an external log, such as "2s"; "all" sorts the whole log
            in memory.
        max_gap: longest pause, such as "1s". Objects are unknown in a longer pause of the samples, and in a
            longer pause of the object's topic.

    Raises:
        UsageError: an invalid value.
    """

    concave: Concave = "decompose"
    mapping: str | PathLike[str] | None = None
    on_time_jump: OnTimeJump = "error"
    rate: float | None = None
    lost: Lost = "drop"
    y_down: bool | None = None
    max_lateness: str = "1s"
    max_gap: str | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise UsageError(f"{name} is {shortened(value)}; give one of {', '.join(choices)}")
        if self.mapping is not None and not isinstance(self.mapping, (str, PathLike)):
            raise UsageError(f"mapping is {shortened(self.mapping)}; give the path of a mapping file")
        if self.y_down not in (None, True, False):
            raise UsageError(f"y_down is {shortened(self.y_down)}; give True, False or None")
        late_ns(self.max_lateness)
        gap_ns(self.max_gap)
        if self.rate is not None:
            _check_rate(self.rate)

    def non_defaults(self) -> dict[str, object]:
        """Return the options that differ from their defaults, except `concave`, which all formats accept."""
        return {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name != "concave" and getattr(self, field.name) != field.default
        }

    def refuse_except(self, accepted: frozenset[str], kind: str, log: str) -> None:
        """Refuse options that do not apply to a format.

        Raises:
            UsageError: an option that is not in `accepted` differs from its default.
        """
        for name, value in self.non_defaults().items():
            if name not in accepted:
                value_text = fspath(cast("PathLike[str]", value)) if name == "mapping" else value
                raise UsageError(
                    f"{_option(name, value_text)} does not apply to {log} ({kind}): {_REASONS[name]}; leave"
                    " it out"
                )


_LATENESS = re.compile(r"(\d{1,9}(?:\.\d{1,9})?)(ms|s)", re.ASCII)


def late_ns(text: object) -> int:
    """Parse a largest lateness, such as "2s", "500ms" or "all", to nanoseconds.

    Raises:
        UsageError: any other text.
    """
    lateness_ns = LATEST_NS if text == "all" else _nanoseconds(text)
    if lateness_ns is None:
        raise UsageError(f"max_lateness is {shortened(text)}; give a duration such as 2s or 500ms, or all")
    return lateness_ns


def gap_ns(text: object) -> int | None:
    """Parse a longest pause, such as "2s" or "500ms", to nanoseconds; None for no limit.

    Raises:
        UsageError: any other text, or 0.
    """
    pause_ns = _nanoseconds(text)
    if text is not None and not pause_ns:
        raise UsageError(f"max_gap is {shortened(text)}; give a duration above 0, such as 2s or 500ms")
    return pause_ns


def _nanoseconds(text: object) -> int | None:
    match = _LATENESS.fullmatch(text) if isinstance(text, str) else None
    return int(Fraction(match[1]) * (10**9 if match[2] == "s" else 10**6)) if match else None


DEFAULTS: Final = ReadOptions()

_REASONS = {
    "mapping": "it names its objects itself",
    "on_time_jump": "its times never go back",
    "max_lateness": "its times never go back",
    "max_gap": "it has no samples",
    "rate": "it has times, not numbers of frames",
    "lost": "it has no rows marked as lost",
    "y_down": (
        "recordings and scenarios have y up, and so have messages unless their mapping file says"
        " `axes: {y: down}`"
    ),
}


def _option(name: str, value: object) -> str:
    """Return an option as written on the command line and in Python."""
    if name == "mapping":
        return f"--mapping {value} (mapping={value!r})"
    return f"--read {name}={str(value).lower()} ({name}={value!r})"


def _check_rate(rate: object) -> None:
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate <= FASTEST_RATE:
        raise UsageError(
            f"rate is {shortened(rate)}; give frames a second, above 0 and at most {FASTEST_RATE}"
        )


def frame_times(rate: float) -> Fraction:
    """Return the exact frame period in nanoseconds. The rate is exact as written: 29.97 is 2997/100."""
    return Fraction(10**9) / Fraction(repr(float(rate)))


MOST_FAULTS = 100
"""Number of faults of one log that are reported one by one; later faults are only counted."""
_NUMBER: Final = re.compile(r"\d[\d.,]*")
_FURTHER: Final = "something else"

_MORE = re.compile(r"… and (\d+) more faults? of")


def count_of(faults: Sequence[str]) -> int:
    """Return the number of faults; the last line may stand for several further faults."""
    more_match = _MORE.match(faults[-1]) if faults else None
    return len(faults) + (int(more_match[1]) - 1 if more_match else 0)


class FaultList:
    """Faults in the order of discovery; `take` returns each fault once."""

    def __init__(self) -> None:
        self._fault_count = 0
        self._moved_count = 0
        self._pending: list[str] = []

    def __len__(self) -> int:
        return self._fault_count

    def add(self, fault: str) -> None:
        """Add a fault with its place."""
        self._fault_count += 1
        if self._fault_count <= MOST_FAULTS:
            self._pending.append(fault)

    def move_to(self, target: FaultList) -> None:
        """Move pending faults to `target`; the number of faults beyond the limit moves, too."""
        for fault in self.take():
            target.add(fault)
        excess = max(0, self._fault_count - MOST_FAULTS)
        target._fault_count += excess - self._moved_count
        self._moved_count = excess

    def take(self, *, last: bool = False) -> tuple[str, ...]:
        """Return the faults since the last call. With `last`, add a line on the faults beyond the limit."""
        faults, self._pending = self._pending, []
        if last and self._fault_count > MOST_FAULTS:
            excess = self._fault_count - MOST_FAULTS
            faults.append(f"… and {excess} more fault{'s' if excess > 1 else ''} of this kind or another")
        return tuple(faults)


class FaultKinds(FaultList):
    """Faults of a live run. The first fault of each kind is reported; repetitions are counted until the end.

    Two faults are of one kind if their topics are equal and their texts differ only in numbers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._first_by_kind: dict[str, str] = {}
        self._repeat_counts: Counter[str] = Counter()

    def add(self, fault: str) -> None:
        """Add a fault with its place."""
        place, separator, fault_text = str(fault).partition(" at ")
        kind = f"{place}{separator}{_NUMBER.sub('0', fault_text)}"
        if kind in self._first_by_kind:
            self._repeat_counts[kind] += 1
        elif len(self._first_by_kind) < MOST_FAULTS:
            self._first_by_kind[kind] = str(fault)
            super().add(fault)
        else:
            self._repeat_counts[_FURTHER] += 1

    def take(self, *, last: bool = False) -> tuple[str, ...]:
        """Return the first fault of each new kind. With `last`, add a count of repetitions for each kind."""
        faults = super().take()
        if not last:
            return faults
        repeat_counts, self._repeat_counts = self._repeat_counts, Counter()
        repeat_lines = (
            f"… and {count:,} more like this: {self._first_by_kind.get(kind, kind)}"
            for kind, count in repeat_counts.items()
        )
        return (*faults, *repeat_lines)
