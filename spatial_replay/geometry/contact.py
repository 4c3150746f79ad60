"""Where two footprints are nearest to each other, deepest in each other, or stick out of each other.

For one pair at one time, to be shown to people (see `contacts` for many): what is measured over many samples
is in `measure`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.contacts import contacts
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.geometry.measure import Operand

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Contact:
    """A point of each of two footprints.

    Attributes:
        first, second: of footprints that are apart, the points nearest to each other; of overlapping ones,
            the ends of the shortest push that would part them.
        distance: signed, negative where they overlap; its absolute value is the distance of the points.
    """

    first: Point
    second: Point
    distance: float


def contact(a: Footprint, b: Footprint) -> Contact:
    """Where the signed distance of two footprints is attained (Def. 2-4)."""
    return _contact(a, b, is_protrusion=False)


def protrusion_contact(inner: Footprint, outer: Footprint) -> Contact:
    """The point of `inner` farthest out of `outer`, or least deep in it, and the nearest on its boundary.

    Its distance is the protrusion: positive where `inner` sticks out (Prop. 2).
    """
    return _contact(inner, outer, is_protrusion=True)


def enlarged(footprint: Footprint, radius: float) -> Footprint:
    """The Minkowski sum of a footprint with a disc of a radius of at least 0."""
    return Footprint(tuple(ConvexPart(part.vertices, part.radius + radius) for part in footprint.parts))


def _contact(first: Footprint, second: Footprint, *, is_protrusion: bool) -> Contact:
    batch = FootprintBatch.from_footprints([first, second])
    operands = [Operand(np.array([[row]])) for row in range(2)]
    x, y, other_x, other_y, distance, _ = contacts(batch, *operands, is_protrusion=is_protrusion)[0].tolist()
    return Contact((x, y), (other_x, other_y), distance)
