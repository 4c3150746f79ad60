"""Two versions of a specification over one log: which verdicts changed, since when, and which edit did it.

The cause of a change is found by evaluation, not by guessing: the old formula with only these edits has the
new result, and the new formula without them has the old one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from spatial_replay.compare.declarations import DeclarationChange, TextPlace, TextVersions
from spatial_replay.compare.edit_cause import EditOutcome, EditOutcomes, find_cause
from spatial_replay.compare.edits import Edit, Origin, TreeDiff
from spatial_replay.compare.shared_names import unify_regions
from spatial_replay.compare.spec_diff import SpecDiff
from spatial_replay.compare.trees import changed_nodes, compare_trees
from spatial_replay.errors import UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.source import Source
from spatial_replay.monitor.evaluate import Evaluation, evaluate
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.replay.selection import DEFAULT_OPTIONS, LogNames, ReplayOptions, Selection
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.formula import NamedSpec, Outline, Specification
from spatial_replay.spec.resolve import MAX_SIZE
from spatial_replay.text import counted, counted_from
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, eq=False)
class SpecificationDiff(Displayed):
    """Two versions of a specification over one log.

    Attributes:
        old, new: the specifications.
        specs: what both have, by the order of the new one: results of either, renamed ones included.
        removed, added: names of results that only the old, or only the new one has.
        first_ns: the time that sentences count from.
        faults: what was lost while reading.
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
    faults: tuple[str, ...] = ()
    missing: tuple[Diagnostic, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs: no formula, new names aside, no verdict, no number."""
        is_edited = any(edit.kind != "renamed" for each in self.specs for edit in each.edits)
        return not (self.removed or self.added or is_edited or any(each.is_different for each in self.specs))

    def spec(self, name: str) -> SpecDiff:
        """Return the first diff of a spec, by its new name.

        Raises:
            UsageError: no such spec.
        """
        for each in self.specs:
            if each.name == name:
                return each
        names = [each.name for each in self.specs]
        raise UsageError(f"no spec {name!r} to compare; {nearest_hint(name, names) or ', '.join(names)}")

    def lines(self) -> Iterator[str]:
        """Yield the diff as text, as the command `diff` prints it."""
        yield f"{self.log}: {counted(self.samples, 'sample')}; {self.old.filename} → {self.new.filename}"
        same = 0
        shown: set[DeclarationChange] = set()
        for each in self.specs:
            if not each.edits and not each.is_different:
                same += 1
                continue
            first, *rest = each.sentences(self.first_ns, shown)
            shown.update(edit.change for edit in each.edits if edit.change is not None)
            yield f"  {each.title}: {first}"
            yield from (f"    {sentence}" for sentence in rest)
        for names, where in ((self.removed, self.old), (self.added, self.new)):
            for name in names:
                yield f"  {name}: only in {where.filename}"
        if same:
            yield f"  {counted(same, 'other spec') if same < len(self.specs) else 'all'} the same"

    @property
    def document(self) -> dict[str, Any]:
        """The diff as values for JSON."""
        return {
            "log": {"name": self.log, "samples": self.samples, "damaged": bool(self.faults)},
            "same": self.is_empty,
            "old": self.old.filename,
            "new": self.new.filename,
            "specifications": [each.document for each in self.specs],
            "removed": list(self.removed),
            "added": list(self.added),
        }

    def __repr__(self) -> str:
        return "\n".join(self.lines())


def compare_specifications(
    old: Specification,
    new: Specification,
    trace: Trace,
    *,
    log: str = "trace",
    start_ns: int = 0,
    end_ns: int = FOREVER,
    each: Mapping[str, str] | None = None,
    semantics: Semantics = "ltlf",
) -> SpecificationDiff:
    """Evaluate two versions of a specification over a trace, and find what changed the results.

    Args:
        start_ns, end_ns, each, semantics: as for `evaluate`.

    Raises:
        UsageError: no spec has a counterpart, another parameter of a template, or what `evaluate` raises.
    """
    pairs, removed, added = _paired(old, new)
    formulas, regions = unify_regions([one.formula for one, _ in pairs], old.regions, new.regions)
    olds = [replace(one, formula=formula) for (one, _), formula in zip(pairs, formulas, strict=True)]
    news = [other for _, other in pairs]

    def evaluated(
        specs: Sequence[NamedSpec], file: Specification, shapes: Mapping[str, Outline] = regions
    ) -> Evaluation:
        results = tuple(replace(spec, is_result=True) for spec in specs)
        return evaluate(
            Specification(results, file.profile, dict(shapes), filename=file.filename),
            trace,
            semantics=semantics,
            start_ns=start_ns,
            end_ns=min(end_ns, FOREVER),
            each=each,
        )

    before, after = evaluated(olds, old), evaluated(news, new)
    versions = TextVersions(old, new)
    names = {spec.name for spec in old.specs}, {spec.name for spec in new.specs}
    trees = {
        id(other.formula): compare_trees(
            one.formula, other.formula, other.name, regions, tuple(_origins(versions, *pair)), names
        )
        for one, other, pair in zip(olds, news, pairs, strict=True)
    }

    @cache
    def by_version(changes: frozenset[int], name: str, *, is_undone: bool) -> Evaluation | None:
        """Evaluate a spec of the new text with declarations undone, or of the old one with some edited."""
        file = versions.undone(changes) if is_undone else versions.applied(changes)
        spec = _spec_named(file, name)
        return None if file is None or spec is None else evaluated([spec], file, file.regions)

    return SpecificationDiff(
        log,
        len(before.results[0].times_ns) if before.results else 0,
        int(trace.times_ns[0]),
        old,
        new,
        tuple(
            _spec_diff(one, other, trees[id(other.formula)], versions, by_version)
            for one, other in zip(before.results, after.results, strict=True)
        ),
        removed,
        added,
        counted_from(trace.faults, int(trace.times_ns[0])),
    )


def diff_over_source(
    source: Source,
    old: Specification,
    new: Specification,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    advance: Callable[[int], None] = lambda samples: None,
) -> SpecificationDiff:
    """Compare two versions of a specification over a log; see `compare_specifications`.

    Args:
        advance: called with the number of samples of each block that is read.

    Raises:
        UsageError: what that raises, no sample in the window. LogError: the log cannot be read.
        SpecificationError: names that the log never has, if names are strict.
    """
    selection = Selection(source, (old, new), replace(options, keep=()))
    trace = selection.trace(advance)
    if not len(selection.inside(trace)):
        raise selection.nothing_to_evaluate(trace.faults)
    names = LogNames()
    names.add(trace)
    missing = selection.missing_names(names)
    window = options.window
    diff = compare_specifications(
        old,
        new,
        trace,
        log=source.name,
        start_ns=window.start_ns,
        end_ns=window.end_ns,
        each=options.each,
        semantics=options.semantics,
    )
    return replace(diff, missing=missing)


def _paired(
    old: Specification, new: Specification
) -> tuple[list[tuple[NamedSpec, NamedSpec]], tuple[str, ...], tuple[str, ...]]:
    """Return the specs that are results in either file, in pairs, and the results without a counterpart."""
    olds, news = ({spec.name: spec for spec in file.specs} for file in (old, new))
    pairs = [
        (olds[spec.name], spec)
        for spec in new.specs
        if spec.name in olds and (spec.is_result or olds[spec.name].is_result)
    ]
    removed = [spec for spec in old.results if spec.name not in news]
    added = [spec for spec in new.results if spec.name not in olds]
    for other in tuple(added):
        for one in removed:
            (formula,), regions = unify_regions([one.formula], old.regions, new.regions)
            if (
                one.parameter == other.parameter
                and not compare_trees(formula, other.formula, other.name, regions).effective
            ):
                pairs.append((one, other))
                removed.remove(one)
                added.remove(other)
                break
    if not pairs:
        names = [f"{file.filename} has {', '.join(spec.name for spec in file.specs)}" for file in (old, new)]
        raise UsageError(
            f"{old.filename} and {new.filename} have no spec in common: {'; '.join(names)}. "
            "Give what is to be compared one name"
        )
    for one, other in pairs:
        if one.parameter != other.parameter:
            raise UsageError(
                f"{other.name} has the parameter {one.parameter or 'none'} in {old.filename} and "
                f"{other.parameter or 'none'} in {new.filename}; give both the same"
            )
    return pairs, tuple(spec.name for spec in removed), tuple(spec.name for spec in added)


def _origins(versions: TextVersions, one: NamedSpec, other: NamedSpec) -> Iterator[Origin]:
    """Yield which nodes of a spec follow from each declaration, and which from the text of the specs."""
    old, new = versions.old, versions.new
    for number, change in enumerate(versions.changes):
        applied, undone = versions.applied({number}), versions.undone({number})
        yield Origin(
            change,
            _changed(old, one, applied, one.name) or frozenset(),
            _changed(new, other, undone, other.name) or frozenset(),
        )
    if versions.changes:
        every = range(len(versions.changes))
        nodes = (
            _changed(old, one, versions.undone(every), other.name),
            _changed(new, other, versions.applied(every), one.name),
        )
        # where the two cannot be distinguished, every node may follow from the text
        all_nodes = frozenset(range(MAX_SIZE))
        yield Origin(None, *(all_nodes if each is None else each for each in nodes))


def _changed(
    file: Specification, spec: NamedSpec, version: Specification | None, name: str
) -> frozenset[int] | None:
    """Return the nodes of a spec that another version of its text does not have; None without a version."""
    other = _spec_named(version, name)
    if version is None or other is None:
        return None
    (formula,), regions = unify_regions([other.formula], version.regions, file.regions)
    return changed_nodes(formula, spec.formula, regions)


def _spec_named(file: Specification | None, name: str) -> NamedSpec | None:
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
        """Return the outcome with only an edit made, or all but that; None if there is no such text."""
        changes: Sequence[int] = range(len(versions.changes))
        if edit.change is not None:
            changes = (versions.changes.index(edit.change),)
        elif sum(each.change is None and each.kind != "renamed" for each in tree.edits) > 1:
            return None
        else:
            # the only edit of the specs' text: the new one with all declarations undone has only this
            is_undone = not is_undone
        found = by_version(frozenset(changes), other.name if is_undone else one.name, is_undone=is_undone)
        results = () if found is None else found.results
        return next((EditOutcome.of(each) for each in results if each.object == one.object), None)

    def suffices(edit: Edit) -> bool:
        verdict_only = before.verdict is not after.verdict
        found = (with_edit(edit, is_undone=False), after), (with_edit(edit, is_undone=True), before)
        return all(
            each is not None and each.same_as(wanted, verdict_only=verdict_only) for each, wanted in found
        )

    cause = [(edit, unit) for unit in units for edit in tree.units[unit]]
    if len(units) == 1 and len(cause) > 1:
        # edits that share a node: one of them may do
        cause = next(([each] for each in cause if suffices(each[0])), cause)
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
    """Return where each edit is in the two texts: the declaration, or a line of a spec, that changed."""
    found: tuple[dict[Edit, TextPlace], dict[Edit, TextPlace]] = {}, {}
    for edit in edits:
        spans = edit.old_span, edit.new_span
        if edit.change is not None:
            places = edit.change.old, edit.change.new
        else:
            places = (
                versions.edited_lines(edit.old_specs, spans)[0],
                versions.edited_lines(edit.new_specs, spans)[1],
            )
        for by_edit, place in zip(found, places, strict=True):
            if place is not None:
                by_edit[edit] = place
    return found
