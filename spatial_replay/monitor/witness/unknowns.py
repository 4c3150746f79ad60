"""Why an atom is unknown in a sample, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from spatial_replay.monitor.operands import Scene
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import (
    Atom,
    Earlier,
    Enlarged,
    Expression,
    Group,
    Maximum,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Projection,
    Signal,
    Sum,
    Term,
    TrackedName,
)
from spatial_replay.spec.terms import base_of, iter_expressions, terms_of
from spatial_replay.trace.trace import ABSENT


def unknowns_of(scene: Scene, atom: Atom) -> tuple[str, ...]:
    """What is not known of the one sample of a scene, each reason once, in the order of the atom."""
    parts = iter_expressions(atom.expression)
    return tuple(dict.fromkeys(reason for part in parts for reason in _reasons(scene, part)))


def _reasons(scene: Scene, part: Expression) -> Iterator[str]:
    match part:
        case Signal():
            values = scene.trace.signals.get(part.name)
            if values is None or not np.isfinite(values[scene.skip]):
                yield f"signal {part.name!r} has no finite value"
        case Number() | Sum() | Negative() | Minimum() | Maximum():
            return
        case _:
            for term in terms_of(part):
                yield from _reasons_of_term(scene, part, term)


def _reasons_of_term(scene: Scene, part: Expression, term: Term) -> Iterator[str]:
    found = scene.find(term)
    if found.unknown[0]:
        yield from _missing(scene, term)
    elif isinstance(part, Misalignment) and np.isnan(found.yaw[0]):
        yield f"{format_term(term)} has no orientation"
    elif isinstance(part, Projection) and part.axis == "z":
        rows = found.operand.rows[0]
        bottoms = scene.batch.bottom[rows[rows >= 0]]
        if np.isnan(bottoms).any():
            yield f"{format_term(term)} has no height"


def _missing(scene: Scene, term: Term) -> Iterator[str]:
    """What of a term is not there."""
    while isinstance(term, Enlarged):
        term = term.term
    if isinstance(term, Earlier) and _is_before_the_first(scene, term):
        yield f"{format_term(term)} looks back to before the first sample"
        return
    members = _members(base_of(term))
    rows = scene.find(term).operand.rows[0]
    for name, row in zip(members or [format_term(term)] * len(rows), rows.tolist(), strict=True):
        when = " then" if isinstance(term, Earlier) else ""
        if row < ABSENT:
            yield f"{name} has no readable position{when}"
        elif row == ABSENT and members:
            yield f"{name} is not in the sample{when and f' that {format_term(term)} looks at'}"


def _members(base: Term) -> Sequence[str]:
    """Who a term stands for, if they are named."""
    match base:
        case TrackedName():
            return [base.name]
        case Group() if base.members is not None:
            left_out = {each.name for each in base.excluded}
            return [name for name in base.members if name not in left_out]
    return ()


def _is_before_the_first(scene: Scene, term: Earlier) -> bool:
    if term.samples is not None:
        return term.samples > scene.skip
    times_ns = scene.trace.times_ns
    return int(times_ns[scene.skip]) - (term.duration_ns or 0) < int(times_ns[0])
