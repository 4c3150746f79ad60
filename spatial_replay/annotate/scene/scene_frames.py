"""Frames of the scene as values for pages with their own drawings, and the colours of the scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spatial_replay import palette
from spatial_replay.annotate.deciding_leaf import SettledViolation
from spatial_replay.annotate.scene.scene_template import (
    OBJECT,
    REGION,
    CauseText,
    Dashes,
    Region,
    Rings,
    border_of,
    dashes_of,
    rings_of,
)
from spatial_replay.annotate.violations import EvaluatedResult, Violations
from spatial_replay.geometry.arrays import Floats, Integers, combined_code, equal_places
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.schemas.Robustness_pb2 import HOLDS_SO_FAR, PENDING, SATISFIED, UNKNOWN, VIOLATED
from spatial_replay.palette import HOLDING, MAP, NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.spec.formula import RegionName, TrackedName
from spatial_replay.text import Instant, cut, with_unit


def failed_objects(
    results: Sequence[EvaluatedResult], names: Sequence[str], times_ns: Integers
) -> NDArray[np.bool_]:
    """Return (S, objects), whether an atom that settled a violation so far names the object."""
    has_failed = np.zeros((len(times_ns), len(names)), np.bool_)
    for settled in [result.settled for result in results if result.settled is not None]:
        for name in settled.objects:
            if name in names:
                has_failed[times_ns >= settled.time_ns, names.index(name)] = True
    return has_failed


def labelled_objects(
    named: frozenset[str], names: Sequence[str], is_present: NDArray[np.bool_], robustness: Floats
) -> NDArray[np.bool_]:
    """Return (S, objects), whether each object has a label.

    In a crowded sample, at most `_MOST_LABELS` objects have labels. Objects that violate a specification
    come first, from the worst on. Objects that a specification names follow.

    Args:
        named: objects that specifications name.
    """
    is_crowded = is_present.sum(axis=1) >= _CROWD
    if not is_crowded.any():
        return np.ones(is_present.shape, np.bool_)
    is_named = np.array([name in named for name in names], np.bool_)
    urgency = np.where(robustness < 0.0, robustness, np.where(is_named, 0.0, np.inf))
    urgency[~is_present] = np.inf
    # sorting the order gives the rank of each object
    ranks = np.argsort(np.argsort(urgency, axis=1, kind="stable"), axis=1, kind="stable")
    is_chosen = (urgency < np.inf) & (ranks < _MOST_LABELS)
    return np.asarray(np.where(is_crowded[:, None], is_chosen, True))


_CROWD: Final = 20
_MOST_LABELS: Final = 20
"""Number of objects that makes a sample crowded, and limit of labels in a crowded sample."""

STANDING_WORDS: Final = MappingProxyType(
    {
        VIOLATED: ("violated", NEGATIVE),
        PENDING: ("pending", palette.PENDING),
        UNKNOWN: ("unknown", NEUTRAL),
        HOLDS_SO_FAR: ("holds so far", HOLDING),
        SATISFIED: ("satisfied", POSITIVE),
    }
)
"""Words and colour of each standing, the worst first."""


class ArrowTexts(NamedTuple):
    """Arrows of S messages.

    Attributes:
        causes: distinct causes of violations, in words.
        cause: (S,), index of each arrow's cause.
        numbers: robustness at each arrow with its unit, as text; empty for messages without an arrow.
    """

    causes: tuple[CauseText, ...]
    cause: Integers
    numbers: Sequence[bytes]

    def label(self, index: int) -> str:
        """Return the whole label of an arrow."""
        return f"{self.causes[self.cause[index]].text}{self.numbers[index].decode()}"


def arrow_texts(
    results: Sequence[EvaluatedResult], found: Violations, first_ns: int, unit: str
) -> ArrowTexts:
    """Return the causes of violations in words, with the robustness at each arrow.

    Args:
        first_ns: zero of times in texts.
        unit: unit of lengths.
    """
    arrow_messages = np.flatnonzero(found.is_shown)
    robustness = np.where(found.holds, -found.robustness, found.robustness)[arrow_messages].tolist()
    number_texts = [with_unit(number, unit).encode() for number in robustness]
    text_lengths = np.fromiter(map(len, number_texts), np.int64, len(number_texts))
    violation_columns = found.result, found.leaf, found.holds, found.moment_ns, found.atom
    columns = [column[arrow_messages] for column in violation_columns]
    causes, cause_indices = list[CauseText](), np.zeros(len(found.result), np.int64)
    for arrow_indices in equal_places(combined_code([*columns, text_lengths], len(arrow_messages))):
        cause_indices[arrow_messages[arrow_indices]] = len(causes)
        result, leaf, holds, moment_ns, atom = (int(column[arrow_indices[0]]) for column in columns)
        pairs = results[result].leaf_pairs if result >= 0 and leaf >= 0 else None
        text, pair = ("", None) if pairs is None else (pairs.texts[leaf], pairs.pairs[leaf])
        if atom >= 0:
            text, pair = found.atoms[atom]
        time_text = " now" if moment_ns < 0 else f" at {Instant(moment_ns, first_ns)}"
        cause_text = f"{cut(text, _LONGEST_CAUSE)}{time_text}: {'must not hold, holds by ' if holds else ''}"
        dashes = () if moment_ns < 0 else _outlines_then(results[result].settled)
        names = () if pair is None else pair.names
        causes.append(CauseText(cause_text, int(text_lengths[arrow_indices[0]]), dashes, names))
    encoded_numbers = [b""] * len(found.result)
    for index, number in zip(arrow_messages.tolist(), number_texts, strict=True):
        encoded_numbers[index] = number
    return ArrowTexts(tuple(causes), cause_indices, encoded_numbers)


def _outlines_then(settled: SettledViolation | None) -> tuple[float, ...]:
    """Return the dashed outlines of the objects in the sample that settled a violation, x and y in turn."""
    if settled is None or settled.sample is None:
        return ()
    sample = settled.sample
    rows = sample.rows[0, [sample.names.index(name) for name in settled.objects]]
    rings = rings_of(sample.footprints.select(rows[rows >= 0]), 0.0)
    outlines = [ring for index in range(int((rows >= 0).sum())) for ring in rings.rings_of(index)]
    return tuple(dashes_of(outlines).reshape(-1).tolist()) if outlines else ()


_LONGEST_CAUSE: Final = 60


_LEAST: Final = 0.4
"""Share of the full colour at the slightest robustness, so that the sign is visible."""

_FROM_GREY: Final = np.subtract((NEGATIVE, POSITIVE), NEUTRAL)
_FROM_GREY.flags.writeable = False
"""Difference of full colours from grey."""

_OPACITY: Final = 0.6
"""Opacity of a map's cells, so that the scene above them stays visible."""


_MAP_PLACES: Final = tuple(np.linspace(-1.0, 1.0, len(MAP)).tolist())
_MAP_COLOURS: Final = tuple(zip(*(bytes.fromhex(colour[1:]) for colour in MAP), strict=True))
"""Positions of a map's colours, -1 (worst) to 1 (best), and the red, green and blue of these colours."""


def colours(robustness: ArrayLike, scale: ArrayLike) -> Floats:
    """Return the colours (..., 3) of robustness (...): full at `scale`, grey where NaN.

    Args:
        scale: positive, in the unit of the robustness; a number, or an array that broadcasts with it.
    """
    values = np.asarray(robustness, np.float64)
    shares = _LEAST + (1.0 - _LEAST) * np.minimum(np.abs(values) / scale, 1.0)
    shares = np.where(np.isnan(values), 0.0, shares)
    mixed_colours = _FROM_GREY[(values >= 0.0).astype(np.intp)] * shares[..., None] + NEUTRAL
    # rounded to 8 bits: finer steps are invisible and compress badly
    return np.asarray(np.round(mixed_colours * 255.0) / 255.0)


def shade_codes(robustness: Floats, scale: ArrayLike) -> NDArray[np.uint8]:
    """Return the index into `SHADES` for each robustness (...), with the same colour as by `colours`."""
    share = np.minimum(np.abs(np.nan_to_num(robustness)), scale) / np.asarray(scale)
    codes = np.where(robustness >= 0.0, 128.0 + np.round(127.0 * share), 127.0 - np.round(126.0 * share))
    return np.where(np.isnan(robustness), 0.0, codes).astype(np.uint8)


def cell_colours(robustness: Floats) -> NDArray[np.uint8]:
    """Return the colours (..., 4) of cells (...) on a map that is white at 0, transparent where NaN."""
    largest = float(np.abs(robustness[np.isfinite(robustness)]).max(initial=0.0)) or 1.0
    map_positions = np.clip(np.nan_to_num(robustness) / largest, -1.0, 1.0)
    shares = [np.interp(map_positions, _MAP_PLACES, column) for column in _MAP_COLOURS]
    opacity = np.where(np.isnan(robustness), 0.0, 255.0 * _OPACITY)
    return np.asarray(np.round(np.stack([*shares, opacity], axis=-1)), np.uint8)


def _shades() -> NDArray[np.uint8]:
    codes = np.arange(256.0)
    # 1e-9 keeps code 127 negative, so that its colour is vermillion
    robustness = np.where(codes < 128.0, (codes - 127.0) / 126.0 - 1e-9, (codes - 128.0) / 127.0)
    robustness[0] = np.nan
    return np.asarray(np.round(255.0 * colours(robustness, 1.0)), np.uint8)


SHADES: Final = _shades()
"""(256, 3), red, green and blue by code of `shade_codes`."""
SHADES.flags.writeable = False

ABSENT, DELETED, FIRST_FORM = -1, 0, 1
"""Code of an object in a message: absent, deleted, or `FIRST_FORM` plus the index of its form."""


class DrawnEntity(NamedTuple):
    """An object or a region in one message.

    Attributes:
        rings: outlines, (n, 2) each.
        colour: red, green and blue, 0 to 255.
        shades: index into `SHADES` for each result, the entity's colour by that result alone. Empty for a
            single result, and for very many results.
        is_last: whether the object is missing, so that `rings` are its last outlines.
    """

    rings: tuple[Floats, ...]
    colour: tuple[int, int, int]
    shades: bytes = b""
    is_last: bool = False


class DrawnViolation(NamedTuple):
    """The arrow at the first violation of a result in one message.

    Attributes:
        ends: (2, 2), begin and end of the arrow.
        label: text at the arrow: the deciding atom and its robustness.
        result: index of the violated result.
        node: id of the violated requirement, or of the atom that settled the violation.
        robustness: robustness of the requirement or of the settling atom, times its sign.
        leaf: index of the deciding leaf in the result's program.
        moment_ns: time of the earlier sample that has this robustness; None if the message's own sample
            has this robustness.
        holds: whether the atom holds but must not.
        atom: deciding atom of a quantifier with its objects; "" for other leaves.
        dashes: outlines at an earlier sample, see `CauseText`.
        names: ids of the atom's entities.
    """

    ends: Floats
    label: str
    result: int
    node: int
    robustness: float
    leaf: int = -1
    moment_ns: int | None = None
    holds: bool = False
    atom: str = ""
    dashes: tuple[float, ...] = ()
    names: tuple[str, ...] = ()


def entity_ids(names: Iterable[TrackedName | RegionName]) -> tuple[str, ...]:
    """Return the ids of the entities for objects and regions."""
    return tuple((REGION if isinstance(name, RegionName) else OBJECT) + name.name for name in names)


class Arrows(NamedTuple):
    """The arrows of one result in S messages.

    Attributes:
        result: index of the result.
        violations: violations in the S samples.
        texts: cause and number of each violation.
    """

    result: int
    violations: Violations
    texts: ArrowTexts

    def at(self, index: int) -> DrawnViolation | None:
        """Return the arrow in a message, or None."""
        violations = self.violations
        if not violations.is_shown[index]:
            return None
        robustness, holds = float(violations.robustness[index]), bool(violations.holds[index])
        label = self.texts.label(index)
        moment_ns = int(violations.moment_ns[index]) if violations.moment_ns[index] >= 0 else None
        node, leaf, atom = (
            int(column[index]) for column in (violations.node, violations.leaf, violations.atom)
        )
        violation_fields = (
            self.result,
            node,
            robustness,
            leaf,
            moment_ns,
            holds,
            violations.atoms[atom].text if atom >= 0 else "",
        )
        cause = self.texts.causes[self.texts.cause[index]]
        return DrawnViolation(
            violations.points[index], label, *violation_fields, cause.dashes, entity_ids(cause.names)
        )


class SceneFrame(NamedTuple):
    """Content of one message.

    Attributes:
        entities: entities by id.
        arrows: arrows of each result in the chosen messages.
        place: index of this message among the chosen messages.
    """

    entities: Mapping[str, DrawnEntity]
    arrows: Sequence[Arrows] = ()
    place: int = 0

    def violation(self, result: int) -> DrawnViolation | None:
        """Return the arrow of a result in this message, or None."""
        return self.arrows[result].at(self.place)

    @property
    def corners(self) -> int:
        """The number of corners of all outlines."""
        return sum(len(ring) for entity in self.entities.values() for ring in entity.rings)


@dataclass(frozen=True, eq=False)
class SceneFrames:
    """Content of S messages.

    Attributes:
        times_ns: (S,) int64, times of the messages.
        objects, regions: (S, objects) and (S, regions), worst robustness of their requirements.
        object_colours, region_colours: (S, objects, 3) and (S, regions, 3), red, green and blue, 0 to 1.
        scale: robustness at which colours are full.
        chosen: (K,) int64, indices of the messages with frames, in order; None for all messages.
    """

    times_ns: Integers
    objects: Floats
    regions: Floats
    object_colours: Floats
    region_colours: Floats
    scale: float
    _content: SceneContent
    _regions: tuple[Region, ...]
    _find_arrows: Callable[[Integers], Sequence[Arrows]]
    _find_shades: Callable[[Integers], tuple[NDArray[np.uint8], NDArray[np.uint8]]]
    chosen: Integers | None = None

    @cached_property
    def _details(self) -> tuple[Integers, Sequence[Arrows], NDArray[np.uint8], NDArray[np.uint8]]:
        """The chosen messages, their arrows, and the shades of their objects and regions by result."""
        messages = np.arange(len(self.times_ns)) if self.chosen is None else self.chosen
        return messages, self._find_arrows(messages), *self._find_shades(messages)

    def frame(self, index: int) -> SceneFrame:
        """Return the content of a chosen message."""
        messages, arrows, object_shades, region_shades = self._details
        chosen_index = int(np.searchsorted(messages, index))
        entities = {
            REGION + region.name: DrawnEntity(tuple(border_of(region)), _bytes(colour), shades.tobytes())
            for region, colour, shades in zip(
                self._regions, self.region_colours[index], region_shades[chosen_index], strict=True
            )
        }
        content = self._content
        for column, name in enumerate(content.names):
            outline_index = int(content.missing[index, column])
            if content.forms[index, column] < FIRST_FORM and outline_index < 0:
                continue
            observation = int(content.observations[index, column])
            rings = (
                content.last.rings[outline_index]
                if outline_index >= 0
                else content.rings.rings_of(observation)
            )
            colour = _bytes(self.object_colours[index, column])
            result_shades = object_shades[chosen_index, column].tobytes()
            entities[OBJECT + name] = DrawnEntity(rings, colour, result_shades, outline_index >= 0)
        return SceneFrame(entities, arrows, chosen_index)


class SceneContent(NamedTuple):
    """Columns of S messages.

    Attributes:
        names: objects in these messages, in the previous message, or with a last outline.
        rows: (S, names), rows of the trace; below 0 where an object is absent.
        forms: (S, names), `ABSENT`, `DELETED`, or `FIRST_FORM` plus the index of the object's form.
        styles: (S, names), -1 where an object is absent. Bit 0: has a label. Bit 1: has violated a result.
            Higher bits: level.
        missing: (S, names), index in `last` of a missing object's outline; else -1.
        last: last outlines of missing objects.
        observations: (S, names), rows of `rings`, `footprints` and `middles`.
        middles: (R, 2), centres of names.
        violations: violations in the S samples.
        label: (S, 2), centre of the arrow's label.
        arrow: (S,), `ABSENT`, `DELETED`, or `FIRST_FORM` plus the index of the arrow's cause in `causes`.
        causes: distinct causes of violations, in words.
        numbers: robustness at each arrow with its unit, as text.
        spots: (S, 2, 2), centres of the names at an arrow.
    """

    names: tuple[str, ...]
    rows: Integers
    forms: Integers
    styles: Integers
    missing: Integers
    last: Dashes
    observations: Integers
    footprints: FootprintBatch
    rings: Rings
    middles: Floats
    violations: Violations
    label: Floats
    arrow: Integers
    causes: tuple[CauseText, ...]
    numbers: Sequence[bytes]
    spots: Floats


def _bytes(colour: Floats) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * share) for share in colour.tolist())
    return red, green, blue
