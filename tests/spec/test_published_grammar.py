"""Formula strings of the published grammar keep their meaning; recorded specifications are read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spatial_replay import parse_specification
from spatial_replay.spec import format_formula, format_specification
from spatial_replay.spec.formula import FUTURE_OPERATORS, Temporal
from spatial_replay.spec.walks import iter_formulas


@pytest.mark.parametrize(
    ("published", "canonical"),
    [
        ("(a leftof b)", "a leftof b"),
        ("(a rightof b)", "a rightof b"),
        ("(a below b)", "a below b"),
        ("(a above b)", "a above b"),
        ("(a ovlp b)", "a ovlp b"),
        ("(a enclosedin b)", "a enclosedin b"),
        ("(a touch b)", "a touch[5] b"),
        ("(a farfrom b)", "a farfrom[150] b"),
        ("(a closeto b)", "a closeto[70] b"),
        ("(a closer b than c)", "a closer b than c"),
        ("(a dist b <= 3)", "a dist b <= 3"),
        ("(a dist b >= 3.5)", "a dist b >= 3.5"),
        ("(a dist b == .5e1)", "a dist b == 5"),
        ("(a dist b <= 5.)", "a dist b <= 5"),
        ("(a moved b)", "a moved[25] b"),
        ("(a moved a[-1])", "a moved[25] a[-1]"),
        ("(enlarge(a, 5) ovlp enlarge(b[-2], 1.5))", "enlarge(a, 5) ovlp enlarge(b[-2], 1.5)"),
        ("((a ovlp b) and (b ovlp c))", "(a ovlp b) and (b ovlp c)"),
        ("(a ovlp b) & (b ovlp c)", "(a ovlp b) and (b ovlp c)"),
        ("(a ovlp b) or (b ovlp c)", "(a ovlp b) or (b ovlp c)"),
        ("(a ovlp b) | (b ovlp c)", "(a ovlp b) or (b ovlp c)"),
        ("(a ovlp b) xor (b ovlp c)", "(a ovlp b) xor (b ovlp c)"),
        ("(a ovlp b) -> (b ovlp c)", "(a ovlp b) -> (b ovlp c)"),
        ("(a ovlp b) implies (b ovlp c)", "(a ovlp b) -> (b ovlp c)"),
        ("(not (a ovlp b))", "not (a ovlp b)"),
        ("(!(a ovlp b))", "not (a ovlp b)"),
        ("(not_t (F (a ovlp b)))", "not (F (a ovlp b))"),
        ("(!t (F (a ovlp b)))", "not (F (a ovlp b))"),
        ("(!t(a ovlp b))", "not (a ovlp b)"),
        ("(!(F (a ovlp b)))", "not (F (a ovlp b))"),
        ("(F (a ovlp b)) ->t (G (b ovlp c))", "(F (a ovlp b)) -> (G (b ovlp c))"),
        ("(F (a ovlp b)) implies_t (G (b ovlp c))", "(F (a ovlp b)) -> (G (b ovlp c))"),
        ("(X (a ovlp b))", "X (a ovlp b)"),
        ("((a ovlp b) U (b ovlp c))", "(a ovlp b) U (b ovlp c)"),
        ("((a ovlp b) U [1, 3] (b ovlp c))", "(a ovlp b) U[1, 3] (b ovlp c)"),
        ("(G (a ovlp b))", "G (a ovlp b)"),
        ("(G [0, 5] (a ovlp b))", "G[0, 5] (a ovlp b)"),
        ("(F (a ovlp b) and (b ovlp c))", "F ((a ovlp b) and (b ovlp c))"),
        ("(F [0, 5] (a ovlp b))", "F[0, 5] (a ovlp b)"),
        ("(F(G(X((a ovlp b)))))", "F (G (X (a ovlp b)))"),
    ],
)
def test_every_production_of_the_published_grammar_keeps_its_meaning(published: str, canonical: str) -> None:
    formula = parse_specification(published, profile="spatial_spec").specs[0].formula
    assert format_formula(formula) == canonical


def test_an_object_named_t_is_read_as_an_object() -> None:
    formula = parse_specification("!t ovlp b and (a ovlp b ->t ovlp c)").specs[0].formula
    assert format_formula(formula) == "(not (t ovlp b)) and ((a ovlp b) -> (t ovlp c))"


def test_a_named_number_is_a_constant() -> None:
    specification = parse_specification(
        "use spatial_spec\nconst n = 2\nspec s = (F [0, n] (a dist b[-n] <= n))"
    )
    assert format_formula(specification.specs[0].formula) == "F[0, 2] (a dist b[-2] <= 2)"


def test_recorded_specifications_are_read(data_folder: Path) -> None:
    cases = json.loads((data_folder / "vectors" / "semantics.json").read_text())["cases"]
    recorded = json.loads((data_folder / "paper" / "expected.json").read_text()).values()
    operators: set[str] = set()
    for case in [*cases, *recorded]:
        specification = parse_specification(case["spec"])
        assert parse_specification(format_specification(specification)) == specification
        for spec in specification.specs:
            operators |= {each.operator for each in iter_formulas(spec.formula) if isinstance(each, Temporal)}
    assert operators >= FUTURE_OPERATORS
