"""The layout of a log for Foxglove and Lichtblick: panels by id, and a tree of splits that places them."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from itertools import zip_longest
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from spatial_replay.annotate.robustness import curved_nodes
from spatial_replay.annotate.scene.extent import VIEW, SceneBounds
from spatial_replay.annotate.scene.scene_frames import STANDING_WORDS
from spatial_replay.annotate.scene.scene_template import FRAMES
from spatial_replay.annotate.specification import FOOTPRINT_UNITS, MIXED, ReportedTree, unit_of, unit_words
from spatial_replay.annotate.standing import FinalStanding, part_title
from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.schemas.Robustness_pb2 import HOLDS_SO_FAR, PENDING, SATISFIED, UNKNOWN, VIOLATED
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    CAMERA_CALIBRATION,
    CAMERA_VIDEO,
    CURVES_TOPIC,
    GRADIENT_MAP,
    LAYOUT,
    MAP_DRAWING,
    PLAN_DECISION,
    PLAN_PATH,
    RECENT_EVENTS,
    REDONE_DRAWING,
    REDONE_MAP,
    REDONE_PATH,
    SCENE,
    SPECIFICATION,
    STANDING,
    topic_of_camera,
)
from spatial_replay.palette import CURVES, hexadecimal, lighter
from spatial_replay.spec.formula import Formula
from spatial_replay.spec.walks import looks_ahead
from spatial_replay.text import Instant, clock_text, cut, number_text, time_text
from spatial_replay.trace.units import OUR_AXES, Axes

_MOST_CURVES: Final = 12
_MOST_STRIPS: Final = 8
"""More curves, or strips of named specs, cannot be distinguished."""

_MOST_PLOTS: Final = 3
_MOST_INDICATORS: Final = 6
"""Lights in one row."""

_LEGEND_PIXELS: Final = 240
"""The width of a legend with the values at the cursor, beside the curves so that it hides none."""

_LONGEST_LABEL: Final = 24
"""The most characters of a label: what fits into a legend."""

_INDICATOR_PIXELS: Final = 18
_ZERO: Final = "#8c8c8c"

_STANDING_COLOURS: Final[Mapping[int, tuple[str, str]]] = MappingProxyType(
    {
        code: (STANDING_WORDS[code][0], hexadecimal(STANDING_WORDS[code][1]))
        for code in (SATISFIED, HOLDS_SO_FAR, PENDING, VIOLATED, UNKNOWN)
    }
)
"""Each number of `Standing` in words, and the colour that it has where a panel lets us choose it."""

Config = dict[str, Any]


class Panel(NamedTuple):
    """A panel: its identifier, and how it is set."""

    identifier: str
    config: Config


def scene_panel(
    camera: Mapping[str, Any], topics: Collection[str], axes: Axes = OUR_AXES, planned_for: str = ""
) -> Panel:
    """Return the scene from above, with the planner's map below it and its path above.

    A viewer can show the planner's redone decisions instead.
    """
    displays: dict[str, Config] = {
        SCENE: {},
        GRADIENT_MAP: {"colorMode": "rgba-fields"},
        MAP_DRAWING: {},
        PLAN_PATH: {},
        REDONE_MAP: {"colorMode": "rgba-fields", "visible": False},
        REDONE_DRAWING: {"visible": False},
        REDONE_PATH: {"visible": False},
    }
    config = {
        "cameraState": camera,
        "followMode": "follow-none",
        "followTf": FRAMES[0],
        "topics": {
            topic: {"visible": True, **display} for topic, display in displays.items() if topic in topics
        },
        # axes are a metre long, whatever the scene's size
        "scene": {"labelScaleFactor": 1, "transforms": {"showLabel": False, "axisScale": 0}},
        "transforms": {f"frame:{frame}": {"visible": False} for frame in FRAMES},
    }
    of = f" of {planned_for} as recorded" if planned_for else ""
    legend = f" (map{of}: vermillion fails, white is 0, blue holds)" if GRADIENT_MAP in topics else ""
    return _title_panel(
        "3D!scene", f"Scene{legend}" if axes == OUR_AXES else f"Scene{legend}, {axes}", config
    )


def indicators(trees: Sequence[ReportedTree], outcomes: Sequence[FinalStanding] = ()) -> list[Panel]:
    """Return a light for each of the first results, in the colour of how it stands at the cursor.

    Args:
        outcomes: of the finished log; titles say the worst number of violated results, and when it was.
    """
    titles = [_light_title(tree, outcome) for tree, outcome in zip_longest(trees, outcomes)]
    rules = [
        {"operator": "=", "rawValue": str(number), "color": colour, "label": words}
        for number, (words, colour) in _STANDING_COLOURS.items()
    ]
    return [
        _title_panel(
            f"Indicator!result{index}",
            titles[index],
            {
                "path": _standing_path(tree.title, "standing"),
                "style": "background",
                "fontSize": _INDICATOR_PIXELS,
                "rules": rules,
                "fallbackColor": _STANDING_COLOURS[UNKNOWN][1],
                "fallbackLabel": "not evaluated",
            },
        )
        for index, tree in enumerate(trees[:_MOST_INDICATORS])
    ]


def sample_curves(
    trees: Sequence[ReportedTree], units: Mapping[str, str], zero: TextZero | None = None
) -> list[Panel]:
    """Return the curves of the results and of named specs, those of each unit in a panel of their own."""
    results = [(tree.title, tree.formula) for tree in trees]
    return [
        panel
        for name, title, formulas in (
            ("robustness", "Robustness of results", results),
            ("parts", "Robustness of named specs", _parts(trees)),
        )
        for panel in _plots(
            name,
            title,
            [
                _Curve(label, _standing_path(label, "robustness"), unit_of(node, units))
                for label, node in formulas
            ],
            zero,
        )
    ]


def whole_curves(trees: Sequence[ReportedTree], units: Mapping[str, str]) -> list[Panel]:
    """Return the curves over the whole log of each result, then of its named specs."""
    curves = [
        _Curve(tree.title, f"{_curves_path(tree, 0)}.value[:]", unit_of(tree.formula, units))
        for tree in trees
    ]
    curves += [
        _Curve(
            part_title(node, tree),
            f"{_curves_path(tree, identifier)}.{'value' if looks_ahead(node) else 'now'}[:]",
            unit_of(node, units),
        )
        for tree in trees
        for identifier, node in curved_nodes(tree.formula).items()
        if identifier
    ]
    times = {"enabled": True, "value": f"{CURVES_TOPIC}.time[:]"}
    whole = {"xAxisVal": "currentCustom", "xAxisPath": times, "isSynced": False}
    return [
        Panel(panel.identifier, {**panel.config, **whole})
        for panel in _plots("whole", "Robustness over the whole log", curves)
    ]


def state_strips(trees: Sequence[ReportedTree], *, by_stamp: bool = False) -> Panel:
    """Return a strip for how each result stands, then for its named specs.

    Args:
        by_stamp: whether the header of a message has its time. After a seek of a live source, earlier
            messages come at the new time.
    """
    strips = [(tree.title, _standing_path(tree.title, "standing")) for tree in trees]
    more = [(title, _standing_path(title, "standing")) for title, node in _parts(trees) if looks_ahead(node)]
    # Foxglove takes its colours from here, Lichtblick from the numbers
    states = [
        {"value": str(number), "label": words, "color": colour}
        for number, (words, colour) in _STANDING_COLOURS.items()
    ]
    paths = [
        {
            "enabled": True,
            "label": label,
            "timestampMethod": "headerStamp" if by_stamp else "receiveTime",
            "value": path,
            "customStates": {"type": "discrete", "states": states},
        }
        for label, path in [*strips, *more[:_MOST_STRIPS]]
    ]
    return _title_panel("StateTransitions!verdicts", "How results stand", {"isSynced": True, "paths": paths})


def image_panels(images: Sequence[str], topics: Collection[str]) -> list[Panel]:
    """Return the picture of each camera that objects were found by, with the outlines that we draw on it.

    A log without annotated images shows its first topic with images.
    """
    cameras = {topic_of_camera(CAMERA_VIDEO, number) for number in range(1, len(images) + 1)}
    copied = iter([image for image in images if image not in cameras])
    panels = []
    for number in range(1, len(images) + 1):
        video, calibration, annotations = (
            topic_of_camera(topic, number) for topic in (CAMERA_VIDEO, CAMERA_CALIBRATION, CAMERA_ANNOTATIONS)
        )
        if number > 1 and annotations not in topics:
            break
        image = video if video in images else next(copied, None)
        if image is None:
            continue
        mode: Config = {"imageTopic": image}
        if calibration in topics:
            mode["calibrationTopic"] = calibration
        if annotations in topics:
            mode["annotations"] = {annotations: {"visible": True}}
        name = "camera" if number == 1 else f"camera{number}"
        title = "Camera" if number == 1 else f"Camera {number}"
        panels.append(_title_panel(f"Image!{name}", title, {"imageMode": mode, "synchronize": False}))
    return panels


def _light_title(tree: ReportedTree, outcome: FinalStanding | None) -> str:
    """Return the name of a result, its worst number if it is violated, then words: viewers cut the end."""
    title, words = tree.title, f": {tree.sentence}" if tree.sentence else ""
    if outcome is None or outcome.standing != VIOLATED or not math.isfinite(outcome.by):
        return f"{title}{words}"
    unit = f" {outcome.unit}" if outcome.unit and outcome.unit != MIXED else ""
    return f"{title}, worst {number_text(-outcome.by)}{unit} at {_with_clock(outcome.at)}{words}"


def _with_clock(at: Instant) -> str:
    """Return a time, and how a viewer's cursor shows it where that differs."""
    return f"{at} ({clock_text(at.time_ns)})" if at.first_ns else str(at)


def _title_panel(identifier: str, title: str, config: Config) -> Panel:
    # each of the two viewers reads a key of its own
    return Panel(identifier, {**config, "foxglovePanelTitle": title, "lichtblickPanelTitle": title})


def _parts(trees: Sequence[ReportedTree]) -> list[tuple[str, Formula]]:
    """Return the named specs of all results, with their titles."""
    parts = ((tree, *part) for tree in trees for part in curved_nodes(tree.formula).items())
    return [(part_title(node, tree), node) for tree, identifier, node in parts if identifier]


class _Curve(NamedTuple):
    """A curve: its label, the path of its numbers, and their unit."""

    label: str
    path: str
    unit: str


def _plots(name: str, title: str, curves: Sequence[_Curve], text_zero: TextZero | None = None) -> list[Panel]:
    """Return a plot for each unit, with a line at 0: above it, things hold."""
    offset = "" if text_zero is None else text_zero.offset
    panels = []
    for index, unit in enumerate(list(dict.fromkeys(curve.unit for curve in curves))[:_MOST_PLOTS]):
        same_unit = [curve for curve in curves if curve.unit == unit][:_MOST_CURVES]
        words = unit_words(unit)
        paths = [
            {
                # viewers draw samples as dots of this colour darkened, which cover a dense curve
                "color": lighter(CURVES[index % len(CURVES)]),
                "enabled": True,
                "label": cut(curve.label, _LONGEST_LABEL),
                "timestampMethod": "receiveTime",
                "value": curve.path,
            }
            for index, curve in enumerate(same_unit)
        ]
        zero = {"color": _ZERO, "enabled": True, "label": "0", "timestampMethod": "receiveTime", "value": "0"}
        config = {
            "paths": [*paths, zero],
            "isSynced": True,
            "showLegend": True,
            "showPlotValuesInLegend": True,
            "legendDisplay": "left",
            "sidebarDimension": _LEGEND_PIXELS,
            "xAxisVal": "timestamp",
            "xAxisLabel": f"time [s]; texts count from {offset}" if offset else "time [s]",
            "yAxisLabel": words,
        }
        panels.append(_title_panel(f"Plot!{name}{index or ''}", f"{title} [{words}]", config))
    return panels


def _standing_path(title: str, field: str) -> str:
    return f"{STANDING}.results[:]{{name=={_quote(title)}}}.{field}"


def _curves_path(tree: ReportedTree, identifier: int) -> str:
    which = f"{{name=={_quote(tree.name)}}}{{object=={_quote(tree.object or '')}}}"
    return f"{CURVES_TOPIC}.specifications[:]{which}.nodes[:]{{id=={identifier}}}"


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


class TextZero(NamedTuple):
    """The time that texts count from, and the one that the axes of a viewer do.

    Attributes:
        zero_ns: of the texts.
        start_ns: of the first message that the viewer shows.
        name: the name of what begins there.
    """

    zero_ns: int
    start_ns: int
    name: str

    @property
    def offset(self) -> str:
        """How far the two are apart; "" where they are the same."""
        if self.zero_ns == self.start_ns:
            return ""
        side = "after" if self.zero_ns > self.start_ns else "before"
        return f"{time_text(abs(self.zero_ns - self.start_ns))} {side} the start of {self.name}"

    def __str__(self) -> str:
        clock = clock_text(self.zero_ns, with_date=True)
        return f"0 s = {clock}{', ' if self.offset else ''}{self.offset}"


_OPENING_NS: Final = 99_000_000
"""The time that a viewer plays by itself when it opens a log."""


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
        planned_for: the file that the planner's decisions were made for, if these results are of another one.
        zero: the time that texts count from; None before it is known.
        planned: the name of the result that a planner worked for; "" without any.
        first_event_ns: the time of the first event; None without any, or before it is known.
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
    planned_for: str = ""
    zero: TextZero | None = None
    planned: str = ""
    first_event_ns: int | None = None

    @property
    def first_tab(self) -> str:
        """The title of the tab that is open at first: it shows something at once."""
        if self.planned and PLAN_DECISION in self.topics:
            return "decision"
        if not self.outcomes or any(outcome.standing == VIOLATED for outcome in self.outcomes):
            return "violated"
        start_ns = 0 if self.zero is None else self.zero.start_ns
        is_at_once = self.first_event_ns is not None and self.first_event_ns <= start_ns + _OPENING_NS
        return "events" if is_at_once else "specification"

    def worst_first(self) -> LayoutContents:
        """Return the same with the worst results first, which then have lights and curves if not all can.

        The result that a planner worked for comes before them.
        """
        order = sorted(
            self.order or range(len(self.trees)), key=lambda place: self.trees[place].name != self.planned
        )
        return self._replace(
            trees=[self.trees[place] for place in order],
            has_states=[self.has_states[place] for place in order],
            outcomes=[self.outcomes[place] for place in order] if self.outcomes else (),
            order=(),
        )


def layout_attachment(contents: LayoutContents, *, live: bool = False) -> Attachment:
    """Return the layout of a log, or of a server that replays it, as a file."""
    layout = layout_for_live(contents) if live else viewer_layout(contents)
    return Attachment(LAYOUT, "application/json", layout_text(layout).encode())


def viewer_layout(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout of a log: whether, where and when; all else is in tabs.

    The lights of the worst results are at the top, the scene on the left. On the right are the curves of one
    unit at a time, the states of results, and a panel of tabs.
    """
    contents = contents.worst_first()
    curves = sample_curves(contents.trees, contents.units, contents.zero)
    return _layout(contents, curves, _details(contents), state_strips(contents.trees))


def layout_for_live(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout for a server that replays a log: with the curves of the whole log at any time, and
    the constants that a viewer may edit."""
    contents = contents.worst_first()
    details = _details(contents)
    if contents.trees:
        summary = {"topicPath": f"{CURVES_TOPIC}.summary"}
        # the decisions of a planner come first
        details.insert(
            1 if contents.planned else 0,
            ("whole log", _title_panel("RawMessages!summary", "The whole log", summary)),
        )
    title = "Playback and constants of the specification"
    constants = _title_panel("Parameters!constants", title, {"title": title})
    curves = whole_curves(contents.trees, contents.units)
    return _layout(contents, curves, details, state_strips(contents.trees, by_stamp=True), below=constants)


_PANELS: Final = "spatial-replay.spatial-replay {}!{}"
"""The identifier of a panel of the extension, by its name."""


def with_panels(layout: Mapping[str, Any], planned: str = "") -> dict[str, Any]:
    """Return the layout of a log for viewers that have the extension: scene, tree, curves and decisions.

    Args:
        layout: that of the log without them (see `viewer_layout`).
        planned: the name of the result that a planner worked for, which the panels open on.
    """
    state = {"result": planned} if planned else {}
    configs = {"3D!scene": layout["configById"]["3D!scene"]}
    curves = [
        Panel(identifier, config)
        for identifier, config in layout["configById"].items()
        if identifier.startswith("Plot!")
    ]
    automaton = ("automaton", Panel(_PANELS.format("automaton", "automaton"), state))
    titled = [automaton]
    if "RawMessages!decision" in layout["configById"]:
        decisions = ("decisions", Panel(_PANELS.format("decisions", "decisions"), {}))
        titled = [decisions, automaton] if planned else [automaton, decisions]
    titled += [(_tab_title(plot), plot) for plot in curves]
    tabs, panels = _tabs("Tab!panels", titled)
    tree = Panel(_PANELS.format("specification", "tree"), state)
    configs |= {panel.identifier: panel.config for panel in (tree, *panels)}
    right = _split("column", [(tree.identifier, 6.0), (tabs, 4.0)])
    whole = {"direction": "row", "first": "3D!scene", "second": right, "splitPercentage": 45}
    return {**layout, "configById": configs, "layout": whole}


_Details = list[tuple[str, Panel]]
"""Panels of one place, by the titles of their tabs."""


def _details(contents: LayoutContents) -> _Details:
    """Return the panels that are in tabs, first the one that opens."""
    trees, planned_for, zero = contents.trees, contents.planned_for, contents.zero
    # the seconds in both tables are not those of the axes
    clock = f"; 0 s = {clock_text(zero.zero_ns)}" if zero is not None and zero.zero_ns else ""
    rows = list[tuple[str, str, str, str]]()
    if trees:
        rows.append(("violated", "Table!violated", f"Violated results{clock}", f"{STANDING}.violated"))
    if trees and RECENT_EVENTS in contents.topics:
        rows.append(("events", "Table!events", f"Events{clock}", f"{RECENT_EVENTS}.events"))
    if trees:
        # a list of texts is shown centred, one text is not
        which = "0" if all(tree.file == 0 for tree in trees) else ":"
        sources = f"{SPECIFICATION}.files[{which}].source"
        title = "Specification" if zero is None else f"Specification; {zero}"
        rows.append(("specification", "RawMessages!specification", title, sources))
    if any(contents.has_states[:1] if contents.planned else contents.has_states):
        title = trees[contents.has_states.index(True)].title
        path = _standing_path(title, "automaton")
        rows.append(("automaton", "RawMessages!automaton", f"Automaton of {title}", path))
    if PLAN_DECISION in contents.topics:
        of = f", for {planned_for} as recorded" if planned_for else ""
        why = f"Why the planner decided so{of}"
        rows.append(("decision", "RawMessages!decision", why, f"{PLAN_DECISION}.reason"))
    rows.sort(key=lambda row: row[0] != contents.first_tab)
    details = [(tab, _title_panel(panel, title, {"topicPath": path})) for tab, panel, title, path in rows]
    cameras = image_panels(contents.images, contents.topics)
    return details + [(camera.config["foxglovePanelTitle"].lower(), camera) for camera in cameras]


def layout_text(layout: Mapping[str, Any]) -> str:
    """Return a layout as a file has it."""
    return json.dumps(layout, indent=1, sort_keys=True, ensure_ascii=False)


def _layout(
    contents: LayoutContents,
    curves: Sequence[Panel],
    details: _Details,
    states: Panel,
    below: Panel | None = None,
) -> dict[str, Any]:
    """Return a layout: lights at the top, the scene on the left, curves, states and details on the right.

    Args:
        below: what is under the scene.
    """
    lights = indicators(contents.trees, contents.outcomes)
    scene = scene_panel(_camera(contents.extent), contents.topics, contents.axes, contents.planned_for)
    panels = [*lights, scene]
    left: list[tuple[_Tree, float]] = [(scene.identifier, 7.0)]
    if below is not None:
        panels.append(below)
        left.append((below.identifier, 3.0))
    right: list[tuple[_Tree, float]] = []
    if curves:
        plots, tab_panels = _tabs("Tab!curves", [(_tab_title(plot), plot) for plot in curves])
        panels += [*tab_panels, states]
        # curves have at least 140 pixels on a screen of 1280 × 720
        # a strip has about 50 pixels
        right += [(plots, 4.5), (states.identifier, min(len(states.config["paths"]), 2) + 1.0)]
    if details:
        tabs, tab_panels = _tabs("Tab!details", details)
        panels += tab_panels
        right.append((tabs, 4.0))
    tree = _split("column", left)
    if right:
        second = _split("column", right)
        tree = {"direction": "row", "first": tree, "second": second, "splitPercentage": 50}
    if lights:
        row = _split("row", [(panel.identifier, 1.0) for panel in lights])
        tree = _split("column", [(row, 1.0), (tree, _LIT_SHARE)])
    return {
        "configById": {panel.identifier: panel.config for panel in panels},
        "globalVariables": {},
        "layout": tree,
        "playbackConfig": {"speed": 1},
        "userNodes": {},
    }


def _tab_title(plot: Panel) -> str:
    """Return the title of a plot in short: "results [m]".

    A tab is too narrow for more than 17 letters; the plot's own title has the rest.
    """
    title = str(plot.config["foxglovePanelTitle"]).removeprefix("Robustness of ")
    title = title.removesuffix(f" [{unit_words(FOOTPRINT_UNITS)}]").removeprefix("named ")
    return title.replace(" units]", "]")


def _tabs(identifier: str, titled: Sequence[tuple[str, Panel]]) -> tuple[str, list[Panel]]:
    """Return the identifier of a panel with tabs, or of the only panel, and all panels."""
    panels = [panel for _, panel in titled]
    if len(panels) == 1:
        return panels[0].identifier, panels
    tabs = [{"title": title, "layout": panel.identifier} for title, panel in titled]
    return identifier, [*panels, Panel(identifier, {"activeTabIdx": 0, "tabs": tabs})]


_Tree = str | dict[str, Any]
_LIT_SHARE: Final = 9.0
"""How much higher the panels below the lights are than a row of these."""


def _split(direction: str, parts: Sequence[tuple[_Tree, float]]) -> _Tree:
    """Return panels beside or below each other, as nested splits."""
    (first, share), *rest = parts
    if not rest:
        return first
    whole = share + sum(part_share for _, part_share in rest)
    return {
        "direction": direction,
        "first": first,
        "second": _split(direction, rest),
        "splitPercentage": round(100.0 * share / whole),
    }


def _camera(extent: SceneBounds | None) -> dict[str, Any]:
    """Return a camera that looks straight down and fits the box."""
    box = extent or SceneBounds(-1.0, -1.0, 1.0, 1.0)
    distance = VIEW * max(box.xmax - box.xmin, box.ymax - box.ymin) or 1.0
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
