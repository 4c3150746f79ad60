"""Text to statements: each statement is parsed separately, so that all faults are reported."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any

import lark
from lark import Lark, Token
from lark.exceptions import UnexpectedToken
from lark.lexer import Lexer

from spatial_replay.spec.diagnostics import Faults, Span, nearest_hint
from spatial_replay.spec.syntax import (
    Arithmetic,
    BooleanSyntax,
    BoundSyntax,
    BrokenStatement,
    Call,
    CentreSyntax,
    ComparisonSyntax,
    ConstStatement,
    DefStatement,
    Delayed,
    DistanceSyntax,
    Duration,
    Enlargement,
    Exclusion,
    FormulaSyntax,
    GroupStatement,
    Name,
    NumberSyntax,
    OpenGroup,
    Point,
    QuantifierSyntax,
    Quantity,
    RateSyntax,
    RegionStatement,
    RelationSyntax,
    ScaleStatement,
    Shape,
    SpecStatement,
    Statement,
    TemporalSyntax,
    TruthSyntax,
    UseStatement,
    depth_of,
)
from spatial_replay.spec.tokens import (
    BINARY_TYPES,
    KEYWORDS,
    STATEMENT_TYPES,
    foreign_token_advice,
    is_called,
    meant_statement,
    quote_name,
    span_of,
)

MAX_DEPTH = 100
"""Maximum number of nested brackets or operators."""

MAX_EXCLUDED = 1000
"""Maximum number of objects after `except` in one term."""

MAX_DURATION_NS = 2**63 - 1
"""Longest duration, ns: times in logs are signed 64-bit integers."""

_BOOLEAN = MappingProxyType({"AND": "and", "OR": "or", "XOR": "xor", "IMPLIES": "->", "IFF": "<->"})
_NS = MappingProxyType({"s": Decimal(10**9), "ms": Decimal(10**6)})


class StatementError(Exception):
    """Fault in a syntax node, raised while the node is built."""

    def __init__(self, span: Span, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.span, self.message, self.hint = span, message, hint


def _span(node: Any) -> Span:
    return span_of(node) if isinstance(node, Token) else node.span


def _cover(children: list[Any]) -> Span:
    present_children = [child for child in children if child is not None]
    return Span(_span(present_children[0]).start, _span(present_children[-1]).end)


def _deeper(operands: tuple[FormulaSyntax, ...], span: Span) -> int:
    depth = 1 + max(depth_of(operand) for operand in operands)
    if depth > MAX_DEPTH:
        hint = "give parts of it names of their own, with spec"
        raise StatementError(span, f"more than {MAX_DEPTH} operators within one another", hint)
    return depth


def read_number(text: str, span: Span) -> float | Duration:
    """Return the value of the text of a number or a duration.

    Raises:
        StatementError: the number is too large, or the duration is not a whole number of nanoseconds.
    """
    unit = "ms" if text.endswith("ms") else "s" if text.endswith("s") else ""
    digits = text.removesuffix(unit)
    if not unit:
        value = float(digits)
        if not isfinite(value):
            hint = "numbers reach up to about 1.7e308"
            raise StatementError(span, f"{text} is too large for a number", hint)
        return value
    amount = Decimal(digits)
    # int() of 1e999999999s would be a number of a billion digits
    if amount and not -40 < amount.adjusted() < 40:
        raise StatementError(span, f"{text} is not a usable duration", "durations go from 1e-9s to 9e9s")
    ns = amount * _NS[unit]
    if ns != int(ns) or ns > MAX_DURATION_NS:
        raise StatementError(span, f"{text} is not a usable duration", "give whole nanoseconds, at most 9e9s")
    return Duration(int(ns))


def _title(token: Token) -> str:
    text: str = token.value.strip()
    if not text:
        raise StatementError(span_of(token), "a title is empty", 'write "REQ-12: what must hold", or nothing')
    return text


def _arithmetic(operator: Any, operands: tuple[Quantity, ...], children: list[Any]) -> Arithmetic:
    span = _cover(children)
    depth = 1 + max([operand.depth for operand in operands if isinstance(operand, Arithmetic)], default=0)
    if depth > MAX_DEPTH:
        hint = "give parts of it names of their own, with const"
        raise StatementError(span, f"more than {MAX_DEPTH} operations within one another", hint)
    return Arithmetic(operator, operands, span, depth)


def _looking_back(written: Quantity) -> Quantity:
    """Return the length of a delay: n of `[-n]`.

    Raises:
        StatementError: the text in brackets does not begin with a minus sign.
    """
    if isinstance(written, Arithmetic):
        leftmost: Quantity = written
        while isinstance(leftmost, Arithmetic) and len(leftmost.operands) == 2:
            leftmost = leftmost.operands[0]
        if isinstance(leftmost, Arithmetic):
            if leftmost is written:
                operand: Quantity = written.operands[0]
                return operand
            # in [-a + b] the sign belongs to a alone, so the delay is the negative of the whole sum
            return Arithmetic("-", (written,), written.span, written.depth + 1)
    hint = "write [-3] for three samples earlier, [-2.5s] for 2.5 seconds"
    if isinstance(written, Name):
        hint = f"leave [{written.text}] out for what it is now; {hint}"
    raise StatementError(written.span, "the brackets behind an object look back, so expected '-'", hint)


class TreeBuilder:
    """Builder of syntax nodes; lark calls the method named after a rule with the rule's tokens and nodes."""

    # ------------------------------------------------------------------------------------ statements

    def use(self, children: list[Any]) -> UseStatement:
        return UseStatement(children[1])

    def const(self, children: list[Any]) -> ConstStatement:
        return ConstStatement(children[1], children[3], children[5])

    def scale(self, children: list[Any]) -> ScaleStatement:
        return ScaleStatement(children[1], children[3])

    def region(self, children: list[Any]) -> RegionStatement:
        _, name, _, shape, *height_children = children
        if height_children[0] is None:
            return RegionStatement(name, shape, None, None)
        return RegionStatement(name, shape, (height_children[2], height_children[4]), _cover(height_children))

    def group(self, children: list[Any]) -> GroupStatement:
        _, name, _, members = children
        if isinstance(members, OpenGroup):
            return GroupStatement(name, None, members)
        return GroupStatement(name, members, None)

    def definition(self, children: list[Any]) -> DefStatement:
        return DefStatement(children[1], children[3] or (), children[6])

    def spec(self, children: list[Any]) -> SpecStatement:
        _, name, _, parameters, _, title, _, formula = children
        return SpecStatement(name, parameters or (), formula, None if title is None else _title(title))

    def names(self, children: list[Any]) -> tuple[Name, ...]:
        return tuple(child for child in children if isinstance(child, Name))

    def name(self, children: list[Token]) -> Name:
        return Name(children[0].value, span_of(children[0]))

    def polygon(self, children: list[Any]) -> Shape:
        return Shape("polygon", children[2] or (), None, _cover(children))

    def box(self, children: list[Any]) -> Shape:
        corners = ((children[2], children[4]), (children[6], children[8]))
        return Shape("box", corners, None, _cover(children))

    def circle(self, children: list[Any]) -> Shape:
        return Shape("circle", (children[2],), children[4], _cover(children))

    def points(self, children: list[Any]) -> tuple[Any, ...]:
        return tuple(child for child in children if not isinstance(child, Token))

    parameters = arguments = points

    def point(self, children: list[Any]) -> Point:
        return (children[1], children[3])

    def number(self, children: list[Token]) -> NumberSyntax:
        span = _cover(children)
        return NumberSyntax(read_number(children[0].value, span), span)

    def negative(self, children: list[Any]) -> Arithmetic:
        return _arithmetic("-", (children[1],), children)

    def arithmetic(self, children: list[Any]) -> Arithmetic:
        left, token, right = children
        return _arithmetic(token.value, (left, right), children)

    # -------------------------------------------------------------------------------------- formulas

    def chain(self, children: list[Any]) -> BooleanSyntax:
        left, token, right = children
        operator: Any = _BOOLEAN[token.type]
        span = _cover(children)
        depth = _deeper((left, right), span_of(token))
        can_merge = operator in ("and", "or") and isinstance(left, BooleanSyntax)
        if can_merge and left.operator == operator and not left.is_bracketed:
            # the list is changed in place, because copies would take quadratic time in a long chain
            left.operands.append(right)
            return BooleanSyntax(operator, left.operands, span, max(left.depth, 1 + depth_of(right)))
        return BooleanSyntax(operator, [left, right], span, depth)

    def negation(self, children: list[Any]) -> BooleanSyntax:
        token, operand = children
        return BooleanSyntax("not", [operand], _cover(children), _deeper((operand,), span_of(token)))

    def infix(self, children: list[Any]) -> TemporalSyntax:
        left, token, bound, right = children
        depth = _deeper((left, right), span_of(token))
        return TemporalSyntax(token.value, span_of(token), bound, (left, right), _cover(children), depth)

    def prefix(self, children: list[Any]) -> TemporalSyntax:
        token, bound, operand = children
        depth = _deeper((operand,), span_of(token))
        return TemporalSyntax(token.value, span_of(token), bound, (operand,), _cover(children), depth)

    def bound(self, children: list[Any]) -> BoundSyntax:
        return BoundSyntax(children[1], children[3], _cover(children))

    def quantifier(self, children: list[Any]) -> QuantifierSyntax:
        token, variables, _, group, _, body = children
        depth = _deeper((body,), span_of(token))
        return QuantifierSyntax(token.value, variables, group, body, _cover(children), depth)

    def truth(self, children: list[Token]) -> TruthSyntax:
        return TruthSyntax(children[0].value == "true", span_of(children[0]))

    def call(self, children: list[Any]) -> Call:
        return Call(children[0], children[2] or (), _cover(children))

    def bracketed(self, children: list[Any]) -> Any:
        inner = children[1]
        if isinstance(inner, BooleanSyntax):
            return inner._replace(span=_cover(children), is_bracketed=True)
        # brackets do not widen the span of a name, because the span's length says whether the name is quoted
        return inner if isinstance(inner, Name) else inner._replace(span=_cover(children))

    def relation(self, children: list[Any]) -> RelationSyntax:
        left, token, parameters, right = children
        operator_span = span_of(token)
        return RelationSyntax(token.value, operator_span, (left, right), parameters or (), _cover(children))

    def closer(self, children: list[Any]) -> RelationSyntax:
        first, token, second, _, third = children
        return RelationSyntax("closer", span_of(token), (first, second, third), (), _cover(children))

    def between(self, children: list[Any]) -> RelationSyntax:
        first, token, parameters, _, second, _, third, _ = children
        terms = (first, second, third)
        return RelationSyntax("between", span_of(token), terms, parameters or (), _cover(children))

    def distance(self, children: list[Any]) -> DistanceSyntax:
        return DistanceSyntax(children[0], children[2], _cover(children))

    def rate(self, children: list[Any]) -> RateSyntax:
        return RateSyntax(children[0].value, children[2] or (), _cover(children))

    def comparison(self, children: list[Any]) -> ComparisonSyntax:
        present_children = [child for child in children if child is not None]
        return ComparisonSyntax(tuple(present_children[::2]), tuple(present_children[1::2]), _cover(children))

    # ----------------------------------------------------------------------------------------- terms

    def open_group(self, children: list[Any]) -> OpenGroup:
        if len(children) == 1:
            return OpenGroup(None, _cover(children))
        if children[1].text == "*":
            hint = "the group of every object is `all`"
            raise StatementError(children[1].span, "no class is named '*'", hint)
        return OpenGroup(children[1].text, _cover(children))

    def exclusion(self, children: list[Any]) -> Exclusion:
        group, _, name = children
        if isinstance(group, Exclusion):
            if len(group.excluded) >= MAX_EXCLUDED:
                hint = "name those that belong to the group instead"
                raise StatementError(name.span, f"more than {MAX_EXCLUDED} objects left out", hint)
            return Exclusion(group.group, (*group.excluded, name), _cover(children))
        return Exclusion(group, (name,), _cover(children))

    def enlarge(self, children: list[Any]) -> Enlargement:
        return Enlargement(children[2], children[4], _cover(children))

    def center(self, children: list[Any]) -> CentreSyntax:
        return CentreSyntax(children[2], _cover(children))

    def delayed(self, children: list[Any]) -> Delayed:
        term, _, amount, _ = children
        span = _cover(children)
        if isinstance(term, Delayed):
            raise StatementError(span, "a delay of a delayed object", "add the two up in one [-n]")
        return Delayed(term, _looking_back(amount), span)


FORMULA_NAME = "spec"
"""Name of the spec in a text that is only a formula."""

TABLES_FILE = "grammar_tables.json"
"""File of the parser tables; `tools/make_grammar` writes it."""
_OPENING = frozenset({"LPAR", "LSQB"})

# in other tools (#people <= 2) counts objects; in this language # begins a comment
_COUNTED = re.compile(r"# *\w+ *[<>=!]")
_COUNTED_HINT = "# begins a comment; a plug-in counts objects"
_STATEMENT_WORDS = (*(word for word, kind in KEYWORDS.items() if kind in STATEMENT_TYPES), "scale")


@dataclass(frozen=True, slots=True)
class TokenGroup:
    """Tokens of one statement, or of a text that is one formula."""

    tokens: tuple[Token, ...]
    is_bare_formula: bool = False
    is_broken: bool = False


def parse_statements(tokens: Sequence[Token], relations: Collection[str], faults: Faults) -> list[Statement]:
    """Return the statements of a text and report its faults.

    A faulty statement becomes a `BrokenStatement` if its name is readable; otherwise it is left out.
    A bare formula becomes a `spec` with the name `FORMULA_NAME`.
    """
    statements: list[Statement] = []
    for group in split_statements(tokens, faults):
        statement = _parse_group(group, relations, faults)
        if statement is not None:
            statements.append(statement)
    return statements


# ---------------------------------------------------------------------------------- where statements end


def split_statements(tokens: Sequence[Token], faults: Faults) -> Iterator[TokenGroup]:
    """Divide the tokens of a text into statements.

    Statement words are reserved and always begin a statement, so an unclosed bracket affects one statement.
    """
    if not any(token.type in STATEMENT_TYPES - {"USE"} for token in tokens):
        yield from _split_bare_formula(tokens, faults)
        return
    statement_tokens: list[Token] = []
    open_brackets: list[tuple[Token, bool]] = []
    is_continued = True
    for token in tokens:
        if statement_tokens and _begins_statement(
            token, statement_tokens[-1], bool(open_brackets), is_continued, faults
        ):
            yield from _close(statement_tokens, open_brackets, faults)
            statement_tokens, open_brackets = [], []
        is_continued = _step(token, statement_tokens, open_brackets)
        statement_tokens.append(token)
    yield from _close(statement_tokens, open_brackets, faults)


def _split_bare_formula(tokens: Sequence[Token], faults: Faults) -> Iterator[TokenGroup]:
    start_index = 0
    while start_index < len(tokens) and tokens[start_index].type == "USE":
        line = tokens[start_index].line
        end_index = start_index + 1
        while end_index < len(tokens) and tokens[end_index].line == line and end_index < start_index + 2:
            end_index += 1
        yield TokenGroup(tuple(tokens[start_index:end_index]))
        if end_index < len(tokens) and tokens[end_index].line == line:
            message = "a statement ends at the end of its line"
            faults.add(span_of(tokens[end_index]), message, "begin a new line here")
        start_index = end_index
    open_brackets: list[tuple[Token, bool]] = []
    formula = list(tokens[start_index:])
    for index, token in enumerate(formula):
        _step(token, formula[:1] if index == 0 else [formula[index - 1]], open_brackets)
    yield from _close(formula, open_brackets, faults, is_bare_formula=True)


def _begins_statement(
    token: Token, previous: Token, is_in_bracket: bool, is_continued: bool, faults: Faults
) -> bool:
    # directly after -, the word is the rest of a name without quotes, such as safe-region
    if token.type in STATEMENT_TYPES and not (
        previous.type == "MINUS" and previous.end_pos == token.start_pos
    ):
        if token.line == previous.line:
            message = f"{token.value!r} begins a statement within a line"
            faults.add(span_of(token), message, "begin a new line")
        return True
    return (
        token.line != previous.line
        and not is_in_bracket
        and not is_continued
        and token.type not in BINARY_TYPES
    )


def _step(token: Token, previous_tokens: Sequence[Token], open_brackets: list[tuple[Token, bool]]) -> bool:
    """Update the open brackets for a token; return whether a line break after the token is allowed.

    An open bracket has a flag: whether it follows a temporal operator.
    """
    if token.type in _OPENING:
        open_brackets.append(
            (token, bool(previous_tokens) and previous_tokens[-1].type in ("PREFIX", "INFIX"))
        )
        return True
    if token.type in ("RPAR", "RSQB") and open_brackets:
        # after the window of a temporal operator, its operand may be on the next line
        bracket, is_after_temporal = open_brackets.pop()
        return is_after_temporal and bracket.type == "LSQB"
    return token.type in BINARY_TYPES or token.type in ("PREFIX", "NOT", "EQUAL", "COLON")


def _close(
    tokens: list[Token],
    open_brackets: list[tuple[Token, bool]],
    faults: Faults,
    is_bare_formula: bool = False,
) -> Iterator[TokenGroup]:
    if not tokens:
        return
    if open_brackets:
        bracket = open_brackets[-1][0]
        closing_bracket = ")" if bracket.type == "LPAR" else "]"
        rest_of_line = faults.source.text[tokens[-1].end_pos :].partition("\n")[0].lstrip()
        hint = _COUNTED_HINT if _COUNTED.match(rest_of_line) else f"add a {closing_bracket!r}"
        faults.add(span_of(bracket), f"{bracket.value!r} is never closed", hint)
    is_broken = bool(open_brackets) or any(token.type == "ERROR" for token in tokens)
    yield TokenGroup(tuple(tokens), is_bare_formula, is_broken)


# ------------------------------------------------------------------------------------------ one statement


class _Tokens(Lexer):
    """Lexer without tokens; lark requires a lexer, but tokens are fed to the parser one by one."""

    def __init__(self, lexer_conf: object) -> None:
        super().__init__()

    def lex(self, lexer_state: object, parser_state: object) -> Iterator[Token]:
        return iter(())


@cache
def grammar() -> Lark:
    """Return the parser of statements and formulas; a conflict in the grammar is an error.

    Computing the parser tables takes longer than reading a specification, so a file next to the grammar
    stores them. The file is used if it was made from this grammar with the installed version of lark.
    """
    text = _resource("grammar.lark")
    tables: Any = json.loads(_resource(TABLES_FILE), object_hook=_with_numbers)
    if tables["made_from"] == made_from(text):
        parser_data = tables["data"]
        # JSON cannot store classes, so they are put back
        parser_data["options"] |= {"lexer": _Tokens, "transformer": TreeBuilder()}
        parser_data["parser"]["lexer_conf"]["lexer_type"] = _Tokens
        return Lark.load({"data": parser_data, "memo": tables["memo"]})
    return built_grammar(text)


def built_grammar(text: str) -> Lark:
    """Compute the tables of a grammar and return its parser."""
    builder: Any = TreeBuilder()
    return Lark(
        text, parser="lalr", lexer=_Tokens, start=["statement", "formula"], strict=True,
        maybe_placeholders=True, transformer=builder,
    )  # fmt: skip


def made_from(grammar_text: str) -> str:
    """Return the key of parser tables: the version of lark and a digest of the grammar."""
    return f"lark {lark.__version__}, grammar {hashlib.sha256(grammar_text.encode()).hexdigest()}"


def _resource(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _with_numbers(table: dict[str, Any]) -> dict[Any, Any]:
    """Return a table with numeric keys as numbers; JSON has only texts as keys."""
    return {int(key) if key.isdecimal() else key: value for key, value in table.items()}


def _parse_group(group: TokenGroup, relations: Collection[str], faults: Faults) -> Statement | None:
    tokens = group.tokens
    if group.is_broken:
        return _broken(tokens)
    fault_count = faults.count
    deep_bracket = _too_deep(tokens)
    if deep_bracket is not None:
        message = f"more than {MAX_DEPTH} brackets within one another"
        faults.add(span_of(deep_bracket), message, "give parts names of their own, with spec")
        return _broken(tokens)
    if not group.is_bare_formula and tokens[0].type not in STATEMENT_TYPES:
        words = ", ".join(_STATEMENT_WORDS)
        hint = meant_statement(tokens) or nearest_hint(tokens[0].value, _STATEMENT_WORDS)
        for name, sign, word in zip(tokens, tokens[1:], tokens[2:], strict=False):
            if (name.type, sign.type) == ("NAME", "MINUS") and word.type in STATEMENT_TYPES:
                hint = f'a name with - is written in quotes: "{name.value}-{word.value}"'
        hint = hint or "a formula is named by spec NAME = ...; a line that goes on ends in an operator"
        faults.add(span_of(tokens[0]), f"expected a statement ({words}), found {tokens[0].value!r}", hint)
        return _broken(tokens)
    parser: Any = grammar().parse_interactive(start="formula" if group.is_bare_formula else "statement")
    node: Any = None
    try:
        for token in tokens:
            parser.feed_token(token)
        node = parser.feed_eof(tokens[-1])
    except UnexpectedToken as unexpected:
        if faults.is_full:
            # `parsing.accepts()` tries every kind of token, which is slow
            faults.add(_place(unexpected.token, tokens), "")
        else:
            _report(unexpected.token, tokens, parser.accepts(), relations, faults)
    except StatementError as fault:
        faults.add(fault.span, fault.message, fault.hint)
    if faults.count > fault_count or node is None:
        return _broken(tokens)
    if group.is_bare_formula:
        formula: FormulaSyntax = node
        return SpecStatement(Name(FORMULA_NAME, Span(0, 0)), (), formula)
    statement: Statement = node
    return statement


def _too_deep(tokens: Sequence[Token]) -> Token | None:
    """Return the first bracket that is nested more than `MAX_DEPTH` deep; None if there is none."""
    depth = 0
    for token in tokens:
        if token.type in _OPENING:
            depth += 1
            if depth > MAX_DEPTH:
                return token
        elif token.type in ("RPAR", "RSQB"):
            depth -= 1
    return None


def _broken(tokens: Sequence[Token]) -> BrokenStatement | None:
    if len(tokens) > 1 and tokens[1].type == "NAME" and tokens[0].type not in ("USE", "SCALE"):
        return BrokenStatement(Name(tokens[1].value, span_of(tokens[1])))
    if len(tokens) > 1 and tokens[0].type == "NAME" and tokens[1].type == "EQUAL":
        return BrokenStatement(Name(tokens[0].value, span_of(tokens[0])))
    return None


# ----------------------------------------------------------------------------------- what was expected

_EXPECTATIONS: tuple[tuple[frozenset[str], str], ...] = (
    (frozenset({"TRUTH", "NOT", "PREFIX"}), "a formula"),
    (frozenset({"NUMBER", "ENLARGE", "RATE"}), "a signal, a number or a distance"),
    (frozenset({"ENLARGE", "ALL"}), "an object, region or group"),
    (frozenset({"NUMBER", "MINUS"}), "a number"),
    (frozenset({"PLUS", "STAR"}), "an arithmetic sign"),
    (frozenset({"NAME"}), "a name"),
    (frozenset({"RELATION"}), "a relation"),
    (frozenset({"COMPARE"}), "a comparison (<=, <, >=, >, ==)"),
    (frozenset({"AND", "OR"}), "an operator"),
)
_SIGN_OF: Mapping[str, str] = MappingProxyType({
    "LPAR": "'('", "RPAR": "')'", "LSQB": "'['", "RSQB": "']'", "COMMA": "','", "COLON": "':'",
    "EQUAL": "'='", "MINUS": "'-'", "IN": "'in'", "THAN": "'than'", "DIST": "'dist'",
    "TITLE": "a title in quotes", "$END": "the end of the statement", "HEIGHT": "'height'",
    "POLYGON": "'polygon'", "BOX": "'box'", "CIRCLE": "'circle'", "CLASS": "'class'",
})  # fmt: skip
_COVERED: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "a formula": frozenset({"NAME", "LPAR", "MINUS", "NUMBER", "ENLARGE", "ALL", "CLASS", "RATE"}),
        "a signal, a number or a distance": frozenset({"NAME", "LPAR", "MINUS", "ALL", "CLASS", "CENTER"}),
        "an object, region or group": frozenset({"NAME", "LPAR", "CLASS", "NUMBER", "MINUS"}),
        "a number": frozenset({"NAME", "LPAR"}),
        "an arithmetic sign": frozenset({"MINUS", "SLASH"}),
        "a relation": frozenset({"DIST", "CLOSER", "BETWEEN"}),
    }
)


def _expectation(accepted_types: set[str]) -> str:
    remaining_types = set(accepted_types)
    phrases: list[str] = []
    for types, phrase in _EXPECTATIONS:
        if types <= remaining_types:
            phrases.append(phrase)
            remaining_types -= types | _COVERED.get(phrase, frozenset())
    phrases += [sign for kind, sign in _SIGN_OF.items() if kind in remaining_types]
    return " or ".join(phrases) if len(phrases) < 3 else ", ".join(phrases[:-1]) + " or " + phrases[-1]


def _place(token: Token, tokens: Sequence[Token]) -> Span:
    if token.type == "$END":
        last_span = span_of(tokens[-1])
        return Span(last_span.end, last_span.end)
    return span_of(token)


def _between_objects(tokens: Sequence[Token], position: int) -> str:
    """Return the correct text of a relation that was written like a function: `closeto(a, b, 0.1)`."""
    arguments: list[list[str]] = [[]]
    for token in tokens[position + 2 :]:
        if token.type == "RPAR":
            break
        if token.type == "COMMA":
            arguments.append([])
        else:
            arguments[-1].append(token.value)
    left, right, *parameters = (
        [*(" ".join(words) for words in arguments), "b"]
        if len(arguments) < 2
        else [" ".join(words) for words in arguments]
    )
    bracket = f"[{', '.join(parameters)}]" if parameters else ""
    return f"{left or 'a'} {tokens[position].value}{bracket} {right or 'b'}"


def _report(
    token: Token, tokens: Sequence[Token], accepted: set[str], relations: Collection[str], faults: Faults
) -> None:
    """Report a token at a place where the grammar does not allow it."""
    position = next((index for index, candidate in enumerate(tokens) if candidate is token), len(tokens))
    previous = tokens[position - 1] if position else None
    span = _place(token, tokens)
    if position and (advice := foreign_token_advice(tokens, position, accepted)) is not None:
        faults.add(span, *advice)
        return
    if token.type == "$END":
        rest_of_line = faults.source.text[span.start :].partition("\n")[0].lstrip()
        hint = _COUNTED_HINT if rest_of_line.startswith("#") else ""
        faults.add(span, f"the statement ends too early: expected {_expectation(accepted)}", hint)
        return
    message = f"expected {_expectation(accepted)}, found {token.value!r}"
    token_types = [token.type for token in tokens[: position + 1]]
    if token_types.count("RPAR") > token_types.count("LPAR"):
        faults.add(span, f"{token.value!r} closes nothing", "leave it out, or open it in front with '('")
    elif token.type == "NAME" and "RELATION" in accepted:
        words = (*relations, "dist", "closer", "between", "and", "or", "implies")
        hint = faults.nearest(token.value, words) or f"relations are {', '.join(sorted(relations))}, dist"
        faults.add(span, f"unknown relation {token.value!r}", hint)
    elif previous is not None and previous.type in ("RELATION", "DIST", "CLOSER", "THAN") and token.type in (
        "PREFIX", "NOT", "QUANTIFIER", "TRUTH",
    ):  # fmt: skip
        hint = f"put it before the relation; an object of that name is written {quote_name(token.value)}"
        faults.add(span, f"{token.value!r} cannot stand inside a relation", hint)
    elif token.type in ("RELATION", "DIST") and is_called(tokens, position):
        hint = f"write it between its objects: {_between_objects(tokens, position)}"
        faults.add(span, f"{token.value!r} is not a function", hint)
    elif token.type == "EQUAL" and tokens[0].type != "CONST":
        faults.add(span, message, "equality is written ==; a statement begins a line with what it defines")
    elif token.type == "SLASH" and "NAME" in accepted:
        hint = 'a name with other characters than letters, digits and _ is written in quotes: "/a/b"'
        faults.add(span, message, hint)
    elif token.type in ("RELATION", "DIST", "CLOSER", "BETWEEN") and previous is not None:
        hint = "a relation stands between two objects, without operators inside"
        if previous.type in ("PREFIX", "INFIX", "TRUTH", "NOT"):
            hint = f"if {previous.value!r} is an object, write it in quotes: {quote_name(previous.value)}"
        faults.add(span, f"{token.value!r} needs an object, region or group on its left", hint)
    elif "NAME" in accepted and (token.value in KEYWORDS or token.type == "RELATION"):
        hint = f"that word is reserved; an object of its name is written in quotes: {quote_name(token.value)}"
        faults.add(span, message, hint)
    elif "TITLE" in accepted and token.type == "NAME":
        hint = 'a title is written in quotes: spec NAME "REQ-12: what must hold" = ...'
        faults.add(span, message, hint)
    elif "NAME" in accepted and token.type == "NUMBER":
        hint = f"a name that begins with a digit is written in quotes: {quote_name(token.value)}"
        faults.add(span, message, hint)
    else:
        faults.add(span, message)
