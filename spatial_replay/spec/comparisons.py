"""Comparisons: a signal, distance or rate with a constant, and comparisons of sums."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Final, NamedTuple

from spatial_replay.spec.constants import names_in
from spatial_replay.spec.diagnostics import Span
from spatial_replay.spec.formula import (
    ComputedSignal,
    Equality,
    Expression,
    Group,
    Maximum,
    NamedNumber,
    Negative,
    Number,
    Product,
    Rate,
    RegionName,
    Scaled,
    Signal,
    SignedDistance,
    Sum,
    Term,
    TrackedName,
    maximum,
    minimum,
)
from spatial_replay.spec.relations import compare
from spatial_replay.spec.resolve import Anything, Resolver, Scope, kind_of
from spatial_replay.spec.syntax import (
    DERIVED_TERMS,
    ArgumentSyntax,
    Arithmetic,
    BrokenStatement,
    Call,
    ComparisonSyntax,
    ConstStatement,
    DefStatement,
    DistanceSyntax,
    FormulaSyntax,
    Name,
    NumberSyntax,
    RateSyntax,
)
from spatial_replay.spec.tokens import function_hint, quote_name, span_of
from spatial_replay.spec.walks import (
    base_of,
    iter_expressions,
    looks_back,
    rate_of,
    speed_of,
)
from spatial_replay.text import text_number

_MIRRORED: Final[Mapping[str, str]] = MappingProxyType(
    {"<=": ">=", "<": ">", ">=": "<=", ">": "<", "==": "==", "!=": "!="}
)
_SIMPLE: Final = (Name, DistanceSyntax, RateSyntax)
"""Quantities whose comparison with a constant has a relation name: "signal", "dist", "speed" or "rate"."""


class Comparison(NamedTuple):
    """Parts of an atom that compares numbers; see `Atom`."""

    relation: str
    expression: Expression
    terms: tuple[Term, ...]
    parameters: tuple[float | str, ...]


_NOTHING: Final = Comparison("sum", compare(Number(0.0), "<=", Number(0.0)), (), ("<=",))
"""Placeholder for a comparison with a fault."""
_NOT_EQUAL: Final[Mapping[str, str]] = MappingProxyType(
    {
        "dist": "write what is too near or too far: a dist b <= c, a dist b >= c",
        "speed": "write what is too slow or too fast: speed(a) >= c, speed(a) <= c",
        "rate": "write what is too slow or too fast: rate(x) >= c, rate(x) <= c",
    }
)
_PLUGIN: Final = (
    'a plug-in computes it: SIGNALS = {"NAME": function of a sample} in a module, given by --plugin; '
    "a comparison has sums, multiples by constants and abs"
)


@dataclass(frozen=True, slots=True)
class ComparisonBuilder:
    """Builder of the comparisons of one text."""

    resolver: Resolver

    def build(self, written: ComparisonSyntax, scope: Scope) -> Comparison:
        """Return the expression of a comparison with its relation, terms and parameters."""
        operands, signs = written.operands, [token.value for token in written.operators]
        if len(operands) == 3:
            return self._range(written, scope)
        left, right = operands
        if self._is_constant(left, scope) and isinstance(right, _SIMPLE):
            if not self._is_constant(right, scope):
                return self._of_one(right, ((_MIRRORED[signs[0]], left),), written, scope)
        elif isinstance(left, _SIMPLE) and self._is_constant(right, scope):
            return self._of_one(left, ((signs[0], right),), written, scope)
        # a quoted name is a text here, an unquoted one a signal
        if isinstance(left, Name) and isinstance(right, Name) and signs[0] in ("==", "!="):
            if right.is_quoted:
                return self._of_text(left, signs[0], right, scope)
            if left.is_quoted:
                return self._of_text(right, signs[0], left, scope)
        self._check_constant(left, right, scope)
        self._check_constant(right, left, scope)
        return self._of_sums(written, scope)

    # ------------------------------------------------------------------------------- one with a constant

    def _of_one(
        self,
        quantity: Name | DistanceSyntax | RateSyntax,
        comparisons: Sequence[tuple[str, FormulaSyntax]],
        written: ComparisonSyntax,
        scope: Scope,
    ) -> Comparison:
        """Return the comparison of one signal, distance or rate with one or two constants."""
        limits = [(sign, self.resolver.number(limit, scope)) for sign, limit in comparisons]  # type: ignore[arg-type]
        if isinstance(quantity, Name):
            ((sign, limit),) = limits
            return self._of_signal(quantity, sign, limit, limit, scope)
        measured_number = self._number(quantity, scope)
        relation = quantity.function if isinstance(quantity, RateSyntax) else "dist"
        signal_names: tuple[float | str, ...] = ()
        if not isinstance(measured_number, Rate | SignedDistance):
            return _NOTHING
        if isinstance(measured_number, Rate) and measured_number.signal:
            signal_names = (measured_number.signal.name,)
        for token in written.operators:
            if token.value == "!=":
                message = f"a {'distance' if relation == 'dist' else 'rate'} is hardly ever exactly a number"
                self.resolver.fault(span_of(token), scope, message, _NOT_EQUAL[relation])
        terms = _written_terms(measured_number)
        margins = [compare(measured_number, sign, limit) for sign, limit in limits]
        (sign, limit), *upper_limits = limits
        if not upper_limits:
            return Comparison(relation, margins[0], terms, (*signal_names, sign, limit))
        parameters = (*signal_names, limit, _MIRRORED[sign], *upper_limits[0])
        return Comparison(relation, minimum(*margins), terms, parameters)

    def _of_text(self, signal: Name, sign: str, text: Name, scope: Scope) -> Comparison:
        return self._of_signal(signal, sign, text_number(text.text), quote_name(text.text), scope)

    def _of_signal(
        self, name: Name, sign: str, limit: float, limit_text: float | str, scope: Scope
    ) -> Comparison:
        """Return the comparison of a signal with a constant or a text; `==` and `!=` are exact."""
        signal = self._signal(name, scope)
        equality = Equality(signal, limit)
        exact_expressions: Mapping[str, Expression] = {"==": equality, "!=": -equality}
        expression = exact_expressions.get(sign) or compare(signal, sign, limit)
        return Comparison("signal", expression, (), (name.text, sign, limit_text))

    # ----------------------------------------------------------------------------------------------- sums

    def _range(self, written: ComparisonSyntax, scope: Scope) -> Comparison:
        """Return a chained comparison, `c1 <= a dist b <= c2`: the minimum of two comparisons."""
        (lower, middle, upper), (lower_sign, upper_sign) = written.operands, written.operators
        for token, side in ((lower_sign, "left"), (upper_sign, "right")):
            if token.value not in ("<=", "<"):
                message = f"{token.value!r} cannot stand on the {side} of a chained comparison, only <= or <"
                self.resolver.fault(
                    span_of(token), scope, message, _range_hint(lower_sign.value, upper_sign.value)
                )
                return _NOTHING
        is_between_constants = self._is_constant(lower, scope) and self._is_constant(upper, scope)
        if is_between_constants and isinstance(middle, DistanceSyntax | RateSyntax):
            limits = ((_MIRRORED[lower_sign.value], lower), (upper_sign.value, upper))
            return self._of_one(middle, limits, written, scope)
        return self._of_sums(written, scope)

    def _of_sums(self, written: ComparisonSyntax, scope: Scope) -> Comparison:
        signs = [token.value for token in written.operators]
        if not {"==", "!="}.isdisjoint(signs):
            self._report_equality(written, scope)
            return _NOTHING
        if all(self._is_constant(operand, scope) for operand in written.operands):
            self._report_constants(written, scope)
            return _NOTHING
        numbers = [self._number(operand, scope) for operand in written.operands]
        for left, right in pairwise(numbers):
            self._check_units(left, right, written, scope)
        margins = [
            compare(left, sign, right) for (left, right), sign in zip(pairwise(numbers), signs, strict=True)
        ]
        expression = margins[0] if len(margins) == 1 else minimum(*margins)
        nodes = list(iter_expressions(expression))
        limits = dict.fromkeys(node.value for node in nodes if isinstance(node, Number))
        terms = dict.fromkeys(term for node in nodes for term in _written_terms(node))
        return Comparison("sum", expression, tuple(terms), (*signs, *limits))

    def _number(self, written: ArgumentSyntax, scope: Scope) -> Expression:
        """Return the expression of a written number; 0 after a fault."""
        self.resolver.size += 1
        if self._is_constant(written, scope):
            return Number(self.resolver.number(written, scope))  # type: ignore[arg-type]
        match written:
            case Name():
                return self._signal(written, scope)
            case DistanceSyntax():
                terms = (self.resolver.term(term, scope) for term in (written.first, written.second))
                return SignedDistance(*terms)
            case RateSyntax():
                return self._rate(written, scope)
            case Call():
                return self._absolute(written, scope)
            case Arithmetic(operands=(operand,)):
                return -self._number(operand, scope)
            case Arithmetic(operator="+" | "-" as sign, operands=(left, right)):
                self._check_hyphen(written, scope)
                left_number, right_number = self._number(left, scope), self._number(right, scope)
                self._check_units(left_number, right_number, written, scope)
                return left_number + right_number if sign == "+" else left_number - right_number
            case Arithmetic():
                return self._multiple(written, scope)
        message, hint = "a formula, where a number is expected", "compare signals, distances or rates"
        if isinstance(written, DERIVED_TERMS):
            message, hint = "an object, where a number is expected", "a distance is written a dist b"
        self.resolver.fault(written.span, scope, message, hint)
        return Number(0.0)

    def _multiple(self, written: Arithmetic, scope: Scope) -> Expression:
        operand, factor = written.operands
        is_product = written.operator == "*"
        if is_product and self._is_constant(operand, scope):
            operand, factor = factor, operand
        if not self._is_constant(factor, scope):
            quantities = "a product of two signals" if is_product else "a quotient of two signals"
            self.resolver.fault(written.span, scope, f"{quantities}, distances or rates", _PLUGIN)
            return Number(0.0)
        factor_value, number = self.resolver.number(factor, scope), self._number(operand, scope)
        if any(self.resolver.is_unknown(name, scope) for name in names_in(factor)):
            return number
        if factor_value == 0.0:
            message = "a factor of 0" if is_product else "division by zero"
            self.resolver.fault(factor.span, scope, message, "leave the number out, or write another factor")
            return Number(0.0)
        # factors and divisors of expressions are positive, so a negative one becomes a negation
        magnitude = abs(factor_value)
        if isinstance(factor_value, NamedNumber):
            magnitude = NamedNumber(magnitude, factor_value.constants)
        multiple = Product(magnitude, number) if is_product else Scaled(number, magnitude)
        return multiple if factor_value > 0.0 else -multiple

    def _absolute(self, written: Call, scope: Scope) -> Expression:
        """Return `abs(x)` as the maximum of x and -x; report a fault for any other function."""
        name, arguments = written.name.text, written.arguments
        definition = self.resolver.names.definitions.get(name)
        if name == "abs" and len(arguments) == 1 and not isinstance(definition, DefStatement):
            operand = self._number(arguments[0], scope)
            return maximum(operand, -operand)
        message, hint = f"{name!r} is not a function", self._function_hint(written)
        if isinstance(definition, DefStatement):
            message, hint = f"{name!r} is a macro, so a formula, where a number is expected", ""
        elif name == "abs":
            message, hint = "'abs' takes one number", "write abs(x - y) <= c"
        self.resolver.fault(written.span, scope, message, hint)
        return Number(0.0)

    def _function_hint(self, written: Call) -> str:
        text = self.resolver.faults.source.text
        arguments = [text[argument.span.start : argument.span.end] for argument in written.arguments]
        return function_hint(written.name.text, f"({', '.join(arguments)})", arguments) or _PLUGIN

    def _rate(self, written: RateSyntax, scope: Scope) -> Expression:
        """Return `speed(a)`, `speed(a, b)` or `rate(signal)`."""
        arguments, function = written.arguments, written.function
        if function == "rate" and len(arguments) == 1 and isinstance(arguments[0], Name):
            return rate_of(self._signal(arguments[0], scope))
        if function == "rate" or not 1 <= len(arguments) <= 2:
            message, hint = "'rate' takes one signal", "write rate(battery) <= c"
            if function == "speed":
                message, hint = "'speed' takes one or two objects", "write speed(a) <= c or speed(a, b) <= c"
            self.resolver.fault(written.span, scope, message, hint)
            return Number(0.0)
        has_one_argument = len(arguments) == 1
        return speed_of(*(self._moving(argument, scope, is_alone=has_one_argument) for argument in arguments))

    def _moving(self, written: ArgumentSyntax, scope: Scope, *, is_alone: bool) -> Term:
        """Return an argument of `speed`; report a fault if it cannot move."""
        if not isinstance(written, (Name, *DERIVED_TERMS)):
            self.resolver.fault(written.span, scope, "a number has no speed", "write speed(a) or speed(a, b)")
            return TrackedName("")
        term = self.resolver.term(written, scope)
        if looks_back(term):
            hint = "leave out the [-n]"
            self.resolver.fault(written.span, scope, "a speed is from the report before to this one", hint)
        elif is_alone and isinstance(base_of(term), Group):
            hint = "write forall p in GROUP: speed(p) <= c"
            self.resolver.fault(written.span, scope, "a group has no speed of its own", hint)
        elif is_alone and isinstance(base_of(term), RegionName):
            hint = "write speed(a) for an object a, or speed(a, REGION)"
            self.resolver.fault(written.span, scope, "a region never moves", hint)
        return term

    def _signal(self, name: Name, scope: Scope) -> Signal:
        """Return a signal of the log or of a plug-in; report a fault if the name has another meaning."""
        plugin = self.resolver.names.signals.get(name.text)
        definition = self.resolver.names.definitions.get(name.text)
        if name.text in scope.values:
            message = f"{name.text!r} is a parameter or variable here; a signal of the log is expected"
            self.resolver.fault(name.span, scope, message)
        elif definition is not None and not isinstance(definition, BrokenStatement):
            message = f"{name.text!r} is {kind_of(definition)}; a signal of the log is expected"
            self.resolver.fault(name.span, scope, message, "if the log has it, rename the definition")
        return Signal(name.text) if plugin is None else ComputedSignal(name.text, plugin)

    def _is_constant(self, written: ArgumentSyntax, scope: Scope) -> bool:
        """Return whether an argument is a constant; parameters of unused macros are treated as constants."""
        match written:
            case NumberSyntax():
                return True
            case Name():
                value = scope.values.get(written.text)
                definition = self.resolver.names.definitions.get(written.text)
                is_broken = value is None and isinstance(definition, BrokenStatement)
                return isinstance(value, Anything) or is_broken or self.resolver.is_number(written, scope)
            case Arithmetic():
                return all(self._is_constant(operand, scope) for operand in written.operands)
        return False

    # --------------------------------------------------------------------------------------------- faults

    def _check_units(
        self, left: Expression, right: Expression, written: Arithmetic | ComparisonSyntax, scope: Scope
    ) -> None:
        """Report a sum of a distance and a speed, or a comparison of a distance with a speed."""
        dimensions = {dimension for dimension in (_kind(left), _kind(right)) if dimension}
        if len(dimensions) > 1:
            hint = "multiply one of them by a constant: a dist b >= 2 * speed(a)"
            self.resolver.fault(written.span, scope, "a distance and a speed have different units", hint)

    def _check_constant(self, limit: FormulaSyntax, quantity: FormulaSyntax, scope: Scope) -> None:
        """Report a limit that is probably a misspelt constant instead of a signal."""
        definitions = self.resolver.names.definitions
        if not isinstance(limit, Name) or limit.is_quoted or limit.text in {*definitions, *scope.values}:
            return
        constant_names = [name for name in definitions if isinstance(definitions[name], ConstStatement)]
        if isinstance(quantity, Name):
            # compared signals often have similar names, so only a difference in case is a misspelling
            constant_names = [name for name in constant_names if name.casefold() == limit.text.casefold()]
        if advice := self.resolver.faults.nearest(limit.text, constant_names):
            hint = f"{advice} A signal of that name is written in quotes: {quote_name(limit.text)}"
            self.resolver.fault(limit.span, scope, f"unknown constant {limit.text!r}", hint)

    def _check_hyphen(self, written: Arithmetic, scope: Scope) -> None:
        """Report `cup dist base-link`: probably an unquoted name, because a difference has blanks."""
        left, right = written.operands
        sign_span = Span(left.span.end, right.span.start)
        if sign_span.end - sign_span.start > 1 or written.operator != "-":
            return
        match left, right:
            case DistanceSyntax(second=Name() as first_part), Name() as last_part:
                name = f"{first_part.text}-{last_part.text}"
            case Name() as first_part, DistanceSyntax(first=Name() as last_part):
                name = f"{first_part.text}-{last_part.text}"
            case _:
                return
        hint = f"a name with - is written in quotes: {quote_name(name)}; a difference has blanks around its -"
        self.resolver.fault(sign_span, scope, "'-' within a name, or without blanks", hint)

    def _report_equality(self, written: ComparisonSyntax, scope: Scope) -> None:
        left_text, right_text = (
            self._source(operand) for operand in (written.operands[0], written.operands[-1])
        )
        is_sum = isinstance(written.operands[-1], Arithmetic)
        hint = f"write abs({left_text} - {f'({right_text})' if is_sum else right_text}) <= 0.01"
        match written.operands:
            case (Name(), Name() as name):
                definitions = self.resolver.names.definitions
                constant_names = [
                    constant for constant in definitions if isinstance(definitions[constant], ConstStatement)
                ]
                advice = self.resolver.faults.nearest(name.text, constant_names)
                hint = advice or f"{hint}; a text stands in quotes, {left_text} == {quote_name(name.text)}"
        (token, *_) = [token for token in written.operators if token.value in ("==", "!=")]
        self.resolver.fault(span_of(token), scope, "two measured numbers are hardly ever equal", hint)

    def _report_constants(self, written: ComparisonSyntax, scope: Scope) -> None:
        name_operands = [operand for operand in written.operands if isinstance(operand, Name)]
        if name_operands:
            self._signal(name_operands[0], scope)
        else:
            hint = "compare a signal, a distance or a rate"
            self.resolver.fault(written.span, scope, "two constants are compared", hint)

    def _source(self, written: ArgumentSyntax) -> str:
        return self.resolver.faults.source.text[written.span.start : written.span.end]


def _written_terms(expression: Expression) -> tuple[Term, ...]:
    """Return the terms of a distance or a speed; () for other expressions."""
    match expression:
        case Rate():
            return expression.terms
        case SignedDistance():
            return expression.first, expression.second
    return ()


def _kind(expression: Expression) -> str:
    """Return the dimension of a number: "length", "speed", or "" for constants and signals (either)."""
    match expression:
        case SignedDistance():
            return "length"
        case Rate(signal=None):
            return "speed"
        case Negative(operand):
            return _kind(operand)
        case Maximum(operands):
            return _kind(operands[0])
        case Sum(first, second):
            return _kind(first) or _kind(second)
    return ""


def _range_hint(lower_sign: str, upper_sign: str) -> str:
    if {"==", "!="} & {lower_sign, upper_sign}:
        return "write a dist b == c, or c1 <= a dist b <= c2"
    if lower_sign[0] == upper_sign[0]:
        return "write the lesser limit first: c1 <= a dist b <= c2"
    return "write it as c1 <= a dist b <= c2, or as two comparisons joined by and"
