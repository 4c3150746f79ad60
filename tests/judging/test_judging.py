"""Judging: rates and agreement with labels, what is undecided, pages, exit codes, and what bad labels get."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import spatial_replay as sr
from batch.fleet import command, write_fleet, write_log
from spatial_replay.judging import statistics

DISTANCES = [0.5, 0.4, 0.2, 0.1]
"""Of which two keep 0.3 m."""


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four logs; their labels agree on two of them."""
    write_fleet(tmp_path, DISTANCES)
    (tmp_path / "gate.spatial").write_text("spec apart = G (cart dist person >= 0.3)\n")
    write_labels(tmp_path / "logs/labels.json", [True, False, True, False])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_labels(file: Path, labels: list[bool]) -> None:
    entries = [{"log": f"run-{number}.jsonl", "success": label} for number, label in enumerate(labels)]
    file.write_text(json.dumps(entries))


def judge(*arguments: str, code: int = 0) -> str:
    """Judge in this process, and return what is printed."""
    ended = command("judge", "logs", "--spec", "gate.spatial", "--jobs", "1", *arguments)
    assert ended.code == code, ended.out + ended.err
    return ended.out + ended.err


@pytest.mark.parametrize(
    ("folder", "formula", "counts"),
    [
        ("push", "F (G (d3 <= 0.05))", (27, 6, 0, 27)),
        ("push", "F (d3 <= 0.05)", (33, 0, 0, 27)),
        ("pick-place", "F (G (d3 <= 0.07))", (32, 6, 0, 22)),
        ("pick-place", "F (d3 <= 0.07)", (38, 0, 0, 22)),
        ("cubes", "F (G (d3 <= 0.04))", (5, 1, 0, 10)),
        ("cubes", "F (d3 <= 0.04)", (6, 0, 0, 10)),
    ],
)
def test_episodes_of_others_agree_as_counted(
    data_folder: Path, tmp_path: Path, folder: str, formula: str, counts: tuple[int, ...]
) -> None:
    (tmp_path / "task.spatial").write_text(f"spec task = {formula}\n")
    judgement = sr.judge(data_folder / "episodes" / folder, tmp_path / "task.spatial")
    agreement = judgement.agreement
    assert (agreement.both, agreement.only_theirs, agreement.only_ours, agreement.neither) == counts
    assert judgement.label_rate == (counts[0] + counts[1], sum(counts))


def test_numbers_are_those_of_scipy_and_statsmodels(data_folder: Path) -> None:
    known = json.loads((data_folder / "vectors/statistics.json").read_text())
    for case in known["intervals"]:
        assert statistics.Rate(case["k"], case["n"]).interval == pytest.approx(case["wilson"], abs=1e-9)
    for case in known["mcnemar"]:
        p = statistics.mcnemar_p(case["only_a"], case["only_b"])
        assert p == pytest.approx(case["exact"], abs=1e-9)
    for case in known["more_pairs"]:
        assert statistics.more_pairs(case["only_a"], case["only_b"], case["pairs"]) == case["more"]
    for case in known["sequential_e_value"]:
        evidence = statistics.e_value(case["only_a"], case["only_b"])
        assert evidence == pytest.approx(case["e_value"], rel=1e-9)
    for case in known["pass_k"]:
        value = statistics.pass_hat_k(case["k_successes"], case["n"], case["k"])
        assert value == pytest.approx(case["pass_hat_k"], abs=1e-9)
    margins = known["margins"]
    assert statistics.wilcoxon(margins["a"], margins["b"]) == pytest.approx(margins["wilcoxon"], abs=1e-9)


def test_both_rates_and_each_disagreement_are_printed(fleet: Path) -> None:
    text = judge()
    assert "ours      2 of 4  50 %   15 to 85\nlabel     2 of 4  50 %   15 to 85\n" in text
    assert re.search(r"agreement 2 of 4 +both 1, only the label 1, only ours 1, neither 1\n", text)
    assert re.search(r"only the label counts 1:\n  run-2  .*cart and person are 0.2 apart", text)
    assert re.search(r"only the verdict counts 1:\n  run-1  ", text)
    line = re.search(r"spatial-replay (explain .*)", text)
    assert line is not None
    assert command(*line[1].split()).code in (0, 1)
    # a second run evaluates nothing, and prints the same
    assert judge() == text


def test_json_and_a_data_frame_have_a_row_for_each_episode(fleet: Path) -> None:
    document = json.loads(judge("--json", "-"))
    assert document["agreement"]["only_theirs"] == document["agreement"]["only_ours"] == 1
    assert (document["episodes"], document["rate"], document["label_rate"]) == (4, 0.5, 0.5)
    assert document["interval"] == pytest.approx([0.15003898915214947, 0.8499610108478506])
    row = document["rows"][2]
    assert (row["episode"], row["label"], row["verdict"], row["tested"]) == (
        "run-2",
        True,
        "violated",
        "full",
    )
    assert row["margin"] == pytest.approx(-0.1)
    assert (row["success_at"], row["agreement"]) == (None, "only_theirs")
    frame = sr.judge("logs", "gate.spatial").to_pandas()
    assert list(frame.columns) == list(row)
    assert frame["verdict"].tolist() == ["satisfied", "satisfied", "violated", "violated"]
    assert not Path("apart.results").exists()


def test_the_page_begins_with_disagreements_and_reports_them_alone(fleet: Path) -> None:
    judge("--html", "pages")
    assert sorted(path.name[:10] for path in Path("pages/reports").iterdir()) == ["logs-run-1", "logs-run-2"]
    page = Path("pages/index.html").read_text()
    matrix = page[page.index('id="matrix"') :]
    places = [matrix.index(f"run-{number}.jsonl") for number in range(4)]
    assert max(places[1:3]) < min(places[0], places[3])
    assert "success, only theirs" in matrix


def test_unreadable_and_untested_episodes_are_undecided_and_not_failures(fleet: Path) -> None:
    Path("logs/run-3.jsonl").write_text("{")
    judge("--json", "judged.json")
    document = json.loads(Path("judged.json").read_text())
    assert (document["decided"], document["agreement"]["undecided"]) == (3, 1)
    assert document["rate"] == pytest.approx(2 / 3)
    assert "undecided 1:\n  run-3  " in judge()
    write_log(Path("logs/run-3.jsonl"), 0.1)
    Path("gate.spatial").write_text("spec apart = G (cart dist person <= 0 -> cart dist person >= 0.3)\n")
    assert "ours      0 of 0  no rate" in judge(code=4)


def test_a_least_rate_is_compared_with_the_lower_end_of_the_interval(fleet: Path) -> None:
    judge("--at-least", "0.15")
    judge("--at-least", "0.16", code=1)
    # Wilson's lower end is 9 % for one of four, 15 % for two, 30 % for three
    Path("logs/run-0.jsonl").write_text("{")
    assert "1 episode undecided or unstored leave" in judge("--at-least", "0.12", code=4)
    judge("--at-least", "0.2", code=1)
    judge("--at-least", "0.04")


def test_the_last_spec_judges_unless_another_one_is_named(fleet: Path) -> None:
    Path("gate.spatial").write_text(
        "spec near = cart dist person <= 1\nspec never = G not near\nspec once = F near\n"
    )
    assert "judged by `once`" in judge()
    assert "judged by `never`" in judge("--result", "never")
    assert "did you mean 'never'?" in judge("--result", "nevr", code=2)
    assert "add `spec judged = near`" in judge("--result", "near", code=2)


def test_labels_in_a_table_elsewhere_count_instead(fleet: Path) -> None:
    Path("all.csv").write_text(
        "episode,success\n" + "".join(f"logs/run-{number},{number < 2}\n" for number in range(4))
    )
    assert "agreement 4 of 4" in judge("--labels", "all.csv")
    Path("logs/labels.json").unlink()
    assert "agreement" not in judge()


def test_labels_that_are_all_successes_are_remarked(fleet: Path) -> None:
    write_labels(Path("logs/labels.json"), [True] * 4)
    assert "all 4 labels are successes" in judge()


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ('[{"log": "run-9.jsonl", "success": true}]', "no judged episode is named 'run-9.jsonl'"),
        ('[{"log": "run-0.jsonl", "success": 2}]', "entry 1: success is '2'; write true or false"),
        ('[{"log": "run-0.jsonl"}]', "it has no 'success'; it has log"),
        ('[{"success": true}]', "it names no episode"),
        (
            '[{"log": "run-0", "success": true}, {"log": "run-0.jsonl", "success": true}]',
            "entry 2: entry 1 labels this episode already",
        ),
        (
            '[{"log": "run-0", "success": 1, "frame": 0}, {"log": "run-0", "success": 1, "frame": 1}]',
            "a label for each frame ('frame')",
        ),
        ("{}", "is no list of objects"),
        ("[", "is not JSON"),
    ],
)
def test_bad_labels_are_refused_with_the_place_and_the_remedy(fleet: Path, labels: str, message: str) -> None:
    Path("logs/labels.json").write_text(labels)
    assert message in judge(code=2)


def test_a_field_of_labels_needs_a_data_set(fleet: Path) -> None:
    assert "--labels next.success: no such file" in judge("--labels", "next.success", code=2)
    assert "missing.json" in judge("--labels", "missing.json", code=2)
