"""The layout of a log for Foxglove and Lichtblick: panels by id, and a tree of splits that places them."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from spatial_replay.annotate.robustness import curved_nodes
from spatial_replay.annotate.scene.scene_template import FRAMES, SceneBounds
from spatial_replay.annotate.specification import MIXED, ReportedTree, unit_of, unit_words
from spatial_replay.annotate.standing import FinalStanding, named_parts, part_title, worst_first
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.schemas.Robustness_pb2 import (
    FAILS_SO_FAR,
    HOLDS_SO_FAR,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
)
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    CAMERA_CALIBRATION,
    CAMERA_VIDEO,
    CURVES_TOPIC,
    EVENT_LOG,
    GRADIENT_MAP,
    LAYOUT,
    PLAN_DECISION,
    PLAN_PATH,
    REDONE_MAP,
    REDONE_PATH,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    STANDING,
    topic_of_camera,
)
from spatial_replay.monitor.online.rewriting import looks_ahead
from spatial_replay.palette import CURVES, FAILING, HOLDING, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal, lighter
from spatial_replay.spec.formula import Formula
from spatial_replay.text import number_text, shortened_formula
from spatial_replay.trace.units import OUR_AXES, Axes

_MOST_CURVES: Final = 12
_MOST_STRIPS: Final = 8
"""More curves, or strips of states, cannot be distinguished."""

_MOST_PLOTS: Final = 3
_MOST_INDICATORS: Final = 24
_LEGEND_PIXELS: Final = 190
"""The width of a legend, beside the curves so that it hides none."""

_LONGEST_LABEL: Final = 24
"""The most characters of a label: what fits into a legend."""

_INDICATOR_PIXELS: Final = 18
_ZERO: Final = "#8c8c8c"

STANDING_COLOURS: Final[Mapping[int, tuple[str, str]]] = MappingProxyType(
    {
        SATISFIED: ("satisfied", hexadecimal(POSITIVE)),
        HOLDS_SO_FAR: ("holds so far", hexadecimal(HOLDING)),
        FAILS_SO_FAR: ("fails so far", hexadecimal(FAILING)),
        VIOLATED: ("violated", hexadecimal(NEGATIVE)),
        UNKNOWN: ("unknown", hexadecimal(NEUTRAL)),
    }
)
"""Each number of `Standing` in words, and the colour that it has where a panel lets us choose it."""

Config = dict[str, Any]


class Panel(NamedTuple):
    """A panel: its identifier, and how it is set."""

    identifier: str
    config: Config


def scene_panel(
    camera: Mapping[str, Any], topics: Collection[str], axes: Axes = OUR_AXES, *, redone: bool = False
) -> Panel:
    """Return the scene from above, with the planner's map below it and its path above.

    Args:
        redone: show what the planner would have decided otherwise, instead of what it decided.
    """
    grid, path = (REDONE_MAP, REDONE_PATH) if redone else (GRADIENT_MAP, PLAN_PATH)
    shown: dict[str, Config] = {SCENE: {}, grid: {"colorMode": "rgba-fields"}, path: {}}
    config = {
        "cameraState": camera,
        "followMode": "follow-none",
        "followTf": FRAMES[0],
        "topics": {topic: {"visible": True, **how} for topic, how in shown.items() if topic in topics},
        "scene": {"labelScaleFactor": 1},
        # its axes are a metre long, whatever the scene's size
        "transforms": {f"frame:{frame}": {"visible": False} for frame in FRAMES},
    }
    title = "Scene, redone" if redone else "Scene"
    shown_title = title if axes == OUR_AXES else f"{title}, {axes}"
    return _titled("3D!redone" if redone else "3D!scene", shown_title, config)


def indicators(trees: Sequence[ReportedTree], outcomes: Sequence[FinalStanding] = ()) -> list[Panel]:
    """Return a light for each result, in the colour of how it stands at the cursor.

    Args:
        outcomes: of the finished log; titles say since when, by how much and over what results are violated.
    """
    titles = [tree.title for tree in trees]
    for index, outcome in enumerate(outcomes):
        titles[index] += _violation_text(outcome)
    rules = [
        {"operator": "=", "rawValue": str(number), "color": colour, "label": words}
        for number, (words, colour) in STANDING_COLOURS.items()
    ]
    return [
        _titled(
            f"Indicator!result{index}",
            titles[index],
            {
                "path": _standing_path(tree.title, "standing"),
                "style": "background",
                "fontSize": _INDICATOR_PIXELS,
                "rules": rules,
                "fallbackColor": STANDING_COLOURS[UNKNOWN][1],
                "fallbackLabel": "not evaluated",
            },
        )
        for index, tree in enumerate(trees[:_MOST_INDICATORS])
    ]


def result_curves(trees: Sequence[ReportedTree], units: Mapping[str, str]) -> list[Panel]:
    """Return the curves of the results, those of each unit in a panel of their own."""
    curves = [
        _Curve(tree.title, _standing_path(tree.title, "robustness"), unit_of(tree.formula, units))
        for tree in trees
    ]
    return _plots("robustness", "Robustness of results", curves)


def part_curves(trees: Sequence[ReportedTree], units: Mapping[str, str]) -> list[Panel]:
    """Return the curves of named specs, those of each unit in a panel of their own."""
    curves = [
        _Curve(
            name if is_clear else part_title(name, tree),
            _standing_path(part_title(name, tree), "robustness"),
            unit_of(node, units),
        )
        for tree, name, node, is_clear in _parts(trees)
    ]
    return _plots("parts", "Robustness of named specs", curves)


def whole_curves(trees: Sequence[ReportedTree], units: Mapping[str, str]) -> list[Panel]:
    """Return the curves over the whole log of each result, then of its named specs."""
    curves = [
        _Curve(tree.title, f"{_curves_path(tree, 0)}.value[:]", unit_of(tree.formula, units))
        for tree in trees
    ]
    curves += [
        _Curve(
            part_title(node.name, tree),
            f"{_curves_path(tree, identifier)}.{_shown_number(node)}[:]",
            unit_of(node, units),
        )
        for tree in trees
        for identifier, node in curved_nodes(tree.formula).items()
        if identifier and node.name
    ]
    times = {"enabled": True, "value": f"{CURVES_TOPIC}.time[:]"}
    whole = {"xAxisVal": "currentCustom", "xAxisPath": times, "isSynced": False}
    return [
        Panel(panel.identifier, {**panel.config, **whole})
        for panel in _plots("whole", "Robustness over the whole log", curves)
    ]


def state_strips(trees: Sequence[ReportedTree], has_states: Sequence[bool]) -> Panel:
    """Return a strip for how each result stands, then for its automaton's state and its named specs."""
    strips = [(tree.title, _standing_path(tree.title, "standing"), True) for tree in trees]
    more = [
        (f"{_short(tree.title)}: automaton", _standing_path(tree.title, "automaton"), False)
        for tree, has_state in zip(trees, has_states, strict=True)
        if has_state
    ]
    more += [
        (part_title(name, tree), _standing_path(part_title(name, tree), "standing"), True)
        for tree, name, node, _ in _parts(trees)
        if looks_ahead(node)
    ]
    # Foxglove takes its colours from here, Lichtblick from the numbers
    states = [
        {"value": str(number), "label": words, "color": colour}
        for number, (words, colour) in STANDING_COLOURS.items()
    ]
    paths = [
        {
            "enabled": True,
            "label": label,
            "timestampMethod": "receiveTime",
            "value": path,
            **({"customStates": {"type": "discrete", "states": states}} if is_standing else {}),
        }
        for label, path, is_standing in [*strips, *more[:_MOST_STRIPS]]
    ]
    return _titled("StateTransitions!verdicts", "How results stand", {"isSynced": True, "paths": paths})


def node_table() -> Panel:
    """Return the table of the worst result's nodes at the cursor: whether they hold now, and by how much."""
    return _titled("Table!nodes", "Nodes of the worst result, now", {"topicPath": f"{STANDING}.present"})


def violation_table() -> Panel:
    """Return the table of violated results: since when, by how much and over what."""
    return _titled("Table!violated", "Violated results", {"topicPath": f"{STANDING}.violated"})


def event_list() -> Panel:
    """Return the list of events."""
    config = {"minLogLevel": 1, "searchTerms": [], "topicToRender": EVENT_LOG}
    return _titled("RosOut!events", "Events", config)


def specification_text() -> Panel:
    """Return the text of the specification, with its nodes."""
    return _titled("RawMessages!specification", "Specification", {"topicPath": SPECIFICATION})


def decision_reason() -> Panel:
    """Return the reason of the planner's decision."""
    config = {"topicPath": f"{PLAN_DECISION}.reason"}
    return _titled("RawMessages!decision", "Why the planner decided so", config)


def image_panels(images: Sequence[str], topics: Collection[str]) -> list[Panel]:
    """Return the picture of each camera that objects were found by, with the outlines that we draw on it.

    A log without annotated images shows its first topic with images.
    """
    own = {topic_of_camera(CAMERA_VIDEO, number) for number in range(1, len(images) + 1)}
    copied = iter([each for each in images if each not in own])
    panels = []
    for number in range(1, len(images) + 1):
        video, calibration, annotations = (
            topic_of_camera(each, number) for each in (CAMERA_VIDEO, CAMERA_CALIBRATION, CAMERA_ANNOTATIONS)
        )
        if number > 1 and annotations not in topics:
            break
        shown = video if video in images else next(copied, None)
        if shown is None:
            continue
        mode: Config = {"imageTopic": shown}
        if calibration in topics:
            mode["calibrationTopic"] = calibration
        if annotations in topics:
            mode["annotations"] = {annotations: {"visible": True}}
        name = "camera" if number == 1 else f"camera{number}"
        title = "Camera" if number == 1 else f"Camera {number}"
        panels.append(_titled(f"Image!{name}", title, {"imageMode": mode, "synchronize": False}))
    return panels


def constants() -> Panel:
    """Return the playback and the constants, which a live server lets a viewer edit."""
    title = "Playback and constants of the specification"
    return _titled("Parameters!constants", title, {"title": title})


def summary() -> Panel:
    """Return what the whole log comes to, with the constants as they are set."""
    return _titled("RawMessages!summary", "The whole log", {"topicPath": f"{CURVES_TOPIC}.summary"})


def _violation_text(outcome: FinalStanding) -> str:
    if outcome.standing != VIOLATED:
        return ""
    since = f", violated since {outcome.since_s:.3f} s"
    if outcome.over:
        # the number of what is named: that of the result may be another atom's, in another unit
        by = f" by {outcome.over_by}" if outcome.over_by else ""
        return f"{since}: {shortened_formula(outcome.over)}{by}"
    unit = f" {outcome.unit}" if outcome.unit and outcome.unit != MIXED else ""
    by = f" by {number_text(outcome.by)}{unit}" if math.isfinite(outcome.by) else ""
    return f"{since}{by}"


def _titled(identifier: str, title: str, config: Config) -> Panel:
    # each of the two viewers reads a key of its own
    return Panel(identifier, {**config, "foxglovePanelTitle": title, "lichtblickPanelTitle": title})


def node_path(
    tree: ReportedTree, *, id: int | None = None, name: str | None = None, field: str = "value"
) -> str:
    """Return the message path of one number of a node, by its id or by its name."""
    which = f"id=={id}" if name is None else f"name=={_quoted(name)}"
    return f"{ROBUSTNESS}{_of(tree)}.nodes[:]{{{which}}}.{field}"


def _parts(trees: Sequence[ReportedTree]) -> Iterator[tuple[ReportedTree, str, Formula, bool]]:
    """Yield the named specs of all results, and whether no two have that name."""
    names = [name for tree in trees for name in named_parts(tree)]
    names += [tree.title for tree in trees]
    for tree in trees:
        for name, (_, node) in named_parts(tree).items():
            yield tree, name, node, names.count(name) == 1


class _Curve(NamedTuple):
    """A curve: its label, the path of its numbers, and their unit."""

    label: str
    path: str
    unit: str


def _plots(name: str, title: str, curves: Sequence[_Curve]) -> list[Panel]:
    """Return a plot for each unit, with a line at 0: above it, things hold."""
    panels = []
    for index, unit in enumerate(list(dict.fromkeys(curve.unit for curve in curves))[:_MOST_PLOTS]):
        own = [curve for curve in curves if curve.unit == unit][:_MOST_CURVES]
        words = unit_words(unit)
        paths = [
            {
                # viewers draw samples as dots of this colour darkened, which cover a dense curve
                "color": lighter(CURVES[index % len(CURVES)]),
                "enabled": True,
                "label": _short(curve.label),
                "timestampMethod": "receiveTime",
                "value": curve.path,
            }
            for index, curve in enumerate(own)
        ]
        zero = {"color": _ZERO, "enabled": True, "label": "0", "timestampMethod": "receiveTime", "value": "0"}
        config = {
            "paths": [*paths, zero],
            "isSynced": True,
            "showLegend": True,
            "legendDisplay": "left",
            "showPlotValuesInLegend": True,
            "sidebarDimension": _LEGEND_PIXELS,
            "xAxisVal": "timestamp",
            "xAxisLabel": "time [s]",
            "yAxisLabel": words,
        }
        panels.append(_titled(f"Plot!{name}{index or ''}", f"{title} [{words}]", config))
    return panels


def _standing_path(title: str, field: str) -> str:
    return f"{STANDING}.results[:]{{name=={_quoted(title)}}}.{field}"


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_LABEL else f"{text[: _LONGEST_LABEL - 1]}…"


def _curves_path(tree: ReportedTree, identifier: int) -> str:
    which = f"{{name=={_quoted(tree.name)}}}{{object=={_quoted(tree.object or '')}}}"
    return f"{CURVES_TOPIC}.specifications[:]{which}.nodes[:]{{id=={identifier}}}"


def _shown_number(node: Formula) -> str:
    return "value" if looks_ahead(node) else "now"


def _of(tree: ReportedTree) -> str:
    return f"{{specification=={_quoted(tree.name)}}}{{object=={_quoted(tree.object or '')}}}"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


_PER_ROW: Final = 6

_MARGIN = 1.5
"""The height of the picture by the size of what is in it; a panel may be narrower than it is high."""


class LayoutContents(NamedTuple):
    """Content of a layout for a log.

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
