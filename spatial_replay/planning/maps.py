"""Gradient maps (Def. 19): how well guards would hold with one object somewhere else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats
from spatial_replay.planning.displacement import PropositionMaps
from spatial_replay.planning.workspace import Grid, Workspace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from spatial_replay.planning.step import Target
    from spatial_replay.trace.sample import Sample

Cube: TypeAlias = tuple[tuple[int, bool], ...]
"""A conjunction of propositions, by number, each to hold or not to; the empty one always holds."""

Cubes: TypeAlias = tuple[Cube, ...]
"""A disjunction of cubes; none never holds."""

FREE: Final = 0
CONSTRAINED: Final = 1
OCCUPIED: Final = 2
OUT_OF_REACH: Final = 3
UNKNOWN: Final = 4
REASONS: Final = ("free", "a constraint would hold", "an obstacle is there", "out of reach", "unknown")
"""Why a cell is blocked, by the number that `GradientMap.blocked` has for it."""


@dataclass(frozen=True, eq=False)
class GradientMap:
    """How well a progress set would hold with an object at each cell (Def. 19).

    Attributes:
        name: of the object.
        grid: the cells; more than the workspace has where an object that is to be pushed lies outside.
        robustness: (A, rows, columns), in the unit of the relations; also at blocked cells.
        blocked: (A, rows, columns) uint8, `FREE` or why the object must not be there (see `REASONS`).
        clearance: (A, rows, columns), signed distance to the nearest obstacle; +inf where there is none.
        turns: (A,) radians by which the object is turned.
    """

    name: str
    grid: Grid
    robustness: Floats
    blocked: NDArray[np.uint8]
    clearance: Floats
    turns: Floats

    @property
    def values(self) -> Floats:
        """(A, rows, columns): the robustness, NaN where cells are blocked."""
        return np.where(self.blocked == FREE, self.robustness, np.nan)

    def best(self) -> float:
        """The greatest robustness at a free cell; -inf where there is none."""
        free = self.blocked == FREE
        return float(self.robustness[free].max()) if free.any() else -np.inf

    def plot(
        self,
        ax: Axes | None = None,
        *,
        turn: int | None = None,
        sample: Sample | None = None,
        target: Target | None = None,
    ) -> Axes:
        """Draw it, with the objects of a sample and the way to a target over it; see `draw_map`."""
        from spatial_replay.planning.map_picture import draw_map

        return draw_map(self, ax, turn=turn, sample=sample, target=target)

    def __repr__(self) -> str:
        cells = f"{self.grid.columns} x {self.grid.rows}"
        return f"<GradientMap of {self.name}: {cells} cells, {self.best():.4g} at best>"

    def _repr_html_(self) -> str:
        from spatial_replay.planning.map_picture import map_html

        return map_html(self)


def gradient_map(
    maps: PropositionMaps,
    progress: Cubes,
    constraints: Cubes,
    workspace: Workspace,
    margin: float = 0.0,
) -> GradientMap:
    """The map of a progress set, blocked where the constraint set would hold.

    Args:
        progress: one of these cubes is to hold.
        constraints: none of these may hold, not even by -`margin`; what may hold for being unknown counts.
        margin: in the unit of the relations, at least 0.
    """
    shape = maps.clearance.shape
    robustness = np.full(shape, -np.inf)
    for cube in progress:
        np.maximum(robustness, _holds(maps.lower, maps.upper, cube, shape), out=robustness)
    danger = np.full(shape, -np.inf)
    for cube in constraints:
        np.maximum(danger, _holds(maps.upper, maps.lower, cube, shape), out=danger)
    blocked = np.zeros(shape, np.uint8)
    blocked[robustness == -np.inf] = UNKNOWN
    blocked[~np.broadcast_to(workspace.within_reach(maps.grid), shape)] = OUT_OF_REACH
    blocked[maps.clearance <= workspace.clearance] = OCCUPIED
    blocked[danger >= -margin] = CONSTRAINED
    return GradientMap(maps.name, maps.grid, robustness, blocked, maps.clearance, maps.turns)


def _holds(positive: Floats, negative: Floats, cube: Cube, shape: tuple[int, ...]) -> Floats:
    """How well a cube holds: the least of its literals."""
    least = np.full(shape, np.inf)
    for number, wanted in cube:
        np.minimum(least, positive[number] if wanted else -negative[number], out=least)
    return least
