"""A witness is true: its atom has the reported value, and the reported change flips the verdict."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import formulas_of_leaves, leaf_runs, recordings, specifications
from laws.strategies_spec import Vocabulary
from laws.test_monitor_laws import observed_in
from spatial_replay import Sample, Specification, Trace, Verdict, evaluate, parse_specification
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.sentences import sentences_of
from spatial_replay.monitor.witness.path import End, deciding_path
from spatial_replay.spec.formula import Number, Sum, iter_nodes
from spatial_replay.spec.walks import rewritten

SIGNALS = Vocabulary(objects=(), signals=("p", "q"), max_depth=4, delays=False)
NUMBER = re.compile(r"(?<![\w.])-?\d+(\.\d+)?(?![\w.])")


@st.composite
def signal_runs(draw) -> Trace:
    size = draw(st.integers(1, 8))
    values = st.sampled_from([-3.0, -1.5, 0.0, 0.25, 1.0, 2.5, 4.75, 9.0])
    known = draw(st.booleans())
    samples = []
    for t in range(size):
        signals = {name: draw(values) for name in ("p", "q") if known or draw(st.integers(0, 5)) > 0}
        samples.append(Sample(t * 10**8, {}, signals))
    return Trace.from_samples(samples)


@st.composite
def comparison_texts(draw) -> str:
    """Formulas over comparisons of signals with numbers."""
    count = draw(st.integers(1, 5))
    signal, comparison = st.sampled_from("pq"), st.sampled_from(["<=", ">=", "<", ">"])
    atoms = [f"({draw(signal)} {draw(comparison)} {draw(st.integers(-2, 8))}.{n + 1})" for n in range(count)]
    joining = st.sampled_from(["and", "or", "and", "or", "->", "U", "R", "W", "S", "U[0,2]"])
    inner = st.sampled_from(["", "F ", "G ", "not ", "O ", "X ", "G[1,3] "])
    outer = st.sampled_from(["F", "G", "not", "F[0,2]", "H", "WX"])
    text = atoms[0]
    for atom in atoms[1:]:
        text = f"({text} {draw(joining)} {draw(inner)}{atom})"
        if draw(st.booleans()):
            text = f"({draw(outer)} {text})"
    return text


@examples(400)
@given(formula=formulas_of_leaves, run=leaf_runs())
def test_the_path_ends_at_the_number_it_began_with(formula, run):
    order, times = compile_formula(formula).leaves, np.array(run.times_ns)
    done = evaluate_offline(formula, order, run.values(order), times)
    for index, _ in enumerate(iter_nodes(formula)):
        low, high = (float(column[0]) for column in done.ends(index))
        end = End.LOW if low >= 0.0 else End.HIGH if high < 0.0 else End.OPEN
        path = deciding_path(done, index, end)
        last = path.steps[-1]
        found = [float(column[last.sample]) for column in done.ends(last.node)]
        if end is End.OPEN:
            assert found[0] < found[1]
            assert found[0] <= 0.0 <= found[1]
        else:
            # an odd number of negations on the way turns the number and the end that it is of
            sign = 1.0 if path.end is end else -1.0
            number = found[0] if path.end is End.LOW else found[1]
            assert sign * number == (low if end is End.LOW else high)


@given(trace=signal_runs(), operator=st.sampled_from("GF"))
def test_the_earliest_of_equal_samples_decides(trace, operator):
    result = evaluate(parse_specification(f"{operator} (p >= 0.5)"), trace).result()
    witness = result.witness()
    assume(witness.verdict is not Verdict.UNKNOWN)
    values = result.full_signal()[1]
    best = np.nanmin(values) if operator == "G" else np.nanmax(values)
    assert witness.time_ns == int(trace.times_ns[int(np.flatnonzero(values == best)[0])])


@examples(80)
@given(specification=specifications(), recording=recordings())
def test_a_witness_has_the_value_it_claims(specification, recording):
    trace = recording.trace()
    observed = observed_in(recording, specification)
    evaluation = evaluate(
        specification, trace, each={"ego": "all"} if specification.specs[0].parameter else None
    )
    for result in evaluation:
        for node in result.nodes:
            witness = result.witness(node.id)
            assert witness.verdict is node.verdict
            np.testing.assert_allclose([witness.lower, witness.upper], [node.final_lower, node.final_upper])
            assert len(sentences_of(witness, first_ns=0)) - len(witness.gaps) in (2, 3, 4)
            deciding = witness.deciding
            if deciding is None:
                continue
            at = trace.times_ns.tolist().index(witness.time_ns)
            nominal, wide = (
                observed.interval(deciding.atom, at, {}, uncertain) for uncertain in (False, True)
            )
            np.testing.assert_allclose([deciding.lower, deciding.upper], wide, atol=1e-9)
            value = nominal.low if math.isclose(nominal.low, nominal.high, abs_tol=1e-9) else math.nan
            np.testing.assert_allclose(deciding.value, value, atol=1e-9)
            assert bool(deciding.unknown) == (wide == (-math.inf, math.inf) and not deciding.measured)
            if witness.verdict is not Verdict.UNKNOWN:
                end = deciding.lower if deciding.end is End.LOW else deciding.upper
                assert math.isclose(
                    abs(end), abs(witness.lower if witness.verdict == "satisfied" else witness.upper)
                )
            if deciding.measured and deciding.lower == deciding.upper and math.isfinite(deciding.value):
                assert math.isclose(total(deciding), deciding.value, abs_tol=1e-9)


def total(deciding) -> float:
    """The deciding branch added up."""
    measured = iter(deciding.measured)
    return sum(
        weight * (part.value if isinstance(part, Number) else next(measured).value)
        for weight, part in deciding.branch
    )


@examples(200)
@given(text=comparison_texts(), trace=signal_runs())
def test_the_threshold_flips_the_verdict(text, trace):
    witness = evaluate(parse_specification(text), trace).result().witness()
    sentences = sentences_of(witness, first_ns=0)
    if witness.threshold is None:
        assert witness.verdict is Verdict.UNKNOWN or not flips_somewhere(text, trace, witness)
        return
    threshold = witness.threshold
    assert threshold.is_written
    assert verdict_with(text, trace, witness, threshold.flips_at) is threshold.verdict
    assert threshold.verdict is not witness.verdict
    nearer = threshold.value + 0.98 * (threshold.flips_at - threshold.value)
    if abs(threshold.flips_at - threshold.value) > 1e-9:
        assert verdict_with(text, trace, witness, nearer) is witness.verdict
    reported = REPORTED.search(sentences[2])
    if reported:
        assert verdict_with(text, trace, witness, float(reported[1])) is threshold.verdict


REPORTED = re.compile(r"(?:with|exactly) (-?[0-9.e-]+)(?: or more| or less|) instead of")


def verdict_with(text: str, trace: Trace, witness, new: float) -> Verdict:
    """The verdict with another number in the deciding atom, where that is written."""
    span = witness.deciding.atom.span
    atom = text[span.start : span.end]
    (number,) = (each for each in witness.deciding.atom.parameters if isinstance(each, float))
    changed = NUMBER.sub(lambda match: repr(new) if float(match[0]) == number else match[0], atom)
    assert changed != atom
    return evaluate(parse_specification(text[: span.start] + changed + text[span.end :]), trace).verdict


def flips_somewhere(text: str, trace: Trace, witness) -> bool:
    """Whether the deciding atom alone can make another verdict."""
    if witness.deciding is None or not math.isfinite(witness.deciding.value):
        return False
    opposite = Verdict.SATISFIED if witness.verdict is Verdict.VIOLATED else Verdict.VIOLATED
    return any(verdict_with(text, trace, witness, new) is opposite for new in (-1000.0, 1000.0))


TEMPLATES = [
    "G (a dist b >= {})",
    "F (a closeto[{}] b)",
    "G (a farfrom[{}] goal)",
    "F (a touch[{}] b)",
    "G not (a moved[{}] a[-1])",
    "F (1 <= a dist b <= {})",
    "F (a dist b == {})",
    "F (enlarge(a, {0}) ovlp enlarge(b, {0}))",
    "(F[5,9] (forall x in people: x dist goal >= {0})) or (forall x in people: x dist goal >= {0})",
    "F (goal moved[{}] goal[-1])",
    "G (forall x in people: x dist goal >= {})",
    "F (exists x, y in everyone: x closeto[{}] y)",
    "(G a dist b >= {}) and F (a ovlp goal)",
    "forall r in pair: F (r closeto[{}] goal)",
    "G (a oriented[{}] b)",
    "F (a enclosedin enlarge(goal, {}))",
    "(G a dist b >= {0}) and (G a dist goal >= {0})",
    "(G a dist b >= {0}) and (F (a closeto[{0}] goal))",
    "G (a dist b >= {0} -> (F b farfrom[{0}] goal))",
    "(a dist b >= {0}) <-> F (enlarge(a, {0}) ovlp goal)",
    "F (a leftof b and a ovlp goal)",
]
WITHOUT_NUMBERS = [
    "G (a ovlp b)",
    "G not (a ovlp goal)",
    "G (a enclosedin goal)",
    "F not (b enclosedin goal)",
    "G (a leftof b)",
    "F (a rightof goal)",
    "G not (a partbelow b)",
    "G (a closer b than goal)",
    "F (a partovlp goal)",
    "G (a ovlp b -> a enclosedin goal)",
    "G (a dist b <= 4 -> F[0, 1] a ovlp goal)",
]
HEADER = """\
region goal = box(-2, -2, 3, 2)
group pair = a, b
group people = class "person"
group everyone = all
"""
WRITTEN = re.compile(
    r"It would be (satisfied|violated) with (?:exactly )?(\S+)(?: or more| or less)? instead of (\S+)"
    r" (?:for `(\w+)`|in `.*`)"
)
ANY = re.compile(
    r"It would be (satisfied|violated) with any number (above|below) (\S+) (?:for `(\w+)`|in `.*`)"
)
REPLACED = re.compile(r"It would be (satisfied|violated) with `(.*)` instead of `.*`\.")
MARGIN = re.compile(r"It would be (satisfied|violated) in a log in which `.*` holds by (\S+) (more|less)\.")
NO_DISTANCE = re.compile(
    r"No distance (?:for `(\w+)`|in `.*`) makes it (satisfied|violated): the objects touch or overlap\."
)


@examples(80)
@given(
    template=st.sampled_from(TEMPLATES) | st.sampled_from(WITHOUT_NUMBERS),
    number=st.sampled_from([0.5, 2.25, 7.125]),
    is_constant=st.booleans(),
    recording=recordings(),
)
def test_advice_of_an_explanation_leads_to_the_verdict_that_it_claims(
    template, number, is_constant, recording
):
    trace = recording.trace()
    text = f"{HEADER}const c = {number}\nspec s = {template.format('c' if is_constant else number)}\n"
    specification = parse_specification(text)
    result = evaluate(specification, trace).result()
    witnesses = {cause.node: cause.witness for cause in result.causes} or {0: result.worst}
    for node, witness in witnesses.items():
        explained = result.explain(first_ns=0)
        said = " ".join(each for each in sentences_of(witness, first_ns=0) if each in explained)
        written, beyond, replaced, margin, no_distance = (
            advice.search(said) for advice in (WRITTEN, ANY, REPLACED, MARGIN, NO_DISTANCE)
        )
        threshold = witness.closest_threshold or witness.threshold
        advice_of_any_kind = written or beyond or replaced or margin or no_distance
        assert bool(advice_of_any_kind) == (threshold is not None)
        if threshold is None:
            continue
        atom = (witness.closest[0] if witness.closest_threshold else witness.deciding).atom
        if no_distance:
            constant, claimed = no_distance.groups()
            for distance in ("0", "0.001", "1000000"):
                if constant:
                    edited = parse_specification(text, constants={constant: float(distance)})
                else:
                    edited = with_number(specification, atom, repr(threshold.value), distance)
                assert evaluate(edited, trace).result().nodes[node].verdict != claimed
            continue
        if written or beyond:
            if written:
                claimed, new, old, constant = written.groups()
                assert threshold.flips_at == float(new)
            else:
                claimed, side, old, constant = beyond.groups()
                new = repr(float(old) + (1e-6 if side == "above" else -1e-6))
            if constant:
                followed = parse_specification(text, constants={constant: float(new)})
            else:
                followed = with_number(specification, atom, old, new)
        elif replaced:
            claimed, new = replaced.groups()
            source, span = specification.source, atom.span
            followed = parse_specification(source[: span.start] + new + source[span.end :])
        else:
            claimed, size, how = margin.groups()
            followed = with_margin(specification, atom, float(size) * (1 if how == "less" else -1))
        assert evaluate(followed, trace).result().nodes[node].verdict == claimed


def with_number(specification, atom, old, new):
    """The specification with another number in an atom, wherever that place of the text is."""
    span = atom.span
    written = specification.source[span.start : span.end]
    changed = re.sub(rf"(?<![\d.]){re.escape(old)}(?![\d.])", new, written)
    if changed == written:
        changed = re.sub(r"\bc\b", new, written)
    assert changed != written
    return parse_specification(
        specification.source[: span.start] + changed + specification.source[span.end :]
    )


def with_margin(specification, decided, margin):
    """The specification with an atom that has to hold by a margin."""

    def change(atom):
        if atom.span != decided.span:
            return atom
        return replace(atom, expression=Sum(atom.expression, Number(-margin)))

    (spec,) = specification.specs
    formula = rewritten(spec.formula, change)
    return Specification((replace(spec, formula=formula),), "paper", regions=specification.regions)
