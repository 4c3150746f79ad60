"""The closest two of many footprints, without measuring every pair.

A sweep over bounding boxes leaves out pairs whose boxes are farther apart than the closest two found so far.
The signed distance of two footprints is at least the gap between their boxes along either axis, also where
that is negative. So what is left out cannot be the least: the result is that over all pairs, bit for bit.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import elementwise, long_kernel
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.kernels import Rows, fill_row, rows_distance

LEFT, RIGHT, LOWER, UPPER = 0, 1, 2, 3


def closest_pairs(batch: FootprintBatch, rows: Integers, uncertainty: Floats, enlargement: float) -> Floats:
    """Compute the signed distance of the closest two of some footprints in each sample.

    Args:
        rows: (T, M), the rows of M footprints in each of T samples; any negative number is none.
        uncertainty: at least one for each of these rows, at least 0, in footprint units.
        enlargement: by how much each distance is less, in footprint units.

    Returns:
        (T, 3): the least over pairs of their distance, of that less both uncertainties, of that plus both;
        +inf where there are fewer than two.
    """
    result = np.empty((len(rows), 3))
    closest_rows(
        batch.part_start,
        batch.vertex_start,
        batch.vertices,
        batch.radius,
        batch.bottom,
        batch.top,
        np.ascontiguousarray(rows),
        uncertainty,
        float(enlargement),
        np.empty((len(batch.vertices), 4)),
        result,
    )
    return result


def candidate_pairs(
    batch: FootprintBatch, rows: Integers, uncertainty: Floats, enlargement: float
) -> Integers:
    """Return the pairs that may be the closest two in one sample, with or without uncertainty.

    Args:
        rows: (M,), the rows of M footprints.
        uncertainty, enlargement: as for `closest_pairs`.

    Returns:
        (P, 2), the lesser of two places among `rows` first, in order.
    """
    chosen = batch.select(rows)
    first_vertex = chosen.vertex_start[chosen.part_start[:-1]]
    radius = np.repeat(chosen.radius, np.diff(chosen.vertex_start))[:, None]
    least = np.minimum.reduceat(chosen.vertices - radius, first_vertex)
    greatest = np.maximum.reduceat(chosen.vertices + radius, first_vertex)
    gaps = np.maximum(least[:, None] - greatest, least - greatest[:, None]).max(axis=2)
    high = closest_pairs(batch, rows[None], uncertainty, enlargement)[0, 2]
    size = max(np.abs(least).max(), np.abs(greatest).max())
    reach = high + enlargement + 2.0 * uncertainty[rows].max() + 1e-9 * size
    return np.argwhere(np.triu(gaps <= reach, 1)).astype(np.int64)


@elementwise
@long_kernel
def closest_rows(
    part_start: Integers,
    vertex_start: Integers,
    vertices: Floats,
    radius: Floats,
    bottom: Floats,
    top: Floats,
    members: Integers,
    uncertainty: Floats,
    enlargement: float,
    edges: Floats,
    result: Floats,
) -> None:
    """Fill `result` (T, 3); see `closest_pairs`. `edges` (V, 4) is room to work in."""
    rows = Rows(part_start, vertex_start, vertices, edges, radius, bottom, top)
    is_filled = np.zeros(len(part_start), dtype=np.bool_)
    width = members.shape[1]
    boxes = np.full((width, 4), np.inf)
    # from left to right; objects move little between samples, so that the order nearly stays
    order = np.arange(width)
    for t in range(result.shape[0]):
        present, size, widest = 0, 0.0, 0.0
        for m in range(width):
            row = members[t, m]
            left, right, lower, upper = np.inf, -np.inf, np.inf, -np.inf
            if row >= 0:
                present += 1
                widest = max(widest, uncertainty[row])
                if not is_filled[row]:
                    is_filled[row] = True
                    fill_row(rows, row)
                for p in range(part_start[row], part_start[row + 1]):
                    for v in range(vertex_start[p], vertex_start[p + 1]):
                        left = min(left, vertices[v, 0] - radius[p])
                        right = max(right, vertices[v, 0] + radius[p])
                        lower = min(lower, vertices[v, 1] - radius[p])
                        upper = max(upper, vertices[v, 1] + radius[p])
                size = max(size, max(max(-left, right), max(-lower, upper)))
            boxes[m, LEFT], boxes[m, RIGHT], boxes[m, LOWER], boxes[m, UPPER] = left, right, lower, upper
        for i in range(1, width):
            moving, at = order[i], i
            while at > 0 and boxes[order[at - 1], LEFT] > boxes[moving, LEFT]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = moving
        # what boxes and distances may be off by from rounding, and a distance by uncertainty
        slack = enlargement + 2.0 * widest + 1e-9 * size
        least, low, high = np.inf, np.inf, np.inf
        for i in range(present):
            a = order[i]
            for j in range(i + 1, present):
                b = order[j]
                reach = high + slack
                gap_x = boxes[b, LEFT] - boxes[a, RIGHT]
                if gap_x > reach:
                    break
                gap_y = max(boxes[b, LOWER] - boxes[a, UPPER], boxes[a, LOWER] - boxes[b, UPPER])
                if gap_y > reach:
                    continue
                if gap_x > 0.0 and gap_y > 0.0 and gap_x * gap_x + gap_y * gap_y > reach * reach:
                    continue
                first, second = members[t, a], members[t, b]
                distance = rows_distance(rows, first, second, enlargement)
                spread = uncertainty[first] + uncertainty[second]
                least = min(least, distance)
                low = min(low, distance - spread)
                high = min(high, distance + spread)
        result[t, 0], result[t, 1], result[t, 2] = least, low, high
