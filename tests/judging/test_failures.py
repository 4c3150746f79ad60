"""Failures and stages of episodes: each template where it happens, and where it only looks like it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import pytest

import spatial_replay as sr
from batch.fleet import command

FAILURES = Path(__file__).parents[2] / "recordings/failures.spatial"
STEP_NS = 50_000_000
GOAL = 0.4


class Moment(NamedTuple):
    """A sample: where the thing is, how high its bottom is, how tall it is, whether it is held, another x."""

    x: float
    z: float = 0.0
    held: bool = False
    tall: float = 0.1
    other: float = -0.4


def lying(x: float, count: int = 8) -> list[Moment]:
    return [Moment(x)] * count


def carried(begin: float, end: float, count: int = 8) -> list[Moment]:
    """Moments of a thing that is lifted and carried."""
    return [Moment(begin + (end - begin) * step / count, 0.2, held=True) for step in range(count + 1)]


def fallen(x: float) -> list[Moment]:
    """Moments of a thing that falls and stays where it is."""
    return [Moment(x, 0.15), Moment(x, 0.08), *lying(x)]


def objects(moment: Moment) -> dict[str, sr.TrackedObject]:
    def disc(x: float, bottom: float, top: float) -> sr.TrackedObject:
        return sr.TrackedObject(sr.Footprint.disc(x, 0.5, 0.02), height=(bottom, top))

    hand = moment.z + moment.tall + (0.0 if moment.held else 0.4)
    return {
        "obj": disc(moment.x, moment.z, moment.z + moment.tall),
        "hand": disc(moment.x, hand, hand + 0.05),
        "goal": sr.TrackedObject(sr.Footprint.disc(GOAL, 0.5, 0.02)),
        "cup": disc(moment.other, 0.0, 0.1),
    }


def happened(moments: Iterable[Moment]) -> list[str]:
    samples = [sr.Sample(number * STEP_NS, objects(moment)) for number, moment in enumerate(moments)]
    specification = sr.load_specification(FAILURES, constants={"upright": 0.08, "deadline": "2s"})
    evaluation = sr.evaluate(specification, sr.Trace.from_samples(samples))
    return [result.name for result in evaluation if result.verdict == "satisfied"]


DELIVERED = [*lying(0.0, 2), *carried(0.0, GOAL), *lying(GOAL)]
SHIFTED = [Moment(0.0, other=-0.4 + 0.01 * step) for step in range(8)]
LEAPT = [Moment(0.0), Moment(0.0, other=-0.3), *lying(0.0, 2)]
TIPPED = [Moment(0.0, tall=0.04)] * 8
BLURRED = [Moment(0.0, tall=0.04), *lying(0.0, 2)]
REGRASPED = [*carried(0.0, 0.2), Moment(0.2, 0.2), *carried(0.2, GOAL), *lying(GOAL)]
CASES = {
    "dropped": ([*carried(0.0, 0.2), *fallen(0.2)], REGRASPED),
    "dropped over the place": ([*carried(0.0, 0.2), *fallen(0.2)], [*carried(0.0, GOAL), *fallen(GOAL)]),
    "wrong_object": ([*SHIFTED, *DELIVERED], [*LEAPT, *DELIVERED]),
    "tipped": ([*TIPPED, *DELIVERED], [*BLURRED, *DELIVERED]),
    "pushed_off": ([*lying(0.0), *lying(-0.7)], [*carried(0.0, -0.7), *carried(-0.7, GOAL), *lying(GOAL)]),
    "came_out": ([*DELIVERED, *lying(0.55)], [*carried(0.0, 0.6), *carried(0.6, GOAL), *lying(GOAL)]),
    "too_late": ([*lying(0.0, 50), *DELIVERED], [*DELIVERED, *lying(0.2, 40), *lying(GOAL)]),
    "hovered": ([*carried(0.0, GOAL), *carried(GOAL, GOAL)], DELIVERED),
    "never_lifted": ([*lying(0.0), *lying(GOAL)], DELIVERED),
}


@pytest.mark.parametrize("case", CASES)
def test_a_failure_is_distinct_from_what_only_looks_like_it(case: str) -> None:
    name = case.split()[0]
    failing, similar = CASES[case]
    assert name in happened(failing)
    assert name not in happened(similar)


def test_an_episode_without_a_failure_has_none() -> None:
    assert happened(DELIVERED) == []


@pytest.fixture
def episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Six episodes, of which two succeed, one of these after the wrong object has moved."""
    monkeypatch.chdir(tmp_path)
    runs = [
        DELIVERED,
        [*SHIFTED, *DELIVERED],
        [*carried(0.0, 0.2), *fallen(0.2), *SHIFTED],
        [*SHIFTED, *carried(0.0, 0.2), *fallen(0.2)],
        [*carried(0.0, 0.2), *fallen(0.2)],
        [*carried(0.0, 0.2), *[Moment(0.2, 0.2, held=True)] * 3],
    ]
    Path("runs").mkdir()
    for number, run in enumerate(runs):
        with sr.Recorder(f"runs/{number}.mcap", units={"": "m"}) as recorder:
            for place, moment in enumerate(run):
                recorder.write(sr.Sample(place * STEP_NS, objects(moment)))
    labels = [{"episode": str(number), "success": number < 3} for number in range(6)]
    Path("runs/labels.json").write_text(json.dumps(labels))
    Path("task.spatial").write_text(
        "spec lifted = surface prec[z] obj\n"
        "spec placed = center(obj) dist goal <= 0.05\n"
        "spec task = F (lifted and F (G placed))\n"
        "region surface = box(-9, -9, 9, 9) height (-9, 0.04)\n"
    )
    return tmp_path


def test_failed_episodes_have_the_failure_that_happened_first(episodes: Path) -> None:
    judgement = sr.judge("runs", "task.spatial", failures=FAILURES)
    assert [(row.failure, row.failure_at) for row in judgement.rows] == [
        (None, None),
        (None, None),
        ("dropped in transport", pytest.approx(0.55)),
        ("wrong object moved", pytest.approx(0.25)),
        ("dropped in transport", pytest.approx(0.55)),
        (None, None),
    ]
    assert (judgement.result, judgement.rate.successes) == ("task", 2)
    ended = command("judge", "runs", "--spec", "task.spatial", "--failures", str(FAILURES), "--html", "pages")
    assert ended.code == 0, ended.err
    # heights decide in all six logs, at other times
    assert ended.err.count("`thing dist gripper <= 0.05` fails") == 1
    table = ended.out[ended.out.index("first failures") :].splitlines()
    assert table[:4] == [
        "first failures of the 4 episodes that fail `task`",
        "  dropped in transport  2  2, 4",
        "  wrong object moved    1  3",
        "  another failure       1  5",
    ]
    # the page has the task alone: a failure that does not happen is no failing result
    assert "never_lifted" not in Path("pages/index.html").read_text()
    document = json.loads(
        command("judge", "runs", "--spec", "task.spatial", "--failures", str(FAILURES), "--json", "-").out
    )
    assert document["failures"] == {"dropped in transport": 2, "wrong object moved": 1, "other": 1}
    assert document["rows"][3]["failure"] == "wrong object moved"


def test_a_file_of_failures_does_not_judge(episodes: Path) -> None:
    ended = command("judge", "runs", "--spec", str(FAILURES), "--failures", str(FAILURES))
    assert ended.code == 2
    assert "--failures has no spec that judges; give that with --spec" in ended.err


def test_stages_at_the_end_are_counted_also_for_labelled_failures(episodes: Path) -> None:
    text = command("judge", "runs", "--spec", "task.spatial", "--stages").out
    assert (
        "stages of `task`    at the end  of the 3 that the label calls failures\n"
        "never lifted        0           0\n"
        "lifted, not placed  4           3\n"
        "placed              2           0\n"
    ) in text
    rows = sr.judge("runs", "task.spatial", stages=True).to_pandas()
    assert rows.progress.tolist() == [1.0, 1.0, 0.5, 0.5, 0.5, 0.5]


def test_stages_need_an_automaton(episodes: Path) -> None:
    Path("past.spatial").write_text("spec task = F (O (obj dist goal <= 0.05))\n")
    ended = command("judge", "runs", "--spec", "past.spatial", "--stages")
    assert ended.code == 2
    assert "past operator" in ended.err


def test_stages_of_episodes_of_others_are_as_counted(data_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "pick.spatial").write_text(
        "spec reached = hand dist obj <= 0.045\nspec lifted = z >= 0.06\nspec placed = d3 <= 0.07\n"
        "spec task = F (reached and F (lifted and F (G placed)))\n"
    )
    judgement = sr.judge(data_folder / "episodes/pick-place", tmp_path / "pick.spatial", stages=True)
    counts = [sum(row.stage == name for row in judgement.rows) for name in judgement.stages]
    assert judgement.stages == ("never reached", "reached, not lifted", "lifted, not placed", "placed")
    assert counts == [26, 4, 7, 23]
