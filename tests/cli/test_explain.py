"""`spatial-replay explain`, and the witnesses, signals and windows of `replay`."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from cli.program import PROGRAM, run_program, written_on_terminal
from spatial_replay.cli import run as run_in_process

TRACKS = """\
{"time_ns": 0, "objects": [{"name": "cube", "polygon": [[0,0],[1,0],[1,1],[0,1]]}], "signals": {"battery": 0.9}}
{"time_ns": 500000000, "objects": [{"name": "cube", "polygon": [[4,0],[5,0],[5,1],[4,1]]}], "signals": {"battery": 0.4}}
{"time_ns": 1000000000, "objects": [{"name": "cube", "polygon": [[6,0],[7,0],[7,1],[6,1]]}, {"name": "cup", "polygon": [[9,0],[10,0],[10,1],[9,1]]}], "signals": {"battery": 0.5}}
{"time_ns": 1500000000, "objects": [{"name": "cube", "polygon": [[7,0],[8,0],[8,1],[7,1]]}, {"name": "cup", "polygon": [[9,0],[10,0],[10,1],[9,1]]}], "signals": {"battery": 0.5}}
"""  # noqa: E501
SPECIFICATION = """\
region goal = box(6.5, -1, 9.25, 2)
spec reach = F (cube enclosedin goal)
spec charged = G (battery >= 0.3)
spec done = reach and charged
spec met = F[1s, 2s] (cube closeto[0.5] cup)
spec apart = G (cube dist cup >= 0.5)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.jsonl").write_text(TRACKS, encoding="utf-8")
    (tmp_path / "run.spatial").write_text(SPECIFICATION, encoding="utf-8")
    return tmp_path


EXPLAIN = ("explain", "run.jsonl", "--spec", "run.spatial")
REPLAY = ("replay", "run.jsonl", "--spec", "run.spatial")


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    code = run_in_process(list(arguments))
    return code, capsys.readouterr().out


def test_every_result_is_explained_in_a_few_sentences(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text = said(capsys, *EXPLAIN)
    met, apart, done = text.strip().split("\n\n")
    assert code == 1
    assert done.splitlines() == [
        "`done` is satisfied: robustness 0.1.",
        "What decides is `battery >= 0.3`, which holds by 0.1 at 0.500 s "
        "(its least within `charged`): battery is 0.4.",
        "It would be violated with 0.4001 or more instead of 0.3 in `battery >= 0.3`.",
        "Its robustness is the least of numbers in different units: lengths and battery.",
    ]
    assert "`met` is violated" in met
    assert "cube and cup are 1 apart" in met
    assert "satisfied with 1 or more instead of 0.5" in met
    assert apart.splitlines() == [
        "`apart` is unknown: robustness between -inf and 0.5.",
        "`cube dist cup >= 0.5` is unknown at 0.000 s, where it could decide (within `apart`): "
        "cup is not in the sample.",
        "cup is missing in 2 of 4 samples, all before 1.000 s: --from 1.000s leaves them out.",
        "Asked only while cup is in the samples, it is satisfied: write `G (present(cup) -> …)`.",
    ]
    _, far = said(capsys, *EXPLAIN, "--spec", "G (cube dist cup >= 2)")
    assert "No number in it makes that satisfied: samples that are unknown decide, too." in far
    assert run_in_process([*EXPLAIN, "--from", "1.000s", "--result", "apart"]) == 0


def test_a_named_spec_is_explained_at_a_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = said(capsys, *EXPLAIN, "--result", "reach", "--at", "1.2s")
    assert code == 4
    assert text.startswith("`reach` is pending: robustness -0.5 so far, and later samples decide.")
    assert "(its greatest so far within `reach`): cube sticks out of goal by 0.5" in text
    assert "violated" not in text
    _, at_the_end = said(capsys, *EXPLAIN, "--result", "reach", "--at", "1500ms")
    assert at_the_end.startswith("`reach` is satisfied: robustness 0.5, certain since 1.500 s.")


def test_many_results_are_counted_with_those_that_are_pending(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [f"spec s{k} = G (battery >= {k / 10})" for k in range(8)]
    (folder / "run.spatial").write_text("\n".join(lines), encoding="utf-8")
    _, text = said(capsys, *EXPLAIN, "--at", "0.5s")
    assert text.splitlines()[0] == "8 results: 3 violated, 5 pending"
    lines = [f"spec s{k} = G (battery >= {k / 100})" for k in range(24)]
    (folder / "run.spatial").write_text("\n".join(lines), encoding="utf-8")
    _, text = said(capsys, *EXPLAIN, "--at", "0.5s")
    assert text.splitlines()[0] == "24 results: 24 pending"
    assert text.splitlines()[-1] == "… and 12 more: 12 pending; --json has all"


def test_any_of_many_results_is_found_by_its_name_with_the_id_of_its_requirement_or_without(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [f"spec s{k} = G (battery >= {k / 100})" for k in range(24)]
    lines.append('spec respond "R-1: it responds" = F (battery >= 0)')
    (folder / "run.spatial").write_text("\n".join(lines), encoding="utf-8")
    for name in ("respond", "R-1", "R-1 respond", "respond [R-1]"):
        assert "`respond` is satisfied" in said(capsys, *EXPLAIN, "--result", name)[1]
    for slip, name in (("respnd", "respond"), ("r-1", "R-1"), ("R-2", "R-1")):
        assert run_in_process([*EXPLAIN, "--result", slip]) == 2
        assert f"did you mean '{name}'?" in capsys.readouterr().err


def test_options_that_cannot_be_explained_are_refused_by_name(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, expected in [
        (("--result", "rech"), "did you mean 'reach'"),
        (("--result", "@7"), "no result is about object '7'"),
        (("--at", "1s", "--to", "2s"), "give only one"),
        (("--at", "-3"), "is not a time"),
        (("--from", "1s", "--at", "0.2s"), "is before --from"),
    ]:
        assert run_in_process([*EXPLAIN, *arguments]) == 2
        assert expected in capsys.readouterr().err


def test_explanations_are_available_as_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text = said(capsys, *EXPLAIN, "--result", "charged", "--json")
    (found,) = json.loads(text)
    assert found["atom"]["text"] == "battery >= 0.3"
    assert (found["atom"]["value"], found["time_ns"], found["verdict"]) == (
        pytest.approx(0.1),
        500_000_000,
        "satisfied",
    )
    assert found["threshold"]["flips_at"] == 0.4001


def specifications(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    _, text = said(capsys, *REPLAY, "--json", "-", *arguments)
    return {each["name"]: each for each in json.loads(text)["specifications"]}


def test_the_json_document_contains_the_witness_of_the_worst_result(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = specifications(capsys)
    assert found["met"]["worst"]["atom"]["objects"] == ["cube", "cup"]
    assert found["met"]["worst"]["atom"]["measured"][0]["points"] == [[8.0, 0.0], [9.0, 0.0]]
    assert found["apart"]["worst"]["atom"]["unknown"] == ["cup is not in the sample"]


def test_signals_and_windows_are_written_as_series(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    series = specifications(capsys, "--to-end", "--window", "600ms")["done"]["series"]
    nodes = specifications(capsys)["done"]["nodes"]
    charged = next(node["id"] for node in nodes if node["name"] == "charged")
    assert series["signal"][charged] == pytest.approx([0.1, 0.1, 0.2, 0.2])
    assert series["window"][charged] == pytest.approx([0.6, 0.1, 0.1, 0.2])
    assert len(series["value"]) == len(series["signal"]) == len(nodes)


def test_a_sliding_window_is_summarised_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text = said(capsys, *REPLAY, "--window", "600ms")
    assert (
        "over the last 0.600 s violated at 3 of 4 samples, first at 0.000 s; robustness at the end 0.2"
        in text
    )


def test_an_unknown_verdict_names_what_was_unknown(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text = said(capsys, *REPLAY)
    assert "cup is not in the sample" in text


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--to-end",), "add --json"),
        (("--window", "0s"), "contains no sample"),
        (("--window", "ten"), "is not a duration"),
        (("--window", "1s", "--semantics", "paper"), "not defined under --semantics paper"),
    ],
)
def test_options_that_exclude_each_other_are_refused(
    folder: Path, arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_in_process([*REPLAY, *arguments]) == 2
    assert expected in capsys.readouterr().err


def test_a_rounding_error_is_no_amount(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "run.spatial").write_text(
        "spec close = G (left dist right <= 0.1)\nspec far = G (left dist right >= 0.3)\n"
    )
    with (folder / "run.jsonl").open("w") as log:
        for time_ns, right in ((0, 1.3), (1, 1.5)):
            objects = ", ".join(
                f'{{"name": "{name}", "polygon": [[{x}, 0], [{x + 1}, 0], [{x + 1}, 1]]}}'
                for name, x in (("left", 0.2), ("right", right))
            )
            log.write(f'{{"time_ns": {time_ns}, "objects": [{objects}]}}\n')
    assert "first at 0.000 s, by rounding." in said(capsys, *REPLAY)[1]
    _, text = said(capsys, *EXPLAIN, "--to", "1ns")
    assert "`left dist right <= 0.1`, which fails by rounding at 0.000 s" in text
    assert "`left dist right >= 0.3`, which fails by 0.2 at" in text


def test_json_has_templates_without_objects_and_may_name_standard_output(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "run.spatial").write_text("spec near(ego) = G (ego dist cube <= 3)\nspec on = G (battery >= 0)")
    arguments = [*EXPLAIN, "--each", "ego=class:bus"]
    code, text = said(capsys, *arguments, "--json", "-")
    assert (code, text) == said(capsys, *arguments, "--json")
    explained, idle = json.loads(text)
    assert (explained["specification"], explained["verdict"]) == ("on", "satisfied")
    assert (idle["specification"], idle["verdict"], idle["vacuous"][0]["reason"]) == (
        "near", None, "no instances",
    )  # fmt: skip
    assert idle["explanation"] == [
        "`near(ego)` was never evaluated: no object stands for ego. The log never has the class 'bus'."
    ]


def luminance(number: int) -> float:
    """The relative luminance of one of the 216 colours of the cube of xterm."""
    red, green, blue = ((0, 95, 135, 175, 215, 255)[(number - 16) // place % 6] / 255 for place in (36, 6, 1))
    linear = [
        each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in (red, green, blue)
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_on_a_terminal_lines_fit_and_verdicts_have_colours_for_black_and_for_white(folder: Path) -> None:
    shown = written_on_terminal((*PROGRAM, *EXPLAIN), folder, {"COLUMNS": "68"})
    colours = {int(each) for each in re.findall(r"\x1b\[38;5;(\d+)m", shown)}
    assert len(colours) == 3  # satisfied, violated and unknown
    for each in colours:
        assert (luminance(each) + 0.05) / 0.05 >= 4.0  # on black
        assert 1.05 / (luminance(each) + 0.05) >= 3.5  # on white
    plain = re.sub(r"\x1b\[[\d;]*m", "", shown).replace("\r", "")
    assert max(map(len, plain.splitlines())) <= 68
    # no line parts a number from its unit
    assert not re.search(r"\d\n +s\b", plain)
    piped = run_program(*EXPLAIN, cwd=folder).stdout
    assert plain.split() == piped.split()


def test_every_command_keeps_words_and_numbers_whole_on_a_terminal(folder: Path) -> None:
    for command in (REPLAY, ("info", "run.jsonl"), ("doctor", "run.spatial")):
        shown = written_on_terminal((*PROGRAM, *command), folder, {"COLUMNS": "72"})
        lines = re.sub(r"\x1b\[[\d;]*m", "", shown).splitlines()
        assert max(map(len, lines)) <= 72
        done = run_program(*command, cwd=folder)
        assert not Counter((done.stdout + done.stderr).split()) - Counter(" ".join(lines).split())


def test_how_often_and_where_an_invariant_is_violated_is_listed(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "spec slow = G (robot closeto[1] ann -> speed <= 0.5)\nspec apart = G not (robot ovlp ann)\n"
    (folder / "run.spatial").write_text(text)
    with (folder / "run.jsonl").open("w") as log:
        for second in range(30):
            far, fast = (3, 3, 0.5, -0.25)[second % 4], second // 4 % 7 < 3 or second % 4 == 0
            objects = ", ".join(
                f'{{"name": "{name}", "polygon": [[{x}, 0], [{x + 1}, 0], [{x + 1}, 1], [{x}, 1]]}}'
                for name, x in (("robot", second), ("ann", second + 1 + far))
            )
            signals = f'{{"speed": {1.25 if fast else 0.25}}}'
            log.write(f'{{"time_ns": {second * 10**9}, "objects": [{objects}], "signals": {signals}}}\n')
    _, text = said(capsys, *EXPLAIN)
    assert [line for line in text.splitlines() if line.startswith(("It is", "From", "At"))] == [
        "It is violated in 3 of 7 entries of `robot closeto[1] ann`:",
        "From 2.000 s to 3.000 s, worst at 3.000 s, near (4, 0.5): speed is 1.25.",
        "From 6.000 s to 7.000 s, worst at 7.000 s, near (8, 0.5): speed is 1.25.",
        "From 10.000 s to 11.000 s, worst at 11.000 s, near (12, 0.5): speed is 1.25.",
        "It is violated in 7 intervals; the first 5 are:",
        *(
            f"At {second}.000 s, near ({second + 1}, 0.5): robot and ann overlap by 0.25."
            for second in (3, 7, 11, 15, 19)
        ),
    ]
    _, text = said(capsys, *REPLAY, "--json", "-")
    slow, apart = (result["violations"][0] for result in json.loads(text)["specifications"])
    assert (slow["condition"], slow["entries"], slow["violated_entries"]) == ("robot closeto[1] ann", 7, 3)
    last = apart["intervals"][-1]
    assert (len(apart["intervals"]), apart["entries"]) == (7, None)
    assert (last["start_ns"], last["samples"], last["robustness"]) == (27 * 10**9, 1, -0.25)
    assert (last["atom"]["objects"], last["place"]) == (["robot", "ann"], [28.0, 0.5])
    _, text = said(capsys, *EXPLAIN, "--at", "7s", "--result", "apart", "--json")
    assert len(json.loads(text)[0]["violations"][0]["intervals"]) == 2


@pytest.mark.parametrize(
    ("formula", "advice"),
    [
        ("G (load >= 1)", "satisfied with 0 or less instead of 1 in `load >= 1`"),
        ("F (load >= 2.001)", "satisfied with 2 or less instead of 2.001 in `load >= 2.001`"),
        ("F (load <= -0.001)", "satisfied with 0 or more instead of -0.001 in `load <= -0.001`"),
        ("G (load >= 0)", "violated with any number above 0 in `load >= 0`"),
        ("G (load <= 2)", "violated with any number below 2 in `load <= 2`"),
        ("G (load >= -1)", "violated with 0.001 or more instead of -1 in `load >= -1`"),
        ("G (load <= 1 -> F[1s, 1s] load <= 1)", "satisfied with 2 or more instead of 1 in `load <= 1`"),
    ],
)
def test_a_number_that_flips_a_verdict_is_no_rounding_error_and_is_that_of_the_response(
    folder: Path, capsys: pytest.CaptureFixture[str], formula: str, advice: str
) -> None:
    lines = [f'{{"time_ns": {10**9 * k}, "objects": [], "signals": {{"load": {2 * k}}}}}\n' for k in (0, 1)]
    (folder / "run.jsonl").write_text("".join(lines))
    _, text = said(capsys, "explain", "run.jsonl", "--spec", formula)
    assert f"It would be {advice}." in text.splitlines()
    _, text = said(capsys, "explain", "run.jsonl", "--spec", formula, "--json")
    (explained,) = json.loads(text)
    if "->" in formula:
        assert explained["missed"]["closest"]["atom"]["measured"][0]["value"] == 2
        assert explained["missed"]["threshold"]["flips_at"] == 2


def test_an_option_of_explain_alone_is_named_by_other_commands(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_in_process([*REPLAY, "--result", "reach"]) == 2
    assert "no option --result; explain takes it: spatial-replay explain LOG" in capsys.readouterr().err
