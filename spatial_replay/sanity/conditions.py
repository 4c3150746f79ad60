"""Propositions as conditions: Boolean functions of linear inequalities between measured quantities.

A relation's robustness is built of measurements by sums, minima and maxima, so "at least 0" is a Boolean
function of inequalities between sums. Two relations about one quantity share it, whatever their names:
`a closeto[0.1] b` and `a dist b >= 0.2` are inequalities about one distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from typing import Final, Literal, NamedTuple

from spatial_replay.automata.diagrams import NO, YES, Diagrams
from spatial_replay.sanity.linear import Inequality
from spatial_replay.sanity.sums import LeastOrGreatest, Linear, Tree, Weights, tree_of
from spatial_replay.spec.format import format_formula, format_number, format_term
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Boolean,
    Expression,
    Formula,
    Group,
    Outline,
    Projection,
    Protrusion,
    Quantified,
    Signal,
    SignedDistance,
    Truth,
    expand,
)
from spatial_replay.spec.walks import iter_formulas

MAX_DECISIONS: Final = 200_000
"""How many nodes the diagrams of conditions may have."""


class Fact(NamedTuple):
    """What a diagram decides on: an inequality between quantities, or something that is not looked into.

    Attributes:
        weights: of a sum of quantities, the first 1; none for what is not looked into.
        threshold: what the sum is compared with.
        side: ">" is false where the sum is less, and leaves open where it is equal, as relations between
            footprints are marginal there. ">=" and "<=" are meant to the letter, for sums that some relation
            compares with "==".
        texts: sentences of the language where it is true, and where it is false.
        alone: of a quantifier over a class, its value where no object is of that class; otherwise None.
    """

    weights: Weights
    threshold: Fraction
    side: Literal[">", ">=", "<="]
    texts: tuple[str, str]
    alone: bool | None = None

    def inequality(self, value: bool, label: int) -> Inequality:
        """Return what holds where the fact is true, or false."""
        rises = (self.side != "<=") == value
        is_strict = self.side == ">" or not value
        sign = -1 if rises else 1
        weights = tuple((quantity, sign * _whole(weight)) for quantity, weight in self.weights)
        return Inequality(weights, sign * self.threshold, is_strict, label)


def _whole(weight: Fraction) -> Fraction | int:
    return weight.numerator if weight.denominator == 1 else weight


class FactDiagrams:
    """The facts that some formulas are about, and the diagrams of propositions over them.

    Attributes:
        diagrams: of all conditions; variables are the numbers of facts.
        facts: by number.
    """

    def __init__(self, formulas: Iterable[Formula], regions: Mapping[str, Outline]) -> None:
        self.diagrams = Diagrams(MAX_DECISIONS)
        self.facts: list[Fact] = []
        self.regions = regions
        self._numbers: dict[object, int] = {}
        self._trees: dict[Expression, Tree | None] = {}
        self._known: dict[int, tuple[Formula, int]] = {}
        self._written: dict[int, dict[str, None]] = {}
        # quantities that are compared with "==": modes and counts as a rule
        self._compared: set[Weights] = set()
        atoms = [each for one in formulas for each in iter_formulas(one) if isinstance(each, Atom)]
        for each in atoms:
            self._tree_of(each.expression)
        # what is measured comes first: a run that only it decides can be placed
        for each in atoms:
            self.of(each)

    def of(self, formula: Formula) -> int:
        """Return the diagram of a formula about one sample."""
        known = self._known.get(id(formula))
        if known is None:
            # the formula is kept, so that its id stays its own
            known = self._known[id(formula)] = formula, self._diagram(expand(formula))
        return known[1]

    def _diagram(self, formula: Formula) -> int:
        diagrams = self.diagrams
        match formula:
            case Truth():
                return YES if formula.value else NO
            case Atom():
                tree = self._tree_of(formula.expression)
                return self._opaque(formula) if tree is None else self._condition(tree, formula)
            case Boolean(operator="not"):
                return diagrams.complement(self.of(formula.operands[0]))
            case Boolean():
                result = self.of(formula.operands[0])
                join = diagrams.both if formula.operator == "and" else diagrams.either
                for each in formula.operands[1:]:
                    result = join(result, self.of(each))
                return result
            case _:
                return self._opaque(formula)

    def _tree_of(self, expression: Expression) -> Tree | None:
        if expression not in self._trees:
            tree = self._trees[expression] = tree_of(expression, self.regions)
            if tree is not None:
                self._compared |= set(_equated(tree))
        return self._trees[expression]

    def _condition(self, tree: Tree, atom: Atom) -> int:
        """Return where a number is at least 0."""
        if isinstance(tree, LeastOrGreatest):
            parts = [self._condition(each, atom) for each in tree.options]
            join = self.diagrams.both if tree.kind == "min" else self.diagrams.either
            result = parts[0]
            for each in parts[1:]:
                result = join(result, each)
            return result
        if not tree.weights:
            return YES if tree.constant >= 0 else NO
        weights, threshold, is_least = _compared(tree)
        is_whole = isinstance(self._trees[atom.expression], Linear)
        texts = _texts(atom, is_whole, is_least, weights, threshold)
        if weights in self._compared:
            side: Literal[">=", "<="] = ">=" if is_least else "<="
            texts = _exact_texts(weights, threshold, side) or texts
            return self._fact(Fact(weights, threshold, side, texts), atom.text)
        node = self._fact(Fact(weights, threshold, ">", texts if is_least else texts[::-1]), atom.text)
        return node if is_least else self.diagrams.complement(node)

    def equal_texts(self, number: int) -> Iterator[tuple[str, str]]:
        """Yield pairs of comparisons of a fact, as "x > 1" and "x >= 1", whose robustness is the same."""
        texts = dict.fromkeys((*self._written.get(number, ()), *self.facts[number].texts))
        for strict in texts:
            for sign in (" > ", " < "):
                other = strict.replace(sign, f"{sign.rstrip()}= ")
                if other != strict and other in texts and strict in self._written[number]:
                    yield strict, other

    def _opaque(self, formula: Formula) -> int:
        text = format_formula(formula)
        alone = None
        if isinstance(formula, Quantified) and isinstance(formula.group, Group):
            alone = formula.quantifier == "forall" if formula.group.class_name != ANY_CLASS else None
        return self._fact(Fact((), Fraction(0), ">", (text, f"not ({text})"), alone))

    def _fact(self, fact: Fact, written: str = "") -> int:
        key = (fact[:3]) if fact.weights else fact.texts
        if key not in self._numbers:
            self._numbers[key] = len(self.facts)
            self.facts.append(fact)
        number = self._numbers[key]
        self._written.setdefault(number, {})[written] = None
        known = self.facts[number]
        # another relation may say without "not" what this one says with it
        first, second = (
            new if is_negated(old) and not is_negated(new) else old
            for old, new in zip(known.texts, fact.texts, strict=True)
        )
        self.facts[number] = known._replace(texts=(first, second))
        return self.diagrams.variable(number)


def is_negated(text: str) -> bool:
    """Return whether a fact is reported by a relation that does not hold."""
    return text.startswith(("not (", "not a part of "))


def _compared(linear: Linear) -> tuple[Weights, Fraction, bool]:
    """Return a sum that is at least 0 as a sum, its threshold, and whether that is the least value."""
    factor = linear.weights[0][1]
    weights = tuple((quantity, weight / factor) for quantity, weight in linear.weights)
    return weights, -linear.constant / factor, factor > 0


def _equated(tree: Tree) -> Iterable[Weights]:
    """Yield the sums that have to be equal to a threshold."""
    if isinstance(tree, Linear):
        return
    sums = [_compared(each) for each in tree.options if isinstance(each, Linear) and each.weights]
    if tree.kind == "min":
        yield from (one[0] for one in sums if one[2] and (*one[:2], False) in sums)
    for option in tree.options:
        yield from _equated(option)


def _texts(
    atom: Atom, is_whole: bool, is_least: bool, weights: Weights, threshold: Fraction
) -> tuple[str, str]:
    """Return the sentences of a fact of an atom: where it holds, and where it fails."""
    if is_whole:
        return atom.text, f"not ({atom.text})"
    compared = _compared_texts(weights, threshold, (">=", "<=") if is_least else ("<=", ">="))
    if compared is not None:
        return compared
    text = _relation_text(weights) if not threshold else None
    if text is None:
        return f"a part of {atom.text}", f"not a part of {atom.text}"
    # the relation says that a sum is at least 0, or at most
    relation, holds_above = text
    texts = relation, f"not ({relation})"
    return texts if holds_above == is_least else texts[::-1]


def _exact_texts(weights: Weights, threshold: Fraction, side: Literal[">=", "<="]) -> tuple[str, str] | None:
    """Return the sentences of a comparison that is meant to the letter; None for a sum of several numbers."""
    return _compared_texts(weights, threshold, (side, "<" if side == ">=" else ">"))


def _compared_texts(weights: Weights, threshold: Fraction, signs: tuple[str, str]) -> tuple[str, str] | None:
    (quantity, _), *others = weights
    if others or not isinstance(quantity, SignedDistance | Signal):
        return None
    name = (
        quantity.name
        if isinstance(quantity, Signal)
        else f"{format_term(quantity.first)} dist {format_term(quantity.second)}"
    )
    limit = format_number(float(threshold))
    return f"{name} {signs[0]} {limit}", f"{name} {signs[1]} {limit}"


def _relation_text(weights: Weights) -> tuple[str, bool] | None:
    """Return the relation between two terms that compares a sum with 0, and whether it holds above 0."""
    match weights:
        case ((Protrusion() as quantity, _),):
            return f"{format_term(quantity.inner)} enclosedin {format_term(quantity.outer)}", False
        case ((Projection() as one, _), (Projection() as other, weight)) if weight == -1:
            ends = {one.side: one, other.side: other}
            if one.axis == other.axis and len(ends) == 2:
                first, second = format_term(ends["max"].term), format_term(ends["min"].term)
                return f"{first} prec[{one.axis}] {second}", one.side == "min"
    return None
