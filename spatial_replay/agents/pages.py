"""Pages for agents. A page consists of sections of the documentation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Final

from spatial_replay.errors import UsageError

PAGES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "language": "The specification language: statements, objects, relations, operators, quantifiers.",
        "cookbook": "Specifications for common sentences: order, keep out, hold, respond, visit twice.",
        "relations": "Each relation in a line, with a picture at spatial://relations/NAME.",
        "mapping": "Mapping files: which topics of a bag or an external log are objects.",
        "errors": "Mistakes in specifications, as they look, and how to write what was meant.",
    }
)
"""Descriptions by the names of pages."""

_SECTIONS: Final[Mapping[str, Sequence[tuple[str, Sequence[str]]]]] = MappingProxyType(
    {
        "language": (
            (
                "language",
                (
                    "A first file",
                    "Statements",
                    "Objects",
                    "Relations",
                    "Operators",
                    "Quantifiers and templates",
                ),
            ),
        ),
        "cookbook": (("cookbook", ()),),
        "relations": (("relations", ()),),
        "mapping": (("mapping", ("The whole file", "A topic", "A suggested mapping")),),
        "errors": (("agents", ("Mistakes, as they look",)), ("language", ("Errors and limits",))),
    }
)
"""Documentation pages and their sections, by page for agents. No sections mean the whole page."""

_HEADING: Final = re.compile(r"^(#{2,}) (.+)$")


def page_text(name: str) -> str:
    """Return a page as Markdown."""
    parts = [_sections(_document(f"{source}.md"), headings) for source, headings in _SECTIONS[name]]
    return "\n".join(parts)


def relation_picture(name: str) -> str:
    """Return the picture of a relation, as SVG."""
    if not re.fullmatch(r"[a-z]+", name):
        raise UsageError(f"no relation {name!r:.40}; spatial://relations names them")
    return _document(f"relations/{name}.svg")


def _document(path: str) -> str:
    """Return the text of a documentation file. In wheels, the file is inside the package."""
    packaged_file = resources.files(__package__).joinpath("docs", path)
    source_file = Path(__file__).parents[2] / "docs" / path
    try:
        return packaged_file.read_text("utf-8") if packaged_file.is_file() else source_file.read_text("utf-8")
    except FileNotFoundError:
        raise UsageError(f"no page {path!r:.80}; spatial://relations names the relations") from None


def _sections(text: str, headings: Sequence[str]) -> str:
    """Return the sections with these headings, without subsections; without headings, the whole page."""
    if not headings:
        return text
    lines: list[str] = []
    is_requested = is_in_code = False
    for line in text.splitlines():
        # a comment in code looks like a heading
        is_in_code ^= line.startswith("```")
        if not is_in_code and (match := _HEADING.match(line)):
            is_requested = match[2] in headings
        if is_requested:
            lines.append(line)
    return "\n".join(lines) + "\n"
