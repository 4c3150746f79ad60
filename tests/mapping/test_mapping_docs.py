"""The documentation of mapping files is complete, and its examples are valid."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path

import pytest

from spatial_replay.mapping.assumptions import ASSUMPTIONS
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.message_types import BUILT_IN

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/mapping.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("text", EXAMPLES)
def test_every_example_is_a_valid_mapping(text: str) -> None:
    mapping = parse_mapping(text)
    assert mapping.topics or mapping.features


def test_every_key_is_documented() -> None:
    schema = json.loads(files("spatial_replay.mapping").joinpath("mapping.schema.json").read_text())
    keys = [
        *schema["properties"],
        *schema["$defs"]["topic"]["properties"],
        *schema["$defs"]["feature"]["properties"],
        *schema["$defs"]["shape"]["properties"],
    ]
    assert [key for key in keys if not re.search(rf"`{{?{key}[`:]", PAGE)] == []


def test_every_built_in_type_is_documented() -> None:
    names = [name.rpartition("/")[2] for name in BUILT_IN]
    assert [name for name in names if not re.search(rf"\b{name}`", PAGE)] == []


def test_the_page_lists_every_assumption_as_it_is_measured() -> None:
    rows = [
        f"| `{assumption.name}`{', remarked' if assumption.is_remark else ''} | {assumption.assumed}"
        f" | {assumption.measured} | {assumption.remedy} |"
        for assumption in ASSUMPTIONS
    ]
    page = PAGE.split("### Assumptions\n")[1]
    assert [line for line in page.splitlines() if line.startswith("| `")] == rows
