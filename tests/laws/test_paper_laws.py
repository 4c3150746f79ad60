"""The paper's semantics on every run, against Def. 16 read slowly."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import LEAVES, WORDS, bounds, cuts, recordings, specifications
from spatial_replay import Monitor, UsageError, evaluate
from spatial_replay.monitor.semantics import PaperRun
from spatial_replay.spec.formula import Atom, Boolean, Formula, Temporal, Truth, iter_nodes

LOST, LEFT_OUT = "lost", "left out"
"""What a leaf is where an object is not seen, and where it looks back to before the log."""


class UndeterminedError(Exception):
    """Something that is not known is needed."""


@dataclass(frozen=True)
class Definition:
    """Def. 16 on the samples of a run: `rho(formula, t, end)` on s_t … s_end, None where it is left out."""

    times_ns: tuple[int, ...]
    cells: dict[str, tuple[float | str, ...]]

    def number(self, formula: Formula, t: int, end: int) -> float:
        """NaN where it is undetermined."""
        try:
            found = self.rho(formula, t, end)
        except UndeterminedError:
            return math.nan
        return math.nan if found is None else found

    def rho(self, formula: Formula, t: int, end: int) -> float | None:
        match formula:
            case Truth():
                return math.inf if formula.value else -math.inf
            case Atom():
                cell = self.cells[formula.text][t]
                if cell == LOST:
                    raise UndeterminedError
                return None if isinstance(cell, str) else cell
            case Boolean():
                return boolean(formula.operator, [self.rho(each, t, end) for each in formula.operands])
            case Temporal(operator="X"):
                return self.rho(formula.operands[0], t + 1, end) if t < end else None
            case Temporal():
                window = [u for u in range(t, end + 1) if self.is_within(formula, t, u)]
                return self.unbounded(formula, window[0], window[-1]) if window else None
        raise ValueError(formula)

    def unbounded(self, formula: Temporal, t: int, end: int) -> float | None:
        first, last = formula.operands[0], formula.operands[-1]
        run = range(t, end + 1)
        if formula.operator == "F":
            return most([self.rho(last, u, end) for u in run])
        if formula.operator == "G":
            return least([self.rho(last, u, end) for u in run])
        return most(
            [
                least([self.rho(last, u, end), *(self.rho(first, w, u) for w in range(t, u + 1))])
                for u in run
            ]
        )  # fmt: skip

    def is_within(self, formula: Temporal, t: int, u: int) -> bool:
        bound = formula.bound
        if bound is None:
            return True
        apart = u - t if bound.unit == "samples" else self.times_ns[u] - self.times_ns[t]
        return bound.lower <= apart and (bound.upper is None or apart <= bound.upper)


def least(numbers: list[float | None]) -> float | None:
    return min((number for number in numbers if number is not None), default=None)


def most(numbers: list[float | None]) -> float | None:
    return max((number for number in numbers if number is not None), default=None)


def boolean(operator: str, operands: list[float | None]) -> float | None:
    first, second = operands[0], operands[-1]
    match operator:
        case "and":
            return least(operands)
        case "or":
            return most(operands)
        case "not":
            return opposite(first)
        case "->":
            return most([opposite(first), second])
        case "xor":
            return most([least([first, opposite(second)]), least([opposite(first), second])])
        case "<->":
            return least([most([opposite(first), second]), most([opposite(second), first])])
    raise ValueError(operator)


def opposite(number: float | None) -> float | None:
    return None if number is None else -number


def _operators(operands):
    single = operands.map(lambda operand: (operand,))
    pairs = st.tuples(operands, operands)
    several = st.lists(operands, min_size=2, max_size=3).map(tuple)
    return st.one_of(
        st.builds(Boolean, st.just("not"), single),
        st.builds(Boolean, st.sampled_from(["and", "or"]), several),
        st.builds(Boolean, st.sampled_from(["xor", "->", "<->"]), pairs),
        st.builds(Temporal, st.just("X"), single),
        st.builds(Temporal, st.sampled_from(["F", "G"]), single, bounds),
        st.builds(Temporal, st.just("U"), pairs, bounds),
        st.builds(Temporal, st.just("U"), pairs, bounds),
    )


_leaves = st.one_of(st.sampled_from(LEAVES), st.sampled_from(LEAVES), st.builds(Truth, st.booleans()))
formulas = st.recursive(_leaves, _operators, max_leaves=9)
_cells = st.one_of(st.integers(-9, 9).map(float), st.integers(-9, 9).map(float), st.just(LEFT_OUT))


@st.composite
def runs(draw):
    size = draw(st.integers(1, 9))
    times = [draw(st.sampled_from([0, 7]))]
    for _ in range(size - 1):
        times.append(times[-1] + draw(st.sampled_from([50, 100, 100, 130, 400])))
    cell = draw(st.sampled_from([_cells, _cells, st.one_of(_cells, _cells, _cells, st.just(LOST))]))
    return Definition(tuple(times), {leaf.text: tuple(draw(cell) for _ in times) for leaf in LEAVES})


def values(run):
    """(2, A, T): the ends of what a leaf may be, NaN where it is left out."""
    low = {LOST: -math.inf, LEFT_OUT: math.nan}
    ends = [[low.get(cell, cell) for cell in run.cells[leaf.text]] for leaf in LEAVES]
    numbers = np.array(ends, np.float64)
    return np.stack([numbers, np.where(np.isneginf(numbers), math.inf, numbers)])


def series_of(formula, run, ends):
    going, leaves, times = PaperRun(formula, LEAVES), values(run), np.array(run.times_ns)
    series = [going.extend(leaves[:, :, i:j], times[i:j]) for i, j in pairwise(ends)]
    return np.concatenate(series, axis=2)


@examples(300)
@given(formulas, runs(), st.data())
def test_every_node_on_every_prefix_equals_the_definition(formula, run, data):
    size = len(run.times_ns)
    series = series_of(formula, run, data.draw(cuts(size)))
    for identifier, _, node in iter_nodes(formula):
        value = [run.number(node, 0, last) for last in range(size)]
        now = [run.number(node, last, last) for last in range(size)]
        np.testing.assert_array_equal(series[identifier], [value, now, value, value], str(node))


@given(formulas, runs(), st.data())
def test_the_size_of_blocks_changes_no_bit(formula, run, data):
    size = len(run.times_ns)
    whole = series_of(formula, run, (0, size))
    for ends in (data.draw(cuts(size)), range(size + 1)):
        assert series_of(formula, run, ends).tobytes() == whole.tobytes()


@examples(50)
@given(specifications(words=replace(WORDS, past=False), templates=False), recordings(), st.data())
def test_a_monitor_equals_an_evaluation_sample_by_sample(specification, recording, data):
    assume(not recording.unreadable)
    trace = recording.trace()
    start_ns = int(data.draw(st.sampled_from([0, *trace.times_ns])))
    try:
        monitor = Monitor(specification, semantics="paper", start_ns=start_ns)
    except UsageError:
        assume(False)
    numbers = [monitor.update(sample).specs[0].numbers for sample in recording.samples]
    series = evaluate(specification, trace, semantics="paper", start_ns=start_ns).result().series
    seen = np.stack(numbers[int(np.searchsorted(trace.times_ns, start_ns)) :], axis=2)
    assert seen.tobytes() == series.tobytes()
