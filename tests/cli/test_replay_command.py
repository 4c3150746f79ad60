"""`spatial-replay replay`, from outside: streams, exit codes, and what bad input gets."""

from __future__ import annotations

import gzip
import json
import random
import re
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from cli.interruptions import interrupted, write_many
from cli.program import PROGRAM, run_process, run_program
from replay.runs import SPECIFICATION, content_of, run, write_tracks
from spatial_replay import Trace
from spatial_replay.cli import run as run_in_process
from spatial_replay.logs.topics import SCENE


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the current one, with a run and a specification."""
    monkeypatch.chdir(tmp_path)
    write_tracks(run(), tmp_path / "run.jsonl")
    (tmp_path / "blocks.spatial").write_text(SPECIFICATION, encoding="utf-8")
    return tmp_path


REPLAY = ("replay", "run.jsonl", "--spec", "blocks.spatial")


def test_verdicts_are_printed_on_standard_output(folder: Path) -> None:
    done = run_program(*REPLAY, "-o", "out.mcap", cwd=folder)
    assert (done.returncode, done.stderr) == (4, "")
    # the worst first, whatever the order in the file
    head, apart, reason, gap, reach, wrote = done.stdout.splitlines()
    assert head == "run.jsonl: 12 samples over 2.750 s"
    assert reach.split()[:2] == ["reach", "satisfied"]
    assert apart.split()[:2] == ["apart", "unknown"]
    assert "cup 物" in reason
    assert gap.strip().startswith("cup 物 is missing in 2 of 12 samples, the longest time from 0.750 s")
    assert wrote == "wrote out.mcap"


def test_json_goes_to_a_file_or_to_standard_output(folder: Path) -> None:
    to_stream = run_program(*REPLAY, "--json", "-", cwd=folder)
    to_file = run_program(*REPLAY, "--json", "found.json", cwd=folder)
    assert (to_stream.returncode, to_file.returncode) == (4, 4)
    found = json.loads(to_stream.stdout)
    assert [each["name"] for each in found["specifications"]] == ["reach", "apart"]
    assert json.loads((folder / "found.json").read_text(encoding="utf-8")) == found
    assert "reach" in to_file.stdout


@pytest.mark.parametrize(
    ("formula", "code"),
    [
        ("F cube ovlp cube", 0),
        ("G cube dist cube >= 1", 1),
        ('G "cup 物" ovlp "cup 物"', 4),
        ('(G "cup 物" ovlp "cup 物") and G cube dist cube >= 1', 1),
    ],
)
def test_the_exit_code_is_the_verdict(folder: Path, formula: str, code: int) -> None:
    (folder / "a.spatial").write_text(formula, encoding="utf-8")
    assert run_in_process(["replay", "run.jsonl", "--spec", "a.spatial"]) == code


def test_each_and_the_window_are_passed_to_the_evaluation(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "near.spatial").write_text("spec near(ego) = G (ego dist cube <= 9)")
    arguments = ["replay", "run.jsonl", "--spec", "near.spatial", "--each", "ego=class:dish", "--json", "-"]
    assert run_in_process([*arguments, "--from", "1s", "--to", "2000ms", "--every", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["log"]["samples"], found["log"]["start_ns"]) == (2, 10**9)
    assert [each["object"] for each in found["specifications"]] == ["cup 物"]


@pytest.mark.parametrize("window", [(), ("--from", "1s"), ("--from", "500000000ns", "--every", "2")])
def test_a_printed_time_is_that_of_the_sample_in_seconds_from_the_start(
    folder: Path, window: Sequence[str], capsys: pytest.CaptureFixture[str]
) -> None:
    odd = Trace.from_samples(replace(each, time_ns=each.time_ns * 10 // 7 + 5) for each in run().samples())
    write_tracks(odd, folder / "run.jsonl")
    run_in_process([*REPLAY, *window, "--json", "found.json"])
    reach = json.loads((folder / "found.json").read_text())["specifications"][0]
    seconds = (reach["satisfied_at_ns"] - odd.times_ns[0]) / 1e9
    assert re.search(rf"reach .*certain since {seconds:.3f} s", capsys.readouterr().out)


def test_numbers_that_are_not_finite_are_counted_and_unknown(folder: Path) -> None:
    with (folder / "run.jsonl").open("a") as stream:
        for index, bad in enumerate(("NaN", "Infinity")):
            cube = f'{{"name": "cube", "polygon": [[{bad}, 0], [1, 0], [1, 1]]}}'
            stream.write(f'{{"time_ns": {3 * 10**9 + index}, "objects": [{cube}]}}\n')
    (folder / "a.spatial").write_text("G cube ovlp cube")
    done = run_program("replay", "run.jsonl", "--spec", "a.spatial", cwd=folder)
    assert done.returncode == 4
    assert done.stderr == (
        "spatial-replay: warning: 2 observations hold a number that is not finite: unknown there\n"
    )


def _log_of(*lines: str) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


GOOD = '{"time_ns": 0, "objects": [{"name": "cube", "polygon": [[0, 0], [1, 0], [1, 1]]}]}'
SAME_TIME = GOOD
TWICE = GOOD.replace("0,", "9,", 1).replace("[{", '[{"name": "cube", "polygon": [[0, 0]]}, {')


@pytest.mark.parametrize(
    ("content", "code", "said"),
    [
        (b"\x89PNG\r\n\x1a\n" + bytes(64), 2, "run.bin is not a log in a known format"),
        (random.Random(3).randbytes(5000), 2, "run.bin is not a log in a known format"),
        (b"", 3, "run.bin is empty"),
        (gzip.compress(b"x" * 9 + GOOD.encode())[:20], 3, "run.bin"),
        (gzip.compress((GOOD + "\n").encode() * 1)[:-9], 3, "run.bin:"),
        (_log_of(GOOD, "no sample"), 3, "run.bin:2: "),
        (_log_of(GOOD, '{"time": 3}'), 3, "run.bin:2: "),
        (
            _log_of(GOOD, SAME_TIME),
            3,
            "run.bin:2: its time is 0.000 s, not after 0.000 s; give times that increase",
        ),
        (
            _log_of(GOOD.replace("0,", "9,", 1), GOOD),
            3,
            "run.bin:2: its time is 0.000 s (0 ns), not after 0.000 s (9 ns)",
        ),
        (_log_of(GOOD, TWICE), 3, "run.bin:2: object 'cube' is there twice"),
    ],
    ids=[
        "a picture",
        "noise",
        "nothing",
        "gzip without a line",
        "gzip that breaks off",
        "a line that is not JSON",
        "a line that is not a sample",
        "a time twice",
        "a time that decreases",
        "an object twice",
    ],
)
def test_a_file_that_is_not_a_log_or_is_damaged_is_reported(
    folder: Path, content: bytes, code: int, said: str
) -> None:
    (folder / "run.bin").write_bytes(content)
    (folder / "a.spatial").write_text("G cube ovlp cube")
    done = run_program("replay", "run.bin", "--spec", "a.spatial", "-o", "out.mcap", cwd=folder)
    assert (done.returncode, len(done.stderr.splitlines())) == (code, 1)
    assert said in done.stderr
    # of a damaged log, a marked verdict is given over what could be read
    assert ("damaged" in done.stdout) == (folder / "out.mcap").exists()


TEN_FAULTS = "\n".join(
    [
        "const near = ",
        "region goal = box(0, 0, 1)",
        "group reds = ",
        "def d(a) = ",
        "spec a = F (x ovlap y)",
        "spec b = G[5, 2] x ovlp y",
        "spec c = x closeto y",
        "spec d = x ovlp",
        "spec e = (x ovlp y",
        ")",
        "spec b = x ovlp y",
        "spec f = (F x) ovlp y",
        "",
    ]
)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("replay", "none.mcap", "--spec", "blocks.spatial"), "none.mcap: no such file; check the path"),
        (("replay", "run.jsonl", "--spec", "none.spatial"), "none.spatial: no such file; check the path"),
        (
            ("replay", "run.jsonl", "blocks.spatial"),
            "specifications come after --spec: spatial-replay replay LOG --spec FILE; batch takes many logs",
        ),
        (("replay", "run.jsonl"), "run.jsonl holds no specification of its own; give one with --spec"),
        ((*REPLAY, "-o", "run.jsonl"), "run.jsonl: the output is a log (MCAP); name it run.mcap"),
        ((*REPLAY, "-o", "./blocks.spatial"), "blocks.spatial is an input too"),
        ((*REPLAY, "--json", "run.jsonl"), "run.jsonl is an input too"),
        ((*REPLAY, "-o", "out", "--json", "./out"), "-o and --json both name ./out"),
        ((*REPLAY, "-o", "none/out.mcap"), "there is no folder none"),
        ((*REPLAY, "-o", "."), "is a folder"),
        ((*REPLAY, "--from", "3"), "--from: '3' has no unit: 3s after the log's first sample, or 3 ns"),
        ((*REPLAY, "-o", "out.csv"), "out.csv is written by spatial-replay export"),
        (("record", "tracks", "run.jsonl", "-o", "out.csv"), "is a log (MCAP); name it out.mcap"),
        ((*REPLAY, "-o", "out.html"), "out.html is written by spatial-replay report"),
        ((*REPLAY, "--from", "soon"), "'soon' is not a time; write 12.5s"),
        ((*REPLAY, "--from", "99s"), "run.jsonl has no sample in the requested window; its samples are from"),
        ((*REPLAY, "--from", "2s", "--to", "1000ms"), "the window --from 2s --to 1000ms is empty"),
        ((*REPLAY, "--to", "0s"), "the window --to 0s is empty"),
        ((*REPLAY, "-o", "-"), "'-' is not a file; only --json - writes to standard output"),
        ((*REPLAY, "--every", "0"), "0 is not in the range x>=1"),
        ((*REPLAY, "--layer"), "add -o FILE"),
        ((*REPLAY, "--series"), "add --json FILE"),
        ((*REPLAY, "--each", "ego=all"), "no template has a parameter 'ego'"),
        ((*REPLAY, "--each", "ego"), "write VAR=class:NAME"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_wrong_usage_is_reported_and_writes_nothing(
    folder: Path, arguments: Sequence[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert run_in_process(arguments) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    assert said in streams.err
    assert len(streams.err.splitlines()) <= 3
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_template_requires_each(folder: Path) -> None:
    (folder / "near.spatial").write_text("spec near(ego) = G (ego dist cube <= 9)")
    replay = ("replay", "run.jsonl", "--spec", "near.spatial")
    without = run_program(*replay, cwd=folder)
    assert (without.returncode, without.stdout) == (2, "")
    assert "near(ego) is a template: say what ego stands for, --each ego=class:NAME" in without.stderr
    known = run_program(*replay, "--each", "ego=class:Block", cwd=folder)
    assert known.returncode == 0
    assert "near(cube)" in known.stdout
    unknown = run_program(*replay, "--each", "ego=class:dog", cwd=folder)
    assert unknown.returncode == 4
    assert "vacuous: `near(ego)` was never evaluated: no object stands for ego." in unknown.stdout
    assert "near.spatial:1:6: warning: the log never has the class 'dog'" in unknown.stderr
    assert "its classes are Block, dish" in unknown.stderr
    explained = run_program("explain", *replay[1:], "--each", "ego=class:dog", cwd=folder)
    assert explained.returncode == 0
    assert (
        explained.stdout
        == "`near(ego)` was never evaluated: no object stands for ego. The log never has the class 'dog'.\n"
    )
    gate = run_program(*replay, "--each", "ego=class:dog", "--fail-on", "vacuous", "--json", "-", cwd=folder)
    assert gate.returncode == 1
    assert json.loads(gate.stdout)["log"]["missing"] == ["the log never has the class 'dog'"]


def test_every_error_of_a_specification_is_reported(folder: Path) -> None:
    (folder / "faulty.spatial").write_text(TEN_FAULTS)
    done = run_program("replay", "run.jsonl", "--spec", "faulty.spatial", cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    places = {line.split(":")[1] for line in done.stderr.splitlines() if line.startswith("faulty.spatial:")}
    assert len(places) >= 10
    assert "Traceback" not in done.stderr


def test_an_object_that_is_not_in_the_log_is_unknown(folder: Path) -> None:
    (folder / "a.spatial").write_text("spec s = F (cub ovlp cube)\n")
    arguments = ("replay", "run.jsonl", "--spec", "a.spatial", "--json", "out.json")
    done = run_program(*arguments, cwd=folder)
    assert done.returncode == 4
    assert "a.spatial:1:13: warning: the log never has the object 'cub'" in done.stderr
    assert "did you mean 'cube'? its objects are cube, cup 物" in done.stderr
    document = json.loads((folder / "out.json").read_text())
    assert document["log"]["missing"] == ["the log never has the object 'cub'"]
    strict = run_program(*arguments, "--strict-names", cwd=folder)
    assert (strict.returncode, strict.stdout) == (2, "")
    assert "a.spatial:1:13: error: the log never has the object 'cub'" in strict.stderr


def test_an_unknown_name_leaves_the_verdicts_of_other_specs(folder: Path) -> None:
    (folder / "two.spatial").write_text("spec a = G (cub ovlp cube)\nspec b = G (cube ovlp cube)\n")
    assert run_in_process(["replay", "run.jsonl", "--spec", "two.spatial", "--json", "two.json"]) == 4
    verdicts = [each["verdict"] for each in json.loads((folder / "two.json").read_text())["specifications"]]
    assert verdicts == ["unknown", "satisfied"]


def test_a_full_disk_gives_code_70_and_leaves_no_file(folder: Path) -> None:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    (folder / "full").symlink_to("/dev/full")
    before = sorted(folder.iterdir())
    done = run_process(*REPLAY, "-o", "full", cwd=folder)
    assert (done.returncode, done.stdout) == (70, "")
    assert done.stderr == "spatial-replay: error: full could not be written: no space left on the device\n"
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_replay_leaves_no_file(tmp_path: Path, number: signal.Signals) -> None:
    write_many(tmp_path / "run.jsonl")
    (tmp_path / "a.spatial").write_text("F cube ovlp cube")
    command = [*PROGRAM, "replay", "run.jsonl", "--spec", "a.spatial", "-o", "out.mcap"]
    code, said = interrupted(command, number, tmp_path, lambda: any(tmp_path.glob(".out.mcap.*")))
    assert (code, said) == (130, "spatial-replay: error: interrupted")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.spatial", "run.jsonl"]


def test_many_warnings_that_differ_in_numbers_only_are_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Path("run.jsonl").open("a") as stream:
        stream.write("{\n" * 60)
    assert run_in_process(["replay", "run.jsonl", "--spec", "blocks.spatial", "--json", "all.json"]) == 3
    said = capsys.readouterr().err
    assert said.count("run.jsonl:") == 1
    assert "(and 59 more like it)" in said
    assert len(json.loads(Path("all.json").read_text())["log"]["faults"]) == 60


@pytest.mark.parametrize(("count", "shown"), [(20, 20), (125, 12)])
def test_of_many_results_the_worst_are_printed(
    folder: Path, capsys: pytest.CaptureFixture[str], count: int, shown: int
) -> None:
    Path("crowd.csv").write_text(
        "time_ns,name,class,x,y,yaw,length,width\n"
        + "".join(f"{tick},p{k},person,{k % 7},0,0,1,1\n" for tick in range(2) for k in range(count))
    )
    Path("crowd.spatial").write_text(
        "region gate = box(3, -1, 4, 1)\nspec out(ego) = G not (ego ovlp gate)\n"
    )
    arguments = ["crowd.csv", "--spec", "crowd.spatial", "--each", "ego=all"]
    for command in ("replay", "explain"):
        assert run_in_process([command, *arguments]) == 1
        printed = capsys.readouterr().out
        assert len(re.findall(r"^ *`?out`?(?:\(| for )", printed, re.MULTILINE)) == shown
        assert (f"and {count - 12} more: " in printed) == (count > shown)
    assert run_in_process(["replay", *arguments[:-1], "ego=p5", "--json", "-"]) == 0
    assert [each["object"] for each in json.loads(capsys.readouterr().out)["specifications"]] == ["p5"]


def test_a_log_is_replayed_with_its_own_specification(folder: Path) -> None:
    assert (
        run_in_process(["record", "tracks", "run.jsonl", "--spec", "blocks.spatial", "-o", "run.mcap"]) == 0
    )
    assert run_in_process(["replay", "run.mcap", "-o", "own.mcap"]) == 4
    assert run_in_process(["replay", "run.mcap", "--spec", "blocks.spatial", "-o", "named.mcap"]) == 4
    assert Path("own.mcap").read_bytes() == Path("named.mcap").read_bytes()
    assert content_of(Path("own.mcap")).of("/spatial/robustness")


def test_the_arrow_of_an_annotated_log_points_at_the_result_that_is_chosen(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'spec near = G "cup 物" closeto[0] cube\nspec apart "R-9: off" = G "cup 物" farfrom[99] cube'
    (folder / "two.spatial").write_text(text, encoding="utf-8")
    command = ["replay", "run.jsonl", "--spec", "two.spatial"]

    def pointed_at(log: str) -> str:
        drawn = [
            SceneUpdate.FromString(each[-1]) for each in content_of(folder / log).messages if each[0] == SCENE
        ]
        [entity] = [entity for entity in drawn[1].entities if entity.id == "witness"]
        return entity.texts[-1].text.partition(":")[0]

    assert run_in_process([*command, "-o", "first.mcap"]) == 1
    assert run_in_process([*command, "-o", "chosen.mcap", "--arrow", "apart"]) == 1
    for number, called in enumerate(("R-9 apart", "apart [R-9]")):
        assert run_in_process([*command, "-o", f"{number}.mcap", "--arrow", called]) == 1
        assert pointed_at(f"{number}.mcap") == pointed_at("chosen.mcap")
    assert pointed_at("first.mcap") == '"cup 物" closeto[0] cube now'
    assert pointed_at("chosen.mcap") == '"cup 物" farfrom[99] cube now'
    # the choice is part of the log, and its certificate is computed again with it
    assert run_in_process(["verify", "chosen.mcap"]) == 0
    capsys.readouterr()
    assert run_in_process([*command, "-o", "other.mcap", "--arrow", "apat"]) == 2
    assert "did you mean 'R-9 apart'?" in capsys.readouterr().err
    assert run_in_process([*command, "--arrow", "apart"]) == 2
    assert "add -o FILE" in capsys.readouterr().err
