"""The loop of a planned run: observe, decide, execute, until there is nothing more to do."""

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
"""How many samples the specification has to stay satisfied before a run ends."""
MOST_WAITING_SAMPLES: Final = 150
"""The most samples without progress between two motions, before a run ends."""


class Robot(Executor, Protocol):
    """A robot that `plan` lets act. It writes every sample to the recorder, also during a motion."""

    def look(self) -> None:
        """Write one more sample to the recorder, while nothing moves."""


@named_arguments
def plan(planner: Planner, robot: Robot, recorder: Recorder, *, timings: bool = False) -> Step:
    """Let a planner decide and a robot act until there is nothing more to do, and record all of it.

    The log has the samples, every decision with its maps and outcome, and the settings, so that
    `verify --decisions` recomputes it. The loop ends: motions are bounded by the attempts at the automaton's
    edges, waiting by the samples in which the automaton reaches no new state.

    Args:
        planner: that has observed nothing yet.
        robot: moves things, and writes samples with `recorder.write`.
        recorder: that records the planner's specification, or was opened with `planner=`.
        timings: also record how long each decision took; the recorder must have no planner yet.

    Returns:
        The last decision: "hold" if the specification is satisfied, as far as the planner can see.

    Raises:
        UsageError: the recorder does not record the planner's specification, or has another planner.
        OutputError: the log cannot be written.
    """
    if recorder.planner is not planner:
        recorder.attach(planner, timings=timings)
    elif timings:
        raise UsageError(
            "a recorder with a planner was given its timings when that was attached; leave them out"
        )
    return run_plan(recorder, robot.execute, robot.look)


def run_plan(
    decider: BlackBox | Recorder, execute: Callable[[Step], Outcome], look: Callable[[], None]
) -> Step:
    """Look, decide and act until there is nothing more to do; return the last decision.

    Args:
        look: takes one more sample, which the planner observes, while nothing moves.
    """
    look()
    planner = decider.planner
    assert planner is not None
    waited, reached = 0, {planner.states}
    while True:
        step = decider.next_step()
        if step.kind == "execute":
            decider.conclude(execute(step))
            waited, reached = 0, {planner.states}
        elif step.kind == "wait" and waited < MOST_WAITING_SAMPLES:
            look()
            # samples count only while the automaton reaches no new state; waits for others are bounded
            is_for_others = step.aim is not None and not step.ahead
            waited += not is_for_others and (not step.ahead or planner.states in reached)
            reached.add(planner.states)
        elif step.kind != "hold" or _holds(planner, look):
            return step


def _holds(planner: Planner, look: Callable[[], None]) -> bool:
    """Look for a while without a motion; return whether the specification stays satisfied."""
    for _ in range(HOLDING_SAMPLES):
        look()
    # no motion can remove doubt about the past
    return planner.is_accepting or planner.is_doubtful
