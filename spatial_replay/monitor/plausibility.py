"""Plausibility of a specification for a log: thresholds out of reach, far regions, windows too long."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf
from operator import itemgetter
from typing import Literal, TypeAlias

import numpy as np

from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene, look_back, tail
from spatial_replay.monitor.witness.evidence import NamedPart, is_missing, named_parts
from spatial_replay.spec.diagnostics import Diagnostic, SourceText, Span
from spatial_replay.spec.format import format_bound, format_number, format_term
from spatial_replay.spec.formula import (
    ANY_CLASS,
    FUTURE_OPERATORS,
    Atom,
    Bound,
    Earlier,
    Expression,
    Formula,
    Group,
    Measurement,
    Outline,
    Quantified,
    Signal,
    SignedDistance,
    Specification,
    Temporal,
    Term,
    TrackedName,
    Variable,
    operands_of,
)
from spatial_replay.spec.walks import base_of, iter_atoms, iter_bound, iter_expressions, terms_of
from spatial_replay.text import plural, time_text
from spatial_replay.trace.trace import Pauses, Trace

_LENGTH_RELATIONS = frozenset({"closeto", "farfrom", "touch", "moved", "dist"})
_FAR = 10.0
"""Largest plausible length, in extents of the log; a greater length is probably in another unit."""
_APART = 5.0
"""Ratio between a threshold and all measured numbers above which the threshold is out of reach."""


@dataclass(frozen=True, slots=True)
class ThresholdRange:
    """The range over a log of the quantity that an atom compares with its threshold.

    Attributes:
        atom: an atom with one distance or signal.
        bound: quantifiers that bind the atom's variables, outermost first. A template parameter is treated
            as a variable with a quantifier.
        least, greatest: range of the quantity over all objects that the variables stand for. The range is
            empty (least > greatest) for a comparison with a text, and for a quantity that is never known.
        known: number of samples in which the quantity is known.
        holding: number of samples in which the atom holds for all objects.
        failing: number of samples in which the atom fails for all objects.
        empty: number of samples in which no object is in the groups of the variables.
        samples: number of all samples.
    """

    atom: Atom
    bound: tuple[Quantified, ...] = ()
    least: float = inf
    greatest: float = -inf
    known: int = 0
    holding: int = 0
    failing: int = 0
    empty: int = 0
    samples: int = 0

    @property
    def holds(self) -> Literal["always", "never", "sometimes", "unknown"]:
        if not self.known:
            return "unknown"
        if self.failing == self.known:
            return "never"
        return "always" if self.holding == self.known else "sometimes"

    @property
    def objects(self) -> str | None:
        """The atom's variables and their groups, as in `d in drinks`; None without variables."""
        binding_texts = [
            f"{', '.join(quantifier.variables)} in {format_term(quantifier.group).strip('()')}"
            for quantifier in self.bound
        ]
        return ", ".join(binding_texts) or None

    @property
    def text(self) -> str:
        """The atom with the groups of its variables."""
        return self.atom.text if self.objects is None else f"{self.atom.text} for {self.objects}"

    @property
    def _words_of_empty(self) -> str:
        """Predicate of samples in which the groups are empty, with the atom's robustness there."""
        quantifiers = {quantified.quantifier for quantified in self.bound}
        if len(quantifiers) > 1:
            return "has no object"
        return f"has no object, and so is {'-inf' if quantifiers == {'exists'} else '+inf'},"

    def __str__(self) -> str:
        is_number = self.least <= self.greatest
        clauses = [f"goes from {self.least:.4g} to {self.greatest:.4g}"] if is_number else []
        unknown_count = self.samples - self.known - self.empty
        for count, predicate in ((unknown_count, "is unknown"), (self.empty, self._words_of_empty)):
            share_text = f"{count:,} of {plural(self.samples, 'sample')}"
            clauses += (
                [f"{predicate} in {'every sample' if count == self.samples else share_text}"] if count else []
            )
        if not self.known:
            return f"{self.text}: {', '.join(clauses)}"
        known_text = plural(self.known, "sample")
        if self.holds != "sometimes":
            clauses.append(f"{self.holds} holds{' in the others' if unknown_count or self.empty else ''}")
        elif self.bound:
            clauses.append(
                f"holds for all in {self.holding:,} and for none in {self.failing:,} of {known_text}"
            )
        else:
            clauses.append(f"holds in {self.holding:,} of {known_text}")
        return f"{self.text}: {', '.join(clauses)}"


class LogNumbers:
    """Numbers of a log against which a specification is checked, collected block by block.

    Attributes:
        box: xmin, ymin, xmax, ymax of all footprints; xmin > xmax without footprints.
        samples: number of samples.
        times_ns: times of the first and the last sample.
        classes: classes of the objects; "" for objects without a class.
        missing: for an object or signal of the specification, the number of samples without it, and the time
            of the first such sample, ns.
    """

    def __init__(self, specification: Specification) -> None:
        """Start before the first sample."""
        self.box: tuple[float, float, float, float] = (inf, inf, -inf, -inf)
        self.samples = 0
        self.classes: set[str] = set()
        self._pauses = Pauses()
        self.times_ns = (0, 0)
        self._regions = specification.regions
        self._reach = look_back([spec.formula for spec in specification.results])
        self._recent_trace: Trace | None = None
        self.missing: dict[NamedPart, tuple[int, int]] = {}
        self._named_parts = list(
            dict.fromkeys(part for spec in specification.results for part in named_parts(spec.formula))
        )
        self._ranges = {
            _key(node, bound): ThresholdRange(node, bound)
            for node, bound in bound_nodes(specification)
            if isinstance(node, Atom) and _compared_quantity(node) is not None
        }

    def add(self, trace: Trace) -> None:
        """Add the next samples, except samples that only fill a pause."""
        trace = trace.without_filling()
        if not len(trace):
            return
        vertices = trace.footprints.vertices
        if len(vertices):
            # an upper bound: the radius of one part enlarges its own vertices only
            margin = float(trace.footprints.radius.max(initial=0.0))
            (left, bottom), (right, top) = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
            lower_corner = (min(self.box[0], left - margin), min(self.box[1], bottom - margin))
            self.box = (*lower_corner, max(self.box[2], right + margin), max(self.box[3], top + margin))
        self.times_ns = (
            self.times_ns[0] if self.samples else int(trace.times_ns[0]),
            int(trace.times_ns[-1]),
        )
        self.samples += len(trace)
        self.classes.update(trace.classes[code] or "" for code in np.unique(trace.class_code).tolist())
        self._pauses.add(trace.times_ns)
        for part in self._named_parts:
            missing_samples = np.flatnonzero(is_missing(trace, part))
            if len(missing_samples):
                missing_count, first_ns = self.missing.get(part, (0, int(trace.times_ns[missing_samples[0]])))
                self.missing[part] = missing_count + len(missing_samples), first_ns
        self._add_ranges(trace)

    def _add_ranges(self, trace: Trace) -> None:
        earlier_samples = (
            None if self._recent_trace is None or not self._reach else tail(self._recent_trace, self._reach)
        )
        extended_trace = trace if earlier_samples is None else Trace.concatenate([earlier_samples, trace])
        self._recent_trace = extended_trace
        scene = TraceScene(extended_trace, self._regions, len(extended_trace) - len(trace))
        for key, threshold_range in self._ranges.items():
            # the robustness of this atom is the quantity itself
            quantity_atom = replace(
                threshold_range.atom,
                expression=_compared_quantity(threshold_range.atom) or threshold_range.atom.expression,
            )
            # one call per formula, because the limit on bindings applies to all formulas of a call together
            least, greatest, all_hold, any_holds = (
                leaf_values(scene, [over_bindings(quantifier, threshold_range.bound, atom)], {})[:, 0]
                for atom in (quantity_atom, threshold_range.atom)
                for quantifier in ("forall", "exists")
            )
            # low and high ends differ where a value is unknown, and are infinite where there is no object
            is_text = isinstance(threshold_range.atom.parameters[-1], str)
            is_known = is_text | (np.isfinite(least[0]) & np.isfinite(greatest[0]))
            for ends in (all_hold, any_holds) if is_text else (least, greatest):
                # a single channel means equal ends
                is_known &= ends[0] == ends[min(1, len(ends) - 1)]
            # over no object, `forall` is +inf and `exists` is -inf
            is_empty = (all_hold == np.inf).all(axis=0) & (any_holds == -np.inf).all(axis=0)
            is_known &= ~is_empty
            has_number = is_known & (not is_text)
            self._ranges[key] = replace(
                threshold_range,
                least=min(threshold_range.least, float(least[0, has_number].min(initial=inf))),
                greatest=max(threshold_range.greatest, float(greatest[0, has_number].max(initial=-inf))),
                known=threshold_range.known + int(is_known.sum()),
                holding=threshold_range.holding + int((all_hold[0, is_known] >= 0.0).sum()),
                failing=threshold_range.failing + int((any_holds[0, is_known] < 0.0).sum()),
                empty=threshold_range.empty + int(is_empty.sum()),
            )

    @property
    def ranges(self) -> Sequence[ThresholdRange]:
        """The range of each atom that compares one signal or distance with a number or text."""
        return tuple(
            replace(threshold_range, samples=self.samples) for threshold_range in self._ranges.values()
        )

    def range_of(self, atom: Atom, bound: tuple[Quantified, ...]) -> ThresholdRange | None:
        """Return the range of an atom; None if it does not compare one signal or distance."""
        return self._ranges.get(_key(atom, bound))

    @property
    def extent(self) -> float:
        """The diagonal of `box`; 0 without footprints."""
        left, bottom, right, top = self.box
        return hypot(right - left, top - bottom) if left <= right else 0.0

    @property
    def seconds(self) -> float:
        """Time from the first sample to the last, s."""
        return (self.times_ns[1] - self.times_ns[0]) / 1e9

    @property
    def rate(self) -> float | None:
        """Usual number of samples per second; None for fewer than two samples."""
        usual_ns = self._pauses.usual_ns
        return 1e9 / usual_ns if usual_ns else None


def window_lines(specification: Specification, log: LogNumbers) -> list[str]:
    """Return a line for each window in samples, and for each nesting, with its seconds at the log's rate."""
    if log.rate is None:
        return []
    lines: dict[str, None] = {}
    for node, _ in bound_nodes(specification):
        bound = node.bound if isinstance(node, Temporal) else None
        if bound is not None and bound.unit == "samples":
            upper_text = "the end" if bound.upper is None else f"{bound.upper / log.rate:.3g} s"
            window_text = f"{node.operator if isinstance(node, Temporal) else ''}{format_bound(bound)}"
            lines[f"{window_text} is {bound.lower / log.rate:.3g} s to {upper_text}"] = None
    for spec in specification.results:
        reach_s, windows = _reach(spec.formula, log.rate)
        if len(windows) > 1 and any(bound.unit == "samples" for _, bound in windows):
            lines[f"{_nesting_text(windows)} reaches {reach_s:.3g} s ahead"] = None
    return [f"at {log.rate:.4g} samples a second, {line}" for line in lines]


_Windows: TypeAlias = tuple[tuple[Temporal, Bound], ...]


def _reach(formula: Formula, rate: float) -> tuple[float, _Windows]:
    """Return the look-ahead of a formula in seconds, with the nested windows that add up to it."""
    farthest_reach = max(
        (_reach(operand, rate) for operand in operands_of(formula)), key=itemgetter(0), default=(0.0, ())
    )
    bound = formula.bound if isinstance(formula, Temporal) else None
    if not isinstance(formula, Temporal) or bound is None or formula.operator not in FUTURE_OPERATORS:
        return farthest_reach
    if bound.upper is None:
        return farthest_reach
    window_s = bound.upper / rate if bound.unit == "samples" else bound.upper / 1e9
    return window_s + farthest_reach[0], ((formula, bound), *farthest_reach[1])


def _nesting_text(windows: _Windows) -> str:
    return " of ".join(f"{node.operator}{format_bound(bound)}" for node, bound in windows)


def plausibility_warnings(
    specification: Specification, log: LogNumbers, zero_ns: int
) -> tuple[Diagnostic, ...]:
    """Return a warning for each region, number and window that is implausible for the log.

    Args:
        zero_ns: reference time of the texts.
    """
    source = SourceText.of(specification.source, specification.filename)
    warnings: dict[str, Diagnostic] = {}
    for name, outline in specification.regions.items():
        gap = _distance(outline, log.box)
        if 0.0 < log.extent < gap:
            text_start = max(source.text.find(f"region {name}"), 0)
            message = f"the region {name!r} is {gap:.4g} away from all that the log ever has"
            hint = f"objects lie in x {log.box[0]:.4g} to {log.box[2]:.4g}, y {log.box[1]:.4g} to "
            span = Span(text_start, text_start + len(f"region {name}"))
            warnings[name] = source.diagnostic("warning", span, message, f"{hint}{log.box[3]:.4g}")
    for part, (missing_count, first_ns) in log.missing.items():
        atoms = (atom for spec in specification.results for atom in iter_atoms(spec.formula))
        span = next(atom.span for atom in atoms if part in named_parts(atom))
        # a name that is missing in every sample is reported by `check_names`
        if missing_count < log.samples:
            first_time = time_text(first_ns, zero_ns)
            share_text = f"{missing_count:,} of {plural(log.samples, 'sample')}"
            message = f"{part.title} is missing in {share_text}, first at {first_time}"
            hint = "atoms about it are unknown there, and so may be a verdict"
            warnings[part.title] = source.diagnostic("warning", span, message, hint)
    for node, bound in bound_nodes(specification):
        doubts: Iterator[tuple[str, str]] = iter(())
        warning_key = ""
        if isinstance(node, Atom):
            threshold_range = log.range_of(node, bound)
            warning_key, doubts = (
                threshold_range.text if threshold_range else node.text,
                _doubts(node, log, threshold_range),
            )
        elif isinstance(node, Temporal) and node.bound is not None:
            warning_key = f"{node.operator}{format_bound(node.bound)}"
            doubts = _doubts_of_window(warning_key, node.bound, log)
        for message, hint in doubts:
            warnings.setdefault(warning_key, source.diagnostic("warning", node.span, message, hint))
    for node, _ in bound_nodes(specification):
        empty_class = _empty_class(node.group, log) if isinstance(node, Quantified) else None
        if empty_class is not None:
            class_names = ", ".join(sorted(filter(None, log.classes))) or "none"
            hint = f"its classes are {class_names}; over no object, forall is +inf and exists -inf"
            message = f"no object of class {empty_class!r} is ever in this log"
            warnings.setdefault(empty_class, source.diagnostic("warning", node.span, message, hint))
    for spec in specification.results:
        # without a rate, windows in samples count as 0 s
        reach_s, windows = _reach(spec.formula, log.rate or inf)
        name = _nesting_text(windows)
        if len(windows) > 1 and reach_s > log.seconds and name not in warnings:
            message = f"the windows {name} together are longer than this log"
            hint = (
                f"they reach {reach_s:.3g} s ahead, and the log has {log.seconds:.3f} s, so its end decides"
            )
            if not any(f"{node.operator}{format_bound(bound)}" in warnings for node, bound in windows):
                warnings[name] = source.diagnostic("warning", windows[0][0].span, message, hint)
    return tuple(sorted(warnings.values(), key=lambda warning: (warning.line, warning.column)))


def _empty_class(group: Group | Earlier, log: LogNumbers) -> str | None:
    """Return the class of a group if no object of the log has it; else None."""
    name = group.class_name if isinstance(group, Group) else None
    if name is None or name == ANY_CLASS or name.casefold() in map(str.casefold, log.classes):
        return None
    return name


def _doubts(atom: Atom, log: LogNumbers, threshold_range: ThresholdRange | None) -> Iterator[tuple[str, str]]:
    limits = [parameter for parameter in atom.parameters if isinstance(parameter, float)]
    lengths = limits if atom.relation in _LENGTH_RELATIONS else []
    for length in lengths:
        if length < 0.0 and atom.relation != "dist":
            yield f"{atom.relation!r} with the negative length {format_number(length)}", "is it a slip?"
        elif 0.0 < log.extent * _FAR < abs(length):
            message = f"{format_number(length)} is far more than anything in the log is apart"
            yield message, f"all that it has lies within {log.extent:.4g}; is the unit the same?"
    is_ever_present = all(log.missing.get(part, (0, 0))[0] < log.samples for part in named_parts(atom))
    if (
        threshold_range is not None
        and not threshold_range.known
        and atom.relation == "signal"
        and is_ever_present
    ):
        hint = "put a text in quotes; `names` of a mapping give texts numbers, and numbers texts"
        yield f"`{threshold_range.text}` compares a text with a number, so it is unknown", hint
    if threshold_range is None or threshold_range.holds not in ("always", "never"):
        return
    if (
        not limits
        and atom.relation == "signal"
        and (threshold_range.holds == "never") == ("==" in atom.parameters)
    ):
        name, _, compared_text = atom.parameters
        hint = "is it spelt so? with `names` in a mapping, a misspelt text is an error"
        yield f"{name} is never {compared_text} in this log", hint
    for limit in limits:
        if _is_far(limit, threshold_range, is_length=bool(lengths)):
            is_below = limit < threshold_range.least
            range_end, side = (
                (threshold_range.least, "below") if is_below else (threshold_range.greatest, "above")
            )
            subject = (
                "the distance is" if lengths else "its signal is" if atom.relation == "signal" else "it is"
            )
            message = (
                f"`{threshold_range.text}` {threshold_range.holds} holds in this log:"
                f" {subject} never {side} {range_end:.4g}"
            )
            yield message, f"no value comes near {format_number(limit)}; is it the threshold you mean?"


def _is_far(limit: float, threshold_range: ThresholdRange, *, is_length: bool) -> bool:
    """Return whether a threshold is out of reach of the measured range."""
    least, greatest = threshold_range.least, threshold_range.greatest
    if least <= limit <= greatest:
        return False
    if is_length and limit < 0.0:
        # only overlapping footprints have a negative distance
        return True
    # a limit is near if its distance to the range is at most the width of the range, or the size of an end
    reach = max(greatest - least, abs(least), abs(greatest))
    if limit < least - reach or limit > greatest + reach:
        return True
    # lengths and speeds are positive, so they are also compared by their ratio
    if least > 0.0 and limit > 0.0:
        return limit < least / _APART or limit > greatest * _APART
    return False


def _doubts_of_window(text: str, bound: Bound, log: LogNumbers) -> Iterator[tuple[str, str]]:
    if not log.samples:
        return
    is_in_seconds = bound.unit != "samples"
    log_length = log.times_ns[1] - log.times_ns[0] if is_in_seconds else log.samples - 1
    length_text = f"{log.seconds:.3f} s" if is_in_seconds else plural(log.samples, "sample")
    if bound.lower > log_length:
        yield f"no sample of this log lies in the window {text}", f"the log has {length_text}"
    elif bound.upper is not None and bound.upper > log_length:
        yield f"the window {text} is longer than this log", f"the log has {length_text}, so its end decides"


def _distance(outline: Outline, box: tuple[float, float, float, float]) -> float:
    """Return the gap between the bounding boxes of an outline and of the log; 0 if they meet."""
    xs, ys = zip(*outline.vertices, strict=True)
    gap_x = max(box[0] - max(xs), min(xs) - box[2], 0.0)
    gap_y = max(box[1] - max(ys), min(ys) - box[3], 0.0)
    return max(0.0, hypot(gap_x, gap_y) - outline.radius)


def _compared_quantity(atom: Atom) -> Expression | None:
    """Return the only signal or distance that an atom compares; None for other atoms."""
    if atom.relation == "sum":
        return None
    quantities = {
        part for part in iter_expressions(atom.expression) if isinstance(part, (Signal, Measurement))
    }
    part = quantities.pop() if len(quantities) == 1 else None
    has_limit = atom.relation == "signal" or any(
        isinstance(parameter, float) for parameter in atom.parameters
    )
    return part if isinstance(part, (Signal, SignedDistance)) and has_limit else None


def _key(atom: Atom, bound: tuple[Quantified, ...]) -> tuple[str, ...]:
    return (atom.text, *(f"{quantifier.variables} {quantifier.group}" for quantifier in bound))


def over_bindings(
    quantifier: Literal["forall", "exists"], bound: tuple[Quantified, ...], atom: Atom
) -> Atom | Quantified:
    """Return an atom with all its quantifiers replaced by `forall`, or all by `exists`."""
    formula: Atom | Quantified = atom
    for binding in reversed(bound):
        formula = Quantified(quantifier, binding.variables, binding.group, formula)
    return formula


def bound_nodes(specification: Specification) -> Iterator[tuple[Formula, tuple[Quantified, ...]]]:
    """Yield every node; atoms come with the quantifiers that bind their variables, outermost first."""
    for spec in specification.results:
        for node, quantifiers in iter_bound(spec.formula):
            yield node, _binding(node, quantifiers, spec.parameter) if isinstance(node, Atom) else ()


def _binding(
    atom: Atom, quantifiers: tuple[Quantified, ...], parameter: str | None
) -> tuple[Quantified, ...]:
    """Return the quantifiers that bind variables of an atom, or variables of these quantifiers' groups.

    A template parameter ranges over all objects that the atom does not name, because an object is not to be
    compared with itself.
    """
    variables = _variables([*terms_of(atom.expression), *atom.terms])
    bound: list[Quantified] = []
    for quantifier in reversed(quantifiers):
        if variables.intersection(quantifier.variables):
            bound.insert(0, quantifier)
            variables = variables.difference(quantifier.variables) | _variables([quantifier.group])
    if parameter is not None and parameter in variables:
        named_objects = tuple(
            term for term in map(base_of, terms_of(atom.expression)) if isinstance(term, TrackedName)
        )
        all_objects = Group("", class_name=ANY_CLASS, excluded=named_objects)
        bound.insert(0, Quantified("forall", (parameter,), all_objects, atom))
    return tuple(bound)


def _variables(terms: Iterable[Term]) -> frozenset[str]:
    bases = [base_of(term) for term in terms]
    excluded_terms = [term for base in bases if isinstance(base, Group) for term in base.excluded]
    return frozenset(term.name for term in [*bases, *excluded_terms] if isinstance(term, Variable))
