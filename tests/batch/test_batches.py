"""Batches: what is evaluated, what is kept, what fails, and what bad input gets."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.request import Request, urlopen
from xml.etree import ElementTree

import pandas
import pyarrow.compute as pc
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from pyarrow import parquet

import spatial_replay as sr
from batch.fleet import GATE, batch, command, write_fleet, write_log
from logs.servers import s3_server
from spatial_replay.batch.overview import overview_page
from spatial_replay.logs.source import MemorySource
from spatial_replay.recording.source_recording import record_source
from spatial_replay.testing import assert_satisfied
from spatial_replay.text import Sentence
from spatial_replay.trace.doubts import Doubt
from users import plain_user

DISTANCES = [0.5, 0.4, 0.2, 0.1]


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with four logs, of which two come too close."""
    write_fleet(tmp_path, DISTANCES)
    monkeypatch.chdir(tmp_path)
    for name in ("GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_a_row_says_what_a_replay_of_the_log_says(fleet: Path) -> None:
    result = sr.evaluate_logs("logs", "gate.spatial", output="results")
    rows = result.table.to_pylist()
    assert [row["log"] for row in rows[::2]] == [f"logs/run-{number}.jsonl" for number in range(4)]
    for row in rows:
        replayed = sr.replay_log(row["log"], "gate.spatial")
        (own,) = (each for each in replayed.results if each.name == row["spec"])
        assert (row["verdict"], row["robustness"]) == (str(own.verdict), own.robustness)
        assert (row["requirement"], row["violated_at_ns"]) == (own.spec.id, own.violated_at_ns)
        if row["verdict"] == "violated":
            assert "\n".join(row["explanation"]) == own.explain()
            # the distance is the same at all times, so what settled the verdict gave the number, too
            assert row["reason"] in row["explanation"][1].replace("What decides is ", "").replace(
                ", which", ""
            )
    assert [row["failure"] for row in result.failures.to_pylist()] == ["violated, expected satisfied"] * 2
    assert sr.read_results("results").equals(result.table)


def test_a_folder_that_cannot_be_read_is_an_error_and_not_a_batch_without_its_logs() -> None:
    # where every user may look
    with TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        write_fleet(folder, DISTANCES[:2])
        (folder / "logs/theirs").mkdir()
        (folder / "logs/run-1.jsonl").rename(folder / "logs/theirs/run-1.jsonl")
        (folder / "out").mkdir()
        (folder / "out").chmod(0o777)

        def outcome(logs: str, results: str) -> tuple[int, str]:
            spec, output = str(folder / "gate.spatial"), str(folder / "out" / results)
            done = batch(str(folder / logs), "--spec", spec, "-o", output, "--json", "-")
            return done.code, done.out

        assert outcome("logs", "all")[0] == 0
        (folder / "logs/theirs").chmod(0)
        for logs, results in (("logs", "most"), ("logs/theirs", "none")):
            with plain_user():
                code, printed = outcome(logs, results)
            assert code == 70
            assert "theirs: Permission denied" in printed
        (folder / "logs/theirs").chmod(0o755)


def test_only_what_is_new_is_evaluated(fleet: Path) -> None:
    Path("other.spatial").write_text("spec near = F (cart dist person <= 0.3)")
    specs = ["gate.spatial", "other.spatial"]
    assert sr.evaluate_logs("logs", specs, output="results").evaluated == 4
    assert sr.evaluate_logs("logs", specs, output="results").evaluated == 0
    # another layout of the text, and other names of the same logs
    Path("gate.spatial").write_text(f"\n\n{GATE}")
    shutil.move("logs", "moved")
    again = sr.evaluate_logs("moved", specs, output="results")
    assert again.evaluated == 0
    assert again.table.column("log")[0].as_py() == "moved/run-0.jsonl"
    assert again.table.column("line")[0].as_py() == 4
    write_log(Path("moved/new.jsonl"), 0.7)
    assert sr.evaluate_logs("moved", specs, output="results").evaluated == 1
    Path("other.spatial").write_text("spec near = F (cart dist person <= 0.15)")
    changed = sr.evaluate_logs("moved", specs, output="results")
    assert changed.evaluated == 5
    assert [row["verdict"] for row in changed.table.to_pylist() if row["spec"] == "near"] == [
        "violated", "violated", "violated", "violated", "satisfied",
    ]  # fmt: skip


def test_what_nothing_tested_passes_nowhere_unless_it_is_allowed(fleet: Path) -> None:
    Path("late.spatial").write_text("spec late = G[60s, 90s] (cart dist person >= 0.3)")
    outputs = ("--junit", "junit.xml", "--html", "pages")
    done = batch("logs/run-0.jsonl", "--spec", "late.spatial", *outputs)
    assert done.code == 4
    failure = "tested by nothing: `G[60s, 90s] (cart dist person >= 0.3)` was never tested"
    assert ("1 result: 1 tested by nothing" in done.out, f"      {failure}" in done.out) == (True, True)
    (own,) = ElementTree.parse("junit.xml").getroot().iter("failure")
    assert (own.get("type"), str(own.get("message")).startswith(failure)) == ("untested", True)
    page = Path("pages/index.html").read_text()
    assert ("number is-untested fails" in page, 'class="number is-satisfied' in page) == (True, False)
    assert batch("logs/run-0.jsonl", "--spec", "late.spatial", "--fail-on", "vacuous").code == 1
    paper = batch(
        "logs/run-0.jsonl", "--spec", "late.spatial", "--semantics", "paper", "--fail-on", "vacuous"
    )
    assert (paper.code, "vacuous: `G[60s, 90s]" in paper.out) == (1, True)
    assert batch("logs/run-0.jsonl", "--spec", "late.spatial", "--allow", "vacuous").code == 0
    Path("suite.yaml").write_text(
        "specs: late.spatial\nallow: vacuous\ncases: [{name: all, logs: logs/run-0.jsonl}]"
    )
    assert batch("suite.yaml").code == 0


def test_a_misspelt_class_of_a_template_passes_nowhere_and_names_the_nearest(fleet: Path) -> None:
    Path("clear.spatial").write_text("spec clear(ego) = G (ego dist cart >= 0)")
    objects = [_box("cart", 0.0), {**_box("anna", 3.0), "class": "pedestrian"}]
    Path("walk.jsonl").write_text(json.dumps({"time_ns": 0, "objects": objects}))
    Path("idle.spatial").write_text("G ((cart dist person <= 0) -> (cart dist person <= 1))")
    misspelt = ("walk.jsonl", "--spec", "clear.spatial", "--each", "ego=class:pedestrain")
    done = batch(*misspelt, "--junit", "junit.xml")
    assert (done.code, "did you mean 'pedestrian'?" in done.out) == (4, True)
    assert "the log never has the class 'pedestrain'; did you mean 'pedestrian'? (in walk.jsonl)" in done.err
    assert ElementTree.parse("junit.xml").getroot().get("failures") == "1"
    Path("people.spatial").write_text(
        'group people = class "pedestrain"\nspec clear = G (forall p in people: p dist cart >= 0)'
    )
    group = batch("walk.jsonl", "--spec", "people.spatial")
    assert "the log never has the class 'pedestrain'; did you mean 'pedestrian'?" in group.err
    assert batch("walk.jsonl", "--spec", "people.spatial", "--strict-names").code == 2
    # each reason once, and one point after it
    idle = batch("logs/run-0.jsonl", "--spec", "idle.spatial", "--junit", "idle.xml", "--html", "pages")
    assert idle.code == 4
    (failure,) = ElementTree.parse("idle.xml").getroot().iter("failure")
    assert (failure.text or "").count("was never tested") == 1
    page = Path("pages/index.html").read_text()
    assert "never held.." not in page


def test_a_cut_window_is_said_and_can_fail(fleet: Path) -> None:
    Path("hold.spatial").write_text("spec hold = F G[0s, 60s] (cart dist person >= 0.3)")
    done = batch("logs/run-0.jsonl", "--spec", "hold.spatial", "--junit", "junit.xml")
    assert (done.code, "1 result decided by a window that the end of the log cut" in done.out) == (0, True)
    (said,) = ElementTree.parse("junit.xml").getroot().iter("system-out")
    tested = ElementTree.parse("junit.xml").find(".//property[@name='tested']")
    assert tested is not None and tested.get("value") == "1 cut"
    assert str(said.text).startswith("tested: cut\n")
    assert "`G[0s, 60s] (cart dist person >= 0.3)` decides at 0.000 s" in str(said.text)
    assert batch("logs/run-0.jsonl", "--spec", "hold.spatial", "--fail-on", "cut").code == 1


def test_a_least_robustness_is_a_floor_whatever_the_verdict_and_an_interval_counts_by_its_lower_end(
    fleet: Path,
) -> None:
    suite = "specs: gate.spatial\ncases: [{name: all, logs: logs/run-3.jsonl, at_least: %s}]"
    for least, code in ((-0.5, 0), (-0.2, 0), (-0.1, 1)):
        Path("suite.yaml").write_text(suite % least)
        assert batch("suite.yaml").code == code
    # between 0.4 and 0.6
    Path("blurred.spatial").write_text("spec apart = G (cart dist person >= 0.1)")
    cart = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1), uncertainty=0.1)
    near = sr.Sample(0, {"cart": cart, "person": sr.Footprint.box(1.6, 0, 2, 1)})
    with sr.Recorder("blurred.mcap") as recorder:
        recorder.write(near)
    text = "specs: blurred.spatial\ncases: [{name: all, logs: blurred.mcap, at_least: %s}]"
    for least, code in ((0.4, 0), (0.55, 1)):
        Path("suite.yaml").write_text(text % least)
        assert batch("suite.yaml").code == code


def test_an_allowance_for_rounding_is_a_key_of_suites(fleet: Path) -> None:
    Path("exact.spatial").write_text("spec apart = G (cart dist person >= 0.5000000001)")
    suite = "specs: exact.spatial\ncases: [{name: all, logs: logs/run-0.jsonl%s}]"
    for key, code in (("", 1), (", tolerance: 1e-9", 0), (", tolerance: 1e-12", 1)):
        Path("suite.yaml").write_text(suite % key)
        said = batch("suite.yaml")
        assert said.code == code
        assert f"1 result: 1 {'violated' if code else 'satisfied'}" in said.out


def test_samples_that_a_recorder_dropped_are_said_and_do_not_pass(fleet: Path) -> None:
    samples = [
        sr.Sample(number, {"cart": sr.Footprint.box(0, 0, 1, 1), "person": sr.Footprint.box(2, 0, 3, 1)})
        for number in range(5)
    ]
    with sr.Recorder("lossy.mcap") as recorder:
        for sample in samples[:2]:
            recorder.write(sample)
        for sample in samples[2:]:
            recorder.miss(sample)
    lossy = ("lossy.mcap", "--spec", "gate.spatial")
    Path("close.spatial").write_text("G (cart dist person <= 0.1)")
    said = "the recorder dropped 3 of 5 samples"
    for run in ("replay", "batch"):
        done = command(run, *lossy)
        assert (done.code, said in done.out) == (4, True)
        assert command(run, *lossy, "--allow", "dropped").code == 0
    # also where another failure comes first
    violated = batch("lossy.mcap", "--spec", "close.spatial")
    assert (violated.code, f"warning: {said} (in lossy.mcap)" in violated.err) == (1, True)
    assert command("report", *lossy, "-o", "lossy.html").code == 0
    assert said in Path("lossy.html").read_text()


def test_the_worst_results_of_several_units_take_turns(fleet: Path) -> None:
    person = sr.Footprint.box(1, 0, 2, 1)
    for number in range(3):
        with sr.Recorder(f"logs/force-{number}.mcap", units={"": "m", "force": "N"}) as recorder:
            cart = sr.Footprint.box(0, 0, 1 - number / 10, 1)
            recorder.write(sr.Sample(0, {"cart": cart, "person": person}, {"force": 20.0 + number}))
    Path("two.spatial").write_text("spec soft = G (force <= 5)\nspec apart = G (cart dist person >= 0.5)")
    done = batch("logs/force-*.mcap", "--spec", "two.spatial")
    worst = [line.split("robustness ")[1] for line in done.out.splitlines() if "violated, robustness" in line]
    assert worst == ["-17 N", "-0.5 m", "-16 N", "-0.4 m", "-15 N", "-0.3 m"]
    totals, _, _ = done.out.partition("failed:")
    assert "  -17 N\n" in totals
    page = overview_page(sr.read_results("results"), "two", {}).decode()
    assert ">soft [N]</button>" in page
    assert ">\N{MINUS SIGN}17 N</td>" in page


def test_an_interrupted_recording_is_said(fleet: Path) -> None:
    with suppress(KeyboardInterrupt), sr.Recorder("stopped.mcap") as recorder:
        recorder.write(sr.Sample(0, {name: sr.Footprint.box(0, 0, 1, 1) for name in ("cart", "person")}))
        raise KeyboardInterrupt
    stopped = ("stopped.mcap", "--spec", "gate.spatial")
    for run in ("replay", "batch", "report", "explain"):
        assert "warning: the recording was interrupted" in command(run, *stopped).err


def test_warnings_of_specifications_are_those_of_replay(fleet: Path) -> None:
    Path("both.spatial").write_text("spec s = G (cart dist person >= 0) && F (cart dist person >= 0)")
    (warning, *_) = command("check", "both.spatial").err.splitlines()
    assert "warning" in warning
    assert warning in batch("logs/run-0.jsonl", "--spec", "both.spatial").err
    assert warning in command("replay", "logs/run-0.jsonl", "--spec", "both.spatial").err


def test_an_absolute_tolerance_has_the_unit_of_the_results(fleet: Path) -> None:
    Path("m.spatial").write_text("spec s = G (cart dist person >= 0)")
    for folder, gap in (("before", 0.5), ("after", 0.4)):
        Path(folder).mkdir()
        with sr.Recorder(f"{folder}/run.mcap", units={"": "m"}) as recorder:
            objects = {"cart": sr.Footprint.box(0, 0, 1, 1), "person": sr.Footprint.box(1 + gap, 0, 3, 1)}
            recorder.write(sr.Sample(0, objects))
    Path("log").symlink_to("before")
    run = ("log/run.mcap", "--spec", "m.spatial", "--baseline", "main")
    missing = batch(*run)
    assert (missing.code, "add --update-baseline once" in missing.err) == (2, True)
    assert batch(*run, "--update-baseline").code == 0
    Path("log").unlink()
    Path("log").symlink_to("after")
    bare = batch(*run, "--tolerance", "5")
    assert (bare.code, "robustness is in m; write 5m, or 5% for a part of it" in bare.err) == (2, True)
    floor = batch(*run, "--tolerance", "5%, at least 0.2")
    assert (floor.code, "robustness is in m; write at least 0.2m" in floor.err) == (2, True)
    both = (("5%, at least 0.2m", 0), ("5%, at least 0.05 m", 1), ("30%, at least 0.05m", 0))
    for tolerance, code in (("0.2m", 0), ("0.05 m", 1), ("30%", 0), ("5%", 1), *both):
        assert batch(*run, "--tolerance", tolerance).code == code
    wrong = batch(*run, "--tolerance", "at least 0.2m")
    assert (wrong.code, "write an amount in units of robustness" in wrong.err) == (2, True)


def test_results_of_an_edited_spec_are_marked_once_for_each_spec_and_counted_apart(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ("logs", "--spec", "gate.spatial", "--baseline", "main")
    batch(*run, "--update-baseline")
    same = batch(*run)
    assert "edited" not in same.out + same.err
    # a stricter spec, and one log that is worse for the spec that was not edited
    Path("gate.spatial").write_text(GATE.replace(">= 0.3", ">= 0.45").replace("REQ-4: ", "REQ-9: "))
    write_log(Path("logs/run-0.jsonl"), 1.2)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    done = batch(*run, "--junit", "junit.xml", "--json", "rows.jsonl", "--html", "pages")
    assert done.code == 1
    totals, _, rest = done.out.partition("4 failed, ")
    assert rest.startswith("1 of them worse than the baseline, or gone, 3 of specs edited since:\n")
    heads, *lines = totals.splitlines()[1:]
    assert heads.split()[5:8] == ["failed", "worse", "edited"]
    assert [line.split()[-4:-1] for line in lines if "REQ" in line] == [["3", "-", "3"], ["1", "1", "-"]]
    assert done.out.count("\n    edited since the baseline\n") == 1
    worse, _, edited = rest.partition(
        "worse, and the spec was edited since the baseline: apart (gate.spatial):"
    )
    assert "  logs/run-0.jsonl: arrives is violated with robustness -0.2; it was satisfied" in worse
    assert [line.split(":")[0].strip() for line in edited.splitlines()[1:4]] == [
        "logs/run-3.jsonl", "logs/run-2.jsonl", "logs/run-1.jsonl"
    ]  # fmt: skip
    rows = [json.loads(line) for line in Path("rows.jsonl").read_text().splitlines()]
    assert {(row["spec"], row["edited_since_baseline"]) for row in rows} == {
        ("apart", True),
        ("arrives", False),
    }
    root = ElementTree.parse("junit.xml").getroot()
    suites = {
        suite.get("name"): [
            each.get("value") for each in suite.iterfind("properties/property[@name='baseline']")
        ]
        for suite in root
    }
    assert suites == {"logs.apart": ["edited since the baseline"], "logs.arrives": []}
    assert "| apart (edited since the baseline) | REQ-3: keep 30 cm" in Path("summary.md").read_text()
    assert "<td>apart (edited since the baseline)</td>" in Path("pages/index.html").read_text()


def test_types_of_failures_in_junit_are_what_was_expected(fleet: Path) -> None:
    Path("suite.yaml").write_text(
        "specs: gate.spatial\ncases:\n"
        "  - {name: floor, logs: logs/run-1.jsonl, at_least: 0.5}\n"
        "  - {name: close, logs: logs/run-0.jsonl, expect: violated}\n"
        "  - {name: apart, logs: logs/run-3.jsonl}\n"
    )
    batch("suite.yaml", "--junit", "junit.xml")
    types = [failure.get("type") for failure in ElementTree.parse("junit.xml").getroot().iter("failure")]
    floor = "expected robustness of at least 0.5"
    assert types == [floor, "expected violated", "expected violated", "expected satisfied"]


def test_formulas_in_the_summary_of_github_are_code(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("gate.spatial").write_text(
        'spec s "<b> | *far*" = G (cart dist person < 0.3 and "a|b" dist cart > 1)'
    )
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    batch("logs", "--spec", "gate.spatial")
    summary = Path("summary.md").read_text()
    assert "`cart dist person < 0.3` fails" in summary
    assert r"| &lt;b> \| \*far\* |" in summary


def test_a_batch_names_the_logs_that_are_damaged_and_those_that_lack_a_name(fleet: Path) -> None:
    Path("logs/run-1.jsonl").write_text("{")
    Path("logs/run-2.jsonl").write_text('{"time_ns": 0, "objects": []}\n')
    done = batch("logs", "--spec", "gate.spatial")
    assert (done.code, "damaged, or not to be read: logs/run-1.jsonl" in done.err) == (3, True)
    assert "(in logs/run-2.jsonl)" in done.err


@pytest.mark.parametrize("output", ["", "--json -"])
def test_a_reader_that_closes_the_output_costs_no_baseline(fleet: Path, output: str) -> None:
    line = f"{sys.executable} -m spatial_replay batch logs --spec gate.spatial --baseline main {output}"
    ended = subprocess.run(
        ["sh", "-c", f"{line} --update-baseline | true"], capture_output=True, text=True, check=False
    )
    assert ended.stderr in ("", "wrote main\n") and Path("main/last_run.parquet").exists()


def test_a_folder_has_logs_of_every_ending_that_the_page_names(fleet: Path) -> None:
    Path("empty").mkdir()
    page = (Path(__file__).parents[2] / "docs/ci.md").read_text()
    (named,) = re.findall(r"files that end in (.*?) are logs", page.replace("\n", " "))
    endings = re.findall(r"`(.*?)`", named)
    refused = batch("empty", "--spec", "gate.spatial")
    assert (refused.code, f"logs end in {', '.join(endings)}" in refused.err) == (2, True)
    for ending in endings:
        Path(f"empty/log{ending}").write_text("{")
    Path("empty/notes.txt").write_text("words")
    done = batch("empty", "--spec", "gate.spatial")
    assert (done.code, done.out.startswith(f"{len(endings)} logs, ")) == (3, True)


def test_annotations_are_of_different_kinds_before_they_repeat_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    write_fleet(tmp_path, [0.1] * 12)
    Path("other.spatial").write_text(
        "spec high = G (cart dist person >= 0.2)\nspec low = G (cart ovlp person)"
    )
    done = batch("logs", "--spec", "gate.spatial", "--spec", "other.spatial")
    lines = [line for line in done.err.splitlines() if line.startswith("::error")]
    assert len(lines) == 10
    assert [sum(f"title={name}" in line for line in lines[:3]) for name in ("apart", "high", "low")] == [
        1
    ] * 3


def _box(name: str, x: float) -> dict[str, object]:
    return {"name": name, "polygon": [[x, 0], [x + 1, 0], [x + 1, 1], [x, 1]]}


def test_file_names_that_are_not_utf_8_are_shown_with_escapes(fleet: Path) -> None:
    folder = Path(os.fsdecode(b"logs/n\xff"))
    log, spec = write_log(folder / os.fsdecode(b"r\xfe.jsonl"), 0.5), Path(os.fsdecode(b"g\xfd.spatial"))
    shutil.copy("gate.spatial", spec)
    outputs = ("--junit", "junit.xml", "--html", "pages", "--json", "rows.jsonl")
    done = batch(str(folder), "--spec", str(spec), *outputs)
    assert done.code == 0, done.err
    rows = sr.read_results("results").to_pylist()
    assert {(row["log"], row["file"]) for row in rows} == {
        (r"logs/n\udcff/r\udcfe.jsonl", r"g\udcfd.spatial")
    }
    assert command("replay", str(log), "--spec", str(spec), "-o", "own.mcap").code == 0
    assert command("verify", "own.mcap", "--source", str(log)).code == 0
    assert command("report", str(log), "--spec", str(spec), "-o", "page.html").code == 0


def test_a_flipped_bit_in_a_folder_of_results_never_changes_a_result(fleet: Path) -> None:
    chance = random.Random(3)
    arguments = ["logs", "--spec", "gate.spatial"]
    batch(*arguments)
    sound = sr.read_results("results").drop(["seconds"])
    files = {name: Path(name).read_bytes() for name in map(str, Path("results").rglob("*.*"))}
    assert len(files) >= 4
    for name, data in [item for item in files.items() for _ in range(10)]:
        for file in Path("results/rows").iterdir():
            file.unlink()
        for other, whole in files.items():
            Path(other).write_bytes(whole)
        place = chance.randrange(8 * len(data))
        damaged = bytearray(data)
        damaged[place // 8] ^= 1 << place % 8
        Path(name).write_bytes(damaged)
        if name.endswith("last_run.parquet"):
            assert "its digest does not fit" in (done := command("results", "results")).err
            assert done.code == 3
        done = batch(*arguments)
        if name.endswith("format.json") and done.code == 2:
            assert "results of " in done.err
            continue
        assert done.code == 1
        assert sr.read_results("results").drop(["seconds"]).equals(sound)
        is_of_rows = name.startswith("results/rows")
        assert ("(0 evaluated now" in done.out) != is_of_rows
        assert (f"{name} cannot be used" in done.err) == (is_of_rows or "identities" in name)


def test_a_log_of_equal_size_and_time_is_evaluated_again(fleet: Path) -> None:
    near, far = write_log(Path("logs/run-2.jsonl"), 0.25), write_log(Path("logs/run-1.jsonl"), 0.75)
    assert near.stat().st_size == far.stat().st_size
    sr.evaluate_logs("logs", "gate.spatial", output="results")
    times = near.stat().st_atime_ns, near.stat().st_mtime_ns
    near.write_bytes(far.read_bytes())
    os.utime(near, ns=times)
    again = sr.evaluate_logs("logs", "gate.spatial", output="results")
    verdicts = [row["verdict"] for row in again.table.to_pylist() if row["spec"] == "apart"]
    assert verdicts == ["satisfied", "satisfied", "satisfied", "violated"]


def test_a_damaged_log_never_passes_as_the_one_that_its_certificate_names(fleet: Path) -> None:
    log = Path("large.mcap")
    # so large that a look at its end would save time
    sr.replay_log("logs/run-0.jsonl", "gate.spatial", output="own.mcap")
    with Path("own.mcap").open("rb") as own, log.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        reader = make_reader(own)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, channel.metadata
                )
            times = message.log_time, message.publish_time
            writer.add_message(channels[channel.id], times[0], message.data, times[1])
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.add_attachment(0, 0, "camera.bin", "application/octet-stream", bytes(17 * 2**20))
        writer.finish()
    assert batch(str(log), "--spec", "gate.spatial").code == 0
    damaged = bytearray(log.read_bytes())
    damaged[1000] ^= 1
    log.write_bytes(damaged)
    done = batch(str(log), "--spec", "gate.spatial")
    assert done.code == 3, done.out


def test_a_log_that_cannot_be_read_is_a_row_until_it_can(fleet: Path) -> None:
    log = Path("logs/run-1.jsonl")
    whole = log.read_text()
    log.write_text("{")
    done = batch("logs", "--spec", "gate.spatial")
    assert done.code == 3
    assert "8 results: 4 satisfied, 2 violated, 2 errors" in done.out
    assert "run-1.jsonl:1: the line is not JSON" in done.out
    rows = sr.read_results("results").to_pylist()
    assert [row["spec"] for row in rows if row["error"]] == ["apart", "arrives"]
    log.write_text(whole)
    done = batch("logs", "--spec", "gate.spatial")
    assert done.code == 1
    assert "(1 evaluated now, 3 known)" in done.out


def test_a_damaged_log_fails_whatever_its_verdict_and_every_output_marks_it(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for log in (Path("logs/run-0.jsonl"), Path("logs/run-3.jsonl")):
        log.write_text(log.read_text() + '{"time_ns": 9')
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    done = batch("logs", "--spec", "gate.spatial", "--html", "pages")
    assert done.code == 3
    assert "the log is damaged: run-0.jsonl:5" in done.out
    assert "8 results: 6 satisfied (3 failed), 2 violated, 4 of damaged logs" in done.out
    assert "run-0.jsonl: apart: satisfied (damaged log), robustness 0.2" in done.out
    assert "run-3.jsonl: apart: violated (damaged log), robustness -0.2" in done.out
    assert "violated, expected satisfied; the log is damaged: run-3.jsonl:5" in done.out
    for page in ("summary.md", "pages/index.html"):
        assert "(damaged log)" in Path(page).read_text()


def test_logs_that_hold_the_same_share_rows_but_errors_name_each_of_them(fleet: Path) -> None:
    for name, text in (("broken", "{"), ("damaged", Path("logs/run-0.jsonl").read_text() + "{")):
        for copy in ("a", "b-a"):
            Path(f"logs/{copy}.{name}.jsonl").write_text(text)
    # the second run takes what it can from the first, in which files had other names
    for _ in range(2):
        table = sr.evaluate_logs("logs", "gate.spatial", output="results").table
        rows = [row for row in table.to_pylist() if row["error"] or row["faults"]]
        assert len(rows) == 8
        for row in rows:
            name = Path(row["log"]).name
            said = row["error"] or row["faults"][0]
            assert said.startswith(name) and said.replace(name, "").count(".jsonl") == 0
            assert name in row["failure"]
        for copy in Path("logs").glob("*-a.*"):
            copy.replace(f"logs/another.{copy.name}")


def test_the_reason_is_about_the_number_beside_it(fleet: Path) -> None:
    lines = [
        Path(f"logs/run-{number}.jsonl").read_text().splitlines()[step]
        for step, number in enumerate((0, 2, 3, 1))
    ]
    Path("later.jsonl").write_text("\n".join(lines))
    Path("later.spatial").write_text(
        "spec apart = G (cart dist person >= 0.3)\nspec near = F (cart dist person <= 0.3)"
    )
    assert batch("later.jsonl", "--spec", "later.spatial", "-o", "results").code == 1
    apart, near = map(json.loads, command("results", "results", "--json", "-").out.splitlines())
    assert apart["reason"] == (
        "`cart dist person >= 0.3` fails by 0.2 at 0.200 s (its least within `apart`): "
        "cart and person are 0.1 apart. It was violated first at 0.100 s, by 0.1."
    )
    assert near["reason"].startswith("`cart dist person <= 0.3` holds by 0.2 at 0.200 s")


def test_results_that_pass_are_explained_when_they_are_asked_for(fleet: Path) -> None:
    first = batch("logs", "--spec", "gate.spatial", "-o", "results", "--json", "-")
    rows = [json.loads(line) for line in first.out.splitlines()]
    columns = ("atom", "atom_time_ns", "atom_objects", "reason", "explanation")
    for row in rows:
        is_explained = row["verdict"] == "violated"
        assert [row[name] is not None for name in columns] == [is_explained] * len(columns)
    asked = [json.loads(line) for line in command("results", "results", "--json", "-").out.splitlines()]
    for row, full in zip(rows, asked, strict=True):
        assert {**row, **{name: full[name] for name in columns}} == full
        result = sr.replay_log(full["log"], "gate.spatial").results[full["spec"] == "arrives"]
        assert "\n".join(full["explanation"]) == result.explain()
    # a second run evaluates nothing, and knows what was explained
    shutil.move("logs/run-3.jsonl", "run-3.jsonl")
    Path("logs/run-3.jsonl").write_bytes(Path("run-3.jsonl").read_bytes())
    again = batch("logs", "--spec", "gate.spatial", "-o", "results", "--json", "-")
    assert again.out == first.out


def test_a_log_that_is_gone_or_another_one_is_not_explained(fleet: Path) -> None:
    batch("logs", "--spec", "gate.spatial", "-o", "results")
    Path("logs/run-0.jsonl").unlink()
    write_log(Path("logs/run-1.jsonl"), 0.7)
    passing = ("results", "results", "--where", 'spec == "arrives"', "--json", "-")
    reply = command(*passing)
    reasons = [json.loads(line)["reason"] for line in reply.out.splitlines()]
    assert [reason is None for reason in reasons] == [True, True, False, False]
    assert "logs/run-0.jsonl is not explained: the log cannot be read any more" in reply.err
    assert "logs/run-1.jsonl is not explained: the log, the mapping or the version has changed" in reply.err
    assert reply.code == 0
    # elsewhere, with the folder alone
    shutil.copytree("results", "elsewhere/results")
    shutil.rmtree("logs")
    listed = command("results", "elsewhere/results", "--worst", "1")
    assert "`cart dist person >= 0.3` fails by 0.2" in listed.out
    assert "Traceback" not in command(*passing).err


def test_the_conditions_of_a_suite_are_those_of_its_explanations(fleet: Path) -> None:
    Path("limits.spatial").write_text("const near = 0.3\nspec apart = G (cart dist person >= near)")
    Path("suites").mkdir()
    Path("suites/night.yaml").write_text(
        "cases:\n  - name: wide\n    logs: ../logs/*.jsonl\n    specs: [../limits.spatial]\n"
        "    constants: {near: 0.15}\n    from: 0.1s\n    every: 2\n"
    )
    assert batch("suites/night.yaml", "-o", "results").code == 1
    rows = command("results", "results", "--json", "-").out.splitlines()
    assert [json.loads(row)["reason"].split(" by ")[0] for row in rows] == [
        *["`cart dist person >= 0.15` holds"] * 3,
        "`cart dist person >= 0.15` fails",
    ]


def test_a_suite_requires_what_info_prints_and_refuses_unfit_logs(fleet: Path) -> None:
    with sr.Recorder("run.mcap") as recorder:
        for step in (*range(10), *range(30, 40)):
            cart = {} if step % 2 else {"cart": sr.Footprint.box(0, 0, 1, 1)}
            person = sr.Footprint.box(3, 0, 4, 1)
            recorder.write(sr.Sample(step * 10**8, {"person": person, **cart}))
    fit = command("info", "run.mcap", "--fit").out
    assert "samples: {rate: 4.87, max_gap: 2.1s}" in fit
    assert '"cart": 0.5\n' in fit
    Path("gate.spatial").write_text("spec apart = G (person dist person <= 0.3)")
    suite = "specs: gate.spatial\ncases: [{name: all, logs: run.mcap}]\n"
    Path("suite.yaml").write_text(suite + fit)
    assert batch("suite.yaml").code == 0
    for wanted, lacking in (
        ("{samples: {rate: 5}}", "samples have 4.87 a second, at least 5 are required"),
        ("{samples: {max_gap: 2s}}", "samples pause for 2.1 s, at most 2s is allowed"),
        ("{topics: {/tf: {}}}", "there is no message of /tf"),
        (
            "{objects: {cart: 0.6, ghost: 0.1}}",
            "cart is known in 0.5 of the samples, at least 0.6 are required",
        ),
    ):
        Path("suite.yaml").write_text(f"{suite}requires: {wanted}")
        done = batch("suite.yaml", "--junit", "junit.xml")
        assert done.code == 3
        (error,) = ElementTree.parse("junit.xml").getroot().iter("error")
        assert error.get("type") == "unfit"
        assert lacking in str(error.get("message"))
    for number in ("requires: {samples: {rate: .nan}}", "at_least: .nan", "tolerance: .inf"):
        Path("suite.yaml").write_text(f"{suite}{number}")
        refused = batch("suite.yaml")
        assert (refused.code, "is no finite number; give one" in refused.err) == (2, True)
    Path("suite.yaml").write_text(f"{suite}requires: {{topics: {{/tf: {{rates: 5}}}}}}")
    assert "did you mean 'rate'?" in batch("suite.yaml").err


def test_too_few_logs_of_a_case_are_an_error_of_the_suite(fleet: Path) -> None:
    suite = "specs: gate.spatial\nat_least_logs: 2\ncases:\n  - {name: near, logs: 'logs/run-[01].jsonl'"
    Path("suite.yaml").write_text(f"{suite}}}\n")
    assert batch("suite.yaml").code == 0
    Path("logs/run-0.jsonl").unlink()
    done = batch("suite.yaml")
    message = "suite.yaml:2: case 'near': 1 log, and at_least_logs is 2; check the patterns"
    assert (done.code, message in done.err) == (2, True), done.err
    Path("suite.yaml").write_text(f"{suite}, at_least_logs: 1}}\n")
    assert batch("suite.yaml").code == 0


def test_runs_of_one_log_that_pass_and_fail_are_flaky(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(4):
        Path(f"logs/run-{number}.jsonl").rename(f"logs/cross#{number}.jsonl")
        write_log(Path(f"logs/far#{number}/log.jsonl"), 0.5)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    done = batch("logs", "--spec", "gate.spatial", "--junit", "junit.xml", "--html", "pages")
    flaky = "logs/cross.jsonl: apart is flaky: 2 of 4 runs failed"
    assert (done.code, done.out.count("flaky"), f"  {flaky}\n" in done.out) == (1, 1, True)
    suites = ElementTree.parse("junit.xml").getroot()
    assert [each.get("value") for each in suites.iterfind("*/properties/property[@name='flaky']")] == [flaky]
    assert f"- {flaky}\n" in Path("summary.md").read_text()
    assert f"<li>{flaky}</li>" in Path("pages/index.html").read_text()


def test_a_suite_says_what_passes(fleet: Path) -> None:
    Path("suite.yaml").write_text(
        "specs: gate.spatial\n"
        "cases:\n"
        "  - {name: good, logs: 'logs/run-[01].jsonl', at_least: 0.05, requirements: SYS-1}\n"
        "  - {name: bad, logs: [logs/run-2.jsonl, logs/run-3.jsonl], specs: bad.spatial, expect: violated}\n"
        "  - {name: unseen, logs: logs/run-0.jsonl, specs: ghost.spatial, expect: unknown}\n"
        "  - {name: blind, logs: logs, specs: ghost.spatial, allow_unknown: true}\n"
    )
    Path("bad.spatial").write_text("spec apart = G (cart dist person >= 0.3)")
    Path("ghost.spatial").write_text("spec seen = F (ghost dist cart <= 1)")
    done = batch("suite.yaml")
    assert (done.code, done.err.count("warning")) == (0, 1), done.out
    assert "ghost" in done.err
    assert Path("suite.results/last_run.parquet").exists()
    assert batch("suite.yaml", "--fail-on", "unknown").code == 1
    text = Path("suite.yaml").read_text()
    Path("suite.yaml").write_text(text.replace("0.05", "0.15"))
    done = batch("suite.yaml")
    assert done.code == 1
    assert "robustness 0.1, expected at least 0.15" in done.out
    assert "satisfied (1 failed), 2 violated as expected, 5 unknown as expected" in done.out
    Path("suite.yaml").write_text(text.replace(", allow_unknown: true", ""))
    assert batch("suite.yaml").code == 4
    Path("suite.yaml").write_text(text.replace("specs: bad.spatial, expect: violated", "expect: unknown"))
    done = batch("suite.yaml")
    assert (done.code, "violated, expected unknown" in done.out) == (1, True), done.out
    table = sr.read_results("suite.results")
    assert {row["requirement"] for row in table.to_pylist() if row["case"] == "good"} == {"REQ-3", "REQ-4"}


def test_templates_windows_and_constants_apply_to_every_log(fleet: Path) -> None:
    Path("each.spatial").write_text("const near = 0.3\nspec calm(who) = G (who dist cart >= near)")
    log = Path("logs/run-0.jsonl")
    log.write_text(log.read_text().replace('"name": "person"', '"name": "person", "class": "human"'))
    arguments = ("logs/run-0.jsonl", "--spec", "each.spatial", "--each", "who=class:human")
    done = batch(*arguments, "--const", "near=0.6", "--from", "0.1s", "--json", "-")
    assert done.code == 1
    row = json.loads(done.out)
    assert (row["spec"], row["object"], row["samples"]) == ("calm", "person", 3)
    assert row["robustness"] == pytest.approx(-0.1)
    assert batch(*arguments).code == 0
    assert batch("logs/run-0.jsonl", "--spec", "each.spatial").code == 2


def test_all_errors_of_a_suite_are_reported_at_once_with_their_lines(fleet: Path) -> None:
    Path("suite.yaml").write_text(
        "cases:\n"
        "  - name: one\n"
        "    logs: []\n"
        "    specs: nowhere.spatial\n"
        "  - name: one\n"
        "    logs: logs\n"
        "    semantics: mtl\n"
        "    from: soon\n"
        "    every: 0\n"
        "  - logs: logs\n"
        "    specs: gate.spatial\n"
        "    expect: violated\n"
        "    at_least: 1\n"
        "    mapping: none.yaml\n"
        "    colour: red\n"
        "  - name: three\n"
        "    logs: [logs, nightly/*.mcap]\n"
        "    specs: [each.spatial, broken.spatial]\n"
        "    mapping: wrong.yaml\n"
        "  - name: four\n"
        "    logs: gone.mcap\n"
        "    specs: each.spatial\n"
        "    constants: {near: 1}\n"
        "  - {name: five, logs: logs, specs: each.spatial, each: {where: all}}\n"
    )
    Path("each.spatial").write_text("spec calm(who) = G (who dist cart >= 1)")
    Path("broken.spatial").write_text("spec a = G (cart dist")
    Path("wrong.yaml").write_text("topics: 3")
    done = batch("suite.yaml")
    assert done.code == 2
    for line, what in [
        (3, "expected a log, a folder"),
        (4, "no file 'nowhere.spatial'"),
        (5, "there is a case 'one' already"),
        (5, "it has no specs"),
        (7, "expected ltlf or paper"),
        (8, "'soon' is not a time"),
        (9, "expected a whole number of at least 1"),
        (10, "the key 'name' is missing"),
        (13, "at_least is a least robustness, and violated results"),
        (14, "no file 'none.yaml'"),
        (15, "unknown key"),
        (17, "nightly/*.mcap: no log matches"),
        (21, "gone.mcap: no such file"),
        (23, "there is no constant 'near'"),
        (24, "no template has a parameter 'where'"),
        (24, "calm is a template"),
    ]:
        assert any(f"suite.yaml:{line}: " in each and what in each for each in done.err.split("\n")), what
    assert "wrong.yaml:1: topics: expected" in done.err
    assert "broken.spatial:1:12: error: '(' is never closed; add a ')'" in done.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nightly/*.mcap", "missing.mcap", "--spec", "gate.spatial"], "no log matches this pattern"),
        (["empty", "--spec", "gate.spatial"], "no log in this folder"),
        (["logs"], "give a specification with --spec FILE"),
        (["logs", "--spec", "G (cart dist person >= 0)"], "is a formula, and results name files"),
        (["logs", "--spec", "gate.spatial", "-o", "gate.spatial"], "is a file; give a folder for results"),
        (["logs", "--spec", "gate.spatial", "-o", "https://h/results"], "give a folder of a bucket"),
        (["logs", "--spec", "gate.spatial", "-o", "logs"], "does not hold the results of a batch"),
        (["logs", "--spec", "gate.spatial", "-o", "old"], "results of format 0"),
        (["logs", "--spec", "gate.spatial", "--tolerance", "5%"], "add --baseline"),
        (["logs", "--spec", "gate.spatial", "--baseline", "gone"], "no such folder"),
        (["logs", "--spec", "gate.spatial", "--junit", "gate.spatial"], "is an input too"),
        (["logs", "--spec", "gate.spatial", "--from", "soon"], "--from: 'soon' is not a time"),
        (["s.yaml", "logs"], "is a suite, which names its logs"),
        (["s.yaml", "--spec", "gate.spatial"], "says how its logs are evaluated"),
        (["logs", "--spec", "broken.spatial"], "broken.spatial:1:"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused_with_the_remedy(fleet: Path, arguments: list[str], message: str) -> None:
    Path("empty").mkdir()
    Path("old").mkdir()
    Path("old/format.json").write_text('{"spatial_replay_results": 0}')
    Path("broken.spatial").write_text("spec a = G (cart dist")
    done = batch(*arguments)
    assert (done.code, message in done.err) == (2, True), done.err
    assert not Path("results").exists()
    if "missing.mcap" in arguments:
        assert "missing.mcap: no such file" in done.err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("lgos: logs", "unknown key; did you mean 'logs'?"),
        ("logs: [logs/run-[0-3].jsonl]", "put patterns in quotes"),
        ("logs: *.jsonl", "put patterns in quotes"),
        ("each: ego=class:cart", "as in {ego: class:NAME}"),
    ],
)
def test_a_slip_in_a_suite_gets_its_remedy(fleet: Path, line: str, said: str) -> None:
    Path("suite.yaml").write_text(f"cases:\n  - name: one\n    specs: gate.spatial\n    {line}\n")
    done = batch("suite.yaml")
    assert (done.code, "suite.yaml:4: " in done.err, said in done.err) == (2, True, True), done.err


def test_two_batches_do_not_write_to_one_folder(fleet: Path) -> None:
    import fcntl

    assert batch("logs", "--spec", "gate.spatial").code == 1
    with Path("results/format.json").open() as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        done = batch("logs", "--spec", "gate.spatial")
    assert done.code == 2
    assert "another command is writing to results" in done.err


def test_what_is_worse_than_a_baseline_or_gone_fails_in_every_output(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ["logs", "--spec", "gate.spatial"]
    assert batch(*first, "--baseline", "main", "--update-baseline").code == 1
    assert "nothing is worse than the baseline" in batch(*first, "--baseline", "main").out
    # 0.2 of robustness becomes 0.19, 0.1 becomes -0.05; one is gone, one is better
    write_log(Path("logs/run-0.jsonl"), 0.49)
    write_log(Path("logs/run-1.jsonl"), 0.25)
    write_log(Path("logs/run-2.jsonl"), 0.6)
    Path("logs/run-3.jsonl").unlink()
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    outputs = ["--junit", "junit.xml", "--json", "rows.jsonl", "--html", "pages"]
    done = batch(*first, "--baseline", "main", "--tolerance", "6%", *outputs)
    assert done.code == 1
    shown, _, listed = done.out.partition("\nworse than the baseline, or gone")
    assert [line.split(":")[0].strip() for line in listed.splitlines()[1:]] == [
        "logs/run-1.jsonl", "logs/run-3.jsonl", "logs/run-3.jsonl", "logs/run-2.jsonl",
    ]  # fmt: skip
    root = ElementTree.parse("junit.xml").getroot()
    assert (root.get("tests"), root.get("failures")) == ("8", "4")
    # the terminal has the totals of the other outputs
    totals = "8 results: 5 satisfied (1 failed), 1 violated, 2 gone"
    assert shown.startswith(f"4 logs, {totals} (all evaluated now, 1 gone)\n"), shown
    assert "\n4 failed, 4 of them worse than the baseline, or gone:\n" in shown
    heads, apart, _, arrives, *_ = (line.split() for line in shown.splitlines()[1:])
    assert heads[5:7] == ["failed", "worse"]
    assert (apart[-3:-1], arrives[-3:-1]) == (["2", "2"], ["2", "2"])
    for other in ("summary.md", "pages/index.html"):
        assert totals in Path(other).read_text()
    rows = [json.loads(line) for line in Path("rows.jsonl").read_text().splitlines()]
    summary, page = Path("summary.md").read_text(), Path("pages/index.html").read_text()
    for log, spec, said, was in (
        ("run-1", "apart", "violated with robustness -0.05; it was satisfied with robustness 0.1", 0.1),
        ("run-2", "arrives", "satisfied with robustness 0.4; it was satisfied with robustness 0.8", 0.8),
        ("run-3", "arrives", "gone; it was satisfied with robustness 0.9", 0.9),
    ):
        name = f"logs/{log}.jsonl"
        cases = root.iterfind(f"testsuite[@name='logs.{spec}']/testcase[@name='{name}']/failure")
        assert [said in str(each.get("message")) for each in cases] == [True]
        (row,) = (row for row in rows if (row["log"], row["spec"]) == (name, spec))
        assert row["worse_than_baseline"] and said in row["failure"]
        assert row["baseline_robustness"] == pytest.approx(was)
        assert any(
            line.startswith("::error") and name in line and said in line for line in done.err.split("\n")
        )
        on_page = said.replace("-", "\N{MINUS SIGN}")
        assert any(name in line and on_page in line for line in summary.split("\n"))
        assert on_page in page
    assert "gone (was 0.9)" in page
    # what the run itself found is kept without the comparison
    assert len(sr.read_results("results")) == 6
    assert "run-0" not in done.out.partition("worse than the baseline")[2]
    assert (
        "logs/run-1.jsonl: apart is violated with robustness -0.05; "
        "it was satisfied with robustness 0.1 in the baseline" in done.out
    )
    assert "logs/run-3.jsonl: arrives is gone; it was satisfied" in done.out
    assert "better: --update-baseline" in done.out
    done = batch(*first, "--baseline", "main", "--tolerance", "1%")
    assert "logs/run-0.jsonl: apart is satisfied with robustness 0.19; it was" in done.out
    assert batch(*first, "--baseline", "main", "--update-baseline").code == 1
    assert "nothing is worse" in batch(*first, "--baseline", "main").out


def test_results_are_summed_up_and_searched(fleet: Path) -> None:
    batch("logs", "--spec", "gate.spatial")
    done = command("results", "results", "--worst", "1")
    assert done.out.startswith("8 results: 6 satisfied, 2 violated\n")
    assert "logs/run-3.jsonl: apart: violated, robustness -0.2\n" in done.out
    assert "cart and person are 0.1 apart" in done.out
    chosen = command("results", "results", "--by", "log", "--where", "spec == apart and robustness < -0.15")
    assert chosen.out.startswith("1 result: 1 violated\n  log ")
    both = '("run-0" in log or not robustness > 0) and object == none'
    assert command("results", "results", "--where", both).out.startswith("4 results")
    for wrong, message in [
        ("colour == red", "there is no column 'colour'"),
        ("__import__('os').system('true')", "is not a condition"),
        ("robustness < 'a'", "compares different kinds"),
        ("verdict ==", "is not a condition"),
        ("failure = unknown", "--where compares with ==; write 'failure == unknown'"),
        ("spec = apart and robustness <= 0", "write 'spec == apart and robustness <= 0'"),
    ]:
        done = command("results", "results", "--where", wrong)
        assert (done.code, message in done.err) == (2, True), done.err
    for empty, hint in [
        (
            "failure == violated",
            """no failure is 'violated'; write '"violated" in failure' for a part of it""",
        ),
        ("verdict == voilated", "no verdict is 'voilated'; did you mean 'violated'?"),
        ("spec == qq", "no spec is 'qq'; there are apart, arrives"),
    ]:
        done = command("results", "results", "--where", empty)
        assert (done.code, hint in done.err) == (0, True), done.err
    assert "warning" not in command("results", "results", "--where", "spec == apart and robustness > 9").err
    assert command("results", "logs").code == 2


def test_unknown_numbers_are_null_and_times_stay_integers_in_pandas(fleet: Path) -> None:
    Path("logs/empty.jsonl").write_text('{"time_ns": 0, "objects": []}\n')
    Path("logs/broken.jsonl").write_text("{")
    batch("logs", "--spec", "gate.spatial", "--baseline", "main", "--update-baseline")
    # the second run reads the rows that the first one stored
    batch("logs", "--spec", "gate.spatial")
    for file in (Path("results/last_run.parquet"), *Path("results/rows").iterdir()):
        table = parquet.read_table(file)
        for name in ("robustness", "lower", "upper"):
            assert not pc.any(pc.is_nan(table[name])).as_py()
        frame = pandas.read_parquet(file)
        names = ["first_satisfied_ns", "violated_at_ns", "satisfied_at_ns", "atom_time_ns", "start_ns"]
        assert {str(frame[name].dtype) for name in [*names, "duration_ns", "samples"]} == {"Int64"}
    assert (frame.violated_at_ns == 0).sum() == 2 and frame.violated_at_ns.isna().any()
    unknown = command("results", "results", "--where", "robustness == none", "--json", "-").out.splitlines()
    rows = [json.loads(line) for line in unknown]
    assert [(row["log"], row["verdict"]) for row in rows] == [
        ("logs/broken.jsonl", None), ("logs/broken.jsonl", None),
        ("logs/empty.jsonl", "unknown"), ("logs/empty.jsonl", "unknown"),
    ]  # fmt: skip


def test_a_page_over_all_logs_links_to_those_that_fail(fleet: Path) -> None:
    Path("logs/<b>&.jsonl").write_text(Path("logs/run-3.jsonl").read_text())
    assert batch("logs", "--spec", "gate.spatial", "--html", "pages", "--junit", "junit.xml").code == 1
    page = Path("pages/index.html").read_text()
    reports = sorted(path.name for path in Path("pages/reports").iterdir())
    assert len(reports) == 3
    assert all(f'href="reports/{name}"' in page for name in reports)
    assert "<b>&.jsonl" not in page
    assert "&lt;b&gt;&amp;.jsonl" in page
    assert f"[[ATTACHMENT|pages/reports/{reports[-1]}]]" in Path("junit.xml").read_text()
    before = {path: path.stat().st_mtime_ns for path in Path("pages/reports").iterdir()}
    batch("logs", "--spec", "gate.spatial", "--html", "pages")
    assert {path: path.stat().st_mtime_ns for path in Path("pages/reports").iterdir()} == before
    assert Path("pages/index.html").read_text() == page


def test_github_gets_annotations_at_the_lines_of_specs_and_a_summary(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    done = batch("logs", "--spec", "gate.spatial")
    lines = [line for line in done.err.splitlines() if line.startswith("::")]
    assert len(lines) == 2
    assert lines[0].startswith(
        "::error file=gate.spatial,line=2,title=apart (REQ-3%3A keep 30 cm from people)::"
        "logs/run-3.jsonl: violated"
    )
    summary = Path("summary.md").read_text()
    assert (
        "| logs | apart | REQ-3: keep 30 cm from people | 2 | 2 | 0 | 0 | 2 | \N{MINUS SIGN}0.2 |" in summary
    )
    assert "| logs/run-3.jsonl | apart | REQ-3: keep 30 cm from people | violated |" in summary


def test_the_terminal_the_page_and_junit_say_which_requirement_fails(fleet: Path) -> None:
    done = batch("logs", "--spec", "gate.spatial", "--html", "pages", "--junit", "junit.xml")
    about = "REQ-3: keep 30 cm from people"
    for shown in (done.out, command("results", "results").out):
        totals, _, worst = shown.partition("logs/run-3.jsonl: apart: violated, robustness -0.2\n")
        assert worst.startswith(f"      {about}\n      `cart dist person >= 0.3` fails")
        lines = totals.splitlines()
        (place,) = (number for number, line in enumerate(lines) if line.startswith("  apart [REQ-3] "))
        assert lines[place + 1] == "    keep 30 cm from people"
    _, _, page = Path("pages/index.html").read_text().partition("</style>")
    _, _, worst = page.partition("The worst")
    assert worst.count(f">{about}<") == 2 and worst.count(f'title="{about}"') == 2
    texts = [each.text or "" for each in ElementTree.parse("junit.xml").iterfind(".//failure")]
    assert [text.startswith(f"{about}\n`apart` is violated") for text in texts] == [True] * 2


def test_titles_name_the_constants_that_were_overridden(fleet: Path) -> None:
    Path("gate.spatial").write_text(f"const near = 0.3\nconst late = 2s\n{GATE.replace('>= 0.3', '>= near')}")
    given = ("--spec", "gate.spatial", "--const", "near=0.15", "--const", "late=2s")
    title = "REQ-3: keep 30 cm from people (near = 0.15 instead of 0.3)"
    done = batch("logs", *given, "--junit", "junit.xml", "--html", "pages")
    assert done.out.count(f"      {title}\n") == 1
    assert "    get to the person\n" in done.out
    root = ElementTree.parse("junit.xml").getroot()
    titles = [each.get("value") for each in root.iterfind("*/properties/property[@name='title']")]
    assert titles == [title.removeprefix("REQ-3: "), "get to the person"]
    assert title in Path("pages/index.html").read_text()
    replayed = command("replay", "logs/run-3.jsonl", *given, "-o", "annotated.mcap")
    assert title.removeprefix("REQ-3: ") in replayed.out
    recorded = command("info", "annotated.mcap", "--specification").out
    assert f'# at least as far apart as in the standard\nspec apart   "{title}" = G' in recorded
    assert command("verify", "annotated.mcap", "--source", "logs/run-3.jsonl").code == 0


def test_annotations_name_files_from_the_top_of_the_repository(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.delenv("GITHUB_WORKSPACE", raising=False)
    Path("broken.spatial").write_text("spec a = G (cart dist")
    Path("suite.yaml").write_text("cases: [{name: one, logs: logs, specs: gate.spatial}]")

    def names() -> set[str]:
        done = [command("check", "broken.spatial", "--format", "github").out, batch("suite.yaml").err]
        lines = "".join(done).splitlines()
        found = {line.split(",")[0].removeprefix("::error file=") for line in lines if line.startswith("::")}
        sarif = json.loads(command("check", "broken.spatial", "--format", "sarif").out)
        place = sarif["runs"][0]["results"][0]["locations"][0]["physicalLocation"]
        return found | {place["artifactLocation"]["uri"]}

    assert names() == {"broken.spatial", "gate.spatial"}
    Path("gates").mkdir()
    for name in ("broken.spatial", "gate.spatial", "suite.yaml", "logs"):
        shutil.move(name, "gates")
    Path(".git").mkdir()
    monkeypatch.chdir("gates")
    assert names() == {"gates/broken.spatial", "gates/gate.spatial"}
    monkeypatch.setenv("GITHUB_WORKSPACE", str(fleet.parent))
    below = f"{fleet.name}/gates"
    assert names() == {f"{below}/broken.spatial", f"{below}/gate.spatial"}


def test_logs_at_addresses_are_evaluated_once_for_each_version(fleet: Path) -> None:
    pytest.importorskip("obstore")
    from logs.web_server import serving

    recording = Path(__file__).parents[2] / "recordings/table.jsonl"
    Path("few.jsonl").write_text("".join(recording.read_text().splitlines(keepends=True)[:5]))
    Path("few.spatial").write_text("spec near = G (cup dist plate <= 5)")
    sr.replay_log("few.jsonl", "few.spatial", output="few.mcap")
    with serving({"few.mcap": Path("few.mcap").read_bytes()}) as server:
        arguments = [server.url("few.mcap"), "--spec", "few.spatial"]
        done = batch(*arguments)
        assert (done.code, "1 result: 1 satisfied" in done.out) == (0, True), done.err
        assert "1 known" in batch(*arguments).out
        done = batch(*arguments, server.url("gone.mcap"))
    assert done.code == 2
    assert "2 results: 1 satisfied, 1 error" in done.out
    assert "there is no such file" in done.out


def test_another_log_of_equal_size_and_date_at_an_address_is_evaluated_again(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("obstore")
    from logs.web_server import serving

    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(fleet / "cache"))
    near, far = (write_log(Path(f"{distance}.jsonl"), distance).read_bytes() for distance in (0.25, 0.75))
    assert len(near) == len(far)
    with serving({"run.jsonl": far}) as server:
        server.dated = "Sat, 01 Jan 2000 00:00:00 GMT"
        asked = ("batch", server.url("run.jsonl"), "--spec", "gate.spatial", "--jobs", "1")
        assert command(*asked).code == 0
        assert "1 known" in command(*asked).out
        server.files["run.jsonl"] = near
        done = command(*asked)
        assert (done.code, "2 results: 1 satisfied, 1 violated" in done.out) == (1, True), done
        assert command("replay", server.url("run.jsonl"), "--spec", "gate.spatial").code == 1


def test_every_key_of_suites_is_documented_and_the_published_schema_is_that_of_the_package() -> None:
    root = Path(__file__).parents[2]
    schema = json.loads((root / "schemas/suite.schema.json").read_text())
    page = (root / "docs/ci.md").read_text()
    case = schema["properties"]["cases"]["items"]["properties"]
    assert [key for key in [*schema["properties"], *case] if f"`{key}`" not in page] == []
    packaged = (files("spatial_replay.batch") / "suite.schema.json").read_text()
    assert json.loads(packaged) == schema


def test_results_in_a_bucket_are_kept_gone_on_with_searched_and_compared(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = ["logs", "--spec", "gate.spatial"]
    with s3_server("fleet", monkeypatch) as server:
        assert (done := batch(*gate, "-o", "s3://fleet/nightly/")).code == 1, done.err
        assert "wrote s3://fleet/nightly" in done.out
        here = sr.evaluate_logs("logs", "gate.spatial", output="results").table
        there = sr.read_results("s3://fleet/nightly")
        assert there.drop(["seconds"]).equals(here.drop(["seconds"]))
        kinds = {name.partition("/")[0] for name in _names(server)}
        assert kinds == {"format.json", "last_run.parquet", "rows"}

        write_log(Path("logs/run-4.jsonl"), 0.05)
        assert sr.evaluate_logs("logs", "gate.spatial", output="s3://fleet/nightly", jobs=2).evaluated == 1
        assert sr.evaluate_logs("logs", "gate.spatial", output="s3://fleet/nightly").evaluated == 0
        assert command("results", "s3://fleet/nightly").out.startswith("10 results: 7 satisfied, 3 violated")
        for wrong, message in (("fleet/none", "no such folder"), ("none/none", "no such bucket")):
            assert (done := command("results", f"s3://{wrong}")).code == 2
            assert f"s3://{wrong}: " in done.err and message in done.err

        compared = ["-o", "s3://fleet/nightly", "--baseline", "s3://fleet/main"]
        assert "wrote s3://fleet/main\n" in batch(*gate, *compared, "--update-baseline").out
        write_log(Path("logs/run-0.jsonl"), 0.35)
        assert "run-0.jsonl: apart is satisfied with robustness 0.05; it was" in batch(*gate, *compared).out

        # rows cannot be written: nothing of them is there, and no table of a run
        deny = {
            "Effect": "Deny",
            "Principal": "*",
            "Action": "s3:PutObject",
            "Resource": "arn:aws:s3:::fleet/day/rows/*",
        }
        policy = json.dumps({"Version": "2012-10-17", "Statement": [deny]}).encode()
        as_json = {"Content-Type": "application/json"}
        urlopen(Request(f"{server}/fleet?policy", policy, as_json, method="PUT")).close()
        done = batch(*gate, "-o", "s3://fleet/day")
        assert done.code == 70
        assert "s3://fleet/day/rows/" in done.err and "access denied; set AWS_ACCESS_KEY_ID" in done.err
        assert _names(server, "day") == ["format.json"]
        urlopen(Request(f"{server}/fleet?policy", method="DELETE")).close()
        assert batch(*gate, "-o", "s3://fleet/day").code == 1


def _names(server: str, folder: str = "nightly") -> list[str]:
    """Return what the server itself lists in a folder of results."""
    with urlopen(f"{server}/fleet?list-type=2&prefix={folder}/") as answer:
        keys = ElementTree.fromstring(answer.read()).iterfind(".//{*}Key")
    return sorted(str(key.text).removeprefix(f"{folder}/") for key in keys)


def _doubtful_log(path: Path, *, is_accepted: bool = False) -> Path:
    """Record a run whose person may have been read wrongly."""
    doubt = Doubt(
        "jumps", "/tracks", Sentence("/tracks: person jumps 30 m in 10 ms"), frozenset({"person"}),
        is_accepted=is_accepted,
    )  # fmt: skip
    person = sr.TrackedObject(sr.Footprint.box(2, 0, 3, 1), class_name="person")
    cart = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1), class_name="cart")
    samples = (sr.Sample(number * 10**8, {"cart": cart, "person": person}) for number in range(5))
    record_source(MemorySource(replace(sr.Trace.from_samples(samples), doubts=(doubt,))), path)
    return path


def test_a_verdict_that_rests_on_a_doubt_passes_nowhere_unless_it_is_allowed(fleet: Path) -> None:
    _doubtful_log(Path("walk.mcap"))
    Path("far.spatial").write_text("spec far = G (cart dist person >= 3)")
    Path("alone.spatial").write_text(
        'group others = class "cart"\nspec alone = G (exists c in others: c dist c <= 0)'
    )
    Path("near.spatial").write_text("const near = 0.5 in [0, 2]\nspec apart = G (cart dist person >= near)")
    said = "/tracks: person jumps 30 m in 10 ms"
    spec = ("walk.mcap", "--spec", "gate.spatial")
    for run in ("replay", "batch"):
        done = command(run, *spec)
        warning = f"doubtful: {said}; if the log is right, `accept: [jumps]`"
        assert (done.code, warning in done.err, "doubtful" in done.out) == (4, True, True)
        assert command(run, *spec, "--allow", "doubtful").code == 0
        assert command(run, *spec, "--fail-on", "doubtful").code == 1
        assert command(run, *spec, "--allow", "doubtful", "--fail-on", "doubtful").code == 1
        # a violation stays one, and other objects are not in doubt
        assert command(run, "walk.mcap", "--spec", "far.spatial").code == 1
        assert command(run, "walk.mcap", "--spec", "alone.spatial").code == 0
        accepted = command(run, str(_doubtful_log(Path("accepted.mcap"), is_accepted=True)), *spec[1:])
        assert (accepted.code, f"accepted: {said}" in accepted.err) == (0, True)
    assert (command("report", *spec, "-o", "walk.html").code, command("explain", *spec).code) == (4, 4)
    page = Path("walk.html").read_text()
    assert f"The verdict is doubtful: {said}." in page
    assert ("chip is-vacuous" in page, "chip is-satisfied" in page) == (True, False)
    assert "The log contradicts how it was read" in page
    for reading in (
        ("info", "walk.mcap"),
        ("check", "gate.spatial", "--log", "walk.mcap"),
        ("diff", "walk.mcap", "logs/run-0.jsonl", "--spec", "gate.spatial"),
        ("tune", "--spec", "near.spatial", "--good", "walk.mcap"),
        ("learn", "walk.mcap", "logs/run-0.jsonl"),
    ):
        assert f"walk.mcap: doubtful: {said}" in command(*reading).err


def test_every_output_of_a_batch_says_which_results_are_doubtful(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    _doubtful_log(Path("walk.mcap"))
    outputs = ("--junit", "junit.xml", "--html", "pages", "--json", "rows.jsonl")
    done = batch("walk.mcap", "--spec", "gate.spatial", *outputs)
    assert "2 results: 2 doubtful" in done.out
    failure = "doubtful: /tracks: person jumps 30 m in 10 ms"
    assert f"walk.mcap: {failure}. " in next(line for line in done.err.splitlines() if "::error" in line)
    tests = list(ElementTree.parse("junit.xml").getroot().iter("failure"))
    assert {(own.get("type"), own.get("message")) for own in tests} == {("doubtful", failure)}
    assert "The verdict is doubtful: /tracks: person jumps" in (tests[0].text or "")
    assert "number is-doubtful fails" in Path("pages/index.html").read_text()
    assert f"| doubtful | {failure} |" in Path("summary.md").read_text()
    rows = [json.loads(line) for line in Path("rows.jsonl").read_text().splitlines()]
    assert [row["doubts"] for row in rows] == [["jumps"], ["jumps"]]
    frame = sr.evaluate_logs("walk.mcap", "gate.spatial", output="results").table.to_pandas()
    assert [list(names) for names in frame["doubts"]] == [["jumps"], ["jumps"]]
    Path("suite.yaml").write_text(
        "specs: gate.spatial\nallow: doubtful\ncases: [{name: all, logs: walk.mcap}]"
    )
    assert batch("suite.yaml").code == 0
    with pytest.raises(AssertionError, match=failure):
        assert_satisfied("walk.mcap", "gate.spatial")
    assert_satisfied("walk.mcap", "gate.spatial", allow=["doubtful"])
