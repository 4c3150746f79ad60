"""`spatial-replay check --dfa`: the automaton of a specification."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spatial_replay import parse_specification
from spatial_replay.cli import run

TEXT = "spec reach = F (cube enclosedin tray)\nspec calm = G (battery >= 0.2)\nspec done = reach and calm\n"


@pytest.fixture
def specification(tmp_path: Path) -> Path:
    path = tmp_path / "done.spatial"
    path.write_text(TEXT)
    return path


def test_the_automaton_is_printed_as_text_below_the_tree(
    specification: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", str(specification), "--dfa", "-"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "spec done"
    assert "automaton of done: 3 states, 2 propositions" in lines
    assert "    to 2 if cube enclosedin tray and battery >= 0.2" in lines


@pytest.mark.parametrize(("suffix", "begin"), [("dot", 'digraph "done" {'), ("hoa", "HOA: v1")])
def test_the_suffix_of_the_file_chooses_the_format(
    specification: Path, suffix: str, begin: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output = specification.with_suffix(f".{suffix}")
    assert run(["check", str(specification), "--dfa", str(output)]) == 0
    assert output.read_text().splitlines()[0] == begin
    assert f"wrote {output}: 3 states, 2 propositions" in capsys.readouterr().out


def test_json_output_stays_valid_when_an_automaton_is_written(
    specification: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = specification.with_suffix(".dot")
    assert run(["check", str(specification), "--json", "--dfa", str(output)]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["file"] == "done.spatial"
    assert "wrote" in captured.err
    assert run(["check", str(specification), "--json", "--dfa", "-"]) == 2


def test_other_file_types_and_inputs_are_refused(
    specification: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", str(specification), "--dfa", "done.png"]) == 2
    captured = capsys.readouterr()
    assert ".dot, .hoa or .svg files" in captured.err
    # refused before the tree is printed
    assert not captured.out
    same = specification.rename(specification.with_suffix(".dot"))
    assert run(["check", str(same), "--dfa", str(same)]) == 2
    assert parse_specification(same.read_text()).results


def test_one_of_several_results_has_to_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, output = tmp_path / "two.spatial", tmp_path / "two.dot"
    path.write_text("spec reach = F p >= 0\nspec before = G (O p >= 0)\n")
    assert run(["check", str(path), "--dfa", str(output)]) == 2
    assert "choose one with --result: reach, before" in capsys.readouterr().err
    assert run(["check", str(path), "--dfa", str(output), "--result", "reach"]) == 0
    assert output.read_text().startswith('digraph "reach"')
    assert run(["check", str(path), "--result", "reach"]) == 2
    capsys.readouterr()
    for file in (str(output), "-"):
        assert run(["check", str(path), "--dfa", file, "--result", "raech"]) == 2
        captured = capsys.readouterr()
        assert "did you mean 'reach'" in captured.err
        assert not captured.out
    # those that have one are shown all the same
    assert run(["check", str(path), "--dfa", "-"]) == 2
    captured = capsys.readouterr()
    assert "automaton of reach" in captured.out
    assert "two.spatial:2:17: error: `O` looks back" in captured.err
    line, carets = captured.err.splitlines()[-3:-1]
    assert line[carets.index("^") :] == "(O p >= 0)"


def test_bounds_in_seconds_are_counted_in_samples_at_a_stated_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, output = tmp_path / "soon.spatial", tmp_path / "soon.dot"
    path.write_text("spec soon = F[0s, 3s] p >= 0\n")
    assert run(["check", str(path), "--dfa", "-"]) == 2
    assert "state the samples a second (--hz, rate_hz)" in capsys.readouterr().err
    for file in ("-", str(output)):
        assert run(["check", str(path), "--dfa", file, "--hz", "30"]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == "at 30 Hz, `F[0s, 3s]` is `F[0, 90]`"
    assert run(["check", str(path), "--dfa", "-", "--hz", "0"]) == 2
    assert run(["check", str(path), "--hz", "30"]) == 2
    assert "--hz is for an automaton; add --dfa FILE" in capsys.readouterr().err
