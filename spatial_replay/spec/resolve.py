"""Names in formulas to terms, numbers and windows: objects, regions and groups, constants, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from spatial_replay.spec.faults import Faults
from spatial_replay.spec.format import format_number
from spatial_replay.spec.formula import (
    Bound,
    Earlier,
    Enlarged,
    Group,
    RegionName,
    Span,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.namespace import Namespace, class_of, kind_of
from spatial_replay.spec.syntax import (
    BoundSyntax,
    BrokenStatement,
    ConstStatement,
    Delayed,
    Duration,
    Enlargement,
    Exclusion,
    GroupStatement,
    Name,
    NumberSyntax,
    OpenGroup,
    Quantity,
    RegionStatement,
    TermSyntax,
)

MAX_SAMPLES = 2**53


MAX_SIZE = 20_000
"""Operators, atoms and terms of one text, with macros, quantifiers and named specs written out."""


@dataclass(frozen=True, slots=True)
class Anything:
    """The argument of a macro that nothing uses: whatever fits, so that its body can be checked."""


Value: TypeAlias = Term | float | Duration | Anything


@dataclass(frozen=True, slots=True)
class Scope:
    """What local names mean at one place, and how deep it lies.

    Attributes:
        values: parameters and variables.
        call: where the outermost macro was used, while its body is read.
        macros: the macros being expanded, from the outside.
        bound: variables of quantifiers and templates around, in the way they are written out.
        order: how many specs stand before this place.
    """

    values: Mapping[str, Value] = field(default_factory=dict)
    call: Span | None = None
    macros: tuple[str, ...] = ()
    bound: frozenset[str] = frozenset()
    depth: int = 1
    order: int = 0

    def deeper(self) -> Scope:
        """The scope of an operand: one operator further in."""
        return replace(self, depth=self.depth + 1)


@dataclass(slots=True)
class Resolver:
    """Turns what is written in places of objects and numbers into values; faults are collected."""

    names: Namespace
    faults: Faults
    size: int = field(default=0)

    def fault(self, span: Span, scope: Scope, message: str, hint: str = "") -> None:
        """Report a fault; inside a macro, say so."""
        if scope.macros and scope.call is not None:
            line = self.faults.source.line_of(scope.call.start)
            message += f" (in {scope.macros[-1]!r}, used in line {line})"
        self.faults.add(span, message, hint)

    # ----------------------------------------------------------------------------------------- terms

    def term(self, written: TermSyntax, scope: Scope) -> Term:
        """What a term stands for; some tracked object after a fault."""
        self.size += 1
        match written:
            case Name():
                return self._named(written, scope)
            case OpenGroup():
                return Group("", class_name=class_of(written))
            case Exclusion():
                return self._exclusion(written, scope)
            case Delayed():
                return self._delay(self.term(written.term, scope), written, scope)
            case Enlargement():
                return self._enlarged(written, scope)

    def _named(self, name: Name, scope: Scope) -> Term:
        value = scope.values.get(name.text)
        if isinstance(value, (float, Duration)):
            self.fault(name.span, scope, f"{name.text!r} is a number; an object is expected here")
        elif value is not None and not isinstance(value, Anything):
            return value
        if name.text in scope.values:
            return TrackedName(name.text)
        match self.names.definitions.get(name.text):
            case None | BrokenStatement():
                return TrackedName(name.text)
            case RegionStatement():
                self.names.used.add(name.text)
                return RegionName(name.text)
            case GroupStatement():
                self.names.used.add(name.text)
                return self.names.groups[name.text]
            case other:
                message = f"{name.text!r} is {kind_of(other)}; an object, region or group is expected here"
                self.fault(name.span, scope, message, "if an object is meant, rename the definition")
                return TrackedName(name.text)

    def _exclusion(self, written: Exclusion, scope: Scope) -> Term:
        group = self.term(written.group, scope)
        excluded = [self._named(name, scope) for name in written.excluded]
        if not isinstance(group, Group):
            if not self._is_open_question(written.group, scope):
                self.fault(written.group.span, scope, "only a group can leave something out with except")
            return group
        left_out = dict.fromkeys(group.excluded)
        for name, term in zip(written.excluded, excluded, strict=True):
            if isinstance(term, (TrackedName, Variable)):
                left_out[term] = None
            else:
                self.fault(name.span, scope, f"except leaves out one object; {name.text!r} is none")
        return replace(group, excluded=tuple(left_out))

    def _is_open_question(self, written: TermSyntax, scope: Scope) -> bool:
        """Whether a name stands for nothing known: a parameter of `Anything`, a broken definition."""
        if not isinstance(written, Name):
            return False
        if isinstance(scope.values.get(written.text), Anything):
            return True
        defined = self.names.definitions.get(written.text)
        return written.text not in scope.values and isinstance(defined, BrokenStatement)

    def _delay(self, term: Term, written: Delayed, scope: Scope) -> Term:
        if isinstance(term, Enlarged):
            return replace(term, term=self._delay(term.term, written, scope))
        if isinstance(term, Earlier):
            self.fault(written.span, scope, "a delay of a delayed object", "add the two up in one [-n]")
            return term
        amount = self.quantity(written.amount, scope)
        if isinstance(amount, Duration):
            if amount.ns < 0:
                self.fault(written.amount.span, scope, "a delay into the future", "write [-n] with n >= 0")
            return Earlier(term, duration_ns=amount.ns) if amount.ns > 0 else term
        samples = self._samples(amount, written.amount, scope)
        return Earlier(term, samples=samples) if samples else term

    def _enlarged(self, written: Enlargement, scope: Scope) -> Term:
        term = self.term(written.term, scope)
        radius = self.number(written.radius, scope)
        if radius < 0.0:
            message = f"enlarge by the negative radius {format_number(radius)}"
            self.fault(written.radius.span, scope, message, "write a radius of at least 0")
            return term
        return Enlarged(term, radius)

    # --------------------------------------------------------------------------------------- numbers

    def quantity(self, written: Quantity, scope: Scope) -> float | Duration:
        """The number or duration that stands somewhere; 0 after a fault."""
        if isinstance(written, NumberSyntax):
            return written.value
        value = scope.values.get(written.text)
        if isinstance(value, (float, Duration)):
            return value
        if isinstance(value, Anything):
            return 0.0
        if value is not None:
            self.fault(written.span, scope, f"{written.text!r} is an object; a number is expected here")
            return 0.0
        self.names.used.add(written.text)
        statement = self.names.definitions.get(written.text)
        if not isinstance(statement, ConstStatement):
            self.names.report_no_number(written, statement)
            return 0.0
        return self.names.constant(written.text) or 0.0

    def number(self, written: Quantity, scope: Scope) -> float:
        """A plain number; a duration in its place is a fault."""
        value = self.quantity(written, scope)
        if isinstance(value, Duration):
            hint = "leave out its unit"
            self.fault(written.span, scope, "a duration, where a plain number is expected", hint)
            return 0.0
        return value

    def _samples(self, value: float, written: Quantity, scope: Scope) -> int:
        if value < 0.0 or not value.is_integer() or value > MAX_SAMPLES:
            message = f"{format_number(value)} is no number of samples"
            hint = "write a whole number of samples, at least 0, or a time such as 0.5s"
            self.fault(written.span, scope, message, hint)
            return 0
        return int(value)

    # --------------------------------------------------------------------------------------- windows

    def bound(self, written: BoundSyntax | None, scope: Scope) -> Bound | None:
        """The window of a temporal operator; None for none, and after a fault."""
        if written is None:
            return None
        lower = self._end(written.lower, scope)
        upper = self._end(written.upper, scope)
        if lower is None:
            self.fault(written.lower.span, scope, "a window cannot begin at inf", "write [0, inf]")
            return None
        known: set[str] = set()
        for end in (lower, upper):
            if isinstance(end, Duration):
                known.add("ns")
            elif end:
                known.add("samples")
        if len(known) == 2:
            hint = "write both ends in samples, or both with s or ms"
            self.fault(written.span, scope, "a window from samples to time, or from time to samples", hint)
            return None
        unit: Literal["samples", "ns"] = "ns" if "ns" in known else "samples"
        first = self._whole(lower, written.lower, scope)
        last = None if upper is None else self._whole(upper, written.upper, scope)
        if last is not None and last < first:
            text = self.faults.source.text[written.span.start : written.span.end]
            hint = "the smaller end comes first"
            self.fault(written.span, scope, f"the window {text} is empty: its ends are reversed", hint)
            return None
        return Bound(first, last, unit)

    def _end(self, written: Quantity, scope: Scope) -> float | Duration | None:
        """One end of a window; None for inf."""
        is_inf = isinstance(written, Name) and written.text == "inf"
        if is_inf and "inf" not in scope.values and "inf" not in self.names.definitions:
            return None
        return self.quantity(written, scope)

    def _whole(self, end: float | Duration, written: Quantity, scope: Scope) -> int:
        if not isinstance(end, Duration):
            return self._samples(end, written, scope)
        if end.ns < 0:
            self.fault(written.span, scope, "a window cannot begin before now", "write ends of at least 0")
            return 0
        return end.ns
