"""Axes of sources: y points down in images and up in samples, and a unit of the source has a length."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from bags.bag_files import START_NS, drive, write_json_mcap, write_ros1
from spatial_replay import read_trace
from spatial_replay.cli import run
from spatial_replay.sources import open_source
from spatial_replay.trace.units import Axes

CSV = """\
time_ns,name,class,x,y,yaw,length,width
0,bird,,5,2,0.5,1,1
0,cat,,5,8,,1,1
"""
ANNOTATIONS = '1 0 10 4 20 0 0 0 0 "Biker"\n2 0 40 4 50 0 0 0 0 "Biker"\n'
MAPPING = "topics: {/p: {name: robot, position: [x, y], yaw: yaw, shape: {box: [4, 2]}, uncertainty: 1.5}}"


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    path = tmp_path / "image.csv"
    path.write_text(CSV)
    return path


def mapped(folder: Path, more: str) -> sr.TrackedObject:
    log = write_json_mcap(folder / "p.mcap", [("/p", START_NS, {"x": 10.0, "y": 20.0, "yaw": 0.25})])
    mapping = folder / "p.yaml"
    mapping.write_text(f"{more}\n{MAPPING}\n")
    (sample,) = read_trace(log, mapping=mapping).samples()
    robot = sample.objects["robot"]
    assert isinstance(robot, sr.TrackedObject)
    return robot


def test_above_means_above_where_y_points_down(tracks: Path) -> None:
    above = sr.parse_specification("bird above cat")
    assert sr.evaluate(above, read_trace(tracks)).verdict == "violated"
    assert sr.evaluate(above, read_trace(tracks, y_down=True)).verdict == "satisfied"


def test_turning_y_over_turns_angles_over(tracks: Path) -> None:
    (plain,), (turned,) = (read_trace(tracks, y_down=each).samples() for each in (False, True))
    assert turned.objects["bird"].yaw == -0.5
    assert turned.objects["cat"].yaw is None
    mirrored = [(x, -y) for x, y in plain.objects["bird"].footprint.parts[0].vertices.tolist()]
    assert turned.objects["bird"].footprint == sr.Footprint.polygon(mirrored)


@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3, st.floats(0.1, 10)), min_size=1, max_size=4))
def test_turning_y_over_keeps_every_distance(boxes: list[tuple[float, float, float, float]]) -> None:
    def trace_of(sign: float) -> sr.Trace:
        objects = {
            f"o{index}": sr.TrackedObject(sr.Footprint.disc(x, sign * y, radius), yaw=sign * yaw)
            for index, (x, y, yaw, radius) in enumerate(boxes)
        }
        return sr.Trace.from_samples([sr.Sample(0, objects)])

    assert Axes("down").convert_trace(trace_of(1.0)) == trace_of(-1.0)
    assert Axes("down").convert_trace(Axes("down").convert_trace(trace_of(1.0))) == trace_of(1.0)


def test_drone_annotations_point_down_by_default(tmp_path: Path) -> None:
    path = tmp_path / "annotations.txt"
    path.write_text(ANNOTATIONS)
    above = sr.parse_specification('"1" above "2"')
    assert sr.evaluate(above, read_trace(path)).verdict == "satisfied"
    assert sr.evaluate(above, read_trace(path, y_down=False)).verdict == "violated"
    assert open_source(path).axes == Axes("down")


def test_a_recording_of_an_image_is_not_turned_over_again(
    tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, recorded, annotated = tmp_path / "a.spatial", tmp_path / "run.mcap", tmp_path / "annotated.mcap"
    spec.write_text("bird above cat\n")
    assert run(["record", "tracks", str(tracks), "--read", "y_down=true", "-o", str(recorded)]) == 0
    assert run(["replay", str(recorded), "--spec", str(spec), "-o", str(annotated)]) == 0
    assert run(["replay", str(annotated)]) == 0
    assert run(["replay", str(tracks), "--spec", str(spec)]) == 1
    assert read_trace(annotated) == read_trace(recorded) == read_trace(tracks, y_down=True)
    assert open_source(annotated).axes == open_source(recorded).axes == Axes("down")
    capsys.readouterr()
    for log in (recorded, annotated):
        assert run(["info", str(log)]) == 0
        assert "axes     y up (down in the source)\n" in capsys.readouterr().out
        assert run(["info", str(log), "--layout"]) == 0
        scene = json.loads(capsys.readouterr().out)["configById"]["3D!scene"]
        assert scene["foxglovePanelTitle"] == "Scene, y up (down in the source)"
    assert run(["info", str(tracks), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["axes"] == {"y": "up", "source": {"y": "up", "scale": 1.0}}


def test_axes_of_a_mapping_turn_its_objects_over(tmp_path: Path) -> None:
    robot = mapped(tmp_path, "axes: {y: down}")
    assert robot.yaw == -0.25
    plain = mapped(tmp_path, "axes: {y: up}").footprint.parts[0].vertices
    assert robot.footprint == sr.Footprint.polygon(plain * [1, -1])


def test_scale_multiplies_all_lengths_of_a_mapping(tmp_path: Path) -> None:
    robot, plain = mapped(tmp_path, "scale: 0.5"), mapped(tmp_path, "")
    np.testing.assert_allclose(
        sorted(robot.footprint.parts[0].vertices.tolist()),
        sorted((plain.footprint.parts[0].vertices / 2).tolist()),
    )
    assert (robot.yaw, robot.uncertainty) == (plain.yaw, plain.uncertainty / 2)
    assert math.isclose(plain.uncertainty, 1.5)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("axes: {y: left}", 'axes.y: expected up or down; got "left"'),
        ("axes: {x: down}", "axes.x: unknown key"),
        ("scale: 0", "scale: expected footprint units per unit of the log: a number above 0"),
        ("scale: mm", "scale: expected footprint units per unit of the log"),
    ],
)
def test_axes_that_mean_nothing_are_refused(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(sr.UsageError) as error:
        mapped(tmp_path, line)
    assert message in str(error.value) and "p.yaml:1: " in str(error.value)


def test_y_down_is_refused_where_something_else_says_it(tmp_path: Path, tracks: Path) -> None:
    log = tmp_path / "run.mcap"
    assert run(["record", "tracks", str(tracks), "-o", str(log)]) == 0
    with pytest.raises(
        sr.UsageError, match=r"--read y_down=true \(y_down=True\) does not apply to run\.mcap \(MCAP\)"
    ):
        open_source(log, y_down=True)
    with pytest.raises(sr.UsageError, match="y_down is 'down'; give True, False or None"):
        open_source(tracks, y_down="down")  # type: ignore[arg-type]


class TestOptionalTopics:
    """A topic that one of many logs lacks."""

    MAPPING = """\
topics:
  /gripper: {position: [x, y], shape: {disc: 0.1}, optional: true}
  /a: {position: [x, y], shape: {disc: 0.5}}
  /battery: {signals: {charge: percentage}, optional: true}
"""

    def read(self, folder: Path, text: str) -> sr.Trace:
        mapping = folder / "drive.yaml"
        mapping.write_text(text)
        return read_trace(write_ros1(folder / "a.bag", drive(5)), mapping=mapping)

    def test_a_log_may_lack_it_and_says_so(self, tmp_path: Path) -> None:
        trace = self.read(tmp_path, self.MAPPING)
        assert trace.names == ("a",) and len(trace) == 5 and not trace.faults
        assert "a.bag: it has no topic '/gripper', which drive.yaml marks as optional" in trace.remarks
        assert "a.bag: it has no topic '/battery', which drive.yaml marks as optional" in trace.remarks

    def test_a_topic_that_is_not_optional_must_be_there(self, tmp_path: Path) -> None:
        with pytest.raises(sr.UsageError, match=r"topics\./gripper: the log has no topic '/gripper'"):
            self.read(tmp_path, self.MAPPING.replace("{disc: 0.1}, optional: true", "{disc: 0.1}"))

    def test_samples_cannot_wait_for_a_topic_that_never_comes(self, tmp_path: Path) -> None:
        with pytest.raises(sr.UsageError, match=r"sample\.topic: the log has no topic '/gripper', so no"):
            self.read(tmp_path, f"sample: {{topic: /gripper}}\n{self.MAPPING}")

    def test_some_topic_must_be_there(self, tmp_path: Path) -> None:
        with pytest.raises(sr.UsageError, match="has none of these optional topics; its topics are /a"):
            self.read(tmp_path, "topics: {/gripper: {position: [x, y], optional: true}}")
