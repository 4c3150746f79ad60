"""The examples of the language reference are specifications, and its tables are complete."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from spatial_replay import parse_specification
from spatial_replay.spec.load import MAX_LENGTH
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.resolve import MAX_SIZE
from spatial_replay.spec.tokens import KEYWORDS, MAX_TOKENS

REFERENCE = (Path(__file__).parents[2] / "docs" / "language.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```spatial\n(.*?)```", REFERENCE, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_of_the_reference_are_read_without_unintended_warnings(example: str) -> None:
    warnings = [str(warning) for warning in parse_specification(example).warnings]
    assert all("reaches over" in warning for warning in warnings), warnings


def test_the_reference_mentions_every_keyword_and_relation() -> None:
    assert len(EXAMPLES) >= 4
    words = set(re.findall(r"[A-Za-z_]+", REFERENCE))
    assert words >= KEYWORDS.keys() | RELATION_NAMES


def test_the_reference_gives_the_limits_of_the_code() -> None:
    for limit in (MAX_LENGTH, MAX_TOKENS, MAX_SIZE):
        assert f"{limit:,}" in REFERENCE
