"""Tokens of a text: words, numbers and signs of the language with their places.

A token is lark's `Token` with `start_pos`, `end_pos` and `line`. Its `type` is declared in grammar.lark. The
`value` of a quoted name has no quotes.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from math import cos, radians
from types import MappingProxyType

from lark import Token

from spatial_replay.spec.diagnostics import Faults, Span

_PREFIX_WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "always": ("PREFIX", "G"),
        "eventually": ("PREFIX", "F"),
        "next": ("PREFIX", "X"),
        "once": ("PREFIX", "O"),
        "historically": ("PREFIX", "H"),
        "NOT": ("NOT", "not"),
        **{f"{operator}_": ("PREFIX", operator) for operator in "GFXOH"},
    }
)
_INFIX_WORDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "until": ("INFIX", "U"),
        "release": ("INFIX", "R"),
        "since": ("INFIX", "S"),
        "AND": ("AND", "and"),
        "OR": ("OR", "or"),
        "XOR": ("XOR", "xor"),
        "IMPLIES": ("IMPLIES", "->"),
        **{f"{operator}_": ("INFIX", operator) for operator in "URWS"},
    }
)
_MEANT: Mapping[str, str] = MappingProxyType(
    {
        **{word: operator for word, (_, operator) in _PREFIX_WORDS.items()},
        **dict.fromkeys(("g", "globally", "alw"), "G"),
        **dict.fromkeys(("f", "finally", "ev", "sometime", "sometimes"), "F"),
        **{"x": "X", "wx": "WX", "h": "H", "o": "O", "y": "Y", "never": "G not", "if": "->"},
        **{"previously": "Y", "yesterday": "Y", "p": "O", "n": "X", "gf": "G F", "fg": "F G"},
        **{"[]": "G", "<>": "F", "s_next": "X", "s_prev": "Y", "prev": "not Y not", "z": "not Y not"},
    }
)
"""Operator by foreign word in lower case; these words can also be names."""
_MEANT_BETWEEN: Mapping[str, str] = MappingProxyType(
    {
        **{"v": "R", "m": "U: (p) M (q) is (q) U (p and q)", "t": "S: (p) T (q) is not ((not p) S (not q))"},
        **{"iff": "<->", "unless": "W", "weak_until": "W", "releases": "R", "then": "->", "therefore": "->"},
        **{word.lower(): operator for word, (_, operator) in _INFIX_WORDS.items()},
    }
)
_MEANT_RELATIONS: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("in", "inside", "within", "contained_in"), "enclosedin"),
        **dict.fromkeys(("near", "close", "close_to", "nearby"), "closeto[e]"),
        **dict.fromkeys(("far", "far_from", "away_from"), "farfrom[e]"),
        **dict.fromkeys(("overlap", "overlaps", "overlapping", "intersects", "collides", "hits"), "ovlp"),
        **dict.fromkeys(("touches", "touching"), "touch[e]"),
        **dict.fromkeys(("over", "on_top_of"), "above"),
        **dict.fromkeys(("under", "beneath"), "below"),
        **dict.fromkeys(("d", "distance", "dist_to"), "dist"),
    }
)
_MEANT_SIGNS: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("/\\", "∧"), "write and, or &"),
        **dict.fromkeys(("\\/", "\u2228"), "write or, or |"),
        **dict.fromkeys(("~", "¬"), "write not, or !"),
        **dict.fromkeys(("→", "⇒", "-->", "==>"), "write ->"),
        **dict.fromkeys(("↔", "⇔", "<=>", "<-->"), "write <->"),
        **dict.fromkeys(("□", "◻", "☐"), "always is written G, as in G (a ovlp b)"),
        **dict.fromkeys(("◇", "◊", "⋄"), "eventually is written F, as in F (a ovlp b)"),
        **{"○": "next is written X, as in X (a ovlp b)", "∀": "write forall", "∃": "write exists"},
        **{"≤": "write <=", "≥": "write >=", "≠": "write not (... == ...)", "\u2212": "write -"},
        **{"^": "write xor, or and; a power of a signal is computed by a plug-in"},
        **{"%": "a share is written as the log has it: 20 % of a signal from 0 to 1 is 0.2"},
        **{";": "a statement ends with its line; leave it out"},
        **dict.fromkeys(("{", "}"), "numbers stand in square brackets: F[0, 5s], closeto[0.1]"),
        **dict.fromkeys(("//", "/*", "--"), "a comment begins with #"),
        **{"~>": "leads to is written G (p -> F (q))", "\\A": "write forall p in people: ..."},
        **{"\\E": "write exists p in people: ...", "\\in": "write in"},
        **dict.fromkeys(
            ("'", "“", "”", "„", "\u2018", "\u2019", "`"), 'names with other characters stand in "quotes"'
        ),
    }
)
_LENGTHS: Mapping[str, float] = MappingProxyType(
    {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
)
"""Units of length, in metres."""
_TIMES: Mapping[str, float] = MappingProxyType({"us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "sec": 1.0})
_PER = re.compile(r"\s*/\s*([a-z]+)")
_ARITHMETIC = frozenset({"STAR", "SLASH", "PLUS", "MINUS"})
_SHAPES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("rect", "rectangle", "square", "aabb", "box"), "box(xmin, ymin, xmax, ymax)"),
        **dict.fromkeys(("disc", "disk", "sphere", "ellipse", "circle"), "circle((x, y), r)"),
        "polygon": "polygon((x, y), ...)",
    }
)
_TYPES = frozenset(
    {
        "float",
        "float32",
        "float64",
        "double",
        "int",
        "int32",
        "bool",
        "real",
        "string",
        "input",
        "output",
        "signal",
    }
)
"""Words that declare signals in other tools."""
_AT_TIMES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("for", "during"), "G[0s, {0}]"),
        **dict.fromkeys(("within", "before", "until"), "F[0s, {0}]"),
        **{"after": "G[{0}, inf]", "from": "G[{0}, inf]", "at": "F[{0}, {0}]"},
    }
)
"""Temporal operators by English preposition; {0} is the time after the preposition."""
_ORDERING: Mapping[str, str] = MappingProxyType(
    {
        "at": "both in one sample: F (p and q); at the end of a log: F (p and WX false)",
        "before": "p before q is written (not q) U p, or with W if p need not be",
        "precedes": "p before q is written (not q) U p, or with W if p need not be; of places, a prec[x] b",
        "after": "p after q is written (not p) U q; always after q, G (q -> G p)",
        "by": "a margin is a part of an object: a leftof enlarge(b, 0.1)",
    }
)
"""Remedies by word between two formulas, for words that no single operator replaces."""
SAMPLES: Mapping[str, str] = MappingProxyType(
    {
        **{"tt": "true", "ff": "false", "last": "WX false", "ftp": "not Y true"},
    }
)
"""Formulas that are words in other tools, by the word in lower case."""
_QUANTIFYING: Mapping[str, str] = MappingProxyType(
    {**dict.fromkeys(("for", "all", "every", "each"), "forall"), **dict.fromkeys(("any", "some"), "exists")}
)
_DEFINING = frozenset({"let", "var", "val", "define", "param", "parameter", "constant", "set"})
_WITH_NUMBER = frozenset({"closeto", "farfrom", "touch", "oriented", "moved"})
_STATEMENTS = frozenset({"CONST", "REGION", "GROUP", "DEF", "SPEC"})

_BEFORE_FORMULA = frozenset({"EQUAL", "LPAR", "RSQB", "COLON", "AND", "OR", "XOR", "IMPLIES", "IFF", "NOT"})
_AFTER_OPERAND = frozenset({"NAME", "RPAR", "RSQB", "NUMBER", "TRUTH"})
STARTS_FORMULA = frozenset(
    {"LPAR", "NAME", "NOT", "PREFIX", "TRUTH", "QUANTIFIER", "NUMBER", "MINUS", "ENLARGE", "ALL", "CLASS"}
)
_CALLED: Mapping[str, str] = MappingProxyType({"speed": "RATE", "rate": "RATE", "center": "CENTER"})
"""Token types of words that are reserved only in front of a bracket; elsewhere they are names."""
_RELATIONS = frozenset({"RELATION", "DIST", "CLOSER", "BETWEEN", "COMPARE"})


def read_spellings(tokens: list[Token], faults: Faults) -> list[Token]:
    """Return the tokens with spellings of other tools replaced by operators.

    A word is replaced only where the grammar allows no name, so an object can be named `always` or `until`.
    """
    macro_names = {name.value for keyword, name in pairwise(tokens) if keyword.type in ("DEF", "SPEC")}
    new_tokens: list[Token] = []
    open_brackets: list[str] = []
    for index, token in enumerate(tokens):
        if token.type in ("LPAR", "LSQB"):
            open_brackets.append(token.type)
        elif token.type in ("RPAR", "RSQB") and open_brackets:
            open_brackets.pop()
        next_tokens = tokens[index + 1 : index + 4]
        sign_pair = token.value + next_tokens[0].value if next_tokens else ""
        if sign_pair in ("[]", "<>") and _starts(new_tokens) and next_tokens[0].start_pos == token.end_pos:
            _report(_as(token, "ERROR", sign_pair), faults)
            new_tokens.append(_as(token, "ERROR", sign_pair))
        elif token.type == "COLON" and open_brackets and open_brackets[-1] == "LSQB":
            # G[0:5], as other tools write windows
            new_tokens.append(_as(token, "COMMA", ","))
        elif token.type == "NAME" and next_tokens and not _is_quoted(token):
            new_token = _word(token, new_tokens, next_tokens, macro_names)
            if new_token.type == "ERROR":
                # the limit keeps the time linear in a text full of such words
                later_tokens = tokens[index + 1 : index + 1000]
                if next_tokens[0].value in macro_names or _holds_formula(later_tokens):
                    _report(token, faults)
                else:
                    new_token = token
            if next_tokens[0].type == "LPAR" and token.value not in macro_names:
                new_token = _as(token, _CALLED.get(token.value, new_token.type), new_token.value)
            new_tokens.append(new_token)
        else:
            new_tokens.append(token)
    return new_tokens


def _word(
    token: Token, previous: Sequence[Token], next_tokens: Sequence[Token], macro_names: set[str]
) -> Token:
    prefix, infix = _PREFIX_WORDS.get(token.value), _INFIX_WORDS.get(token.value)
    if infix is not None and _is_between(previous, next_tokens):
        return _as(token, *infix)
    if (prefix is None and _plain(token) not in _MEANT) or not _is_in_front(previous, next_tokens):
        return token
    if token.value in macro_names and (prefix is None or next_tokens[0].type == "LPAR"):
        return token
    return _as(token, "ERROR", token.value) if prefix is None else _as(token, *prefix)


def _plain(token: Token) -> str:
    """Return the key of a word in the tables: in lower case, without a trailing underscore."""
    return str(token.value).lower().removesuffix("_")


def _holds_formula(later_tokens: Sequence[Token]) -> bool:
    """Return whether the bracket after a word contains a relation, and so a formula instead of arguments."""
    depth = 0
    for token in later_tokens:
        depth += {"LPAR": 1, "LSQB": 1, "RPAR": -1, "RSQB": -1}.get(token.type, 0)
        if token.type in _RELATIONS:
            return True
        if depth <= 0 and token.type == "RPAR":
            return False
    return False


def _report(token: Token, faults: Faults) -> None:
    operator_text = _MEANT[_plain(token)]
    example = "a ovlp b -> c ovlp d" if operator_text == "->" else f"{operator_text} (a ovlp b)"
    hint = f"the operator is written {operator_text}, as in {example}; a macro is defined with def"
    end_offset = (token.start_pos or 0) + len(token.value)
    faults.add(Span(token.start_pos or 0, end_offset), f"{token.value!r} is not an operator", hint)


def _is_in_front(previous: Sequence[Token], next_tokens: Sequence[Token]) -> bool:
    """Return whether a word between these tokens can be a prefix operator, but no name."""
    if not _starts(previous):
        return False
    if next_tokens[0].type == "LSQB":
        is_index = [token.type for token in next_tokens[1:]] == ["NAME", "RSQB"]
        return len(next_tokens) > 1 and next_tokens[1].type != "MINUS" and not is_index
    # in "always until p", `always` is a name; if a relation follows, `until` is the name
    if next_tokens[0].value in _INFIX_WORDS and next_tokens[0].type == "NAME":
        return len(next_tokens) > 1 and next_tokens[1].type in _RELATIONS
    return next_tokens[0].type in STARTS_FORMULA - {"MINUS"}


def _starts(previous: Sequence[Token]) -> bool:
    """Return whether a formula can start after these tokens."""
    can_start = (
        not previous
        or previous[-1].type in _BEFORE_FORMULA
        or previous[-1].type in ("PREFIX", "INFIX", "ERROR")
    )
    return can_start or (len(previous) > 1 and previous[-2].type == "USE")


def _is_between(previous: Sequence[Token], next_tokens: Sequence[Token]) -> bool:
    """Return whether a word between these tokens can be an infix operator, but no name."""
    if not previous or previous[-1].type not in _AFTER_OPERAND:
        return False
    if len(previous) > 1 and previous[-2].type in ("USE", "SPEC", "DEF", "CONST", "REGION", "GROUP", "SCALE"):
        return False
    if next_tokens[0].type == "LSQB":
        return len(next_tokens) > 1 and next_tokens[1].type != "MINUS"
    return next_tokens[0].type in STARTS_FORMULA


def _as(token: Token, kind: str, value: str) -> Token:
    return Token(kind, value, token.start_pos, token.line, None, token.line, None, token.end_pos)


def _is_quoted(token: Token) -> bool:
    return (token.end_pos or 0) - (token.start_pos or 0) > len(token.value)


# ------------------------------------------------------------------------------------ what was meant


def meant_sign(sign: str) -> str:
    """Return the remedy for a sign of another language; "" if the sign is unknown."""
    return _MEANT_SIGNS.get(sign) or _MEANT_SIGNS.get(sign[:1], "")


def unit_hint(number: str, unit: str, per: str = "") -> str:
    """Return the remedy for a number with a unit; "" if the unit is unknown.

    Args:
        per: unit of time of a speed, such as "s" in "m/s".
    """
    if unit in _LENGTHS:
        seconds = _TIMES.get(per, 1.0)
        metres = format(float(number) * _LENGTHS[unit] / seconds, ".4g")
        return f"lengths are in the unit of the log's footprints: write {metres} if those are metres"
    if unit in ("deg", "degrees", "rad", "radians"):
        angle = float(number) if unit.startswith("rad") else radians(float(number))
        threshold = format(1.0 - cos(angle), ".4g")
        return f"orientations are compared by 1 - cos of their angle: write {threshold}"
    if unit == "px":
        return f"lengths are in the unit of the log's footprints: write {number} if those are pixels"
    if unit in _TIMES:
        return f"units of time are s and ms: write {format(float(number) * _TIMES[unit], 'g')}s"
    return f"write it without the blank: {number}{unit}" if unit in ("s", "ms") else ""


def foreign_token_advice(
    tokens: Sequence[Token], position: int, accepted: Collection[str]
) -> tuple[str, str] | None:
    """Return message and hint for a misplaced token that is typical of another language, else None.

    Args:
        position: index of the token; `len(tokens)` for the end of the statement.
        accepted: types of tokens that the grammar allows at this position.
    """
    no_token = Token("$END", "")
    token = tokens[position] if position < len(tokens) else no_token
    previous, earlier, *_ = [*reversed(tokens[max(0, position - 2) : position]), no_token, no_token]
    following = tokens[position + 1] if position + 1 < len(tokens) else no_token
    message = f"{token.value!r} cannot stand here"
    if position == 1 and (statement := meant_statement(tokens)):
        return f"{previous.value!r} begins no statement", statement
    operator = tokens[position - 3].value if position > 2 else ""
    is_bound = earlier.type == "LSQB" and previous.type == "NUMBER" and token.type == "RSQB"
    if is_bound and operator in ("X", "WX", "Y"):
        window_formula = f"{'O' if operator == 'Y' else 'F'}[0, {previous.value}]"
        return (
            f"{operator} takes no window",
            f"it means one sample; within {previous.value} is {window_formula} (...)",
        )
    if window := _meant_window(tokens, position):
        return message, f"a window is written with both of its ends: {window}"
    relation = previous if previous.type == "RELATION" else earlier
    if token.type == "NUMBER" and relation.value in _WITH_NUMBER and previous.type in ("RELATION", "LPAR"):
        return message, f"the number of a relation stands in square brackets: {relation.value}[{token.value}]"
    if earlier.type == "RSQB" and previous.value in ("s", "ms"):
        return f"{previous.value!r} cannot stand here", "each number has its unit: [0s, 5s], [200ms, 1s]"
    if token.type in _RELATIONS and earlier.type in ("SLASH", "MINUS") and previous.type == "NAME":
        name_start = tokens[position - 3].value if position > 2 else ""
        hint = (
            f'a name with {earlier.value} is written in quotes: "{name_start}{earlier.value}{previous.value}"'
        )
        return f"{token.value!r} needs an object, region or group on its left", hint
    if token.type == "MINUS" and earlier.type in _RELATIONS - {"COMPARE"} and following.value.isidentifier():
        return message, f'a name with - is written in quotes: "{previous.value}-{following.value}"'
    if (earlier.type, previous.type) == ("NAME", "MINUS") and token.value[1:].isidentifier():
        return message, f'a name with - is written in quotes: "{earlier.value}-{token.value}"'
    if token.type in _RELATIONS and earlier.type == "LPAR" and previous.type == "NAME" and position > 2:
        name = tokens[position - 3]
        if name.type == "NAME" and (hint := function_hint(name.value, _argument(tokens, position - 1))):
            return f"{name.value!r} is not a function", hint
    if tokens[0].type == "GROUP" and previous.type == "EQUAL" and token.type in ("LSQB", "LPAR"):
        return message, f"members stand without brackets: group {tokens[1].value} = a, b"
    if shape := _meant_shape(tokens, position, accepted):
        return message, shape
    if (token.value == "=>" and "COMPARE" in accepted) or (
        earlier.value == "=>" and token.type in ("RPAR", "$END")
    ):
        return "'=>' means implies", "at least is written >="
    if token.value == "=" and previous.value in ("==", "!="):
        return message, f"it is written {previous.value}"
    if token.type == "NOT" and previous.type == "LSQB" and earlier.value in ("X", "WX"):
        return f"{earlier.value}[!] is no operator", "a next sample that has to be there is written X (...)"
    if token.value == "=" and (
        sign := {"<": "<=", ">": ">="}.get(following.value if "COMPARE" in accepted else previous.value)
    ):
        return message, f"it is written {sign}, without a blank"
    if token.type == "TRUTH" and previous.type == "COMPARE":
        return message, f"a flag is a number: {earlier.value} {previous.value} {int(token.value == 'true')}"
    if token.value == "dist" and _is_quoted(token):
        return message, f"a relation stands without quotes: {previous.value} dist {following.value or 'b'}"
    if token.type == "NUMBER" and (template := _AT_TIMES.get(previous.value.lower())):
        return message, f"a window stands behind its operator: {template.format(token.value)} (...)"
    if previous.type in _STATEMENTS and token.type != "NAME" and token.value.isidentifier():
        kind = "a relation" if "RELATION" not in accepted and token.type in _RELATIONS else "a reserved word"
        return f"{token.value!r} is {kind}, so no name for a {previous.value}", "give it another name"
    if tokens[0].type == "DEF" and position == 2 and token.type in ("EQUAL", "COLON"):
        return (
            f"{previous.value!r} has no parameters",
            f"such a formula is named by spec {previous.value} = ...",
        )
    if "EQUAL" in accepted and tokens[0].type in _STATEMENTS:
        return _meant_definition(tokens, position)
    if previous.type == "NUMBER" and token.type == "NAME":
        time_unit = (
            tokens[position + 2].value if following.type == "SLASH" and position + 2 < len(tokens) else ""
        )
        hint = unit_hint(previous.value, token.value, time_unit)
        return f"{token.value!r} is no unit here", hint or f"only s and ms are units: leave out {token.value}"
    if (
        token.type == "COMMA"
        and previous.type == following.type == "NUMBER"
        and token.end_pos == following.start_pos
    ):
        return "a comma within a number", f"decimals have a point: {previous.value}.{following.value}"
    if token.type == "NOT" and "RELATION" in accepted and following.type in _RELATIONS:
        return (
            "'not' cannot stand within a relation",
            f"write it in front: not {previous.value} {following.value} ...",
        )
    if token.type in ("NAME", "IN", "ALL"):
        return _meant_word(token, previous, following, accepted)
    is_delayed = previous.type == "RSQB" and "DIST" in accepted and "AND" not in accepted
    if is_delayed and token.type in (*_ARITHMETIC, "COMPARE", "RPAR", "$END"):
        hint = "rate(x) is its change since its last report, Y (x >= 1) looks at the sample before"
        return "a signal has no [-n]", hint
    if token.type == "COMPARE" and previous.type in ("RPAR", "AND", "OR"):
        hint = "a comparison is about a signal, battery >= 1.5, or a distance, a dist b <= 2"
        return message, f"{hint}; a range is two comparisons, joined by and"
    return None


def _meant_window(tokens: Sequence[Token], position: int) -> str:
    """Return the probable window of the nearest operator before a position; "" if it has none."""
    positions = range(position - 1, max(-1, position - 6), -1)
    operator_index = next((index for index in positions if tokens[index].type in ("PREFIX", "INFIX")), None)
    if operator_index is None:
        return ""
    window_tokens = tokens[operator_index + 1 : operator_index + 6]
    types = [token.type for token in window_tokens]
    numbers = [token.value.strip(".") for token in window_tokens if token.type == "NUMBER"]
    operator = tokens[operator_index].value
    if operator in ("X", "WX", "Y"):
        return ""
    match types:
        case ["COMPARE", "NUMBER", *_] | ["LSQB", "COMPARE", "NUMBER", *_]:
            sign = next(token.value for token in window_tokens if token.type == "COMPARE")
            return f"{operator}[{numbers[0]}, inf]" if sign[0] == ">" else f"{operator}[0, {numbers[0]}]"
        case ["LSQB", "NUMBER", "RSQB", *_]:
            return f"{operator}[0, {numbers[0]}]"
        case (
            ["LSQB", "NUMBER", "NUMBER", *_]
            | ["LSQB", "NUMBER", "MINUS", "NUMBER", "RSQB"]
            | ["LPAR", "NUMBER", "COMMA", "NUMBER", *_]
            | ["LSQB", "NUMBER", "COMMA", "NUMBER", "RPAR"]
        ):
            return f"{operator}[{numbers[0]}, {numbers[1]}]"
        case ["LSQB", "NUMBER", "COMMA", "NAME", "RPAR"]:
            return f"{operator}[{numbers[0]}, {window_tokens[3].value}]"
    return ""


def _meant_definition(tokens: Sequence[Token], position: int) -> tuple[str, str] | None:
    """Return message and hint for a token between the name of a statement and its =."""
    token, name = tokens[position] if position < len(tokens) else None, tokens[1].value
    if token is None or token.type in ("NAME", "EQUAL"):
        return None
    if token.type in ("MINUS", "SLASH", "PLUS", "STAR"):
        return f"{token.value!r} cannot stand in a name", "a name has letters, digits and _"
    return f"{token.value!r} stands where = is missing", f"write {tokens[0].value} {name} = ..."


def _meant_word(
    token: Token, previous: Token, following: Token, accepted: Collection[str]
) -> tuple[str, str] | None:
    word = str(token.value).lower()
    message = f"{token.value!r} cannot stand here"
    if word in _ORDERING and "AND" in accepted and (following.type != "NUMBER" or word == "by"):
        return message, _ORDERING[word]
    if (str(previous.value).lower(), word) == ("exactly", "once"):
        return message, "p holds in one sample only is written (not p) U (p and WX (G not p))"
    if "RELATION" in accepted:
        if word in ("is", "are"):
            relation = following.value if following.type in _RELATIONS else "leftof"
            example = (
                f'; a text is compared as {previous.value} == "AUTO"'
                if following.type not in _RELATIONS
                else ""
            )
            return message, f"leave it out: {previous.value} {relation} ...{example}"
        if quantifier := _QUANTIFYING.get(str(previous.value).lower()):
            return message, f"write {quantifier} {token.value if token.type == 'NAME' else 'x'} in GROUP: ..."
        if word in _MEANT_RELATIONS and following.type == "NAME":
            hint = f"write {previous.value} {_MEANT_RELATIONS[word]} {following.value or 'b'}"
            return f"unknown relation {token.value!r}", hint
    if "AND" in accepted and word in _MEANT_BETWEEN:
        return f"{token.value!r} is not an operator", f"the operator is written {_MEANT_BETWEEN[word]}"
    if "AND" in accepted and word in _AT_TIMES:
        window = _AT_TIMES[word].format(following.value or "5s")
        return message, f"a window stands behind its operator: {window} (...)"
    return None


def meant_statement(tokens: Sequence[Token]) -> str:
    """Return the probable statement for a line that begins with no statement word; "" if unknown."""
    line = [token for token in tokens if token.line == tokens[0].line]
    if line[0].value.lower() in _TYPES and len(line) > 1 and line[1].type == "NAME":
        return "signals are not declared: leave the line out"
    if line[0].value.lower() in _DEFINING:
        del line[0]
    elif (word := line[0].value.lower()) in KEYWORDS and line[0].value != word:
        return f"words of the language have their own case: write {word}"
    if len(line) < 3 or line[1].type not in ("EQUAL", "COLON") or line[2].type == "COMPARE":
        return ""
    value = line[3:] if line[2].type == "EQUAL" else line[2:]
    if not value:
        return ""
    is_number = all(token.type in ("NUMBER", "NAME", *_ARITHMETIC) for token in value)
    definition = f"{line[0].value} = {_source_text(value)}"
    if is_number:
        return f"a number is defined by const {definition}; equality is written =="
    return f"a formula is named by spec {definition}"


def _source_text(tokens: Sequence[Token]) -> str:
    """Return the text of tokens; blanks between them are reduced to one."""
    gaps = ["" if left.end_pos == right.start_pos else " " for left, right in pairwise(tokens)]
    return "".join(token.value + gap for token, gap in zip(tokens, [*gaps, ""], strict=True))


def _meant_shape(tokens: Sequence[Token], position: int, accepted: Collection[str]) -> str:
    """Return the remedy for a faulty shape of a region; "" if the fault is something else."""
    token = tokens[position] if position < len(tokens) else None
    if token is not None and "CIRCLE" in accepted and token.value.lower() in _SHAPES:
        return f"it is written {_SHAPES[token.value.lower()]}"
    called_index = next((index for index in (position, position - 1) if is_called(tokens, index)), 0)
    shape = _SHAPES.get(tokens[called_index].value.lower())
    if (
        called_index
        and shape
        and tokens[0].type != "REGION"
        and tokens[called_index - 1].type not in _STATEMENTS
    ):
        return f"a shape gets a name first: region goal = {shape}"
    shape_index = next((index for index, token in enumerate(tokens[:position]) if token.type in _SHAPE), None)
    if shape_index is None or "HEIGHT" in {*accepted, *(token.type for token in tokens[:position])}:
        return ""
    numbers = _numbers(tokens[shape_index:])
    points = [f"({x}, {y})" for x, y in zip(numbers[::2], numbers[1::2], strict=False)]
    match tokens[shape_index].type:
        case "BOX" if len(numbers) == 4:
            return f"a box has four numbers: box({', '.join(numbers)})"
        case "CIRCLE" if len(numbers) == 3:
            return f"the centre stands in brackets: circle({points[0]}, {numbers[2]})"
        case "POLYGON" if len(numbers) > 3:
            return f"each corner stands in brackets: polygon({', '.join(points)})"
    return f"it is written {_SHAPES[tokens[shape_index].value]}; decimals have a point"


def is_called(tokens: Sequence[Token], position: int) -> bool:
    """Return whether an opening bracket follows a token."""
    return 0 <= position < len(tokens) - 1 and tokens[position + 1].type == "LPAR"


_SHAPE = frozenset({"BOX", "CIRCLE", "POLYGON"})


def _numbers(tokens: Sequence[Token]) -> list[str]:
    """Return the numbers of a line with their signs."""
    line_tokens = [token for token in tokens if token.line == tokens[0].line]
    signs = ["-" if previous.type == "MINUS" else "" for previous in line_tokens]
    return [
        sign + token.value
        for sign, token in zip(signs, line_tokens[1:], strict=False)
        if token.type == "NUMBER"
    ]


def _argument(tokens: Sequence[Token], start: int) -> str:
    """Return the text of arguments in brackets; `start` is the position after the opening bracket."""
    depth, end_position = 1, start
    while end_position < len(tokens) and depth:
        depth += {"LPAR": 1, "RPAR": -1}.get(tokens[end_position].type, 0)
        end_position += 1
    return f"({_source_text(tokens[start : end_position - (depth == 0)])})"


def function_hint(name: str, argument: str, arguments: Sequence[str] = ()) -> str:
    """Return the remedy for a function of other tools; "" if the function is unknown.

    Args:
        argument: text of all arguments with their brackets, "(a, b)".
        arguments: text of each argument where a number is expected; else empty.
    """
    match name.lower(), arguments:
        case "fabs" | "norm" | "magnitude", [inner]:
            return f"it is written abs({inner})"
        case "velocity" | "vel", [inner]:
            return f"it is written speed({inner})"
        case "derivative" | "der" | "diff", [inner]:
            return f"it is written rate({inner})"
        case "angle" | "heading" | "yaw" | "orientation", _:
            return "orientations are compared by a oriented[k] b, where k is 1 - cos of the greatest angle"
        case "min" | "max", [_, _, *_]:
            return "compare each by itself, joined by and, or by or"
        case _, [first, second] if first.isidentifier() and second.isidentifier():
            return f"a distance is written between its objects: {first} dist {second}"
    match name.lower():
        case "rise" | "rising" | "rising_edge" | "rose":
            return f"a rising edge is written (Y not {argument}) and {argument}"
        case "fall" | "falling" | "falling_edge" | "fell":
            return f"a falling edge is written (Y {argument}) and not {argument}"
        case "until":
            return "it stands between its formulas: (p) U (q)"
        case word if word in _MEANT_RELATIONS:
            return f"it stands between its objects: a {_MEANT_RELATIONS[word]} b"
    return ""


STATEMENT_TYPES: frozenset[str] = frozenset({"USE", "CONST", "SCALE", "REGION", "GROUP", "DEF", "SPEC"})
BINARY_TYPES: frozenset[str] = frozenset({"AND", "OR", "XOR", "IMPLIES", "IFF", "INFIX"})

KEYWORDS: Mapping[str, str] = MappingProxyType(
    {
        **{word: word.upper() for word in ("use", "const", "region", "group", "def", "spec")},
        **{word: word.upper() for word in ("in", "except", "all", "class", "height", "than")},
        **{
            word: word.upper()
            for word in ("enlarge", "polygon", "box", "circle", "dist", "closer", "between")
        },
        **{word: word.upper() for word in ("not", "and", "or", "xor", "implies")},
        "not_t": "NOT",
        "implies_t": "IMPLIES",
        "forall": "QUANTIFIER",
        "exists": "QUANTIFIER",
        "true": "TRUTH",
        "false": "TRUTH",
        **dict.fromkeys(("F", "G", "X", "WX", "Y", "O", "H"), "PREFIX"),
        **dict.fromkeys(("U", "R", "W", "S"), "INFIX"),
    }
)
"""Token types by reserved word; names of relations are reserved, too."""

_SIGNS: Mapping[str, str] = MappingProxyType(
    {
        "<->": "IFF",
        "->": "IMPLIES",
        "!": "NOT",
        **dict.fromkeys(("&", "&&"), "AND"),
        **dict.fromkeys(("|", "||"), "OR"),
        "=>": "IMPLIES",
        **dict.fromkeys(("<=", ">=", "==", "!=", "<", ">"), "COMPARE"),
        "(": "LPAR",
        ")": "RPAR",
        "[": "LSQB",
        "]": "RSQB",
        ",": "COMMA",
        ":": "COLON",
        "=": "EQUAL",
        "-": "MINUS",
        "+": "PLUS",
        "*": "STAR",
        "/": "SLASH",
    }
)

# foreign signs come before the signs that they begin with, such as <=> before <=
_TOKEN = re.compile(
    r"""
      (?P<line>\r\n|\r|\n)
    | (?P<blank>[ \t\f\v\u00a0]+ | \#[^\r\n]*)
    | (?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?P<unit>[A-Za-z_][A-Za-z0-9_]*)?)
    | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
    | (?P<quoted>"(?:[^"\\\r\n]|\\[^\r\n])*")
    | (?P<foreign>/\\|\\/|\\[A-Za-z]+|<=>|<-->|-->|==>|~>|//[^\r\n]*|/\*[^\r\n]*|--[ \t][^\r\n]*)
    | (?P<sign><->|->|<=|>=|==|=>|!=|&&|\|\||[<>!&|()\[\],:=+*/-])
    | (?P<unknown>"[^\r\n]*|[^\sA-Za-z0-9_"\#()\[\],:=<>!&|.+*/-]+|.)
    """,
    re.VERBOSE | re.DOTALL,
)
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)


def is_reserved(word: str, relations: Iterable[str]) -> bool:
    """Return whether a word is reserved: a word of the language or the name of a relation."""
    return word in KEYWORDS or word in relations


def written_name(name: str, relations: Iterable[str]) -> str:
    """Return the text of a name: in quotes unless it is an identifier that is not reserved."""
    if _IDENTIFIER.match(name) and not is_reserved(name, relations):
        return name
    return quote_name(name)


def title_hint(name: str) -> str:
    """Return a hint that gives a spec a new name and keeps its old name as a title."""
    identifier = re.sub(r"\W", "_", name) + "_holds"
    return f"a title keeps its name: spec {identifier} {quote_name(name)} = ..."


def quote_name(name: str) -> str:
    """Return a name in quotes."""
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def span_of(token: Token) -> Span:
    """Return the place of a token of `tokenize`."""
    return Span(token.start_pos or 0, token.end_pos or 0)


MAX_TOKENS = 40_000
"""Maximum number of words, numbers and signs of a text."""


def tokenize(text: str, relations: frozenset[str], faults: Faults) -> list[Token]:
    """Return the tokens of a text; invalid characters are reported and become tokens of type ERROR.

    The result has at most `MAX_TOKENS` tokens; further tokens are a fault.
    """
    tokens: list[Token] = []
    line = 1
    for token_match in _TOKEN.finditer(text):
        kind, value = token_match.lastgroup, token_match.group()
        span = Span(token_match.start(), token_match.end())
        if kind == "line":
            line += 1
            continue
        if kind == "blank":
            continue
        if len(tokens) == MAX_TOKENS:
            message = f"the text has more than {MAX_TOKENS} words and signs"
            faults.add(span, message, "split it into several files")
            break
        if kind == "word":
            token_type = KEYWORDS.get(value) or ("RELATION" if value in relations else "NAME")
        elif kind == "sign":
            token_type = _SIGNS[value]
        elif kind == "quoted":
            token_type = "TITLE" if _is_title_expected(tokens) else "NAME"
            value = _unquote(value, span, faults)
        elif kind == "foreign":
            sign = value[:2] if value.startswith(("//", "/*", "-- ", "--\t")) else value
            faults.add(span, f"'{sign}' is not part of the language", meant_sign(sign))
            token_type = "ERROR"
        elif kind == "unknown":
            _report_unknown(value, span, faults, tokens, text[token_match.end() : token_match.end() + 1])
            token_type = "ERROR"
        else:
            token_type = "NUMBER"
            unit = token_match.group("unit")
            if unit is not None and unit not in ("s", "ms"):
                per_match = _PER.match(text, token_match.end())
                # in a window, m most likely stands for minutes instead of metres
                is_in_window = unit == "m" and {"PREFIX", "INFIX"} & {token.type for token in tokens[-4:-1]}
                meant_unit = (
                    "min" if is_in_window and "LSQB" in {token.type for token in tokens[-3:]} else unit
                )
                hint = unit_hint(
                    value.removesuffix(unit), meant_unit, per_match.group(1) if per_match else ""
                )
                hint = hint or f"units of time are s and ms; a name is written in quotes: {quote_name(value)}"
                faults.add(span, f"{value!r} is neither a number, nor a duration, nor a name", hint)
                value = value[: -len(unit)]
                # in 3m/s the next tokens are the rest of the unit; ERROR prevents further faults about them
                token_type = "ERROR" if per_match else token_type
        tokens.append(Token(token_type, value, span.start, line, None, line, None, span.end))
    return read_spellings(_with_scales(_join_published_spellings(tokens)), faults)


def _with_scales(tokens: list[Token]) -> list[Token]:
    """Mark `scale NAME =` at the beginning of a line as a statement; `scale` is not a reserved word."""
    for index, token in enumerate(tokens[:-2]):
        next_types = [token.type for token in tokens[index + 1 : index + 3]]
        if token.value == "scale" and token.type == "NAME" and next_types == ["NAME", "EQUAL"]:
            previous = tokens[index - 1] if index else None
            if previous is None or previous.line != token.line:
                token.type = "SCALE"
    return tokens


def _is_title_expected(previous: list[Token]) -> bool:
    """Return whether a quoted text after these tokens is the title of a spec."""
    if not previous:
        return False
    if previous[-1].type == "NAME":
        return len(previous) > 1 and previous[-2].type == "SPEC"
    # no quoted name can follow a closing bracket
    return previous[-1].type == "RPAR"


def _unquote(literal: str, span: Span, faults: Faults) -> str:
    name = literal[1:-1]
    if not name:
        faults.add(span, "a name is empty", "write at least one character between the quotes")
        return "?"
    for escape in _ESCAPED.finditer(name):
        if escape.group(1) not in '"\\':
            escape_start = span.start + 1 + escape.start()
            hint = 'in quotes, \\" stands for a quote and \\\\ for a backslash'
            faults.add(
                Span(escape_start, escape_start + 2), f"unknown escape {escape.group()!r} in a name", hint
            )
    return _ESCAPED.sub(r"\1", name)


def _report_unknown(
    text: str, span: Span, faults: Faults, previous: Sequence[Token], next_character: str
) -> None:
    if text == "." and (not next_character or next_character.isspace()):
        faults.add(span, "a full stop behind a statement", meant_sign(";"))
        return
    if text == "}" and any(token.value == "{" for token in previous[-8:]):
        # the opening { is already reported
        return
    if text == "." and previous and previous[-1].type == "NAME" and previous[-1].end_pos == span.start:
        object_name = previous[-1].value
        message = f"an object has no fields, so nothing is behind {object_name!r}"
        hint = (
            f"places are compared by relations, such as {object_name} leftof b, "
            f"speeds by speed({object_name}) <= 1; a name with a dot is written in quotes"
        )
        faults.add(span, message, hint)
        return
    if text[0] == "{" and [token.type for token in previous[-3:]] == ["GROUP", "NAME", "EQUAL"]:
        hint = f"members stand without brackets: group {previous[-2].value} = a, b"
        faults.add(span, "'{' cannot stand here", hint)
        return
    if text.startswith('"'):
        faults.add(span, "a quoted name does not end on its line", 'close it with "')
        return
    hint = meant_sign(text) or "a name with other characters than A-Z, a-z, 0-9 and _ is written in quotes"
    faults.add(span, f"the character {text[0]!r} is not part of the language", hint)


def _join_published_spellings(tokens: list[Token]) -> list[Token]:
    """Join `!t` and `->t` to one operator if an operand follows.

    These are the spellings of `not` and `->` in the published implementation; elsewhere `t` is a name.
    """
    new_tokens: list[Token] = []
    for index, token in enumerate(tokens):
        if (
            token.value == "t"
            and new_tokens
            and new_tokens[-1].value in ("!", "->")
            and new_tokens[-1].end_pos == token.start_pos
            and (token.end_pos or 0) - (token.start_pos or 0) == 1
            and index + 1 < len(tokens)
            and tokens[index + 1].type in STARTS_FORMULA
        ):
            sign = new_tokens.pop()
            value = sign.value + "t"
            new_tokens.append(
                Token(sign.type, value, sign.start_pos, sign.line, None, sign.line, None, token.end_pos)
            )
        else:
            new_tokens.append(token)
    return new_tokens
