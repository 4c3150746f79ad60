"""A blueprint for Rerun: panels for an annotated log. The log stays unchanged."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.annotate.scene.scene_frames import STANDING_WORDS
from spatial_replay.errors import importing
from spatial_replay.logs.schemas.Robustness_pb2 import Standing, StandingUpdate
from spatial_replay.logs.topics import EVENT_LOG, SCENE, STANDING
from spatial_replay.palette import CURVES, hexadecimal

_SOURCE: Final = f"{StandingUpdate.DESCRIPTOR.full_name}:message"
"""Component in which Rerun stores the topic's messages."""
_TIMELINE: Final = "message_log_time"
_MOST_LANES: Final = 12
_Strip: TypeAlias = tuple[list[tuple[float, float, float]], int]


class BlueprintRow(NamedTuple):
    """A result or named spec in Rerun.

    Attributes:
        title: name in the messages.
        unit: unit of the robustness, or "".
        selector: Rerun's selector of the row's entry in a message.
        colour: colour of the curve, "#rrggbb".
    """

    title: str
    unit: str
    selector: str
    colour: str


def blueprint_rows(standing: StandingUpdate) -> list[BlueprintRow]:
    """Return the rows of a message. All messages of one log have equal rows, in the same order."""
    return [
        BlueprintRow(
            result.name, result.unit, f".results[{result_index}]", CURVES[result_index % len(CURVES)]
        )
        for result_index, result in enumerate(standing.results)
    ]


def state_words() -> Iterator[tuple[str, str, str]]:
    """Yield each state of a row: its name in messages, its words, and its colour."""
    for code, (words, colour) in STANDING_WORDS.items():
        yield Standing.Name(code), words, hexadecimal(colour)


def write_blueprint(
    rows: Sequence[BlueprintRow], log: Path, path: Path, scenes: Iterable[SceneUpdate] = ()
) -> None:
    """Write a blueprint: a view of curves per unit, a lane per result, and the sentences of the events.

    Rerun finds the blueprint of a log by the log's name without the suffix. A file with the suffix .rrd also
    has the log and the outlines of the scenes, because Rerun shows each file as a separate recording.

    Raises:
        UsageError: Rerun is not installed.
    """
    with importing("a blueprint needs rerun", extra="rerun"):
        from rerun import blueprint
    units = dict.fromkeys(row.unit for row in rows)
    curves = [_curves(unit, [row for row in rows if row.unit == unit]) for unit in units]
    lanes = blueprint.StateTimelineView(
        origin=STANDING,
        contents=STANDING,
        name="How results stand",
        overrides={STANDING: [_lane(row) for row in rows[:_MOST_LANES]]},
    )
    view = blueprint.Vertical(
        blueprint.Tabs(*curves), lanes, blueprint.TextLogView(origin=EVENT_LOG, name="Events")
    )
    is_recording = path.suffix == ".rrd"
    if is_recording:
        view = blueprint.Horizontal(blueprint.Spatial3DView(origin=SCENE, name="Scene"), view)
    panels = [
        blueprint.TimePanel(state="expanded", timeline=_TIMELINE),
        blueprint.SelectionPanel(state="hidden"),
        blueprint.BlueprintPanel(state="hidden"),
    ]
    layout = blueprint.Blueprint(view, *panels)
    if is_recording:
        _write_recording(log, path, layout, scenes)
    else:
        layout.save(log.stem, path)


def _write_recording(log: Path, path: Path, layout: Any, scenes: Iterable[SceneUpdate]) -> None:
    import rerun

    times_ns, strips_by_entity = list[int](), defaultdict[str, dict[int, list[_Strip]]](dict)
    for scene in scenes:
        stamps = [entity.timestamp for entity in scene.entities] or [
            deletion.timestamp for deletion in scene.deletions
        ]
        times_ns += [stamp.ToNanoseconds() for stamp in stamps[:1]]
        for entity in scene.entities:
            strips = [strip for line in entity.lines for strip in _strips(line)]
            if strips:
                strips_by_entity[entity.id][len(times_ns) - 1] = strips
    time_column = rerun.TimeColumn(_TIMELINE, timestamp=np.array(times_ns, "datetime64[ns]"))
    with rerun.RecordingStream(log.stem, recording_id=log.stem) as stream:
        stream.save(path, default_blueprint=layout)
        stream.log_file_from_path(log)
        for name, strips_by_scene in strips_by_entity.items():
            corners, colours = zip(*chain(*strips_by_scene.values()), strict=True)
            strip_columns = rerun.LineStrips3D.columns(strips=corners, colors=colours)
            strip_counts = [len(strips_by_scene.get(scene_index, ())) for scene_index in range(len(times_ns))]
            stream.send_columns(f"{SCENE}/{name}", [time_column], strip_columns.partition(strip_counts))


def _strips(line: LinePrimitive) -> list[_Strip]:
    """Return the strips of a line; a list of segments has a strip for each segment."""
    corners = [(point.x, point.y, line.pose.position.z) for point in line.points]
    colour = _number(hexadecimal((line.color.r, line.color.g, line.color.b)))
    strip_length = 2 if line.type == LinePrimitive.LINE_LIST else max(len(corners), 1)
    closing_corner = corners[: line.type == LinePrimitive.LINE_LOOP]
    return [
        (corners[start : start + strip_length] + closing_corner, colour)
        for start in range(0, len(corners), strip_length)
    ]


def _curves(unit: str, rows: Sequence[BlueprintRow]) -> Any:
    import rerun
    from rerun import blueprint

    lines = [
        rerun.SeriesLines(names=row.title, colors=_number(row.colour)).visualizer(
            mappings=[_mapping("Scalars:scalars", f"{row.selector}.robustness")]
        )
        for row in rows
    ]
    unit_text = unit or "footprint units"
    return blueprint.TimeSeriesView(
        origin=STANDING, contents=STANDING, name=f"Robustness [{unit_text}]", overrides={STANDING: lines}
    )


def _lane(row: BlueprintRow) -> Any:
    """Return a result's lane. Rerun names lanes after topics, so the label of each state names the result."""
    import rerun

    names, words, colours = zip(*state_words(), strict=True)
    states = rerun.StateConfiguration(
        values=names,
        labels=[f"{row.title}: {word}" for word in words],
        colors=list(map(_number, colours)),
    )
    return states.visualizer(mappings=[_mapping("StateChange:state", f"{row.selector}.standing.name")])


def _mapping(target: str, selector: str) -> Any:
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    source = ComponentSourceKind.SourceComponent
    return VisualizerComponentMapping(target, source, source_component=_SOURCE, selector=selector)


def _number(colour: str) -> int:
    """Return a colour as an opaque 0xrrggbbaa."""
    return int(colour.removeprefix("#"), 16) << 8 | 0xFF
