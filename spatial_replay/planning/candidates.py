"""Objects that could be moved to take an edge of the automaton, and which of them is."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from spatial_replay.errors import TraceError
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.displacement import PropositionMaps, proposition_maps
from spatial_replay.planning.maps import gradient_map
from spatial_replay.planning.poses import centre_of
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.step import Candidate, Consideration, Guards
from spatial_replay.planning.subjects import concerns
from spatial_replay.planning.targets import find_target
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample


class Movables:
    """The objects of one sample that can be moved; what is measured of one serves every edge."""

    def __init__(
        self,
        propositions: Sequence[Formula],
        regions: Mapping[str, Outline],
        sample: Sample,
        settings: Settings,
    ) -> None:
        self._propositions, self._regions = propositions, regions
        self._sample, self._settings = sample, settings
        self._maps: dict[str, PropositionMaps] = {}

    def names_for(self, progress: Guards) -> list[str]:
        """The objects that a progress set is about, in the order of the settings."""
        about = {number for cube in progress.cubes for number, _ in cube}
        movable, seen = self._settings.movable, self._sample.objects
        return [
            name
            for name in (sorted(seen) if movable is None else movable)
            if name in seen and any(concerns(self._propositions[number], name) for number in about)
        ]

    def candidate(
        self, name: str, consideration: Consideration, failed: Collection[tuple[float, float]] = ()
    ) -> Candidate:
        """An object with its map for an edge, and where it should go or why it cannot.

        Args:
            failed: places (x, y) where it could not be brought before.

        Raises:
            TraceError: the sample says too little about it.
        """
        tracked = self._sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            raise TraceError(f"object {name!r} is {tracked!r}; give a TrackedObject")
        found = gradient_map(
            self._maps_of(name, tracked),
            consideration.progress.cubes,
            consideration.constraints.cubes,
            self._settings.workspace,
            self._settings.constraint_margin,
        )
        target = find_target(found, tracked, self._settings, failed)
        if isinstance(target, str):
            return Candidate(name, found, None, target)
        return Candidate(name, found, target)

    def _maps_of(self, name: str, tracked: TrackedObject) -> PropositionMaps:
        if name not in self._maps:
            workspace = self._settings.workspace
            pushes = self._settings.skill == "push"
            # what is pushed goes over all cells from where it lies
            grid = workspace.grid.reaching(*centre_of(tracked.footprint)) if pushes else workspace.grid
            self._maps[name] = proposition_maps(
                self._propositions, self._regions, self._sample, name, workspace, grid
            )
        return self._maps[name]


def with_choice(
    consideration: Consideration, candidates: Sequence[Candidate], settings: Settings
) -> Consideration:
    """An edge with its candidates, the best of them chosen; given up, with the reasons, if none can do it.

    The best one has the shortest way if it is pushed, the greatest robustness if it is placed; of equals, the
    first.
    """
    costs = {
        number: each.target.length if settings.skill == "push" else -each.target.robustness
        for number, each in enumerate(candidates)
        if each.target is not None
    }
    if not costs:
        reasons = "; ".join(f"{each.name}: {each.rejected}" for each in candidates)
        reason = (
            f"no object can do it ({reasons})" if reasons else "no object that can be moved matters to it"
        )
        return replace(consideration, candidates=tuple(candidates), pruned=reason)
    chosen = min(costs, key=lambda number: costs[number])
    marked = (replace(each, is_chosen=number == chosen) for number, each in enumerate(candidates))
    return replace(consideration, candidates=tuple(marked))
