"""Propositions as conditions: Boolean functions of linear inequalities between measured quantities.

A relation combines measurements by sums, minima and maxima. So its condition, "at least 0", is a Boolean
function of linear inequalities. Relations on the same quantity share it: `a closeto[0.1] b` and
`a dist b >= 0.2` are two inequalities about one distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import combinations, permutations, product
from math import dist, isfinite
from typing import Final, Literal, NamedTuple, TypeAlias

from spatial_replay.automata.guards import NO, YES, Diagrams, Shapes
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.sanity.linear import Inequality
from spatial_replay.spec.format import format_formula, format_number, format_term
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
    Maximum,
    Measurement,
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
    RegionName,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Term,
    TrackedName,
    Truth,
    Variable,
    expand,
)
from spatial_replay.spec.relations import compare
from spatial_replay.spec.walks import (
    base_of,
    is_about_having_rates,
    iter_expressions,
    iter_formulas,
    named_members,
    standing,
    terms_of,
)
from spatial_replay.text import is_text_number
from spatial_replay.trace.trace import Sample, Trace

# ------------------------------------------------------------------------------------------------------- sums

MAX_INEQUALITIES: Final = 64
"""Maximum number of inequalities of one relation; with more, the relation is an opaque proposition."""

Quantity: TypeAlias = Measurement | Signal
Weights: TypeAlias = tuple[tuple[Quantity, Fraction], ...]


class Linear(NamedTuple):
    """Weighted sum of quantities plus a constant."""

    weights: Weights
    constant: Fraction = Fraction(0)


class LeastOrGreatest(NamedTuple):
    """Minimum or maximum of several numbers."""

    kind: Literal["min", "max"]
    options: tuple[Linear | LeastOrGreatest, ...]


Tree: TypeAlias = Linear | LeastOrGreatest


def tree_of(expression: Expression, regions: Mapping[str, Outline]) -> Tree | None:
    """Return an expression as minima and maxima of sums; None if it has no such form, or too many sums."""
    try:
        return _build(expression, regions)
    except OverflowError:
        return None


def _build(expression: Expression, regions: Mapping[str, Outline]) -> Tree:
    match expression:
        case Number():
            return Linear((), exact(expression.value))
        case Signal():
            return Linear(((expression, Fraction(1)),))
        case Sum():
            return _add(_build(expression.first, regions), _build(expression.second, regions))
        case Negative(Equality()):
            # `!=` excludes one number, but inequalities here include their limits
            raise OverflowError("an excluded number")
        case Negative():
            return _times(_build(expression.operand, regions), Fraction(-1))
        case Equality(signal, value):
            if is_text_number(value) or isinstance(signal, Present):
                raise OverflowError("a text, or whether an object is in the sample")
            return _build(compare(signal, "==", value), regions)
        case Product():
            return _times(_build(expression.operand, regions), exact(expression.factor))
        case Scaled():
            return _times(_build(expression.operand, regions), 1 / exact(expression.divisor))
        case Minimum() | Maximum():
            options = tuple(_build(operand, regions) for operand in expression.operands)
            return _least_or_greatest("min" if isinstance(expression, Minimum) else "max", options)
        case _:
            return _split_measurement(expression, regions)


def exact(value: float) -> Fraction:
    """Return the exact fraction of a number's decimal text.

    Raises:
        OverflowError: the number is not finite.
    """
    if not isfinite(value):
        raise OverflowError("not finite")
    return Fraction(repr(float(value)))


def _add(left: Tree, right: Tree) -> Tree:
    if isinstance(left, LeastOrGreatest):
        return _least_or_greatest(left.kind, tuple(_add(option, right) for option in left.options))
    if isinstance(right, LeastOrGreatest):
        return _add(right, left)
    weight_by_quantity = dict(left.weights)
    for quantity, weight in right.weights:
        weight_by_quantity[quantity] = weight_by_quantity.get(quantity, Fraction(0)) + weight
    # weights have a fixed order, so that equal sums are equal values
    weights = sorted(
        ((quantity, weight) for quantity, weight in weight_by_quantity.items() if weight),
        key=lambda item: repr(item[0]),
    )
    return Linear(tuple(weights), left.constant + right.constant)


def _times(tree: Tree, factor: Fraction) -> Tree:
    if isinstance(tree, LeastOrGreatest):
        kind = tree.kind if factor > 0 else "max" if tree.kind == "min" else "min"
        return LeastOrGreatest(kind, tuple(_times(option, factor) for option in tree.options))
    weights = tuple((quantity, weight * factor) for quantity, weight in tree.weights)
    return Linear(weights, tree.constant * factor)


def _least_or_greatest(kind: Literal["min", "max"], options: tuple[Tree, ...]) -> Tree:
    if sum(map(_size, options)) > MAX_INEQUALITIES:
        raise OverflowError("too many sums")
    return options[0] if len(options) == 1 else LeastOrGreatest(kind, options)


def _size(tree: Tree) -> int:
    return 1 if isinstance(tree, Linear) else sum(map(_size, tree.options))


def _split_measurement(measurement: Measurement, regions: Mapping[str, Outline]) -> Tree:
    """Return a measurement of unions as the minimum or maximum over their members."""
    kind: Literal["min", "max"]
    member_measurements: list[Measurement]
    if all(isinstance(without_radius(plain(term)), RegionName) for term in measurement.terms):
        return _of_regions(measurement, regions)
    match measurement:
        case SignedDistance() | Misalignment():
            kind = "min"
            term_pairs = product(*map(members, measurement.terms))
            # both kinds are symmetric; a fixed order of terms makes equal measurements equal values
            member_measurements = [
                measurement.with_terms(*sorted(term_pair, key=repr)) for term_pair in term_pairs
            ]
        case Protrusion():
            # an outer union is not split: the inner term may lie partly in one member and partly in another
            kind, outer = "max", plain(measurement.outer)
            member_measurements = [Protrusion(inner, outer) for inner in members(measurement.inner)]
        case Projection():
            kind, axis = measurement.side, measurement.axis
            member_measurements = [Projection(term, axis, kind) for term in members(measurement.term)]
        case CentroidProjection():
            kind, axis = measurement.side, measurement.axis
            terms = map(without_radius, members(measurement.term))
            member_measurements = [CentroidProjection(term, axis, kind) for term in terms]
        case _:
            return Linear(((measurement, Fraction(1)),))
    return _least_or_greatest(
        kind, tuple(_shift(member_measurement, regions) for member_measurement in member_measurements)
    )


def _of_regions(measurement: Measurement, regions: Mapping[str, Outline]) -> Linear:
    """Return a measurement between regions as a constant, or as a quantity if its value is unknown."""
    (value,) = _numbers_of([measurement], regions)
    return Linear(((measurement, Fraction(1)),)) if value is None else Linear((), value)


def _numbers_of(measurements: Sequence[Measurement], regions: Mapping[str, Outline]) -> list[Fraction | None]:
    """Return the numbers of measurements between regions; None for an unknown number."""
    # regions need no objects, so one empty sample is enough
    empty_scene = TraceScene(Trace.from_samples([Sample(0, {})]), regions)
    bound_pairs = leaf_values(empty_scene, [Atom("", "", measurement) for measurement in measurements], {})[
        :, :, 0
    ].T.tolist()
    return [
        exact(bounds[0]) if len(set(bounds)) == 1 and isfinite(bounds[0]) else None for bounds in bound_pairs
    ]


def _between(atoms: Sequence[Atom], regions: Mapping[str, Outline]) -> dict[Measurement, Fraction]:
    """Return the distances of disjoint regions, and the protrusions of regions from enclosing regions."""
    terms = (term for atom in atoms for term in terms_of(atom.expression))
    region_terms = dict.fromkeys(term for term in map(without_radius, terms) if isinstance(term, RegionName))
    region_pairs = list(permutations(region_terms, 2))
    measurements: list[Measurement] = [
        SignedDistance(*region_pair)
        for region_pair in region_pairs
        if repr(region_pair[0]) < repr(region_pair[1])
    ]
    measurements += [Protrusion(*region_pair) for region_pair in region_pairs]
    measurement_values = (
        zip(measurements, _numbers_of(measurements, regions), strict=True) if measurements else ()
    )
    return {
        measurement: value
        for measurement, value in measurement_values
        if value is not None and isinstance(measurement, SignedDistance) == (value > 0)
    }


def _diameter(outline: Outline) -> Fraction:
    vertex_diameter = max((dist(*pair) for pair in combinations(outline.vertices, 2)), default=0.0)
    return exact(vertex_diameter + 2.0 * outline.radius)


def is_about_heights(atoms: Iterable[Atom]) -> bool:
    """Return whether an atom compares coordinates along z."""
    expressions = (expression for atom in atoms for expression in iter_expressions(atom.expression))
    return any(isinstance(expression, Projection) and expression.axis == "z" for expression in expressions)


def _shift(measurement: Measurement, regions: Mapping[str, Outline]) -> Linear:
    """Return a measurement of enlarged terms as the bare terms' measurement plus a constant, if exact."""
    unit_weight = Fraction(1)
    match measurement:
        case Projection() if measurement.axis != "z":
            radius = radius_of(measurement.term)
            bare_projection = Projection(without_radius(measurement.term), measurement.axis, measurement.side)
            return Linear(((bare_projection, unit_weight),), radius if measurement.side == "max" else -radius)
        # with heights, enlarging in the plane can change a distance by less than the radius
        case SignedDistance() if is_flat(measurement.first, regions) or is_flat(measurement.second, regions):
            terms = measurement.first, measurement.second
            bare_distance = SignedDistance(*sorted(map(without_radius, terms), key=repr))
            return Linear(((bare_distance, unit_weight),), -sum(map(radius_of, terms), Fraction(0)))
        case Protrusion() if is_flat(measurement.inner, regions) or is_flat(measurement.outer, regions):
            bare_protrusion = Protrusion(without_radius(measurement.inner), without_radius(measurement.outer))
            return Linear(
                ((bare_protrusion, unit_weight),), radius_of(measurement.inner) - radius_of(measurement.outer)
            )
    return Linear(((measurement, unit_weight),))


# -------------------------------------------------------------------------------------------- terms


def members(term: Term) -> tuple[Term, ...]:
    """Return the members of a named group, with the delay, enlargement or centre of the term.

    Any other term is returned as its only member.
    """
    term = plain(term)
    if isinstance(term, Enlarged):
        return tuple(Enlarged(member, term.radius) for member in members(term.term))
    if isinstance(term, Centre):
        return tuple(Centre(standing(member)) for member in members(term.term))
    group = term.term if isinstance(term, Earlier) else term
    if not isinstance(group, Group) or group.members is None:
        return (term,)
    if any(isinstance(name, Variable) for name in group.excluded):
        return (term,)
    tracked_members = [TrackedName(name) for name in named_members(group)]
    if not tracked_members:
        return (term,)
    if isinstance(term, Earlier):
        return tuple(Earlier(name, term.samples, term.duration_ns, term.rate) for name in tracked_members)
    return tuple(tracked_members)


def plain(term: Term) -> Term:
    """Return a term with nested enlargements merged, and a region without its delay."""
    if isinstance(term, Enlarged):
        inner = plain(term.term)
        radius = term.radius + (inner.radius if isinstance(inner, Enlarged) else 0.0)
        return Enlarged(without_radius(inner), radius) if radius else inner
    if isinstance(term, Earlier) and isinstance(term.term, RegionName):
        return term.term
    return term


def without_radius(term: Term) -> Term:
    """Return a term without its enlargement."""
    return term.term if isinstance(term, Enlarged) else term


def radius_of(term: Term) -> Fraction:
    """Return the radius of a term's enlargement; 0 without one."""
    return exact(term.radius) if isinstance(term, Enlarged) else Fraction(0)


def is_flat(term: Term, regions: Mapping[str, Outline]) -> bool:
    """Return whether a term is a region without a height; distances to it are distances in the plane."""
    base = without_radius(term)
    return isinstance(base, RegionName) and base.name in regions and regions[base.name].height is None


def is_solid(term: Term) -> bool:
    """Return whether a term has a footprint in every sample in which it is known; a group may be empty."""
    return not isinstance(base_of(term), Group)


def terms_in(quantities: Iterable[Quantity]) -> list[Term]:
    """Return the distinct measured terms of quantities, without enlargements."""
    terms = (term for quantity in quantities if isinstance(quantity, Measurement) for term in quantity.terms)
    return list(dict.fromkeys(without_radius(term) for term in terms))


# ------------------------------------------------------------------------------------------------- conditions

MAX_DECISIONS: Final = 200_000
"""Maximum number of nodes in the diagrams of conditions."""


class Fact(NamedTuple):
    """Condition of a diagram: an inequality between quantities, or an opaque proposition.

    Attributes:
        weights: quantities of a sum with their factors, the first factor 1; empty for an opaque proposition.
        threshold: limit of the sum.
        side: comparison of the sum with the threshold. ">" is true above the threshold and false below it.
            At the threshold, ">" is neither, because a relation between footprints is marginal there.
            ">=" and "<=" are exact. They are used for sums that some relation compares with "==".
        texts: formulas for the true fact and for the false fact.
        alone: value of a quantifier over a class if no object has that class; None for other facts.
    """

    weights: Weights
    threshold: Fraction
    side: Literal[">", ">=", "<="]
    texts: tuple[str, str]
    alone: bool | None = None

    def inequality(self, value: bool, label: int) -> Inequality:
        """Return the inequality of the fact (`value` is True) or of its negation, with a label."""
        is_lower_limit = (self.side != "<=") == value
        # ">" leaves equality open, so the fact and its negation are both strict
        is_strict = self.side == ">" or not value
        sign = -1 if is_lower_limit else 1
        weights = tuple((quantity, sign * _whole(weight)) for quantity, weight in self.weights)
        return Inequality(weights, sign * self.threshold, is_strict, label)


def _whole(weight: Fraction) -> Fraction | int:
    return weight.numerator if weight.denominator == 1 else weight


class FactDiagrams:
    """Facts in some formulas, and diagrams of propositions over these facts.

    Attributes:
        diagrams: diagrams of all conditions; a variable of a diagram is the number of a fact.
        facts: facts by number.
        diameters: diameters of regions by name; empty if a formula or a region has heights.
        between: distances of disjoint regions, and protrusions of regions from enclosing regions.
    """

    def __init__(self, formulas: Iterable[Formula], regions: Mapping[str, Outline]) -> None:
        self.diagrams = Diagrams(MAX_DECISIONS)
        self.facts: list[Fact] = []
        self.regions = regions
        self._fact_numbers: dict[object, int] = {}
        self._trees: dict[Expression, Tree | None] = {}
        self._nodes_by_id: dict[int, tuple[Formula, int]] = {}
        self._written_texts: dict[int, dict[str, None]] = {}
        self._shapes = Shapes()
        self._opaque_nodes: dict[int, int] = {}
        # sums that are compared with "==", usually modes and counts
        self._exact_sums: set[Weights] = set()
        atoms = [part for formula in formulas for part in iter_formulas(formula) if isinstance(part, Atom)]
        # first all sums that "==" compares: they decide which facts are exact
        for atom in atoms:
            self._tree_of(atom.expression)
        is_upright = is_about_heights(atoms) or any(
            outline.height is not None for outline in regions.values()
        )
        self.diameters = {} if is_upright else {name: _diameter(outline) for name, outline in regions.items()}
        self.between = _between(atoms, regions)
        # atoms get low numbers: `necessary` drops high numbers first, and opaque facts cannot be placed
        for atom in atoms:
            self.of(atom)

    def of(self, formula: Formula) -> int:
        """Return the diagram of a formula without temporal operators."""
        entry = self._nodes_by_id.get(id(formula))
        if entry is None:
            # the formula is stored, because the id of a deleted object can be reused
            entry = self._nodes_by_id[id(formula)] = formula, self._diagram(expand(formula))
        return entry[1]

    def _diagram(self, formula: Formula) -> int:
        diagrams = self.diagrams
        match formula:
            case Truth():
                return YES if formula.value else NO
            case Atom():
                if is_about_having_rates(formula):
                    # an examination assumes that rates have values
                    return YES
                tree = self._tree_of(formula.expression)
                return self._opaque(formula) if tree is None else self._condition(tree, formula)
            case Boolean(operator="not"):
                return diagrams.complement(self.of(formula.operands[0]))
            case Boolean():
                node = self.of(formula.operands[0])
                join = diagrams.both if formula.operator == "and" else diagrams.either
                for operand in formula.operands[1:]:
                    node = join(node, self.of(operand))
                return node
            case _:
                return self._opaque(formula)

    def _tree_of(self, expression: Expression) -> Tree | None:
        if expression not in self._trees:
            tree = self._trees[expression] = tree_of(expression, self.regions)
            if tree is not None:
                self._exact_sums |= set(_equal_sums(tree))
        return self._trees[expression]

    def _condition(self, tree: Tree, atom: Atom) -> int:
        """Return the diagram of the condition that a number is at least 0."""
        if isinstance(tree, LeastOrGreatest):
            option_nodes = [self._condition(option, atom) for option in tree.options]
            join = self.diagrams.both if tree.kind == "min" else self.diagrams.either
            joint_node = option_nodes[0]
            for option_node in option_nodes[1:]:
                joint_node = join(joint_node, option_node)
            return joint_node
        if not tree.weights:
            return YES if tree.constant >= 0 else NO
        weights, threshold, is_lower_limit = _with_threshold(tree)
        is_whole = isinstance(self._trees[atom.expression], Linear)
        texts = _texts(atom, is_whole, is_lower_limit, weights, threshold)
        if weights in self._exact_sums:
            side: Literal[">=", "<="] = ">=" if is_lower_limit else "<="
            texts = _exact_texts(weights, threshold, side) or texts
            return self._fact(Fact(weights, threshold, side, texts), atom.text)
        node = self._fact(Fact(weights, threshold, ">", texts if is_lower_limit else texts[::-1]), atom.text)
        return node if is_lower_limit else self.diagrams.complement(node)

    def equal_texts(self, number: int) -> Iterator[tuple[str, str]]:
        """Yield pairs of comparisons in one fact that have equal robustness, such as "x > 1" and "x >= 1"."""
        texts = dict.fromkeys((*self._written_texts.get(number, ()), *self.facts[number].texts))
        for strict in texts:
            for sign in (" > ", " < "):
                lenient = strict.replace(sign, f"{sign.rstrip()}= ")
                if lenient != strict and lenient in texts and strict in self._written_texts[number]:
                    yield strict, lenient

    def _opaque(self, formula: Formula) -> int:
        shape = self._shapes.of(formula)
        if shape not in self._opaque_nodes:
            node = self._opaque_nodes[shape] = self._new_opaque(formula)
            # `exists x: p` is the negation of `forall x: not p`, so both have one fact
            self._opaque_nodes[self._shapes.negate(shape)] = self.diagrams.complement(node)
        return self._opaque_nodes[shape]

    def _new_opaque(self, formula: Formula) -> int:
        text = format_formula(formula)
        empty_value = None
        if isinstance(formula, Quantified) and isinstance(formula.group, Group):
            empty_value = formula.quantifier == "forall" if formula.group.class_name != ANY_CLASS else None
        return self._fact(Fact((), Fraction(0), ">", (text, f"not ({text})"), empty_value))

    def _fact(self, fact: Fact, written_text: str = "") -> int:
        fact_key = (fact[:3]) if fact.weights else fact.texts
        if fact_key not in self._fact_numbers:
            self._fact_numbers[fact_key] = len(self.facts)
            self.facts.append(fact)
        fact_number = self._fact_numbers[fact_key]
        self._written_texts.setdefault(fact_number, {})[written_text] = None
        existing_fact = self.facts[fact_number]
        # several relations can have the same fact; texts without "not" are preferred
        true_text, false_text = (
            new if is_negated(old) and not is_negated(new) else old
            for old, new in zip(existing_fact.texts, fact.texts, strict=True)
        )
        self.facts[fact_number] = existing_fact._replace(texts=(true_text, false_text))
        return self.diagrams.variable(fact_number)


def is_negated(text: str) -> bool:
    """Return whether the text of a fact is a negated relation."""
    return text.startswith(("not (", "not a part of "))


def _with_threshold(linear: Linear) -> tuple[Weights, Fraction, bool]:
    """Return `linear >= 0` as a limit of a sum: factors, threshold, and whether it is a lower limit."""
    # weights are divided by the first factor, so that 2 x >= 2 and x >= 1 are one fact
    factor = linear.weights[0][1]
    weights = tuple((quantity, weight / factor) for quantity, weight in linear.weights)
    return weights, -linear.constant / factor, factor > 0


def _equal_sums(tree: Tree) -> Iterable[Weights]:
    """Yield the sums with equal lower and upper limits."""
    if isinstance(tree, Linear):
        return
    comparisons = [
        _with_threshold(option) for option in tree.options if isinstance(option, Linear) and option.weights
    ]
    if tree.kind == "min":
        yield from (
            comparison[0]
            for comparison in comparisons
            if comparison[2] and (*comparison[:2], False) in comparisons
        )
    for option in tree.options:
        yield from _equal_sums(option)


def _texts(
    atom: Atom, is_whole: bool, is_lower_limit: bool, weights: Weights, threshold: Fraction
) -> tuple[str, str]:
    """Return the texts of an atom's condition and of its negation."""
    if is_whole:
        return atom.text, f"not ({atom.text})"
    comparison_texts = _compared_texts(weights, threshold, (">=", "<=") if is_lower_limit else ("<=", ">="))
    if comparison_texts is not None:
        return comparison_texts
    relation_and_side = _relation_text(weights) if not threshold else None
    if relation_and_side is None:
        return f"a part of {atom.text}", f"not a part of {atom.text}"
    # the relation limits a sum by 0 from below or from above
    relation, holds_above = relation_and_side
    texts = relation, f"not ({relation})"
    return texts if holds_above == is_lower_limit else texts[::-1]


def _exact_texts(weights: Weights, threshold: Fraction, side: Literal[">=", "<="]) -> tuple[str, str] | None:
    """Return the texts of an exact comparison and of its negation; None for a sum of several quantities."""
    return _compared_texts(weights, threshold, (side, "<" if side == ">=" else ">"))


def _compared_texts(weights: Weights, threshold: Fraction, signs: tuple[str, str]) -> tuple[str, str] | None:
    (quantity, _), *other_weights = weights
    if other_weights or not isinstance(quantity, SignedDistance | Signal):
        return None
    quantity_text = (
        quantity.name
        if isinstance(quantity, Signal)
        else f"{format_term(quantity.first)} dist {format_term(quantity.second)}"
    )
    limit = format_number(float(threshold))
    return f"{quantity_text} {signs[0]} {limit}", f"{quantity_text} {signs[1]} {limit}"


def _relation_text(weights: Weights) -> tuple[str, bool] | None:
    """Return the relation that compares a sum with 0, and whether it holds above 0; None if none does."""
    match weights:
        case ((Protrusion() as quantity, _),):
            return f"{format_term(quantity.inner)} enclosedin {format_term(quantity.outer)}", False
        case ((Projection() as left, _), (Projection() as right, weight)) if weight == -1:
            projection_by_side = {left.side: left, right.side: right}
            if left.axis == right.axis and len(projection_by_side) == 2:
                before_text, after_text = (
                    format_term(projection_by_side["max"].term),
                    format_term(projection_by_side["min"].term),
                )
                return f"{before_text} prec[{left.axis}] {after_text}", left.side == "min"
    return None
