"""Verdicts that rest on objects or signals which a log may have been read wrongly for."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from spatial_replay.monitor.ends import Needs
from spatial_replay.monitor.stream import Instance
from spatial_replay.spec.formula import ANY_CLASS, Specification
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.trace import ABSENT, Trace


def doubts_of_instances(
    instances: Sequence[Instance], doubts: Sequence[Doubt], traces: Callable[[], Iterable[Trace]]
) -> list[tuple[Doubt, ...]]:
    """Return for each instance the doubts that its verdict rests on, without those that are accepted.

    Args:
        traces: iterates over the samples; called where an instance has groups of a class.
    """
    doubts = [doubt for doubt in doubts if not doubt.is_accepted]

    @cache
    def members(classes: frozenset[str]) -> frozenset[str]:
        return frozenset().union(*(_members(trace, classes) for trace in traces()))

    def rests_on(needs: Needs, doubt: Doubt) -> bool:
        if not (needs.objects.isdisjoint(doubt.objects) and needs.signals.isdisjoint(doubt.signals)):
            return True
        if not (needs.classes and doubt.objects):
            return False
        return ANY_CLASS in needs.classes or not doubt.objects.isdisjoint(members(needs.classes))

    return [
        tuple(doubt for doubt in doubts if rests_on(needs, doubt))
        for needs in (map(_needs, instances) if doubts else [Needs()] * len(instances))
    ]


def _needs(instance: Instance) -> Needs:
    """Return the names that one instance uses; a template's parameter stands for its object."""
    needs = Needs.of([Specification((replace(instance.spec, parameter=None),), profile="")], {})
    return needs if instance.object is None else replace(needs, objects=needs.objects | {instance.object})


def _members(trace: Trace, classes: Collection[str]) -> frozenset[str]:
    """Return the objects that are of some classes, given in lower case, in any sample."""
    codes = [code for code, name in enumerate(trace.classes) if (name or "").casefold() in classes]
    if not codes:
        return frozenset()
    rows = np.where(trace.rows < ABSENT, -2 - trace.rows, trace.rows)
    is_member = (rows != ABSENT) & np.isin(trace.class_code, codes)[rows]
    return frozenset(trace.names[column] for column in np.flatnonzero(is_member.any(axis=0)).tolist())
