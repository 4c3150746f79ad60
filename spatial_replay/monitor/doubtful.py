"""Doubtful verdicts: their objects or signals may have been misread from the log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from spatial_replay.monitor.ends import Needs
from spatial_replay.monitor.stream import Instance
from spatial_replay.spec.formula import ANY_CLASS, NamedSpec, Specification, TrackedName
from spatial_replay.spec.walks import base_of, iter_atoms
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.trace import ABSENT, Trace


class ClassMembers:
    """Names of the objects of given classes, collected over all samples so far.

    Args:
        classes: class names in lower case; `ANY_CLASS` stands for every object.
    """

    def __init__(self, classes: Iterable[str]) -> None:
        self._names = {name: set[str]() for name in classes if name != ANY_CLASS}

    def __bool__(self) -> bool:
        """Return whether the members of any class are collected."""
        return bool(self._names)

    def add(self, trace: Trace) -> None:
        """Add the objects of the next samples."""
        class_by_code = {code: (name or "").casefold() for code, name in enumerate(trace.classes)}
        codes = [code for code, name in class_by_code.items() if name in self._names]
        if not codes:
            return
        # an object with unknown position has row -2 - observation, and its class is known
        rows = np.where(trace.rows < ABSENT, -2 - trace.rows, trace.rows)
        # an absent object has row -1, which points to the appended code -1 of no class
        code_of_row = np.append(trace.class_code, -1)[rows]
        for code in codes:
            columns = np.flatnonzero((code_of_row == code).any(axis=0)).tolist()
            self._names[class_by_code[code]].update(trace.names[column] for column in columns)

    def may_include(self, classes: Iterable[str], objects: frozenset[str]) -> bool:
        """Return whether any of the objects had any of the classes."""
        return bool(objects) and any(
            name == ANY_CLASS or not objects.isdisjoint(self._names[name]) for name in classes
        )


def needs_of_spec(spec: NamedSpec, object: str | None = None) -> Needs:
    """Return the names that a spec uses.

    Args:
        object: the object of a template's instance; None for other specs.
    """
    needs = Needs.of([Specification((replace(spec, parameter=None),), profile="")], {})
    # `Needs.of` omits objects that only `present` names; a misread log may lack them as well
    object_names = {
        term.name
        for atom in iter_atoms(spec.formula)
        for term in map(base_of, atom.terms)
        if isinstance(term, TrackedName)
    }
    return replace(needs, objects=needs.objects | object_names | ({object} if object is not None else set()))


def doubts_about(needs: Needs, doubts: Iterable[Doubt], members: ClassMembers) -> tuple[Doubt, ...]:
    """Return the doubts about needed objects, signals and classes, without accepted doubts."""
    return tuple(
        doubt
        for doubt in doubts
        if not doubt.is_accepted
        and (
            not needs.objects.isdisjoint(doubt.objects)
            or not needs.signals.isdisjoint(doubt.signals)
            or members.may_include(needs.classes, doubt.objects)
        )
    )


def doubts_of_instances(
    instances: Sequence[Instance], doubts: Sequence[Doubt], traces: Callable[[], Iterable[Trace]]
) -> list[tuple[Doubt, ...]]:
    """Return the doubts that affect the verdict of each instance, without accepted doubts.

    Args:
        traces: iterates over the samples; called only if there are doubts and groups of a class.
    """
    # without doubts, the samples are not read again
    if all(doubt.is_accepted for doubt in doubts):
        return [()] * len(instances)
    needs_by_instance = [needs_of_spec(instance.spec, instance.object) for instance in instances]
    members = ClassMembers(name for needs in needs_by_instance for name in needs.classes)
    for trace in traces() if members else ():
        members.add(trace)
    return [doubts_about(needs, doubts, members) for needs in needs_by_instance]
