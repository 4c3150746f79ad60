"""Demands: what has to hold in one sample, and by how much; samples with objects elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Final, NamedTuple, TypeAlias

from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.poses import moved_object
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.planning.maps import Cube
from spatial_replay.spec.formula import Boolean, Formula, Outline, Truth, expand
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

Pose: TypeAlias = tuple[float, float, float]
"""x, y and turn of an object."""

MOST_ALTERNATIVES: Final = 32
"""The most conjunctions that a formula is written as; further ones are not tried."""


class Demand(NamedTuple):
    """A formula about one sample that has to hold, or must not, by at least a margin."""

    formula: Formula
    wanted: bool
    least: float


def alternatives(formula: Formula, wanted: bool) -> list[tuple[tuple[Formula, bool], ...]]:
    """Return conjunctions of atoms, each of which makes a formula hold, or its negation; a few at most."""
    formula = expand(formula)
    match formula:
        case Truth():
            return [()] if formula.value == wanted else []
        case Boolean(operator="not"):
            return alternatives(formula.operands[0], not wanted)
        case Boolean():
            parts = [alternatives(each, wanted) for each in formula.operands]
            if (formula.operator == "and") == wanted:
                return _conjoined(parts)
            return [each for part in parts for each in part][:MOST_ALTERNATIVES]
        case _:
            return [((formula, wanted),)]


def demands_of(cube: Cube, formulas: Sequence[Formula], least: float) -> list[tuple[Demand, ...]]:
    """Return the ways to make a cube of propositions hold, as conjunctions of demands."""
    parts = [alternatives(formulas[number], wanted) for number, wanted in cube]
    return [tuple(Demand(*each, least) for each in one) for one in _conjoined(parts)]


def _conjoined(
    parts: Sequence[list[tuple[tuple[Formula, bool], ...]]],
) -> list[tuple[tuple[Formula, bool], ...]]:
    combined: list[tuple[tuple[Formula, bool], ...]] = [()]
    for part in parts:
        combined = [(*one, *other) for one, other in product(combined, part)][:MOST_ALTERNATIVES]
    unique = (dict.fromkeys(each) for each in combined)
    return [tuple(each) for each in unique if not any((one, not wanted) in each for one, wanted in each)]


def values_in(
    sample: Sample, formulas: Sequence[Formula], regions: Mapping[str, Outline]
) -> tuple[list[float], list[float]]:
    """Return the lower and the upper robustness of formulas in a sample; infinite if it is unknown."""
    leaves = leaf_values(TraceScene(Trace.from_samples([sample]), regions), formulas, {})
    return leaves[0][:, 0].tolist(), leaves[min(1, len(leaves) - 1)][:, 0].tolist()


def surplus(lower: float, upper: float, demand: Demand) -> float:
    """Return by how much a demand is met, less its margin; an unknown one is not met."""
    return (lower if demand.wanted else -upper) - demand.least


class Budget:
    """How many maps a decision may compute."""

    def __init__(self, maps: int) -> None:
        self.left = maps

    def spend(self, maps: int = 1) -> bool:
        """Count maps; return whether there are any left."""
        self.left -= maps
        return self.left >= 0


def with_moved(sample: Sample, poses: Mapping[str, Pose]) -> Sample:
    """Return a sample with objects moved to poses (x, y, turn)."""
    tracked = {name: sample.objects[name] for name in poses}
    moved = {name: each for name, each in tracked.items() if isinstance(each, TrackedObject)}
    return with_objects(sample, {name: moved_object(each, *poses[name]) for name, each in moved.items()})


def with_objects(sample: Sample, objects: Mapping[str, TrackedObject]) -> Sample:
    """Return a sample with some objects in place of those that it has."""
    return Sample(sample.time_ns, {**sample.objects, **objects}, sample.signals, sample.unknown)
