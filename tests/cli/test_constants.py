"""Constants given on the command line, and the recorded text that says which were used."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from spatial_replay.cli import run

RECORDINGS = Path(__file__).parent.parent.parent / "recordings"
LOG, SPEC = RECORDINGS / "table.jsonl", RECORDINGS / "table.spatial"
WIDE = ("--const", "near=0.3", "--const", "deadline=4s")
RELATED = (
    "# related\nconst near = 0.08 in [0, 3] # m\nconst far = 2 * near\nspec s = G (cup dist plate <= far)\n"
)


def _json(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, object]]:
    capsys.readouterr()
    code = run([*map(str, arguments), "--json", "-"])
    return code, json.loads(capsys.readouterr().out)


def _call(*arguments: str | Path) -> int:
    return run(list(map(str, arguments)))


def _edited(folder: Path) -> Path:
    """Return the specification with the values of `WIDE` typed into it."""
    text = SPEC.read_text().replace("near = 0.08", "near = 0.3").replace("deadline = 8s", "deadline = 4s")
    (folder / "table.spatial").write_text(text)
    return folder / "table.spatial"


def test_a_constant_given_equals_one_that_is_typed_into_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = _json(capsys, "replay", LOG, "--spec", SPEC, *WIDE)
    assert given == _json(capsys, "replay", LOG, "--spec", _edited(tmp_path))
    assert given[1] != _json(capsys, "replay", LOG, "--spec", SPEC)[1]


def test_an_annotated_log_says_the_values_used_and_reproduces_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    annotated = tmp_path / "annotated.mcap"
    assert _call("replay", LOG, "--spec", SPEC, *WIDE, "-o", annotated) == 0
    capsys.readouterr()
    assert _call("info", annotated, "--specification") == 0
    printed = capsys.readouterr().out
    assert printed == _edited(tmp_path).read_text(), "comments, names and layout are those of the file"
    _, again = _json(capsys, "replay", annotated)
    _, first = _json(capsys, "replay", LOG, "--spec", SPEC, *WIDE)
    assert again["specifications"] == first["specifications"]
    assert _call("verify", annotated) == 0


def test_the_recorded_specification_is_evaluated_with_other_constants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = tmp_path / "run.mcap"
    assert _call("record", "tracks", LOG, "--spec", SPEC, "-o", recorded) == 0
    code, _ = _json(capsys, "replay", recorded, "--const", "near=0.01")
    assert code == 1


def test_a_recording_holds_the_values_it_was_made_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = tmp_path / "run.mcap"
    assert _call("record", "tracks", LOG, "--spec", SPEC, *WIDE, "-o", recorded) == 0
    capsys.readouterr()
    assert _call("info", recorded, "--specification", "laid") == 0
    assert capsys.readouterr().out == _edited(tmp_path).read_text()


def test_a_constant_that_is_computed_from_another_follows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s.spatial").write_text(RELATED)
    annotated = tmp_path / "annotated.mcap"
    _call("replay", LOG, "--spec", tmp_path / "s.spatial", "--const", "near=2", "-o", annotated)
    capsys.readouterr()
    assert _call("info", annotated, "--specification") == 0
    assert capsys.readouterr().out == RELATED.replace("0.08", "2")


def test_of_several_files_each_takes_the_constants_that_it_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.spatial").write_text(f"const near = 0\nspec {name} = G (cup dist plate >= near)")
    files = ("--spec", tmp_path / "one.spatial", "--spec", tmp_path / "two.spatial")

    def verdicts(*constants: str) -> list[str]:
        options = [part for each in constants for part in ("--const", each)]
        _, document = _json(capsys, "replay", LOG, *files, *options)
        specifications = document["specifications"]
        assert isinstance(specifications, list)
        return [each["verdict"] for each in specifications]

    assert verdicts() == ["satisfied", "satisfied"]
    assert verdicts("near=9") == ["violated", "violated"]
    assert verdicts("two.near=9") == ["satisfied", "violated"]
    assert verdicts("near=9", "one.near=0") == ["satisfied", "violated"]


@pytest.mark.parametrize(
    "command",
    [
        ("check", SPEC),
        ("explain", LOG, "--spec", SPEC),
        ("report", LOG, "--spec", SPEC, "-o", "page.html"),
        ("serve", LOG, "--spec", SPEC, "--layout"),
        ("record", "tracks", LOG, "--spec", SPEC, "-o", "run.mcap"),
    ],
)
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("neer=80", "there is no constant 'neer'; did you mean 'near'?"),
        ("near", "--const: 'near' is incomplete; write NAME=VALUE, such as near=80 or hold=2s"),
        ("near=", "'near=' is incomplete"),
        ("near=wide", "'wide'"),
    ],
)
def test_a_constant_that_cannot_be_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: Sequence[str | Path],
    given: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert _call(*command, "--const", given) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_constant_is_given_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert _call("check", SPEC, "--const", "near=1", "--const", "near=2") == 2
    assert "'near' is given twice; give one value" in capsys.readouterr().err


def test_a_specification_that_was_not_recorded_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    annotated = tmp_path / "annotated.mcap"
    _call("replay", LOG, "--spec", SPEC, "-o", annotated)
    capsys.readouterr()
    assert _call("info", annotated, "--specification", "lad") == 2
    assert "has no specification 'lad'; files: table.spatial; specs: safe, plate_first, laid" in (
        capsys.readouterr().err
    )
    assert _call("info", LOG, "--specification") == 2
    assert "table.jsonl holds no specification" in capsys.readouterr().err


def test_info_reports_no_error_where_a_spec_has_no_automaton(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    annotated = tmp_path / "annotated.mcap"
    _call("replay", LOG, "--spec", SPEC, "-o", annotated)
    capsys.readouterr()
    assert _call("info", annotated) == 0
    printed = capsys.readouterr().out
    assert "table_set  none: `F[0s, 8s]` counts seconds, an automaton counts samples\n" in printed
    assert "error" not in printed
