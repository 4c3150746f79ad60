"""The log of a run that waits for it: whatever time the log takes, no sample is lost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.logs.mcap.writer import LogWriter
from spatial_replay.logs.messages import Messages, merge
from spatial_replay.logs.output_file import open_output, refuse_inputs
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.recording import Recording
from spatial_replay.recording.interruption import leaving, terminable, uninterrupted
from spatial_replay.recording.recording import refuse_templates
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

_STRETCH = 30
"""Samples that are written together. After each such stretch what was written can be read, even if the
process is killed."""


class RunLog:
    """A log being written: samples as they come, and messages about what was decided in between.

    Equal samples, specifications and messages give equal bytes. Use `run_log` to make one.
    """

    def __init__(self, writer: LogWriter, recording: Recording) -> None:
        self._writer = writer
        self._recording = recording
        self._waiting: list[Sample] = []
        self._beside: list[Messages] = []
        self._first_ns = self._last_ns = 0
        self._samples = 0

    @property
    def samples(self) -> int:
        """How many samples were taken in."""
        return self._samples

    @property
    def seconds(self) -> float:
        """The time from the first sample to the last."""
        return (self._last_ns - self._first_ns) / 1e9

    @property
    def verdicts(self) -> Mapping[str, Verdict]:
        """The verdict of each result, by its name, on what was written; the final one once the log ended."""
        return self._recording.verdicts

    def write(self, sample: Sample) -> None:
        """Take in the next sample.

        Raises:
            TraceError: it does not come after the one before.
            OutputError: the log cannot be written.
        """
        if not self._samples:
            self._first_ns = sample.time_ns
        self._last_ns = sample.time_ns
        self._samples += 1
        if len(self._waiting) >= _STRETCH:
            # what is told of the newest sample has its time, and no later sample comes before that
            self.flush()
        self._waiting.append(sample)

    def write_messages(self, messages: Messages) -> None:
        """Write messages of other channels, at the time of the newest sample."""
        self._beside.append(messages)

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record.

        Raises:
            OutputError: the log cannot be written.
        """
        with uninterrupted():
            self._write_waiting()
            self._writer.add_metadata(name, data)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Keep a file in the log.

        Raises:
            OutputError: the log cannot be written.
        """
        with uninterrupted():
            self._write_waiting()
            self._writer.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Write everything taken in so far, so that it can be read whatever happens to the process."""
        with uninterrupted():
            self._write_waiting()
            self._writer.flush()

    def end(self, *, interrupted: bool = False) -> None:
        """Write what comes after the last sample, and close the log."""
        self._write_waiting()
        self._recording.end(interrupted=interrupted)
        self._writer.close()

    def _write_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        beside, self._beside = self._beside, []
        if waiting or beside:
            self._recording.add(Trace.from_samples(waiting), merge(beside))


@contextmanager
def run_log(
    output: Path,
    files: Sequence[Specification] = (),
    about: Mapping[str, str] | None = None,
    inputs: Sequence[Path] = (),
    known: Sequence[SpecAutomaton] = (),
) -> Iterator[RunLog]:
    """Open the log of a run, in place under its final name, and close it properly however the run ends.

    After an interruption or an error the log is shorter, and says that it was interrupted.

    Args:
        files: specifications to evaluate and write beside the samples.
        about: what else the metadata says: the scenario, a seed.
        inputs: files that the output must not be.
        known: automata of specs of these files, which are not compiled again.

    Raises:
        UsageError: the output is an input, or a specification cannot be recorded.
        OutputError: the output cannot be written.
    """
    refuse_inputs(output, inputs)
    refuse_templates(files)
    interrupted = True
    with leaving(output), terminable(), open_output(output) as stream, ExitStack() as ending:
        # an interruption meanwhile leaves a log that is ended all the same
        with uninterrupted():
            writer = LogWriter(stream)
            log = RunLog(writer, Recording(writer, files, about, known))
            ending.callback(lambda: _end(log, interrupted=interrupted))
        yield log
        interrupted = False


def _end(log: RunLog, *, interrupted: bool) -> None:
    with uninterrupted():
        log.end(interrupted=interrupted)
