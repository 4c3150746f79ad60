"""What a recorder writes to: a file from the first sample to the last; and the trial run before it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.compiled import compile_ahead
from spatial_replay.errors import OutputError
from spatial_replay.geometry.contact import contacts
from spatial_replay.geometry.footprint import Footprint, FootprintBatch, TrackedObject
from spatial_replay.geometry.measure import Operand
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.output_file import Durability, open_output
from spatial_replay.logs.topics import PLAN_METADATA
from spatial_replay.recording.recording import Recording, RunEvent
from spatial_replay.spec import object_names, signal_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

if TYPE_CHECKING:
    from spatial_replay.planning.planner import Planner

GATHER_S: Final = 0.2
"""How long samples are gathered before they are encoded. A few together cost hardly more than one, and while
none are encoded, the caller's thread need not wait for the interpreter lock."""


_EVALUATING_S: Final = 0.05
"""About how long samples are evaluated before those that have come are written."""
_AT_FIRST, _MOST_AT_ONCE = 16, 1024
"""How many samples are evaluated at first before that time is known, and at most."""


Missed: TypeAlias = Literal["sample", "message"]


class RunEnd(NamedTuple):
    """How a recording ended: whether early, and how many samples and messages found no place."""

    interrupted: bool
    dropped: int
    messages_dropped: int


class RecorderLog(Protocol):
    """What the thread of a recorder writes to; only that thread calls it, but for `miss` and `close`."""

    @property
    def gather_s(self) -> float:
        """How long to gather samples before the next call of `add`."""

    @property
    def is_busy(self) -> bool:
        """Whether to call `add` again at once, whatever has come."""

    @property
    def backlog(self) -> int:
        """How many of the samples given so far wait for their evaluation."""

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """Write the next samples, given in both forms, and messages."""

    def miss(self, time_ns: int, kind: Missed) -> None:
        """Take note of what found no place; the threads that write call it."""

    def report(self, event: RunEvent) -> None:
        """Write what happens to the run beside its samples."""

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""

    def end(self, end: RunEnd) -> None:
        """Write what follows the last sample."""

    def break_off(self, end: RunEnd) -> None:
        """Write the end after a failure, as far as that is possible."""

    def close(self) -> None:
        """Let go of files, whatever happened before."""


class FileLog:
    """One log in one file, written in place.

    Samples are written before they are evaluated, a few at a time: an evaluation can be repeated from the
    log, samples cannot.
    """

    gather_s = GATHER_S

    def __init__(
        self,
        path: Path,
        files: Sequence[Specification],
        about: Mapping[str, str] | None,
        durability: Durability = "process",
        *,
        overwrite: bool = True,
    ) -> None:
        """Begin the file, with everything compiled that writing to it takes."""
        self.backlog = 0
        self._unevaluated: deque[Trace] = deque()
        self._plans: deque[Mapping[str, str]] = deque()
        self._at_once = _AT_FIRST
        self._stream = open_output(path, durability, overwrite=overwrite)
        try:
            self._writer = LogWriter(self._stream, clock=time.monotonic)
            self._recording = Recording(self._writer, files, about)
            self.flush()
            warm_up(self._recording.files, self._recording.automata)
        except BaseException:
            with suppress(OutputError):
                self._stream.close()
            raise

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """See `RecorderLog`."""
        while self._plans:
            self._recording.add_metadata(PLAN_METADATA, self._plans.popleft())
        if len(trace) or len(messages):
            self._recording.add_samples(trace, messages)
        if len(trace):
            self.backlog += len(trace)
            self._unevaluated.append(trace)
        if self._unevaluated:
            self._evaluate_some()

    def miss(self, time_ns: int, kind: Missed) -> None:
        """The end of the log has the counts."""

    def report(self, event: RunEvent) -> None:
        """See `RecorderLog`."""
        self._recording.report(event)

    def add_plan(self, planner: Planner, number: int) -> None:
        """Write the settings of a planner of a specification with what is added next; from any thread."""
        from spatial_replay.planning.decision_log import plan_metadata

        self._plans.append(plan_metadata(planner, self._recording.files[number].filename))

    @property
    def is_busy(self) -> bool:
        """Whether samples wait for their evaluation."""
        return bool(self._unevaluated)

    def _evaluate_some(self) -> None:
        """Evaluate the next samples, as many as take the time that there is."""
        trace = self._unevaluated.popleft()
        count = min(self._at_once, len(trace))
        if count < len(trace):
            self._unevaluated.appendleft(trace.slice(count, len(trace)))
        begun = time.monotonic()
        self._recording.evaluate(trace.slice(0, count))
        self.backlog -= count
        took_s = max(time.monotonic() - begun, 1e-6)
        self._at_once = max(1, min(int(count * _EVALUATING_S / took_s), _MOST_AT_ONCE))

    def flush(self) -> None:
        """See `RecorderLog`."""
        self._writer.flush()
        self._stream.flush()

    def end(self, end: RunEnd) -> None:
        """See `RecorderLog`."""
        while self._unevaluated:
            self._evaluate_some()
        self._recording.end(
            interrupted=end.interrupted, dropped=end.dropped, messages_dropped=end.messages_dropped
        )
        self._writer.close()

    def break_off(self, end: RunEnd) -> None:
        """See `RecorderLog`."""
        self._recording.break_off(dropped=end.dropped, messages_dropped=end.messages_dropped)
        self._writer.close()

    def close(self) -> None:
        """See `RecorderLog`."""
        self._stream.close()


def encodable(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples before the first that cannot be encoded."""
    sound: list[Sample] = []
    with suppress(Exception):
        for sample in samples:
            Trace.from_samples([sample])
            sound.append(sample)
    return sound


def warm_up(files: Sequence[Specification], automata: Sequence[SpecAutomaton]) -> None:
    """Record some samples into memory, so that the code for the specifications is compiled and loaded.

    With an empty compiler cache this takes many seconds, otherwise a fraction of one.

    Args:
        automata: those of the specifications, which are not compiled again.
    """
    compile_ahead()
    writer = LogWriter(BytesIO())
    recording = Recording(writer, files, known=automata)
    objects = ["object", *(name for file in files for name in object_names(file))]
    signals = {name: 0.0 for file in files for name in signal_names(file)}
    samples = [
        Sample(
            time_s * 10**9,
            {
                name: _tracked(index + time_s, 0.1 * index + time_s)
                for index, name in enumerate(dict.fromkeys(objects))
            },
            signals,
        )
        for time_s in range(4)
    ]
    recording.add(Trace.from_samples(samples[:1]))
    recording.add(Trace.from_samples(samples[1:]))
    # without objects: intervals of unknown atoms run code of their own
    recording.add(Trace.from_samples([Sample(10**10, {})]))
    recording.end()
    writer.close()
    # the arrow at a violation, of which these samples may have none
    shapes = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in range(2)])
    contacts(shapes, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=False)


def _tracked(kind: int, x: float) -> TrackedObject:
    box, disc = Footprint.box(x, 0, x + 1, 1), Footprint.disc(x + 0.5, 0.5, 0.5)
    footprint = (box, disc, Footprint((*box.parts, *disc.parts)))[kind % 3]
    return TrackedObject(footprint, class_name="thing", yaw=x, height=(0.0, 1.0), uncertainty=0.01)
