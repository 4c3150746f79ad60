"""Traversals of terms, expressions and formulas: parts, substitution and units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from math import inf
from typing import Any, Literal

from spatial_replay.spec.format import format_atom, format_number, format_term
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Centre,
    ComputedSignal,
    DerivedTerm,
    Earlier,
    Enlarged,
    Equality,
    Expression,
    Formula,
    Group,
    HasRate,
    Maximum,
    Measurement,
    Minimum,
    Negative,
    Number,
    Present,
    PreviousSignal,
    Product,
    Quantified,
    Rate,
    RegionName,
    ReportStep,
    Scale,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    TrackedName,
    Truth,
    Variable,
    iter_nodes,
    judged_operands,
    operands_of,
    operator_of,
)
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import written_name
from spatial_replay.text import plain_unit


def base_of(term: Term) -> TrackedName | Variable | RegionName | Group:
    """Return the object, variable, region or group of a term, without delays, enlargements and centres."""
    while isinstance(term, DerivedTerm):
        term = term.term
    return term


def standing(term: Term) -> TrackedName | Variable | RegionName | Group | Earlier:
    """Return a term without enlargements and centres; a delay is kept."""
    while isinstance(term, Enlarged | Centre):
        term = term.term
    return term


def is_centre(term: Term) -> bool:
    """Return whether a term is a centre or an enlarged centre."""
    return isinstance(term, Centre) or (isinstance(term, Enlarged) and is_centre(term.term))


def looks_back(term: Term) -> bool:
    """Return whether a term is delayed."""
    return isinstance(standing(term), Earlier)


def iter_expressions(expression: Expression) -> Iterator[Expression]:
    """Yield an expression and all its subexpressions."""
    stack = [expression]
    while stack:
        subexpression = stack.pop()
        yield subexpression
        match subexpression:
            case Sum():
                stack += (subexpression.second, subexpression.first)
            case Negative() | Product() | Scaled():
                stack.append(subexpression.operand)
            case Equality():
                stack.append(subexpression.signal)
            case HasRate():
                stack.append(subexpression.rate)
            case Minimum() | Maximum():
                stack += reversed(subexpression.operands)


def terms_of(expression: Expression) -> Iterator[Term]:
    """Yield the measured terms of an expression; a rate yields its current and its earlier terms."""
    for subexpression in iter_expressions(expression):
        if isinstance(subexpression, Measurement):
            yield from subexpression.terms
        elif isinstance(subexpression, Rate):
            yield from terms_of(change_of(subexpression))


def speed_of(*terms: Term) -> Rate:
    """Return the speed of one term, or the speed at which the distance of two terms decreases."""
    return Rate(f"speed({', '.join(map(format_term, terms))})", terms)


def rate_of(signal: Signal) -> Rate:
    """Return the rate of change of a signal."""
    return Rate(f"rate({written_name(signal.name, RELATION_NAMES)})", (), signal)


def presence_of(term: TrackedName | Variable) -> Equality:
    """Return the condition that a sample contains an object."""
    return Equality(Present(f"present({format_term(term)})", term), 1.0)


def rates_of(formula: Formula) -> list[Rate]:
    """Return the rates of change in a formula."""
    return [part for part in iter_parts(formula) if isinstance(part, Rate)]


def has_rate(formula: Formula) -> bool:
    """Return whether a formula contains a rate of change."""
    return bool(rates_of(formula))


def leaves_out(formula: Formula) -> bool:
    """Return whether the outermost operator skips samples or members in which a rate has no value."""
    operands = (formula.body,) if isinstance(formula, Quantified) else operands_of(formula)
    return judged_operands(operator_of(formula), operands) is not operands


def is_about_having_rates(leaf: Formula) -> bool:
    """Return whether a leaf is the condition that a rate has a value (see `judged_operands`)."""
    return isinstance(leaf, Atom) and any(isinstance(part, HasRate) for part in iter_parts(leaf))


def change_of(rate: Rate) -> Sum | SignedDistance:
    """Return the change of a rate's quantity between two reports; the rate is change / `step_of`."""
    match rate.terms:
        case (first, second):
            earlier_terms = (_moved_back(term, _moving(rate)) for term in rate.terms)
            return SignedDistance(*earlier_terms) - SignedDistance(first, second)
        case (term,):
            base: Any = base_of(term)
            return SignedDistance(Centre(base), _moved_back(Centre(base), _moving(rate)))
    signal = rate.signal or Signal("")
    return signal - PreviousSignal(signal.name, signal)


def step_of(rate: Rate) -> ReportStep:
    """Return the time between the two reports of a rate, in seconds."""
    return ReportStep("", _moving(rate), rate.signal)


def _moving(rate: Rate) -> tuple[TrackedName | Variable | Group, ...]:
    bases = map(base_of, rate.terms)
    return tuple(base for base in bases if not isinstance(base, RegionName))


def _moved_back(term: Term, rate: tuple[TrackedName | Variable | Group, ...]) -> Term:
    if isinstance(term, RegionName):
        return term
    inner_term: Any = term
    if isinstance(term, Enlarged | Centre):
        inner_term = _moved_back(term.term, rate)
        return replace(term, term=inner_term)
    return Earlier(inner_term, rate=rate)


def logged_signals(expression: Expression) -> Iterator[str]:
    """Yield the names of the logged signals in an expression."""
    for subexpression in iter_expressions(expression):
        signal = subexpression.signal if isinstance(subexpression, Rate) else subexpression
        signal = signal.signal if isinstance(signal, PreviousSignal) else signal
        if isinstance(signal, Signal) and not isinstance(signal, ComputedSignal | HasRate | Present):
            yield signal.name


def signals_in(expression: Expression) -> frozenset[str]:
    """Return the names of the signals and rates in an expression."""
    return frozenset(part.name for part in iter_expressions(expression) if isinstance(part, Signal))


def iter_formulas(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and its subformulas in text order, bodies of quantifiers included."""
    stack = [formula]
    while stack:
        subformula = stack.pop()
        yield subformula
        match subformula:
            case Boolean() | Temporal():
                stack += reversed(subformula.operands)
            case Quantified():
                stack.append(subformula.body)


def iter_bound(formula: Formula) -> Iterator[tuple[Formula, tuple[Quantified, ...]]]:
    """Yield the formulas of `iter_formulas`, each with its enclosing quantifiers, outermost first."""
    stack: list[tuple[Formula, tuple[Quantified, ...]]] = [(formula, ())]
    while stack:
        node, quantifiers = stack.pop()
        yield node, quantifiers
        if isinstance(node, Quantified):
            stack.append((node.body, (*quantifiers, node)))
        stack += [(operand, quantifiers) for operand in reversed(operands_of(node))]


def iter_atoms(formula: Formula) -> Iterator[Atom]:
    """Yield the atoms of a formula in text order, including atoms in quantifiers."""
    return (part for part in iter_formulas(formula) if isinstance(part, Atom))


def iter_parts(formula: Formula) -> Iterator[Expression]:
    """Yield every expression in the atoms of a formula."""
    return (part for atom in iter_atoms(formula) for part in iter_expressions(atom.expression))


def leaf_key(leaf: Formula) -> tuple[object, ...]:
    """Return a key that is equal for equal leaves; names and places in the text are ignored."""
    if isinstance(leaf, Quantified):
        return leaf.quantifier, leaf.variables, leaf.group, leaf.body
    return (leaf.expression,) if isinstance(leaf, Atom) else (leaf,)


def nodes_of(formula: Formula) -> list[Formula]:
    """Return all nodes of a tree in the order of their ids."""
    return [node for _, _, node in iter_nodes(formula)]


def nodes_with_operands(formula: Formula) -> list[tuple[Formula, list[int]]]:
    """Return all nodes of a tree in the order of their ids, each with the ids of its operands."""
    nodes: list[tuple[Formula, list[int]]] = []
    for node_id, parent, node in iter_nodes(formula):
        nodes.append((node, []))
        if parent is not None:
            nodes[parent][1].append(node_id)
    return nodes


def named_members(group: Group) -> tuple[str, ...]:
    """Return the members of a named group without excluded members; () for an open group."""
    excluded_names = {member.name for member in group.excluded}
    return tuple(name for name in group.members or () if name not in excluded_names)


def is_spatial(formula: Formula) -> bool:
    """Return whether a formula has no temporal operator."""
    return not any(isinstance(part, Temporal) for part in iter_formulas(formula))


def looks_ahead(formula: Formula) -> bool:
    """Return whether a formula contains a future operator."""
    return any(
        isinstance(part, Temporal) and part.operator in FUTURE_OPERATORS for part in iter_formulas(formula)
    )


def iter_terms(formulas: Iterable[Formula]) -> Iterator[Term]:
    """Yield the terms of atoms and the groups of open quantifiers, in text order."""
    for formula in formulas:
        for subformula in iter_formulas(formula):
            if isinstance(subformula, Atom):
                yield from terms_of(subformula.expression)
            elif isinstance(subformula, Quantified):
                yield subformula.group


def other_names(formula: Formula) -> frozenset[str]:
    """Return the names of objects, regions, groups and specs in a formula; variables are left out."""
    names = {part.name for part in iter_formulas(formula) if part.name is not None}
    present_terms = (part.term for part in iter_parts(formula) if isinstance(part, Present))
    for base in map(base_of, chain(iter_terms([formula]), present_terms)):
        if isinstance(base, (TrackedName, RegionName, Group)):
            names.add(base.name)
        if isinstance(base, Group):
            names.update(member.name for member in base.excluded if isinstance(member, TrackedName))
    return frozenset(names)


def operand_signs(formula: Formula, operand: int) -> tuple[int, ...]:
    """Return the signs with which an operand enters its node's robustness: 1, -1 or both.

    Args:
        operand: index of the operand.
    """
    if not isinstance(formula, Boolean):
        return (1,)
    # stand-ins, because two equal operands can be the same Python object
    stand_ins = tuple(Truth(True) for _ in formula.operands)
    node = Boolean(formula.operator, stand_ins)
    signs: set[int] = set()
    stack: list[tuple[Formula, int]] = [(node.expansion or node, 1)]
    while stack:
        subformula, sign = stack.pop()
        if subformula is stand_ins[operand]:
            signs.add(sign)
        operand_sign = -sign if operator_of(subformula) == "not" else sign
        stack.extend((inner, operand_sign) for inner in operands_of(subformula))
    return tuple(sorted(signs, reverse=True))


# -------------------------------------------------------------------------------------- substitution

Names = Mapping[str, TrackedName | Variable]


def horizon_ns(formula: Formula) -> float:
    """Return the future horizon of a formula, in ns; inf if it is not bounded in time."""
    longest_ns = max(map(horizon_ns, operands_of(formula)), default=0.0)
    if not isinstance(formula, Temporal) or formula.operator not in FUTURE_OPERATORS:
        return longest_ns
    bound = formula.bound
    # a window in samples has no fixed duration
    if bound is None or bound.upper is None or bound.unit != "ns":
        return inf
    return longest_ns + bound.upper


def can_settle(formula: Formula, *, satisfied: bool) -> bool:
    """Return whether a prefix of a run may settle a formula as satisfied, or as violated if not `satisfied`.

    The check looks only at operators: the result can be True although no prefix settles the formula.
    """
    match formula:
        case Boolean(operator="not", operands=(operand,)):
            return can_settle(operand, satisfied=not satisfied)
        case Boolean(operator="and" | "or" as operator, operands=operands):
            needs_all = (operator == "and") == satisfied
            return (all if needs_all else any)(
                can_settle(operand, satisfied=satisfied) for operand in operands
            )
        case Temporal(operator="G" | "F" as operator, operands=(operand,), bound=bound):
            is_open = bound is None or bound.upper is None
            # a later sample can always violate an open `G`, or satisfy an open `F`
            if is_open and (operator == "G") == satisfied:
                return isinstance(operand, Truth)
            return can_settle(operand, satisfied=satisfied)
        case (
            Boolean(operator="spec", operands=(operand,)) | Temporal(operator="X" | "WX", operands=(operand,))
        ):
            return can_settle(operand, satisfied=satisfied)
    return True


def substitute(formula: Formula, names: Names, relations: frozenset[str] = RELATION_NAMES) -> Formula:
    """Return a formula with some of its variables replaced."""
    if not names:
        return formula
    match formula:
        case Truth():
            return formula
        case Atom():
            expression = map_leaves(
                formula.expression, partial(changed_leaf, change=partial(substitute_term, names=names))
            )
            terms = tuple(substitute_term(term, names) for term in formula.terms)
            text = formula.text
            if terms:
                text = format_atom(formula.relation, expression, terms, formula.parameters, relations)
            return replace(formula, text=text, terms=terms, expression=expression)
        case Quantified():
            group: Any = substitute_term(formula.group, names)
            free_names = {old: new for old, new in names.items() if old not in formula.variables}
            return replace(formula, group=group, body=substitute(formula.body, free_names, relations))
        case _:
            operands = tuple([substitute(operand, names, relations) for operand in formula.operands])
            return replace(formula, operands=operands)


def rewritten(formula: Formula, change: Callable[[Atom], Atom]) -> Formula:
    """Return a formula with a function applied to each of its atoms."""
    match formula:
        case Atom():
            return change(formula)
        case Truth():
            return formula
        case Quantified():
            return replace(formula, body=rewritten(formula.body, change))
        case Boolean() | Temporal():
            operands = tuple([rewritten(operand, change) for operand in formula.operands])
            return replace(formula, operands=operands)


def with_operands(formula: Formula, node: int, operands: tuple[Formula, ...]) -> Formula:
    """Return a formula with new operands for the node with the id `node`."""
    if not isinstance(formula, Boolean | Temporal):
        return formula
    if node == 0:
        return replace(formula, operands=operands)
    new_operands: list[Formula] = []
    operand_id = 1
    for operand in formula.operands:
        node_count = sum(1 for _ in iter_nodes(operand))
        is_within = operand_id <= node < operand_id + node_count
        new_operands.append(with_operands(operand, node - operand_id, operands) if is_within else operand)
        operand_id += node_count
    return replace(formula, operands=tuple(new_operands))


def without_variables(formula: Quantified) -> Formula:
    """Return the body of a quantifier with numbered variables, so that equality ignores variable names."""
    quantifier_count = sum(isinstance(part, Quantified) for part in iter_formulas(formula.body))
    # these names begin with a blank, so they clash only with a quoted name that begins with a blank
    return substitute(
        formula.body,
        {name: Variable(f" {quantifier_count}.{index}") for index, name in enumerate(formula.variables)},
    )


def substitute_term(term: Term, names: Names) -> Term:
    """Return a term with some of its variables replaced."""
    match term:
        case Variable():
            return names.get(term.name, term)
        case Group():
            return replace(term, excluded=tuple(_object(member, names) for member in term.excluded))
        case Earlier(rate=(_, *_)):
            moved_term: Any = substitute_term(term.term, names)
            rate: Any = tuple(substitute_term(rate_term, names) for rate_term in term.rate)
            return replace(term, term=moved_term, rate=rate)
        case Earlier() | Enlarged() | Centre():
            inner_term: Any = substitute_term(term.term, names)
            return replace(term, term=inner_term)
        case _:
            return term


def _object(term: TrackedName | Variable, names: Names) -> TrackedName | Variable:
    return names.get(term.name, term) if isinstance(term, Variable) else term


def map_leaves(
    expression: Expression, change: Callable[[Number | Signal | Measurement], Expression]
) -> Expression:
    """Return an expression with a function applied to its numbers, signals and measurements."""
    match expression:
        case Sum():
            return Sum(map_leaves(expression.first, change), map_leaves(expression.second, change))
        case Negative():
            return Negative(map_leaves(expression.operand, change))
        case Minimum():
            return Minimum(tuple([map_leaves(operand, change) for operand in expression.operands]))
        case Maximum():
            return Maximum(tuple([map_leaves(operand, change) for operand in expression.operands]))
        case Product():
            return Product(expression.factor, map_leaves(expression.operand, change))
        case Scaled():
            return Scaled(map_leaves(expression.operand, change), expression.divisor)
        case Equality(Present() as presence):
            signal: Any = change(presence)
            return replace(expression, signal=signal)
        case Equality():
            return expression
        case _:
            return change(expression)


def changed_leaf(leaf: Number | Signal | Measurement, change: Callable[[Term], Term]) -> Expression:
    """Return a number, signal or measurement with a function applied to its terms."""
    if isinstance(leaf, Rate):
        return speed_of(*map(change, leaf.terms)) if leaf.terms else leaf
    if isinstance(leaf, Present):
        term: Any = change(leaf.term)
        return presence_of(term).signal
    return leaf if isinstance(leaf, Number | Signal) else leaf.with_terms(*map(change, leaf.terms))


LENGTHS = "lengths"
"""Name of the footprint units in `scale`."""
MULTIPLES = "multiples"
"""Name of the unit of a sum in which every signal or distance has a factor, as in `2 * x <= 1`."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of an atom's number.

    Attributes:
        kind: "length" (unit of the footprints), "signal" (unit of the signal), "rate" (either unit per
            second) or "orientation" (no unit).
        signal: name of the signal, or None.
        divisor: divisor from a `scale` line, or None.
    """

    kind: Literal["length", "signal", "rate", "orientation"]
    signal: str | None = None
    divisor: float | None = None

    def __str__(self) -> str:
        name = "orientations" if self.kind == "orientation" else self.signal or LENGTHS
        name += " per second" if self.kind == "rate" else ""
        return name if self.divisor is None else f"{name} / {format_number(self.divisor)}"


def units_of(formula: Formula) -> tuple[Unit, ...]:
    """Return the distinct units of a formula's atoms, in text order.

    An equality such as `mode == 2` has no unit, because its robustness is infinite.

    A minimum over atoms with the same unit has that unit. A minimum over several units may compare numbers
    that are not comparable, unless all units are scaled (see `is_mixed`).
    """
    return tuple(dict.fromkeys(unit for atom in iter_atoms(formula) for unit in _units(atom.expression)))


def declared_unit(formula: Formula, declared: Mapping[str, str], *, is_scaled: bool = True) -> str:
    """Return the declared unit of a formula's robustness; "" if there is not exactly one.

    Args:
        declared: units by name of signal; the unit of lengths has the key "".
        is_scaled: whether `scale` lines are applied; a scaled number has no unit.
    """
    if not declared:
        return ""
    units = {
        "" if is_scaled and unit.divisor is not None else _declared_name(unit, declared)
        for unit in units_of(formula)
    }
    return units.pop() if len(units) == 1 else ""


def _declared_name(unit: Unit, declared: Mapping[str, str]) -> str:
    if unit.kind == "orientation":
        return ""
    name = declared.get(unit.signal or "", "")
    return per_second(name) if unit.kind == "rate" else plain_unit(name)


def per_second(unit: str) -> str:
    """Return the unit of a rate of change; "" if the unit of the changing number is not declared."""
    return plain_unit(unit) and ("1/s" if unit == "1" else f"{unit}/s")


def is_mixed(units: Sequence[Unit]) -> bool:
    """Return whether numbers of these units are not comparable: several units, not all of them scaled."""
    return len(units) > 1 and any(unit.divisor is None and unit.kind != "orientation" for unit in units)


def units_text(units: Sequence[Unit]) -> str:
    """Return a sentence with the units that a robustness combines; "" for fewer than two."""
    if len(units) < 2:
        return ""
    *first_units, last_unit = map(str, units)
    kind = "different units" if is_mixed(units) else "units made comparable"
    return f"Its robustness is the least of numbers in {kind}: {', '.join(first_units)} and {last_unit}."


def divide_by_scale(expression: Expression, scales: Sequence[Scale]) -> Expression:
    """Return the expression of an atom, divided by the scale of its unit if there is one."""
    units = _units(expression)
    for scale in scales:
        kind: Literal["length", "signal"] = "length" if scale.signal is None else "signal"
        if units == [Unit(kind, scale.signal)]:
            return Scaled(expression, scale.divisor)
    return expression


def _units(expression: Expression) -> list[Unit]:
    divisor = expression.divisor if isinstance(expression, Scaled) else None
    unscaled = expression.operand if isinstance(expression, Scaled) else expression
    subexpressions = list(iter_expressions(unscaled))
    if any(isinstance(subexpression, Equality) for subexpression in subexpressions):
        return []
    if leaves := _unit_leaves(unscaled):
        return list(dict.fromkeys(_unit_of(leaf, divisor) for leaf in leaves))
    is_number = all(
        isinstance(subexpression, Number | Sum | Negative | Minimum | Maximum)
        for subexpression in subexpressions
    )
    return [] if is_number else [Unit("signal", MULTIPLES, divisor)]


def _unit_leaves(expression: Expression) -> list[Signal | Measurement]:
    """Return the parts that determine the unit of an expression.

    Summands have the same unit, so one summand is enough. A multiple is left out, because its constant may
    convert the unit.
    """
    match expression:
        case Sum(first, second):
            return _unit_leaves(first) or _unit_leaves(second)
        case Negative(operand):
            return _unit_leaves(operand)
        case Minimum(operands) | Maximum(operands):
            return [leaf for operand in operands for leaf in _unit_leaves(operand)]
        case Number() | Product() | Scaled() | Equality():
            return []
    return [expression]


def _unit_of(leaf: Signal | Measurement, divisor: float | None) -> Unit:
    match leaf:
        case Rate():
            return Unit("rate", leaf.signal.name if leaf.signal else None, divisor)
        case Signal():
            return Unit("signal", leaf.name, divisor)
        case Measurement(unit="orientation"):
            return Unit("orientation")
    return Unit("length", None, divisor)


def summed_units(expression: Expression, declared: Mapping[str, str]) -> list[str]:
    """Return the distinct declared units of a sum's operands; multiples are left out.

    Args:
        declared: units by name of signal (see `declared_unit`).
    """
    units: dict[str, None] = {}
    stack = [expression.operand if isinstance(expression, Scaled) else expression]
    while stack:
        current = stack.pop()
        match current:
            case Sum(first, second):
                stack += (second, first)
            case Negative(operand):
                stack.append(operand)
            case Minimum(operands) | Maximum(operands):
                stack += reversed(operands)
            case Signal() | SignedDistance():
                units[_declared_name(_unit_of(current, None), declared)] = None
    return [unit for unit in units if unit]
