"""The edits between two formulas, each of which can be made without the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

from spatial_replay.compare.declarations import DeclarationChange
from spatial_replay.spec.format import format_formula, format_term
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Group,
    Quantified,
    RegionName,
    Span,
    Temporal,
    Term,
    Truth,
    iter_nodes,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import base_of, iter_terms

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
        old_specs, new_specs: the specs whose text may have been edited, the innermost first, by their names
            in both texts; of what was moved, where it was and where it is.
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
    old_specs: tuple[tuple[str, str], ...] = ()
    new_specs: tuple[tuple[str, str], ...] = ()

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
class Place:
    """A node with its id, the names of the specs that it is in, the innermost first, and its depth."""

    node: Formula
    id: int
    specs: tuple[str, ...]
    depth: int

    @property
    def around(self) -> tuple[str, ...]:
        """The specs whose text has the node: not the one that it is itself, by name."""
        return self.specs if self.node.name is None else self.specs[1:] or self.specs

    @property
    def operands(self) -> list[Place]:
        """The nodes below, through specs that only repeat another."""
        found, identifier = [], self.id + 1
        for operand in operands_of(self.node):
            specs = self.specs if operand.name is None else (operand.name, *self.specs)
            found.append(Place(operand, identifier, specs, self.depth + 1))
            identifier += sum(1 for _ in iter_nodes(operand))
        return found

    def members(self, operator: str, *, through_names: bool = False) -> list[Place]:
        """The operands of a conjunction or disjunction, and in place of those that are one, too, theirs.

        Args:
            through_names: look into specs, too.
        """
        found: list[Place] = []
        for place in self.operands:
            inner = place.bare if through_names else place
            is_more = operator_of(inner.node) == operator and (through_names or inner.node.name is None)
            found += inner.members(operator, through_names=through_names) if is_more else [place]
        return found

    @property
    def bare(self) -> Place:
        """The node itself, or what it only repeats under another name."""
        place = self
        while isinstance(place.node, Boolean) and place.node.operator == "spec":
            place = place.operands[0]
        return place


class FoundSite(NamedTuple):
    """A place where the trees differ, with what was edited there; `parts` are those within a quantifier."""

    kind: EditKind
    old: Place | None
    new: Place | None
    subject: str | None = None
    parts: tuple[FoundSite, ...] = ()

    @property
    def ids(self) -> tuple[range, range]:
        """The ids of the nodes that differ; of those with another window or name, only their own."""
        old, new = (_ids(place, self._is_alone) for place in (self.old, self.new))
        return old, new

    @property
    def _is_alone(self) -> bool:
        is_window = self.kind == "constant" and self.new is not None and isinstance(self.new.node, Temporal)
        return self.kind == "renamed" or is_window

    def follows_from(self, origin: Origin) -> bool:
        """Say whether an edit of the texts changed it."""
        return self.kind != "renamed" and not (
            origin.old.isdisjoint(self.ids[0]) and origin.new.isdisjoint(self.ids[1])
        )

    def only(self, kind: EditKind) -> Iterator[Place]:
        """Yield the node if that is the kind, added or removed."""
        yield from (place for place in (self.old, self.new) if place is not None and self.kind == kind)


def _ids(place: Place | None, is_alone: bool) -> range:
    if place is None:
        return range(0)
    return range(place.id, place.id + (1 if is_alone else sum(1 for _ in iter_nodes(place.node))))


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


def kind_of(old: Formula, new: Formula) -> tuple[EditKind, str | None]:
    """Return what of a node was edited, and the region or group if that is it."""
    if isinstance(old, Atom) and isinstance(new, Atom) and old.relation == new.relation:
        if old.text == new.text:
            for one, other in zip(iter_terms([old]), iter_terms([new]), strict=False):
                if one != other and isinstance(base_of(other), RegionName):
                    return "region", format_term(base_of(other))
                if one != other and isinstance(base_of(other), Group):
                    return "group", format_term(base_of(other))
            return "definition", None
        if _without_numbers(old) == _without_numbers(new):
            return "constant", None
    if isinstance(old, Quantified) and format_formula(old) == format_formula(new):
        return "definition", None
    return "replaced", None


def _without_numbers(atom: Atom) -> Hashable:
    texts = tuple(each for each in atom.parameters if isinstance(each, str))
    # the number of a signal's comparison is a text too: NAME, comparison, number
    texts = texts[:2] if atom.relation == "signal" else texts
    return texts, len(atom.parameters), tuple(_without_radius(term) for term in atom.terms)


def _without_radius(term: Term) -> Hashable:
    base = base_of(term)
    return type(term).__name__, format_term(base)


def similarity(old: Formula, new: Formula) -> float:
    """Return how much of what two nodes are about is the same, 0 to 1."""
    one, other = _subjects(old), _subjects(new)
    return (one & other).total() / max((one | other).total(), 1)


def _subjects(formula: Formula) -> Counter[str]:
    found = Counter(format_term(base_of(term)) for term in iter_terms([formula]))
    found.update(
        str(node.parameters[0])
        for _, _, node in iter_nodes(formula)
        if isinstance(node, Atom) and not node.terms
    )
    return found
