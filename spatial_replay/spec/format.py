"""Canonical text of terms, formulas and specifications, and the lines of a formula's tree.

Constants, macros and quantifiers over named groups are expanded. Every operand except names, `true` and
`false` is in brackets. Numbers keep all digits. Parsing the text gives an equal specification.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import NamedTuple

from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Boolean,
    Bound,
    Centre,
    Earlier,
    Enlarged,
    Expression,
    Formula,
    Group,
    Maximum,
    Minimum,
    NamedSpec,
    Negative,
    Number,
    Outline,
    Product,
    Quantified,
    Rate,
    Scaled,
    Signal,
    SignedDistance,
    Specification,
    Sum,
    Temporal,
    Term,
    Truth,
    operands_of,
    operator_of,
)
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import quote_name, written_name

_LARGEST_PLAIN = 1e16
"""Smallest whole number that is written with an exponent, as by `repr`."""


def format_number(value: float) -> str:
    """Return a number with all its digits; a whole number has no ".0"."""
    if value.is_integer() and abs(value) < _LARGEST_PLAIN:
        return str(int(value))
    return repr(value)


def format_duration(ns: int) -> str:
    """Return nanoseconds as exact seconds: "2.5s"."""
    # Decimal, because floats of seconds do not hold every nanosecond
    return f"{Decimal(ns).scaleb(-9).normalize():f}s"


def format_bound(bound: Bound | None) -> str:
    """Return the text of a window, such as "[0, 10]"; "" without a window."""
    if bound is None:
        return ""
    format_end = format_duration if bound.unit == "ns" else str
    upper = "inf" if bound.upper is None else format_end(bound.upper)
    return f"[{format_end(bound.lower)}, {upper}]"


# ---------------------------------------------------------------------------------------------- terms


def format_term(term: Term, relations: frozenset[str] = RELATION_NAMES) -> str:
    """Return the text of a term; a name in `relations` is quoted."""
    match term:
        case Enlarged():
            return f"enlarge({format_term(term.term, relations)}, {format_number(term.radius)})"
        case Centre():
            return f"center({format_term(term.term, relations)})"
        case Earlier(samples=int(samples)):
            return f"{format_term(term.term, relations)}[-{samples}]"
        case Earlier():
            return f"{format_term(term.term, relations)}[-{format_duration(term.duration_ns or 0)}]"
        case Group():
            return _format_group(term, relations)
        case _:
            return written_name(term.name, relations)


def _format_group(group: Group, relations: frozenset[str]) -> str:
    text = written_name(group.name, relations) if group.name else _format_open(group)
    for excluded in group.excluded:
        text += f" except {written_name(excluded.name, relations)}"
    return f"({text})" if group.excluded else text


def _format_open(group: Group) -> str:
    return "all" if group.class_name == ANY_CLASS else f"class {quote_name(group.class_name or '')}"


def format_relation(
    relation: str,
    terms: Sequence[Term],
    parameters: Sequence[float | str],
    relations: frozenset[str] = RELATION_NAMES,
) -> str:
    """Return the text of an atom from its relation, terms and parameters (see `Atom`)."""
    texts = [format_term(term, relations) for term in terms]
    arguments = [format_number(value) if isinstance(value, float) else value for value in parameters]
    if relation == "signal":
        return f"{written_name(arguments[0], relations)} {arguments[1]} {arguments[2]}"
    if relation in ("dist", "speed", "rate"):
        quantity = f"{texts[0]} dist {texts[1]}" if relation == "dist" else f"speed({', '.join(texts)})"
        if relation == "rate":
            signal, *arguments = arguments
            quantity = f"rate({written_name(signal, relations)})"
        if len(arguments) == 2:
            return f"{quantity} {arguments[0]} {arguments[1]}"
        if not arguments:
            return quantity
        return f"{arguments[0]} {arguments[1]} {quantity} {arguments[2]} {arguments[3]}"
    if relation == "present":
        return f"present({texts[0]})"
    if relation == "closer":
        return f"{texts[0]} closer {texts[1]} than {texts[2]}"
    bracket = f"[{', '.join(arguments)}]" if arguments else ""
    right = f"({texts[1]}, {texts[2]})" if relation == "between" else texts[1]
    return f"{texts[0]} {relation}{bracket} {right}"


def format_atom(
    relation: str,
    expression: Expression,
    terms: Sequence[Term],
    parameters: Sequence[float | str],
    relations: frozenset[str] = RELATION_NAMES,
) -> str:
    """Return the text of an atom (see `Atom`); the text of a sum comes from its expression."""
    if relation != "sum":
        return format_relation(relation, terms, parameters, relations)
    unscaled = expression.operand if isinstance(expression, Scaled) else expression
    margins = unscaled.operands if isinstance(unscaled, Minimum) else (unscaled,)
    signs = [sign for sign in parameters if isinstance(sign, str)]
    sides = [_sides(margin, sign) for margin, sign in zip(margins, signs, strict=True)]
    texts = [format_sum(side, relations) for side in (sides[0][0], *(right for _, right in sides))]
    return texts[0] + "".join(f" {sign} {text}" for sign, text in zip(signs, texts[1:], strict=True))


def _sides(margin: Expression, sign: str) -> tuple[Expression, Expression]:
    """Return the left and right side of a comparison from its margin (see `relations.compare`)."""
    match margin:
        case Sum(first, Negative(second)):
            return (first, second) if sign.startswith(">") else (second, first)
    raise TypeError(f"{margin!r} is no margin of a comparison")


def format_sum(expression: Expression, relations: frozenset[str] = RELATION_NAMES) -> str:
    """Return the text of a computed number; each operand that is an operation is in brackets."""

    def operand(inner: Expression) -> str:
        text = format_sum(inner, relations)
        is_unbracketed = isinstance(inner, Number | Signal | Maximum)
        return text if is_unbracketed else f"({text})"

    match expression:
        case Number(value):
            return format_number(value)
        case SignedDistance(first, second):
            return format_relation("dist", (first, second), (), relations)
        case Rate(terms=(), signal=Signal(name)):
            return format_relation("rate", (), (name,), relations)
        case Rate(terms=terms):
            return format_relation("speed", terms, (), relations)
        case Signal(name):
            return written_name(name, relations)
        case Maximum((inner, _)):
            return f"abs({format_sum(inner, relations)})"
        case Negative(inner):
            return f"-{operand(inner)}"
        case Product(factor, inner):
            return f"{format_number(factor)} * {operand(inner)}"
        case Scaled(inner, divisor):
            return f"{operand(inner)} / {format_number(divisor)}"
        case Sum(first, Negative(second)):
            return f"{_first_summand(first, relations)} - {operand(second)}"
        case Sum(first, second):
            return f"{_first_summand(first, relations)} + {operand(second)}"
    raise TypeError(f"{expression!r} is no sum")


def _first_summand(expression: Expression, relations: frozenset[str]) -> str:
    text = format_sum(expression, relations)
    return f"({text})" if isinstance(expression, SignedDistance | Negative) else text


# ------------------------------------------------------------------------------------------- formulas


def format_formula(
    formula: Formula, *, references: bool = False, relations: frozenset[str] = RELATION_NAMES
) -> str:
    """Return the canonical text of a formula.

    Args:
        references: whether named specs below the root are written by their names, as in a file, instead of
            as formulas.
        relations: names that need quotes.
    """

    def operand(inner: Formula) -> str:
        if references and inner.name is not None:
            return written_name(inner.name, relations)
        text = format_formula(inner, references=references, relations=relations)
        return text if isinstance(inner, Truth) else f"({text})"

    match formula:
        case Truth():
            return "true" if formula.value else "false"
        case Atom():
            return formula.text
        case Boolean(operator="spec"):
            spec_formula = formula.operands[0]
            if references and spec_formula.name is not None:
                return written_name(spec_formula.name, relations)
            return format_formula(spec_formula, references=references, relations=relations)
        case Boolean(operator="given" | "with"):
            return format_formula(formula.operands[-1], references=references, relations=relations)
        case Boolean(operator="not"):
            return f"not {operand(formula.operands[0])}"
        case Boolean():
            return f" {formula.operator} ".join([operand(inner) for inner in formula.operands])
        case Temporal():
            operator = formula.operator + format_bound(formula.bound)
            if len(formula.operands) == 1:
                return f"{operator} {operand(formula.operands[0])}"
            return f"{operand(formula.operands[0])} {operator} {operand(formula.operands[1])}"
        case Quantified():
            variables = ", ".join(written_name(variable, relations) for variable in formula.variables)
            group = format_term(formula.group, relations)
            return f"{formula.quantifier} {variables} in {group}: {operand(formula.body)}"


def format_specification(specification: Specification) -> str:
    """Return the canonical text of a specification, with one line for each `spec`."""
    relations = RELATION_NAMES | specification.relations
    lines = [f"use {specification.profile}"]
    # the digest is a comment, because parsing does not check it
    lines += [f"use {name}  # SHA-256 {digest}" for name, digest in specification.plugins.items()]
    for name, outline in specification.regions.items():
        lines.append(f"region {written_name(name, relations)} = {_format_outline(outline)}")
    for scale in specification.scales:
        # a signal with the name "lengths" needs quotes
        signal = "lengths" if scale.signal is None else written_name(scale.signal, relations | {"lengths"})
        lines.append(f"scale {signal} = {format_number(scale.divisor)}")
    for name, group in specification.groups.items():
        members = _format_open(group)
        if group.members is not None:
            members = ", ".join(written_name(member, relations) for member in group.members)
        lines.append(f"group {written_name(name, relations)} = {members}")
    lines.extend(_format_spec(spec, relations) for spec in specification.specs)
    return "\n".join(lines) + "\n"


def _format_spec(spec: NamedSpec, relations: frozenset[str]) -> str:
    parameter = f"({written_name(spec.parameter, relations)})" if spec.parameter is not None else ""
    formula = format_formula(spec.formula, references=True, relations=relations)
    title = f" {quote_name(title_text(spec))}" if spec.title is not None else ""
    return f"spec {written_name(spec.name, relations)}{parameter}{title} = {formula}"


def title_text(spec: NamedSpec) -> str:
    """Return the requirement id and title of a spec as one text; "" without id and title."""
    return ": ".join(text for text in (spec.id, spec.title) if text is not None)


def _format_outline(outline: Outline) -> str:
    points = [f"({format_number(x)}, {format_number(y)})" for x, y in outline.vertices]
    height = ""
    if outline.height is not None:
        bottom, top = outline.height
        height = f" height ({format_number(bottom)}, {format_number(top)})"
    if outline.is_disc:
        return f"circle({points[0]}, {format_number(outline.radius)}){height}"
    return f"polygon({', '.join(points)}){height}"


class Branch(NamedTuple):
    """Node of a formula's tree, printed as one line.

    Attributes:
        id: number of the node in text order; the root is 0.
        stem: lines that connect the node with its ancestors, such as "│  ├─ ".
    """

    id: int
    stem: str
    node: Formula


def iter_branches(formula: Formula) -> Iterator[Branch]:
    """Yield every node in text order, the root first."""
    stack = [("", "", formula)]
    node_id = 0
    while stack:
        ancestor_stem, node_connector, node = stack.pop()
        yield Branch(node_id, ancestor_stem + node_connector, node)
        node_id += 1
        child_stem = ancestor_stem + {"": "", "├─ ": "│  ", "└─ ": "   "}[node_connector]
        connector = "└─ "
        for operand in reversed(operands_of(node)):
            stack.append((child_stem, connector, operand))
            connector = "├─ "


def title_of(node: Formula) -> str:
    """Return the operator or atom of a node without name and operands: "F[0, 10]", "a ovlp b"."""
    match node:
        case Atom() | Quantified() | Truth():
            return format_formula(node)
        case Temporal(operator, _, bound) if bound is not None:
            return f"{operator}{format_bound(bound)}"
        case _:
            return operator_of(node)


def label_of(node: Formula) -> str:
    """Return the operator or atom of a node, with its name if it has one: "reach = F[0, 10]"."""
    return title_of(node) if node.name is None else f"{node.name} = {title_of(node)}"
