"""Simulated worlds: bodies that touch, a robot that moves them, and samples of where they are."""

from __future__ import annotations

from spatial_replay.simulation.world import Body, Execution, ReachableArea, World

__all__ = ["Body", "Execution", "ReachableArea", "World"]
