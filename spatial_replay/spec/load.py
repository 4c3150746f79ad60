"""Specifications from texts and files: names resolved, macros and quantifiers expanded.

A quantifier over a named group is expanded to one formula for each member. Over an open group it stays one
node, because the members can differ in each sample.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import islice, permutations
from os import PathLike
from pathlib import Path, PurePath
from reprlib import repr as shortened
from typing import Any, get_args

from lark import Token

from spatial_replay.errors import MissingFileError, SpecificationError, UsageError
from spatial_replay.spec.checks import (
    equality_warnings,
    past_warnings,
    reach_warnings,
    scale_warnings,
    spelling_warnings,
    unused_warnings,
)
from spatial_replay.spec.comparisons import ComparisonBuilder
from spatial_replay.spec.constants import replace_constants
from spatial_replay.spec.diagnostics import Diagnostic, Faults, SourceText, Span, nearest_hint
from spatial_replay.spec.format import format_atom, format_duration, format_number, title_text
from spatial_replay.spec.formula import (
    Atom,
    Axis,
    Boolean,
    Constant,
    Earlier,
    Enlarged,
    Expression,
    Formula,
    Group,
    Measurement,
    NamedSpec,
    Quantified,
    RegionName,
    Specification,
    Temporal,
    Term,
    TrackedName,
    Truth,
    Variable,
    as_expression,
)
from spatial_replay.spec.parser import MAX_DEPTH, parse_statements
from spatial_replay.spec.relations import (
    DEFAULT_PROFILE,
    PROFILES,
    RELATION_NAMES,
    THREE_TERM_RELATIONS,
    Plugin,
    Relation,
    plugins_of,
    used_modules,
)
from spatial_replay.spec.resolve import MAX_SIZE, Anything, Namespace, Resolver, Scope, Value, kind_of
from spatial_replay.spec.syntax import (
    DERIVED_TERMS,
    ArgumentSyntax,
    Arithmetic,
    BooleanSyntax,
    BrokenStatement,
    Call,
    ComparisonSyntax,
    ConstStatement,
    DefStatement,
    DistanceSyntax,
    FormulaSyntax,
    Name,
    NumberSyntax,
    QuantifierSyntax,
    Quantity,
    RateSyntax,
    RelationSyntax,
    SpecStatement,
    Statement,
    TemporalSyntax,
    TruthSyntax,
    UseStatement,
)
from spatial_replay.spec.tokens import (
    MAX_TOKENS,
    SAMPLES,
    function_hint,
    is_reserved,
    quote_name,
    span_of,
    tokenize,
)
from spatial_replay.spec.walks import (
    base_of,
    divide_by_scale,
    is_centre,
    iter_expressions,
    iter_formulas,
    named_members,
    other_names,
    presence_of,
    substitute,
    terms_of,
)
from spatial_replay.text import encodable, named_arguments

_AXES: tuple[str, ...] = get_args(Axis)


def parameters_of(name: str, relation: Relation) -> tuple[inspect.Parameter, ...]:
    """Return a relation's parameters without its terms; a text has these parameters in square brackets.

    Raises:
        UsageError: the function has too few parameters, or a parameter that is not positional.
    """
    parameters = tuple(inspect.signature(relation).parameters.values())
    positional_kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    term_count = 3 if name in THREE_TERM_RELATIONS else 2
    if len(parameters) < term_count or any(
        parameter.kind not in positional_kinds for parameter in parameters
    ):
        hint = "give a function of two terms and, after them, numbers, all positional"
        raise UsageError(f"relations: {name!r} cannot be written between two objects; {hint}")
    return parameters[term_count:]


@dataclass(frozen=True, slots=True)
class AtomBuilder:
    """Builder of the atoms of one text in one profile."""

    relations: Mapping[str, Relation]
    names: frozenset[str]
    resolver: Resolver
    faults: Faults

    def relation(self, written: RelationSyntax, scope: Scope) -> Atom | None:
        """Return the atom of a relation; report a fault and return None if its parameters do not fit."""
        terms = tuple([self.resolver.term(term, scope) for term in written.terms])
        parameters = self._parameters(written, scope)
        if parameters is None:
            return None
        try:
            expression = as_expression(self.relations[written.relation](*terms, *parameters))
        except TypeError as error:
            raise UsageError(
                f"relations: {written.relation!r} does not return an expression: {error}"
            ) from error
        self._check(expression, written, scope)
        return self._atom(written.relation, expression, terms, parameters, written, scope)

    def comparison(self, written: ComparisonSyntax, scope: Scope) -> Atom:
        """Return the atom of a comparison."""
        return self._atom(*ComparisonBuilder(self.resolver).build(written, scope), written, scope)

    def presence(self, written: Call, scope: Scope) -> Formula:
        """Return the atom of `present(a)`; report a fault and return `true` if `a` is not one object."""
        if len(written.arguments) == 1 and isinstance(written.arguments[0], (Name, *DERIVED_TERMS)):
            term = self.resolver.term(written.arguments[0], scope)
            if isinstance(term, (TrackedName, Variable)):
                return self._atom("present", presence_of(term), (term,), (), written, scope)
        hint = "write present(a) for an object a, or forall p in GROUP: present(p)"
        self.resolver.fault(written.span, scope, "'present' takes one object of the log", hint)
        return Truth(True)

    def _atom(
        self,
        relation: str,
        expression: Expression,
        terms: tuple[Term, ...],
        parameters: tuple[float | str, ...],
        written: RelationSyntax | ComparisonSyntax | Call,
        scope: Scope,
    ) -> Atom:
        text = format_atom(relation, expression, terms, parameters, self.names)
        expression = divide_by_scale(expression, self.resolver.names.scales)
        span = scope.call or written.span
        return Atom(text, relation, expression, span=span, terms=terms, parameters=parameters)

    # ------------------------------------------------------------------------------------ parameters

    def _parameters(self, written: RelationSyntax, scope: Scope) -> tuple[float | str, ...] | None:
        expected_parameters = parameters_of(written.relation, self.relations[written.relation])
        quantities = written.parameters
        missing_parameters = expected_parameters[len(quantities) :]
        if len(quantities) > len(expected_parameters) or any(
            parameter.default is parameter.empty for parameter in missing_parameters
        ):
            self._report_parameters(written, expected_parameters, scope)
            return None
        arguments = [
            self._axis(quantity, scope) if parameter.name == "axis" else self.resolver.number(quantity, scope)
            for parameter, quantity in zip(expected_parameters, quantities, strict=False)
        ]
        arguments += [
            parameter.default if parameter.name == "axis" else float(parameter.default)
            for parameter in missing_parameters
        ]
        return tuple(arguments)

    def _report_parameters(
        self, written: RelationSyntax, parameters: tuple[inspect.Parameter, ...], scope: Scope
    ) -> None:
        name = written.relation
        bracket = ", ".join("x" if parameter.name == "axis" else parameter.name for parameter in parameters)
        if not parameters:
            self.resolver.fault(written.operator, scope, f"{name!r} takes no parameter", f"write a {name} b")
            return
        right_side = "(b, c)" if name == "between" else "b"
        kind = "an axis, x, y or z" if parameters[0].name == "axis" else "a number"
        hint = f"write a {name}[{bracket}] {right_side}, where {parameters[0].name} is {kind}"
        if len(parameters) == 1 and len(written.parameters) == 2:
            hint += "; decimals have a point: 0.1"
        mismatch = (
            f"{len(parameters)} parameter{'s' if len(parameters) > 1 else ''}, not {len(written.parameters)}"
        )
        self.resolver.fault(written.operator, scope, f"{name!r} takes {mismatch}", hint)

    def _axis(self, quantity: Quantity, scope: Scope) -> str:
        if isinstance(quantity, Name) and quantity.text in _AXES:
            return quantity.text
        self.resolver.fault(quantity.span, scope, "an axis is expected here", "write x, y or z")
        return "x"

    # ---------------------------------------------------------------------------------------- checks

    def _check(self, expression: Expression, written: RelationSyntax, scope: Scope) -> None:
        """Report terms without orientation in a relation that compares orientations, and negative radii."""
        for node in iter_expressions(expression):
            if isinstance(node, Measurement) and node.needs_orientation:
                for term in node.terms:
                    self._check_orientation(term, written, scope)
        for term in terms_of(expression):
            if isinstance(term, Enlarged) and term.radius < 0.0:
                message = f"{written.relation!r} with the negative radius {format_number(term.radius)}"
                self.resolver.fault(written.operator, scope, message, "write a number of at least 0")

    def _check_orientation(self, term: Term, written: RelationSyntax, scope: Scope) -> None:
        base = base_of(term)
        if is_centre(term) or isinstance(base, (RegionName, Group)):
            kind = "point" if is_centre(term) else "region" if isinstance(base, RegionName) else "group"
            message = f"{written.relation!r} needs an orientation, and a {kind} has none"
            self.resolver.fault(written.operator, scope, message, "compare single objects of the log")


@dataclass(frozen=True, slots=True)
class QuantifierBuilder:
    """Builder of the quantified formulas of one text.

    Attributes:
        words: all words of the text, which renamed variables avoid.
        elaborate: function that returns the formula of a body in a scope.
    """

    names: Namespace
    relations: Mapping[str, Relation]
    words: Collection[str]
    resolver: Resolver
    elaborate: Callable[[FormulaSyntax, Scope], Formula]

    def formula(self, written: QuantifierSyntax, scope: Scope, span: Span) -> Formula:
        """Return the formula of a quantifier; `true` if it has faults."""
        repetition = first_repetition(written.variables)
        if repetition is not None:
            self.resolver.fault(repetition.span, scope, f"the variable {repetition.text!r} is given twice")
        group = self.resolver.term(written.group, scope)
        base = base_of(group)
        if isinstance(base, Group) and base.is_open and isinstance(group, (Group, Earlier)):
            return self._open_quantifier(written, group, scope, span)
        if isinstance(group, Group):
            return self._named_quantifier(written, group, scope, span)
        if isinstance(base, Group):
            hint = "quantify over the group, and write the delay or enlarge in the body"
            message = f"{written.quantifier} runs over the members of a group, whose names never change"
            self.resolver.fault(written.group.span, scope, message, hint)
        elif not self.resolver.is_unknown(written.group, scope):
            hint = 'define it: group NAME = a, b, or group NAME = class "name"'
            message = f"{written.quantifier} runs over a group, and this is not one"
            self.resolver.fault(written.group.span, scope, message, hint)
        self._body_of_any(written, scope)
        return Truth(True)

    def _body_of_any(self, written: QuantifierSyntax, scope: Scope) -> None:
        """Report the faults of a body if the quantifier has no members to expand over."""
        values = dict(scope.values) | {name.text: TrackedName(name.text) for name in written.variables}
        self.elaborate(written.body, replace(scope.deeper(), values=values))

    def _named_quantifier(self, written: QuantifierSyntax, group: Group, scope: Scope, span: Span) -> Formula:
        if any(isinstance(member, Variable) for member in group.excluded):
            message = "which members are left out is known only once the variable has a value"
            hint = "quantify over a class or all, or define the group without that member"
            self.resolver.fault(written.group.span, scope, message, hint)
        members = [TrackedName(name) for name in named_members(group)]
        # permutations grow factorially; more than MAX_SIZE of them exceed the limit of a text anyway
        member_tuples = list(islice(permutations(members, len(written.variables)), MAX_SIZE))
        if not member_tuples:
            self._body_of_any(written, scope)
            return Truth(written.quantifier == "forall", span=span)
        body_scope = scope.deeper()
        instances: list[Formula] = []
        for member_tuple in member_tuples:
            bindings = dict(zip((name.text for name in written.variables), member_tuple, strict=True))
            instances.append(
                self.elaborate(written.body, replace(body_scope, values={**scope.values, **bindings}))
            )
        # `and` and `or` have at least two operands
        if len(instances) == 1:
            return instances[0]
        return Boolean("and" if written.quantifier == "forall" else "or", tuple(instances), span=span)

    def _open_quantifier(
        self, written: QuantifierSyntax, group: Group | Earlier, scope: Scope, span: Span
    ) -> Formula:
        variables: list[str] = []
        for name in written.variables:
            bound_names = scope.bound.union(variables)
            variables.append(self._fresh(name.text, bound_names) if name.text in bound_names else name.text)
        bindings: dict[str, Value] = {
            name.text: Variable(variable) for name, variable in zip(written.variables, variables, strict=True)
        }
        body_scope = replace(
            scope.deeper(), values={**scope.values, **bindings}, bound=scope.bound.union(variables)
        )
        body = self.elaborate(written.body, body_scope)
        temporal = next(
            (subformula for subformula in iter_formulas(body) if isinstance(subformula, Temporal)), None
        )
        if temporal is not None:
            message = f"{temporal.operator!r} inside {written.quantifier} over an open group"
            hint = "its members change from sample to sample; use a template: spec name(object) = ..."
            self.resolver.fault(temporal.span, scope, message, hint)
        quantified = Quantified(written.quantifier, tuple(variables), group, body, span=span)
        return self._without_clash(quantified, scope)

    def _without_clash(self, quantified: Quantified, scope: Scope) -> Quantified:
        """Rename variables that have the name of an object, region, group or definition."""
        # the canonical text does not distinguish a variable from an object of the same name
        body_names = other_names(quantified.body)
        new_names = {
            variable: self._fresh(variable, scope.bound | body_names)
            for variable in quantified.variables
            if variable in body_names or variable in self.names.definitions
        }
        if not new_names:
            return quantified
        new_variables = {old: Variable(new) for old, new in new_names.items()}
        body = substitute(quantified.body, new_variables, frozenset(self.relations))
        variables = tuple(new_names.get(variable, variable) for variable in quantified.variables)
        return replace(quantified, variables=variables, body=body)

    def _fresh(self, name: str, used_names: Collection[str]) -> str:
        suffix = 2
        while f"{name}_{suffix}" in used_names or f"{name}_{suffix}" in self.words:
            suffix += 1
        return f"{name}_{suffix}"


def first_repetition(names: Sequence[Name]) -> Name | None:
    """Return the first name that repeats an earlier name; None if all names are distinct."""
    texts: set[str] = set()
    for name in names:
        if name.text in texts:
            return name
        texts.add(name.text)
    return None


def _split_title(text: str | None) -> tuple[str | None, str | None]:
    """Return the requirement id and the title of "ID: TITLE"; an id has no blanks."""
    if text is None:
        return None, None
    identifier, _, title = text.partition(": ")
    if not title or not identifier or any(character.isspace() for character in identifier):
        return None, text
    return identifier, title.strip()


_UNBOUNDED = frozenset({"X", "WX", "Y"})
"""Temporal operators without windows."""


class TooLargeError(Exception):
    """An expansion exceeds its limit; the fault is already reported."""


@dataclass(frozen=True, slots=True)
class _Known:
    """Elaborated spec; its size and depth are added again for each reference to it."""

    spec: NamedSpec
    order: int
    size: int
    depth: int


@dataclass(slots=True)
class Elaborator:
    """Elaborator of the statements of one text.

    Attributes:
        words: all words of the text, which renamed variables avoid.
        known: elaborated specs by name.
        referred: names of specs that other specs use.
        deepest: greatest depth of a node in the current spec.
        shared: total size of the specs that the current spec uses.
    """

    names: Namespace
    relations: Mapping[str, Relation]
    words: Collection[str]
    faults: Faults
    resolver: Resolver = field(init=False)
    atoms: AtomBuilder = field(init=False)
    quantifiers: QuantifierBuilder = field(init=False)
    known: dict[str, _Known] = field(default_factory=dict)
    referred: set[str] = field(default_factory=set)
    deepest: int = 0
    shared: int = 0

    def __post_init__(self) -> None:
        self.resolver = Resolver(self.names, self.faults)
        relation_names = frozenset(self.relations)
        self.atoms = AtomBuilder(self.relations, relation_names, self.resolver, self.faults)
        self.quantifiers = QuantifierBuilder(
            self.names, self.relations, self.words, self.resolver, self.formula
        )

    # ----------------------------------------------------------------------------------------- specs

    def specs(self, statements: Sequence[SpecStatement]) -> tuple[NamedSpec, ...]:
        """Return all specs in text order.

        Raises:
            TooLargeError: the text expands to more than `MAX_SIZE` nodes.
        """
        for spec_index, statement in enumerate(statements):
            if self.names.definitions.get(statement.name.text) is statement:
                self._spec(statement, spec_index)
        for definition in self.names.definitions.values():
            if isinstance(definition, DefStatement):
                self._check_macro(definition)
        specs = [entry.spec for entry in self.known.values()]
        # the size of a spec includes the sizes of the specs that it uses
        total_size = sum(entry.size for name, entry in self.known.items() if name not in self.referred)
        if total_size > MAX_SIZE:
            self._too_large(statements[-1].name.span)
        return tuple(replace(spec, is_result=spec.name not in self.referred) for spec in specs)

    def _spec(self, statement: SpecStatement, spec_index: int) -> None:
        name = statement.name.text
        parameter = self._template_parameter(statement)
        scope = Scope(order=spec_index)
        if parameter is not None:
            values: dict[str, Value] = {parameter: Variable(parameter)}
            scope = Scope(values, bound=frozenset(values), order=spec_index)
        size_before, self.deepest, self.shared = self.resolver.size, 0, 0
        formula = self.formula(statement.formula, scope)
        if parameter is not None:
            self._check_capture(statement, formula)
        # a node has one name, so a second name needs a node of its own
        if formula.name is not None:
            formula = Boolean("spec", (formula,), span=statement.formula.span)
            self.deepest += 1
        formula = replace(formula, name=name)
        requirement_id, title = _split_title(statement.title)
        span = statement.name.span
        spec = NamedSpec(name, formula, parameter, span=span, id=requirement_id, title=title)
        size = self.resolver.size - size_before + self.shared
        self.known[name] = _Known(spec, spec_index, size, self.deepest)

    def _template_parameter(self, statement: SpecStatement) -> str | None:
        if not statement.parameters:
            return None
        parameter, *extra_parameters = statement.parameters
        if extra_parameters:
            message = f"the template {statement.name.text!r} has more than one parameter"
            self.faults.add(
                extra_parameters[0].span, message, "a template is evaluated per object; use def for macros"
            )
        definition = self.names.definitions.get(parameter.text)
        if definition is not None:
            message = f"{parameter.text!r} is already the name of {kind_of(definition)}"
            self.faults.add(parameter.span, message, "give the parameter another name")
        return parameter.text

    def _check_capture(self, statement: SpecStatement, formula: Formula) -> None:
        parameter = statement.parameters[0]
        if parameter.text in other_names(formula):
            message = f"{parameter.text!r} is the template's parameter, and an object in something it uses"
            self.faults.add(parameter.span, message, "give the parameter another name")

    def _check_macro(self, definition: DefStatement) -> None:
        """Report repeated parameters of a macro, and the faults of its body if the macro is unused."""
        repetition = first_repetition(definition.parameters)
        if repetition is not None:
            self.faults.add(repetition.span, f"the parameter {repetition.text!r} is given twice")
        if definition.name.text not in self.names.used:
            values: dict[str, Value] = {parameter.text: Anything() for parameter in definition.parameters}
            scope = Scope(values, macros=(definition.name.text,), order=len(self.known))
            self.formula(definition.body, scope)

    # -------------------------------------------------------------------------------------- formulas

    def formula(self, written: FormulaSyntax, scope: Scope) -> Formula:
        """Return the formula of a syntax node; `true` if it has faults."""
        span = scope.call or written.span
        self._count(span, scope)
        match written:
            case TruthSyntax():
                return Truth(written.value, span=span)
            case Name():
                return self._reference(written, scope)
            case Call():
                return self._call(written, scope)
            case RelationSyntax():
                return self.atoms.relation(written, scope) or Truth(True)
            case NumberSyntax() | Arithmetic() | DistanceSyntax() | RateSyntax():
                self._report_number(written, scope)
                return Truth(True)
            case ComparisonSyntax():
                return self.atoms.comparison(written, scope)
            case BooleanSyntax(operator="->", operands=[left, NumberSyntax() as right]):
                operator_span = Span(left.span.end, right.span.start)
                self.resolver.fault(operator_span, scope, "'=>' means implies", "at least is written >=")
                return Truth(True)
            case BooleanSyntax():
                operand_scope = scope.deeper()
                operands = tuple([self.formula(operand, operand_scope) for operand in written.operands])
                return Boolean(written.operator, operands, span=span)
            case TemporalSyntax():
                return self._temporal(written, scope, span)
            case QuantifierSyntax():
                return self.quantifiers.formula(written, scope, span)

    def _report_number(self, written: FormulaSyntax, scope: Scope) -> None:
        text = self.faults.source.text[written.span.start : written.span.end]
        hint = f"compare it with a number: {text} <= 1"
        self.resolver.fault(written.span, scope, "a number, where a formula is expected", hint)

    def _count(self, span: Span, scope: Scope) -> None:
        self.resolver.size += 1
        if self.resolver.size + self.shared > MAX_SIZE:
            self._too_large(span)
        self._reach(scope.depth, span)

    def _reach(self, depth: int, span: Span) -> None:
        self.deepest = max(self.deepest, depth)
        if depth > MAX_DEPTH:
            message = f"more than {MAX_DEPTH} operators within one another, counting what names refer to"
            self.faults.add(span, message, "nest specs and macros less deeply")
            raise TooLargeError

    def _too_large(self, span: Span) -> None:
        message = f"with macros, quantifiers and names written out, this text has more than {MAX_SIZE} parts"
        self.faults.add(span, message, "use smaller groups, or an open group (class or all)")
        raise TooLargeError

    def _temporal(self, written: TemporalSyntax, scope: Scope, span: Span) -> Formula:
        if written.operator in _UNBOUNDED and written.bound is not None:
            hint = f"F and G take windows; {written.operator} means one sample"
            self.resolver.fault(written.bound.span, scope, f"{written.operator!r} takes no window", hint)
        bound = self.resolver.bound(written, scope)
        operand_scope = scope.deeper()
        operands = tuple([self.formula(operand, operand_scope) for operand in written.operands])
        return Temporal(written.operator, operands, bound, span=span)  # type: ignore[arg-type]

    # -------------------------------------------------------------------------------- names and calls

    def _reference(self, name: Name, scope: Scope) -> Formula:
        if name.text in scope.values:
            message = f"{name.text!r} is an object or number; a formula is expected here"
            self.resolver.fault(name.span, scope, message, f"write a relation, such as {name.text} ovlp b")
            return Truth(True)
        definition = self.names.definitions.get(name.text)
        entry = self.known.get(name.text)
        if entry is not None and entry.order < scope.order and entry.spec.parameter is None:
            self.names.used.add(name.text)
            self.referred.add(name.text)
            self.shared += entry.size
            self._reach(scope.depth + entry.depth, name.span)
            return entry.spec.formula
        if not isinstance(definition, BrokenStatement):
            self._report_reference(name, entry, scope)
        return Truth(True)

    def _report_reference(self, name: Name, entry: _Known | None, scope: Scope) -> None:
        definition = self.names.definitions.get(name.text)
        if entry is not None and entry.spec.parameter is not None:
            hint = "a template is evaluated for each object by itself; share formulas by def"
            self.resolver.fault(name.span, scope, f"{name.text!r} is a template, not a formula", hint)
        elif isinstance(definition, SpecStatement):
            hint = "a spec may name those above it; move it down"
            self.resolver.fault(name.span, scope, f"{name.text!r} is not defined before this place", hint)
        elif isinstance(definition, DefStatement):
            arguments = ", ".join(parameter.text for parameter in definition.parameters)
            hint = f"write {name.text}({arguments})"
            self.resolver.fault(name.span, scope, f"{name.text!r} is a macro, and needs its arguments", hint)
        elif definition is not None:
            message = f"{name.text!r} is {kind_of(definition)}; a formula is expected here"
            self.resolver.fault(name.span, scope, message, f"write a relation, such as a ovlp {name.text}")
        else:
            hint = self.faults.nearest(name.text, self._formula_names())
            if name.text.lower() in ("true", "false"):
                hint = f"truth values are written {name.text.lower()}"
            elif name.text.lower() in SAMPLES:
                hint = f"it is written {SAMPLES[name.text.lower()]}"
            name_text = name.text if name.text.isidentifier() else quote_name(name.text)
            hint = hint or (
                f"a signal needs a comparison, such as {name_text} >= 1.0 or, for a flag, {name_text} == 1; "
                f"an object needs a relation, such as {name_text} ovlp other"
            )
            self.resolver.fault(name.span, scope, f"no spec is named {name.text!r}", hint)

    def _formula_names(self) -> Iterator[str]:
        kinds = (SpecStatement, DefStatement)
        return (name for name, statement in self.names.definitions.items() if isinstance(statement, kinds))

    def _call(self, written: Call, scope: Scope) -> Formula:
        name = written.name.text
        definition = self.names.definitions.get(name)
        if isinstance(definition, BrokenStatement):
            return Truth(True)
        if name == "present" and not isinstance(definition, DefStatement | SpecStatement):
            return self.atoms.presence(written, scope)
        if not isinstance(definition, DefStatement):
            self._report_call(written, scope)
            return Truth(True)
        self.names.used.add(name)
        if name in scope.macros:
            message = f"def {name!r} is defined in terms of itself"
            self.faults.add(written.span, message, "a macro is written out where it is used, so it must end")
            return Truth(True)
        if len(written.arguments) != len(definition.parameters):
            parameter_names = ", ".join(parameter.text for parameter in definition.parameters)
            mismatch = (
                f"{len(definition.parameters)} arguments ({parameter_names}), not {len(written.arguments)}"
            )
            self.resolver.fault(written.span, scope, f"{name!r} takes {mismatch}")
            return Truth(True)
        values = {
            parameter.text: self._argument(argument, scope)
            for parameter, argument in zip(definition.parameters, written.arguments, strict=True)
        }
        call_span = scope.call or written.span
        body_scope = replace(
            scope, values=values, call=call_span, macros=(*scope.macros, name), depth=scope.depth + 1
        )
        return self.formula(definition.body, body_scope)

    def _report_call(self, written: Call, scope: Scope) -> None:
        name = written.name.text
        definition = self.names.definitions.get(name)
        if isinstance(definition, SpecStatement) and definition.parameters:
            hint = "a template is evaluated for each object by itself; share formulas by def"
            self.resolver.fault(written.name.span, scope, f"{name!r} is a template, not a macro", hint)
            return
        macro_names = (
            macro_name
            for macro_name, statement in self.names.definitions.items()
            if isinstance(statement, DefStatement)
        )
        arguments = written.arguments
        text = self.faults.source.text
        argument_text = f"({text[arguments[0].span.start : arguments[-1].span.end] if arguments else 'p'})"
        hint = (
            self.faults.nearest(name, macro_names)
            or function_hint(name, argument_text)
            or "define it with def"
        )
        self.resolver.fault(written.name.span, scope, f"no macro is named {name!r}", hint)

    def _argument(self, written: ArgumentSyntax, scope: Scope) -> Value:
        if isinstance(written, (NumberSyntax, Arithmetic)):
            return self.resolver.quantity(written, scope)
        if not isinstance(written, (Name, *DERIVED_TERMS)):
            hint = "a macro takes objects and numbers"
            self.resolver.fault(written.span, scope, "a formula in the place of an object", hint)
            return Anything()
        if isinstance(written, Name):
            value = scope.values.get(written.text)
            if value is not None:
                return value
            constant = self.names.with_constant_name(written.text, self.names.constant(written.text))
            if constant is not None:
                self.names.used.add(written.text)
                return constant
        return self.resolver.term(written, scope)


MAX_LENGTH = 256 * 1024
"""Maximum number of characters of a text."""

_MAX_WARNINGS = 100
_RELATION_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


@named_arguments
def parse_specification(
    text: str,
    *,
    filename: str = "<text>",
    profile: str | None = None,
    relations: Mapping[str, Callable[..., Expression]] | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> Specification:
    """Parse a specification or a single formula.

    Args:
        text: statements, or one formula, which becomes a spec named "spec".
        filename: name of the text in messages.
        profile: relation profile of a text without a `use` line: "paper" (the default) or "spatial_spec".
        relations: functions of further relations by name (see module `relations`).
        constants: new values of `const` lines by name: numbers, or durations as texts such as "2s".
            `Specification.source` is the text with these values, otherwise unchanged.

    Raises:
        SpecificationError: the text has faults; the error lists them.
        UsageError: not a text, an unknown profile, a relation whose parameters are not terms and numbers, an
            unknown constant, a number for a duration or the reverse.
    """
    _require_text(text)
    plugins = plugins_of(text)
    custom_relations = {
        name: relation for plugin in plugins.values() for name, relation in plugin.relations.items()
    }
    custom_relations |= relations or {}
    _check_relations(custom_relations)
    if profile is not None and profile not in PROFILES:
        raise UsageError(f"unknown profile {profile!r}; the profiles are {', '.join(PROFILES)}")
    # some editors write a byte order mark, which is not a part of the text
    text = text.removeprefix("\ufeff")
    relation_names = RELATION_NAMES.union(custom_relations)
    if constants:
        text = _constant_writer(text, filename, relation_names)(constants)
    faults = Faults(SourceText.of(text, filename))
    for name, offsets in used_modules(text).items():
        # a name that is similar to a profile is reported as a misspelt profile later
        if name not in plugins and not nearest_hint(name, PROFILES):
            message = f"{name!r} is neither a profile ({', '.join(PROFILES)}) nor an allowed plug-in"
            hint = (
                f'if you trust the module: plugins = ["{name}"] in pyproject.toml, under'
                f" [tool.spatial-replay]; or --plugin {name} of check, replay and batch"
            )
            faults.add(Span(*offsets), message, hint)
    faults.raise_if_any()
    tokens = _tokens(text, relation_names, faults)
    statements = parse_statements(tokens, relation_names, faults)
    used_profile = _profile(statements, plugins, faults) or profile or DEFAULT_PROFILE
    words = frozenset(token.value for token in tokens)
    namespace = Namespace(
        faults, {name: plugin.place for plugin in plugins.values() for name in plugin.signals}
    )
    namespace.declare(statements)
    constants_with_ranges = namespace.constant_ranges()
    elaborator = Elaborator(namespace, {**PROFILES[used_profile], **custom_relations}, words, faults)
    spec_statements = [statement for statement in statements if isinstance(statement, SpecStatement)]
    if not spec_statements and not any(isinstance(statement, BrokenStatement) for statement in statements):
        end_span = Span(len(text), len(text))
        if not faults.found:
            hint = "write a formula, or: spec name = formula"
            if text.lstrip().startswith("#") and any(sign in text for sign in "<>="):
                hint += "; # begins a comment, and a plug-in counts objects"
            faults.add(end_span, "this text holds no spec", hint)
    try:
        elaborated_specs = elaborator.specs(spec_statements)
    except TooLargeError:
        elaborated_specs = ()
    faults.raise_if_any()
    warnings: list[Diagnostic] = [
        *reach_warnings(tokens, faults.source, used_profile == "spatial_spec"),
        *spelling_warnings(tokens, faults.source),
        *past_warnings(elaborated_specs, faults.source),
        *equality_warnings(elaborated_specs, faults.source),
        *unused_warnings(namespace, faults.source),
        *scale_warnings(statements, elaborated_specs, faults.source),
    ]
    warnings.sort(key=lambda warning: (warning.line, warning.column))
    return Specification(
        elaborated_specs,
        used_profile,
        namespace.regions,
        namespace.groups,
        frozenset(custom_relations),
        {
            name: plugin.sha256
            for name, plugin in plugins.items()
            if name in used_modules(text) or not words.isdisjoint({*plugin.relations, *plugin.signals})
        },
        constants_with_ranges,
        scales=tuple(namespace.scales),
        source=text,
        filename=encodable(filename),
        warnings=tuple(warnings[:_MAX_WARNINGS]),
    )


_FILE = re.compile(r"[^\s\"]+\.spatial")
_LOG_ENDINGS = frozenset({".mcap", ".bag", ".db3", ".jsonl", ".csv", ".gz"})


@named_arguments
def load_specification(
    path: str | Path,
    *,
    profile: str | None = None,
    relations: Mapping[str, Callable[..., Expression]] | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> Specification:
    """Parse a specification file (UTF-8); see `parse_specification`.

    Raises:
        MissingFileError: the file is missing or cannot be read.
        SpecificationError: the text has faults; the error lists them.
        UsageError: `path` is a log, a YAML file, a formula or no path; or an argument is invalid (see
            `parse_specification`).
    """
    _require_path(path)
    path = Path(path)
    if path.suffix in (".yaml", ".yml"):
        raise UsageError(
            f"{path.name} is YAML, not a specification; give a mapping by --mapping, a tags file by --tags"
        )
    if path.suffix in _LOG_ENDINGS:
        raise UsageError(f"{path.name} is a log, not a specification; give a log before --spec")
    if is_formula(path):
        raise UsageError(f"{shortened(str(path))} is a formula; parse_specification(text) takes it")
    try:
        with path.open("rb") as file:
            # a UTF-8 character has at most 4 bytes (RFC 3629), so a text that is cut here is too long anyway
            content = file.read(4 * MAX_LENGTH + 4)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from error
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        decoded_text = content[: error.start].decode("utf-8")
        source = SourceText.of(decoded_text + "\ufffd", path.name)
        message = f"byte 0x{content[error.start]:02x} is not UTF-8 text"
        hint = "save the file as UTF-8"
        span = Span(len(decoded_text), len(decoded_text) + 1)
        raise SpecificationError([source.diagnostic("error", span, message, hint)]) from error
    return parse_specification(
        text, filename=path.name, profile=profile, relations=relations, constants=constants
    )


def require_specification(value: object) -> None:
    """Raise an error if a value is not a specification.

    Raises:
        UsageError: the value has another type.
    """
    if not isinstance(value, Specification):
        remedy = "give a Specification, from parse_specification(text) or load_specification(path)"
        raise UsageError(f"specification is {shortened(value)}; {remedy}")


def listed_specifications(value: object) -> list[Specification]:
    """Return one or several specifications as a list.

    Raises:
        UsageError: a value of another type, such as the path of a file.
    """
    is_several = isinstance(value, Iterable) and not isinstance(value, (str, bytes))
    specifications: list[Any] = list(value) if is_several else [value]  # type: ignore[call-overload]
    for specification in specifications:
        require_specification(specification)
    return specifications


def _require_text(value: object) -> None:
    # a text that looks like a file name is a path that was meant for load_specification
    if not isinstance(value, str) or _FILE.fullmatch(value):
        remedy = "give the text as a str; load_specification(path) reads a file"
        raise UsageError(f"text is {shortened(value)}; {remedy}")


def _require_path(value: object) -> None:
    if not isinstance(value, (str, PathLike)):
        remedy = "give the path of a file; parse_specification(text) takes a text"
        raise UsageError(f"path is {shortened(value)}; {remedy}")


def _check_relations(relations: Mapping[str, Relation]) -> None:
    for name, relation in relations.items():
        if not isinstance(name, str) or not _RELATION_NAME.match(name):
            raise UsageError(f"relations: {name!r} is not a name; use letters, digits and _")
        if is_reserved(name, RELATION_NAMES):
            raise UsageError(f"relations: {name!r} is already part of the language; choose another name")
        if not callable(relation):
            raise UsageError(f"relations: {name!r} is {relation!r}; give a function")
        parameters_of(name, relation)


def constant_writer(specification: Specification) -> Callable[[Mapping[str, float | str]], str]:
    """Return a function from values of constants to the text of a specification with these values.

    For many values, this is faster than `parse_specification` with `constants`, which parses each text.
    """
    relation_names = RELATION_NAMES | specification.relations
    return _constant_writer(specification.source, specification.filename, relation_names)


# viewers change the constants of the same text repeatedly
@lru_cache(maxsize=16)
def _constant_writer(
    text: str, filename: str, relation_names: frozenset[str]
) -> Callable[[Mapping[str, float | str]], str]:
    faults = Faults(SourceText.of(text, filename))
    namespace = Namespace(faults)
    namespace.declare(parse_statements(_tokens(text, relation_names, faults), relation_names, faults))
    faults.raise_if_any()
    const_statements = {
        name: statement
        for name, statement in namespace.definitions.items()
        if isinstance(statement, ConstStatement)
    }
    return partial(replace_constants, text, const_statements, namespace.constants)


def _tokens(text: str, relation_names: frozenset[str], faults: Faults) -> list[Token]:
    if len(text) > MAX_LENGTH:
        message = f"the text has {len(text)} characters, more than {MAX_LENGTH}"
        faults.add(Span(0, 1), message, "split it into several files")
        faults.raise_if_any()
    tokens = tokenize(text, relation_names, faults)
    if len(tokens) == MAX_TOKENS:
        faults.raise_if_any()
    return tokens


def _profile(statements: Sequence[Statement], plugins: Mapping[str, Plugin], faults: Faults) -> str | None:
    uses = [statement for statement in statements if isinstance(statement, UseStatement)]
    uses = [use for use in uses if use.name.text not in plugins]
    for statement in uses[1:]:
        faults.add(statement.name.span, "a second use line", "a text has one relation profile")
    if not uses:
        return None
    name = uses[0].name
    if name.text in PROFILES:
        return name.text
    hint = nearest_hint(name.text, PROFILES) or f"the profiles are {', '.join(PROFILES)}"
    faults.add(name.span, f"unknown profile {name.text!r}", hint)
    return None


_FORMULA = re.compile(
    r"[(<>=]|\S [a-z]+(\[.*\])? \S|^(true|false)$|^(!|not |always |eventually |([FGXYOH]|WX)(\[.*\])? )"
)
"""Parts of a formula that are rare in file names: signs, a word between two words, an operator."""
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?", re.ASCII)


def constants_from_texts(texts: Iterable[str]) -> dict[str, float | str]:
    """Read values of constants from a command line: `near=80`, `hold=2s`.

    Returns:
        A value by name: a number, or a duration as a text.

    Raises:
        UsageError: a text is not `NAME=VALUE`, or a name occurs twice.
    """
    constants: dict[str, float | str] = {}
    for text in texts:
        name, equals_sign, value = (part.strip() for part in text.partition("="))
        if not (equals_sign and name and value):
            raise UsageError(f"{text!r} is incomplete; write NAME=VALUE, such as near=80 or hold=2s")
        if name in constants:
            raise UsageError(f"{name!r} is given twice; give one value")
        constants[name] = float(value) if _NUMBER.fullmatch(value) else value
    return constants


@dataclass(frozen=True, slots=True)
class SpecificationText:
    """Text of a specification with the name of its file."""

    text: str
    filename: str


def load_specifications(
    sources: Sequence[Path | SpecificationText],
    *,
    constants: Mapping[str, float | str] | None = None,
) -> list[Specification]:
    """Parse several files or texts, with new values for their constants.

    Args:
        constants: values by name; `NAME` applies to all files with that constant, `STEM.NAME` only to the
            file with that stem.

    Raises:
        MissingFileError: a file cannot be read.
        SpecificationError: a specification has faults.
        UsageError: a constant that no file has, or a number for a duration or the reverse.
    """
    specifications = [_parse(source, {}) for source in sources]
    if not constants:
        return specifications
    _check_names(specifications, constants)
    values_by_file = [_own_constants(specification, constants) for specification in specifications]
    return [
        _with_titles(_parse(source, values), specification, values) if values else specification
        for source, specification, values in zip(sources, specifications, values_by_file, strict=True)
    ]


def _with_titles(
    changed: Specification, written: Specification, values: Mapping[str, float | str]
) -> Specification:
    """Return a specification whose titles list the changed values of constants.

    A title such as "keep 30 cm from people" may otherwise contain an outdated number.

    Args:
        changed: specification with the new values.
        written: specification with the values of its text.
        values: new values of constants by name.
    """
    written_formulas = {spec.name: spec.formula for spec in written.specs}
    new_and_old = {name: (changed.constants[name], written.constants[name]) for name in values}
    overrides = [
        f"{name} = {_constant_text(new)} instead of {_constant_text(old)}"
        for name, (new, old) in new_and_old.items()
        if new != old
    ]
    text = changed.source
    faults = Faults(SourceText.of(text, changed.filename))
    tokens = tokenize(text, RELATION_NAMES | changed.relations, faults)
    # specs are changed backwards, so that the offsets of earlier titles stay valid
    for spec in sorted(changed.specs, key=lambda spec: spec.span.start, reverse=True):
        if spec.title is None or spec.formula == written_formulas[spec.name]:
            continue
        title_span = next(
            span_of(token)
            for token in tokens
            if token.type == "TITLE" and span_of(token).start >= spec.span.end
        )
        new_title = quote_name(f"{title_text(spec)} ({', '.join(overrides)})")
        text = f"{text[: title_span.start]}{new_title}{text[title_span.end :]}"
    return _parse(SpecificationText(text, changed.filename), {})


def _constant_text(constant: Constant) -> str:
    if constant.duration_ns is None:
        return format_number(constant.value)
    return format_duration(constant.duration_ns)


def is_formula(source: Path) -> bool:
    """Return whether the argument for a file is a formula."""
    text = str(source)
    return bool(_FORMULA.search(text)) and not text.endswith(".spatial") and not source.exists()


def _parse(source: Path | SpecificationText, constants: Mapping[str, float | str]) -> Specification:
    if isinstance(source, SpecificationText):
        return parse_specification(source.text, filename=source.filename, constants=constants)
    if is_formula(source):
        return parse_specification(str(source), filename="<formula>", constants=constants)
    return load_specification(source, constants=constants)


def _qualify(specification: Specification, constant: str) -> str:
    return f"{PurePath(specification.filename).stem}.{constant}"


def _own_constants(
    specification: Specification, constants: Mapping[str, float | str]
) -> dict[str, float | str]:
    """Return the new values of one file's constants by name, without the stem."""
    return {
        constant_name: constants[given_name]
        for constant_name in specification.constants
        for given_name in (constant_name, _qualify(specification, constant_name))
        if given_name in constants
    }


def _check_names(specifications: Sequence[Specification], constants: Mapping[str, float | str]) -> None:
    """Raise an error for a constant that no file has."""
    constant_names = dict.fromkeys(
        name for specification in specifications for name in specification.constants
    )
    accepted_names = {
        *constant_names,
        *(
            _qualify(specification, name)
            for specification in specifications
            for name in specification.constants
        ),
    }
    for name in constants:
        if name not in accepted_names:
            hint = (
                nearest_hint(name, accepted_names)
                or f"the constants are: {', '.join(constant_names) or 'none'}"
            )
            raise UsageError(f"there is no constant {name!r}; {hint}")
