"""Laws of geometry: linear inequalities between measurements that hold for all footprints.

Each holds for unions of convex parts, with heights or without; what the plane alone would allow is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from itertools import combinations, permutations
from typing import Final

from spatial_replay.sanity.linear import Inequality
from spatial_replay.sanity.sums import (
    Quantity,
    exact,
    is_flat,
    is_solid,
    radius_of,
    terms_in,
    without_radius,
)
from spatial_replay.spec.formula import (
    Axis,
    CentroidProjection,
    Enlarged,
    Misalignment,
    Outline,
    Projection,
    Protrusion,
    RegionName,
    SignedDistance,
    Term,
)

MAX_TERMS: Final = 12
"""How many terms laws are written out for; between more of them only those of one measurement are."""


def laws(
    quantities: Iterable[Quantity], inside: Iterable[Protrusion], regions: Mapping[str, Outline]
) -> list[Inequality]:
    """Return the laws between quantities, and between these and others that are about the same terms.

    Args:
        inside: the protrusions that are at most 0.
    """
    used = list(dict.fromkeys(quantities))
    terms = [term for term in terms_in(used) if is_solid(term)]
    found = list(_single(used))
    if len(terms) > MAX_TERMS:
        return found
    extents = _Extents(used, terms, regions)
    distances = {each for each in used if isinstance(each, SignedDistance)}
    protrusions = {each for each in used if isinstance(each, Protrusion)}
    found += _enlarged(distances, protrusions)
    distances = {_distance(*map(without_radius, (each.first, each.second))) for each in distances}
    protrusions = {Protrusion(without_radius(each.inner), without_radius(each.outer)) for each in protrusions}
    within = {each for each in inside if not isinstance(each.inner, Enlarged)}
    found += _transitive(protrusions, within, regions)
    found += _nested(distances, protrusions, within, regions)
    if extents.matter:
        found += extents.laws(distances, protrusions)
    return found


def _law(*weights: tuple[Quantity, int], bound: Fraction = Fraction(0)) -> Inequality:
    """Return the law that a weighted sum is at most a bound."""
    total: dict[Quantity, Fraction] = {}
    for quantity, weight in weights:
        total[quantity] = total.get(quantity, Fraction(0)) + weight
    return Inequality(tuple((key, value) for key, value in total.items() if value), bound)


def _distance(one: Term, other: Term) -> SignedDistance:
    first, second = sorted((one, other), key=repr)
    return SignedDistance(first, second)


def _single(used: Iterable[Quantity]) -> Iterator[Inequality]:
    """Yield the laws of single measurements."""
    for each in used:
        match each:
            case Misalignment():
                yield _law((each, -1))
                yield _law((each, 1), bound=Fraction(0 if each.first == each.second else 2))
            case SignedDistance() if each.first == each.second:
                yield _law((each, 1))
            case Protrusion() if each.inner == each.outer:
                yield _law((each, 1))


def _enlarged(distances: Iterable[SignedDistance], protrusions: Iterable[Protrusion]) -> Iterator[Inequality]:
    """Yield by how much enlarging changes a measurement at most: less where heights decide it."""
    for each in sorted(distances, key=repr):
        bare = _distance(without_radius(each.first), without_radius(each.second))
        for other in sorted({*distances, bare} - {each}, key=repr):
            if _distance(without_radius(other.first), without_radius(other.second)) == bare:
                radius = _reach(each) - _reach(other)
                if radius >= 0:
                    yield _law((each, 1), (other, -1))
                    yield _law((other, 1), (each, -1), bound=radius)
    for one in sorted(protrusions, key=repr):
        within = Protrusion(without_radius(one.inner), without_radius(one.outer))
        for alike in sorted({*protrusions, within} - {one}, key=repr):
            if (without_radius(alike.inner), without_radius(alike.outer)) == (within.inner, within.outer):
                change = _growth(one) - _growth(alike)
                yield _law((one, 1), (alike, -1), bound=max(change, Fraction(0)))
                yield _law((alike, 1), (one, -1), bound=max(-change, Fraction(0)))


def _reach(distance: SignedDistance) -> Fraction:
    return radius_of(distance.first) + radius_of(distance.second)


def _growth(protrusion: Protrusion) -> Fraction:
    return radius_of(protrusion.inner) - radius_of(protrusion.outer)


def _transitive(
    protrusions: set[Protrusion], within: set[Protrusion], regions: Mapping[str, Outline]
) -> Iterator[Inequality]:
    """Yield that a sticks out of c at most as far as a out of b and b out of c together."""
    terms = [term for term in terms_in(protrusions) if is_solid(term)]
    for _ in terms:
        more = set()
        for first, second in permutations(sorted(protrusions, key=repr), 2):
            a, b, c = first.inner, first.outer, second.outer
            if b != second.inner or a == c or not all(map(is_solid, (a, b, c))):
                continue
            # heights count between a and c, but not on the way over a region without any
            if is_flat(b, regions) and not is_flat(a, regions) and not is_flat(c, regions):
                continue
            whole = Protrusion(a, c)
            yield _law((whole, 1), (first, -1), (second, -1))
            if {first, second} <= within:
                within.add(whole)
            more.add(whole)
        if more <= protrusions:
            break
        protrusions |= more


def _nested(
    distances: set[SignedDistance],
    protrusions: set[Protrusion],
    within: set[Protrusion],
    regions: Mapping[str, Outline],
) -> Iterator[Inequality]:
    """Yield that what is inside overlaps, and is as far from others as its outside or farther."""
    for each in sorted(within & protrusions, key=repr):
        if is_solid(each.inner) and is_solid(each.outer):
            distances.add(_distance(each.inner, each.outer))
            yield _law((_distance(each.inner, each.outer), 1), (each, -1))
    for _ in within:
        more = set()
        for each in sorted(within, key=repr):
            a, b = each.inner, each.outer
            if not (is_solid(a) and is_solid(b)) or (is_flat(a, regions) and not is_flat(b, regions)):
                continue
            for pair in sorted(distances, key=repr):
                for c, other in ((pair.first, pair.second), (pair.second, pair.first)):
                    if other in (a, b) and c not in (a, b):
                        yield _law((_distance(b, c), 1), (_distance(a, c), -1), (each, -1))
                        more |= {_distance(b, c), _distance(a, c)}
        if more <= distances:
            break
        distances |= more


class _Extents:
    """The least and greatest coordinates of terms along the axes."""

    def __init__(self, used: Iterable[Quantity], terms: list[Term], regions: Mapping[str, Outline]) -> None:
        along = [each for each in used if isinstance(each, (Projection, CentroidProjection))]
        self._terms = terms
        self._regions = regions
        self._upright = {each.term for each in along if each.axis == "z"}
        self._centroids = dict.fromkeys(each for each in along if isinstance(each, CentroidProjection))
        self.matter = bool(along) or any(isinstance(term, RegionName) for term in terms)

    def laws(
        self, distances: Iterable[SignedDistance], protrusions: Iterable[Protrusion]
    ) -> Iterator[Inequality]:
        """Yield the laws of extents, and those between them and other measurements."""
        for term in self._terms:
            for axis in self._axes(term):
                least, most = Projection(term, axis, "min"), Projection(term, axis, "max")
                yield _law((least, 1), (most, -1))
                yield from self._of_region(term, axis)
        for each in self._centroids:
            yield _law((Projection(each.term, each.axis, "min"), 1), (each, -1))
            yield _law((each, 1), (Projection(each.term, each.axis, "max"), -1))
        for one, other in combinations(self._centroids, 2):
            if (one.term, one.axis) == (other.term, other.axis):
                low, high = (one, other) if one.side == "min" else (other, one)
                yield _law((low, 1), (high, -1))
        for pair in sorted(distances, key=repr):
            if not (is_solid(pair.first) and is_solid(pair.second)) or pair.first == pair.second:
                continue
            for a, b in ((pair.first, pair.second), (pair.second, pair.first)):
                for axis in self._axes(a, b):
                    gap = (Projection(b, axis, "min"), 1), (Projection(a, axis, "max"), -1)
                    yield _law(*gap, (pair, -1))
        for inside in sorted(protrusions, key=repr):
            a, b = inside.inner, inside.outer
            if not (is_solid(a) and is_solid(b)) or a == b:
                continue
            for axis in self._axes(a, b):
                yield _law((Projection(a, axis, "max"), 1), (Projection(b, axis, "max"), -1), (inside, -1))
                yield _law((Projection(b, axis, "min"), 1), (Projection(a, axis, "min"), -1), (inside, -1))

    def _axes(self, *terms: Term) -> tuple[Axis, ...]:
        is_upright = all(term in self._upright for term in terms)
        return ("x", "y", "z") if is_upright else ("x", "y")

    def _of_region(self, term: Term, axis: Axis) -> Iterator[Inequality]:
        outline = self._regions.get(term.name) if isinstance(term, RegionName) else None
        if outline is None:
            return
        limits = extent(outline, axis)
        if limits is not None:
            least, most = Projection(term, axis, "min"), Projection(term, axis, "max")
            for quantity, value in ((least, limits[0]), (most, limits[1])):
                yield _law((quantity, 1), bound=value)
                yield _law((quantity, -1), bound=-value)


def extent(outline: Outline, axis: Axis) -> tuple[Fraction, Fraction] | None:
    """Return the least and the greatest coordinate of a region along an axis; None without heights."""
    if axis == "z":
        return None if outline.height is None else (exact(outline.height[0]), exact(outline.height[1]))
    coordinates = [exact(vertex["xy".index(axis)]) for vertex in outline.vertices]
    radius = exact(outline.radius)
    return min(coordinates) - radius, max(coordinates) + radius
