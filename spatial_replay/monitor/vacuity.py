"""Find untested parts of a formula, and windows that the end of a log cuts short."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers, roomy
from spatial_replay.monitor.offline import (
    OfflineNodes,
    evaluate_offline,
    evaluate_with_whole_windows,
    is_cut,
    windows_of,
)
from spatial_replay.monitor.online.codes import in_channels, joined_channels, low_and_high
from spatial_replay.monitor.stream import Instance
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import DecidingPath, End, PathNode, deciding_atom, deciding_path
from spatial_replay.spec.format import format_formula, format_term
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Earlier,
    Equality,
    Formula,
    Group,
    NamedSpec,
    Quantified,
    Signal,
    Temporal,
    TrackedName,
    iter_nodes,
    judged_operator,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import (
    is_about_having_rates,
    is_spatial,
    iter_parts,
    iter_terms,
    leaf_key,
    leaves_out,
    nodes_of,
    nodes_with_operands,
    standing,
    substitute,
)
from spatial_replay.text import (
    Instant,
    Sentence,
    nearest_hint,
    plural,
    printable,
    shortened_formula,
    time_text,
)

Tested: TypeAlias = Literal["full", "cut", "nothing"]
"""Whether the log tested a verdict, see `SpecResult.tested`."""
Reason: TypeAlias = Literal[
    "empty window",
    "antecedent never held",
    "no members",
    "past the end",
    "no rate",
    "no instances",
    "cut window",
]
_Samples: TypeAlias = NDArray[np.bool_]
_NEXT = {"X": "next sample", "WX": "next sample", "Y": "sample before"}


@dataclass(frozen=True, slots=True)
class UntestedPart:
    """A part of a formula that was not tested, or was tested only in part.

    Attributes:
        node: node id of the part; None for a template without instances.
        text: canonical text of the part.
        reason: "empty window": the operator's window has no sample wherever the result depends on the
            operator. "antecedent never held": the part is an implication, in any spelling. "no members": an
            open group is empty. "past the end": the result is infinite, because the deciding part looks
            beyond the log. "no rate": the result is infinite, because the deciding part leaves all samples
            or members out. "no instances": no object fits a template. "cut window": the part decides at a
            sample whose window ends after the log.
        message: a sentence.
        time_ns: time of the sample at which the part decides; None without such a sample.
    """

    node: int | None
    text: str
    reason: Reason
    message: Sentence
    time_ns: int | None = None


def idle_templates(
    specs: Iterable[NamedSpec],
    evaluated: Iterable[Formula],
    each: Mapping[str, str],
    classes: Collection[str],
) -> tuple[UntestedPart, ...]:
    """Return the templates that decided nothing, because no object fits them.

    Args:
        evaluated: formulas that have a result.
        each: choice of objects by template parameter, such as "class:person".
        classes: classes of the log.
    """
    untested_parts, evaluated_ids = [], {id(formula) for formula in evaluated}
    for spec in specs:
        if spec.parameter is None or id(spec.formula) in evaluated_ids:
            continue
        text = f"{spec.name}({spec.parameter})"
        message = f"`{text}` was never evaluated: no object stands for {spec.parameter}."
        kind, _, class_name = each.get(spec.parameter, "").partition(":")
        if kind == "class":
            hint = nearest_hint(class_name, sorted(classes))
            message += f" The log never has the class {printable(class_name)!r}{f'; {hint}' if hint else '.'}"
        untested_parts.append(UntestedPart(None, text, "no instances", Sentence(message)))
    return tuple(untested_parts)


def find_vacuous(
    evidence: Evidence, leaves: Floats, times_ns: Integers, *, infinite: End | None
) -> tuple[UntestedPart, ...]:
    """Return the parts of an instance's formula that decided nothing, in the order of the text.

    Args:
        evidence: evidence of the instance.
        leaves: (C, A, T), leaves of the instance.
        times_ns: (T,), T at least 1.
        infinite: deciding end of an infinite robustness: the lower end for inf, the upper end for -inf. It is
            None for a finite robustness.
    """
    instance = evidence.instance
    if infinite is None and not _may_decide_nothing(instance):
        return ()
    nodes = nodes_of(instance.formula)
    implications = _implications_of(instance.formula)
    windows, holding_samples = _Windows(times_ns), _Holding(instance, leaves, times_ns)
    scopes = _scopes(instance.formula, windows, holding_samples)
    active_scopes = _scopes(implications.formula, windows, holding_samples, is_conditional=True)
    idle_parts = [
        *_empty_windows(nodes, scopes, implications.by_node(active_scopes, len(nodes)), windows, evidence),
        *_idle_implications(implications, active_scopes, holding_samples, evidence),
        *_idle_bodies(nodes, scopes, evidence),
        *_empty_groups(nodes, scopes, evidence),
    ]
    if infinite is not None:
        offline_nodes = evaluate_offline(instance.formula, instance.program.leaves, leaves, times_ns)
        path = deciding_path(offline_nodes, 0, infinite)
        node, sample = path.steps[-1].node, path.steps[-1].sample
        # a missed goal (`F`) is -inf as well, so -inf alone does not show that nothing was tested
        is_idle = infinite is End.LOW or (
            _leaves_all_out(offline_nodes, path, evidence)
            and is_tested_by_nothing(evidence, leaves, times_ns, Verdict.VIOLATED)
        )
        if is_idle and node not in {part.node for part in idle_parts}:
            idle_parts += _infinite(node, nodes[node], Instant(int(times_ns[sample]), evidence.first_ns()))
    return tuple(
        _part(idle_part, nodes[idle_part.node], evidence)
        for idle_part in sorted(idle_parts, key=lambda idle_part: idle_part.node)
    )


# answers are cached, because a batch evaluates the same instances on each of its logs
@lru_cache(maxsize=256)
def _may_decide_nothing(instance: Instance) -> bool:
    """Return whether a part of an instance's formula can be untested in some log.

    Such a formula has a window that may be empty, an implication, a quantifier, or an open group.
    """
    nodes = nodes_of(instance.formula)
    leaves = [substitute(leaf, instance.bindings) for leaf in instance.program.leaves]
    return (
        any(isinstance(node, Temporal) and _may_be_empty(node) for node in nodes)
        or any(operator_of(node) == "->" for node in nodes_of(_implications_of(instance.formula).formula))
        or any(isinstance(leaf, Quantified) or any(_open_groups(leaf)) for leaf in leaves)
    )


def _may_be_empty(node: Temporal) -> bool:
    """Return whether an operator's window may be empty, because it excludes the operator's own sample."""
    return node.operator in _NEXT or (node.bound is not None and node.bound.lower > 0)


class _Idle(NamedTuple):
    """An untested part. Its message is its text followed by `predicate`."""

    node: int
    reason: Reason
    predicate: tuple[str | Instant, ...]
    time_ns: int | None = None


def _part(idle_part: _Idle, node: Formula, evidence: Evidence) -> UntestedPart:
    text = format_formula(evidence.bound(node))
    return UntestedPart(
        idle_part.node,
        text,
        idle_part.reason,
        Sentence(f"`{text}` ", *idle_part.predicate),
        idle_part.time_ns,
    )


# ------------------------------------------------------------------------------------------ implications


class _Implications(NamedTuple):
    """A formula with the robustness of an original formula, in which implications are written with `->`.

    Attributes:
        nodes: for each node of this formula, the id of the original node that it stands for.
    """

    formula: Formula
    nodes: tuple[int, ...]

    def by_node(self, scopes: Sequence[_Samples], node_count: int) -> list[_Samples]:
        """Return for each of `node_count` original nodes the samples (T,) of the nodes that stand for it."""
        samples_by_node = [np.zeros(len(scopes[0]), np.bool_) for _ in range(node_count)]
        for node, scope in zip(self.nodes, scopes, strict=True):
            samples_by_node[node] |= scope
        return samples_by_node


def _implications_of(formula: Formula, node: int = 0, sign: int = 1) -> _Implications:
    """Write `->` for each implication of a formula.

    `not a or b` and `not (a and not b)` become `a -> b`. `not (a and b)` becomes
    `(a or b) -> not (a and b)`, because each operand is a condition for the other operand. `not F p` is
    treated like `G not p`.

    Args:
        node: id of the original formula.
        sign: 1 if the formula has to hold, -1 if it must not hold, 0 for neither, as in a goal. With sign 0,
            disjunctions and conjunctions are not read as implications.
    """
    operands = list(_operands_with_ids(formula, node))
    operator = operator_of(formula)
    has_condition = any(operator_of(operand) != "not" for operand, _ in operands)
    if sign < 0 and operator == "and" and has_condition:
        negation = _implications_of(Boolean("not", (formula,)), node - 1)
        nodes = (node, *(max(identifier, node) for identifier in negation.nodes))
        return _Implications(Boolean("not", (negation.formula,)), nodes)
    is_negated = operator == "not" and operator_of(operands[0][0]) == "and"
    if sign > 0 and (operator == "or" or is_negated):
        disjuncts = list(_operands_with_ids(*operands[0])) if is_negated else operands
        # `not` marks the conditions of a disjunction, and the response in a negated conjunction
        are_conditions = [(operator_of(disjunct) == "not") is not is_negated for disjunct, _ in disjuncts]
        sides = [
            [
                _implications_of(*_without_negation(*disjunct), 0 if is_condition else 1)
                for disjunct, is_condition in zip(disjuncts, are_conditions, strict=True)
                if is_condition is is_chosen_side
            ]
            for is_chosen_side in (True, False)
        ]
        if all(sides):
            return _join_implications(
                "->",
                (_join_implications("and", sides[0], node), _join_implications("or", sides[1], node)),
                node,
            )
        if sides[0]:
            conjunction = _join_implications("and", sides[0], node)
            response = _Implications(Boolean("not", (conjunction.formula,)), (node, *conjunction.nodes))
            return _join_implications("->", (_join_implications("or", sides[0], node), response), node)
    if not isinstance(formula, Boolean | Temporal):
        return _Implications(formula, (node,))
    signs = [_sign_below(operator, operand_index, sign) for operand_index in range(len(operands))]
    operand_parts = [
        _implications_of(*operand, sign_below) for operand, sign_below in zip(operands, signs, strict=True)
    ]
    new_formula = replace(formula, operands=tuple(part.formula for part in operand_parts))
    return _Implications(
        new_formula, (node, *(identifier for part in operand_parts for identifier in part.nodes))
    )


def _operands_with_ids(formula: Formula, node: int) -> Iterator[tuple[Formula, int]]:
    node += 1
    for operand in operands_of(formula):
        yield operand, node
        node += sum(1 for _ in iter_nodes(operand))


def _without_negation(formula: Formula, node: int) -> tuple[Formula, int]:
    is_negation = operator_of(formula) == "not"
    return (operands_of(formula)[0], node + 1) if is_negation else (formula, node)


_GOALS = frozenset({("F", 0), ("O", 0), ("U", 1), ("S", 1), ("W", 1), ("R", 0)})
"""Operators with the index of an operand that has to hold at one sample only."""
_EVERYWHERE = frozenset({"F", "G", "U", "R", "W", "O", "H", "S"})
"""Operators whose windows have several samples."""


def _body(node: Quantified) -> Formula:
    return _implications_of(node.body, sign=int(node.quantifier == "forall")).formula


def _sign_below(operator: str, operand_index: int, sign: int) -> int:
    if operator == "not":
        return -sign
    if operator in ("xor", "<->") or (operator, operand_index) == ("->", 0):
        return 0
    # a negated goal has to fail at all samples, as in `not F`
    is_goal = (operator, operand_index) in _GOALS
    return 0 if operator in _EVERYWHERE and is_goal is (sign > 0) else sign


def _join_implications(
    operator: Literal["and", "or", "->"], parts: Sequence[_Implications], node: int
) -> _Implications:
    if len(parts) == 1:
        return parts[0]
    formula = Boolean(operator, tuple(part.formula for part in parts))
    return _Implications(formula, (node, *(identifier for part in parts for identifier in part.nodes)))


class _Holding:
    """Computes the samples (T,) at which a condition may hold, once per condition."""

    def __init__(self, instance: Instance, leaves: Floats, times_ns: Integers) -> None:
        self._leaf_order = instance.program.leaves
        self._leaves, self._times_ns = leaves, times_ns
        self._samples: dict[Formula, _Samples] = {}

    def __call__(self, condition: Formula) -> _Samples:
        if condition not in self._samples:
            nodes = evaluate_offline(condition, self._leaf_order, self._leaves, self._times_ns)
            self._samples[condition] = nodes.ends(0)[1] >= 0.0
        return self._samples[condition]


# ---------------------------------------------------------------------------------------------- scopes


class _Windows:
    """Computes the windows of an operator at all samples (see `windows_of`), once per operator."""

    def __init__(self, times_ns: Integers) -> None:
        self.times_ns = times_ns
        self._windows: dict[tuple[str, Bound | None], tuple[Integers, Integers]] = {}

    def __call__(self, node: Temporal) -> tuple[Integers, Integers]:
        key = node.operator, node.bound
        if key not in self._windows:
            self._windows[key] = windows_of(node, self.times_ns)
        return self._windows[key]


def _scopes(
    formula: Formula, windows: _Windows, holding_samples: _Holding, *, is_conditional: bool = False
) -> list[_Samples]:
    """Return for each node the samples (T,) at which the formula's robustness depends on the node.

    Samples are excluded if an operator leaves them out because a rate has no value.

    Args:
        is_conditional: whether a consequent only gets the samples at which its antecedent may hold.
    """
    tree = nodes_with_operands(formula)
    # the verdict is decided by the robustness of the root at the first sample
    scopes = [np.arange(len(windows.times_ns)) == 0] * len(tree)
    # parents precede their operands, so an entry is final when the loop reaches it
    for scope, (node, operands) in zip(scopes, tree, strict=True):
        for operand_index, operand in enumerate(operands):
            operand_scope = scope
            if isinstance(node, Temporal):
                operand_scope = _below(node, operand_index, scope, windows)
                judged_operand = judged_operator(node).operands[operand_index]
                if operator_of(judged_operand) in ("given", "with"):
                    operand_scope = operand_scope & holding_samples(operands_of(judged_operand)[0])
            elif is_conditional and operand_index and operator_of(node) == "->" and scope.any():
                operand_scope = scope & holding_samples(operands_of(node)[0])
            scopes[operand] = operand_scope
    return scopes


def _below(formula: Temporal, operand_index: int, scope: _Samples, windows: _Windows) -> _Samples:
    """Return the samples (T,) at which an operand counts, if its operator counts at the samples `scope`."""
    begins, ends = windows(formula)
    counting_samples = np.flatnonzero(scope & (begins < ends))
    begins, ends = begins[counting_samples], ends[counting_samples]
    if operand_index < len(formula.operands) - 1:
        # the left operand counts from the operator's sample to before the right operand's sample
        if formula.operator == "S":
            begins, ends = begins + 1, counting_samples + 1
        else:
            begins = counting_samples
            ends = ends - (formula.operator != "W")
    # +1 where a window begins, -1 after its end: the running sum is the number of windows at a sample
    window_edges = np.zeros(len(scope) + 1, np.int64)
    is_open = begins < ends
    # `add.at`, because several windows may begin or end at one sample
    np.add.at(window_edges, begins[is_open], 1)
    np.add.at(window_edges, ends[is_open], -1)
    is_covered: _Samples = np.cumsum(window_edges[:-1]) > 0
    return is_covered


# --------------------------------------------------------------------------------------------- reasons


def _empty_windows(
    nodes: Sequence[Formula],
    scopes: Sequence[_Samples],
    active_scopes: Sequence[_Samples],
    windows: _Windows,
    evidence: Evidence,
) -> Iterator[_Idle]:
    """Find operators whose windows are empty at all samples of their scopes.

    Args:
        scopes: samples at which the robustness depends on each node.
        active_scopes: samples at which the verdict depends on each node, because conditions hold there.
    """
    for identifier, (node, scope, active_scope) in enumerate(zip(nodes, scopes, active_scopes, strict=True)):
        if not isinstance(node, Temporal) or not scope.any():
            continue
        (begins, ends), times_ns = windows(node), windows.times_ns
        is_relevant = active_scope if active_scope.any() else scope
        if not (begins < ends)[is_relevant].any():
            place_text = " where it counts" if (begins < ends)[scope].any() else ""
            predicate: tuple[str | Instant, ...] = (f"no sample of the log lies in its window{place_text}",)
            begin_sample = int(begins[is_relevant][0])
            if node.operator in _NEXT:
                predicate = (f"the log has no {_NEXT[node.operator]}{place_text}",)
            elif 0 < begin_sample < len(times_ns):
                instants = (
                    Instant(int(time_ns), evidence.first_ns())
                    for time_ns in times_ns[begin_sample - 1 : begin_sample + 1]
                )
                first_text = "first " if is_relevant.sum() > 1 else ""
                predicate += (f", {first_text}between those at ", next(instants), " and ", next(instants))
            yield _Idle(identifier, "empty window", ("was never tested: ", *predicate, "."))


def _idle_implications(
    implications: _Implications,
    active_scopes: Sequence[_Samples],
    holding_samples: _Holding,
    evidence: Evidence,
) -> Iterator[_Idle]:
    nodes = nodes_of(implications.formula)
    for identifier, node, scope in zip(implications.nodes, nodes, active_scopes, strict=True):
        if isinstance(node, Boolean) and node.operator == "->" and scope.any():
            is_held = holding_samples(node.operands[0])
            if not is_held[scope].any():
                yield _untested_implication(
                    identifier, node, evidence, " where it counts" if is_held.any() else ""
                )


def _untested_implication(
    identifier: int, implication: Boolean, evidence: Evidence, place_text: str = ""
) -> _Idle:
    antecedent = format_formula(evidence.bound(implication.operands[0]))
    predicate = f"was never tested: `{antecedent}` never held{place_text}."
    return _Idle(identifier, "antecedent never held", (predicate,))


def _idle_bodies(nodes: Sequence[Formula], scopes: Sequence[_Samples], evidence: Evidence) -> Iterator[_Idle]:
    """Find implications with an antecedent that never held for any member, in the bodies of quantifiers."""
    for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True)):
        if not isinstance(node, Quantified) or not scope.any():
            continue
        inner_implications = list(_implications(node))
        if not inner_implications:
            continue
        columns = evidence.columns([evidence.bound(ever_holds) for _, ever_holds, _ in inner_implications])
        high_ends = columns[low_and_high(len(columns), wide=True)[1]]
        for (implication, _, is_nested), high_end in zip(inner_implications, high_ends, strict=True):
            if not (high_end[scope] >= 0.0).any():
                yield _untested_implication(
                    identifier, implication, evidence, " where it counts" if is_nested else ""
                )


def _implications(node: Quantified) -> Iterator[tuple[Boolean, Formula, bool]]:
    """Yield for each implication in a quantifier's body the implication, a formula, and whether it is nested.

    The formula states that the antecedent holds for some member. A nested implication is in the consequent of
    another implication, and its formula also requires the antecedent of that implication.
    """
    pending_parts: list[tuple[Formula, tuple[Formula, ...]]] = [(_body(node), ())]
    while pending_parts:
        part, conditions = pending_parts.pop()
        if isinstance(part, Quantified):
            for implication, ever_holds, is_nested in _implications(part):
                body = _all((*conditions, ever_holds))
                yield (
                    implication,
                    replace(node, quantifier="exists", body=body),
                    is_nested or bool(conditions),
                )
            continue
        operands = [(operand, conditions) for operand in operands_of(part)]
        if isinstance(part, Boolean) and part.operator == "->":
            antecedents = (*conditions, part.operands[0])
            yield part, replace(node, quantifier="exists", body=_all(antecedents)), bool(conditions)
            operands[1] = (part.operands[1], antecedents)
        pending_parts.extend(reversed(operands))


def _all(formulas: tuple[Formula, ...]) -> Formula:
    return formulas[0] if len(formulas) == 1 else Boolean("and", formulas)


def _empty_groups(
    nodes: Sequence[Formula], scopes: Sequence[_Samples], evidence: Evidence
) -> Iterator[_Idle]:
    open_groups = {
        identifier: list(_open_groups(evidence.bound(node)))
        for identifier, (node, scope) in enumerate(zip(nodes, scopes, strict=True))
        if isinstance(node, Atom | Quantified) and scope.any()
    }
    all_groups = list(dict.fromkeys(group for node_groups in open_groups.values() for group in node_groups))
    has_members = {
        group: bool(members.any())
        for group, members in zip(all_groups, evidence.members(all_groups), strict=True)
    }
    for identifier, node_groups in open_groups.items():
        empty_groups = [group for group in node_groups if not has_members[group]]
        if empty_groups:
            names = " or ".join(f"`{format_term(group)}`" for group in dict.fromkeys(empty_groups))
            predicate = f"decided nothing: no object was ever in {names}."
            yield _Idle(identifier, "no members", (predicate,))


def _open_groups(formula: Formula) -> Iterator[Group | Earlier]:
    """Yield the open groups of a leaf. Excluded variables are dropped, because they differ by binding."""
    for term in map(standing, iter_terms([formula])):
        group = term.term if isinstance(term, Earlier) else term
        if isinstance(group, Group) and group.members is None:
            excluded = tuple(
                excluded_term for excluded_term in group.excluded if isinstance(excluded_term, TrackedName)
            )
            full_group = replace(group, excluded=excluded)
            yield replace(term, term=full_group) if isinstance(term, Earlier) else full_group


def _leaves_all_out(nodes: OfflineNodes, path: DecidingPath, evidence: Evidence) -> bool:
    """Return whether the last operator of a path leaves out all its samples or all its members."""
    node, sample = path.steps[-1]
    formula, operands = nodes.tree[node]
    if isinstance(formula, Quantified):
        scene = evidence.scene(int(nodes.times_ns[sample]))
        return leaves_out(formula) and deciding_atom(scene, evidence.bound(formula), path.end) is None
    if not isinstance(formula, Temporal):
        return False
    begins, ends = windows_of(formula, nodes.times_ns)
    window = range(int(begins[sample]), int(ends[sample]))
    return len(window) > 0 and any(
        all(nodes.is_left_out(operand, window_sample) for window_sample in window) for operand in operands
    )


def _infinite(identifier: int, node: Formula, instant: Instant) -> Iterator[_Idle]:
    """Yield the reason of an infinite result, which depends on the formula of the deciding node."""
    if leaves_out(node):
        member = "object in its group" if isinstance(node, Quantified) else "sample in its window"
        predicate = ("decides at ", instant, f", where no {member} has a rate.")
        yield _Idle(identifier, "no rate", predicate, instant.time_ns)
    elif isinstance(node, Temporal):
        side = "past the end" if node.operator in FUTURE_OPERATORS else "before the start"
        predicate = ("decides at ", instant, f", where it looks {side} of the log.")
        yield _Idle(identifier, "past the end", predicate, instant.time_ns)
    elif isinstance(node, Atom | Quantified) and not any(
        isinstance(part, Equality) for part in iter_parts(node)
    ):
        # an equality with a text is infinite by definition, also with members in its groups
        needed_count = len(node.variables) if isinstance(node, Quantified) else 1
        members_text = "no object is" if needed_count == 1 else f"fewer than {needed_count} objects are"
        predicate = ("decides at ", instant, f", where {members_text} in its group.")
        yield _Idle(identifier, "no members", predicate, instant.time_ns)


def goals_at_the_start(evidence: Evidence, leaves: Floats, times_ns: Integers) -> tuple[Sentence, ...]:
    """Return remarks on the goals (`F`) of a formula that already hold at the first sample."""
    leaf_order = evidence.instance.program.leaves
    sentences: list[Sentence] = []
    pending_nodes = [evidence.instance.formula]
    while pending_nodes:
        node = pending_nodes.pop()
        if isinstance(node, Boolean) and node.operator in ("and", "spec"):
            # operands are reversed on the stack, so that goals come in the order of the text
            pending_nodes += reversed(node.operands)
        elif (
            isinstance(node, Temporal)
            and node.operator == "F"
            and (node.bound is None or not node.bound.lower)
        ):
            (goal,) = node.operands
            if is_spatial(goal):
                low, _ = evaluate_offline(goal, leaf_order, leaves[..., :1], times_ns[:1]).interval(0)
                name = node.name or shortened_formula(format_formula(node))
                sentences += (
                    [Sentence(f"`{name}` is already true at the first sample.")] if low >= 0.0 else []
                )
    return tuple(sentences)


# ------------------------------------------------------------------------------------- tested by nothing

_UNKNOWN: Final = Atom("", "signal", Signal("\0"))
"""An atom that is unknown in every log, because no log has such a signal."""


def is_tested_by_nothing(evidence: Evidence, leaves: Floats, times_ns: Integers, verdict: Verdict) -> bool:
    """Return whether a verdict is independent of the values of the leaves.

    Some leaves keep their values:

    - leaves in antecedents of a satisfied formula, because nothing is tested if no antecedent holds;
    - leaves over an open group, at samples where the group is empty;
    - conditions that a rate has a value, because samples that are left out test nothing.

    Args:
        leaves: (C, A, T), the leaves of the instance's formula.
    """
    instance = evidence.instance
    leaf_order = instance.program.leaves
    unknown_leaves = _with_unknown_leaves(leaf_order, leaves, evidence)
    known_leaves = leaves if verdict is Verdict.SATISFIED else unknown_leaves
    # each leaf is evaluated twice: unknown, and with its values for antecedents
    stand_ins = {leaf_key(leaf): Atom("", "signal", Signal(f"\0{n}")) for n, leaf in enumerate(leaf_order)}

    def with_stand_ins(formula: Formula, *, in_antecedent: bool = False) -> Formula:
        match formula:
            case Boolean(operator="->", operands=(antecedent, consequent)):
                new_antecedent = with_stand_ins(antecedent, in_antecedent=True)
                return replace(
                    formula,
                    operands=(new_antecedent, with_stand_ins(consequent, in_antecedent=in_antecedent)),
                )
            case Boolean(operator="given" | "with", operands=(condition, body)):
                return replace(
                    formula, operands=(condition, with_stand_ins(body, in_antecedent=in_antecedent))
                )
            case Boolean() | Temporal():
                judged_operands = (
                    judged_operator(formula).operands if isinstance(formula, Temporal) else formula.operands
                )
                operands = [
                    with_stand_ins(operand, in_antecedent=in_antecedent) for operand in judged_operands
                ]
                return replace(formula, operands=tuple(operands))
            case Atom() | Quantified() if in_antecedent:
                return stand_ins[leaf_key(formula)]
        return formula

    all_leaves = joined_channels([unknown_leaves, known_leaves], axis=1)
    formula = with_stand_ins(_implications_of(instance.formula).formula)
    nodes = evaluate_offline(formula, (*leaf_order, *stand_ins.values()), all_leaves, times_ns)
    return final_verdict(*nodes.interval(0)) is verdict


def _with_unknown_leaves(
    leaf_order: Sequence[Atom | Quantified], leaves: Floats, evidence: Evidence
) -> Floats:
    """Return leaves (2, A, T) with unknown values.

    Only antecedents in quantifiers, leaves over empty groups, and conditions on rates keep their values.
    """
    low, high = low_and_high(len(leaves), wide=True)
    unknown_leaves = roomy((2, *leaves.shape[1:]), np.float64)
    unknown_leaves[0], unknown_leaves[1] = -np.inf, np.inf
    for leaf_index, leaf in enumerate(leaf_order):
        bound_leaf = evidence.bound(leaf)
        groups = list(dict.fromkeys(_open_groups(bound_leaf)))
        if is_about_having_rates(bound_leaf):
            unknown_leaves[:, leaf_index] = leaves[[low, high], leaf_index]
        elif isinstance(bound_leaf, Quantified):
            column = evidence.columns([_without_tests(bound_leaf)])
            # channels 2 and 3 are the ends with uncertainty
            unknown_leaves[:, leaf_index] = in_channels(column, 4)[2:, 0]
        elif groups:
            is_empty = ~evidence.members(groups).all(axis=0)
            unknown_leaves[:, leaf_index, is_empty] = leaves[[low, high], leaf_index][:, is_empty]
    return unknown_leaves


def _without_tests(formula: Formula) -> Formula:
    """Return a quantifier with unknown atoms in its body, except in antecedents."""
    match formula:
        case Atom():
            return _UNKNOWN
        case Quantified():
            judged_body = replace(formula, body=_body(formula)).judged
            return replace(formula, body=_without_tests(judged_body))
        case Boolean(operator="->" | "given" | "with", operands=(antecedent, consequent)):
            return replace(formula, operands=(antecedent, _without_tests(consequent)))
        case Boolean():
            return replace(formula, operands=tuple(_without_tests(operand) for operand in formula.operands))
        case _:
            return formula


# ------------------------------------------------------------------------------------------ cut windows


def find_cut_window(
    evidence: Evidence, leaves: Floats, times_ns: Integers, verdict: Verdict
) -> UntestedPart | None:
    """Return the operator whose cut window decides a verdict; None if no cut window decides it.

    A window with an upper bound, and the window of X, may contain samples beyond the end of the log. All
    other windows end with the log.

    Args:
        leaves: (C, A, T), the leaves of the instance's formula.
    """
    instance = evidence.instance
    nodes = nodes_of(instance.formula)
    if not any(isinstance(node, Temporal) and is_cut(node, times_ns)[-1] for node in nodes):
        return None
    leaf_order = instance.program.leaves
    cut_nodes = evaluate_offline(instance.formula, leaf_order, leaves, times_ns)
    whole_nodes = evaluate_with_whole_windows(instance.formula, leaf_order, leaves, times_ns)
    cut_verdict, whole_verdict = (final_verdict(*nodes.interval(0)) for nodes in (cut_nodes, whole_nodes))
    if cut_verdict is not verdict or whole_verdict is verdict:
        return None
    ranks = _rank_by_verdict(cut_nodes, whole_nodes, is_violated=verdict is Verdict.VIOLATED)
    path = deciding_path(ranks, 0, End.of(verdict))
    cut_steps = [step for step in path.steps if _is_cut_at(nodes[step.node], step.sample, times_ns)]
    # rank 1 or -1: decided by a cut window, but not by a whole window
    deciding_steps = [
        step for step in cut_steps if {1.0, -1.0} & {*ranks.columns[:, step.node, step.sample].tolist()}
    ]
    step = deciding_steps[-1] if deciding_steps else path.steps[0]
    return _part(_cut(step, nodes[step.node], times_ns, evidence), nodes[step.node], evidence)


def _is_cut_at(node: Formula, sample: int, times_ns: Integers) -> bool:
    return isinstance(node, Temporal) and bool(is_cut(node, times_ns)[sample])


def _cut(step: PathNode, node: Formula, times_ns: Integers, evidence: Evidence) -> _Idle:
    """Return the cut window of a node at a sample, with its length beyond the log."""
    identifier, sample = step.node, step.sample
    instant = Instant(int(times_ns[sample]), evidence.first_ns())
    bound = node.bound if isinstance(node, Temporal) else None
    if bound is None or bound.upper is None:
        reach_text = "the log has no next sample"
    else:
        is_time = bound.unit == "ns"
        # positions are in ns or in samples, so that one calculation serves both units
        position, last_position = (
            (int(times_ns[sample]), int(times_ns[-1])) if is_time else (sample, len(times_ns) - 1)
        )
        missing_length = position + bound.upper - last_position
        # a window in samples includes both ends
        window_length = bound.upper - bound.lower + (not is_time)
        seen_length = max(window_length - missing_length, 0)
        left_text, whole_text = (
            time_text(n) if is_time else plural(n, "sample") for n in (missing_length, window_length)
        )
        seen_text = time_text(seen_length) if is_time else f"{seen_length:,}"
        reach_text = f"its window ends {left_text} after the log"
        reach_text += f" ({seen_text} of {whole_text} seen)" if window_length else ""
    return _Idle(
        identifier,
        "cut window",
        ("decides at ", instant, f", where {reach_text}: a longer log may change the verdict."),
        instant.time_ns,
    )


def _rank_by_verdict(
    cut_nodes: OfflineNodes, whole_nodes: OfflineNodes, *, is_violated: bool
) -> OfflineNodes:
    """Return nodes with ranks as robustness.

    The ranks are: decided with whole windows, decided only with cut windows, and undecided. Minima, maxima
    and negations preserve the order of ranks, so the deciding path of ranks ends at a cut window.
    """
    # 0 satisfies, so only a violation needs a strict comparison
    holds = np.greater if is_violated else np.greater_equal
    end_pairs = [
        nodes.columns[[*low_and_high(len(nodes.columns), wide=True)]] for nodes in (cut_nodes, whole_nodes)
    ]
    low_ranks = sum(holds(low, 0.0) * 1.0 for low, _ in end_pairs)
    return replace(
        cut_nodes, columns=np.stack([low_ranks, -sum(holds(-high, 0.0) * 1.0 for _, high in end_pairs)])
    )
