"""The layout of a log for Foxglove and Lichtblick: panels by id, and a tree of splits around the panels."""

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
"""Limit of curves in a plot; viewers cannot distinguish more."""

_MOST_STRIPS: Final = 8
"""Limit of strips of named specs; viewers cannot distinguish more."""

_MOST_PLOTS: Final = 3
"""Limit of plots; each unit has its own plot."""

_MOST_INDICATORS: Final = 6
"""Limit of lights in the row of lights."""

_LEGEND_PIXELS: Final = 240
"""Width of a legend with the values at the cursor, pixels. The legend covers no curve."""

_LONGEST_LABEL: Final = 24
"""Limit of a label that fits into a legend, characters."""

_INDICATOR_PIXELS: Final = 18
_ZERO: Final = "#8c8c8c"

_STANDING_COLOURS: Final[Mapping[int, tuple[str, str]]] = MappingProxyType(
    {
        code: (STANDING_WORDS[code][0], hexadecimal(STANDING_WORDS[code][1]))
        for code in (SATISFIED, HOLDS_SO_FAR, PENDING, VIOLATED, UNKNOWN)
    }
)
"""Words and colour of each value of `Standing`, in panels that accept a colour."""

Config = dict[str, Any]


class Panel(NamedTuple):
    """A panel: its identifier and its settings."""

    identifier: str
    config: Config


def scene_panel(
    camera: Mapping[str, Any], topics: Collection[str], axes: Axes = OUR_AXES, planned_for: str = ""
) -> Panel:
    """Return the scene from above, with the planner's map below it and the planned path above it.

    The planner's redone decisions are hidden; a viewer can show them instead of the recorded decisions.
    """
    settings_by_topic: dict[str, Config] = {
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
            topic: {"visible": True, **settings}
            for topic, settings in settings_by_topic.items()
            if topic in topics
        },
        # viewers draw axes of 1 m, which do not fit every scene
        "scene": {"labelScaleFactor": 1, "transforms": {"showLabel": False, "axisScale": 0}},
        "transforms": {f"frame:{frame}": {"visible": False} for frame in FRAMES},
    }
    origin_text = f" of {planned_for} as recorded" if planned_for else ""
    legend = (
        f" (map{origin_text}: vermillion fails, white is 0, blue holds)" if GRADIENT_MAP in topics else ""
    )
    return _title_panel(
        "3D!scene", f"Scene{legend}" if axes == OUR_AXES else f"Scene{legend}, {axes}", config
    )


def indicators(trees: Sequence[ReportedTree], outcomes: Sequence[FinalStanding] = ()) -> list[Panel]:
    """Return a light for each of the first results, in the colour of the standing at the cursor.

    Args:
        outcomes: outcomes over the finished log. The title of a violated result has the worst number
            and the number's time.
    """
    titles = [_light_title(tree, outcome) for tree, outcome in zip_longest(trees, outcomes)]
    rules = [
        {"operator": "=", "rawValue": str(standing), "color": colour, "label": words}
        for standing, (words, colour) in _STANDING_COLOURS.items()
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
    """Return panels with the curves of results and of named specs, one panel per unit."""
    results = [(tree.title, tree.formula) for tree in trees]
    return [
        panel
        for name, title, titled_formulas in (
            ("robustness", "Robustness of results", results),
            ("parts", "Robustness of named specs", _parts(trees)),
        )
        for panel in _plots(
            name,
            title,
            [
                _Curve(label, _standing_path(label, "robustness"), unit_of(node, units))
                for label, node in titled_formulas
            ],
            zero,
        )
    ]


def whole_curves(trees: Sequence[ReportedTree], units: Mapping[str, str]) -> list[Panel]:
    """Return panels with the curves over the whole log, of results and then of named specs."""
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
    time_axis = {"enabled": True, "value": f"{CURVES_TOPIC}.time[:]"}
    axis_settings = {"xAxisVal": "currentCustom", "xAxisPath": time_axis, "isSynced": False}
    return [
        Panel(panel.identifier, {**panel.config, **axis_settings})
        for panel in _plots("whole", "Robustness over the whole log", curves)
    ]


def state_strips(trees: Sequence[ReportedTree], *, by_stamp: bool = False) -> Panel:
    """Return a panel with a strip for the standing of each result, and then of each named spec.

    Args:
        by_stamp: whether strips use the stamps in message headers. A live source needs these stamps, because
            after a seek its earlier messages arrive at the new time.
    """
    result_strips = [(tree.title, _standing_path(tree.title, "standing")) for tree in trees]
    spec_strips = [
        (title, _standing_path(title, "standing")) for title, node in _parts(trees) if looks_ahead(node)
    ]
    # Foxglove reads colours from these settings, Lichtblick derives colours from the numbers
    state_settings = [
        {"value": str(standing), "label": words, "color": colour}
        for standing, (words, colour) in _STANDING_COLOURS.items()
    ]
    strip_settings = [
        {
            "enabled": True,
            "label": label,
            "timestampMethod": "headerStamp" if by_stamp else "receiveTime",
            "value": path,
            "customStates": {"type": "discrete", "states": state_settings},
        }
        for label, path in [*result_strips, *spec_strips[:_MOST_STRIPS]]
    ]
    return _title_panel(
        "StateTransitions!verdicts", "How results stand", {"isSynced": True, "paths": strip_settings}
    )


def image_panels(images: Sequence[str], topics: Collection[str]) -> list[Panel]:
    """Return a panel for each camera that detected objects, with the outlines on its images.

    A log without annotated images gets a panel for its first topic with images.
    """
    camera_topics = {
        topic_of_camera(CAMERA_VIDEO, camera_number) for camera_number in range(1, len(images) + 1)
    }
    other_images = iter([image for image in images if image not in camera_topics])
    panels = []
    for camera_number in range(1, len(images) + 1):
        video, calibration, annotations = (
            topic_of_camera(topic, camera_number)
            for topic in (CAMERA_VIDEO, CAMERA_CALIBRATION, CAMERA_ANNOTATIONS)
        )
        if camera_number > 1 and annotations not in topics:
            break
        image = video if video in images else next(other_images, None)
        if image is None:
            continue
        image_mode: Config = {"imageTopic": image}
        if calibration in topics:
            image_mode["calibrationTopic"] = calibration
        if annotations in topics:
            image_mode["annotations"] = {annotations: {"visible": True}}
        name = "camera" if camera_number == 1 else f"camera{camera_number}"
        title = "Camera" if camera_number == 1 else f"Camera {camera_number}"
        panels.append(_title_panel(f"Image!{name}", title, {"imageMode": image_mode, "synchronize": False}))
    return panels


def _light_title(tree: ReportedTree, outcome: FinalStanding | None) -> str:
    """Return the title of a light: the result, the worst number of a violated result, and the sentence.

    The sentence comes last, because viewers cut long titles at the end.
    """
    title, sentence_text = tree.title, f": {tree.sentence}" if tree.sentence else ""
    if outcome is None or outcome.standing != VIOLATED or not math.isfinite(outcome.by):
        return f"{title}{sentence_text}"
    unit_text = f" {outcome.unit}" if outcome.unit and outcome.unit != MIXED else ""
    return f"{title}, worst {number_text(-outcome.by)}{unit_text} at {_with_clock(outcome.at)}{sentence_text}"


def _with_clock(at: Instant) -> str:
    """Return a time, followed by the clock time of a viewer's cursor if the clock time differs."""
    return f"{at} ({clock_text(at.time_ns)})" if at.first_ns else str(at)


def _title_panel(identifier: str, title: str, config: Config) -> Panel:
    # Foxglove and Lichtblick read different keys
    return Panel(identifier, {**config, "foxglovePanelTitle": title, "lichtblickPanelTitle": title})


def _parts(trees: Sequence[ReportedTree]) -> list[tuple[str, Formula]]:
    """Return the named specs of all results, with their titles."""
    parts = ((tree, *part) for tree in trees for part in curved_nodes(tree.formula).items())
    return [(part_title(node, tree), node) for tree, identifier, node in parts if identifier]


class _Curve(NamedTuple):
    """A curve: its label, the message path of its numbers, and their unit."""

    label: str
    path: str
    unit: str


def _plots(name: str, title: str, curves: Sequence[_Curve], text_zero: TextZero | None = None) -> list[Panel]:
    """Return a plot for each unit, with a line at 0, above which specifications hold."""
    offset = "" if text_zero is None else text_zero.offset
    panels = []
    for index, unit in enumerate(list(dict.fromkeys(curve.unit for curve in curves))[:_MOST_PLOTS]):
        same_unit = [curve for curve in curves if curve.unit == unit][:_MOST_CURVES]
        unit_text = unit_words(unit)
        curve_settings = [
            {
                # viewers draw samples as dots in a darker shade, and these dots cover a dense curve
                "color": lighter(CURVES[index % len(CURVES)]),
                "enabled": True,
                "label": cut(curve.label, _LONGEST_LABEL),
                "timestampMethod": "receiveTime",
                "value": curve.path,
            }
            for index, curve in enumerate(same_unit)
        ]
        zero_line = {
            "color": _ZERO,
            "enabled": True,
            "label": "0",
            "timestampMethod": "receiveTime",
            "value": "0",
        }
        config = {
            "paths": [*curve_settings, zero_line],
            "isSynced": True,
            "showLegend": True,
            "showPlotValuesInLegend": True,
            "legendDisplay": "left",
            "sidebarDimension": _LEGEND_PIXELS,
            "xAxisVal": "timestamp",
            "xAxisLabel": f"time [s]; texts count from {offset}" if offset else "time [s]",
            "yAxisLabel": unit_text,
        }
        panels.append(_title_panel(f"Plot!{name}{index or ''}", f"{title} [{unit_text}]", config))
    return panels


def _standing_path(title: str, field: str) -> str:
    return f"{STANDING}.results[:]{{name=={_quote(title)}}}.{field}"


def _curves_path(tree: ReportedTree, identifier: int) -> str:
    selector = f"{{name=={_quote(tree.name)}}}{{object=={_quote(tree.object or '')}}}"
    return f"{CURVES_TOPIC}.specifications[:]{selector}.nodes[:]{{id=={identifier}}}"


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


class TextZero(NamedTuple):
    """The zero of times in texts, and the zero of a viewer's axes.

    Attributes:
        zero_ns: zero of texts.
        start_ns: zero of the axes, the time of the first message that the viewer shows.
        name: name of the log that begins with that message.
    """

    zero_ns: int
    start_ns: int
    name: str

    @property
    def offset(self) -> str:
        """The offset between both zeros in words; "" for equal zeros."""
        if self.zero_ns == self.start_ns:
            return ""
        side = "after" if self.zero_ns > self.start_ns else "before"
        return f"{time_text(abs(self.zero_ns - self.start_ns))} {side} the start of {self.name}"

    def __str__(self) -> str:
        clock = clock_text(self.zero_ns, with_date=True)
        return f"0 s = {clock}{', ' if self.offset else ''}{self.offset}"


_OPENING_NS: Final = 99_000_000
"""Time that a viewer plays by itself when it opens a log, nanoseconds."""


class LayoutContents(NamedTuple):
    """Content of a layout for a log.

    Attributes:
        trees: trees of the results.
        has_states: whether the log has the states of each tree's automaton.
        extent: bounds of the footprints; None without footprints.
        topics: all topics with messages.
        axes: axes of the source; the scene's title names axes that differ from the axes of samples.
        units: declared units, see `unit_of`.
        outcomes: final outcome of each tree; empty before the end of the log.
        images: topics with images.
        order: indices of the trees, the worst first; empty before the end of the log.
        planned_for: specification file of the planner's decisions, if these results are of another file.
        zero: zero of times in texts; None before it is known.
        planned: name of the result that a planner worked for; "" without a planner.
        first_event_ns: time of the first event; None without a known event.
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
        """The title of the initially open tab, which has content at the start of the log."""
        if self.planned and PLAN_DECISION in self.topics:
            return "decision"
        if not self.outcomes or any(outcome.standing == VIOLATED for outcome in self.outcomes):
            return "violated"
        start_ns = 0 if self.zero is None else self.zero.start_ns
        has_early_event = self.first_event_ns is not None and self.first_event_ns <= start_ns + _OPENING_NS
        return "events" if has_early_event else "specification"

    def worst_first(self) -> LayoutContents:
        """Return the contents sorted by outcome, so that the worst results have lights and curves.

        The result that a planner worked for comes before all others.
        """
        tree_order = sorted(
            self.order or range(len(self.trees)), key=lambda tree: self.trees[tree].name != self.planned
        )
        return self._replace(
            trees=[self.trees[index] for index in tree_order],
            has_states=[self.has_states[index] for index in tree_order],
            outcomes=[self.outcomes[index] for index in tree_order] if self.outcomes else (),
            order=(),
        )


def layout_attachment(contents: LayoutContents, *, live: bool = False) -> Attachment:
    """Return the layout for a log, or with `live` for a server that replays the log, as an attachment."""
    layout = layout_for_live(contents) if live else viewer_layout(contents)
    return Attachment(LAYOUT, "application/json", layout_text(layout).encode())


def viewer_layout(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout of a log.

    The lights of the worst results are at the top, and the scene is on the left. On the right are the curves
    in one tab per unit, the strips of results, and tabs with all other panels.
    """
    contents = contents.worst_first()
    curves = sample_curves(contents.trees, contents.units, contents.zero)
    return _layout(contents, curves, _details(contents), state_strips(contents.trees))


def layout_for_live(contents: LayoutContents) -> dict[str, Any]:
    """Return the layout for a server that replays a log.

    The layout always has the curves of the whole log, and the constants for editing.
    """
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
"""Format of the identifier of a panel in the extension: name of the panel, name of the instance."""


def with_panels(layout: Mapping[str, Any], planned: str = "") -> dict[str, Any]:
    """Return the layout of a log for viewers with the extension: scene, tree, curves and decisions.

    Args:
        layout: layout of the log without the extension (see `viewer_layout`).
        planned: name of the result that a planner worked for, which panels show first; "" without a planner.
    """
    panel_state = {"result": planned} if planned else {}
    configs = {"3D!scene": layout["configById"]["3D!scene"]}
    curves = [
        Panel(identifier, config)
        for identifier, config in layout["configById"].items()
        if identifier.startswith("Plot!")
    ]
    automaton = ("automaton", Panel(_PANELS.format("automaton", "automaton"), panel_state))
    titled_panels = [automaton]
    if "RawMessages!decision" in layout["configById"]:
        decisions = ("decisions", Panel(_PANELS.format("decisions", "decisions"), {}))
        titled_panels = [decisions, automaton] if planned else [automaton, decisions]
    titled_panels += [(_tab_title(plot), plot) for plot in curves]
    tabs, panels = _tabs("Tab!panels", titled_panels)
    tree = Panel(_PANELS.format("specification", "tree"), panel_state)
    configs |= {panel.identifier: panel.config for panel in (tree, *panels)}
    right_side = _split("column", [(tree.identifier, 6.0), (tabs, 4.0)])
    root_split = {"direction": "row", "first": "3D!scene", "second": right_side, "splitPercentage": 45}
    return {**layout, "configById": configs, "layout": root_split}


_Details = list[tuple[str, Panel]]
"""Panels that share one place, with the titles of their tabs."""


def _details(contents: LayoutContents) -> _Details:
    """Return the panels in tabs. The first panel is open initially."""
    trees, planned_for, zero = contents.trees, contents.planned_for, contents.zero
    # the zero of the seconds in both tables differs from the zero of the axes
    zero_text = f"; 0 s = {clock_text(zero.zero_ns)}" if zero is not None and zero.zero_ns else ""
    tab_rows = list[tuple[str, str, str, str]]()
    if trees:
        tab_rows.append(
            ("violated", "Table!violated", f"Violated results{zero_text}", f"{STANDING}.violated")
        )
    if trees and RECENT_EVENTS in contents.topics:
        tab_rows.append(("events", "Table!events", f"Events{zero_text}", f"{RECENT_EVENTS}.events"))
    if trees:
        # a viewer centres a list of texts, but not a single text
        file_selector = "0" if all(tree.file == 0 for tree in trees) else ":"
        sources = f"{SPECIFICATION}.files[{file_selector}].source"
        title = "Specification" if zero is None else f"Specification; {zero}"
        tab_rows.append(("specification", "RawMessages!specification", title, sources))
    if any(contents.has_states[:1] if contents.planned else contents.has_states):
        title = trees[contents.has_states.index(True)].title
        path = _standing_path(title, "automaton")
        tab_rows.append(("automaton", "RawMessages!automaton", f"Automaton of {title}", path))
    if PLAN_DECISION in contents.topics:
        origin_text = f", for {planned_for} as recorded" if planned_for else ""
        decision_title = f"Why the planner decided so{origin_text}"
        tab_rows.append(("decision", "RawMessages!decision", decision_title, f"{PLAN_DECISION}.reason"))
    tab_rows.sort(key=lambda row: row[0] != contents.first_tab)
    details = [(tab, _title_panel(panel, title, {"topicPath": path})) for tab, panel, title, path in tab_rows]
    cameras = image_panels(contents.images, contents.topics)
    return details + [(camera.config["foxglovePanelTitle"].lower(), camera) for camera in cameras]


def layout_text(layout: Mapping[str, Any]) -> str:
    """Return the text of a layout file."""
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
        below: panel under the scene; None for no panel.
    """
    lights = indicators(contents.trees, contents.outcomes)
    scene = scene_panel(_camera(contents.extent), contents.topics, contents.axes, contents.planned_for)
    panels = [*lights, scene]
    left_parts: list[tuple[_Tree, float]] = [(scene.identifier, 7.0)]
    if below is not None:
        panels.append(below)
        left_parts.append((below.identifier, 3.0))
    right_parts: list[tuple[_Tree, float]] = []
    if curves:
        plots, tab_panels = _tabs("Tab!curves", [(_tab_title(plot), plot) for plot in curves])
        panels += [*tab_panels, states]
        # on a screen of 1280 × 720, these heights give curves at least 140 pixels, and each strip about 50
        right_parts += [(plots, 4.5), (states.identifier, min(len(states.config["paths"]), 2) + 1.0)]
    if details:
        tabs, tab_panels = _tabs("Tab!details", details)
        panels += tab_panels
        right_parts.append((tabs, 4.0))
    tree = _split("column", left_parts)
    if right_parts:
        right_side = _split("column", right_parts)
        tree = {"direction": "row", "first": tree, "second": right_side, "splitPercentage": 50}
    if lights:
        light_row = _split("row", [(panel.identifier, 1.0) for panel in lights])
        tree = _split("column", [(light_row, 1.0), (tree, _LIT_SHARE)])
    return {
        "configById": {panel.identifier: panel.config for panel in panels},
        "globalVariables": {},
        "layout": tree,
        "playbackConfig": {"speed": 1},
        "userNodes": {},
    }


def _tab_title(plot: Panel) -> str:
    """Return the short title of a plot for its tab, such as "results [m]".

    A tab has room for 17 letters; the panel itself has the whole title.
    """
    title = str(plot.config["foxglovePanelTitle"]).removeprefix("Robustness of ")
    title = title.removesuffix(f" [{unit_words(FOOTPRINT_UNITS)}]").removeprefix("named ")
    return title.replace(" units]", "]")


def _tabs(identifier: str, titles_and_panels: Sequence[tuple[str, Panel]]) -> tuple[str, list[Panel]]:
    """Return the identifier of a panel with tabs, and all panels. A single panel has no tabs."""
    panels = [panel for _, panel in titles_and_panels]
    if len(panels) == 1:
        return panels[0].identifier, panels
    tabs = [{"title": title, "layout": panel.identifier} for title, panel in titles_and_panels]
    return identifier, [*panels, Panel(identifier, {"activeTabIdx": 0, "tabs": tabs})]


_Tree = str | dict[str, Any]
_LIT_SHARE: Final = 9.0
"""Height of the panels below the row of lights, multiples of the row's height."""


def _split(direction: str, parts: Sequence[tuple[_Tree, float]]) -> _Tree:
    """Return panels next to or below each other, as nested splits of two parts."""
    (first_panel, first_share), *other_parts = parts
    if not other_parts:
        return first_panel
    total_share = first_share + sum(part_share for _, part_share in other_parts)
    return {
        "direction": direction,
        "first": first_panel,
        "second": _split(direction, other_parts),
        "splitPercentage": round(100.0 * first_share / total_share),
    }


def _camera(extent: SceneBounds | None) -> dict[str, Any]:
    """Return a camera that looks straight down and shows the whole extent."""
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
