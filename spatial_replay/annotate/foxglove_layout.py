"""The layout of a log for Foxglove and Lichtblick: panels by id, and a tree of splits that places them."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from spatial_replay.annotate.rings import SceneBounds
from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.annotate.standing import FinalStanding, worst_first
from spatial_replay.annotate.viewer_panels import (
    Panel,
    constants,
    decision_reason,
    event_list,
    image_panels,
    indicators,
    node_table,
    part_curves,
    result_curves,
    scene_panel,
    specification_text,
    state_strips,
    summary,
    violation_table,
    whole_curves,
)
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.schemas.Robustness_pb2 import VIOLATED
from spatial_replay.logs.topics import EVENT_LOG, LAYOUT, PLAN_DECISION, REDONE_MAP
from spatial_replay.trace.units import OUR_AXES, Axes

_PER_ROW: Final = 6

_MARGIN = 1.5
"""The height of the picture by the size of what is in it; a panel may be narrower than it is high."""


class LayoutContents(NamedTuple):
    """What a layout shows of a log.

    Attributes:
        trees: its results.
        has_states: of each, whether the log has the states of its automaton.
        extent: where its footprints are; None if it has none.
        topics: all that have messages.
        axes: those of the source, which the title of the scene says where they are not ours.
        units: those that are declared, see `unit_of`.
        outcomes: of each tree, what it came to; empty while that can change.
        order: the places of the trees, the worst first; empty while that is not known.
        images: the topics with images.
    """

    trees: Sequence[ReportedTree]
    has_states: Sequence[bool]
    extent: SceneBounds | None
    topics: Collection[str]
    axes: Axes = OUR_AXES
    units: Mapping[str, str] = MappingProxyType({})
    outcomes: Sequence[FinalStanding] = ()
    images: Sequence[str] = ()
    order: Sequence[int] = ()

    def worst_first(self) -> LayoutContents:
        """Return the same with the worst results first, which then have lights and curves if not all can."""
        order = self.order or worst_first(self.outcomes) or range(len(self.trees))
        return self._replace(
            trees=[self.trees[place] for place in order],
            has_states=[self.has_states[place] for place in order],
            outcomes=[self.outcomes[place] for place in order] if self.outcomes else (),
            order=(),
        )


def layout_attachment(contents: LayoutContents) -> Attachment:
    """Return the layout of a log as a file to attach to it (see `viewer_layout`)."""
    return _attachment(viewer_layout(contents))


def live_layout_attachment(contents: LayoutContents) -> Attachment:
    """Return the layout for a server that replays a log as a file (see `layout_for_live`)."""
    return _attachment(layout_for_live(contents))


def viewer_layout(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout of a log: the scene on the left, its evaluation on the right.

    If the log has a planner's decisions, its map lies under the scene, and the reasons are listed below it.
    """
    contents = contents.worst_first()
    return _layout(contents, _scene_panels(contents), _evaluation_panels(contents))


def layout_for_live(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout for a server that replays a log: with the curves of the whole log at any time, and
    the constants that a viewer may edit."""
    contents = contents.worst_first()
    left = [*_scene_panels(contents), (constants(), 1.5)]
    panels = _evaluation_panels(contents)
    if panels:
        # the curves of the whole log include those played so far
        played = len(result_curves(contents.trees, contents.units))
        panels[:played] = [(panel, 3.0) for panel in whole_curves(contents.trees, contents.units)]
        panels.insert(0, (violation_table(), 1.5))
        left.append((summary(), 0.7))
    return _layout(contents, left, panels)


_Weighted = tuple[Panel, float]
"""A panel, and its share of the space beside its neighbours."""


def _scene_panels(contents: LayoutContents) -> list[_Weighted]:
    """Return the pictures of cameras, the scene and, of a planner, its reasons."""
    about = _camera(contents.extent), contents.topics, contents.axes
    scenes = [(scene_panel(*about), 4.0)]
    if REDONE_MAP in contents.topics:
        scenes.append((scene_panel(*about, redone=True), 4.0))
    cameras = [(each, 4.0) for each in image_panels(contents.images, contents.topics)]
    return [*cameras, *scenes, *([(decision_reason(), 1.0)] if PLAN_DECISION in contents.topics else [])]


def _evaluation_panels(contents: LayoutContents) -> list[_Weighted]:
    """Return the panels of the evaluation, from top to bottom."""
    trees = contents.trees
    if not trees:
        return []
    panels = [(panel, 3.0) for panel in result_curves(trees, contents.units)]
    if any(outcome.standing == VIOLATED for outcome in contents.outcomes):
        panels.insert(0, (violation_table(), 1.5))
    panels += [(panel, 2.0) for panel in part_curves(trees, contents.units)]
    panels.append((state_strips(trees, contents.has_states), 3.0))
    if EVENT_LOG in contents.topics:
        panels.append((event_list(), 2.0))
    return [*panels, (node_table(), 2.0), (specification_text(), 1.0)]


def _attachment(layout: dict[str, Any]) -> Attachment:
    text = json.dumps(layout, indent=1, sort_keys=True, ensure_ascii=False)
    return Attachment(LAYOUT, "application/json", text.encode())


def _layout(
    contents: LayoutContents, left: Sequence[_Weighted], right: Sequence[_Weighted]
) -> dict[str, Any]:
    """Return a layout: the lights of the results at the top, and two columns below them."""
    lights = indicators(contents.trees, contents.outcomes)
    rows = [lights[begin : begin + _PER_ROW] for begin in range(0, len(lights), _PER_ROW)]
    tree = _split("column", [(panel.identifier, share) for panel, share in left])
    if right:
        second = _split("column", [(panel.identifier, share) for panel, share in right])
        tree = {"direction": "row", "first": tree, "second": second, "splitPercentage": 45}
    if rows:
        lit: list[tuple[_Tree, float]] = [
            (_split("row", [(panel.identifier, 1.0) for panel in row]), 1.0) for row in rows
        ]
        tree = _split("column", [*lit, (tree, _LIT_SHARE)])
    return {
        "configById": {
            panel.identifier: panel.config for panel in (*lights, *(panel for panel, _ in (*left, *right)))
        },
        "globalVariables": {},
        "layout": tree,
        "playbackConfig": {"speed": 1},
        "userNodes": {},
    }


_Tree = str | dict[str, Any]
_LIT_SHARE: Final = 9.0
"""How much higher the panels below the lights are than a row of these."""


def _split(direction: str, parts: Sequence[tuple[_Tree, float]]) -> _Tree:
    """Return panels beside or below each other, as nested splits."""
    (first, share), *rest = parts
    if not rest:
        return first
    whole = share + sum(other for _, other in rest)
    return {
        "direction": direction,
        "first": first,
        "second": _split(direction, rest),
        "splitPercentage": round(100.0 * share / whole),
    }


def _camera(extent: SceneBounds | None) -> dict[str, Any]:
    """Return a camera that looks straight down and fits the box."""
    box = extent or SceneBounds(-1.0, -1.0, 1.0, 1.0)
    distance = _MARGIN * max(box.xmax - box.xmin, box.ymax - box.ymin) or 1.0
    return {
        "perspective": False,
        "distance": distance,
        "phi": 0,
        "thetaOffset": 0,
        # viewers place the target at the followed frame, so the offset moves the view
        "target": [0, 0, 0],
        "targetOffset": [(box.xmin + box.xmax) / 2, (box.ymin + box.ymax) / 2, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": distance / 1000,
        "far": distance * 100,
    }
