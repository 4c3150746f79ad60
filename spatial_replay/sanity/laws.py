"""Laws of geometry: linear inequalities between measurements that hold for all footprints.

Each law holds for unions of convex parts, with and without heights. Laws of the plane alone are left out,
except for those with the label `LEVEL`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from fractions import Fraction
from itertools import combinations, product
from typing import Final, TypeVar

from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.sanity.conditions import (
    Quantity,
    exact,
    is_flat,
    is_solid,
    radius_of,
    terms_in,
    without_radius,
)
from spatial_replay.sanity.linear import Inequality
from spatial_replay.spec.formula import (
    Axis,
    Centre,
    CentroidProjection,
    Measurement,
    Misalignment,
    Outline,
    Projection,
    Protrusion,
    RegionName,
    SignedDistance,
    Term,
)

LEVEL: Final = -1
"""Label of laws about objects without a gap in height; labels of facts are at least 0."""


def laws(
    quantities: Iterable[Quantity],
    inside: Iterable[Protrusion],
    regions: Mapping[str, Outline],
    between: Mapping[Measurement, Fraction],
    diameters: Mapping[str, Fraction],
) -> list[Inequality]:
    """Return the laws of some quantities and of further measurements of their terms.

    Args:
        inside: protrusions that are at most 0.
        between: distances of regions that are apart, and protrusions of regions from enclosing ones.
        diameters: diameters of regions by name, for objects without a gap in height; empty if heights matter.
    """
    used = list(dict.fromkeys(quantities))
    present = set(terms_in(used))
    between = {
        measurement: value for measurement, value in between.items() if present.issuperset(measurement.terms)
    }
    used += [measurement for measurement in between if measurement not in used]
    terms = [term for term in terms_in(used) if is_solid(term)]
    inequalities = [*_single(used), *_region_laws(between)]
    extents = _Extents(used, terms, regions)
    distances = [quantity for quantity in used if isinstance(quantity, SignedDistance)]
    protrusions = [quantity for quantity in used if isinstance(quantity, Protrusion)]
    inequalities += _enlargement(distances, protrusions)
    # in text order (a set has no order), so that equal questions take equal steps
    bare = dict.fromkeys(
        _distance(without_radius(distance.first), without_radius(distance.second)) for distance in distances
    )
    outside = dict.fromkeys(_bare(protrusion) for protrusion in protrusions)
    held: set[object] = {*inside, *between}
    within = dict.fromkeys(protrusion for protrusion in outside if protrusion in held)
    inequalities += _transitive(outside, within, regions)
    inequalities += _nesting(bare, within, regions)
    inequalities += _across(bare, outside, diameters)
    inequalities += _centres(outside, regions)
    if extents.matter:
        # protrusions between regions are already measured and rounded, so exact extents add nothing
        inequalities += extents.laws(
            bare, [protrusion for protrusion in outside if protrusion not in between]
        )
    return inequalities


def _law(*weights: tuple[Quantity, int], bound: Fraction = Fraction(0)) -> Inequality:
    """Return the law that a weighted sum of quantities is at most a bound."""
    total: dict[Quantity, int] = {}
    for quantity, weight in weights:
        total[quantity] = total.get(quantity, 0) + weight
    return Inequality(tuple((key, value) for key, value in total.items() if value), bound)


def _distance(a: Term, b: Term) -> SignedDistance:
    # the distance is symmetric; a fixed order makes equal ones equal values
    first, second = sorted((a, b), key=repr)
    return SignedDistance(first, second)


def _single(used: Iterable[Quantity]) -> Iterator[Inequality]:
    """Yield the laws of single measurements."""
    for quantity in used:
        match quantity:
            case Misalignment():
                yield _law((quantity, -1))
                yield _law((quantity, 1), bound=Fraction(0 if quantity.first == quantity.second else 2))
            case SignedDistance() if quantity.first == quantity.second:
                yield _law((quantity, 1))
            case Protrusion() if quantity.inner == quantity.outer:
                yield _law((quantity, 1))


def _region_laws(between: Mapping[Measurement, Fraction]) -> Iterator[Inequality]:
    """Yield the least distances between regions, and their greatest protrusions from enclosing regions."""
    for measurement, value in between.items():
        sign = -1 if isinstance(measurement, SignedDistance) else 1
        yield _law((measurement, sign), bound=sign * value)


def _across(
    distances: Iterable[SignedDistance], outside: Mapping[Protrusion, None], diameters: Mapping[str, Fraction]
) -> Iterator[Inequality]:
    """Yield: two objects are at most the diameter of a region apart, plus their protrusions from it."""
    for pair, (name, diameter) in product(distances, diameters.items()):
        region = RegionName(name)
        rooms = [Protrusion(pair.first, region), Protrusion(pair.second, region)]
        if pair.first != pair.second and all(protrusion in outside for protrusion in rooms):
            law = _law((pair, 1), *((protrusion, -1) for protrusion in rooms), bound=diameter)
            yield law._replace(label=LEVEL)


def _centres(outside: Mapping[Protrusion, None], regions: Mapping[str, Outline]) -> Iterator[Inequality]:
    """Yield: the protrusion of a centre from a convex region is at most that of the whole footprint."""
    for protrusion in outside:
        inner, outer = protrusion.inner, protrusion.outer
        if not isinstance(inner, Centre) or not isinstance(outer, RegionName):
            continue
        whole, outline = Protrusion(inner.term, outer), regions.get(outer.name)
        if whole in outside and outline is not None and len(footprint_from_outline(outline).parts) == 1:
            yield _law((protrusion, 1), (whole, -1))


def _enlargement(distances: list[SignedDistance], protrusions: list[Protrusion]) -> Iterator[Inequality]:
    """Yield the greatest change of a measurement by enlargement; the change is less if heights decide it."""
    for first, second in _variants(
        distances, lambda distance: _distance(*map(without_radius, (distance.first, distance.second)))
    ):
        change = _reach(first) - _reach(second)
        yield _law((first, 1), (second, -1), bound=max(-change, Fraction(0)))
        yield _law((second, 1), (first, -1), bound=max(change, Fraction(0)))
    for inner, outer in _variants(protrusions, _bare):
        change = _growth(inner) - _growth(outer)
        yield _law((inner, 1), (outer, -1), bound=max(change, Fraction(0)))
        yield _law((outer, 1), (inner, -1), bound=max(-change, Fraction(0)))


_Measured = TypeVar("_Measured", SignedDistance, Protrusion)


def _variants(
    measured: list[_Measured], bare_of: Callable[[_Measured], _Measured]
) -> Iterator[tuple[_Measured, _Measured]]:
    """Yield pairs of measurements of the same terms with different enlargements."""
    alike: dict[_Measured, dict[_Measured, None]] = {}
    for measurement in measured:
        alike.setdefault(bare_of(measurement), {})[measurement] = None
    for bare, variants in alike.items():
        yield from combinations({**variants, bare: None}, 2)


def _bare(protrusion: Protrusion) -> Protrusion:
    return Protrusion(without_radius(protrusion.inner), without_radius(protrusion.outer))


def _reach(distance: SignedDistance) -> Fraction:
    return radius_of(distance.first) + radius_of(distance.second)


def _growth(protrusion: Protrusion) -> Fraction:
    return radius_of(protrusion.inner) - radius_of(protrusion.outer)


def _transitive(
    protrusions: dict[Protrusion, None], within: dict[Protrusion, None], regions: Mapping[str, Outline]
) -> Iterator[Inequality]:
    """Yield: the protrusion of a from c is at most that of a from b plus that of b from c."""
    outers: dict[Term, dict[Term, Protrusion]] = {}
    for protrusion in protrusions:
        if is_solid(protrusion.inner) and is_solid(protrusion.outer):
            outers.setdefault(protrusion.inner, {})[protrusion.outer] = protrusion
    beyond = {term: _reachable(term, outers) for term in outers}
    waiting = [protrusion for by_outer in outers.values() for protrusion in by_outer.values()]
    # the loop appends further protrusions to its list
    for first in waiting:
        a, b = first.inner, first.outer
        for c, second in outers.get(b, {}).items():
            if a == c:
                # if a is inside b with a margin, b protrudes from a by at least this margin
                yield _law((first, -1), (second, -1))
            # heights matter between a and c, but not in steps over a region b without a height
            is_gap = is_flat(b, regions) and not is_flat(a, regions) and not is_flat(c, regions)
            # a chain that leads to no measured protrusion of a adds nothing to its single steps
            is_nested = isinstance(b, RegionName) and isinstance(c, RegionName)
            leads = is_nested or c in outers[a] or not beyond.get(c, frozenset()).isdisjoint(outers[a])
            if a == c or is_gap or not (leads or is_flat(a, regions)):
                continue
            whole = Protrusion(a, c)
            yield _law((whole, 1), (first, -1), (second, -1))
            if first in within and second in within:
                within[whole] = None
            if whole not in protrusions:
                protrusions[whole] = None
                waiting.append(whole)


def _reachable(term: Term, outers: Mapping[Term, Mapping[Term, Protrusion]]) -> frozenset[Term]:
    """Return the terms that chains of protrusions reach from a term."""
    waiting, reached = [term], set[Term]()
    while waiting:
        more = outers.get(waiting.pop(), {}).keys() - reached
        reached |= more
        waiting += more
    return frozenset(reached)


def _nesting(
    distances: dict[SignedDistance, None], within: dict[Protrusion, None], regions: Mapping[str, Outline]
) -> Iterator[Inequality]:
    """Yield: a nested term overlaps its outer term, and is at least as far from any third term."""
    inside: dict[Term, list[Protrusion]] = {}
    for protrusion in within:
        if is_solid(protrusion.inner) and is_solid(protrusion.outer):
            for term in (protrusion.inner, protrusion.outer):
                inside.setdefault(term, []).append(protrusion)
    waiting = list(distances)
    # the loop appends further distances to its list
    for pair in waiting:
        for end, c in ((pair.first, pair.second), (pair.second, pair.first)):
            for protrusion in inside.get(end, ()):
                a, b = protrusion.inner, protrusion.outer
                if c in (a, b) and c != end:
                    yield _law((pair, 1), (protrusion, -1))
                elif not (is_flat(a, regions) and not is_flat(b, regions)):
                    near, far = _distance(b, c), _distance(a, c)
                    yield _law((near, 1), (far, -1), (protrusion, -1))
                    more = [distance for distance in (near, far) if distance not in distances]
                    distances.update(dict.fromkeys(more))
                    waiting += more


class _Extents:
    """Least and greatest coordinates of terms along the axes."""

    def __init__(self, used: Iterable[Quantity], terms: list[Term], regions: Mapping[str, Outline]) -> None:
        along = [quantity for quantity in used if isinstance(quantity, (Projection, CentroidProjection))]
        self._terms = terms
        self._regions = regions
        self._upright = {quantity.term for quantity in along if quantity.axis == "z"}
        self._centroids = dict.fromkeys(
            quantity for quantity in along if isinstance(quantity, CentroidProjection)
        )
        self.matter = bool(along) or any(isinstance(term, RegionName) for term in terms)

    def laws(
        self, distances: Iterable[SignedDistance], protrusions: Iterable[Protrusion]
    ) -> Iterator[Inequality]:
        """Yield the laws between extents, and between extents and other measurements."""
        for term in self._terms:
            for axis in self._axes(term):
                least, most = Projection(term, axis, "min"), Projection(term, axis, "max")
                yield _law((least, 1), (most, -1))
                yield from self._of_region(term, axis)
        for centroid in self._centroids:
            yield _law((Projection(centroid.term, centroid.axis, "min"), 1), (centroid, -1))
            yield _law((centroid, 1), (Projection(centroid.term, centroid.axis, "max"), -1))
        for first, second in combinations(self._centroids, 2):
            if (first.term, first.axis) == (second.term, second.axis):
                low, high = (first, second) if first.side == "min" else (second, first)
                yield _law((low, 1), (high, -1))
        for pair in distances:
            if not (is_solid(pair.first) and is_solid(pair.second)) or pair.first == pair.second:
                continue
            for a, b in ((pair.first, pair.second), (pair.second, pair.first)):
                for axis in self._axes(a, b):
                    gap = (Projection(b, axis, "min"), 1), (Projection(a, axis, "max"), -1)
                    yield _law(*gap, (pair, -1))
        for inside in protrusions:
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
    """Return the least and the greatest coordinate of a region along an axis; None for z without a height."""
    if axis == "z":
        return None if outline.height is None else (exact(outline.height[0]), exact(outline.height[1]))
    coordinates = [exact(vertex["xy".index(axis)]) for vertex in outline.vertices]
    radius = exact(outline.radius)
    return min(coordinates) - radius, max(coordinates) + radius
