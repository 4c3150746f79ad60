"""A planner in a loop with an executor of its steps, without physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import spatial_replay as sr
from planning.kinematics import Table, block
from spatial_replay import Planner, Settings
from spatial_replay.planning import Grid, Workspace
from spatial_replay.planning.decision_log import BlackBox
from spatial_replay.recording.plan_loop import HOLDING_SAMPLES, MOST_WAITING_SAMPLES, run_plan
from spatial_replay.runs.scripted import RunLog, run_log

TABLE = Settings(Workspace(Grid.over(0, 0, 10, 10, 0.5), supports=frozenset({"plate"})))
THINGS = {"cup": block(1, 1, size=1), "fork": block(9, 9, size=1), "plate": block(5, 5, size=3)}


@dataclass
class Camera:
    """A camera that does not see the objects hidden in a sample.

    Attributes:
        hides: says for a sample's number and an object's name whether the object is hidden.
    """

    log: RunLog
    box: BlackBox
    settings: Settings
    hides: object
    seen: int = 0

    def observe(self, sample):
        objects = {name: each for name, each in sample.objects.items() if not self.hides(self.seen, name)}
        self.seen += 1
        shown = sr.Sample(sample.time_ns, objects)
        self.log.write(shown)
        self.box.observe(shown)


def run(path, text, hides, things=THINGS, **options):
    """Return the last decision, the planner, the number of motions and the log's verdict."""
    specification = sr.parse_specification(text)
    planner = Planner(specification, TABLE)
    with run_log(path, [specification]) as log:
        table = Table(dict(things), None, **options)
        box = BlackBox(planner, log.write_messages)
        table.planner = Camera(log, box, TABLE, hides)
        last = run_plan(box, table.execute, table.look)
    assert log.samples == len(table.samples)
    return last, planner, planner.motions, log.verdicts["spec"]


def test_a_doubt_that_remains_does_not_prolong_a_run(tmp_path):
    text = "(G (fork rightof plate)) and F (cup enclosedin plate)"
    last, planner, motions, verdict = run(
        tmp_path / "run.mcap", text, lambda number, name: name == "fork" and number == 1
    )
    assert last.kind == "hold"
    assert "unless it was violated" in last.reason
    assert planner.is_doubtful
    assert not planner.is_accepting
    assert verdict == "unknown"
    assert motions == 1


def test_a_run_ends_while_waiting_for_an_object_that_never_appears(tmp_path):
    text = "(G (fork rightof plate)) and F (cup enclosedin plate)"
    last, _, motions, _ = run(tmp_path / "run.mcap", text, lambda number, name: name == "fork")
    assert last.kind == "wait"
    assert motions == 0
    assert last.number == 0
    assert len(sr.read_trace(tmp_path / "run.mcap")) == 1 + MOST_WAITING_SAMPLES


def test_a_run_waits_for_a_bound_in_the_future(tmp_path):
    text = f"F[{2 * MOST_WAITING_SAMPLES},{3 * MOST_WAITING_SAMPLES}] (cup enclosedin plate)"
    last, _, motions, verdict = run(tmp_path / "run.mcap", text, lambda number, name: False)
    assert (last.kind, verdict) == ("hold", "satisfied")
    assert motions == 1
    assert last.number == 2


def test_a_satisfied_specification_is_observed_for_some_samples(tmp_path):
    seen = 0

    def counted(number, name):
        nonlocal seen
        seen = number + 1
        return False

    last, planner, _, verdict = run(tmp_path / "run.mcap", "F (cup enclosedin plate)", counted)
    assert (last.kind, verdict) == ("hold", "satisfied")
    assert planner.is_accepting
    assert not planner.is_doubtful
    assert seen == 1 + 1 + HOLDING_SAMPLES


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "text",
    [
        "(G (fork rightof plate)) and F (cup enclosedin plate)",
        "G ((cup leftof plate) -> F (fork enclosedin plate))",
        "(not (cup enclosedin plate)) U (fork leftof plate)",
        "F (G (cup enclosedin plate))",
    ],
)
def test_a_run_ends_whichever_objects_are_hidden(tmp_path, text, seed):
    random = np.random.default_rng(seed)
    last, planner, motions, verdict = run(
        tmp_path / "run.mcap", text, lambda number, name: number > 0 and random.random() < 0.2, slips=2
    )
    motions = TABLE.attempts * len(planner.automaton.transitions)
    assert motions <= motions
    assert last.number <= (motions + 1) * (MOST_WAITING_SAMPLES + 2)
    if verdict == "satisfied":
        assert last.kind == "hold"
