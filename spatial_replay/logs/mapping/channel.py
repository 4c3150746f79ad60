"""The messages of one topic on their way to samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.foreign.messages import Decoder, Message
from spatial_replay.logs.mapping.binding import TimeGetter, bind_time
from spatial_replay.logs.mapping.extract import Extractor, Seen
from spatial_replay.logs.mapping.fields import style_of
from spatial_replay.logs.mapping.naming import Codes
from spatial_replay.logs.mapping.paths import FieldError, Get, Path, check, getter, walk
from spatial_replay.logs.mapping.plan import PlannedTopic
from spatial_replay.logs.mapping.readings import GENERIC
from spatial_replay.logs.mapping.transforms import stamp_of_transforms
from spatial_replay.trace.times import LATEST_NS

MISFITS = (FieldError, AttributeError, LookupError, TypeError, ValueError, OverflowError)
"""What reading fields of a message raises that is not as the mapping says."""


class Pending:
    """Messages with their times: decoded, not yet turned into objects."""

    def __init__(self) -> None:
        self.times_ns = np.empty(0, np.int64)
        self.sequences = np.empty(0, np.int64)
        self.log_times_ns = np.empty(0, np.int64)
        self.contents: list[object] = []

    def add(
        self, times_ns: Integers, sequences: Integers, log_times_ns: Integers, contents: list[object]
    ) -> None:
        self.times_ns = np.concatenate([self.times_ns, times_ns])
        self.sequences = np.concatenate([self.sequences, sequences])
        self.log_times_ns = np.concatenate([self.log_times_ns, log_times_ns])
        self.contents += contents

    def take(self, upto_ns: int) -> tuple[Integers, Integers, list[object]]:
        """Times, log times and contents of the messages up to a time, in order; they are pending no more."""
        order = np.lexsort((self.sequences, self.times_ns))
        count = int(np.searchsorted(self.times_ns[order], upto_ns, "right"))
        taken, rest = order[:count], order[count:]
        # what is left keeps the order in which it came
        rest = np.sort(rest)
        found = (self.times_ns[taken], self.log_times_ns[taken], [self.contents[i] for i in taken.tolist()])
        self.times_ns, self.sequences = self.times_ns[rest], self.sequences[rest]
        self.log_times_ns = self.log_times_ns[rest]
        self.contents = [self.contents[i] for i in rest.tolist()]
        return found


class Channel:
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
        self._time: TimeGetter | None = None
        self._has_time = False
        self._signals: list[Get] | None = None

    @property
    def name(self) -> str:
        return self.planned.name

    def decoded(self, messages: Sequence[Message]) -> tuple[list[object], list[int]]:
        """What the messages hold, and which of them could be decoded."""
        if self._decode is None:
            return [None] * len(messages), list(range(len(messages)))
        decode = self._decode
        try:
            return [decode(message[4]) for message in messages], list(range(len(messages)))
        except LogError:
            payloads = [message[4] for message in messages]
            return self._one_by_one(payloads, decode, [message[1] for message in messages])

    def times(self, messages: Sequence[Message], contents: Sequence[object]) -> tuple[list[int], list[int]]:
        """The time of each message on its clock, and which of the messages have one.

        Raises:
            UsageError: there are no stamps where the mapping says.
        """
        if self.planned.clock != "header":
            by_log = self.planned.clock == "log"
            times_ns = [message[1] if by_log else message[2] for message in messages]
            return times_ns, list(range(len(messages)))
        found, kept = self._one_by_one(contents, self._stamp, [message[1] for message in messages])
        pairs = [(time, place) for time, place in zip(found, kept, strict=True) if isinstance(time, int)]
        late = [time for time, _ in pairs if not 0 <= time <= LATEST_NS]
        if late:
            raise self._misfit(f"its stamp {late[0]} ns lies outside the times of a log; take another clock")
        return [time for time, _ in pairs], [place for _, place in pairs]

    def seen(self, log_times_ns: Integers, contents: list[object]) -> tuple[Seen, list[int]]:
        """The objects in messages, and which of the messages could be read.

        Raises:
            UsageError: the mapping does not fit the first message with objects.
        """
        assert self.extractor is not None
        extractor = self.extractor
        everything = list(range(len(contents)))
        try:
            return extractor.extract(contents), everything
        except MISFITS as error:
            if not extractor.is_bound:
                self._bind_first(contents, error)
        _, kept = self._one_by_one(
            contents, lambda content: extractor.extract([content]), log_times_ns.tolist()
        )
        return extractor.extract([contents[i] for i in kept]), kept

    def signals(self, log_times_ns: Integers, contents: list[object]) -> tuple[list[Floats], list[int]]:
        """(M,) values of each signal, and which of the messages could be read.

        Raises:
            UsageError: a signal's path leads nowhere in the first message.
        """
        entry = self.planned.mapping
        if entry is None or not entry.signals:
            return [], list(range(len(contents)))
        if self._signals is None and contents:
            self._signals = [self._bind_signal(signal.field, contents[0]) for signal in entry.signals]
        gets = self._signals or []

        def values(content: object) -> list[float]:
            return [_number(get(content)) for get in gets]

        found, kept = self._one_by_one(contents, values, log_times_ns.tolist())
        columns = np.array(found, np.float64).reshape(len(found), len(entry.signals))
        return [columns[:, place] for place in range(len(entry.signals))], kept

    def _stamp(self, content: object) -> int | None:
        if self.planned.is_transforms and self.extractor is None:
            return stamp_of_transforms(content)
        try:
            if self.extractor is not None:
                return self.extractor.message_times([content])[0] if self._checked_stamps(content) else None
            if not self._has_time:
                entry = self.planned.mapping
                stamps = GENERIC.stamp if entry is None or entry.stamp is None else (entry.stamp,)
                self._time = bind_time(stamps, content, content)
                self._has_time = True
        except FieldError as error:
            raise self._misfit(f"the clock is header, but {error}") from None
        if self._time is None:
            raise self._misfit("the clock is header, but its messages have no stamp; give one with `stamp`")
        return self._time.nanoseconds([content])[0]

    def _checked_stamps(self, content: object) -> bool:
        assert self.extractor is not None
        if not self.extractor.reading.stamp:
            raise self._misfit("the clock is header, but its messages have no stamp; give one with `stamp`")
        return content is not None

    def _bind_first(self, contents: list[object], error: Exception) -> None:
        """Find the message that no path is known to fit yet, and say what is wrong with it."""
        assert self.extractor is not None
        for content in contents:
            try:
                self.extractor.extract([content])
            except FieldError as fault:
                raise self._misfit(str(fault)) from None
            except MISFITS as fault:
                raise self._misfit(f"its messages are not as expected: {fault}") from None
            if self.extractor.is_bound:
                return
        raise self._misfit(str(error)) from None

    def _bind_signal(self, text: str, content: object) -> Get:
        path = Path.of(text)
        try:
            check(path, content)
            _number(walk(path, content))
        except FieldError as error:
            raise self._misfit(str(error)) from None
        except (TypeError, ValueError):
            raise self._misfit(f"{text}: its value is no number; give the path of one") from None
        return getter(path, style_of(content))

    def _misfit(self, what: str) -> UsageError:
        return UsageError(f"{self._mapping_name}: topics.{self.name}: {what}")

    def _one_by_one(
        self, items: Sequence[object], read: Callable[[Any], object], log_times_ns: Sequence[int]
    ) -> tuple[list[object], list[int]]:
        """What can be read of each, and which those are; the others are told as faults."""
        found: list[object] = []
        kept: list[int] = []
        for place, item in enumerate(items):
            try:
                found.append(read(item))
            except (*MISFITS, LogError) as error:
                self._fault(self.name, log_times_ns[place], _said(error))
            else:
                kept.append(place)
        return found, kept


def _number(value: object) -> float:
    return float("nan") if value is None else float(value)  # type: ignore[arg-type]


def _said(error: Exception) -> str:
    if isinstance(error, FieldError | LogError):
        return str(error)
    return f"the message is not as the others: {error}"
