"""The loop of a planned run: observe, decide, execute, until no step is left."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from spatial_replay.errors import UsageError
from spatial_replay.planning.decision_log import BlackBox
from spatial_replay.planning.decisions import Executor, Outcome, Step
from spatial_replay.planning.planner import Planner
from spatial_replay.recording.recorder import Recorder
from spatial_replay.text import named_arguments

HOLDING_SAMPLES: Final = 30
"""Number of samples for which the specification must stay satisfied before a run ends."""
MOST_WAITING_SAMPLES: Final = 150
"""Maximum number of samples without progress between two motions; then the run ends."""


class Robot(Executor, Protocol):
    """A robot that executes the steps of `plan`, and records every sample, also during motions."""

    def look(self) -> None:
        """Write one more sample to the recorder, while nothing moves."""


@named_arguments
def plan(planner: Planner, robot: Robot, recorder: Recorder, *, timings: bool = False) -> Step:
    """Run a planner and a robot until no step is left, and record the run.

    The log has the samples, the settings, and every decision with its maps and outcome, so that
    `verify --decisions` can recompute the run. The loop always ends: the planner tries each edge of the
    automaton a limited number of times. A wait ends after a number of samples without a new automaton state.

    Args:
        planner: a planner that has observed nothing yet.
        robot: moves objects, and writes samples with `recorder.write`.
        recorder: records the planner's specification, or was opened with `planner=`.
        timings: also record the duration of each decision; the recorder must have no planner yet.

    Returns:
        The last decision; "hold" means that the planner's observations satisfy the specification.

    Raises:
        UsageError: the recorder does not record the planner's specification, or has another planner.
        OutputError: the log cannot be written.
    """
    if recorder.planner is not planner:
        recorder.attach(planner, timings=timings)
    elif timings:
        raise UsageError(
            "the recorder has this planner already, so its timings cannot be changed; leave timings out"
        )
    return run_plan(recorder, robot.execute, robot.look)


def run_plan(
    decider: BlackBox | Recorder, execute: Callable[[Step], Outcome], look: Callable[[], None]
) -> Step:
    """Observe, decide and execute until no step is left; return the last decision.

    Args:
        look: takes one sample without a motion, and gives it to the planner.
    """
    look()
    planner = decider.planner
    assert planner is not None
    waited_samples, reached_states = 0, {planner.states}
    while True:
        step = decider.next_step()
        if step.kind == "execute":
            decider.conclude(execute(step))
            waited_samples, reached_states = 0, {planner.states}
        elif step.kind == "wait" and waited_samples < MOST_WAITING_SAMPLES:
            look()
            # the planner limits a wait for other agents; samples without a new state limit any other wait
            is_for_others = step.aim is not None and not step.ahead
            waited_samples += not is_for_others and (not step.ahead or planner.states in reached_states)
            reached_states.add(planner.states)
        elif step.kind != "hold" or _holds(planner, look):
            return step


def _holds(planner: Planner, look: Callable[[], None]) -> bool:
    """Observe `HOLDING_SAMPLES` without a motion; return whether the specification stays satisfied."""
    for _ in range(HOLDING_SAMPLES):
        look()
    # no motion can remove uncertainty about the past
    return planner.is_accepting or planner.is_doubtful
