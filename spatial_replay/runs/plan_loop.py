"""A planner, what executes its steps and the log of both, from the first sample to the end."""

from __future__ import annotations

import time
from collections.abc import Callable

from spatial_replay.planning.black_box import BlackBox
from spatial_replay.planning.step import Executor, Step
from spatial_replay.runs.run_log import RunLog
from spatial_replay.trace.sample import Sample

HOLDING_SAMPLES = 30
"""How long it has to stay satisfied before a run ends."""
MOST_WAITING_SAMPLES = 150
"""How long it waits between two motions for what it does not see, or while nothing comes of it."""


class PlanLoop:
    """Lets a planner decide and an executor act until there is nothing more to do.

    Every sample goes to `observe`, during an execution too. The loop comes to an end: motions are bounded by
    the attempts of the automaton's edges, waiting by a number of samples in which the automaton does not get
    into another state.

    Attributes:
        executed: how many motions there were.
        planning_s: how long the planner thought, in seconds of real time.
    """

    def __init__(self, box: BlackBox, log: RunLog, executor: Executor, look: Callable[[], None]) -> None:
        """Begin before the first sample.

        Args:
            executor: its samples have to come to `observe`.
            look: lets one more sample come to `observe`, while nothing is moved.
        """
        self._box, self._log, self._executor, self._look = box, log, executor, look
        self.executed = 0
        self.planning_s = 0.0

    def observe(self, sample: Sample) -> None:
        """Take in the next sample.

        Raises:
            TraceError: it does not come after the one before.
            OutputError: the log cannot be written.
        """
        self._log.write(sample)
        began = time.perf_counter()
        self._box.observe(sample)
        self.planning_s += time.perf_counter() - began

    def run(self) -> Step:
        """Look, decide and act; the last decision."""
        self._look()
        waited, reached = 0, {self._box.planner.states}
        while True:
            step = self._decide()
            if step.kind == "execute":
                outcome = self._executor.execute(step)
                self._log.write_messages(self._box.conclude(outcome))
                self.executed, waited, reached = self.executed + 1, 0, {self._box.planner.states}
            elif step.kind == "wait" and waited < MOST_WAITING_SAMPLES:
                self._look()
                waited += not step.ahead or self._box.planner.states in reached
                reached.add(self._box.planner.states)
            elif step.kind != "hold" or self._holds():
                return step

    def _decide(self) -> Step:
        began = time.perf_counter()
        step, messages = self._box.decide()
        self.planning_s += time.perf_counter() - began
        self._log.write_messages(messages)
        return step

    def _holds(self) -> bool:
        """Whether it stays as satisfied as it can be while nothing is moved."""
        for _ in range(HOLDING_SAMPLES):
            self._look()
        planner = self._box.planner
        # doubt about the past stays, whatever is done
        return planner.is_accepting or planner.is_doubtful
