"""Read one topic: raw messages in, columns of detections and signals out.

A message passes three steps: it is decoded, its signals are read, its objects are read. Each step may fail
for single messages. One boolean mask per batch says which messages are still good; a step skips the others,
reports those that fail, and clears their flags.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import compress
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.bags.topic import Decoder
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.mapping.binding import TimeGetter, bind_time
from spatial_replay.mapping.detections import DetectionChunk, Detections
from spatial_replay.mapping.extract import Extractor
from spatial_replay.mapping.field_paths import (
    ContentError,
    FieldError,
    FieldPath,
    Get,
    getter,
    sparse,
    style_of,
    walk,
)
from spatial_replay.mapping.message_types import GENERIC
from spatial_replay.mapping.model import SignalMapping
from spatial_replay.mapping.names import Codes
from spatial_replay.mapping.reading_plan import PlannedTopic
from spatial_replay.mapping.transforms import TransformReader
from spatial_replay.text import text_number
from spatial_replay.trace.sample import LATEST_NS

MISFITS = (FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError)
"""Raised by reading fields of a message that is not as the mapping says."""

ReportFault: TypeAlias = Callable[[str, int, str], None]
"""Takes the topic and the log time of a message that is lost, and the reason."""

_NO_STAMP = (
    "the clock is header, but its messages have no stamp; give `stamp`, or `clock: log` for this topic"
)

_PATIENCE = 100
"""Messages of a topic that may misfit before the first that fits; beyond that the mapping is wrong."""

_MOST_UNNAMED, _LONGEST_UNNAMED = 8, 40

_CHUNK = 256
_CHUNK_BYTES = 2**14
"""Messages decoded at once: few, so that their contents are freed before they pile up."""


class TopicColumns(NamedTuple):
    """Columns read from N messages of a topic, of which M are good.

    Attributes:
        good: (N,) which messages could be read.
        detections: the objects of the M good messages, or None for a topic without objects.
        signals: (M, S) the value of each signal in each good message.
    """

    good: Booleans
    detections: Detections | None
    signals: Floats


class TopicReader:
    """Decodes the messages of one topic and reads stamps, objects and signals.

    Args:
        names, classes: codes that all topics share.
        needs_frame: whether there is a fixed frame, so that frames matter.
        decodes_early: whether messages whose objects have frames are decoded when they arrive.
        report: receives each message that is lost.
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
        decodes_early: bool = False,
        report: ReportFault,
    ) -> None:
        self.planned = planned
        self.name = planned.name
        self.pending = PendingMessages(has_own_clock=planned.clock == "header")
        self.decodes_on_arrival = (
            planned.is_transforms
            or planned.clock == "header"
            or (decodes_early and needs_frame and planned.layout is not None)
        )
        self.transforms = TransformReader() if planned.is_transforms else None
        self.extractor: Extractor | None = None
        self.unstamped = 0
        """Messages without a stamp, or with one of 0, which have no time on the clock `header`."""
        self._is_stamped = False
        if planned.layout is not None and planned.mapping is not None:
            self.extractor = Extractor(
                planned.layout, planned.mapping, names, classes, needs_frame=needs_frame
            )
        self._mapping_name = mapping_name
        self._report = report
        reads = self.is_mapped or self.decodes_on_arrival
        self._decode: Decoder = decoder(planned.name) if reads else _skip
        if reads and planned.mapping is not None and planned.mapping.has_zeros_left_out:
            decode = self._decode
            self._decode = lambda payload: sparse(decode(payload))
        self._time: TimeGetter | None = None
        self._is_time_bound = False
        self._signal_fields = () if planned.mapping is None else planned.mapping.signals
        self._signals: list[Get] | None = None
        self.unnamed: dict[str, dict[str, None]] = {}
        """Some texts of signals, by signal, for which the mapping has no number."""
        self._misfits: dict[str, tuple[int, str]] = {}

    @property
    def is_mapped(self) -> bool:
        """Whether its messages hold objects or signals of the mapping."""
        return self.planned.mapping is not None

    @property
    def advances_time(self) -> bool:
        """Whether its times show how far the log has come.

        Log times do. Stamps of transforms and of latched messages may lie in the future or the past.
        """
        if self.planned.clock == "log":
            return True
        return not self.planned.is_latched and (self.transforms is None or self.extractor is not None)

    def decode(self, payloads: Sequence[bytes], log_times_ns: Sequence[int], good: Booleans) -> list[Any]:
        """Decode the good messages; None for the others and for those that turn out to be bad."""
        return self._read_each(self._decode, payloads, log_times_ns, good)

    def stamps(self, messages: Sequence[Any], log_times_ns: Sequence[int], good: Booleans) -> Integers:
        """Return the stamp (N,) of each message; those without one are not good.

        Raises:
            UsageError: there are no stamps where the mapping says.
        """

        def read(message: object) -> int | None:
            time_ns = self._stamp(message)
            if time_ns is not None and not 0 <= time_ns <= LATEST_NS:
                raise ContentError(f"its stamp {time_ns} ns lies outside the times of a log")
            # a stamp of 0 was never set, but by simulators, before they have a time
            return time_ns or (0 if self.planned.is_static else None)

        times = self._read_each(read, messages, log_times_ns, good)
        # a list without objects and without a header has no stamp
        has_stamp = np.array([time_ns is not None for time_ns in times], np.bool_)
        self.unstamped += int(np.count_nonzero(good & ~has_stamp))
        good &= has_stamp
        self._is_stamped = self._is_stamped or bool(good.any())
        return np.array([time_ns or 0 for time_ns in times], np.int64)

    def read(self, log_times_ns: Integers, contents: Sequence[Any]) -> TopicColumns:
        """Read objects and signals.

        Args:
            contents: payloads, or decoded messages where the reader `decodes_on_arrival`.

        Raises:
            UsageError: the mapping fits none of many messages.
        """
        good = np.ones(len(contents), np.bool_)
        chunks: list[DetectionChunk] = []
        signals: list[list[float]] = []
        times = log_times_ns.tolist()
        size = _chunk_size(contents)
        for begin in range(0, len(contents), size):
            messages, at = contents[begin : begin + size], times[begin : begin + size]
            # a view: flags that are cleared here are cleared in the whole
            part = good[begin : begin + size]
            if not self.decodes_on_arrival:
                messages = self.decode(messages, at, part)
            values = self._read_each(self._signal_values, messages, at, part) if self._signal_fields else []
            if self.extractor is not None:
                chunks += self._read_objects(self.extractor, messages, begin, at, part)
            signals += compress(values, part.tolist())
        return TopicColumns(
            good=good,
            detections=None if self.extractor is None else self.extractor.detections(chunks, good),
            signals=np.array(signals, np.float64).reshape(int(good.sum()), len(self._signal_fields)),
        )

    def finish(self) -> None:
        """Check that the mapping fitted some message, after the last one.

        Raises:
            UsageError: there were messages, and the mapping fitted none.
        """
        if self.unstamped and not self._is_stamped and self.is_mapped:
            raise self._misfit_error(_NO_STAMP)
        for what, (_, first) in self._misfits.items():
            is_bound = self._signals is not None
            if what == "objects":
                is_bound = self.extractor is None or self.extractor.is_bound
            if not is_bound:
                raise self._misfit_error(first)
        if self.extractor is not None and self.extractor.is_bound and self.extractor.unseen:
            listed = ", ".join(self.extractor.unseen)
            raise self._misfit_error(
                f"none of its messages has {listed}; with `missing: 0` it would be 0 in all"
            )

    def _read_each(
        self, read: Callable[[Any], Any], items: Sequence[Any], log_times_ns: Sequence[int], good: Booleans
    ) -> list[Any]:
        """Apply `read` to the good items; report those that fail, and clear their flags."""
        results: list[Any] = [None] * len(items)
        for place in np.flatnonzero(good).tolist():
            try:
                results[place] = read(items[place])
            except (*MISFITS, LogError) as error:
                good[place] = False
                reason = str(error)
                if not isinstance(error, FieldError | LogError):
                    reason = f"the message differs from the others: {error}"
                self._report(self.name, log_times_ns[place], reason)
        return results

    def _read_objects(
        self,
        extractor: Extractor,
        messages: Sequence[Any],
        first: int,
        log_times_ns: Sequence[int],
        good: Booleans,
    ) -> list[DetectionChunk]:
        """Read the objects of the good messages, all at once if they are alike.

        Args:
            first: the place of the first message in its batch.
        """
        places = np.flatnonzero(good)
        try:
            return [extractor.read([messages[place] for place in places.tolist()], first + places)]
        except MISFITS:
            pass

        # one of them has another form: only reading each on its own shows which
        def read(numbered: tuple[int, object]) -> DetectionChunk:
            place, message = numbered
            was_bound = extractor.is_bound
            try:
                return extractor.read([message], np.array([place]))
            except ContentError:
                # bad values say nothing against the mapping
                raise
            except MISFITS as error:
                if not was_bound:
                    self._count_misfit("objects", error)
                raise

        chunks = self._read_each(read, list(enumerate(messages, first)), log_times_ns, good)
        return [chunk for chunk in chunks if chunk is not None]

    def _signal_values(self, message: object) -> list[float]:
        if self._signals is None:
            try:
                self._signals = [self._bind_signal(each, message) for each in self._signal_fields]
            except FieldError as error:
                self._count_misfit("signals", error)
                raise
        return [read(message) for read in self._signals]

    def _bind_signal(self, signal: SignalMapping, message: object) -> Get:
        path = FieldPath.of(signal.field)
        value = walk(path, message)
        get, table = getter(path, style_of(message)), signal.table
        if table:

            def number_of(message: object) -> float:
                text = str(get(message))
                if (
                    text not in table
                    and len(known := self.unnamed.setdefault(signal.name, {})) < _MOST_UNNAMED
                ):
                    known.setdefault(text[:_LONGEST_UNNAMED])
                return table.get(text, nan)

            return number_of
        try:
            _number(value)
        except (TypeError, OverflowError):
            raise FieldError(f"{signal.field}: its value is neither a number nor a text") from None
        return lambda message: _number(get(message))

    def _stamp(self, message: object) -> int | None:
        if self.transforms is not None and self.extractor is None:
            return self.transforms.stamp(message)
        try:
            if self.extractor is not None:
                time_ns = self.extractor.stamp(message)
                if self.extractor.lacks_stamp:
                    raise self._misfit_error(_NO_STAMP)
                return time_ns
            if not self._is_time_bound:
                entry = self.planned.mapping
                stamps = GENERIC.stamp if entry is None or entry.stamp is None else (entry.stamp,)
                self._time = bind_time(stamps, message, message)
                self._is_time_bound = True
        except FieldError as error:
            # before the first stamp, the mapping is wrong; afterwards, this message is
            if self._is_time_bound or (self.extractor is not None and self.extractor.is_timed):
                raise
            raise self._misfit_error(f"the clock is header, but {error}") from None
        if self._time is None:
            raise self._misfit_error(_NO_STAMP)
        return self._time.nanoseconds([message])[0]

    def _count_misfit(self, what: str, error: Exception) -> None:
        """Count a message that the mapping does not fit, before there was one that it fits.

        Raises:
            UsageError: there were many.
        """
        count, first = self._misfits.get(what, (0, ""))
        reason = str(error) if isinstance(error, FieldError) else f"its messages are not as expected: {error}"
        self._misfits[what] = count + 1, first or reason
        if count + 1 >= _PATIENCE:
            raise self._misfit_error(first)

    def _misfit_error(self, reason: str) -> UsageError:
        return UsageError(f"{self._mapping_name}: topics.{self.name}: {reason}")


class ClockStep(NamedTuple):
    """Where the clock of a topic steps back."""

    from_ns: int
    to_ns: int


class PendingMessages:
    """Messages of one topic that wait until no earlier message can arrive.

    Attributes:
        steps: how often the time steps back between messages whose sequence goes on.
        first_step: where it does so the first time.
    """

    def __init__(self, *, has_own_clock: bool) -> None:
        self.steps = 0
        self.first_step: ClockStep | None = None
        self._has_own_clock = has_own_clock
        self._columns: list[tuple[Integers, Integers, Integers, Integers]] = []
        self._contents: list[Any] = []

    def __len__(self) -> int:
        return len(self._contents)

    @property
    def first_ns(self) -> int | None:
        """The time of the first message that waits."""
        return min((int(each[0].min()) for each in self._columns if len(each[0])), default=None)

    def add(
        self,
        times_ns: Integers,
        sequences: Integers,
        log_times_ns: Integers,
        recorded: Integers,
        contents: list[Any],
    ) -> None:
        """Add messages in the order of arrival.

        Args:
            recorded: numbers that increase in the order of recording.
            contents: payloads, or decoded messages.
        """
        self._columns.append((times_ns, sequences, log_times_ns, recorded))
        self._contents += contents

    def take(self, upto_ns: int) -> tuple[Integers, Integers, list[Any]]:
        """Remove the messages up to a time, and return their times, log times and contents.

        They are ordered by time, then sequence, then arrival. A message that was recorded after a step of the
        clock, and would be sorted among those before, counts right after them.
        """
        none = np.empty(0, np.int64)
        columns = zip((none, none, none, none), *self._columns, strict=True)
        times, sequences, log_times, recorded = map(np.concatenate, columns)
        contents = self._contents
        if not self._has_own_clock:
            times = self._without_steps(times, sequences, recorded)
        if len(times) and not (times[1:] > times[:-1]).all():
            order = np.lexsort((sequences, times))
            times, sequences, log_times = times[order], sequences[order], log_times[order]
            recorded, contents = recorded[order], [contents[i] for i in order.tolist()]
        count = int(np.searchsorted(times, upto_ns, "right"))
        self._columns = [(times[count:], sequences[count:], log_times[count:], recorded[count:])]
        self._contents = contents[count:]
        return times[:count], log_times[:count], contents[:count]

    def _without_steps(self, times_ns: Integers, sequences: Integers, recorded: Integers) -> Integers:
        """Return times that do not step back, if the sequence goes on where they do."""
        if (recorded[1:] > recorded[:-1]).all() and (times_ns[1:] >= times_ns[:-1]).all():
            return times_ns
        order = np.argsort(recorded, kind="stable")
        times = times_ns[order]
        back = np.flatnonzero(times[1:] < times[:-1])
        if not len(back) or not (np.diff(sequences[order]) > 0).all():
            return times_ns
        self.steps += len(back)
        at = int(back[0])
        self.first_step = self.first_step or ClockStep(int(times[at]), int(times[at + 1]))
        # strictly increasing: what was recorded later counts later
        number = np.arange(len(times))
        moved = np.empty_like(times)
        moved[order] = np.maximum.accumulate(times - number) + number
        return moved


def _number(value: object) -> float:
    """Return the value of a signal, and the `text_number` of a text."""
    try:
        return float("nan") if value is None else float(value)  # type: ignore[arg-type]
    except ValueError:
        return text_number(str(value))


def _skip(payload: bytes) -> None:
    """Decode nothing: only the times of the topic are used."""


def _chunk_size(contents: Sequence[Any]) -> int:
    if not contents or not isinstance(contents[0], bytes):
        return _CHUNK
    return max(8, min(_CHUNK, _CHUNK_BYTES * len(contents) // max(1, sum(map(len, contents)))))
