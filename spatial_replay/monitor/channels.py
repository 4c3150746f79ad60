"""Channels: what a number can be when something is unknown or uncertain.

All numbers exist in up to four channels: the ends of the interval with every uncertainty at 0 (nominal low
and high), and the ends with uncertainty (wide low and high). They are equal, and only the first is kept, for
as long as everything is known; the second appears with the first unknown, the rest with uncertainty. A
negation swaps low and high: channel ^ 1.
"""

from __future__ import annotations

from types import MappingProxyType

from spatial_replay.geometry.arrays import Floats

CHANNELS = 4
"""Nominal low and high, wide low and high."""

_STANDS_FOR = MappingProxyType({1: (0, 0, 0, 0), 2: (0, 1, 0, 1), 4: (0, 1, 2, 3)})
"""Which channel of so many each of all stands for."""


def in_channels(numbers: Floats, channels: int) -> Floats:
    """Numbers (C, …) in the given number of channels, at least C: 1, 2 or 4."""
    return numbers if len(numbers) == channels else numbers[list(_STANDS_FOR[len(numbers)][:channels])]


def low_and_high(channels: int, *, wide: bool) -> tuple[int, int]:
    """Which of so many channels hold the low and the high ends, nominal or with uncertainty."""
    stands_for = _STANDS_FOR[channels]
    return (stands_for[2], stands_for[3]) if wide else (stands_for[0], stands_for[1])
