"""Sentences on the demands of an edge: a goal, and the conditions to keep or to avoid on the way.

A guard is a text of literals joined by "and"; a negative literal is "not …". In sentences, formulas are
between backquotes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Final, NamedTuple

import numpy as np

_MOST_PROPOSITIONS: Final = 12
"""Maximum number of propositions of simplified guards; each proposition doubles the truth table."""
_LONGEST: Final = 100
"""Maximum length of a formula, characters."""
_MOST_RULES: Final = 4
"""Maximum number of listed bans with several literals."""
_QUOTED: Final = re.compile(r'"(?:[^"\\]|\\.)*"')
"""A name in quotes."""


class Ban(NamedTuple):
    """Literals that must not all be true together.

    Attributes:
        holding: propositions of the positive literals.
        failing: propositions of the negative literals.
    """

    holding: tuple[str, ...]
    failing: tuple[str, ...]

    @property
    def rule(self) -> str:
        """The ban as a rule for the robot: keep, avoid, or not before."""
        if not self.holding:
            return f"keep {_listing(self.failing, 'or')}"
        if not self.failing:
            return f"avoid {_listing(self.holding, 'together with')}"
        return f"{_listing(self.holding, 'and')} not before {_listing(self.failing, 'or')}"


def bans_of(guards: Sequence[str], given_up: Sequence[str] = ()) -> tuple[Ban, ...]:
    """Return the shortest bans that together forbid exactly the guards, in the order of the guards.

    Args:
        given_up: guards of pruned edges; bans may also forbid these guards, if the bans become shorter.
    """
    return tuple(
        Ban(
            tuple(text for text, value in cube.items() if value),
            tuple(text for text, value in cube.items() if not value),
        )
        for cube in _simplify(
            [_literals_of(guard) for guard in guards], [_literals_of(guard) for guard in given_up]
        )
    )


def ban_of(guard: str, bans: Iterable[Ban]) -> Ban:
    """Return the first ban that forbids a guard; without such a ban, the guard itself as a ban."""
    literals = _literals_of(guard).items()
    for ban in bans:
        if {(text, True) for text in ban.holding} | {(text, False) for text in ban.failing} <= literals:
            return ban
    return bans_of([guard])[0]


def rules_of(bans: Sequence[Ban]) -> tuple[str, ...]:
    """Return the rules for the way; bans with a single literal share one "keep" and one "avoid" rule."""
    required = [ban.failing[0] for ban in bans if not ban.holding and len(ban.failing) == 1]
    avoided = [ban.holding[0] for ban in bans if not ban.failing and len(ban.holding) == 1]
    other_rules = [ban.rule for ban in bans if len(ban.holding) + len(ban.failing) > 1]
    more_text = [f"{len(other_rules) - _MOST_RULES} more rules"] if len(other_rules) > _MOST_RULES else []
    return (
        *([f"keep {_listing(required, 'and')}"] if required else []),
        *([f"avoid {_listing(avoided, 'and')}"] if avoided else []),
        *other_rules[:_MOST_RULES],
        *more_text,
    )


def demand_of(literal: str, bans: Iterable[Ban], *, is_required: bool = True) -> str:
    """Return a literal of a goal as a demand: a relation to reach, to keep or to avoid.

    Args:
        bans: bans on the way to the goal; a relation that a ban requires is a relation to keep.
        is_required: whether the literal must hold; otherwise the literal is one of several alternatives.
    """
    if not is_required:
        return f"one of several: {demand_of(literal, bans)}"
    text = _without_brackets(literal.removeprefix("not "))
    if literal.startswith("not "):
        return f"avoid {_listing([text], '')}"
    required = [ban.failing[0] for ban in bans if not ban.holding and len(ban.failing) == 1]
    is_kept = any(text in map(_without_brackets, _operands_of_and(formula)) for formula in required)
    return f"{'keep ' if is_kept else ''}{_listing([text], '')}"


def wanted_of(guards: Sequence[str], bans: Sequence[Ban]) -> tuple[str, ...]:
    """Return the goal of each alternative of a progress set, without literals that bans already name."""
    required = {text for ban in bans if not ban.holding and len(ban.failing) == 1 for text in ban.failing}
    avoided = {text for ban in bans for text in ban.holding}
    alternatives = []
    for cube in _simplify([_literals_of(guard) for guard in guards]):
        goals = [text for text, value in cube.items() if text not in (required if value else avoided)]
        texts = [f"`{text}`" if cube[text] else f"`{text}` no longer" for text in goals or cube]
        alternatives.append(" and ".join(texts))
    return tuple(dict.fromkeys(alternatives))


def _literals_of(guard: str) -> dict[str, bool]:
    """Return whether each proposition of a guard must hold; empty for the guard "true"."""
    literals = {}
    for literal in _operands_of_and(guard):
        text = literal.removeprefix("not ")
        literals[_without_brackets(text)] = text == literal
    literals.pop("true", None)
    return literals


def _operands_of_and(text: str) -> list[str]:
    operands, start = [], 0
    for index, depth in enumerate(_depths(text)):
        if depth == 0 and text.startswith(" and ", index):
            operands.append(text[start:index])
            start = index + len(" and ")
    return [*operands, text[start:]]


def _without_brackets(text: str) -> str:
    """Remove the outer brackets of a text, if one pair encloses the whole text."""
    is_bracketed = text.startswith("(") and text.endswith(")") and min(_depths(text)[:-1]) > 0
    return text[1:-1] if is_bracketed else text


def _depths(text: str) -> list[int]:
    """Return the number of open brackets and quotes after each letter; brackets in quotes are ignored."""
    letters = _QUOTED.sub(lambda name: f"({' ' * (len(name[0]) - 2)})", text)
    return list(accumulate({"(": 1, ")": -1}.get(letter, 0) for letter in letters))


def _simplify(
    cubes: Sequence[Mapping[str, bool]], ignored: Sequence[Mapping[str, bool]] = ()
) -> list[dict[str, bool]]:
    """Return distinct cubes without literals that do not affect the union of all cubes.

    Args:
        ignored: cubes that the union may include, but need not.
    """
    propositions = tuple(dict.fromkeys(name for cube in (*cubes, *ignored) for name in cube))
    simplified = [dict(cube) for cube in cubes]
    if len(propositions) <= _MOST_PROPOSITIONS:
        union = np.zeros((2,) * len(propositions), bool)
        for cube in (*cubes, *ignored):
            union[_part_of_table(cube, propositions)] = True
        for cube in simplified:
            for name in tuple(cube):
                value = cube.pop(name)
                if not union[_part_of_table(cube, propositions)].all():
                    cube[name] = value
    return list({frozenset(cube.items()): cube for cube in simplified}.values())


def _part_of_table(cube: Mapping[str, bool], names: Sequence[str]) -> tuple[int | slice, ...]:
    return tuple(int(cube[name]) if name in cube else slice(None) for name in names)


def _listing(texts: Sequence[str], conjunction: str) -> str:
    """Return formulas between backquotes; a conjunction joins the last two formulas."""
    *leading, last = [f"`{_shorten(text)}`" for text in texts] or ["anything"]
    return f"{', '.join(leading)} {conjunction} {last}" if leading else last


def _shorten(text: str) -> str:
    """Return a formula; a long formula is shortened to the first operand of its "and"."""
    first_operand, *other_operands = _operands_of_and(text)
    return (
        f"{first_operand} and {len(other_operands)} more" if other_operands and len(text) > _LONGEST else text
    )
