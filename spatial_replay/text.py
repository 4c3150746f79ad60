"""Text for people: counts, sentences with times, numbers in JSON, printable text, suggestions for names."""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from datetime import UTC, datetime
from functools import partial, wraps
from inspect import signature
from reprlib import repr as shortened
from typing import Any, Final, TypeVar, cast

from spatial_replay.errors import UsageError

_Called = TypeVar("_Called", bound=Callable[..., Any])

_LONGEST: Final = 300
"""Length limit of a printable text, characters."""
_LONGEST_FORMULA: Final = 60
# comparisons of names take quadratic time, and names in logs may be hostile
_LONGEST_NAME: Final = 100
_MOST_NAMES: Final = 2_000
_MOST_ALIKE: Final = 5


def is_encodable(text: str) -> bool:
    """Return whether UTF-8 can encode a text. UTF-8 cannot encode half of a surrogate pair."""
    return text.isascii() or not any("\ud800" <= character <= "\udfff" for character in text)


def encodable(text: str) -> str:
    """Return a text that UTF-8 can encode, with escapes for the invalid bytes of a file name."""
    return text.encode("utf-8", "backslashreplace").decode()


@dataclass(frozen=True, slots=True)
class Instant:
    """A time in a sentence, printed in seconds since `first_ns`."""

    time_ns: int
    first_ns: int

    def __str__(self) -> str:
        # adding 0.0 removes the sign of a time that rounds to -0.0
        return f"{round((self.time_ns - self.first_ns) / 1e9, 3) + 0.0:.3f} s"


class Sentence(str):
    """A sentence with its times as values, for links on pages.

    Attributes:
        parts: texts and times of the sentence, in order.
    """

    __slots__ = ("parts",)
    parts: tuple[str | Instant, ...]

    def __new__(cls, *parts: str | Instant) -> Sentence:
        sentence = super().__new__(cls, "".join(map(str, parts)))
        # a part may be a clause with times
        sentence.parts = tuple(
            piece for part in parts for piece in (part.parts if isinstance(part, Sentence) else (part,))
        )
        return sentence


CALENDAR_NS: Final = 500_000_000 * 10**9
"""Least time that is measured from 1970, ns. Smaller times come from clocks that start at power-on."""


def clock_text(time_ns: int, *, with_date: bool = False) -> str:
    """Return a time as in viewers: "19:25:04.500 UTC", or seconds on the log's own clock."""
    if time_ns < CALENDAR_NS:
        return f"{time_ns / 1e9:.3f} s on the log's clock"
    # rounded before the split, because rounding may change the seconds
    milliseconds = round(time_ns / 10**6)
    moment = datetime.fromtimestamp(milliseconds // 1000, UTC)
    day = f"{moment:%Y-%m-%d} " if with_date else ""
    return f"{day}{moment:%H:%M:%S}.{milliseconds % 1000:03} UTC"


def counted_from(texts: Iterable[str], first_ns: int) -> tuple[Sentence, ...]:
    """Return texts as sentences. Times in sentences count from `first_ns`."""
    return tuple(
        Sentence(
            *(Instant(part.time_ns, first_ns) if isinstance(part, Instant) else part for part in text.parts)
        )
        if isinstance(text, Sentence)
        else Sentence(text)
        for text in texts
    )


_CODE_OR_NUMBER = re.compile(r"(`[^`]*`)|\d[\d.,]*")
_FEW: Final = 3


def without_numbers(text: str) -> str:
    """Return a text with 0 for each number outside of code, for comparisons without numbers."""
    return _CODE_OR_NUMBER.sub(lambda match: match[1] or "0", text)


def without_repetition(texts: Iterable[str]) -> list[str]:
    """Return texts. More than `_FEW` texts that differ only in numbers become one text with a count."""
    texts_by_form: dict[str, list[str]] = {}
    for text in texts:
        texts_by_form.setdefault(without_numbers(text), []).append(text)
    return [
        text
        for group in texts_by_form.values()
        for text in (group if len(group) <= _FEW else [f"{group[0]} (and {len(group) - 1:,} more like it)"])
    ]


def plural(count: int, noun: str) -> str:
    """Return a count with its noun: "1 sample", "1,579 samples"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


DIGITS: Final = 4
"""Number of significant digits in texts."""
LARGEST_PLAIN: Final = 1e12
"""Limit from which numbers in texts have an exponent."""


def number_text(number: float) -> str:
    """Return a number with four digits, for readers. JSON and logs have all digits."""
    # adding 0.0 removes the sign of -0.0
    number += 0.0
    # from half below on, numbers round to five digits, which `g` would write as 1e+04
    is_long = 10.0**DIGITS - 0.5 <= abs(number) < LARGEST_PLAIN
    return f"{number:.0f}" if is_long else f"{number:.{DIGITS}g}"


def with_unit(number: float, unit: str) -> str:
    """Return a number with its unit: "0.05 m". Infinity and numbers of unit "1" are without a unit."""
    if names := names_from_unit(unit):
        name_texts = [f" ({json.dumps(name, ensure_ascii=False)})" for name in names if names[name] == number]
        return number_text(number) + "".join(name_texts[:1])
    return number_text(number) if unit in ("", "1") or math.isinf(number) else f"{number_text(number)} {unit}"


def interval_text(robustness: float, lower: float, upper: float, unit: str = "") -> str:
    """Return a robustness with its unit. An interval of uncertainty is added: "between -inf and -0.2 m"."""
    robustness_text = "not determined" if math.isnan(robustness) else with_unit(robustness, unit)
    if math.isnan(lower) or lower == upper == robustness:
        return robustness_text
    interval = f"between {with_unit(lower, unit)} and {with_unit(upper, unit)}"
    return interval if math.isnan(robustness) else f"{robustness_text}, {interval}"


def names_from_unit(unit: str) -> dict[str, float]:
    """Return the numbers by name in a JSON object that replaces a unit. A plain unit has no names."""
    try:
        return {name: float(number) for name, number in json.loads(unit).items()} if unit[:1] == "{" else {}
    except (ValueError, TypeError, OverflowError, RecursionError):
        return {}


def plain_unit(unit: str) -> str:
    """Return a plain unit; "" for names of numbers instead of a unit."""
    return "" if names_from_unit(unit) else unit


def json_number(number: float) -> float | str | None:
    """Return a number as valid JSON: infinities become the strings "inf" and "-inf", NaN becomes null."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "inf" if number > 0 else "-inf"
    return number


def json_value(value: Any) -> Any:
    """Return a value as valid JSON: numbers as in `json_number`, and records as objects of their fields."""
    if isinstance(value, float):
        return json_number(value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): json_value(element) for key, element in value.items()}
    if is_dataclass(value) or hasattr(value, "_fields"):
        return json_fields(value)
    return [json_value(element) for element in value] if isinstance(value, tuple | list) else value


def json_fields(record: Any, *names: str) -> dict[str, Any]:
    """Return attributes of a record for JSON, all fields by default. Keys are names without "is_"."""
    keys = names or getattr(record, "_fields", None) or [field.name for field in fields(record)]
    return {key.removeprefix("is_"): json_value(getattr(record, key)) for key in keys}


def printable(text: str, longest: int = _LONGEST) -> str:
    """Return a text with blanks instead of unprintable characters, cut to a length."""
    return cut("".join(character if character.isprintable() else " " for character in text), longest)


def cut(text: str, longest: int) -> str:
    """Return a text of bounded length. A cut text ends with an ellipsis."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def listing(names: Sequence[str], most: int = 8) -> str:
    """Return the first names, with an ellipsis for further names."""
    return ", ".join([*names[:most], *["…"] * (len(names) > most)])


def first_lines(lines: Sequence[str], most: int) -> list[str]:
    """Return the first lines, and a line with the number of further lines."""
    count_line = [f"… and {len(lines) - most:,} more"] if len(lines) > most else []
    return [*lines[:most], *count_line]


def escape_text(text: str, kept: str = "") -> str:
    """Return a text with escapes such as `\\x1b` for unprintable characters, except those in `kept`."""
    if text.isprintable():
        return text
    return "".join(
        character
        if character.isprintable() or character in kept
        else character.encode("unicode_escape").decode()
        for character in text
    )


def shortened_formula(text: str) -> str:
    """Return a short text of a formula, for sentences that only mention the formula."""
    return printable(text, _LONGEST_FORMULA)


def time_text(time_ns: int, first_ns: int = 0) -> str:
    """Return the time since `first_ns`, or a duration, in the form of all texts: "5.533 s"."""
    return str(Instant(time_ns, first_ns))


def times_apart(*times_ns: int) -> tuple[Sentence, ...]:
    """Return times in seconds, and also in nanoseconds if different times have equal texts."""
    times = tuple(Sentence(Instant(time_ns, 0)) for time_ns in times_ns)
    if len(set(times)) == len(set(map(int, times_ns))):
        return times
    return tuple(Sentence(time, f" ({time_ns} ns)") for time, time_ns in zip(times, times_ns, strict=True))


def requirement_text(identifier: str | None, title: str | None) -> str:
    """Return the id and the title of a requirement: "REQ-12: no one is hit". Either may be missing."""
    return ": ".join(part for part in (identifier, title) if part)


def names_of(title: str, requirement: str | None) -> tuple[str, ...]:
    """Return the names of a result or node: its title, and three forms with the id of its requirement."""
    ids = () if requirement is None else (requirement, f"{requirement} {title}", f"{title} [{requirement}]")
    return title, *ids


TEXTS: Final = -(2.0**1000)
"""Greatest number that represents a text in signals. Measured numbers are far from this range."""


def text_number(text: str) -> float:
    """Return the number that represents a text in signals: 48 bits of the text's digest."""
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=6).digest()
    # 48 bits are exact in a double, whose fraction has 52
    return TEXTS * (1.0 + int.from_bytes(digest, "little") / 2**48)


def is_text_number(number: float) -> bool:
    """Return whether a number represents a text."""
    return -math.inf < number <= TEXTS


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """Return "did you mean …?" with the known name closest to `name`; "" if no name is close."""
    if len(name) > _LONGEST_NAME:
        return ""
    candidates = [candidate for candidate in known if len(candidate) <= _LONGEST_NAME][:_MOST_NAMES]
    equal_names = [candidate for candidate in candidates if candidate.casefold() == name.casefold()]
    close_names = equal_names or difflib.get_close_matches(name, candidates, n=_MOST_ALIKE)
    return f"did you mean {max(close_names, key=partial(_likeness, name))!r}?" if close_names else ""


def named_arguments(called: _Called) -> _Called:
    """Return a function or class that refuses unknown arguments, and suggests the nearest name.

    Raises:
        UsageError: a call has an unknown argument.
    """
    function = called.__init__ if isinstance(called, type) else called  # type: ignore[misc]

    @wraps(function)
    def checked_call(*positionals: Any, **keywords: Any) -> Any:
        try:
            return function(*positionals, **keywords)
        except TypeError:
            # a TypeError with another cause is raised again
            refuse_unknown(keywords, [name for name in signature(called).parameters if name != "cls"])
            raise

    if not isinstance(called, type):
        return cast("_Called", checked_call)
    setattr(called, "__init__", checked_call)  # noqa: B010
    return called


def refuse_unknown(given: Mapping[str, object], known: Collection[str]) -> None:
    """Refuse arguments with an unknown name.

    Raises:
        UsageError: a name is unknown. The message suggests the nearest name.
    """
    for name in given:
        if name not in known:
            remedy = nearest_hint(name, known) or f"there are {', '.join(known)}"
            raise UsageError(f"{name}={shortened(given[name])} is no argument; {remedy}")


def _likeness(name: str, known: str) -> tuple[float, float]:
    """Return the likeness of two names and of their sorted letters. Sorting finds swapped letters."""
    ratio = difflib.SequenceMatcher(None, known, name).ratio()
    return ratio, difflib.SequenceMatcher(None, sorted(known), sorted(name)).ratio()
