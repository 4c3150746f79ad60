"""Laws of the language: reading and writing are inverse, sugar is what it says, nothing slips through."""

from __future__ import annotations

import re

import hypothesis.strategies as st
from hypothesis import given

from examples import examples
from laws.strategies_spec import Vocabulary, formula_texts, noise, specification_texts
from spatial_replay import SpecificationError, parse_specification
from spatial_replay.spec import check_names, format_formula, format_specification, object_names
from spatial_replay.spec.formula import Formula, TrackedName, Variable, operands_of
from spatial_replay.spec.walks import base_of, iter_formulas, substitute


def formula_of(text: str) -> Formula:
    return parse_specification(text).specs[0].formula


@given(specification_texts())
@examples(60)
def test_reading_a_canonical_text_gives_an_equal_specification(text: str) -> None:
    specification = parse_specification(text)
    canonical = format_specification(specification)
    assert parse_specification(canonical) == specification
    assert format_specification(parse_specification(canonical)) == canonical


@given(specification_texts())
@examples(60)
def test_the_text_of_a_node_means_that_node(text: str) -> None:
    """The text of a node, which tools show by itself, means that node."""
    specification = parse_specification(text)
    definitions = [line for line in format_specification(specification).splitlines() if line[:5] != "spec "]
    for spec in specification.specs[:2]:
        for operand in operands_of(spec.formula):
            alone = parse_specification("\n".join([*definitions, f"spec alone = {format_formula(operand)}"]))
            (read,) = (each.formula for each in alone.specs)
            assert format_formula(read) == format_formula(operand)


@given(noise)
@examples(500)
def test_any_text_is_a_specification_or_has_faults_with_places(text: str) -> None:
    try:
        specification = parse_specification(text)
    except SpecificationError as error:
        assert error.diagnoses
        for diagnosis in error.diagnoses:
            assert 1 <= diagnosis.line <= text.count("\n") + text.count("\r") + 1
            assert diagnosis.column >= 1
            assert str(diagnosis)
    else:
        assert parse_specification(format_specification(specification)) == specification


@given(specification_texts(), st.data())
def test_a_damaged_text_has_faults_or_a_meaning(text: str, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 10)))
    damaged = text[:start] + data.draw(noise) + text[end:]
    try:
        specification = parse_specification(damaged)
    except SpecificationError as error:
        assert error.diagnoses
    else:
        assert parse_specification(format_specification(specification)) == specification


@given(st.lists(formula_texts(Vocabulary(max_depth=2)), min_size=2, max_size=4), st.data())
def test_precedence_is_that_of_the_brackets_it_stands_for(parts: list[str], data: st.DataObject) -> None:
    first, second = data.draw(
        st.sampled_from(
            [
                ("U", "and"),
                ("R", "and"),
                ("S", "xor"),
                ("and", "xor"),
                ("xor", "or"),
                ("or", "->"),
                ("or", "<->"),
            ]
        )
    )
    a, b, c = f"({parts[0]})", f"({parts[1]})", f"({parts[-1]})"
    assert formula_of(f"{a} {first} {b} {second} {c}") == formula_of(f"({a} {first} {b}) {second} {c}")
    assert formula_of(f"{a} {second} {b} {first} {c}") == formula_of(f"{a} {second} ({b} {first} {c})")
    assert formula_of(f"not {a} {first} {b}") == formula_of(f"(not {a}) {first} {b}")
    assert formula_of(f"{a} -> {b} -> {c} <-> {a}") == formula_of(f"({a} -> ({b} -> {c})) <-> {a}")
    assert formula_of(f"{a} U {b} W {c}") == formula_of(f"{a} U ({b} W {c})")


@given(formula_texts(Vocabulary(max_depth=2)), formula_texts(Vocabulary(max_depth=2)))
def test_a_prefix_reaches_up_to_the_closing_bracket(a: str, b: str) -> None:
    for prefix in ("F", "G[0, 2]", "X", "WX", "Y", "O", "H[0.5s, 1s]"):
        for operator in ("and", "xor", "or", "->", "<->", "U"):
            long = formula_of(f"({a}) or {prefix} ({a}) {operator} ({b})")
            assert long == formula_of(f"({a}) or ({prefix} (({a}) {operator} ({b})))")


@given(specification_texts())
@examples(60)
def test_object_and_signal_names_are_exactly_those_used(text: str) -> None:
    specification = parse_specification(text)
    names = object_names(specification)
    assert check_names(specification, names, ("battery", "air temperature")) == ()
    missing = check_names(specification, (), ("battery", "air temperature"))
    assert len(missing) == len(names)


@given(specification_texts())
@examples(60)
def test_an_instance_of_a_template_is_about_its_object(text: str) -> None:
    specification = parse_specification(text)
    template = next(spec for spec in specification.specs if spec.parameter == "ego")
    instance = substitute(template.formula, {"ego": TrackedName("car 7")})
    terms = [base_of(term) for each in iter_formulas(instance) for term in getattr(each, "terms", ())]
    assert Variable("ego") not in terms
    direct = re.sub(r"\bego\b", '"car 7"', text.replace("spec ahead(ego)", "spec ahead"))
    expected = next(spec for spec in parse_specification(direct).specs if spec.name == "ahead")
    assert instance == expected.formula
