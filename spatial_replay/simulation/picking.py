"""Picking bodies up with two fingers, which hold them by friction, and placing them elsewhere."""

from __future__ import annotations

import math
from collections.abc import Generator

from spatial_replay.simulation.arm import ABOVE, Motion
from spatial_replay.simulation.grasp import Grasp, Point, best_grasp, surface
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Execution

_SLOW = 0.15
_SETTING_DOWN = 0.002
"""The height above its support at which a body is released, in metres."""
_LOST_TICKS = 6
"""Ticks without contact after which a body is lost."""
_NEAR = 0.02
"""The tolerance of a body's position, in metres."""


def picking(scene: Scene, name: str, goal: Point, yaw: float | None) -> Generator[None, None, Execution]:
    """Pick a body up and place its centre at a point, with `yaw` unless that is None."""
    grasp = best_grasp(scene, name, goal, yaw)
    if isinstance(grasp, str):
        return Execution(False, grasp)
    stood = scene.pose(name).stands
    trouble = yield from pick_up(scene, name, grasp)
    if not trouble:
        trouble = yield from carry(scene, name, grasp, goal)
    if not trouble:
        trouble = yield from set_down(scene, name, goal)
    yield from let_go(scene, grasp.opening)
    trouble = trouble or missed(scene, name, goal, stood=stood)
    return Execution(not trouble, trouble or f"placed {name}")


def pick_up(scene: Scene, name: str, grasp: Grasp) -> Generator[None, None, str]:
    """Grasp a body and lift it; return the reason of a failure, or ""."""
    arm, (x, y) = scene.arm, scene.place_of(name)
    z = scene.height(name)[0] + grasp.above_bottom
    yield from arm.travel(x, y, grasp.yaw)
    yield from arm.grip(grasp.opening)
    yield from arm.move(x, y, z + 0.05)
    yield from arm.move(x, y, z, speed=_SLOW)
    yield from arm.grip(0.0)
    if scene.engine.fingers_touching(name) < 2:
        return f"the fingers closed beside {name}"
    lifted = yield from _holding(scene, name, arm.move(x, y, ABOVE, speed=2 * _SLOW))
    return "" if lifted else f"{name} slipped out of the fingers as it was lifted"


def carry(scene: Scene, name: str, grasp: Grasp, goal: Point) -> Generator[None, None, str]:
    """Move the held body above a point; return the reason of a failure, or ""."""
    x, y = _tool_for(scene, name, goal, grasp.turn)
    carried = yield from _holding(scene, name, scene.arm.travel(x, y, grasp.turn))
    return "" if carried else f"{name} slipped out of the fingers on the way"


def set_down(scene: Scene, name: str, goal: Point) -> Generator[None, None, str]:
    """Lower the held body onto its support; return the reason of a failure, or ""."""
    arm = scene.arm
    x, y, above = arm.commanded
    # measured now, because the body may hang in another pose than it stood in
    z = surface(scene, name, goal) + above - scene.height(name)[0] + _SETTING_DOWN
    lowered = yield from _holding(scene, name, arm.move(x, y, z + 0.03))
    if lowered:
        lowered = yield from _holding(scene, name, arm.move(x, y, z, speed=_SLOW / 2))
    return "" if lowered else f"{name} slipped out of the fingers as it was set down"


def let_go(scene: Scene, opening: float) -> Motion:
    """Open the fingers, and lift them."""
    x, y, _ = scene.arm.commanded
    yield from scene.arm.grip(opening)
    yield from scene.arm.move(x, y, ABOVE)


def missed(scene: Scene, name: str, goal: Point, *, stood: bool = True) -> str:
    """Return how a released body differs from its goal, or ""."""
    if stood and not scene.pose(name).stands:
        return f"{name} fell over"
    away = math.dist(scene.place_of(name), goal)
    return "" if away <= _NEAR else f"{name} lies {away * 100:.1f} cm from where it was put"


def _tool_for(scene: Scene, name: str, goal: Point, turn: float) -> Point:
    """Return the tool position for which the held body, usually off centre, is at a point."""
    x, y = scene.place_of(name)
    tool_x, tool_y, _ = scene.arm.commanded
    dx, dy, turned = x - tool_x, y - tool_y, turn - scene.arm.yaw
    cosine, sine = math.cos(turned), math.sin(turned)
    return goal[0] - dx * cosine + dy * sine, goal[1] - dx * sine - dy * cosine


def _holding(scene: Scene, name: str, motion: Motion) -> Generator[None, None, bool]:
    """Move while the fingers hold a body; stop and return False when they lose it."""
    lost = 0
    for _ in motion:
        yield
        lost = lost + 1 if scene.engine.fingers_touching(name) == 0 else 0
        if lost >= _LOST_TICKS:
            return False
    return True
