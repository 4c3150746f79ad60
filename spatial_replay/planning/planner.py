"""The planner (Algorithm 1 of the paper), which takes one edge of the automaton at a time by motions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton as automaton_of
from spatial_replay.automata.compile import chosen_spec
from spatial_replay.automata.guards import Transition
from spatial_replay.automata.ltlf import bounds_in_samples, counts_seconds
from spatial_replay.errors import TraceError, UsageError
from spatial_replay.planning.decisions import (
    Consideration,
    Edge,
    Kind,
    Loss,
    Outcome,
    Reason,
    Step,
    Target,
)
from spatial_replay.planning.demands import Ban, bans_of
from spatial_replay.planning.edges import (
    LATER,
    Attempts,
    Budget,
    Observer,
    Pose,
    Symbol,
    absence_text,
    consideration_of,
    equivalent_edges,
    groups_without_members,
    guards_of,
    idle_transitions,
    loss_text,
    moved_later,
    order_text,
    refuse_template,
    specs_of,
    unknown_reasons,
    why_no_path,
    worst_state,
)
from spatial_replay.planning.lookahead import MOST_MAPS, Lookahead
from spatial_replay.planning.maps import concerns, refuse_delays, refuse_unknown
from spatial_replay.planning.motions import Expectations, Movables, costs_of, with_choice
from spatial_replay.planning.movers import (
    Evasion,
    Lookout,
    MotionTimes,
    Timing,
    least_motion,
    motions_between,
    next_sample,
)
from spatial_replay.planning.settings import Settings, Workspace, kind_faults, refuse_faults
from spatial_replay.spec.formula import Group, Specification, Temporal
from spatial_replay.spec.walks import iter_formulas
from spatial_replay.text import named_arguments, plural, times_apart
from spatial_replay.trace.trace import Sample, require_sample

_LONGEST_WANTED: Final = 60
"""Maximum length of a proposition in a reason, characters; the name of a spec replaces a longer one."""


@named_arguments
class Planner:
    """Plans for a specification step by step, from observed samples (section 5.2 of the paper).

    Use as:

        planner = Planner(specification)
        planner.observe(sample)
        while (step := planner.next_step()).kind in ("execute", "wait"):
            outcome = executor.execute(step) if step.kind == "execute" else None
            planner.observe(sample)
            if outcome is not None:
                planner.conclude(outcome)

    The planner must observe every sample, also during an execution, because each sample moves the automaton.
    Every run ends: an edge is pruned after `Settings.attempts` failed motions of one object, and after a
    total of `MOST_MOTIONS`. Equal samples and outcomes give equal steps.

    Attributes:
        specification: specification to plan for.
        automaton: automaton of the planned spec.
        rate_hz: sampling rate that converts bounds in seconds; None without such bounds.
        bounds: sentence on bounds in seconds and their numbers of samples; empty without such bounds.
    """

    def __init__(
        self,
        specification: Specification,
        settings: Settings | None = None,
        *,
        name: str | None = None,
        rate_hz: float | None = None,
    ) -> None:
        """Begin before the first sample.

        Args:
            settings: settings of the planner. Without them, every object can be picked up and placed anywhere
                around the objects of the first sample.
            name: name of the spec to plan for; None for the only result of the specification.
            rate_hz: sampling rate, for bounds in seconds.

        Raises:
            NoAutomatonError: past operators, bounds in seconds without a rate, or too large a formula.
            UsageError: no such spec, several results without `name`, a template, propositions about earlier
                samples, or a wrong type of settings.
        """
        if settings is not None:
            refuse_faults(kind_faults("settings", settings, Settings, "Settings(workspace), or None"))
        self.automaton: Automaton = automaton_of(specification, name, rate_hz=rate_hz)
        formula = chosen_spec(specification, name).formula
        # without bounds in seconds, the automaton does not depend on the rate
        self.rate_hz = rate_hz if counts_seconds(formula) else None
        self.bounds = "" if rate_hz is None else bounds_in_samples(formula, rate_hz)
        refuse_template(specification, self.automaton.name)
        self._settings = settings
        self.specification = specification
        self._regions = specification.regions
        self._formulas = [proposition.formula for proposition in self.automaton.propositions]
        refuse_delays(self._formulas)
        self._specs = specs_of(formula, self._formulas)
        # in sentences, a spec names a long proposition that is its only one, unless the spec is `G …`
        uses = Counter(name for names in self._specs for name in names)
        temporal = (part for part in iter_formulas(formula) if isinstance(part, Temporal))
        uses += Counter(part.name for part in temporal if part.name and part.operator == "G")
        spec_names = (next((name for name in names if uses[name] == 1), None) for names in self._specs)
        named = [
            replace(proposition, name=spec_name)
            if spec_name and len(proposition.literal(True)) > _LONGEST_WANTED
            else proposition
            for proposition, spec_name in zip(self.automaton.propositions, spec_names, strict=True)
        ]
        self._words = self.automaton.with_propositions(named)
        self._states: frozenset[int] = frozenset({self.automaton.initial})
        # the states if goals that only empty groups satisfy are still open
        self._tested = self._states
        self._awaited: list[Group] = []
        # time of the newest observation of each object
        self._seen: dict[str, int] = {}
        self._sample: Sample | None = None
        self._observer = Observer(self._formulas, specification.regions)
        self._symbol: Symbol = ()
        self._stop_reason = ""
        self._lost: Loss | None = None
        self._pruned: dict[Edge, Reason] = {}
        # pruned edges that several motions may still take
        self._passed: set[Edge] = set()
        self._attempts = Attempts()
        self._running: Step | None = None
        # motions of the objects between the newest two samples
        self._motions: dict[str, Pose] = {}
        self._times = MotionTimes()
        self._decided: Sample | None = None
        # whether the motion must stop because of objects that move by themselves
        self._is_evaded = False
        # the motion that is delayed until other objects have passed
        self._delayed: Target | None = None
        # whether no sample came during the last motion aside
        self._is_idle = False
        self._yielded = 0
        self._waiting: Step | None = None
        self._ahead: tuple[int, ...] = ()
        self._steps = 0
        # the budget of the newest decision
        self._budget = Budget(MOST_MAPS)

    @property
    def settings(self) -> Settings:
        """The settings of the planner.

        Raises:
            UsageError: the settings depend on the first sample, which was not observed yet.
        """
        if self._settings is None:
            raise UsageError("where to plan depends on the first sample; observe one first, or give settings")
        return self._settings

    @property
    def states(self) -> tuple[int, ...]:
        """The possible states of the automaton; one state if all propositions were known."""
        return tuple(sorted(self._states))

    @property
    def motions(self) -> int:
        """The number of concluded motions; refused motions, during which no sample came, do not count."""
        return self._attempts.motions

    @property
    def has_observed(self) -> bool:
        """Whether the planner has observed a sample."""
        return self._sample is not None

    @property
    def is_accepting(self) -> bool:
        """Whether the observed samples satisfy the specification, by its propositions."""
        return self._sample is not None and self._states <= self.automaton.accepting

    @property
    def stop_reason(self) -> str:
        """The reason why a motion must stop now; empty while it may continue.

        A motion must stop if the predicted next sample loses acceptance. In this sample every object repeats
        its motion between the newest two samples, but the moved object stops at the end of its path. A
        motion must also stop if a moving object may come too near before its end, and waiting or a motion
        aside is safer. A robot that checks after each sample ends the motion with
        `Outcome(False, planner.stop_reason)`.
        """
        return self._stop_reason

    @property
    def is_doubtful(self) -> bool:
        """Whether the samples satisfy the specification, unless unknown propositions hid a violation.

        No later sample can resolve this doubt.
        """
        if self._sample is None or self._states.isdisjoint(self.automaton.accepting):
            return False
        open_states = self._states - self.automaton.accepting
        return bool(open_states) and open_states.isdisjoint(self.automaton.can_accept)

    def observe(self, sample: Sample) -> None:
        """Observe the next sample.

        Raises:
            TraceError: the sample's time is not after the previous sample's time.
            UsageError: not a sample; at the first sample, settings that name unknown objects, or neither
                settings nor objects.
        """
        require_sample(sample)
        if self._sample is not None and sample.time_ns <= self._sample.time_ns:
            at, last = times_apart(sample.time_ns, self._sample.time_ns)
            raise TraceError(f"a sample at {at} follows one at {last}; give times that increase")
        if self._settings is None:
            self._settings = Settings(Workspace.around(sample))
        if self._sample is None:
            refuse_unknown(self._settings.movable or (), sample, self._formulas)
        before, self._sample = self._sample, sample
        self._motions = {} if before is None else motions_between(before, sample)
        running = None if self._running is None else self._running.target
        if running is not None and running.name in sample.objects:
            length = math.hypot(*self._motions.get(running.name, (0.0, 0.0))[:2])
            self._times.observe(length, least_motion(self._settings))
        self._is_evaded = False
        states, symbol = self._states, self._symbol
        self._symbol = self._observer.symbol(sample)
        self._states = self.automaton.step_set(states, self._symbol)
        self._seen |= dict.fromkeys(sample.objects, sample.time_ns)
        self._test(sample)
        if self._lost is None and self._states.isdisjoint(self.automaton.can_accept):
            text = loss_text(self._words, states, symbol, self._symbol)
            self._lost = Loss(sample.time_ns, text)
        self._stop_reason = self._why_stop(before, sample)
        # a wait ends early if the automaton is not in the state to which time alone should have led
        self._ahead = self._ahead[1:] if not self._states.isdisjoint(self._ahead[:1]) else ()

    def _test(self, sample: Sample) -> None:
        """Update `_tested`: propositions of empty groups count as open, unless that loses acceptance."""
        groups = [groups_without_members(formula, sample) for formula in self._formulas]
        closed = self.automaton.step_set(self._tested, self._symbol)
        symbol = [None if empty else value for empty, value in zip(groups, self._symbol, strict=True)]
        still_open = self.automaton.step_set(self._tested, symbol) & self.automaton.can_accept
        self._awaited = [] if still_open <= closed else [group for empty in groups for group in empty]
        self._tested = closed | still_open

    @property
    def _lacks_members(self) -> bool:
        """Whether only groups without members satisfy the specification."""
        accepting = self.automaton.accepting
        return bool(self._awaited) and self._states <= accepting and not self._tested <= accepting

    def _why_stop(self, before: Sample | None, sample: Sample) -> str:
        """Return the reason why the motion must stop after two consecutive samples; "" if it may continue."""
        target = None if self._running is None else self._running.target
        if before is None or target is None or self._states.isdisjoint(self.automaton.can_accept):
            return ""
        was, now = before.objects.get(target.name), sample.objects.get(target.name)
        if was is None or now is None:
            return ""
        symbol = self._observer.symbol(next_sample(before, sample, target, self.settings.skill))
        if not self.automaton.step_set(self._states, symbol).isdisjoint(self.automaton.can_accept):
            evasion = self._evasion(target)
            self._is_evaded = evasion is not None
            return "" if evasion is None else f"stopped: {evasion.reason}"
        changes = zip(self._words.propositions, self._symbol, symbol, strict=True)
        changed = [
            proposition.literal(bool(after)) for proposition, value, after in changes if after is not value
        ]
        numbers = [number for number, value in enumerate(self._symbol) if symbol[number] is not value]
        self._is_evaded = self._is_about_movers(numbers, target.name)
        return (
            f"stopped: with the next sample, {' and '.join(changed) or 'the specification would be violated'}"
        )

    def _is_about_movers(self, numbers: Iterable[int], name: str) -> bool:
        """Return whether a proposition concerns another object that has moved since the decision."""
        moved = {} if self._decided is None else motions_between(self._decided, self._newest())
        formulas = [self._formulas[number] for number in numbers]
        return any(concerns(formula, mover) for mover in moved.keys() - {name} for formula in formulas)

    def _evasion(self, target: Target) -> Evasion | None:
        """Return how to evade moving objects; None if a motion to a target may continue."""
        return self._lookout.evasion(self._newest(), self._states, self._motions, target, self._timing)

    @property
    def _lookout(self) -> Lookout:
        return Lookout(self.automaton, self._formulas, self._regions, self.settings)

    @property
    def _timing(self) -> Timing:
        return self._times.timing(self.settings.workspace.grid.cell_size)

    def next_step(self) -> Step:
        """Return the next decision (Algorithm 1).

        The planner prunes edges that no movable object can take now, and tries the next shortest path, until
        an edge can be taken or no path is left. During a wait it returns the same step.

        Raises:
            UsageError: no sample was observed yet, or the last step was not concluded.
        """
        self._newest()
        if self._running is not None:
            raise UsageError(
                f"step {self._running.number} is being executed; conclude it with its outcome first"
            )
        if self._waiting is not None and self._waits_on(self._waiting):
            return self._waiting
        step = self._next_step()
        self._delayed = None
        if step.target is not None and self._yielded < MOST_YIELDED:
            step = self._yielding(step, step.target)
        self._running = step if step.kind == "execute" else None
        self._decided = self._newest()
        self._waiting = step if step.kind == "wait" else None
        self._ahead = step.ahead
        return step

    def conclude(self, outcome: Outcome) -> None:
        """Record the outcome of the last step, after the samples of its execution.

        Later targets of the object avoid the place of a failed motion.

        Raises:
            UsageError: not an outcome, or no step is being executed.
        """
        if not isinstance(outcome, Outcome):
            raise UsageError(f"{outcome!r} is no outcome; give an Outcome(succeeded, reason)")
        step = self._running
        if step is None or step.target is None or step.aim is None:
            raise UsageError("no step is being executed; call next_step() first")
        self._running = None
        self._times.end()
        # a concluded motion is over, so the object counts as standing
        self._motions.pop(step.target.name, None)
        # a controller returns the stop reason unchanged
        is_stopped = not outcome.succeeded and outcome.reason == self._stop_reason
        if self._delayed is not None:
            # a motion aside is no attempt at an edge
            self._attempts.motions += 1
            self._is_idle = self._decided is self._newest()
        elif is_stopped and self._is_evaded and self._yielded < MOST_YIELDED:
            # stopped for a moving object, which does not count as a failure
            self._attempts.motions += 1
            self._attempts.withdraw(step.aim.edge, step.target.name)
        else:
            about = step.aim, step.target, outcome, self.states, self._newest()
            self._attempts.conclude(*about, is_stopped=is_stopped)
            self._yielded = 0 if outcome.succeeded else self._yielded

    def _yielding(self, step: Step, target: Target) -> Step:
        """Return the step of a motion, or a step that first evades moving objects."""
        if step.aim is None:
            return step
        target = self._lookout.past_others(self._newest(), self._motions, target, step.aim, self._timing)
        evasion = self._evasion(target)
        if evasion is None:
            return replace(step, target=target)
        self._attempts.withdraw(step.aim.edge, target.name)
        self._delayed = target
        self._yielded += 1
        # without a sample during the last motion aside, the robot did not move; so wait instead
        aside = None if self._is_idle else evasion.aside
        self._is_idle = False
        if aside is None:
            return replace(step, kind="wait", target=None, reason=f"wait: {evasion.reason}")
        place = f"({aside.x:.4g}, {aside.y:.4g})"
        reason = f"{aside.name} goes aside to {place}: {evasion.reason}"
        return replace(step, target=aside, reason=reason)

    def _waits_on(self, step: Step) -> bool:
        if self._delayed is not None:
            self._yielded += 1
            evasion = self._evasion(self._delayed) if self._yielded < MOST_YIELDED else None
            return evasion is not None and evasion.aside is None
        return bool(self._ahead) if step.ahead else self._is_blind() or self._lacks_members

    def _is_blind(self) -> bool:
        """Return whether unknown propositions leave several states possible that do not all accept."""
        is_accepting = self._states <= self.automaton.accepting
        return len(self._states) > 1 and None in self._symbol and not is_accepting

    def _next_step(self) -> Step:
        self._budget = Budget(MOST_MAPS)
        if self._lacks_members:
            groups = absence_text(self._awaited, self._newest())
            return self._decision("wait", (), f"nothing shows that it is done: no object is in {groups}")
        if self._states <= self.automaton.accepting:
            if self._tested <= self.automaton.accepting:
                return self._decision("hold", (), "the specification is satisfied: hold")
            # groups have members now, which do not satisfy the goal yet
            self._states = self._tested
        if self._is_blind():
            return self._decision("wait", (), f"not enough is seen: {self._unknown()}")
        state = worst_state(self.automaton, self.states)
        if state is None:
            reason = "no path left: the specification cannot be satisfied any more"
            return self._decision("no path", (), reason)
        if self.is_doubtful:
            return self._decision("hold", (), "satisfied, unless it was violated while not enough was seen")
        return self._step_from(state)

    def _step_from(self, state: int) -> Step:
        """Return the step for the first edge that can be taken, over paths of increasing length."""
        idle = idle_transitions(self.automaton, state, self._symbol)
        foresight = self._foresight(self._attempts)
        considered: list[Consideration] = []
        undecided: dict[int, tuple[Consideration, tuple[Transition, ...], frozenset[Edge]]] = {}
        # time takes idle transitions without any motion, so they remain possible
        given_up = frozenset(self._pruned) - self._passed
        pruned = given_up - idle.edges
        while (path := next(self.automaton.paths(state, pruned), None)) and not idle.along(path):
            aim = consideration_of(self._words, path, pruned, self._symbol)
            aim = replace(
                aim,
                failed=self._attempts.failures(aim.edge),
                order=order_text(self.automaton, path, pruned | idle.edges),
            )
            exhausted = self._attempts.why_not_again(aim.edge, self.settings.attempts)
            if exhausted is not None:
                considered.append(replace(aim, pruned=exhausted))
                self._passed.discard(aim.edge)
            else:
                aim = self._consider(aim, path, foresight.movables)
                before = pruned | given_up
                undecided[len(considered)] = aim, path, before
                considered.append(foresight.decide(aim, path, before))
                self._passed.add(aim.edge)
            if (reason := considered[-1].pruned) is None:
                return self._running_step(considered)
            self._pruned[aim.edge] = reason
            pruned |= {aim.edge, *equivalent_edges(self.automaton, aim, idle, pruned, self._symbol)}
        # edges that need several motions, or a motion that failed before, come after all other edges
        for number, (alone, way, before) in undecided.items():
            decision = foresight.decide(alone, way, before, together=True)
            if decision.pruned and self._attempts.motions > 0:
                # a motion may fail by chance, so a failed motion is repeated if there is no other
                again = self._foresight(self._attempts.forgiven())
                repeated = self._consider(alone, way, again.movables)
                repeated = again.decide(repeated, way, before, together=True)
                decision = decision if repeated.pruned else repeated
            considered[number] = decision
            if decision.pruned is None:
                return self._running_step(considered[: number + 1])
            self._pruned[decision.edge] = decision.pruned
            self._passed.discard(decision.edge)
        if path is not None:
            considered.append(consideration_of(self._words, path, pruned, self._symbol))
            return self._waiting_step(considered, idle.along(path))
        why = ""
        if considered and self.settings.motions > 1 and not self._attempts.are_any:
            first = considered[0].pruned
            is_later = any(reason.kind == LATER for reason in self._pruned.values())
            why = foresight.why_not(state) or ("" if first is None or is_later else first.detail)
        said = why_no_path(self.automaton, state, self._pruned, why)
        if self._budget.left <= 0:
            said += f"; the search ended after {MOST_MAPS} maps, and there may be a way that it did not find"
        return self._decision("no path", considered, said)

    def _foresight(self, attempts: Attempts) -> Lookahead:
        about = self.automaton, self._formulas, self._regions, self.settings
        return Lookahead(Expectations(*about, attempts, self._budget), self._newest())

    def _consider(
        self, consideration: Consideration, path: tuple[Transition, ...], movables: Movables
    ) -> Consideration:
        """Return an edge with its candidates and the best one chosen; pruned if no single motion takes it."""
        later = moved_later(path, self._symbol, self._formulas, movables.names)
        candidates = [
            movables.candidate(name, consideration, later, refine=True)
            for name in movables.names_for(consideration.progress)
        ]
        return with_choice(replace(consideration, pruned=None), candidates, self.settings)

    def _waiting_step(self, considered: list[Consideration], ahead: tuple[int, ...]) -> Step:
        reason = f"wait for {plural(len(ahead), 'sample')}: time alone leads on, to state {ahead[-1]}"
        return replace(self._decision("wait", considered, reason), ahead=ahead)

    def _running_step(self, considered: list[Consideration]) -> Step:
        aim = considered[-1]
        (target,) = [candidate.target for candidate in aim.candidates if candidate.is_chosen]
        if target is None:
            raise UsageError("the chosen object has no target")
        self._attempts.begin(aim.edge, target.name, self._newest(), self.settings)
        self._pruned.pop(aim.edge, None)
        verb = "push" if self.settings.skill == "push" else "place"
        edge = f"{aim.edge[0]} -> {aim.edge[1]}"
        which = f", the first of {len(aim.motions)} motions," if aim.is_joint and len(aim.motions) > 1 else ""
        what = f"{verb} {target.name} at ({target.x:.4g}, {target.y:.4g}){which} for the edge {edge}"
        reason = f"{self._why(aim, target)}. {what}"
        return replace(self._decision("execute", considered, reason), target=target)

    def bans(self, consideration: Consideration, pruned: Iterable[tuple[Edge, Reason]]) -> tuple[Ban, ...]:
        """Return the shortest bans for the way to an edge.

        Args:
            pruned: pruned edges, whose guards the bans may also forbid.
        """
        source = consideration.edge[0]
        given_up: list[str] = []
        for edge, _ in pruned:
            transition = self._words.transition(*edge) if edge[0] == source else None
            if transition is not None and edge != consideration.edge and not transition.is_cut:
                given_up += guards_of(self._words, [transition]).texts
        return bans_of(consideration.constraints.texts, given_up)

    def _why(self, aim: Consideration, target: Target) -> str:
        """Return the reason why an object is moved, and why it is preferred to other objects."""
        name = target.name
        wrong = (
            [literal for literal in cube if self._symbol[literal[0]] is not literal[1]]
            for cube in aim.progress.cubes
        )
        unmet = min(wrong, key=len)
        relevant = [literal for literal in unmet if concerns(self._formulas[literal[0]], name)]
        later = [motion.name for motion in aim.motions[1:]]
        others = [mover for mover in later if mover != name]
        if aim.is_joint and others and (name in later or not relevant):
            failed = self._attempts.failed_here(others[0], self._newest(), self.settings)
            why = "could not be moved next to it" if failed else "has to pass"
            return f"{name} goes aside: {others[0]} {why}"
        goal = " and ".join(self._wanted_text(*literal) for literal in relevant or unmet)
        why = f"{name} moves{goal and f': {goal} is wanted'}"
        rivals = [
            candidate.target for candidate in aim.candidates if candidate.target and not candidate.is_chosen
        ]
        if aim.is_joint or not rivals:
            return why
        rival = min(rivals, key=lambda rival: costs_of(rival, self.settings.skill))
        names = [candidate.name for candidate in aim.candidates]
        is_later = names.index(rival.name) > names.index(name)
        return f"{why}; {rival.name} could do it with {self._comparison(rival, target, is_later)}"

    def _comparison(self, rival: Target, target: Target, is_later: bool) -> str:
        """Return the difference between the target of a rival and the chosen target.

        Args:
            is_later: whether the rival comes later in the order of objects.
        """
        skill = self.settings.skill
        rows = list(zip(_COMPARED[skill], costs_of(rival, skill), costs_of(target, skill), strict=True))
        (same, *_), *costs = rows[0]
        if costs[0] != costs[1]:
            return _difference_text(rows[0])
        equal = f"{same} ({abs(costs[0]):.3g})"
        (same, *_), *costs = rows[1]
        if costs[0] != costs[1]:
            return f"{equal}, and {_difference_text(rows[1])}"
        order = "by name" if self.settings.movable is None else "in `movable`"
        return f"{equal} and {same}, {f'and comes later {order}' if is_later else _LEADS_NOWHERE}"

    def _wanted_text(self, number: int, value: bool) -> str:
        """Return the text of a literal with the names of its specs; only the names for a long text."""
        text, specs = self._words.propositions[number].literal(value), " and ".join(self._specs[number])
        if not specs or self._words.propositions[number].name:
            return text
        return specs if len(text) > _LONGEST_WANTED else f"{text} ({specs})"

    def _decision(self, kind: Kind, considered: Iterable[Consideration], reason: str) -> Step:
        number, self._steps = self._steps, self._steps + 1
        pruned = tuple(sorted(self._pruned.items()))
        time_ns = self._newest().time_ns
        lost = self._lost
        about = self.states, tuple(considered), None, pruned, reason
        return Step(number, time_ns, kind, *about, lost=lost, search=self._budget.search)

    def _newest(self) -> Sample:
        if self._sample is None:
            raise UsageError("there is nothing to plan on; observe a sample first")
        return self._sample

    def _unknown(self) -> str:
        """Return the labels of the unknown propositions in the newest sample, with the reasons."""
        numbers = [number for number, value in enumerate(self._symbol) if value is None]
        labels = ", ".join(self._words.propositions[number].label for number in numbers)
        formulas = [self._formulas[number] for number in numbers]
        reasons = unknown_reasons(formulas, self._newest(), self._seen, self._regions)
        return f"{labels} unknown: {'; '.join(reasons)}" if reasons else f"{labels} unknown"


_LENGTH: Final = "the same length of way", "a longer way", "a shorter way"
_ROBUSTNESS: Final = "the same robustness", "less robustness", "more robustness"
_COMPARED: Final = {"push": (_LENGTH, _ROBUSTNESS), "place": (_ROBUSTNESS, _LENGTH)}
"""Words for an equal, a worse and a better target, for each cost in the order of `costs_of`."""
_LEADS_NOWHERE: Final = "but no motions lead on from there"


def _difference_text(row: tuple[tuple[str, str, str], float, float]) -> str:
    """Return the comparison of a rival's cost with the least cost, in words."""
    (_, worse, better), cost, least = row
    numbers = f"({abs(cost):.3g}, here {abs(least):.3g})"
    return f"{worse} {numbers}" if cost > least else f"{better} {numbers}, {_LEADS_NOWHERE}"


MOST_YIELDED: Final = 1800
"""Maximum number of waiting samples and motions aside without a successful motion; then motions do not wait.

In a minute at 30 Hz, a person who walks two metres to and fro at 0.1 m/s leaves the path free.
"""
