"""Runs to try laws of meaning on: formulas with any values of their leaves, and recordings of objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from laws.reference import ANYTHING, Interval
from laws.strategies_geometry import convex_parts
from laws.strategies_spec import Vocabulary, formula_texts
from spatial_replay import Footprint, Sample, Trace, TrackedObject, parse_specification
from spatial_replay.spec.formula import Atom, Boolean, Bound, Signal, Temporal, Truth

# ------------------------------------------------------------------- formulas over leaves of any value

LEAVES = tuple(Atom(name, "signal", Signal(name)) for name in ("p", "q", "r"))
_leaves = st.sampled_from(LEAVES)


@st.composite
def sample_bounds(draw):
    lower = draw(st.integers(0, 3))
    return Bound(lower, draw(st.one_of(st.none(), st.integers(lower, lower + 4))), "samples")


@st.composite
def time_bounds(draw):
    """Ends that often coincide with the time between two samples of `leaf_runs`, and often do not."""
    lower = draw(st.sampled_from([0, 100, 200, 250, 500]))
    upper = draw(st.sampled_from([None, 0, 100, 250, 400, 8 * 10**18]))
    return Bound(lower, None if upper is None else lower + upper, "ns")


bounds = st.one_of(st.none(), st.none(), sample_bounds(), time_bounds())


def combinations_of(operands, bounds=bounds):
    """One operator over the given formulas."""
    single = operands.map(lambda operand: (operand,))
    pairs = st.tuples(operands, operands)
    several = st.lists(operands, min_size=2, max_size=3).map(tuple)
    return st.one_of(
        st.builds(Boolean, st.just("not"), single),
        st.builds(Boolean, st.sampled_from(["and", "or"]), several),
        st.builds(Boolean, st.sampled_from(["xor", "->", "<->"]), pairs),
        st.builds(Temporal, st.sampled_from(["X", "WX", "Y"]), single),
        st.builds(Temporal, st.sampled_from(["F", "G", "F", "G", "O", "H"]), single, bounds),
        st.builds(Temporal, st.sampled_from(["U", "R", "W", "S"]), pairs, bounds),
    )


def _nested(depth):
    """Formulas up to so many operators deep, mostly just as deep."""
    leaves = st.one_of(_leaves, _leaves, _leaves, st.builds(Truth, st.booleans()))
    if depth == 0:
        return leaves
    deeper = combinations_of(_nested(depth - 1))
    return st.one_of(leaves, deeper, deeper, deeper)


_windows_within = st.builds(
    Temporal,
    st.sampled_from(["F", "G", "O", "H"]),
    st.tuples(
        st.builds(
            Temporal,
            st.sampled_from(["U", "R", "W", "S"]),
            st.tuples(_leaves, _leaves),
            st.one_of(sample_bounds(), time_bounds()),
        )
    ),
    bounds,
)
"""A bounded operator below another: what looks through windows has rules of its own."""

_literals = st.one_of(_leaves, _leaves.map(lambda leaf: Boolean("not", (leaf,))))


def responses(windows):
    """An unbounded operator over conditions and windows, as requirements are usually written."""
    conditioned = st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(_literals, windows))
    bodies = st.one_of(
        windows,
        conditioned,
        st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(conditioned, windows)),
        st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(conditioned, _literals)),
    )
    return st.one_of(
        st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(bodies)),
        st.builds(Temporal, st.sampled_from(["U", "R", "W"]), st.tuples(_literals, bodies)),
    )


def windows_of(operands, bounds):
    """One operator that looks ahead over the given formulas."""
    single, pairs = st.tuples(operands), st.tuples(operands, operands)
    return st.one_of(
        st.builds(Temporal, st.sampled_from(["F", "G"]), single, bounds),
        st.builds(Temporal, st.sampled_from(["U", "R"]), pairs, bounds),
        st.builds(Temporal, st.sampled_from(["X", "WX"]), single),
    )


_responses = responses(windows_of(_literals, st.one_of(sample_bounds(), time_bounds())))
nested_windows = responses(
    windows_of(
        windows_of(_literals, st.one_of(sample_bounds(), time_bounds())),
        st.one_of(sample_bounds(), time_bounds()),
    )
)
"""Windows below windows, which are kept at each position that is open."""
_short = st.one_of(sample_bounds(), time_bounds())
_ahead = windows_of(_literals, _short)
alternative_windows = responses(
    st.one_of(
        st.builds(Boolean, st.sampled_from(["and", "or", "xor", "<->"]), st.tuples(_ahead, _ahead)),
        st.builds(Boolean, st.just("or"), st.tuples(_ahead, _ahead, _ahead)),
        windows_of(st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(_literals, _ahead)), _short),
        st.builds(Temporal, st.sampled_from(["O", "H"]), st.tuples(_ahead), bounds),
        st.builds(Temporal, st.just("S"), st.tuples(_literals, _ahead), bounds),
    )
)
"""Windows beside windows, of which some say the same as one, and below past operators."""
_at_once = st.one_of(
    st.builds(Bound, st.just(0), st.one_of(st.integers(0, 6), st.none()), st.just("samples")),
    st.builds(Bound, st.just(0), st.sampled_from([0, 100, 250, 600]), st.just("ns")),
)
_begun = st.one_of(_ahead, st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_literals), _at_once))
_negated = st.one_of(_begun, st.builds(Boolean, st.just("not"), st.tuples(_begun)))
_alternatives = st.one_of(
    _negated,
    st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(_literals, _negated)),
    st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(_negated, _literals, _negated)),
    st.builds(Temporal, st.just("F"), st.tuples(_begun), _at_once),
)
_since = st.one_of(
    st.builds(Temporal, st.sampled_from(["O", "H"]), st.tuples(_alternatives), st.one_of(_at_once, bounds)),
    st.builds(
        Temporal,
        st.just("S"),
        st.tuples(st.one_of(_literals, _literals, _begun), _alternatives),
        st.one_of(_at_once, bounds),
    ),
)
past_over_windows = st.one_of(
    _since,
    responses(_since),
    st.builds(Boolean, st.just("not"), st.tuples(_since)),
    st.builds(Temporal, st.sampled_from(["F", "G", "X", "WX", "Y"]), st.tuples(_since)),
    st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_since), _at_once),
)
"""Past operators over windows ahead, most of which begin at once."""
_alike = st.one_of(
    st.builds(Bound, st.integers(0, 2), st.integers(2, 9), st.just("samples")),
    st.builds(Bound, st.sampled_from([0, 0, 100, 250]), st.sampled_from([250, 600, 1100]), st.just("ns")),
)


def _two_of(bound):
    window = st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_literals), st.just(bound))
    joined = st.builds(Boolean, st.sampled_from(["and", "or", "->", "xor", "<->"]), st.tuples(window, window))
    more = st.builds(Boolean, st.sampled_from(["and", "or"]), st.tuples(joined, st.one_of(window, _literals)))
    return st.one_of(*[joined] * 4, more)


_two = _alike.flatmap(_two_of)
alike_windows = st.one_of(
    *[st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_two))] * 4,
    st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_two), _short),
    responses(_two),
)
"""Windows that begin and end alike, of the same kind or of both."""
_lasting = st.one_of(responses(windows_of(_literals, bounds)), windows_of(_literals, bounds))
_from_later = st.one_of(
    st.builds(Bound, st.integers(1, 3), st.none(), st.just("samples")),
    st.builds(Bound, st.sampled_from([100, 250, 500]), st.none(), st.just("ns")),
)
lasting_windows = st.one_of(
    st.builds(
        lambda outer, inner, body: Temporal(outer, (Temporal(inner, (body,)),)),
        st.sampled_from(["F", "G"]),
        st.sampled_from(["F", "G", "O", "H"]),
        _lasting,
    ),
    st.builds(Temporal, st.sampled_from(["F", "G"]), st.tuples(_lasting), _from_later),
    st.builds(Temporal, st.sampled_from(["U", "R", "W"]), st.tuples(_literals, _lasting), _from_later),
)
"""Windows below what holds from some time on, or again and again."""
_unbounded = st.one_of(st.none(), _from_later)
_never_falling = st.one_of(
    st.builds(Temporal, st.just("G"), st.tuples(_lasting), _unbounded),
    st.builds(
        Boolean, st.just("not"), st.tuples(st.builds(Temporal, st.just("F"), st.tuples(_lasting), _unbounded))
    ),
    st.builds(Temporal, st.just("O"), st.tuples(_ahead), _unbounded),
)
_held = st.one_of(
    _never_falling,
    st.builds(Boolean, st.sampled_from(["and", "or", "->"]), st.tuples(_never_falling, _never_falling)),
    # these may fall
    st.builds(Temporal, st.sampled_from(["G", "F", "O", "H"]), st.tuples(_lasting), bounds),
)
_until_held = st.builds(
    Temporal,
    st.sampled_from(["U", "U", "U", "R", "W"]),
    st.tuples(_held, st.one_of(_literals, _ahead, _lasting)),
    st.one_of(bounds, _from_later),
)
untils_of_lasting = st.one_of(
    _until_held,
    _until_held,
    st.builds(Boolean, st.sampled_from(["not", "spec"]), st.tuples(_until_held)),
    st.builds(Boolean, st.sampled_from(["and", "->"]), st.tuples(_until_held, _literals)),
    st.builds(Temporal, st.sampled_from(["G", "F", "H", "O", "X", "Y"]), st.tuples(_until_held)),
)
"""Untils whose left operands mostly never fall."""
formulas_of_leaves = st.one_of(_responses, _nested(1), _nested(2), _nested(3), _nested(4), _windows_within)


@dataclass(frozen=True)
class LeafRun:
    """Times of samples, and what each leaf is in them.

    Attributes:
        nominal, wide: by leaf, an interval per sample; the second holds the first.
        channels: how many of their ends are given to a run.
    """

    times_ns: tuple[int, ...]
    nominal: dict[str, tuple[Interval, ...]]
    wide: dict[str, tuple[Interval, ...]]
    channels: int

    def __len__(self):
        return len(self.times_ns)

    def values(self, leaves):
        """(C, A, T)."""
        ends = [
            [[getattr(interval, end) for interval in kind[leaf.text]] for leaf in leaves]
            for kind in (self.nominal, self.wide)
            for end in ("low", "high")
        ]
        return np.array(ends).reshape(4, len(leaves), len(self))[: self.channels]

    def nominal_leaf(self, formula, t):
        return self.nominal[formula.text][t]

    def wide_leaf(self, formula, t):
        return self.wide[formula.text][t]


@st.composite
def leaf_runs(draw, max_size=14):
    size = draw(st.integers(1, max_size))
    channels = draw(st.sampled_from([1, 2, 4]))
    times = [draw(st.sampled_from([0, 7, 1_790_000_000 * 10**9]))]
    for _ in range(size - 1):
        times.append(times[-1] + draw(st.sampled_from([50, 100, 100, 130, 400])))
    nominal, wide = {}, {}
    for leaf in LEAVES:
        cells = [draw(_cells(channels)) for _ in times]
        nominal[leaf.text] = tuple(cell[0] for cell in cells)
        wide[leaf.text] = tuple(cell[1] for cell in cells)
    return LeafRun(tuple(times), nominal, wide, channels)


@st.composite
def ramps(draw, max_size=90):
    """Runs whose leaves go one way for long, but for leaps, and whose samples come more often later on."""
    size = draw(st.integers(20, max_size))
    slow, pace = draw(st.integers(1, size)), draw(st.sampled_from([5, 20, 100]))
    times = np.cumsum([0] + [100 if index < slow else pace for index in range(1, size)]).tolist()
    exact = {}
    for leaf in LEAVES:
        level, slope = draw(st.sampled_from([-200.0, 0.0, 200.0])), draw(st.sampled_from([-1.0, 0.0, 1.0]))
        leaps = draw(
            st.dictionaries(st.integers(0, size - 1), st.sampled_from([-500.0, 500.0, -3.0]), max_size=3)
        )
        values = [leaps.get(index, level + slope * index) for index in range(size)]
        exact[leaf.text] = tuple(Interval(value, value) for value in values)
    return LeafRun(tuple(times), exact, exact, 1)


@st.composite
def _cells(draw, channels):
    value = float(draw(st.integers(-9, 9)))
    if channels > 1 and draw(st.integers(0, 6)) == 0:
        return ANYTHING, ANYTHING
    spread = draw(st.sampled_from([0.0, 0.0, 1.0, 2.5])) if channels > 2 else 0.0
    return Interval(value, value), Interval(value - spread, value + spread)


@st.composite
def widened(draw, run):
    """The same run, with all four channels, and some of its cells known less well."""
    nominal, wide = {}, {}
    for leaf in LEAVES:
        lost = [draw(st.integers(0, 4)) == 0 for _ in run.times_ns]
        more = [draw(st.sampled_from([0.0, 0.0, 1.0])) for _ in run.times_ns]
        nominal[leaf.text] = tuple(
            ANYTHING if gone else cell for gone, cell in zip(lost, run.nominal[leaf.text], strict=True)
        )
        wide[leaf.text] = tuple(
            ANYTHING if gone else Interval(cell.low - e, cell.high + e)
            for gone, e, cell in zip(lost, more, run.wide[leaf.text], strict=True)
        )
    return LeafRun(run.times_ns, nominal, wide, 4)


def cuts(size):
    """Where to cut so many samples into stretches."""
    return st.sets(st.integers(1, max(1, size - 1)), max_size=4).map(
        lambda inside: sorted({0, size, *(cut for cut in inside if cut < size)})
    )


# -------------------------------------------------------------------------- recordings and specifications

NAMES = ("a", "b", "c")
CLASSES = ("person", "cart")
HEADER = """\
region goal = box(-2, -2, 3, 2)
region table = circle((1, 0.5), 1.5) height (0, 1)
region corner = polygon((0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (0, 3))
group pair = a, b
group people = class "person"
group everyone = all
"""
WORDS = Vocabulary(
    objects=NAMES,
    classes=CLASSES,
    signals=("battery",),
    rates=True,
    regions=("goal", "table", "corner"),
    groups=("pair", "people", "everyone"),
    axes=("x", "y", "z"),
    oriented=True,
    quantifiers=True,
    max_depth=3,
)


@dataclass(frozen=True)
class Recording:
    """Samples, and which observations in them hold numbers that are not finite."""

    samples: tuple[Sample, ...]
    unreadable: frozenset[tuple[int, str]] = frozenset()

    def trace(self):
        trace = Trace.from_samples(self.samples)
        rows = trace.rows.copy()
        for t, name in self.unreadable:
            at = (t, trace.names.index(name))
            rows[at] = -2 - rows[at]
        return replace(trace, rows=rows)


_heights = st.tuples(st.integers(-2, 2), st.integers(0, 3)).map(lambda pair: (pair[0], pair[0] + pair[1]))


@st.composite
def tracked_objects(draw, *, certain=False):
    parts = draw(st.lists(convex_parts(), min_size=1, max_size=2))
    return TrackedObject(
        Footprint(tuple(parts)),
        class_name=draw(st.sampled_from([None, "person", "Person", "cart"])),
        yaw=draw(st.one_of(st.none(), st.floats(-3, 3))),
        height=draw(st.one_of(st.none(), _heights)),
        uncertainty=0.0 if certain else draw(st.sampled_from([0.0, 0.0, 0.25, 1.0])),
    )


@st.composite
def recordings(draw, max_size=5):
    size = draw(st.integers(1, max_size))
    certain = draw(st.booleans())
    shapes = draw(st.lists(tracked_objects(certain=certain), min_size=2, max_size=4))
    complete, slow = draw(st.booleans()), draw(st.booleans())
    lasting, reported = draw(st.sets(st.sampled_from(NAMES), max_size=1)), {}
    time, samples, unreadable = draw(st.integers(0, 10**9)), [], set()
    for t in range(size):
        objects = {
            name: draw(st.sampled_from(shapes))
            for name in NAMES
            if complete or draw(st.integers(0, 3)) > 0
        }  # fmt: skip
        battery = draw(st.sampled_from([0.5, 1.0, 3.25, float("nan")]))
        signals = {"battery": battery} if draw(st.booleans()) else {}
        if slow:
            # some reports are held, some go back
            shown = {
                name: draw(st.sampled_from([reported.get(name, time), time, time, 0]))
                for name in (*NAMES, "battery")
            }
            reported = {name: shown[name] for name in (*objects, *signals)}
        samples.append(Sample(time, objects, signals, reported_ns=reported, lasting=lasting))
        if not complete:
            unreadable |= {(t, name) for name in objects if draw(st.integers(0, 6)) == 0}
        time += draw(st.sampled_from([50, 100, 250, 400, 500])) * 10**6
    return Recording(tuple(samples), frozenset(unreadable))


@st.composite
def specifications(draw, words=WORDS, templates=True):
    """One spec, or a template over `ego`, in either profile."""
    profile = draw(st.sampled_from(["paper", "spatial_spec"]))
    is_template = templates and draw(st.booleans())
    if is_template:
        words = replace(words, objects=(*words.objects, "ego"))
    head = "spec s(ego)" if is_template else "spec s"
    return parse_specification(f"{HEADER}{head} = {draw(formula_texts(words))}\n", profile=profile)
