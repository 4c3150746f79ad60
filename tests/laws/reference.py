"""What formulas mean, by the definitions alone: slow, recursive, and nothing of the monitor's own.

Everything is an interval: [x, x] where a number is known, [-inf, inf] where nothing is. A `Prefix` is a run
of samples; its `rho` is a formula's robustness at one of them. `Observed` gives the atoms, from footprints
and another geometry library.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import shapely

from spatial_replay import ConvexPart, Footprint, TrackedObject
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Boolean,
    Centre,
    CentroidProjection,
    Earlier,
    Enlarged,
    Equality,
    Expression,
    Formula,
    Group,
    HasRate,
    Maximum,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Outline,
    Present,
    Product,
    Projection,
    Protrusion,
    Quantified,
    Rate,
    RegionName,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    Truth,
    Variable,
    iter_nodes,
)


class Interval(NamedTuple):
    low: float
    high: float

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)


ANYTHING = Interval(-math.inf, math.inf)
TRUE = Interval(math.inf, math.inf)
FALSE = Interval(-math.inf, -math.inf)


def least(intervals: Sequence[Interval]) -> Interval:
    return Interval(min((i.low for i in intervals), default=math.inf),
                    min((i.high for i in intervals), default=math.inf))  # fmt: skip


def greatest(intervals: Sequence[Interval]) -> Interval:
    return Interval(max((i.low for i in intervals), default=-math.inf),
                    max((i.high for i in intervals), default=-math.inf))  # fmt: skip


def combine(operator: str, operands: Sequence[Interval]) -> Interval:
    """A Boolean operator over intervals."""
    first, second = operands[0], operands[-1]
    match operator:
        case "spec":
            return first
        case "not":
            return -first
        case "and":
            return least(operands)
        case "or":
            return greatest(operands)
        case "->":
            return greatest([-first, second])
        case "xor":
            return greatest([least([first, -second]), least([-first, second])])
        case "<->":
            return least([greatest([-first, second]), greatest([-second, first])])
    raise ValueError(operator)


def leave_out(body: Interval, has_rates: Interval, is_implied: bool) -> Interval:
    """A body where its rates have values: `has_rates -> body`, or `has_rates and body`."""
    return greatest([-has_rates, body]) if is_implied else least([has_rates, body])


def has_value_atoms(formula: Formula) -> list[Atom]:
    """That each rate has a value, of those below no operator but Booleans, X, WX and Y."""
    match formula:
        case Atom():
            parts = [formula.expression]
            for part in parts:
                match part:
                    case Sum():
                        parts += [part.first, part.second]
                    case Negative() | Product() | Scaled():
                        parts.append(part.operand)
                    case Minimum() | Maximum():
                        parts += part.operands
            rates = [part for part in parts if isinstance(part, Rate)]
            return [Atom("", "signal", Equality(HasRate("", each), 1.0)) for each in rates]
        case Boolean() | Temporal(operator="X" | "WX" | "Y"):
            return [atom for each in formula.operands for atom in has_value_atoms(each)]
    return []


# ------------------------------------------------------------------------------------ temporal operators

Leaf = Callable[[Formula, int], Interval]


class Prefix:
    """The samples of a run so far; what follows them is nothing, or (`goes_on`) anything."""

    def __init__(self, times_ns: Sequence[int], leaf: Leaf, *, goes_on: bool) -> None:
        self.times_ns = times_ns
        self.leaf = leaf
        self.goes_on = goes_on
        self._known: dict[tuple[int, int], Interval] = {}
        self._read: dict[tuple[int, int, int], Interval] = {}

    def rho(self, formula: Formula, t: int) -> Interval:
        key = (id(formula), t)
        if key not in self._known:
            self._known[key] = self._rho(formula, t)
        return self._known[key]

    def _rho(self, formula: Formula, t: int) -> Interval:
        match formula:
            case Truth():
                return TRUE if formula.value else FALSE
            case Boolean():
                return combine(formula.operator, [self.rho(each, t) for each in formula.operands])
            case Temporal():
                return self._temporal(formula, t)
            case _:
                return self.leaf(formula, t)

    def _temporal(self, formula: Temporal, t: int) -> Interval:
        def left(at: int) -> Interval:
            return self._operand(formula, 0, at)

        def right(at: int) -> Interval:
            return self._operand(formula, -1, at)

        match formula.operator:
            case "X":
                return self._next(formula, t, beyond_the_end=FALSE)
            case "WX":
                return self._next(formula, t, beyond_the_end=TRUE)
            case "F":
                return greatest([right(u) for u in self._ahead(formula, t)] + self._open(formula, t))
            case "G":
                return least([right(u) for u in self._ahead(formula, t)] + self._open(formula, t))
            case "U":
                return self._until(formula, t, left, right)
            case "R":
                return -self._until(formula, t, lambda u: -left(u), lambda u: -right(u))
            case "W":
                always = least([left(u) for u in self._ahead(formula, t)] + self._open(formula, t))
                return greatest([self._until(formula, t, left, right), always])
            case "Y":
                return right(t - 1) if t > 0 else FALSE
            case "O":
                return greatest([right(u) for u in self._behind(formula, t)])
            case "H":
                return least([right(u) for u in self._behind(formula, t)])
        return greatest(
            [
                least([right(u), *(left(w) for w in range(u + 1, t + 1))])
                for u in self._behind(formula, t)
            ]
        )  # fmt: skip

    def _operand(self, formula: Temporal, place: int, t: int) -> Interval:
        """An operand as its operator reads it: without the samples in which a rate has no value."""
        key = (id(formula), place, t)
        if key not in self._read:
            self._read[key] = self._read_operand(formula, place, t)
        return self._read[key]

    def _read_operand(self, formula: Temporal, place: int, t: int) -> Interval:
        operand = formula.operands[place]
        leaves_out = {"GHUSW": (True, False), "FO": (False, False), "R": (False, True)}
        is_given = next((how for names, how in leaves_out.items() if formula.operator in names), None)
        if is_given is None:
            return self.rho(operand, t)
        is_only = len(formula.operands) == 1
        is_implied = is_given[0] if is_only or place == 0 else is_given[1]
        return leave_out(self.rho(operand, t), self._has_rates(operand, t), is_implied)

    def _has_rates(self, formula: Formula, t: int) -> Interval:
        """Whether all rates of a body have values, those of next and earlier samples then."""
        match formula:
            case Atom():
                return least([self.leaf(each, t) for each in has_value_atoms(formula)])
            case Boolean():
                return least([self._has_rates(each, t) for each in formula.operands])
            case Temporal(operator="X" | "WX") if t + 1 < len(self.times_ns):
                return self._has_rates(formula.operands[0], t + 1)
            case Temporal(operator="X" | "WX") if self.goes_on and has_value_atoms(formula):
                return ANYTHING
            case Temporal(operator="Y") if t > 0:
                return self._has_rates(formula.operands[0], t - 1)
        return TRUE

    def _next(self, formula: Temporal, t: int, beyond_the_end: Interval) -> Interval:
        if t + 1 < len(self.times_ns):
            return self.rho(formula.operands[0], t + 1)
        return ANYTHING if self.goes_on else beyond_the_end

    def _until(
        self, formula: Temporal, t: int, left: Callable[[int], Interval], right: Callable[[int], Interval]
    ) -> Interval:
        still = [left(w) for w in range(t, len(self.times_ns))]
        met = [least([right(u), *still[: u - t]]) for u in self._ahead(formula, t)]
        return greatest(met + [least([later, *still]) for later in self._open(formula, t)])

    def _ahead(self, formula: Temporal, t: int) -> list[int]:
        """The samples in the window of a future operator."""
        return [u for u in range(t, len(self.times_ns)) if self._is_within(formula, t, u)]

    def _behind(self, formula: Temporal, t: int) -> list[int]:
        """The samples in the window of a past operator."""
        return [u for u in range(t + 1) if self._is_within(formula, u, t)]

    def _is_within(self, formula: Temporal, earlier: int, later: int) -> bool:
        bound = formula.bound
        if bound is None:
            return True
        apart = later - earlier
        if bound.unit == "ns":
            apart = self.times_ns[later] - self.times_ns[earlier]
        return bound.lower <= apart and (bound.upper is None or apart <= bound.upper)

    def _open(self, formula: Temporal, t: int) -> list[Interval]:
        """What samples that are still to come may add to the window of a future operator."""
        last, bound = len(self.times_ns) - 1, formula.bound
        if not self.goes_on:
            return []
        if bound is None or bound.upper is None:
            return [ANYTHING]
        passed = last - t if bound.unit == "samples" else self.times_ns[last] - self.times_ns[t]
        return [] if passed >= bound.upper else [ANYTHING]


class Numbers(NamedTuple):
    """What is expected of each node after each sample.

    Attributes:
        series: (N, 4, T): value, now, lower, upper; NaN where value or now are not determined.
        slack: (N, 2, T): how far the ends of value and now lie apart.
        final: (N, 2).
    """

    series: np.ndarray
    slack: np.ndarray
    final: np.ndarray


def numbers_of(formula: Formula, times_ns: Sequence[int], nominal: Leaf, wide: Leaf) -> Numbers:
    """Every node on every prefix, given the leaves with every uncertainty at 0 and with it."""
    nodes = [node for _, _, node in iter_nodes(formula)]
    series = np.empty((len(nodes), 4, len(times_ns)))
    slack = np.empty((len(nodes), 2, len(times_ns)))
    final = np.empty((len(nodes), 2))
    for last in range(len(times_ns)):
        seen = times_ns[: last + 1]
        ended = Prefix(seen, nominal, goes_on=False)
        going_on = Prefix(seen, wide, goes_on=True)
        for n, node in enumerate(nodes):
            for which, at in enumerate((0, last)):
                low, high = ended.rho(node, at)
                series[n, which, last] = low if low == high else math.nan
                slack[n, which, last] = 0.0 if low == high else high - low
            series[n, 2:, last] = going_on.rho(node, 0)
    ended = Prefix(times_ns, wide, goes_on=False)
    for n, node in enumerate(nodes):
        final[n] = ended.rho(node, 0)
    return Numbers(series, slack, final)


# ------------------------------------------------------------------------------------------------ atoms

Bindings = Mapping[str, str]


class Observed:
    """A recording, and the regions of a specification: what atoms are in each sample.

    `unreadable` holds the observations, (t, name), whose numbers are not finite; `reported_ns` the times of
    reports by (t, name), where they are not those of samples; `lasting` the objects that stand
    without a rate.
    """

    def __init__(
        self,
        times_ns: Sequence[int],
        objects: Sequence[Mapping[str, TrackedObject]],
        unreadable: frozenset[tuple[int, str]],
        signals: Sequence[Mapping[str, float]],
        regions: Mapping[str, Outline],
        reported_ns: Mapping[tuple[int, str], int] = MappingProxyType({}),
        lasting: frozenset[str] = frozenset(),
    ) -> None:
        self.times_ns = times_ns
        self.reported_ns = reported_ns
        self.lasting = lasting
        self.objects = objects
        self.unreadable = unreadable
        self.signals = signals
        self.regions = {name: TrackedObject(_shape(o), height=o.height) for name, o in regions.items()}

    def leaf(self, start: int, bindings: Bindings, *, uncertain: bool) -> Leaf:
        """Atoms and open quantifiers at a sample, counted from `start`."""
        return lambda formula, t: self.interval(formula, start + t, bindings, uncertain)

    def interval(self, formula: Formula, t: int, bindings: Bindings, uncertain: bool) -> Interval:
        """A formula without temporal operators in one sample."""
        match formula:
            case Truth():
                return TRUE if formula.value else FALSE
            case Atom():
                return self._expression(formula.expression, t, bindings, uncertain) or ANYTHING
            case Boolean():
                operands = [self.interval(each, t, bindings, uncertain) for each in formula.operands]
                return combine(formula.operator, operands)
            case Quantified():
                join = least if formula.quantifier == "forall" else greatest
                names = self._member_names(formula.group, t, bindings)
                if names is None:
                    return ANYTHING
                bound = [
                    {**bindings, **dict(zip(formula.variables, chosen, strict=True))}
                    for chosen in permutations(names, len(formula.variables))
                ]
                conditions = has_value_atoms(formula.body)
                return join(
                    [
                        leave_out(
                            self.interval(formula.body, t, each, uncertain),
                            least([self.interval(atom, t, each, uncertain) for atom in conditions]),
                            formula.quantifier == "forall",
                        )
                        for each in bound
                    ]
                )
        raise ValueError(formula)

    def _expression(
        self, expression: Expression, t: int, bindings: Bindings, uncertain: bool
    ) -> Interval | None:
        """None where it is unknown."""

        def inner(each: Expression) -> Interval | None:
            return self._expression(each, t, bindings, uncertain)

        match expression:
            case Number():
                return Interval(expression.value, expression.value)
            case Rate():
                return self._rate(expression, t, bindings, uncertain)
            case Signal():
                number = self.signals[t].get(expression.name, math.nan)
                return None if math.isnan(number) else Interval(number, number)
            case Equality(Present(term=term)):
                (name,) = _names([term], bindings)
                return TRUE if name in self.objects[t] else FALSE
            case Equality(HasRate(rate=rate)):
                current = [self.members(each, t, bindings) for each in rate.terms]
                if None in (current or [self._expression(rate.signal or Signal(""), t, bindings, uncertain)]):
                    return None
                return FALSE if self._rate(rate, t, bindings, uncertain) is None else TRUE
            case Equality():
                number = self.signals[t].get(expression.signal.name, math.nan)
                return None if math.isnan(number) else TRUE if number == expression.value else FALSE
            case Negative():
                operand = inner(expression.operand)
                return None if operand is None else -operand
            case Sum():
                first, second = inner(expression.first), inner(expression.second)
                if first is None or second is None:
                    return None
                low, high = first.low + second.low, first.high + second.high
                return None if math.isnan(low) or math.isnan(high) else Interval(low, high)
            case Product() | Scaled():
                operand = inner(expression.operand)
                if operand is None:
                    return None
                low, high = (
                    end * expression.factor if isinstance(expression, Product) else end / expression.divisor
                    for end in operand
                )
                return Interval(low, high)
            case Minimum() | Maximum():
                operands = [inner(each) for each in expression.operands]
                known = [each for each in operands if each is not None]
                if len(known) < len(operands):
                    return None
                return least(known) if isinstance(expression, Minimum) else greatest(known)
        return self._measurement(expression, t, bindings, uncertain)

    def _rate(self, rate: Rate, t: int, bindings: Bindings, uncertain: bool) -> Interval | None:
        """What changed between two reports, per second."""
        if not rate.terms:
            name = (rate.signal or Signal("")).name
            reports = self._reports(name, t, lambda u: self.signals[u].get(name))
            if reports is None:
                return None
            before, step = reports
            change = self.signals[t][name] - self.signals[before][name]
            return Interval(change / step, change / step)
        step = self._step(rate.terms, t, bindings)
        if step is None:
            return None
        terms = rate.terms if len(rate.terms) == 2 else [Centre(_base(rate.terms[0]))]
        now, before = [[self.members(each, t, bindings, back) for each in terms] for back in (0.0, step)]
        if any(each is None for each in (*now, *before)):
            return None
        pairs: Any = [before, now] if len(terms) == 2 else [[now[0], before[0]]]
        distances = [_measured(SignedDistance(*rate.terms[:1] * 2), *pair) for pair in pairs]
        spreads = [
            sum(max((one.uncertainty for one in union), default=0.0) for union in pair) if uncertain else 0.0
            for pair in pairs
        ]
        change = distances[0] - (distances[1] if len(terms) == 2 else 0.0)
        low, high = (change - sum(spreads)) / step, (change + sum(spreads)) / step
        return None if math.isnan(low) or math.isnan(high) else Interval(low, high)

    def _reports(self, name: str, t: int, shown: Callable[[int], object]) -> tuple[int, float] | None:
        """The last sample that showed another report, and the seconds between both; None after a hole."""
        times = [self.reported_ns.get((u, name), self.times_ns[u]) for u in range(t + 1)]
        for u in range(t, -1, -1):
            if shown(u) is None or (isinstance(shown(u), float) and not math.isfinite(shown(u))):
                return None
            if times[u] != times[t]:
                return (u, (times[t] - times[u]) / 1e9) if times[u] < times[t] else None
        return None

    def _reports_of(self, name: str, t: int) -> tuple[int, float] | None:
        return self._reports(
            name, t, lambda u: None if (u, name) in self.unreadable else self.objects[u].get(name)
        )

    def _step(self, terms: Sequence[Term], t: int, bindings: Bindings) -> float | None:
        """The shortest time between two reports of what moves."""
        steps = []
        for base in map(_base, terms):
            if isinstance(base, RegionName):
                continue
            names = _names([base], bindings)
            if isinstance(base, Group):
                left_out = _names(base.excluded, bindings)
                names = [name for name in base.members or () if name not in left_out]
                if base.members is None:
                    names = self._member_names(base, t, bindings) or []
            for name in names:
                reports = self._reports_of(name, t)
                if reports is not None:
                    steps.append(reports[1])
                elif name not in self.lasting:
                    return None
        return min(steps, default=None)

    def _moved_back(self, name: str, t: int, step: float) -> TrackedObject | None:
        """An object as it was so many seconds ago by its velocity between two reports."""
        now, reports = self.objects[t][name], self._reports_of(name, t)
        if reports is None:
            return now if name in self.lasting else None
        before, seconds = reports
        then = self.objects[before][name]
        if seconds == step:
            return then
        ends = [_centre(each).footprint.parts[0].vertices for each in (now, then)]
        shift = (ends[1] - ends[0]) * step / seconds
        parts = [ConvexPart(part.vertices + shift, part.radius) for part in now.footprint.parts]
        uncertainty = max(now.uncertainty, then.uncertainty)
        return TrackedObject(Footprint(tuple(parts)), now.class_name, now.yaw, now.height, uncertainty)

    def _measurement(
        self, measurement: Expression, t: int, bindings: Bindings, uncertain: bool
    ) -> Interval | None:
        terms = _terms(measurement)
        found = [self.members(term, t, bindings) for term in terms]
        if any(each is None for each in found):
            return None
        unions = [each for each in found if each is not None]
        value = _measured(measurement, *unions)
        if value is None:
            return None
        spread = sum(max((one.uncertainty for one in union), default=0.0) for union in unions)
        if not uncertain or isinstance(measurement, Misalignment):
            spread = 0.0
        return Interval(value - spread, value + spread)

    def members(
        self, term: Term, t: int, bindings: Bindings, back: float = 0.0
    ) -> list[TrackedObject] | None:
        """The objects whose union a term is, moved back by some seconds; None where one is unknown."""
        match term:
            case Enlarged():
                inner = self.members(term.term, t, bindings, back)
                return None if inner is None else [_enlarged(each, term.radius) for each in inner]
            case Centre():
                inner = self.members(term.term, t, bindings, back)
                return None if inner is None else [_centre(each) for each in inner]
            case RegionName():
                return [self.regions[term.name]]
            case Earlier():
                then = self._then(term, t)
                return None if then is None else self.members(term.term, then, bindings)
            case Group() if term.members is None:
                names = self._member_names(term, t, bindings) or []
            case Group():
                left_out = _names(term.excluded, bindings)
                names = [name for name in term.members if name not in left_out]
            case _:
                names = _names([term], bindings)
        found = [None if (t, name) in self.unreadable else self.objects[t].get(name) for name in names]
        if back and None not in found:
            found = [self._moved_back(name, t, back) for name in names]
        return None if None in found else [each for each in found if each is not None]

    def _member_names(self, group: Group | Earlier, t: int, bindings: Bindings) -> list[str] | None:
        if isinstance(group, Earlier):
            then = self._then(group, t)
            return None if then is None else self._member_names(group.term, then, bindings)
        left_out = _names(group.excluded, bindings)
        return [
            name
            for name in sorted(self.objects[t])
            if name not in left_out and self._is_of_class(name, t, group.class_name)
        ]

    def _is_of_class(self, name: str, t: int, class_name: str | None) -> bool:
        own = self.objects[t][name].class_name or ""
        return class_name == ANY_CLASS or own.casefold() == (class_name or "").casefold()

    def _then(self, term: Earlier, t: int) -> int | None:
        if term.samples is not None:
            return t - term.samples if t >= term.samples else None
        limit = self.times_ns[t] - (term.duration_ns or 0)
        return max((u for u in range(t + 1) if self.times_ns[u] <= limit), default=None)


def _base(term: Term) -> Any:
    while isinstance(term, Enlarged | Centre):
        term = term.term
    return term


def _names(terms: Sequence[Term], bindings: Bindings) -> list[str]:
    return [bindings[term.name] if isinstance(term, Variable) else term.name for term in terms]


def _terms(measurement: Expression) -> list[Term]:
    match measurement:
        case Protrusion():
            return [measurement.inner, measurement.outer]
        case SignedDistance() | Misalignment():
            return [measurement.first, measurement.second]
        case Projection() | CentroidProjection():
            return [measurement.term]
    raise ValueError(measurement)


def _shape(outline: Outline) -> Footprint:
    if outline.radius > 0:
        return Footprint((ConvexPart(np.array(outline.vertices), outline.radius),))
    return Footprint.polygon(outline.vertices)


def _enlarged(tracked: TrackedObject, radius: float) -> TrackedObject:
    parts = tuple(ConvexPart(part.vertices, part.radius + radius) for part in tracked.footprint.parts)
    return TrackedObject(
        Footprint(parts), tracked.class_name, tracked.yaw, tracked.height, tracked.uncertainty
    )


def _centre(tracked: TrackedObject) -> TrackedObject:
    shapes = [
        (shapely.MultiPoint(part.vertices).convex_hull, part.radius) for part in tracked.footprint.parts
    ]
    # half of the length of a segment's outline is its own
    around = [shape.length * (2 if shape.geom_type == "LineString" else 1) for shape, _ in shapes]
    areas = [s.area + length * r + math.pi * r**2 for (s, r), length in zip(shapes, around, strict=True)]
    weights = areas if sum(areas) > 0 else [1.0] * len(areas)
    x, y = np.average([shape.centroid.coords[0] for shape, _ in shapes], axis=0, weights=weights)
    height = tracked.height and (sum(tracked.height) / 2,) * 2
    return TrackedObject(
        Footprint.disc(x, y, 0.0), tracked.class_name, tracked.yaw, height, tracked.uncertainty
    )


# --------------------------------------------------------------------------------------------- geometry

Union = Sequence[TrackedObject]


def _parts(union: Union) -> Iterator[tuple[ConvexPart, tuple[float, float] | None]]:
    for tracked in union:
        for part in tracked.footprint.parts:
            yield part, tracked.height


def _measured(measurement: Expression, *unions: Union) -> float | None:
    match measurement:
        case SignedDistance():
            pairs = [(p, q) for p in _parts(unions[0]) for q in _parts(unions[1])]
            return min((_distance_of_prisms(*p, *q) for p, q in pairs), default=math.inf)
        case Protrusion():
            return max(
                (
                    min((_protrusion_of_prisms(*p, *q) for q in _parts(unions[1])), default=math.inf)
                    for p in _parts(unions[0])
                ),
                default=-math.inf,
            )
        case Misalignment():
            yaws = [union[0].yaw for union in unions]
            if None in yaws:
                return None
            (x, y), (u, v) = ((math.cos(yaw), math.sin(yaw)) for yaw in yaws if yaw is not None)
            return ((x - u) ** 2 + (y - v) ** 2) / 2
        case Projection(axis="z"):
            heights = [tracked.height for tracked in unions[0]]
            if None in heights:
                return None
            ends = [end for height in heights if height is not None for end in height]
            return _extreme(ends, measurement.side)
        case Projection():
            along = "xy".index(measurement.axis)
            return _extreme(
                [
                    corner + sign * part.radius
                    for part, _ in _parts(unions[0])
                    for corner in part.vertices[:, along].tolist()
                    for sign in (-1.0, 1.0)
                ],
                measurement.side,
            )
        case CentroidProjection():
            centroids = [_hull(part.vertices).centroid for part, _ in _parts(unions[0])]
            return _extreme([getattr(point, measurement.axis) for point in centroids], measurement.side)
    raise ValueError(measurement)


def _extreme(numbers: Sequence[float], side: str) -> float:
    if side == "min":
        return min(numbers, default=math.inf)
    return max(numbers, default=-math.inf)


def _hull(points: np.ndarray) -> shapely.Geometry:
    return shapely.MultiPoint(points).convex_hull


def _polygon_distance(first: np.ndarray, second: np.ndarray) -> float:
    """The signed distance of the origin to the Minkowski difference of two convex polygons."""
    difference = _hull((first[:, None] - second[None, :]).reshape(-1, 2))
    origin = shapely.Point(0, 0)
    apart = float(shapely.distance(difference, origin))
    if apart > 0 or not isinstance(difference, shapely.Polygon):
        return apart
    return -float(shapely.distance(difference.exterior, origin))


def _distance_of_prisms(
    p: ConvexPart, p_height: tuple[float, float] | None, q: ConvexPart, q_height: tuple[float, float] | None
) -> float:
    planar = _polygon_distance(p.vertices, q.vertices) - p.radius - q.radius
    if p_height is None or q_height is None:
        return planar
    gap = max(p_height[0] - q_height[1], q_height[0] - p_height[1])
    return math.hypot(planar, gap) if planar > 0 and gap > 0 else max(planar, gap)


def _protrusion_of_prisms(
    p: ConvexPart, p_height: tuple[float, float] | None, q: ConvexPart, q_height: tuple[float, float] | None
) -> float:
    planar = max(_polygon_distance(corner[None], q.vertices) for corner in p.vertices)
    planar += p.radius - q.radius
    if p_height is None or q_height is None:
        return planar
    return max(planar, q_height[0] - p_height[0], p_height[1] - q_height[1])
