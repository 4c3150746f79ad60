"""Two versions of a specification over one log: which verdicts changed, since when, and which edit did it.

The cause of a change is found by evaluation, not by guessing: the old formula with only these edits has the new
result, and the new formula without them has the old one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.compare.trees import Edit, TreeDiff, compare_trees, unify_regions
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.evaluate import evaluate
from spatial_replay.monitor.offline import evaluate_offline, new_leaves
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import number_text, reason_sentence, time_text
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import Atom, Formula, NamedSpec, Quantified, Span, Specification
from spatial_replay.spec.load import parse_specification
from spatial_replay.text import counted, json_number
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace

_MOST_EVALUATIONS: Final = 256
"""Formulas that are evaluated to find the cause of one change; the cause found by then stands."""
_MOST_CONSTANTS: Final = 32
"""Changed constants of a file that edits are traced back to."""


class TextPlace(NamedTuple):
    """A line of a specification file, from 1."""

    filename: str
    line: int
    text: str


class Outcome(NamedTuple):
    """The result of a formula on a finished log; the robustness is NaN if not determined."""

    verdict: Verdict
    robustness: float
    lower: float
    upper: float

    @classmethod
    def of(cls, result: SpecResult) -> Outcome:
        return cls(result.verdict, result.robustness, result.lower, result.upper)

    def same_as(self, other: Outcome, *, verdict_only: bool = False) -> bool:
        """Say whether two outcomes have one verdict and, unless that is all that counts, the same numbers."""
        if verdict_only:
            return self.verdict is other.verdict
        pairs = zip(self[1:], other[1:], strict=True)
        return self.verdict is other.verdict and all(a == b or (a != a and b != b) for a, b in pairs)


class FirstDifference(NamedTuple):
    """The first sample with another value of a result, and both values (NaN: not determined)."""

    time_ns: int
    old: float
    new: float


@dataclass(frozen=True, eq=False)
class SpecDiff(Displayed):
    """One spec before and after the edit, or one object's instance of a template.

    Attributes:
        name: in the new file; `old_name` in the old one.
        old, new: its results over the log.
        edits: between the two formulas, named specs within them included.
        cause: the edits that changed the verdict or, if that stayed, the robustness; none if both stayed.
            Making only these gives the new outcome, making all others the old one.
        alone: for each edit of the cause, the outcome with that edit only.
        old_places, new_places: the lines of the two texts, by edit.
    """

    name: str
    old_name: str
    old: SpecResult
    new: SpecResult
    edits: tuple[Edit, ...]
    cause: tuple[Edit, ...]
    alone: tuple[Outcome, ...]
    old_places: Mapping[Edit, TextPlace]
    new_places: Mapping[Edit, TextPlace]

    @property
    def is_flipped(self) -> bool:
        """Whether the verdict changed."""
        return self.old.verdict is not self.new.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdict or a final number changed."""
        return not Outcome.of(self.old).same_as(Outcome.of(self.new))

    @cached_property
    def first(self) -> FirstDifference | None:
        """The first sample with another value or another interval; None if there is none."""
        if self.old.times_ns.shape != self.new.times_ns.shape:
            return None
        one, other = self.old.series[0, [0, 2, 3]], self.new.series[0, [0, 2, 3]]
        differs = ((one != other) & ~(np.isnan(one) & np.isnan(other))).any(axis=0)
        at = int(differs.argmax()) if len(differs) else 0
        if not len(differs) or not differs[at]:
            return None
        return FirstDifference(int(self.old.times_ns[at]), float(one[0, at]), float(other[0, at]))

    @property
    def title(self) -> str:
        """Its name with the object that it is about, and its old name if that was another."""
        title = self.name if self.old.object is None else f"{self.name}({self.old.object})"
        return title if self.name == self.old_name else f"{title} (was {self.old_name})"

    def sentences(self, first_ns: int) -> Iterator[str]:
        """Yield what changed, one sentence each, with times counted from `first_ns`."""
        yield f"{_outcome_text(self.old)} → {_outcome_text(self.new)}"
        if self.first is not None:
            values = f"{number_text(self.first.old)} → {number_text(self.first.new)}"
            yield f"first differs at {time_text(self.first.time_ns, first_ns)}: {values}"
        for edit, alone in zip(self.cause, self.alone, strict=True):
            yield f"because: {edit}, in {edit.spec}"
            for places in (self.old_places, self.new_places):
                if edit in places:
                    place = places[edit]
                    yield f"  {place.filename}:{place.line}: {place.text}"
            numbers = f"{alone.verdict}, robustness {number_text(alone.robustness)}"
            yield f"  with this edit alone: {numbers}"
        if len(self.cause) > 1:
            yield f"only these {len(self.cause)} edits together bring it about"
        if self.is_flipped and self.new.causes and self.new.causes[0].witness is not None:
            yield reason_sentence(self.new.causes[0].witness, first_ns=first_ns)
        others = [edit for edit in self.edits if edit not in self.cause]
        for edit in others[:_MOST_LISTED]:
            yield f"{'also' if self.cause else 'edited, without effect on the result'}: {edit}"
        if len(others) > _MOST_LISTED:
            yield f"and {counted(len(others) - _MOST_LISTED, 'other edit')}"

    @property
    def document(self) -> dict[str, Any]:
        """The same as values for JSON."""
        first = self.first
        return {
            "name": self.name,
            "old_name": self.old_name,
            "object": self.old.object,
            "flipped": self.is_flipped,
            "old": _outcome_value(Outcome.of(self.old)),
            "new": _outcome_value(Outcome.of(self.new)),
            "first_difference": None
            if first is None
            else {"time_ns": first.time_ns, "old": json_number(first.old), "new": json_number(first.new)},
            "cause": [
                {**self._edit_value(edit), "alone": _outcome_value(alone)}
                for edit, alone in zip(self.cause, self.alone, strict=True)
            ],
            "edits": [self._edit_value(edit) for edit in self.edits],
        }

    def _edit_value(self, edit: Edit) -> dict[str, Any]:
        old, new = self.old_places.get(edit), self.new_places.get(edit)
        return {
            "kind": edit.kind,
            "spec": edit.spec,
            "subject": edit.subject,
            "old": edit.old,
            "new": edit.new,
            "old_nodes": list(edit.old_nodes),
            "new_nodes": list(edit.new_nodes),
            "old_line": None if old is None else old.line,
            "new_line": None if new is None else new.line,
        }

    def __repr__(self) -> str:
        return f"<{self.title}: {_outcome_text(self.old)} → {_outcome_text(self.new)}>"


_MOST_LISTED: Final = 8
"""Edits without effect that are listed; JSON has all."""


@dataclass(frozen=True, eq=False)
class SpecificationDiff(Displayed):
    """Two versions of a specification over one log.

    Attributes:
        old, new: the specifications.
        specs: what both have, by the order of the new one: results of either, renamed ones included.
        removed, added: names of results that only the old, or only the new one has.
        first_ns: the time that sentences count from.
    """

    log: str
    samples: int
    first_ns: int
    old: Specification
    new: Specification
    specs: tuple[SpecDiff, ...]
    removed: tuple[str, ...]
    added: tuple[str, ...]
    faults: tuple[str, ...] = field(default=())

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs: no formula, no verdict, no number."""
        return not (self.removed or self.added or any(each.edits or each.is_different for each in self.specs))

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
) -> SpecificationDiff:
    """Evaluate two versions of a specification over a trace, and find what changed the results.

    Args:
        start_ns, end_ns, each: as for `evaluate`.

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
            start_ns=start_ns,
            end_ns=min(end_ns, FOREVER),
            each=each,
        )
        for specs, file in ((olds, old), (news, new))
    )
    trees = {
        id(other.formula): _traced_back(compare_trees(one.formula, other.formula, other.name), one, other, old, new)
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
        trace.faults,
    )


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
            if one.parameter == other.parameter and not compare_trees(
                formulas[0], other.formula, other.name
            ).effective:
                pairs.append((one, other))
                removed.remove(one)
                added.remove(other)
                break
    if not pairs:
        names = [", ".join(spec.name for spec in file.specs) for file in (old, new)]
        raise UsageError(
            f"{old.filename} and {new.filename} have no spec in common: {names[0]}; {names[1]}. "
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
                if edit.kind in ("constant", "replaced") and edit.subject is None and _place_of(edit) not in rest
                else edit
                for edit in edits
            ]
    return replace(diff, edits=tuple(edits))


def _place_of(edit: Edit) -> tuple[object, ...]:
    return edit.kind, edit.old_nodes, edit.new_nodes


def _spec_diff(
    one: SpecResult, other: SpecResult, diff: TreeDiff, old: Specification, new: Specification
) -> SpecDiff:
    outcomes = _Outcomes(one, other, diff)
    cause = find_cause(diff, outcomes, Outcome.of(one), Outcome.of(other))
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


class _Outcomes:
    """What the old formula gives with some of the edits; atoms are those that were evaluated already."""

    def __init__(self, one: SpecResult, other: SpecResult, diff: TreeDiff) -> None:
        self._diff = diff
        self._times_ns = one.times_ns
        self._rows: dict[Atom | Quantified, Floats] = {}
        blocks = [(each, each.leaves) for each in (one, other) if each.leaves is not None]
        channels = max((len(leaves) for _, leaves in blocks), default=0)
        for each, leaves in blocks:
            columns = in_channels(leaves, channels)
            for index, leaf in enumerate(each.evidence.instance.program.leaves):
                self._rows[leaf] = columns[:, index]
        self._known: dict[frozenset[int], Outcome] = {}
        self.count = 0

    def __call__(self, edits: Sequence[int]) -> Outcome:
        """Return the outcome of the old formula with only these edits made."""
        chosen = frozenset(edits)
        if chosen not in self._known:
            self.count += 1
            self._known[chosen] = self._evaluated(self._diff.formula(chosen))
        return self._known[chosen]

    def _evaluated(self, formula: Formula) -> Outcome:
        leaves = new_leaves(formula, ())
        shape = next(iter(self._rows.values())).shape if self._rows else (1, len(self._times_ns))
        rows = [self._rows[leaf] for leaf in leaves]
        columns = np.stack(rows, axis=1) if rows else np.empty((shape[0], 0, shape[1]))
        done = evaluate_offline(formula, leaves, columns, self._times_ns)
        lower, upper = (float(end[0]) + 0.0 for end in done.ends(0))
        least, greatest = (float(end[0]) + 0.0 for end in done.ends(0, wide=False))
        return Outcome(final_verdict(lower, upper), least if least == greatest else math.nan, lower, upper)


def find_cause(
    diff: TreeDiff, outcome: Callable[[Sequence[int]], Outcome], old: Outcome, new: Outcome
) -> tuple[int, ...]:
    """Return the edits that changed a verdict or, if that stayed, the numbers; deepest first.

    Making only these gives the new verdict (numbers), making all the others the old one, and none of them can
    be left out. A single edit is looked for first, the deepest before others.

    Args:
        outcome: returns the outcome of the old formula with some of the edits.
    """
    if old.same_as(new):
        return ()
    verdict_only = old.verdict is not new.verdict
    edits = sorted(diff.effective, key=lambda number: -diff.edits[number].depth)
    evaluated = 0

    def suffices(chosen: Sequence[int]) -> bool:
        nonlocal evaluated
        evaluated += 1
        others = [number for number in edits if number not in chosen]
        return (
            evaluated <= _MOST_EVALUATIONS
            and outcome(chosen).same_as(new, verdict_only=verdict_only)
            and outcome(others).same_as(old, verdict_only=verdict_only)
        )

    for number in edits:
        if suffices((number,)):
            return (number,)
    return tuple(minimised(edits, suffices))


def minimised(parts: Sequence[int], holds: Callable[[Sequence[int]], bool]) -> list[int]:
    """Return some of the parts for which a condition, which holds for all of them, still holds.

    None of these can be left out alone (delta debugging: larger pieces are left out first).
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


def _outcome_text(result: SpecResult) -> str:
    return f"{result.verdict} ({number_text(result.robustness)})"


def _outcome_value(outcome: Outcome) -> dict[str, Any]:
    return {
        "verdict": str(outcome.verdict),
        "robustness": json_number(outcome.robustness),
        "lower": json_number(outcome.lower),
        "upper": json_number(outcome.upper),
    }
