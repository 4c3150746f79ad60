"""What a log holds, in numbers and names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.logs.mcap_info import LogSummary, summarise_mcap
from spatial_replay.logs.mcap_reader import McapSource
from spatial_replay.logs.source import Source, TrackSource
from spatial_replay.logs.survey import Survey
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, slots=True)
class ObjectOverview:
    """One object over a log.

    Attributes:
        classes: the class names it was given, in order of code points.
        samples: in how many samples it was seen.
        unreadable: in how many of them its coordinates were not all finite.
    """

    name: str
    classes: tuple[str, ...]
    samples: int
    unreadable: int


@dataclass(frozen=True, slots=True)
class Overview:
    """What a log holds.

    Attributes:
        start_ns, end_ns: times of the first and the last sample; None without samples.
        faults: what was lost or set aside, in words.
        container: channels, metadata and attachments of an MCAP log; None for other formats.
        remarks: what else there is to know, without anything being lost.
    """

    name: str
    kind: str
    samples: int
    start_ns: int | None
    end_ns: int | None
    objects: tuple[ObjectOverview, ...]
    signals: tuple[str, ...]
    faults: tuple[str, ...]
    container: LogSummary | None = None
    remarks: tuple[str, ...] = ()


def overview_of(source: Source, advance: Callable[[int], object] = lambda samples: None) -> Overview:
    """Read a log once and say what it holds.

    Args:
        advance: called with the number of samples read, again and again.

    Raises:
        LogError: nothing in the log can be read as a sample.
    """
    tally = _Tally()
    remarks: list[str] = []
    container = summarise_mcap(source.path) if isinstance(source, McapSource) else None
    # a log of something else has no samples, and yet something to tell
    if container is None or container.has_objects:
        try:
            for block in source.iter_blocks():
                tally.add(block.trace)
                remarks += block.remarks
                advance(len(block.trace))
        except UsageError as error:
            # a scenario without objects is sound; a mapping that does not fit is a mistake to be put right
            if not isinstance(source, TrackSource):
                raise
            remarks.append(str(error))
    faults = [*tally.faults, *(container.faults if container is not None else ())]
    return Overview(
        name=source.name,
        kind=source.kind,
        samples=tally.samples,
        start_ns=tally.start_ns,
        end_ns=tally.end_ns,
        objects=tally.objects(),
        signals=tuple(sorted(tally.signals)),
        # reading the samples and the rest of the file comes upon the same damage
        faults=tuple(dict.fromkeys(faults)),
        container=container,
        remarks=tuple(remarks),
    )


def overview_of_survey(path: Path, survey: Survey) -> Overview:
    """What is in a log of messages by others, of which nothing says yet what its samples are."""
    container = summarise_mcap(path) if survey.kind == McapSource.kind else None
    return Overview(
        name=survey.name,
        kind=survey.kind,
        samples=0,
        start_ns=None,
        end_ns=None,
        objects=(),
        signals=(),
        faults=container.faults if container is not None else (),
        container=container,
    )


@dataclass(slots=True)
class _Tally:
    """Counts over the blocks so far."""

    samples: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    seen: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    unreadable: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    classes: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    signals: set[str] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)

    def add(self, trace: Trace) -> None:
        self.faults.extend(trace.faults)
        if not len(trace):
            return
        self.samples += len(trace)
        self.start_ns = int(trace.times_ns[0]) if self.start_ns is None else self.start_ns
        self.end_ns = int(trace.times_ns[-1])
        self.signals.update(trace.signals)
        for column, name in enumerate(trace.names):
            rows = trace.rows[:, column]
            readable, unreadable = rows[rows >= 0], -2 - rows[rows <= -2]
            self.seen[name] += len(readable) + len(unreadable)
            self.unreadable[name] += len(unreadable)
            codes = np.unique(trace.class_code[np.concatenate([readable, unreadable])])
            self.classes[name].update(
                class_name for code in codes.tolist() if (class_name := trace.classes[code]) is not None
            )

    def objects(self) -> tuple[ObjectOverview, ...]:
        return tuple(
            ObjectOverview(name, tuple(sorted(self.classes[name])), self.seen[name], self.unreadable[name])
            for name in sorted(self.seen)
        )
