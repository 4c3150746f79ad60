"""The arrays that kernels share: a run's memory and scratch space; positions of samples and window ends.
`stamps` holds the times of the samples offset, offset + 1, … of the run; `last` is the newest of them that
counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online.codes import (
    CHANNELS,
    HISTORICALLY,
    ONCE,
    PART_IS_NESTED,
    PART_KIND,
    SAMPLES,
    SIGNAL_IS_KEPT,
    WINDOWED,
)
from spatial_replay.monitor.online.program import Program

TILE = 256
"""How many samples are taken in together: enough to amortise the walk over a program's tables, few enough to
stay in the processor's cache."""

LONG_TILE = 1024
"""As many where a great many come together."""

NUMBERS = 8
"""Numbers of a node at a sample: low and high end of its value, of what it is now, of its value over every
continuation, and of its value if the run ends there."""


LOOKS = 6
"""How many of these a part with windows computes apart: what it is now comes with its value."""

JOINED = 64
"""So many open positions together are joined, of which only few change with a sample."""

POSITION, OFFSET, START_NS, KEEPS = range(4)
CLOCK = 4
"""What the clock of a run holds."""


class Memory(NamedTuple):
    """What is carried from sample to sample.

    Attributes:
        history: (CHANNELS, S, room), every signal at the recent samples.
        stamps: (room,), their times in ns.
        running: (CHANNELS, S), every signal at the last sample.
        firsts: (CHANNELS, S), every signal at the first sample.
        wedges: (W, CHANNELS, room), the positions in each ring of a signal.
        wedge_ends: (W, CHANNELS, 2), how many ever left and entered it.
        wedge_next: (W,), the next position to enter a sliding window.
        tables: (CHANNELS, ...), the parts' tables (see `tables`).
        cells: the parts' bookkeeping (see `windows`).
        columns: (LOOKS, D, room), the nodes of the parts with windows at the recent samples, for each number.
        known: (P, LOOKS), the last sample that each part's columns know, -1 for none.
        unjoined: (P, LOOKS), the first sample that is not yet in `joined`.
        joined: (LOOKS, P, room / JOINED), what the root of each part joins, so many positions at a time.
        lows: (D,), the first position of each of these nodes that matters.
        window_ends: (W, 2, room), where the windows in seconds ahead of the recent samples start, and what
            comes after them.
        window_next: (W, 3), the next sample to take in, and the next positions whose windows start and end.
        clock: (CLOCK,), the number of samples so far; the one that the recent samples begin with; the time
            of the first; 1 if more than the newest sample is looked at, else 0.
    """

    history: Floats
    stamps: Integers
    running: Floats
    firsts: Floats
    wedges: Integers
    wedge_ends: Integers
    wedge_next: Integers
    tables: Floats
    cells: Integers
    columns: Floats
    known: Integers
    unjoined: Integers
    joined: Floats
    lows: Integers
    window_ends: Integers
    window_next: Integers
    clock: Integers


class Scratch(NamedTuple):
    """Room to work in, of no meaning between two calls.

    Attributes:
        columns: (D, tile), a column per node of a part.
        corners: (D, room), the nodes of a part that depend on a variable, at one corner of its table.
        low, high, plain, changed: (D,), positions per node.
        values: (D,), a number per node.
        point, order: (16,), a point at which a table is read.
        starts: values that past operators start from, one per table.
        fresh: a part's next tables.
        extrema: (2, 2 * room), extrema over windows of growing width.
        ends: (2, room), where windows start and end.
        series: (3, tile), what one part says in one channel.
        parts: (P, NUMBERS, tile), what each part says.
        nodes: (N, NUMBERS, tile), what each node of the tree says.
    """

    columns: Floats
    corners: Floats
    low: Integers
    high: Integers
    plain: Integers
    changed: Integers
    values: Floats
    point: Floats
    order: Integers
    starts: Floats
    fresh: Floats
    extrema: Floats
    ends: Integers
    series: Floats
    parts: Floats
    nodes: Floats


def first_memory(program: Program, room: int) -> Memory:
    """Return the memory before the first sample, with room for some recent ones."""
    signals = len(program.signals)
    cells = np.zeros(program.cells, np.int64)
    nodes = len(program.nodes) if has_windows(program) else 0
    for _, _, variables, tables, _, cell, *_ in program.parts:
        cells[cell + 1 + variables : cell + 1 + variables + tables] = -1
    return Memory(
        history=np.zeros((CHANNELS, signals, room)),
        stamps=np.zeros(room, np.int64),
        running=np.zeros((CHANNELS, signals)),
        firsts=np.zeros((CHANNELS, signals)),
        wedges=np.zeros((program.windows, CHANNELS, room), np.int64),
        wedge_ends=np.zeros((program.windows, CHANNELS, 2), np.int64),
        wedge_next=np.zeros(program.windows, np.int64),
        tables=np.zeros((CHANNELS, program.table_size)),
        cells=cells,
        columns=np.zeros((LOOKS, nodes, room)),
        known=np.full((len(program.parts), LOOKS), -1),
        unjoined=np.zeros((len(program.parts), LOOKS), np.int64),
        joined=np.zeros((LOOKS, len(program.parts), room // JOINED + 1)),
        lows=np.zeros(nodes, np.int64),
        window_ends=np.zeros((program.timed, 2, room), np.int64),
        window_next=np.full((program.timed, 3), -1),
        clock=np.array([0, 0, 0, int(program.keeps_history)], np.int64),
    )


def has_windows(program: Program) -> bool:
    """Return whether any part is run over what is open."""
    return bool((program.parts[:, PART_KIND] == WINDOWED).any())


def scratch_for(program: Program, room: int, tile: int) -> Scratch:
    """Allocate scratch arrays for some recent samples, and for the samples added together."""
    widest = max((int(end - first) for first, end, *_ in program.parts), default=0)
    largest = max(((1 << int(part[2])) * int(part[3]) for part in program.parts), default=1)
    most_tables = max((int(part[3]) for part in program.parts), default=1)
    low, high, plain, changed = np.zeros((4, widest), np.int64)
    open_room = room if has_windows(program) else 0
    return Scratch(
        columns=np.zeros((widest, tile)),
        corners=np.empty((widest if program.parts[:, PART_IS_NESTED].any() else 0, room)),
        low=low,
        high=high,
        plain=plain,
        changed=changed,
        values=np.zeros(max(widest, 1)),
        point=np.zeros(16),
        order=np.zeros(16, np.int64),
        starts=np.zeros(most_tables),
        fresh=np.zeros(largest),
        extrema=np.empty((2, 2 * open_room)),
        ends=np.zeros((2, open_room), np.int64),
        series=np.zeros((3, tile)),
        parts=np.zeros((len(program.parts), NUMBERS, tile)),
        nodes=np.zeros((len(program.reports), NUMBERS, tile)),
    )


def widen(memory: Memory, before: int) -> None:
    """Copy into each new channel the state of the one of the `before` channels that it was equal to."""
    by_channel = (memory.running, memory.firsts, memory.tables, memory.history)
    by_window = (ring.swapaxes(0, 1) for ring in (memory.wedges, memory.wedge_ends))
    for state in (*by_channel, *by_window):
        if before == 1:
            state[1] = state[0]
        state[2:] = state[:2]
    know_no_columns(memory)


def know_no_columns(memory: Memory) -> None:
    """Have the columns of parts with windows computed again: positions have moved, or there are more."""
    memory.known[:] = -1
    memory.window_next[:] = -1


def with_room(memory: Memory, room: int, channels: int, signals: Integers) -> Memory:
    """Return the memory with more room for recent samples; only channels in use take up memory.

    Args:
        room: that of the memory, doubled any number of times.
        signals: (S, SIGNAL_WIDTH), those of the program; of some, only the newest sample is looked at.
    """
    old = len(memory.stamps)
    history = np.empty((*memory.history.shape[:2], room))
    for signal in np.flatnonzero(signals[:, SIGNAL_IS_KEPT]).tolist():
        history[:channels, signal, :old] = memory.history[:channels, signal]
    wedges = np.empty((*memory.wedges.shape[:2], room), np.int64)
    for window, channel in np.ndindex(len(wedges), channels):
        entries = np.arange(*memory.wedge_ends[window, channel, :2])
        wedges[window, channel, entries % room] = memory.wedges[window, channel, entries % old]
    know_no_columns(memory)
    return memory._replace(
        columns=np.empty((*memory.columns.shape[:2], room)),
        joined=np.empty((*memory.joined.shape[:2], room // JOINED + 1)),
        window_ends=np.empty((*memory.window_ends.shape[:2], room), np.int64),
        stamps=np.concatenate((memory.stamps, np.zeros(room - old, np.int64))),
        history=history,
        wedges=wedges,
    )


@inlined
def past_value(code: int, first: float, second: float, before: float) -> float:
    """Return an unbounded once, historically or since at a sample, from its value at the one before."""
    if code == ONCE:
        return max(first, before)
    if code == HISTORICALLY:
        return min(first, before)
    return max(second, min(first, before))


@uncounted
def first_after(stamps: Integers, offset: int, last: int, position: int, distance: int) -> int:
    """Return the first position, offset … last, at least `distance` ns after another; else last + 1."""
    return first_since(stamps, offset, last, stamps[position - offset], distance)


@uncounted
def first_since(stamps: Integers, offset: int, last: int, origin: int, distance: int) -> int:
    """Return the first position, offset … last, at least `distance` ns after a time; else last + 1.

    Times are compared by their differences, which fit where a time plus the distance might not.
    """
    low, high = 0, last - offset + 1
    while low < high:
        middle = (low + high) >> 1
        if stamps[middle] - origin < distance:
            low = middle + 1
        else:
            high = middle
    return offset + low


@uncounted
def ahead(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> int:
    """Return the first position at least a distance ahead (it may lie after `last`)."""
    if unit == SAMPLES:
        return position + distance
    if position > last:
        return last + 1
    return first_after(stamps, offset, last, position, distance)


@uncounted
def last_ahead(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> int:
    """Return the last known position at most a distance ahead: `last` at most."""
    if unit == SAMPLES:
        return min(position + distance, last)
    if position > last:
        return last
    return first_after(stamps, offset, last, position, distance + 1) - 1


@uncounted
def is_closed(stamps: Integers, offset: int, last: int, position: int, unit: int, distance: int) -> bool:
    """Return whether no later sample can fall into the window that ends a distance ahead of a position."""
    if position > last:
        return False
    if unit == SAMPLES:
        return position + distance <= last
    return bool(stamps[last - offset] - stamps[position - offset] >= distance)


@uncounted
def behind(stamps: Integers, offset: int, position: int, unit: int, distance: int) -> int:
    """Return the last position at least a distance behind; before `offset` if there is none."""
    if unit == SAMPLES:
        return position - distance
    return first_after(stamps, offset, position, position, 1 - distance) - 1


@uncounted
def first_behind(stamps: Integers, offset: int, position: int, unit: int, distance: int) -> int:
    """Return the first position at most a distance behind, `offset` at least."""
    if unit == SAMPLES:
        return max(position - distance, offset)
    return first_after(stamps, offset, position, position, -distance)
