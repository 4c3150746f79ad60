"""Quantities that several runs have in common, and their values in one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.offline import OfflineFormula, new_leaves
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.spec.format import format_relation
from spatial_replay.spec.formula import (
    Atom,
    Expression,
    Formula,
    Group,
    Quantified,
    Signal,
    SignedDistance,
    TrackedName,
    Variable,
)
from spatial_replay.spec.relations import PROFILES
from spatial_replay.text import TEXTS, plural
from spatial_replay.trace.trace import ABSENT, Trace

MOST_OBJECTS: Final = 60
MOST_PAIRS: Final = 400
MOST_MEMBERS: Final = 30
"""Limits of the comparison: objects, pairs of objects, members of a class."""
MOST_MEASURED: Final = 1 << 26
"""Maximum number of measurements, pairs times samples; two pairs are always measured."""
MOST_SIGNALS: Final = 50
_SAMPLED: Final = 33
"""Samples of the first run that order the pairs: those that come nearest are measured first."""

Relation: TypeAlias = Literal["dist", "oriented", "signal", "enclosedin", "ovlp", "leftof", "below", "prec"]
_EITHER_WAY: tuple[Relation, ...] = ("dist", "ovlp", "oriented")
_ONE_WAY: tuple[Relation, ...] = ("enclosedin", "leftof", "below", "prec")
WITH_LIMIT: frozenset[Relation] = frozenset({"dist", "oriented", "signal"})
"""Relations with a learned limit; the others only hold or fail."""
_PARAMETERS: Mapping[str, tuple[float | str, ...]] = MappingProxyType({"oriented": (0.0,), "prec": ("z",)})


@dataclass(frozen=True, slots=True, order=True)
class Party:
    """One side of a relation: an object by name, or every object of a class."""

    name: str
    is_class: bool = False


@dataclass(frozen=True, slots=True)
class Quantity:
    """Number in every sample: the robustness of a relation, or the number that a limit is learned for.

    Attributes:
        parties: the two sides of the relation; empty for a signal.
        signal: name of a signal, or "".
        formula: formula of the number: the signed distance for "dist", the negated misalignment for
            "oriented", the signal for "signal". Over classes it is the least number of all members.
        reach: over classes, the least negated number of all members; else `formula`.
    """

    relation: Relation
    parties: tuple[Party, ...]
    signal: str
    formula: Formula
    reach: Formula

    @property
    def pair(self) -> frozenset[Party]:
        """The sides of the relation in any order."""
        return frozenset(self.parties)

    @property
    def is_symmetric(self) -> bool:
        """Whether the order of the parties does not matter."""
        return self.relation in _EITHER_WAY


def scope_of(traces: Sequence[Trace], profile: str) -> tuple[list[Quantity], list[str]]:
    """Return the quantities that all runs have, and phrases for the objects and signals that are left out.

    Objects are compared by name. A class is compared as a whole, too, as in `forall a, b in class "block"`.
    For this every run must have two of its objects, or the runs must have different objects of the class.

    Args:
        profile: profile of the relations.
    """
    common = set(traces[0].names).intersection(*(trace.names for trace in traces[1:]))
    names = sorted(common)
    left_out = []
    if len(names) > MOST_OBJECTS:
        left_out.append(
            f"{plural(len(names) - MOST_OBJECTS, 'object')} beyond the first {MOST_OBJECTS} by name"
        )
        names = names[:MOST_OBJECTS]
    samples = sum(map(len, traces))
    most = min(MOST_PAIRS, max(2, MOST_MEASURED // max(1, samples)))
    members = [members_of(trace) for trace in traces]
    classes, crowded = _classes(members, common)
    if crowded:
        left_out.append(f"classes with more than {MOST_MEMBERS} objects: {', '.join(crowded)}")
    class_pairs = list(_class_pairs(classes, members, names, common))
    pairs = _nearest_first(traces[0], [*combinations(map(Party, names), 2)])
    measured_pairs = [*class_pairs[:most], *pairs[: max(0, most - len(class_pairs))]]
    if missing := len(class_pairs) + len(pairs) - len(measured_pairs):
        left_out.append(
            f"{plural(missing, 'pair')} of objects that come less near than {len(measured_pairs):,} others"
        )
    signals = sorted(set(traces[0].signals).intersection(*(trace.signals for trace in traces[1:])))
    signals = [
        signal for signal in signals if not any((trace.signals[signal] <= TEXTS).any() for trace in traces)
    ]
    if len(signals) > MOST_SIGNALS:
        left_out.append(f"{plural(len(signals) - MOST_SIGNALS, 'signal')} beyond the first {MOST_SIGNALS}")
    taken_names = common | {name for trace in traces for name in trace.names}
    quantities = [quantity for a, b in measured_pairs for quantity in _quantities(a, b, profile, taken_names)]
    for name in signals[:MOST_SIGNALS]:
        atom = Atom(format_relation("signal", (), (name, ">=", 0.0)), "signal", Signal(name))
        quantities.append(Quantity("signal", (), name, atom, atom))
    return quantities, left_out


def members_of(trace: Trace) -> dict[str, set[str]]:
    """Return the names of objects by class."""
    names_by_class: dict[str, set[str]] = {}
    for column, name in enumerate(trace.names):
        rows = trace.rows[:, column]
        rows = rows[rows != ABSENT]
        # an unknown object has the row -2 - row, which still has its class (see `Trace`)
        codes = np.unique(trace.class_code[np.where(rows < 0, -2 - rows, rows)])
        for code in codes.tolist():
            if class_name := trace.classes[code]:
                names_by_class.setdefault(class_name, set()).add(name)
    return names_by_class


def _classes(members: Sequence[Mapping[str, set[str]]], common: set[str]) -> tuple[list[str], list[str]]:
    """Return the classes to compare as a whole, and the classes with too many objects."""
    shared = set(members[0]).intersection(*members[1:])
    fitting = sorted(
        name
        for name in shared
        if all(len(run_members[name]) > 1 for run_members in members) or not members[0][name] <= common
    )
    crowded = [
        name for name in fitting if any(len(run_members[name]) > MOST_MEMBERS for run_members in members)
    ]
    return [name for name in fitting if name not in crowded], crowded


def _class_pairs(
    classes: Sequence[str], members: Sequence[Mapping[str, set[str]]], names: Sequence[str], common: set[str]
) -> Iterator[tuple[Party, Party]]:
    for name in classes:
        if all(len(run_members[name]) > 1 for run_members in members):
            yield Party(name, True), Party(name, True)
        for object_name in names:
            if not any(object_name in run_members[name] for run_members in members):
                yield Party(name, True), Party(object_name)
    for a, b in combinations(classes, 2):
        if not all(run_members[a] <= common and run_members[b] <= common for run_members in members):
            yield Party(a, True), Party(b, True)


def _nearest_first(trace: Trace, pairs: list[tuple[Party, Party]]) -> list[tuple[Party, Party]]:
    if len(pairs) < 2 or not len(trace):
        return pairs
    few = trace.take(np.unique(np.linspace(0, len(trace) - 1, _SAMPLED).astype(np.int64)))
    atoms = [_atom("dist", TrackedName(a.name), TrackedName(b.name), "paper") for a, b in pairs]
    nearest = leaf_values(TraceScene(few, {}), atoms, {})[0].min(axis=1)
    # pairs that are unknown in some sample come last
    key = np.where(np.isfinite(nearest), nearest, np.inf)
    return [pairs[index] for index in np.argsort(key, kind="stable").tolist()]


def _quantities(a: Party, b: Party, profile: str, taken: set[str]) -> Iterator[Quantity]:
    for relation in _EITHER_WAY:
        yield _quantity(relation, a, b, profile, taken)
    ways = [(a, b)] if a == b else [*permutations((a, b))]
    for relation in _ONE_WAY:
        for first, second in ways:
            yield _quantity(relation, first, second, profile, taken)


def _quantity(relation: Relation, a: Party, b: Party, profile: str, taken: set[str]) -> Quantity:
    variables = variables_of((a, b), taken)
    terms = [
        Variable(variable) if party.is_class else TrackedName(party.name)
        for party, variable in zip((a, b), variables, strict=True)
    ]
    atom = _atom(relation, terms[0], terms[1], profile)
    formula: Formula = _over((a, b), variables, atom)
    reach = formula
    if formula is not atom:
        reach = _over((a, b), variables, Atom(atom.text, relation, -atom.expression))
    return Quantity(relation, (a, b), "", formula, reach)


def variables_of(parties: Sequence[Party], taken: set[str]) -> tuple[str, str]:
    """Return two names of variables that no object has."""
    variables = []
    for name in ("a", "b"):
        while name in taken or name in {party.name for party in parties}:
            name += "_"
        variables.append(name)
    return variables[0], variables[1]


def _over(parties: tuple[Party, Party], variables: tuple[str, str], atom: Atom) -> Atom | Quantified:
    groups = [Group("", class_name=party.name) for party in parties]
    if parties[0].is_class and parties[0] == parties[1]:
        return Quantified("forall", variables, groups[0], atom)
    formula: Atom | Quantified = atom
    for party, variable, group in reversed(list(zip(parties, variables, groups, strict=True))):
        if party.is_class:
            formula = Quantified("forall", (variable,), group, formula)
    return formula


def _atom(relation: str, a: TrackedName | Variable, b: TrackedName | Variable, profile: str) -> Atom:
    parameters = _PARAMETERS.get(relation, ())
    expression: Expression
    if relation == "dist":
        expression, parameters = SignedDistance(a, b), (">=", 0.0)
    else:
        expression = PROFILES[profile][relation](a, b, *parameters)
    return Atom(format_relation(relation, (a, b), parameters), relation, expression)


# ---------------------------------------------------------------------------------------------------- one run

_AT_ONCE: Final = 1 << 22
"""Maximum count of a run's numbers in memory at once."""
_SAMPLED_OF_A_RUN: Final = 64
"""Samples of a run that estimate how often a relation holds."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Numbers of a run with lower and upper ends, which differ for unknown or uncertain positions.

    Attributes:
        trace: samples of the run.
        least, greatest, first, last: (2, 2, Q) for Q quantities. The first axis is the direction: the
            quantity or its negative. The second axis is the end.
        sampled: (2, Q, S), lower ends in S samples, by direction.
        travel: (Q,), difference between the greatest and the least value of each quantity.
        shifts: displacement of each object from the first to the last sample; infinite if it is missing in
            one of them or its shape changes.
    """

    trace: Trace
    least: Floats
    greatest: Floats
    first: Floats
    last: Floats
    sampled: Floats
    travel: Floats
    shifts: Mapping[str, float]

    @classmethod
    def of(cls, trace: Trace, quantities: Sequence[Quantity]) -> Observed:
        """Measure every quantity in every sample."""
        scene = TraceScene(trace, {})
        step = max(1, _AT_ONCE // max(1, len(trace)))
        some = np.unique(np.linspace(0, len(trace) - 1, _SAMPLED_OF_A_RUN).astype(np.int64))
        blocks: list[tuple[Floats, ...]] = []
        for start in range(0, len(quantities), step):
            values = measure_both_ways(scene, quantities[start : start + step])
            nominal = np.where(np.isfinite(values[0]), values[0], np.nan).mean(axis=0)
            is_known = np.isfinite(nominal)
            span = np.where(is_known, nominal, -np.inf).max(axis=1) - np.where(is_known, nominal, np.inf).min(
                axis=1
            )
            ends = values.min(axis=3), values.max(axis=3), values[..., 0], values[..., -1]
            blocks.append((*ends, values[:, 0][..., some], np.maximum(span, 0.0)))
        # the axis of the quantities in each array
        axes = (2, 2, 2, 2, 1, 0)
        least, greatest, first, last, sampled, travel = (
            np.concatenate(parts, axis) for parts, axis in zip(zip(*blocks, strict=True), axes, strict=True)
        )
        shifts = {name: _shift(trace, column) for column, name in enumerate(trace.names)}
        return cls(trace, least, greatest, first, last, sampled, travel, shifts)

    def first_time(self, quantity: Quantity, direction: int, limit: float, *, surely: bool) -> int:
        """Return the first sample in which a quantity, or its negative, reaches a limit; T if there is none.

        Args:
            direction: 0 for the quantity, 1 for its negative.
            surely: whether the lower end is compared with the limit instead of the upper end.
        """
        values = measure_both_ways(TraceScene(self.trace, {}), [quantity])[direction, 0 if surely else 1, 0]
        holds = values >= limit if surely else values > limit
        return int(holds.argmax()) if holds.any() else len(holds)


def _shift(trace: Trace, column: int) -> float:
    """Return the mean displacement of an object's corners from the first to the last sample."""
    rows = trace.rows[[0, -1], column]
    if (rows < 0).any():
        return np.inf
    shapes = trace.footprints
    first, last = (
        shapes.vertices[
            shapes.vertex_start[shapes.part_start[row]] : shapes.vertex_start[shapes.part_start[row + 1]]
        ]
        for row in rows.tolist()
    )
    if first.shape != last.shape:
        return np.inf
    return float(np.hypot(*(last - first).mean(axis=0)))


def measure_both_ways(scene: TraceScene, quantities: Sequence[Quantity]) -> Floats:
    """Return quantities and their negatives with lower and upper ends in each sample: (2, 2, Q, T)."""
    result = np.empty((2, 2, len(quantities), len(scene)))
    formulas = [quantity.formula for quantity in quantities]
    values = leaf_values(scene, formulas, {})
    low, high = low_and_high(len(values), wide=True)
    result[0] = values[low], values[high]
    result[1] = -values[high], -values[low]
    others = [index for index, quantity in enumerate(quantities) if quantity.reach is not quantity.formula]
    if others:
        # over a class, the negated least number is not the least negated number
        values = leaf_values(scene, [quantities[index].reach for index in others], {})
        low, high = low_and_high(len(values), wide=True)
        result[1][:, others] = values[low], values[high]
    return result


def robustness_of(formula: Formula, trace: Trace) -> tuple[float, float]:
    """Return the lower and upper end of a formula's robustness over a whole run, as in a replay."""
    order = new_leaves(formula, ())
    leaves = leaf_values(TraceScene(trace, {}), order, {})
    low, high = OfflineFormula.of(formula, order).evaluate(leaves, trace.times_ns).ends(0)
    return float(low[0]), float(high[0])
