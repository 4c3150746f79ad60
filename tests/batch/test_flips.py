"""Edits of specifications, and later runs, over many logs: what flipped, what got less, and why."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from batch.fleet import GATE, batch, command, write_fleet, write_log


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with four logs, and an edit that one of them is too close for."""
    write_fleet(tmp_path, [0.5, 0.4, 0.2, 0.1])
    monkeypatch.chdir(tmp_path)
    Path("new.spatial").write_text(f"const near = 0.45\n{GATE.replace('>= 0.3', '>= near')}")
    return tmp_path


def test_an_edit_over_many_logs_names_what_flipped_and_why(fleet: Path) -> None:
    specs = ("--spec", "gate.spatial", "--spec", "new.spatial")
    for logs in (["logs"], ["logs/*.jsonl"], [f"logs/run-{number}.jsonl" for number in range(4)]):
        done = command("diff", *logs, *specs)
        assert done.code == 1, done.err
        assert done.out.startswith("gate.spatial → new.spatial\n4 logs, 8 results\n")
    table, _, rest = done.out.partition("flipped:\n")
    heads, apart, arrives = (line.split() for line in table.splitlines()[2:])
    assert heads == ["spec", "flipped", "less", "same"]
    assert (apart, arrives) == (["apart", "1", "3", "-", "edited"], ["arrives", "-", "-", "4"])
    flipped, _, less = rest.partition("\nless:\n")
    assert flipped.startswith(
        "  logs/run-1.jsonl: apart: satisfied (0.1) → violated (-0.05)\n"
        "      `cart dist person >= 0.45` fails by 0.05 at 0.000 s (within `apart`): cart and person are"
        " 0.4 apart.\nthe edit, by logs/run-1.jsonl:\n"
    )
    assert "with this edit alone: violated, robustness -0.05" in flipped
    assert [line.split(":")[0].strip() for line in less.splitlines()[::2]] == [
        "logs/run-3.jsonl", "logs/run-2.jsonl", "logs/run-0.jsonl"
    ]  # fmt: skip
    document = json.loads(command("diff", "logs", *specs, "--json").out)
    (change,) = (change for change in document["changes"] if change["change"] == "flipped")
    assert (change["log"], change["before"], change["now"]) == ("logs/run-1.jsonl", "satisfied", "violated")
    assert document["causes"][0]["log"] == "logs/run-1.jsonl" and document["causes"][0]["cause"]
    # the way back: what was wrong before is the reason
    back = command("diff", "logs", "--spec", "new.spatial", "--spec", "gate.spatial")
    assert (
        "apart: violated (-0.05) → satisfied (0.1)\n      before: `cart dist person >= 0.45` fails"
        in back.out
    )
    assert (back.code, command("diff", "logs", "--spec", "gate.spatial", "--spec", "gate.spatial").code) == (
        1,
        0,
    )
    for arguments, message in (
        (["-o", "diff.html"], "-o applies to one log; give one that flipped"),
        (["--align", "progress"], "--align applies to one log"),
    ):
        refused = command("diff", "logs", *specs, *arguments)
        assert (refused.code, message in refused.err) == (2, True)


def test_an_edit_after_which_nothing_tests_a_result_flips_it(fleet: Path) -> None:
    Path("new.spatial").write_text(GATE.replace("= G (", "= G[60s, 90s] ("))
    done = command("diff", "logs", "--spec", "gate.spatial", "--spec", "new.spatial")
    assert (done.code, "logs/run-0.jsonl: apart: satisfied (0.2) → untested (inf)" in done.out) == (1, True)
    (Path("logs") / "broken.jsonl").write_text("{")
    broken = command("diff", "logs", "--spec", "gate.spatial", "--spec", "gate.spatial")
    assert (broken.code, "damaged, or not to be read: logs/broken.jsonl" in broken.err) == (3, True)


def test_two_folders_of_results_are_compared(fleet: Path) -> None:
    batch("logs", "--spec", "gate.spatial", "-o", "a")
    assert command("results", "a", "a").code == 0
    write_log(Path("logs/run-0.jsonl"), 0.49)
    write_log(Path("logs/run-2.jsonl"), 0.35)
    write_log(Path("logs/new.jsonl"), 0.7)
    batch("logs", "--spec", "gate.spatial", "-o", "b")
    done = command("results", "a", "b", "--json", "changes.jsonl")
    assert done.code == 1
    assert "logs/run-2.jsonl: apart: violated (-0.1) → satisfied (0.05)\n      before: `cart dist" in done.out
    assert "less:\n  logs/run-0.jsonl: apart: satisfied (0.2) → satisfied (0.19)\n" in done.out
    assert "  logs/new.jsonl: apart: satisfied (0.4)\n" in done.out.partition("new:\n")[2]
    rows = [json.loads(line) for line in Path("changes.jsonl").read_text().splitlines()]
    kinds = {(row["log"], row["spec"]): row["change"] for row in rows}
    assert kinds["logs/run-0.jsonl", "apart"] == "less" and kinds["logs/run-2.jsonl", "apart"] == "flipped"
    assert "less:" not in command("results", "a", "b", "--tolerance", "0.2").out
    refused = command("diff", "a", "b")
    assert refused.code == 2
    assert "a: this folder has results of a batch; `results` shows them, and compares two" in refused.err
    gone = command("results", "b", "a").out.partition("gone:\n")[2]
    assert "  logs/new.jsonl: apart: satisfied (0.4)\n" in gone
    batch("logs/run-0.jsonl", "--spec", "new.spatial", "-o", "c")
    Path("elsewhere").symlink_to("logs")
    batch("elsewhere/run-0.jsonl", "--spec", "gate.spatial", "-o", "d")
    for arguments, message in (
        (("c", "d"), "no result is in both: c has logs/run-0.jsonl: apart"),
        (("a", "b", "--by", "log"), "--by applies to the results of one run"),
        (("a", "--tolerance", "5%"), "--tolerance applies to two runs"),
    ):
        refused = command("results", *arguments)
        assert (refused.code, message in refused.err) == (2, True), refused.err
