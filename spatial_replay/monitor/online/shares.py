"""A long stretch of samples on two cores, each of which computes some numbers of the parts with windows.

Nothing that is open in a part matters to another one, nor do the columns of one number to those of another
(see `windows`). So two runs of the same samples share these: the one that says what all nodes are takes what
it has not computed from the other, which goes ahead of it tile by tile.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias, cast

import numpy as np

from spatial_replay.cores import Work, drop
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.closing import is_settled
from spatial_replay.monitor.online.open_windows import looks_of
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.state import NUMBERS, OFFSET, POSITION, Memory, know_no_columns

_LOWER, _UPPER = 1 << 4, 1 << 5

_AGAIN = ("columns", "joined", "window_ends")
"""What a copy of the memory computes again."""

_TWICE = 1.2
"""So many times the work it takes to have a part in both shares."""

_Unit: TypeAlias = tuple[float, int, int]
"""What one run computes: its cost, the part, and the numbers, a bit for each."""


def shared_programs(program: Program, memory: Memory, channels: int) -> tuple[Program, Program] | None:
    """Return the program as two, each of which computes some numbers of the parts; None if one has most.

    The second one computes none of the tree.

    Args:
        memory: of a run of the program; what has settled costs nothing.
    """
    whole, divided = list[_Unit](), list[_Unit]()
    position = int(memory.clock[POSITION]) - 1
    for number, part in enumerate(program.parts):
        nodes = program.nodes[part[codes.PART_FIRST] : part[codes.PART_END]]
        if part[codes.PART_KIND] != codes.WINDOWED or cast(Any, is_settled).interpreted()(part, memory):
            continue
        looks = cast(Any, looks_of).interpreted()(part, nodes[-1], memory, channels, False, position)
        cost = float(np.count_nonzero(nodes[:, codes.NODE_CODE] != codes.LITERAL))
        # with four channels, a bound stands for two of these: apart, no run would have the part's whole table
        bounds = [bound for bound in (_LOWER, _UPPER) if looks & bound and channels < 4]
        whole.append((cost * int(looks).bit_count(), number, codes.ALL_NUMBERS))
        rest = cost * (int(looks).bit_count() - len(bounds))
        divided.append((_TWICE * rest if bounds else rest, number, codes.ALL_NUMBERS & ~sum(bounds)))
        divided += [(_TWICE * cost, number, bound) for bound in bounds]
    (lightest, numbers), *_ = sorted(
        map(partial(_assigned, program), (whole, divided)), key=lambda way: way[0]
    )
    if lightest >= 0.9 * sum(cost for cost, *_ in whole):
        return None
    first, second = (
        replace(program, parts=np.concatenate((program.parts[:, : codes.PART_NUMBERS], own[:, None]), axis=1))
        for own in numbers
    )
    return first, replace(second, reports=program.reports[:0])


def _assigned(program: Program, units: list[_Unit]) -> tuple[float, Integers]:
    """Share units out, dear ones first; return the cost of the longer share, and the numbers, (2, P)."""
    costs, numbers = [0.0, 0.0], np.zeros((2, len(program.parts)), np.int64)
    numbers[0] = codes.ALL_NUMBERS
    numbers[0, [number for _, number, _ in units]] = 0
    for cost, number, own in sorted(units, key=lambda unit: -unit[0]):
        # the first one has the tree, too
        share = int(costs[0] > 0 and costs[1] <= costs[0])
        costs[share] += cost
        numbers[share, number] |= own
    return max(costs), numbers


def copied(memory: Memory) -> Memory:
    """Return a copy of a run's memory, of which columns are to be computed again."""
    # zeros take up memory once they are touched
    again = {name: np.zeros(getattr(memory, name).shape, getattr(memory, name).dtype) for name in _AGAIN}
    others = {name: values.copy() for name, values in memory._asdict().items() if name not in again}
    copy = Memory(**others, **again)
    know_no_columns(copy)
    return copy


def joined_memory(programs: tuple[Program, Program], memories: tuple[Memory, Memory]) -> Memory:
    """Return the memory of a run that has computed all, from those of two that have shared its work."""
    # the one that remembers more of the samples has all that the other needs
    kept = int(memories[0].clock[OFFSET] > memories[1].clock[OFFSET])
    memory, other = memories[kept], memories[1 - kept]
    for part in programs[1 - kept].parts.tolist():
        # what is made of signals has no cells
        if part[codes.PART_NUMBERS] & 1 and part[codes.PART_KIND] != codes.CLAUSES:
            cell, table = part[codes.PART_CELL_START], part[codes.PART_TABLE_START]
            variables, tables = part[codes.PART_VARIABLES], part[codes.PART_TABLES]
            cells = slice(cell, cell + 1 + variables + tables)
            numbers = slice(table, table + (tables << variables))
            memory.cells[cells], memory.tables[:, numbers] = other.cells[cells], other.tables[:, numbers]
    know_no_columns(memory)
    return memory


def iter_ahead(
    run: Callable[[int, int], Floats], tiles: Sequence[tuple[int, int]]
) -> Generator[Floats, None, None]:
    """Yield what is run for each tile, the next of which another thread runs in the meantime.

    One is begun when the one before is done, so that no two threads run at once.

    Args:
        run: runs samples, given the first and the one after the last.
        tiles: one after the other.
    """

    def run_next(number: int) -> Floats:
        numbers = run(*tiles[number])
        if number + 1 in works:
            works[number + 1].hand_out()
        return numbers

    # half of a tile cannot be run again, as other work is that was interrupted
    works = {number: Work(partial(run_next, number), waits=True) for number in range(len(tiles))}
    try:
        works[0].hand_out()
        for number in range(len(tiles)):
            numbers = works[number].result()
            del works[number]
            yield numbers
    finally:
        drop(works.values())


def numbers_of(program: Program) -> tuple[Integers, Integers]:
    """Return which numbers of which parts a run computes for another, as indices of the first two axes of
    `Scratch.parts`."""
    masks = program.parts[:, codes.PART_NUMBERS, None] >> np.arange(NUMBERS)
    parts, numbers = np.nonzero(masks & 1)
    return parts, numbers
