"""Messages that wait for those that may still come before them."""

from __future__ import annotations

from typing import Any

import numpy as np

from spatial_replay.geometry.arrays import Integers


class Pending:
    """Messages of one topic with their times, in the order in which they came."""

    def __init__(self) -> None:
        self._times_ns: list[Integers] = []
        self._sequences: list[Integers] = []
        self._log_times_ns: list[Integers] = []
        self._contents: list[Any] = []

    def add(
        self, times_ns: Integers, sequences: Integers, log_times_ns: Integers, contents: list[Any]
    ) -> None:
        """Let messages wait.

        Args:
            contents: each message's payload, or what it holds.
        """
        self._times_ns.append(times_ns)
        self._sequences.append(sequences)
        self._log_times_ns.append(log_times_ns)
        self._contents += contents

    def take(self, upto_ns: int) -> tuple[Integers, Integers, list[Any]]:
        """Times, log times and contents of the messages up to a time, in order; they wait no more.

        They are in the order of time; of equal times, of sequence, then as they came.
        """
        times, sequences, log_times = map(_joined, (self._times_ns, self._sequences, self._log_times_ns))
        contents = self._contents
        if len(times) and not (times[1:] > times[:-1]).all():
            order = np.lexsort((sequences, times))
            times, sequences, log_times = times[order], sequences[order], log_times[order]
            contents = [contents[i] for i in order.tolist()]
        count = int(np.searchsorted(times, upto_ns, "right"))
        self._times_ns, self._sequences = [times[count:]], [sequences[count:]]
        self._log_times_ns, self._contents = [log_times[count:]], contents[count:]
        return times[:count], log_times[:count], contents[:count]


def _joined(arrays: list[Integers]) -> Integers:
    return np.concatenate([np.empty(0, np.int64), *arrays])
