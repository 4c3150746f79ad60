"""The tree of a formula as lines of text, and as rows for machines."""

from __future__ import annotations

from collections.abc import Iterator

from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, iter_nodes, operator_of
from spatial_replay.spec.tree import iter_branches, label_of


def iter_tree_lines(formula: Formula) -> Iterator[str]:
    """One line for each node: its id, branches down to it, its name and what it is."""
    branches = list(iter_branches(formula))
    width = len(str(len(branches) - 1))
    for identifier, stem, node in branches:
        yield f"{identifier:>{width}}  {stem}{label_of(node)}"


def node_rows(formula: Formula) -> list[dict[str, object]]:
    """The nodes as rows of a table: id, parent, operator, name, text."""
    return [
        {
            "id": identifier,
            "parent": parent,
            "operator": operator_of(node),
            "name": node.name,
            "text": format_formula(node),
        }
        for identifier, parent, node in iter_nodes(formula)
    ]
