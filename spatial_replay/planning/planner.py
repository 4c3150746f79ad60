"""Algorithm 1 of the paper: an edge of the automaton at a time, by moving one object at a time.

What was tried for each edge of the automaton, and where that failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton as automaton_of
from spatial_replay.errors import TraceError, UsageError
from spatial_replay.planning.candidates import Movables, with_choice
from spatial_replay.planning.decisions import Consideration, Edge, Kind, Outcome, Step, Target
from spatial_replay.planning.edges import (
    Observer,
    Symbol,
    consideration_of,
    drift_of,
    refuse_template,
    twins_of,
    why_no_path,
    worst_state,
)
from spatial_replay.planning.maps import Cubes, refuse_delays, refuse_unknown
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Workspace, kind_faults, refuse_faults
from spatial_replay.spec.formula import Specification
from spatial_replay.text import counted
from spatial_replay.trace.sample import Sample

MOST_MOTIONS: Final = 100
"""How many motions an edge gets in all, however often they succeed."""


class Attempts:
    """The motions of a run."""

    def __init__(self) -> None:
        self._in_vain: Counter[Edge] = Counter()
        self._in_all: Counter[Edge] = Counter()
        self._places: dict[tuple[Cubes, str], tuple[tuple[float, float], ...]] = {}

    def why_enough(self, edge: Edge, most_in_vain: int) -> str:
        """Why an edge is not to be tried again, or ""."""
        if self._in_vain[edge] >= most_in_vain:
            return f"tried {self._in_vain[edge]} times"
        return f"tried {MOST_MOTIONS} times in all" if self._in_all[edge] >= MOST_MOTIONS else ""

    def begin(self, edge: Edge) -> None:
        """Count a motion for an edge, in vain so far."""
        self._in_vain[edge] += 1
        self._in_all[edge] += 1

    def conclude(self, aim: Consideration, target: Target, outcome: Outcome, states: Sequence[int]) -> None:
        """Take in how a motion went, and where the automaton is then."""
        if not outcome.succeeded:
            key = (aim.progress.cubes, target.name)
            self._places[key] = (*self._places.get(key, ()), (target.x, target.y))
        elif tuple(states) == aim.edge[1:]:
            del self._in_vain[aim.edge]

    def failed(self, aim: Consideration, name: str) -> tuple[tuple[float, float], ...]:
        """The places (x, y) where an object could not be brought for equal progress."""
        return self._places.get((aim.progress.cubes, name), ())


class Planner:
    """Plans towards a specification, step by step, from what is observed (section 5.2 of the paper).

    Use as:

        planner = Planner(specification)
        planner.observe(sample)
        while (step := planner.next_step()).kind in ("execute", "wait"):
            outcome = executor.execute(step) if step.kind == "execute" else None
            planner.observe(sample)
            if outcome is not None:
                planner.conclude(outcome)

    It observes every sample, during an execution too: each one moves the automaton. Motions come to an end:
    an edge of the automaton is given up after so many attempts in vain, and after `MOST_MOTIONS` in all.
    Equal samples and outcomes give equal steps.

    Attributes:
        automaton: of the specification.
    """

    def __init__(
        self, specification: Specification, settings: Settings | None = None, *, name: str | None = None
    ) -> None:
        """Begin before the first sample.

        Args:
            settings: where and how to plan; without them, every object can be picked up and placed around
                where the first sample shows objects.
            name: which spec of the file to plan for; without it, its only result.

        Raises:
            NoAutomatonError: past operators, bounds in seconds, or too large a formula.
            UsageError: no such spec, several to choose from, a template, propositions about earlier samples,
                or settings that are none.
        """
        if settings is not None:
            refuse_faults(kind_faults("settings", settings, Settings, "Settings(workspace), or None"))
        self.automaton: Automaton = automaton_of(specification, name)
        refuse_template(specification, self.automaton.name)
        self._settings = settings
        self._regions = specification.regions
        self._formulas = [each.formula for each in self.automaton.propositions]
        refuse_delays(self._formulas)
        self._states: frozenset[int] = frozenset({self.automaton.initial})
        self._sample: Sample | None = None
        self._observer = Observer(self._formulas, specification.regions)
        self._symbol: Symbol = ()
        self._pruned: dict[Edge, str] = {}
        self._attempts = Attempts()
        self._running: Step | None = None
        self._waiting: Step | None = None
        self._ahead: tuple[int, ...] = ()
        self._steps = 0

    @property
    def settings(self) -> Settings:
        """Where and how it plans.

        Raises:
            UsageError: none were given, and no sample has been observed yet.
        """
        if self._settings is None:
            raise UsageError("where to plan depends on the first sample; observe one first, or give settings")
        return self._settings

    @property
    def states(self) -> tuple[int, ...]:
        """Where the automaton can be after the samples observed; one state where everything is known."""
        return tuple(sorted(self._states))

    @property
    def is_accepting(self) -> bool:
        """Whether the samples observed satisfy the specification, as far as propositions tell."""
        return self._sample is not None and self._states <= self.automaton.accepting

    @property
    def is_doubtful(self) -> bool:
        """Whether they satisfy it unless it was violated for good while not enough was seen.

        No later sample takes that doubt away.
        """
        if self._sample is None or self._states.isdisjoint(self.automaton.accepting):
            return False
        open_states = self._states - self.automaton.accepting
        return bool(open_states) and open_states.isdisjoint(self.automaton.can_accept)

    def observe(self, sample: Sample) -> None:
        """Take in the next sample.

        Raises:
            TraceError: a time that does not come after the last one's.
            UsageError: what is no sample; at the first one: the settings name objects to be moved that nobody
                knows, or there are no settings and no objects.
        """
        if not isinstance(sample, Sample):
            raise UsageError(f"{sample!r} is no sample; give a Sample(time_ns, objects)")
        if self._sample is not None and sample.time_ns <= self._sample.time_ns:
            raise TraceError(
                f"a sample at {sample.time_ns} ns follows one at {self._sample.time_ns} ns; give times that "
                "increase"
            )
        if self._settings is None:
            self._settings = Settings(Workspace.around(sample))
        if self._sample is None:
            refuse_unknown(self._settings.movable or (), sample, self._formulas)
        self._sample = sample
        self._symbol = self._observer.symbol(sample)
        self._states = self.automaton.step_set(self._states, self._symbol)
        # a wait goes on while time leads where it was to lead
        self._ahead = self._ahead[1:] if not self._states.isdisjoint(self._ahead[:1]) else ()

    def next_step(self) -> Step:
        """Decide on what the samples observed so far say (Algorithm 1).

        Edges that no movable object can take now are pruned, and the next shortest path is tried, until one
        can be taken or none is left. Where nothing is to be done but to let time pass, the same step comes
        again and again until that is over.

        Raises:
            UsageError: nothing was observed yet, or a step is being executed and was not concluded.
        """
        self._newest()
        if self._running is not None:
            raise UsageError(
                f"step {self._running.number} is being executed; conclude it with its outcome first"
            )
        if self._waiting is not None and self._waits_on(self._waiting):
            return self._waiting
        step = self._next_step()
        self._running = step if step.kind == "execute" else None
        self._waiting = step if step.kind == "wait" else None
        self._ahead = step.ahead
        return step

    def conclude(self, outcome: Outcome) -> None:
        """Say how the execution of the last step went, once its samples were observed.

        A place where an object could not be brought is avoided when the same progress is tried for again.

        Raises:
            UsageError: what is no outcome, or no step is being executed.
        """
        if not isinstance(outcome, Outcome):
            raise UsageError(f"{outcome!r} is no outcome; give an Outcome(succeeded, reason)")
        step = self._running
        if step is None or step.target is None or step.aim is None:
            raise UsageError("no step is being executed; call next_step() first")
        self._running = None
        self._attempts.conclude(step.aim, step.target, outcome, self.states)

    def _waits_on(self, step: Step) -> bool:
        return bool(self._ahead) if step.ahead else self._is_blind()

    def _is_blind(self) -> bool:
        """Whether too little is seen to tell where the automaton is."""
        is_accepting = self._states <= self.automaton.accepting
        return len(self._states) > 1 and None in self._symbol and not is_accepting

    def _next_step(self) -> Step:
        if self._states <= self.automaton.accepting:
            return self._decided("hold", (), "the specification is satisfied: hold")
        if self._is_blind():
            return self._decided("wait", (), f"not enough is seen: {self._unknown()} unknown")
        state = worst_state(self.automaton, self.states)
        if state is None:
            reason = "no path left: the specification cannot be satisfied any more"
            return self._decided("no path", (), reason)
        if self.is_doubtful:
            return self._decided("hold", (), "satisfied, unless it was violated while not enough was seen")
        return self._step_from(state)

    def _step_from(self, state: int) -> Step:
        """The step for the first edge of a shortest path that can be taken."""
        drift = drift_of(self.automaton, state, self._symbol)
        movables = Movables(self._formulas, self._regions, self._newest(), self.settings)
        considered: list[Consideration] = []
        # what time alone does need not be given up
        given_up = set(self._pruned) - drift.edges
        while (way := next(self.automaton.paths(state, given_up), None)) is not None:
            consideration = consideration_of(self.automaton, way, given_up, self._symbol)
            if ahead := drift.along(way):
                return self._waiting_step([*considered, consideration], ahead)
            considered.append(self._considered(consideration, movables))
            if not considered[-1].pruned:
                return self._running_step(considered)
            edge = consideration.edge
            self._pruned[edge] = considered[-1].pruned
            given_up |= {edge, *twins_of(self.automaton, consideration, drift, given_up, self._symbol)}
        return self._decided("no path", considered, why_no_path(self.automaton, state, self._pruned))

    def _considered(self, consideration: Consideration, movables: Movables) -> Consideration:
        """Look into an edge: which objects could do what it takes."""
        enough = self._attempts.why_enough(consideration.edge, self.settings.attempts)
        if enough:
            return replace(consideration, pruned=enough)
        candidates = [
            movables.candidate(name, consideration, self._attempts.failed(consideration, name))
            for name in movables.names_for(consideration.progress)
        ]
        return with_choice(consideration, candidates, self.settings)

    def _waiting_step(self, considered: list[Consideration], ahead: tuple[int, ...]) -> Step:
        reason = f"wait for {counted(len(ahead), 'sample')}: time alone leads on, to state {ahead[-1]}"
        return replace(self._decided("wait", considered, reason), ahead=ahead)

    def _running_step(self, considered: list[Consideration]) -> Step:
        aim = considered[-1]
        (target,) = [each.target for each in aim.candidates if each.is_chosen]
        if target is None:
            raise UsageError("the chosen object has no target")
        self._attempts.begin(aim.edge)
        verb = "push" if self.settings.skill == "push" else "place"
        reason = (
            f"{verb} {target.name} at ({target.x:.4g}, {target.y:.4g}) for the edge {aim.edge[0]} -> "
            f"{aim.edge[1]}: {aim.progress}"
        )
        return replace(self._decided("execute", considered, reason), target=target)

    def _decided(self, kind: Kind, considered: Iterable[Consideration], reason: str) -> Step:
        number, self._steps = self._steps, self._steps + 1
        pruned = tuple(sorted(self._pruned.items()))
        time_ns = self._newest().time_ns
        return Step(number, time_ns, kind, self.states, tuple(considered), None, pruned, reason)

    def _newest(self) -> Sample:
        if self._sample is None:
            raise UsageError("there is nothing to plan on; observe a sample first")
        return self._sample

    def _unknown(self) -> str:
        """The propositions that the newest sample says nothing about."""
        propositions = self.automaton.propositions
        labels = zip(propositions, self._symbol, strict=True)
        return ", ".join(each.label for each, value in labels if value is None)
