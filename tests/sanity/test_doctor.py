"""The doctor finds what is wrong with specifications, and says how far it could look."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from pages import shown
from spatial_replay.sanity.examples import Example

REGIONS = """
region left_bin = box(0, 0, 1, 1)
region right_bin = circle((3, 0.5), 0.5)
region corner = box(0, 0, 0.4, 0.4)
region left_disc = circle((5, 5), 0.5)
region right_disc = circle((5.8, 5.8), 0.5)
group cups = cup, mug
"""


def findings(text: str) -> list[tuple[str, tuple[str, ...]]]:
    specification = sr.parse_specification(REGIONS + text)
    return [(each.kind, each.specs) for each in sr.doctor(specification, examples=False).findings]


def exclusions(formula: str, profile: str = "paper") -> tuple[tuple[str, ...], ...]:
    """What excludes that a formula ever holds."""
    specification = sr.parse_specification(f"{REGIONS}spec s = F ({formula})\n", profile=profile)
    (finding,) = sr.doctor(specification, examples=False).findings
    assert finding.kind == "unsatisfiable"
    return finding.exclusions


@pytest.mark.parametrize(
    ("formula", "excluded"),
    [
        ("a leftof b and b leftof a", ("a leftof b", "b leftof a")),
        ("a leftof b and b leftof c and c leftof a", ("a leftof b", "b leftof c", "c leftof a")),
        ("a leftof b and a ovlp b", ("a leftof b", "a ovlp b")),
        ("a prec[z] b and a ovlp b", ("a prec[z] b", "a ovlp b")),
        ("a enclosedin b and not (a ovlp b)", ("a enclosedin b", "not (a ovlp b)")),
        (
            "a enclosedin b and b enclosedin c and not (a enclosedin c)",
            ("a enclosedin b", "b enclosedin c", "not (a enclosedin c)"),
        ),
        ("a enclosedin b and b leftof c and c ovlp a", ("a enclosedin b", "b leftof c", "c ovlp a")),
        ("a dist b <= 0.1 and b farfrom[0.2] a", ("a dist b <= 0.1", "b farfrom[0.2] a")),
        ("a moved[0.2] b and not (a moved[0.1] b)", ("a moved[0.2] b", "not (a moved[0.1] b)")),
        (
            "a closer b than c and a ovlp c and a dist b > 0",
            ("a closer b than c", "a ovlp c", "a dist b > 0"),
        ),
        ("a oriented[-0.1] b", ("a oriented[-0.1] b",)),
        (
            "cup enclosedin left_bin and cup enclosedin right_bin",
            ("cup enclosedin left_bin", "cup enclosedin right_bin"),
        ),
        (
            "cup enclosedin left_bin and pen enclosedin right_bin and pen leftof cup",
            ("cup enclosedin left_bin", "pen enclosedin right_bin", "pen leftof cup"),
        ),
        ("cups leftof b and b leftof mug", ("mug prec[x] b", "b leftof mug")),
        ("mode == 2 and mode >= 3", ("mode <= 2", "mode >= 3")),
        ("a enclosedin b and b enclosedin a", ("a enclosedin b", "b enclosedin a")),
        (
            "a enclosedin b and b enclosedin c and c enclosedin a",
            ("a enclosedin b", "b enclosedin c", "c enclosedin a"),
        ),
        (
            "cup enclosedin corner and not (cup enclosedin left_bin)",
            ("cup enclosedin corner", "not (cup enclosedin left_bin)"),
        ),
        # their extents along both axes overlap
        (
            "cup enclosedin left_disc and cup enclosedin right_disc",
            ("cup enclosedin left_disc", "cup enclosedin right_disc"),
        ),
        (
            "cup enclosedin corner and mug enclosedin left_bin and cup dist mug >= 2",
            ("cup enclosedin corner", "mug enclosedin left_bin", "cup dist mug >= 2", "no gap in height"),
        ),
    ],
)
def test_what_geometry_excludes_is_named(formula: str, excluded: tuple[str, ...]) -> None:
    assert exclusions(formula) == (excluded,)


@pytest.mark.parametrize(
    ("relations", "excluded"),
    [
        ([f"a{n} leftof a{n + 1}" for n in range(24)] + ["a24 leftof a0"], 25),
        ([f"a{n} enclosedin a{n + 1}" for n in range(18)] + ["a18 leftof b", "b ovlp a0"], 20),
        ([f"a{n} enclosedin left_bin" for n in range(30)] + ["a29 ovlp right_bin"], 2),
    ],
    ids=("in a row", "in each other", "in a bin"),
)
def test_what_excludes_each_other_is_found_among_many_objects(relations: list[str], excluded: int) -> None:
    (found,) = exclusions(" and ".join(relations))
    assert len(found) == excluded
    # without the last one, all of them can hold
    assert findings(f"spec s = F ({' and '.join(relations[:-1])})") == []


def test_the_published_profile_compares_centroids() -> None:
    assert exclusions("a leftof b and b leftof a", "spatial_spec") == (("a leftof b", "b leftof a"),)
    # by their centroids, overlapping objects may be left of each other
    specification = sr.parse_specification("F (a leftof b and a ovlp b)", profile="spatial_spec")
    assert sr.doctor(specification, examples=False).findings == ()


def test_what_can_hold_is_not_excluded() -> None:
    assert (
        findings("spec s = F (a leftof b and a rightof c and a dist b <= 0.1 and c enclosedin left_bin)\n")
        == []
    )
    # marginal by its nature, and meant
    assert findings("spec s = F (mode == 2 and mode >= 2)\nspec t = F (a touch[0] b)\n") == []
    assert findings("spec s = G (fault != 1)") == findings("spec s = F (fault != 1)") == []


@pytest.mark.parametrize(
    "text",
    [
        "spec s = F (cup enclosedin corner and mug enclosedin corner and cup dist mug >= 0.5)",
        "spec s = F (a moved[0.2] corner and b enclosedin corner and a dist b >= 0.7)",
        # things of which one stands on the other may be further apart than their region is wide
        "spec s = F (a enclosedin corner and b enclosedin corner and a dist b >= 1 and b prec[z] a)",
        "region shelf = box(9, 9, 10, 10) height (1, 2)\n"
        "spec s = F (cup enclosedin corner and mug enclosedin corner and cup dist mug >= 1)",
    ],
    ids=("diagonal", "outside", "above", "shelf"),
)
def test_things_in_a_region_may_be_as_far_apart_as_it_is_wide(text: str) -> None:
    assert findings(text) == []


def test_none_and_some_are_opposites_whatever_their_variables_are_called() -> None:
    none = "spec none = G (forall p in all: not (p ovlp robot))\n"
    assert findings(f"{none}spec some = F (exists q in all: q ovlp robot)") == [
        ("contradiction", ("none", "some"))
    ]
    assert findings(f"{none}spec other = F (exists q in all: q ovlp person)") == []


def test_contradictions_of_logic_alone_are_said_to_be() -> None:
    specification = sr.parse_specification("F (p >= 1 and not (p >= 1))")
    (finding,) = sr.doctor(specification).findings
    assert finding.reason == "by logic alone, whatever is measured"
    assert "no run satisfies spec: by logic alone" in finding.diagnostic.message
    assert exclusions("a leftof b and a rightof b") == ()


def test_a_relation_between_regions_holds_always_or_never() -> None:
    nested = "region shelf = box(-1, -1, 2, 2)\n"
    assert findings(f"{nested}spec s = F (left_bin enclosedin shelf)\n") == [("always true", ("s",))]
    assert findings(f"{nested}spec s = G (shelf enclosedin left_bin)\n") == [("unsatisfiable", ("s",))]
    assert findings("spec s = G (left_bin dist right_bin >= 1.5 -> a ovlp b)\n") == []


def test_relations_are_reported_as_they_are_written_and_opposites_are_named() -> None:
    specification = sr.parse_specification("spec s = F (a dist b <= 0.2)\nspec t = G (b dist a >= 0.2)")
    examined = sr.doctor(specification)
    (finding,) = examined.findings
    assert finding.kind == "contradiction"
    assert finding.reason.endswith("; `b dist a >= 0.2` and `a dist b <= 0.2` are opposites")
    one, _ = examined.specs
    assert one.violated is not None
    assert one.violated.sentences == ("b dist a >= 0.2",)
    (never,) = sr.doctor(sr.parse_specification("F (a dist b <= 0.2) and G (a dist b >= 0.2)")).specs
    assert never.violated is not None
    assert never.violated.sentences == ("any sample",)


def test_what_is_compared_by_equality_is_reported_to_the_letter() -> None:
    specification = sr.parse_specification("spec on = F (mode > 1)\nspec one = G (mode == 1)")
    examined = sr.doctor(specification)
    (finding,) = examined.findings
    assert (finding.kind, finding.specs) == ("implied", ("on", "one"))
    assert finding.reason.endswith("whatever is measured; `mode > 1` has the robustness of `mode >= 1`")
    runs = [run.sentences for spec in examined.specs for run in (spec.satisfied, spec.violated) if run]
    assert runs == [("mode >= 1",), ("mode < 1",), ("mode >= 1 and mode <= 1",), ("mode < 1",)]
    (alike,) = sr.doctor(sr.parse_specification("spec s = F (p >= 1)\nspec t = F (p > 1)")).findings
    assert alike.reason.endswith("; `p > 1` has the robustness of `p >= 1`")


def test_of_many_antecedents_the_one_that_never_holds_is_found() -> None:
    antecedents = [f"a{n} leftof b{n}" for n in range(12)]
    antecedents[7] += " and b7 leftof a7"
    text = " and ".join(f"(G ({each} -> F c dist d >= 0.{n + 1}))" for n, each in enumerate(antecedents))
    (finding,) = sr.doctor(sr.parse_specification(text), examples=False).findings
    assert finding.kind == "idle antecedent"
    assert "(a7 leftof b7) and (b7 leftof a7)" in finding.diagnostic.message
    assert finding.exclusions == (("a7 leftof b7", "b7 leftof a7"),)


def test_a_note_says_how_many_implications_were_examined() -> None:
    text = " and ".join(f"(G (a{n} ovlp b -> F a{n} ovlp c))" for n in range(45))
    examined = sr.doctor(sr.parse_specification(f"spec s = {text}"), examples=False)
    assert examined.notes == ("of 45 implications of s, 40 were examined",)


def test_specs_are_compared_with_each_other() -> None:
    found = findings(
        "spec far = G (cup dist mug >= 0.2)\n"
        "spec apart = G (cup dist mug >= 0.1)\n"
        "spec near = F (cup dist mug <= 0.15)\n"
        "spec other = G (pen dist mug >= 0.1)\n"
    )
    assert found == [("implied", ("apart", "far")), ("contradiction", ("far", "near"))]


def test_specs_that_say_the_same_are_one_finding() -> None:
    assert findings("spec one = G (a ovlp b)\nspec two = not F (a dist b > 0)\n") == [
        ("implied", ("two", "one"))
    ]


def test_the_conjuncts_of_a_result_are_compared_too() -> None:
    assert findings(
        "spec never = G not (cup ovlp left_bin)\n"
        "spec put = F (cup enclosedin left_bin)\n"
        "spec whole = never and put\n"
    ) == [("contradiction", ("never", "put")), ("unsatisfiable", ("whole",))]


def test_an_antecedent_that_never_holds_is_found() -> None:
    (finding,) = sr.doctor(
        sr.parse_specification(
            "spec s = G (a dist b >= 0.2) and G (a dist b <= 0.1 -> F (a leftof b))", filename="s.spatial"
        )
    ).findings
    assert finding.kind == "idle antecedent"
    assert finding.diagnostic.message == (
        "`a dist b <= 0.1` never holds in a run that satisfies s, so this implication checks nothing: "
        "`a dist b >= 0.2` and `a dist b <= 0.1` exclude each other"
    )
    assert (finding.diagnostic.line, finding.diagnostic.column) == (1, 36)


def test_without_an_automaton_looser_readings_decide_what_they_can() -> None:
    specification = sr.parse_specification(
        "spec never = F[0s, 2s] (a leftof b and b leftof a)\n"
        "spec once = G (a leftof c -> O (a ovlp c))\n"
        "spec bound = F[0s, 2s] (a leftof d)\n"
        "spec wrong = G (a rightof d)\n"
    )
    examined = sr.doctor(specification)
    assert [(each.kind, each.specs) for each in examined.findings] == [
        ("unsatisfiable", ("never",)),
        ("contradiction", ("bound", "wrong")),
    ]
    assert "however its bounds and past operators are read" in examined.findings[0].reason
    never, once, bound, wrong = examined.specs
    assert never.reason == "`F[0s, 2s]` counts seconds, an automaton counts samples"
    assert "looks back" in once.reason
    assert not wrong.reason
    # guesses that an evaluation confirmed
    assert bound.satisfied is not None
    assert bound.satisfied.robustness is not None
    assert bound.satisfied.robustness > 0


def test_too_large_an_automaton_is_read_without_its_bounds() -> None:
    specification = sr.parse_specification(
        "spec s = G (a leftof b -> F[400, 20000] b leftof a) and F (a ovlp b and a leftof b)"
    )
    examined = sr.doctor(specification)
    assert [each.kind for each in examined.findings] == ["unsatisfiable"]
    assert "more than 10000 subformulas" in examined.specs[0].reason


def test_what_is_decided_propositionally_only_is_listed() -> None:
    specification = sr.parse_specification(
        'group people = class "person"\n'
        "spec s = F (exists p in people: p dist a <= 1) and G not (a moved[0.1] a[-1])\n"
    )
    (spec,) = sr.doctor(specification).specs
    assert spec.unrelated == ("exists p in people: (p dist a <= 1)", "a moved[0.1] a[-1]")
    assert spec.satisfied is not None
    assert spec.satisfied.samples is None
    assert spec.satisfied.note


def test_shortest_runs_show_what_has_to_hold_in_each_sample() -> None:
    specification = sr.parse_specification("spec s = (a leftof b) U[2, 4] (a ovlp b) and G (battery >= 0.2)")
    (spec,) = sr.doctor(specification).specs
    assert spec.satisfied is not None
    assert spec.violated is not None
    assert spec.satisfied.sentences == (
        "a leftof b and battery >= 0.2",
        "a leftof b and battery >= 0.2",
        "a ovlp b and battery >= 0.2",
    )
    assert spec.violated.sentences == ("not (battery >= 0.2)",)
    assert len(spec.satisfied.rows) == 3


def shown_runs(text: str) -> list[Example]:
    """The shortest runs of the one result of a text, each evaluated again from its samples."""
    specification = sr.parse_specification(text)
    (spec,) = sr.doctor(specification).specs
    assert spec.undecided == ()
    runs = [run for run in (spec.satisfied, spec.violated) if run is not None]
    for run in runs:
        assert run.samples is not None, run.note
        assert sr.evaluate(specification, sr.Trace.from_samples(run.samples)).verdict == run.verdict
    return runs


@pytest.mark.parametrize("deadline", ["", "[0, 3]"])
def test_runs_of_many_responses_about_the_same_objects_are_placed(deadline: str) -> None:
    relations = ["{} leftof {}", "{} ovlp {}", "{} dist {} >= 0.2", "{} above {}", "{} dist {} <= 0.1"]
    pairs = [(f"o{one}", f"o{other}") for one in range(5) for other in range(5) if one != other]
    atoms = [relations[n % 5].format(*pairs[7 * n % 20]) for n in range(28)]
    responses = [
        f"(G ({before} -> F{deadline} {after}))" for before, after in zip(atoms[:14], atoms[14:], strict=True)
    ]
    text = " and ".join(responses)
    assert [len(run.sentences) for run in shown_runs(text)] == [1, 1]
    # it begins with what is asked for two samples later, which takes three of them
    begun = f"{text} and (o0 ovlp o1) and (X X o0 dist o1 >= 0.3)"
    assert [len(run.sentences) for run in shown_runs(begun)] == [3, 1]


def test_of_many_specs_that_hold_together_the_two_that_contradict_each_other_are_named() -> None:
    goals = [f"(F (a{n} enclosedin left_bin))" for n in range(14)]
    specification = sr.parse_specification(
        f"{REGIONS}spec s = {' and '.join(goals)} and G not (a9 ovlp left_bin)"
    )
    (finding,) = sr.doctor(specification, examples=False).findings
    assert finding.kind == "unsatisfiable"
    assert finding.exclusions == (("a9 enclosedin left_bin", "not (a9 ovlp left_bin)"),)


def test_what_nests_too_much_for_one_evaluation_is_shown_in_parts() -> None:
    # without brackets each G reaches over all that follow
    text = " and ".join(f"G (o{n} leftof o{n + 1} -> F o{n + 1} leftof o{n})" for n in range(9))
    (spec,) = sr.doctor(sr.parse_specification(text)).specs
    for run in (spec.satisfied, spec.violated):
        assert run is not None
        assert run.samples is not None
        assert run.robustness is not None
        assert (run.robustness > 0) == (run.verdict == "satisfied")


ATOMS = ("a leftof b", "a ovlp b", "b leftof a", "a dist b >= 0.2", "a dist c <= 0.1", "c leftof b", "p >= 1")
parts = st.one_of(
    st.builds("F {}".format, st.sampled_from(ATOMS)),
    st.builds("G not ({})".format, st.sampled_from(ATOMS)),
    st.builds("X {}".format, st.sampled_from(ATOMS)),
    st.builds("G ({} -> F[1, 2] {})".format, st.sampled_from(ATOMS), st.sampled_from(ATOMS)),
    st.builds("({}) U ({})".format, st.sampled_from(ATOMS), st.sampled_from(ATOMS)),
)


@examples(30)
@given(st.lists(parts, min_size=2, max_size=5))
def test_formulas_that_hold_together_are_decided_as_one_formula_is(formulas: list[str]) -> None:
    together = " and ".join(f"({each})" for each in formulas)
    # which is not taken apart
    one = f"not ({' or '.join(f'(not ({each}))' for each in formulas)})"
    lengths = []
    for text in (together, one):
        (spec,) = sr.doctor(sr.parse_specification(text)).specs
        assert spec.undecided == ()
        runs = (spec.satisfied, spec.violated)
        lengths.append([None if run is None else len(run.sentences) for run in runs])
        for run in runs:
            if run is not None and run.samples is not None:
                trace = sr.Trace.from_samples(run.samples)
                assert sr.evaluate(sr.parse_specification(one), trace).verdict == run.verdict
    assert lengths[0] == lengths[1]


responses = st.builds(
    "G ({0} -> F[{1}, {2}] {3})".format,
    st.sampled_from(("a leftof b", "c ovlp d", "not (e leftof f)")),
    st.integers(0, 2),
    st.integers(2, 5),
    st.sampled_from(("g ovlp h", "not (g ovlp h)", "i leftof j", "not (a leftof b)")),
)
untils = st.builds(
    "({}) U ({})".format, st.sampled_from(("g ovlp h", "i leftof j")), st.sampled_from(ATOMS[:2])
)


@examples(20)
@given(st.lists(st.one_of(responses, untils, parts), min_size=3, max_size=6))
def test_a_conjunction_that_its_automaton_decides_is_decided(formulas: list[str]) -> None:
    specification = sr.parse_specification(f"spec s = {' and '.join(f'({each})' for each in formulas)}")
    automaton = sr.automaton(specification)
    examined = sr.doctor(specification, examples=False)
    (spec,) = examined.specs
    assert spec.undecided == ()
    if automaton.initial not in automaton.can_accept:
        # geometry may exclude more runs than propositions do
        assert ("unsatisfiable", ("s",)) in [(each.kind, each.specs) for each in examined.findings]


def test_a_template_is_examined_about_any_object() -> None:
    specification = sr.parse_specification("spec s(e) = G (e dist cup >= 0.3) and F (e dist cup <= 0.2)")
    examined = sr.doctor(specification)
    assert [each.kind for each in examined.findings] == ["unsatisfiable"]
    assert examined.specs[0].violated is not None
    assert examined.specs[0].violated.note == "a template is about the objects of a log"


def test_only_specifications_are_examined() -> None:
    with pytest.raises(sr.UsageError, match="give a Specification"):
        sr.doctor("F (a leftof b)")  # type: ignore[arg-type]


def test_a_notebook_shows_findings_and_the_shortest_runs() -> None:
    text = "spec never = F (a leftof b and b leftof a)\nspec near = F[0, 3] (a dist b <= 0.1)"
    found = sr.doctor(sr.parse_specification(text))
    page = shown(found)
    assert "1 finding in 2 results" in page
    assert found.findings[0].diagnostic.message in page
    assert found.specs[1].satisfied is not None
    assert found.specs[1].satisfied.sentences[0] in page
