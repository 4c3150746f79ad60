"""The tree of a formula, as it is shown: line by line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from spatial_replay.spec.format import format_bound, format_formula
from spatial_replay.spec.formula import Atom, Formula, Quantified, Temporal, Truth, operands_of, operator_of


class Branch(NamedTuple):
    """A node of a tree.

    Attributes:
        id: its number, from the root, 0, in the order of the text.
        stem: what leads to it from the nodes above: "│  ├─ ".
    """

    id: int
    stem: str
    node: Formula


def iter_branches(formula: Formula) -> Iterator[Branch]:
    """Every node, from the root, in the order of the text."""
    stack = [("", "", formula)]
    identifier = 0
    while stack:
        above, branch, node = stack.pop()
        yield Branch(identifier, above + branch, node)
        identifier += 1
        below = above + {"": "", "├─ ": "│  ", "└─ ": "   "}[branch]
        last = "└─ "
        for operand in reversed(operands_of(node)):
            stack.append((below, last, operand))
            last = "├─ "


def title_of(node: Formula) -> str:
    """What a node is, without its name and what stands below it: "F[0, 10]", "a ovlp b"."""
    match node:
        case Atom() | Quantified() | Truth():
            return format_formula(node)
        case Temporal(operator, _, bound) if bound is not None:
            return f"{operator}{format_bound(bound)}"
        case _:
            return operator_of(node)


def label_of(node: Formula) -> str:
    """The same with its name: "reach = F[0, 10]"."""
    return title_of(node) if node.name is None else f"{node.name} = {title_of(node)}"
