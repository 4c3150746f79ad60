"""The tree of a formula as lines of text, and as rows for machines."""

from __future__ import annotations

from collections.abc import Iterator

from spatial_replay.spec.format import format_bound, format_formula
from spatial_replay.spec.formula import Atom, Formula, Quantified, Temporal, Truth, iter_nodes, operator_of


def iter_tree_lines(formula: Formula) -> Iterator[str]:
    """One line for each node: its id, branches down to it, its name and what it is."""
    nodes = list(iter_nodes(formula))
    last_child = {parent: identifier for identifier, parent, _ in nodes}
    width = len(str(len(nodes) - 1))
    below: dict[int | None, str] = {}
    for identifier, parent, node in nodes:
        is_last = last_child[parent] == identifier
        stem = below.get(parent, "")
        branch = "" if parent is None else "└─ " if is_last else "├─ "
        below[identifier] = stem + ("" if parent is None else "   " if is_last else "│  ")
        yield f"{identifier:>{width}}  {stem}{branch}{label_of(node)}"


def label_of(node: Formula) -> str:
    """What a node is, without what stands below it: "reach = F[0, 10]", "a ovlp b"."""
    match node:
        case Atom() | Quantified() | Truth():
            text = format_formula(node)
        case Temporal(operator, _, bound) if bound is not None:
            text = f"{operator}{format_bound(bound)}"
        case _:
            text = operator_of(node)
    return text if node.name is None else f"{node.name} = {text}"


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
