"""The deciding path of a node: from the node to its deciding leaf and atom, at the deciding sample.

Robustness consists of minima and maxima only, so it equals the number of one leaf at one sample, perhaps
negated. The path to this leaf follows one end of the interval (see `End`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise, permutations, product
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.geometry.measure import Contact, candidate_pairs, contact, enlarge, protrusion_contact
from spatial_replay.monitor.atoms.instructions import closest_pair_of
from spatial_replay.monitor.atoms.measurements import leaf_values, measurement_values
from spatial_replay.monitor.atoms.terms import Bindings, TraceScene
from spatial_replay.monitor.offline import OfflineNodes, is_closed, windows_of
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.spec.format import format_formula, format_term
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    BooleanOperator,
    DerivedTerm,
    Earlier,
    Equality,
    Expression,
    Formula,
    Group,
    Maximum,
    Measurement,
    Minimum,
    Negative,
    Number,
    Present,
    Product,
    Projection,
    Protrusion,
    Quantified,
    Rate,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    TrackedName,
    Truth,
    operands_of,
    operator_of,
    rate_conditions,
)
from spatial_replay.spec.walks import (
    base_of,
    iter_expressions,
    logged_signals,
    named_members,
    standing,
    substitute,
    terms_of,
)
from spatial_replay.text import is_text_number, shortened_formula
from spatial_replay.trace.trace import ABSENT

_Number = TypeVar("_Number")

Interval = tuple[float, float]


class End(Enum):
    """The deciding end of an interval.

    The low end decides a satisfied formula, because it is at least 0. The high end decides a violated
    formula. Other formulas are `OPEN`. The path of an open formula follows the low ends of minima and the
    high ends of maxima, so it ends at an open operand.
    """

    LOW = "low"
    HIGH = "high"
    OPEN = "open"

    @classmethod
    def of(cls, verdict: Verdict) -> End:
        """Return the end that decides a verdict."""
        return {Verdict.SATISFIED: cls.LOW, Verdict.VIOLATED: cls.HIGH}.get(verdict, cls.OPEN)

    @property
    def turned(self) -> End:
        """The deciding end of a negation's operand."""
        return {End.LOW: End.HIGH, End.HIGH: End.LOW, End.OPEN: End.OPEN}[self]

    def of_minimum(self, low: _Number, high: _Number) -> _Number:
        """Return the ends that a minimum compares to choose its operand, given low and high ends."""
        return high if self is End.HIGH else low

    def of_maximum(self, low: _Number, high: _Number) -> _Number:
        """Return the ends that a maximum compares to choose its operand, given low and high ends."""
        return low if self is End.LOW else high


@dataclass(frozen=True, slots=True)
class SignedOperand:
    """An operand of a minimum or a maximum, by index, possibly negated."""

    index: int
    negated: bool = False


class Extremum(NamedTuple):
    """A minimum or a maximum of operands or of other extrema."""

    is_minimum: bool
    operands: tuple[SignedOperand | Extremum, ...]


def extremum_of(operator: BooleanOperator, operands: Sequence[int]) -> SignedOperand | Extremum:
    """Return a Boolean operator as minima and maxima of the operands with the given indices."""
    # distinct stand-ins, because equal operands of the text may be a single Python object
    stand_ins = tuple(Truth(True) for _ in operands)
    operand_of_id = {id(stand_in): number for stand_in, number in zip(stand_ins, operands, strict=True)}
    formula = Boolean(operator, stand_ins)
    return _normal_form(formula.expansion or formula, operand_of_id, negated=False)


def _normal_form(
    formula: Formula, operand_of_id: Mapping[int, int], *, negated: bool
) -> SignedOperand | Extremum:
    if id(formula) in operand_of_id:
        return SignedOperand(operand_of_id[id(formula)], negated)
    operator = operator_of(formula)
    if operator == "not":
        return _normal_form(operands_of(formula)[0], operand_of_id, negated=not negated)
    operands = tuple(
        _normal_form(operand, operand_of_id, negated=negated) for operand in operands_of(formula)
    )
    return Extremum((operator == "and") != negated, operands)


def attaining_operands(
    part: SignedOperand | Extremum, end: End, interval: Callable[[int], Interval]
) -> list[SignedOperand]:
    """Return the operands that attain an extremum, in the order of its operands.

    Args:
        interval: returns the low and high end of an operand, before negation.
    """
    if isinstance(part, SignedOperand):
        return [part]
    choose = end.of_minimum if part.is_minimum else end.of_maximum
    compared_ends = [choose(*_interval(operand, interval)) for operand in part.operands]
    best_end = min(compared_ends) if part.is_minimum else max(compared_ends)
    best_parts = [
        operand
        for operand, compared_end in zip(part.operands, compared_ends, strict=True)
        if compared_end == best_end
    ]
    return [operand for best_part in best_parts for operand in attaining_operands(best_part, end, interval)]


def _interval(part: SignedOperand | Extremum, interval: Callable[[int], Interval]) -> Interval:
    if isinstance(part, SignedOperand):
        low, high = interval(part.index)
        return (-high, -low) if part.negated else (low, high)
    lows, highs = zip(*(_interval(operand, interval) for operand in part.operands), strict=True)
    return (min(lows), min(highs)) if part.is_minimum else (max(lows), max(highs))


class PathNode(NamedTuple):
    """A node at a sample on a deciding path.

    Attributes:
        node: node id.
        sample: index among the evaluated samples.
    """

    node: int
    sample: int


class DecidingPath(NamedTuple):
    """The path down from a node.

    Attributes:
        steps: at least one step. The last step is a leaf, `true` or `false`, or an operator without a sample.
            The window of such an operator is empty, beyond the log, or has only samples that are left out.
        end: deciding end of the last node's interval.
    """

    steps: tuple[PathNode, ...]
    end: End


def deciding_path(nodes: OfflineNodes, node: int, end: End, *, sample: int = 0) -> DecidingPath:
    """Return the deciding path of a node at a sample.

    Ties between operands go to the path that ends at the earliest sample, then to the first operand. Ties in
    a window go to the earliest sample.
    """
    return _Walk(nodes).follow(node, sample, end)


class _Walk:
    """Follows deciding paths in the tree of a formula, by every node's numbers."""

    def __init__(self, nodes: OfflineNodes) -> None:
        self._nodes = nodes

    def follow(self, node: int, sample: int, end: End) -> DecidingPath:
        step, (formula, operands) = PathNode(node, sample), self._nodes.tree[node]
        match formula:
            case Boolean():
                extremum = extremum_of(formula.operator, operands)
                paths = [
                    self.follow(operand.index, sample, end.turned if operand.negated else end)
                    for operand in attaining_operands(
                        extremum, end, lambda index: self._nodes.interval(index, sample)
                    )
                ]
                # `min` returns the first of equal keys, so the first operand wins ties
                operand_path = min(paths, key=lambda path: path.steps[-1].sample)
            case Temporal():
                lasting_step = self._lasting(node, sample, end) if self._nodes.goes_on else None
                next_step = lasting_step or self._deciding_operand(formula, operands, sample, end)
                if next_step is None or self._nodes.is_left_out(next_step.node, next_step.sample):
                    return DecidingPath((step,), end)
                operand_path = self.follow(next_step.node, next_step.sample, end)
                if end is End.OPEN and not self._is_open(operand_path.steps[-1]):
                    # the operand is certain, but it is unknown whether its rates have values
                    operand_path = next(self._unknown_rates(next_step.node, next_step.sample), operand_path)
            case _:
                return DecidingPath((step,), end)
        return DecidingPath((step, *operand_path.steps), operand_path.end)

    def _is_open(self, step: PathNode) -> bool:
        low, high = self._nodes.interval(step.node, step.sample)
        return low < 0.0 <= high

    def _unknown_rates(self, node: int, sample: int) -> Iterator[DecidingPath]:
        """Iterate over the paths to unknown rates in the operand of an operator."""
        step, (formula, operands) = PathNode(node, sample), self._nodes.tree[node]
        match formula:
            case Atom() if rate_conditions(formula) and self._is_open(step):
                yield DecidingPath((step,), End.OPEN)
                return
            case Temporal(operator="X" | "WX"):
                sample += 1
            case Temporal(operator="Y"):
                sample -= 1
            case Temporal() | Quantified():
                return
        if 0 <= sample < len(self._nodes.times_ns):
            for operand in operands:
                for operand_path in self._unknown_rates(operand, sample):
                    yield DecidingPath((step, *operand_path.steps), End.OPEN)

    def _ends(self, operand: SignedOperand, samples: slice) -> tuple[Floats, Floats]:
        low, high = (column[samples] for column in self._nodes.judged_ends(operand.index))
        return (-high, -low) if operand.negated else (low, high)

    def _deciding_operand(
        self, formula: Temporal, operands: Sequence[int], sample: int, end: End
    ) -> PathNode | None:
        """Return the operand and sample that decide an operator's number; None for an empty window."""
        *_, right = operands
        window = self._window(formula, sample)
        if not len(window):
            return None
        match formula.operator:
            case "G" | "H" | "WX":
                return self._extreme(SignedOperand(right), window, end, is_minimum=True)
            case "F" | "O" | "X" | "Y":
                return self._extreme(SignedOperand(right), window, end, is_minimum=False)
            case "R":
                left, right = operands
                return self._until(
                    SignedOperand(left, True), SignedOperand(right, True), sample, window, end.turned
                )
            case "W":
                return self._weak_until(operands, sample, window, end)
        left, right = operands
        is_ahead = formula.operator == "U"
        return self._until(SignedOperand(left), SignedOperand(right), sample, window, end, is_ahead=is_ahead)

    def _lasting(self, node: int, sample: int, end: End) -> PathNode | None:
        """Return the least left operand so far of an until with an open window, if it decides the until.

        The result is None for the low end, because later samples cannot lower this end.
        """
        formula, operands = self._nodes.tree[node]
        if not isinstance(formula, Temporal) or formula.operator not in ("U", "R"):
            return None
        left, (low, high) = SignedOperand(operands[0]), self._nodes.interval(node, sample)
        if formula.operator == "R":
            left, end, high = SignedOperand(left.index, True), end.turned, -low
        if end is End.LOW or is_closed(formula.bound, self._nodes.times_ns)[sample]:
            return None
        left_ends = self._ends(left, slice(sample, None))[1]
        return PathNode(left.index, sample + int(np.argmin(left_ends))) if left_ends.min() == high else None

    def _window(self, formula: Temporal, sample: int) -> range:
        # a single window, because the windows of all samples made explanations several times slower
        begin, end = windows_of(formula, self._nodes.times_ns, np.array([sample]))
        return range(int(begin[0]), int(end[0]))

    def _extreme(self, operand: SignedOperand, window: range, end: End, *, is_minimum: bool) -> PathNode:
        low, high = self._ends(operand, slice(window.start, window.stop))
        if is_minimum:
            return PathNode(operand.index, window[int(np.argmin(end.of_minimum(low, high)))])
        return PathNode(operand.index, window[int(np.argmax(end.of_maximum(low, high)))])

    def _until(
        self,
        left: SignedOperand,
        right: SignedOperand,
        sample: int,
        window: range,
        end: End,
        *,
        is_ahead: bool = True,
    ) -> PathNode:
        """Return the operand and sample that decide an until, or a since if `is_ahead` is false."""
        span = slice(sample, window.stop) if is_ahead else slice(window.start, sample + 1)
        left_ends, right_ends = self._ends(left, span), self._ends(right, slice(window.start, window.stop))
        left_minima = [_least_between(numbers, is_ahead=is_ahead) for numbers in left_ends]
        window_slice = slice(window.start - span.start, window.stop - span.start)
        low, high = (
            np.minimum(right_numbers, left_least[window_slice])
            for right_numbers, left_least in zip(right_ends, left_minima, strict=True)
        )
        best_sample = window[int(np.argmax(end.of_maximum(low, high)))]
        right_number = float(end.of_minimum(*right_ends)[best_sample - window.start])
        left_samples = range(sample, best_sample) if is_ahead else range(best_sample + 1, sample + 1)
        left_numbers = end.of_minimum(*left_ends)[
            left_samples.start - span.start : left_samples.stop - span.start
        ]
        left_steps = (
            [PathNode(left.index, left_samples[int(np.argmin(left_numbers))])] if len(left_samples) else []
        )
        least_left = float(left_numbers.min()) if len(left_samples) else np.inf
        # a tie goes to the earlier sample
        if right_number == least_left:
            return min([*left_steps, PathNode(right.index, best_sample)], key=lambda step: step.sample)
        return left_steps[0] if least_left < right_number else PathNode(right.index, best_sample)

    def _weak_until(self, operands: Sequence[int], sample: int, window: range, end: End) -> PathNode:
        """Return the operand and sample that decide a weak until: the maximum of `phi U psi` and `G phi`."""
        left, right = map(SignedOperand, operands)
        window_slice = slice(window.start, window.stop)
        left_ends, right_ends = self._ends(left, slice(sample, window.stop)), self._ends(right, window_slice)
        left_minima = [
            _least_between(numbers, is_ahead=True)[window.start - sample :] for numbers in left_ends
        ]
        until_ends = [float(np.max(np.minimum(*pair))) for pair in zip(right_ends, left_minima, strict=True)]
        always_ends = [float(np.min(numbers)) for numbers in self._ends(left, window_slice)]
        compared_ends = [
            float(end.of_maximum(np.array(low), np.array(high))) for low, high in (until_ends, always_ends)
        ]
        if compared_ends[0] >= compared_ends[1]:
            return self._until(left, right, sample, window, end)
        return self._extreme(left, window, end, is_minimum=True)


def _least_between(column: Floats, *, is_ahead: bool) -> Floats:
    """Return the minimum of the column before each place; after each place if not `is_ahead`."""
    ordered_column = column if is_ahead else column[::-1]
    minima = np.minimum.accumulate(np.concatenate([[np.inf], ordered_column[:-1]]))
    return minima if is_ahead else minima[::-1]


@dataclass(frozen=True, slots=True)
class MissedResponse:
    """A failed implication on the deciding path: its condition held, and its response did not hold.

    Attributes:
        condition, response: name or shortened text of the condition, and of the response.
        time_ns: time of the sample at which the condition held.
        is_condition: whether the deciding atom is in the condition.
    """

    condition: str
    response: str
    time_ns: int
    is_condition: bool


def short_title(formula: Formula) -> str:
    """Return the name of a formula, or its shortened text."""
    return formula.name or shortened_formula(format_formula(formula))


def missed_response(
    path: DecidingPath, nodes: OfflineNodes, bindings: Bindings = MappingProxyType({})
) -> tuple[MissedResponse | None, DecidingPath | None]:
    """Return the outermost failed implication on the path of a violated formula, or None.

    If the condition decides, also return the path to the atom that came closest to fulfilling the response.

    Args:
        bindings: objects by the names of variables.
    """
    for step, next_step in pairwise(path.steps):
        node, operands = nodes.tree[step.node]
        if operator_of(node) == "->" and nodes.ends(step.node)[1][step.sample] < 0.0:
            condition, response = (
                short_title(substitute(operand, bindings)) for operand in operands_of(node)
            )
            time_ns, is_condition = int(nodes.times_ns[step.sample]), next_step.node == operands[0]
            closest_path = (
                deciding_path(nodes, operands[1], End.HIGH, sample=step.sample) if is_condition else None
            )
            return MissedResponse(condition, response, time_ns, is_condition), closest_path
    return None, None


def unknowns_of(scene: TraceScene, atom: Atom) -> tuple[str, ...]:
    """Return the distinct reasons why an atom is unknown in the single sample of a scene."""
    parts = list(iter_expressions(atom.expression))
    compared_signals = [part.signal for part in parts if isinstance(part, Equality)]
    reasons = (reason for part in parts if part not in compared_signals for reason in _reasons(scene, part))
    return tuple(dict.fromkeys(reasons))


def _reasons(scene: TraceScene, part: Expression) -> Iterator[str]:
    match part:
        case Rate():
            is_explained = scene.compared_ns(part) is not None
            for inner_part in (part.signal,) if part.signal else map(_position, part.terms):
                reasons = tuple(_reasons(scene, inner_part))
                is_explained = is_explained or bool(reasons)
                yield from reasons
            if not is_explained:
                rate_text = part.signal.name if part.signal else " and ".join(map(format_term, part.terms))
                yield f"{rate_text} has no report to compare with, or none of an earlier time"
        case Signal() | Equality():
            signal, compared_value = (part, 0.0) if isinstance(part, Signal) else (part.signal, part.value)
            name, value = signal.name, scene.signal(signal)[0]
            if any(name_of_part not in scene.trace.signals for name_of_part in logged_signals(signal)):
                yield f"there is no signal {name!r}"
            elif not np.isfinite(value):
                yield f"signal {name!r} has no finite value in the sample"
            elif is_text_number(compared_value) != is_text_number(value):
                kind_text = "a text, not a number; `names` of its mapping give texts numbers"
                if is_text_number(compared_value):
                    kind_text = "a number, not a text; `names` of its mapping give numbers names"
                yield f"signal {name!r} is {kind_text}"
        case Number() | Sum() | Negative() | Minimum() | Maximum() | Product() | Scaled():
            return
        case _:
            for term in terms_of(part):
                yield from _reasons_of_term(scene, part, term)


def _position(term: Term) -> Projection:
    """Return a coordinate of a term, which is unknown if the position of the term is unknown."""
    return Projection(term, "x", "min")


def _reasons_of_term(scene: TraceScene, part: Expression, term: Term) -> Iterator[str]:
    resolved_term = scene.resolve(term)
    if resolved_term.unknown[0]:
        yield from _missing(scene, term)
    elif isinstance(part, Measurement) and part.needs_orientation and np.isnan(resolved_term.yaw[0]):
        yield f"{format_term(term)} has no orientation"
    elif isinstance(part, Projection) and part.axis == "z":
        rows = resolved_term.operand.rows[0]
        bottoms = scene.batch.bottom[rows[rows >= 0]]
        if np.isnan(bottoms).any():
            yield f"{format_term(term)} has no height"


def _missing(scene: TraceScene, term: Term) -> Iterator[str]:
    """Iterate over the reasons why a term is unknown."""
    term = standing(term)
    if isinstance(term, Earlier) and _is_before_the_first(scene, term):
        yield f"{format_term(term)} looks back to before the first sample"
        return
    member_names = _members(base_of(term))
    rows = scene.resolve(term).operand.rows[0]
    for name, row in zip(member_names or [format_term(term)] * len(rows), rows.tolist(), strict=True):
        time_text = " then" if isinstance(term, Earlier) else ""
        if row < ABSENT:
            yield f"the position of {name} is unknown{time_text}"
        elif row == ABSENT and member_names:
            yield f"{name} is not in the sample{time_text and f' that {format_term(term)} looks at'}"


def _members(base: Term) -> Sequence[str]:
    """Return the named objects of a term; none for an open group."""
    match base:
        case TrackedName():
            return [base.name]
        case Group():
            return named_members(base)
    return ()


def _is_before_the_first(scene: TraceScene, term: Earlier) -> bool:
    if term.samples is not None:
        return term.samples > scene.skip
    times_ns = scene.trace.times_ns
    return int(times_ns[scene.skip]) - (term.duration_ns or 0) < int(times_ns[0])


@dataclass(frozen=True, slots=True)
class Measured:
    """A number that decides an atom.

    Attributes:
        quantity: "signed_distance", "protrusion", "max_x", …, "misalignment", "signal", "present", "speed" or
            "rate".
        names: measured objects or regions with delays and enlargements, or the signal.
        value: the number.
        spread: uncertainty of the number, from the uncertainty of the objects.
        contact: closest points of a distance; else None.
        reports_ns: times of the two reports that a rate compares; else None.
    """

    quantity: str
    names: tuple[str, ...]
    value: float
    spread: float = 0.0
    contact: Contact | None = None
    reports_ns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class DecidingAtom:
    """An atom in one sample.

    Attributes:
        atom: the atom, with objects instead of variables.
        end: deciding end of the atom's interval.
        value: robustness of the atom with every uncertainty at 0; NaN if unknown.
        lower, upper: ends of the atom's interval.
        branch: summands of the robustness: numbers, signals and measurements, each with a weight such as -1.
            It is empty if the atom is unknown.
        measured: signals and measurements among the summands.
        unknown: reasons why the atom is unknown.
    """

    atom: Atom = field(repr=False)
    end: End
    value: float
    lower: float
    upper: float
    branch: tuple[tuple[float, Expression], ...] = field(repr=False)
    measured: tuple[Measured, ...]
    unknown: tuple[str, ...]

    @property
    def text(self) -> str:
        """The text of the atom, with objects instead of variables."""
        return self.atom.text

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the atom's objects, regions and groups, in the order of the text."""
        bases = (base_of(term) for term in self.atom.terms)
        return tuple(dict.fromkeys(base.name or format_term(base) for base in bases))


def deciding_atom(scene: TraceScene, leaf: Formula, end: End) -> DecidingAtom | None:
    """Return the atom that decides a leaf in the single sample of a scene; None for an empty group."""
    while not isinstance(leaf, Atom):
        operand_and_end = _below(scene, leaf, end)
        if operand_and_end is None:
            return None
        leaf, end = operand_and_end
    (nominal_interval,), ((lower, upper),) = (_intervals(scene, [leaf], wide=wide) for wide in (False, True))
    value = nominal_interval[0] if nominal_interval[0] == nominal_interval[1] else float("nan")
    unknown_reasons = unknowns_of(scene, leaf)
    branch = () if unknown_reasons else tuple(_branch(scene, leaf.expression, end, 1))
    measurements = tuple(_measurement_of(scene, part) for _, part in branch if not isinstance(part, Number))
    return DecidingAtom(leaf, end, value, lower, upper, branch, measurements, unknown_reasons)


def failed_implication(scene: TraceScene, leaf: Formula, end: End) -> tuple[Formula, Formula, bool] | None:
    """Return the condition and the response of the outermost failed implication below a quantifier.

    The third value is whether the deciding atom of the leaf is in the condition.
    """
    while not isinstance(leaf, Atom):
        operand_and_end = _below(scene, leaf, end)
        if operand_and_end is None:
            return None
        if operator_of(leaf) == "->" and _intervals(scene, [leaf])[0][1] < 0.0:
            condition, response = operands_of(leaf)
            return condition, response, operand_and_end[0] is condition
        leaf, end = operand_and_end
    return None


def _intervals(scene: TraceScene, formulas: Sequence[Formula], *, wide: bool = True) -> list[Interval]:
    """Return the interval of each formula in the single sample of a scene."""
    values = leaf_values(scene, formulas, {})[:, :, 0]
    low_channel, high_channel = low_and_high(len(values), wide=wide)
    return [
        (float(low_end), float(high_end))
        for low_end, high_end in zip(values[low_channel], values[high_channel], strict=True)
    ]


def _below(scene: TraceScene, leaf: Formula, end: End) -> tuple[Formula, End] | None:
    """Return the operand or binding that decides a leaf, and its deciding end."""
    match leaf:
        case Boolean():
            formulas = list(leaf.operands)
            extremum = extremum_of(leaf.operator, range(len(formulas)))
        case Quantified():
            formulas = _judged_bodies(scene, leaf)
            extremum = Extremum(leaf.quantifier == "forall", tuple(map(SignedOperand, range(len(formulas)))))
        case _:
            return None
    if not formulas:
        return None
    intervals = _intervals(scene, formulas)
    chosen_operand, *_ = attaining_operands(extremum, end, intervals.__getitem__)
    return formulas[chosen_operand.index], end.turned if chosen_operand.negated else end


def _judged_bodies(scene: TraceScene, formula: Quantified) -> list[Formula]:
    """Return the bodies of the bindings that a quantifier does not leave out."""
    bodies = list(_bodies(scene, formula))
    if not rate_conditions(formula.body):
        return bodies
    rate_intervals = _intervals(scene, [Boolean("and", tuple(rate_conditions(body))) for body in bodies])
    # a condition of -inf: a rate of the body has no value
    return [body for body, (_, high) in zip(bodies, rate_intervals, strict=True) if high > -np.inf]


def _bodies(scene: TraceScene, formula: Quantified) -> Iterator[Formula]:
    """Iterate over a quantifier's body for all bindings that may decide it."""
    names, members, _ = scene.members(formula.group)
    present_names = [name for name, is_member in zip(names, members[0].tolist(), strict=True) if is_member]
    for object_names in _may_decide(scene, formula, present_names):
        yield substitute(
            formula.body, dict(zip(formula.variables, map(TrackedName, object_names), strict=True))
        )


def _may_decide(
    scene: TraceScene, formula: Quantified, present_names: Sequence[str]
) -> Iterable[tuple[str, ...]]:
    """Return the bindings that may decide a quantifier: near pairs for a distance, else all bindings."""
    pair = closest_pair_of(formula)
    all_bindings = permutations(present_names, len(formula.variables))
    if pair is None or len(present_names) < 3:
        return all_bindings
    rows = np.array([scene.resolve(TrackedName(name)).operand.rows[0, 0] for name in present_names])
    # an object with unknown position may decide, too
    if (rows < 0).any():
        return all_bindings
    near_pairs = candidate_pairs(scene.batch, rows, scene.trace.uncertainty, pair.enlargement)
    return [(present_names[a], present_names[b]) for a, b in near_pairs.tolist()]


# ------------------------------------------------------------------------------------------ expressions


def _branch(
    scene: TraceScene, expression: Expression, end: End, weight: float
) -> Iterator[tuple[float, Expression]]:
    """Iterate over the weights and summands of an expression; of a minimum or maximum, its chosen operand."""
    match expression:
        case Sum():
            yield from _branch(scene, expression.first, end, weight)
            yield from _branch(scene, expression.second, end, weight)
        case Negative():
            yield from _branch(scene, expression.operand, end.turned, -weight)
        case Product(factor, operand):
            yield from _branch(scene, operand, end, weight * factor)
        case Scaled(operand, divisor):
            yield from _branch(scene, operand, end, weight / divisor)
        case Equality():
            yield weight, expression.signal
        case Minimum() | Maximum():
            operands = expression.operands
            intervals = _intervals(scene, [_as_atom(operand) for operand in operands])
            extremum = Extremum(
                isinstance(expression, Minimum), tuple(map(SignedOperand, range(len(operands))))
            )
            chosen_operand, *_ = attaining_operands(extremum, end, intervals.__getitem__)
            yield from _branch(scene, operands[chosen_operand.index], end, weight)
        case _:
            yield weight, expression


def _as_atom(expression: Expression) -> Atom:
    return Atom("", "", expression)


# ----------------------------------------------------------------------------------------- measurements


def _measurement_of(scene: TraceScene, part: Expression) -> Measured:
    """Return the number of a signal or measurement, with the deciding members instead of groups."""
    match part:
        case Rate():
            low, high = _intervals(scene, [_as_atom(part)])[0]
            names = tuple(map(format_term, part.terms)) or ((part.signal or part).name,)
            quantity, reports_ns = "speed" if part.terms else "rate", scene.compared_ns(part)
            # the ends of the interval are value - spread and value + spread
            return Measured(quantity, names, (low + high) / 2, (high - low) / 2, reports_ns=reports_ns)
        case Present():
            return Measured("present", (part.term.name,), float(scene.signal(part)[0]))
        case Signal():
            return Measured("signal", (part.name,), float(scene.signal(part)[0]))
        case Measurement():
            single_measurement = _attaining(scene, part)
        case _:
            raise TypeError(f"{part!r} is no measurement")
    (value,), (spread,) = (
        column[:, 0].tolist() for column in measurement_values(scene, [single_measurement])
    )
    return Measured(
        single_measurement.quantity,
        tuple(map(format_term, single_measurement.terms)),
        value,
        spread,
        _contact(scene, single_measurement),
    )


def _attaining(scene: TraceScene, part: Measurement) -> Measurement:
    """Return a measurement with the deciding members instead of groups."""
    single_terms = [_singles(scene, term) for term in part.terms]
    candidates = [part.with_terms(*terms) for terms in product(*single_terms)]
    values, candidate_indices = measurement_values(scene, candidates)[0][:, 0], np.arange(len(candidates))
    for side_terms, side in zip(reversed(single_terms), reversed(part.extrema), strict=True):
        value_rows = values.reshape(-1, len(side_terms))
        best_columns = (np.argmin if side == "min" else np.argmax)(value_rows, axis=1)
        row_numbers = np.arange(len(value_rows))
        values, candidate_indices = (
            value_rows[row_numbers, best_columns],
            candidate_indices.reshape(value_rows.shape)[row_numbers, best_columns],
        )
    return candidates[int(candidate_indices[0])]


def _singles(scene: TraceScene, term: Term) -> list[Term]:
    """Return the single objects or regions of a term in the sample; the term itself for an empty group."""
    base = base_of(term)
    if not isinstance(base, Group):
        return [term]
    if base.members is None:
        group: Any = standing(term)
        names, members, _ = scene.members(group)
        present_names = [
            name for name, is_member in zip(names, members[0].tolist(), strict=True) if is_member
        ]
    else:
        present_names = [*named_members(base)]
    return [_of_member(term, name) for name in present_names] or [term]


def _of_member(term: Term, name: str) -> Term:
    if not isinstance(term, DerivedTerm):
        return TrackedName(name)
    inner_term: Any = _of_member(term.term, name)
    return replace(term, term=inner_term)


def _contact(scene: TraceScene, part: Measurement) -> Contact | None:
    match part:
        case SignedDistance():
            first_footprint, second_footprint = _footprint(scene, part.first), _footprint(scene, part.second)
            return (
                contact(first_footprint, second_footprint) if first_footprint and second_footprint else None
            )
        case Protrusion():
            inner_footprint, outer_footprint = _footprint(scene, part.inner), _footprint(scene, part.outer)
            return (
                protrusion_contact(inner_footprint, outer_footprint)
                if inner_footprint and outer_footprint
                else None
            )
    return None


def _footprint(scene: TraceScene, term: Term) -> Footprint | None:
    """Return the footprint of a single object or region; None for an empty group."""
    operand = scene.resolve(term).operand
    rows = operand.rows[0]
    if len(rows) != 1 or rows[0] < 0:
        return None
    return enlarge(scene.batch.footprint(int(rows[0])), operand.enlargement)
