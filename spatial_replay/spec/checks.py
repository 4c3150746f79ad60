"""Checks of a specification: warnings about its text, and names that a log lacks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Final

from lark import Token

from spatial_replay.spec.diagnostics import Diagnostic, Faults, SourceText, Span, nearest_hint
from spatial_replay.spec.format import format_relation
from spatial_replay.spec.formula import (
    ANY_CLASS,
    FUTURE_OPERATORS,
    PAST_OPERATORS,
    Atom,
    Equality,
    Formula,
    Group,
    NamedSpec,
    Negative,
    Quantified,
    Specification,
    Temporal,
    Term,
    TrackedName,
    operands_of,
    operator_of,
)
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.resolve import Namespace, kind_of
from spatial_replay.spec.syntax import BrokenStatement, ScaleStatement, SpecStatement, Statement
from spatial_replay.spec.tokens import (
    BINARY_TYPES,
    STATEMENT_TYPES,
    quote_name,
    span_of,
    title_hint,
    tokenize,
)
from spatial_replay.spec.walks import (
    LENGTHS,
    base_of,
    iter_formulas,
    logged_signals,
    named_members,
    rewritten,
    summed_units,
    terms_of,
    units_of,
)
from spatial_replay.text import is_text_number, names_from_unit, text_number

_NO_CHOICE: Mapping[str, str] = MappingProxyType({})
_LISTED = 12
"""Maximum number of names that a hint lists."""
_R2U2_SIGNS = frozenset({"&&", "||"})
_TIGHTNESS = MappingProxyType({"IFF": 0, "IMPLIES": 1, "OR": 2, "XOR": 3, "AND": 4})
"""Precedence of binary operators; the highest binds most tightly."""


@dataclass(slots=True)
class _Level:
    """Operators met since a bracket opened."""

    prefix: Token | None = None
    negation: Token | None = None
    binary: Token | None = None


def reach_warnings(tokens: Sequence[Token], source: SourceText, published: bool) -> Iterator[Diagnostic]:
    """Yield a warning for each operator whose operand is longer than a reader may expect.

    Args:
        published: whether to warn also where the grammar of the published implementation groups differently.
            That grammar has no precedence: Boolean operators group to the right, and `not` reaches as far as
            F and G. In that grammar, U reaches to the ends of the formula on both sides.
    """
    levels = [_Level()]
    for previous, token in pairwise([None, *tokens]):
        level = levels[-1]
        if token is None:
            continue
        if token.type in STATEMENT_TYPES:
            levels = [_Level()]
        elif token.type == "LPAR":
            levels.append(_Level())
        elif token.type == "RPAR":
            if len(levels) > 1:
                levels.pop()
        elif token.type == "PREFIX":
            levels[-1] = _Level(prefix=token)
        elif token.type == "COLON":
            levels[-1] = _Level()
        elif token.type == "NOT":
            level.negation = level.negation or token
            if previous is not None and previous.value in ("X", "WX") and _is_strong_sign(previous, token):
                yield _strong_next(previous, token, source)
        elif token.type in BINARY_TYPES:
            if level.prefix is not None:
                yield _reach(level.prefix, token, source)
                # one warning is enough for each prefix operator
                level.prefix = None
            if published:
                yield from _grouping_warnings(level, token, source)
            level.binary = token


def _is_strong_sign(previous: Token, token: Token) -> bool:
    """Return whether a `!` directly follows a prefix operator, as in `X! a`."""
    return token.value == "!" and previous.type == "PREFIX" and previous.end_pos == token.start_pos


def _strong_next(prefix: Token, sign: Token, source: SourceText) -> Diagnostic:
    span = Span(span_of(prefix).start, span_of(sign).end)
    hint = f"write {prefix.value} not (...) for that; a next sample that has to be there is written X (...)"
    return source.diagnostic("warning", span, f"'{prefix.value}!' is read as '{prefix.value} not'", hint)


def _reach(prefix: Token, operator: Token, source: SourceText) -> Diagnostic:
    message = f"{prefix.value!r} reaches over {operator.value!r} up to the closing bracket"
    hint = f"write ({prefix.value} ...) {operator.value} ... or {prefix.value} (... {operator.value} ...)"
    tool = "R2U2" if _source_text(operator, source) in _R2U2_SIGNS else "rtamt"
    if tool == "R2U2" or _source_text(prefix, source) != prefix.value:
        hint = f"in {tool} it ends in front of {operator.value!r}; {hint}"
    return source.diagnostic("warning", span_of(prefix), message, hint)


def _grouping_warnings(level: _Level, operator: Token, source: SourceText) -> Iterator[Diagnostic]:
    if level.negation is not None:
        message = f"the published grammar takes 'not' over {operator.value!r} as well; here it ends before it"
        yield source.diagnostic("warning", span_of(level.negation), message, "write the brackets you mean")
        level.negation = None
    elif level.binary is not None and _differs(level.binary, operator):
        operators = f"{level.binary.value!r} and {operator.value!r}"
        message = f"the published grammar groups {operators} the other way round"
        yield source.diagnostic("warning", span_of(operator), message, "write the brackets you mean")


def _differs(first_operator: Token, second_operator: Token) -> bool:
    """Return whether the published grammar groups two consecutive operators differently."""
    if "INFIX" in (first_operator.type, second_operator.type):
        return first_operator.type != second_operator.type
    return _TIGHTNESS[first_operator.type] > _TIGHTNESS[second_operator.type]


def spelling_warnings(tokens: Sequence[Token], source: SourceText) -> Iterator[Diagnostic]:
    """Yield a warning for each operator in the spelling of a tool that defines the operator differently.

    This language and R2U2 spell bounded U and R equally. The warning about R2U2 requires `&&` or `||` in
    the text.
    """
    connectives = (token for token in tokens if token.type in ("AND", "OR"))
    has_r2u2_sign = any(_source_text(token, source) in _R2U2_SIGNS for token in connectives)
    for position, token in enumerate(tokens):
        if token.type not in ("PREFIX", "INFIX"):
            continue
        if _source_text(token, source) == "next":
            message = "'next' is read as X, so there has to be a next sample"
            hint = "in rtamt it holds at the last sample, too: write WX for that, X for this"
            yield source.diagnostic("warning", span_of(token), message, hint)
        next_tokens = tokens[position + 1 : position + 3]
        has_window = [next_token.type for next_token in next_tokens] == ["LSQB", "NUMBER"]
        lower_end = next_tokens[1].value if has_window else ""
        if has_r2u2_sign and token.value in ("U", "R") and lower_end.strip("0").isdigit():
            message = f"the left side of {token.value!r} counts from now, not from its window's beginning"
            hint = f"in R2U2 it counts from there: F[{lower_end}, {lower_end}] (a {token.value}[0, ...] b)"
            yield source.diagnostic("warning", span_of(token), message, hint)


def _source_text(token: Token, source: SourceText) -> str:
    return source.text[span_of(token).start : span_of(token).end]


def past_warnings(specs: Sequence[NamedSpec], source: SourceText) -> Iterator[Diagnostic]:
    """Yield a warning for each past operator outside future operators: it sees only the first sample."""
    warned: set[Span] = set()
    for spec in specs:
        stack: list[Formula] = [spec.formula] if spec.is_result else []
        while stack:
            node = stack.pop()
            # inside a future operator, a past operator sees earlier samples
            if isinstance(node, Temporal) and node.operator in FUTURE_OPERATORS:
                continue
            if isinstance(node, Temporal) and node.operator in PAST_OPERATORS:
                if node.span not in warned:
                    warned.add(node.span)
                    message = f"{node.operator!r} looks back from the first sample, where there is no past"
                    hint = f"put it inside a future operator, such as G ({node.operator} ...)"
                    yield source.diagnostic("warning", node.span, message, hint)
                continue
            stack.extend(operands_of(node))


def last_sample_warnings(specification: Specification) -> Iterator[Diagnostic]:
    """Yield a warning for each `F G p` and `G F p`: over a finite log both mean p at the last sample."""
    source = SourceText.of(specification.source, specification.filename)
    warned_spans: set[Span] = set()
    for spec in specification.results:
        for formula in iter_formulas(spec.formula):
            operand = operands_of(formula)[0] if _is_unbounded(formula) else formula
            operators = f"{operator_of(formula)} {operator_of(operand)}"
            if operators not in ("F G", "G F") or not _is_unbounded(operand) or formula.span in warned_spans:
                continue
            warned_spans.add(formula.span)
            message = f"`{operators} p` asks for the last sample of a log alone"
            yield source.diagnostic("warning", formula.span, message, _LASTING[operators])


_LASTING: Final = {
    "F G": "write F ((G[0s, 2s] p) and (F[2s, inf] true)) for two seconds on end, or"
    " F ((G p) and (F[2s, inf] true)) for at least the last two",
    "G F": "write G ((F[0s, 9s] p) or not (F[9s, inf] true)) for again and again, at least every"
    " nine seconds",
}
"""Suggested formula by pair of operators."""


def _is_unbounded(formula: Formula) -> bool:
    """Return whether a formula is an F or G over all samples from the current one to the end."""
    if not isinstance(formula, Temporal) or formula.operator not in ("F", "G"):
        return False
    return formula.bound is None or (formula.bound.lower, formula.bound.upper) == (0, None)


def equality_warnings(specs: Sequence[NamedSpec], source: SourceText) -> Iterator[Diagnostic]:
    """Yield a warning for each `a dist b == c`: a measured distance hardly ever equals a number."""
    warned: set[Span] = set()
    for spec in specs:
        for atom in iter_formulas(spec.formula):
            is_exact = isinstance(atom, Atom) and atom.relation != "signal" and "==" in atom.parameters
            if isinstance(atom, Atom) and is_exact and atom.span not in warned:
                warned.add(atom.span)
                message = f"`{atom.text}` hardly ever holds: its robustness is at most 0"
                *rate_signals, _, limit = atom.parameters
                # 12 digits, because 0.1 + 0.05 would be written as 0.15000000000000002
                lower, upper = (float(f"{float(limit) + offset:.12g}") for offset in (-0.05, 0.05))
                band = format_relation(atom.relation, atom.terms, (*rate_signals, lower, "<=", "<=", upper))
                hint = f"write a band, such as {band}"
                yield source.diagnostic("warning", atom.span, message, hint)


def unused_warnings(names: Namespace, source: SourceText) -> Iterator[Diagnostic]:
    """Yield a warning for each unused definition, except specs: an unused spec is a result."""
    for name, statement in names.definitions.items():
        # a broken definition already has a fault
        if isinstance(statement, (SpecStatement, BrokenStatement)) or name in names.used:
            continue
        message = f"{name!r} is {kind_of(statement)} that nothing uses"
        yield source.diagnostic("warning", statement.name.span, message, "use it or leave it out")


def scale_warnings(
    statements: Sequence[Statement], specs: Sequence[NamedSpec], source: SourceText
) -> Iterator[Diagnostic]:
    """Yield a warning for each `scale` line that applies to no atom."""
    scales = [statement for statement in statements if isinstance(statement, ScaleStatement)]
    units = {str(unit.signal or LENGTHS): unit for spec in specs if scales for unit in units_of(spec.formula)}
    for statement in scales:
        name = statement.name.text
        if name not in units or units[name].divisor is None:
            signals = [unit.signal for unit in units.values() if unit.signal is not None]
            hint = nearest_hint(name, signals) or f"it takes a signal that a spec compares, or {LENGTHS}"
            message = f"no number of a spec is in the unit of {name!r}, so this scale divides nothing"
            yield source.diagnostic("warning", statement.name.span, message, hint)


def object_names(specification: Specification) -> tuple[str, ...]:
    """Return the tracked objects of the specs' atoms in text order, including members of named groups."""
    names: dict[str, None] = {}
    for atom in _atoms(specification):
        for term in terms_of(atom.expression):
            base = base_of(term)
            if isinstance(base, TrackedName):
                names[base.name] = None
            elif isinstance(base, Group):
                names.update(dict.fromkeys(named_members(base)))
    return tuple(names)


def group_classes(specification: Specification) -> tuple[str, ...]:
    """Return the classes of open groups in text order; `ANY_CLASS` stands for all objects."""
    terms: list[Term] = []
    for spec in specification.results:
        for formula in iter_formulas(spec.formula):
            if isinstance(formula, Quantified):
                terms.append(formula.group)
            elif isinstance(formula, Atom):
                terms += terms_of(formula.expression)
    bases = [base for term in terms if isinstance(base := base_of(term), Group)]
    return tuple(dict.fromkeys(name for base in bases if (name := base.class_name)))


def signal_names(specification: Specification) -> tuple[str, ...]:
    """Return the logged signals that the specs compare, in text order."""
    atoms = _atoms(specification)
    return tuple(dict.fromkeys(name for atom in atoms for name in logged_signals(atom.expression)))


def _atoms(specification: Specification) -> Iterable[Atom]:
    # a spec that uses another spec shares its formula, so one atom can be in several specs
    visited_ids: set[int] = set()
    for spec in specification.results:
        for formula in iter_formulas(spec.formula):
            if isinstance(formula, Atom) and id(formula) not in visited_ids:
                visited_ids.add(id(formula))
                yield formula


def check_names(
    specification: Specification,
    known: Iterable[str],
    signals: Iterable[str],
    *,
    where: str = "log",
    during: str = "",
    classes: Iterable[str] = (),
    each: Mapping[str, str] = _NO_CHOICE,
) -> tuple[Diagnostic, ...]:
    """Compare the names of a specification with the names of a log.

    Args:
        known: names of the log's objects.
        signals: names of the log's numeric signals.
        where: word for the source of the known names in messages, such as "log".
        during: part of the source that was read, such as "in its first 5.000 s"; "" for the whole source.
        classes: classes of the log's objects.
        each: objects by template parameter: "all", "class:NAME" or the name of one object.

    Returns:
        Errors and warnings in text order. Each object, signal and template class that the log lacks is an
        error with the nearest name. A missing class of an open group is an error only if a class of the log
        has a similar name. A definition that hides an object of the log is a warning.
    """
    known_objects, known_signals = tuple(known), tuple(signals)
    known_classes = tuple(classes)
    source = SourceText.of(specification.source, specification.filename)
    first_places, definition_places = _places(specification, source)
    diagnostics: list[Diagnostic] = []

    def report(
        kind: str, name: str, candidates: tuple[str, ...], span: Span, hint: str = "", during: str = ""
    ) -> None:
        # an unknown name in a sum is parsed as a signal, so it may be a misspelt constant
        similar_names = (*candidates, *specification.constants) if kind == "signal" else candidates
        hint = hint or " ".join(filter(None, (nearest_hint(name, similar_names), _listing(kind, candidates))))
        message = f"the {where} never has the {kind} {name!r}" + (during and f" {during}")
        diagnostics.append(source.diagnostic("error", span, message, hint))

    for kind, names, candidates in (
        ("object", object_names(specification), known_objects),
        ("signal", signal_names(specification), known_signals),
    ):
        for name in names:
            if name not in candidates:
                hint = _class_hint(name, kind, known_classes)
                report(kind, name, candidates, first_places.get(name, Span(0, 0)), hint, during)
    folded_classes = {name.casefold() for name in known_classes}
    for spec in specification.results:
        choice = each.get(spec.parameter or "", "all")
        kind, _, name = choice.partition(":")
        if kind == "class" and name.casefold() not in folded_classes:
            report("class", name, known_classes, spec.span)
        elif kind != "class" and choice not in ("all", *known_objects):
            report("object", choice, known_objects, spec.span)
    for name in group_classes(specification):
        # a log may lack a class, so only a name that is close to one of its classes is reported as misspelt
        if name != ANY_CLASS and name.casefold() not in folded_classes and nearest_hint(name, known_classes):
            report("class", name, known_classes, first_places.get(name, Span(0, 0)))
    for name, span in definition_places.items():
        if name in known_objects:
            message = f"the {where} has an object {name!r}, which this definition hides"
            hint = "give the definition another name"
            hint += f"; {title_hint(name)}" if any(spec.name == name for spec in specification.specs) else ""
            diagnostics.append(source.diagnostic("warning", span, message, hint))
    return tuple(sorted(diagnostics, key=lambda diagnostic: (diagnostic.line, diagnostic.column)))


def with_numbers(specification: Specification, units: Mapping[str, str]) -> Specification:
    """Return a specification with the names of enumerated signals replaced by their numbers.

    Args:
        units: declared unit by signal; an enumerated signal has a JSON object of numbers by name instead.

    Raises:
        SpecificationError: an unknown name of an enumerated signal, or a sum or comparison of numbers with
            different units.
    """
    names_by_signal = {signal: names for signal, unit in units.items() if (names := names_from_unit(unit))}
    faults = Faults(SourceText.of(specification.source, specification.filename))

    def named_equality(atom: Atom) -> Equality | None:
        equality = atom.expression.operand if isinstance(atom.expression, Negative) else atom.expression
        if (
            isinstance(equality, Equality)
            and equality.signal.name in names_by_signal
            and is_text_number(equality.value)
        ):
            return equality
        return None

    def change(atom: Atom) -> Atom:
        if (equality := named_equality(atom)) is None:
            return atom
        names = names_by_signal[equality.signal.name]
        number_by_text = {text_number(name): number for name, number in names.items()}
        if equality.value not in number_by_text:
            fault_text = f"no number of {equality.signal.name} is called {atom.parameters[-1]}"
            faults.add(atom.span, fault_text, f"its names are {', '.join(map(quote_name, names))}")
            return atom
        numeric_equality = replace(equality, value=number_by_text[equality.value])
        return replace(
            atom, expression=numeric_equality if equality is atom.expression else -numeric_equality
        )

    for atom in _atoms(specification):
        sum_units = summed_units(atom.expression, units) if atom.relation == "sum" else []
        if len(sum_units) > 1:
            message = f"`{atom.text}` adds or compares numbers in {' and '.join(sum_units)}"
            hint = (
                "multiply one of them by a constant that converts it, or by 1 if its declared unit is wrong"
            )
            faults.add(atom.span, message, hint)
    if not any(map(named_equality, _atoms(specification))):
        faults.raise_if_any()
        return specification
    specs = tuple(replace(spec, formula=rewritten(spec.formula, change)) for spec in specification.specs)
    faults.raise_if_any()
    return replace(specification, specs=specs)


def _class_hint(name: str, kind: str, classes: Iterable[str]) -> str:
    """Return a hint that an unknown object name is a class; "" if no class has the name."""
    class_name = next((label for label in classes if label.casefold() == name.casefold()), None)
    if kind != "object" or class_name is None:
        return ""
    group_text = f"class {quote_name(class_name)}"
    return f"it is a class: write {group_text} for all of them, or forall one in {group_text}: ..."


def _listing(kind: str, names: tuple[str, ...]) -> str:
    kinds = "classes" if kind == "class" else f"{kind}s"
    if not names:
        return f"it has no {kinds}"
    listed_names = ", ".join(names[:_LISTED])
    return f"its {kinds} are {listed_names}" + (", ..." if len(names) > _LISTED else "")


def _places(specification: Specification, source: SourceText) -> tuple[dict[str, Span], dict[str, Span]]:
    """Return two places for each name: its first occurrence, and its definition."""
    relations = RELATION_NAMES | specification.relations
    tokens = tokenize(specification.source, relations, Faults(source))
    first_places: dict[str, Span] = {}
    definition_places: dict[str, Span] = {}
    for token in tokens:
        if token.type == "NAME":
            first_places.setdefault(token.value, span_of(token))
    for keyword, name in pairwise(tokens):
        if keyword.type in ("CONST", "REGION", "GROUP", "DEF", "SPEC") and name.type == "NAME":
            definition_places.setdefault(name.value, span_of(name))
    return first_places, definition_places
