"""A viewer's layout for one log: what to open so that everything in it is seen at once.

The form is the one that Foxglove and Lichtblick import: panels by id, and a tree of splits that places them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from spatial_replay.inspection.specification import ReportedTree
from spatial_replay.logs.sink import Attachment
from spatial_replay.logs.topics import ROBUSTNESS, SCENE, SPECIFICATION
from spatial_replay.trace.trace import Trace

LAYOUT = "layout.json"
"""Name of the attachment; a replay replaces it."""

_SCENE_PANEL, _CURVES_PANEL, _SPECIFICATION_PANEL = "3D!scene", "Plot!robustness", "RawMessages!specification"
_PLOTTED = 12


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
        vertices = vertices[np.isfinite(vertices).all(axis=1)]
        if not len(vertices):
            return before
        low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
        if before is not None:
            low = [min(low[0], before.xmin), min(low[1], before.ymin)]
            high = [max(high[0], before.xmax), max(high[1], before.ymax)]
        return cls(low[0], low[1], high[0], high[1])


def layout_attachment(trees: Sequence[ReportedTree], extent: Extent | None) -> Attachment:
    """The layout as a file to be kept in the log: the scene from above, the curves, the specification."""
    text = json.dumps(viewer_layout(trees, extent), indent=1, sort_keys=True, ensure_ascii=False)
    return Attachment(LAYOUT, "application/json", text.encode())


def viewer_layout(trees: Sequence[ReportedTree], extent: Extent | None) -> dict[str, Any]:
    """The layout as a value; the first results are plotted, each by the value of its root."""
    scene = {
        "cameraState": _camera(extent),
        "followMode": "follow-none",
        "topics": {SCENE: {"visible": True}},
        "scene": {"labelScaleFactor": 1},
    }
    if not trees:
        return _layout({_SCENE_PANEL: scene}, _SCENE_PANEL)
    curves = {
        "paths": [_curve(tree) for tree in trees[:_PLOTTED]],
        "isSynced": True,
        "showLegend": True,
        "xAxisVal": "timestamp",
    }
    panels = {_SCENE_PANEL: scene, _CURVES_PANEL: curves, _SPECIFICATION_PANEL: {"topicPath": SPECIFICATION}}
    beside = {
        "direction": "column",
        "first": _CURVES_PANEL,
        "second": _SPECIFICATION_PANEL,
        "splitPercentage": 65,
    }
    return _layout(
        panels, {"direction": "row", "first": _SCENE_PANEL, "second": beside, "splitPercentage": 55}
    )


def curve_path(tree: ReportedTree) -> str:
    """The message path of a result's root in /spatial/robustness."""
    name = json.dumps(tree.name, ensure_ascii=False)
    instance = json.dumps(tree.object or "", ensure_ascii=False)
    return f"{ROBUSTNESS}{{specification=={name}}}{{object=={instance}}}.nodes[:]{{id==0}}.value"


def _curve(tree: ReportedTree) -> dict[str, Any]:
    label = tree.name if tree.object is None else f"{tree.name}({tree.object})"
    return {"enabled": True, "label": label, "timestampMethod": "receiveTime", "value": curve_path(tree)}


def _camera(extent: Extent | None) -> dict[str, Any]:
    """From straight above, so that the box fits."""
    box = extent or Extent(-1.0, -1.0, 1.0, 1.0)
    distance = 1.3 * max(box.xmax - box.xmin, box.ymax - box.ymin) or 1.0
    return {
        "perspective": False,
        "distance": distance,
        "phi": 0,
        "thetaOffset": 0,
        "target": [(box.xmin + box.xmax) / 2, (box.ymin + box.ymax) / 2, 0],
        "targetOffset": [0, 0, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": distance / 1000,
        "far": distance * 100,
    }


def _layout(panels: dict[str, Any], tree: str | dict[str, Any]) -> dict[str, Any]:
    return {
        "configById": panels,
        "globalVariables": {},
        "layout": tree,
        "playbackConfig": {"speed": 1},
        "userNodes": {},
    }
