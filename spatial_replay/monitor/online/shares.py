"""A long stretch of samples on several cores: each takes a section of them, or some numbers of the parts.

*Sections*: with nothing but bounded windows below an unbounded root, what is open at a sample depends on the
samples around it alone, and what has closed is no more than a bound. So other runs begin further on, each
as if nothing had closed before, and their numbers are bounded by what has closed in the sections before. The
run of the first section then says what all nodes are in the others, too, and takes the numbers of these piece
by piece.

*Shares*: nothing that is open in a part matters to another one, nor do the columns of one number to those of
another (see `windows`). So two runs of the same samples share these: the one that says what all nodes are
takes what it has not computed from the other, which goes ahead of it piece by piece.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from spatial_replay.cores import Work, drop
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.closing import CLOSING, is_settled
from spatial_replay.monitor.online.node_columns import cells_of, look_of
from spatial_replay.monitor.online.open_windows import is_plain, looks_of
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.state import BLOCK, NUMBERS, OFFSET, POSITION, Memory, know_no_columns

_LOWER, _UPPER = 1 << codes.LOWER, 1 << codes.UPPER

_AGAIN = ("columns", "joined", "window_ends")
"""What a copy of the memory computes again."""

_TWICE = 1.2
"""So many times the work it takes to have a part in both shares."""

_MOST_OF_WORK = 0.8
"""So much of the work at least is done in sections, or none."""

NARROW = 0.3
"""So much at most of what windows span is open where one thread is as fast as several."""

_SOON = 0.25
"""Windows that close within so much of a stretch are waited for before it is shared; within a fourth of that,
where a signal alone may outdo what is open."""

_ENTERING = 0.15
"""So much of the work is to enter the numbers of all nodes."""

_OWN = 2
"""So many times what it looks at before are a later section's own samples, at least."""

_BOUNDED = (
    codes.LITERAL, codes.PART_AND, codes.PART_OR, codes.PAST_DELAY, *codes.AHEAD_OF, *codes.PAST_WINDOWS,
)  # fmt: skip
"""Nodes that look at no more than the samples around a position."""

_Unit: TypeAlias = tuple[float, int, int]
"""What one run computes: its cost, the part, and the numbers, a bit for each."""


class Sections(NamedTuple):
    """A program in two, for the sections of a stretch.

    Attributes:
        early: all but the parts that `late` runs: of later sections, this is left to do.
        late: the parts that are run in sections, without a tree.
        samples, time_ns: so far ahead at most these look from a position.
    """

    early: Program
    late: Program
    samples: int
    time_ns: int


class SectionStart(NamedTuple):
    """Where a later section begins: the first sample that its run looks at, and the first of its own."""

    seen: int
    own: int


def open_share(program: Program, memory: Memory, left: int) -> float:
    """Return how much of what windows span is open in a run, infinity if never less than all of it.

    Where what a root joins is outdone by what it is already, positions matter no more long before their
    windows close (see `closing`), so that one thread is as fast as several. All of them matter to what a past
    operator is at the last sample, though. 0 if windows close for the first time soon.

    Args:
        left: the samples that are to be run.
    """
    position, offset = int(memory.clock[POSITION]), int(memory.clock[OFFSET])
    stamps, widest = memory.stamps[: position - offset], 0.0
    per_ns = (len(stamps) - 1) / max(int(stamps[-1] - stamps[0]), 1)
    for number, part in enumerate(program.parts):
        nodes = program.nodes[part[codes.PART_FIRST] : part[codes.PART_END]]
        if part[codes.PART_KIND] != codes.WINDOWED or cast(Any, is_settled).interpreted()(part, memory):
            continue
        if not part[codes.PART_NUMBERS] & codes.FIRST_NUMBERS:
            continue  # said by another part
        if part[codes.PART_VARIABLES] == 0 and part[codes.PART_LAST_IN] != number:
            continue  # soon over
        samples, time_ns = _horizon(nodes)
        width, base = samples + time_ns * per_ns, int(memory.cells[part[codes.PART_CELL_START]])
        far, is_counted = nodes[-1, codes.NODE_HIGH], nodes[-1, codes.NODE_UNIT] == codes.SAMPLES
        if far > 0 and far * (1 if is_counted else per_ns) + width - position <= left * _SOON:
            continue
        is_outdone = part[codes.PART_LIMIT] >= 0 or part[codes.PART_OUTDONE_BY] != codes.BY_NOTHING
        if part[codes.PART_IS_REMEMBERING] or not is_outdone:
            return np.inf
        if base > 0:
            # what closes within a block is absorbed with it
            widest = max(widest, (position - base) / (width + BLOCK))
        elif _begin_of(nodes, per_ns) > NARROW * width:
            return np.inf  # nothing is found before windows begin
        elif width > left * (_SOON if part[codes.PART_OUTDONE_BY] == codes.BY_VALUE else _SOON / 4):
            return np.inf
    return widest


def sections_of(program: Program, memory: Memory) -> Sections | None:
    """Return a program in two whose parts mostly look no further than bounded windows; None for another.

    Args:
        memory: of a run of the program; what has settled costs nothing.
    """
    own = np.zeros((2, len(program.parts)), np.int64)
    own[0] = codes.ALL_NUMBERS
    late = whole = 0
    samples = time_ns = 0
    for number, part in enumerate(program.parts):
        nodes = program.nodes[part[codes.PART_FIRST] : part[codes.PART_END]]
        if part[codes.PART_KIND] != codes.WINDOWED or cast(Any, is_settled).interpreted()(part, memory):
            continue
        if part[codes.PART_VARIABLES] == 0 or nodes[-1, codes.NODE_HIGH] > 0:
            continue  # soon over, mostly
        cost = int(np.count_nonzero(nodes[:, codes.NODE_CODE] != codes.LITERAL))
        whole += cost
        if _is_bounded(part, nodes):
            late += cost
            own[:, number] = 0, codes.ALL_NUMBERS
            counted, timed = _horizon(nodes)
            samples, time_ns = max(samples, counted), max(time_ns, timed)
    if not late or late < _MOST_OF_WORK * whole:
        return None
    first, second = _programs_of(program, own)
    return Sections(first, second, samples, time_ns)


def _is_bounded(part: Integers, nodes: Integers) -> bool:
    """Return whether a part is an unbounded root that joins what bounded windows are."""
    root = nodes[-1]
    is_root = root[codes.NODE_A] < 0 and root[codes.NODE_HIGH] <= 0
    if not cast(Any, is_plain).interpreted()(part) or not is_root:
        return False
    return bool(np.isin(nodes[:-1, codes.NODE_CODE], _BOUNDED).all())


def _begin_of(nodes: Integers, per_ns: float) -> float:
    """Return how far ahead, in samples, the first windows of a part's body begin: of several, the earliest.

    Args:
        per_ns: samples.
    """
    begins = list[float | None]()
    for node in nodes[:-1].tolist():
        operands = [begins[d] for d in (node[codes.NODE_A], node[codes.NODE_B]) if 0 <= d < len(begins)]
        known = (
            [] if node[codes.NODE_CODE] == codes.LITERAL else [each for each in operands if each is not None]
        )
        begin = min(known, default=None)
        if node[codes.NODE_CODE] in codes.AHEAD_OF:
            is_counted = node[codes.NODE_UNIT] == codes.SAMPLES
            begin = (begin or 0.0) + node[codes.NODE_LOW] * (1.0 if is_counted else per_ns)
        begins.append(begin)
    return begins[-1] or 0.0 if begins else 0.0


def _horizon(nodes: Integers) -> tuple[int, int]:
    """Return how far ahead a part's body looks at most: in samples, and in ns besides."""
    horizons = list[tuple[int, int]]()
    for node in nodes[:-1].tolist():
        operands = [horizons[d] for d in (node[codes.NODE_A], node[codes.NODE_B]) if 0 <= d < len(horizons)]
        if node[codes.NODE_CODE] == codes.LITERAL:
            operands = []
        samples, time_ns = (
            (max(ends, default=0) for ends in zip(*operands, strict=True)) if operands else (0, 0)
        )
        if node[codes.NODE_CODE] in codes.AHEAD_OF:
            far = max(node[codes.NODE_LOW], node[codes.NODE_HIGH])
            is_counted = node[codes.NODE_UNIT] == codes.SAMPLES
            samples, time_ns = samples + far * is_counted, time_ns + far * (not is_counted)
        horizons.append((samples, time_ns))
    return max(samples for samples, _ in horizons), max(time_ns for _, time_ns in horizons)


def _late_start(sections: Sections, times_ns: Integers, begin: int, own: int) -> int | None:
    """Return the first sample that a later section looks at.

    None if it looks at all samples from `begin` on, so that it gains nothing.

    Args:
        times_ns: (T,), of the stretch.
        begin, own: the first sample of the first section, and of this one.
    """
    # what has closed is absorbed some samples later
    newest = own - 1 - sections.samples - 2 * CLOSING - BLOCK
    if newest <= begin or sections.time_ns >= int(times_ns[newest]) - int(times_ns[begin]):
        return None
    start = int(np.searchsorted(times_ns, times_ns[newest] - sections.time_ns)) - 1
    return start if start > begin else None


def starts_of(sections: Sections, times_ns: Integers, begin: int, end: int, most: int) -> list[SectionStart]:
    """Return where the later sections of samples `begin` to before `end` begin; none if they gain nothing.

    The run of the first section enters the numbers of all nodes for all, so its section is shorter by as much
    as that takes. What the others look at before their own is work of theirs: so much at least is their own.

    Args:
        times_ns: as for `late_start`.
        most: so many sections at most.
    """
    middle = (begin + end) // 2
    seen = _late_start(sections, times_ns, begin, middle)
    if seen is None:
        return []
    before = (middle - seen) / (end - begin)
    for others in range(most - 1, 0, -1):
        # both take as long: first + ENTERING * (1 - first) and (1 - first) / others + before
        first = (1 / others + before - _ENTERING) / (1 / others + 1 - _ENTERING)
        # no later one looks at the first sample
        first = max(first, 1.25 * before)
        if (1 - first) / others >= _OWN * before:
            break
    else:
        return []
    ends = np.linspace(begin + first * (end - begin), end, others + 1).astype(int)[:-1].tolist()
    found = [_late_start(sections, times_ns, begin, own) for own in ends]
    starts = [SectionStart(seen, own) for seen, own in zip(found, ends, strict=True) if seen is not None]
    return starts if len(starts) == len(ends) else []


def begin_late(program: Program, memory: Memory, channels: int, position: int) -> None:
    """Have a run's parts begin at a position, as if nothing had closed before."""
    for part in _parts_run(program):
        base, boundary, _ = cast(Any, cells_of).interpreted()(part)
        memory.cells[base] = memory.cells[boundary] = position
        table = part[codes.PART_TABLE_START]
        memory.tables[:channels, table], memory.tables[:channels, table + 1] = -np.inf, np.inf


def closed_up_to(program: Program, memory: Memory) -> int:
    """Return the first position that some part of a program has not absorbed, of those that still matter."""
    closed = int(memory.clock[POSITION])
    for part in _parts_run(program):
        # what has settled absorbs no more, and bounds later sections to one number
        if not cast(Any, is_settled).interpreted()(part, memory):
            closed = min(closed, int(memory.cells[part[codes.PART_CELL_START]]))
    return closed


def bound_late(
    program: Program, tables: Floats, channels: int, which: tuple[Integers, Integers], numbers: Floats
) -> None:
    """Bound what a run says of samples of a later section by what has closed before.

    Args:
        program: that of later sections.
        tables: `Memory.tables` at the end of the section before.
        which: what the numbers are (see `numbers_of`).
        numbers: (K, T), changed.
    """
    for k, (number, look) in enumerate(np.transpose(which).tolist()):
        if look not in (2, 3):  # what a part is now, nothing before matters to
            channel = cast(Any, look_of).interpreted()(look, channels).channel
            table = program.parts[number, codes.PART_TABLE_START]
            np.clip(numbers[k], *tables[channel, table : table + 2], out=numbers[k])


def bound_memory(program: Program, late: Memory, tables: Floats, channels: int) -> None:
    """Bound the memory at the end of a later section as `bound_late` does numbers."""
    for part in _parts_run(program):
        table = part[codes.PART_TABLE_START]
        ends = slice(table, table + 2)
        for channel in range(channels):
            late.tables[channel, ends] = np.clip(late.tables[channel, ends], *tables[channel, ends])


def _parts_run(program: Program) -> Integers:
    parts: Integers = program.parts[program.parts[:, codes.PART_NUMBERS] & codes.FIRST_NUMBERS != 0]
    return parts


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
    return _programs_of(program, numbers)


def _programs_of(program: Program, numbers: Integers) -> tuple[Program, Program]:
    """Return a program as two, given which numbers of each part these compute, (2, P).

    The second one computes none of the tree.
    """
    numbers = numbers & program.parts[:, codes.PART_NUMBERS] & codes.FIRST_NUMBERS
    for number, host in enumerate(program.parts[:, codes.PART_LAST_IN].tolist()):
        # what a part is at the last sample comes with the value of the one that says so
        if host >= 0:
            numbers[:, number] |= np.where(numbers[:, host] & 1, codes.LAST_NUMBERS, 0)
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
    again = {name: np.empty_like(getattr(memory, name)) for name in _AGAIN}
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
        # signals are run by both, and whether they matter is said by the memory that they are in
        if part[codes.PART_NUMBERS] & 1 and part[codes.PART_KIND] != codes.CLAUSES:
            cell, table = part[codes.PART_CELL_START], part[codes.PART_TABLE_START]
            variables, tables = part[codes.PART_VARIABLES], part[codes.PART_TABLES]
            cells = slice(cell, cell + 1 + variables + tables)
            numbers = slice(table, table + (tables << variables))
            memory.cells[cells], memory.tables[:, numbers] = other.cells[cells], other.tables[:, numbers]
    know_no_columns(memory)
    return memory


class RunAhead:
    """Pieces of a stretch, run by another thread while the numbers of those before are worked with.

    Each begins when the one before is done, so that no two of these run at once.
    """

    def __init__(self, run: Callable[[int, int], Floats], pieces: Sequence[tuple[int, int]]) -> None:
        """Prepare it; `begin` is apart, so that what has to stop it can know it before it begins.

        Args:
            run: runs samples, given the first and the one after the last.
            pieces: one after the other.
        """
        self._run, self._pieces = run, pieces
        # half of a piece cannot be run again, as other work is that was interrupted
        self._works = {at: Work(partial(self._run_next, at), waits=True) for at in range(len(pieces))}

    def _run_next(self, at: int) -> Floats:
        numbers = self._run(*self._pieces[at])
        if at + 1 in self._works:
            self._works[at + 1].hand_out()
        return numbers

    def begin(self) -> None:
        """Have the first piece run."""
        self._works[0].hand_out()

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield the first sample of each piece, and what was run for it, once."""
        for at, (begin, _) in enumerate(self._pieces):
            numbers = self._works[at].result()
            del self._works[at]
            yield begin, numbers

    @staticmethod
    def stop(several: Iterable[RunAhead]) -> None:
        """Have no further piece begin of any, and wait until none is run."""
        drop([work for each in several for work in each._works.values()])


def numbers_of(program: Program) -> tuple[Integers, Integers]:
    """Return which numbers of which parts a run computes for another, as indices of the first two axes of
    `Scratch.parts`."""
    masks = program.parts[:, codes.PART_NUMBERS, None] >> np.arange(NUMBERS)
    parts, numbers = np.nonzero(masks & 1)
    return parts, numbers
