"""Conversion between the numbers of nodes after each sample and messages of /spatial/robustness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.schemas.Curves_pb2 import Curves, NodeCurves, SpecificationCurves
from spatial_replay.logs.schemas.Robustness_pb2 import (
    HOLDS_SO_FAR,
    PENDING,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
    Robustness,
)
from spatial_replay.logs.topics import CURVES_TOPIC, protobuf_channel
from spatial_replay.logs.wire import Payloads, WireTemplate, words_of
from spatial_replay.monitor.result import SpecResult
from spatial_replay.spec.formula import Formula, iter_nodes
from spatial_replay.spec.walks import looks_ahead

Codes = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class RobustnessSeries:
    """The numbers in a log of one specification, or of one instance of a template.

    Attributes:
        specification: name of the specification.
        object: object of a template's instance, or None.
        ids: (N,) int64, ids of the nodes.
        names: N names; None for a node without a name.
        times_ns: (T,) int64, times of the samples.
        series: (N, 4, T): value, now, lower, upper.
    """

    specification: str
    object: str | None
    ids: Integers
    names: tuple[str | None, ...]
    times_ns: Integers
    series: Floats


def encode_robustness(
    name: str,
    object: str | None,
    names: Sequence[str | None],
    times_ns: Integers,
    series: Floats,
    *,
    final: bool = False,
) -> Payloads:
    """Return one message for each sample.

    Args:
        name: name of the specification.
        object: object of a template's instance, or None.
        names: names of the N nodes by id; None for a node without a name.
        times_ns: (T,) int64, times of the samples.
        series: (N, 4, T): value, now, lower, upper.
        final: whether lower and upper are ends over the finished log.
    """
    numbers = series.reshape(4 * len(names), len(times_ns))
    words = words_of([times_ns[:, None], numbers.T])
    template = _encoded_once(name, object, tuple(names), final)
    return template.encode(words, standing_codes(series, final=final).T)


@lru_cache(64)
def _encoded_once(name: str, object: str | None, names: tuple[str | None, ...], final: bool) -> WireTemplate:
    """Return the template of a result's messages; blocks share it."""
    # each number that is set here becomes a slot; its value does not matter
    message = Robustness(time_ns=1, specification=name, object=object or "", final=final)
    for identifier, node in enumerate(names):
        message.nodes.add(
            id=identifier, name=node or "", value=1.0, now=1.0, lower=1.0, upper=1.0, standing=UNKNOWN
        )
    return WireTemplate.of(message)


def standing_codes(series: Floats, *, final: bool = False) -> Codes:
    """Return (N, T), the standing of some nodes as values of the messages' enumeration `Standing`.

    Args:
        series: (N, 4, T): value, now, lower, upper.
        final: whether lower and upper are ends over the finished log, so that no node is pending.
    """
    value, _, lower, upper = series.swapaxes(0, 1)
    codes = np.full(value.shape, UNKNOWN, np.uint8)
    if not final:
        codes[value >= 0.0] = HOLDS_SO_FAR
        codes[value < 0.0] = PENDING
    codes[upper < 0.0] = VIOLATED
    codes[lower >= 0.0] = SATISFIED
    return codes


def decode_robustness(payloads: Sequence[bytes]) -> list[RobustnessSeries]:
    """Decode messages into one series per specification and object, in order of first appearance.

    Messages with different nodes, such as messages of another run, get a series of their own. Final messages,
    which describe the finished log, are left out.

    Raises:
        LogError: a message of another type.
    """
    messages_by_heading: dict[
        tuple[str, str | None, tuple[int, ...], tuple[str | None, ...]], list[Robustness]
    ] = {}
    for index, payload in enumerate(payloads):
        try:
            message = Robustness.FromString(payload)
        except DecodeError as error:
            raise LogError(
                f"message {index} of {len(payload)} bytes is not a spatial_replay.Robustness; "
                "write the annotated log again from its source"
            ) from error
        if not message.final:
            ids, names = tuple(node.id for node in message.nodes), tuple(node.name for node in message.nodes)
            heading = (
                message.specification,
                message.object or None,
                ids,
                tuple(name or None for name in names),
            )
            messages_by_heading.setdefault(heading, []).append(message)
    return [
        RobustnessSeries(
            name,
            object,
            np.array(ids, np.int64),
            names,
            np.array([message.time_ns for message in messages], np.uint64).astype(np.int64),
            np.array(
                [
                    [(node.value, node.now, node.lower, node.upper) for node in message.nodes]
                    for message in messages
                ]
            )
            .reshape(len(messages), -1, 4)
            .transpose(1, 2, 0),
        )
        for (name, object, ids, names), messages in messages_by_heading.items()
    ]


MOST_POINTS: Final = 2_000
"""Limit of points in a curve; messages with very many curves have fewer."""

_MOST_NUMBERS: Final = 1 << 19
"""Approximate limit of numbers in a message: 4 MiB."""
_FEWEST_POINTS: Final = 64


class Thinning:
    """Thins long curves to the least and the greatest number in each of equally long stretches."""

    def __init__(self, times_ns: Integers, most: int) -> None:
        """Divide the samples of a log into stretches.

        Args:
            times_ns: (T,) int64, times of all samples, at least one.
            most: limit of points in a curve, at least 2.
        """
        self._times_ns = times_ns
        sample_count = len(times_ns)
        self._is_needed = sample_count > most
        self._starts = np.linspace(0, sample_count, most // 2, endpoint=False).astype(np.int64)
        self._ends = np.append(self._starts[1:], sample_count) - 1

    def seconds(self, first_ns: int) -> Floats:
        """Return the times of the points in seconds after `first_ns`."""
        seconds = (self._times_ns - first_ns) / 1e9
        return self._interleave(seconds[self._starts], seconds[self._ends]) if self._is_needed else seconds

    def points(self, times_ns: Integers, numbers: Floats) -> Floats:
        """Return the points of one curve.

        Args:
            times_ns: (S,) int64, times of consecutive samples of the log.
            numbers: (S,), numbers of the curve in these samples.
        """
        all_numbers = np.full(len(self._times_ns), np.nan)
        first_index = int(np.searchsorted(self._times_ns, times_ns[0])) if len(times_ns) else 0
        all_numbers[first_index : first_index + len(numbers)] = numbers
        if not self._is_needed:
            return all_numbers
        least = np.fmin.reduceat(all_numbers, self._starts)
        greatest = np.fmax.reduceat(all_numbers, self._starts)
        # the order of both points within a stretch follows the curve, so that slopes keep their direction
        is_falling = all_numbers[self._starts] > all_numbers[self._ends]
        return self._interleave(np.where(is_falling, greatest, least), np.where(is_falling, least, greatest))

    def _interleave(self, first: Floats, second: Floats) -> Floats:
        return np.column_stack([first, second]).reshape(-1)


def encode_curves(
    times_ns: Integers, results: Sequence[SpecResult], first_ns: int, summary: str = ""
) -> bytes:
    """Return the message with the curves of a whole log.

    Args:
        times_ns: (T,) int64, times of all samples, at least one.
        first_ns: zero of the seconds.
        summary: all results in words.
    """
    curve_count = 2 * sum(len(curved_nodes(result.formula)) for result in results)
    point_limit = min(MOST_POINTS, max(_FEWEST_POINTS, _MOST_NUMBERS // max(curve_count, 1)))
    thinning = Thinning(times_ns, point_limit)
    message = Curves(
        time=thinning.seconds(first_ns),
        specifications=[_result(result, thinning) for result in results],
        summary=summary,
    )
    return message.SerializeToString(deterministic=True)


def curved_nodes(formula: Formula) -> dict[int, Formula]:
    """Return the nodes with curves, by id: the root, and each node with a unique name."""
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
