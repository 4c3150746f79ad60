"""Changes of verdicts and of signs, from sample to sample.

A verdict that no continuation can change counts at once. The sign of a value that is still pending counts
once it lasts `LASTING` samples in a row, so that noise around zero is no event. The state between blocks of
samples is a few numbers for each node, and cutting a run into blocks changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.compiled import kernel
from spatial_replay.geometry.arrays import Floats, Integers

LASTING: Final = 3
"""Samples in a row that a sign must last."""

START, HOLDING, FAILING, SATISFIED, VIOLATED = 0, 1, 2, 3, 4
"""Nothing known yet; pending, with a value of at least 0; pending, below 0; and the final ones."""

OF_CURRENT, OF_CANDIDATE = -1, -2
"""In place of a sample of the block: the worst sample lies before it and is part of the state."""

_CODE, _SINCE, _UNTIL, _NEXT, _COUNT, _NEXT_SINCE = range(6)


class Period(NamedTuple):
    """A time during which a node was in one state.

    Attributes:
        code: the state.
        start_ns, end_ns: its first and its last sample.
        worst: the least number: of the value; of a final verdict, the end of the interval that decides.
        place: the first sample of the block that has it, or `OF_CURRENT`, `OF_CANDIDATE`.
    """

    code: int
    start_ns: int
    end_ns: int
    worst: float
    place: int


class Change(NamedTuple):
    """A node is in another state than before.

    Attributes:
        node: index among the nodes tracked.
        sample: index in the block, where it is confirmed.
        before: None where nothing was known before.
        after: the new period, up to the sample that confirms it.
    """

    node: int
    sample: int
    before: Period | None
    after: Period


@dataclass(frozen=True, eq=False)
class NodeStates:
    """The states of some nodes, each with a candidate for the next one.

    Attributes:
        integers: (K, 6) int64: of each node, its state, since when, its last sample; the candidate, for how
            many samples in a row, since when.
        worst: (K, 2): the least number of the state and of the candidate.
    """

    integers: Integers
    worst: Floats

    @classmethod
    def begin(cls, nodes: int) -> NodeStates:
        """Return the states before the first sample."""
        return cls(np.zeros((nodes, 6), np.int64), np.full((nodes, 2), np.inf))

    @property
    def are_final(self) -> bool:
        """Whether no node can change any more."""
        return bool((self.integers[:, _CODE] >= SATISFIED).all())

    @property
    def pending(self) -> list[int]:
        """The nodes that can still change."""
        return np.flatnonzero(self.integers[:, _CODE] < SATISFIED).tolist()

    def period(self, node: int) -> Period:
        """Return the current period of a node, up to the last sample in that state."""
        code, since, until = self.integers[node, [_CODE, _SINCE, _UNTIL]].tolist()
        return Period(code, since, until, float(self.worst[node, 0]), OF_CURRENT)


class TrackedChanges(NamedTuple):
    """The states of some nodes after a block, and the changes in it.

    Attributes:
        changes: by node, then by time.
        places: (K, 2) int64, where each of `states.worst` is: a sample of the block, or `OF_CURRENT`,
            `OF_CANDIDATE`.
    """

    states: NodeStates
    changes: list[Change]
    places: Integers


def track(
    before: NodeStates, times_ns: Integers, series: Floats, nodes: Integers, *, settles: bool = True
) -> TrackedChanges:
    """Take in the next samples.

    Args:
        times_ns: (T,).
        series: (N, 4, T): value, now, lower, upper.
        nodes: (K,) int64, ids of the nodes that are tracked.
        settles: whether an interval on one side of 0 is a verdict that stays.
    """
    integers, worst = before.integers.copy(), before.worst.copy()
    places = np.tile(np.array([OF_CURRENT, OF_CANDIDATE], np.int64), (len(nodes), 1))
    room = len(nodes) * (len(times_ns) // LASTING + 2)
    found, numbers = np.empty((room, 10), np.int64), np.empty((room, 2))
    count = _track(times_ns, series, nodes, settles, integers, worst, places, found, numbers)
    changes = []
    for row, (worst_before, worst_after) in zip(
        found[:count].tolist(), numbers[:count].tolist(), strict=True
    ):
        node, sample, code, start, end, place, next_code, next_start, next_end, next_place = row
        period = Period(code, start, end, worst_before, place) if code != START else None
        after = Period(next_code, next_start, next_end, worst_after, next_place)
        changes.append(Change(node, sample, period, after))
    return TrackedChanges(NodeStates(integers, worst), changes, places)


@kernel
def _track(
    times_ns: Integers,
    series: Floats,
    nodes: Integers,
    settles: bool,
    integers: Integers,
    worst: Floats,
    places: Integers,
    found: Integers,
    numbers: Floats,
) -> int:
    """Update the state in place (see `NodeStates`) and return how many rows of `found` are filled."""
    count = 0
    for k in range(nodes.shape[0]):
        value, lower, upper = series[nodes[k], 0], series[nodes[k], 2], series[nodes[k], 3]
        state = integers[k]
        for t in range(times_ns.shape[0]):
            if state[_CODE] >= SATISFIED:
                break
            code, number = START, value[t]
            if settles and lower[t] >= 0.0:
                code, number = SATISFIED, lower[t]
            elif settles and upper[t] < 0.0:
                code, number = VIOLATED, upper[t]
            elif value[t] >= 0.0:
                code = HOLDING
            elif value[t] < 0.0:
                code = FAILING
            if code == state[_CODE] or code == START:
                state[_COUNT] = 0
                if code != START:
                    state[_UNTIL] = times_ns[t]
                    if number < worst[k, 0]:
                        worst[k, 0], places[k, 0] = number, t
                continue
            if state[_COUNT] == 0 or state[_NEXT] != code:
                state[_NEXT], state[_COUNT], state[_NEXT_SINCE] = code, 0, times_ns[t]
                worst[k, 1], places[k, 1] = number, t
            elif number < worst[k, 1]:
                worst[k, 1], places[k, 1] = number, t
            state[_COUNT] += 1
            is_first = state[_CODE] == START and code < SATISFIED
            if not is_first and code < SATISFIED and state[_COUNT] < LASTING:
                continue
            if not is_first:
                row = found[count]
                row[0], row[1] = k, t
                row[2], row[3], row[4], row[5] = state[_CODE], state[_SINCE], state[_UNTIL], places[k, 0]
                row[6], row[7], row[8], row[9] = code, state[_NEXT_SINCE], times_ns[t], places[k, 1]
                numbers[count, 0], numbers[count, 1] = worst[k, 0], worst[k, 1]
                count += 1
            state[_CODE], state[_SINCE], state[_UNTIL] = code, state[_NEXT_SINCE], times_ns[t]
            worst[k, 0], places[k, 0] = worst[k, 1], places[k, 1]
            state[_COUNT] = 0
    return count
