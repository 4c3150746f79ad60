"""`spatial-replay check`: how a specification is read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spatial_replay.cli import run

SPECIFICATION = """\
region goal = box(0, 0, 4, 4)
spec reach = F[0, 3s] cube enclosedin goal
spec safe = G (not cube ovlp hand)
spec done = reach and safe
"""
LOG = """\
{"time_ns": 0, "objects": [{"name": "cube", "polygon": [[0, 0], [1, 0], [1, 1]]}]}
{"time_ns": 6000000000, "objects": [{"name": "hans", "parts": [{"vertices": [[5, 5]], "radius": 1}]}]}
"""


@pytest.fixture
def specification(tmp_path: Path) -> Path:
    path = tmp_path / "done.spatial"
    path.write_text(SPECIFICATION)
    return path


def test_the_tree_shows_every_node_under_its_id(
    specification: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", str(specification)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "spec done",
        "  0  done = and",
        "  1  ├─ reach = F[0s, 3s]",
        "  2  │  └─ cube enclosedin goal",
        "  3  └─ safe = G",
        "  4     └─ not",
        "  5        └─ cube ovlp hand",
    ]


def test_json_holds_the_same_nodes(specification: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(specification), "--json"]) == 0
    (spec,) = json.loads(capsys.readouterr().out)["specifications"]
    assert spec["name"] == "done"
    assert [(node["id"], node["parent"], node["operator"], node["name"]) for node in spec["nodes"]] == [
        (0, None, "and", "done"),
        (1, 0, "F", "reach"),
        (2, 1, "enclosedin", None),
        (3, 0, "G", "safe"),
        (4, 3, "not", None),
        (5, 4, "ovlp", None),
    ]


def test_every_error_is_shown_with_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    faulty = tmp_path / "faulty.spatial"
    faulty.write_text("spec a = F (x ovlap y)\nspec b = G[5, 2] x ovlp y\n")
    assert run(["check", str(faulty)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "faulty.spatial:1:15: error" in said.err
    assert "faulty.spatial:2:" in said.err
    assert said.err.rstrip().endswith("the specification has 2 errors, shown above")


def test_warnings_go_to_standard_error_and_do_not_change_the_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = tmp_path / "odd.spatial"
    odd.write_text("const unused = 3\nspec a = F x ovlp y\n")
    assert run(["check", str(odd)]) == 0
    said = capsys.readouterr()
    assert "warning" in said.err
    assert "warning" not in said.out


def test_names_are_compared_with_those_in_a_log(
    specification: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "run.jsonl"
    log.write_text(LOG)
    assert run(["check", str(specification), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert "3:30: warning: the log never has the object 'hand'" in output.err
    assert "did you mean 'hans'?" in output.err
    assert output.out.endswith(
        "2 samples of run.jsonl over 6.000 s: 1 name that it never has and 1 other warning\n"
    )
    assert "cube is missing in 1 of 2 samples, first at 6.000 s" in output.err
    assert run(["check", str(specification), "--log", str(log), "--strict-names"]) == 2
    assert "3:30: error: the log never has the object 'hand'" in capsys.readouterr().err
    both = LOG.splitlines()[0].replace("cube", "hand")[len('{"time_ns": 0, "objects": [') :]
    seen = LOG.splitlines()[0].removesuffix("]}")
    log.write_text("\n".join(f"{seen}, {both}".replace(': 0, "o', f': {t}, "o') for t in (0, 6 * 10**9)))
    assert run(["check", str(specification), "--log", str(log), "--strict-names"]) == 0
    assert capsys.readouterr().out.endswith("all names, thresholds and windows fit\n")


def test_a_former_option_of_reading_names_its_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", "drive.bag", "--max-lateness", "5s"]) == 2
    assert "no option --max-lateness; write --read max_lateness=T" in capsys.readouterr().err


def test_a_use_line_chooses_the_profile_instead_of_an_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published = tmp_path / "published.spatial"
    published.write_text("F (a closeto b)")
    assert run(["check", str(published)]) == 2
    capsys.readouterr()
    assert run(["check", str(published), "--profile", "spatial_spec"]) == 2
    said = capsys.readouterr().err
    assert "no option --profile; write `use spatial_spec` in the first line of the specification" in said
    published.write_text("use spatial_spec\nF (a closeto b)")
    assert run(["check", str(published)]) == 0


SLOW = "".join(
    f'{{"time_ns": {500_000_000 * n}, "objects": [{{"name": "cube", "polygon": [[0, 0], [1, 0], [1, 1]]}}, '
    f'{{"name": "crate", "polygon": [[{2 + n / 10}, 0], [3, 0], [3, 1]]}}], '
    f'"signals": {{"battery": 0.{9 - n}, "state": "OK"}}}}\n'
    for n in range(4)
)


def test_with_a_log_windows_in_samples_are_shown_in_seconds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "slow.jsonl", tmp_path / "s.spatial"
    log.write_text(SLOW)
    spec.write_text('spec s "REQ-1: soon" = F[0, 3] (G[1, inf] (battery >= 0.2))')
    assert run(["check", str(spec), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert output.out.startswith('spec s "REQ-1: soon"\n')
    assert "at 2 samples a second, F[0, 3] is 0 s to 1.5 s" in output.out
    assert "G[1, inf] is 0.5 s to the end" in output.out
    assert output.err == ""


def test_with_a_log_a_result_that_its_end_cuts_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "slow.jsonl", tmp_path / "s.spatial"
    log.write_text(SLOW)
    spec.write_text(
        "spec full = F (G[0s, 1s] (battery <= 0.85))\nspec late = F (G[0s, 1s] (battery <= 0.65))\n"
        "spec counted = F (G[0, 4] (battery <= 0.75))\nspec about(x) = F (G[0s, 1s] (x ovlp cube))"
    )
    assert run(["check", str(spec), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert output.err.count("warning") == 3 and "full" not in output.err.replace("spec full", "")
    assert (
        "s.spatial:2:15: warning: late would be satisfied: `G[0s, 1s] (battery <= 0.65)` decides at 1.500 s, "
        "where its window ends 1.000 s after the log (0.000 s of 1.000 s seen)"
    ) in output.err
    assert "window ends 3 samples after the log (2 of 5 samples seen)" in output.err
    assert "all names, thresholds and windows fit" not in output.out


def test_windows_within_each_other_are_added(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, spec = tmp_path / "slow.jsonl", tmp_path / "s.spatial"
    log.write_text(SLOW)
    spec.write_text("spec s = G[0, 2] ((battery >= 0.2) -> F[0s, 1s] (battery >= 0.2))")
    assert run(["check", str(spec), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert "at 2 samples a second, G[0, 2] of F[0s, 1s] reaches 2 s ahead" in output.out
    assert "the windows G[0, 2] of F[0s, 1s] together are longer than this log" in output.err
    assert "they reach 2 s ahead, and the log has 1.500 s, so its end decides" in output.err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("region goal = box(100, 100, 101, 101)\nspec s = F (cube enclosedin goal)", "'goal' is 1"),
        ("spec s = F (cube closeto[-1] cube[-1])", "'closeto' with the negative length -1"),
        ("spec s = F (cube closeto[1000] cube[-1])", "1000 is far more than anything in the log is apart"),
        ("spec s = G (battery >= 20)", "never holds in this log: its signal is never above 0.9"),
        ("spec s = G (battery >= 0.0001)", "always holds in this log: its signal is never below 0.6"),
        ("spec s = G (crate dist cube >= -5)", "always holds in this log: the distance is never below 1"),
        ("spec s = F (crate dist cube < 0.05)", "never holds in this log: the distance is never below 1"),
        ("spec s = F[0s, 60s] (battery <= 0.7)", "F[0s, 60s] is longer than this log"),
        ('spec s = G (state != "FUAL")', 'state is never "FUAL" in this log'),
        ("spec s = G[7, 9] (battery >= 0.7)", "no sample of this log lies in the window G[7, 9]"),
    ],
)
def test_with_a_log_numbers_that_hardly_fit_it_are_warned_of(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "slow.jsonl", tmp_path / "s.spatial"
    log.write_text(SLOW)
    spec.write_text(text)
    assert run(["check", str(spec), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert message in output.err
    assert output.out.endswith("over 1.500 s: 1 warning\n")


def test_with_a_log_the_numbers_behind_each_threshold_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "slow.jsonl", tmp_path / "s.spatial"
    log.write_text(SLOW)
    spec.write_text(
        "spec s = G (battery >= 0.75 or crate dist cube <= 1.5 or 1.05 <= crate dist cube <= 1.25)"
    )
    assert run(["check", str(spec), "--log", str(log), "--json"]) == 0
    *shown, _chained = json.loads(capsys.readouterr().out)["thresholds"]
    assert [(each["atom"], each["holding"], each["known"]) for each in shown] == [
        ("battery >= 0.75", 2, 4),
        ("crate dist cube <= 1.5", 4, 4),
    ]
    assert [each["least"] for each in shown] == pytest.approx([0.6, 1.0])
    assert [each["greatest"] for each in shown] == pytest.approx([0.9, 1.3])
    assert run(["check", str(spec), "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "battery >= 0.75: goes from 0.6 to 0.9, holds in 2 of 4 samples\n" in said
    assert "1.05 <= crate dist cube <= 1.25: goes from 1 to 1.3, holds in 2 of 4 samples\n" in said


def test_thresholds_of_open_groups_and_templates_are_compared_over_their_objects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "crossing.jsonl", tmp_path / "s.spatial"
    # the van comes 1 closer with each sample, and the bus is gone in the last
    log.write_text(
        "".join(
            json.dumps(
                {
                    "time_ns": 10**9 * n,
                    "objects": [
                        {"name": name, "class": kind, "polygon": [[x, 0], [x + 1, 0], [x + 1, 1], [x, 1]]}
                        for name, kind, x in (
                            ("walker", "person", 0),
                            ("van", "car", 9 - n),
                            ("bus", "car", 3),
                        )
                        if name != "bus" or n < 3
                    ],
                }
            )
            + "\n"
            for n in range(4)
        )
    )
    spec.write_text(
        'group people = class "person"\ngroup cars = class "car"\n'
        "spec seen = F exists c in cars: c dist walker <= 6.5\n"
        "spec pairs = G forall p in people: exists c in cars: p dist c >= 0.01\n"
        "spec clear(ego) = G forall c in cars except ego: ego dist c >= 60\n"
    )
    assert run(["check", str(spec), "--log", str(log), "--json"]) == 0
    output = capsys.readouterr()
    seen, pairs, clear = json.loads(output.out)["thresholds"]
    assert (seen["objects"], seen["least"], seen["greatest"]) == ("c in cars", 2.0, 8.0)
    # for all cars from the third sample on, for none of them in no sample
    assert (seen["known"], seen["holding"], seen["failing"]) == (4, 2, 0)
    assert (pairs["objects"], pairs["holding"], pairs["known"]) == ("p in people, c in cars", 4, 4)
    assert (clear["objects"], clear["least"]) == ("ego in all, c in cars except ego", 2.0)
    assert "`p dist c >= 0.01 for p in people, c in cars` always holds in this log" in output.err
    assert "`ego dist c >= 60 for ego in all, c in cars except ego` never holds" in output.err
    assert run(["check", str(spec), "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "for c in cars: goes from 2 to 8, holds for all in 2 and for none in 0 of 4 samples\n" in said


def test_an_empty_group_holds_and_rates_are_known_where_a_log_is_read_in_parts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "long.jsonl", tmp_path / "s.spatial"
    box = [[0, 0], [1, 0], [1, 1], [0, 1]]
    walker = {"name": "walker", "class": "person", "polygon": box}
    # long enough to be read in several blocks
    lines = (
        {"time_ns": 10**7 * n, "objects": [walker] if n < 5 else [], "signals": {"x": 0.01 * n}}
        for n in range(20_001)
    )
    log.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    spec.write_text(
        "region lane = box(3, 0, 9, 1)\n"
        "spec steady = G (rate(x) <= 3)\n"
        'spec clear = G forall p in class "person": p dist lane >= 1\n'
        'spec none = G forall c in class "car": c dist lane >= 1\n'
    )
    assert run(["check", str(spec), "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "rate(x) <= 3: goes from 1 to 1, is unknown in 1 of 20,001 samples" in said
    clear = 'p dist lane >= 1 for p in class "person": goes from 2 to 2, has no object, and so is +inf,'
    assert f"{clear} in 19,996 of 20,001 samples, always holds in the others" in said
    none = 'c dist lane >= 1 for c in class "car": has no object, and so is +inf, in every sample'
    assert none in said
    assert run(["check", str(spec), "--log", str(log), "--json"]) == 0
    counts = [(each["known"], each["empty"]) for each in json.loads(capsys.readouterr().out)["thresholds"]]
    assert counts == [(20_000, 0), (5, 19_996), (0, 20_001)]


def test_a_class_that_a_log_never_has_does_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, spec = tmp_path / "run.jsonl", tmp_path / "s.spatial"
    box = {"name": "cup", "class": "dish", "polygon": [[0, 0], [1, 0], [1, 1]]}
    log.write_text("".join(json.dumps({"time_ns": n * 10**8, "objects": [box]}) + "\n" for n in range(3)))
    spec.write_text('spec s = G (forall p in class "Dish": p leftof cup)\n')
    assert run(["check", str(spec), "--log", str(log)]) == 0
    assert "all names, thresholds and windows fit" in capsys.readouterr().out
    spec.write_text('spec s = G (forall p in class "person": p leftof cup)\n')
    assert run(["check", str(spec), "--log", str(log)]) == 0
    output = capsys.readouterr()
    assert "no object of class 'person' is ever in this log" in output.err
    assert "its classes are dish" in output.err


def test_errors_are_marked_at_their_lines_for_github_and_for_code_scanning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "done.spatial"
    path.write_text("spec a = G (cube ovlp hand)\nspec b = F (cube enclosedinn goal)\n")
    assert run(["check", str(path), "--format", "github"]) == 2
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"::error file={path},line=2,col=18::")
    assert "did you mean 'enclosedin'" in line
    assert run(["check", str(path), "--format", "sarif"]) == 2
    (found,) = json.loads(capsys.readouterr().out)["runs"][0]["results"]
    place = found["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"] == path.as_posix()
    assert (place["region"]["startLine"], place["region"]["startColumn"]) == (2, 18)
    path.write_text("spec a = G (cube ovlp hand)")
    assert run(["check", str(path), "--format", "sarif"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["results"] == []
    assert run(["check", str(path), "--format", "github", "--json"]) == 2


@pytest.mark.parametrize(
    ("text", "caret", "remedy"),
    [
        ("always[0:5] (battery >= 1)", "[0:5]", "G[0, 5] for samples, G[0s, 5s] for seconds"),
        ("eventually[0,4] (battery >= 1)", "[0,4]", "F[0, 4] for samples, F[0s, 4s] for seconds"),
        ("G_[0,5] (battery >= 1)", "[0,5]", "G[0, 5] for samples, G[0s, 5s] for seconds"),
        ("G[2:inf] (battery >= 1)", "[2:inf]", "G[2, inf] for samples, G[2s, inf] for seconds"),
        ("(a ovlp b) U_[0,5] (battery >= 1)", "[0,5]", "U[0, 5] for samples, U[0s, 5s] for seconds"),
        ("G[0,5) (battery >= 1)", ")", "G[0, 5]"),
        ("region r = circle(0, 0, 1)\nspec s = F (a ovlp r)", "0", "circle((0, 0), 1)"),
        ("region r = rect(0, 0, 1, 1)\nspec s = F (a ovlp r)", "rect", "box(xmin, ymin, xmax, ymax)"),
        ("region r = box((0,0),(1,-1))\nspec s = F (a ovlp r)", ",", "box(0, 0, 1, -1)"),
        ("region r = polygon(0,0, 1,1, 2,3)\nspec s = F (a ovlp r)", "0", "polygon((0, 0), (1, 1), (2, 3))"),
        ("G (x[t] >= 1)", "t", "leave [t] out"),
        ("const d = 5\nspec s = G (a dist b >= D)", "D", "did you mean 'd'?"),
        ("const most = 5\nspec s = G (speed(a) <= mots)", "mots", "did you mean 'most'?"),
        ("keep = 0.5\nspec s = G (a dist b >= keep)", "keep", "const keep = 0.5"),
        ("let keep = 0.5\nspec s = G (a dist b >= keep)", "let", "const keep = 0.5"),
        ("let keep = 0.5\nG (a dist b >= keep)", "keep", "const keep = 0.5"),
        ("out = always (battery >= 1)", "=", "spec out = G (battery >= 1)"),
        ("float battery\nout = always (battery >= 1)", "battery", "leave the line out"),
        ("input float battery\nspec s = G (battery >= 1)", "input", "leave the line out"),
        ("G (rise(p) -> a ovlp b)", "rise", "(Y not (p)) and (p)"),
        ("G (fell(battery >= 1) -> a ovlp b)", ">=", "(Y (battery >= 1)) and not (battery >= 1)"),
        ("(a ovlp b) ~> (c ovlp d)", "~>", "G (p -> F (q))"),
        (r"\A p \in people : p ovlp b", r"\A", "write forall p in people: ..."),
        ("G (base-link dist cup >= 1)", "-", '"base-link"'),
        ("G (cup dist base-link >= 1)", "-", '"base-link"'),
        ("spec s = G (cup dist base-group >= 1)", "group", '"base-group"'),
        ("spec s = a-group ovlp b", "group", '"a-group"'),
        ("G (a ovlp b) -- comment", "-- comment", "a comment begins with #"),
        ("battery and G (a ovlp b)", "battery", "battery >= 1.0"),
        ("after 5s (a ovlp b)", "5s", "G[5s, inf]"),
        ("F (a ovlp b) within 5s", "within", "F[0s, 5s]"),
    ],
)
def test_spellings_of_other_tools_get_the_one_that_is_meant(
    text: str, caret: str, remedy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.spatial"
    path.write_text(text)
    assert run(["check", str(path)]) == 2
    head, line, mark, hint, *_ = capsys.readouterr().err.splitlines()
    assert head.startswith(f"error: {path.name}:") or f"{path.name}:" in head
    assert line[mark.index("^") : mark.rindex("^") + 1] == caret
    assert remedy in hint


@pytest.mark.parametrize(
    ("text", "title"),
    [
        ("G (0.1 <= charge)", "charge >= 0.1"),
        ("G (0.1 <= cup dist plate)", "cup dist plate >= 0.1"),
        ("G (2 == mode)", "mode == 2"),
        ("const low = 3\nspec s = G (low < charge)", "charge > 3"),
        ("always[0s:5s] (charge >= 1)", "G[0s, 5s]"),
        ("G_[0s, 5s] (charge >= 1)", "G[0s, 5s]"),
    ],
)
def test_spellings_that_mean_the_same_are_read(
    text: str, title: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "other.spatial"
    path.write_text(text)
    assert run(["check", str(path)]) == 0
    assert title in capsys.readouterr().out


def test_a_formula_stands_in_place_of_a_file_and_a_mapping_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text(LOG)
    assert run(["replay", str(log), "--spec", "F (cube dist hans <= 1)"]) in (1, 4)
    assert "spec" in capsys.readouterr().out
    assert run(["replay", str(log), "--spec", "F near"]) == 2
    assert "no spec is named 'near'" in capsys.readouterr().err
    assert run(["check", "--spec", str(log)]) == 2
    assert "check FILE takes the specification without it" in capsys.readouterr().err
    mapping = tmp_path / "own.yaml"
    mapping.write_text("topics: {}\n")
    assert run(["replay", str(log), "--spec", str(mapping)]) == 2
    assert "own.yaml is YAML, not a specification; give a mapping by --mapping" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("formula", "pair"),
    [
        ("F G (load >= 1)", "F G"),
        ("G[0, inf] (F load >= 1)", "G F"),
        ("F ((G[0s, 2s] load >= 1) and (F[2s, inf] true))", ""),
        ("F ((G load >= 1) and (F[2s, inf] true))", ""),
        ("F[0s, 9s] G load >= 1", ""),
        ("G F[0s, 9s] load >= 1", ""),
        ("G ((F[0s, 9s] load >= 1) or not (F[9s, inf] true))", ""),
    ],
)
def test_formulas_about_the_last_sample_alone_are_warned_of(
    formula: str, pair: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", formula]) == 0
    said = capsys.readouterr().err
    assert ("asks for the last sample of a log alone" in said) == bool(pair)
    if pair:
        remedy = {"F G": "F ((G[0s, 2s] p) and (F[2s, inf] true))", "G F": "for again and again"}[pair]
        assert f"`{pair} p` asks" in said and remedy in said
