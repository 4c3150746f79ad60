"""Judging: rates and agreement with labels, what is undecided, pages, exit codes, and what bad labels get."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import spatial_replay as sr
from batch.fleet import command, write_fleet, write_log
from spatial_replay.annotate.stages import stages
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
    ("folder", "limit", "staying", "reaching"),
    [
        ("push", 0.05, (27, 6, 0, 27), (33, 0, 0, 27)),
        ("pick-place", 0.07, (32, 6, 0, 22), (38, 0, 0, 22)),
        ("cubes", 0.04, (5, 1, 0, 10), (6, 0, 0, 10)),
    ],
)
def test_episodes_of_others_agree_as_counted(
    data_folder: Path,
    tmp_path: Path,
    folder: str,
    limit: float,
    staying: tuple[int, ...],
    reaching: tuple[int, ...],
) -> None:
    specification, episodes = tmp_path / "task.spatial", data_folder / "episodes" / folder
    specification.write_text(f"spec stays = F (G (d3 <= {limit}))\nspec reached = F (d3 <= {limit})\n")
    for result, counts in {"stays": staying, "reached": reaching}.items():
        judgement = sr.judge(episodes, specification, result=result, output=tmp_path / "results")
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
    assert "--at-least 0.12 depends on 1 undecided or unstored episode" in judge("--at-least", "0.12", code=4)
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


def test_labels_next_to_other_logs_of_the_same_names_are_refused(fleet: Path) -> None:
    shutil.copytree(fleet / "logs", fleet / "elsewhere")
    text = judge("--labels", "elsewhere/labels.json", code=2)
    assert "entry 1: 'run-0.jsonl' is the log next to this file, not logs/run-0.jsonl" in text
    assert "entry 4" in text


def test_a_field_of_labels_needs_a_data_set(fleet: Path) -> None:
    assert "--labels next.success: no such file" in judge("--labels", "next.success", code=2)
    assert "missing.json" in judge("--labels", "missing.json", code=2)


def test_a_table_of_labels_has_true_and_false_and_leaves_undecided_episodes_out(fleet: Path) -> None:
    Path("logs/run-3.jsonl").write_text("{")
    judge("--write-labels", "labels.parquet")
    rows = pq.read_table("labels.parquet").to_pylist()
    assert [(row["episode"], row["episode_idx"], row["success"]) for row in rows] == [
        ("run-0", 0, True),
        ("run-1", 1, True),
        ("run-2", 2, False),
    ]
    assert rows[0]["policy_id"] == "logs"
    assert not {"seed", "task"} & rows[0].keys()
    judge("--write-labels", "labels.csv")
    frame = pandas.read_csv("labels.csv")
    assert frame["success"].tolist() == [True, True, False]
    assert frame["margin"].tolist() == pytest.approx([0.2, 0.1, -0.1])
    assert "ends in .parquet or .csv" in judge("--write-labels", "labels.txt", code=2)
    Path("all.csv").write_text("log,success\nlogs/run-0,true\n")
    assert "is an input" in judge("--labels", "all.csv", "--write-labels", "all.csv", code=2)


PUSH = """\
unit: m
features:
  observation.environment_state:
    - {name: puck, position: [puck_x, puck_y, puck_z], shape: puck}
    - {name: goal, position: [goal_x, goal_y, goal_z], shape: puck}
shapes: {puck: {disc: 0.02, height: [-0.02, 0.02]}}
"""


@pytest.fixture
def push(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the LeRobot data sets of a pushed puck, a mapping and a specification."""
    for folder in (data_folder / "learning/lerobot").iterdir():
        if folder.is_dir():
            shutil.copytree(folder, tmp_path / folder.name, copy_function=shutil.copyfile)
    for folder in tmp_path.rglob(""):
        folder.chmod(0o755)
    (tmp_path / "push.yaml").write_text(PUSH)
    (tmp_path / "push.spatial").write_text("spec reached = F (center(puck) dist center(goal) <= 0.05)\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def judge_set(name: str, *arguments: str, code: int = 0) -> str:
    options = ("--mapping", "push.yaml", "--spec", "push.spatial", "--jobs", "1", *arguments)
    ended = command("judge", name, *options)
    assert ended.code == code, ended.out + ended.err
    return ended.out + ended.err


@pytest.mark.parametrize("name", ["push_v3", "push_v21", "push_v3_thirdparty"])
@pytest.mark.usefixtures("push")
def test_labels_of_a_data_set_are_its_own(name: str) -> None:
    document = json.loads(judge_set(name, "--json", "-"))
    assert (document["agreement"]["both"], document["agreement"]["neither"]) == (2, 2)
    assert [row["episode"] for row in document["rows"]] == [f"{name}#{number}" for number in range(4)]
    assert document["rows"][1]["task"] == ("push" if "third" in name else "slide the puck onto the red mark")
    assert document["pass_k"] == {}


@pytest.mark.usefixtures("push")
def test_successes_after_the_last_frame_are_unstored_and_no_disagreements() -> None:
    text = judge_set("push_v3_stopped")
    assert "ours      0 of 4" in text
    assert "2 of 4  50 %   15 to 85   if the 2 unstored count" in text
    assert re.search(r"agreement 2 of 2 .*neither 2, unstored 2\n", text)
    assert "which is not in the data; 3.8 mm were missing" in text
    text = judge_set("push_v3_stopped", "--against", "push_v3_stopped")
    line = "2 of 4  50 %   15 to 85   if the 2 unstored count"
    assert re.search(rf"against   0 of 4 .*\n +{line}\n", text)
    judge_set("push_v3_stopped", "--at-least", "0.1", code=4)
    judge_set("push_v3_stopped", "--at-least", "0.2", code=1)


@pytest.mark.usefixtures("push")
def test_one_reason_of_several_episodes_is_printed_once() -> None:
    ended = command("judge", "push_v3", "--spec", "push.spatial", "--jobs", "1")
    assert ended.code == 2
    assert ended.out.count("--suggest-mapping") == 1
    assert "undecided 4:\n  push_v3#0, push_v3#1, push_v3#2, push_v3#3  push_v3 is a LeRobot" in ended.out


@pytest.mark.usefixtures("push")
def test_a_field_or_a_file_gives_the_labels_instead() -> None:
    assert "label     4 of 4" in judge_set("push_v3", "--labels", "next.done")
    assert "did you mean 'next.success'?" in judge_set("push_v3", "--labels", "next.succes", code=2)
    Path("push.yaml").write_text(f"label: next.done\n{PUSH}")
    assert "label     4 of 4" in judge_set("push_v3")
    Path("mine.csv").write_text("episode,success\n0,0\n1,0\n2,1\n3,0\n")
    assert "agreement 3 of 4" in judge_set("push_v3", "--labels", "mine.csv")
    Path("mine.csv").write_text("episode,success\n0,1\n1,1\n")
    info = Path("push_v3/meta/info.json")
    description = json.loads(info.read_text()) | {"total_episodes": 9}
    info.write_text(json.dumps(description))
    text = judge_set("push_v3", "--labels", "mine.csv")
    assert "label     2 of 2" in text and "without a label 2" in text
    assert "push_v3: meta/info.json says 9 episodes, and meta has 4" in text
    info.write_text(json.dumps(description | {"codebase_version": "v1.6"}))
    assert "push_v3 is LeRobot v1.6; v2.0 to v3.x are read" in judge_set("push_v3", code=2)


@pytest.mark.usefixtures("push")
def test_labels_of_other_episodes_are_refused() -> None:
    Path("other").mkdir()
    Path("other/000.jsonl").write_text("")
    write = Path("other/labels.json").write_text
    for entries in ([], [{"log": "000.jsonl", "success": True}]):
        write(json.dumps(entries))
        text = judge_set("push_v3", "--labels", "other/labels.json", code=2)
        assert "--labels other/labels.json: it has no entry for a judged episode" in text


@pytest.mark.usefixtures("push")
def test_a_data_set_that_cannot_be_opened_is_reported_before_labels() -> None:
    Path("one.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 99)
    Path("labels.json").write_text('[{"episode": 0, "success": true}]')
    assert "one.hdf5 cannot be read" in judge_set("one.hdf5", code=3)


@pytest.mark.usefixtures("push")
def test_a_shaped_reward_is_no_label() -> None:
    text = judge_set("push_v3", "--labels", "next.reward", code=2)
    assert re.search(r"push_v3: next\.reward is no label: it has 0\.\d+; a label has 0 and 1", text)


@pytest.mark.usefixtures("push")
def test_a_data_set_is_copied_with_its_verdicts_for_training() -> None:
    files = {path: path.read_bytes() for path in Path("push_v3").rglob("*") if path.is_file()}
    judge_set("push_v3", "--annotate", "new")
    assert all(path.read_bytes() == data for path, data in files.items())
    table = pq.read_table("new/meta/episodes/chunk-000/file-000.parquet")
    assert table["judge/success"].to_pylist() == [True, False, True, False]
    assert table["judge/success_at"].null_count == 2
    assert "reached = F (" in table["judge/spec"][0].as_py()
    old = pq.read_table("push_v3/meta/episodes/chunk-000/file-000.parquet")
    assert table.select(old.column_names).equals(old)
    # the copy is a data set, which is judged as the original
    assert "agreement 4 of 4" in judge_set("new")
    assert "it exists" in judge_set("push_v3", "--annotate", "new", code=2)
    judge_set("new", "--result", "reached", "--annotate", "newer")
    assert pq.read_schema("newer/meta/episodes/chunk-000/file-000.parquet").names == table.column_names
    judge_set("push_v3_stopped", "--annotate", "stopped")
    table = pq.read_table("stopped/meta/episodes/chunk-000/file-000.parquet")
    assert table["judge/success"].to_pylist() == [None, False, None, False]
    # an episode that is not judged has no label
    judge_set("push_v3#2", "--annotate", "one")
    table = pq.read_table("one/meta/episodes/chunk-000/file-000.parquet")
    assert table["judge/success"].to_pylist() == [None, None, True, None]
    assert table["judge/spec"].null_count == 3


@pytest.mark.usefixtures("push")
def test_a_copy_has_the_stage_of_each_frame() -> None:
    Path("stages.spatial").write_text(
        "spec close = center(puck) dist center(goal) <= 0.1\n"
        "spec there = center(puck) dist center(goal) <= 0.05\n"
        "spec task = F (close and F (G there))\n"
    )
    options = ("--spec", "stages.spatial", "--mapping", "push.yaml", "--stages")
    files = {path: path.read_bytes() for path in Path("push_v3").rglob("*") if path.is_file()}
    assert command("judge", "push_v3", *options, "--annotate", "new").code == 0
    assert all(path.read_bytes() == data for path, data in files.items())
    file = "data/chunk-000/file-000.parquet"
    old, new = pq.read_table(f"push_v3/{file}"), pq.read_table(f"new/{file}")
    assert new.select(old.column_names).cast(old.schema).equals(old)
    assert pq.ParquetFile(f"new/{file}").num_row_groups == pq.ParquetFile(f"push_v3/{file}").num_row_groups
    names = pandas.read_parquet("new/meta/subtasks.parquet").index.tolist()
    assert names[:3] == ["never close", "close, not there", "there"]
    info = json.loads(Path("new/meta/info.json").read_text())["features"]
    assert {info[name]["dtype"] for name in ("subtask_index", "judge.progress", "language_persistent")} == {
        "int64",
        "float32",
        "language",
    }
    for number in range(4):
        evaluation = sr.evaluate(
            sr.load_specification("stages.spatial"), sr.read_trace(f"push_v3#{number}", mapping="push.yaml")
        )
        run, frames = stages(evaluation), new.filter(pc.equal(new["episode_index"], number)).to_pylist()
        assert [names[frame["subtask_index"]] for frame in frames] == [
            run[sample].name for sample in range(len(frames))
        ]
        np.testing.assert_allclose([frame["judge.progress"] for frame in frames], run.progress, rtol=1e-6)
        # a row holds from its time on, until the next one
        rows = frames[0]["language_persistent"]
        assert len(rows) > 1 or number in (1, 3)
        for frame in frames:
            assert frame["language_persistent"] == rows
            row = [row for row in rows if row["timestamp"] <= frame["timestamp"]][-1]
            assert (row["style"], row["content"]) == ("subtask", names[frame["subtask_index"]])
    # frames of an episode that is not judged have none; a copy is annotated again
    assert command("judge", "new#2", *options, "--annotate", "one").code == 0
    one = pq.read_table(f"one/{file}")
    assert one.column_names == new.column_names
    rest = one.filter(pc.not_equal(one["episode_index"], 2))
    assert set(rest["subtask_index"].to_pylist()) == {-1}
    assert not any(rest["language_persistent"].to_pylist())


@pytest.mark.usefixtures("push")
def test_episodes_of_two_data_sets_are_pairs_by_their_numbers() -> None:
    comparison = sr.judge("push_v3", "push.spatial", against="push_v21", mapping="push.yaml").comparison
    assert comparison is not None
    assert (len(comparison.pairs), comparison.elsewhere, comparison.decision) == (4, 0, "undecided")


def test_only_a_data_set_is_annotated(fleet: Path) -> None:
    assert "--write-labels FILE.parquet" in judge("--annotate", "new", code=2)
    assert "it exists" in judge("--annotate", "logs", code=2)


def write_pairs(new: list[float], old: list[float]) -> None:
    """Write two fleets in which the cart keeps these distances at last, and starts at the same places."""
    for name, distances in {"new": new, "old": old}.items():
        for number, distance in enumerate(distances):
            file = Path(name) / f"{number}.jsonl"
            start = write_log(file, 0.5, samples=1).read_text()
            end = write_log(file, distance).read_text().splitlines(keepends=True)[-1]
            file.write_text(start + end)


def test_pairs_that_start_alike_decide_which_side_is_better(fleet: Path) -> None:
    write_pairs([0.5] * 9 + [0.1] + [0.4] * 2, [0.1] * 9 + [0.5] + [0.4] * 2)
    ended = command("judge", "new", "--spec", "gate.spatial", "--jobs", "1", "--against", "old")
    assert ended.code == 0, ended.err
    assert "against old: 12 pairs with the same start\n" in ended.out
    assert "new is better: 9 won, 1 lost of 12 pairs, p = 0.021\nevidence 9.3 of the 20" in ended.out
    assert re.search(r"against   3 of 12 +25 %", ended.out)
    comparison = sr.judge("old", "gate.spatial", against="new").comparison
    assert comparison is not None
    assert (comparison.decision, comparison.won, comparison.lost) == ("worse", 1, 9)


def test_too_few_pairs_are_undecided_with_a_number_of_further_ones(fleet: Path) -> None:
    write_pairs([0.5] * 12, [0.1, *[0.5] * 11])
    arguments = ["--spec", "gate.spatial", "--jobs", "1", "--against", "old"]
    more = statistics.more_pairs(1, 0, 12)
    text = command("judge", "new", *arguments).out
    assert f"undecided: 1 won, 0 lost of 12, p = 1; about {more} more pairs would decide" in text
    Path("old/11.jsonl").rename("old/12.jsonl")
    document = json.loads(command("judge", "new", *arguments, "--json", "-").out)["comparison"]
    assert (document["decision"], document["pairs"], document["alone"]) == ("undecided", 11, 2)


def test_equal_names_are_no_pair_if_objects_start_elsewhere(fleet: Path) -> None:
    write_pairs([0.5, 0.5], [0.1, 0.1])
    # the cart of the second old run starts 5 mm away
    text = Path("old/1.jsonl").read_text()
    Path("old/1.jsonl").write_text(text.replace("[0.0, 0]", "[-0.02, 0]", 1))
    assert Path("old/1.jsonl").read_text() != text
    for distance, counts in {None: (1, 1), 0.02: (2, 0)}.items():
        comparison = sr.judge("new", "gate.spatial", against="old", same_start=distance).comparison
        assert comparison is not None
        assert (len(comparison.pairs), comparison.elsewhere) == counts


def test_repeated_runs_say_how_often_all_of_them_succeed(fleet: Path) -> None:
    for start, distances in {"a": [0.5, 0.5, 0.1], "b": [0.5, 0.5, 0.5]}.items():
        for number, distance in enumerate(distances):
            write_log(Path(f"runs/{start}#{number}.jsonl"), distance)
    ended = command("judge", "runs", "--spec", "gate.spatial", "--jobs", "1", "--json", "-")
    # of three runs of a, two succeed: one of its three pairs does
    assert json.loads(ended.out)["pass_k"] == pytest.approx({"2": 2 / 3, "3": 0.5})


def test_same_start_needs_earlier_episodes(fleet: Path) -> None:
    assert "add --against LOG" in judge("--same-start", "0.1", code=2)
    with pytest.raises(sr.UsageError, match="same_start is about pairs; give the earlier episodes: against="):
        sr.judge("logs", "gate.spatial", same_start=0.1)
