"""Simulated worlds: bodies with contact, a robot that moves them, and samples of their poses."""

from __future__ import annotations

from spatial_replay.simulation.world import Body, Execution, ReachableArea, World

__all__ = ["Body", "Execution", "ReachableArea", "World"]
