"""Which sample of one run stands beside which of another, and where two runs part in an automaton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.annotate.automaton_state import AutomatonRun
from spatial_replay.automata.compile import automaton
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.semantics import require_ltlf
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Specification

AlignmentKind: TypeAlias = Literal["time", "event", "progress"]


class Knot(NamedTuple):
    """Two times, one in each run, that stand beside each other."""

    a_ns: int
    b_ns: int


@dataclass(frozen=True, eq=False)
class Alignment:
    """How the samples of run A correspond to those of run B.

    Attributes:
        kind: by "time" since the first sample, by an "event", by the "progress" of an automaton.
        about: what the event or the progress is of.
        knots: at least one; between two, time runs evenly, and outside them as fast in both.
        a, b: (P,) indices of the samples that stand beside each other, by time in A.
    """

    kind: AlignmentKind
    about: str | None
    knots: tuple[Knot, ...]
    a: Integers
    b: Integers

    def __str__(self) -> str:
        if self.kind == "time":
            return "aligned by time since the first sample"
        return f"aligned by the {'event' if self.kind == 'event' else 'progress of'} {self.about}"


class Parting(NamedTuple):
    """Where the paths of two runs through one automaton part: the first states that differ.

    Attributes:
        name: of the result.
        a_ns, b_ns: when each run enters its own; None if it ends before.
        a_states, b_states: these states; () if the run ends before.
    """

    name: str
    a_ns: int | None
    b_ns: int | None
    a_states: tuple[int, ...]
    b_states: tuple[int, ...]


def align_runs(
    times_ns: tuple[Integers, Integers],
    results: Sequence[tuple[SpecResult, SpecResult]],
    files: Sequence[Specification],
    align: str,
) -> Alignment:
    """Align two runs.

    Args:
        times_ns: of the samples of A and of B, at least one each.
        results: of both runs, in pairs.
        align: "time", "progress", "progress:NAME", or the name of a spec, whose first change of sign is the
            event.

    Raises:
        UsageError: no such spec, a spec that never changes its sign, no result with an automaton.
    """
    a, b = times_ns
    start = Knot(int(a[0]), int(b[0]))
    if align == "time":
        return _alignment("time", None, [start], a, b)
    kind, colon, wanted = align.partition(":")
    if kind != "progress" or (colon and not wanted):
        return _alignment("event", align, [_event(results, align)], a, b)
    if wanted:
        results = _titled(results, wanted)
    found: list[tuple[str, list[Knot]]] = []
    for one, other in results:
        require_ltlf(one.semantics, "the progress of an automaton")
        paths = [_path(result, files) for result in (one, other)]
        if paths[0] is None or paths[1] is None:
            continue
        common = _common(paths[0], paths[1])
        knots = [
            Knot(x.time_ns, y.time_ns) for x, y in zip(paths[0][:common], paths[1][:common], strict=True)
        ]
        if common == len(paths[0]) == len(paths[1]):
            knots.append(Knot(int(a[-1]), int(b[-1])))
        found.append((one.title, knots))
    if not found:
        raise UsageError(
            f"{wanted + ' has no' if wanted else 'no spec has an'} automaton to align by (past operators and "
            "bounds in seconds have none); align by time, or by a spec's name"
        )
    # without temporal operators, an automaton ends where it begins
    name, knots = max(found, key=lambda each: len(each[1]))
    return _alignment("progress", name, knots, a, b)


def _titled(
    results: Sequence[tuple[SpecResult, SpecResult]], wanted: str
) -> list[tuple[SpecResult, SpecResult]]:
    """Return the pair of results of a name or title."""
    found = [pair for pair in results if wanted in (pair[0].title, pair[0].name)]
    if not found:
        titles = [one.title for one, _ in results]
        hint = nearest_hint(wanted, titles) or f"there are {', '.join(titles) or 'none'}"
        raise UsageError(f"no result is named {wanted!r} to align by the progress of; {hint}")
    return found


def parting_of(one: SpecResult, other: SpecResult, files: Sequence[Specification]) -> Parting | None:
    """Return where two runs of one spec part in its automaton; None if they do not, or it has none."""
    paths = [_path(result, files) for result in (one, other)]
    if paths[0] is None or paths[1] is None or paths[0] == paths[1]:
        return None
    common = _common(paths[0], paths[1])
    one_end, other_end = (path[common] if common < len(path) else None for path in (paths[0], paths[1]))
    if one_end is None and other_end is None:
        return None
    return Parting(
        one.title,
        None if one_end is None else one_end.time_ns,
        None if other_end is None else other_end.time_ns,
        () if one_end is None else one_end.states,
        () if other_end is None else other_end.states,
    )


def _alignment(
    kind: AlignmentKind, about: str | None, knots: Sequence[Knot], a_ns: Integers, b_ns: Integers
) -> Alignment:
    increasing = [knots[0]]
    for knot in knots[1:]:
        if knot.a_ns > increasing[-1].a_ns and knot.b_ns > increasing[-1].b_ns:
            increasing.append(knot)
    beside_ns = _mapped(a_ns, increasing)
    after = np.clip(np.searchsorted(b_ns, beside_ns), 1, max(len(b_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(b_ns) - 1)
    nearest = np.where(beside_ns - b_ns[before] <= b_ns[after] - beside_ns, before, after)
    # where one run has no sample within a step, there is nothing to compare with
    steps = [int(np.median(np.diff(times_ns))) for times_ns in (a_ns, b_ns) if len(times_ns) > 1]
    inside = np.flatnonzero(np.abs(b_ns[nearest] - beside_ns) <= max(steps, default=0))
    return Alignment(kind, about, tuple(increasing), inside, nearest[inside])


def _mapped(a_ns: Integers, knots: Sequence[Knot]) -> Integers:
    """Return the times in B that stand beside times in A."""
    first, last = knots[0], knots[-1]
    # relative to the first knot, so that doubles hold every nanosecond of a long log
    x = np.array([knot.a_ns - first.a_ns for knot in knots], np.float64)
    y = np.array([knot.b_ns - first.b_ns for knot in knots], np.float64)
    inner = np.round(np.interp((a_ns - first.a_ns).astype(np.float64), x, y)).astype(np.int64) + first.b_ns
    inner = np.where(a_ns < first.a_ns, a_ns - first.a_ns + first.b_ns, inner)
    return np.asarray(np.where(a_ns > last.a_ns, a_ns - last.a_ns + last.b_ns, inner), np.int64)


def _event(results: Sequence[tuple[SpecResult, SpecResult]], name: str) -> Knot:
    """Return the times at which the value of a named spec first changes its sign in each run."""
    names: list[str] = []
    for one, other in results:
        names += [node.name for node in one.nodes if node.name is not None]
        if name not in names:
            continue
        # the value of a spec without temporal operators is that of the first sample, and stays
        pairs = [
            [_first_change(result.times_ns, series(result.node(name))) for result in (one, other)]
            for series in (attrgetter("value"), attrgetter("now"))
        ]
        times = next((pair for pair in pairs if None not in pair), pairs[0])
        for which, time_ns in zip("AB", times, strict=True):
            if time_ns is None:
                raise UsageError(
                    f"{name} never changes its sign in run {which}, so it is no event to align by; "
                    "align by time, or by another spec"
                )
        return Knot(*(time_ns for time_ns in times if time_ns is not None))
    known = nearest_hint(name, names) or f"there are {', '.join(dict.fromkeys(names)) or 'none'}"
    raise UsageError(f"no spec is named {name!r} to align by; {known}; or give time or progress")


def _first_change(times_ns: Integers, values: Floats) -> int | None:
    known = np.flatnonzero(~np.isnan(values))
    holds = values[known] >= 0.0
    turned = np.flatnonzero(holds != holds[0]) if len(known) else known
    return int(times_ns[known[turned[0]]]) if len(turned) else None


class _Visit(NamedTuple):
    """States of an automaton, and the first sample after which a run is in them."""

    time_ns: int
    states: tuple[int, ...]


def _path(result: SpecResult, files: Sequence[Specification]) -> list[_Visit] | None:
    """Return the states of a run, each as often as it is entered; None without an automaton."""
    if result.leaves is None or not len(result.times_ns) or result.semantics != "ltlf":
        return None
    file = file_of(files, result)
    if file is None:
        return None
    try:
        machine = automaton(file, result.spec.name)
    except NoAutomatonError:
        return None
    run = AutomatonRun(
        result.name, result.object, machine, result.formula, result.evidence.instance.program.leaves
    )
    after = run.states(SeriesBlock(result.times_ns, result.series, result.leaves))
    changed = after[1:] != after[:-1]
    entered = [0, *(np.flatnonzero(changed if after.ndim == 1 else changed.any(axis=1)) + 1).tolist()]
    return [
        _Visit(
            int(result.times_ns[at]),
            tuple(np.flatnonzero(after[at]).tolist()) if after.ndim > 1 else (int(after[at]),),
        )
        for at in entered
    ]


def file_of(files: Sequence[Specification], result: SpecResult) -> Specification | None:
    """Return the file that a result comes from; None if it is another one."""
    pairs = [(file, each.formula) for file in files for each in file.specs]
    same = (file for file, formula in pairs if formula is result.formula)
    # one that was parsed by another profile is evaluated as it is logged: equal, and another object
    equal = (file for file, formula in pairs if formula == result.formula)
    return next(same, None) or next(equal, None)


def _common(one: Sequence[_Visit], other: Sequence[_Visit]) -> int:
    """Count the states that two paths begin with."""
    pairs = zip(one, other, strict=False)
    return next(
        (index for index, (a, b) in enumerate(pairs) if a.states != b.states), min(len(one), len(other))
    )
