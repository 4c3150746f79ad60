"""A recorder in the loop: the caller hands over samples, a thread of its own writes them.

Compiled code loaded before the first sample, so that no sample waits for it.

Compiled code loaded before the first sample, so that no decision waits for it.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.compiled import compile_ahead
from spatial_replay.errors import OutputError, TraceError, UsageError
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.contact import contacts
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.geometry.measure import Operand
from spatial_replay.logs.mcap.writer import LogWriter
from spatial_replay.logs.messages import MemorySink
from spatial_replay.logs.output_file import open_output, refuse_inputs
from spatial_replay.planning.decision_log import BlackBox
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.recording.interruption import terminable, uninterrupted
from spatial_replay.recording.recording import Recording, refuse_templates
from spatial_replay.spec import object_names, parse_specification, signal_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace


def warm_up(files: Sequence[Specification], automata: Sequence[SpecAutomaton]) -> None:
    """Record some samples into nothing, as the specifications will have it done.

    With nothing in the compiler's cache this takes many seconds, otherwise a fraction of one.

    Args:
        automata: those of the specifications.
    """
    compile_ahead()
    recording = Recording(MemorySink(), files, known=automata)
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
    # nothing is known: what may be takes code of its own
    recording.add(Trace.from_samples([Sample(10**10, {})]))
    recording.end()
    # what draws an arrow at a violation, of which these samples may have none
    shapes = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in range(2)])
    contacts(shapes, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=False)


def _tracked(kind: int, x: float) -> TrackedObject:
    box, disc = Footprint.box(x, 0, x + 1, 1), Footprint.disc(x + 0.5, 0.5, 0.5)
    footprint = (box, disc, Footprint((*box.parts, *disc.parts)))[kind % 3]
    return TrackedObject(footprint, class_name="thing", yaw=x, height=(0.0, 1.0), uncertainty=0.01)


FLUSH_S = 0.4
"""A sample is handed to the operating system at most about this long after it was written."""

_GATHER_S = 0.2
"""How long samples are gathered before they are encoded: a few together cost hardly more than one, and while
none are encoded, the caller has the interpreter to itself."""

_TOGETHER = 1024
"""At most this many samples are encoded at once."""

_PAUSE_S = 0.001
"""How long a full queue is left to empty before it is looked at again."""


class Recorder:
    """Records samples into an MCAP log, with the robustness of specifications beside them.

    The log is written in place: when the process is killed, what was written more than a second before can be
    read. Leaving the `with` block closes the log properly, after an error or Ctrl-C too; it then says that it
    was interrupted. SIGTERM does the same: in a `with` block of the main thread it raises SystemExit(143),
    unless the program handles SIGTERM in a way of its own. A signal that comes while the log is closed waits
    until that is done.

    Use as:

        with Recorder("run.mcap", specifications=[spec]) as recorder:
            recorder.write(sample)
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        specifications: Specification | Sequence[Specification] = (),
        about: Mapping[str, str] | None = None,
        waiting: int = 4096,
        block: bool = True,
    ) -> None:
        """Begin a log.

        Returns when the first sample can be written at once: the first time on a machine, numerical code is
        compiled before, which takes many seconds.

        Args:
            path: replaced if it exists.
            specifications: evaluated as the samples come, without templates; one or several.
            about: what the log's metadata should say besides: a seed, where the samples come from.
            waiting: how many samples may wait for the writing thread.
            block: when that many wait, let `write` wait too; otherwise drop samples, and count them in the
                log.

        Raises:
            UsageError: a specification that cannot be recorded, a limit below 1.
            OutputError: the file cannot be written.
        """
        if waiting < 1:
            raise UsageError(f"waiting is {waiting}; give 1 or more samples")
        files = [specifications] if isinstance(specifications, Specification) else list(specifications)
        refuse_templates(files)
        self._path = Path(path)
        refuse_inputs(self._path, ())
        # an interruption can leave this kind of queue locked in no way, unlike one with a limit of its own
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._waiting = waiting
        self._enough = max(1, min(waiting, _TOGETHER) // 2)
        self._blocks = block
        self._dropped = 0
        self._last_ns = -1
        self._closed = False
        self._failure: Exception | None = None
        self._entered = ExitStack()
        self._stream = open_output(self._path)
        try:
            self._writer = LogWriter(self._stream, clock=time.monotonic)
            self._recording = Recording(self._writer, files, about)
            self._flush()
            warm_up(self._recording.files, self._recording.automata)
        except BaseException:
            with suppress(OutputError):
                self._stream.close()
            raise
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many samples found no place in the queue."""
        return self._dropped

    def write(self, sample: Sample) -> None:
        """Hand over the next sample; returns at once unless the queue is full.

        Raises:
            TraceError: a time that does not come after the last one's.
            OutputError: an earlier sample could not be written.
            UsageError: what is no sample, or the recorder is closed.
        """
        if not isinstance(sample, Sample):
            raise UsageError(f"{sample!r} is no sample; give a Sample(time_ns, objects)")
        if self._closed:
            raise UsageError(f"{self._path.name} is closed; open another recorder")
        self._raise_failure()
        if sample.time_ns <= self._last_ns:
            raise TraceError(
                f"a sample at {sample.time_ns} ns follows one at {self._last_ns} ns; give times that increase"
            )
        self._last_ns = sample.time_ns
        while self._queue.qsize() >= self._waiting:
            if not self._blocks:
                self._dropped += 1
                return
            time.sleep(_PAUSE_S)
        self._queue.put(sample)
        if self._queue.qsize() >= self._enough:
            self._ring()

    def close(self, *, interrupted: bool = False) -> None:
        """Write what waits and finish the log; closing twice does nothing.

        Raises:
            OutputError: something could not be written.
        """
        with uninterrupted():
            if self._closed:
                return
            self._closed = True
            self._queue.put(None)
            self._ring()
            self._thread.join()
            self._finish(interrupted=interrupted)
        self._raise_failure()

    def __enter__(self) -> Self:
        self._entered.enter_context(terminable())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._entered:
            self.close(interrupted=error is not None)

    def _finish(self, *, interrupted: bool) -> None:
        """Write the end of the log; of one that failed, nothing more."""
        try:
            if self._failure is None:
                self._recording.end(interrupted=interrupted, dropped=self._dropped)
                self._writer.close()
        finally:
            self._stream.close()

    def _flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._writer.flush()
        self._stream.flush()

    def _work(self) -> None:
        """Encode and write what waits, until told to end."""
        flushed = time.monotonic()
        ended = False
        while not ended:
            samples, ended = self._waiting_samples()
            if self._failure is not None:
                continue
            try:
                if samples:
                    self._recording.add(Trace.from_samples(samples))
                if time.monotonic() - flushed >= FLUSH_S:
                    self._flush()
                    flushed = time.monotonic()
            except Exception as error:
                # whatever it is, it is the caller's to know: nobody sees what a thread dies of
                self._failure = error

    def _ring(self) -> None:
        """Let the writing thread begin with what waits."""
        if self._bell.empty():
            self._bell.put(None)

    def _waiting_samples(self) -> tuple[list[Sample], bool]:
        """What has been gathered; and whether that is the end."""
        if self._queue.qsize() < self._enough:
            with suppress(queue.Empty):
                self._bell.get(timeout=_GATHER_S)
        samples: list[Sample] = []
        try:
            while len(samples) < _TOGETHER:
                sample = self._queue.get_nowait()
                if sample is None:
                    return samples, True
                samples.append(sample)
        except queue.Empty:
            pass
        return samples, False

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure


def warm_up_planner() -> None:
    """Decide on a push that nobody makes.

    With nothing in the compiler's cache this takes many seconds, otherwise a fraction of one.
    """
    compile_ahead()
    task = parse_specification("F (cup leftof jug and cup dist jug >= 1)")
    workspace = Workspace(Grid(0.0, 0.0, 1.0, 8, 8), obstacles=(Footprint.box(0, 0, 1, 1),))
    box = BlackBox(Planner(task, Settings(workspace, "push")))
    things = {
        "cup": TrackedObject(Footprint.box(6, 6, 7, 7), yaw=0.0, height=(0.0, 1.0)),
        "jug": TrackedObject(Footprint.disc(4, 4, 1), height=(0.0, 1.0)),
    }
    box.observe(Sample(0, things))
    box.decide()
