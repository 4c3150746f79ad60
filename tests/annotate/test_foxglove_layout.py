"""The layout in a log shows what the log has."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from mcap.reader import make_reader
from mcap.writer import Writer

import spatial_replay as sr
from annotate.layouts import layout_of, panels, paths_of
from annotate.message_paths import split, values
from spatial_replay.annotate.foxglove_layout import LayoutContents, layout_for_live
from spatial_replay.cli import run as run_command
from spatial_replay.logs.schemas.Robustness_pb2 import Standing
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import SPECIFICATION
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.selection import ReplayOptions
from spatial_replay.sources import open_source

PUSH = Path(__file__).parents[2] / "recordings" / "push.spatial"
TEXT = "spec near = F a closeto[2] b\nspec apart = G a farfrom[0] b"


def run(tmp_path: Path, text: str, **options: object) -> Path:
    samples = [
        sr.Sample(t * 10**8, {"a": sr.Footprint.box(t, 0, t + 1, 1), "b": sr.Footprint.disc(10, 2, 1)})
        for t in range(5)
    ]
    output = tmp_path / "annotated.mcap"
    files = [sr.parse_specification(text)]
    run_replay(MemorySource.from_samples(samples), files, ReplayOptions(**options), output=output)
    return output


def check_layout(log: Path) -> dict:
    """That every panel is placed once and finds what it shows; the layout."""
    layout = layout_of(log)
    assert panels(layout) == set(layout["configById"])
    for path in paths_of(layout["configById"]):
        assert values(log, path), path
    return layout


def test_a_layout_reads_no_topic_of_more_than_60_messages_a_second(tmp_path):
    step_ns, count = 2_000_000, 200
    samples = [
        sr.Sample(t * step_ns, {"a": sr.Footprint.box(t, 0, t + 1, 1), "b": sr.Footprint.disc(50, 2, 1)})
        for t in range(count)
    ]
    output = tmp_path / "annotated.mcap"
    files = [sr.parse_specification(TEXT)]
    run_replay(MemorySource.from_samples(samples), files, output=output)
    counts = Counter()
    with output.open("rb") as stream:
        counts.update(channel.topic for _, channel, _ in make_reader(stream).iter_messages())
    seconds = (count - 1) * step_ns / 1e9
    read = {split(path)[0] for path in paths_of(layout_of(output)["configById"])}
    assert {"/spatial/scene", "/spatial/standing"} <= read
    # the first sample, and how the log ends, are messages besides
    assert all((counts[topic] - 2) / seconds <= 60 for topic in read)
    assert counts["/spatial/robustness"] / seconds > 60


RECORDINGS = Path(__file__).parents[2] / "recordings"


@pytest.mark.parametrize("specification", ["table.spatial", "table_edited.spatial"])
def test_every_path_of_a_layout_finds_something_in_its_log(tmp_path, specification):
    output = tmp_path / "annotated.mcap"
    files = [sr.load_specification(RECORDINGS / specification)]
    run_replay(open_source(RECORDINGS / "table.jsonl"), files, output=output)
    layout = check_layout(output)
    kinds = {panel.partition("!")[0] for panel in layout["configById"]}
    assert kinds == {"3D", "Indicator", "Plot", "RawMessages", "StateTransitions", "Tab", "Table"}


def test_a_layout_shows_nothing_that_its_log_has_not(tmp_path):
    text = "spec settled = G[0s, 0.2s] battery >= 0"  # no automaton, no event, nothing to draw
    log = tmp_path / "run.mcap"
    with sr.Recorder(log, specifications=[sr.parse_specification(text)]) as recorder:
        recorder.write(sr.Sample(0, {}, {"battery": -1.0}))
        recorder.write(sr.Sample(10**8, {}, {"battery": 1.0}))
    layout = check_layout(log)
    assert curves(layout).keys() == {"settled"}
    assert layout["configById"]["Plot!robustness"]["yAxisLabel"] == "units of battery"


def test_the_scene_has_half_of_the_window_and_details_are_in_tabs(tmp_path):
    layout = layout_of(run(tmp_path, TEXT + "\nspec turned = G a oriented[1] b"))
    below = layout["layout"]["second"]
    assert (below["first"], below["splitPercentage"]) == ("3D!scene", 50)
    tabs = {name: layout["configById"][name]["tabs"] for name in ("Tab!curves", "Tab!details")}
    assert [tab["title"] for tab in tabs["Tab!curves"]] == ["results", "results [no unit]"]
    assert [tab["title"] for tab in tabs["Tab!details"]] == [
        "violated",
        "events",
        "specification",
        "automaton",
    ]
    mixed = "spec turned = G a oriented[1] b\nspec apart = G a farfrom[0] b\nspec both = turned and apart"
    titles = [tab["title"] for tab in layout_of(run(tmp_path, mixed))["configById"]["Tab!curves"]["tabs"]]
    assert "results [mixed]" in titles and {"specs", "specs [no unit]"} <= {*titles}
    held = layout_of(run(tmp_path, "spec apart = G a farfrom[0] b"))
    # a viewer shows nothing of events before the first one
    assert held["configById"]["Tab!details"]["tabs"][0]["title"] == "specification"
    held = layout_of(run(tmp_path, "spec apart = a farfrom[0] b"))
    assert held["configById"]["Tab!details"]["tabs"][0]["title"] == "events"


def test_curves_have_their_values_and_140_pixels_on_a_small_screen(tmp_path):
    layout = layout_of(run(tmp_path, TEXT))
    plot = layout["configById"]["Plot!robustness"]
    assert plot["showLegend"] and plot["showPlotValuesInLegend"]
    # a list of one text would be shown centred
    assert (
        layout["configById"]["RawMessages!specification"]["topicPath"] == f"{SPECIFICATION}.files[0].source"
    )
    height = 720 - _AROUND
    tree = layout["layout"]
    height *= 1 - tree["splitPercentage"] / 100
    column = tree["second"]["second"]
    assert height * column["splitPercentage"] / 100 - _TITLES >= 140


_AROUND, _TITLES = 44 + 64, 30 + 30
"""Heights in pixels: of a viewer's bars, and of a panel's title and axis."""


def test_viewers_with_the_extension_have_a_layout_of_its_panels(tmp_path, capsys):
    log = run(tmp_path, TEXT)
    assert run_command(["info", str(log), "--layout", "--panels"]) == 0
    layout = json.loads(capsys.readouterr().out)
    assert panels(layout) == set(layout["configById"])
    assert {"3D!scene", "spatial-replay.spatial-replay specification!tree"} < panels(layout)
    assert run_command(["info", str(log), "--panels"]) == 2


def test_a_planned_run_opens_on_the_planned_result_and_its_decisions(tmp_path, capsys):
    """Another result is violated, which would come first otherwise."""
    spec = tmp_path / "two.spatial"
    spec.write_text(f"{PUSH.read_text()}\nspec still = G (green dist red >= 100)\n")
    log = tmp_path / "annotated.mcap"
    assert run_command(["replay", str(PUSH.with_suffix(".mcap")), "--spec", str(spec), "-o", str(log)]) == 1
    config = layout_of(log)["configById"]
    assert config["Indicator!result0"]["path"] == '/spatial/standing.results[:]{name=="push"}.standing'
    tabs = config["Tab!details"]
    assert tabs["tabs"][tabs["activeTabIdx"]]["layout"] == "RawMessages!decision"
    assert config["RawMessages!automaton"]["foxglovePanelTitle"] == "Automaton of push"
    camera = config["3D!scene"]["cameraState"]
    with log.open("rb") as stream:
        maps = [record.data for *_, record in make_reader(stream).iter_messages(["/plan/gradient_map"])]
    for grid in map(Grid.FromString, maps):
        low = np.array([grid.pose.position.x, grid.pose.position.y])
        cells = np.array([grid.column_count, len(grid.data) // grid.row_stride])
        high = low + cells * grid.cell_size.x
        # axes and the colour bar beside the map take a fifth
        reach = np.abs([low, high] - np.array(camera["targetOffset"][:2])).max()
        assert 1.2 * reach <= camera["distance"] / 2.0
    capsys.readouterr()
    assert run_command(["info", str(log), "--layout", "--panels"]) == 0
    config = json.loads(capsys.readouterr().out)["configById"]
    named = {key: value for key, value in config.items() if key.startswith("spatial-replay")}
    assert [value["result"] for value in named.values() if value] == ["push", "push"]
    assert config["Tab!panels"]["tabs"][0]["title"] == "decisions"


def test_any_node_is_found_by_name_and_by_id(tmp_path):
    log = run(tmp_path, 'spec close = a closeto[2] b\nspec "so near" = F (close and a farfrom[0] b)')
    [document] = sr.evaluate(
        sr.parse_specification('spec close = a closeto[2] b\nspec "so near" = F (close and a farfrom[0] b)'),
        sr.read_trace(log),
    ).results
    close = document.node("close")
    for field in ("value", "now", "lower", "upper"):
        by_name = values(
            log, f'/spatial/robustness{{specification=="so near"}}.nodes[:]{{name=="close"}}.{field}'
        )
        by_id = values(
            log, f'/spatial/robustness{{specification=="so near"}}.nodes[:]{{id=={close.id}}}.{field}'
        )
        # and once more about the finished log
        assert by_name[:-1] == by_id[:-1] == getattr(close, field).tolist()


def test_parts_that_look_ahead_are_plotted_by_their_value_and_others_as_they_are_now(tmp_path):
    text = "spec close = a closeto[2] b\nspec met = F close\nspec all_of_it = met and G a farfrom[0] b"
    log = run(tmp_path, text)
    parts = curves(layout_of(log), "Plot!parts")
    assert list(parts) == ["met in all_of_it", "close in all_of_it"]
    result = sr.evaluate(sr.parse_specification(text), sr.read_trace(log)).results[0]
    for name, field in (("met", "value"), ("close", "now")):
        assert values(log, parts[f"{name} in all_of_it"])[:-1] == getattr(result.node(name), field).tolist()


def test_a_planned_run_has_its_map_path_and_decision(tmp_path):
    first = run(tmp_path, TEXT)
    planned = tmp_path / "planned.mcap"
    with first.open("rb") as source, planned.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = {
            topic: writer.register_channel(topic, "json", 0)
            for topic in ("/plan/decision", "/plan/gradient_map", "/plan/map_drawing", "/plan/path")
        }
        for channel in channels.values():
            writer.add_message(channel, 0, b"{}", 0)
        for schema, channel, message in make_reader(source).iter_messages(["/spatial/objects"]):
            if channel.topic not in channels:
                kept = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "protobuf", kept)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    files = [sr.parse_specification(TEXT)]
    annotated, layer = tmp_path / "annotated.mcap", tmp_path / "layer.mcap"
    run_replay(open_source(planned), files, output=annotated)
    run_replay(open_source(planned), files, output=layer, layer=True)
    layout = layout_of(annotated)
    shown = layout["configById"]["3D!scene"]["topics"]
    assert set(shown) == {"/spatial/scene", "/plan/gradient_map", "/plan/map_drawing", "/plan/path"}
    assert shown["/plan/gradient_map"]["colorMode"] == "rgba-fields"
    assert layout["configById"]["RawMessages!decision"]["topicPath"] == "/plan/decision.reason"
    assert panels(layout) == set(layout["configById"])
    assert "/plan/" not in json.dumps(layout_of(layer))


def test_the_layout_for_a_live_server_has_its_constants():
    layout = layout_for_live(LayoutContents((), (), None, ()))
    assert panels(layout) == set(layout["configById"]) == {"3D!scene", "Parameters!constants"}


@pytest.mark.parametrize("path", ["spatial/a", "/a.", "/a{b=1}", "/a[x]", '/a{b=="c}'])
def test_what_is_no_path_is_not_taken_for_one(path):
    with pytest.raises(ValueError, match=r"path|topic"):
        split(path)


def curves(layout: dict, panel: str = "Plot!robustness") -> dict[str, str]:
    """The paths of a plot's curves by their labels, without the line at 0."""
    *own, zero = layout["configById"][panel]["paths"]
    assert zero["value"] == "0"
    return {path["label"]: path["value"] for path in own}


def test_the_title_of_a_light_has_the_verdicts_number_and_when_it_was_least(tmp_path):
    text = 'spec apart "REQ-2: they keep their distance" = G (a dist b >= 8)\nspec near = F a closeto[2] b'
    output = run(tmp_path, text)
    result = sr.evaluate(sr.parse_specification(text), sr.read_trace(output)).results[0]
    assert (result.violated_at_ns, result.least_at_ns) == (10**8, 4 * 10**8)
    lights = layout_of(output)["configById"]
    titles = [lights[f"Indicator!result{place}"]["foxglovePanelTitle"] for place in (0, 1)]
    number = f"{result.robustness:.4g}"
    assert titles[0] == f"REQ-2 apart, worst {number} at 0.400 s: they keep their distance"
    assert titles[1].startswith("near, worst -")


def test_every_result_has_its_curve_its_light_and_its_strip_under_its_name(tmp_path):
    layout = layout_of(run(tmp_path, TEXT))
    panels = layout["configById"]
    assert curves(layout) == {
        name: f'/spatial/standing.results[:]{{name=="{name}"}}.robustness' for name in ("near", "apart")
    }
    lights = [panel for name, panel in panels.items() if name.startswith("Indicator!")]
    for key in ("lichtblickPanelTitle", "foxglovePanelTitle"):
        first, second = (light[key] for light in lights)
        assert first == "near, worst -2.099 at 0.400 s"
        assert second == "apart"
    assert panels["Table!violated"]["topicPath"] == "/spatial/standing.violated"
    strips = panels["StateTransitions!verdicts"]["paths"]
    assert [strip["value"] for strip in strips[:2]] == [light["path"] for light in lights]
    rules = {rule["rawValue"]: rule["label"] for rule in lights[0]["rules"]}
    states = {state["value"]: state["label"] for state in strips[0]["customStates"]["states"]}
    numbers = {str(number): name.lower().replace("_", " ") for name, number in Standing.items() if number}
    assert rules == states == numbers


def test_results_of_different_units_are_plotted_apart_with_a_line_at_0(tmp_path):
    layout = layout_of(run(tmp_path, TEXT + "\nspec turned = G a oriented[1] b"))
    assert list(curves(layout)) == ["near", "apart"]
    assert list(curves(layout, "Plot!robustness1")) == ["turned"]
    axes = [layout["configById"][name]["yAxisLabel"] for name in ("Plot!robustness", "Plot!robustness1")]
    assert axes == ["footprint units", "no unit"]


def test_the_worst_of_many_results_have_lights_and_curves(tmp_path):
    # only the last one of the file is violated
    text = "\n".join(f"spec s{index} = G a farfrom[{0 if index < 44 else 4.5}] b" for index in range(45))
    layout = check_layout(run(tmp_path, text))
    lights = [panel for name, panel in layout["configById"].items() if name.startswith("Indicator!")]
    titles = [light["foxglovePanelTitle"].partition(",")[0] for light in lights]
    assert titles == ["s44", *(f"s{index}" for index in range(5))]
    assert next(iter(curves(layout))) == "s44"


def test_there_are_as_many_strips_as_results(tmp_path):
    text = "\n".join(f"spec s{index} = G a farfrom[{index}] b" for index in range(30))
    layout = check_layout(run(tmp_path, text))
    labels = [path["label"] for path in layout["configById"]["StateTransitions!verdicts"]["paths"]]
    assert sorted(labels[:30]) == sorted(f"s{index}" for index in range(30))


def test_an_instance_of_a_template_has_a_curve_of_its_own(tmp_path):
    layout = check_layout(run(tmp_path, "spec calm(x) = G x dist x <= 0", each={"x": "all"}))
    assert set(curves(layout)) == {"calm(a)", "calm(b)"}


def test_a_curve_is_labelled_with_the_id_of_its_requirement(tmp_path):
    layout = check_layout(run(tmp_path, 'spec near "REQ-2: they meet" = F a closeto[2] b'))
    assert list(curves(layout)) == ["REQ-2 near"]


def test_the_camera_looks_at_everything_from_above(tmp_path):
    camera = layout_of(run(tmp_path, TEXT))["configById"]["3D!scene"]["cameraState"]
    assert camera["target"] == [0, 0, 0]
    assert camera["targetOffset"] == pytest.approx([5.5, 1.5, 0])
    assert camera["phi"] == 0
    assert camera["distance"] >= 10


def test_another_replay_replaces_the_layout(tmp_path):
    first = run(tmp_path, TEXT)
    second = tmp_path / "again.mcap"
    run_replay(open_source(first), [sr.parse_specification("spec other = G a farfrom[0] b")], output=second)
    assert "other" in json.dumps(layout_of(second))
    assert "apart" not in json.dumps(layout_of(second))
