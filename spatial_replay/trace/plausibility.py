"""Numbers of a specification against those of a log: regions far away, thresholds out of reach, windows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import hypot, inf

import numpy as np

from spatial_replay.spec.diagnostics import Diagnostic, SourceText
from spatial_replay.spec.format import format_bound, format_number
from spatial_replay.spec.formula import Atom, Formula, Outline, Span, Specification, Temporal
from spatial_replay.spec.walks import iter_formulas
from spatial_replay.trace.trace import Trace

_LENGTH_RELATIONS = frozenset({"closeto", "farfrom", "touch", "moved", "dist"})
_FAR = 10.0
"""Beyond so many times the extent of all that was seen, a length is most likely in another unit."""


@dataclass(frozen=True, slots=True)
class LogNumbers:
    """What a log holds, in numbers.

    Attributes:
        box: xmin, ymin, xmax, ymax of all footprints; empty (xmin > xmax) without any.
        ranges: least and greatest finite value of each signal.
        times_ns: of the first and the last sample.
    """

    box: tuple[float, float, float, float] = (inf, inf, -inf, -inf)
    ranges: Mapping[str, tuple[float, float]] | None = None
    samples: int = 0
    times_ns: tuple[int, int] = (0, 0)

    def extended(self, trace: Trace) -> LogNumbers:
        """Return the numbers of these samples and of the next ones."""
        if not len(trace):
            return self
        ranges = dict(self.ranges or {})
        for name, column in trace.signals.items():
            values = column[np.isfinite(column)]
            low, high = ranges.get(name, (inf, -inf))
            if len(values):
                ranges[name] = (min(low, float(values.min())), max(high, float(values.max())))
        box, vertices = self.box, trace.footprints.vertices
        if len(vertices):
            margin = float(trace.footprints.radius.max(initial=0.0))
            (left, low_y), (right, high_y) = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
            seen = (left - margin, low_y - margin, right + margin, high_y + margin)
            box = (*map(min, box[:2], seen[:2]), *map(max, box[2:], seen[2:]))
        first = self.times_ns[0] if self.samples else int(trace.times_ns[0])
        return LogNumbers(box, ranges, self.samples + len(trace), (first, int(trace.times_ns[-1])))

    @property
    def extent(self) -> float:
        """The diagonal of `box`; 0 if nothing was seen."""
        left, bottom, right, top = self.box
        return hypot(right - left, top - bottom) if left <= right else 0.0

    @property
    def rate(self) -> float | None:
        """Samples a second, on average; None of fewer than two samples."""
        span = self.times_ns[1] - self.times_ns[0]
        return (self.samples - 1) * 1e9 / span if span > 0 else None


def window_lines(specification: Specification, log: LogNumbers) -> list[str]:
    """Return each window given in samples, in seconds at the log's rate."""
    if log.rate is None:
        return []
    lines: dict[str, None] = {}
    for node in _nodes(specification):
        bound = node.bound if isinstance(node, Temporal) else None
        if bound is not None and bound.unit == "samples":
            upper = "the end" if bound.upper is None else f"{bound.upper / log.rate:.3g} s"
            name = f"{node.operator if isinstance(node, Temporal) else ''}{format_bound(bound)}"
            lines[f"{name} is {bound.lower / log.rate:.3g} s to {upper}"] = None
    return [f"at {log.rate:.4g} samples a second, {line}" for line in lines]


def plausibility_warnings(specification: Specification, log: LogNumbers) -> tuple[Diagnostic, ...]:
    """Return a warning for each region and number that hardly fits what the log holds."""
    source = SourceText.of(specification.source, specification.filename)
    found: dict[str, Diagnostic] = {}
    for name, outline in specification.regions.items():
        apart = _distance(outline, log.box)
        if 0.0 < log.extent < apart:
            start = max(source.text.find(f"region {name}"), 0)
            message = f"the region {name!r} is {apart:.4g} away from all that the log ever has"
            hint = f"objects lie in x {log.box[0]:.4g} to {log.box[2]:.4g}, y {log.box[1]:.4g} to "
            span = Span(start, start + len(f"region {name}"))
            found[name] = source.diagnostic("warning", span, message, f"{hint}{log.box[3]:.4g}")
    for atom in _nodes(specification):
        if isinstance(atom, Atom) and atom.text not in found:
            for message, hint in _doubts(atom, log):
                found.setdefault(atom.text, source.diagnostic("warning", atom.span, message, hint))
    return tuple(sorted(found.values(), key=lambda each: (each.line, each.column)))


def _doubts(atom: Atom, log: LogNumbers) -> Iterator[tuple[str, str]]:
    numbers = [each for each in atom.parameters if isinstance(each, float)]
    if atom.relation == "signal":
        name = str(atom.parameters[0])
        low, high = (log.ranges or {}).get(name, (-inf, inf))
        reach = max(high - low, abs(high), abs(low))
        for limit in numbers:
            if limit > high + reach or limit < low - reach:
                message = f"{name!r} never comes near {format_number(limit)} in this log"
                yield message, f"it goes from {low:.4g} to {high:.4g}"
    elif atom.relation in _LENGTH_RELATIONS:
        for length in numbers:
            if length < 0.0 and atom.relation != "dist":
                yield f"{atom.relation!r} with the negative length {format_number(length)}", "is it a slip?"
            elif 0.0 < log.extent * _FAR < abs(length):
                message = f"{format_number(length)} is far more than anything in the log is apart"
                yield message, f"all that it has lies within {log.extent:.4g}; is the unit the same?"


def _distance(outline: Outline, box: tuple[float, float, float, float]) -> float:
    """Return how far the bounding boxes of an outline and of the log are apart; 0 if they meet."""
    xs, ys = zip(*outline.vertices, strict=True)
    apart_x = max(box[0] - max(xs), min(xs) - box[2], 0.0)
    apart_y = max(box[1] - max(ys), min(ys) - box[3], 0.0)
    return max(0.0, hypot(apart_x, apart_y) - outline.radius)


def _nodes(specification: Specification) -> Iterator[Formula]:
    for spec in specification.results:
        yield from iter_formulas(spec.formula)
