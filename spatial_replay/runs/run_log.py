"""The log of a run that waits for it: no sample is dropped, however long writing takes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Messages, merge
from spatial_replay.logs.output_file import Durability, open_output, refuse_inputs
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.recording import Recording
from spatial_replay.recording.log import refuse_templates
from spatial_replay.recording.recorder import leaving, terminable, uninterrupted
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

_STRETCH = 30
"""Samples that are written together. The written part can be read even if the process is killed."""


class RunLog:
    """A log being written: samples as they arrive, and messages about decisions in between.

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
        """The number of samples so far."""
        return self._samples

    @property
    def seconds(self) -> float:
        """The time from the first sample to the last."""
        return (self._last_ns - self._first_ns) / 1e9

    @property
    def verdicts(self) -> Mapping[str, Verdict]:
        """The verdict of each result, by its name, on what was written; final when the log has ended."""
        return self._recording.verdicts

    def write(self, sample: Sample) -> None:
        """Add the next sample.

        Raises:
            TraceError: it is not after the one before.
            OutputError: the log cannot be written.
        """
        if not self._samples:
            self._first_ns = sample.time_ns
        self._last_ns = sample.time_ns
        self._samples += 1
        if len(self._waiting) >= _STRETCH:
            # flushed only when the next sample arrives: messages about the newest sample have its time
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
            self._recording.add_metadata(name, data)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to the log.

        Raises:
            OutputError: the log cannot be written.
        """
        with uninterrupted():
            self._write_waiting()
            self._writer.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Write everything so far, so that it can be read even if the process is killed."""
        with uninterrupted():
            self._write_waiting()
            self._writer.flush()

    def end(self, *, interrupted: bool = False) -> None:
        """Write what follows the last sample, and close the log."""
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
    durability: Durability = "process",
) -> Iterator[RunLog]:
    """Open the log of a run, in place under its final name, and close it properly however the run ends.

    After an interruption or an error the log is shorter, and marked as interrupted.

    Args:
        files: specifications to evaluate and write beside the samples.
        about: further metadata: the scenario, a seed.
        inputs: files that the output must not be.
        known: automata of specs of these files, which are not compiled again.
        durability: "disk" for a log of which the disk has each chunk as soon as it is written.

    Raises:
        UsageError: the output is an input, or a specification cannot be recorded.
        OutputError: the output cannot be written.
    """
    refuse_inputs(output, inputs)
    refuse_templates(files)
    interrupted = True
    with leaving(output), terminable(), open_output(output, durability) as stream, ExitStack() as ending:
        # an interruption between these lines would leave a log without an end
        with uninterrupted():
            writer = LogWriter(stream)
            log = RunLog(writer, Recording(writer, files, about, known))
            ending.callback(lambda: _end(log, interrupted=interrupted))
        yield log
        interrupted = False


def _end(log: RunLog, *, interrupted: bool) -> None:
    with uninterrupted():
        log.end(interrupted=interrupted)
