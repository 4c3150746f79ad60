"""Tables: the value of a formula at the first sample as a function of what is still to come.

Let x_1 … x_m be the values that the unbounded temporal subformulas of a part will have at the next sample.
In negation normal form the part's value is a monotone lattice polynomial of them (minima and maxima only),
so it is known from its values at the corners x in {-inf, +inf}^m: those are its table, of 2^m numbers. A new
sample substitutes for each x_j the formula that it expands to (max(psi, min(phi, x)) for an until) and reads
the old table at that point. The first and the last entry bound the value over every continuation; the corner
where strong operators are -inf and weak ones +inf is the value if the run ends here.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import START_NS, Memory, Scratch


@uncounted
def read_table(table: Floats, variables: int, point: Floats, order: Integers) -> float:
    """Read a table at a point: walk its corners in descending order of the coordinates."""
    if variables == 1:
        return float(max(table[0], min(point[0], table[1])))
    # insertion sort into `order`: there are only a few variables
    for j in range(variables):
        k = j
        while k > 0 and point[order[k - 1]] < point[j]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = j
    # a monotone lattice polynomial is the maximum over the chain of corners of min(coordinate, entry)
    result = table[0]
    corner = 0
    for k in range(variables):
        corner |= 1 << order[k]
        result = max(result, min(point[order[k]], table[corner]))
    return float(result)


@uncounted
def corner_value(corner: int, variable: int) -> float:
    return np.inf if (corner >> variable) & 1 else -np.inf


@uncounted
def _start(nodes: Integers, part: Integers, table: Floats, values: Floats) -> None:
    """Fill the table before the first sample: each operator as it is there."""
    first, end = part[codes.PART_FIRST], part[codes.PART_END]
    for corner in range(1 << part[codes.PART_VARIABLES]):
        for d in range(first, end):
            if nodes[d, codes.NODE_VARIABLE] >= 0:
                values[d - first] = corner_value(corner, nodes[d, codes.NODE_VARIABLE])
            elif nodes[d, codes.NODE_CODE] == codes.PART_OR:
                values[d - first] = max(values[nodes[d, codes.NODE_A]], values[nodes[d, codes.NODE_B]])
        table[corner] = values[end - 1 - first]


@uncounted
def _fill_columns(
    nodes: Integers,
    part: Integers,
    channel: int,
    mirror: int,
    history: Floats,
    begin: int,
    count: int,
    columns: Floats,
) -> None:
    """Compute the nodes that depend on no variable, over some samples."""
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        code, a, b = nodes[d, codes.NODE_CODE], nodes[d, codes.NODE_A], nodes[d, codes.NODE_B]
        column = columns[d - part[codes.PART_FIRST]]
        if code == codes.LITERAL:
            signal = history[mirror if b else channel, a, begin : begin + count]
            for k in range(count):
                column[k] = -signal[k] if b else signal[k]
        elif nodes[d, codes.NODE_DEPENDS]:
            continue
        elif code == codes.PART_AND:
            for k in range(count):
                column[k] = min(columns[a, k], columns[b, k])
        elif code == codes.PART_OR:
            for k in range(count):
                column[k] = max(columns[a, k], columns[b, k])


@uncounted
def _is_anchored(code: int) -> bool:
    return code in (codes.ANCHORED_UNTIL, codes.ANCHORED_RELEASE)


@uncounted
def _expand_anchored(node: Integers, values: Floats, later: float, position: int, elapsed_ns: int) -> float:
    """Expand an anchored until or release at a sample, from `values` there and its value at the next sample.

    Its right operand counts inside its window only.
    """
    a, right = node[codes.NODE_A], values[node[codes.NODE_B]]
    now = position if node[codes.NODE_UNIT] == codes.SAMPLES else elapsed_ns
    counts = node[codes.NODE_LOW] <= now and (node[codes.NODE_HIGH] < 0 or now <= node[codes.NODE_HIGH])
    if node[codes.NODE_CODE] == codes.ANCHORED_UNTIL:
        value = min(values[a], later) if a >= 0 else later
        return float(max(right, value)) if counts else float(value)
    value = max(values[a], later) if a >= 0 else later
    return float(min(right, value)) if counts else float(value)


@uncounted
def _close_windows(nodes: Integers, part: Integers, table: Floats, position: int, elapsed_ns: int) -> None:
    """Settle the anchored operators whose window no later sample can fall into."""
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        now = position if nodes[d, codes.NODE_UNIT] == codes.SAMPLES else elapsed_ns
        if (
            _is_anchored(nodes[d, codes.NODE_CODE])
            and nodes[d, codes.NODE_HIGH] >= 0
            and now >= nodes[d, codes.NODE_HIGH]
        ):
            bit = 1 << nodes[d, codes.NODE_VARIABLE]
            for corner in range(1 << part[codes.PART_VARIABLES]):
                table[corner] = table[corner | bit] if nodes[d, codes.NODE_WEAK] else table[corner & ~bit]


@inlined
def _step_channel(
    nodes: Integers, part: Integers, table: Floats, channel: int, mirror: int, memory: Memory,
    scratch: Scratch, position: int, begin: int, count: int,
) -> None:  # fmt: skip
    """Run `step_tables` in one channel; put the values of an ending run and the bounds into the scratch."""
    first, end, variables, end_corner = (
        part[codes.PART_FIRST],
        part[codes.PART_END],
        part[codes.PART_VARIABLES],
        part[codes.PART_END_CORNER],
    )
    corners = 1 << variables
    columns, values, fresh, point = scratch.columns, scratch.values, scratch.fresh, scratch.point
    ends, lows, highs = scratch.series[0], scratch.series[1], scratch.series[2]
    if position == 0:
        _start(nodes, part, table, values)
    elif table[0] == table[corners - 1]:
        # it says the same whatever comes
        for k in range(count):
            ends[k] = lows[k] = highs[k] = table[0]
        return
    _fill_columns(nodes, part, channel, mirror, memory.history, begin, count, columns)
    anchored = (
        _is_anchored(nodes[end - 1, codes.NODE_CODE]) or nodes[end - 1, codes.NODE_CODE] == codes.PART_OR
    )
    if variables == 1 and not anchored:
        _step_simple(nodes[end - 1], table, columns, count, end_corner, ends, lows, highs)
        return
    for k in range(count):
        elapsed_ns = memory.stamps[begin + k] - memory.clock[START_NS]
        for d in range(first, end):
            # what depends on no variable is the same at every corner
            if not nodes[d, codes.NODE_DEPENDS]:
                values[d - first] = columns[d - first, k]
        for corner in range(corners):
            for d in range(first, end):
                if not nodes[d, codes.NODE_DEPENDS]:
                    continue
                code, a, b = nodes[d, codes.NODE_CODE], nodes[d, codes.NODE_A], nodes[d, codes.NODE_B]
                if code == codes.PART_AND:
                    value = min(values[a], values[b])
                elif code == codes.PART_OR:
                    value = max(values[a], values[b])
                else:
                    variable = nodes[d, codes.NODE_VARIABLE]
                    later = np.inf if (corner >> variable) & 1 else -np.inf
                    # the two that most formulas are made of come without a call
                    if code == codes.UNTIL:
                        value = max(values[b], min(values[a], later) if a >= 0 else later)
                    elif code == codes.RELEASE:
                        value = min(values[b], max(values[a], later) if a >= 0 else later)
                    else:
                        value = _expand_anchored(nodes[d], values, later, position + k, elapsed_ns)
                    point[variable] = value
                values[d - first] = value
            fresh[corner] = read_table(table, variables, point, scratch.order)
        for corner in range(corners):
            table[corner] = fresh[corner]
        if anchored:
            _close_windows(nodes, part, table, position + k, elapsed_ns)
        ends[k], lows[k], highs[k] = table[end_corner], table[0], table[corners - 1]


@uncounted
def _step_simple(
    node: Integers,
    table: Floats,
    columns: Floats,
    count: int,
    end_corner: int,
    ends: Floats,
    lows: Floats,
    highs: Floats,
) -> None:
    """Run `step_tables` for a single until or release: a table of two numbers."""
    low, high = table[0], table[1]
    a, b = node[codes.NODE_A], node[codes.NODE_B]
    until = node[codes.NODE_CODE] == codes.UNTIL
    for k in range(count):
        right = columns[b, k]
        if until:
            later_low = right
            later_high = max(right, columns[a, k]) if a >= 0 else np.inf
        else:
            later_low = min(right, columns[a, k]) if a >= 0 else -np.inf
            later_high = right
        low, high = max(low, min(later_low, high)), max(low, min(later_high, high))
        lows[k], highs[k] = low, high
        ends[k] = high if end_corner else low
    table[0], table[1] = low, high


@uncounted
def step_tables(
    nodes: Integers, parts: Integers, memory: Memory, scratch: Scratch, channels: int, position: int,
    begin: int, count: int,
) -> None:  # fmt: skip
    """Substitute samples into the tables of the parts without windows.

    Args:
        position: of the first of the `count` samples; they stand at `begin` in the history.
    """
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    ends, lows, highs = scratch.series[0], scratch.series[1], scratch.series[2]
    for p in range(parts.shape[0]):
        part, numbers = parts[p], scratch.parts[p]
        if not part[codes.PART_NUMBERS]:
            continue
        if part[codes.PART_KIND] != codes.TABLE:
            continue
        for channel in range(channels):
            table = memory.tables[
                channel,
                part[codes.PART_TABLE_START] : part[codes.PART_TABLE_START]
                + (1 << part[codes.PART_VARIABLES]),
            ]
            mirror = channel ^ nominal_high
            _step_channel(nodes, part, table, channel, mirror, memory, scratch, position, begin, count)
            for k in range(count):
                if channel == 0:
                    numbers[0, k] = ends[k]
                if channel == nominal_high:
                    numbers[1, k] = ends[k]
                if channel == wide_low:
                    numbers[4, k], numbers[6, k] = lows[k], ends[k]
                if channel == wide_low + nominal_high:
                    numbers[5, k], numbers[7, k] = highs[k], ends[k]
