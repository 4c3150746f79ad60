"""The panels of a viewer's layout: what each shows of a log.

Their kinds, the part of an identifier before `!`, are those that Foxglove and Lichtblick both have.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, NamedTuple

from spatial_replay.inspection.curves import curved_nodes
from spatial_replay.inspection.drawing import FRAME
from spatial_replay.inspection.specification import ReportedTree, unit_of
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
from spatial_replay.monitor.signal_table import looks_ahead
from spatial_replay.palette import CURVES, lighter
from spatial_replay.spec.formula import Formula, iter_nodes

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
