"""The layout in a log shows what the log has."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from mcap.reader import make_reader

import spatial_replay as sr
from spatial_replay.logs.source import MemorySource, open_source
from spatial_replay.replay import run_replay

TEXT = "spec near = F a closeto[2] b\nspec apart = G a farfrom[0] b"


def run(tmp_path: Path, text: str, **options: object) -> Path:
    samples = [
        sr.Sample(t * 10**8, {"a": sr.Footprint.box(t, 0, t + 1, 1), "b": sr.Footprint.disc(10, 2, 1)})
        for t in range(5)
    ]
    output = tmp_path / "annotated.mcap"
    files = [sr.parse_specification(text)]
    run_replay(MemorySource.from_samples(samples), files, output=output, **options)
    return output


def layout_of(log: Path) -> dict:
    with log.open("rb") as stream:
        found = [each for each in make_reader(stream).iter_attachments() if each.name == "layout.json"]
    assert len(found) == 1
    return json.loads(found[0].data)


def panels(tree: object) -> set[str]:
    return {tree} if isinstance(tree, str) else panels(tree["first"]) | panels(tree["second"])


def test_every_panel_is_placed_and_every_topic_is_in_the_log(tmp_path):
    log = run(tmp_path, TEXT)
    layout = layout_of(log)
    assert panels(layout["layout"]) == set(layout["configById"])
    with log.open("rb") as stream:
        topics = {channel.topic for channel in make_reader(stream).get_summary().channels.values()}
    assert set(re.findall(r"/spatial/\w+", json.dumps(layout))) <= topics


def test_every_result_has_its_curve_under_its_name(tmp_path):
    layout = layout_of(run(tmp_path, TEXT))
    paths = {path["label"]: path["value"] for path in layout["configById"]["Plot!robustness"]["paths"]}
    assert paths == {
        name: f'/spatial/robustness{{specification=="{name}"}}{{object==""}}.nodes[:]{{id==0}}.value'
        for name in ("near", "apart")
    }


def test_an_instance_of_a_template_has_a_curve_of_its_own(tmp_path):
    layout = layout_of(run(tmp_path, "spec calm(x) = G x dist x <= 0", each={"x": "all"}))
    paths = {path["label"]: path["value"] for path in layout["configById"]["Plot!robustness"]["paths"]}
    assert set(paths) == {"calm(a)", "calm(b)"}
    assert '{object=="b"}' in paths["calm(b)"]


def test_the_camera_looks_at_everything_from_above(tmp_path):
    camera = layout_of(run(tmp_path, TEXT))["configById"]["3D!scene"]["cameraState"]
    assert camera["target"] == pytest.approx([5, 1, 0])
    assert camera["phi"] == 0
    assert camera["distance"] >= 10


def test_another_replay_replaces_the_layout(tmp_path):
    first = run(tmp_path, TEXT)
    second = tmp_path / "again.mcap"
    run_replay(open_source(first), [sr.parse_specification("spec other = G a farfrom[0] b")], output=second)
    assert "other" in json.dumps(layout_of(second))
    assert "apart" not in json.dumps(layout_of(second))
