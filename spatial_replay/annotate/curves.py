"""The robustness of a whole log as curves → one message of /spatial/curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.schemas.Curves_pb2 import Curves, NodeCurves, SpecificationCurves
from spatial_replay.logs.topics import CURVES_TOPIC, protobuf_channel
from spatial_replay.monitor.online.rewriting import looks_ahead
from spatial_replay.monitor.result import SpecResult
from spatial_replay.spec.formula import Formula, iter_nodes

MOST_POINTS: Final = 2_000
"""Points of a curve; of very many curves there are fewer."""

_MOST_NUMBERS: Final = 1 << 19
"""Numbers in a message, about: 4 MiB of them."""
_FEWEST_POINTS: Final = 64


class Thinning:
    """Thins long curves to the least and the greatest point of equally many samples."""

    def __init__(self, times_ns: Integers, most: int) -> None:
        """Cut up the samples of a log.

        Args:
            times_ns: (T,) int64, of all samples, at least one.
            most: points that a curve may have, at least 2.
        """
        self._times_ns = times_ns
        count = len(times_ns)
        self._is_needed = count > most
        self._starts = np.linspace(0, count, most // 2, endpoint=False).astype(np.int64)
        self._ends = np.append(self._starts[1:], count) - 1

    def seconds(self, first_ns: int) -> Floats:
        """Return the times of the points, counted from a first one."""
        seconds = (self._times_ns - first_ns) / 1e9
        return self._paired(seconds[self._starts], seconds[self._ends]) if self._is_needed else seconds

    def points(self, times_ns: Integers, numbers: Floats) -> Floats:
        """Return the points of one curve.

        Args:
            times_ns: (S,) int64, a stretch of the log's samples.
            numbers: (S,).
        """
        whole = np.full(len(self._times_ns), np.nan)
        first = int(np.searchsorted(self._times_ns, times_ns[0])) if len(times_ns) else 0
        whole[first : first + len(numbers)] = numbers
        if not self._is_needed:
            return whole
        low = np.fmin.reduceat(whole, self._starts)
        high = np.fmax.reduceat(whole, self._starts)
        falls = whole[self._starts] > whole[self._ends]
        return self._paired(np.where(falls, high, low), np.where(falls, low, high))

    def _paired(self, first: Floats, second: Floats) -> Floats:
        return np.column_stack([first, second]).reshape(-1)


def encode_curves(
    times_ns: Integers, results: Sequence[SpecResult], first_ns: int, summary: str = ""
) -> bytes:
    """Return the message with the curves of a whole log.

    Args:
        times_ns: (T,) int64, of all samples, at least one.
        first_ns: the time that seconds count from.
        summary: what the results come to, in words.
    """
    curves = 2 * sum(len(curved_nodes(result.formula)) for result in results)
    most = min(MOST_POINTS, max(_FEWEST_POINTS, _MOST_NUMBERS // max(curves, 1)))
    thinning = Thinning(times_ns, most)
    message = Curves(
        time=thinning.seconds(first_ns),
        specifications=[_result(each, thinning) for each in results],
        summary=summary,
    )
    return message.SerializeToString(deterministic=True)


def curved_nodes(formula: Formula) -> dict[int, Formula]:
    """Return the nodes that have curves, by id: the root, and those with a name that no other node has."""
    nodes = [(identifier, node) for identifier, _, node in iter_nodes(formula)]
    names = [node.name for _, node in nodes]
    return {
        identifier: node
        for identifier, node in nodes
        if not identifier or (node.name and names.count(node.name) == 1)
    }


def _result(result: SpecResult, thinning: Thinning) -> SpecificationCurves:
    return SpecificationCurves(
        name=result.name,
        object=result.object or "",
        verdict=str(result.verdict),
        robustness=result.robustness,
        nodes=[
            NodeCurves(
                id=identifier,
                name=node.name or "",
                value=thinning.points(result.times_ns, result.series[identifier, 0]),
                now=()
                if looks_ahead(node)
                else thinning.points(result.times_ns, result.series[identifier, 1]),
            )
            for identifier, node in curved_nodes(result.formula).items()
        ],
    )


CURVES_CHANNEL: Final[Channel] = protobuf_channel(CURVES_TOPIC, Curves)
