"""Name resolution: definitions of a text, and terms, numbers and windows that refer to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from spatial_replay.spec.constants import constant_of, names_in, range_fault, value_of
from spatial_replay.spec.diagnostics import Faults, Span
from spatial_replay.spec.format import format_number
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Bound,
    Centre,
    Constant,
    Earlier,
    Enlarged,
    Group,
    NamedNumber,
    Outline,
    RegionName,
    Scale,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.syntax import (
    BoundSyntax,
    BrokenStatement,
    CentreSyntax,
    ConstStatement,
    DefStatement,
    Delayed,
    Duration,
    Enlargement,
    Exclusion,
    GroupStatement,
    Name,
    OpenGroup,
    Quantity,
    RegionStatement,
    ScaleStatement,
    SpecStatement,
    Statement,
    TemporalSyntax,
    TermSyntax,
    UseStatement,
)
from spatial_replay.spec.tokens import quote_name, title_hint
from spatial_replay.spec.walks import LENGTHS, standing

Corner: TypeAlias = tuple[float, float]


@dataclass(slots=True)
class Effort:
    """Remaining budget of edge comparisons for all polygons of one text."""

    left: int = 100_000


class OutlineError(Exception):
    """Fault of a shape, with its remedy."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


def polygon(corners: Sequence[Corner], effort: Effort) -> Outline:
    """Return the outline of a polygon.

    Raises:
        OutlineError: no corner, or a boundary that crosses or touches itself. Collinear corners are accepted
            as a point or a segment.
    """
    if not corners:
        raise OutlineError("a polygon without corners", "write at least one corner (x, y)")
    # repeated corners would give edges of length 0, which touch their neighbours
    ring = [corner for index, corner in enumerate(corners) if index == 0 or corner != corners[index - 1]]
    if len(ring) > 1 and ring[0] == ring[-1]:
        ring.pop()
    if not _is_collinear(ring):
        crossing_corners = _crossing(ring, effort)
        if crossing_corners is not None:
            (ax, ay), (bx, by) = crossing_corners
            message = f"the polygon crosses itself: its edges from ({ax:g}, {ay:g}) and ({bx:g}, {by:g}) meet"
            raise OutlineError(message, "list the corners in the order of its boundary")
    return Outline(tuple(corners))


def box(xmin: float, ymin: float, xmax: float, ymax: float) -> Outline:
    """Return the outline of a box.

    Raises:
        OutlineError: a minimum is above its maximum.
    """
    for axis, least, greatest in (("x", xmin, xmax), ("y", ymin, ymax)):
        if least > greatest:
            message = f"a box whose {axis}min, {least:g}, is above its {axis}max, {greatest:g}"
            raise OutlineError(message, "write box(xmin, ymin, xmax, ymax)")
    return Outline(((xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)))


def circle(centre: Corner, radius: float) -> Outline:
    """Return the outline of a disc.

    Raises:
        OutlineError: the radius is negative.
    """
    if radius < 0.0:
        raise OutlineError(f"a circle of the negative radius {radius:g}", "write a radius of at least 0")
    return Outline((centre,), radius)


def _turn(a: Corner, b: Corner, c: Corner) -> float:
    """Return twice the signed area of a triangle: positive for a left turn a, b, c; 0 on one line."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _is_collinear(ring: Sequence[Corner]) -> bool:
    if len(ring) < 3:
        return True
    return all(_turn(ring[0], ring[1], corner) == 0.0 for corner in ring[2:])


def _within(a: Corner, b: Corner, c: Corner) -> bool:
    """Return whether c, on the line through a and b, lies between them."""
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])


def _meet(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether the segments ab and cd have a common point."""
    c_side, d_side, a_side, b_side = _turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)
    if ((c_side > 0 > d_side) or (c_side < 0 < d_side)) and ((a_side > 0 > b_side) or (a_side < 0 < b_side)):
        return True
    touch_candidates = ((c_side, a, b, c), (d_side, a, b, d), (a_side, c, d, a), (b_side, c, d, b))
    return any(side == 0.0 and _within(*points) for side, *points in touch_candidates)


def _fold_back(a: Corner, b: Corner, c: Corner) -> bool:
    """Return whether the edge bc runs back over ab."""
    dot_product = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1])
    return _turn(a, b, c) == 0.0 and dot_product < 0.0


def _crossing(ring: Sequence[Corner], effort: Effort) -> tuple[Corner, Corner] | None:
    """Return the start corners of two edges that cross, touch or fold back; None for a simple polygon."""
    corner_count = len(ring)
    edges = [(ring[index], ring[(index + 1) % corner_count]) for index in range(corner_count)]
    for index in range(corner_count):
        if _fold_back(*edges[index - 1], edges[index][1]):
            return edges[index - 1][0], edges[index][0]
    # a sweep along x: only edges that overlap in x are compared
    indices_by_left = sorted(
        range(corner_count), key=lambda index: min(edges[index][0][0], edges[index][1][0])
    )
    for position, first_index in enumerate(indices_by_left):
        right_end = max(edges[first_index][0][0], edges[first_index][1][0])
        for second_index in indices_by_left[position + 1 :]:
            if min(edges[second_index][0][0], edges[second_index][1][0]) > right_end:
                break
            effort.left -= 1
            if effort.left < 0:
                raise OutlineError("the polygons of this text have too many corners", "use fewer of them")
            # neighbouring edges always meet at their common corner
            if (first_index - second_index) % corner_count not in (1, corner_count - 1) and _meet(
                *edges[first_index], *edges[second_index]
            ):
                return edges[min(first_index, second_index)][0], edges[max(first_index, second_index)][0]
    return None


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


def kind_of(statement: Statement) -> str:
    """Return the kind of a definition with its article, such as "a constant"."""
    return KIND_OF[type(statement)]


@dataclass(slots=True)
class Namespace:
    """Definitions of one text.

    Attributes:
        signals: plug-ins by the names of the signals that they compute.
        definitions: statements by name; the first statement if a name is defined twice.
        regions, groups: values of region and group definitions by name.
        used: names that formulas refer to.
        entangled: names that constants, regions or scales refer to.
        constants: values of constants by name; None for a constant with a fault.
        scales: divisors from `scale` lines.
    """

    faults: Faults
    signals: Mapping[str, str] = field(default_factory=dict)
    definitions: dict[str, Statement] = field(default_factory=dict)
    regions: dict[str, Outline] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    entangled: frozenset[str] = frozenset()
    constants: dict[str, float | Duration | None] = field(default_factory=dict)
    scales: list[Scale] = field(default_factory=list)

    def declare(self, statements: Sequence[Statement]) -> None:
        """Add the definitions of a text and compute its constants, regions and groups."""
        for statement in statements:
            if not isinstance(statement, (UseStatement, ScaleStatement)):
                self._declare(statement)
        for statement in statements:
            if isinstance(statement, ScaleStatement):
                self._add_scale(statement)
        effort = Effort()
        for name, statement in self.definitions.items():
            match statement:
                case ConstStatement():
                    self.constant(name)
                case RegionStatement():
                    self.regions[name] = self._region(statement, effort)
                case GroupStatement():
                    self.groups[name] = self._group(statement)
        self.entangled = frozenset(self.used)

    def _declare(self, statement: Statement) -> None:
        name = statement.name
        first_statement = self.definitions.setdefault(name.text, statement)
        if first_statement is not statement:
            line = self.faults.source.line_of(first_statement.name.span.start)
            message = f"{name.text!r} is already the name of {kind_of(first_statement)}, in line {line}"
            self.faults.add(name.span, message, "give each definition a name of its own")

    def _add_scale(self, statement: ScaleStatement) -> None:
        name, fault_count = statement.name, self.faults.count
        # a signal with the name "lengths" is written in quotes
        signal = None if name.text == LENGTHS and not name.is_quoted else name.text
        divisor = self.plain_number(statement.value)
        definition = self.definitions.get(name.text)
        if signal is not None and definition is not None:
            hint = f"scale takes a signal of the log, or {LENGTHS}"
            self.faults.add(name.span, f"{name.text!r} is {kind_of(definition)}", hint)
        elif any(scale.signal == signal for scale in self.scales):
            self.faults.add(name.span, f"{name.text!r} is scaled twice", "leave one out")
        elif self.faults.count == fault_count and divisor <= 0.0:
            message = f"a scale of {format_number(divisor)}"
            hint = "write what counts as much as 1 of the others, above 0"
            self.faults.add(statement.value.span, message, hint)
        else:
            self.scales.append(Scale(signal, divisor))

    def constant(self, name: str) -> float | Duration | None:
        """Return the value of a constant; report a fault and return None if its definition is circular."""
        # a stack instead of recursion: a chain of constants can be longer than Python's recursion limit
        pending_names = [name]
        while pending_names:
            current_name = pending_names[-1]
            statement = self.definitions.get(current_name)
            if current_name in self.constants or not isinstance(statement, ConstStatement):
                pending_names.pop()
                continue
            needed_name = next(
                (
                    operand_name
                    for operand_name in names_in(statement.value)
                    if self._is_pending(operand_name)
                ),
                None,
            )
            if needed_name is None:
                self.constants[current_name] = value_of(statement.value, self.named_value, self.faults.add)
            elif needed_name.text in pending_names:
                message = f"const {needed_name.text!r} is defined in terms of itself"
                self.faults.add(needed_name.span, message, "give it a number")
                self.constants[current_name] = None
            else:
                pending_names.append(needed_name.text)
        return self.constants.get(name)

    def _is_pending(self, name: Name) -> bool:
        return name.text not in self.constants and isinstance(self.definitions.get(name.text), ConstStatement)

    def constant_ranges(self) -> dict[str, Constant]:
        """Return the constants that have a value, by name; report values outside of their range."""
        constants: dict[str, Constant] = {}
        for name, statement in self.definitions.items():
            value = self.constants.get(name)
            if value is None or not isinstance(statement, ConstStatement):
                continue
            ends = None
            if statement.range is not None:
                low, high = (
                    value_of(end, self.named_value, self.faults.add)
                    for end in (statement.range.lower, statement.range.upper)
                )
                ends = None if low is None or high is None else (low, high)
            fault = None if ends is None else range_fault(value, ends)
            if fault is not None:
                self.faults.add(statement.value.span, f"const {name!r}: {fault[0]}", fault[1])
            constants[name] = constant_of(statement.value, value, ends)
        return constants

    def _report_not_a_number(self, name: Name, statement: Statement | None) -> None:
        """Report that a name is not a number; `statement` is its definition, or None."""
        if name.text == "inf":
            self.faults.add(
                name.span, "'inf' is not a number here", "it is the upper end of a window: [0, inf]"
            )
        elif name.is_quoted and statement is None:
            hint = f"an object gets another name by a group: group NAME = {quote_name(name.text)}"
            self.faults.add(name.span, "a text, where a number or a duration is expected", hint)
        elif statement is None:
            constant_names = (
                constant_name
                for constant_name, definition in self.definitions.items()
                if isinstance(definition, ConstStatement)
            )
            hint = self.faults.nearest(name.text, constant_names) or (
                f"define it: const {name.text} = 1.0; a text stands in quotes,"
                f" mode == {quote_name(name.text)}; a signal is not compared with a signal"
            )
            self.faults.add(name.span, f"unknown constant {name.text!r}", hint)
        elif not isinstance(statement, BrokenStatement):
            self.faults.add(name.span, f"{name.text!r} is {kind_of(statement)}; a number is expected here")

    def quantity(self, written: Quantity) -> float | Duration:
        """Return the number or duration of a quantity outside of formulas; 0 after a fault."""
        return value_of(written, self.named_value, self.faults.add) or 0.0

    def named_value(self, name: Name) -> float | Duration | None:
        """Return the value of a constant; report a fault and return None if the name is not a constant."""
        self.used.add(name.text)
        statement = self.definitions.get(name.text)
        if not isinstance(statement, ConstStatement):
            self._report_not_a_number(name, statement)
            return None
        return self.constant(name.text)

    def with_constant_name(self, name: str, value: float | Duration | None) -> float | Duration | None:
        """Return a constant's value, as a `NamedNumber` if only formulas depend on the constant."""
        if isinstance(value, float) and name not in self.entangled:
            return NamedNumber(value, (name,), is_plain=True)
        return value

    def plain_number(self, written: Quantity) -> float:
        """Return a plain number outside of formulas; report a fault and return 0 for a duration."""
        value = self.quantity(written)
        if isinstance(value, Duration):
            message = "a duration, where a plain number is expected"
            self.faults.add(written.span, message, "leave out its unit")
            return 0.0
        return value

    def _region(self, statement: RegionStatement, effort: Effort) -> Outline:
        shape = statement.shape
        fault_count = self.faults.count
        corners = [(self.plain_number(x), self.plain_number(y)) for x, y in shape.points]
        radius = self.plain_number(shape.radius) if shape.radius is not None else 0.0
        height = self._height(statement)
        # a placeholder, so that the uses of the region are checked, too
        if self.faults.count > fault_count:
            return Outline(((0.0, 0.0),))
        try:
            match shape.kind:
                case "polygon":
                    outline = polygon(corners, effort)
                case "box":
                    outline = box(*corners[0], *corners[1])
                case _:
                    outline = circle(corners[0], radius)
        except OutlineError as fault:
            self.faults.add(shape.span, fault.message, fault.hint)
            return Outline(((0.0, 0.0),))
        return Outline(outline.vertices, outline.radius, height)

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
            definition = self.definitions.get(member.text)
            if definition is not None and not isinstance(definition, BrokenStatement):
                message = (
                    f"{member.text!r} is {kind_of(definition)}; a group has objects of the log as members"
                )
                self.faults.add(member.span, message)
            elif member.text in members:
                self.faults.add(member.span, f"{member.text!r} is listed twice", "leave one out")
            members.setdefault(member.text, member.span)
        return Group(name, members=tuple(members))


def class_of(group: OpenGroup) -> str:
    """Return the `class_name` of an open group."""
    return ANY_CLASS if group.class_name is None else group.class_name


MAX_SAMPLES = 2**53
"""Largest number of samples; all integers up to 2**53 are exact as floating-point numbers."""

MAX_SIZE = 20_000
"""Maximum number of operators, atoms and terms of one text, with macros, quantifiers and specs expanded."""


@dataclass(frozen=True, slots=True)
class Anything:
    """Placeholder argument for checking the body of an unused macro; it is valid as any kind of argument."""


Value: TypeAlias = Term | float | Duration | Anything


@dataclass(frozen=True, slots=True)
class Scope:
    """Local names and depth at one place of a text.

    Attributes:
        values: values of parameters and variables by name.
        call: place where the text uses the outermost macro being expanded; None outside of macros.
        macros: names of the macros that are being expanded, outermost first.
        bound: variables of the enclosing quantifiers and template, after renaming.
        depth: number of enclosing operators, plus 1.
        order: number of specs before this place.
    """

    values: Mapping[str, Value] = field(default_factory=dict)
    call: Span | None = None
    macros: tuple[str, ...] = ()
    bound: frozenset[str] = frozenset()
    depth: int = 1
    order: int = 0

    def deeper(self) -> Scope:
        """Return the scope of an operand, one level deeper."""
        return replace(self, depth=self.depth + 1)


@dataclass(slots=True)
class Resolver:
    """Resolver of terms, numbers and windows; it collects faults.

    Attributes:
        size: number of resolved parts, compared with `MAX_SIZE`.
    """

    names: Namespace
    faults: Faults
    size: int = field(default=0)

    def fault(self, span: Span, scope: Scope, message: str, hint: str = "") -> None:
        """Report a fault; the message names the macro that is being expanded."""
        if scope.macros and scope.call is not None:
            line = self.faults.source.line_of(scope.call.start)
            message += f" (in {scope.macros[-1]!r}, used in line {line})"
        self.faults.add(span, message, hint)

    # ----------------------------------------------------------------------------------------- terms

    def term(self, written: TermSyntax, scope: Scope) -> Term:
        """Return the term of a syntax node; a tracked object after a fault."""
        self.size += 1
        match written:
            case Name():
                return self._term_of_name(written, scope)
            case OpenGroup():
                return Group("", class_name=class_of(written))
            case Exclusion():
                return self._exclusion(written, scope)
            case Delayed():
                return self._delay(self.term(written.term, scope), written, scope)
            case Enlargement():
                return self._enlarge(written, scope)
            case CentreSyntax():
                return Centre(standing(self.term(written.term, scope)))

    def _term_of_name(self, name: Name, scope: Scope) -> Term:
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
            case definition:
                message = (
                    f"{name.text!r} is {kind_of(definition)}; an object, region or group is expected here"
                )
                hint = "if an object is meant, rename the definition"
                if isinstance(definition, SpecStatement):
                    hint = f"if an object is meant, rename the specification; {title_hint(name.text)}"
                self.fault(name.span, scope, message, hint)
                return TrackedName(name.text)

    def _exclusion(self, written: Exclusion, scope: Scope) -> Term:
        group = self.term(written.group, scope)
        excluded_terms = [self._term_of_name(name, scope) for name in written.excluded]
        if not isinstance(group, Group):
            if not self.is_unknown(written.group, scope):
                self.fault(written.group.span, scope, "only a group can leave something out with except")
            return group
        excluded_members = dict.fromkeys(group.excluded)
        for name, term in zip(written.excluded, excluded_terms, strict=True):
            if isinstance(term, (TrackedName, Variable)):
                excluded_members[term] = None
            else:
                self.fault(name.span, scope, f"except leaves out one object; {name.text!r} is not an object")
        return replace(group, excluded=tuple(excluded_members))

    def is_unknown(self, written: TermSyntax, scope: Scope) -> bool:
        """Return whether a name has no known meaning: an `Anything` parameter or a broken definition."""
        if not isinstance(written, Name):
            return False
        if isinstance(scope.values.get(written.text), Anything):
            return True
        definition = self.names.definitions.get(written.text)
        return written.text not in scope.values and isinstance(definition, BrokenStatement)

    def _delay(self, term: Term, written: Delayed, scope: Scope) -> Term:
        # a delay applies to the footprint before it is enlarged or reduced to its centre
        if isinstance(term, Enlarged | Centre):
            inner: Any = self._delay(term.term, written, scope)
            return replace(term, term=inner)
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

    def _enlarge(self, written: Enlargement, scope: Scope) -> Term:
        term = self.term(written.term, scope)
        radius = self.number(written.radius, scope)
        if radius < 0.0:
            message = f"enlarge by the negative radius {format_number(radius)}"
            self.fault(written.radius.span, scope, message, "write a radius of at least 0")
            return term
        return Enlarged(term, radius)

    # --------------------------------------------------------------------------------------- numbers

    def quantity(self, written: Quantity, scope: Scope) -> float | Duration:
        """Return the number or duration of a quantity in a formula; 0 after a fault."""

        def named_value(name: Name) -> float | Duration | None:
            value = scope.values.get(name.text)
            if value is None:
                return self.names.with_constant_name(name.text, self.names.named_value(name))
            if isinstance(value, (float, Duration)):
                return value
            if not isinstance(value, Anything):
                message = f"{name.text!r} is an object; a number is expected here"
                self.fault(name.span, scope, message)
            return None

        def report(span: Span, message: str, hint: str) -> None:
            self.fault(span, scope, message, hint)

        value = value_of(written, named_value, report)
        return 0.0 if value is None else value

    def is_number(self, name: Name, scope: Scope) -> bool:
        """Return whether a name is a constant, or a macro parameter with a number as its argument."""
        local_value = scope.values.get(name.text)
        if local_value is not None:
            return isinstance(local_value, (float, Duration))
        return isinstance(self.names.definitions.get(name.text), ConstStatement)

    def number(self, written: Quantity, scope: Scope) -> float:
        """Return a plain number; report a fault and return 0 for a duration."""
        value = self.quantity(written, scope)
        if isinstance(value, Duration):
            hint = "leave out its unit"
            self.fault(written.span, scope, "a duration, where a plain number is expected", hint)
            return 0.0
        return value

    def _samples(self, value: float, written: Quantity, scope: Scope) -> int:
        if value < 0.0 or not value.is_integer() or value > MAX_SAMPLES:
            message = f"{format_number(value)} is not a whole number of samples"
            hint = "write a whole number of samples, at least 0, or a time such as 0.5s"
            self.fault(written.span, scope, message, hint)
            return 0
        return int(value)

    # --------------------------------------------------------------------------------------- windows

    def bound(self, operator: TemporalSyntax, scope: Scope) -> Bound | None:
        """Return the window of a temporal operator; None without a window or after a fault."""
        window = operator.bound
        if window is None:
            return None
        lower = self._end(window.lower, scope)
        upper = self._end(window.upper, scope)
        if lower is None:
            self.fault(window.lower.span, scope, "a window cannot begin at inf", "write [0, inf]")
            return None
        units: set[str] = set()
        for end in (lower, upper):
            if isinstance(end, Duration):
                units.add("ns")
            # 0 fits both units
            elif end:
                units.add("samples")
        if len(units) == 2:
            hint = "write both ends in samples, or both with s or ms"
            self.fault(window.span, scope, "a window from samples to time, or from time to samples", hint)
            return None
        unit: Literal["samples", "ns"] = "ns" if "ns" in units else "samples"
        if units == {"samples"} and self._lacks_unit(operator, window, scope):
            return None
        whole_lower = self._whole(lower, window.lower, scope)
        whole_upper = None if upper is None else self._whole(upper, window.upper, scope)
        if whole_upper is not None and whole_upper < whole_lower:
            text = self.faults.source.text[window.span.start : window.span.end]
            hint = "the smaller end comes first"
            self.fault(window.span, scope, f"the window {text} is empty: its ends are reversed", hint)
            return None
        return Bound(whole_lower, whole_upper, unit)

    def _lacks_unit(self, operator: TemporalSyntax, written: BoundSyntax, scope: Scope) -> bool:
        """Report a window that needs a unit, because of its decimal numbers or of another tool's spelling.

        Return whether the window is reported.
        """
        text, ends = self.faults.source.text, (written.lower, written.upper)
        keyword, window_text = (text[span.start : span.end] for span in (operator.keyword, written.span))
        end_values = [self._end(end, scope) for end in ends]
        numbers = [value for value in end_values if isinstance(value, float)]
        is_whole = all(number.is_integer() for number in numbers)
        is_decimal = not is_whole or any("." in text[end.span.start : end.span.end] for end in ends)
        # other tools write windows in seconds without a unit: always[0:5]
        is_own_spelling = keyword == operator.operator and ":" not in window_text
        if (is_own_spelling and not is_decimal) or numbers[0] < 0.0 or numbers != sorted(numbers):
            return False

        def remedy(unit: str) -> str:
            end_texts = [
                format_number(value) + unit if isinstance(value, float) else "inf" for value in end_values
            ]
            return f"{operator.operator}[{', '.join(end_texts)}] for {'seconds' if unit else 'samples'}"

        reason = (
            "needs its unit in this spelling" if not is_own_spelling else "of decimal numbers needs its unit"
        )
        remedies = [remedy(unit) for unit in (["", "s"] if is_whole else ["s"])]
        self.fault(written.span, scope, f"a window {reason}", f"write {', '.join(remedies)}")
        return True

    def _end(self, written: Quantity, scope: Scope) -> float | Duration | None:
        """Return the end of a window; None for inf."""
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
