"""A viewer's layout for one log: what to open so that everything in it is seen at once.

The form is the one that Foxglove and Lichtblick import: panels by id, and a tree of splits that places them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.inspection.panels import (
    Panel,
    constants,
    decision_words,
    event_list,
    node_table,
    part_curves,
    result_curves,
    scene_panel,
    specification_text,
    state_strips,
    whole_curves,
)
from spatial_replay.inspection.specification import ReportedTree
from spatial_replay.logs.sink import Attachment
from spatial_replay.logs.topics import EVENT_LOG, PLAN_DECISION
from spatial_replay.trace.trace import Trace

LAYOUT = "layout.json"
"""Name of the attachment; a replay replaces it."""

_MARGIN = 1.5
"""The height of the picture by the size of what is in it; a panel may be narrower than it is high."""


class Extent(NamedTuple):
    """The box that a log's footprints have covered so far, in footprint units."""

    xmin: float
    ymin: float
    xmax: float
    ymax: float

    @classmethod
    def of(cls, trace: Trace, before: Extent | None) -> Extent | None:
        """The box of some samples and of those before; None while nothing was seen."""
        vertices = trace.footprints.vertices
        low, high = _corners(vertices)
        if not np.isfinite([low, high]).all():
            vertices = vertices[np.isfinite(vertices).all(axis=1)]
            low, high = _corners(vertices)
        if not len(vertices):
            return before
        if before is not None:
            low = [min(low[0], before.xmin), min(low[1], before.ymin)]
            high = [max(high[0], before.xmax), max(high[1], before.ymax)]
        return cls(low[0], low[1], high[0], high[1])


class Contents(NamedTuple):
    """What a log has that a layout shows.

    Attributes:
        trees: its results.
        has_states: of each, whether the log has the states of its automaton.
        extent: where its footprints are; None if it has none.
        topics: all that have messages.
    """

    trees: Sequence[ReportedTree]
    has_states: Sequence[bool]
    extent: Extent | None
    topics: Collection[str]


def layout_attachment(contents: Contents) -> Attachment:
    """The layout of a log as a file to be kept in it (see `viewer_layout`)."""
    return _attachment(viewer_layout(contents))


def live_layout_attachment(contents: Contents) -> Attachment:
    """The layout for a server that replays a log as a file (see `layout_for_live`)."""
    return _attachment(layout_for_live(contents))


def viewer_layout(contents: Contents) -> dict[str, Any]:
    """The layout of a log: the scene on the left, what is said of it on the right.

    Where a planner's decisions are in the log, its map lies under the scene and its words below.
    """
    return _layout(_shown(contents), _said(contents))


def layout_for_live(contents: Contents) -> dict[str, Any]:
    """The layout for a server that replays a log: the same, with the curves of the whole log at any time, and
    the constants that it lets one change."""
    said = _said(contents)
    if said:
        # what was played so far is part of the whole
        said[:1] = [(whole_curves(contents.trees), 3.0)]
    return _layout([*_shown(contents), (constants(), 1.0)], said)


_Weighted = tuple[Panel, float]
"""A panel, and its share of the room beside its neighbours."""


def _shown(contents: Contents) -> list[_Weighted]:
    """The scene and, of a planner, its words."""
    scene = scene_panel(_camera(contents.extent), contents.topics)
    return [(scene, 4.0), *([(decision_words(), 1.0)] if PLAN_DECISION in contents.topics else [])]


def _said(contents: Contents) -> list[_Weighted]:
    """What is said of the samples, from above to below."""
    trees = contents.trees
    if not trees:
        return []
    said = [(result_curves(trees), 3.0)]
    parts = part_curves(trees)
    if parts is not None:
        said.append((parts, 2.0))
    said.append((state_strips(trees, contents.has_states), 3.0))
    if EVENT_LOG in contents.topics:
        said.append((event_list(), 2.0))
    return [*said, (node_table(trees[-1]), 2.0), (specification_text(), 1.0)]


def _attachment(layout: dict[str, Any]) -> Attachment:
    text = json.dumps(layout, indent=1, sort_keys=True, ensure_ascii=False)
    return Attachment(LAYOUT, "application/json", text.encode())


def _layout(left: Sequence[_Weighted], right: Sequence[_Weighted]) -> dict[str, Any]:
    tree: str | dict[str, Any] = _column(left)
    if right:
        tree = {"direction": "row", "first": tree, "second": _column(right), "splitPercentage": 55}
    return {
        "configById": {panel.identifier: panel.config for panel, _ in (*left, *right)},
        "globalVariables": {},
        "layout": tree,
        "playbackConfig": {"speed": 1},
        "userNodes": {},
    }


def _column(panels: Sequence[_Weighted]) -> str | dict[str, Any]:
    """Panels one below the other, as splits in two."""
    (first, share), *rest = panels
    if not rest:
        return first.identifier
    whole = share + sum(other for _, other in rest)
    return {
        "direction": "column",
        "first": first.identifier,
        "second": _column(rest),
        "splitPercentage": round(100.0 * share / whole),
    }


def _corners(vertices: Floats) -> tuple[list[float], list[float]]:
    """The least and the greatest coordinates (V, 2); of no vertices, none that is finite."""
    columns = [vertices[:, axis] for axis in (0, 1)]
    low = [float(column.min(initial=np.inf)) for column in columns]
    return low, [float(column.max(initial=-np.inf)) for column in columns]


def _camera(extent: Extent | None) -> dict[str, Any]:
    """From straight above, so that the box fits."""
    box = extent or Extent(-1.0, -1.0, 1.0, 1.0)
    distance = _MARGIN * max(box.xmax - box.xmin, box.ymax - box.ymin) or 1.0
    return {
        "perspective": False,
        "distance": distance,
        "phi": 0,
        "thetaOffset": 0,
        # viewers put the target where the followed frame is; what is looked at is the offset from it
        "target": [0, 0, 0],
        "targetOffset": [(box.xmin + box.xmax) / 2, (box.ymin + box.ymax) / 2, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": distance / 1000,
        "far": distance * 100,
    }
