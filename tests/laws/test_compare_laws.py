"""What a diff states and a clip keeps is true of every specification and every log."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, assume, example, given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from laws.strategies_monitor import HEADER, WORDS, Recording, recordings, specifications
from laws.strategies_spec import formula_texts
from spatial_replay import Specification
from spatial_replay.compare.clips import cut_clip
from spatial_replay.compare.edits import unify_regions
from spatial_replay.logs.source import MemorySource
from spatial_replay.monitor.result import SpecResult
from spatial_replay.spec.formula import Formula, NamedSpec

OTHER_HEADER = HEADER.replace("box(-2, -2, 3, 2)", "box(-1, -2, 3, 1)")


def numbers_of(result: SpecResult) -> tuple[object, ...]:
    return result.verdict, *(None if x != x else x for x in (result.robustness, result.lower, result.upper))


@st.composite
def versions(draw) -> tuple[sr.Specification, sr.Specification]:
    """Two specifications that share some of their parts, and not always the shapes of their regions."""
    small = replace(WORDS, max_depth=2)
    parts = draw(st.lists(formula_texts(small), min_size=4, max_size=4))
    texts = []
    for header in (HEADER, draw(st.sampled_from([HEADER, OTHER_HEADER]))):
        chosen = [parts[index] for index in draw(st.permutations(range(4)))[: draw(st.integers(1, 3))]]
        joined = draw(st.sampled_from([" and ", " or "])).join(f"({part})" for part in chosen)
        texts.append(f"{header}spec s = {draw(st.sampled_from(['', '', 'F ', 'G ']))}({joined})\n")
    old, new = map(sr.parse_specification, texts)
    return old, new


@examples(40, suppress_health_check=[HealthCheck.too_slow])
@given(pair=versions(), recording=recordings(), semantics=st.sampled_from(["ltlf", "ltlf", "paper"]))
def test_the_cause_of_a_change_undone_undoes_it(pair, recording, semantics):
    old, new = pair
    trace = recording.trace()
    try:
        (diff,) = sr.diff_specifications(trace, old, new, semantics=semantics).specs
    except sr.UsageError as error:
        assert "the paper's semantics has no" in str(error)
        return
    assert numbers_of(diff.old) == numbers_of(sr.evaluate(old, trace, semantics=semantics).result())
    assert numbers_of(diff.new) == numbers_of(sr.evaluate(new, trace, semantics=semantics).result())
    (_,), regions = unify_regions([old.specs[0].formula], old.regions, new.regions)
    tree = diff.tree

    def outcome(formula: Formula) -> tuple[object, ...]:
        specification = Specification((NamedSpec("s", formula),), "paper", regions)
        return numbers_of(sr.evaluate(specification, trace, semantics=semantics).result())

    everything = tree.effective
    assert outcome(tree.formula(())) == numbers_of(diff.old)
    assert outcome(tree.formula(everything)) == numbers_of(diff.new)
    assert bool(diff.cause) == (numbers_of(diff.old) != numbers_of(diff.new))
    if diff.cause:
        cause = [number for number in everything if set(tree.units[number]) & set(diff.cause)]
        compared = slice(0, 1) if diff.is_flipped else slice(None)
        others = [number for number in everything if number not in cause]
        assert outcome(tree.formula(cause))[compared] == numbers_of(diff.new)[compared]
        assert outcome(tree.formula(others))[compared] == numbers_of(diff.old)[compared]


DECLARED = """\
const near = {near}
const far = near * {far}
region zone = box(-2, -2, {zone}, 2)
group many = {many}
def beside(x, y) = x dist y {beside}
spec calm = G ({low} <= a dist b <= far)
spec met = F (beside(a, b) and b ovlp zone)
{extra}
spec s = {whole}
"""
WRITTEN = {
    "near": ["1", "1.5", "3"],
    "far": ["2", "4"],
    "zone": ["1", "3"],
    "many": ["a", "a, b", "b, c"],
    "beside": ["<= near", "<= far and x leftof y", ">= near"],
    "low": ["0", "0.5"],
    "extra": ["spec held = forall x in many: x enclosedin zone", "spec held = F (a leftof b)"],
    "whole": [
        *["calm", "calm and (met or held)", "calm and met", "met and held", "calm and (not met)"],
        *["(not calm) or held", "held and G (calm and met)", "calm and met and a leftof b", "met or held"],
    ],
}
STATEMENTS = {"constant": "const", "region": "region", "group": "group", "definition": "def"}


@st.composite
def edited_texts(draw) -> tuple[str, str]:
    """A text, and the same after edits of some of its declarations and specs."""
    old = {name: draw(st.sampled_from(values)) for name, values in WRITTEN.items()}
    edited = draw(st.sets(st.sampled_from(sorted(WRITTEN)), min_size=1, max_size=3))
    new = {name: draw(st.sampled_from(WRITTEN[name])) if name in edited else old[name] for name in old}
    return DECLARED.format(**old), DECLARED.format(**new)


@examples(25, suppress_health_check=[HealthCheck.too_slow])
@given(texts=edited_texts(), recording=recordings())
def test_the_lines_that_a_diff_names_are_those_that_were_edited_and_undone_they_undo_it(texts, recording):
    old, new = texts
    trace = recording.trace()
    diff = sr.diff_specifications(trace, *map(sr.parse_specification, texts)).spec("s")
    lines = [set(text.splitlines()) for text in texts]
    for edit in diff.edits:
        pair = diff.old_places[edit].text, diff.new_places[edit].text
        assert pair[0] in lines[0] - lines[1]
        assert pair[1] in lines[1] - lines[0]
        statement = "spec" if edit.subject is None else f"{STATEMENTS[edit.kind]} {edit.subject}"
        assert pair[1].startswith(statement)
    declared = [edit for edit in diff.edits if edit.change is not None]
    assert len({diff.new_places[edit] for edit in declared}) == len(declared)
    cause, others = (
        {diff.new_places[edit].text for edit in diff.edits if (edit in diff.cause) == is_cause}
        for is_cause in (True, False)
    )
    # of several edits of a line, one may be the cause alone; what only one text uses, edited itself
    assume(not cause & others)
    assume(all(line in cause | others for line in lines[1] - lines[0]))
    for edit in diff.cause:
        old = old.replace(diff.old_places[edit].text, diff.new_places[edit].text)
        new = new.replace(diff.new_places[edit].text, diff.old_places[edit].text)
    for text, wanted in ((old, diff.new), (new, diff.old)):
        outcome = numbers_of(sr.evaluate(sr.parse_specification(text), trace).result("s"))
        compared = slice(0, 1) if diff.is_flipped else slice(None)
        assert outcome[compared] == numbers_of(wanted)[compared]


@examples(30)
@given(text=formula_texts(WORDS), recording=recordings())
def test_equal_specifications_differ_in_nothing(text, recording):
    one, other = (sr.parse_specification(f"{HEADER}{line} = {text}\n") for line in ("spec s", "  spec  s"))
    diff = sr.diff_specifications(recording.trace(), one, other)
    assert diff.is_empty
    assert not diff.spec("s").edits
    assert diff.spec("s").first is None


@examples(30)
@given(recording=recordings(), other=recordings(), text=formula_texts(WORDS))
def test_runs_differ_unless_they_are_equal(recording, other, text):
    specification = sr.parse_specification(f"{HEADER}spec s = {text}\n")
    one, another = recording.trace(), other.trace()
    assert sr.diff_logs(one, one, specification).is_empty
    assume(set(one.names) & set(another.names))
    try:
        diff = sr.diff_logs(one, another, specification)
    except sr.UsageError as error:
        assert "different units" in str(error)
        return
    assert diff.is_empty == (one == another)
    for spec in diff.specs:
        assert numbers_of(spec.a) == numbers_of(sr.evaluate(specification, one).result())
        assert numbers_of(spec.b) == numbers_of(sr.evaluate(specification, another).result())


ONE_AFTER_THE_OTHER = Recording(
    tuple(
        sr.Sample(second * 10**9, {name: sr.Footprint.box(0, 0, 1, 1)}) for second, name in enumerate("aabb")
    )
)


@examples(40, suppress_health_check=[HealthCheck.too_slow])
@example(sr.parse_specification("spec s(ego) = ego ovlp ego"), ONE_AFTER_THE_OTHER)
@given(specification=specifications(), recording=recordings(max_size=7))
def test_a_clip_has_the_verdicts_the_robustness_and_the_witnesses_of_the_log(specification, recording):
    # a log holds what is unreadable as numbers that are not finite, which these observations do not have
    trace = replace(recording, unreadable=frozenset()).trace()
    each = {"ego": "all"} if specification.specs[0].parameter else {}
    whole = sr.evaluate(specification, trace, each=each)
    assume(whole.results)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "clip.mcap")
        titles = [result.title for result in whole]
        clip = sr.clip_log(trace, specification, output=path, each=each, of=titles)
        cut = sr.read_trace(path)
    assert len(cut) == clip.replayed.samples <= len(trace)
    assert set(cut.times_ns.tolist()) <= set(trace.times_ns.tolist())
    again = sr.evaluate(specification, cut, each=each)
    for one, other in zip(whole, again, strict=True):
        assert (one.title, one.verdict) == (other.title, other.verdict)
        # the other end may be unknown because of a sample that decides nothing
        if one.verdict is not sr.Verdict.UNKNOWN:
            deciding = "upper" if one.verdict is sr.Verdict.VIOLATED else "lower"
            assert getattr(one, deciding) == getattr(other, deciding)
        # what `replay` prints
        if one.verdict is not sr.Verdict.UNKNOWN:
            assert one.reason(0) == other.reason(0)
        assert one.certain_ns() == other.certain_ns()
        assert [(each.node, each.settled_ns) for each in one.causes[:1]] == [
            (each.node, each.settled_ns) for each in other.causes[:1]
        ]
        mine, its = one.witness(), other.witness()
        assert (mine.time_ns, [step.node for step in mine.path]) == (
            its.time_ns,
            [step.node for step in its.path],
        )
        assert (mine.deciding is None) == (its.deciding is None)
        if mine.deciding is not None and its.deciding is not None:
            assert mine.deciding.text == its.deciding.text
            assert np.array_equal(
                [mine.deciding.lower, mine.deciding.upper, mine.deciding.value],
                [its.deciding.lower, its.deciding.upper, its.deciding.value],
                equal_nan=True,
            )


def test_a_sample_that_decides_nothing_makes_no_clip_longer(tmp_path):
    specification = sr.parse_specification("spec s = G (gap >= 0.5)")
    holes = {10: {}}
    gaps = {k: {"gap": 0.2 if k == 300 else 1.0} for k in range(600)}
    for numbers, expected in (
        # a near miss, and an unknown sample far away from it
        ({**gaps, **holes}, (300, sr.Verdict.VIOLATED)),
        # the only sample that leaves the verdict open
        ({**gaps, **holes, 300: {"gap": 0.6}}, (10, sr.Verdict.UNKNOWN)),
    ):
        samples = [sr.Sample(k * 10**8, {}, signals) for k, signals in numbers.items()]
        clip = cut_clip(MemorySource.from_samples(samples), [specification], tmp_path / "clip.mcap")
        assert (clip.start_ns // 10**8, clip.replayed.verdict) == expected
        assert clip.replayed.samples == 1


def test_a_clip_of_a_missed_response_leaves_out_what_came_before(tmp_path):
    specification = sr.parse_specification("spec s = G (p >= 0 -> q >= 0)")
    numbers = [(1.0, -0.5) if k == 30 else (-1.0, 1.0) for k in range(60)]
    samples = [sr.Sample(k * 10**8, {}, {"p": p, "q": q}) for k, (p, q) in enumerate(numbers)]
    clip = cut_clip(MemorySource.from_samples(samples), [specification], tmp_path / "clip.mcap")
    assert (clip.start_ns, clip.replayed.samples) == (30 * 10**8, 1)
