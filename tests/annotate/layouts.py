"""Layouts of viewers, as they are kept in logs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader


def layout_of(log: Path) -> dict[str, Any]:
    """The layout in a log."""
    with log.open("rb") as stream:
        [text] = [each.data for each in make_reader(stream).iter_attachments() if each.name == "layout.json"]
    layout: dict[str, Any] = json.loads(text)
    return layout


def panels(layout: dict[str, Any], tree: Any = None) -> set[str]:
    """The identifiers of the panels that a layout places, in splits and in tabs."""
    tree = layout["layout"] if tree is None else tree
    if isinstance(tree, dict):
        return panels(layout, tree["first"]) | panels(layout, tree["second"])
    tabs = layout["configById"][tree].get("tabs", [])
    return {tree}.union(*(panels(layout, tab["layout"]) for tab in tabs))


def paths_of(config: Any) -> Iterator[str]:
    """Every message path, and every topic, in a layout."""
    if isinstance(config, str):
        if config.startswith("/"):
            yield config
    elif isinstance(config, dict):
        for key, value in config.items():
            yield from paths_of(key)
            yield from paths_of(value)
    elif isinstance(config, list):
        for value in config:
            yield from paths_of(value)
