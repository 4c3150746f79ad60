"""The two things that an arrow joins: those that an atom relates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spatial_replay.annotate.deciding_leaf import LeavesBelow, leaves_below
from spatial_replay.annotate.requirements import Requirement
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.sentences import divisor_of
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Atom, Formula, Outline, Protrusion, SignedDistance, Term
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.walks import iter_expressions, looks_back, substitute


class Pair(NamedTuple):
    """Two terms that an atom relates: by their distance, or by how far one sticks out of the other."""

    first: Term
    second: Term
    is_protrusion: bool


class LeafPairs(NamedTuple):
    """The pairs of objects and regions that the leaves of one result relate.

    Attributes:
        pairs: of each of the program's leaves; None for one that does not relate two things in one sample.
        below: of each requirement of the formula, its leaves.
        regions: shapes by name.
        divisors: of each leaf, what `scale` divides its number by.
        texts: of each leaf, in the language.
        relations: the names of those that texts may use.
    """

    pairs: tuple[Pair | None, ...]
    below: tuple[LeavesBelow, ...]
    regions: Mapping[str, Outline]
    divisors: Floats
    texts: tuple[str, ...]
    relations: frozenset[str]

    def text_of(self, formula: Formula) -> str:
        """Return a part of the formula in the language."""
        return format_formula(formula, relations=self.relations)


def leaf_pairs(
    instance: Instance,
    requirements: Sequence[Requirement],
    regions: Mapping[str, Outline],
    relations: frozenset[str] = frozenset(),
) -> LeafPairs:
    """Return what the leaves of an instance relate.

    Args:
        relations: the names of those that the file defines.
    """
    below = leaves_below(instance.formula, instance.program.leaves)
    leaves = [substitute(leaf, instance.bindings) for leaf in instance.program.leaves]
    pairs, known = tuple(map(pair_of, leaves)), RELATION_NAMES | relations
    texts = tuple(format_formula(leaf, relations=known) for leaf in leaves)
    divisors = np.array([divisor_of(leaf) for leaf in instance.program.leaves])
    of_requirements = tuple(below[requirement.node] for requirement in requirements)
    return LeafPairs(pairs, of_requirements, regions, divisors, texts, known)


def pair_of(leaf: Formula) -> Pair | None:
    """Return the first distance or enclosure in an atom, or the distance of its first terms."""
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
