"""The scene: objects and regions in the colours of their robustness, as messages of /spatial/scene.

The encoder also returns the content of the messages as values (`SceneFrames`), for pages with their own
drawings.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.scene.extent import VIEW, SceneExtent
from spatial_replay.annotate.scene.placing import Box, Surroundings, free_names, place_labels, place_names
from spatial_replay.annotate.scene.scene_frames import (
    ABSENT,
    DELETED,
    FIRST_FORM,
    Arrows,
    ArrowTexts,
    SceneContent,
    SceneFrames,
    arrow_texts,
    colours,
    failed_objects,
    labelled_objects,
    shade_codes,
)
from spatial_replay.annotate.scene.scene_template import (
    LEVELS,
    CauseText,
    Dashes,
    DrawnObject,
    Region,
    SceneLayout,
    SceneTemplate,
    boxes,
    dashes_of,
    encode_regions,
    encoded_stamps,
    extents,
    make_template,
    missing_words,
    numbers_of_witness,
    outlines_of,
    rings_of,
)
from spatial_replay.annotate.violations import (
    EvaluatedResult,
    Presence,
    Violations,
    first_violations,
    worst_robustness,
)
from spatial_replay.geometry.arrays import Floats, Integers, combined_code, equal_places
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.wire import Words, join_in_order, words_of
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.spec.formula import Outline, RegionName
from spatial_replay.trace.trace import Trace

LIFT: Final = 0.01
"""Height of flat objects above the plane, fraction of the scene's scale."""


class SceneNumbers:
    """The numbers of S messages with R drawn objects in total."""

    def __init__(
        self, times_ns: Integers, regions: Floats, objects: Floats, content: SceneContent, scale: float
    ) -> None:
        """Prepare the numbers from the content of the messages.

        Args:
            times_ns: (S,), times of the messages.
            regions: (S, regions, 3), colours of the regions.
            objects: (R, 3), colours of the drawn objects, message by message.
            content: content of the messages.
            scale: size of objects in the scene.
        """
        self._stamps = encoded_stamps(times_ns)
        self._regions = regions.reshape(len(times_ns), -1)
        self._content, self._scale = content, scale
        self._of_objects = [objects, content.middles]
        if any(form.has_height for form in content.rings.forms):
            top, bottom = content.footprints.top, content.footprints.bottom
            self._of_objects.append(np.stack([top, bottom, top - bottom, top + LIFT * scale], axis=-1))

    def of_messages(self, layout: SceneLayout, samples: Integers) -> Words:
        """Return (K, N), the numbers that fill a layout's template in K messages, each number once."""
        columns = [self._stamps[samples], self._regions[samples]]
        content, count = self._content, len(layout.objects)
        if count:
            # the drawn objects of a message are consecutive rows
            first = content.observations[samples, content.names.index(layout.objects[0].name)]
            corners = sum(sum(figure.form.rings) for figure in layout.objects)
            columns.append(_runs(content.rings.points, content.rings.start[first], corners))
            of_objects = self._of_objects[: 3 if layout.has_heights else 2]
            columns += [_runs(rows, first, count) for rows in of_objects]
        for name, length in layout.missing:
            rows = content.missing[samples, content.names.index(name)]
            columns.append(
                np.array([content.last.rows[row] for row in rows.tolist()]).reshape(-1, 2 * length)
            )
        if isinstance(layout.witness, CauseText):
            violations, witness = content.violations, layout.witness
            labels = witness.ends([content.numbers[index] for index in samples.tolist()])
            z = np.fmax(violations.top[samples], 0.0) + 3.0 * LIFT * self._scale
            spots = content.spots[samples, : len(layout.names)]
            at = violations.points[samples], z, spots, content.label[samples]
            columns += numbers_of_witness(*at, self._scale, labels, witness.words)
        return words_of(columns)


def _runs(rows: Floats, first: Integers, count: int) -> Floats:
    """Return runs of `count` consecutive rows (R, k), one run from each start (K,), as (K, count * k)."""
    return np.asarray(rows[first[:, None] + np.arange(count)].reshape(len(first), -1))


PERIOD_NS: Final = 20_000_000
"""Least time between two messages, nanoseconds; viewers warn of higher rates."""

_POINT: Final = 0.02
"""Radius of a point, fraction of the scene's scale."""

_UNSCALED: Final = 1.0
"""Scale before the first object, and scale of a scene of points, which have no size."""

_MOST_TEMPLATES: Final = 256
_MOST_SHADES: Final = 4_096
"""Limit of shades in one message, which has one per result and object or region."""
_LINE: Final = 0.05
"""Estimated line height, fraction of the scene's longer side."""


@dataclass(frozen=True, eq=False)
class SceneState:
    """The state after a message, on which the next message depends.

    Attributes:
        zero_ns: zero of times in texts; None before the first sample.
        written_ns: time of the last message; None before the first message.
        shown: objects in the last message.
        last: last footprint (batch, row) of each object that specifications name.
        is_pointing: whether the last message has an arrow at a violation.
        scale: robustness at which colours are full, None before any object is shown. It is the median size
            (longer side of the bounding box) of the objects in the first message with objects.
        extent: extent of the samples so far, which scales texts.
        templates: templates of the layouts so far; a cache that changes no message.
    """

    zero_ns: int | None = None
    written_ns: int | None = None
    shown: tuple[str, ...] = ()
    last: Mapping[str, tuple[FootprintBatch, int]] = field(default_factory=lambda: MappingProxyType({}))
    is_pointing: bool = False
    scale: float | None = None
    extent: SceneExtent = field(default_factory=SceneExtent)
    templates: Mapping[SceneLayout, SceneTemplate] = field(default_factory=lambda: MappingProxyType({}))


def scene_start(trace: Trace, regions: Mapping[str, Outline], zero_ns: int) -> SceneState:
    """Return the state before a run's first message, with its scale (see `SceneState`).

    Args:
        trace: samples of the run from the first one on.
        zero_ns: zero of times in texts.
    """
    rows = trace.rows[samples_to_write(trace.times_ns, None)]
    return SceneEncoder(regions).with_scale(SceneState(zero_ns), trace, rows)[0]


class SceneMessages(NamedTuple):
    """Encoded messages with their times (S,) int64, the state after them, and their content if any."""

    times_ns: Integers
    payloads: Sequence[bytes]
    state: SceneState
    frames: SceneFrames | None


class SceneEncoder:
    """Draws traces over the regions of a specification.

    Every message has all regions and all observed objects, so that a viewer can jump to any message. Objects
    that are gone are deleted. If a specification names a missing object, its last outline stays. An object or
    region has the colour of its worst requirement: blue holds, vermillion fails, grey is unknown (see
    `palette` and `requirements`). An arrow with its robustness points at the violation that was certain first
    (see `violations`).

    Attributes:
        unit: declared unit of lengths; "" if none is declared.
        named: objects that specifications name.
    """

    def __init__(
        self, regions: Mapping[str, Outline], unit: str = "", named: frozenset[str] = frozenset()
    ) -> None:
        self.unit, self.named = unit, named
        self._drawn = tuple(
            Region(name, outline, tuple(outlines_of(footprint_from_outline(outline))))
            for name, outline in sorted(regions.items(), key=itemgetter(0))
        )
        rings = [ring for region in self._drawn for ring in region.rings]
        self._corners = np.concatenate(rings) if rings else None
        self._encoded, self._unnamed = (encode_regions(self._drawn, named=named) for named in (True, False))

    def encode(
        self, trace: Trace, results: Sequence[EvaluatedResult] = (), state: SceneState | None = None
    ) -> SceneMessages:
        """Return the messages of the next samples, which do not depend on the cut into blocks.

        Args:
            trace: the next samples, after the samples of the state.
            results: results over these samples.
            state: state that the previous call returned; None to begin.
        """
        state = state or SceneState()
        if state.zero_ns is None and len(trace):
            state = replace(state, zero_ns=int(trace.times_ns[0]))
        sample_places = samples_to_write(trace.times_ns, state.written_ns)
        times_ns = trace.times_ns[sample_places]
        if not len(sample_places):
            return SceneMessages(times_ns, [], self.pass_over(trace, state), None)
        state, scales, first = self.with_scale(state, trace, trace.rows[sample_places])
        extent, corners, sizes = state.extent.grow(trace, self._corners)
        view = _View(corners[sample_places], _LINE * sizes[sample_places])
        state = replace(state, extent=extent)
        names = tuple(sorted({*trace.names, *state.shown, *state.last}))
        missing, state = self._missing(names, trace, state, sample_places, view.line)
        missing[0][:first] = -1
        scale = state.scale or _UNSCALED
        violations = first_violations(results, trace, sample_places)
        rows = _rows_of(names, trace, trace.rows[sample_places])
        presence = Presence(times_ns, names, _class_codes(trace, rows), trace.classes)
        objects, regions = worst_robustness(results, presence, [region.name for region in self._drawn])
        objects[missing[0] >= 0] = np.nan
        has_label = labelled_objects(self.named, names, rows >= 0, objects)
        labels = has_label, failed_objects(results, names, times_ns)
        arrows = arrow_texts(results, violations, state.zero_ns or 0, self.unit)
        regions_by_name = {region.name: np.concatenate(region.rings) for region in self._drawn}
        content = _content(
            trace, names, rows, state, violations, arrows, labels, missing, regions_by_name, view
        )
        shades = colours(objects, scales), colours(regions, scales)
        object_shades = shades[0].reshape(-1, 3) if (rows >= 0).all() else shades[0][rows >= 0]
        columns = SceneNumbers(times_ns, shades[1], object_shades, content, scale)
        templates = dict(state.templates)
        encoded = []
        for layout, samples in _by_layout(content):
            if layout not in templates:
                of_regions = self._unnamed if isinstance(layout.witness, CauseText) else self._encoded
                templates[layout] = make_template(layout, of_regions, LIFT * scale)
            encoded.append((samples, templates[layout].encode(columns.of_messages(layout, samples))))
        is_shown = (content.forms[-1] >= FIRST_FORM) | (content.missing[-1] >= 0)
        after = replace(
            state,
            written_ns=int(times_ns[-1]),
            shown=tuple(
                name for name, is_drawn in zip(content.names, is_shown.tolist(), strict=True) if is_drawn
            ),
            is_pointing=bool(content.violations.is_shown[-1]),
            templates=MappingProxyType(dict(list(templates.items())[-_MOST_TEMPLATES:])),
        )
        find_arrows = partial(_arrows_of, results, trace, sample_places, state.zero_ns or 0, self.unit)
        find_shades = partial(_shades_of, results, presence, [region.name for region in self._drawn], scales)
        frames = SceneFrames(
            times_ns, objects, regions, *shades, scale, content, self._drawn, find_arrows, find_shades
        )
        return SceneMessages(times_ns, join_in_order(encoded), after, frames)

    def pass_over(self, trace: Trace, state: SceneState) -> SceneState:
        """Return the state after more samples, without encoding messages."""
        state = replace(state, extent=state.extent.after(trace, self._corners))
        return self._missing(trace.names, trace, state, np.empty(0, np.int64), np.empty(0))[1]

    def _missing(
        self, names: tuple[str, ...], trace: Trace, state: SceneState, written: Integers, lines: Floats
    ) -> tuple[tuple[Integers, Dashes], SceneState]:
        """Return the last outlines of missing objects in S messages, and the state after the samples.

        The array (S, names) has the index of each missing object's outline, -1 for other objects.
        """
        last, outline_numbers = dict(state.last), np.full((len(written), len(names)), -1, np.int64)
        outlines, rows_of = list[tuple[Floats, ...]](), list[Floats]()
        line_heights, line = np.unique(lines, return_inverse=True)
        for name in sorted(self.named & {*trace.names, *last}):
            column = trace.names.index(name) if name in trace.names else None
            rows = np.full(len(trace), -1) if column is None else trace.rows[:, column]
            seen = np.maximum.accumulate(np.where(rows >= 0, np.arange(len(rows)), -1))
            last_seen = np.where(rows[written] < 0, seen[written], len(rows))
            keys = last_seen * len(line_heights) + line
            for key in np.unique(keys).tolist():
                at, height = divmod(key, len(line_heights))
                if at < len(rows) and (at >= 0 or name in last):
                    batch, row = last[name] if at < 0 else (trace.footprints, int(rows[at]))
                    outline_numbers[keys == key, names.index(name)] = len(outlines)
                    rings = rings_of(batch.select(np.array([row])), _POINT * (state.scale or _UNSCALED))
                    outlines.append(rings.rings_of(0))
                    places = np.concatenate(outlines[-1])
                    middle = (places[:, 0].min() + places[:, 0].max()) / 2.0
                    under = [[middle, places[:, 1].min() - 0.75 * line_heights[height]]]
                    rows_of.append(np.concatenate([dashes_of(outlines[-1]), under]))
            if len(seen) and seen[-1] >= 0:
                last[name] = trace.footprints, int(rows[seen[-1]])
        return (outline_numbers, Dashes(rows_of, outlines)), replace(state, last=MappingProxyType(last))

    def with_scale(self, state: SceneState, trace: Trace, rows: Integers) -> tuple[SceneState, Floats, int]:
        """Return the state with its scale, the scale (S, 1) of each message, and the first scaled message.

        The scale is set by the first message with an object.
        """
        if state.scale is not None:
            return state, np.full((len(rows), 1), state.scale), 0
        scales = np.full((len(rows), 1), _UNSCALED)
        is_shown = (rows >= 0).any(axis=1)
        if not is_shown.any():
            return state, scales, len(rows)
        first = int(is_shown.argmax())
        footprints = trace.footprints.select(rows[first][rows[first] >= 0])
        scale = float(np.median(extents(footprints))) or _UNSCALED
        scales[first:] = scale
        return replace(state, scale=scale), scales, first


class _View(NamedTuple):
    """The extents of S messages: low and high corners (S, 2, 2), and line heights (S,)."""

    corners: Floats
    line: Floats


def _arrows_of(
    results: Sequence[EvaluatedResult],
    trace: Trace,
    written: Integers,
    first_ns: int,
    unit: str,
    chosen: Integers,
) -> list[Arrows]:
    """Return the arrows of each result in some messages, found for each result alone."""
    arrows = []
    for number, result in enumerate(results):
        violations = first_violations([result], trace, written[chosen])
        arrows.append(Arrows(number, violations, arrow_texts([result], violations, first_ns, unit)))
    return arrows


def _shades_of(
    results: Sequence[EvaluatedResult],
    presence: Presence,
    regions: Sequence[str],
    scales: Floats,
    chosen: Integers,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return (K, objects, R) and (K, regions, R), shades in K messages by each of R results alone.

    R is 0 for a single result, whose shades equal the colours, and for more shades than `_MOST_SHADES`.
    """
    entities = len(presence.names) + len(regions)
    shaded = results if 1 < len(results) <= _MOST_SHADES // max(entities, 1) else ()
    part = presence._replace(times_ns=presence.times_ns[chosen], class_code=presence.class_code[chosen])
    of_objects = np.empty((len(chosen), len(presence.names), len(shaded)), np.uint8)
    of_regions = np.empty((len(chosen), len(regions), len(shaded)), np.uint8)
    for number, result in enumerate(shaded):
        objects, places = worst_robustness([result], part, regions)
        of_objects[:, :, number] = shade_codes(objects, scales[chosen])
        of_regions[:, :, number] = shade_codes(places, scales[chosen])
    return of_objects, of_regions


def samples_to_write(times_ns: Integers, written_ns: int | None) -> Integers:
    """Return the indices of the samples with a message, each at least `PERIOD_NS` after the previous one.

    Args:
        written_ns: time of the last message; None before the first message.
    """
    if not len(times_ns):
        return np.empty(0, np.int64)
    earliest = int(times_ns[0]) if written_ns is None else written_ns + PERIOD_NS
    if times_ns[0] >= earliest and (np.diff(times_ns) >= PERIOD_NS).all():
        return np.arange(len(times_ns))
    indices = []
    at = bisect_left(times_ns, earliest)
    while at < len(times_ns):
        indices.append(at)
        at = bisect_left(times_ns, int(times_ns[at]) + PERIOD_NS, at + 1)
    return np.array(indices, np.int64)


def _rows_of(names: Sequence[str], trace: Trace, rows: Integers) -> Integers:
    """Return (S, names), rows of the trace by `names`; below 0 where an object is absent."""
    of_all = np.full((len(rows), len(names)), -1, np.int64)
    of_all[:, list(map(set(trace.names).__contains__, names))] = rows
    return of_all


def _content(
    trace: Trace,
    names: tuple[str, ...],
    rows: Integers,
    last_state: SceneState,
    violations: Violations,
    arrows: ArrowTexts,
    label_flags: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    missing: tuple[Integers, Dashes],
    regions: Mapping[str, Floats],
    view: _View,
) -> SceneContent:
    is_present = rows >= 0
    is_drawn = is_present | (missing[0] >= 0)
    was_present = np.concatenate([np.isin([names], last_state.shown), is_drawn[:-1]])
    footprints = trace.footprints.select(rows[is_present])
    rings = rings_of(footprints, _POINT * (last_state.scale or _UNSCALED))
    observations = np.full(rows.shape, -1, np.int64)
    observations[is_present] = np.arange(len(footprints))
    forms = np.where(was_present & (missing[0] < 0), DELETED, ABSENT)
    forms[is_present] = FIRST_FORM + rings.form
    styles = np.full(rows.shape, -1, np.int64)
    low, high = boxes(rings.points, rings.start)
    sizes = extents(footprints) if rings.has_round else np.maximum(*(high - low).T)
    has_label, failed = (flags[is_present] for flags in label_flags)
    styles[is_present] = 4 * _levels(sizes, last_state.scale or _UNSCALED) + 2 * failed + (has_label | failed)
    was_pointing = np.append(last_state.is_pointing, violations.is_shown[:-1])
    arrow = np.where(violations.is_shown, FIRST_FORM + arrows.cause, np.where(was_pointing, DELETED, ABSENT))
    name_lengths = np.broadcast_to(list(map(len, names)), rows.shape)[is_present]
    arrow_messages = np.flatnonzero(violations.is_shown)
    boxes_of_objects = _boxes_of(observations, low, high)
    is_named = (label_flags[0] | label_flags[1]) & is_present & ~violations.is_shown[:, None]
    object_name_centres = _name_places(low, high, name_lengths, np.repeat(view.line, is_present.sum(axis=1)))
    text_lengths = np.array([len(name) + 2 for name in names], np.float64)
    named_observations = np.where(is_named, observations, -1)
    object_name_centres = _free_places(
        object_name_centres,
        text_lengths,
        named_observations,
        is_named & label_flags[1],
        boxes_of_objects,
        view,
    )
    boxes_of_objects = boxes_of_objects[0][..., arrow_messages], boxes_of_objects[1][..., arrow_messages]
    deciding_boxes = _deciding_boxes(names, violations, arrows, boxes_of_objects, missing, regions)
    name_centres, label_centres = np.zeros((len(rows), 2, 2)), np.full((len(rows), 2), np.nan)
    arrow_view = _View(view.corners[arrow_messages], view.line[arrow_messages])
    label_lengths = np.array([len(cause.text) + cause.length for cause in arrows.causes], np.float64)
    label_lengths = label_lengths[arrows.cause[arrow_messages]] if len(arrow_messages) else np.empty(0)
    name_centres[arrow_messages], label_centres[arrow_messages] = _places(
        deciding_boxes, label_lengths, boxes_of_objects, arrow_view
    )
    return SceneContent(
        names,
        rows,
        forms,
        styles,
        *missing,
        observations,
        footprints,
        rings,
        object_name_centres,
        violations,
        label_centres,
        arrow,
        arrows.causes,
        arrows.numbers,
        name_centres,
    )


_ARROW_BOX, _THEN_BOX, _BLOCKED = 2, 3, 6
"""Indices of the boxes of the arrow and of earlier outlines among the blocked boxes, and count of these.

The boxes of the objects come first, and the boxes of names last."""


class _DecidingBoxes(NamedTuple):
    """Arguments of `place_names` for the names at the arrows of K messages."""

    low: Floats
    high: Floats
    letters: Floats
    blocked: Box


def _deciding_boxes(
    names: Sequence[str],
    found: Violations,
    arrows: ArrowTexts,
    boxes_of_objects: Box,
    missing: tuple[Integers, Dashes],
    regions: Mapping[str, Floats],
) -> _DecidingBoxes:
    """Return the boxes of the deciding objects and regions, and the boxes that texts must not cover.

    Args:
        boxes_of_objects: boxes in the messages with an arrow, in the order of `names`.
    """
    messages = np.flatnonzero(found.is_shown)
    ends = found.points[messages].transpose(1, 2, 0)
    named = np.full((2, 2, 2, len(messages)), np.nan)
    blocked = np.full((2, _BLOCKED, 2, len(messages)), np.nan)
    letters = np.zeros((2, len(messages)))
    lasts = [_box(np.concatenate(rings)) for rings in missing[1].rings]
    for cause in np.unique(arrows.cause[messages]).tolist():
        is_cause = arrows.cause[messages] == cause
        places = slice(None) if is_cause.all() else np.flatnonzero(is_cause)
        text = arrows.causes[cause]
        if text.dashes:
            blocked[:, _THEN_BOX][..., places] = _box(np.reshape(text.dashes, (-1, 2)))[..., None]
        for side, name in enumerate(text.names):
            letters[side, places] = len(name.name) + 2
            if isinstance(name, RegionName):
                if name.name in regions:
                    named[:, side][..., places] = _box(regions[name.name])[..., None]
                continue
            if name.name not in names:
                continue
            column = names.index(name.name)
            for corner, of_objects in zip(blocked, boxes_of_objects, strict=True):
                corner[side][:, places] = of_objects[column][:, places]
            last = missing[0][messages, column]
            for place in np.flatnonzero(is_cause & (last >= 0)).tolist():
                blocked[:, side][..., place] = lasts[last[place]]
                letters[side, place] = len(missing_words(name.name))
            named[:, side][..., places] = blocked[:, side][..., places]
    blocked[0, _ARROW_BOX] = np.minimum(ends[0], ends[1])
    blocked[1, _ARROW_BOX] = np.maximum(ends[0], ends[1])
    # the name of an object without a box is at the end of the arrow
    low, high = np.where(np.isnan(named), ends, named)
    return _DecidingBoxes(low, high, letters, (blocked[0], blocked[1]))


def _box(points: Floats) -> Floats:
    """Return the low and the high corner of points (n, 2), as (2, 2)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _boxes_of(observations: Integers, low: Floats, high: Floats) -> Box:
    """Return the boxes (N, 2, K) of the objects in K messages; NaN for absent objects."""
    places = observations.T
    if not len(low):
        nowhere = np.full((len(places), 2, places.shape[1]), np.nan)
        return nowhere, nowhere
    columns = [np.where(places < 0, np.nan, column[places]) for column in (*low.T, *high.T)]
    return np.stack(columns[:2], axis=1), np.stack(columns[2:], axis=1)


def _places(deciding: _DecidingBoxes, letters: Floats, others: Box, view: _View) -> tuple[Floats, Floats]:
    """Return the centres of the names (K, 2, 2) and of the label (K, 2) of an arrow.

    Args:
        letters: (K,), lengths of labels.
        others: boxes of all objects.
        view: view of these messages.
    """
    around = _surroundings(deciding.blocked, others, view)
    spots = place_names(deciding.low, deciding.high, deciding.letters, around)
    arrow = deciding.blocked[0][_ARROW_BOX], deciding.blocked[1][_ARROW_BOX]
    return spots.transpose(2, 0, 1), place_labels(letters, arrow, around).T


def _surroundings(blocked: Box, others: Box, view: _View) -> Surroundings:
    low, high = view.corners.transpose(1, 2, 0)
    return Surroundings(blocked, others, (low, high), VIEW / 2.0 * (high - low).max(axis=0), view.line)


def _free_places(
    middles: Floats,
    letters: Floats,
    observations: Integers,
    movable: NDArray[np.bool_],
    boxes_of_objects: Box,
    view: _View,
) -> Floats:
    """Return the centres of names (R, 2). A name that covers another object moves to a free side, if any.

    Args:
        letters: (N,), lengths of names.
        observations: (S, N), rows of objects with names; -1 for other objects.
        movable: (S, N), whether each name may move.
    """
    if not movable.any():
        return middles
    is_named = observations.T >= 0
    usual = np.where(is_named, middles.T[:, observations.T], np.nan).swapaxes(0, 1)
    nothing = np.empty((0, 2, len(observations))), np.empty((0, 2, len(observations)))
    around = _surroundings(nothing, boxes_of_objects, view)
    free = free_names(usual, letters, movable.T, boxes_of_objects, around)
    moved = middles.copy()
    moved[observations.T[is_named]] = free.swapaxes(0, 1)[:, is_named].T
    return moved


def _name_places(low: Floats, high: Floats, letters: Integers, line: Floats) -> Floats:
    """Return (R, 2), the centres of names: in the middle of large objects, below small ones."""
    # half the sum of the corners, unlike a mean of points, does not depend on the order of summation
    places = (low + high) / 2.0
    sides = high - low
    is_small = (sides[:, 1] < 1.5 * line) | (sides[:, 0] < 0.5 * line * letters)
    places[:, 1] = np.where(is_small, low[:, 1] - 0.75 * line, places[:, 1])
    return places


def _levels(sizes: Floats, scale: float) -> Integers:
    """Return the level of each size: half the size has the next level. An unknown size has level 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        levels = np.round(LEVELS / 2.0 - np.log2(sizes / scale))
    # fmax takes the 0 where the level is NaN
    return np.fmin(np.fmax(levels, 0.0), LEVELS).astype(np.int64)


def _class_codes(trace: Trace, rows: Integers) -> Integers:
    codes = np.full(rows.shape, -1, np.int64)
    codes[rows >= 0] = trace.class_code[rows[rows >= 0]]
    return codes


def _by_layout(content: SceneContent) -> Iterator[tuple[SceneLayout, Integers]]:
    """Yield the layouts, each with the indices of its messages."""
    lengths = np.array([*map(len, content.last.rows), -1])[content.missing]
    keys = [*content.forms.T, *content.styles.T, *lengths.T, content.arrow]
    for samples in equal_places(combined_code(keys, len(content.arrow))):
        yield _layout(content, int(samples[0])), samples


def _layout(content: SceneContent, message: int) -> SceneLayout:
    arrow = int(content.arrow[message])
    is_pointing = arrow >= FIRST_FORM
    of_objects = content.forms[message].tolist(), content.styles[message].tolist()
    entries: list[tuple[str, int, int]] = list(zip(content.names, *of_objects, strict=True))
    figures = tuple(
        DrawnObject(
            name,
            content.rings.forms[form - FIRST_FORM],
            style >> 2,
            "" if is_pointing else _label(name, style),
        )
        for name, form, style in entries
        if form >= FIRST_FORM
    )
    deleted = tuple(name for name, form, _ in entries if form == DELETED)
    last = zip(content.names, content.missing[message].tolist(), strict=True)
    missing = tuple((name, len(content.last.rows[row])) for name, row in last if row >= 0)
    cause: CauseText | Literal["deleted"] | None = None
    if arrow != ABSENT:
        cause = "deleted" if arrow == DELETED else content.causes[arrow - FIRST_FORM]
    words = {name: _label(name, style | 1) for name, _, style in entries if style >= 0}
    words |= {name: missing_words(name) for name, _ in missing}
    beside = cause.names if isinstance(cause, CauseText) else ()
    names = [
        base.name if isinstance(base, RegionName) else words.get(base.name, base.name) for base in beside
    ]
    return SceneLayout(deleted, figures, missing, cause, tuple(names))


def _label(name: str, style: int) -> str:
    return f"{name} ✕" if style & 2 else name if style & 1 else ""
