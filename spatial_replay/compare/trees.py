"""Two formulas compared node by node, by meaning: the edits that turn one into the other.

Equal nodes are found wherever they moved to and whatever they are called. What follows from one declaration,
such as a constant, is one edit.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from spatial_replay.compare.edits import (
    Edit,
    EditKind,
    FoundSite,
    Inner,
    Merged,
    Origin,
    Place,
    Site,
    TreeDiff,
    kind_of,
    renumbered,
    similarity,
)
from spatial_replay.compare.shared_names import SharedNames, without_variables
from spatial_replay.spec.format import format_bound, format_formula
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Outline,
    Quantified,
    Span,
    Temporal,
    Truth,
    operator_of,
)


def compare_trees(
    old: Formula,
    new: Formula,
    name: str,
    regions: Mapping[str, Outline],
    origins: Sequence[Origin] = (),
    specs: tuple[Collection[str], Collection[str]] = ((), ()),
) -> TreeDiff:
    """Compare two formulas over the same regions (see `unify_regions`).

    Args:
        name: what the formulas are called.
        origins: the edits of the two texts that nodes follow from; without them, each node has its own.
        specs: the names of all specs of the two texts.
    """
    comparison = _Comparison(regions, specs)
    merged = comparison.align(Place(old, 0, (name,), 0), Place(new, 0, (name,), 0))
    return comparison.finished(merged, origins)


def changed_nodes(old: Formula, new: Formula, regions: Mapping[str, Outline]) -> frozenset[int]:
    """Return the ids of the nodes of a new formula that differ from an old one, and of those within them."""
    comparison = _Comparison(regions)
    comparison.align(Place(old, 0, ("",), 0), Place(new, 0, ("",), 0))
    sites = [site for site in comparison.sites if site.kind != "renamed"]
    return frozenset(number for site in sites for number in site.ids[1])


class _Comparison:
    """Aligns two trees; numbers meanings, so that equal ones are found at once."""

    def __init__(
        self, regions: Mapping[str, Outline], specs: tuple[Collection[str], Collection[str]] = ((), ())
    ) -> None:
        self._names = SharedNames.of(regions)
        self._specs = specs
        self._renamed: set[tuple[str | None, str | None]] = set()
        self._numbers: dict[Hashable, int] = {}
        self._known: dict[int, tuple[Formula, int]] = {}
        self.sites: list[FoundSite] = []

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
                members = Place(node, 0, ("",), 0).members(operator, through_names=True)
                key = (operator, tuple(sorted(self.meaning(each.node) for each in members)))
            case Boolean(operator="xor" | "<->"):
                key = (node.operator, tuple(sorted(map(self.meaning, node.operands))))
            case Boolean():
                key = (node.operator, tuple(map(self.meaning, node.operands)))
            case Temporal():
                key = (node.operator, node.bound, tuple(map(self.meaning, node.operands)))
        return self._numbers.setdefault(key, len(self._numbers))

    def align(self, old: Place, new: Place) -> Merged:
        """Compare two nodes that stand in for each other."""
        names = old.node.name, new.node.name
        is_renamed = names[0] != names[1] and None not in names
        is_equal = self.meaning(old.node) == self.meaning(new.node)
        if is_renamed and not is_equal and (names[0] in self._specs[1] or names[1] in self._specs[0]):
            # another spec stands there, and neither was edited
            return self._site(FoundSite("replaced", old, new))
        if is_renamed:
            self._renamed.add(names)
            self.sites.append(FoundSite("renamed", old, new))
        if is_equal:
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
                    edit = self._site(FoundSite("constant", old, new)).edit
                return Inner(edit, old.node, new.node, self._pairwise(old, new))
            case Quantified(), Quantified() if _ranges_alike(old.node, new.node):
                kind, subject = kind_of(old.node, new.node)
                return self._site(FoundSite(kind, old, new, subject, self._parts(old, new)))
        kind, subject = kind_of(old.node, new.node)
        return self._site(FoundSite(kind, old, new, subject))

    def _parts(self, old: Place, new: Place) -> tuple[FoundSite, ...]:
        """Return where the bodies of two quantifiers differ, which are evaluated as one."""
        count = len(self.sites)
        bodies = [
            Place(place.node.body, place.id, place.specs, place.depth + 1)
            for place in (old, new)
            if isinstance(place.node, Quantified)
        ]
        self.align(bodies[0], bodies[1])
        inner, self.sites = self.sites[count:], self.sites[:count]

        def inside(place: Place | None, whole: Place) -> Place | None:
            return None if place is None else replace(place, id=whole.id)

        parts = chain(*(each.parts or (each,) for each in inner))
        return tuple(each._replace(old=inside(each.old, old), new=inside(each.new, new)) for each in parts)

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
        joined_rest = self._joined([self.sites[number] for number in rest])
        units += [(rest[sites[0]], [rest[number] for number in sites], []) for sites in joined_rest]
        units.sort()
        numbers = {site: unit for unit, (_, sites, _) in enumerate(units) for site in sites}
        text = [origin for origin in origins if origin.change is None]
        return TreeDiff(
            tuple(
                tuple(self._unit(sites, [declared[index] for index in own], text)) for _, sites, own in units
            ),
            renumbered(merged, numbers),
        )

    def _joined(self, found: Sequence[FoundSite]) -> Iterable[list[int]]:
        """Join places that follow from one edit of the text of the specs, by number."""
        removed, added = (
            {self.meaning(place.node) for each in found for place in each.only(kind)}
            for kind in ("removed", "added")
        )
        joined: dict[Hashable, list[int]] = {}
        for number, each in enumerate(found):
            places = each.old, each.new
            meanings = [None if place is None else self.meaning(place.node) for place in places]
            known = {meaning for meaning in meanings if meaning is not None}
            spans = tuple(None if place is None else place.node.span for place in places)
            specs = self._specs_of(each.old, each.new)[:1]
            key: Hashable = ("place", each.kind == "renamed", specs, *spans)
            if each.kind in ("added", "removed") and known <= removed & added:
                key = ("moved", *known)
            elif Span(0, 0) in spans:
                key = (each.kind, specs, *(_text(place, each.kind) for place in places), *meanings)
            joined.setdefault(key, []).append(number)
        return joined.values()

    def _specs_of(self, old: Place | None, new: Place | None) -> tuple[tuple[str, str], ...]:
        """Return the specs that have the two places in their text, innermost first, by both names."""
        if old is None or new is None:
            return tuple((name, name) for place in (old, new) if place is not None for name in place.around)
        pairs = [(one, other) for other in new.specs for one in old.specs]
        return tuple(pair for pair in pairs if pair[0] == pair[1] or pair in self._renamed)

    def _unit(
        self, sites: Sequence[int], declared: Sequence[Origin], text: Sequence[Origin]
    ) -> Iterator[Edit]:
        """Yield the edits that sites follow from together: of each declaration, and of the specs' text."""
        found = [self.sites[site] for site in sites]
        for origin in declared:
            if origin.change is not None:
                edit = self._edit([each for each in found if each.follows_from(origin)])
                yield replace(edit, kind=origin.change.kind, subject=origin.change.name, change=origin.change)
        if declared:
            own = [each for each in found if any(each.follows_from(origin) for origin in text)]
        else:
            own = list(chain(*(each.parts or (each,) for each in found)))
        for numbers in self._joined(own):
            yield self._edit([own[number] for number in numbers])

    def _edit(self, found: Sequence[FoundSite]) -> Edit:
        olds = [each.old for each in found if each.old is not None]
        news = [each.new for each in found if each.new is not None]
        kinds = {each.kind for each in found}
        kind: EditKind = "moved" if kinds == {"added", "removed"} else found[0].kind
        first_old, first_new = next(iter(olds), None), next(iter(news), None)
        if kind == "moved":
            specs = self._specs_of(first_old, None), self._specs_of(None, first_new)
        else:
            specs = (self._specs_of(first_old, first_new),) * 2
        return Edit(
            kind,
            specs[1][0][1],
            _text(first_old, kind),
            _text(first_new, kind),
            tuple(dict.fromkeys(place.id for place in olds)),
            tuple(dict.fromkeys(place.id for place in news)),
            None if first_old is None else first_old.node.span,
            None if first_new is None else first_new.node.span,
            max(place.depth for place in (*olds, *news)),
            found[0].subject,
            old_specs=specs[0],
            new_specs=specs[1],
        )

    def _site(self, found: FoundSite) -> Site:
        self.sites.append(found)
        old, new = (None if place is None else place.node for place in (found.old, found.new))
        return Site(len(self.sites) - 1, old, new)

    def _align_names(self, old: Place, new: Place) -> None:
        """Note the nodes within equal ones that have other names."""
        for one, other in zip(old.operands, new.operands, strict=False):
            if self.meaning(one.node) == self.meaning(other.node):
                if one.node.name != other.node.name and None not in (one.node.name, other.node.name):
                    self.sites.append(FoundSite("renamed", one, other))
                self._align_names(one, other)

    def _pairwise(self, old: Place, new: Place) -> tuple[Merged, ...]:
        return tuple([self.align(*pair) for pair in zip(old.operands, new.operands, strict=True)])

    def _is_among(self, place: Place, operands: Sequence[Place]) -> bool:
        return any(self.meaning(place.node) == self.meaning(each.node) for each in operands)

    def _matched(self, old_node: Any, olds: Sequence[Place], new_node: Any, news: Sequence[Place]) -> Inner:
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
            match(lambda old, new, least=least: _is_alike(old, new, least, by_operator=True))
        match(lambda old, new: _is_alike(old, new, 0.5, by_operator=False))
        operands: list[Merged] = [
            self.align(olds[partner[number]], new)
            if number in partner
            else self._site(FoundSite("added", None, new))
            for number, new in enumerate(news)
        ]
        left = [old for index, old in enumerate(olds) if index not in taken]
        operands += [self._site(FoundSite("removed", old, None)) for old in left]
        return Inner(None, old_node, new_node, tuple(operands))


def _is_alike(old: Place, new: Place, least: float, *, by_operator: bool) -> bool:
    """Say whether two nodes are about the same, of one operator or of any."""
    one, other = old.bare.node, new.bare.node
    return (not by_operator or operator_of(one) == operator_of(other)) and similarity(one, other) >= least


def _ranges_alike(old: Quantified, new: Quantified) -> bool:
    """Say whether two quantifiers differ in their bodies alone."""
    return (old.quantifier, old.variables, old.group) == (new.quantifier, new.variables, new.group)


def _text(place: Place | None, kind: EditKind) -> str | None:
    if place is None:
        return None
    if kind == "renamed":
        return place.node.name
    if kind == "constant" and isinstance(place.node, Temporal):
        # the operands stay or have edits of their own
        return f"{place.node.operator}{format_bound(place.node.bound)} …"
    return format_formula(place.node)
