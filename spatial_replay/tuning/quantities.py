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
"""Maximum number of compared objects."""
MOST_PAIRS: Final = 400
"""Maximum number of compared pairs of objects."""
MOST_MEMBERS: Final = 30
"""Maximum number of members of a compared class."""
MOST_MEASURED: Final = 1 << 26
"""Maximum number of measurements, pairs times samples; two pairs are always measured."""
MOST_SIGNALS: Final = 50
"""Maximum number of compared signals."""
_SAMPLED: Final = 33
"""Number of samples of the first run whose distances order the pairs, the nearest pairs first."""

Relation: TypeAlias = Literal["dist", "oriented", "signal", "enclosedin", "ovlp", "leftof", "below", "prec"]
_EITHER_WAY: tuple[Relation, ...] = ("dist", "ovlp", "oriented")
_ONE_WAY: tuple[Relation, ...] = ("enclosedin", "leftof", "below", "prec")
WITH_LIMIT: frozenset[Relation] = frozenset({"dist", "oriented", "signal"})
"""Relations with a learned limit; other relations only hold or fail."""
_PARAMETERS: Mapping[str, tuple[float | str, ...]] = MappingProxyType({"oriented": (0.0,), "prec": ("z",)})


@dataclass(frozen=True, slots=True, order=True)
class Party:
    """One side of a relation: an object by name, or every object of a class."""

    name: str
    is_class: bool = False


@dataclass(frozen=True, slots=True)
class Quantity:
    """Number in every sample: the robustness of a relation, or the number whose limit is learned.

    Attributes:
        parties: the two sides of the relation; empty for a signal.
        signal: name of a signal, or "".
        formula: formula of the number: the signed distance for "dist", the negated misalignment for
            "oriented", the signal for "signal". Over classes it is the minimum over all members.
        reach: over classes, formula of the least negated number of all members; else `formula` itself.
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
    A class needs two objects in every run, or an object of the first run that another run lacks.

    Args:
        profile: profile of the relations.
    """
    common_names = set(traces[0].names).intersection(*(trace.names for trace in traces[1:]))
    names = sorted(common_names)
    left_out_phrases = []
    if len(names) > MOST_OBJECTS:
        left_out_phrases.append(
            f"{plural(len(names) - MOST_OBJECTS, 'object')} beyond the first {MOST_OBJECTS} by name"
        )
        names = names[:MOST_OBJECTS]
    sample_count = sum(map(len, traces))
    most_pairs = min(MOST_PAIRS, max(2, MOST_MEASURED // max(1, sample_count)))
    members = [members_of(trace) for trace in traces]
    classes, crowded_classes = _classes(members, common_names)
    if crowded_classes:
        left_out_phrases.append(
            f"classes with more than {MOST_MEMBERS} objects: {', '.join(crowded_classes)}"
        )
    class_pairs = list(_class_pairs(classes, members, names, common_names))
    object_pairs = _nearest_first(traces[0], [*combinations(map(Party, names), 2)])
    measured_pairs = [*class_pairs[:most_pairs], *object_pairs[: max(0, most_pairs - len(class_pairs))]]
    if missing_count := len(class_pairs) + len(object_pairs) - len(measured_pairs):
        left_out_phrases.append(
            f"{plural(missing_count, 'pair')} of objects that come less near than "
            f"{len(measured_pairs):,} others"
        )
    signals = sorted(set(traces[0].signals).intersection(*(trace.signals for trace in traces[1:])))
    signals = [
        signal for signal in signals if not any((trace.signals[signal] <= TEXTS).any() for trace in traces)
    ]
    if len(signals) > MOST_SIGNALS:
        left_out_phrases.append(
            f"{plural(len(signals) - MOST_SIGNALS, 'signal')} beyond the first {MOST_SIGNALS}"
        )
    taken_names = common_names | {name for trace in traces for name in trace.names}
    quantities = [quantity for a, b in measured_pairs for quantity in _quantities(a, b, profile, taken_names)]
    for name in signals[:MOST_SIGNALS]:
        atom = Atom(format_relation("signal", (), (name, ">=", 0.0)), "signal", Signal(name))
        quantities.append(Quantity("signal", (), name, atom, atom))
    return quantities, left_out_phrases


def members_of(trace: Trace) -> dict[str, set[str]]:
    """Return the names of objects by class."""
    names_by_class: dict[str, set[str]] = {}
    for column, name in enumerate(trace.names):
        object_rows = trace.rows[:, column]
        object_rows = object_rows[object_rows != ABSENT]
        # an unknown object has the row -2 - row, which still has its class (see `Trace`)
        codes = np.unique(trace.class_code[np.where(object_rows < 0, -2 - object_rows, object_rows)])
        for code in codes.tolist():
            if class_name := trace.classes[code]:
                names_by_class.setdefault(class_name, set()).add(name)
    return names_by_class


def _classes(
    members: Sequence[Mapping[str, set[str]]], common_names: set[str]
) -> tuple[list[str], list[str]]:
    """Return the classes to compare as a whole, and the classes with too many objects."""
    shared_classes = set(members[0]).intersection(*members[1:])
    fitting_classes = sorted(
        name
        for name in shared_classes
        if all(len(run_members[name]) > 1 for run_members in members) or not members[0][name] <= common_names
    )
    crowded_classes = [
        name
        for name in fitting_classes
        if any(len(run_members[name]) > MOST_MEMBERS for run_members in members)
    ]
    return [name for name in fitting_classes if name not in crowded_classes], crowded_classes


def _class_pairs(
    classes: Sequence[str],
    members: Sequence[Mapping[str, set[str]]],
    names: Sequence[str],
    common_names: set[str],
) -> Iterator[tuple[Party, Party]]:
    for name in classes:
        if all(len(run_members[name]) > 1 for run_members in members):
            yield Party(name, True), Party(name, True)
        for object_name in names:
            if not any(object_name in run_members[name] for run_members in members):
                yield Party(name, True), Party(object_name)
    for first_class, second_class in combinations(classes, 2):
        if not all(
            run_members[first_class] <= common_names and run_members[second_class] <= common_names
            for run_members in members
        ):
            yield Party(first_class, True), Party(second_class, True)


def _nearest_first(trace: Trace, pairs: list[tuple[Party, Party]]) -> list[tuple[Party, Party]]:
    if len(pairs) < 2 or not len(trace):
        return pairs
    sampled_trace = trace.take(np.unique(np.linspace(0, len(trace) - 1, _SAMPLED).astype(np.int64)))
    atoms = [_atom("dist", TrackedName(a.name), TrackedName(b.name), "paper") for a, b in pairs]
    least_distances = leaf_values(TraceScene(sampled_trace, {}), atoms, {})[0].min(axis=1)
    # pairs that are unknown in some sample come last
    sort_distances = np.where(np.isfinite(least_distances), least_distances, np.inf)
    return [pairs[index] for index in np.argsort(sort_distances, kind="stable").tolist()]


def _quantities(a: Party, b: Party, profile: str, taken_names: set[str]) -> Iterator[Quantity]:
    for relation in _EITHER_WAY:
        yield _quantity(relation, a, b, profile, taken_names)
    ordered_pairs = [(a, b)] if a == b else [*permutations((a, b))]
    for relation in _ONE_WAY:
        for first_party, second_party in ordered_pairs:
            yield _quantity(relation, first_party, second_party, profile, taken_names)


def _quantity(relation: Relation, a: Party, b: Party, profile: str, taken_names: set[str]) -> Quantity:
    variables = variables_of((a, b), taken_names)
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
    """Return two names for variables that differ from all names of objects."""
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
"""Maximum number of a run's values in memory at once."""
_SAMPLED_OF_A_RUN: Final = 64
"""Number of samples of a run that estimate how often a relation holds."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Measured quantities of a run. The lower and upper ends differ if positions are unknown or uncertain.

    Attributes:
        trace: samples of the run.
        least, greatest, first, last: (2, 2, Q) for Q quantities. The first axis is the direction: the
            quantity or its negative. The second axis has the lower and the upper end.
        sampled: (2, Q, S), lower ends in S samples, by direction.
        travel: (Q,), difference between the greatest and the least value of each quantity.
        shifts: displacement of each object from the first to the last sample; infinite if the
            object is missing in either sample or its shape changes.
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
        block_size = max(1, _AT_ONCE // max(1, len(trace)))
        sample_indices = np.unique(np.linspace(0, len(trace) - 1, _SAMPLED_OF_A_RUN).astype(np.int64))
        blocks: list[tuple[Floats, ...]] = []
        for start in range(0, len(quantities), block_size):
            block_values = measure_both_ways(scene, quantities[start : start + block_size])
            nominal_values = np.where(np.isfinite(block_values[0]), block_values[0], np.nan).mean(axis=0)
            is_known = np.isfinite(nominal_values)
            block_travel = np.where(is_known, nominal_values, -np.inf).max(axis=1) - np.where(
                is_known, nominal_values, np.inf
            ).min(axis=1)
            block_ends = (
                block_values.min(axis=3),
                block_values.max(axis=3),
                block_values[..., 0],
                block_values[..., -1],
            )
            blocks.append(
                (*block_ends, block_values[:, 0][..., sample_indices], np.maximum(block_travel, 0.0))
            )
        # the axis of the quantities in each array
        quantity_axes = (2, 2, 2, 2, 1, 0)
        least, greatest, first, last, sampled, travel = (
            np.concatenate(quantity_blocks, quantity_axis)
            for quantity_blocks, quantity_axis in zip(zip(*blocks, strict=True), quantity_axes, strict=True)
        )
        shifts = {name: _shift(trace, column) for column, name in enumerate(trace.names)}
        return cls(trace, least, greatest, first, last, sampled, travel, shifts)

    def first_time(self, quantity: Quantity, direction: int, limit: float, *, surely: bool) -> int:
        """Return the first sample in which a quantity, or its negative, reaches a limit.

        The result is the number of samples if the limit is never reached.

        Args:
            direction: 0 for the quantity, 1 for its negative.
            surely: whether the lower end is compared with the limit instead of the upper end.
        """
        run_values = measure_both_ways(TraceScene(self.trace, {}), [quantity])[
            direction, 0 if surely else 1, 0
        ]
        is_reached = run_values >= limit if surely else run_values > limit
        return int(is_reached.argmax()) if is_reached.any() else len(is_reached)


def _shift(trace: Trace, column: int) -> float:
    """Return the mean displacement of an object's corners from the first to the last sample."""
    shape_rows = trace.rows[[0, -1], column]
    if (shape_rows < 0).any():
        return np.inf
    footprints = trace.footprints
    first_corners, last_corners = (
        footprints.vertices[
            footprints.vertex_start[footprints.part_start[row]] : footprints.vertex_start[
                footprints.part_start[row + 1]
            ]
        ]
        for row in shape_rows.tolist()
    )
    if first_corners.shape != last_corners.shape:
        return np.inf
    return float(np.hypot(*(last_corners - first_corners).mean(axis=0)))


def measure_both_ways(scene: TraceScene, quantities: Sequence[Quantity]) -> Floats:
    """Return quantities and their negatives with lower and upper ends in each sample: (2, 2, Q, T)."""
    both_ways = np.empty((2, 2, len(quantities), len(scene)))
    formulas = [quantity.formula for quantity in quantities]
    values = leaf_values(scene, formulas, {})
    low, high = low_and_high(len(values), wide=True)
    both_ways[0] = values[low], values[high]
    both_ways[1] = -values[high], -values[low]
    class_indices = [
        index for index, quantity in enumerate(quantities) if quantity.reach is not quantity.formula
    ]
    if class_indices:
        # over a class, the negated least number is not the least negated number
        values = leaf_values(scene, [quantities[index].reach for index in class_indices], {})
        low, high = low_and_high(len(values), wide=True)
        both_ways[1][:, class_indices] = values[low], values[high]
    return both_ways


def robustness_of(formula: Formula, trace: Trace) -> tuple[float, float]:
    """Return the lower and upper end of a formula's robustness over a whole run, as in a replay."""
    leaf_formulas = new_leaves(formula, ())
    leaves = leaf_values(TraceScene(trace, {}), leaf_formulas, {})
    lower_ends, upper_ends = (
        OfflineFormula.of(formula, leaf_formulas).evaluate(leaves, trace.times_ns).ends(0)
    )
    return float(lower_ends[0]), float(upper_ends[0])
