"""Every relation, in both profiles, is the number the reference says."""

from __future__ import annotations

import inspect
import re
from math import inf
from typing import Any

import pytest

from spatial_replay import parse_specification
from spatial_replay.spec.formula import (
    Atom,
    CentroidProjection,
    Enlarged,
    Equality,
    Expression,
    Maximum,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Projection,
    Protrusion,
    Signal,
    SignedDistance,
    Sum,
    Term,
)
from spatial_replay.spec.relations import PROFILES

SD_AB, SD_AC, STICKS_OUT = 3.0, 5.0, -2.0
X = {"a": (0.0, 4.0), "b": (5.0, 9.0), "c": (11.0, 12.0)}
CENTROIDS = {"a": (1.0, 2.0), "b": (6.0, 8.0), "c": (11.0, 11.5)}


def value(expression: Expression) -> float:
    """Evaluates an expression in a world where every measurement is known."""
    match expression:
        case Number():
            return expression.value
        case SignedDistance():
            return SD_AC if name_of(expression.second) == "c" else SD_AB
        case Protrusion(outer=Enlarged(radius=radius)):
            return STICKS_OUT - radius
        case Protrusion():
            return STICKS_OUT
        case Projection():
            return along(X, expression)
        case CentroidProjection():
            return along(CENTROIDS, expression)
        case Misalignment():
            return 0.25
        case Signal():
            return 20.0
        case Equality():
            return inf if value(expression.signal) == expression.value else -inf
        case Sum():
            return value(expression.first) + value(expression.second)
        case Negative():
            return -value(expression.operand)
        case Minimum():
            return min(map(value, expression.operands))
        case Maximum():
            return max(map(value, expression.operands))


def name_of(term: Term) -> str:
    return name_of(term.term) if isinstance(term, Enlarged) else getattr(term, "name", "")


def along(extents: dict[str, tuple[float, float]], projection: Projection | CentroidProjection) -> float:
    low, high = extents[name_of(projection.term)]
    factor = {"x": 1.0, "y": 10.0, "z": 100.0}[projection.axis]
    return factor * (low if projection.side == "min" else high)


PAPER = {
    "a dist b <= 7": 4.0,
    "a dist b < 7": 4.0,
    "a dist b >= 7": -4.0,
    "a dist b > 7": -4.0,
    "a dist b == 7": -4.0,
    "2 <= a dist b <= 7": 1.0,
    "2 < a dist b < 4.5": 1.0,
    "a closeto[5] b": 2.0,
    "a farfrom[5] b": -2.0,
    "a ovlp b": -3.0,
    "a touch[4] b": 1.0,
    "a touch[-4] b": -7.0,
    "a enclosedin b": 2.0,
    "a partovlp b": -3.0,
    "a closer b than c": 2.0,
    "a prec[x] b": 1.0,
    "a prec[y] b": 10.0,
    "a prec[z] b": 100.0,
    "a partprec[x] b": 5.0,
    "a leftof b": 1.0,
    "a below b": 10.0,
    "a rightof b": -1.0,
    "a above b": -10.0,
    "a partleftof b": 5.0,
    "a partbelow b": 50.0,
    "a partrightof b": -5.0,
    "a partabove b": -50.0,
    "b between[x] (a, c)": 1.0,
    "c between[x] (b, a)": -12.0,
    "a oriented[1] b": 0.75,
    "a moved[1.5] b": -3.5,
    "temperature >= 3.5": 16.5,
    "temperature > 3.5": 16.5,
    "temperature <= 3.5": -16.5,
    "temperature < 3.5": -16.5,
    "temperature == 21": -inf,
    "temperature == 20": inf,
    "temperature != 21": inf,
}
CHANGED_IN_PUBLISHED = {
    "a touch[4] b": 1.0,
    "a touch[-4] b": -7.0,
    "a leftof b": 4.0,
    "a below b": 40.0,
    "a rightof b": -7.0,
    "b rightof a": 4.0,
    "a above b": -70.0,
    "a closeto b": 67.0,
    "a farfrom b": -147.0,
    "a touch b": 2.0,
    "a moved b": -27.0,
}


def robustness(text: str, profile: str) -> float:
    formula = parse_specification(text, profile=profile).specs[0].formula
    assert isinstance(formula, Atom)
    return value(formula.expression)


@pytest.mark.parametrize(("text", "expected"), PAPER.items())
def test_a_relation_of_the_paper_profile_has_the_defined_value(text: str, expected: float) -> None:
    assert robustness(text, "paper") == expected


@pytest.mark.parametrize(("text", "expected"), (PAPER | CHANGED_IN_PUBLISHED).items())
def test_a_relation_of_the_published_profile_has_the_defined_value(text: str, expected: float) -> None:
    assert robustness(text, "spatial_spec") == expected


def test_touch_in_the_published_profile_does_not_look_at_depth() -> None:
    paper, published = (
        parse_specification("a touch[4] b", profile=profile).specs[0].formula
        for profile in ("paper", "spatial_spec")
    )
    assert isinstance(paper, Atom) and isinstance(published, Atom)
    assert isinstance(paper.expression, Minimum)
    assert published.expression == Number(4.0) - SignedDistance(*published.terms)  # type: ignore[arg-type]


@pytest.mark.parametrize("profile", PROFILES)
def test_the_docstring_of_a_relation_gives_its_syntax_and_value(profile: str) -> None:
    for name, relation in PROFILES[profile].items():
        written, _, number = (inspect.getdoc(relation) or "").partition(": ")
        assert re.fullmatch(rf"`a {name}(\[\w+\])? .*`", written), name
        assert number, name


def test_relations_are_added_by_argument_and_not_by_changing_a_profile() -> None:
    profiles: Any = PROFILES
    for profile in profiles.values():
        with pytest.raises(TypeError):
            profile["near"] = profile["closeto"]
