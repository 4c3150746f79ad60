"""Two formulas compared node by node, by meaning: the edits that turn one into the other.

Equal nodes are found wherever they moved to and whatever they are called. What follows from one declaration,
such as a constant, is one edit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple

from spatial_replay.compare.edits import Edit, EditKind, Inner, Merged, Origin, Site, TreeDiff, renumbered
from spatial_replay.compare.shared_names import SharedNames, without_variables
from spatial_replay.spec.format import format_bound, format_formula, format_term
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Group,
    Outline,
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


def compare_trees(
    old: Formula,
    new: Formula,
    name: str,
    regions: Mapping[str, Outline],
    origins: Sequence[Origin] = (),
) -> TreeDiff:
    """Compare two formulas over the same regions (see `unify_regions`).

    Args:
        name: what the formulas are called.
        origins: the edits of the two texts that nodes follow from; without them, each node has its own.
    """
    comparison = _Comparison(regions)
    merged = comparison.align(_Place(old, 0, name, 0), _Place(new, 0, name, 0))
    return comparison.finished(merged, origins)


def changed_nodes(old: Formula, new: Formula, regions: Mapping[str, Outline]) -> frozenset[int]:
    """Return the ids of the nodes of a new formula that differ from an old one, and of those within them."""
    comparison = _Comparison(regions)
    comparison.align(_Place(old, 0, "", 0), _Place(new, 0, "", 0))
    sites = [site for site in comparison.sites if site.kind != "renamed"]
    return frozenset(number for site in sites for number in site.ids[1])


@dataclass(frozen=True, slots=True)
class _Place:
    """A node with its id, the spec that it is in, and its depth."""

    node: Formula
    id: int
    spec: str
    depth: int

    @property
    def operands(self) -> list[_Place]:
        """The nodes below, through specs that only repeat another."""
        found, identifier = [], self.id + 1
        for operand in operands_of(self.node):
            found.append(_Place(operand, identifier, operand.name or self.spec, self.depth + 1))
            identifier += sum(1 for _ in iter_nodes(operand))
        return found

    def members(self, operator: str, *, through_names: bool = False) -> list[_Place]:
        """The operands of a conjunction or disjunction, and in place of those that are one, too, theirs.

        Args:
            through_names: look into specs, too.
        """
        found: list[_Place] = []
        for place in self.operands:
            inner = place.bare if through_names else place
            is_more = operator_of(inner.node) == operator and (through_names or inner.node.name is None)
            found += inner.members(operator, through_names=through_names) if is_more else [place]
        return found

    @property
    def bare(self) -> _Place:
        """The node itself, or what it only repeats under another name."""
        place = self
        while isinstance(place.node, Boolean) and place.node.operator == "spec":
            place = place.operands[0]
        return place


class _Found(NamedTuple):
    """A place where the trees differ, with what was edited there."""

    kind: EditKind
    old: _Place | None
    new: _Place | None
    subject: str | None

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


def _ids(place: _Place | None, is_alone: bool) -> range:
    if place is None:
        return range(0)
    return range(place.id, place.id + (1 if is_alone else sum(1 for _ in iter_nodes(place.node))))


class _Comparison:
    """Aligns two trees; numbers meanings, so that equal ones are found at once."""

    def __init__(self, regions: Mapping[str, Outline]) -> None:
        self._names = SharedNames.of(regions)
        self._numbers: dict[Hashable, int] = {}
        self._known: dict[int, tuple[Formula, int]] = {}
        self.sites: list[_Found] = []

    def meaning(self, node: Formula) -> int:
        """Return a number that nodes of equal meaning share: names and the order of operands do not count."""
        known = self._known.get(id(node))
        if known is None:
            known = self._known[id(node)] = (node, self._meaning(node))
        return known[1]

    def _meaning(self, node: Formula) -> int:
        key: Hashable
        match node:
            case Truth():
                key = node.value
            case Atom():
                key = self._names.expression(node.expression)
            case Quantified():
                group = self._names.term(node.group)
                key = (node.quantifier, len(node.variables), group, self.meaning(without_variables(node)))
            case Boolean(operator="spec"):
                return self.meaning(node.operands[0])
            case Boolean(operator="and" | "or" as operator):
                # brackets around some of the operands mean nothing
                members = _Place(node, 0, "", 0).members(operator, through_names=True)
                key = (operator, tuple(sorted(self.meaning(each.node) for each in members)))
            case Boolean(operator="xor" | "<->"):
                key = (node.operator, tuple(sorted(map(self.meaning, node.operands))))
            case Boolean():
                key = (node.operator, tuple(map(self.meaning, node.operands)))
            case Temporal():
                key = (node.operator, node.bound, tuple(map(self.meaning, node.operands)))
        return self._numbers.setdefault(key, len(self._numbers))

    def align(self, old: _Place, new: _Place) -> Merged:
        """Compare two nodes that stand in for each other."""
        if old.node.name != new.node.name and None not in (old.node.name, new.node.name):
            self.sites.append(_Found("renamed", old, new, None))
        if self.meaning(old.node) == self.meaning(new.node):
            self._align_names(old, new)
            return new.node
        old, new = old.bare, new.bare
        match old.node, new.node:
            case Boolean(operator="and" | "or" as one), Boolean(operator=other) if one == other:
                return self._matched(old.node, old.members(one), new.node, new.members(one))
            case _, Boolean(operator="and" | "or" as one) if self._is_among(old, new.members(one)):
                return self._matched(new.node, [old], new.node, new.members(one))
            case Boolean(operator="and" | "or" as one), _ if self._is_among(new, old.members(one)):
                return self._matched(old.node, old.members(one), old.node, [new])
            case Boolean(), Boolean() if old.node.operator == new.node.operator:
                return Inner(None, old.node, new.node, self._pairwise(old, new))
            case Temporal(), Temporal() if old.node.operator == new.node.operator:
                edit = None
                if old.node.bound != new.node.bound:
                    edit = self._site("constant", old, new).edit
                return Inner(edit, old.node, new.node, self._pairwise(old, new))
        kind, subject = _kind_of(old.node, new.node)
        return self._site(kind, old, new, subject)

    def finished(self, merged: Merged, origins: Sequence[Origin]) -> TreeDiff:
        """Join the sites of one edit, wherever they occur, and return the edits."""
        declared = [origin for origin in origins if origin.change is not None]
        shared: list[tuple[set[int], list[int]]] = []
        rest: list[int] = []
        for number, site in enumerate(self.sites):
            own = {index for index, origin in enumerate(declared) if site.follows_from(origin)}
            if not own:
                rest.append(number)
                continue
            # declarations that share a node are edited together
            joined = [each for each in shared if each[0] & own]
            shared = [each for each in shared if not each[0] & own]
            shared.append(
                (own.union(*(each[0] for each in joined)), [*chain(*(each[1] for each in joined)), number])
            )
        units = [(min(sites), sites, sorted(own)) for own, sites in shared]
        units += [(min(sites), sites, []) for sites in self._joined(rest)]
        units.sort()
        numbers = {site: unit for unit, (_, sites, _) in enumerate(units) for site in sites}
        text = [origin for origin in origins if origin.change is None]
        return TreeDiff(
            tuple(
                tuple(self._unit(sites, [declared[index] for index in own], text)) for _, sites, own in units
            ),
            renumbered(merged, numbers),
        )

    def _joined(self, sites: Sequence[int]) -> Iterable[list[int]]:
        """Join sites that follow from the text of the specs, by the places there."""
        removed, added = (
            {self.meaning(place.node) for site in sites for place in self._only(site, kind)}
            for kind in ("removed", "added")
        )
        joined: dict[Hashable, list[int]] = {}
        for number in sites:
            kind, old, new, _ = self.sites[number]
            meanings = [None if place is None else self.meaning(place.node) for place in (old, new)]
            found = {each for each in meanings if each is not None}
            spans = tuple(None if place is None else place.node.span for place in (old, new))
            key: Hashable = ("place", kind == "renamed", *spans)
            if kind in ("added", "removed") and found <= removed & added:
                key = ("moved", *found)
            elif Span(0, 0) in spans:
                spec = (new or old or _NOWHERE).spec
                key = (kind, spec, *(_text(place, kind) for place in (old, new)), *meanings)
            joined.setdefault(key, []).append(number)
        return joined.values()

    def _only(self, site: int, kind: EditKind) -> Iterator[_Place]:
        """Yield the node of a site of a kind, added or removed."""
        found = self.sites[site]
        yield from (place for place in (found.old, found.new) if place is not None and found.kind == kind)

    def _unit(
        self, sites: Sequence[int], declared: Sequence[Origin], text: Sequence[Origin]
    ) -> Iterator[Edit]:
        """Yield the edits that sites follow from together: of each declaration, and of the specs' text."""
        for origin in declared:
            if origin.change is not None:
                edit = self._edit([site for site in sites if self.sites[site].follows_from(origin)])
                yield replace(edit, kind=origin.change.kind, subject=origin.change.name, change=origin.change)
        own = [site for site in sites if any(self.sites[site].follows_from(origin) for origin in text)]
        if own or not declared:
            yield self._edit(own if declared else sites)

    def _edit(self, sites: Sequence[int]) -> Edit:
        found = [self.sites[site] for site in sites]
        olds = [old for _, old, _, _ in found if old is not None]
        news = [new for _, _, new, _ in found if new is not None]
        kinds = {kind for kind, *_ in found}
        kind: EditKind = "moved" if kinds == {"added", "removed"} else found[0][0]
        first = (news or olds)[0]
        return Edit(
            kind,
            first.spec,
            _text(olds[0], kind) if olds else None,
            _text(news[0], kind) if news else None,
            tuple(place.id for place in olds),
            tuple(place.id for place in news),
            olds[0].node.span if olds else None,
            news[0].node.span if news else None,
            max(place.depth for place in (*olds, *news)),
            found[0][3],
        )

    def _site(
        self, kind: EditKind, old: _Place | None, new: _Place | None, subject: str | None = None
    ) -> Site:
        self.sites.append(_Found(kind, old, new, subject))
        return Site(len(self.sites) - 1, None if old is None else old.node, None if new is None else new.node)

    def _align_names(self, old: _Place, new: _Place) -> None:
        """Note the nodes within equal ones that have other names."""
        for one, other in zip(old.operands, new.operands, strict=False):
            if self.meaning(one.node) == self.meaning(other.node):
                if one.node.name != other.node.name and None not in (one.node.name, other.node.name):
                    self.sites.append(_Found("renamed", one, other, None))
                self._align_names(one, other)

    def _pairwise(self, old: _Place, new: _Place) -> tuple[Merged, ...]:
        return tuple([self.align(*pair) for pair in zip(old.operands, new.operands, strict=True)])

    def _is_among(self, place: _Place, operands: Sequence[_Place]) -> bool:
        return any(self.meaning(place.node) == self.meaning(each.node) for each in operands)

    def _matched(self, old_node: Any, olds: Sequence[_Place], new_node: Any, news: Sequence[_Place]) -> Inner:
        """Match the operands of a conjunction or disjunction: equal ones, those of one name, similar ones."""
        partner: dict[int, int] = {}
        taken: set[int] = set()

        def match(fits: Any) -> None:
            for number, new in enumerate(news):
                for index, old in enumerate(olds if number not in partner else ()):
                    if index not in taken and fits(old, new):
                        partner[number] = index
                        taken.add(index)
                        break

        match(lambda old, new: self.meaning(old.node) == self.meaning(new.node))
        match(lambda old, new: old.node.name is not None and old.node.name == new.node.name)
        for least in (1.0, 0.5, 0.01):
            match(lambda old, new, least=least: _similarity(old.bare.node, new.bare.node) >= least)
        operands: list[Merged] = [
            self.align(olds[partner[number]], new) if number in partner else self._site("added", None, new)
            for number, new in enumerate(news)
        ]
        operands += [self._site("removed", old, None) for index, old in enumerate(olds) if index not in taken]
        return Inner(None, old_node, new_node, tuple(operands))


_NOWHERE = _Place(Truth(True), 0, "", 0)


def _kind_of(old: Formula, new: Formula) -> tuple[EditKind, str | None]:
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
    if isinstance(old, Quantified) and isinstance(new, Quantified):
        if format_formula(old) == format_formula(new):
            return "definition", None
        if (old.quantifier, old.variables, old.group) == (new.quantifier, new.variables, new.group):
            kind, subject = _kind_of(old.body, new.body)
            return ("replaced", None) if kind in ("added", "removed") else (kind, subject)
    return "replaced", None


def _without_numbers(atom: Atom) -> Hashable:
    texts = tuple(each for each in atom.parameters if isinstance(each, str))
    # the number of a signal's comparison is a text too: NAME, comparison, number
    texts = texts[:2] if atom.relation == "signal" else texts
    return texts, len(atom.parameters), tuple(_without_radius(term) for term in atom.terms)


def _without_radius(term: Term) -> Hashable:
    base = base_of(term)
    return type(term).__name__, format_term(base)


def _similarity(old: Formula, new: Formula) -> float:
    """Return how much of what two nodes are about is the same, 0 to 1; 0 for different operators."""
    if operator_of(old) != operator_of(new):
        return 0.0
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


def _text(place: _Place | None, kind: EditKind) -> str | None:
    if place is None:
        return None
    if kind == "renamed":
        return place.node.name
    if kind == "constant" and isinstance(place.node, Temporal):
        # the operands stay or have edits of their own
        return f"{place.node.operator}{format_bound(place.node.bound)} …"
    return format_formula(place.node)
