"""The leaves of whole traces, from signals and from measurements that the trace caches."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import reduce

import numpy as np

from spatial_replay.cores import over_cores
from spatial_replay.geometry.arrays import Flags, Floats
from spatial_replay.geometry.closest import closest_pairs
from spatial_replay.geometry.measure import MeasureRequest, Operand, Quantity, measure, misalignment
from spatial_replay.monitor.atoms.closest_pair import ClosestPair
from spatial_replay.monitor.atoms.instructions import LeafCode, Membership, run_instructions
from spatial_replay.monitor.atoms.terms import Bindings, TraceScene
from spatial_replay.spec.formula import (
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
    values = iter(measure(scene.batch, operands, requests) if requests else ())
    result = []
    for each in measurements:
        found = [scene.resolve(term) for term in measured_terms(each)]
        value = misalignment(found[0].yaw, found[1].yaw) if isinstance(each, Misalignment) else next(values)
        unknown = reduce(np.logical_or, [one.unknown for one in found])
        if unknown.any():
            value = np.where(unknown, np.nan, value)
        columns = [value]
        if not scene.is_sure:
            is_turn = isinstance(each, Misalignment)
            spread = np.zeros(len(scene)) if is_turn else reduce(np.add, [one.spread for one in found])
            columns.append(spread)
        array = np.array(columns)
        array.flags.writeable = False
        result.append(array)
    return result


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
    if isinstance(term, Enlarged):
        return Enlarged(_unnamed(term.term), term.radius)
    return RegionName("") if _region(term) is not None else term


def leaf_values(scene: TraceScene, leaves: Sequence[Formula], bindings: Bindings) -> Floats:
    """Compute each leaf in each sample of a scene.

    Returns:
        (C, A, T) with C = 1 where everything is known, C = 2 (low and high end) where something may not be,
        C = 4 (the same with uncertainty behind them) where there is uncertainty.

    Raises:
        UsageError: more than `MAX_BINDINGS`.
    """
    code = LeafCode(scene)
    outputs = code.add_leaves(leaves, bindings)
    values, spreads = measured(scene, list(code.measurements))
    missing = np.full(len(scene), np.nan)
    signals = np.array(
        [
            scene.trace.signals[name][scene.skip :] if name in scene.trace.signals else missing
            for name in code.signals
        ]
    ).reshape(len(code.signals), len(scene))
    members = np.array([_flags(scene, each) for each in code.members], np.int8)
    members = members.reshape(len(code.members), len(scene))
    closest = np.array([_closest(scene, each) for each in code.closest]).reshape(
        len(code.closest), 4, len(scene)
    )
    is_known = np.isfinite(values).all() and np.isfinite(signals).all() and not (members < 0).any()
    is_known = is_known and (closest[:, 0] == closest[:, 1]).all()
    is_sure = (scene.is_sure or not spreads.any()) and (closest[:, :2] == closest[:, 2:]).all()
    channels = 4 if not is_sure else 1 if is_known else 2
    result = np.empty((channels, len(outputs), len(scene)))
    arguments = (
        np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        np.array(list(code.constants), np.float64),
        values,
        spreads,
        signals,
        closest,
        members,
        np.array(outputs, np.int64),
        result,
    )
    over_cores(
        run_instructions,
        lambda begin, end: run_instructions(*arguments, begin, end),
        result.shape[2],
        _SHARE // max(len(code.rows), 1) + 1,
    )
    return result


def _closest(scene: TraceScene, pair: ClosestPair) -> Floats:
    """Compute the ends of a closest pair's distance, (4, T), or take them from the trace's cache."""
    cache, key = scene.trace.cache, (scene.skip, pair)
    found = cache.get(key)
    if found is None:
        operand = scene.resolve(pair.group).operand
        trace = scene.trace
        least, low, high = closest_pairs(scene.batch, operand.rows, trace.uncertainty, pair.enlargement).T
        # one that cannot be read may be anywhere, and so may be the closest
        is_hidden = (operand.rows < ABSENT).any(axis=1) & ((operand.rows != ABSENT).sum(axis=1) > 1)
        found = np.array(
            (np.where(is_hidden, -np.inf, least), least, np.where(is_hidden, -np.inf, low), high)
        )
        found.flags.writeable = False
        cache.put(key, found)
    return found


def _flags(scene: TraceScene, membership: Membership) -> Flags:
    """Return the state of a binding in each sample, (T,) (see `Membership`)."""
    _, members, unknown = scene.members(membership.group)
    if not membership.chosen:
        return np.where(unknown, -1, 0).astype(np.int8)
    return np.asarray(members[:, membership.chosen].min(axis=1))
