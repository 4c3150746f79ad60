"""Atoms and open quantifiers: their values in every sample, from measurements and signals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.geometry.arrays import Flags, Floats
from spatial_replay.monitor.leaf_code import LeafCode, Membership
from spatial_replay.monitor.leaf_kernel import run_instructions
from spatial_replay.monitor.measurements import measured
from spatial_replay.monitor.operands import Bindings, Scene
from spatial_replay.spec.formula import Formula


def leaf_values(scene: Scene, leaves: Sequence[Formula], bindings: Bindings) -> Floats:
    """Each leaf in each sample of a scene.

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
    is_known = np.isfinite(values).all() and np.isfinite(signals).all() and not (members < 0).any()
    channels = 4 if spreads.any() else 1 if is_known else 2
    result = np.empty((channels, len(outputs), len(scene)))
    run_instructions(
        np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        np.array(list(code.constants), np.float64),
        values,
        spreads,
        signals,
        members,
        np.array(outputs, np.int64),
        result,
    )
    return result


def _flags(scene: Scene, membership: Membership) -> Flags:
    """(T,): what a binding is in each sample (see `Membership`)."""
    _, members, unknown = scene.members(membership.group)
    if not membership.chosen:
        return np.where(unknown, -1, 0).astype(np.int8)
    return np.asarray(members[:, membership.chosen].min(axis=1))
