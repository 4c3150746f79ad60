"""Objects, regions and how well they do → messages of /spatial/scene.

How strongly robustness is coloured, by how large it is.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spatial_replay.annotate.requirements import Evaluated, Seen, worst_robustness
from spatial_replay.annotate.scene_entities import (
    LABEL_LENGTH,
    Form,
    Layout,
    Region,
    Rings,
    SceneTemplate,
    extents,
    make_template,
    rings_of,
    words_of_object,
    words_of_region,
    words_of_witness,
)
from spatial_replay.annotate.violations import Judged, Pointers, pointers
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.logs.objects.wire import payloads_of
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.spec.formula import Outline
from spatial_replay.trace.trace import Trace

_LEAST: Final = 0.4
"""How far the colour of the slightest robustness is from grey: its sign can be seen."""

_OPACITY: Final = 0.6
"""Of a map's cells: what lies over them stands out."""


def colours(robustness: ArrayLike, scale: ArrayLike) -> Floats:
    """The colours (..., 3) of robustness (...): full where it is as large as `scale`, grey where NaN.

    Args:
        scale: above 0, in the unit of the robustness; one, or an array that goes with it.
    """
    values = np.asarray(robustness, np.float64)[..., None]
    share = _LEAST + (1.0 - _LEAST) * np.minimum(np.abs(values) / np.asarray(scale)[..., None], 1.0)
    hue = np.where(values >= 0.0, POSITIVE, NEGATIVE)
    mixed = np.where(np.isnan(values), NEUTRAL, NEUTRAL + share * (hue - NEUTRAL))
    # the steps of a screen: finer ones nobody sees, and a log of them is larger
    return np.asarray(np.round(mixed * 255.0) / 255.0)


def cell_colours(robustness: Floats) -> NDArray[np.uint8]:
    """Red, green, blue and alpha (..., 4) of cells (...): full where the map is largest, clear where NaN."""
    largest = float(np.abs(robustness[np.isfinite(robustness)]).max(initial=0.0))
    opacity = np.where(np.isnan(robustness), 0.0, _OPACITY)
    shares = np.concatenate([colours(robustness, largest or 1.0), opacity[..., None]], axis=-1)
    return np.asarray(np.round(255.0 * shares), np.uint8)


PERIOD_NS: Final = 20_000_000
"""The least time between two messages: what viewers draw without a warning."""

_LIFT: Final = 0.01
_POINT: Final = 0.02
"""Height of flat objects above the plane, and radius of a point, by the scale of the scene."""

_UNSCALED: Final = 1.0
"""The scale before any object is seen, and that of a scene of points, which have no size."""

_TEMPLATES_KEPT: Final = 256
_ABSENT, _DELETED, _FIRST_FORM = -1, 0, 1


@dataclass(frozen=True, eq=False)
class SceneState:
    """What the next message depends on besides its own sample.

    Attributes:
        written_ns: the time of the last message, or None before the first.
        shown: the objects in it.
        is_pointing: whether it points at a violation.
        scale: the robustness at which colours are full: the median size (longer side of the bounding box) of
            the objects in the first message that shows any; None before that.
        templates: the layouts met so far; they save time and change no message.
    """

    written_ns: int | None = None
    shown: tuple[str, ...] = ()
    is_pointing: bool = False
    scale: float | None = None
    templates: Mapping[Layout, SceneTemplate] = field(default_factory=lambda: MappingProxyType({}))


def scene_scale(trace: Trace) -> float | None:
    """Return the scale of a run's scene (see `SceneState`); None if no message shows an object.

    Args:
        trace: from the first sample on.
    """
    rows = trace.rows[_spaced(trace.times_ns, None)]
    is_shown = (rows >= 0).any(axis=1)
    return _scale_of(trace, rows[int(is_shown.argmax())]) if is_shown.any() else None


class SceneMessages(NamedTuple):
    """Encoded messages, their times (S,) int64, and the state to go on from."""

    times_ns: Integers
    payloads: list[bytes]
    state: SceneState


class _Cast(NamedTuple):
    """Who is in S samples, and where.

    Attributes:
        names: objects that are, or just were, in sight.
        rows: (S, names), rows of the trace; below 0 where an object is not seen.
        forms: (S, names), `_ABSENT`, `_DELETED`, or from `_FIRST_FORM` on the number of its form.
        observations: (S, names), rows of `rings` and `footprints`.
        pointers: of the S samples.
        witness: (S,), the same as `forms` for the arrow at the worst violation.
    """

    names: tuple[str, ...]
    rows: Integers
    forms: Integers
    observations: Integers
    footprints: FootprintBatch
    rings: Rings
    pointers: Pointers
    witness: Integers


@dataclass(frozen=True, eq=False)
class SceneEncoder:
    """Draws traces over the regions of a specification.

    Every message holds all regions and all objects seen, so that a viewer that jumps to it misses nothing;
    objects no longer seen are deleted. Blue, vermillion and grey say how the worst of what is asked of an
    object or region stands now (see `palette` and `involvement`). Where that is violated, an arrow with the
    number points at the worst (see `pointing`).

    Attributes:
        regions: by name.
    """

    regions: Mapping[str, Outline]
    _drawn: tuple[Region, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        drawn = tuple(_region(name, self.regions[name]) for name in sorted(self.regions))
        object.__setattr__(self, "_drawn", drawn)

    def encode(
        self,
        trace: Trace,
        evaluated: Sequence[Evaluated] = (),
        state: SceneState | None = None,
        judged: Sequence[Judged] = (),
    ) -> SceneMessages:
        """The messages of the next samples; it does not matter into how many blocks a run is cut.

        Args:
            trace: the next samples, after those of the state.
            evaluated: what specifications say of these samples; others have no say in the colours.
            state: what the call before returned, or None to begin.
            judged: the same of those whose violations are to be pointed at.
        """
        state = state or SceneState()
        written = _spaced(trace.times_ns, state.written_ns)
        times_ns = trace.times_ns[written]
        if not len(written):
            return SceneMessages(times_ns, [], state)
        state, scales = _scaled(state, trace, trace.rows[written])
        scale = state.scale or _UNSCALED
        cast = _cast(trace, trace.rows[written], state, scale, pointers(judged, trace, written))
        seen = Seen(times_ns, cast.names, _class_codes(trace, cast.rows), trace.classes)
        objects, regions = worst_robustness(evaluated, seen, [region.name for region in self._drawn])
        shades = colours(objects, scales), colours(regions, scales)
        templates = dict(state.templates)
        payloads = [b""] * len(written)
        for layout, samples in _by_layout(cast):
            if layout not in templates:
                templates[layout] = make_template(layout, self._drawn, _LIFT * scale)
            words = self._words(layout, samples, cast, *shades, scale)
            rows = templates[layout].fill(times_ns[samples], words)
            for sample, payload in zip(samples.tolist(), payloads_of(rows), strict=True):
                payloads[sample] = payload
        last = cast.forms[-1] >= _FIRST_FORM
        after = SceneState(
            written_ns=int(times_ns[-1]),
            shown=tuple(name for name, is_shown in zip(cast.names, last.tolist(), strict=True) if is_shown),
            is_pointing=bool(cast.pointers.is_shown[-1]),
            scale=state.scale,
            templates=MappingProxyType(dict(list(templates.items())[-_TEMPLATES_KEPT:])),
        )
        return SceneMessages(times_ns, payloads, after)

    def _words(
        self, layout: Layout, samples: Integers, cast: _Cast, objects: Floats, regions: Floats, scale: float
    ) -> Floats:
        """(S, W) what the layout's template leaves open."""
        columns = []
        for index, region in enumerate(self._drawn):
            columns += words_of_region(region, regions[samples, index])
        for name, form in layout.objects:
            column = cast.names.index(name)
            rows = cast.observations[samples, column]
            points = cast.rings.points[cast.rings.start[rows][:, None] + np.arange(sum(form.rings))]
            bottom, top = cast.footprints.bottom[rows], cast.footprints.top[rows]
            colour = objects[samples, column]
            columns += words_of_object(form, points, bottom, top, colour, _LIFT * scale)
        if layout.witness:
            columns += _words_of_witness(cast.pointers, samples, scale)
        return np.concatenate([np.empty((len(samples), 0)), *columns], axis=1)


def _words_of_witness(found: Pointers, samples: Integers, scale: float) -> list[Floats]:
    z = np.fmax(found.top[samples], 0.0) + 3.0 * _LIFT * scale
    labels = [_label(number) for number in found.robustness[samples].tolist()]
    return words_of_witness(found.points[samples], z, scale, labels)


def _label(number: float) -> str:
    """A number in as many digits, up to three, as there is room for."""
    text = f"{number:.3g}"
    if len(text) > LABEL_LENGTH:
        text = next(text for digits in (2, 1) if len(text := f"{number:.{digits}g}") <= LABEL_LENGTH)
    return text


def _region(name: str, outline: Outline) -> Region:
    rings = rings_of(FootprintBatch.from_footprints([footprint_from_outline(outline)]), 0.0)
    ends = np.cumsum(rings.forms[0].rings)[:-1]
    return Region(name, outline, tuple(np.split(rings.points, ends)))


def _spaced(times_ns: Integers, written_ns: int | None) -> Integers:
    """Indices of the samples to write: each at least a period after the one written before."""
    if not len(times_ns):
        return np.empty(0, np.int64)
    earliest = int(times_ns[0]) if written_ns is None else written_ns + PERIOD_NS
    if times_ns[0] >= earliest and (np.diff(times_ns) >= PERIOD_NS).all():
        return np.arange(len(times_ns))
    chosen = []
    at = bisect_left(times_ns, earliest)
    while at < len(times_ns):
        chosen.append(at)
        at = bisect_left(times_ns, int(times_ns[at]) + PERIOD_NS, at + 1)
    return np.array(chosen, np.int64)


def _scaled(state: SceneState, trace: Trace, rows: Integers) -> tuple[SceneState, Floats]:
    """Return the state with its scale, once an object is shown, and the scale (S, 1) of each message."""
    if state.scale is not None:
        return state, np.full((len(rows), 1), state.scale)
    scales = np.full((len(rows), 1), _UNSCALED)
    is_shown = (rows >= 0).any(axis=1)
    if not is_shown.any():
        return state, scales
    first = int(is_shown.argmax())
    scale = _scale_of(trace, rows[first])
    scales[first:] = scale
    return replace(state, scale=scale), scales


def _scale_of(trace: Trace, rows: Integers) -> float:
    """Return the median size of the objects in one sample, whose rows are given."""
    return float(np.median(extents(trace.footprints.select(rows[rows >= 0])))) or _UNSCALED


def _cast(trace: Trace, rows: Integers, before: SceneState, scale: float, found: Pointers) -> _Cast:
    names = tuple(sorted({*trace.names, *before.shown}))
    of_all = np.full((len(rows), len(names)), -1, np.int64)
    of_all[:, [names.index(name) for name in trace.names]] = rows
    is_seen = of_all >= 0
    was_seen = np.concatenate([[[name in before.shown for name in names]], is_seen[:-1]])
    footprints = trace.footprints.select(of_all[is_seen])
    rings = rings_of(footprints, _POINT * scale)
    observations = np.full(of_all.shape, -1, np.int64)
    observations[is_seen] = np.arange(len(footprints))
    forms = np.where(was_seen, _DELETED, _ABSENT)
    forms[is_seen] = _FIRST_FORM + rings.form
    was_pointing = np.append(before.is_pointing, found.is_shown[:-1])
    witness = np.where(found.is_shown, _FIRST_FORM, np.where(was_pointing, _DELETED, _ABSENT))
    return _Cast(names, of_all, forms, observations, footprints, rings, found, witness)


def _class_codes(trace: Trace, rows: Integers) -> Integers:
    codes = np.full(rows.shape, -1, np.int64)
    codes[rows >= 0] = trace.class_code[rows[rows >= 0]]
    return codes


def _by_layout(cast: _Cast) -> Iterator[tuple[Layout, Integers]]:
    """The layouts, and the samples (S,) that have each."""
    forms = np.column_stack([cast.forms, cast.witness])
    if (forms == forms[0]).all():
        yield _layout(cast, forms[0]), np.arange(len(forms))
        return
    rows, which = np.unique(forms, axis=0, return_inverse=True)
    for number, row in enumerate(rows):
        yield _layout(cast, row), np.flatnonzero(which.reshape(-1) == number)


def _layout(cast: _Cast, forms: NDArray[np.int64]) -> Layout:
    *of_objects, witness = forms.tolist()
    listed: list[tuple[str, int]] = list(zip(cast.names, of_objects, strict=True))
    seen: list[tuple[str, Form]] = [
        (name, cast.rings.forms[form - _FIRST_FORM]) for name, form in listed if form >= _FIRST_FORM
    ]
    deleted = tuple(name for name, form in listed if form == _DELETED)
    return Layout(deleted, tuple(seen), None if witness == _DELETED else witness == _FIRST_FORM)
