"""Relations with the limits learned for them, in time: their text in a specification, and in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, TypeAlias

from spatial_replay.learning.quantities import WITH_LIMIT, Party, Quantity, variables_of
from spatial_replay.spec.format import format_number
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.tokens import quoted, written_name
from spatial_replay.text import number_text

Pattern: TypeAlias = Literal["always", "finally", "eventually", "until", "before"]
Phrases: TypeAlias = Mapping[str, tuple[str, str]]

_OPERATORS: Mapping[Pattern, str] = MappingProxyType({"always": "G", "finally": "F G", "eventually": "F"})
_PHRASES: Phrases = MappingProxyType(
    {
        "enclosedin": ("inside {b}", "not inside {b}"),
        "ovlp": ("overlapping {b}", "clear of {b}"),
        "leftof": ("left of {b}", "not left of {b}"),
        "below": ("below {b}", "not below {b}"),
        "prec": ("lower than {b}", "not lower than {b}"),
    }
)
"""What a relation is called, and its opposite."""
_NAMED: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "dist": ("apart", "near"),
        "oriented": ("aligned", "aligned"),
        "signal": ("at_least", "at_most"),
        "enclosedin": ("in", "outside"),
        "ovlp": ("overlap", "clear"),
        "leftof": ("left", "not_left"),
        "below": ("below", "not_below"),
        "prec": ("lower", "not_lower"),
    }
)
"""What a spec about it is named."""


@dataclass(frozen=True, slots=True)
class LimitedRelation:
    """A relation that holds in a sample, or not.

    Attributes:
        direction: 0 where the quantity is at least a limit, 1 where its negative is.
        limit: what it, or its negative, is at least; 0.0 for relations without a number.
        other_limit: for a distance between two limits, the limit of its negative.
    """

    quantity: Quantity
    direction: int
    limit: float
    other_limit: float | None = None

    def text(self, taken: set[str]) -> str:
        """Return it as written in a specification; `taken` are names that no variable may have."""
        parties = self.quantity.parties
        if not parties:
            name = written_name(self.quantity.signal, RELATION_NAMES)
            return f"{name} {self._compared}"
        variables = variables_of(parties, taken)
        a, b = (
            variable if party.is_class else written_name(party.name, RELATION_NAMES)
            for party, variable in zip(parties, variables, strict=True)
        )
        text = self._atom(a, b)
        if parties[0].is_class and parties[0] == parties[1]:
            return f"forall {a}, {b} in class {quoted(parties[0].name)}: {text}"
        for party, variable in reversed(list(zip(parties, variables, strict=True))):
            if party.is_class:
                text = f"forall {variable} in class {quoted(party.name)}: {text}"
        return text

    def _atom(self, a: str, b: str) -> str:
        relation = self.quantity.relation
        if relation == "dist":
            if self.other_limit is not None:
                return f"{format_number(self.limit)} <= {a} dist {b} <= {format_number(-self.other_limit)}"
            return f"{a} dist {b} {self._compared}"
        if relation == "oriented":
            return f"{a} oriented[{format_number(-self.limit)}] {b}"
        bracket = "[z]" if relation == "prec" else ""
        text = f"{a} {relation}{bracket} {b}"
        return f"not ({text})" if self.direction else text

    @property
    def _compared(self) -> str:
        # 0 - limit rather than -limit: zero stays zero
        return (
            f"<= {format_number(0.0 - self.limit)}" if self.direction else f">= {format_number(self.limit)}"
        )

    def words(self, verb: Callable[[str], str]) -> str:
        """Return it in words, as "red and blue are at least 0.05 apart".

        Args:
            verb: returns what stands for "are" or "is".
        """
        quantity = self.quantity
        number = number_text(0.0 - self.limit if self.direction else self.limit)
        if not quantity.parties:
            return f"{quantity.signal} {verb('is')} {'at most' if self.direction else 'at least'} {number}"
        one, other = quantity.parties
        if one == other:
            both, a, b = f"any two of class {one.name}", f"any {one.name}", "any other"
        else:
            a, b = _called(one), _called(other)
            both = f"{a} and {b}"
        if quantity.relation == "dist":
            if self.other_limit is not None:
                far = number_text(0.0 - self.other_limit)
                return f"{both} {verb('are')} {number} to {far} apart"
            return f"{both} {verb('are')} {'at most' if self.direction else 'at least'} {number} apart"
        if quantity.relation == "oriented":
            return f"{a} {verb('is')} turned as {b} is"
        return f"{a} {verb('is')} {_PHRASES[quantity.relation][self.direction].format(b=b)}"

    @property
    def name(self) -> str:
        """What a spec about it may be called: letters, digits and underscores."""
        which = _NAMED[self.quantity.relation][self.direction if self.other_limit is None else 1]
        names = [party.name for party in dict.fromkeys(self.quantity.parties)] or [self.quantity.signal]
        parts = [names[0], which, *names[1:]]
        text = "_".join("".join(c if c.isascii() and c.isalnum() else "_" for c in part) for part in parts)
        return text if text[0].isalpha() else f"_{text}"

    @property
    def near(self) -> LimitedRelation:
        """The same, of a distance between two limits only the greater one."""
        return self if self.other_limit is None else LimitedRelation(self.quantity, 1, self.other_limit)

    def opposite(self) -> LimitedRelation:
        """Return that it does not hold."""
        return replace(self, direction=1 - self.direction, limit=0.0 - self.limit)


def _called(party: Party) -> str:
    return f"every {party.name}" if party.is_class else party.name


@dataclass(frozen=True, slots=True)
class Line:
    """One spec that is learned: a fact in time, or one fact before another.

    Attributes:
        fact: what holds always, finally, eventually; what comes first, for "before" and "until".
        later: what does not hold before that, for "before" and "until".
    """

    pattern: Pattern
    fact: LimitedRelation
    later: LimitedRelation | None = None

    def formula(self, taken: set[str]) -> str:
        """Return its formula as a text; `taken` are names that no variable may have."""
        text = self.fact.text(taken)
        if self.later is None:
            return f"{_OPERATORS[self.pattern]} ({text})"
        held = (
            self.later.opposite().text(taken)
            if self.pattern == "until"
            else f"not ({self.later.text(taken)})"
        )
        return f"({held}) U ({text})"

    @property
    def title(self) -> str:
        """What it says, in words."""
        words = self.fact.words
        if self.later is not None:
            if self.pattern == "until":
                return f"{self.later.opposite().words(str)} until {words(str)}"
            return f"{words(str)} before {self.later.words(str)}"
        if self.pattern == "finally":
            return words(lambda be: {"are": "end", "is": "ends"}[be])
        return words(lambda be: f"{be} {'always' if self.pattern == 'always' else 'once'}")

    @property
    def name(self) -> str:
        """What the spec may be called."""
        if self.later is not None:
            if self.pattern == "until":
                return f"{self.later.opposite().name}_until_{self.fact.name}"
            return f"{self.fact.name}_before_{self.later.name}"
        ends = {"always": "always", "finally": "at_end", "eventually": "once"}
        return f"{self.fact.name}_{ends[self.pattern]}"

    @property
    def facts(self) -> tuple[LimitedRelation, ...]:
        """Its facts."""
        return (self.fact,) if self.later is None else (self.fact, self.later)


def ordered(first: LimitedRelation, later: LimitedRelation) -> Line:
    """Return that a fact holds before another one does, in the words that need the fewer negations."""
    is_positive = later.quantity.relation not in WITH_LIMIT and not later.direction
    return Line("before" if is_positive else "until", first, later)
