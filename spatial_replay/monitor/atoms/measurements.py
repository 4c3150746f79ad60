"""The leaves of whole traces, from signals and from measurements that the trace caches."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from copy import copy
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from spatial_replay.compiled import over_cores
from spatial_replay.geometry.arrays import Booleans, Flags, Floats
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import (
    MeasureRequest,
    Operand,
    Quantity,
    Remeasured,
    closest_pairs,
    measure,
    misalignment,
)
from spatial_replay.monitor.atoms.closest_pair import ClosestPair
from spatial_replay.monitor.atoms.instructions import LeafCode, Membership, run_instructions
from spatial_replay.monitor.atoms.terms import Bindings, TraceScene
from spatial_replay.spec.formula import (
    Centre,
    CentroidProjection,
    Enlarged,
    Formula,
    Measurement,
    Misalignment,
    Projection,
    Protrusion,
    RegionName,
    SignedDistance,
    Term,
)
from spatial_replay.spec.walks import base_of, map_terms, measured_terms
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import ABSENT

_SHARE = 200_000
"""So many instructions, each over one sample, pay for a thread of their own."""


def measured(scene: TraceScene, measurements: Sequence[Measurement]) -> tuple[Floats, Floats]:
    """Compute each measurement in each sample of a scene, or take it from the trace's cache.

    Returns:
        Values (K, T), NaN where unknown, and how far each may be off for uncertainty (K, T).
    """
    keys = [_key(scene, measurement) for measurement in measurements]
    cache = scene.trace.cache
    found = {key: array for key in keys if (array := cache.get(key)) is not None}
    missing = {
        key: measurement for key, measurement in zip(keys, measurements, strict=True) if key not in found
    }
    if missing:
        for key, array in zip(missing, _measure(scene, list(missing.values())), strict=True):
            cache.put(key, array)
            found[key] = array
    if not keys:
        return np.empty((0, len(scene))), np.empty((0, len(scene)))
    values = np.array([found[key][0] for key in keys])
    if scene.is_sure:
        return values, np.zeros(values.shape)
    return values, np.array([found[key][1] for key in keys])


def _measure(scene: TraceScene, measurements: Sequence[Measurement]) -> list[Floats]:
    """Compute value (NaN if unknown) and uncertainty of each measurement, in one kernel call.

    Returns:
        (2, T) each, or (1, T), the values alone, where the scene is sure.
    """
    operands, requests = _requested(scene, measurements)
    values = iter(measure(scene.batch, operands, requests) if requests else ())
    result = []
    for each in measurements:
        value = _turned(scene, each) if isinstance(each, Misalignment) else next(values)
        unknown, spread = _doubt(scene, each)
        if unknown.any():
            value = np.where(unknown, np.nan, value)
        array = np.array([value] if scene.is_sure else [value, spread])
        array.flags.writeable = False
        result.append(array)
    return result


def _turned(scene: TraceScene, each: Misalignment) -> Floats:
    first, second = [scene.resolve(term).yaw for term in measured_terms(each)]
    return misalignment(first, second)


def _doubt(scene: TraceScene, each: Measurement) -> tuple[Booleans, Floats]:
    """Return where a measurement is unknown, and how far it may be off for uncertainty, (T,) each."""
    found = [scene.resolve(term) for term in measured_terms(each)]
    unknown = reduce(np.logical_or, [one.unknown for one in found])
    if scene.is_sure or isinstance(each, Misalignment):
        return unknown, np.zeros(len(scene))
    return unknown, reduce(np.add, [one.spread for one in found])


def _requested(
    scene: TraceScene, measurements: Sequence[Measurement]
) -> tuple[list[Operand], list[MeasureRequest]]:
    """Return what to measure of footprints, in order: all but what is between orientations."""
    numbers: dict[Term, int] = {}
    operands: list[Operand] = []

    def operand(term: Term) -> int:
        if term not in numbers:
            numbers[term] = len(operands)
            operands.append(scene.resolve(term).operand)
        return numbers[term]

    requests = [
        MeasureRequest(quantity_of(each), *(operand(term) for term in measured_terms(each)))
        for each in measurements
        if not isinstance(each, Misalignment)
    ]
    return operands, requests


def quantity_of(measurement: Measurement) -> Quantity:
    match measurement:
        case SignedDistance():
            return "signed_distance"
        case Protrusion():
            return "protrusion"
        case Projection():
            return f"{measurement.side}_{measurement.axis}"  # type: ignore[return-value]
        case CentroidProjection():
            return f"centroid_{measurement.side}_{measurement.axis}"  # type: ignore[return-value]
        case Misalignment():
            raise TypeError("an orientation is no quantity of footprints")


def _key(scene: TraceScene, measurement: Measurement) -> Hashable:
    """Return the cache key of a measurement: independent of its specification, with regions by shape."""
    shapes = tuple(
        scene.regions[name] for name in map(_region, measured_terms(measurement)) if name is not None
    )
    if not shapes:
        return scene.skip, measurement
    if isinstance(measurement, Misalignment | Projection | CentroidProjection):
        return scene.skip, measurement, shapes
    return scene.skip, map_terms(measurement, _unnamed), shapes


def _region(term: Term) -> str | None:
    base = base_of(term)
    return base.name if isinstance(base, RegionName) else None


def _unnamed(term: Term) -> Term:
    if isinstance(term, Enlarged | Centre):
        inner: Any = _unnamed(term.term)
        return replace(term, term=inner)
    return RegionName("") if _region(term) is not None else term


def leaf_values(scene: TraceScene, leaves: Sequence[Formula], bindings: Bindings) -> Floats:
    """Compute each leaf in each sample of a scene.

    Returns:
        (C, A, T). C = 1 if everything is known, C = 2 (low and high end) if something may be unknown, C = 4
        (the same with uncertainty behind them) if there is uncertainty.

    Raises:
        UsageError: more than `MAX_BINDINGS`.
    """
    code = _Code(scene, leaves, bindings)
    closest = np.array([_closest(scene, each) for each in code.closest])
    return code.run(*measured(scene, code.measurements), closest)


class MovedLeaves:
    """Leaves of a scene in which nothing changes but the outlines of footprints.

    Each thread needs its own, since it computes in the same room each time.

    Attributes:
        compares_turns: whether orientations matter, too.
    """

    def __init__(self, scene: TraceScene, leaves: Sequence[Formula], bindings: Bindings) -> None:
        self._scene, self._code = scene, _Code(scene, leaves, bindings)
        measurements = self._code.measurements
        doubts = [_doubt(scene, each) for each in measurements]
        self._unknown = [(place, where) for place, (where, _) in enumerate(doubts) if where.any()]
        self._spreads = np.array([spread for _, spread in doubts]).reshape(len(doubts), len(scene))
        self._values = np.empty(self._spreads.shape)
        is_turn = np.array([isinstance(each, Misalignment) for each in measurements], np.bool_)
        for place, each in enumerate(measurements):
            if isinstance(each, Misalignment):
                self._values[place] = _turned(scene, each)
        self._of_footprints, self.compares_turns = ~is_turn, bool(is_turn.any())
        self._measured = Remeasured(scene.batch, *_requested(scene, measurements))

    def another(self) -> MovedLeaves:
        """Return the same with room of its own."""
        made = copy(self)
        made._values, made._measured = self._values.copy(), self._measured.another()
        return made

    def values(self, vertices: Floats) -> Floats:
        """Compute each leaf in each sample, (C, A, T) as `leaf_values` does.

        Args:
            vertices: (V or more, 2), in the places of the scene's.
        """
        vertices = self._scene.with_centres(vertices)
        values = self._measured.measure(vertices)
        if self.compares_turns:
            if len(values):
                self._values[self._of_footprints] = values
            values = self._values
        for place, where in self._unknown:
            values[place, where] = np.nan
        batch = self._scene.batch
        batch = replace(batch, vertices=vertices[: len(batch.vertices)])
        closest = np.array([_ends_of(self._scene, each, batch) for each in self._code.closest])
        return self._code.run(values, self._spreads, closest)


class _Code:
    """The instructions for leaves of a scene, with what does not depend on measurements."""

    def __init__(self, scene: TraceScene, leaves: Sequence[Formula], bindings: Bindings) -> None:
        code = LeafCode(scene)
        self._outputs = np.array(code.add_leaves(leaves, bindings), np.int64)
        self.measurements, self.closest = list(code.measurements), list(code.closest)
        self._signals = np.array([scene.signal(each) for each in code.signals])
        self._signals = self._signals.reshape(len(code.signals), len(scene))
        members = np.array([_flags(scene, each) for each in code.members], np.int8)
        self._members = members.reshape(len(code.members), len(scene))
        self._rows = np.array(list(code.rows), np.int64).reshape(len(code.rows), 4)
        self._constants = np.array(list(code.constants), np.float64)
        self._is_sure = scene.is_sure
        # whether a number is equal to a text is not known
        self._has_texts = bool(
            (self._signals <= TEXTS).any()
            or (np.isfinite(self._constants) & (self._constants <= TEXTS)).any()
        )

    def run(self, values: Floats, spreads: Floats, closest: Floats) -> Floats:
        """Compute the leaves, (C, A, T) as `leaf_values` does, from what was measured.

        Args:
            values, spreads: (K, T), of each measurement and how far it may be off.
            closest: (P, 4, T), the ends of each closest pair's distance.
        """
        signals, members, count = self._signals, self._members, values.shape[1]
        closest = closest.reshape(len(self.closest), 4, count)
        is_known = np.isfinite(values).all() and np.isfinite(signals).all() and not (members < 0).any()
        is_known = is_known and not self._has_texts and (closest[:, 0] == closest[:, 1]).all()
        is_sure = (self._is_sure or not spreads.any()) and (closest[:, :2] == closest[:, 2:]).all()
        channels = 4 if not is_sure else 1 if is_known else 2
        result = np.empty((channels, len(self._outputs), count))
        arguments = (
            self._rows,
            self._constants,
            values,
            spreads,
            signals,
            closest,
            members,
            self._outputs,
            result,
        )
        over_cores(
            run_instructions,
            lambda begin, end: run_instructions(*arguments, begin, end),
            count,
            _SHARE // max(len(self._rows), 1) + 1,
        )
        return result


def _closest(scene: TraceScene, pair: ClosestPair) -> Floats:
    """Compute the ends of a closest pair's distance, (4, T), or take them from the trace's cache."""
    cache, key = scene.trace.cache, (scene.skip, pair)
    found = cache.get(key)
    if found is None:
        found = _ends_of(scene, pair, scene.batch)
        found.flags.writeable = False
        cache.put(key, found)
    return found


def _ends_of(scene: TraceScene, pair: ClosestPair, batch: FootprintBatch) -> Floats:
    """Compute the ends of a closest pair's distance, (4, T), with the outlines of a batch."""
    rows, uncertainty = scene.resolve(pair.group).operand.rows, scene.trace.uncertainty
    least, low, high = closest_pairs(batch, rows, uncertainty, pair.enlargement).T
    # one that cannot be read may be anywhere, and so may be the closest
    is_hidden = (rows < ABSENT).any(axis=1) & ((rows != ABSENT).sum(axis=1) > 1)
    return np.array((np.where(is_hidden, -np.inf, least), least, np.where(is_hidden, -np.inf, low), high))


def _flags(scene: TraceScene, membership: Membership) -> Flags:
    """Return the state of a binding in each sample, (T,) (see `Membership`)."""
    _, members, unknown = scene.members(membership.group)
    if not membership.chosen:
        return np.where(unknown, -1, 0).astype(np.int8)
    return np.asarray(members[:, membership.chosen].min(axis=1))
