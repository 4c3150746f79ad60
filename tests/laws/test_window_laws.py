"""Windows over long runs: samples that come together say what they say one by one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from examples import examples
from laws.reference import ANYTHING, Interval, numbers_of
from laws.strategies_monitor import LEAVES, LeafRun, combinations_of, responses, windows_of
from laws.test_monitor_laws import fewest
from spatial_replay import UsageError
from spatial_replay.compiled import only
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.online.step import OnlineRun
from spatial_replay.spec.formula import Boolean, Bound, Temporal

P, Q, R = LEAVES

# --------------------------------------------------------------------------------------------- formulas

_widths = st.sampled_from([0, 0, 1, 2, 5, 8, 15, 16, 17, 31, 32, 33, 40, 80, 130, 260])
_begins = st.sampled_from([0, 0, 0, 0, 1, 2, 10, 31, 33, 40])
_even_bounds = st.builds(lambda low, more: Bound(low, low + more, "samples"), _begins, _widths)
_timed_bounds = st.builds(
    lambda low, more: Bound(low, low + more, "ns"),
    st.sampled_from([0, 0, 0, 1, 50, 100, 250, 1000, 3300]),
    st.sampled_from([0, 1, 50, 99, 100, 101, 250, 800, 1600, 3200, 8000, 8 * 10**18]),
)
_wide = st.one_of(_even_bounds, _timed_bounds)
_endless = st.one_of(
    st.none(), st.none(), st.builds(Bound, st.sampled_from([1, 33]), st.none(), st.just("samples"))
)
_bounds = st.one_of(_wide, _wide, _endless)
_literals = st.one_of(
    *[st.sampled_from(LEAVES)] * 3, st.sampled_from(LEAVES).map(lambda leaf: Boolean("not", (leaf,)))
)


def _below(depth):
    """Formulas of so many operators over each other, at most."""
    if depth == 0:
        return _literals
    return st.one_of(_literals, *[combinations_of(_below(depth - 1), _bounds)] * 3)


def _behind(operands):
    return st.one_of(
        st.builds(Temporal, st.sampled_from(["O", "H"]), st.tuples(operands), _bounds),
        st.builds(Temporal, st.just("S"), st.tuples(operands, operands), _bounds),
        st.builds(Temporal, st.just("Y"), st.tuples(operands)),
    )


_ahead = windows_of(_literals, _bounds)
_over = windows_of(_below(1), _bounds)
_deep = st.one_of(windows_of(st.one_of(_over, _behind(_ahead)), _bounds), _behind(_over))
_beside = st.builds(Boolean, st.sampled_from(["and", "or", "xor", "<->"]), st.tuples(_ahead, _over))
formulas = st.one_of(
    responses(_deep), responses(_over), responses(_beside), _deep, _behind(_below(2)), _below(3)
)
_ends = st.one_of(
    st.builds(
        lambda low, more: Bound(low, low + more, "samples"),
        st.sampled_from([0, 0, 0, 1, 5, 31, 40]),
        st.sampled_from([1, 2, 8, 31, 32, 33, 64, 100, 150, 260, 5000]),
    ),
    st.builds(
        lambda low, more: Bound(low, low + more, "ns"),
        st.sampled_from([0, 0, 0, 1, 100, 250, 3300]),
        st.sampled_from([1, 50, 100, 800, 3200, 3250, 8000, 10**6, 8 * 10**18]),
    ),
)
_far = st.one_of(
    st.builds(
        lambda low, more: Bound(low, low + more, "samples"),
        st.sampled_from([0, 0, 0, 0, 1, 33, 200]),
        st.sampled_from([0, 5, 100, 150, 200, 260, 330]),
    ),
    st.builds(
        lambda low, more: Bound(low, low + more, "ns"),
        st.sampled_from([0, 0, 0, 0, 1, 3300, 20000]),
        st.sampled_from([0, 500, 10000, 15000, 20000, 33000]),
    ),
)

_far_or_never = st.one_of(_far, st.none())


def _wide_windows(depth):
    if depth == 0:
        return _literals
    below = _wide_windows(depth - 1)
    return st.one_of(
        *[st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(below), _far)] * 4,
        st.builds(Temporal, st.sampled_from(["O", "H"]), st.tuples(below), _far),
        st.builds(Temporal, st.sampled_from(["U", "R", "S"]), st.tuples(_literals, below), _far_or_never),
        st.builds(Temporal, st.sampled_from(["U", "R", "S"]), st.tuples(below, _literals), _far_or_never),
        st.builds(Temporal, st.sampled_from(["F", "G", "O", "H"]), st.tuples(below)),
        *[st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(_literals, below))] * 3,
        st.builds(
            Boolean, st.sampled_from(["and", "or", "<->"]), st.tuples(below, _wide_windows(min(depth - 1, 1)))
        ),
    )


wide_windows = st.one_of(
    *[st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_wide_windows(4)))] * 4,
    st.builds(Temporal, st.sampled_from(["U", "R", "W"]), st.tuples(_literals, _wide_windows(3))),
    st.builds(Temporal, st.sampled_from(["U", "R", "W"]), st.tuples(_wide_windows(2), _wide_windows(2))),
)
"""Windows of some hundred samples over each other, and operators that never end above and below them."""


_conditioned = st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(_literals, _ahead))
_several = st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(_conditioned, _ahead))
_endless = st.one_of(
    st.builds(Temporal, st.sampled_from(["F", "G", "O", "H"]), st.tuples(st.one_of(_conditioned, _over))),
    st.builds(Temporal, st.sampled_from(["U", "S"]), st.tuples(_literals, st.one_of(_conditioned, _ahead))),
    st.builds(Temporal, st.sampled_from(["U", "S"]), st.tuples(_conditioned, _literals)),
)
_beside_endless = st.builds(
    Boolean, st.sampled_from(["and", "or", "->", "<->"]), st.tuples(st.one_of(_literals, _ahead), _endless)
)
_below_ends = st.one_of(_conditioned, _several, _over, _deep, _beside, _behind(_ahead), _below(2))
_ending_body = st.one_of(*[_below_ends] * 2, _endless, _beside_endless)
ending = st.one_of(
    *[st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_ending_body), _ends)] * 3,
    st.builds(Temporal, st.sampled_from(["U", "R"]), st.tuples(_literals, _ending_body), _ends),
    st.builds(Temporal, st.sampled_from(["U", "R"]), st.tuples(_conditioned, _conditioned), _ends),
)
"""A window from the first sample on over what looks ahead itself."""

_brief = st.one_of(
    st.builds(lambda low, more: Bound(low, low + more, "samples"), st.integers(0, 2), st.integers(0, 9)),
    st.builds(
        lambda low, more: Bound(low, low + more, "ns"), st.sampled_from([0, 0, 100]), st.integers(0, 900)
    ),
)


def _one_way(window, until, depth, bounds):
    """What only rises, or only falls, as samples come; past operators over it, and literals beside it."""
    if depth == 0:
        return _literals
    below = _one_way(window, until, depth - 1, bounds)
    return st.one_of(
        *[st.builds(Temporal, st.just(window), st.tuples(below), bounds)] * 3,
        st.builds(Temporal, st.just(until), st.tuples(below, below), bounds),
        st.builds(Temporal, st.sampled_from(["O", "H"]), st.tuples(below), bounds),
        *[st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(_literals, below))] * 2,
    )


def _outdone(depth, bounds):
    rising, falling = (_one_way(*ahead, depth, bounds) for ahead in (("F", "U"), ("G", "R")))
    both = st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(rising, falling))
    within = st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(st.one_of(rising, falling)), bounds)
    roots = ("G", st.one_of(rising, rising, both, within)), ("F", st.one_of(falling, falling, both, within))
    return st.one_of(
        *[st.builds(Temporal, st.just(root), st.tuples(body)) for root, body in roots],
        *[
            st.builds(
                Temporal,
                st.just(root),
                st.tuples(st.builds(Boolean, st.just(by), st.tuples(_literals, body))),
            )
            for (root, body), by in zip(roots, ("or", "and"), strict=True)
        ],
    )


outdone, outdone_widely = _outdone(3, _brief), _outdone(2, _far)
"""Roots that what they join may be outdone by, long before its windows close."""

# ------------------------------------------------------------------------------------------------- runs

_STEPS = (
    (100,),
    (50, 100, 100, 150, 400),
    (1, 1, 2, 50, 100, 3000, 20000),  # gaps longer than windows
    (1, 10, 50, 1, 10, 50, 1, 10, 50, 9000),  # many samples within a window
)


def _values(source, size, kind):
    """What a leaf is at so many samples."""
    return {
        "ties": lambda: source.integers(-2, 3, size).astype(float),
        "random walk": lambda: np.cumsum(source.integers(-2, 3, size)).astype(float),
        "rising": lambda: np.cumsum(source.integers(0, 3, size)).astype(float),
        "falling": lambda: -np.cumsum(source.integers(0, 3, size)).astype(float),
        "infinite": lambda: source.choice([np.inf, -np.inf, 0.0, -0.0, 1.0], size),
        "rarely": lambda: np.where(source.random(size) < 0.05, source.normal(size=size), -0.0),
        "any": lambda: source.normal(size=size),
        "steps": lambda: np.repeat(source.normal(size=size // 9 + 1), 9)[:size],
    }[kind]()


_KINDS = ("ties", "random walk", "rising", "falling", "infinite", "rarely", "any", "steps")


@st.composite
def long_runs(draw, min_size=100, max_size=400):
    """Long runs, of which what is unknown or uncertain begins somewhere, and ends again."""
    size, channels = draw(st.integers(min_size, max_size)), draw(st.sampled_from([1, 2, 4]))
    source = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = source.choice(draw(st.sampled_from(_STEPS)), size)
    times = draw(st.sampled_from([0, 1_790_000_000 * 10**9])) + np.cumsum(steps)
    begin = draw(st.sampled_from([0, size // 3, size // 2]))
    end = begin + draw(st.sampled_from([5, 40, size]))
    inside = (np.arange(size) >= begin) & (np.arange(size) < end)
    rate = draw(st.sampled_from([0.02, 0.2, 0.6]))
    nominal, wide = {}, {}
    for leaf in LEAVES:
        values = _values(source, size, draw(st.sampled_from(_KINDS))).tolist()
        is_lost = (inside & (source.random(size) < rate) & (channels > 1)).tolist()
        spreads = np.where(inside & (source.random(size) < rate) & (channels > 2), 1.5, 0.0).tolist()
        cells = list(zip(values, is_lost, spreads, strict=True))
        nominal[leaf.text] = tuple(ANYTHING if lost else Interval(value, value) for value, lost, _ in cells)
        wide[leaf.text] = tuple(
            ANYTHING if lost else Interval(value - spread, value + spread) for value, lost, spread in cells
        )
    return LeafRun(tuple(times.tolist()), nominal, wide, channels)


@st.composite
def stretches(draw, size):
    """Ends of stretches: few long ones, or many short ones."""
    if draw(st.booleans()):
        inside = draw(st.sets(st.integers(1, size - 1), max_size=4))
    else:
        lengths = draw(st.lists(st.sampled_from([1, 7, 8, 9, 23, 31, 32, 33, 40, 65]), max_size=12))
        inside = set(np.cumsum(lengths, dtype=int).tolist())
    return sorted({0, size, *(cut for cut in inside if cut < size)})


# ------------------------------------------------------------------------------------------------- laws


def program_of(formula):
    """The formula's tables, if it has windows to run."""
    try:
        program = compile_formula(formula)
    except UsageError:  # too many operators without end
        assume(False)
    assume(has_windows(program))
    return program


def has_windows(program):
    return (program.parts[:, codes.PART_KIND] == codes.WINDOWED).any()


def leaving_out_nothing(program):
    """The same program, of which positions count until their windows close."""
    part_rows = tuple(rows.copy() for rows in program.part_rows)
    for rows in part_rows:
        rows[-1, codes.PART_IS_MONOTONE] = 0
    parts = np.array([rows[-1] for rows in part_rows]).reshape(program.parts.shape)
    return replace(program, parts=parts, part_rows=part_rows)


def both_ways(program, run, ends, **options):
    """What a run says in stretches, and sample by sample: (N, 4, T), and (N, 2) after each stretch."""
    leaves, times = run.values(program.leaves), np.array(run.times_ns)
    together, single = OnlineRun(program, **options), OnlineRun(program, tile=1)
    said, expected = ([], []), ([], [])
    for begin, end in pairwise(ends):
        # as few channels as each stretch needs: the others come up while windows are open
        part = fewest(leaves[:, :, begin:end])
        said[0].append(together.extend(part, times[begin:end]))
        said[1].append(together.final)
        for k in range(end - begin):
            expected[0].append(single.extend(part[:, :, k : k + 1], times[begin + k : begin + k + 1]))
        expected[1].append(single.final)
    return tuple((np.concatenate(series, axis=2), np.array(finals)) for series, finals in (said, expected))


def assert_same_bits(first, second):
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.tobytes() == other.tobytes()


rooms = st.sampled_from([2, 3, 16, 64, 256, 512])
tiles = st.sampled_from([33, 40, 256, 256])
widths = st.sampled_from([100, 256, 1024])


@examples(1000)
@given(data=st.data(), formula=formulas, run=long_runs(), room=rooms, tile=tiles)
def test_samples_together_say_what_they_say_one_by_one(data, formula, run, room, tile):
    ends = data.draw(stretches(len(run)))
    assert_same_bits(*both_ways(program_of(formula), run, ends, room=room, tile=tile))


@examples(200)
@given(data=st.data(), formula=wide_windows, run=long_runs(min_size=500, max_size=900), tile=widths)
def test_wide_windows_say_the_same_of_samples_together_and_one_by_one(data, formula, run, tile):
    ends = data.draw(stretches(len(run)))
    assert_same_bits(*both_ways(program_of(formula), run, ends, room=2048, tile=tile))


@examples(60)
@given(data=st.data(), formula=formulas, run=long_runs(min_size=36, max_size=60), room=rooms)
def test_long_windows_equal_the_definitions(data, formula, run, room):
    ends = data.draw(stretches(len(run)))
    assert_as_defined(formula, program_of(formula), run, ends, room=room)


def assert_as_defined(formula, program, run, ends, **options):
    """Samples together, and one by one, say what the definitions do."""
    ways = both_ways(program, run, ends, **options)
    wide_leaf = run.wide_leaf if run.channels == 4 else run.nominal_leaf
    expected = numbers_of(formula, run.times_ns, run.nominal_leaf, wide_leaf)
    for series, finals in ways:
        np.testing.assert_array_equal(series, expected.series)
        np.testing.assert_array_equal(finals[-1], expected.final)


@examples(600)
@given(
    data=st.data(),
    case=st.one_of(*[st.tuples(outdone, long_runs())] * 2, st.tuples(outdone_widely, long_runs(700, 1000))),
    tile=st.sampled_from([1, 33, 256]),
)
def test_leaving_out_what_matters_no_more_changes_nothing(data, case, tile):
    formula, run = case
    program = compile_formula(formula)
    whole = leaving_out_nothing(program)
    if not has_windows(program) or (whole.parts == program.parts).all():
        return
    ends, leaves, times = data.draw(stretches(len(run))), run.values(program.leaves), np.array(run.times_ns)
    runs = [OnlineRun(each, tile=tile) for each in (program, whole)]
    for begin, end in pairwise(ends):
        part = fewest(leaves[:, :, begin:end])
        one, other = (each.extend(part, times[begin:end]) for each in runs)
        assert_same_bits([one], [other])


@examples(300)
@given(data=st.data(), formula=ending, run=long_runs(), room=rooms, tile=tiles)
def test_windows_from_the_first_sample_say_the_same_together_and_one_by_one(data, formula, run, room, tile):
    ends = data.draw(stretches(len(run)))
    assert_same_bits(*both_ways(program_of(formula), run, ends, room=room, tile=tile))


@examples(100)
@given(data=st.data(), formula=ending, run=long_runs(min_size=36, max_size=60), room=rooms)
def test_windows_from_the_first_sample_equal_the_definitions(data, formula, run, room):
    ends = data.draw(stretches(len(run)))
    assert_as_defined(formula, compile_formula(formula), run, ends, room=room)


def test_memory_does_not_grow_with_a_window_from_the_first_sample():
    size, rng = 6000, np.random.default_rng(3)
    times = np.arange(size) * 100
    for body in (
        ahead("F", 0, 20, Boolean("and", (P, ahead("F", 0, 20, Q)))),
        Boolean("->", (P, ahead("F", 0, 20, Q))),
        Temporal("F", (Boolean("and", (P, ahead("F", 0, 20, Q))),)),  # a table
    ):
        program = compile_formula(ahead("G", 0, 10**6, body))
        run = OnlineRun(program, room=64, tile=32)
        run.extend(rng.normal(size=(1, len(program.leaves), size)), times)
        # room for more is less than all there is
        assert run.room <= 512


@examples(40)
@given(data=st.data(), formula=formulas, run=long_runs(min_size=20, max_size=50))
def test_interpreted_windows_have_the_same_bits(data, formula, run):
    ends, program = data.draw(stretches(len(run))), program_of(formula)
    with only("interpreted"):
        interpreted, _ = both_ways(program, run, ends)
    with only("compiled"):
        compiled, _ = both_ways(program, run, ends)
    assert_same_bits(interpreted, compiled)


# ------------------------------------------------------------------------------- where some went wrong


def ahead(operator, low, high, *operands, unit="samples"):
    return Temporal(operator, operands, Bound(low, high, unit))


def run_of_numbers(numbers, size, spread):
    """A run in which each leaf is 0 but where its numbers say."""
    nominal, wide = {}, {}
    for leaf in LEAVES:
        values = [numbers.get(leaf.text, {}).get(t, 0.0) for t in range(size)]
        nominal[leaf.text] = tuple(Interval(value, value) for value in values)
        wide[leaf.text] = tuple(Interval(value - spread, value + spread) for value in values)
    return LeafRun(tuple(range(0, size * 100, 100)), nominal, wide, 4 if spread else 1)


NEVER = -np.inf
_both_open = Boolean("or", (ahead("G", 0, 0, Q), ahead("G", 0, 1, ahead("G", 0, 0, P), unit="ns")))


@pytest.mark.parametrize("tile", [1, 33, 256])
@pytest.mark.parametrize(
    ("formula", "numbers", "ends", "spread"),
    [
        pytest.param(
            ahead("F", 34, 67, ahead("G", 0, 800, P, unit="ns")),
            {"p": {30: NEVER, 39: NEVER}},
            (0, 40),
            0.0,
            id="most windows begin after the last sample",
        ),
        pytest.param(
            Temporal("F", (ahead("O", 1, 1, ahead("U", 1, None, P, R), unit="ns"),)),
            {},
            (0, 40),
            0.0,
            id="fewer positions matter after a block",
        ),
        pytest.param(
            Temporal("G", (_both_open,)),
            {"p": {35: -0.5}, "q": {35: NEVER}},
            (0, 41),
            0.0,
            id="no window cuts a bound short",
        ),
        pytest.param(
            Temporal("F", (ahead("W", 0, 7, Boolean("or", (P, R)), ahead("F", 10, 30, P)),)),
            {"p": {10: 1.0}},
            (0, 6, 14),
            0.5,
            id="samples come together into windows that none of them is in",
        ),
        pytest.param(
            ahead("H", 0, 5, Temporal("G", (Temporal("G", (P,)),))),
            {"p": {0: 3.0, 1: 2.0, 20: -1.0}},
            (0, 10, 41),
            0.5,
            id="nothing past is left of a past operator",
        ),
    ],
)
def test_windows_equal_the_definitions_where(formula, numbers, ends, spread, tile):
    run, program = run_of_numbers(numbers, ends[-1], spread), compile_formula(formula)
    assert has_windows(program)
    assert_as_defined(formula, program, run, ends, tile=tile)


@pytest.mark.parametrize("shape", [(1, 1, 5), (1, 2, 4), (3, 2, 5), (2, 5)])
def test_leaves_that_do_not_fit_are_refused(shape):
    run = OnlineRun(compile_formula(ahead("G", 0, 5, Boolean("->", (P, ahead("F", 0, 2, Q))))))
    with pytest.raises(ValueError, match="leaves have the shape"):
        run.extend(np.zeros(shape), np.arange(5))
    assert len(run) == 0
