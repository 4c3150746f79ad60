"""The edits between two formulas, each of which can be made without the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

from spatial_replay.compare.declarations import DeclarationChange
from spatial_replay.spec.formula import Boolean, Formula, Span, Temporal, Truth

EditKind: TypeAlias = Literal[
    "constant", "region", "group", "definition", "replaced", "added", "removed", "moved", "renamed"
]
"""What was edited: a number, a shape or group that is named, what a macro or relation means (`def`, profile,
`scale`), the node itself, one operand of a conjunction or disjunction, only its place or its name."""


@dataclass(frozen=True, slots=True)
class Edit:
    """One edit of a formula, wherever it occurs in it.

    Attributes:
        spec: the innermost named spec that it is in.
        old, new: canonical text of the node before and after; None if it was added or removed.
        old_nodes, new_nodes: ids of the nodes in the two trees.
        old_span, new_span: the place of the first of them in the two texts.
        depth: of the deepest of them, from 0 at the root.
        subject: the constant, region, group or macro whose declaration was edited, if it was one.
        change: that declaration in both texts; None if the text of a spec was edited.
    """

    kind: EditKind
    spec: str
    old: str | None
    new: str | None
    old_nodes: tuple[int, ...]
    new_nodes: tuple[int, ...]
    old_span: Span | None
    new_span: Span | None
    depth: int
    subject: str | None = None
    change: DeclarationChange | None = None

    @property
    def is_structural(self) -> bool:
        """Whether operators, objects or operands changed, not only numbers, shapes or names."""
        return self.kind in ("replaced", "added", "removed", "moved")

    def __str__(self) -> str:
        about = f" {self.subject}" if self.subject else ""
        match self.kind:
            case "added":
                return f"added `{self.new}`"
            case "removed":
                return f"removed `{self.old}`"
            case "moved":
                return f"moved `{self.new}`"
            case "renamed":
                return f"renamed {self.old} to {self.new}"
            case "region" | "group" | "definition":
                return f"{self.kind}{about} changed in `{self.old if self.new is None else self.new}`"
        if self.old is None or self.new is None:
            return f"{self.kind}{about}: {f'adds `{self.new}`' if self.new else f'removes `{self.old}`'}"
        return f"{self.kind}{about}: `{self.old}` to `{self.new}`"


class Origin(NamedTuple):
    """The nodes of two trees that follow from one edit of their texts.

    Attributes:
        change: the declaration that was edited; None for the text of the specs themselves.
        old, new: ids of the nodes.
    """

    change: DeclarationChange | None
    old: frozenset[int]
    new: frozenset[int]


@dataclass(frozen=True, slots=True)
class Site:
    """A place where the trees differ; `edit` is its number once sites of one edit are joined."""

    edit: int
    old: Formula | None
    new: Formula | None


@dataclass(frozen=True, slots=True)
class Inner:
    """A node of both trees with operands that differ, or, if `edit` is given, with another window."""

    edit: int | None
    old: Boolean | Temporal
    new: Boolean | Temporal
    operands: tuple[Merged, ...]


Merged: TypeAlias = "Formula | Site | Inner"


@dataclass(frozen=True, eq=False)
class TreeDiff:
    """The edits between two formulas; none if they mean the same under the same names.

    Attributes:
        units: edits that the tree can only show together: one, or declarations that share a node.
    """

    units: tuple[tuple[Edit, ...], ...]
    _merged: Merged = field(repr=False)

    @property
    def edits(self) -> tuple[Edit, ...]:
        """All edits."""
        return tuple(edit for unit in self.units for edit in unit)

    @property
    def effective(self) -> tuple[int, ...]:
        """The numbers of the units that change what the formula means: all but new names."""
        return tuple(number for number, unit in enumerate(self.units) if unit[0].kind != "renamed")

    def formula(self, units: Collection[int]) -> Formula:
        """Return the old formula with only these of the units made, by number."""
        built = _built(self._merged, frozenset(units))
        return Truth(True) if built is None else built


def _built(merged: Merged, chosen: frozenset[int]) -> Formula | None:
    if isinstance(merged, Site):
        return merged.new if merged.edit in chosen else merged.old
    if not isinstance(merged, Inner):
        return merged
    head = merged.new if merged.edit in chosen else merged.old
    operands = tuple(each for operand in merged.operands if (each := _built(operand, chosen)) is not None)
    if head.operator in ("and", "or") and len(operands) < 2:
        return operands[0] if operands else Truth(head.operator == "and")
    return replace(head, operands=operands)


def renumbered(merged: Merged, numbers: Mapping[int, int]) -> Merged:
    """Return merged trees whose edits have other numbers."""
    if isinstance(merged, Site):
        return replace(merged, edit=numbers[merged.edit])
    if not isinstance(merged, Inner):
        return merged
    operands = tuple(renumbered(operand, numbers) for operand in merged.operands)
    edit = None if merged.edit is None else numbers[merged.edit]
    return replace(merged, edit=edit, operands=operands)
