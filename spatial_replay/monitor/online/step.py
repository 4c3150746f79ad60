"""The evaluation of one program over one stream of samples, for monitors and replays.

Samples run in tiles: first the signals of a tile (subformulas without future operators, final at each
sample), then each part, then the tree as the user wrote it. The bits of a result do not depend on the length
of a tile, because the only arithmetic is minima, maxima and negation.

In one channel, a node has four numbers for each sample: value, now, lower and upper. In more channels (see
`codes`), it has eight numbers, the low and high ends of four values. The four values are the value, `now`,
the value over every continuation, and the value if the run ends with the sample. A node's number depends on
its operands' numbers in the same row. A negation's number depends on the mirror row.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.geometry.arrays import Empty, Floats, Integers
from spatial_replay.monitor.atoms.live import SampleRoom, measure_sample
from spatial_replay.monitor.online import codes, windows
from spatial_replay.monitor.online.codes import CHANNELS, in_channels
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.signals import (
    ENTERING,
    EXTRA_ROWS,
    HEAD,
    RING,
    TAIL,
    run_signals,
    run_table,
)
from spatial_replay.monitor.online.windows import run_windows

NUMBERS = 8
"""Number of rows for the numbers of a node or part."""
SERIES = 4
"""Number of result rows of a node: value, now, lower and upper."""


@inlined
def _mirror(row: int, channels: int) -> int:
    if channels > 1:
        return row ^ 1
    # value and now are their own mirrors; lower and upper swap
    return row if row < 2 else 5 - row


@inlined
def _channel(row: int, channels: int) -> int:
    if channels == 1:
        return 0
    # value and now are nominal, the other two numbers have uncertainty
    return row & 1 if row < 4 or channels == 2 else 2 + (row & 1)


@inlined
def result_row(mode: int, channel: int, channels: int) -> int:
    """Return the row of a part's result in a channel, for a mode such as `OPEN_END`; -1 without a result."""
    if channels == 1:
        return 0 if mode == codes.OPEN_END else 1 + mode
    if mode == codes.OPEN_END:
        return channel if channel < 2 else -1
    return 3 + mode if channel == channels - 3 + mode else -1


@inlined
def _combine(code: int, left: float, left_mirror: float, right: float, right_mirror: float) -> float:
    """Return the lower end of a Boolean operator over two intervals. The upper end is its mirror image."""
    if code == codes.REPORT_XOR:
        return max(min(left, -right_mirror), min(-left_mirror, right))
    if code == codes.REPORT_IMPLIES:
        return max(-left_mirror, right)
    return min(max(-left_mirror, right), max(-right_mirror, left))


@inlined
def _join(code: int, work: Floats, target: int, source: int, count: int) -> None:
    if code == codes.REPORT_AND:
        for sample in range(count):
            work[target, sample] = min(work[target, sample], work[source, sample])
    else:
        for sample in range(count):
            work[target, sample] = max(work[target, sample], work[source, sample])


@inlined
def _copy(work: Floats, source: int, target: int, count: int) -> None:
    for sample in range(count):
        work[target, sample] = work[source, sample]


@inlined
def _fill(work: Floats, target: int, value: float, count: int) -> None:
    for sample in range(count):
        work[target, sample] = value


@piece
def report(
    rows: Integers, history: Floats, memory: Floats, work: Floats, channels: int, begin: int, count: int
) -> None:
    """Compute the numbers of every node over `count` samples, operands first.

    Args:
        rows: rows of a program (see `Program`).
        history, memory: history and memory of the signals (see `run_signals`).
        work: numbers of the parts, then the output: numbers of the nodes, and the series.
        begin: place of the first of the `count` samples in the history.
    """
    first_report, node_count = rows[0, codes.HEAD_REPORTS_AT], rows[0, codes.HEAD_REPORTS]
    operands_begin, width = rows[0, codes.HEAD_OPERANDS_AT], rows.shape[1]
    nodes_begin, row_count = NUMBERS * rows[0, codes.HEAD_PARTS], SERIES if channels == 1 else NUMBERS
    for node in range(node_count - 1, -1, -1):
        row = first_report + node
        code, index, rule = (
            rows[row, codes.REPORT_CODE],
            rows[row, codes.REPORT_INDEX],
            rows[row, codes.REPORT_RULE],
        )
        operand_start, operand_stop, left_begin, right_begin = (
            rows[row, codes.REPORT_FIRST],
            rows[row, codes.REPORT_END],
            0,
            0,
        )
        if operand_stop > operand_start:
            left_begin = (
                nodes_begin + NUMBERS * rows[operands_begin + operand_start // width, operand_start % width]
            )
            right_begin = (
                nodes_begin
                + NUMBERS * rows[operands_begin + (operand_stop - 1) // width, (operand_stop - 1) % width]
            )
        for number_row in range(row_count):
            target_row, part_row, mirror_row = (
                nodes_begin + NUMBERS * node + number_row,
                NUMBERS * index + number_row,
                _mirror(number_row, channels),
            )
            channel, is_now = (
                _channel(number_row, channels),
                number_row == 1 if channels == 1 else number_row in (2, 3),
            )
            if is_now and code == codes.REPORT_SIGNAL:
                for sample in range(count):
                    work[target_row, sample] = history[channel, index, begin + sample]
            elif code == codes.REPORT_SIGNAL:  # the value of a signal at the first sample is final
                _fill(work, target_row, memory[channel, rows[0, codes.HEAD_SIGNALS] + index], count)
            elif code == codes.REPORT_PART:
                if not is_now or rule == codes.NOW_OF_PART:
                    _copy(work, part_row, target_row, count)
                elif rule in (codes.NOW_LAST_OPERAND, codes.NOW_EITHER):
                    _copy(work, right_begin + number_row, target_row, count)
                    if rule == codes.NOW_EITHER:
                        _join(codes.REPORT_OR, work, target_row, left_begin + number_row, count)
                else:
                    _fill(work, target_row, np.inf if rule == codes.NOW_TRUE else -np.inf, count)
            elif code == codes.REPORT_NOT:
                for sample in range(count):
                    work[target_row, sample] = -work[left_begin + mirror_row, sample]
            elif code in (codes.REPORT_AND, codes.REPORT_OR, codes.REPORT_SPEC):
                _copy(work, left_begin + number_row, target_row, count)
                for operand_index in range(operand_start + 1, operand_stop):
                    operand_begin = (
                        nodes_begin
                        + NUMBERS * rows[operands_begin + operand_index // width, operand_index % width]
                    )
                    _join(code, work, target_row, operand_begin + number_row, count)
            else:
                for sample in range(count):
                    work[target_row, sample] = _combine(
                        code,
                        work[left_begin + number_row, sample],
                        work[left_begin + mirror_row, sample],
                        work[right_begin + number_row, sample],
                        work[right_begin + mirror_row, sample],
                    )
    _write_series(work, nodes_begin, nodes_begin + NUMBERS * node_count, node_count, channels, count)


@inlined
def _write_series(
    work: Floats, nodes_begin: int, series_begin: int, node_count: int, channels: int, count: int
) -> None:
    """Write value, now, lower and upper of every node, and NaN where the ends of value or now differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers have equal bits.
    """
    for node in range(node_count):
        for number_row in range(SERIES):
            target_row, source_row = (
                series_begin + SERIES * node + number_row,
                nodes_begin + NUMBERS * node + number_row,
            )
            if channels > 1 and number_row < 2:
                source_row += number_row
                for sample in range(count):
                    low, high = work[source_row, sample], work[source_row + 1, sample]
                    work[target_row, sample] = low + 0.0 if low == high else np.nan
            else:
                source_row += 0 if channels == 1 else 2
                for sample in range(count):
                    work[target_row, sample] = work[source_row, sample] + 0.0


TILE = 1024
"""Number of samples in a tile: enough to amortise kernel calls, few enough for the CPU cache."""

ROOM = 256
"""Initial capacity of a live run in recent samples, small enough for the CPU cache."""

BEGIN, FINISH = 1, 2
"""Phases of `run_samples`: BEGIN runs signals and parts without windows, FINISH runs all nodes."""
_UNKNOWN = -2
"""Entry of `KNOWN` for a set of columns without a sample."""


@kernel
def run_samples(
    rows: Integers, leaves: Floats, history: Floats, times: Integers, memory: Floats, work: Floats,
    first_leaf: int, t: int, count: int, position: int, begin: int, start_ns: int, phases: int,
) -> None:  # fmt: skip
    """Run samples through a program, except for its parts with windows.

    Args:
        rows: rows of the program.
        leaves: (C, A, T). The leaves of this program begin at `first_leaf`, and its samples at `t`.
        history: (4, S, room), signals at the recent samples, by channel.
        times: (1 + 4 W, room + RING), times of the recent samples, then rings of sliding windows, by channel.
        memory: (4, …), each signal at the last and at the first sample, then the tables of parts.
        work: rows for the numbers of parts and nodes, for the series, and for intermediate numbers.
        position: index in the run of the first of the `count` samples.
        begin: place of this first sample in the history.
    """
    channel_count, signal_count, part_count = (
        leaves.shape[0],
        rows[0, codes.HEAD_SIGNALS],
        rows[0, codes.HEAD_PARTS],
    )
    if phases & BEGIN:
        run_signals(rows, leaves, first_leaf, t, count, position, begin, start_ns, history, times, memory)
        free_row = NUMBERS * part_count + (NUMBERS + SERIES) * rows[0, codes.HEAD_REPORTS]
        for part_number in range(part_count):
            part_row = rows[0, codes.HEAD_PARTS_AT] + part_number
            table_begin = 2 * signal_count + rows[part_row, codes.PART_TABLE_START]
            for channel in range(channel_count if rows[part_row, codes.PART_KIND] == codes.TABLE else 0):
                first_result = run_table(
                    rows,
                    part_row,
                    history,
                    channel,
                    memory,
                    table_begin,
                    work,
                    free_row,
                    position,
                    begin,
                    count,
                )
                for mode in range(3):
                    row = result_row(mode, channel, channel_count)
                    if row >= 0:
                        for sample in range(count):
                            work[NUMBERS * part_number + row, sample] = work[first_result + mode, sample]
                if channel_count > 1 and channel >= channel_count - 2:
                    for sample in range(count):
                        work[NUMBERS * part_number + 6 + (channel & 1), sample] = work[first_result, sample]
    if phases & FINISH:
        report(rows, history, memory, work, channel_count, begin, count)


@kernel
def run_sample(
    whole: Integers, real: Floats, sample: Floats, end: int, leaves: Floats, rows: Integers,
    history: Floats, times: Integers, memory: Floats, work: Floats, numbers: Floats, channels: int,
    first_leaf: int, time_ns: int, position: int, begin: int, start_ns: int, run_channels: int, phases: int,
) -> int:  # fmt: skip
    """Measure the leaves of one sample and run it through a program, as `run_samples` does.

    Args:
        whole, real, sample, end, leaves: arguments of `measure_sample`.
        numbers: (N, 4), output: value, now, lower and upper of each node.
        channels: number of channels of the leaves; 0 if the leaves are not measured yet.
        run_channels: number of channels of the state. If the leaves have more channels, the program does not
            run.

    Returns:
        the number of channels of the leaves.
    """
    if channels == 0:
        # the same kernel measures, because an update by two kernels took 1.4 times as long
        channels = measure_sample(whole, real, sample, end, leaves)
        # a run with more channels than the leaves reads copies (see `codes.in_channels`)
        for channel in range(channels, CHANNELS):
            for leaf in range(leaves.shape[1]):
                leaves[channel, leaf, 0] = leaves[channel % channels, leaf, 0]
    if channels > run_channels:
        return channels
    if phases & BEGIN:
        times[0, begin] = time_ns
    run_samples(
        rows, leaves[:run_channels], history, times, memory, work, first_leaf, 0, 1, position, begin,
        start_ns, phases,
    )  # fmt: skip
    if phases & FINISH:
        series_begin = NUMBERS * (rows[0, codes.HEAD_PARTS] + rows[0, codes.HEAD_REPORTS])
        for node in range(numbers.shape[0]):
            for number_row in range(SERIES):
                numbers[node, number_row] = work[series_begin + SERIES * node + number_row, 0]
    return channels


class _OpenPart:
    """State of one part with windows in one channel, for `run_windows`.

    Args:
        rows: rows of the part's nodes, then the row of the part.
        room: capacity in recent samples.
    """

    def __init__(self, rows: Integers, room: int) -> None:
        node_count, part, timed_count = len(rows) - 1, rows[-1], int(rows[:-1, codes.NODE_TIMED].max()) + 1
        variable_count, table_count = int(part[codes.PART_VARIABLES]), int(part[codes.PART_TABLES])
        self.rows, self._node_count = rows, node_count
        self.tables = np.zeros((2 * table_count + 2, max(1 << variable_count, table_count)))
        self.columns = np.empty((windows.EXTRA * node_count + windows.EXTRA_ROWS, room))
        state_width = max(room, node_count, windows.NEXT + 2 * timed_count)
        self.state = np.zeros((windows.STARTS + 2 * timed_count, state_width), np.int64)
        self.state[windows.HEAD, windows.KNOWN : windows.KNOWN + windows.SETS] = _UNKNOWN
        self.state[windows.STATE, :node_count] = -1

    def copy(self, room: int) -> _OpenPart:
        """Return a copy of the state without the columns, which are computed again."""
        part = _OpenPart(self.rows, room)
        part.tables[:] = self.tables
        part.state[windows.HEAD, : windows.ENTERED] = self.state[windows.HEAD, : windows.ENTERED]
        part.state[windows.LOWS : windows.STARTS, : self._node_count] = self.state[
            windows.LOWS : windows.STARTS, : self._node_count
        ]
        return part

    def forget(self, drop_count: int) -> None:
        """Shift all positions after the oldest samples were dropped."""
        head = self.state[windows.HEAD]
        head[windows.OFFSET] += drop_count
        head[windows.BASE] -= drop_count
        # windows in seconds are recorded again for the new positions
        head[windows.ENTERED :] = 0
        head[windows.KNOWN : windows.KNOWN + windows.SETS] = _UNKNOWN
        self.state[[windows.LOWS, windows.BOUNDARY], : self._node_count] -= drop_count
        # -1 marks a node without a state, and is not shifted
        self.state[windows.STATE, : self._node_count] -= np.where(
            self.state[windows.STATE, : self._node_count] < 0, 0, drop_count
        )

    @property
    def kept_from(self) -> int | None:
        """The first position that the part may still read; None if the part reads no position."""
        is_begun, last_corner = (
            self.state[windows.HEAD, windows.IS_BEGUN],
            (1 << self.rows[-1, codes.PART_VARIABLES]) - 1,
        )
        # the extreme corners of a monotone table bound all other corners
        is_constant = is_begun and self.tables[0, 0] == self.tables[0, last_corner]
        if is_constant and not self.rows[-1, codes.PART_HAS_NOW]:
            return None
        return int(self.state[windows.LOWS, : self._node_count].min())


class OnlineRun:
    """The state of a compiled formula between samples.

    The size of the state depends on the formula and on the samples in its windows, not on the length of the
    stream.

    Attributes:
        room: capacity in recent samples.
    """

    def __init__(self, program: Program, *, room: int = 2 * TILE, tile: int = TILE) -> None:
        """Start before the first sample.

        Args:
            room: initial capacity in recent samples. The capacity doubles when needed.
            tile: limit on samples that run together.
        """
        self._program, self._tile = program, tile
        self.room = room = max(room, tile) if program.keeps_history else tile
        signal_count, part_count, node_count = len(program.signals), len(program.parts), len(program.reports)
        self._history = np.zeros((CHANNELS, signal_count, room))
        self._times = np.zeros((1 + CHANNELS * program.windows, room + RING), np.int64)
        self._memory = np.zeros((CHANNELS, 2 * signal_count + program.table_size))
        most_rows = max((len(rows) for rows in program.part_rows), default=0)
        most_corners = 1 << max((int(part[codes.PART_VARIABLES]) for part in program.parts), default=0)
        work_shape = (
            NUMBERS * part_count + (NUMBERS + SERIES) * node_count + most_rows + EXTRA_ROWS,
            max(tile, most_rows, most_corners),
        )
        self._work = np.zeros(work_shape)
        series_begin = NUMBERS * (part_count + node_count)
        self._numbers = self._work[NUMBERS * part_count : series_begin].reshape(
            node_count, NUMBERS, work_shape[1]
        )
        self._series = self._work[series_begin : series_begin + SERIES * node_count].reshape(
            node_count, SERIES, work_shape[1]
        )
        self._numbers_shape = node_count, SERIES
        self._begin()

    def restart(self) -> None:
        """Drop all samples, but keep the capacity."""
        for state in (self._history, self._times, self._memory):
            state.fill(0)
        self._begin()

    def _begin(self) -> None:
        self._channels, self._position, self._offset, self._start_ns = 1, 0, 0, 0
        self._newest_place = 0  # place of the newest sample's numbers
        self._open_parts = [
            (number, [_OpenPart(rows, self.room)])
            for number, rows in enumerate(self._program.part_rows)
            if rows[-1, codes.PART_KIND] == codes.WINDOWED
        ]
        self._refresh_views()

    def __len__(self) -> int:
        """Return the number of added samples."""
        return self._position

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the run ends here."""
        ends = [0, 0] if self._channels == 1 else [6, 7]
        # adding zero turns -0.0 into 0.0
        return np.asarray(self._numbers[:, ends, self._newest_place] + 0.0)

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), leaves of the program. With C = 1, they are exact values. With C = 2, they are
                ends of intervals, because values are unknown. With C = 4, the ends with uncertainty follow.
            times_ns: (T,), increasing and after the previous samples.
            empty: allocator of the result.

        Returns:
            (N, 4, T): value, now, lower and upper of each node.

        Raises:
            ValueError: the shapes do not match, so kernels would read beyond the arrays.
        """
        leaf_shape = len(self._program.leaves), len(times_ns)
        if leaves.shape[1:] != leaf_shape or len(leaves) not in (1, 2, 4):
            raise ValueError(
                f"leaves have the shape {leaves.shape}; the program needs (1, 2 or 4, *{leaf_shape})"
            )
        self.widen(len(leaves))
        # a copy, because kernels are compiled for writable arrays in C order
        leaves = np.array(in_channels(leaves, self._channels), np.float64, order="C")
        series, begin = empty((len(self._program.reports), SERIES, len(times_ns))), 0
        while begin < len(times_ns):
            sample_count = self._make_room(min(self._tile, len(times_ns) - begin))
            self._add(leaves, times_ns[begin : begin + sample_count], begin, sample_count)
            series[:, :, begin : begin + sample_count] = self._series[:, :, :sample_count]
            begin += sample_count
        return series

    def widen(self, channels: int) -> None:
        """Extend the state to `channels`. A new channel starts as a copy of the channel that it equalled."""
        if channels <= self._channels:
            return
        old_channels, self._channels = self._channels, channels
        for state in (self._history, self._memory, self._rings().swapaxes(0, 1)):
            if old_channels == 1:
                state[1] = state[0]
            state[2:] = state[:2]
        for _, parts in self._open_parts:
            parts += [
                parts[channel % old_channels].copy(self.room) for channel in range(old_channels, channels)
            ]
        self._refresh_views()

    def add_sample(self, room: SampleRoom, first_leaf: int, time_ns: int) -> Floats:
        """Add one sample, and return value, now, lower and upper of each node, (N, 4).

        Args:
            room: memory with the sample. Its leaves are measured if needed.
            first_leaf: index of the program's first leaf in the memory.
        """
        program, position = self._program, self._position
        if not program.keeps_history:
            self._offset = position
        elif position - self._offset == self.room:
            self._make_room(1)
        begin = position - self._offset
        if position == 0:
            self._start_ns = time_ns
        numbers = np.empty(self._numbers_shape)
        phases = BEGIN if self._open_parts else BEGIN | FINISH
        # if a sample needs more channels than the run has, it is run again after `widen`
        while True:
            room.channels = channels = run_sample(
                *room.arguments, *self._arrays, numbers,
                room.channels, first_leaf, time_ns, position, begin, self._start_ns, self._channels, phases,
            )  # fmt: skip
            if channels > self._channels:
                self.widen(channels)
            elif phases & FINISH:
                break
            else:
                self._run_all_open(begin, 1)
                phases = FINISH
        self._position, self._newest_place = position + 1, 0
        return numbers

    def _add(self, leaves: Floats, times_ns: Integers, t: int, count: int) -> None:
        """Add samples within the capacity.

        Args:
            leaves: (C, A, T) with as many channels as the run.
            times_ns: times of the samples.
            t: index in `leaves` of the first added sample.
        """
        if not self._program.keeps_history:
            self._offset = self._position
        begin = self._position - self._offset
        self._stamps[begin : begin + count] = times_ns
        if self._position == 0:
            self._start_ns = int(self._stamps[begin])
        kernel_arrays = self._program.rows, leaves, self._history, self._times, self._memory, self._work
        kernel_numbers = 0, t, count, self._position, begin, self._start_ns
        if not self._open_parts:
            run_samples(*kernel_arrays, *kernel_numbers, BEGIN | FINISH)
        else:
            run_samples(*kernel_arrays, *kernel_numbers, BEGIN)
            self._run_all_open(begin, count)
            run_samples(*kernel_arrays, *kernel_numbers, FINISH)
        self._position += count
        self._newest_place = count - 1

    def _run_all_open(self, begin: int, count: int) -> None:
        for part_number, parts in self._open_parts:
            for channel, part in enumerate(parts):
                self._run_open(part_number, channel, part, begin, count)

    def _run_open(self, part_number: int, channel: int, part: _OpenPart, begin: int, count: int) -> None:
        channels, is_high = self._channels, channel & 1
        # bounds include uncertainty, so they come from the last two channels
        bounds = 3 if channels == 1 else 1 << is_high if channel >= channels - 2 else 0
        run_windows(
            part.rows, self._channel_history[channel], self._stamps, part.columns, part.state, part.tables,
            begin, count, bounds,
        )  # fmt: skip
        results = part.columns[-SERIES:, :count]
        rows = self._work[NUMBERS * part_number : NUMBERS * (part_number + 1), :count]
        if channels == 1:
            rows[:SERIES] = results
            return
        if channel < 2:
            rows[is_high], rows[2 + is_high] = results[0], results[windows.RESULT_NOW]
        if bounds:
            rows[4 + is_high], rows[6 + is_high] = results[2 + is_high], results[0]

    def _refresh_views(self) -> None:
        """Renew the views of the recent samples, and the arrays for `run_sample`."""
        self._stamps = self._times[0, : self.room]
        self._arrays = self._program.rows, self._history, self._times, self._memory, self._work
        self._channel_history = [self._history[channel] for channel in range(CHANNELS)]

    def _rings(self) -> Integers:
        """Return the rings of sliding windows, (W, CHANNELS, …)."""
        return self._times[1:].reshape(-1, CHANNELS, self._times.shape[1])

    def _make_room(self, requested_count: int) -> int:
        """Make room for at least one of the requested samples, and return the number of samples that fit."""
        if not self._program.keeps_history:
            return min(requested_count, self.room)
        used_count = self._position - self._offset
        if used_count + requested_count > self.room:
            drop_count = self._kept_from() if used_count else 0
            # to drop less than half would move numbers often, so the capacity doubles instead
            if 2 * drop_count >= self.room:
                self._forget(drop_count, used_count - drop_count)
                used_count -= drop_count
            elif used_count == self.room:
                self._grow()
        return min(requested_count, self.room - used_count)

    def _kept_from(self) -> int:
        """Return the first of the recent samples that later samples may still read."""
        last_place = self._position - self._offset - 1
        first_needed, stamps = last_place, self._stamps[: last_place + 1]
        for code, _, _, unit, low, high, *_ in self._program.signals.tolist():
            if code not in (codes.DELAY, *codes.RINGS):
                continue
            far_distance = low if code == codes.DELAY else high
            if unit == codes.SAMPLES:
                first_needed = min(first_needed, last_place - far_distance)
            else:
                distances_ns = stamps[last_place] - stamps
                # a delay also reads the last sample beyond the distance
                first_needed = min(
                    first_needed, int(np.count_nonzero(distances_ns > far_distance)) - (code == codes.DELAY)
                )
        for _, parts in self._open_parts:
            for part in parts:
                part_start = part.kept_from
                first_needed = first_needed if part_start is None else min(first_needed, part_start)
        return max(first_needed, 0)

    def _forget(self, drop_count: int, keep_count: int) -> None:
        """Drop the oldest samples, which later samples do not read."""
        self._stamps[:keep_count] = self._stamps[drop_count : drop_count + keep_count].copy()
        signals = np.flatnonzero(self._program.signals[:, codes.SIGNAL_IS_KEPT])
        for signal in signals.tolist():
            signal_numbers = self._history[: self._channels, signal]
            signal_numbers[:, :keep_count] = signal_numbers[:, drop_count : drop_count + keep_count].copy()
        for _, parts in self._open_parts:
            for part in parts:
                part.forget(drop_count)
        self._offset += drop_count

    def _grow(self) -> None:
        """Double the capacity."""
        old_room, self.room = self.room, 2 * self.room
        new_history = np.zeros((*self._history.shape[:2], self.room))
        new_history[: self._channels, :, :old_room] = self._history[: self._channels]
        new_times = np.zeros((len(self._times), self.room + RING), np.int64)
        new_times[0, :old_room] = self._stamps
        for ring, new_ring in zip(self._times[1:], new_times[1:], strict=True):
            # places in a ring are modulo the capacity, which changes
            entries = np.arange(ring[HEAD], ring[TAIL])
            new_ring[[HEAD, TAIL, ENTERING]] = ring[[HEAD, TAIL, ENTERING]]
            new_ring[RING + entries % self.room] = ring[RING + entries % old_room]
        self._history, self._times = new_history, new_times
        for _, parts in self._open_parts:
            parts[:] = [part.copy(self.room) for part in parts]
        self._refresh_views()
