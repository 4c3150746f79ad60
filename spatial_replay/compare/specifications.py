"""Two versions of a specification over one log: which verdicts changed, since when, and which edit did it.

The cause of a change is found by evaluation, not by guessing: the old formula with only these edits has the
new result, and the new formula without them has the old one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

from spatial_replay.compare.edit_cause import EditOutcome, EditOutcomes, find_cause
from spatial_replay.compare.shared_names import unify_regions
from spatial_replay.compare.spec_diff import SpecDiff, TextPlace
from spatial_replay.compare.trees import Edit, TreeDiff, compare_trees
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.source import Source
from spatial_replay.monitor.evaluate import evaluate
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.replay.selection import DEFAULT_OPTIONS, LogNames, ReplayOptions, Selection
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import NamedSpec, Span, Specification
from spatial_replay.spec.load import parse_specification
from spatial_replay.text import counted, counted_from
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace

_MOST_CONSTANTS: Final = 32
"""Changed constants of a file that edits are traced back to."""


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
        for each in self.specs:
            if not each.edits and not each.is_different:
                same += 1
                continue
            first, *rest = each.sentences(self.first_ns)
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
    olds = tuple(
        replace(one, formula=formula, is_result=True)
        for (one, _), formula in zip(pairs, formulas, strict=True)
    )
    news = tuple(replace(other, is_result=True) for _, other in pairs)
    before, after = (
        evaluate(
            Specification(specs, file.profile, regions, filename=file.filename),
            trace,
            semantics=semantics,
            start_ns=start_ns,
            end_ns=min(end_ns, FOREVER),
            each=each,
        )
        for specs, file in ((olds, old), (news, new))
    )
    trees = {
        id(other.formula): _traced_back(
            compare_trees(one.formula, other.formula, other.name), one, other, old, new
        )
        for one, other in zip(olds, news, strict=True)
    }
    return SpecificationDiff(
        log,
        len(before.results[0].times_ns) if before.results else 0,
        int(trace.times_ns[0]),
        old,
        new,
        tuple(
            _spec_diff(one, other, trees[id(other.formula)], old, new)
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
            formulas, _ = unify_regions([one.formula], old.regions, new.regions)
            if (
                one.parameter == other.parameter
                and not compare_trees(formulas[0], other.formula, other.name).effective
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


def _traced_back(
    diff: TreeDiff, one: NamedSpec, other: NamedSpec, old: Specification, new: Specification
) -> TreeDiff:
    """Return a diff whose edits name the constant that they follow from, if one has another value."""
    changed = [
        name
        for name, value in new.constants.items()
        if name in old.constants
        and (old.constants[name].value, old.constants[name].duration_ns) != (value.value, value.duration_ns)
    ]
    edits = list(diff.edits)
    for name in changed[:_MOST_CONSTANTS]:
        written = old.constants[name]
        duration_ns = written.duration_ns
        value = written.value if duration_ns is None else format_duration(duration_ns)
        with suppress(SpecificationError, UsageError):
            undone = parse_specification(new.source, profile=new.profile, constants={name: value})
            formula = next(spec.formula for spec in undone.specs if spec.name == other.name)
            before, _ = unify_regions([one.formula], old.regions, undone.regions)
            rest = {_place_of(edit) for edit in compare_trees(before[0], formula, other.name).edits}
            edits = [
                replace(edit, subject=name)
                if edit.kind in ("constant", "replaced")
                and edit.subject is None
                and _place_of(edit) not in rest
                else edit
                for edit in edits
            ]
    return replace(diff, edits=tuple(edits))


def _place_of(edit: Edit) -> tuple[object, ...]:
    return edit.kind, edit.old_nodes, edit.new_nodes


def _spec_diff(
    one: SpecResult, other: SpecResult, diff: TreeDiff, old: Specification, new: Specification
) -> SpecDiff:
    outcomes = EditOutcomes(one, other, diff)
    cause = find_cause(diff, outcomes, EditOutcome.of(one), EditOutcome.of(other))
    return SpecDiff(
        other.name,
        one.name,
        one,
        other,
        diff.edits,
        tuple(diff.edits[number] for number in cause),
        tuple(outcomes((number,)) for number in cause),
        dict(_places(diff.edits, old, is_old=True)),
        dict(_places(diff.edits, new, is_old=False)),
    )


_STATEMENT: Final = {"region": "region", "group": "group", "constant": "const", "replaced": "const"}


def _places(edits: Sequence[Edit], file: Specification, *, is_old: bool) -> Iterator[tuple[Edit, TextPlace]]:
    """Yield the line that each edit is in: of the definition that changed, or of the node."""
    lines = file.source.splitlines()
    for edit in edits:
        line = None
        if edit.subject is not None and edit.kind in _STATEMENT:
            line = _defining_line(lines, _STATEMENT[edit.kind], edit.subject)
        span = edit.old_span if is_old else edit.new_span
        if line is None and span is not None and span != Span(0, 0):
            line = len(file.source[: span.start + 1].splitlines())
        if line is not None and 0 < line <= len(lines):
            yield edit, TextPlace(file.filename, line, lines[line - 1].strip())


def _defining_line(lines: Sequence[str], statement: str, name: str) -> int | None:
    pattern = re.compile(rf'\s*{statement}\s+"?{re.escape(name)}"?\s*=')
    return next((number for number, line in enumerate(lines, 1) if pattern.match(line)), None)
