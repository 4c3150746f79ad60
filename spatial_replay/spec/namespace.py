"""What the names of a text stand for: one namespace of constants, regions, groups, macros and specs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from spatial_replay.errors import UsageError
from spatial_replay.spec import outline
from spatial_replay.spec.builder import StatementError, read_number
from spatial_replay.spec.faults import Faults, nearest_hint
from spatial_replay.spec.formula import ANY_CLASS, Group, Outline, Span
from spatial_replay.spec.syntax import (
    BrokenStatement,
    ConstStatement,
    DefStatement,
    Duration,
    GroupStatement,
    Name,
    OpenGroup,
    Quantity,
    RegionStatement,
    SpecStatement,
    Statement,
    UseStatement,
)

KIND_OF: Mapping[type, str] = MappingProxyType(
    {
        ConstStatement: "a constant",
        RegionStatement: "a region",
        GroupStatement: "a group",
        DefStatement: "a macro",
        SpecStatement: "a specification",
        BrokenStatement: "a definition",
    }
)

_DURATION = re.compile(r"-?\d+(\.\d*)?([eE][+-]?\d{1,3})?m?s")


def kind_of(statement: Statement) -> str:
    """What a statement defines, with its article."""
    return KIND_OF[type(statement)]


@dataclass(slots=True)
class Namespace:
    """The definitions of one text.

    Attributes:
        definitions: statements by name; of a name given twice, the first.
        regions, groups: the values of those definitions.
        used: names that something refers to.
        overrides: constants given from outside instead of the text's: numbers and, as texts, durations.
    """

    faults: Faults
    overrides: Mapping[str, float | str]
    definitions: dict[str, Statement] = field(default_factory=dict)
    regions: dict[str, Outline] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    constants: dict[str, float | Duration | None] = field(default_factory=dict)

    def declare(self, statements: Sequence[Statement]) -> None:
        """Take in the definitions of a text, and work out constants, regions and groups."""
        for statement in statements:
            if not isinstance(statement, UseStatement):
                self._declare(statement)
        self._check_overrides()
        effort = outline.Effort()
        for name, statement in self.definitions.items():
            match statement:
                case ConstStatement():
                    self.constant(name)
                case RegionStatement():
                    self.regions[name] = self._region(statement, effort)
                case GroupStatement():
                    self.groups[name] = self._group(statement)

    def _declare(self, statement: Statement) -> None:
        name = statement.name
        first = self.definitions.setdefault(name.text, statement)
        if first is not statement:
            line = self.faults.source.line_of(first.name.span.start)
            message = f"{name.text!r} is already the name of {kind_of(first)}, in line {line}"
            self.faults.add(name.span, message, "give each definition a name of its own")

    def _check_overrides(self) -> None:
        consts = [name for name, each in self.definitions.items() if isinstance(each, ConstStatement)]
        for name, value in self.overrides.items():
            if name not in consts:
                hint = nearest_hint(name, consts) or f"its constants are: {', '.join(consts) or 'none'}"
                raise UsageError(f"constants: the specification has no const {name!r}; {hint}")
            _overriding(name, value)

    def constant(self, name: str) -> float | Duration | None:
        """The value of a constant; None, and a fault, for one that is defined by way of itself."""
        if name in self.constants:
            return self.constants[name]
        chain: dict[str, ConstStatement] = {}
        value: float | Duration | None = None
        current: str | None = name
        while current is not None:
            statement = self.definitions.get(current)
            if current in self.constants:
                value, current = self.constants[current], None
            elif not isinstance(statement, ConstStatement) or current in chain:
                self._report_constant(chain, current, statement)
                current = None
            else:
                chain[current] = statement
                value, current = self._one_constant(current, statement)
        for each in chain:
            self.constants[each] = value
        return value

    def _one_constant(
        self, name: str, statement: ConstStatement
    ) -> tuple[float | Duration | None, str | None]:
        """The value of a constant, or the name of the constant that it repeats."""
        if name in self.overrides:
            return _overriding(name, self.overrides[name]), None
        if isinstance(statement.value, Name):
            self.used.add(statement.value.text)
            return None, statement.value.text
        return statement.value.value, None

    def _report_constant(
        self, chain: Mapping[str, ConstStatement], name: str, statement: Statement | None
    ) -> None:
        if not chain or isinstance(statement, BrokenStatement):
            return
        user = list(chain.values())[-1]
        if name in chain:
            message = f"const {name!r} is defined by way of itself"
            self.faults.add(user.value.span, message, "give it a number")
        else:
            self.report_no_number(Name(name, user.value.span), statement)

    def report_no_number(self, name: Name, statement: Statement | None) -> None:
        """Say that a name, and the statement that defines it if one does, gives no number."""
        if statement is None:
            consts = (each for each, what in self.definitions.items() if isinstance(what, ConstStatement))
            hint = self.faults.nearest(name.text, consts) or f"define it: const {name.text} = 1.0"
            self.faults.add(name.span, f"unknown constant {name.text!r}", hint)
        elif not isinstance(statement, BrokenStatement):
            self.faults.add(name.span, f"{name.text!r} is {kind_of(statement)}; a number is expected here")

    def plain_number(self, quantity: Quantity) -> float:
        """A number written outside of formulas; 0 after a fault."""
        value: float | Duration | None
        if isinstance(quantity, Name):
            self.used.add(quantity.text)
            statement = self.definitions.get(quantity.text)
            if not isinstance(statement, ConstStatement):
                self.report_no_number(quantity, statement)
                return 0.0
            value = self.constant(quantity.text)
        else:
            value = quantity.value
        if isinstance(value, Duration):
            message = "a duration, where a plain number is expected"
            self.faults.add(quantity.span, message, "leave out its unit")
            return 0.0
        return value or 0.0

    def _region(self, statement: RegionStatement, effort: outline.Effort) -> Outline:
        shape = statement.shape
        before = self.faults.count
        corners = [(self.plain_number(x), self.plain_number(y)) for x, y in shape.points]
        radius = self.plain_number(shape.radius) if shape.radius is not None else 0.0
        height = self._height(statement)
        if self.faults.count > before:
            return Outline(((0.0, 0.0),))
        try:
            match shape.kind:
                case "polygon":
                    found = outline.polygon(corners, effort)
                case "box":
                    found = outline.box(*corners[0], *corners[1])
                case _:
                    found = outline.circle(corners[0], radius)
        except outline.OutlineError as fault:
            self.faults.add(shape.span, fault.message, fault.hint)
            return Outline(((0.0, 0.0),))
        return Outline(found.vertices, found.radius, height)

    def _height(self, statement: RegionStatement) -> tuple[float, float] | None:
        if statement.height is None or statement.height_span is None:
            return None
        bottom, top = (self.plain_number(quantity) for quantity in statement.height)
        if bottom > top:
            message = f"the bottom of the height, {bottom:g}, is above its top, {top:g}"
            self.faults.add(statement.height_span, message, "write height (bottom, top)")
        return bottom, top

    def _group(self, statement: GroupStatement) -> Group:
        name = statement.name.text
        if statement.open_group is not None:
            return Group(name, class_name=class_of(statement.open_group))
        members: dict[str, Span] = {}
        for member in statement.members or ():
            defined = self.definitions.get(member.text)
            if defined is not None and not isinstance(defined, BrokenStatement):
                message = f"{member.text!r} is {kind_of(defined)}; a group has objects of the log as members"
                self.faults.add(member.span, message)
            elif member.text in members:
                self.faults.add(member.span, f"{member.text!r} is listed twice", "leave one out")
            members.setdefault(member.text, member.span)
        return Group(name, members=tuple(members))


def _overriding(name: str, value: object) -> float | Duration:
    """The value given for a constant from outside.

    Raises:
        UsageError: it is neither a finite number nor the text of a duration.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    if isinstance(value, str) and _DURATION.fullmatch(value):
        try:
            return read_number(value, Span(0, 0))
        except StatementError as fault:
            raise UsageError(f"constants: {name!r}: {fault.message}; {fault.hint}") from fault
    raise UsageError(
        f"constants: {name!r} is {value!r}; give a finite number or, as a text, a duration: '2s', '500ms'"
    )


def class_of(group: OpenGroup) -> str:
    """The `class_name` of an open group."""
    return ANY_CLASS if group.class_name is None else group.class_name
