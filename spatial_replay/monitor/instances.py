"""The instances to evaluate: one per spec, and one per object for a template."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.monitor.atoms.terms import Bindings
from spatial_replay.monitor.online.program import Program, compile_formula
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, TrackedName
from spatial_replay.trace.trace import ABSENT, Trace, window_of


@dataclass(frozen=True, eq=False)
class Instance:
    """One formula to evaluate.

    Attributes:
        spec: the statement that it comes from.
        object: the object that the template's parameter stands for, or None.
        bindings: that object by the parameter's name.
        start_ns, end_ns: it is evaluated over the samples from start to before end.
        named: the specs of its file by name, of which some are parts of the formula.
    """

    spec: NamedSpec
    object: str | None
    program: Program
    bindings: Bindings
    start_ns: int
    end_ns: int
    named: Mapping[str, NamedSpec] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def formula(self) -> Formula:
        return self.spec.formula


@dataclass(frozen=True, slots=True)
class Choice:
    """The objects that a template's parameter stands for: all, those of a class, or one by its name.

    Attributes:
        class_name: the class, in any case; None for objects of any.
        name: of the one object; None for objects of any.
    """

    class_name: str | None
    name: str | None = None

    @classmethod
    def parse(cls, parameter: str, text: str) -> Choice:
        """Read `all`, `class:NAME`, or the name of an object.

        Raises:
            UsageError: there is no name.
        """
        if text == "all":
            return cls(None)
        kind, colon, name = text.partition(":")
        if colon and kind == "class" and name:
            return cls(name)
        if text and not (colon and kind == "class"):
            return cls(None, text)
        raise UsageError(
            f"{parameter}={text!r} chooses no objects; write {parameter}=all, {parameter}=class:NAME or"
            f" {parameter}=OBJECT"
        )

    def fits(self, name: str, class_name: str | None) -> bool:
        if self.name is not None:
            return self.name == name
        return self.class_name is None or (class_name or "").casefold() == self.class_name.casefold()


def find_instances(
    specification: Specification, each: Mapping[str, str], traces: Iterable[Trace], start_ns: int, end_ns: int
) -> list[Instance]:
    """Return the instances of a specification over the samples from `start_ns` to before `end_ns`.

    A template has one per chosen object, by name, over the samples from the object's first to its last
    appearance among them.

    Args:
        traces: the samples, in blocks; read only if there is a template.

    Raises:
        UsageError: no choice for a template's parameter, a choice for a parameter that no template has.
    """
    templates = [spec for spec in specification.results if spec.parameter is not None]
    check_choices(templates, each)
    choices = {
        spec.parameter: Choice.parse(spec.parameter or "", each[spec.parameter or ""]) for spec in templates
    }
    chosen = _appearances(choices, traces, start_ns, end_ns) if choices else {}
    instances: list[Instance] = []
    named = {spec.name: spec for spec in specification.specs}
    for spec in specification.results:
        program = compile_formula(spec.formula)
        if spec.parameter is None:
            instances.append(Instance(spec, None, program, {}, start_ns, end_ns, named))
            continue
        for name, (first_ns, last_ns) in sorted(chosen[spec.parameter].items()):
            bindings = {spec.parameter: TrackedName(name)}
            instances.append(Instance(spec, name, program, bindings, first_ns, last_ns + 1, named))
    return instances


def check_choices(templates: list[NamedSpec], each: Mapping[str, str]) -> None:
    """Check that the parameters of all templates, and no others, have a choice of objects."""
    for spec in templates:
        if spec.parameter not in each:
            raise UsageError(
                f"{spec.name}({spec.parameter}) is a template: say what {spec.parameter} stands for, "
                f"--each {spec.parameter}=class:NAME, --each {spec.parameter}=OBJECT or"
                f" --each {spec.parameter}=all"
            )
    check_parameters(templates, each)


def check_parameters(templates: list[NamedSpec], each: Mapping[str, str]) -> None:
    """Check that every choice of objects is for the parameter of some template."""
    for parameter in each:
        if parameter not in {spec.parameter for spec in templates}:
            known = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            raise UsageError(f"no template has a parameter {parameter!r}; templates here: {known}")


def _appearances(
    choices: Mapping[str | None, Choice], traces: Iterable[Trace], start_ns: int, end_ns: int
) -> dict[str | None, dict[str, tuple[int, int]]]:
    """Return the objects that fit each choice, with the times of their first and last samples."""
    spans: dict[str, tuple[int, int]] = {}
    fitting: dict[str | None, set[str]] = {parameter: set() for parameter in choices}
    for trace in traces:
        begin, end = window_of(trace.times_ns, start_ns, end_ns)
        times = trace.times_ns[begin:end]
        for name, rows in zip(trace.names, trace.rows[begin:end].T, strict=True):
            seen = np.flatnonzero(rows != ABSENT)
            if not len(seen):
                continue
            first_ns = spans[name][0] if name in spans else int(times[seen[0]])
            spans[name] = (first_ns, int(times[seen[-1]]))
            codes = np.unique(trace.class_code[np.where(rows < ABSENT, -2 - rows, rows)[seen]])
            for parameter, choice in choices.items():
                if any(choice.fits(name, trace.classes[code]) for code in codes.tolist()):
                    fitting[parameter].add(name)
    return {parameter: {name: spans[name] for name in names} for parameter, names in fitting.items()}
