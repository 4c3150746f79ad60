"""A report → one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from typing import Final

from spatial_replay.inspection.report.contents import Report
from spatial_replay.inspection.report.packing import json_text
from spatial_replay.inspection.report.page_data import page_data
from spatial_replay.inspection.report.prose import footer, header, panels, text
from spatial_replay.inspection.report.theme import theme
from spatial_replay.markup import element

_STYLES: Final = ("uplot/uPlot.min.css", "browser/page.css", "browser/panels.css")
_LIBRARY: Final = "uplot/uPlot.iife.min.js"
_SCRIPTS: Final = (
    "run", "elements", "clock", "standing", "transport", "verdicts", "tree", "lanes", "blocks", "curves",
    "gradient", "trails", "asked", "caption", "scene", "automaton", "events", "decisions", "page",
)  # fmt: skip
"""Files of browser/, in the order in which they need each other."""


def page(report: Report) -> bytes:
    """The page, in UTF-8; equal reports give equal bytes."""
    data = page_data(report)
    style = "\n".join([theme(), *map(_asset, _STYLES)])
    library, script = _asset(_LIBRARY), _script()
    parts = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_policy([library, script], style)}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        element("title", text(f"{report.log}: {report.verdict}")),
        f"<style>{style}</style></head><body>",
        header(report, data.omissions),
        panels(report),
        footer(report),
        '<div id="transport" class="transport" role="group" aria-label="Time"></div>',
        f'<script type="application/json" id="facts">{json_text(data.facts)}</script>',
        f'<script type="application/octet-stream" id="numbers">{data.numbers}</script>',
        f"<script>{library}</script>",
        f"<script>{script}</script></body></html>\n",
    ]
    return "".join(parts).encode("utf-8")


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _script() -> str:
    """Our scripts as one, whose names nobody else sees."""
    scripts = "\n".join(_asset(f"browser/{name}.js") for name in _SCRIPTS)
    return f'(() => {{\n"use strict";\n{scripts}\n}})();\n'


def _policy(scripts: Sequence[str], style: str) -> str:
    """That the browser loads nothing, and runs nothing but what the page was made with."""
    allowed = " ".join(map(_digest, scripts))
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_digest(style)}; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
