"""The robot of a simulated world as what executes a planner's steps."""

from __future__ import annotations

from spatial_replay.errors import UsageError
from spatial_replay.planning.settings import Skill
from spatial_replay.planning.step import Outcome, Step
from spatial_replay.simulation.world import World


class WorldExecutor:
    """The robot of a simulated world as an `Executor`."""

    def __init__(self, world: World, skill: Skill) -> None:
        self._world = world
        self._skill = skill

    def execute(self, step: Step) -> Outcome:
        """See `Executor`.

        Raises:
            UsageError: the step moves nothing.
        """
        target = step.target
        if target is None:
            raise UsageError(f"step {step.number} ({step.kind}) moves nothing")
        if self._skill == "push":
            done = self._world.push(target.name, target.waypoints[1:] or target.waypoints)
        else:
            done = self._world.place(target.name, target.x, target.y, target.yaw)
        return Outcome(done.succeeded, done.reason)
