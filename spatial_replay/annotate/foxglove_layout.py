"""A viewer's layout for one log: what to open so that everything in it is seen at once.

The form is the one that Foxglove and Lichtblick import: panels by id, and a tree of splits that places them.

The panels of a viewer's layout: what each shows of a log.

Their kinds, the part of an identifier before `!`, are those that Foxglove and Lichtblick both have.
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
    PLAN_DECISION,
    PLAN_PATH,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
)
from spatial_replay.monitor.online.operators import looks_ahead
from spatial_replay.palette import CURVES, lighter
from spatial_replay.spec.formula import Formula, iter_nodes
from spatial_replay.trace.trace import Trace

_MOST_CURVES: Final = 12
_MOST_STRIPS: Final = 8
"""More curves, or strips of states, than these nobody tells apart."""

_LEGEND_PIXELS: Final = 150
"""The width of a legend; beside the curves it hides none."""

Config = dict[str, Any]


class Panel(NamedTuple):
    """A panel: its identifier, and how it is set."""

    identifier: str
    config: Config


def scene_panel(camera: Mapping[str, Any], topics: Collection[str]) -> Panel:
    """The scene from above; under it the planner's map in the colours that it brings, over it the path."""
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
    return Panel("3D!scene", config)


def result_curves(trees: Sequence[ReportedTree]) -> Panel:
    """The value of each result."""
    paths = [(_label(tree), node_path(tree, id=0)) for tree in trees]
    return Panel("Plot!robustness", _plot(paths[:_MOST_CURVES]))


def part_curves(trees: Sequence[ReportedTree]) -> Panel | None:
    """Each spec that results are made of, what does not look ahead as it is now; None if there is none."""
    paths = [
        (f"{name} in {_title(tree)}", node_path(tree, name=name, field="value" if ahead else "now"))
        for tree in trees
        for name, ahead in named_parts(tree).items()
    ]
    return Panel("Plot!parts", _plot(paths[:_MOST_CURVES])) if paths else None


def whole_curves(trees: Sequence[ReportedTree]) -> Panel:
    """The value of each result, then what it is made of, over the whole log, from the newest message."""
    labelled = [(_label(tree), f"{_curves_path(tree, 0)}.value[:]") for tree in trees]
    labelled += [
        (f"{node.name} in {_title(tree)}", f"{_curves_path(tree, identifier)}.{_shown_number(node)}[:]")
        for tree in trees
        for identifier, node in curved_nodes(tree.formula).items()
        if identifier
    ]
    times = {"enabled": True, "value": f"{CURVES_TOPIC}.time[:]"}
    whole = {"xAxisVal": "currentCustom", "xAxisPath": times, "isSynced": False}
    return Panel("Plot!whole", {**_plot(labelled[:_MOST_CURVES]), **whole})


def state_strips(trees: Sequence[ReportedTree], has_states: Sequence[bool]) -> Panel:
    """The verdict of each result over time and, where it has an automaton, the state of that; then the
    verdicts of the specs that results are made of."""
    strips = []
    for tree, has_state in zip(trees, has_states, strict=True):
        strips.append((f"{_title(tree)}: verdict", node_path(tree, id=0, field="verdict")))
        if has_state:
            strips.append((f"{_title(tree)}: state", f"{AUTOMATON}{_of(tree)}.states[0]"))
    for tree in trees:
        strips += [
            (f"{name} in {_title(tree)}: verdict", node_path(tree, name=name, field="verdict"))
            for name, ahead in named_parts(tree).items()
            if ahead
        ]
    paths = [
        {"enabled": True, "label": label, "timestampMethod": "receiveTime", "value": path}
        for label, path in strips[:_MOST_STRIPS]
    ]
    return Panel("StateTransitions!verdicts", {"isSynced": True, "paths": paths})


def node_table(tree: ReportedTree) -> Panel:
    """The numbers and verdicts of every node of a result, at the time looked at.

    Viewers take the newest message of the topic, so that a table finds the last of several results only.
    """
    return Panel("Table!nodes", {"topicPath": f"{ROBUSTNESS}{_of(tree)}.nodes"})


def event_list() -> Panel:
    """What changed, in words."""
    return Panel("RosOut!events", {"minLogLevel": 1, "searchTerms": [], "topicToRender": EVENT_LOG})


def specification_text() -> Panel:
    """The specification, with the table of nodes."""
    return Panel("RawMessages!specification", {"topicPath": SPECIFICATION})


def decision_words() -> Panel:
    """The planner's decision in words."""
    return Panel("RawMessages!decision", {"topicPath": f"{PLAN_DECISION}.reason"})


def constants() -> Panel:
    """What a live server lets one change."""
    return Panel("Parameters!constants", {"title": "Constants of the specification"})


def node_path(
    tree: ReportedTree, *, id: int | None = None, name: str | None = None, field: str = "value"
) -> str:
    """The message path of one number of a node, by its id or by its name."""
    which = f"id=={id}" if name is None else f"name=={_quoted(name)}"
    return f"{ROBUSTNESS}{_of(tree)}.nodes[:]{{{which}}}.{field}"


def named_parts(tree: ReportedTree) -> dict[str, bool]:
    """Names that one node of a tree has, the root aside, so that a path by name finds it; with whether it
    looks ahead."""
    named = [(node.name, node) for _, _, node in iter_nodes(tree.formula) if node.name]
    names = [name for name, _ in named]
    return {name: looks_ahead(node) for name, node in named[1:] if names.count(name) == 1}


def _plot(labelled: Sequence[tuple[str, str]]) -> Config:
    paths = [
        {
            # samples are dots of this colour darkened, and cover the curve where they are many
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


def _title(tree: ReportedTree) -> str:
    return tree.name if tree.object is None else f"{tree.name}({tree.object})"


def _label(tree: ReportedTree) -> str:
    """With the unit, where it is not that of footprints."""
    unit = unit_of(tree.formula, {})
    return f"{_title(tree)} [{unit}]" if unit else _title(tree)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


LAYOUT = "layout.json"
"""Name of the attachment; a replay replaces it."""

_MARGIN = 1.5
"""The height of the picture by the size of what is in it; a panel may be narrower than it is high."""


class SceneBounds(NamedTuple):
    """The box that a log's footprints have covered so far, in footprint units."""

    xmin: float
    ymin: float
    xmax: float
    ymax: float

    @classmethod
    def of(cls, trace: Trace, before: SceneBounds | None = None) -> SceneBounds | None:
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


class LayoutContents(NamedTuple):
    """What a log has that a layout shows.

    Attributes:
        trees: its results.
        has_states: of each, whether the log has the states of its automaton.
        extent: where its footprints are; None if it has none.
        topics: all that have messages.
    """

    trees: Sequence[ReportedTree]
    has_states: Sequence[bool]
    extent: SceneBounds | None
    topics: Collection[str]


def layout_attachment(contents: LayoutContents) -> Attachment:
    """The layout of a log as a file to be kept in it (see `viewer_layout`)."""
    return _attachment(viewer_layout(contents))


def live_layout_attachment(contents: LayoutContents) -> Attachment:
    """The layout for a server that replays a log as a file (see `layout_for_live`)."""
    return _attachment(layout_for_live(contents))


def viewer_layout(contents: LayoutContents) -> dict[str, Any]:
    """The layout of a log: the scene on the left, what is said of it on the right.

    Where a planner's decisions are in the log, its map lies under the scene and its words below.
    """
    return _layout(_shown(contents), _said(contents))


def layout_for_live(contents: LayoutContents) -> dict[str, Any]:
    """The layout for a server that replays a log: the same, with the curves of the whole log at any time, and
    the constants that it lets one change."""
    said = _said(contents)
    if said:
        # what was played so far is part of the whole
        said[:1] = [(whole_curves(contents.trees), 3.0)]
    return _layout([*_shown(contents), (constants(), 1.0)], said)


_Weighted = tuple[Panel, float]
"""A panel, and its share of the room beside its neighbours."""


def _shown(contents: LayoutContents) -> list[_Weighted]:
    """The scene and, of a planner, its words."""
    scene = scene_panel(_camera(contents.extent), contents.topics)
    return [(scene, 4.0), *([(decision_words(), 1.0)] if PLAN_DECISION in contents.topics else [])]


def _said(contents: LayoutContents) -> list[_Weighted]:
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


def _camera(extent: SceneBounds | None) -> dict[str, Any]:
    """From straight above, so that the box fits."""
    box = extent or SceneBounds(-1.0, -1.0, 1.0, 1.0)
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
