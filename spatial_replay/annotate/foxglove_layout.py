"""The layout of a log for Foxglove and Lichtblick: panels by id, and a tree of splits that places them.

The kind of a panel, the part of its identifier before `!`, is one that both viewers have.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.annotate.curves import curved_nodes
from spatial_replay.annotate.scene_entities import FRAME
from spatial_replay.annotate.specification import ReportedTree, unit_of
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.topics import (
    AUTOMATON,
    CURVES_TOPIC,
    EVENT_LOG,
    GRADIENT_MAP,
    LAYOUT,
    PLAN_DECISION,
    PLAN_PATH,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
)
from spatial_replay.monitor.online.operators import looks_ahead
from spatial_replay.palette import CURVES, lighter
from spatial_replay.spec.formula import Formula, iter_nodes
from spatial_replay.trace.axes import OUR_AXES, Axes
from spatial_replay.trace.trace import Trace

_MOST_CURVES: Final = 12
_MOST_STRIPS: Final = 8
"""More curves, or strips of states, cannot be distinguished."""

_LEGEND_PIXELS: Final = 150
"""The width of a legend, beside the curves so that it hides none."""

Config = dict[str, Any]


class Panel(NamedTuple):
    """A panel: its identifier, and how it is set."""

    identifier: str
    config: Config


def scene_panel(camera: Mapping[str, Any], topics: Collection[str], axes: Axes = OUR_AXES) -> Panel:
    """Return the scene from above, with the planner's map below it and its path above."""
    shown: dict[str, Config] = {SCENE: {}, GRADIENT_MAP: {"colorMode": "rgba-fields"}, PLAN_PATH: {}}
    config = {
        "cameraState": camera,
        "followMode": "follow-none",
        "followTf": FRAME,
        "topics": {topic: {"visible": True, **how} for topic, how in shown.items() if topic in topics},
        "scene": {"labelScaleFactor": 1},
        # its axes are a metre long, whatever the scene's size
        "transforms": {f"frame:{FRAME}": {"visible": False}},
    }
    if axes != OUR_AXES:
        # each of the two viewers reads a key of its own
        title = f"Scene, {axes}"
        config |= {"foxglovePanelTitle": title, "lichtblickPanelTitle": title}
    return Panel("3D!scene", config)


def result_curves(trees: Sequence[ReportedTree]) -> Panel:
    """Return the curves of each result's value."""
    paths = [(_label(tree), node_path(tree, id=0)) for tree in trees]
    return Panel("Plot!robustness", _plot(paths[:_MOST_CURVES]))


def part_curves(trees: Sequence[ReportedTree]) -> Panel | None:
    """Return the curves of named specs: `now` of those that do not look ahead; None without any."""
    paths = [
        (f"{name} in {tree.title}", node_path(tree, name=name, field="value" if ahead else "now"))
        for tree in trees
        for name, ahead in named_parts(tree).items()
    ]
    return Panel("Plot!parts", _plot(paths[:_MOST_CURVES])) if paths else None


def whole_curves(trees: Sequence[ReportedTree]) -> Panel:
    """Return the curves over the whole log of each result, then of its named specs."""
    labelled = [(_label(tree), f"{_curves_path(tree, 0)}.value[:]") for tree in trees]
    labelled += [
        (f"{node.name} in {tree.title}", f"{_curves_path(tree, identifier)}.{_shown_number(node)}[:]")
        for tree in trees
        for identifier, node in curved_nodes(tree.formula).items()
        if identifier
    ]
    times = {"enabled": True, "value": f"{CURVES_TOPIC}.time[:]"}
    whole = {"xAxisVal": "currentCustom", "xAxisPath": times, "isSynced": False}
    return Panel("Plot!whole", {**_plot(labelled[:_MOST_CURVES]), **whole})


def state_strips(trees: Sequence[ReportedTree], has_states: Sequence[bool]) -> Panel:
    """Return strips of each result's verdict and automaton state, then of its named specs' verdicts."""
    strips = []
    for tree, has_state in zip(trees, has_states, strict=True):
        strips.append((f"{tree.title}: verdict", node_path(tree, id=0, field="verdict")))
        if has_state:
            strips.append((f"{tree.title}: state", f"{AUTOMATON}{_of(tree)}.states[0]"))
    for tree in trees:
        strips += [
            (f"{name} in {tree.title}: verdict", node_path(tree, name=name, field="verdict"))
            for name, ahead in named_parts(tree).items()
            if ahead
        ]
    paths = [
        {"enabled": True, "label": label, "timestampMethod": "receiveTime", "value": path}
        for label, path in strips[:_MOST_STRIPS]
    ]
    return Panel("StateTransitions!verdicts", {"isSynced": True, "paths": paths})


def node_table(tree: ReportedTree) -> Panel:
    """Return the table of a result's nodes, with their numbers and verdicts at the cursor.

    Viewers take the newest message of the topic, so only the table of the last of several results has rows.
    """
    return Panel("Table!nodes", {"topicPath": f"{ROBUSTNESS}{_of(tree)}.nodes"})


def event_list() -> Panel:
    """Return the list of events."""
    return Panel("RosOut!events", {"minLogLevel": 1, "searchTerms": [], "topicToRender": EVENT_LOG})


def specification_text() -> Panel:
    """Return the text of the specification, with its nodes."""
    return Panel("RawMessages!specification", {"topicPath": SPECIFICATION})


def decision_reason() -> Panel:
    """Return the reason of the planner's decision."""
    return Panel("RawMessages!decision", {"topicPath": f"{PLAN_DECISION}.reason"})


def constants() -> Panel:
    """Return the constants that a live server lets a viewer edit."""
    return Panel("Parameters!constants", {"title": "Constants of the specification"})


def node_path(
    tree: ReportedTree, *, id: int | None = None, name: str | None = None, field: str = "value"
) -> str:
    """Return the message path of one number of a node, by its id or by its name."""
    which = f"id=={id}" if name is None else f"name=={_quoted(name)}"
    return f"{ROBUSTNESS}{_of(tree)}.nodes[:]{{{which}}}.{field}"


def named_parts(tree: ReportedTree) -> dict[str, bool]:
    """Return the names that exactly one node below the root has, each with whether it looks ahead.

    A message path by name would otherwise find several nodes.
    """
    named = [(node.name, node) for _, _, node in iter_nodes(tree.formula) if node.name]
    names = [name for name, _ in named]
    return {name: looks_ahead(node) for name, node in named[1:] if names.count(name) == 1}


def _plot(labelled: Sequence[tuple[str, str]]) -> Config:
    paths = [
        {
            # viewers draw samples as dots of this colour darkened, which cover a dense curve
            "color": lighter(CURVES[index % len(CURVES)]),
            "enabled": True,
            "label": label,
            "timestampMethod": "receiveTime",
            "value": path,
        }
        for index, (label, path) in enumerate(labelled)
    ]
    return {
        "paths": paths,
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "left",
        "sidebarDimension": _LEGEND_PIXELS,
        "xAxisVal": "timestamp",
    }


def _curves_path(tree: ReportedTree, identifier: int) -> str:
    which = f"{{name=={_quoted(tree.name)}}}{{object=={_quoted(tree.object or '')}}}"
    return f"{CURVES_TOPIC}.specifications[:]{which}.nodes[:]{{id=={identifier}}}"


def _shown_number(node: Formula) -> str:
    return "value" if looks_ahead(node) else "now"


def _of(tree: ReportedTree) -> str:
    return f"{{specification=={_quoted(tree.name)}}}{{object=={_quoted(tree.object or '')}}}"


def _label(tree: ReportedTree) -> str:
    """Return the title, with the unit where it is not that of footprints."""
    unit = unit_of(tree.formula, {})
    return f"{tree.title} [{unit}]" if unit else tree.title


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


_MARGIN = 1.5
"""The height of the picture by the size of what is in it; a panel may be narrower than it is high."""


class SceneBounds(NamedTuple):
    """The box that a log's footprints lie in, in footprint units."""

    xmin: float
    ymin: float
    xmax: float
    ymax: float

    @classmethod
    def of(cls, trace: Trace, before: SceneBounds | None = None) -> SceneBounds | None:
        """Return the box of some samples and of those before; None without any footprint."""
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


class LayoutContents(NamedTuple):
    """What a layout shows of a log.

    Attributes:
        trees: its results.
        has_states: of each, whether the log has the states of its automaton.
        extent: where its footprints are; None if it has none.
        topics: all that have messages.
        axes: those of the source, which the title of the scene says where they are not ours.
    """

    trees: Sequence[ReportedTree]
    has_states: Sequence[bool]
    extent: SceneBounds | None
    topics: Collection[str]
    axes: Axes = OUR_AXES


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
    return _layout(_scene_panels(contents), _evaluation_panels(contents))


def layout_for_live(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout for a server that replays a log: with the curves of the whole log at any time, and
    the constants that a viewer may edit."""
    panels = _evaluation_panels(contents)
    if panels:
        # the curves of the whole log include those played so far
        panels[:1] = [(whole_curves(contents.trees), 3.0)]
    return _layout([*_scene_panels(contents), (constants(), 1.0)], panels)


_Weighted = tuple[Panel, float]
"""A panel, and its share of the space beside its neighbours."""


def _scene_panels(contents: LayoutContents) -> list[_Weighted]:
    """Return the scene and, of a planner, its reasons."""
    scene = scene_panel(_camera(contents.extent), contents.topics, contents.axes)
    return [(scene, 4.0), *([(decision_reason(), 1.0)] if PLAN_DECISION in contents.topics else [])]


def _evaluation_panels(contents: LayoutContents) -> list[_Weighted]:
    """Return the panels of the evaluation, from top to bottom."""
    trees = contents.trees
    if not trees:
        return []
    panels = [(result_curves(trees), 3.0)]
    parts = part_curves(trees)
    if parts is not None:
        panels.append((parts, 2.0))
    panels.append((state_strips(trees, contents.has_states), 3.0))
    if EVENT_LOG in contents.topics:
        panels.append((event_list(), 2.0))
    return [*panels, (node_table(trees[-1]), 2.0), (specification_text(), 1.0)]


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
    """Return panels one below the other, as nested splits."""
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
    """Return the least and the greatest coordinates of vertices (V, 2); infinite without any."""
    columns = [vertices[:, axis] for axis in (0, 1)]
    low = [float(column.min(initial=np.inf)) for column in columns]
    return low, [float(column.max(initial=-np.inf)) for column in columns]


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
