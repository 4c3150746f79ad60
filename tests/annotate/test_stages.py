"""Stages of a task: what runs have reached, and what they owe next."""

import json
import os
from collections import Counter
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.annotate.stages import Stages, stages

_TASK = """
spec reached = hand <= 0.03
spec lifted = z >= 0.06
spec placed = d <= 0.07
spec task = F (reached and F (lifted and F (G placed)))
"""


def _stages(text: str, *samples: dict[str, float]) -> Stages:
    trace = sr.Trace.from_samples(
        [sr.Sample(number * 50_000_000, {}, signals) for number, signals in enumerate(samples)]
    )
    return stages(sr.evaluate(sr.parse_specification(text), trace))


def _names(run: Stages) -> list[str]:
    return [run[sample].name for sample in range(len(run.times_ns))]


def test_each_sample_has_its_stage_and_a_lost_one_goes_back() -> None:
    away = {"hand": 1.0, "z": 0.0, "d": 1.0}
    run = _stages(
        _TASK, away, {**away, "hand": 0.0}, {**away, "z": 0.1}, {**away, "d": 0.0}, {**away, "d": 0.2}
    )
    lifted = "lifted, not placed"
    assert _names(run) == ["never reached", "reached, not lifted", lifted, "placed", lifted]
    assert run.progress == pytest.approx([0, 1 / 3, 2 / 3, 1, 2 / 3])
    assert [run[sample].owed for sample in range(4)] == ["reached", "lifted", "placed", ""]


def test_several_propositions_may_come_true_in_one_sample() -> None:
    run = _stages(_TASK, {"hand": 0.0, "z": 0.1, "d": 0.0})
    assert _names(run) == ["placed"]


def test_a_proposition_that_must_stay_true_is_not_owed_and_its_loss_is_permanent() -> None:
    text = "spec safe = force <= 5\nspec done = d <= 1\nspec task = (G safe) and F done"
    run = _stages(text, {"force": 0.0, "d": 2.0}, {"force": 9.0, "d": 2.0}, {"force": 0.0, "d": 0.0})
    assert _names(run) == ["never done", "lost", "lost"]
    assert run.progress.tolist() == [0.0, 0.0, 0.0]


def test_a_proposition_that_is_unknown_claims_no_progress() -> None:
    run = _stages("spec done = F (d <= 1)", {"other": 0.0}, {"d": 0.0})
    assert _names(run) == ["unknown", "d <= 1"]
    assert run.progress.tolist() == [0.0, 1.0]


def test_bounds_in_seconds_count_evenly_spaced_samples() -> None:
    held = "spec held = F ((G[0s, 0.1s] d <= 1) and (F[0.1s, inf] true))"
    run = _stages(held, *[{"d": number} for number in (2.0, 0.0, 0.0, 0.0)])
    over = "d <= 1, not long enough"
    assert _names(run) == ["not d <= 1", over, over, "d <= 1"]


def test_progress_is_one_where_the_verdict_is_satisfied() -> None:
    if "SPATIAL_REPLAY_DATA" not in os.environ:
        pytest.skip("SPATIAL_REPLAY_DATA is unset")
    folder = Path(os.environ["SPATIAL_REPLAY_DATA"]) / "episodes" / "pick-place"
    task = sr.parse_specification(
        _TASK.replace("hand <= 0.03", "hand dist obj <= 0.045").replace("d <", "d3 <")
    )
    ends: Counter[str] = Counter()
    for row in json.loads((folder / "labels.json").read_text()):
        evaluation = sr.evaluate(task, sr.read_trace(folder / row["log"]))
        run = stages(evaluation)
        assert (run.progress[-1] == 1.0) == (evaluation.verdict == "satisfied")
        ends[run[-1].name] += 1
    assert ends == {"never reached": 26, "reached, not lifted": 4, "lifted, not placed": 7, "placed": 23}
