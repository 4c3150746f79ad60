"""Laws of the doctor: what it excludes happens in no run, and its shortest runs are runs, and shortest."""

from __future__ import annotations

from itertools import product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from laws.reference import Interval, Prefix
from spatial_replay.sanity.linear import Inequality, solve
from spatial_replay.spec.formula import NamedSpec

NAMES = "abc"


@st.composite
def relations(draw: st.DrawFn) -> str:
    """A relation between a few objects and regions, with few thresholds, so that some exclude others."""
    first, second, third = draw(st.permutations(NAMES))
    term = draw(st.sampled_from([second, second, "left_bin", "right_bin", f"enlarge({second}, 0.5)"]))
    limit = draw(st.sampled_from(["-0.5", "0", "0.5", "1"]))
    return draw(
        st.sampled_from(
            [
                f"{first} leftof {term}",
                f"{first} rightof {term}",
                f"{first} below {second}",
                f"{first} partleftof {second}",
                f"{first} prec[z] {second}",
                f"{first} dist {term} <= {limit}",
                f"{first} dist {term} >= {limit}",
                f"{first} ovlp {term}",
                f"{first} partovlp {second}",
                f"{first} enclosedin {term}",
                f"{first} moved[{limit.removeprefix('-')}] {second}",
                f"{first} closer {second} than {third}",
                f"{first} between[x] ({second}, {third})",
                f"{first} oriented[{limit}] {second}",
                f"both leftof {first}",
                f"{first} enclosedin tall",
            ]
        )
    )


@st.composite
def spatial_formulas(draw: st.DrawFn) -> str:
    """Some relations that have to hold, or not, in one sample or all, now or later."""
    literals = [
        draw(st.sampled_from(["{}", "{}", "(not {})"])).format(f"({each})")
        for each in draw(st.lists(relations(), min_size=2, max_size=4))
    ]
    body = draw(st.sampled_from([" and ", " and ", " or "])).join(literals)
    return draw(st.sampled_from(["F ({})", "G ({})", "F[0s, 2s] ({})", "G (O ({}))"])).format(body)


REGIONS = """
region left_bin = box(0, 0, 1, 1)
region right_bin = circle((3, 0.5), 0.5)
region tall = box(0, 0, 2, 2) height (0, 1)
group both = b, c
"""


def crowded_trace(seed: int, samples: int = 60) -> sr.Trace:
    """Boxes, discs and unions on a coarse grid, so that many touch, overlap and lie in one another."""
    random = np.random.default_rng(seed)

    def footprint() -> sr.Footprint:
        x, y = random.integers(-1, 7, 2) / 2.0
        width, height = random.choice([0.0, 0.25, 0.5, 1.0, 3.0], 2)
        kind = random.integers(4)
        if kind == 0:
            return sr.Footprint.disc(x, y, width / 2.0)
        box = sr.Footprint.box(x, y, x + width, y + height)
        if kind == 1:
            return sr.Footprint.union([box, sr.Footprint.disc(x, y, 0.25)])
        if kind == 2:
            return sr.Footprint.polygon([(x, y), (x + 1, y), (x, y + 1)])
        return box

    def tracked() -> sr.TrackedObject:
        bottom = float(random.choice([-0.5, 0.0, 0.5]))
        turn = float(random.choice([0.0, 1.0, np.pi]))
        return sr.TrackedObject(
            footprint(), yaw=turn, height=(bottom, bottom + float(random.choice([0.25, 1.0])))
        )

    return sr.Trace.from_samples(
        [sr.Sample(time_ns * 10**9, {name: tracked() for name in NAMES}) for time_ns in range(samples)]
    )


ROUNDING = 1e-9


@examples(60)
@given(spatial_formulas(), spatial_formulas(), st.integers(0, 2**32))
def test_what_the_doctor_excludes_happens_in_no_run(one: str, other: str, seed: int) -> None:
    specification = sr.parse_specification(f"{REGIONS}spec one = {one}\nspec other = {other}\n")
    examined = sr.doctor(specification, examples=False)
    if not examined.findings:
        return
    # single samples in turn, so that each of them has to be excluded, and all of them together
    trace = crowded_trace(seed)
    windows = [trace, *(crowded_trace(seed + number, 1) for number in range(8))]
    for window in windows:
        rho = {result.name: result.robustness for result in sr.evaluate(specification, window).results}
        for finding in examined.findings:
            values = [rho[name] for name in finding.specs]
            if finding.kind == "unsatisfiable":
                assert values[0] <= ROUNDING
            elif finding.kind == "always true":
                assert values[0] >= -ROUNDING
            elif finding.kind == "contradiction":
                assert min(values) <= ROUNDING
            elif finding.kind == "implied":
                assert max(values[0], -values[1]) >= -ROUNDING


SLACK = 0.001
PLACES = (*NAMES, "left_bin", "right_bin", "tall")
PAIRS = [(a, b) for a, b in product(PLACES, repeat=2) if a != b and a in NAMES]


def measured(relations: list[str], trace: sr.Trace) -> list[float]:
    """The robustness of relations in the first sample."""
    specs = "".join(f"spec r{number} = {each}\n" for number, each in enumerate(relations))
    results = sr.evaluate(sr.parse_specification(REGIONS + specs), trace).results
    return [0.0 if each.robustness is None else each.robustness for each in results]


def true_literals(trace: sr.Trace) -> list[str]:
    """Relations that hold in the first sample, with thresholds that are as tight as can be."""
    literals = []
    for (a, b), number in zip(PAIRS, measured([f"{a} dist {b} >= 0" for a, b in PAIRS], trace), strict=True):
        literals += [f"{a} dist {b} >= {number - SLACK:.6f}", f"{a} dist {b} <= {number + SLACK:.6f}"]
    for (a, b), number in zip(PAIRS, measured([f"{a} enclosedin {b}" for a, b in PAIRS], trace), strict=True):
        if number > SLACK:
            literals.append(f"enlarge({a}, {number - SLACK:.6f}) enclosedin {b}")
            if b in ("left_bin", "right_bin"):
                literals.append(f"not (enlarge({a}, {number + SLACK:.6f}) enclosedin {b})")
        elif number < -SLACK:
            literals += [
                f"{a} moved[{-number - SLACK:.6f}] {b}",
                f"not ({a} moved[{SLACK - number:.6f}] {b})",
            ]
    for axis in "xyz":
        pairs = [pair for pair in PAIRS if axis != "z" or pair[1] in (*NAMES, "tall")]
        gaps = measured([f"{a} prec[{axis}] {b}" for a, b in pairs], trace)
        for (a, b), number in zip(pairs, gaps, strict=True):
            if number > SLACK and axis != "z":
                literals.append(f"enlarge({a}, {number - SLACK:.6f}) prec[{axis}] {b}")
                literals.append(f"not (enlarge({a}, {number + SLACK:.6f}) prec[{axis}] {b})")
            elif abs(number) > SLACK:
                literals.append(f"{a} prec[{axis}] {b}" if number > 0 else f"not ({a} prec[{axis}] {b})")
    return literals


@examples(25)
@given(st.integers(0, 2**32))
def test_the_doctor_excludes_nothing_that_is_measured(seed: int) -> None:
    literals = true_literals(crowded_trace(seed, 1))
    assert len(literals) > 30
    specification = sr.parse_specification(f"{REGIONS}spec all_of_it = F ({' and '.join(literals)})\n")
    examined = sr.doctor(specification, examples=False)
    assert examined.findings == ()
    assert examined.specs[0].undecided == ()


@examples(25)
@given(st.integers(0, 2**32))
def test_without_heights_nothing_that_is_measured_in_the_plane_is_excluded(seed: int) -> None:
    """In the plane two objects in a region are no further apart than it is wide."""
    (sample,) = crowded_trace(seed, 1).samples()
    flat = {name: sr.TrackedObject(each.footprint) for name, each in sample.objects.items()}
    trace = sr.Trace.from_samples([sr.Sample(0, flat)])
    pairs = [(a, b) for a, b in PAIRS if b != "tall"]
    apart = measured([f"{a} dist {b} >= 0" for a, b in pairs], trace)
    inside = measured([f"{a} enclosedin {b}" for a, b in pairs], trace)
    literals = []
    for (a, b), distance, room in zip(pairs, apart, inside, strict=True):
        literals += [f"{a} dist {b} >= {distance - SLACK:.6f}", f"{a} dist {b} <= {distance + SLACK:.6f}"]
        enclosed = f"{a} enclosedin {b}" if room > SLACK else f"{a} moved[{-room - SLACK:.6f}] {b}"
        literals += [enclosed] if abs(room) > SLACK else []
    planar = "\n".join(line for line in REGIONS.splitlines() if "height" not in line)
    specification = sr.parse_specification(f"{planar}\nspec all_of_it = F ({' and '.join(literals)})\n")
    assert sr.doctor(specification, examples=False).findings == ()


@examples(60)
@given(spatial_formulas())
def test_a_placed_run_is_evaluated_to_the_verdict_that_it_shows(text: str) -> None:
    specification = sr.parse_specification(f"{REGIONS}spec one = {text}\n")
    (spec,) = sr.doctor(specification).specs
    for example in (spec.satisfied, spec.violated):
        if example is not None and example.samples is not None:
            result = sr.evaluate(specification, sr.Trace.from_samples(example.samples))
            assert result.verdict == example.verdict
            assert result.results[0].robustness == example.robustness
            assert len(example.samples) == len(example.sentences)
        elif example is not None:
            assert example.note


def _formulas(depth: int) -> st.SearchStrategy[str]:
    leaves = st.sampled_from(["(p >= 1)", "(q >= 1)", "(q < 1)", "true"])
    if depth == 0:
        return leaves
    inner = _formulas(depth - 1)
    unary = st.sampled_from(
        ["not {}", "(F {})", "(G {})", "(X {})", "(WX {})", "(F[1, 2] {})", "(G[0, 1] {})"]
    )
    binary = st.sampled_from(
        ["({} and {})", "({} or {})", "({} -> {})", "({} U {})", "({} R {})", "({} W {})"]
    )
    return st.one_of(
        leaves,
        st.builds(lambda shape, one: shape.format(one), unary, inner),
        st.builds(lambda shape, one, other: shape.format(one, other), binary, inner, inner),
        st.builds(lambda shape, one, other: shape.format(one, other), binary, inner, inner),
    )


LONGEST = 3
SYMBOLS = list(product([False, True], repeat=2))


Word = tuple[tuple[bool, bool], ...]
WORDS: list[Word] = [word for length in range(1, LONGEST + 1) for word in product(SYMBOLS, repeat=length)]


def accepts(formula: object, word: Word) -> bool:
    """Whether a run in which p and q are so satisfies a formula."""

    def leaf(atom: NamedSpec, t: int) -> Interval:
        name, operator, _ = atom.parameters
        holds = word[t]["pq".index(name)] == (operator == ">=")
        return Interval(1.0, 1.0) if holds else Interval(-1.0, -1.0)

    times_ns = [10**9 * t for t in range(len(word))]
    return Prefix(times_ns, leaf, goes_on=False).rho(formula, 0).low > 0


def satisfying_lengths(formula: object) -> dict[bool, set[int]]:
    """The lengths of short runs that satisfy a formula about p and q, and violate it, by trying all."""
    lengths: dict[bool, set[int]] = {True: set(), False: set()}
    for word in WORDS:
        lengths[accepts(formula, word)].add(len(word))
    return lengths


@examples(80)
@given(_formulas(3))
def test_shortest_runs_are_found_exactly_where_there_are_runs(text: str) -> None:
    specification = sr.parse_specification(f"spec one = {text}\n")
    examined = sr.doctor(specification)
    (spec,) = examined.specs
    assert not spec.reason
    assert not spec.undecided
    lengths = satisfying_lengths(specification.specs[0].formula)
    kinds = {finding.kind for finding in examined.findings}
    for example, satisfied, empty in (
        (spec.satisfied, True, "unsatisfiable"),
        (spec.violated, False, "always true"),
    ):
        assert (example is None) == (empty in kinds)
        if example is None:
            assert not lengths[satisfied]
            continue
        assert example.samples is not None
        if len(example.samples) <= LONGEST:
            assert len(example.samples) == min(lengths[satisfied])
        else:
            assert not lengths[satisfied]
        verdict = sr.evaluate(specification, sr.Trace.from_samples(example.samples)).verdict
        assert verdict == ("satisfied" if satisfied else "violated")


@examples(60)
@given(_formulas(2), _formulas(2))
def test_the_shortest_runs_distinguish_two_specifications(first: str, second: str) -> None:
    pair = [sr.parse_specification(f"spec one = {text}\n") for text in (first, second)]
    distinction = sr.distinguish(*pair)
    runs = distinction.only_first, distinction.only_second
    relations = {(False, False): "same", (True, False): "weaker", (False, True): "stricter"}
    assert distinction.relation == relations.get(tuple(run is not None for run in runs), "different")
    for run, (accepting, rejecting) in zip(runs, (pair, pair[::-1]), strict=True):
        lengths = {
            len(word)
            for word in WORDS
            if accepts(accepting.specs[0].formula, word) and not accepts(rejecting.specs[0].formula, word)
        }
        if run is None:
            assert not lengths
            continue
        assert min(lengths, default=LONGEST + 1) in (len(run.sentences), LONGEST + 1)
        assert run.samples is not None
        trace = sr.Trace.from_samples(run.samples)
        verdicts = [sr.evaluate(specification, trace).verdict for specification in (accepting, rejecting)]
        assert verdicts == ["satisfied", "violated"]


sums = st.dictionaries(st.sampled_from("xyzw"), st.sampled_from([-2, -1, 1, 2]), min_size=1, max_size=3)


@given(
    st.lists(st.tuples(sums, st.integers(-3, 3), st.booleans()), min_size=1, max_size=6),
    st.lists(st.tuples(sums, st.integers(-2, 2)), max_size=8),
)
@examples(150)
def test_laws_that_are_added_only_when_they_are_broken_decide_as_all_of_them_do(
    asked: list[tuple[dict[str, int], int, bool]], known: list[tuple[dict[str, int], int]]
) -> None:
    own = [
        Inequality(tuple(weights.items()), bound, strict, n)
        for n, (weights, bound, strict) in enumerate(asked)
    ]
    laws = [Inequality(tuple(weights.items()), bound) for weights, bound in known]
    found = solve(own, laws)
    assert (found.conflict is None) == (solve([*own, *laws]).conflict is None)
    if found.values is not None:
        reached = [
            sum(weight * found.values[key] for key, weight in each.coefficients) for each in (*own, *laws)
        ]
        assert all(value <= each.bound for value, each in zip(reached, (*own, *laws), strict=True))
    else:
        # what conflicts does so by itself, together with the laws
        assert solve([each for each in own if each.label in found.conflict], laws).conflict is not None
