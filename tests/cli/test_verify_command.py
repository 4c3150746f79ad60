"""`verify`, and `info --decisions`, on logs that were planned and on others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

import spatial_replay as sr
from planning.plans import PUSH, record_plan_of
from spatial_replay.cli.application import application


def call(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(application, [str(each) for each in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.output


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    specification = sr.parse_specification("F (a leftof b)")
    with sr.Recorder(tmp_path / "run.mcap", specifications=specification) as recorder:
        for k in range(40):
            box = sr.Footprint.box(20 - k, 0, 21 - k, 1)
            recorder.write(sr.Sample(k * 10**8, {"a": box, "b": sr.Footprint.disc(5, 5, 1)}))
    return tmp_path / "run.mcap"


def test_an_unchanged_log_is_verified(recorded: Path) -> None:
    code, said = call("verify", recorded)
    assert code == 0
    assert "results match" in said


def test_an_annotated_log_is_verified_alone_and_against_its_source(recorded: Path, tmp_path: Path) -> None:
    call("replay", recorded, "-o", tmp_path / "annotated.mcap", "--from", "1s", "--every", "2")
    assert call("verify", tmp_path / "annotated.mcap")[0] == 0
    assert call("verify", tmp_path / "annotated.mcap", "--source", recorded)[0] == 0


def test_a_layer_is_verified_against_its_source(recorded: Path, tmp_path: Path) -> None:
    call("replay", recorded, "-o", tmp_path / "layer.mcap", "--layer")
    assert call("verify", tmp_path / "layer.mcap", "--source", recorded)[0] == 0
    with pytest.raises(sr.UsageError, match="--source"):
        call("verify", tmp_path / "layer.mcap")


def test_a_different_source_is_detected(recorded: Path, tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "other.mcap") as recorder:
        recorder.write(sr.Sample(0, {"a": sr.Footprint.disc(1, 1, 1), "b": sr.Footprint.disc(5, 5, 1)}))
    code, said = call("verify", recorded, "--source", tmp_path / "other.mcap")
    assert code == 1
    assert "other samples" in said
    assert "other results" in said
    assert "another specification" not in said


def test_a_truncated_log_has_no_certificate(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(recorded.read_bytes()[: recorded.stat().st_size // 2])
    code, said = call("verify", tmp_path / "cut.mcap")
    assert code == 1
    assert "no certificate" in said


def test_decisions_are_recomputed(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap")
    code, said = call("verify", tmp_path / "run.mcap", "--decisions")
    assert code == 0
    assert "3 decisions recomputed with 9 maps" in said


def test_decisions_that_differ_are_reported(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap", recorded_settings=replace(PUSH, margin=0.03))
    code, said = call("verify", tmp_path / "run.mcap", "--decisions")
    assert code == 1
    assert "of decision 0" in said


def test_decisions_of_the_source_are_recomputed(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap")
    call("replay", tmp_path / "run.mcap", "-o", tmp_path / "layer.mcap", "--layer")
    call("replay", tmp_path / "run.mcap", "-o", tmp_path / "cut.mcap", "--from", "50ms")
    for name in ("layer.mcap", "cut.mcap"):
        code, said = call("verify", tmp_path / name, "--decisions", "--source", tmp_path / "run.mcap")
        assert code == 0
        assert "run.mcap: 3 decisions recomputed with 9 maps" in said
    with pytest.raises(sr.UsageError, match="begins within the run"):
        call("verify", tmp_path / "cut.mcap", "--decisions")


def test_decisions_are_printed_step_by_step(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap", slips=1)
    code, said = call("info", tmp_path / "run.mcap", "--decisions")
    lines = said.splitlines()
    assert code == 0
    assert lines[0].startswith("run.mcap: 4 decisions for 'push', 3 motions, 1 edge given up")
    assert next(line for line in lines if line.startswith("step ")) == "step 0 at 0.000 s, state 0"
    assert "    given up: no object can do it" in lines
    assert any(line.startswith("  failed at") and "it slipped" in line for line in lines)
    assert any("chosen" in line for line in lines)
    assert lines[-1] == "  the specification is satisfied: hold"


def test_decisions_fit_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "70")
    record_plan_of(tmp_path / "run.mcap")
    _, said = call("info", tmp_path / "run.mcap", "--decisions")
    assert max(map(len, said.splitlines())) <= 70
    _, whole = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    printed = " ".join(said.split())
    for edge in json.loads(whole)["decisions"][0]["considered"]:
        assert f"to reach {edge['progress'][0]['text']}" in printed


def test_a_motion_cut_off_by_the_end_of_the_log_is_marked(tmp_path: Path) -> None:
    def seen(sample: sr.Sample) -> sr.Sample:
        if sample.time_ns > 2 * 10**8:
            raise KeyboardInterrupt
        return sample

    with pytest.raises(KeyboardInterrupt):
        record_plan_of(tmp_path / "run.mcap", recorded_as=seen)
    _, said = call("info", tmp_path / "run.mcap", "--decisions")
    lines = said.splitlines()
    assert lines[0] == "run.mcap: 2 decisions for 'push', 1 motion and one cut short, 1 edge given up"
    assert lines[-1] == "  the log ends during this motion"


def test_decisions_of_a_truncated_log_are_printed(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap", slips=1)
    whole = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, said = call("info", tmp_path / "cut.mcap", "--decisions")
    assert code == 3
    assert "step 0 at 0.000 s, state 0" in said
    code, said = call("verify", tmp_path / "cut.mcap", "--decisions")
    assert code == 1
    assert "recomputed" in said
    assert "no certificate" in said


def test_decisions_are_available_as_json(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap")
    code, said = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    decisions = json.loads(said)["decisions"]
    assert code == 0
    assert [each["kind"] for each in decisions] == ["execute", "execute", "hold"]
    assert decisions[0]["time_ns"] == 0
    assert decisions[0]["outcome"]["succeeded"] is True
    assert decisions[0]["target"]["object"] in {"red", "blue"}


def test_infinite_numbers_are_written_as_in_other_json(tmp_path: Path) -> None:
    everywhere = sr.Footprint.box(-1, -1, 2, 2)
    walled = replace(PUSH, workspace=replace(PUSH.workspace, obstacles=(everywhere,)))
    record_plan_of(tmp_path / "run.mcap", settings=walled)
    _, said = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    candidates = json.loads(said)["decisions"][0]["considered"][0]["candidates"]
    assert [each["best"] for each in candidates] == ["-inf", "-inf", "-inf"]


def test_a_log_without_decisions_is_wrong_usage(recorded: Path) -> None:
    with pytest.raises(sr.UsageError, match="holds no decisions"):
        call("info", recorded, "--decisions")
    with pytest.raises(sr.UsageError, match="holds no decisions"):
        call("verify", recorded, "--decisions")


def test_a_mapping_requires_a_source(recorded: Path) -> None:
    with pytest.raises(sr.UsageError, match="add --source"):
        call("verify", recorded, "--mapping", "m.yaml")


def test_a_source_is_read_as_it_was_when_the_log_was_made(tmp_path: Path) -> None:
    boxes, spec = tmp_path / "annotations.txt", tmp_path / "near.spatial"
    boxes.write_text('1 0 10 4 20 0 0 0 0 "Biker"\n2 0 40 4 50 9 1 0 0 "Biker"\n')
    spec.write_text('F ("1" above "2")\n')
    call(
        "replay", boxes, "--spec", spec, "--y-up", "--rate", "10", "--lost", "keep", "-o", tmp_path / "a.mcap"
    )
    assert call("verify", tmp_path / "a.mcap", "--source", boxes)[0] == 0
    assert call("verify", tmp_path / "a.mcap", "--source", boxes, "--y-down")[0] == 1
