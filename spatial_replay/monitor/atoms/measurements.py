"""The leaves of whole traces, computed from signals and cached measurements."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from spatial_replay.compiled import over_cores
from spatial_replay.geometry.arrays import Flags, Floats
from spatial_replay.geometry.measure import (
    MeasureRequest,
    Operand,
    closest_pairs,
    measure,
    misalignment,
)
from spatial_replay.monitor.atoms.instructions import ClosestPair, LeafCode, Membership, run_instructions
from spatial_replay.monitor.atoms.terms import Bindings, TraceScene
from spatial_replay.spec.formula import (
    Centre,
    Enlarged,
    Formula,
    Measurement,
    RegionName,
    Term,
)
from spatial_replay.spec.walks import base_of
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import ABSENT

_SHARE = 200_000
"""Minimum work of a thread: instructions times samples."""


def measurement_values(scene: TraceScene, measurements: Sequence[Measurement]) -> tuple[Floats, Floats]:
    """Compute each measurement in each sample of a scene, or read it from the trace's cache.

    Returns:
        values (K, T), NaN where unknown, and the spreads of the values from uncertainty (K, T).
    """
    keys = [_key(scene, measurement) for measurement in measurements]
    cache = scene.trace.cache
    arrays = {key: array for key in keys if (array := cache.get(key)) is not None}
    missing_measurements = {
        key: measurement for key, measurement in zip(keys, measurements, strict=True) if key not in arrays
    }
    if missing_measurements:
        for key, array in zip(
            missing_measurements, _measure(scene, list(missing_measurements.values())), strict=True
        ):
            cache.put(key, array)
            arrays[key] = array
    if not keys:
        return np.empty((0, len(scene))), np.empty((0, len(scene)))
    values = np.array([arrays[key][0] for key in keys])
    if scene.is_sure:
        return values, np.zeros(values.shape)
    return values, np.array([arrays[key][1] for key in keys])


def _measure(scene: TraceScene, measurements: Sequence[Measurement]) -> list[Floats]:
    """Compute values and spreads of all measurements in one kernel call.

    Returns:
        (2, T) for each measurement: values, NaN where unknown, and spreads. If the scene is sure, (1, T)
        without spreads.
    """
    operand_numbers: dict[Term, int] = {}
    operands: list[Operand] = []

    def operand(term: Term) -> int:
        if term not in operand_numbers:
            operand_numbers[term] = len(operands)
            operands.append(scene.resolve(term).operand)
        return operand_numbers[term]

    requests = [
        MeasureRequest(measurement.quantity, *map(operand, measurement.terms))
        for measurement in measurements
        if not measurement.needs_orientation
    ]
    values = iter(measure(scene.batch, operands, requests) if requests else ())
    arrays = []
    for measurement in measurements:
        resolved_terms = [scene.resolve(term) for term in measurement.terms]
        if measurement.needs_orientation:
            value, spread = misalignment(*(term.yaw for term in resolved_terms)), np.zeros(len(scene))
        else:
            value, spread = next(values), reduce(np.add, [term.spread for term in resolved_terms])
        is_unknown = reduce(np.logical_or, [term.unknown for term in resolved_terms])
        if is_unknown.any():
            value = np.where(is_unknown, np.nan, value)
        array = np.array([value] if scene.is_sure else [value, spread])
        array.flags.writeable = False
        arrays.append(array)
    return arrays


def _key(scene: TraceScene, measurement: Measurement) -> Hashable:
    """Return the cache key of a measurement, with the shapes of regions instead of their names."""
    # the key has shapes, because an edited specification may use a region's name for another region
    shapes = tuple(scene.regions[name] for name in map(_region, measurement.terms) if name is not None)
    # `skip` is part of the key, because arrays begin with the sample `skip`
    if not shapes:
        return scene.skip, measurement
    return scene.skip, measurement.with_terms(*map(_without_region_name, measurement.terms)), shapes


def _region(term: Term) -> str | None:
    base = base_of(term)
    return base.name if isinstance(base, RegionName) else None


def _without_region_name(term: Term) -> Term:
    if isinstance(term, Enlarged | Centre):
        inner_term: Any = _without_region_name(term.term)
        return replace(term, term=inner_term)
    return RegionName("") if _region(term) is not None else term


def leaf_values(scene: TraceScene, leaves: Sequence[Formula], bindings: Bindings) -> Floats:
    """Compute each leaf in each sample of a scene.

    Returns:
        (C, A, T) in C channels. C is 1 if all values are known. C is 2, for low and high ends, if a value is
        unknown. C is 4, for both ends without and with uncertainty, if a value is uncertain.

    Raises:
        UsageError: the bindings exceed `MAX_BINDINGS`.
    """
    code = LeafCode(scene)
    outputs = np.array(code.add_leaves(leaves, bindings), np.int64)
    values, spreads = measurement_values(scene, list(code.measurements))
    sample_count = len(scene)
    signals = np.array([scene.signal(signal) for signal in code.signals]).reshape(
        len(code.signals), sample_count
    )
    membership_rows = np.array([_flags(scene, membership) for membership in code.members], np.int8)
    membership_rows = membership_rows.reshape(len(code.members), sample_count)
    closest_ends = np.array([_closest(scene, pair) for pair in code.closest]).reshape(
        len(code.closest), 4, sample_count
    )
    instruction_rows = np.array(list(code.rows), np.int64).reshape(len(code.rows), 4)
    constants = np.array(list(code.constants), np.float64)
    # a comparison of a number with a text is unknown
    has_texts = (signals <= TEXTS).any() or (np.isfinite(constants) & (constants <= TEXTS)).any()
    is_known = np.isfinite(values).all() and np.isfinite(signals).all() and not (membership_rows < 0).any()
    is_known = is_known and not has_texts and (closest_ends[:, 0] == closest_ends[:, 1]).all()
    is_sure = (scene.is_sure or not spreads.any()) and (closest_ends[:, :2] == closest_ends[:, 2:]).all()
    channel_count = 4 if not is_sure else 1 if is_known else 2
    leaf_numbers = np.empty((channel_count, len(outputs), sample_count))
    kernel_arguments = (
        instruction_rows.reshape(-1), constants, values.reshape(-1), spreads.reshape(-1), signals.reshape(-1),
        closest_ends.reshape(-1), membership_rows.reshape(-1), outputs, leaf_numbers,
    )  # fmt: skip
    over_cores(
        run_instructions,
        lambda begin, end: run_instructions(*kernel_arguments, begin, end),
        sample_count,
        _SHARE // max(len(instruction_rows), 1) + 1,
    )
    return leaf_numbers


def _closest(scene: TraceScene, pair: ClosestPair) -> Floats:
    """Compute the ends of a closest pair's distance, (4, T), or read them from the trace's cache."""
    cache, key = scene.trace.cache, (scene.skip, pair)
    ends = cache.get(key)
    if ends is None:
        rows, uncertainty = scene.resolve(pair.group).operand.rows, scene.trace.uncertainty
        nominal, low, high = closest_pairs(scene.batch, rows, uncertainty, pair.enlargement).T
        # a member with unknown position may belong to the closest pair
        is_hidden = (rows < ABSENT).any(axis=1) & ((rows != ABSENT).sum(axis=1) > 1)
        nominal_low, wide_low = (np.where(is_hidden, -np.inf, distances) for distances in (nominal, low))
        ends = np.stack((nominal_low, nominal, wide_low, high))
        ends.flags.writeable = False
        cache.put(key, ends)
    return ends


def _flags(scene: TraceScene, membership: Membership) -> Flags:
    """Return the state of a binding in each sample, (T,) (see `Membership`)."""
    _, members, unknown = scene.members(membership.group)
    if not membership.candidates:
        return np.where(unknown, -1, 0).astype(np.int8)
    return np.asarray(members[:, membership.candidates].min(axis=1))
