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
        self._region_colours = regions.reshape(len(times_ns), -1)
        self._content, self._scale = content, scale
        self._object_columns = [objects, content.middles]
        if any(form.has_height for form in content.rings.forms):
            top, bottom = content.footprints.top, content.footprints.bottom
            self._object_columns.append(np.stack([top, bottom, top - bottom, top + LIFT * scale], axis=-1))

    def of_messages(self, layout: SceneLayout, samples: Integers) -> Words:
        """Return (K, N), a template's numbers in K messages, in the order of `make_template`."""
        columns = [self._stamps[samples], self._region_colours[samples]]
        content, object_count = self._content, len(layout.objects)
        if object_count:
            # the drawn objects of a message are consecutive rows
            first_rows = content.observations[samples, content.names.index(layout.objects[0].name)]
            corner_count = sum(sum(figure.form.rings) for figure in layout.objects)
            columns.append(_runs(content.rings.points, content.rings.start[first_rows], corner_count))
            object_columns = self._object_columns[: 3 if layout.has_heights else 2]
            columns += [_runs(column, first_rows, object_count) for column in object_columns]
        for name, length in layout.missing:
            outlines = content.missing[samples, content.names.index(name)]
            columns.append(
                np.array([content.last.rows[outline] for outline in outlines.tolist()]).reshape(
                    -1, 2 * length
                )
            )
        if isinstance(layout.witness, CauseText):
            violations, witness = content.violations, layout.witness
            columns += numbers_of_witness(
                violations.points[samples],
                np.fmax(violations.top[samples], 0.0) + 3.0 * LIFT * self._scale,
                content.spots[samples, : len(layout.names)],
                content.label[samples],
                self._scale,
                witness.ends([content.numbers[index] for index in samples.tolist()]),
                witness.words,
            )
        return words_of(columns)


def _runs(rows: Floats, first_rows: Integers, count: int) -> Floats:
    """Return runs of `count` consecutive rows (R, k), one run from each start (K,), as (K, count * k)."""
    return np.asarray(rows[first_rows[:, None] + np.arange(count)].reshape(len(first_rows), -1))


PERIOD_NS: Final = 20_000_000
"""Least time between two messages, nanoseconds; viewers warn of higher rates."""

_POINT: Final = 0.02
"""Radius of a point, fraction of the scene's scale."""

_UNSCALED: Final = 1.0
"""Scale before the first object, and scale of a scene of points, which have no size."""

_MOST_TEMPLATES: Final = 256
_MOST_SHADES: Final = 4_096
"""Limit of shades in one message; each result has one shade per object or region."""
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
        scale: robustness at which colours are full, None before any object is shown. The scale is the
            median size (longer side of the bounding box) of the objects in the first message with objects.
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
    """Return the state before a run's first message, with the scale (see `SceneState`).

    Args:
        trace: samples of the run, from the first sample on.
        zero_ns: zero of times in texts.
    """
    rows = trace.rows[samples_to_write(trace.times_ns, None)]
    return SceneEncoder(regions).with_scale(SceneState(zero_ns), trace, rows)[0]


class SceneMessages(NamedTuple):
    """Encoded messages.

    Attributes:
        times_ns: (S,) int64, times of the messages.
        state: state after the messages.
        frames: content of the messages; None if there is no message.
    """

    times_ns: Integers
    payloads: Sequence[bytes]
    state: SceneState
    frames: SceneFrames | None


class SceneEncoder:
    """Draws traces over the regions of a specification.

    Every message has all regions and all observed objects, so that a viewer can jump to any message. Objects
    that are gone are deleted. If a specification names a missing object, its last outline stays. An object or
    region has the colour of its worst requirement: blue holds, vermillion fails, grey is unknown (see
    `palette` and `requirements`). An arrow with a robustness points at the violation that was certain first
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
        written_samples = samples_to_write(trace.times_ns, state.written_ns)
        times_ns = trace.times_ns[written_samples]
        if not len(written_samples):
            return SceneMessages(times_ns, [], self.pass_over(trace, state), None)
        state, scales, first_shown = self.with_scale(state, trace, trace.rows[written_samples])
        extent, corners, sizes = state.extent.grow(trace, self._corners)
        view = _View(corners[written_samples], _LINE * sizes[written_samples])
        state = replace(state, extent=extent)
        names = tuple(sorted({*trace.names, *state.shown, *state.last}))
        missing, state = self._missing(names, trace, state, written_samples, view.line)
        missing[0][:first_shown] = -1
        scale = state.scale or _UNSCALED
        violations = first_violations(results, trace, written_samples)
        rows = _rows_of(names, trace, trace.rows[written_samples])
        presence = Presence(times_ns, names, _class_codes(trace, rows), trace.classes)
        object_robustness, region_robustness = worst_robustness(
            results, presence, [region.name for region in self._drawn]
        )
        object_robustness[missing[0] >= 0] = np.nan
        has_label = labelled_objects(self.named, names, rows >= 0, object_robustness)
        label_flags = has_label, failed_objects(results, names, times_ns)
        arrows = arrow_texts(results, violations, state.zero_ns or 0, self.unit)
        regions_by_name = {region.name: np.concatenate(region.rings) for region in self._drawn}
        content = _content(
            trace, names, rows, state, violations, arrows, label_flags, missing, regions_by_name, view
        )
        entity_colours = colours(object_robustness, scales), colours(region_robustness, scales)
        object_colours = (
            entity_colours[0].reshape(-1, 3) if (rows >= 0).all() else entity_colours[0][rows >= 0]
        )
        numbers = SceneNumbers(times_ns, entity_colours[1], object_colours, content, scale)
        templates = dict(state.templates)
        indices_and_payloads = []
        for layout, message_indices in _by_layout(content):
            if layout not in templates:
                encoded_regions = self._unnamed if isinstance(layout.witness, CauseText) else self._encoded
                templates[layout] = make_template(layout, encoded_regions, LIFT * scale)
            indices_and_payloads.append(
                (message_indices, templates[layout].encode(numbers.of_messages(layout, message_indices)))
            )
        is_shown = (content.forms[-1] >= FIRST_FORM) | (content.missing[-1] >= 0)
        new_state = replace(
            state,
            written_ns=int(times_ns[-1]),
            shown=tuple(
                name for name, is_drawn in zip(content.names, is_shown.tolist(), strict=True) if is_drawn
            ),
            is_pointing=bool(content.violations.is_shown[-1]),
            templates=MappingProxyType(dict(list(templates.items())[-_MOST_TEMPLATES:])),
        )
        find_arrows = partial(_arrows_of, results, trace, written_samples, state.zero_ns or 0, self.unit)
        find_shades = partial(_shades_of, results, presence, [region.name for region in self._drawn], scales)
        frames = SceneFrames(
            times_ns,
            object_robustness,
            region_robustness,
            *entity_colours,
            scale,
            content,
            self._drawn,
            find_arrows,
            find_shades,
        )
        return SceneMessages(times_ns, join_in_order(indices_and_payloads), new_state, frames)

    def pass_over(self, trace: Trace, state: SceneState) -> SceneState:
        """Return the state after more samples, without encoding messages."""
        state = replace(state, extent=state.extent.after(trace, self._corners))
        return self._missing(trace.names, trace, state, np.empty(0, np.int64), np.empty(0))[1]

    def _missing(
        self,
        names: tuple[str, ...],
        trace: Trace,
        state: SceneState,
        written_samples: Integers,
        line_heights: Floats,
    ) -> tuple[tuple[Integers, Dashes], SceneState]:
        """Return the last outlines of missing objects in S messages, and the state after the samples.

        The array (S, names) has the index of each missing object's outline, -1 for other objects.
        """
        last_footprints = dict(state.last)
        outline_numbers = np.full((len(written_samples), len(names)), -1, np.int64)
        outlines, outline_rows = list[tuple[Floats, ...]](), list[Floats]()
        distinct_heights, height_indices = np.unique(line_heights, return_inverse=True)
        for name in sorted(self.named & {*trace.names, *last_footprints}):
            column = trace.names.index(name) if name in trace.names else None
            footprint_rows = np.full(len(trace), -1) if column is None else trace.rows[:, column]
            seen_samples = np.maximum.accumulate(
                np.where(footprint_rows >= 0, np.arange(len(footprint_rows)), -1)
            )
            last_seen_samples = np.where(
                footprint_rows[written_samples] < 0, seen_samples[written_samples], len(footprint_rows)
            )
            outline_keys = last_seen_samples * len(distinct_heights) + height_indices
            for key in np.unique(outline_keys).tolist():
                sample, height_index = divmod(key, len(distinct_heights))
                if sample < len(footprint_rows) and (sample >= 0 or name in last_footprints):
                    batch, row = (
                        last_footprints[name]
                        if sample < 0
                        else (trace.footprints, int(footprint_rows[sample]))
                    )
                    outline_numbers[outline_keys == key, names.index(name)] = len(outlines)
                    rings = rings_of(batch.select(np.array([row])), _POINT * (state.scale or _UNSCALED))
                    outlines.append(rings.rings_of(0))
                    corners = np.concatenate(outlines[-1])
                    middle_x = (corners[:, 0].min() + corners[:, 0].max()) / 2.0
                    name_position = [[middle_x, corners[:, 1].min() - 0.75 * distinct_heights[height_index]]]
                    outline_rows.append(np.concatenate([dashes_of(outlines[-1]), name_position]))
            if len(seen_samples) and seen_samples[-1] >= 0:
                last_footprints[name] = trace.footprints, int(footprint_rows[seen_samples[-1]])
        return (outline_numbers, Dashes(outline_rows, outlines)), replace(
            state, last=MappingProxyType(last_footprints)
        )

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
        first_shown = int(is_shown.argmax())
        footprints = trace.footprints.select(rows[first_shown][rows[first_shown] >= 0])
        scale = float(np.median(extents(footprints))) or _UNSCALED
        scales[first_shown:] = scale
        return replace(state, scale=scale), scales, first_shown


class _View(NamedTuple):
    """The extents of S messages: low and high corners (S, 2, 2), and line heights (S,)."""

    corners: Floats
    line: Floats


def _arrows_of(
    results: Sequence[EvaluatedResult],
    trace: Trace,
    written_samples: Integers,
    first_ns: int,
    unit: str,
    message_indices: Integers,
) -> list[Arrows]:
    """Return the arrows of each result in some messages, found for each result alone."""
    arrows = []
    for result_index, result in enumerate(results):
        violations = first_violations([result], trace, written_samples[message_indices])
        arrows.append(Arrows(result_index, violations, arrow_texts([result], violations, first_ns, unit)))
    return arrows


def _shades_of(
    results: Sequence[EvaluatedResult],
    presence: Presence,
    regions: Sequence[str],
    scales: Floats,
    message_indices: Integers,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return (K, objects, R) and (K, regions, R), shades in K messages by each of R results alone.

    R is 0 for a single result, whose shades equal the colours, and for more shades than `_MOST_SHADES`.
    """
    entity_count = len(presence.names) + len(regions)
    shaded_results = results if 1 < len(results) <= _MOST_SHADES // max(entity_count, 1) else ()
    part_presence = presence._replace(
        times_ns=presence.times_ns[message_indices], class_code=presence.class_code[message_indices]
    )
    object_shades = np.empty((len(message_indices), len(presence.names), len(shaded_results)), np.uint8)
    region_shades = np.empty((len(message_indices), len(regions), len(shaded_results)), np.uint8)
    for result_index, result in enumerate(shaded_results):
        object_robustness, region_robustness = worst_robustness([result], part_presence, regions)
        object_shades[:, :, result_index] = shade_codes(object_robustness, scales[message_indices])
        region_shades[:, :, result_index] = shade_codes(region_robustness, scales[message_indices])
    return object_shades, region_shades


def samples_to_write(times_ns: Integers, written_ns: int | None) -> Integers:
    """Return the indices of the samples with a message, each at least `PERIOD_NS` after the previous message.

    Args:
        written_ns: time of the last message; None before the first message.
    """
    if not len(times_ns):
        return np.empty(0, np.int64)
    earliest_ns = int(times_ns[0]) if written_ns is None else written_ns + PERIOD_NS
    if times_ns[0] >= earliest_ns and (np.diff(times_ns) >= PERIOD_NS).all():
        return np.arange(len(times_ns))
    indices = []
    index = bisect_left(times_ns, earliest_ns)
    while index < len(times_ns):
        indices.append(index)
        index = bisect_left(times_ns, int(times_ns[index]) + PERIOD_NS, index + 1)
    return np.array(indices, np.int64)


def _rows_of(names: Sequence[str], trace: Trace, rows: Integers) -> Integers:
    """Return (S, names), rows of the trace by `names`; below 0 where an object is absent."""
    rows_by_name = np.full((len(rows), len(names)), -1, np.int64)
    rows_by_name[:, list(map(set(trace.names).__contains__, names))] = rows
    return rows_by_name


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
    lows, highs = boxes(rings.points, rings.start)
    sizes = extents(footprints) if rings.has_round else np.maximum(*(highs - lows).T)
    has_label, has_failed = (flags[is_present] for flags in label_flags)
    styles[is_present] = (
        4 * _levels(sizes, last_state.scale or _UNSCALED) + 2 * has_failed + (has_label | has_failed)
    )
    was_pointing = np.append(last_state.is_pointing, violations.is_shown[:-1])
    arrow_codes = np.where(
        violations.is_shown, FIRST_FORM + arrows.cause, np.where(was_pointing, DELETED, ABSENT)
    )
    name_lengths = np.broadcast_to(list(map(len, names)), rows.shape)[is_present]
    arrow_messages = np.flatnonzero(violations.is_shown)
    boxes_of_objects = _boxes_of(observations, lows, highs)
    is_named = (label_flags[0] | label_flags[1]) & is_present & ~violations.is_shown[:, None]
    object_name_centres = _name_places(
        lows, highs, name_lengths, np.repeat(view.line, is_present.sum(axis=1))
    )
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
        arrow_codes,
        arrows.causes,
        arrows.numbers,
        name_centres,
    )


_ARROW_BOX, _THEN_BOX, _BLOCKED = 2, 3, 6
"""Index of the arrow's box, index of the box around earlier outlines, and number of blocked boxes.

Two boxes of objects come before the arrow's box. Two boxes of names come last."""


class _DecidingBoxes(NamedTuple):
    """Arguments of `place_names` for the names at the arrows of K messages."""

    low: Floats
    high: Floats
    letters: Floats
    blocked: Box


def _deciding_boxes(
    names: Sequence[str],
    violations: Violations,
    arrows: ArrowTexts,
    boxes_of_objects: Box,
    missing: tuple[Integers, Dashes],
    regions: Mapping[str, Floats],
) -> _DecidingBoxes:
    """Return the boxes of the deciding objects and regions, and the boxes that texts must not cover.

    Args:
        boxes_of_objects: boxes in the messages with an arrow, in the order of `names`.
    """
    messages = np.flatnonzero(violations.is_shown)
    arrow_ends = violations.points[messages].transpose(1, 2, 0)
    name_boxes = np.full((2, 2, 2, len(messages)), np.nan)
    blocked_boxes = np.full((2, _BLOCKED, 2, len(messages)), np.nan)
    name_lengths = np.zeros((2, len(messages)))
    missing_boxes = [_box(np.concatenate(rings)) for rings in missing[1].rings]
    for cause in np.unique(arrows.cause[messages]).tolist():
        is_cause = arrows.cause[messages] == cause
        arrow_indices = slice(None) if is_cause.all() else np.flatnonzero(is_cause)
        cause_text = arrows.causes[cause]
        if cause_text.dashes:
            blocked_boxes[:, _THEN_BOX][..., arrow_indices] = _box(np.reshape(cause_text.dashes, (-1, 2)))[
                ..., None
            ]
        for side, name in enumerate(cause_text.names):
            name_lengths[side, arrow_indices] = len(name.name) + 2
            if isinstance(name, RegionName):
                if name.name in regions:
                    name_boxes[:, side][..., arrow_indices] = _box(regions[name.name])[..., None]
                continue
            if name.name not in names:
                continue
            column = names.index(name.name)
            for blocked_corners, object_corners in zip(blocked_boxes, boxes_of_objects, strict=True):
                blocked_corners[side][:, arrow_indices] = object_corners[column][:, arrow_indices]
            outline_indices = missing[0][messages, column]
            for arrow_index in np.flatnonzero(is_cause & (outline_indices >= 0)).tolist():
                blocked_boxes[:, side][..., arrow_index] = missing_boxes[outline_indices[arrow_index]]
                name_lengths[side, arrow_index] = len(missing_words(name.name))
            name_boxes[:, side][..., arrow_indices] = blocked_boxes[:, side][..., arrow_indices]
    blocked_boxes[0, _ARROW_BOX] = np.minimum(arrow_ends[0], arrow_ends[1])
    blocked_boxes[1, _ARROW_BOX] = np.maximum(arrow_ends[0], arrow_ends[1])
    # an object without a box has its name at the end of the arrow
    low, high = np.where(np.isnan(name_boxes), arrow_ends, name_boxes)
    return _DecidingBoxes(low, high, name_lengths, (blocked_boxes[0], blocked_boxes[1]))


def _box(points: Floats) -> Floats:
    """Return the low and the high corner of points (n, 2), as (2, 2)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _boxes_of(observations: Integers, low: Floats, high: Floats) -> Box:
    """Return the boxes (N, 2, K) of the objects in K messages; NaN for absent objects."""
    observation_rows = observations.T
    if not len(low):
        no_boxes = np.full((len(observation_rows), 2, observation_rows.shape[1]), np.nan)
        return no_boxes, no_boxes
    box_columns = [
        np.where(observation_rows < 0, np.nan, column[observation_rows]) for column in (*low.T, *high.T)
    ]
    return np.stack(box_columns[:2], axis=1), np.stack(box_columns[2:], axis=1)


def _places(
    deciding: _DecidingBoxes, label_lengths: Floats, other_boxes: Box, view: _View
) -> tuple[Floats, Floats]:
    """Return the centres of the names (K, 2, 2) and of the label (K, 2) of an arrow.

    Args:
        label_lengths: (K,), lengths of labels, letters.
        other_boxes: boxes of all objects.
        view: view of these messages.
    """
    around = _surroundings(deciding.blocked, other_boxes, view)
    name_centres = place_names(deciding.low, deciding.high, deciding.letters, around)
    arrow_box = deciding.blocked[0][_ARROW_BOX], deciding.blocked[1][_ARROW_BOX]
    return name_centres.transpose(2, 0, 1), place_labels(label_lengths, arrow_box, around).T


def _surroundings(blocked: Box, other_boxes: Box, view: _View) -> Surroundings:
    lows, highs = view.corners.transpose(1, 2, 0)
    return Surroundings(
        blocked, other_boxes, (lows, highs), VIEW / 2.0 * (highs - lows).max(axis=0), view.line
    )


def _free_places(
    centres: Floats,
    name_lengths: Floats,
    observations: Integers,
    is_movable: NDArray[np.bool_],
    boxes_of_objects: Box,
    view: _View,
) -> Floats:
    """Return the centres of names (R, 2). A name that covers another object moves to a free side, if any.

    Args:
        name_lengths: (N,), lengths of names, letters.
        observations: (S, N), rows of objects with names; -1 for other objects.
        is_movable: (S, N), whether each name may move.
    """
    if not is_movable.any():
        return centres
    is_named = observations.T >= 0
    usual_centres = np.where(is_named, centres.T[:, observations.T], np.nan).swapaxes(0, 1)
    no_boxes = np.empty((0, 2, len(observations))), np.empty((0, 2, len(observations)))
    around = _surroundings(no_boxes, boxes_of_objects, view)
    free_centres = free_names(usual_centres, name_lengths, is_movable.T, boxes_of_objects, around)
    moved_centres = centres.copy()
    moved_centres[observations.T[is_named]] = free_centres.swapaxes(0, 1)[:, is_named].T
    return moved_centres


def _name_places(low: Floats, high: Floats, name_lengths: Integers, line_heights: Floats) -> Floats:
    """Return (R, 2), the centres of names: in the middle of large objects, below small ones."""
    # half the sum of the corners, unlike a mean of points, does not depend on the order of summation
    centres = (low + high) / 2.0
    sides = high - low
    is_small = (sides[:, 1] < 1.5 * line_heights) | (sides[:, 0] < 0.5 * line_heights * name_lengths)
    centres[:, 1] = np.where(is_small, low[:, 1] - 0.75 * line_heights, centres[:, 1])
    return centres


def _levels(sizes: Floats, scale: float) -> Integers:
    """Return the level of each size. Half the size gives a level higher by 1; an unknown size gives 0."""
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
    outline_lengths = np.array([*map(len, content.last.rows), -1])[content.missing]
    layout_keys = [*content.forms.T, *content.styles.T, *outline_lengths.T, content.arrow]
    for message_indices in equal_places(combined_code(layout_keys, len(content.arrow))):
        yield _layout(content, int(message_indices[0])), message_indices


def _layout(content: SceneContent, message: int) -> SceneLayout:
    arrow_code = int(content.arrow[message])
    is_pointing = arrow_code >= FIRST_FORM
    forms_and_styles = content.forms[message].tolist(), content.styles[message].tolist()
    entries: list[tuple[str, int, int]] = list(zip(content.names, *forms_and_styles, strict=True))
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
    missing_rows = zip(content.names, content.missing[message].tolist(), strict=True)
    missing = tuple((name, len(content.last.rows[row])) for name, row in missing_rows if row >= 0)
    cause: CauseText | Literal["deleted"] | None = None
    if arrow_code != ABSENT:
        cause = "deleted" if arrow_code == DELETED else content.causes[arrow_code - FIRST_FORM]
    name_labels = {name: _label(name, style | 1) for name, _, style in entries if style >= 0}
    name_labels |= {name: missing_words(name) for name, _ in missing}
    cause_names = cause.names if isinstance(cause, CauseText) else ()
    names = [
        base.name if isinstance(base, RegionName) else name_labels.get(base.name, base.name)
        for base in cause_names
    ]
    return SceneLayout(deleted, figures, missing, cause, tuple(names))


def _label(name: str, style: int) -> str:
    return f"{name} ✕" if style & 2 else name if style & 1 else ""
