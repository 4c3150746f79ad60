"""Three blocks on a table, and a robot that pushes them."""

from __future__ import annotations

from collections.abc import Generator

from spatial_replay.planning.decisions import Outcome
from spatial_replay.simulation.arm import Scene, pushing
from spatial_replay.simulation.tabletop import Placement, Scenario
from spatial_replay.simulation.world import Body, Box

_BLOCK = Box(0.04, 0.04, 0.04)


def _block(name: str, x: float, y: float, yaw: float, colour: tuple[float, float, float]) -> Placement:
    return Placement(Body(name, "block", _BLOCK), x, y, yaw, 0.08, colour)


def _script(scene: Scene) -> Generator[None, None, Outcome]:
    """Push red above blue, then green to the right of red and blue."""
    blue_x, blue_y = scene.place_of("blue")
    red_x, _ = scene.place_of("red")
    red_outcome = yield from pushing(scene, "red", [(red_x, blue_y + 0.06)])
    if not red_outcome.succeeded:
        return red_outcome
    _, green_y = scene.place_of("green")
    return (yield from pushing(scene, "green", [(blue_x + 0.05, green_y)]))


SCENARIO = Scenario(
    name="push",
    placements=(
        _block("green", 0.35, -0.01, 0.0, (0.2, 0.65, 0.3)),
        _block("red", 0.47, -0.09, 0.4, (0.85, 0.2, 0.2)),
        _block("blue", 0.585, 0.1, 0.8, (0.2, 0.35, 0.85)),
    ),
    workspace={"area": (0.29, -0.2, 0.69, 0.2), "nearest": 0.3, "farthest": 0.71},
    skill="push",
    script=_script,
    scatter_m=0.008,
)
