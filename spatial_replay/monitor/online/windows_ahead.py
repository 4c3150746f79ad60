"""Windows ahead at the open positions of a part, brought up to the newest sample (see `node_columns`)."""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.node_columns import columns_number, look_of, signal_of
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    STRIDE,
    Recent,
    beyond,
    copy,
    either,
    extremum,
    fill,
    first_unclosed,
    first_up_to,
    is_decided,
    recent_of,
    run_to_last,
    slide_evenly,
    window_after,
    window_start,
)
from spatial_replay.monitor.online.state import OFFSET, behind

FEW = 8
"""So many new samples are joined with open windows one by one; of more, windows are computed again."""

MANY = 16
"""So many windows that have ended are looked through together, by vector instructions."""


@apart
def run_ahead(table_at: int, number: int, d: int, which: int, channels: int, since: int, last: int) -> int:
    """Bring the column of a window ahead up (see `join_operands`)."""
    tables, memory, scratch, _ = arrays_at(table_at)
    node, first, offset = tables.nodes[d], tables.parts[number, codes.PART_FIRST], memory.clock[OFFSET]
    look, recent = look_of(which, channels), recent_of(memory, scratch)
    columns, lowest, changed = (
        memory.columns[columns_number(which)],
        memory.lows[d],
        scratch.changed[node[codes.NODE_A]],
    )
    target, signal = columns[d], signal_of(tables.nodes, first + node[codes.NODE_A])
    source = columns[first + node[codes.NODE_A]] if signal < 0 else memory.history[look.channel, signal]
    is_greatest = node[codes.NODE_CODE] == codes.PART_WINDOW_MAX
    is_joined = since <= changed and since > offset and last - since < FEW
    if is_decided(node, look.mode):
        # those that have closed have changed, too
        tail = max(first_unclosed(node, recent, offset, last), lowest)
        changed, is_joined = max(min(changed, since - 1), offset), False
    else:
        tail = max(_first_unended(node, recent, offset, last), lowest)
    begin = max(first_up_to(node, codes.NODE_HIGH, recent, offset, last, changed), lowest)
    if is_joined:
        return _join_samples(node, source, target, begin, lowest, recent, offset, last, since)
    steady = max(_steady_from(node, source, changed, offset, last), begin)
    ended = min(steady, tail)
    begin = _run_ended(is_greatest, node, source, target, begin, ended, since, recent, offset, last)
    if ended < tail:
        fill(target[ended - offset : tail - offset], source[last - offset])
    if is_decided(node, look.mode):
        first_new = max(tail, since)
        fill(target[first_new - offset : last + 1 - offset], beyond(look.mode, node[codes.NODE_WEAK]))
    else:
        nothing = -np.inf if is_greatest else np.inf
        first_new = run_to_last(
            is_greatest, node, source, target, nothing, tail, changed, since, recent, offset, last
        )
    return int(begin if begin < tail else first_new)


@inlined
def _outdoes(is_greatest: bool, value: float, other: float) -> bool:
    return value > other if is_greatest else value < other


@inlined
def _join_samples(
    node: Integers, source: Floats, target: Floats, begin: int, lowest: int, recent: Recent, offset: int,
    last: int, since: int,
) -> int:  # fmt: skip
    """Join the new samples with the open windows that hold them, the first of which is that of `begin`.

    These windows all end with the sample, so that the later one begins, the less it holds: where one changes,
    so do those after it.

    Returns:
        The first position that changes.
    """
    is_greatest, changed = node[codes.NODE_CODE] == codes.PART_WINDOW_MAX, since
    for position in range(since, last + 1):
        value = source[position - offset]
        target[position - offset] = -np.inf if is_greatest else np.inf
        low, after = begin, position + 1
        if position > since:
            low = max(first_up_to(node, codes.NODE_HIGH, recent, offset, last, position), lowest)
        if node[codes.NODE_LOW] > 0:
            after = 1 + behind(recent.stamps, offset, position, node[codes.NODE_UNIT], node[codes.NODE_LOW])
        if low < after and _outdoes(is_greatest, value, target[low - offset]):
            after, first = low, after
            fill(target[low - offset : first - offset], value)
        while low + STRIDE <= after and _outdoes(is_greatest, value, target[after - STRIDE - offset]):
            fill(target[after - STRIDE - offset : after - offset], value)
            after -= STRIDE
        while low < after and _outdoes(is_greatest, value, target[after - 1 - offset]):
            after -= 1
            target[after - offset] = value
        changed = min(changed, after)
    # of windows that begin late, a sample is in none of the recent ones
    return max(changed, offset)


@inlined
def _steady_from(node: Integers, source: Floats, changed: int, offset: int, last: int) -> int:
    """Return the first position from which on windows hold but the newest number; after the last for none.

    So it is while a quantity goes one way: a window that it changes holds the newest number from end to end.
    """
    near, steady, stride = node[codes.NODE_LOW], last, STRIDE
    if node[codes.NODE_UNIT] != codes.SAMPLES and near > 0:
        return last + 1
    value = source[last - offset]
    while steady - stride >= changed:
        stretch = source[steady - stride - offset : steady - offset]
        if extremum(True, stretch, value) != value or extremum(False, stretch, value) != value:
            break
        steady, stride = steady - stride, 2 * stride
    return steady - near if steady < last else last + 1


@inlined
def _first_unended(node: Integers, recent: Recent, offset: int, last: int) -> int:
    """Return the first position whose window ahead ends with the last sample, or after it."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(max(last - node[codes.NODE_HIGH], offset))
    return int(recent.window_next[node[codes.NODE_TIMED], 2])


@inlined
def _run_ended(
    is_greatest: bool, node: Integers, source: Floats, target: Floats, begin: int, end: int, since: int,
    recent: Recent, offset: int, last: int,
) -> int:  # fmt: skip
    """Compute extrema over windows ahead that have ended, at begin … end - 1; return the first that changes.

    What all of these hold is looked through once, and then what the first ones hold before it, and the last
    ones after it.
    """
    nothing, before, changed = -np.inf if is_greatest else np.inf, recent.extrema[0], end
    width, first = node[codes.NODE_HIGH] - node[codes.NODE_LOW] + 1, begin + node[codes.NODE_LOW]
    # the wider these are, the more of what they hold is common to them, and looked through once below
    if node[codes.NODE_UNIT] == codes.SAMPLES and end - begin >= max(MANY, width // 2):
        kept = recent.extrema[0, len(recent.stamps) :]
        copy(target[begin - offset : end - offset], kept[: end - begin])
        slide_evenly(is_greatest, source, target, begin, end, first, width, recent.extrema, offset, last)
        changed = begin
        while changed < min(end, since) and kept[changed - begin] == target[changed - offset]:
            changed += 1
        return changed
    while begin < end:
        middle = window_after(node, recent, begin, offset, last)
        at = window_start(node, recent, end - 1, offset, last)
        beyond_last = end
        if at >= middle:
            beyond_last, at = begin + 1, window_start(node, recent, begin, offset, last)
            while window_start(node, recent, beyond_last, offset, last) < middle:
                at = window_start(node, recent, beyond_last, offset, last)
                beyond_last += 1
        value = extremum(is_greatest, source[at - offset : max(middle, at) - offset], nothing)
        for position in range(beyond_last - 1, begin - 1, -1):
            start = window_start(node, recent, position, offset, last)
            while at > start:
                at -= 1
                value = either(is_greatest, value, source[at - offset])
            before[position - begin] = value
        value = nothing
        for position in range(begin, beyond_last):
            after = window_after(node, recent, position, offset, last)
            while middle < after:
                value = either(is_greatest, value, source[middle - offset])
                middle += 1
            number = either(is_greatest, before[position - begin], value)
            if changed == end and (position >= since or target[position - offset] != number):
                changed = position
            target[position - offset] = number
        begin = beyond_last
    return changed
