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
"""Maximum number of tests of edits for one cause. At the limit, the smallest cause until then is returned."""


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
        """Return whether two outcomes have equal verdicts and equal numbers.

        Args:
            verdict_only: whether only the verdicts are compared.
        """
        if verdict_only:
            return self.verdict is other.verdict
        # two NaN count as equal
        number_pairs = zip(self[1:], other[1:], strict=True)
        return self.verdict is other.verdict and all(a == b or (a != a and b != b) for a, b in number_pairs)


class EditOutcomes:
    """Outcomes of the old formula with some of the edits. Atoms are not evaluated again."""

    def __init__(self, one: SpecResult, other: SpecResult, diff: TreeDiff) -> None:
        self._diff = diff
        self._times_ns = one.times_ns
        self._semantics = one.semantics
        self._leaf_rows: dict[Atom | Quantified, Floats] = {}
        result_leaves = [(result, result.leaves) for result in (one, other) if result.leaves is not None]
        channel_count = max((len(leaves) for _, leaves in result_leaves), default=0)
        for result, leaves in result_leaves:
            channel_leaves = in_channels(leaves, channel_count)
            for leaf_index, leaf in enumerate(result.evidence.instance.program.leaves):
                self._leaf_rows[leaf] = channel_leaves[:, leaf_index]
        self._known_outcomes: dict[frozenset[int], EditOutcome] = {}
        self.count = 0

    def __call__(self, units: Sequence[int]) -> EditOutcome:
        """Return the outcome of the old formula with the edits of some units, given by index."""
        edited_units = frozenset(units)
        if edited_units not in self._known_outcomes:
            self.count += 1
            self._known_outcomes[edited_units] = self._evaluate(self._diff.formula(edited_units))
        return self._known_outcomes[edited_units]

    def _evaluate(self, formula: Formula) -> EditOutcome:
        leaves = new_leaves(formula, ())
        leaf_shape = (
            next(iter(self._leaf_rows.values())).shape if self._leaf_rows else (1, len(self._times_ns))
        )
        leaf_rows = [self._leaf_rows[leaf] for leaf in leaves]
        leaf_values = (
            np.stack(leaf_rows, axis=1) if leaf_rows else np.empty((leaf_shape[0], 0, leaf_shape[1]))
        )
        if self._semantics == "paper":
            paper_run = PaperRun(formula, leaves)
            paper_run.extend(leaf_values, self._times_ns)
            value = float(paper_run.final[0, 0])
            return EditOutcome(final_verdict(value, value), value, value, value)
        evaluation = evaluate_offline(formula, leaves, leaf_values, self._times_ns)
        lower, upper = evaluation.interval(0)
        nominal_lower, nominal_upper = evaluation.interval(0, wide=False)
        return EditOutcome(
            final_verdict(lower, upper),
            nominal_lower if nominal_lower == nominal_upper else math.nan,
            lower,
            upper,
        )


def find_cause(
    diff: TreeDiff, outcome: Callable[[Sequence[int]], EditOutcome], old: EditOutcome, new: EditOutcome
) -> tuple[int, ...]:
    """Return the units of edits that changed the verdict or, for equal verdicts, the numbers.

    The result is sorted by depth, deepest units first. These units alone give the new outcome, and all other
    units alone give the old outcome. No unit can be left out. Single units are tried first, deeper units
    before others.

    Args:
        outcome: function from unit indices to the outcome of the old formula with the edits of these units.
    """
    if old.same_as(new):
        return ()
    verdict_only = old.verdict is not new.verdict
    units = sorted(diff.effective, key=lambda unit: -max(edit.depth for edit in diff.units[unit]))
    evaluation_count = 0

    def suffices(chosen_units: Sequence[int]) -> bool:
        nonlocal evaluation_count
        evaluation_count += 1
        other_units = [unit for unit in units if unit not in chosen_units]
        return (
            evaluation_count <= _MOST_EVALUATIONS
            and outcome(chosen_units).same_as(new, verdict_only=verdict_only)
            and outcome(other_units).same_as(old, verdict_only=verdict_only)
        )

    for unit in units:
        if suffices((unit,)):
            return (unit,)
    return tuple(minimise(units, suffices))


def minimise(parts: Sequence[int], holds: Callable[[Sequence[int]], bool]) -> list[int]:
    """Return a minimal subset of parts for which a condition holds; it must hold for all parts together.

    No single part of the subset can be left out. The method is delta debugging, which removes larger pieces
    first (Zeller and Hildebrandt 2002, https://doi.org/10.1109/32.988498).
    """
    subset = list(parts)
    piece_size = max(len(subset) // 2, 1)
    while True:
        piece_begin, is_reduced = 0, False
        while piece_begin < len(subset):
            smaller_subset = subset[:piece_begin] + subset[piece_begin + piece_size :]
            if smaller_subset and holds(smaller_subset):
                subset, is_reduced = smaller_subset, True
            else:
                piece_begin += piece_size
        if piece_size == 1 and not is_reduced:
            return subset
        piece_size = max(piece_size // 2, 1)


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
        tree: edits between the two formulas, which can be applied to the old formula one by one.
        cause: edits that changed the verdict or, for equal verdicts, the robustness; empty for equal results.
            These edits alone give the new outcome, and all other edits alone give the old outcome.
        alone: outcome with a single edit, for each edit of the cause; None if the edit needs other edits.
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
        """The edits between the two formulas, including edits in named specs."""
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
        different_samples = np.flatnonzero(
            (old_values != new_values) & ~(np.isnan(old_values) & np.isnan(new_values))
        )
        if not len(different_samples):
            return None
        sample = int(different_samples[0])
        return FirstDifference(
            int(self.old.times_ns[sample]), float(old_values[sample]), float(new_values[sample])
        )

    @property
    def title(self) -> str:
        """Name, with the object of a template's instance, and with the old name after a rename."""
        title = self.name if self.old.object is None else f"{self.name}({self.old.object})"
        return title if self.name == self.old_name else f"{title} (was {self.old_name})"

    def sentences(self, first_ns: int, shown: Collection[DeclarationChange] = ()) -> Iterator[Sentence]:
        """Yield one sentence for each change; times are relative to `first_ns`.

        Args:
            shown: declarations whose lines are not repeated.
        """
        results = (self.old, self.new) if self.is_different else (self.old,)
        yield Sentence(" → ".join(map(outcome_text, results)) + difference_text(self.old, self.new))
        if self.first is not None:
            values_with_units = (self.first.old, self.old.unit), (self.first.new, self.new.unit)
            values_text = " → ".join(
                interval_text(value, value, value, unit) for value, unit in values_with_units
            )
            yield Sentence("first differs at ", Instant(self.first.time_ns, first_ns), f": {values_text}")
        for edit, outcome in zip(self.cause, self.alone, strict=True):
            more_nodes = max(len(edit.old_nodes), len(edit.new_nodes)) - 1
            more_text = f" (and {plural(more_nodes, 'more node')})" if more_nodes else ""
            yield Sentence(f"because: {edit}, in `{edit.spec}`{more_text}")
            yield from self._lines_of(edit, shown)
            if outcome is not None:
                robustness_text = interval_text(*outcome[1:], self.old.unit)
                yield Sentence(f"  with this edit alone: {outcome.verdict}, robustness {robustness_text}")
        if len(self.cause) > 1:
            yield Sentence(self._together())
        if self.is_flipped and self.new.causes and self.new.causes[0].witness is not None:
            yield cause_reason(self.new.causes[0], first_ns)
        other_edits = [edit for edit in self.edits if edit not in self.cause]
        for edit in other_edits[:_MOST_LISTED]:
            prefix = "edited, too: " if self.cause else "edited, without effect on the result: "
            yield Sentence(f"{'' if edit.kind == 'renamed' else prefix}{edit}")
            if edit.kind != "renamed":
                yield from self._lines_of(edit, shown)
        if len(other_edits) > _MOST_LISTED:
            yield Sentence(f"and {plural(len(other_edits) - _MOST_LISTED, 'other edit')}")

    def _together(self) -> str:
        """Return a sentence on how several edits of a cause act together."""
        new_outcome = EditOutcome.of(self.new)
        sufficient_count = sum(
            outcome is not None and outcome.same_as(new_outcome, verdict_only=self.is_flipped)
            for outcome in self.alone
        )
        edit_count, quantity = len(self.cause), "verdict" if self.is_flipped else "robustness"
        if not sufficient_count:
            return f"it takes these {edit_count} edits together"
        sufficient_edits = (
            f"each of these {edit_count} edits"
            if sufficient_count == edit_count
            else f"{sufficient_count} of these {edit_count} edits"
        )
        all_edits = "both" if edit_count == 2 else f"all {edit_count}"
        return f"{sufficient_edits} is enough by itself; to get the old {quantity} back, undo {all_edits}"

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
                {**self._edit_value(edit), "alone": json_value(outcome)}
                for edit, outcome in zip(self.cause, self.alone, strict=True)
            ],
            "edits": [self._edit_value(edit) for edit in self.edits],
        }

    def _edit_value(self, edit: Edit) -> dict[str, Any]:
        place_by_side = {"old": self.old_places.get(edit), "new": self.new_places.get(edit)}
        return {
            **json_fields(edit, "kind", "spec", "subject", "old", "new", "old_nodes", "new_nodes"),
            **{f"{side}_line": place and place.line for side, place in place_by_side.items()},
            **{f"{side}_text": place and place.text for side, place in place_by_side.items()},
        }

    def __repr__(self) -> str:
        return f"<{self.title}: {outcome_text(self.old)} → {outcome_text(self.new)}>"


_MOST_LISTED: Final = 8
"""Maximum number of edits without effect in the text; JSON lists all."""


def outcome_text(result: SpecResult) -> str:
    """Return a verdict with its robustness: "violated (-0.2 m)", "violated (between -inf and -0.2 m)"."""
    return f"{result.verdict} ({interval_text(*EditOutcome.of(result)[1:], result.unit)})"


def difference_text(first: SpecResult, second: SpecResult) -> str:
    """Return ", the same" for equal outcomes.

    If different outcomes have equal texts, return a clause with the greatest difference; else return "".
    """
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
        first_ns: zero of times in sentences.
        old, new: specifications.
        specs: differences of specs that are results in either version, in the new order. Renamed specs are
            last.
        removed, added: names of results that only the old or only the new version has.
        faults: sentences on data that was lost while reading.
        doubts: remarks on assumptions that a log contradicts.
        missing: a warning for each name in the specifications that the log lacks.
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
        """Return the difference of the spec with this name in the new file, or of its first instance.

        Raises:
            UsageError: an unknown spec.
        """
        for spec in self.specs:
            if spec.name == name:
                return spec
        spec_names = [spec.name for spec in self.specs]
        raise UsageError(
            f"no spec {name!r} to compare; {nearest_hint(name, spec_names) or ', '.join(spec_names)}"
        )

    def lines(self) -> Iterator[str]:
        """Yield the lines of text that the command `diff` prints."""
        yield f"{self.log}: {plural(self.samples, 'sample')}; {self.old.filename} → {self.new.filename}"
        same_count = 0
        printed_changes: set[DeclarationChange] = set()
        for spec in self.specs:
            if not spec.edits and not spec.is_different:
                same_count += 1
                continue
            first_sentence, *other_sentences = spec.sentences(self.first_ns, printed_changes)
            printed_changes.update(edit.change for edit in spec.edits if edit.change is not None)
            yield f"  {spec.title}: {first_sentence}"
            yield from (f"    {sentence}" for sentence in other_sentences)
        for spec_names, file in ((self.removed, self.old), (self.added, self.new)):
            for name in spec_names:
                yield f"  {name}: only in {file.filename}"
        if same_count:
            yield f"  {plural(same_count, 'other spec') if same_count < len(self.specs) else 'all'} the same"

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
            sample, or `evaluate` raises this error.
        LogError: the log cannot be read.
        SpecificationError: the log lacks a name in the specifications, and names are strict.
    """
    selection = Selection(source, (old, new), replace(options, keep=()))
    trace, missing_names, zero_ns = selection.checked_trace(advance)
    versions = TextVersions(old, new, trace.units)
    old, new = versions.old, versions.new
    spec_pairs, removed_names, added_names = _pair_specs(old, new)
    formulas, regions = unify_regions(
        [old_spec.formula for old_spec, _ in spec_pairs], old.regions, new.regions
    )
    old_specs = [
        replace(old_spec, formula=formula)
        for (old_spec, _), formula in zip(spec_pairs, formulas, strict=True)
    ]
    new_specs = [new_spec for _, new_spec in spec_pairs]

    def evaluate_version(
        specs: Sequence[NamedSpec], file: Specification, shapes: Mapping[str, Outline] = regions
    ) -> Evaluation:
        result_specs = tuple(replace(spec, is_result=True) for spec in specs)
        version = Specification(result_specs, file.profile, dict(shapes), filename=file.filename)
        return evaluate_with(options, version, trace)

    old_evaluation, new_evaluation = evaluate_version(old_specs, old), evaluate_version(new_specs, new)
    spec_names = {spec.name for spec in old.specs}, {spec.name for spec in new.specs}
    trees = {
        # the keys are ids, because two results can have equal formulas
        id(new_spec.formula): compare_trees(
            old_spec.formula,
            new_spec.formula,
            new_spec.name,
            regions,
            tuple(_origins(versions, *pair)),
            spec_names,
        )
        for old_spec, new_spec, pair in zip(old_specs, new_specs, spec_pairs, strict=True)
    }

    @cache
    def by_version(changes: frozenset[int], name: str, *, is_undone: bool) -> Evaluation | None:
        """Evaluate a spec of the new text with old declarations, or of the old text with new declarations."""
        file = versions.version(changes, is_undone=is_undone)
        spec = _find_spec(file, name)
        return None if file is None or spec is None else evaluate_version([spec], file, file.regions)

    return SpecificationDiff(
        source.name,
        len(old_evaluation.results[0].times_ns) if old_evaluation.results else 0,
        zero_ns,
        old,
        new,
        tuple(
            _spec_diff(old_result, new_result, trees[id(new_result.formula)], versions, by_version)
            for old_result, new_result in zip(old_evaluation.results, new_evaluation.results, strict=True)
        ),
        removed_names,
        added_names,
        counted_from(trace.faults, zero_ns),
        counted_from((doubt.remark(source.name) for doubt in trace.doubts), zero_ns),
        missing_names,
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
    """Return pairs of specs that are results in either file, and the names of removed and added results."""
    old_by_name, new_by_name = ({spec.name: spec for spec in file.specs} for file in (old, new))
    spec_pairs = [
        (old_by_name[spec.name], spec)
        for spec in new.specs
        if spec.name in old_by_name and (spec.is_result or old_by_name[spec.name].is_result)
    ]
    removed_specs = [spec for spec in old.results if spec.name not in new_by_name]
    added_specs = [spec for spec in new.results if spec.name not in old_by_name]
    # a removed and an added result of equal meaning are one renamed result
    for new_spec in tuple(added_specs):
        for old_spec in removed_specs:
            (formula,), regions = unify_regions([old_spec.formula], old.regions, new.regions)
            if (
                old_spec.parameter == new_spec.parameter
                and not compare_trees(formula, new_spec.formula, new_spec.name, regions).effective
            ):
                spec_pairs.append((old_spec, new_spec))
                removed_specs.remove(old_spec)
                added_specs.remove(new_spec)
                break
    if not spec_pairs:
        file_texts = [
            f"{file.filename} has {', '.join(spec.name for spec in file.specs)}" for file in (old, new)
        ]
        raise UsageError(
            f"{old.filename} and {new.filename} have no spec in common: {'; '.join(file_texts)}. "
            "Give specs that are to be compared the same name"
        )
    for old_spec, new_spec in spec_pairs:
        if old_spec.parameter != new_spec.parameter:
            raise UsageError(
                f"{new_spec.name} has the parameter {old_spec.parameter or 'none'} in {old.filename} and "
                f"{new_spec.parameter or 'none'} in {new.filename}; give both the same"
            )
    return spec_pairs, tuple(spec.name for spec in removed_specs), tuple(spec.name for spec in added_specs)


def _origins(versions: TextVersions, old_spec: NamedSpec, new_spec: NamedSpec) -> Iterator[Origin]:
    """Yield the nodes of a spec that depend on each changed declaration, and on changed texts of specs."""
    old_file, new_file = versions.old, versions.new
    for change_index, change in enumerate(versions.changes):
        applied_version, undone_version = (
            versions.version({change_index}, is_undone=is_undone) for is_undone in (False, True)
        )
        yield Origin(
            change,
            _changes(old_file, old_spec, applied_version, old_spec.name) or frozenset(),
            _changes(new_file, new_spec, undone_version, new_spec.name) or frozenset(),
        )
    if versions.changes:
        all_changes = range(len(versions.changes))
        text_nodes = (
            _changes(old_file, old_spec, versions.version(all_changes, is_undone=True), new_spec.name),
            _changes(new_file, new_spec, versions.version(all_changes, is_undone=False), old_spec.name),
        )
        # without a valid mixed version, every node may depend on the text of specs
        all_nodes = frozenset(range(MAX_SIZE))
        yield Origin(None, *(all_nodes if node_ids is None else node_ids for node_ids in text_nodes))


def _changes(
    file: Specification, spec: NamedSpec, other_file: Specification | None, counterpart_name: str
) -> frozenset[int] | None:
    """Return the ids of a spec's nodes that its counterpart in another file lacks.

    The result is None if the other file is invalid or has no counterpart.
    """
    counterpart = _find_spec(other_file, counterpart_name)
    if other_file is None or counterpart is None:
        return None
    (formula,), regions = unify_regions([counterpart.formula], other_file.regions, file.regions)
    return changed_nodes(formula, spec.formula, regions)


def _find_spec(file: Specification | None, name: str) -> NamedSpec | None:
    return None if file is None else next((spec for spec in file.specs if spec.name == name), None)


def _spec_diff(
    old_result: SpecResult,
    new_result: SpecResult,
    tree: TreeDiff,
    versions: TextVersions,
    by_version: Callable[..., Evaluation | None],
) -> SpecDiff:
    edit_outcomes = EditOutcomes(old_result, new_result, tree)
    old_outcome, new_outcome = EditOutcome.of(old_result), EditOutcome.of(new_result)
    cause_units = find_cause(tree, edit_outcomes, old_outcome, new_outcome)

    def with_edit(edit: Edit, *, is_undone: bool) -> EditOutcome | None:
        """Return the outcome with only one edit. If `is_undone`, all edits except this edit are applied.

        The result is None if no mixed version of the text has exactly these edits.
        """
        change_indices: Sequence[int] = range(len(versions.changes))
        if edit.change is not None:
            change_indices = (versions.changes.index(edit.change),)
        elif sum(other_edit.change is None and other_edit.kind != "renamed" for other_edit in tree.edits) > 1:
            return None
        else:
            # the specs have no other edit, so the new text with all old declarations contains only this edit
            is_undone = not is_undone
        evaluation = by_version(
            frozenset(change_indices), new_result.name if is_undone else old_result.name, is_undone=is_undone
        )
        version_results = () if evaluation is None else evaluation.results
        return next(
            (EditOutcome.of(result) for result in version_results if result.object == old_result.object), None
        )

    def suffices(edit: Edit) -> bool:
        verdict_only = old_outcome.verdict is not new_outcome.verdict
        outcomes_and_goals = (
            (with_edit(edit, is_undone=False), new_outcome),
            (with_edit(edit, is_undone=True), old_outcome),
        )
        return all(
            outcome is not None and outcome.same_as(wanted_outcome, verdict_only=verdict_only)
            for outcome, wanted_outcome in outcomes_and_goals
        )

    cause_edits = [(edit, unit) for unit in cause_units for edit in tree.units[unit]]
    if len(cause_units) == 1 and len(cause_edits) > 1:
        # one of the edits that share a node may be sufficient by itself
        cause_edits = next(
            ([edit_with_unit] for edit_with_unit in cause_edits if suffices(edit_with_unit[0])), cause_edits
        )
    outcomes_alone = [
        edit_outcomes((unit,)) if len(tree.units[unit]) == 1 else with_edit(edit, is_undone=False)
        for edit, unit in cause_edits
    ]
    return SpecDiff(
        new_result.name,
        old_result.name,
        old_result,
        new_result,
        tree,
        tuple(edit for edit, _ in cause_edits),
        tuple(outcomes_alone),
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
        for place_by_edit, place in zip(places_by_edit, places, strict=True):
            if place is not None:
                place_by_edit[edit] = place
    return places_by_edit
