"""A blueprint for Rerun: which panels show an annotated log there, without any change of the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from spatial_replay.annotate.scene.scene_frames import STANDING_WORDS
from spatial_replay.errors import importing
from spatial_replay.logs.schemas.Robustness_pb2 import Standing, StandingUpdate
from spatial_replay.logs.topics import EVENT_LOG, STANDING
from spatial_replay.palette import CURVES, hexadecimal

_SOURCE: Final = f"{StandingUpdate.DESCRIPTOR.full_name}:message"
"""Name that Rerun gives to the messages of the topic."""
_TIMELINE: Final = "message_log_time"
_MOST_LANES: Final = 12


class BlueprintRow(NamedTuple):
    """A result or named spec in Rerun.

    Attributes:
        title: as in the messages.
        unit: of its robustness, or "".
        selector: of its entry in a message.
        colour: of its curve, "#rrggbb".
    """

    title: str
    unit: str
    selector: str
    colour: str


def blueprint_rows(standing: StandingUpdate) -> list[BlueprintRow]:
    """Return the rows of a message, which each message of its log has in the same places."""
    return [
        BlueprintRow(result.name, result.unit, f".results[{place}]", CURVES[place % len(CURVES)])
        for place, result in enumerate(standing.results)
    ]


def state_words() -> Iterator[tuple[str, str, str]]:
    """Yield the states of a row: their names in messages, in words, and their colours."""
    for code, (words, colour) in STANDING_WORDS.items():
        yield Standing.Name(code), words, hexadecimal(colour)


def write_blueprint(rows: Sequence[BlueprintRow], application: str, path: Path) -> None:
    """Write a blueprint: curves of each unit, a lane for each result, and the sentences of the log.

    Args:
        application: name of the log without its suffix, by which Rerun knows whose blueprint it is.

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
    panels = [
        blueprint.TimePanel(state="expanded", timeline=_TIMELINE),
        blueprint.SelectionPanel(state="hidden"),
        blueprint.BlueprintPanel(state="hidden"),
    ]
    blueprint.Blueprint(view, *panels).save(application, path)


def _curves(unit: str, rows: Sequence[BlueprintRow]) -> Any:
    import rerun
    from rerun import blueprint

    lines = [
        rerun.SeriesLines(names=row.title, colors=_number(row.colour)).visualizer(
            mappings=[_mapping("Scalars:scalars", f"{row.selector}.robustness")]
        )
        for row in rows
    ]
    words = unit or "footprint units"
    return blueprint.TimeSeriesView(
        origin=STANDING, contents=STANDING, name=f"Robustness [{words}]", overrides={STANDING: lines}
    )


def _lane(row: BlueprintRow) -> Any:
    """Return a lane; Rerun names lanes by their topic, so that each state has the name of the result."""
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
    """Return a colour as Rerun takes it: 0xrrggbbaa."""
    return int(colour.removeprefix("#"), 16) << 8 | 0xFF
