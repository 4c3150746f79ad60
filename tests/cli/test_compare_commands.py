"""`spatial-replay diff` and `spatial-replay clip`, as a user types them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import spatial_replay as sr
from bags.bag_files import START_NS, drive, write_ros1
from spatial_replay.cli import run

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
TABLE = ("table.jsonl", "--spec", "table.spatial", "--spec", "table_edited.spatial")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("table.jsonl", "table.spatial", "table_edited.spatial", "push.mcap", "push_edited.spatial"):
        shutil.copy(RECORDINGS / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(list(arguments))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.usefixtures("folder")
def test_the_edit_that_flips_a_verdict_is_named_with_its_lines(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = said(capsys, "diff", *TABLE)
    assert code == 1
    assert "table_set: satisfied (0.02487) → violated (-0.1552)" in out
    assert "because: constant deadline: `F[0s, 8s] …` to `F[0s, 4s] …`, in `laid`" in out
    assert "+ table_edited.spatial:2: const deadline = 4s" in out
    code, out, _ = said(capsys, "diff", *TABLE, "--json")
    (changed,) = [each for each in json.loads(out)["specifications"] if each["edits"]]
    assert (code, changed["flipped"]) == (1, True)
    assert [edit["subject"] for edit in changed["cause"]] == ["deadline"]
    assert changed["cause"][0]["alone"]["verdict"] == "violated"


@pytest.mark.usefixtures("folder")
def test_numbers_of_a_diff_have_the_units_that_replay_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "record", "tracks", "table.jsonl", "--unit", "m", "-o", "metres.mcap")[0] == 0
    edited = said(capsys, "diff", "metres.mcap", *TABLE[1:])[1]
    for line in (
        "table_set: satisfied (0.02487 m) → violated (-0.1552 m)",
        "first differs at 5.433 s: -0.1543 m → -0.1552 m",
        "with this edit alone: violated, robustness -0.1552 m",
        "fails by 0.1552 m at 4.000 s (within `laid`): spoon and plate are 0.2352 m apart.",
    ):
        assert line in edited
    replayed = said(capsys, "replay", "metres.mcap", "--spec", "table_edited.spatial")[1]
    assert "robustness -0.1552 m" in replayed
    # of two runs, distances and numbers alike
    Path("late.jsonl").write_text("".join(Path("table.jsonl").read_text().splitlines(keepends=True)[30:]))
    assert said(capsys, "record", "tracks", "late.jsonl", "--unit", "m", "-o", "late.mcap")[0] == 0
    runs = said(capsys, "diff", "metres.mcap", "late.mcap", "--spec", "table.spatial")[1]
    assert "table_set: satisfied (0.02487 m) | " in runs
    (moved,) = (line for line in runs.splitlines() if line.strip().startswith("spoon: differs"))
    assert "by up to 0.3058 m; apart from itself" in moved
    assert "farthest by 0.1766 m at" in moved


@pytest.mark.usefixtures("folder")
def test_intervals_are_said_by_every_command_as_by_replay(capsys: pytest.CaptureFixture[str]) -> None:
    # milk comes late
    Path("safe.spatial").write_text("spec safe = G (milk dist cup >= 0.2)")
    Path("safer.spatial").write_text("spec safe = G (milk dist cup >= 0.25)")
    given, interval = ("table.jsonl", "--spec", "safe.spatial"), "between -inf and -0.0873"
    assert f"robustness not determined, {interval}" in said(capsys, "replay", *given, "-o", "out.mcap")[1]
    edited = said(capsys, "diff", *given, "--spec", "safer.spatial")[1]
    assert f"violated ({interval}) → violated (between -inf and -0.1373)" in edited
    assert "with this edit alone: violated, robustness between -inf and -0.1373" in edited
    for command in (
        ("diff", "table.jsonl", "out.mcap", "--spec", "safe.spatial"),
        ("info", "out.mcap"),
        ("batch", *given, "-o", "results", "--html", "page"),
        ("results", "results"),
    ):
        out = said(capsys, *command)[1]
        assert "nan" not in out.split(), command
        assert interval in out or "the same 300 samples" in out, command
    page = Path("page/index.html").read_text(encoding="utf-8")
    assert interval.replace("inf", "∞").replace("-", "\N{MINUS SIGN}") in page


@pytest.mark.usefixtures("folder")
def test_what_is_equal_differs_in_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    same = ("--spec", "table.spatial")
    assert said(capsys, "diff", "table.jsonl", *same, *same)[0] == 0
    code, out, _ = said(capsys, "diff", "push.mcap", "push.mcap")
    assert (code, out.splitlines()[1:]) == (0, ["  the same 546 samples"])
    code, out, _ = said(capsys, "diff", "table.jsonl", "table.jsonl")
    assert (code, out.splitlines()[1:]) == (0, ["  the same 300 samples"])


@pytest.mark.usefixtures("folder")
def test_new_names_alone_are_listed_and_are_no_difference(capsys: pytest.CaptureFixture[str]) -> None:
    text = Path("table.spatial").read_text()
    Path("renamed.spatial").write_text(text.replace("table_set", "table_laid"))
    files = ("table.jsonl", "--spec", "table.spatial", "--spec", "renamed.spatial")
    code, out, _ = said(capsys, "diff", *files)
    assert code == 0
    assert "table_laid (was table_set): satisfied (0.02487), the same" in out
    assert "    renamed table_set to table_laid" in out
    assert json.loads(said(capsys, "diff", *files, "--json")[1])["same"]


@pytest.mark.usefixtures("folder")
def test_the_edit_that_flips_a_verdict_by_the_papers_semantics_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("old.spatial").write_text("const near = 0.08\nspec near_plate = F G (spoon dist plate <= near)")
    Path("new.spatial").write_text("const near = 0.01\nspec near_plate = F G (spoon dist plate <= near)")
    files = ("table.jsonl", "--spec", "old.spatial", "--spec", "new.spatial", "--semantics", "paper")
    code, out, _ = said(capsys, "diff", *files, "-o", "diff.html")
    assert code == 1
    assert "because: constant near: `spoon dist plate <= 0.08` to `spoon dist plate <= 0.01`" in out
    runs = ("table.jsonl", "table.jsonl", "--spec", "old.spatial", "--semantics", "paper")
    assert said(capsys, "diff", *runs)[0] == 0
    code, _, err = said(capsys, "diff", *runs, "--align", "progress")
    assert (code, "not defined under the semantics 'paper'" in err) == (2, True)


MOVED = 0.5


def shifted(log: str, name: str) -> None:
    """A copy of a log of tracks in which one object stands elsewhere from 5 s on."""
    lines = []
    for line in Path(log).read_text().splitlines():
        sample = json.loads(line)
        for each in sample["objects"] if sample["time_ns"] >= 5 * 10**9 else ():
            if each["name"] == name:
                for part in each.get("parts", [{"vertices": each.get("polygon", [])}]):
                    part["vertices"][:] = [[x + MOVED, y] for x, y in part["vertices"]]
        lines.append(json.dumps(sample))
    Path("moved.jsonl").write_text("\n".join(lines))


@pytest.mark.usefixtures("folder")
def test_of_two_runs_it_says_who_moved_differently_since_when_and_what_that_did(
    capsys: pytest.CaptureFixture[str],
) -> None:
    shifted("table.jsonl", "spoon")
    logs = ("table.jsonl", "moved.jsonl", "--spec", "table.spatial")
    code, out, _ = said(capsys, "diff", *logs, "--json")
    found = json.loads(out)
    (spoon,) = found["objects"]
    assert (code, spoon["name"]) == (1, "spoon")
    assert spoon["first_ns"] >= 5 * 10**9 > spoon["first_ns"] - 10**8
    assert spoon["greatest_shift"] == pytest.approx(MOVED)
    flipped = {each["name"]: each for each in found["specifications"]}["table_set"]
    assert (flipped["a"]["verdict"], flipped["b"]["verdict"]) == ("satisfied", "violated")
    assert flipped["moved"] == ["spoon"]
    code, out, _ = said(capsys, "diff", *logs, "-o", "diff.html")
    assert code == 1
    assert "spoon: differs since 5.000 s, by up to 0.5; apart from itself since 5.000 s" in out
    page = Path("diff.html").read_text()
    assert "moved differently" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["diff", "table.jsonl"], "give a second log, or --spec OLD --spec NEW"),
        (["diff", *TABLE[:3]], "table.jsonl holds no specification of its own; give --spec OLD, too"),
        (["diff", *TABLE, "--spec", "push_edited.spatial"], "3 specifications; give two"),
        (
            ["diff", "table.jsonl", "--spec", "table.spatial", "--spec", "push_edited.spatial"],
            "table.spatial and push_edited.spatial have no spec in common",
        ),
        (["diff", *TABLE, "--align", "progress"], "--align applies to two logs"),
        (["diff", *TABLE, "-o", "diff.txt"], "diff.html"),
        (["diff", *TABLE, "-o", "table.spatial"], "table.spatial"),
        (["diff", "table.jsonl", "push.mcap"], "the runs have no object in common"),
        (["diff", "push.mcap", "push.mcap", "--align", "gap"], "did you mean 'gaps'?"),
        (["clip", *TABLE[:3], "-o", "bug.mcap", "--result", "lade"], "did you mean 'laid'?"),
        (["clip", *TABLE[:3], "-o", "bug.mcap", "--around", "5"], "--around: '5' is not a duration"),
        (["clip", *TABLE[:3], "-o", "table.jsonl"], "table.jsonl"),
        (["clip", *TABLE[:3], "-o", "bug.mcap", "--every", "2"], "a clip keeps every sample"),
        (["clip", "push.mcap", "-o", "bug.mcap", "--topics", "/camera/*"], "no topic of push.mcap fits"),
    ],
)
def test_mistakes_are_named_with_their_remedy(
    capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    code, _, err = said(capsys, *arguments)
    assert code == 2
    assert words in err


@pytest.mark.usefixtures("folder")
def test_runs_in_other_units_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    lines = [json.loads(line) for line in Path("table.jsonl").read_text().splitlines()[:3]]
    for sample in lines:
        for each in sample["objects"]:
            for part in each.get("parts", [{"vertices": each.get("polygon", [])}]):
                part["vertices"][:] = [[1000 * x, 1000 * y] for x, y in part["vertices"]]
                part["radius"] = 1000 * part.get("radius", 0.0)
    Path("mm.jsonl").write_text("\n".join(map(json.dumps, lines)))
    code, _, err = said(capsys, "diff", "table.jsonl", "mm.jsonl")
    assert code == 2
    assert "different units" in err
    runs = "--good", "table.jsonl", "--bad", "mm.jsonl"
    code, _, err = said(capsys, "tune", "--spec", "table.spatial", *runs, "--vary", "near=0.05:0.2")
    assert code == 2
    assert "table.jsonl and mm.jsonl seem to have different units" in err


@pytest.mark.usefixtures("folder")
def test_a_diff_names_a_difference_that_rounded_numbers_hide(capsys: pytest.CaptureFixture[str]) -> None:
    for name, apart in ("old", "0.08"), ("new", "0.08000001"):
        Path(f"{name}.spatial").write_text(f"spec gap = G (red dist blue >= {apart})")
    code, out, _ = said(capsys, "diff", "push.mcap", "--spec", "old.spatial", "--spec", "new.spatial")
    assert code == 1
    assert "gap: violated (-0.0148 m) → violated (-0.0148 m), different by 1e-08 m" in out


@pytest.mark.usefixtures("folder")
def test_a_clip_says_how_small_it_got_and_is_replayed_without_other_files(
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ("clip", "push.mcap", "--spec", "push_edited.spatial", "--result", "gaps", "-o", "bug.mcap")
    code, out, _ = said(capsys, *arguments)
    assert code == 0
    assert "gaps: 32 of 546 samples, 4.233 s to 5.267 s of the log" in out
    assert "it begins at 4.233 s, where `gaps` became violated for certain" in out
    assert "it ends at 5.267 s, where the robustness of `gaps` is decided" in out
    longer = said(capsys, "clip", "push.mcap", "--spec", "push_edited.spatial", "-o", "long.mcap")[1]
    assert "it ends at 15.967 s: in a shorter clip `push` has another robustness" in longer
    around = said(capsys, *arguments[:-1], "around.mcap", "--around", "2s")[1]
    assert "it begins at 2.233 s, 2s from the samples that decide, by --around" in around
    size = Path("bug.mcap").stat().st_size
    assert f"{size:,} bytes" in out
    assert size < Path("push.mcap").stat().st_size / 4
    code, out, _ = said(capsys, "replay", "bug.mcap", "--json", "-")
    (push,) = json.loads(out)["specifications"]
    assert {node["name"]: node["robustness"] for node in push["nodes"]}["gaps"] == pytest.approx(-0.01480400)
    assert said(capsys, "verify", "bug.mcap")[0] == 0
    assert said(capsys, "verify", "bug.mcap", "--source", "push.mcap")[0] == 0
    assert said(capsys, "verify", "bug.mcap", "--source", "table.jsonl")[0] != 0
    # a replay of a clip was made from all of it
    assert said(capsys, "replay", "bug.mcap", "-o", "again.mcap")[0] == 1
    assert said(capsys, "verify", "again.mcap", "--source", "bug.mcap")[0] == 0
    before = Path("bug.mcap").read_bytes()
    said(capsys, *arguments)
    assert Path("bug.mcap").read_bytes() == before
    assert said(capsys, *arguments, "--around", "1s")[1].count("92 of 546 samples") == 1


@pytest.mark.usefixtures("folder")
def test_a_clip_of_several_results_keeps_those_that_failed_and_says_what_it_left_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("two.spatial").write_text(
        "spec rest = F (cup dist plate >= 0)\nspec apart = G (cup dist plate >= 1)"
    )
    arguments = ("clip", "table.jsonl", "--spec", "two.spatial", "-o", "two.mcap")
    code, out, err = said(capsys, *arguments)
    assert (code, "another verdict" in err) == (0, False)
    assert "\n  apart: " in out
    assert "not kept, since nothing failed there: rest; --result NAME keeps one" in out
    assert "not kept" not in said(capsys, *arguments, "--result", "rest", "--result", "apart")[1]


def test_a_clip_fails_for_the_reason_that_settled_the_verdict_not_only_with_the_least_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    samples = [sr.Sample(index * 10**9, {}, {"gap": 3.0 - index, "done": -9.0}) for index in range(5)]
    Path("run.spatial").write_text(
        "spec safe = G (gap >= 0.5)\nspec deliver = F (done >= 1)\nspec task = safe and deliver\n"
    )
    with sr.Recorder("run.mcap") as recorder:
        for sample in samples:
            recorder.write(sample)
    assert said(capsys, "clip", "run.mcap", "--spec", "run.spatial", "-o", "bug.mcap")[0] == 0
    whole, cut = (
        sr.evaluate(sr.load_specification("run.spatial"), sr.read_trace(path)).result()
        for path in ("run.mcap", "bug.mcap")
    )
    assert cut.robustness == whole.robustness == -10.0
    for result in (whole, cut):
        assert [cause.spec for cause in result.causes] == ["safe", "deliver"]
        assert result.worst is not None
        assert result.worst.deciding is not None
        assert result.worst.deciding.text == "gap >= 0.5"


def test_a_clip_says_which_parts_fail_in_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.spatial").write_text(
        "spec safe = G (gap >= 0.5)\nspec deliver = F (done >= 1)\nspec task = safe and deliver\n"
    )
    with sr.Recorder("run.mcap") as recorder:
        for index in range(9):
            recorder.write(sr.Sample(index * 10**9, {}, {"gap": -9.0 * (index == 1), "done": index - 7.0}))
    code, _, err = said(capsys, "clip", "run.mcap", "--spec", "run.spatial", "-o", "bug.mcap")
    assert code == 0
    assert "deliver: fails in the clip alone" in err
    whole, cut = (
        sr.evaluate(sr.load_specification("run.spatial"), sr.read_trace(path)).result()
        for path in ("run.mcap", "bug.mcap")
    )
    assert [cause.spec for cause in whole.causes] == ["safe"]
    assert [cause.spec for cause in cut.causes] == ["safe", "deliver"]


def test_a_verdict_that_needs_the_whole_log_is_said_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    samples = [sr.Sample(index * 10**9, {}, {"level": float(index in (0, 4))}) for index in range(5)]
    Path("ends.spatial").write_text("spec ends = (level >= 1) and F[4, 4] (level >= 1)")
    with sr.Recorder("run.mcap") as recorder:
        for sample in samples:
            recorder.write(sample)
    code, out, _ = said(capsys, "clip", "run.mcap", "--spec", "ends.spatial", "-o", "bug.mcap")
    assert code == 0
    assert "nothing smaller has these verdicts and witnesses" in out
    Path("far.spatial").write_text("spec low = G (level <= 0.5)")
    code, out, _ = said(capsys, "clip", "run.mcap", "--spec", "far.spatial", "-o", "low.mcap")
    assert "is smaller than its schemas and annotations" in out
    assert len(sr.read_trace("bug.mcap")) == 5


MAPPING = """\
sample: {topic: /b}
topics:
  /a: {name: a, position: [x, y], shape: {disc: 0.5}}
  /b: {name: b, position: [x, y], shape: {disc: 0.5}}
"""


def test_a_clip_of_a_bag_keeps_what_was_valid_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ros1(
        Path("drive.bag"),
        [each for each in drive() if each.topic != "/words" or each.time_ns < START_NS + 10**9],
    )
    Path("drive.yaml").write_text(MAPPING)
    Path("near.spatial").write_text("spec far = G (a dist b >= 2)")
    arguments = ("drive.bag", "--mapping", "drive.yaml", "--spec", "near.spatial")
    code, out, _ = said(capsys, "clip", *arguments, "-o", "bug.mcap", "--around", "500ms")
    assert code == 0
    assert "of 60 samples" in out
    info = json.loads(said(capsys, "info", "bug.mcap", "--json")[1])
    counts = {each["topic"]: each["messages"] for each in info["topics"]}
    # the strings ended long before; the last of them is still what a viewer shows
    assert counts["/words"] == 1
    assert 8 <= counts["/a"] <= 20
    code, out, _ = said(capsys, "clip", *arguments, "-o", "small.mcap", "--topics", "/a")
    info = json.loads(said(capsys, "info", "small.mcap", "--json")[1])
    assert "/words" not in {each["topic"] for each in info["topics"]}
    for name in ("bug.mcap", "small.mcap"):
        # the last messages before the clip are cut out again, too
        source = ("--source", "drive.bag", "--mapping", "drive.yaml")
        assert said(capsys, "verify", name, *source)[0] == 0
    # a clip of the annotated bag was cut from that, and a replay of the clip was not cut
    assert said(capsys, "replay", *arguments, "-o", "annotated.mcap")[0] == 1
    assert said(capsys, "clip", "annotated.mcap", "-o", "cut.mcap")[0] == 0
    assert said(capsys, "replay", "cut.mcap", "-o", "again.mcap")[0] == 1
    for name, origin in (("cut", "annotated"), ("again", "cut"), ("again", "annotated")):
        assert said(capsys, "verify", f"{name}.mcap", "--source", f"{origin}.mcap")[0] == 0
