"""Logs of messages as sources of samples: read, mapped, and copied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.block import Block
from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.foreign.channels import CopiedMessages
from spatial_replay.logs.foreign.columns import Columns, MessageColumns, in_pieces
from spatial_replay.logs.foreign.jumps import without_jumps
from spatial_replay.logs.foreign.messages import MessageReader, Topic
from spatial_replay.logs.foreign.opening import ColumnReader, open_messages
from spatial_replay.logs.mapping.assembler import Assembler
from spatial_replay.logs.mapping.model import Mapping as TopicsMapping
from spatial_replay.logs.mapping.plan import Plan
from spatial_replay.logs.options import OnTimeJump
from spatial_replay.logs.sink import Attachment
from spatial_replay.trace.times import FOREVER
from spatial_replay.trace.trace import Trace

_WAITING_BYTES = 2**26
_MOST_UNREAD = 20
"""How many topics that cannot be decoded are told one by one."""


@dataclass(frozen=True)
class ForeignSource:
    """A log of messages that others recorded, with a mapping that says what in them are objects."""

    path: Path
    mapping: TopicsMapping
    kind: str
    concave: Concave = "decompose"
    on_time_jump: OnTimeJump = "error"

    @property
    def name(self) -> str:
        return self.path.name or self.path.absolute().name

    @property
    def options(self) -> Mapping[str, object]:
        """How the log is read, for the metadata of a copy."""
        mapping = {"mapping": self.mapping.name, "mapping_sha256": self.mapping.sha256}
        return mapping | ({} if self.on_time_jump == "error" else {"on_time_jump": self.on_time_jump})

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`; of an indexed log, only what the window needs is read.

        Blocks hold the messages of mapped topics, raw.
        """
        # a window that leaves nothing out is none: what a log declares is compared with all that is read
        start_ns = start_ns or None
        end_ns = None if end_ns is None or end_ns >= FOREVER else end_ns
        reader = open_messages(self.path)
        topics = reader.topics()
        plan = self._plan(reader, topics)
        read = [topic for topic in topics if topic.name in plan.topics]
        assembler = Assembler(
            plan,
            reader.decoder,
            name=self.name,
            start_ns=start_ns,
            end_ns=end_ns,
            on_time_jump=self.on_time_jump,
            concave=self.concave,
        )
        blocks = _Blocks(assembler, reader, CopiedMessages(read, _WAITING_BYTES), start_ns, end_ns)
        blocks.remarks.extend(_unread(self.name, topics, plan))
        as_recorded = self.on_time_jump == "split"
        columns = _columns(reader, plan, start_ns, end_ns, as_recorded=as_recorded)
        if not as_recorded:
            columns = without_jumps(columns, self.name)
        for piece in in_pieces(columns):
            yield from blocks.of(assembler.add(piece), piece)
            if assembler.is_finished:
                break
        yield from blocks.of(assembler.finish(), MessageColumns(), last=True)
        if not blocks.any_sample and start_ns is None and end_ns is None:
            reason = blocks.first_fault or "its messages make none with this mapping"
            raise LogError(f"{self.name} holds no sample: {reason}")

    def _plan(self, reader: MessageReader, topics: Sequence[Topic]) -> Plan:
        """What has to be read, and how.

        Raises:
            LogError: a topic that is mapped cannot be decoded, or is missing from a damaged log.
            UsageError: the mapping does not fit the log.
        """
        mapped = {*(each.topic for each in self.mapping.topics), self.mapping.sampling.topic}
        reasons = [topic.unreadable for topic in topics if topic.name in mapped and topic.unreadable]
        if reasons:
            raise LogError("\n".join(f"{self.name}: {reason}" for reason in reasons))
        try:
            return Plan.of(self.mapping, topics)
        except UsageError as error:
            faults = reader.take_faults()
            if faults:
                raise LogError("\n".join([str(error), *faults])) from None
            raise

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`; a log of others keeps nothing that a replay needs."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return ()


class _Blocks:
    """Samples and messages to blocks, with what was lost on the way."""

    def __init__(
        self,
        assembler: Assembler,
        reader: MessageReader,
        copied: CopiedMessages,
        start_ns: int | None,
        end_ns: int | None,
    ) -> None:
        self._assembler = assembler
        self._reader = reader
        self._copied = copied
        self._window = start_ns or 0, end_ns
        self._faults = FaultList()
        self.remarks: list[str] = []
        self.any_sample = False
        self.first_fault: str | None = None

    def of(self, trace: Trace, messages: MessageColumns, *, last: bool = False) -> Iterator[Block]:
        """A block, or none while there is nothing to say."""
        start_ns, end_ns = self._window
        if start_ns or end_ns is not None:
            inside = messages.log_time_ns >= start_ns
            if end_ns is not None:
                inside &= messages.log_time_ns < end_ns
            messages = messages.take(np.flatnonzero(inside))
        self._copied.add(messages)
        for fault in trace.faults:
            self._faults.add(fault)
        self._reader.move_faults(self._faults)
        self._assembler.move_faults(self._faults)
        faults = self._faults.take(last=last)
        self.any_sample = self.any_sample or len(trace) > 0
        self.first_fault = self.first_fault or next(iter(faults), None)
        remarks = (*self.remarks, *self._reader.take_remarks(), *self._assembler.take_remarks())
        self.remarks = []
        copied = self._copied.take(trace, last=last)
        if len(trace) or len(copied) or faults or remarks:
            yield Block(replace(trace, faults=faults), copied, remarks)


def _unread(name: str, topics: Sequence[Topic], plan: Plan) -> list[str]:
    """Remarks on topics that are not mapped and could not be, with how many messages they have."""
    unread = [each for each in topics if each.unreadable and each.count != 0 and each.name not in plan.topics]
    remarks = []
    for topic in unread[:_MOST_UNREAD]:
        count = "an unknown number" if topic.count is None else f"{topic.count}"
        remarks.append(f"{name}: {topic.unreadable}; it is not mapped: messages not read: {count}")
    if len(unread) > _MOST_UNREAD:
        more = len(unread) - _MOST_UNREAD
        remarks.append(f"{name}: of the topics that are not mapped, {more} more cannot be decoded")
    return remarks


def _columns(
    reader: ColumnReader, plan: Plan, start_ns: int | None, end_ns: int | None, *, as_recorded: bool
) -> Columns:
    """The messages that samples of a window depend on."""
    if not plan.by_log_time or (not start_ns and end_ns is None):
        return reader.iter_columns(plan.topics, as_recorded=as_recorded)
    last = None if end_ns is None else end_ns + plan.margin_ns
    lookback = {topic: plan.lookback_ns(topic) for topic in plan.topics}
    known = [each for each in lookback.values() if each is not None]
    first = max(0, (start_ns or 0) - max(known, default=0))
    lasting = [topic for topic, each in lookback.items() if each is None]
    window = reader.iter_columns(plan.topics, first or None, last, as_recorded=as_recorded)
    if not lasting or not first:
        return window
    return chain(reader.iter_columns(lasting, None, first, as_recorded=as_recorded), window)
