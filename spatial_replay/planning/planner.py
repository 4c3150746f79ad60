"""The planner (Algorithm 1 of the paper): motions take the automaton's edges, one edge at a time."""

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
"""Maximum length of a proposition in a reason, characters; a spec's name replaces a longer proposition."""


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
    Every run ends: an edge is pruned after `Settings.attempts` failed motions of one object, and after
    `MOST_MOTIONS` motions in total. Equal samples and outcomes give equal steps.

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
            settings: settings of the planner. Without settings, every object can be picked up and placed
                anywhere around the objects of the first sample.
            name: name of the spec to plan for; None for the only result of the specification.
            rate_hz: sampling rate, for bounds in seconds.

        Raises:
            NoAutomatonError: the formula has past operators, has bounds in seconds without a rate, or is too
                large.
            UsageError: no such spec, several results without `name`, a template, propositions about earlier
                samples, or settings of a wrong type.
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
        # in sentences, the spec's name replaces a long proposition if the spec has no other proposition.
        # a spec `G …` never replaces its proposition
        name_counts = Counter(name for names in self._specs for name in names)
        temporal_parts = (part for part in iter_formulas(formula) if isinstance(part, Temporal))
        name_counts += Counter(part.name for part in temporal_parts if part.name and part.operator == "G")
        spec_names = (next((name for name in names if name_counts[name] == 1), None) for names in self._specs)
        named_propositions = [
            replace(proposition, name=spec_name)
            if spec_name and len(proposition.literal(True)) > _LONGEST_WANTED
            else proposition
            for proposition, spec_name in zip(self.automaton.propositions, spec_names, strict=True)
        ]
        self._named_automaton = self.automaton.with_propositions(named_propositions)
        self._states: frozenset[int] = frozenset({self.automaton.initial})
        # the possible states if goals that only empty groups satisfy count as open
        self._tested_states = self._states
        self._empty_groups: list[Group] = []
        # time of the newest observation of each object
        self._seen_ns: dict[str, int] = {}
        self._sample: Sample | None = None
        self._observer = Observer(self._formulas, specification.regions)
        self._symbol: Symbol = ()
        self._stop_reason = ""
        self._loss: Loss | None = None
        self._prune_reasons: dict[Edge, Reason] = {}
        # pruned edges that a sequence of several motions may still take
        self._joint_edges: set[Edge] = set()
        self._attempts = Attempts()
        self._current_step: Step | None = None
        # motions of the objects between the newest two samples
        self._object_motions: dict[str, Pose] = {}
        self._motion_times = MotionTimes()
        self._decision_sample: Sample | None = None
        # whether the motion must stop because of objects that move without the robot
        self._is_evaded = False
        # the motion that is delayed until other objects have passed
        self._delayed_target: Target | None = None
        # whether no sample came during the last motion aside
        self._is_idle = False
        self._yield_count = 0
        self._wait_step: Step | None = None
        self._expected_states: tuple[int, ...] = ()
        self._step_count = 0
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
        """The number of concluded motions; refused motions, which have no sample, do not count."""
        return self._attempts.motions

    @property
    def has_observed(self) -> bool:
        """Whether the planner has observed a sample."""
        return self._sample is not None

    @property
    def is_accepting(self) -> bool:
        """Whether the observed samples satisfy the specification, for any values of unknown propositions."""
        return self._sample is not None and self._states <= self.automaton.accepting

    @property
    def stop_reason(self) -> str:
        """The reason why a motion must stop now; empty while it may continue.

        A motion must stop if the predicted next sample loses acceptance. In the prediction, every object
        repeats its motion between the newest two samples. The object that the robot moves stops at the end of
        its path. A motion must also stop if waiting or a motion aside is safer, because another object may
        come too near. A robot checks the reason after each sample, and ends a motion that must stop with
        `Outcome(False, planner.stop_reason)`.
        """
        return self._stop_reason

    @property
    def is_doubtful(self) -> bool:
        """Whether unknown propositions may hide a violation of an otherwise satisfied specification.

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
            sample_time, previous_time = times_apart(sample.time_ns, self._sample.time_ns)
            raise TraceError(
                f"a sample at {sample_time} follows one at {previous_time}; give times that increase"
            )
        if self._settings is None:
            self._settings = Settings(Workspace.around(sample))
        if self._sample is None:
            refuse_unknown(self._settings.movable or (), sample, self._formulas)
        previous_sample, self._sample = self._sample, sample
        self._object_motions = {} if previous_sample is None else motions_between(previous_sample, sample)
        running_target = None if self._current_step is None else self._current_step.target
        if running_target is not None and running_target.name in sample.objects:
            moved_length = math.hypot(*self._object_motions.get(running_target.name, (0.0, 0.0))[:2])
            self._motion_times.observe(moved_length, least_motion(self._settings))
        self._is_evaded = False
        previous_states, previous_symbol = self._states, self._symbol
        self._symbol = self._observer.symbol(sample)
        self._states = self.automaton.step_set(previous_states, self._symbol)
        self._seen_ns |= dict.fromkeys(sample.objects, sample.time_ns)
        self._test(sample)
        if self._loss is None and self._states.isdisjoint(self.automaton.can_accept):
            condition = loss_text(self._named_automaton, previous_states, previous_symbol, self._symbol)
            self._loss = Loss(sample.time_ns, condition)
        self._stop_reason = self._why_stop(previous_sample, sample)
        # a wait ends early if the automaton is not in the state that the wait expects
        self._expected_states = (
            self._expected_states[1:] if not self._states.isdisjoint(self._expected_states[:1]) else ()
        )

    def _test(self, sample: Sample) -> None:
        """Update `_tested_states`.

        A proposition about an empty group may have any value that allows acceptance.
        """
        empty_groups = [groups_without_members(formula, sample) for formula in self._formulas]
        closed_states = self.automaton.step_set(self._tested_states, self._symbol)
        symbol = [None if empty else value for empty, value in zip(empty_groups, self._symbol, strict=True)]
        open_states = self.automaton.step_set(self._tested_states, symbol) & self.automaton.can_accept
        self._empty_groups = (
            [] if open_states <= closed_states else [group for empty in empty_groups for group in empty]
        )
        self._tested_states = closed_states | open_states

    @property
    def _lacks_members(self) -> bool:
        """Whether only groups without members satisfy the specification."""
        accepting = self.automaton.accepting
        return bool(self._empty_groups) and self._states <= accepting and not self._tested_states <= accepting

    def _why_stop(self, previous_sample: Sample | None, sample: Sample) -> str:
        """Return the reason why the motion must stop after two consecutive samples, or ""."""
        target = None if self._current_step is None else self._current_step.target
        if previous_sample is None or target is None or self._states.isdisjoint(self.automaton.can_accept):
            return ""
        previous_object, tracked = previous_sample.objects.get(target.name), sample.objects.get(target.name)
        if previous_object is None or tracked is None:
            return ""
        next_symbol = self._observer.symbol(next_sample(previous_sample, sample, target, self.settings.skill))
        if not self.automaton.step_set(self._states, next_symbol).isdisjoint(self.automaton.can_accept):
            evasion = self._evasion(target)
            self._is_evaded = evasion is not None
            return "" if evasion is None else f"stopped: {evasion.reason}"
        changes = zip(self._named_automaton.propositions, self._symbol, next_symbol, strict=True)
        causes = [
            proposition.literal(bool(next_value))
            for proposition, value, next_value in changes
            if next_value is not value
        ]
        changed_numbers = [
            number for number, value in enumerate(self._symbol) if next_symbol[number] is not value
        ]
        self._is_evaded = self._is_about_movers(changed_numbers, target.name)
        return (
            f"stopped: with the next sample, {' and '.join(causes) or 'the specification would be violated'}"
        )

    def _is_about_movers(self, proposition_numbers: Iterable[int], name: str) -> bool:
        """Return whether a proposition concerns another object that has moved since the decision."""
        motions = (
            {} if self._decision_sample is None else motions_between(self._decision_sample, self._newest())
        )
        formulas = [self._formulas[number] for number in proposition_numbers]
        return any(concerns(formula, mover) for mover in motions.keys() - {name} for formula in formulas)

    def _evasion(self, target: Target) -> Evasion | None:
        """Return how to evade moving objects; None if a motion to a target may continue."""
        return self._lookout.evasion(self._newest(), self._states, self._object_motions, target, self._timing)

    @property
    def _lookout(self) -> Lookout:
        return Lookout(self.automaton, self._formulas, self._regions, self.settings)

    @property
    def _timing(self) -> Timing:
        return self._motion_times.timing(self.settings.workspace.grid.cell_size)

    def next_step(self) -> Step:
        """Return the next decision (Algorithm 1).

        The planner prunes each edge that no movable object can take now, and tries the next shortest path.
        The search ends with an edge that can be taken, or without a path. During a wait, the same step is
        returned.

        Raises:
            UsageError: no sample was observed yet, or the last step was not concluded.
        """
        self._newest()
        if self._current_step is not None:
            raise UsageError(
                f"step {self._current_step.number} is being executed; conclude it with its outcome first"
            )
        if self._wait_step is not None and self._waits_on(self._wait_step):
            return self._wait_step
        step = self._next_step()
        self._delayed_target = None
        if step.target is not None and self._yield_count < MOST_YIELDED:
            step = self._yielding(step, step.target)
        self._current_step = step if step.kind == "execute" else None
        self._decision_sample = self._newest()
        self._wait_step = step if step.kind == "wait" else None
        self._expected_states = step.ahead
        return step

    def conclude(self, outcome: Outcome) -> None:
        """Record the outcome of the last step, after the samples of its execution.

        Later targets of the object avoid the place of a failed motion.

        Raises:
            UsageError: not an outcome, or no step is being executed.
        """
        if not isinstance(outcome, Outcome):
            raise UsageError(f"{outcome!r} is no outcome; give an Outcome(succeeded, reason)")
        step = self._current_step
        if step is None or step.target is None or step.aim is None:
            raise UsageError("no step is being executed; call next_step() first")
        self._current_step = None
        self._motion_times.end()
        # a concluded motion is over, so the object counts as standing
        self._object_motions.pop(step.target.name, None)
        # a controller returns the stop reason unchanged
        is_stopped = not outcome.succeeded and outcome.reason == self._stop_reason
        if self._delayed_target is not None:
            # a motion aside is no attempt at an edge
            self._attempts.motions += 1
            self._is_idle = self._decision_sample is self._newest()
        elif is_stopped and self._is_evaded and self._yield_count < MOST_YIELDED:
            # stopped for a moving object, which does not count as a failure
            self._attempts.motions += 1
            self._attempts.withdraw(step.aim.edge, step.target.name)
        else:
            motion_record = step.aim, step.target, outcome, self.states, self._newest()
            self._attempts.conclude(*motion_record, is_stopped=is_stopped)
            self._yield_count = 0 if outcome.succeeded else self._yield_count

    def _yielding(self, step: Step, target: Target) -> Step:
        """Return the step with its motion, or a step that evades moving objects before the motion."""
        if step.aim is None:
            return step
        target = self._lookout.past_others(
            self._newest(), self._object_motions, target, step.aim, self._timing
        )
        evasion = self._evasion(target)
        if evasion is None:
            return replace(step, target=target)
        self._attempts.withdraw(step.aim.edge, target.name)
        self._delayed_target = target
        self._yield_count += 1
        # without a sample during the last motion aside, the robot did not move, so the step is a wait
        aside_target = None if self._is_idle else evasion.aside
        self._is_idle = False
        if aside_target is None:
            return replace(step, kind="wait", target=None, reason=f"wait: {evasion.reason}")
        place_text = f"({aside_target.x:.4g}, {aside_target.y:.4g})"
        reason = f"{aside_target.name} goes aside to {place_text}: {evasion.reason}"
        return replace(step, target=aside_target, reason=reason)

    def _waits_on(self, step: Step) -> bool:
        if self._delayed_target is not None:
            self._yield_count += 1
            evasion = self._evasion(self._delayed_target) if self._yield_count < MOST_YIELDED else None
            return evasion is not None and evasion.aside is None
        return bool(self._expected_states) if step.ahead else self._is_blind() or self._lacks_members

    def _is_blind(self) -> bool:
        """Return whether unknown propositions leave several states possible that do not all accept."""
        is_accepting = self._states <= self.automaton.accepting
        return len(self._states) > 1 and None in self._symbol and not is_accepting

    def _next_step(self) -> Step:
        self._budget = Budget(MOST_MAPS)
        if self._lacks_members:
            groups_text = absence_text(self._empty_groups, self._newest())
            return self._decision("wait", (), f"nothing shows that it is done: no object is in {groups_text}")
        if self._states <= self.automaton.accepting:
            if self._tested_states <= self.automaton.accepting:
                return self._decision("hold", (), "the specification is satisfied: hold")
            # empty groups have received members, which do not satisfy the goal yet
            self._states = self._tested_states
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
        lookahead = self._foresight(self._attempts)
        considerations: list[Consideration] = []
        undecided_aims: dict[int, tuple[Consideration, tuple[Transition, ...], frozenset[Edge]]] = {}
        # time takes idle transitions without any motion, so they remain possible
        given_up_edges = frozenset(self._prune_reasons) - self._joint_edges
        pruned_edges = given_up_edges - idle.edges
        while (path := next(self.automaton.paths(state, pruned_edges), None)) and not idle.along(path):
            aim = consideration_of(self._named_automaton, path, pruned_edges, self._symbol)
            aim = replace(
                aim,
                failed=self._attempts.failures(aim.edge),
                order=order_text(self.automaton, path, pruned_edges | idle.edges),
            )
            limit_reason = self._attempts.why_not_again(aim.edge, self.settings.attempts)
            if limit_reason is not None:
                considerations.append(replace(aim, pruned=limit_reason))
                self._joint_edges.discard(aim.edge)
            else:
                aim = self._consider(aim, path, lookahead.movables)
                pruned_before = pruned_edges | given_up_edges
                undecided_aims[len(considerations)] = aim, path, pruned_before
                considerations.append(lookahead.decide(aim, path, pruned_before))
                self._joint_edges.add(aim.edge)
            if (reason := considerations[-1].pruned) is None:
                return self._running_step(considerations)
            self._prune_reasons[aim.edge] = reason
            pruned_edges |= {
                aim.edge,
                *equivalent_edges(self.automaton, aim, idle, pruned_edges, self._symbol),
            }
        # edges that need several motions, or that repeat a failed motion, come after all other edges
        for index, (single_aim, aim_path, pruned_before) in undecided_aims.items():
            decision = lookahead.decide(single_aim, aim_path, pruned_before, together=True)
            if decision.pruned and self._attempts.motions > 0:
                # a motion may fail by chance, so a failed motion is repeated if there is no other motion
                repeat_lookahead = self._foresight(self._attempts.forgiven())
                repeat_decision = self._consider(single_aim, aim_path, repeat_lookahead.movables)
                repeat_decision = repeat_lookahead.decide(
                    repeat_decision, aim_path, pruned_before, together=True
                )
                decision = decision if repeat_decision.pruned else repeat_decision
            considerations[index] = decision
            if decision.pruned is None:
                return self._running_step(considerations[: index + 1])
            self._prune_reasons[decision.edge] = decision.pruned
            self._joint_edges.discard(decision.edge)
        if path is not None:
            considerations.append(consideration_of(self._named_automaton, path, pruned_edges, self._symbol))
            return self._waiting_step(considerations, idle.along(path))
        why = ""
        if considerations and self.settings.motions > 1 and not self._attempts.are_any:
            first_reason = considerations[0].pruned
            is_later = any(reason.kind == LATER for reason in self._prune_reasons.values())
            why = lookahead.why_not(state) or (
                "" if first_reason is None or is_later else first_reason.detail
            )
        sentence = why_no_path(self.automaton, state, self._prune_reasons, why)
        if self._budget.left <= 0:
            sentence += (
                f"; the search ended after {MOST_MAPS} maps, and there may be a way that it did not find"
            )
        return self._decision("no path", considerations, sentence)

    def _foresight(self, attempts: Attempts) -> Lookahead:
        automaton_inputs = self.automaton, self._formulas, self._regions, self.settings
        return Lookahead(Expectations(*automaton_inputs, attempts, self._budget), self._newest())

    def _consider(
        self, consideration: Consideration, path: tuple[Transition, ...], movables: Movables
    ) -> Consideration:
        """Return an edge with its candidates; pruned if no single motion takes the edge."""
        later_names = moved_later(path, self._symbol, self._formulas, movables.names)
        candidates = [
            movables.candidate(name, consideration, later_names, refine=True)
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
        self._prune_reasons.pop(aim.edge, None)
        verb = "push" if self.settings.skill == "push" else "place"
        edge_text = f"{aim.edge[0]} -> {aim.edge[1]}"
        count_text = (
            f", the first of {len(aim.motions)} motions," if aim.is_joint and len(aim.motions) > 1 else ""
        )
        action = (
            f"{verb} {target.name} at ({target.x:.4g}, {target.y:.4g}){count_text} for the edge {edge_text}"
        )
        reason = f"{self._why(aim, target)}. {action}"
        return replace(self._decision("execute", considered, reason), target=target)

    def bans(self, consideration: Consideration, pruned: Iterable[tuple[Edge, Reason]]) -> tuple[Ban, ...]:
        """Return the shortest bans on the way to an edge.

        Args:
            pruned: pruned edges, whose guards the bans may also forbid.
        """
        source = consideration.edge[0]
        pruned_guards: list[str] = []
        for edge, _ in pruned:
            transition = self._named_automaton.transition(*edge) if edge[0] == source else None
            if transition is not None and edge != consideration.edge and not transition.is_cut:
                pruned_guards += guards_of(self._named_automaton, [transition]).texts
        return bans_of(consideration.constraints.texts, pruned_guards)

    def _why(self, aim: Consideration, target: Target) -> str:
        """Return the reason why an object is moved, and why the object is preferred to other objects."""
        name = target.name
        unmet_by_cube = (
            [literal for literal in cube if self._symbol[literal[0]] is not literal[1]]
            for cube in aim.progress.cubes
        )
        unmet_literals = min(unmet_by_cube, key=len)
        relevant_literals = [
            literal for literal in unmet_literals if concerns(self._formulas[literal[0]], name)
        ]
        later_names = [motion.name for motion in aim.motions[1:]]
        other_names = [mover for mover in later_names if mover != name]
        if aim.is_joint and other_names and (name in later_names or not relevant_literals):
            failed_targets = self._attempts.failed_here(other_names[0], self._newest(), self.settings)
            sentence = "could not be moved next to it" if failed_targets else "has to pass"
            return f"{name} goes aside: {other_names[0]} {sentence}"
        goal = " and ".join(self._wanted_text(*literal) for literal in relevant_literals or unmet_literals)
        sentence = f"{name} moves{goal and f': {goal} is wanted'}"
        rival_targets = [
            candidate.target for candidate in aim.candidates if candidate.target and not candidate.is_chosen
        ]
        if aim.is_joint or not rival_targets:
            return sentence
        rival = min(rival_targets, key=lambda rival: costs_of(rival, self.settings.skill))
        candidate_names = [candidate.name for candidate in aim.candidates]
        is_later = candidate_names.index(rival.name) > candidate_names.index(name)
        return f"{sentence}; {rival.name} could do it with {self._comparison(rival, target, is_later)}"

    def _comparison(self, rival: Target, target: Target, is_later: bool) -> str:
        """Return the difference between the target of a rival and the chosen target.

        Args:
            is_later: whether the rival comes later in the order of objects.
        """
        skill = self.settings.skill
        comparisons = list(
            zip(_COMPARED[skill], costs_of(rival, skill), costs_of(target, skill), strict=True)
        )
        (equal_words, *_), *costs = comparisons[0]
        if costs[0] != costs[1]:
            return _difference_text(comparisons[0])
        equality = f"{equal_words} ({abs(costs[0]):.3g})"
        (equal_words, *_), *costs = comparisons[1]
        if costs[0] != costs[1]:
            return f"{equality}, and {_difference_text(comparisons[1])}"
        order = "by name" if self.settings.movable is None else "in `movable`"
        return f"{equality} and {equal_words}, {f'and comes later {order}' if is_later else _LEADS_NOWHERE}"

    def _wanted_text(self, proposition_number: int, is_wanted: bool) -> str:
        """Return the text of a literal with the names of its specs; a long text is left out."""
        text, spec_text = (
            self._named_automaton.propositions[proposition_number].literal(is_wanted),
            " and ".join(self._specs[proposition_number]),
        )
        if not spec_text or self._named_automaton.propositions[proposition_number].name:
            return text
        return spec_text if len(text) > _LONGEST_WANTED else f"{text} ({spec_text})"

    def _decision(self, kind: Kind, considered: Iterable[Consideration], reason: str) -> Step:
        step_number, self._step_count = self._step_count, self._step_count + 1
        pruned_reasons = tuple(sorted(self._prune_reasons.items()))
        time_ns = self._newest().time_ns
        lost = self._loss
        step_fields = self.states, tuple(considered), None, pruned_reasons, reason
        return Step(step_number, time_ns, kind, *step_fields, lost=lost, search=self._budget.search)

    def _newest(self) -> Sample:
        if self._sample is None:
            raise UsageError("there is nothing to plan on; observe a sample first")
        return self._sample

    def _unknown(self) -> str:
        """Return the labels of the unknown propositions in the newest sample, with the reasons."""
        unknown_numbers = [number for number, value in enumerate(self._symbol) if value is None]
        labels = ", ".join(self._named_automaton.propositions[number].label for number in unknown_numbers)
        formulas = [self._formulas[number] for number in unknown_numbers]
        reasons = unknown_reasons(formulas, self._newest(), self._seen_ns, self._regions)
        return f"{labels} unknown: {'; '.join(reasons)}" if reasons else f"{labels} unknown"


_LENGTH: Final = "the same length of way", "a longer way", "a shorter way"
_ROBUSTNESS: Final = "the same robustness", "less robustness", "more robustness"
_COMPARED: Final = {"push": (_LENGTH, _ROBUSTNESS), "place": (_ROBUSTNESS, _LENGTH)}
"""Words for an equal, a worse and a better target, for each cost in the order of `costs_of`."""
_LEADS_NOWHERE: Final = "but no motions lead on from there"


def _difference_text(comparison: tuple[tuple[str, str, str], float, float]) -> str:
    """Return the comparison of a rival's cost with the least cost, in words."""
    (_, worse, better), cost, least_cost = comparison
    numbers_text = f"({abs(cost):.3g}, here {abs(least_cost):.3g})"
    return f"{worse} {numbers_text}" if cost > least_cost else f"{better} {numbers_text}, {_LEADS_NOWHERE}"


MOST_YIELDED: Final = 1800
"""Maximum number of waiting samples and motions aside without a successful motion.

After this number, motions no longer wait.
In a minute at 30 Hz, a person who walks two metres to and fro at 0.1 m/s leaves the path free.
"""
