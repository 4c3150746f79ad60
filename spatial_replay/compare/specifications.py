"""Two versions of a specification over a log: edits, outcomes and the cause of a change."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.compare.edits import (
    DeclarationChange,
    Edit,
    Origin,
    TextPlace,
    TextVersions,
    TreeDiff,
    changed_nodes,
    compare_trees,
    unify_regions,
)
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.lazy import Displayed, Printed
from spatial_replay.logs.source import Source
from spatial_replay.monitor.offline import evaluate_offline, new_leaves
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.result import Evaluation, SpecResult, evaluate
from spatial_replay.monitor.semantics import PaperRun
from spatial_replay.monitor.sentences import cause_reason
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions, Selection
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.formula import Atom, Formula, NamedSpec, Outline, Quantified, Specification
from spatial_replay.spec.resolve import MAX_SIZE
from spatial_replay.text import (
    Instant,
    Sentence,
    counted_from,
    interval_text,
    json_fields,
    json_value,
    plural,
    with_unit,
)
from spatial_replay.trace.trace import Trace

_MOST_EVALUATIONS: Final = 256
"""Maximum number of formulas evaluated for one cause; at the limit, the cause so far is returned."""


class EditOutcome(NamedTuple):
    """Result of a formula on a finished log; the robustness is NaN if it is not determined."""

    verdict: Verdict
    robustness: float
    lower: float
    upper: float

    @classmethod
    def of(cls, result: SpecResult) -> EditOutcome:
        return cls(result.verdict, result.robustness, result.lower, result.upper)

    def same_as(self, other: EditOutcome, *, verdict_only: bool = False) -> bool:
        """Return whether two outcomes have the same verdict and, unless `verdict_only`, the same numbers."""
        if verdict_only:
            return self.verdict is other.verdict
        # NaN, which is not equal to itself, counts as equal to NaN
        pairs = zip(self[1:], other[1:], strict=True)
        return self.verdict is other.verdict and all(a == b or (a != a and b != b) for a, b in pairs)


class EditOutcomes:
    """Outcomes of the old formula with some of the edits, from atoms that are already evaluated."""

    def __init__(self, one: SpecResult, other: SpecResult, diff: TreeDiff) -> None:
        self._diff = diff
        self._times_ns = one.times_ns
        self._semantics = one.semantics
        self._rows: dict[Atom | Quantified, Floats] = {}
        blocks = [(result, result.leaves) for result in (one, other) if result.leaves is not None]
        channels = max((len(leaves) for _, leaves in blocks), default=0)
        for result, leaves in blocks:
            columns = in_channels(leaves, channels)
            for index, leaf in enumerate(result.evidence.instance.program.leaves):
                self._rows[leaf] = columns[:, index]
        self._known: dict[frozenset[int], EditOutcome] = {}
        self.count = 0

    def __call__(self, units: Sequence[int]) -> EditOutcome:
        """Return the outcome of the old formula with only some units of edits applied."""
        edited_units = frozenset(units)
        if edited_units not in self._known:
            self.count += 1
            self._known[edited_units] = self._evaluate(self._diff.formula(edited_units))
        return self._known[edited_units]

    def _evaluate(self, formula: Formula) -> EditOutcome:
        leaves = new_leaves(formula, ())
        shape = next(iter(self._rows.values())).shape if self._rows else (1, len(self._times_ns))
        rows = [self._rows[leaf] for leaf in leaves]
        columns = np.stack(rows, axis=1) if rows else np.empty((shape[0], 0, shape[1]))
        if self._semantics == "paper":
            run = PaperRun(formula, leaves)
            run.extend(columns, self._times_ns)
            value = float(run.final[0, 0])
            return EditOutcome(final_verdict(value, value), value, value, value)
        evaluation = evaluate_offline(formula, leaves, columns, self._times_ns)
        lower, upper = evaluation.interval(0)
        least, greatest = evaluation.interval(0, wide=False)
        return EditOutcome(
            final_verdict(lower, upper), least if least == greatest else math.nan, lower, upper
        )


def find_cause(
    diff: TreeDiff, outcome: Callable[[Sequence[int]], EditOutcome], old: EditOutcome, new: EditOutcome
) -> tuple[int, ...]:
    """Return the units of edits that changed the verdict or, for equal verdicts, the numbers; deepest first.

    These units alone give the new outcome, and all other units alone give the old outcome. No unit can be
    left out. Single units are tried first, the deepest ones before others.

    Args:
        outcome: function that returns the outcome of the old formula with some units applied.
    """
    if old.same_as(new):
        return ()
    verdict_only = old.verdict is not new.verdict
    units = sorted(diff.effective, key=lambda number: -max(edit.depth for edit in diff.units[number]))
    evaluated = 0

    def suffices(chosen: Sequence[int]) -> bool:
        nonlocal evaluated
        evaluated += 1
        others = [number for number in units if number not in chosen]
        return (
            evaluated <= _MOST_EVALUATIONS
            and outcome(chosen).same_as(new, verdict_only=verdict_only)
            and outcome(others).same_as(old, verdict_only=verdict_only)
        )

    for number in units:
        if suffices((number,)):
            return (number,)
    return tuple(minimise(units, suffices))


def minimise(parts: Sequence[int], holds: Callable[[Sequence[int]], bool]) -> list[int]:
    """Return a minimal subset of parts for which a condition holds; it must hold for the full set.

    No single part of the subset can be left out. The method is delta debugging, which removes larger pieces
    first (Zeller and Hildebrandt 2002, https://doi.org/10.1109/32.988498).
    """
    current = list(parts)
    size = max(len(current) // 2, 1)
    while True:
        at, removed = 0, False
        while at < len(current):
            rest = current[:at] + current[at + size :]
            if rest and holds(rest):
                current, removed = rest, True
            else:
                at += size
        if size == 1 and not removed:
            return current
        size = max(size // 2, 1)


class FirstDifference(NamedTuple):
    """First sample with different values of a result, and both values; NaN if not determined."""

    time_ns: int
    old: float
    new: float


@dataclass(frozen=True, eq=False)
class SpecDiff(Displayed):
    """One spec, or the instance of a template for one object, before and after the edits.

    Attributes:
        name, old_name: name in the new file and in the old file.
        old, new: results over the log.
        tree: edits between the two formulas; it can apply some of them to the old formula.
        cause: edits that changed the verdict or, for equal verdicts, the robustness; empty if both are equal.
            These edits alone give the new outcome, and all others alone give the old outcome.
        alone: for each edit of the cause, the outcome with only this edit; None if it needs other edits.
        old_places, new_places: edited declaration or line in each text, by edit.
    """

    name: str
    old_name: str
    old: SpecResult
    new: SpecResult
    tree: TreeDiff
    cause: tuple[Edit, ...]
    alone: tuple[EditOutcome | None, ...]
    old_places: Mapping[Edit, TextPlace]
    new_places: Mapping[Edit, TextPlace]

    @property
    def edits(self) -> tuple[Edit, ...]:
        """The edits between the two formulas, those in named specs included."""
        return self.tree.edits

    @property
    def is_flipped(self) -> bool:
        """Whether the verdict changed."""
        return self.old.verdict is not self.new.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdict or a final number changed."""
        return not EditOutcome.of(self.old).same_as(EditOutcome.of(self.new))

    @cached_property
    def first(self) -> FirstDifference | None:
        """The first sample with different values; None if there is none."""
        if self.old.times_ns.shape != self.new.times_ns.shape:
            return None
        old_values, new_values = self.old.series[0, 0], self.new.series[0, 0]
        differs = np.flatnonzero((old_values != new_values) & ~(np.isnan(old_values) & np.isnan(new_values)))
        if not len(differs):
            return None
        at = int(differs[0])
        return FirstDifference(int(self.old.times_ns[at]), float(old_values[at]), float(new_values[at]))

    @property
    def title(self) -> str:
        """Name with the object of a template, and the old name if it was another."""
        title = self.name if self.old.object is None else f"{self.name}({self.old.object})"
        return title if self.name == self.old_name else f"{title} (was {self.old_name})"

    def sentences(self, first_ns: int, shown: Collection[DeclarationChange] = ()) -> Iterator[Sentence]:
        """Yield one sentence for each change; times count from `first_ns`.

        Args:
            shown: declarations whose lines are not repeated.
        """
        outcomes = (self.old, self.new) if self.is_different else (self.old,)
        yield Sentence(" → ".join(map(outcome_text, outcomes)) + difference_text(self.old, self.new))
        if self.first is not None:
            pairs = (self.first.old, self.old.unit), (self.first.new, self.new.unit)
            values = " → ".join(interval_text(value, value, value, unit) for value, unit in pairs)
            yield Sentence("first differs at ", Instant(self.first.time_ns, first_ns), f": {values}")
        for edit, alone in zip(self.cause, self.alone, strict=True):
            more = max(len(edit.old_nodes), len(edit.new_nodes)) - 1
            elsewhere = f" (and {plural(more, 'more node')})" if more else ""
            yield Sentence(f"because: {edit}, in `{edit.spec}`{elsewhere}")
            yield from self._lines_of(edit, shown)
            if alone is not None:
                number = interval_text(*alone[1:], self.old.unit)
                yield Sentence(f"  with this edit alone: {alone.verdict}, robustness {number}")
        if len(self.cause) > 1:
            yield Sentence(self._together())
        if self.is_flipped and self.new.causes and self.new.causes[0].witness is not None:
            yield cause_reason(self.new.causes[0], first_ns)
        others = [edit for edit in self.edits if edit not in self.cause]
        for edit in others[:_MOST_LISTED]:
            what = "edited, too: " if self.cause else "edited, without effect on the result: "
            yield Sentence(f"{'' if edit.kind == 'renamed' else what}{edit}")
            if edit.kind != "renamed":
                yield from self._lines_of(edit, shown)
        if len(others) > _MOST_LISTED:
            yield Sentence(f"and {plural(len(others) - _MOST_LISTED, 'other edit')}")

    def _together(self) -> str:
        """Return a sentence on how several edits of a cause act together."""
        new = EditOutcome.of(self.new)
        enough = sum(
            outcome is not None and outcome.same_as(new, verdict_only=self.is_flipped)
            for outcome in self.alone
        )
        count, what = len(self.cause), "verdict" if self.is_flipped else "robustness"
        if not enough:
            return f"it takes these {count} edits together"
        which = f"each of these {count} edits" if enough == count else f"{enough} of these {count} edits"
        all_of_them = "both" if count == 2 else f"all {count}"
        return f"{which} is enough by itself; to get the old {what} back, undo {all_of_them}"

    def _lines_of(self, edit: Edit, shown: Collection[DeclarationChange]) -> Iterator[Sentence]:
        if edit.change in shown:
            return
        for sign, places in (("-", self.old_places), ("+", self.new_places)):
            if edit in places:
                place = places[edit]
                yield Sentence(f"  {sign} {place.filename}:{place.line}: {place.text}")

    @property
    def document(self) -> dict[str, Any]:
        """The difference as values for JSON."""
        return {
            **json_fields(self, "name", "old_name"),
            "object": self.old.object,
            "flipped": self.is_flipped,
            "old": json_value(EditOutcome.of(self.old)),
            "new": json_value(EditOutcome.of(self.new)),
            "first_difference": json_value(self.first),
            "cause": [
                {**self._edit_value(edit), "alone": json_value(alone)}
                for edit, alone in zip(self.cause, self.alone, strict=True)
            ],
            "edits": [self._edit_value(edit) for edit in self.edits],
        }

    def _edit_value(self, edit: Edit) -> dict[str, Any]:
        sides = {"old": self.old_places.get(edit), "new": self.new_places.get(edit)}
        return {
            **json_fields(edit, "kind", "spec", "subject", "old", "new", "old_nodes", "new_nodes"),
            **{f"{side}_line": place and place.line for side, place in sides.items()},
            **{f"{side}_text": place and place.text for side, place in sides.items()},
        }

    def __repr__(self) -> str:
        return f"<{self.title}: {outcome_text(self.old)} → {outcome_text(self.new)}>"


_MOST_LISTED: Final = 8
"""Maximum number of edits without effect in the text; JSON lists all."""


def outcome_text(result: SpecResult) -> str:
    """Return a verdict with its robustness: "violated (-0.2 m)", "violated (between -inf and -0.2 m)"."""
    return f"{result.verdict} ({interval_text(*EditOutcome.of(result)[1:], result.unit)})"


def difference_text(first: SpecResult, second: SpecResult) -> str:
    """Return ", the same" for equal outcomes, the difference if only their texts are equal, or ""."""
    outcomes = EditOutcome.of(first), EditOutcome.of(second)
    if outcomes[0].same_as(outcomes[1]):
        return ", the same"
    if outcome_text(first) != outcome_text(second):
        return ""
    differences = (abs(a - b) for a, b in zip(outcomes[0][1:], outcomes[1][1:], strict=True) if a != b)
    difference = max(filter(math.isfinite, differences), default=0.0)
    return f", different by {with_unit(difference, first.unit)}" if difference else ""


@dataclass(frozen=True, eq=False)
class SpecificationDiff(Printed, Displayed):
    """Differences between two versions of a specification over one log.

    Attributes:
        log: name of the log.
        samples: number of evaluated samples.
        first_ns: time that sentences count from.
        old, new: specifications.
        specs: specs of both versions that are results in either, renamed ones included, in the new order.
        removed, added: names of results that only the old or only the new version has.
        faults: sentences on data that was lost while reading.
        doubts: remarks on assumptions that a log contradicts.
        missing: a warning for each name in the specifications that the log never has.
    """

    log: str
    samples: int
    first_ns: int
    old: Specification
    new: Specification
    specs: tuple[SpecDiff, ...]
    removed: tuple[str, ...]
    added: tuple[str, ...]
    faults: tuple[str, ...]
    doubts: tuple[str, ...]
    missing: tuple[Diagnostic, ...]

    @property
    def is_empty(self) -> bool:
        """Whether formulas, verdicts and numbers are equal; names may differ."""
        is_edited = any(edit.kind != "renamed" for spec in self.specs for edit in spec.edits)
        return not (self.removed or self.added or is_edited or any(spec.is_different for spec in self.specs))

    def spec(self, name: str) -> SpecDiff:
        """Return the difference of the spec of this name in the new file; of several instances, the first.

        Raises:
            UsageError: an unknown spec.
        """
        for spec in self.specs:
            if spec.name == name:
                return spec
        names = [spec.name for spec in self.specs]
        raise UsageError(f"no spec {name!r} to compare; {nearest_hint(name, names) or ', '.join(names)}")

    def lines(self) -> Iterator[str]:
        """Yield the lines of text that the command `diff` prints."""
        yield f"{self.log}: {plural(self.samples, 'sample')}; {self.old.filename} → {self.new.filename}"
        same = 0
        printed_changes: set[DeclarationChange] = set()
        for spec in self.specs:
            if not spec.edits and not spec.is_different:
                same += 1
                continue
            first, *rest = spec.sentences(self.first_ns, printed_changes)
            printed_changes.update(edit.change for edit in spec.edits if edit.change is not None)
            yield f"  {spec.title}: {first}"
            yield from (f"    {sentence}" for sentence in rest)
        for names, where in ((self.removed, self.old), (self.added, self.new)):
            for name in names:
                yield f"  {name}: only in {where.filename}"
        if same:
            yield f"  {plural(same, 'other spec') if same < len(self.specs) else 'all'} the same"

    @property
    def document(self) -> dict[str, Any]:
        """The differences as values for JSON."""
        return {
            "log": {
                "name": self.log,
                "samples": self.samples,
                "zero_ns": self.first_ns,
                "damaged": bool(self.faults),
            },
            "same": self.is_empty,
            "old": self.old.filename,
            "new": self.new.filename,
            "specifications": [spec.document for spec in self.specs],
            "removed": list(self.removed),
            "added": list(self.added),
        }

    def __repr__(self) -> str:
        return "\n".join(self.lines())


def diff_over_source(
    source: Source,
    old: Specification,
    new: Specification,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    advance: Callable[[int], None] = lambda samples: None,
) -> SpecificationDiff:
    """Evaluate two versions of a specification over a log, and find the edits that changed the results.

    Args:
        advance: function that is called with the number of samples of each read block.

    Raises:
        UsageError: the versions have no common spec or different parameters of a template, the window has no
            sample, or `evaluate` raises it.
        LogError: the log cannot be read.
        SpecificationError: the specifications mention names that the log never has, if names are strict.
    """
    selection = Selection(source, (old, new), replace(options, keep=()))
    trace, missing, zero_ns = selection.checked_trace(advance)
    versions = TextVersions(old, new, trace.units)
    old, new = versions.old, versions.new
    pairs, removed, added = _pair_specs(old, new)
    formulas, regions = unify_regions([old_spec.formula for old_spec, _ in pairs], old.regions, new.regions)
    olds = [
        replace(old_spec, formula=formula) for (old_spec, _), formula in zip(pairs, formulas, strict=True)
    ]
    news = [new_spec for _, new_spec in pairs]

    def evaluate_version(
        specs: Sequence[NamedSpec], file: Specification, shapes: Mapping[str, Outline] = regions
    ) -> Evaluation:
        results = tuple(replace(spec, is_result=True) for spec in specs)
        version = Specification(results, file.profile, dict(shapes), filename=file.filename)
        return evaluate_with(options, version, trace)

    before, after = evaluate_version(olds, old), evaluate_version(news, new)
    spec_names = {spec.name for spec in old.specs}, {spec.name for spec in new.specs}
    trees = {
        # by id, because two results can have equal formulas
        id(new_spec.formula): compare_trees(
            old_spec.formula,
            new_spec.formula,
            new_spec.name,
            regions,
            tuple(_origins(versions, *pair)),
            spec_names,
        )
        for old_spec, new_spec, pair in zip(olds, news, pairs, strict=True)
    }

    @cache
    def by_version(changes: frozenset[int], name: str, *, is_undone: bool) -> Evaluation | None:
        """Evaluate a spec of the new text with old declarations, or of the old text with new declarations."""
        file = versions.version(changes, is_undone=is_undone)
        spec = _find_spec(file, name)
        return None if file is None or spec is None else evaluate_version([spec], file, file.regions)

    return SpecificationDiff(
        source.name,
        len(before.results[0].times_ns) if before.results else 0,
        zero_ns,
        old,
        new,
        tuple(
            _spec_diff(old_result, new_result, trees[id(new_result.formula)], versions, by_version)
            for old_result, new_result in zip(before.results, after.results, strict=True)
        ),
        removed,
        added,
        counted_from(trace.faults, zero_ns),
        counted_from((doubt.remark(source.name) for doubt in trace.doubts), zero_ns),
        missing,
    )


def evaluate_with(options: ReplayOptions, file: Specification, trace: Trace) -> Evaluation:
    """Evaluate a specification over a trace, with the options of a replay."""
    parameters = {spec.parameter for spec in file.results}
    return evaluate(
        file,
        trace,
        semantics=options.semantics,
        start_ns=options.window.start_ns,
        end_ns=options.window.end_ns,
        each={name: choice for name, choice in options.each.items() if name in parameters},
    )


def _pair_specs(
    old: Specification, new: Specification
) -> tuple[list[tuple[NamedSpec, NamedSpec]], tuple[str, ...], tuple[str, ...]]:
    """Return pairs of specs that are results in either file, and names of results without a counterpart."""
    olds, news = ({spec.name: spec for spec in file.specs} for file in (old, new))
    pairs = [
        (olds[spec.name], spec)
        for spec in new.specs
        if spec.name in olds and (spec.is_result or olds[spec.name].is_result)
    ]
    removed = [spec for spec in old.results if spec.name not in news]
    added = [spec for spec in new.results if spec.name not in olds]
    # a removed and an added result of equal meaning are one renamed result
    for new_spec in tuple(added):
        for old_spec in removed:
            (formula,), regions = unify_regions([old_spec.formula], old.regions, new.regions)
            if (
                old_spec.parameter == new_spec.parameter
                and not compare_trees(formula, new_spec.formula, new_spec.name, regions).effective
            ):
                pairs.append((old_spec, new_spec))
                removed.remove(old_spec)
                added.remove(new_spec)
                break
    if not pairs:
        names = [f"{file.filename} has {', '.join(spec.name for spec in file.specs)}" for file in (old, new)]
        raise UsageError(
            f"{old.filename} and {new.filename} have no spec in common: {'; '.join(names)}. "
            "Give specs that are to be compared the same name"
        )
    for old_spec, new_spec in pairs:
        if old_spec.parameter != new_spec.parameter:
            raise UsageError(
                f"{new_spec.name} has the parameter {old_spec.parameter or 'none'} in {old.filename} and "
                f"{new_spec.parameter or 'none'} in {new.filename}; give both the same"
            )
    return pairs, tuple(spec.name for spec in removed), tuple(spec.name for spec in added)


def _origins(versions: TextVersions, one: NamedSpec, other: NamedSpec) -> Iterator[Origin]:
    """Yield the nodes of a spec that depend on each declaration, and those that depend on text of specs."""
    old, new = versions.old, versions.new
    for number, change in enumerate(versions.changes):
        applied, undone = (versions.version({number}, is_undone=is_undone) for is_undone in (False, True))
        yield Origin(
            change,
            _changes(old, one, applied, one.name) or frozenset(),
            _changes(new, other, undone, other.name) or frozenset(),
        )
    if versions.changes:
        every = range(len(versions.changes))
        nodes = (
            _changes(old, one, versions.version(every, is_undone=True), other.name),
            _changes(new, other, versions.version(every, is_undone=False), one.name),
        )
        # without a valid mixed version, every node may depend on the text of specs
        all_nodes = frozenset(range(MAX_SIZE))
        yield Origin(None, *(all_nodes if changed is None else changed for changed in nodes))


def _changes(
    file: Specification, spec: NamedSpec, version: Specification | None, name: str
) -> frozenset[int] | None:
    """Return the ids of nodes of a spec that another version lacks; None if that version is invalid."""
    counterpart = _find_spec(version, name)
    if version is None or counterpart is None:
        return None
    (formula,), regions = unify_regions([counterpart.formula], version.regions, file.regions)
    return changed_nodes(formula, spec.formula, regions)


def _find_spec(file: Specification | None, name: str) -> NamedSpec | None:
    return None if file is None else next((spec for spec in file.specs if spec.name == name), None)


def _spec_diff(
    one: SpecResult,
    other: SpecResult,
    tree: TreeDiff,
    versions: TextVersions,
    by_version: Callable[..., Evaluation | None],
) -> SpecDiff:
    outcomes = EditOutcomes(one, other, tree)
    before, after = EditOutcome.of(one), EditOutcome.of(other)
    units = find_cause(tree, outcomes, before, after)

    def with_edit(edit: Edit, *, is_undone: bool) -> EditOutcome | None:
        """Return the outcome with only one edit, or with all other edits; None if no text has just these."""
        changes: Sequence[int] = range(len(versions.changes))
        if edit.change is not None:
            changes = (versions.changes.index(edit.change),)
        elif sum(other_edit.change is None and other_edit.kind != "renamed" for other_edit in tree.edits) > 1:
            return None
        else:
            # the only edit of the specs' text: the new text with all old declarations has just this edit
            is_undone = not is_undone
        evaluation = by_version(
            frozenset(changes), other.name if is_undone else one.name, is_undone=is_undone
        )
        results = () if evaluation is None else evaluation.results
        return next((EditOutcome.of(result) for result in results if result.object == one.object), None)

    def suffices(edit: Edit) -> bool:
        verdict_only = before.verdict is not after.verdict
        outcomes_and_goals = (
            (with_edit(edit, is_undone=False), after),
            (with_edit(edit, is_undone=True), before),
        )
        return all(
            outcome is not None and outcome.same_as(goal, verdict_only=verdict_only)
            for outcome, goal in outcomes_and_goals
        )

    cause = [(edit, unit) for unit in units for edit in tree.units[unit]]
    if len(units) == 1 and len(cause) > 1:
        # of several edits that share a node, one may be enough
        cause = next(([pair] for pair in cause if suffices(pair[0])), cause)
    alone = [
        outcomes((unit,)) if len(tree.units[unit]) == 1 else with_edit(edit, is_undone=False)
        for edit, unit in cause
    ]
    return SpecDiff(
        other.name,
        one.name,
        one,
        other,
        tree,
        tuple(edit for edit, _ in cause),
        tuple(alone),
        *_places(tree.edits, versions),
    )


def _places(
    edits: Sequence[Edit], versions: TextVersions
) -> tuple[dict[Edit, TextPlace], dict[Edit, TextPlace]]:
    """Return the place of each edit in the two texts: the changed declaration or line of a spec."""
    places_by_edit: tuple[dict[Edit, TextPlace], dict[Edit, TextPlace]] = {}, {}
    for edit in edits:
        spans = edit.old_span, edit.new_span
        if edit.change is not None:
            places = edit.change.old, edit.change.new
        else:
            places = (
                versions.edited_lines(edit.old_specs, spans)[0],
                versions.edited_lines(edit.new_specs, spans)[1],
            )
        for by_edit, place in zip(places_by_edit, places, strict=True):
            if place is not None:
                by_edit[edit] = place
    return places_by_edit
