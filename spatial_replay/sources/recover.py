"""Recover damaged logs: write all readable messages to an MCAP log with an index and a list of losses."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from spatial_replay.bags.open import McapLog, open_messages
from spatial_replay.bags.reader import MessageReader
from spatial_replay.bags.ros1 import Ros1Bag
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Integers, select
from spatial_replay.logs.mcap.read import decode_samples, is_samples, without
from spatial_replay.logs.mcap.write import WHOLE_CHUNK_NS, LogWriter
from spatial_replay.logs.messages import Channel, Messages
from spatial_replay.logs.output_file import refuse_inputs, replacing
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.logs.topics import ENDING, METADATA, RECOVERY
from spatial_replay.sources.open_log import format_of, is_bag_folder, readable_file
from spatial_replay.text import Instant, Sentence, counted_from, plural
from spatial_replay.trace.trace import FOREVER

_MOST_GAPS = 1_000
"""Limit of listed sample gaps; the last listed gap extends over later gaps."""
_BY_ENDING: Mapping[str, type[MessageReader]] = {".mcap": McapLog, ".bag": Ros1Bag}
"""Readers by file ending, for files whose first bytes are damaged."""


@dataclass(frozen=True, slots=True)
class SampleGap:
    """A gap of missing samples in a recording.

    Attributes:
        first, last: numbers of the first and the last missing sample, from 0.
        after_ns: time of the sample before the gap; None without such a sample.
        before_ns: time of the sample after the gap; None without such a sample.
    """

    first: int
    last: int
    after_ns: int | None
    before_ns: int | None


@dataclass(frozen=True, slots=True)
class Recovery:
    """Saved and missing parts of a log.

    Attributes:
        name: name of the damaged log.
        start_ns, end_ns: log times of the first and the last saved message.
        saved: numbers of saved messages, by topic.
        missing: numbers of missing messages, by topic, from the counts that the log declares. A log without
            an index declares no counts.
        spans: known (start, end) times of losses, in nanoseconds.
        samples: gaps among the samples of our own recordings; empty for other logs.
        faults: sentences on damage, each with the place in the file. Times count from the first message.
        remarks: notes that do not concern losses.
    """

    name: str
    start_ns: int
    end_ns: int
    saved: Mapping[str, int]
    missing: Mapping[str, int]
    spans: tuple[tuple[int, int], ...]
    samples: tuple[SampleGap, ...]
    faults: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @property
    def messages(self) -> int:
        """Number of saved messages."""
        return sum(self.saved.values())

    @property
    def is_whole(self) -> bool:
        """Whether the log has no fault."""
        return not self.faults

    @property
    def losses(self) -> str:
        """Clause on the missing parts, such as `3 messages are missing`."""
        sample_count = sum(gap.last - gap.first + 1 for gap in self.samples)
        message_count = sum(self.missing.values())
        if message_count and sample_count:
            return f"{_missing(message_count, 'message')}, {plural(sample_count, 'sample')} among them"
        if message_count or sample_count:
            return _missing(message_count or sample_count, "message" if message_count else "sample")
        return "how much is missing is not known"

    def metadata(self) -> dict[str, str]:
        """Return the metadata record of the losses."""
        return {
            "source": self.name,
            "losses": self.losses,
            "spans_ns": json.dumps(self.spans),
            "samples": json.dumps([[gap.first, gap.last] for gap in self.samples]),
            "messages": json.dumps(dict(sorted(self.missing.items()))),
            "faults": json.dumps(self.faults),
        }


def recover_log(
    log: str | PathLike[str],
    output: str | PathLike[str],
    advance: Callable[[int], object] = lambda messages: None,
) -> Recovery:
    """Write all readable messages of a log to an MCAP log with an index.

    Messages are copied byte for byte in order of time, with their topics, types, sequence numbers and times.
    Metadata and attachments are copied, too. Our own samples are left out if they cannot be decoded or repeat
    a time.

    The result, and a metadata record of the output, list the losses. Without losses, the output has no such
    record. Recovering the output again gives the same bytes.

    Args:
        log: our own or an external MCAP log, a ROS 1 bag, or a file or folder of a ROS 2 bag.
        output: path of the output, which replaces an existing file once it is complete.
        advance: function that is called with the number of messages read since the last call.

    Raises:
        UsageError: the log is a text file, or the output is an input.
        MissingFileError: there is no such log.
        LogError: no message can be read.
        OutputError: the output cannot be written.
    """
    inputs, output = local_files([log]), Path(output)
    refuse_inputs(output, inputs)
    reader, faults = _open_log(readable_file(log))
    recovery, is_ordered = _write(reader, faults, output, inputs, advance)
    if not is_ordered:
        # messages with damaged times were written in their chunk's place; reading the output sorts them by
        # time
        _write(McapLog(output), FaultList(), output, (), advance)
    return recovery


def _write(
    reader: MessageReader,
    faults: FaultList,
    output: Path,
    inputs: Sequence[Path],
    advance: Callable[[int], object],
) -> tuple[Recovery, bool]:
    """Write all messages of a reader; return the recovery, and whether messages are in order of time."""
    try:
        topics = reader.topics()
    except LogError as error:
        raise LogError(f"nothing of {reader.name} can be recovered: {error}") from None
    topic_names = {topic.name for topic in topics}
    channels, metadata = reader.channels(topic_names), reader.metadata()
    saved_counts, start_ns, end_ns, is_ordered = Counter[str](), FOREVER, -1, True
    sample_filter = _Samples(reader.name, channels, dict(metadata), faults)
    with (
        replacing(output, inputs) as stream,
        LogWriter(stream, profile=reader.profile, chunk_ns=WHOLE_CHUNK_NS) as writer,
    ):
        for name, data in metadata:
            if name != RECOVERY:
                writer.add_metadata(name, data)
        for attachment in reader.attachments():
            attachment_times = {
                "log_time_ns": attachment.log_time_ns,
                "create_time_ns": attachment.create_time_ns,
            }
            writer.add_attachment(attachment.name, attachment.media_type, attachment.data, **attachment_times)
        for columns in reader.iter_columns(topic_names):
            messages = sample_filter.usable(columns)
            writer.write_messages(messages)
            for channel_number, message_count in zip(
                *np.unique(messages.channel, return_counts=True), strict=True
            ):
                saved_counts[channels[int(channel_number)].topic] += int(message_count)
            if len(messages):
                times_ns = messages.log_time_ns
                is_ordered &= bool(times_ns[0] >= end_ns and (times_ns[1:] >= times_ns[:-1]).all())
                start_ns, end_ns = min(start_ns, int(times_ns.min())), max(end_ns, int(times_ns.max()))
            advance(len(columns))
        reader.move_faults(faults)
        if end_ns < 0:
            reason = next(iter(faults.take()), "it has none")
            raise LogError(f"no message of {reader.name} can be recovered: {reason}")
        recovery = Recovery(
            reader.name,
            start_ns,
            end_ns,
            saved={name: saved_counts[name] for name in sorted(topic_names)},
            missing={
                topic.name: topic.count - saved_counts[topic.name]
                for topic in topics
                if topic.count is not None and topic.count > saved_counts[topic.name]
            },
            spans=(),
            samples=(),
            faults=counted_from(faults.take(last=True), start_ns),
            remarks=counted_from(reader.take_remarks(), start_ns),
        )
        if not recovery.is_whole:
            recovery = replace(recovery, spans=_spans(recovery.faults), samples=sample_filter.gaps())
        # records of earlier recoveries stay, because the losses in them are still missing
        earlier_records = [data for name, data in metadata if name == RECOVERY]
        for record in [*earlier_records, *([] if recovery.is_whole else [recovery.metadata()])]:
            writer.add_metadata(RECOVERY, record)
    return recovery, is_ordered


def _open_log(file: LogFile) -> tuple[MessageReader, FaultList]:
    """Return a reader of a log, also if its first bytes are damaged, and the faults so far."""
    faults = FaultList()
    if isinstance(file, Path) and is_bag_folder(file):
        return open_messages(file), faults
    format_name = format_of(file)
    if format_name is not None and not format_name.endswith(("MCAP", "bag")):
        raise UsageError(
            f"{file.name} is a {format_name}, a text file without an index; `spatial-replay record tracks`"
            " writes its readable part as a log"
        )
    reader = _BY_ENDING.get(Path(file.name).suffix.lower())
    if format_name is None and reader is not None:
        faults.add(f"{file.name}: at byte 0: its first bytes are not those of a {reader.kind} log")
        return reader(file), faults
    return open_messages(file), faults


def _missing(count: int, noun: str) -> str:
    return f"{plural(count, noun)} {'is' if count == 1 else 'are'} missing"


def _spans(faults: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return the (start, end) of each fault with times, in nanoseconds and in order."""
    times_of_faults = [
        [part.time_ns for part in fault.parts if isinstance(part, Instant)]
        for fault in faults
        if isinstance(fault, Sentence)
    ]
    return tuple(sorted({(min(times_ns), max(times_ns)) for times_ns in times_of_faults if times_ns}))


class _Samples:
    """Filter of our own samples that also finds gaps in the sample numbers."""

    def __init__(
        self,
        name: str,
        channels: Mapping[int, Channel],
        metadata: Mapping[str, Mapping[str, str]],
        faults: FaultList,
    ) -> None:
        self._name = name
        self._faults = faults
        self._sample_channels = [
            channel_number for channel_number, channel in channels.items() if is_samples(channel)
        ]
        # only recordings number samples from 0; a replay of a part of a log keeps the log's numbers
        is_recording = metadata.get(METADATA, {}).get("written_by") == "record"
        self._last_number = -1 if is_recording else None
        self._declared_count = metadata.get(ENDING, {}).get("samples", "") if is_recording else ""
        self._last_ns = -1
        self._gaps: list[SampleGap] = []

    def usable(self, messages: Messages) -> Messages:
        """Return the messages, except our own samples that cannot be decoded or repeat a time."""
        sample_indices = np.flatnonzero(np.isin(messages.channel, self._sample_channels))
        if not len(sample_indices):
            return messages
        _, readable_indices = decode_samples(messages, sample_indices, self._last_ns, self._fault)
        self._find_gaps(messages.sequence[readable_indices], messages.log_time_ns[readable_indices])
        return (
            select(messages, without(messages, sample_indices, readable_indices))
            if len(readable_indices) < len(sample_indices)
            else messages
        )

    def gaps(self) -> tuple[SampleGap, ...]:
        """Return all gaps, also a gap between the last sample and the declared number of samples."""
        if self._declared_count.isdecimal() and self._last_number is not None:
            self._gap(self._last_number + 1, int(self._declared_count) - 1, None)
        return tuple(self._gaps)

    def _find_gaps(self, sample_numbers: Integers, times_ns: Integers) -> None:
        for sample_number, time_ns in zip(sample_numbers.tolist(), times_ns.tolist(), strict=True):
            if self._last_number is not None:
                self._gap(self._last_number + 1, sample_number - 1, time_ns)
            self._last_number, self._last_ns = sample_number, time_ns

    def _gap(self, first_missing: int, last_missing: int, before_ns: int | None) -> None:
        if first_missing > last_missing:
            return
        after_ns = None if self._last_ns < 0 else self._last_ns
        if len(self._gaps) < _MOST_GAPS:
            self._gaps.append(SampleGap(first_missing, last_missing, after_ns, before_ns))
        else:
            self._gaps[-1] = replace(self._gaps[-1], last=last_missing, before_ns=before_ns)

    def _fault(self, fault_text: Sentence) -> None:
        self._faults.add(Sentence(f"{self._name}: ", fault_text))
