"""What the commands do, from Python: the functions and the program agree."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.cli import run

RECORDINGS = Path(__file__).parent.parent / "recordings"
LOG, SPEC = RECORDINGS / "table.jsonl", RECORDINGS / "table.spatial"


def test_a_replay_writes_the_file_that_the_command_writes(tmp_path: Path) -> None:
    replayed = sr.replay_log(LOG, SPEC, output=tmp_path / "python.mcap", constants={"near": 0.3})
    command = ["replay", str(LOG), "--spec", str(SPEC), "--const", "near=0.3"]
    assert run([*command, "-o", str(tmp_path / "command.mcap"), "--json", str(tmp_path / "all.json")]) == 0
    assert (tmp_path / "python.mcap").read_bytes() == (tmp_path / "command.mcap").read_bytes()
    document = json.loads((tmp_path / "all.json").read_text())
    assert [each.robustness for each in replayed.results] == [
        each["robustness"] for each in document["specifications"]
    ]
    assert replayed.verdict == "satisfied"


def test_a_trace_and_a_parsed_specification_do_as_well_as_files() -> None:
    of_values = sr.replay_log(sr.read_trace(LOG), sr.load_specification(SPEC))
    of_files = sr.replay_log(str(LOG), [SPEC])
    assert [each.robustness for each in of_values.results] == [each.robustness for each in of_files.results]
    assert of_values.results[0].explain() == of_files.results[0].explain()


def test_a_report_is_the_page_that_the_command_writes(tmp_path: Path) -> None:
    sr.write_report(LOG, SPEC, output=tmp_path / "python.html")
    assert run(["report", str(LOG), "--spec", str(SPEC), "-o", str(tmp_path / "command.html")]) == 0
    assert (tmp_path / "python.html").read_bytes() == (tmp_path / "command.html").read_bytes()


def test_a_log_is_verified_and_described(tmp_path: Path) -> None:
    sr.replay_log(LOG, SPEC, output=tmp_path / "annotated.mcap")
    assert sr.verify(tmp_path / "annotated.mcap").differences == ()
    assert sr.verify(tmp_path / "annotated.mcap", LOG).differences == ()
    described = sr.info(tmp_path / "annotated.mcap")
    assert (described.samples, [each.name for each in described.objects]) == (
        300,
        ["cup", "fork", "milk", "plate", "spoon"],
    )


def test_the_log_s_own_specification_is_evaluated_without_another(tmp_path: Path) -> None:
    first = sr.replay_log(LOG, SPEC, output=tmp_path / "annotated.mcap", constants={"near": 0.01})
    again = sr.replay_log(tmp_path / "annotated.mcap")
    assert first.verdict == again.verdict == "violated"
    assert [each.robustness for each in again.results] == [each.robustness for each in first.results]


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(sr.UsageError, match=r"no such file"):
        sr.replay_log(tmp_path / "none.jsonl", SPEC)
    with pytest.raises(sr.UsageError, match=r"holds no specification of its own"):
        sr.replay_log(LOG)
    with pytest.raises(sr.UsageError, match=r"constants are for files"):
        sr.replay_log(LOG, sr.load_specification(SPEC), constants={"near": 1})
    with pytest.raises(sr.UsageError, match=r"specifications has 3"):
        sr.replay_log(LOG, [3])  # type: ignore[list-item]
    with pytest.raises(sr.UsageError, match=r"is a trace already"):
        sr.replay_log(sr.read_trace(LOG), SPEC, rate=5.0)
    with pytest.raises(sr.UsageError, match=r"give source="):
        sr.verify(LOG, rate=5.0)
    copy = tmp_path / "copy.jsonl"
    copy.write_bytes(LOG.read_bytes())
    with pytest.raises(sr.UsageError, match=r"copy\.jsonl"):
        sr.write_report(copy, SPEC, output=copy)
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log that is needed")
    with pytest.raises(sr.UsageError, match=r"report writes an HTML page; name it run\.html"):
        sr.write_report(LOG, SPEC, output=log)
    assert log.read_bytes() == b"a log that is needed"
    with pytest.raises(sr.UsageError, match="evry=2 is no argument; did you mean 'every'"):
        sr.replay_log(LOG, SPEC, evry=2)  # type: ignore[call-arg]
    with pytest.raises(sr.UsageError, match=r"is no argument; there are .*, specifications, "):
        sr.replay_log(LOG, spec=SPEC)  # type: ignore[call-arg]
    for kinds, said in (
        ({"fail_on": "vacuous"}, "give a sequence"),
        ({"allow": ["droped"]}, "mean 'dropped'"),
    ):
        with pytest.raises(sr.UsageError, match=said):
            sr.evaluate_logs(LOG, SPEC, output="out", **kinds)  # type: ignore[arg-type]
    for asked in (sr.info, sr.verify, lambda log, **own: sr.evaluate_logs(log, output="out", **own)):
        with pytest.raises(sr.UsageError, match=r"maping=.m\.yaml. is no argument; did you mean .mapping."):
            asked(LOG, maping="m.yaml")


def test_an_argument_that_does_not_exist_names_the_nearest_and_what_is_no_object_says_so(
    tmp_path: Path,
) -> None:
    specification = sr.parse_specification("G (a dist b >= 1)")
    disc = sr.Footprint.disc(0, 0, 1)
    for name, given, said in (
        ("Sample", ((0, {}), {"signal": {"battery": 1}}), "did you mean 'signals'"),
        ("TrackedObject", ((disc,), {"heigth": (0, 1)}), "did you mean 'height'"),
        ("Monitor", ((specification,), {"stric_names": True}), "did you mean 'strict_names'"),
        ("Recorder", ((tmp_path / "a.mcap",), {"specification": []}), "did you mean 'specifications'"),
        ("Trigger", (("violated",), {"before": 1}), "did you mean 'before_s'"),
        ("evaluate", ((specification, None), {"semantic": "paper"}), "did you mean 'semantics'"),
        ("automaton", ((specification,), {"rate": 3}), "did you mean 'rate_hz'"),
        ("doctor", ((specification,), {"example": False}), "did you mean 'examples'"),
        ("distinguish", ((specification, specification), {"rate": 3}), "did you mean 'rate_hz'"),
        ("parse_specification", (("true",), {"const": {}}), "did you mean 'constants'"),
        ("read_trace", (("a.jsonl",), {"maping": "m.yaml"}), "did you mean 'mapping'"),
        ("tune", ((specification, "a.jsonl"), {"vary": ["near"]}), "give ranges by name"),
        ("tune", ((specification, "a.jsonl"), {"vary": {"near": "0:1"}}), "give ranges by name"),
        ("Sample", ((0, {"mode": "on"}), {}), "numbers and texts are signals: Sample"),
        ("Sample", ((0, {"battery": 0.5}), {}), "numbers and texts are signals: Sample"),
    ):
        values, named = given
        with pytest.raises((sr.UsageError, sr.TraceError), match=said):
            getattr(sr, name)(*values, **named)
    with pytest.raises(sr.UsageError, match=r"radus=1 is no argument; did you mean 'radius'"):
        sr.Footprint.disc(0, 0, radus=1)  # type: ignore[call-arg]
    with pytest.raises(sr.UsageError, match=r"angle=1 is no argument; there are xmin, ymin"):
        sr.Footprint.box(0, 0, 1, 1, angle=1)  # type: ignore[call-arg]


def test_a_log_a_file_a_text_and_a_trace_in_the_place_of_another_are_named(tmp_path: Path) -> None:
    trace = sr.read_trace(LOG)
    assert [sample.time_ns for sample in trace] == trace.times_ns.tolist()
    for call, said in (
        (lambda: sr.load_specification(LOG), "table.jsonl is a log, not a specification"),
        (lambda: sr.load_specification("G (a dist b >= 1)"), r"is a formula; parse_specification\(text\)"),
        (lambda: sr.parse_specification("table.spatial"), r"load_specification\(path\) reads a file"),
        (lambda: sr.read_trace(SPEC), "table.spatial is a specification, not a log; give it by --spec"),
        (lambda: sr.Trace.from_samples([{"time_ns": 0}]), "is not a sample; give a Sample"),  # type: ignore[list-item]
        (lambda: sr.evaluate_logs([trace], SPEC, output=tmp_path), "give paths; evaluate takes a trace"),  # type: ignore[list-item]
    ):
        with pytest.raises(sr.UsageError, match=said):
            call()
