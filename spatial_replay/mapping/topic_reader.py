"""The messages of one topic on their way to samples.

Messages that wait for those that may still come before them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.bags.topic import Decoder
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.mapping.detections import DetectionChunk, Detections
from spatial_replay.mapping.extract import Extractor
from spatial_replay.mapping.field_paths import (
    ContentError,
    FieldError,
    FieldPath,
    Get,
    check,
    getter,
    style_of,
    walk,
)
from spatial_replay.mapping.message_types import GENERIC
from spatial_replay.mapping.names import Codes
from spatial_replay.mapping.reading_plan import PlannedTopic
from spatial_replay.mapping.stamps import TimeGetter, bind_time
from spatial_replay.mapping.transforms import TransformReader
from spatial_replay.trace.sample import LATEST_NS


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


_NO_STAMP = "the clock is header, but its messages have no stamp; give `stamp`, or `clock: log`"

MISFITS = (FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError)
"""What reading fields of a message raises that is not as the mapping says."""


_PATIENCE = 100
"""Messages of a topic that may be no use before the first that fits; with more, the mapping is to blame."""

_CHUNK = 256
_CHUNK_BYTES = 2**14
"""Messages decoded at once: few, so that what they hold is let go of before it piles up."""


@dataclass(slots=True)
class Harvest:
    """What messages of a topic tell of.

    Attributes:
        seen: the objects, or None for a topic without.
        signals: (M,) values of each signal.
        kept: which messages could be read; `seen` and `signals` count these only.
    """

    seen: Detections | None
    signals: list[Floats]
    kept: list[int]


class TopicReader:
    """One topic: decodes its messages, knows their times, reads objects and signals out of them.

    Args:
        fault: takes the log time of a message that is lost, and why.
    """

    def __init__(
        self,
        planned: PlannedTopic,
        decoder: Callable[[str], Decoder],
        names: Codes,
        classes: Codes,
        *,
        mapping_name: str,
        needs_frame: bool,
        fault: Callable[[str, int, str], None],
    ) -> None:
        self.planned = planned
        self.pending = Pending()
        self._mapping_name = mapping_name
        self._fault = fault
        reads = planned.mapping is not None or planned.is_transforms or planned.clock == "header"
        self._decode = decoder(planned.name) if reads else None
        self.extractor: Extractor | None = None
        if planned.reading is not None:
            entry = planned.mapping
            self.extractor = Extractor(
                planned.reading,
                planned.name,
                names,
                classes,
                only=entry.only if entry is not None else (),
                without=entry.without if entry is not None else (),
                needs_frame=needs_frame,
            )
        self.transforms = TransformReader() if planned.is_transforms else None
        self.keeps_decoded = planned.is_transforms or planned.clock == "header"
        self._time: TimeGetter | None = None
        self._has_time = False
        self._signals: list[Get] | None = None
        self._unfit: dict[str, tuple[int, str]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether its times tell how far the log has come.

        Log times do; stamps of transforms and of what was sent once may lie in the future or the past.
        """
        if self.planned.clock == "log":
            return True
        return not self.planned.is_latched and (self.transforms is None or self.extractor is not None)

    @property
    def reads(self) -> bool:
        """Whether its messages tell of objects or signals."""
        return self.planned.mapping is not None

    @property
    def name(self) -> str:
        return self.planned.name

    def decoded(self, payloads: Sequence[bytes], log_times_ns: Sequence[int]) -> tuple[list[Any], list[int]]:
        """What the messages hold, and which of them could be decoded."""
        if self._decode is None:
            return [None] * len(payloads), list(range(len(payloads)))
        try:
            return list(map(self._decode, payloads)), list(range(len(payloads)))
        except LogError:
            return self._one_by_one(payloads, self._decode, log_times_ns)

    def stamps(self, log_times_ns: Sequence[int], contents: Sequence[Any]) -> tuple[list[int], list[int]]:
        """The stamp of each message, and which of the messages have one.

        Raises:
            UsageError: there are no stamps where the mapping says.
        """
        found, kept = self._one_by_one(contents, self._stamp, log_times_ns)
        times: list[int] = []
        places: list[int] = []
        for time_ns, place in zip(found, kept, strict=True):
            if time_ns is not None and not 0 <= time_ns <= LATEST_NS:
                what = f"its stamp {time_ns} ns lies outside the times of a log"
                self._fault(self.name, log_times_ns[place], what)
            elif time_ns is not None:
                times.append(time_ns)
                places.append(place)
        return times, places

    def harvest(self, log_times_ns: Integers, contents: Sequence[Any]) -> Harvest:
        """What messages tell of: payloads, or what they hold where the channel `keeps_decoded`.

        Raises:
            UsageError: the mapping fits none of many messages.
        """
        parts: list[DetectionChunk] = []
        values: list[list[float]] = []
        kept: list[int] = []
        times = log_times_ns.tolist()
        size = _chunk_size(contents)
        for begin in range(0, len(contents), size):
            chunk, at = list(contents[begin : begin + size]), times[begin : begin + size]
            good = list(range(len(chunk)))
            if not self.keeps_decoded:
                chunk, good = self.decoded(chunk, at)
                at = [at[i] for i in good] if len(good) < len(at) else at
            chunk, read = self._read_signals(chunk, at, values)
            good = good if read is None else [good[i] for i in read]
            if self.extractor is not None:
                read = self._read_objects(self.extractor, chunk, at, len(kept), parts)
                good = good if read is None else [good[i] for i in read]
                values = (
                    values
                    if read is None
                    else values[: len(kept)] + [values[len(kept) + i] for i in read if values]
                )
            kept += [begin + i for i in good]
        columns = np.array(values, np.float64).reshape(len(values), -1) if values else np.empty((0, 0))
        return Harvest(
            seen=None if self.extractor is None else self.extractor.seen(parts),
            signals=[columns[:, place] for place in range(columns.shape[1])],
            kept=kept,
        )

    def _read_objects(
        self,
        extractor: Extractor,
        chunk: list[Any],
        log_times_ns: list[int],
        first: int,
        parts: list[DetectionChunk],
    ) -> list[int] | None:
        """Add what a few messages tell of to `parts`; which of them could be read, or None for all."""
        try:
            parts.append(extractor.harvest(chunk, first))
            return None
        except MISFITS:
            pass

        def read(content: object) -> DetectionChunk:
            was_bound = extractor.is_bound
            try:
                return extractor.harvest([content], 0)
            except ContentError:
                # this message alone is to blame
                raise
            except MISFITS as error:
                if not was_bound:
                    self._turn_down("objects", error)
                raise

        found, kept = self._one_by_one(chunk, read, log_times_ns)
        # not together: each may be of a form of its own
        parts += [part.shifted(first + place) for place, part in enumerate(found)]
        return kept

    def _read_signals(
        self, chunk: list[Any], log_times_ns: list[int], values: list[list[float]]
    ) -> tuple[list[Any], list[int] | None]:
        """Add the signals of a few messages to `values`; those that could be read, and which (None: all).

        Raises:
            UsageError: a signal's path leads nowhere in any of many messages.
        """
        entry = self.planned.mapping
        if entry is None or not entry.signals or not chunk:
            return chunk, None
        gets = self._signals
        try:
            if gets is not None:
                values += [[_number(get(content)) for get in gets] for content in chunk]
                return chunk, None
        except MISFITS:
            pass

        def read(content: object) -> list[float]:
            if self._signals is None:
                try:
                    self._signals = [_bound_signal(signal.field, content) for signal in entry.signals]
                except FieldError as error:
                    self._turn_down("signals", error)
                    raise
            return [_number(get(content)) for get in self._signals]

        found, kept = self._one_by_one(chunk, read, log_times_ns)
        values += found
        return [chunk[i] for i in kept], kept

    def _stamp(self, content: object) -> int | None:
        if self.transforms is not None and self.extractor is None:
            return self.transforms.stamp(content)
        try:
            if self.extractor is not None:
                (time_ns,) = self.extractor.message_times([content])
                if self.extractor.lacks_stamp:
                    raise self._misfit(_NO_STAMP)
                return time_ns
            if not self._has_time:
                entry = self.planned.mapping
                stamps = GENERIC.stamp if entry is None or entry.stamp is None else (entry.stamp,)
                self._time = bind_time(stamps, content, content)
                self._has_time = True
        except FieldError as error:
            if self._has_time or (self.extractor is not None and self.extractor.is_timed):
                raise
            raise self._misfit(f"the clock is header, but {error}") from None
        if self._time is None:
            raise self._misfit(_NO_STAMP)
        return self._time.nanoseconds([content])[0]

    def _turn_down(self, what: str, error: Exception) -> None:
        """Count a message that the mapping does not fit, before there was one that it fits.

        Raises:
            UsageError: there were many.
        """
        count, first = self._unfit.get(what, (0, ""))
        said = str(error) if isinstance(error, FieldError) else f"its messages are not as expected: {error}"
        self._unfit[what] = count + 1, first or said
        if count + 1 >= _PATIENCE:
            raise self._misfit(first)

    def finish(self) -> None:
        """Say that there will be no more messages.

        Raises:
            UsageError: there were some, and the mapping fitted none.
        """
        for what, (_, first) in self._unfit.items():
            is_bound = self._signals is not None
            if what == "objects":
                is_bound = self.extractor is None or self.extractor.is_bound
            if not is_bound:
                raise self._misfit(first)

    def _misfit(self, what: str) -> UsageError:
        return UsageError(f"{self._mapping_name}: topics.{self.name}: {what}")

    def _one_by_one(
        self, items: Sequence[Any], read: Callable[[Any], Any], log_times_ns: Sequence[int]
    ) -> tuple[list[Any], list[int]]:
        """What can be read of each, and which those are; the others are told as faults."""
        found: list[Any] = []
        kept: list[int] = []
        for place, item in enumerate(items):
            try:
                found.append(read(item))
            except (*MISFITS, LogError) as error:
                self._fault(self.name, log_times_ns[place], _said(error))
            else:
                kept.append(place)
        return found, kept


def _bound_signal(text: str, content: object) -> Get:
    path = FieldPath.of(text)
    check(path, content)
    try:
        _number(walk(path, content))
    except (TypeError, ValueError, OverflowError):
        raise FieldError(f"{text}: its value is no number; give the path of one") from None
    return getter(path, style_of(content))


def _number(value: object) -> float:
    return float("nan") if value is None else float(value)  # type: ignore[arg-type]


def _said(error: Exception) -> str:
    if isinstance(error, FieldError | LogError):
        return str(error)
    return f"the message is not as the others: {error}"


def _chunk_size(contents: Sequence[Any]) -> int:
    if not contents or not isinstance(contents[0], bytes):
        return _CHUNK
    return max(8, min(_CHUNK, _CHUNK_BYTES * len(contents) // max(1, sum(map(len, contents)))))
