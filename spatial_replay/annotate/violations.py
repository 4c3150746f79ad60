"""The worst that is violated in a sample, and the two points between which that is so."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.deciding_leaf import LeavesBelow, leaves_below
from spatial_replay.annotate.requirements import Concern, Evaluated
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.contact import contacts
from spatial_replay.geometry.measure import Operand
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.spec.formula import (
    Atom,
    Formula,
    Outline,
    Protrusion,
    SignedDistance,
    Term,
)
from spatial_replay.spec.walks import iter_expressions, looks_back, substitute
from spatial_replay.trace.trace import Trace


class Pair(NamedTuple):
    """What an atom is about: how far apart two terms are, or how far one sticks out of the other."""

    first: Term
    second: Term
    is_protrusion: bool


class Pointing(NamedTuple):
    """What one result can point at.

    Attributes:
        pairs: of each of the program's leaves; None of one that is not about two things in one sample.
        below: of each concern of the formula, its leaves.
        regions: shapes by name.
    """

    pairs: tuple[Pair | None, ...]
    below: tuple[LeavesBelow, ...]
    regions: Mapping[str, Outline]


class Judged(NamedTuple):
    """One result over some samples, with what its numbers were made of.

    Attributes:
        leaves: (C, A, T), the program's leaves.
    """

    evaluated: Evaluated
    leaves: Floats
    pointing: Pointing


class Pointers(NamedTuple):
    """At what to point in S samples.

    Attributes:
        is_shown: (S,), whether there is anything to point at.
        points: (S, 2, 2), a point of the first of the pair and one of the second.
        top: (S,), the upper end of the higher one, NaN if neither has a height.
        robustness: (S,), below 0: of what is violated.
    """

    is_shown: NDArray[np.bool_]
    points: Floats
    top: Floats
    robustness: Floats

    @classmethod
    def nowhere(cls, samples: int) -> Pointers:
        """Nothing is violated."""
        return cls(
            np.zeros(samples, np.bool_),
            np.full((samples, 2, 2), np.nan),
            np.full(samples, np.nan),
            np.full(samples, np.nan),
        )


def pointing_of(instance: Instance, concerns: Sequence[Concern], regions: Mapping[str, Outline]) -> Pointing:
    """How to point at what an instance finds violated."""
    below = leaves_below(instance.formula, instance.program.leaves)
    pairs = tuple(_pair(substitute(leaf, instance.bindings)) for leaf in instance.program.leaves)
    return Pointing(pairs, tuple(below[concern.node] for concern in concerns), regions)


def pointers(judged: Sequence[Judged], trace: Trace, samples: Integers) -> Pointers:
    """At what to point in some samples of a trace.

    It is the atom that gives its number to the worst of all concerns (see `involvement`), where that is
    violated: the two points at which the signed distance of its two terms is attained, or of an enclosure how
    far the one sticks out of the other.

    Args:
        samples: (S,) int64, indices.
    """
    found = Pointers.nowhere(len(samples))
    result, concern, worst = _worst([each.evaluated for each in judged], trace.times_ns[samples])
    for index, own in enumerate(judged):
        here = np.flatnonzero((result == index) & (worst < 0.0))
        if len(here):
            at = np.searchsorted(own.evaluated.times_ns, trace.times_ns[samples[here]])
            _point(own.pointing, _deciding(own, concern[here], at), trace, samples, here, found)
    found.robustness[found.is_shown] = worst[found.is_shown]
    return found


def _worst(evaluated: Sequence[Evaluated], times_ns: Integers) -> tuple[Integers, Integers, Floats]:
    """(S,) the worst of all concerns in each sample: of which result, which one, how bad it is.

    What is violated without a number, as when there is nobody to satisfy it, is passed over.
    """
    result, concern = np.full(len(times_ns), -1, np.int64), np.full(len(times_ns), -1, np.int64)
    worst = np.full(len(times_ns), np.inf)
    for index, own in enumerate(evaluated):
        if not len(own.times_ns):
            continue
        at = np.minimum(np.searchsorted(own.times_ns, times_ns), len(own.times_ns) - 1)
        is_evaluated = own.times_ns[at] == times_ns
        for number, one in enumerate(own.concerns):
            now = one.robustness(own.series, at)
            is_worse = is_evaluated & (now < worst) & (now > -np.inf)
            result[is_worse], concern[is_worse], worst[is_worse] = index, number, now[is_worse]
    return result, concern, worst


def _deciding(own: Judged, concern: Integers, at: Integers) -> Integers:
    """(H,) the leaf that a concern (H,) has its number from in a sample (H,); -1 where none has it."""
    leaf = np.full(len(at), -1, np.int64)
    low, high = low_and_high(len(own.leaves), wide=False)
    for number in np.unique(concern).tolist():
        there = np.flatnonzero(concern == number)
        below = own.pointing.below[number]
        if not len(below.indices):
            continue  # a constant
        places = below.indices[:, None], at[there][None, :]
        lows, highs = own.leaves[low][places], own.leaves[high][places]
        now = own.evaluated.series[own.evaluated.concerns[number].node, 1, at[there]]
        is_hit = (lows == highs) & (lows * below.signs[:, None] == now)
        leaf[there] = np.where(is_hit.any(axis=0), below.indices[is_hit.argmax(axis=0)], -1)
    return leaf


def _point(
    pointing: Pointing, leaf: Integers, trace: Trace, samples: Integers, here: Integers, found: Pointers
) -> None:
    """Fill in the samples `here` (H,), whose leaves (H,) are given."""
    scene = TraceScene(trace, pointing.regions)
    for index in np.unique(leaf[leaf >= 0]).tolist():
        pair = pointing.pairs[index]
        if pair is None:
            continue
        there = here[leaf == index]
        operands = [scene.find(term).operand for term in (pair.first, pair.second)]
        first, second = (Operand(each.rows[samples[there]], each.enlargement) for each in operands)
        numbers = contacts(scene.batch, first, second, is_protrusion=pair.is_protrusion)
        found.points[there] = numbers[:, :4].reshape(-1, 2, 2)
        found.top[there] = numbers[:, 5]
        found.is_shown[there] = np.isfinite(numbers[:, :5]).all(axis=1)


def _pair(leaf: Formula) -> Pair | None:
    """The first distance or enclosure that an atom is made of, or else the distance of its first terms."""
    if not isinstance(leaf, Atom):
        return None
    for pair in _pairs(leaf):
        if not any(map(looks_back, (pair.first, pair.second))):
            return pair
    return None


def _pairs(atom: Atom) -> Iterator[Pair]:
    for part in iter_expressions(atom.expression):
        match part:
            case SignedDistance():
                yield Pair(part.first, part.second, False)
            case Protrusion():
                yield Pair(part.inner, part.outer, True)
    if len(atom.terms) > 1:
        yield Pair(atom.terms[0], atom.terms[1], False)
