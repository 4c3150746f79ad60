"""Algorithm 1 of the paper: an edge of the automaton at a time, by moving one object at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compiling import automaton as automaton_of
from spatial_replay.automata.moves import Transition
from spatial_replay.errors import TraceError, UsageError
from spatial_replay.planning.candidates import Movables, with_choice
from spatial_replay.planning.checks import kind_faults, refuse_faults
from spatial_replay.planning.edges import consideration_of, why_no_path, worst_state
from spatial_replay.planning.observing import Observer, Symbol, refuse_template
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.step import Consideration, Edge, Kind, Outcome, Step
from spatial_replay.planning.subjects import refuse_delays, refuse_unknown
from spatial_replay.planning.workspace import Workspace
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample


class Planner:
    """Plans towards a specification, step by step, from what is observed (section 5.2 of the paper).

    Use as:

        planner = Planner(specification)
        planner.observe(sample)
        while (step := planner.next_step()).kind == "execute":
            outcome = executor.execute(step)
            planner.observe(sample)
            planner.conclude(outcome)

    It observes every sample, during an execution too: each one moves the automaton. It comes to an end: each
    step uses up one of the attempts that every edge of the automaton has. Equal samples and outcomes give
    equal steps.

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
        self._tried: dict[Edge, int] = {}
        self._failed: dict[tuple[Edge, str], tuple[tuple[float, float], ...]] = {}
        self._running: Step | None = None
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

    def next_step(self) -> Step:
        """Decide on what the samples observed so far say (Algorithm 1).

        Edges that no movable object can take now are pruned, and the next shortest path is tried, until one
        can be taken or none is left.

        Raises:
            UsageError: nothing was observed yet, or a step is being executed and was not concluded.
        """
        if self._sample is None:
            raise UsageError("there is nothing to plan on; observe a sample first")
        if self._running is not None:
            raise UsageError(
                f"step {self._running.number} is being executed; conclude it with its outcome first"
            )
        if self._states <= self.automaton.accepting:
            return self._decided("hold", (), "the specification is satisfied: hold")
        if len(self._states) > 1 and None in self._symbol:
            return self._decided("wait", (), f"not enough is seen: {self._unknown()} unknown")
        state = worst_state(self.automaton, self.states)
        if state is None:
            reason = "no path left: the specification cannot be satisfied any more"
            return self._decided("no path", (), reason)
        if self.is_doubtful:
            return self._decided("hold", (), "satisfied, unless it was violated while not enough was seen")
        considered: list[Consideration] = []
        movables = Movables(self._formulas, self._regions, self._sample, self.settings)
        while (way := next(self.automaton.paths(state, self._pruned), None)) is not None:
            considered.append(self._considered(way, movables))
            if not considered[-1].pruned:
                return self._running_step(considered)
            self._pruned[considered[-1].edge] = considered[-1].pruned
        return self._decided("no path", considered, why_no_path(self.automaton, state, self._pruned))

    def conclude(self, outcome: Outcome) -> None:
        """Say how the execution of the last step went, once its samples were observed.

        A place where an object could not be brought is avoided when the same edge is tried again.

        Raises:
            UsageError: what is no outcome, or no step is being executed.
        """
        if not isinstance(outcome, Outcome):
            raise UsageError(f"{outcome!r} is no outcome; give an Outcome(succeeded, reason)")
        step = self._running
        if step is None or step.target is None or step.aim is None:
            raise UsageError("no step is being executed; call next_step() first")
        self._running = None
        if not outcome.succeeded:
            key = (step.aim.edge, step.target.name)
            self._failed[key] = (*self._failed.get(key, ()), (step.target.x, step.target.y))

    def _considered(self, way: tuple[Transition, ...], movables: Movables) -> Consideration:
        """Look into the first edge of a path: what it takes, and which objects could do it."""
        consideration = consideration_of(self.automaton, way, self._pruned)
        edge = consideration.edge
        tried = self._tried.get(edge, 0)
        if tried >= self.settings.attempts:
            return replace(consideration, pruned=f"tried {tried} times")
        candidates = [
            movables.candidate(name, consideration, self._failed.get((edge, name), ()))
            for name in movables.names_for(consideration.progress)
        ]
        return with_choice(consideration, candidates, self.settings)

    def _running_step(self, considered: list[Consideration]) -> Step:
        aim = considered[-1]
        (target,) = [each.target for each in aim.candidates if each.is_chosen]
        if target is None:
            raise UsageError("the chosen object has no target")
        self._tried[aim.edge] = self._tried.get(aim.edge, 0) + 1
        verb = "push" if self.settings.skill == "push" else "place"
        reason = (
            f"{verb} {target.name} at ({target.x:.4g}, {target.y:.4g}) for the edge {aim.edge[0]} -> "
            f"{aim.edge[1]}: {aim.progress}"
        )
        self._running = replace(self._decided("execute", considered, reason), target=target)
        return self._running

    def _decided(self, kind: Kind, considered: Iterable[Consideration], reason: str) -> Step:
        if self._sample is None:
            raise UsageError("there is nothing to plan on; observe a sample first")
        number, self._steps = self._steps, self._steps + 1
        pruned = tuple(sorted(self._pruned.items()))
        return Step(number, self._sample.time_ns, kind, self.states, tuple(considered), None, pruned, reason)

    def _unknown(self) -> str:
        """The propositions that the newest sample says nothing about."""
        propositions = self.automaton.propositions
        labels = zip(propositions, self._symbol, strict=True)
        return ", ".join(each.label for each, value in labels if value is None)
