"""Picking bodies up with two fingers, which hold them by friction, and placing them elsewhere."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from itertools import pairwise

from spatial_replay.simulation.arm import ABOVE, WIDEST, Motion
from spatial_replay.simulation.grasp import Grasp, Point, best_grasp, surface
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Execution, Stage

_SLOW = 0.15
_SETTING_DOWN = 0.002
"""The height above its support at which a body is released, in metres."""
_LOST_TICKS = 6
"""Ticks without contact after which a body is lost."""
_STRAIGHT = 0.08
"""The longest stretch, in metres, on which the tool's way counts as straight."""
_NEAR = 0.02
"""The tolerance of a body's position, in metres."""


def picking(
    scene: Scene, name: str, goal: Point, yaw: float | None, via: Sequence[Point] = ()
) -> Generator[None, None, Execution]:
    """Pick a body up and place its centre at a point, along others, with `yaw` unless that is None."""
    grasp = best_grasp(scene, name, goal, yaw)
    if isinstance(grasp, Execution):
        return grasp
    stood = scene.pose(name).stands
    at: Stage = "pick"
    trouble = yield from pick_up(scene, name, grasp)
    if not trouble:
        at, trouble = "way", (yield from carry(scene, name, grasp, goal, via))
    if not trouble:
        at, trouble = "place", (yield from set_down(scene, name, goal))
    yield from let_go(scene, grasp.opening)
    trouble = trouble or missed(scene, name, goal, stood=stood)
    return Execution(False, trouble, at) if trouble else Execution(True, f"placed {name}")


def pick_up(scene: Scene, name: str, grasp: Grasp) -> Generator[None, None, str]:
    """Grasp a body and lift it; return the reason of a failure, or ""."""
    (x, y), trouble = scene.place_of(name), (yield from take_hold(scene, name, grasp))
    if trouble:
        return trouble
    lifted = yield from _holding(scene, name, scene.arm.move(x, y, ABOVE, speed=2 * _SLOW))
    return "" if lifted else f"{name} slipped out of the fingers as it was lifted"


def take_hold(scene: Scene, name: str, grasp: Grasp) -> Generator[None, None, str]:
    """Close the fingers on a body where it stands; return the reason of a failure, or ""."""
    arm, (x, y) = scene.arm, scene.place_of(name)
    z = scene.height(name)[0] + grasp.above_bottom
    yield from arm.travel(x, y, grasp.yaw)
    yield from arm.grip(grasp.opening)
    yield from arm.move(x, y, z + 0.05)
    yield from arm.move(x, y, z, speed=_SLOW)
    yield from arm.grip(0.0)
    if scene.engine.fingers_touching(name) < 2:
        return f"the fingers closed beside {name}"
    return ""


def carry(
    scene: Scene, name: str, grasp: Grasp, goal: Point, via: Sequence[Point] = ()
) -> Generator[None, None, str]:
    """Move the held body above a point, along others; return the reason of a failure, or ""."""
    for point in _fine(scene.place_of(name), (*via, goal)) if via else (goal,):
        x, y = _tool_for(scene, name, point, grasp.turn)
        carried = yield from _holding(scene, name, scene.arm.travel(x, y, grasp.turn))
        if not carried:
            return f"{name} slipped out of the fingers on the way"
    return ""


def turn_on_the_spot(scene: Scene, name: str, yaw: float) -> Generator[None, None, str]:
    """Turn a body on its support between the fingers; return the reason of a failure, or ""."""
    grasp = best_grasp(scene, name, scene.place_of(name), yaw, is_lifted=False)
    if isinstance(grasp, Execution):
        return grasp.reason
    trouble = yield from take_hold(scene, name, grasp)
    if not trouble:
        turned = yield from _holding(scene, name, scene.arm.move(*scene.arm.commanded, grasp.turn))
        trouble = "" if turned else f"{name} slipped out of the fingers as it was turned"
    yield from let_go(scene, grasp.opening)
    return trouble


def put_back(scene: Scene, name: str) -> Motion:
    """Put down what the fingers hold, where it is, and open them."""
    if scene.engine.fingers_touching(name):
        yield from set_down(scene, name, scene.place_of(name))
    yield from let_go(scene, WIDEST)


def _fine(start: Point, points: Sequence[Point]) -> list[Point]:
    """Return points along straight lines, so close that the tool's way hardly leaves these."""
    fine = []
    for begin, end in pairwise((start, *points)):
        count = max(1, math.ceil(math.dist(begin, end) / _STRAIGHT))
        shares = (step / count for step in range(1, count + 1))
        fine += [(begin[0] + s * (end[0] - begin[0]), begin[1] + s * (end[1] - begin[1])) for s in shares]
    return fine


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
