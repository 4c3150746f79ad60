"""The parser's tables that ship with the grammar read what the grammar says."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.spec import parser

ROOT = Path(__file__).resolve().parents[2]
TEXTS = [
    *(path.read_text(encoding="utf-8") for path in sorted((ROOT / "recordings").glob("*.spatial"))),
    'const near = 70\nspec a(ego) = G[0s, 2.5s] (ego closeto[near] "the cup" -> not P[0, 3] ego in $x)',
    'use spatial_spec\ngroup g = class "x" except a, b\n'
    "spec s = forall x, y in g: (x dist y >= 1) W (a ovlp b)",
    "F (a ovlp",
    "spec = G",
]


def resource(name):
    return files("spatial_replay.spec").joinpath(name).read_text(encoding="utf-8")


@pytest.fixture
def built():
    return parser.built_grammar(resource("grammar.lark"))


def test_they_belong_to_the_grammar_and_the_library():
    text = resource("grammar.lark")
    assert f'"{parser.made_from(text)}"' in resource(parser.TABLES_FILE)


@pytest.mark.parametrize("text", TEXTS)
def test_a_text_means_the_same_with_them_and_without(text, built, monkeypatch):
    with_tables = meaning_of(text)
    monkeypatch.setattr(parser, "grammar", lambda: built)
    assert meaning_of(text) == with_tables


def meaning_of(text):
    try:
        return sr.parse_specification(text)
    except sr.SpecificationError as error:
        return str(error)
