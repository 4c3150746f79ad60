"""What is written into the scene: which objects have labels, what arrows say, and the banner above it all."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.robustness import standing_codes
from spatial_replay.annotate.scene.scene_template import Banner, CauseText
from spatial_replay.annotate.violations import EvaluatedResult, Violations
from spatial_replay.geometry.arrays import Floats, Integers, combined, equal_places
from spatial_replay.logs.schemas.Robustness_pb2 import (
    FAILS_SO_FAR,
    HOLDS_SO_FAR,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
)
from spatial_replay.palette import FAILING, HOLDING, NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.text import Instant


def labelled_objects(
    results: Sequence[EvaluatedResult],
    names: Sequence[str],
    is_present: NDArray[np.bool_],
    robustness: Floats,
) -> NDArray[np.bool_]:
    """Return (S, objects), which objects have their names beside them.

    Where a sample has very many, these are the ones that violate a specification there, the worst first, and
    then those that it names.
    """
    is_crowded = is_present.sum(axis=1) >= _CROWD
    if not is_crowded.any():
        return np.ones(is_present.shape, np.bool_)
    named = {each for result in results for own in result.requirements for each in own.objects}
    is_named = np.array([name in named for name in names], np.bool_)
    urgency = np.where(robustness < 0.0, robustness, np.where(is_named, 0.0, np.inf))
    urgency[~is_present] = np.inf
    rank = np.argsort(np.argsort(urgency, axis=1, kind="stable"), axis=1, kind="stable")
    is_chosen = (urgency < np.inf) & (rank < _MOST_LABELS)
    return np.asarray(np.where(is_crowded[:, None], is_chosen, True))


_CROWD: Final = 40
_MOST_LABELS: Final = 20
"""From so many objects on, not all have labels; the most that then have."""

_MOST_TITLES: Final = 3
_STANDING_WORDS: Final = MappingProxyType(
    {
        VIOLATED: ("violated", NEGATIVE),
        FAILS_SO_FAR: ("failing so far", FAILING),
        UNKNOWN: ("unknown", NEUTRAL),
        HOLDS_SO_FAR: ("holding so far", HOLDING),
        SATISFIED: ("satisfied", POSITIVE),
    }
)
"""How results stand, the worst first, each in words and as a colour."""


def banners_of(
    results: Sequence[EvaluatedResult], times_ns: Integers, place: tuple[float, float], first: int
) -> tuple[Integers, tuple[Banner | None, ...]]:
    """Return which of some banners (S,) each message has: all results that it evaluates, the worst first.

    Args:
        first: the first message that has any.
    """
    titled = [each for each in results if each.title]
    if not titled:
        return np.zeros(len(times_ns), np.int64), (None,)
    codes = np.zeros((len(times_ns), len(titled)), np.uint8)
    for column, result in enumerate(titled):
        own_ns = result.block.times_ns
        if not len(own_ns):
            continue
        at = np.minimum(np.searchsorted(own_ns, times_ns), len(own_ns) - 1)
        now = standing_codes(result.block.series[:1], final=result.is_final)[0, at]
        codes[:, column] = np.where((own_ns[at] == times_ns) | result.is_final, now, 0)
    codes[:first] = 0
    banners, which = list[Banner | None](), np.zeros(len(times_ns), np.int64)
    for places in equal_places(combined(codes.T, len(codes))):
        which[places] = len(banners)
        banners.append(_banner(titled, codes[places[0]], place))
    return which, tuple(banners)


def _banner(
    results: Sequence[EvaluatedResult], codes: NDArray[np.uint8], place: tuple[float, float]
) -> Banner | None:
    parts, colour, titles = [], None, [each.title for each in results]
    for code, (words, hue) in _STANDING_WORDS.items():
        of_code = [result for result, each in zip(results, codes.tolist(), strict=True) if each == code]
        if code == VIOLATED:  # the one that was so first comes first
            of_code.sort(key=lambda each: each.violated_ns)
        own = [each.title for each in of_code]
        if own:
            few = own if len(own) <= _MOST_TITLES else [*own[:_MOST_TITLES], "…"]
            parts.append(f"{len(own)} {words}: {', '.join(few)}" if len(titles) > 1 else f"{own[0]} {words}")
            colour = colour or hue
    return None if colour is None else Banner("; ".join(parts), colour, place)


class ArrowTexts(NamedTuple):
    """What the arrows of S messages say.

    Attributes:
        causes: what decides violations, in words.
        cause: (S,), which of them decides each that is shown.
        numbers: of each that is shown, the number with its unit; empty for the others.
    """

    causes: tuple[CauseText, ...]
    cause: Integers
    numbers: Sequence[bytes]

    def label(self, index: int) -> str:
        """Return all that an arrow that is shown says."""
        return f"{self.causes[self.cause[index]].text}{self.numbers[index].decode()}"


def arrow_texts(
    results: Sequence[EvaluatedResult], found: Violations, first_ns: int, unit: str
) -> ArrowTexts:
    """Return what decides violations, and their numbers.

    Args:
        first_ns: the time of the log's first sample.
        unit: of lengths.
    """
    shown = np.flatnonzero(found.is_shown)
    robustness = np.where(found.holds, -found.robustness, found.robustness)[shown].tolist()
    texts = [robustness_text(number, unit).encode() for number in robustness]
    words = -(-np.fromiter(map(len, texts), np.int64, len(texts)) // 8)
    of = found.result, found.leaf, found.holds, found.moment_ns, found.atom
    columns = [each[shown] for each in of]
    causes, cause = list[CauseText](), np.zeros(len(found.result), np.int64)
    for places in equal_places(combined([*columns, words], len(shown))):
        cause[shown[places]] = len(causes)
        result, leaf, holds, moment_ns, atom = (int(each[places[0]]) for each in columns)
        known = results[result].leaf_pairs if result >= 0 and leaf >= 0 else None
        text = found.atoms[atom] if atom >= 0 else "" if known is None else known.texts[leaf]
        text = text if len(text) <= _LONGEST_CAUSE else f"{text[: _LONGEST_CAUSE - 1]}…"
        at = "" if moment_ns < 0 else f" at {Instant(moment_ns, first_ns)}"
        causes.append(CauseText(f"{text}{at}: {'holds by ' if holds else ''}", int(words[places[0]])))
    numbers = [b""] * len(found.result)
    for index, number in zip(shown.tolist(), texts, strict=True):
        numbers[index] = number
    return ArrowTexts(tuple(causes), cause, numbers)


_LONGEST_CAUSE: Final = 60


def robustness_text(number: float, unit: str) -> str:
    """Return a number with three digits and its unit."""
    return f"{number:.3g} {unit}" if unit not in ("", "1") else f"{number:.3g}"
