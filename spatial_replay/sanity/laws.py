"""Laws of geometry: linear inequalities between measurements that hold for all footprints.

Each law holds for unions of convex parts, with and without heights. Laws that hold only in the plane are
left out, except laws with the label `LEVEL`.
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
    """Return the laws between some quantities and further measurements of their terms.

    Args:
        inside: protrusions that are at most 0.
        between: distances of disjoint regions, and protrusions of regions from enclosing regions.
        diameters: diameters of regions by name, for objects without a gap in height; empty if heights matter.
    """
    all_quantities = list(dict.fromkeys(quantities))
    present_terms = set(terms_in(all_quantities))
    between = {
        measurement: value
        for measurement, value in between.items()
        if present_terms.issuperset(measurement.terms)
    }
    all_quantities += [measurement for measurement in between if measurement not in all_quantities]
    solid_terms = [term for term in terms_in(all_quantities) if is_solid(term)]
    inequalities = [*_single(all_quantities), *_region_laws(between)]
    extents = _Extents(all_quantities, solid_terms, regions)
    distances = [quantity for quantity in all_quantities if isinstance(quantity, SignedDistance)]
    protrusions = [quantity for quantity in all_quantities if isinstance(quantity, Protrusion)]
    inequalities += _enlargement(distances, protrusions)
    # distances are in text order (a set has no order), so that equal questions take equal steps
    bare_distances = dict.fromkeys(
        _distance(without_radius(distance.first), without_radius(distance.second)) for distance in distances
    )
    bare_protrusions = dict.fromkeys(_bare(protrusion) for protrusion in protrusions)
    known_inside: set[object] = {*inside, *between}
    inside_protrusions = dict.fromkeys(
        protrusion for protrusion in bare_protrusions if protrusion in known_inside
    )
    inequalities += _transitive(bare_protrusions, inside_protrusions, regions)
    inequalities += _nesting(bare_distances, inside_protrusions, regions)
    inequalities += _across(bare_distances, bare_protrusions, diameters)
    inequalities += _centres(bare_protrusions, regions)
    if extents.matter:
        # protrusions between regions are already measured and rounded, so exact extents add nothing
        inequalities += extents.laws(
            bare_distances, [protrusion for protrusion in bare_protrusions if protrusion not in between]
        )
    return inequalities


def _law(*weights: tuple[Quantity, int], bound: Fraction = Fraction(0)) -> Inequality:
    """Return the law that a weighted sum of quantities is at most a bound."""
    weight_by_quantity: dict[Quantity, int] = {}
    for quantity, weight in weights:
        weight_by_quantity[quantity] = weight_by_quantity.get(quantity, 0) + weight
    return Inequality(tuple((key, value) for key, value in weight_by_quantity.items() if value), bound)


def _distance(a: Term, b: Term) -> SignedDistance:
    # the distance is symmetric; a fixed order makes equal distances equal values
    first, second = sorted((a, b), key=repr)
    return SignedDistance(first, second)


def _single(quantities: Iterable[Quantity]) -> Iterator[Inequality]:
    for quantity in quantities:
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
    distances: Iterable[SignedDistance],
    bare_protrusions: Mapping[Protrusion, None],
    diameters: Mapping[str, Fraction],
) -> Iterator[Inequality]:
    """Yield: a distance is at most a region's diameter plus the protrusions of both terms from the region."""
    for distance, (name, diameter) in product(distances, diameters.items()):
        region = RegionName(name)
        pair_protrusions = [Protrusion(distance.first, region), Protrusion(distance.second, region)]
        if distance.first != distance.second and all(
            protrusion in bare_protrusions for protrusion in pair_protrusions
        ):
            law = _law((distance, 1), *((protrusion, -1) for protrusion in pair_protrusions), bound=diameter)
            yield law._replace(label=LEVEL)


def _centres(
    bare_protrusions: Mapping[Protrusion, None], regions: Mapping[str, Outline]
) -> Iterator[Inequality]:
    """Yield: a centre's protrusion from a convex region is at most the whole footprint's protrusion."""
    for protrusion in bare_protrusions:
        inner, outer = protrusion.inner, protrusion.outer
        if not isinstance(inner, Centre) or not isinstance(outer, RegionName):
            continue
        whole_protrusion, outline = Protrusion(inner.term, outer), regions.get(outer.name)
        if (
            whole_protrusion in bare_protrusions
            and outline is not None
            and len(footprint_from_outline(outline).parts) == 1
        ):
            yield _law((protrusion, 1), (whole_protrusion, -1))


def _enlargement(distances: list[SignedDistance], protrusions: list[Protrusion]) -> Iterator[Inequality]:
    """Yield limits of a measurement's change by enlargement; the change is less if heights decide."""
    for first_distance, second_distance in _variants(
        distances, lambda distance: _distance(*map(without_radius, (distance.first, distance.second)))
    ):
        change = _reach(first_distance) - _reach(second_distance)
        yield _law((first_distance, 1), (second_distance, -1), bound=max(-change, Fraction(0)))
        yield _law((second_distance, 1), (first_distance, -1), bound=max(change, Fraction(0)))
    for first_protrusion, second_protrusion in _variants(protrusions, _bare):
        change = _growth(first_protrusion) - _growth(second_protrusion)
        yield _law((first_protrusion, 1), (second_protrusion, -1), bound=max(change, Fraction(0)))
        yield _law((second_protrusion, 1), (first_protrusion, -1), bound=max(-change, Fraction(0)))


_Measured = TypeVar("_Measured", SignedDistance, Protrusion)


def _variants(
    measurements: list[_Measured], bare_of: Callable[[_Measured], _Measured]
) -> Iterator[tuple[_Measured, _Measured]]:
    """Yield pairs of measurements of the same terms with different enlargements."""
    variants_by_bare: dict[_Measured, dict[_Measured, None]] = {}
    for measurement in measurements:
        variants_by_bare.setdefault(bare_of(measurement), {})[measurement] = None
    for bare, variants in variants_by_bare.items():
        yield from combinations({**variants, bare: None}, 2)


def _bare(protrusion: Protrusion) -> Protrusion:
    return Protrusion(without_radius(protrusion.inner), without_radius(protrusion.outer))


def _reach(distance: SignedDistance) -> Fraction:
    return radius_of(distance.first) + radius_of(distance.second)


def _growth(protrusion: Protrusion) -> Fraction:
    return radius_of(protrusion.inner) - radius_of(protrusion.outer)


def _transitive(
    protrusions: dict[Protrusion, None],
    inside_protrusions: dict[Protrusion, None],
    regions: Mapping[str, Outline],
) -> Iterator[Inequality]:
    """Yield: protrusion(a, c) <= protrusion(a, b) + protrusion(b, c)."""
    protrusions_by_term: dict[Term, dict[Term, Protrusion]] = {}
    for protrusion in protrusions:
        if is_solid(protrusion.inner) and is_solid(protrusion.outer):
            protrusions_by_term.setdefault(protrusion.inner, {})[protrusion.outer] = protrusion
    reachable_by_term = {term: _reachable(term, protrusions_by_term) for term in protrusions_by_term}
    pending_protrusions = [
        protrusion for by_outer in protrusions_by_term.values() for protrusion in by_outer.values()
    ]
    # the loop appends further protrusions to its list
    for first_step in pending_protrusions:
        a, b = first_step.inner, first_step.outer
        for c, second_step in protrusions_by_term.get(b, {}).items():
            if a == c:
                # if a is inside b with a margin, b protrudes from a by at least this margin
                yield _law((first_step, -1), (second_step, -1))
            # heights matter between a and c, but not in steps over a region b without a height
            is_gap = is_flat(b, regions) and not is_flat(a, regions) and not is_flat(c, regions)
            # a chain adds no information if it leads to no measured protrusion of `a`
            is_nested = isinstance(b, RegionName) and isinstance(c, RegionName)
            is_useful = (
                is_nested
                or c in protrusions_by_term[a]
                or not reachable_by_term.get(c, frozenset()).isdisjoint(protrusions_by_term[a])
            )
            if a == c or is_gap or not (is_useful or is_flat(a, regions)):
                continue
            whole_protrusion = Protrusion(a, c)
            yield _law((whole_protrusion, 1), (first_step, -1), (second_step, -1))
            if first_step in inside_protrusions and second_step in inside_protrusions:
                inside_protrusions[whole_protrusion] = None
            if whole_protrusion not in protrusions:
                protrusions[whole_protrusion] = None
                pending_protrusions.append(whole_protrusion)


def _reachable(term: Term, protrusions_by_term: Mapping[Term, Mapping[Term, Protrusion]]) -> frozenset[Term]:
    """Return the terms that chains of protrusions reach from a term."""
    pending_terms, reachable_terms = [term], set[Term]()
    while pending_terms:
        new_terms = protrusions_by_term.get(pending_terms.pop(), {}).keys() - reachable_terms
        reachable_terms |= new_terms
        pending_terms += new_terms
    return frozenset(reachable_terms)


def _nesting(
    distances: dict[SignedDistance, None],
    inside_protrusions: dict[Protrusion, None],
    regions: Mapping[str, Outline],
) -> Iterator[Inequality]:
    """Yield: a nested term overlaps its outer term; a third term is at most as near to the nested term."""
    protrusions_by_term: dict[Term, list[Protrusion]] = {}
    for protrusion in inside_protrusions:
        if is_solid(protrusion.inner) and is_solid(protrusion.outer):
            for term in (protrusion.inner, protrusion.outer):
                protrusions_by_term.setdefault(term, []).append(protrusion)
    pending_distances = list(distances)
    # the loop appends further distances to its list
    for pair in pending_distances:
        for end_term, c in ((pair.first, pair.second), (pair.second, pair.first)):
            for protrusion in protrusions_by_term.get(end_term, ()):
                a, b = protrusion.inner, protrusion.outer
                if c in (a, b) and c != end_term:
                    yield _law((pair, 1), (protrusion, -1))
                elif not (is_flat(a, regions) and not is_flat(b, regions)):
                    near, far = _distance(b, c), _distance(a, c)
                    yield _law((near, 1), (far, -1), (protrusion, -1))
                    new_distances = [distance for distance in (near, far) if distance not in distances]
                    distances.update(dict.fromkeys(new_distances))
                    pending_distances += new_distances


class _Extents:
    """Least and greatest coordinates of terms along the axes."""

    def __init__(
        self, quantities: Iterable[Quantity], terms: list[Term], regions: Mapping[str, Outline]
    ) -> None:
        projections = [
            quantity for quantity in quantities if isinstance(quantity, (Projection, CentroidProjection))
        ]
        self._terms = terms
        self._regions = regions
        self._upright = {quantity.term for quantity in projections if quantity.axis == "z"}
        self._centroids = dict.fromkeys(
            quantity for quantity in projections if isinstance(quantity, CentroidProjection)
        )
        self.matter = bool(projections) or any(isinstance(term, RegionName) for term in terms)

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
        for first_centroid, second_centroid in combinations(self._centroids, 2):
            if (first_centroid.term, first_centroid.axis) == (second_centroid.term, second_centroid.axis):
                low, high = (
                    (first_centroid, second_centroid)
                    if first_centroid.side == "min"
                    else (second_centroid, first_centroid)
                )
                yield _law((low, 1), (high, -1))
        for pair in distances:
            if not (is_solid(pair.first) and is_solid(pair.second)) or pair.first == pair.second:
                continue
            for a, b in ((pair.first, pair.second), (pair.second, pair.first)):
                for axis in self._axes(a, b):
                    gap = (Projection(b, axis, "min"), 1), (Projection(a, axis, "max"), -1)
                    yield _law(*gap, (pair, -1))
        for protrusion in protrusions:
            a, b = protrusion.inner, protrusion.outer
            if not (is_solid(a) and is_solid(b)) or a == b:
                continue
            for axis in self._axes(a, b):
                yield _law(
                    (Projection(a, axis, "max"), 1), (Projection(b, axis, "max"), -1), (protrusion, -1)
                )
                yield _law(
                    (Projection(b, axis, "min"), 1), (Projection(a, axis, "min"), -1), (protrusion, -1)
                )

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
