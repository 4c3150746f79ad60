"""Operation codes and table columns shared by programs and kernels, and the channels of numbers.

Every number has up to four channels: the ends of its interval with every uncertainty at 0 (nominal low and
high), and the ends with uncertainty (wide low and high). Channels that are equal for the whole run are not
stored. A run without unknown values has one channel, and a run without uncertainty has two. A negation swaps
low and high: channel ^ 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from spatial_replay.geometry.arrays import Floats, join_arrays

SAMPLES, NANOSECONDS = 0, 1

# columns of signals
SIGNAL_CODE, SIGNAL_A, SIGNAL_B, SIGNAL_UNIT, SIGNAL_LOW, SIGNAL_HIGH, SIGNAL_WINDOW = range(7)
SIGNAL_IS_KEPT = 7  # whether the signal is also read at earlier samples
SIGNAL_WIDTH = 8
OFFLINE_TARGET = 6  # in offline rows instead of SIGNAL_WINDOW: the column that the row writes
OFFLINE_WIDTH = 7
# codes of signals
LEAF = 0  # leaf a
CONSTANT = 1  # infinity with the sign low
NOT, AND, OR = 2, 3, 4
ONCE, HISTORICALLY, SINCE = 7, 8, 9
WINDOW_MAX, WINDOW_MIN = 10, 11  # extremum of a over positions low to high back
DELAY = 12  # a at distance low back; before the first sample, infinity with the sign high
# infinity with the sign high at distances of at least low after the first sample, else the opposite infinity
ELAPSED = 31
RINGS = (WINDOW_MAX, WINDOW_MIN)  # store positions in a ring
AHEAD = 16  # added to ONCE and greater codes for the operator in reversed time (see `offline`)

# columns of parts' nodes
# a = -1 if the left operand is missing: `true` in an until, `false` in a release
NODE_CODE, NODE_A, NODE_B, NODE_WEAK, NODE_UNIT, NODE_LOW, NODE_HIGH = range(7)
NODE_VARIABLE, NODE_TABLE, NODE_DEPENDS = 7, 8, 9  # variable and table are -1 for none
NODE_TIMED = 10  # number of a window or shift in seconds within its part, -1 for none
NODE_WIDTH = 11
# codes of parts' nodes
LITERAL = 0  # signal a
PART_AND, PART_OR = 2, 3
# max(b, min(a, next)); min(b, max(a, next))
UNTIL, RELEASE = 4, 5
PART_WINDOW_MAX, PART_WINDOW_MIN = 6, 7  # extremum of a over positions low to high ahead
SHIFT = 8  # a at low ahead; positions of a up to high ahead are needed
AHEAD_OF = (PART_WINDOW_MAX, PART_WINDOW_MIN, SHIFT)
PAST_SINCE, PAST_TRIGGER = 9, 10  # max(b, min(a, previous)); min(b, max(a, previous))
PAST_WINDOW_MAX, PAST_WINDOW_MIN = 11, 12
PAST_DELAY = 13
PAST_WINDOWS = (PAST_WINDOW_MAX, PAST_WINDOW_MIN)
PAST = (PAST_SINCE, PAST_TRIGGER, *PAST_WINDOWS, PAST_DELAY)
BINARY_NODES = (PART_AND, PART_OR, UNTIL, RELEASE, PAST_SINCE, PAST_TRIGGER)

# columns of parts: rows of the nodes, the kind, numbers of variables and tables, the corner that ends a run,
# and the begin of the table in each channel (for parts without windows)
PART_FIRST, PART_END, PART_KIND, PART_VARIABLES, PART_TABLES, PART_END_CORNER, PART_TABLE_START = range(7)
# a bit for `OPEN_LOW` and a bit for `OPEN_HIGH`: whether the bound follows from the table alone, because
# later samples may exceed every pending position
PART_KNOWN = 7
PART_HAS_NOW = 8  # whether the part also reports its value at the newest sample
# whether the operand never falls (for a root that joins by the minimum) or never rises (by the maximum)
PART_IS_MONOTONE = 9
# kinds of parts
TABLE, WINDOWED = 0, 1  # see `signals`, `windows`

# columns of reports: index of the signal or part; rule for the number `now`
REPORT_CODE, REPORT_INDEX, REPORT_RULE, REPORT_FIRST, REPORT_END = range(5)
REPORT_WIDTH = 5
# codes of reports. Reports are nodes as written, so `xor`, `->` and `<->` have codes, too. A row for each
# node of an expansion would cost eight numbers per sample
REPORT_SIGNAL, REPORT_PART = 0, 1
REPORT_NOT, REPORT_AND, REPORT_OR, REPORT_XOR, REPORT_IMPLIES, REPORT_IFF, REPORT_SPEC = 2, 3, 4, 5, 6, 7, 8
REPORT_OF_BOOLEAN = MappingProxyType(
    {
        "not": REPORT_NOT,
        "and": REPORT_AND,
        "or": REPORT_OR,
        "xor": REPORT_XOR,
        "->": REPORT_IMPLIES,
        "<->": REPORT_IFF,
        "spec": REPORT_SPEC,
    }
)
NOW_LAST_OPERAND, NOW_EITHER, NOW_TRUE, NOW_FALSE, NOW_OF_PART = 0, 1, 2, 3, 4

# columns of the first row of a program: begin and number of rows of each table
HEAD_SIGNALS_AT, HEAD_SIGNALS, HEAD_PARTS_AT, HEAD_PARTS, HEAD_REPORTS_AT, HEAD_REPORTS = range(6)
HEAD_OPERANDS_AT = 6

# treatment of the values beyond the last sample: end of the run, lowest values, highest values
OPEN_END, OPEN_LOW, OPEN_HIGH = 0, 1, 2

CHANNELS = 4
"""Number of channels: nominal low and high, wide low and high."""

_STANDS_FOR = MappingProxyType({1: (0, 0, 0, 0), 2: (0, 1, 0, 1), 4: (0, 1, 2, 3)})
"""Index of the stored channel that equals each of the four channels, by how many channels are stored."""


def in_channels(numbers: Floats, channels: int) -> Floats:
    """Expand numbers (C, …) to the given number of channels, at least C: 1, 2 or 4."""
    return numbers if len(numbers) == channels else numbers[list(_STANDS_FOR[len(numbers)][:channels])]


def distinct_channels(numbers: Floats) -> Floats:
    """Return numbers (C, …) in as few channels as possible: one for equal ends, two without uncertainty."""
    if len(numbers) == CHANNELS and np.array_equal(numbers[:2], numbers[2:]):
        numbers = numbers[:2]
    return numbers[:1] if len(numbers) == 2 and np.array_equal(numbers[0], numbers[1]) else numbers


def joined_channels(parts: Sequence[Floats], axis: int) -> Floats:
    """Concatenate arrays (C, …) into a `roomy` array. C is the largest number of channels of an array."""
    channel_count = max(map(len, parts))
    return join_arrays([in_channels(part, channel_count) for part in parts], axis)


def low_and_high(channels: int, *, wide: bool) -> tuple[int, int]:
    """Return the channels of the low and high ends, nominal or with uncertainty."""
    stored_channels = _STANDS_FOR[channels]
    return (stored_channels[2], stored_channels[3]) if wide else (stored_channels[0], stored_channels[1])
