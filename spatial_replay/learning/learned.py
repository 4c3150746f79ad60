"""Specifications learned from runs: their text, the evidence for each line, and a check on runs left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from spatial_replay.errors import UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.learning.choose import chosen_lines
from spatial_replay.learning.facts import Line, Pattern
from spatial_replay.learning.fit import FittedLimits
from spatial_replay.learning.observed import Observed, robustness_of
from spatial_replay.learning.quantities import scope_of
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec import parse_specification
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.relations import DEFAULT_PROFILE, PROFILES
from spatial_replay.spec.tokens import quoted
from spatial_replay.text import counted, json_number, number_text, printable
from spatial_replay.trace.other_units import require_same_units
from spatial_replay.tuning.margins import LabelledRun
from spatial_replay.tuning.tuned import MOST_RUNS, MOST_SAMPLES

MOST_LINES: Final = 100
DEFAULT_LINES: Final = 20
_FOLDS: Final = 10
_FEWEST_SAMPLES: Final = 3
_MOST_NAMED: Final = 3
_LONGEST: Final = 1_000
"""Characters of a comment."""


@dataclass(frozen=True, slots=True)
class LearnedLine:
    """One spec, and the evidence for it.

    Attributes:
        name, title, text: of the spec; the text is its formula.
        pattern: of relations in time.
        lowest: the lowest robustness of a good run, and the run that has it.
        violated_by: the bad runs that violate it.
    """

    name: str
    title: str
    text: str
    pattern: Pattern
    lowest: float
    lowest_run: str
    violated_by: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CheckedRun:
    """A run that was left out: what the lines learned from the others say about it."""

    name: str
    is_good: bool
    verdict: Verdict

    @property
    def is_right(self) -> bool:
        """Whether it is satisfied if it is good, and violated if it is bad."""
        return self.verdict is (Verdict.SATISFIED if self.is_good else Verdict.VIOLATED)


@dataclass(frozen=True, eq=False)
class Learned(Displayed):
    """A specification learned from runs.

    Attributes:
        text: the specification file; comments say the evidence. "" if nothing was found.
        specification: the same, parsed; None if nothing was found.
        lines: its specs, in its order, the most distinctive first.
        runs: every run's name, and whether it is good, in the order given.
        missed: bad runs that no line distinguishes.
        checked: runs that were left out in turn; none with fewer than three good runs.
        left_out: what was not compared, in sentences.
    """

    text: str
    specification: Specification | None
    lines: tuple[LearnedLine, ...]
    runs: tuple[tuple[str, bool], ...]
    missed: tuple[str, ...]
    checked: tuple[CheckedRun, ...]
    left_out: tuple[str, ...]

    @property
    def is_found(self) -> bool:
        """Whether there are lines, and they distinguish every bad run."""
        return bool(self.lines) and not self.missed

    def __repr__(self) -> str:
        return f"<Learned from {counted(len(self.runs), 'run')}: {counted(len(self.lines), 'spec')}>"

    @property
    def document(self) -> dict[str, Any]:
        """This as values for JSON."""
        return {
            "found": self.is_found,
            "text": self.text,
            "lines": [
                {
                    "name": line.name,
                    "title": line.title,
                    "text": line.text,
                    "pattern": line.pattern,
                    "lowest": json_number(line.lowest),
                    "lowest_run": line.lowest_run,
                    "violated_by": list(line.violated_by),
                }
                for line in self.lines
            ],
            "runs": [{"name": name, "good": is_good} for name, is_good in self.runs],
            "missed": list(self.missed),
            "checked": [
                {"name": run.name, "good": run.is_good, "verdict": run.verdict} for run in self.checked
            ],
            "left_out": list(self.left_out),
        }


def learn_runs(
    runs: Sequence[LabelledRun],
    *,
    lines: int = DEFAULT_LINES,
    profile: str = DEFAULT_PROFILE,
    advance: Callable[[int], None] = lambda runs: None,
) -> Learned:
    """Find relations that hold in all good runs, and not in bad ones.

    Args:
        lines: write at most so many specs.
        profile: of the relations.
        advance: called with the number of runs that are measured.

    Raises:
        UsageError: fewer than two good runs, a run that is too short, runs that are equal or in other units,
            nothing that the runs have in common, unknown options.
    """
    if not 1 <= lines <= MOST_LINES:
        raise UsageError(f"{lines} lines cannot be learned; give 1 to {MOST_LINES}")
    if profile not in PROFILES:
        raise UsageError(f"unknown profile {profile!r}; the profiles are {', '.join(PROFILES)}")
    _check(runs)
    good = [run for run in runs if run.is_good]
    bad = [run for run in runs if not run.is_good]
    scope = scope_of([run.trace for run in good], profile)
    if not scope.quantities:
        raise UsageError(_nothing_in_common(good))
    left_out = (*_missing(good), *scope.left_out)
    observed: dict[int, Observed] = {}
    for run in runs:
        observed[id(run)] = Observed.of(run.trace, scope.quantities)
        advance(1)
    writer = _Writer(profile, {name for run in runs for name in run.trace.names})

    def learn(some: Sequence[LabelledRun]) -> _Written | None:
        groups = ([observed[id(run)] for run in some if run.is_good is kind] for kind in (True, False))
        found = chosen_lines(FittedLimits.to(scope.quantities, *groups), lines)
        return writer.written(found, some)

    written = learn(runs)
    if written is not None and bad:
        written = writer.ordered(written, bad)
    learned = [_evidence(*each, good, bad) for each in written.pairs] if written is not None else []
    violating = {name for line in learned for name in line.violated_by}
    checked = tuple(_checked(good, bad, learn))
    missed = tuple(run.name for run in bad if run.name not in violating)
    text = ""
    if written is not None:
        head = list(_head(good, bad, missed, checked, left_out))
        text = writer.text(written, head, learned, len(good), len(bad))
    return Learned(
        text,
        parse_specification(text, filename="learned.spatial") if text else None,
        tuple(learned),
        tuple((run.name, run.is_good) for run in runs),
        missed,
        checked,
        left_out,
    )


def _check(runs: Sequence[LabelledRun]) -> None:
    good = [run for run in runs if run.is_good]
    if len(good) < 2:
        have = "there is no good run" if not good else f"{good[0].name} is the only good run"
        raise UsageError(f"{have}; what may vary shows in several: give at least two, better five")
    if len(runs) > MOST_RUNS:
        raise UsageError(f"{len(runs)} runs are more than {MOST_RUNS}; learn from some of them")
    samples = sum(len(run.trace) for run in runs)
    if samples > MOST_SAMPLES:
        raise UsageError(
            f"the runs have {samples} samples, more than {MOST_SAMPLES}; learn from some of them"
        )
    for run in runs:
        if len(run.trace) < _FEWEST_SAMPLES:
            have = counted(len(run.trace), "sample")
            raise UsageError(f"{run.name} is too short to learn from: it has {have}; leave it out")
        if run is not runs[0]:
            require_same_units(runs[0].trace, run.trace, (runs[0].name, run.name))
    for one in good:
        for other in runs:
            if other is one or (len(one.trace), one.trace.names) != (len(other.trace), other.trace.names):
                continue
            if one.trace == other.trace:
                if one.name == other.name:
                    raise UsageError(f"{one.name} is given twice; give each run once")
                kind = "good" if other.is_good else "bad"
                raise UsageError(
                    f"the {kind} run {other.name} holds the same samples as the good run {one.name}; "
                    "leave one of them out"
                )


def _missing(good: Sequence[LabelledRun]) -> Iterator[str]:
    """Yield the objects that most good runs have, but not all."""
    counts = Counter(name for run in good for name in run.trace.names)
    some = [name for name in sorted(counts) if len(good) / 2 <= counts[name] < len(good)]
    for name in some[:_MOST_NAMED]:
        yield f"{name}, which is missing in {len(good) - counts[name]} of {counted(len(good), 'good run')}"
    if len(some) > _MOST_NAMED:
        yield f"{counted(len(some) - _MOST_NAMED, 'more object')} that some good runs lack"


def _nothing_in_common(good: Sequence[LabelledRun]) -> str:
    listed = "; ".join(
        f"{run.name} has {printable(', '.join(run.trace.names), 60) or 'none'}" for run in good[:_MOST_NAMED]
    )
    return (
        "no two objects, classes or signals are in all good runs, so there is nothing to compare: "
        f"{listed}. Give runs of one scene, or a mapping that gives objects the same names or classes"
    )


class _Written(NamedTuple):
    """Lines, and the specification that has one spec for each."""

    lines: tuple[Line, ...]
    specification: Specification

    @property
    def pairs(self) -> Iterator[tuple[Line, NamedSpec]]:
        """Each line with its spec."""
        return zip(self.lines, self.specification.specs, strict=True)


@dataclass(frozen=True)
class _Writer:
    """Writes lines as a specification; `taken` are the objects' names, which no spec or variable has."""

    profile: str
    taken: set[str]

    def written(self, lines: Sequence[Line], runs: Sequence[LabelledRun]) -> _Written | None:
        """Return the lines that, as they are written, all good runs satisfy, and that some bad run violates.

        None if there are none.
        """
        if not lines:
            return None
        kept = [
            line for line, spec in zip(lines, self._parse(lines).specs, strict=True) if _is_kept(spec, runs)
        ]
        return _Written(tuple(kept), self._parse(kept)) if kept else None

    def ordered(self, written: _Written, bad: Sequence[LabelledRun]) -> _Written:
        """Return the same lines: of those that the same bad runs violate, the shorter ones first."""
        alike: dict[tuple[bool, ...], list[Line]] = {}
        keys = []
        for line, spec in written.pairs:
            keys.append(tuple(robustness_of(spec.formula, run.trace)[1] < 0.0 for run in bad))
            alike.setdefault(keys[-1], []).append(line)
        for lines in alike.values():
            lines.sort(key=lambda line: len(line.formula(self.taken).split()))
        lines = [alike[key].pop(0) for key in keys]
        return _Written(tuple(lines), self._parse(lines))

    def _parse(self, lines: Sequence[Line]) -> Specification:
        names: set[str] = set()
        texts = [f"use {self.profile}"]
        for number, line in enumerate(lines, 1):
            name = base = line.name
            more = 2
            while name in names or name in self.taken:
                name, more = f"{base}_{more}", more + 1
            names.add(name)
            title = quoted(f"LEARNED-{number}: {printable(line.title)}")
            texts.append(f"spec {name} {title} = {line.formula(self.taken)}")
        return parse_specification("\n".join([*texts, ""]))

    def text(
        self,
        written: _Written,
        head: Sequence[str],
        evidence: Sequence[LearnedLine],
        good: int,
        bad: int,
    ) -> str:
        """Return the file: each spec in its canonical form, below a comment with its evidence."""
        lines = [*map(_comment, head), f"use {self.profile}"]
        for spec, line in zip(written.specification.specs, evidence, strict=True):
            lowest = f"lowest robustness {number_text(line.lowest)} in {line.lowest_run}"
            lines += ["", _comment(f"Holds in {good} of {counted(good, 'good run')}, {lowest}.")]
            if bad:
                violating = f"{len(line.violated_by)} of {counted(bad, 'bad run')}{_listed(line.violated_by)}"
                lines.append(_comment(f"Violated by {violating}."))
            title = quoted(f"{spec.id}: {spec.title}")
            lines.append(f"spec {spec.name} {title} = {format_formula(spec.formula)}")
        return "\n".join([*lines, ""])


def _is_kept(spec: NamedSpec, runs: Sequence[LabelledRun]) -> bool:
    """Return whether all good runs satisfy a spec, and some bad run, if there is one, violates it."""
    bad = [run for run in runs if not run.is_good]
    return all(robustness_of(spec.formula, run.trace)[0] >= 0.0 for run in runs if run.is_good) and (
        not bad or any(robustness_of(spec.formula, run.trace)[1] < 0.0 for run in bad)
    )


def _comment(text: str) -> str:
    return f"# {printable(text, _LONGEST)}"


def _listed(names: Sequence[str]) -> str:
    if not names:
        return ""
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f": {', '.join(names[:_MOST_NAMED])}{more}"


def _evidence(
    line: Line, spec: NamedSpec, good: Sequence[LabelledRun], bad: Sequence[LabelledRun]
) -> LearnedLine:
    lowest, run = min((robustness_of(spec.formula, run.trace)[0], index) for index, run in enumerate(good))
    violating = tuple(run.name for run in bad if robustness_of(spec.formula, run.trace)[1] < 0.0)
    text = format_formula(spec.formula)
    return LearnedLine(spec.name, spec.title or "", text, line.pattern, lowest, good[run].name, violating)


def _checked(
    good: Sequence[LabelledRun],
    bad: Sequence[LabelledRun],
    learn: Callable[[Sequence[LabelledRun]], _Written | None],
) -> Iterator[CheckedRun]:
    """Yield each run with its verdict by what is learned without it, and without others of its fold."""
    if len(good) < _FEWEST_SAMPLES:
        return
    folds = min(_FOLDS, max(len(good), len(bad)))
    # each fold leaves at least two good runs to learn from
    if len(good) - -(-len(good) // folds) < 2:
        folds = len(good)
    for fold in range(folds):
        left_out = [*good[fold::folds], *bad[fold::folds]]
        kept = [run for run in (*good, *bad) if not any(run is each for each in left_out)]
        written = learn(kept)
        for run in left_out:
            lower = upper = float("inf")
            for spec in () if written is None else written.specification.specs:
                low, high = robustness_of(spec.formula, run.trace)
                lower, upper = min(lower, low), min(upper, high)
            yield CheckedRun(run.name, run.is_good, final_verdict(lower, upper))


def _head(
    good: Sequence[LabelledRun],
    bad: Sequence[LabelledRun],
    missed: Sequence[str],
    checked: Sequence[CheckedRun],
    left_out: Sequence[str],
) -> Iterator[str]:
    runs = counted(len(good), "good run") + (f" and {counted(len(bad), 'bad run')}" if bad else "")
    yield f"Learned from {runs}."
    if missed:
        verb = "violates" if len(missed) == 1 else "violate"
        yield f"{counted(len(missed), 'bad run')} {verb} none of these lines{_listed(missed)}."
    if checked:
        yield checked_text(checked)
    else:
        yield "Not checked on runs left out: that takes three good runs."
    for each in left_out:
        yield f"Not compared: {each}."


def checked_text(checked: Sequence[CheckedRun]) -> str:
    """Return how the runs that were left out in turn came out, in a sentence."""
    parts = []
    for kind, what in ((True, "satisfied"), (False, "violated")):
        some = [run for run in checked if run.is_good is kind]
        if some:
            right = sum(run.is_right for run in some)
            parts.append(f"{right} of {len(some)} {'good' if kind else 'bad'} runs are {what}")
    return f"Checked on runs left out in turn: {', '.join(parts)}."
