"""How finely and how carefully is planned in a simulated world."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

from spatial_replay.planning.settings import Settings, Skill
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.simulation.world import World


@dataclass(frozen=True, slots=True)
class _Care:
    """How finely and carefully is planned for a skill, in metres."""

    cell_size: float
    margin: float
    constraint_margin: float
    clearance: float
    room: float


_CARE: MappingProxyType[Skill, _Care] = MappingProxyType(
    {
        # a block that is pushed ends up within a centimetre of where it should
        "push": _Care(cell_size=0.005, margin=0.012, constraint_margin=0.008, clearance=0.0, room=0.0),
        # fingers need room beside what they hold, and the hand above that beside taller things
        "place": _Care(cell_size=0.02, margin=0.01, constraint_margin=0.01, clearance=0.02, room=0.09),
    }
)


def settings_for(world: World) -> Settings:
    """How to plan in a world."""
    bodies, space = world.bodies, world.workspace
    skill: Skill = world.skill
    care = _CARE[skill]
    workspace = Workspace(
        Grid.over(space.xmin, space.ymin, space.xmax, space.ymax, care.cell_size),
        yaws=space.yaws,
        nearest=space.nearest,
        farthest=space.farthest,
        obstacles=tuple(world.obstacles),
        supports=frozenset(body.name for body in bodies if body.support),
        clearance=care.clearance,
    )
    return Settings(
        workspace,
        skill,
        movable=tuple(body.name for body in bodies if body.movable),
        margin=care.margin,
        constraint_margin=care.constraint_margin,
        room=care.room,
    )
