"""Logs of simulated runs, and recordings of a world's scripted run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import numpy as np

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Channel, Messages, merge, messages_of
from spatial_replay.logs.output_file import Durability, open_output, refuse_inputs
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.recording.interruption import leaving, terminable, uninterrupted
from spatial_replay.recording.log import Recording, refuse_templates
from spatial_replay.recording.source_recording import recording_in
from spatial_replay.runs.virtual_camera import open_film
from spatial_replay.simulation.tabletop import default_specification, make_world
from spatial_replay.simulation.world import Conditions
from spatial_replay.spec import check_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import Sample, Trace
from spatial_replay.trace.units import Axes

_STRETCH = 30
"""Number of samples that are written together; written samples remain readable if the process is killed."""


class RunLog:
    """The open log of a run: samples, and messages of other channels between samples.

    Equal samples, specifications and messages give equal bytes. `run_log` opens a `RunLog`.

    Attributes:
        samples: number of samples.
        newest_ns: time of the newest sample.
    """

    def __init__(self, writer: LogWriter, recording: Recording) -> None:
        self._writer = writer
        self._recording = recording
        self._pending_samples: list[Sample] = []
        self._pending_messages: list[Messages] = []
        self._first_ns = self.newest_ns = self.samples = 0
        self._message_counts = Counter[str]()

    @property
    def seconds(self) -> float:
        """Time from the first to the last sample, s."""
        return (self.newest_ns - self._first_ns) / 1e9

    @property
    def verdicts(self) -> Mapping[str, Verdict]:
        """The verdict of each result by name, over the written samples; final at the end of the log."""
        return self._recording.verdicts

    def write(self, sample: Sample) -> None:
        """Add the next sample.

        Raises:
            TraceError: the sample is not after the previous sample.
            OutputError: the log cannot be written.
        """
        if not self.samples:
            self._first_ns = sample.time_ns
        self.newest_ns = sample.time_ns
        self.samples += 1
        if len(self._pending_samples) >= _STRETCH:
            # samples are flushed at the next sample, because messages may follow with the newest time
            self.flush()
        self._pending_samples.append(sample)

    def write_messages(self, messages: Messages) -> None:
        """Write messages of other channels, at the time of the newest sample."""
        self._pending_messages.append(messages)

    def write_payload(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        """Write the next message of a channel."""
        sequence_number = self._message_counts[channel.topic]
        self.write_messages(messages_of(channel, np.array([time_ns], np.int64), [payload], sequence_number))
        self._message_counts[channel.topic] += 1

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record.

        Raises:
            OutputError: the log cannot be written.
        """
        with uninterrupted():
            self.write_waiting()
            self._recording.add_metadata(name, data)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to the log.

        Raises:
            OutputError: the log cannot be written.
        """
        with uninterrupted():
            self.write_waiting()
            self._writer.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Write all samples and messages, so that they remain readable if the process is killed."""
        with uninterrupted():
            self.write_waiting()
            self._writer.flush()

    def write_waiting(self) -> None:
        """Write the pending samples and messages, without flushing the file."""
        samples, self._pending_samples = self._pending_samples, []
        messages, self._pending_messages = self._pending_messages, []
        if samples or messages:
            self._recording.add(Trace.from_samples(samples), merge(messages))


@contextmanager
def run_log(
    output: Path,
    files: Sequence[Specification] = (),
    about: Mapping[str, str] | None = None,
    inputs: Sequence[Path] = (),
    known: Sequence[SpecAutomaton] = (),
    durability: Durability = "process",
) -> Iterator[RunLog]:
    """Open the log of a run, and close the log in any case. The file has its final name from the start.

    After an interruption or an error, the log is shorter and is marked as interrupted.

    Args:
        files: specifications to evaluate and to store in the log.
        about: further metadata, such as the scenario or a seed.
        inputs: input files, which the output must not overwrite.
        known: compiled automata of specs in `files`; these specs are not compiled again.
        durability: "disk" to force each written chunk to the disk at once.

    Raises:
        UsageError: the output is an input, or a specification cannot be recorded.
        OutputError: the output cannot be written.
    """
    refuse_inputs(output, inputs)
    refuse_templates(files)
    with (
        leaving(output),
        terminable(),
        open_output(output, durability) as stream,
        recording_in(stream, files, about, known) as recording_parts,
    ):
        log = RunLog(*recording_parts)
        try:
            yield log
        finally:
            with uninterrupted():
                log.write_waiting()


def refuse_unknown_names(files: Iterable[Specification], sample: Sample) -> None:
    """Check that a world has all objects and signals that the specifications name.

    Args:
        sample: any sample of the world, because every sample has all objects.

    Raises:
        SpecificationError: lists every missing name.
    """
    object_names, signal_names = sorted(sample.objects), sorted(sample.signals)
    remarks = [
        remark for file in files for remark in check_names(file, object_names, signal_names, where="world")
    ]
    errors = [remark for remark in remarks if remark.severity == "error"]
    if errors:
        raise SpecificationError(errors)


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """The result of a simulated run.

    Attributes:
        samples: number of samples.
        seconds: time from the first to the last sample.
        objects: names of the objects.
        outcome: end of the robot's motion, in words.
    """

    samples: int
    seconds: float
    objects: tuple[str, ...]
    outcome: str


def record_script(
    scenario: str,
    output: Path,
    files: Sequence[Specification] | None = None,
    *,
    duration_ns: int | None = None,
    cameras: Sequence[Path] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
    **conditions: Unpack[Conditions],
) -> SimulatedRun:
    """Record a scenario's world while its robot follows the script; equal arguments give equal bytes.

    Args:
        files: specifications to evaluate during the run; None for the scenario's specification.
        duration_ns: duration in simulated time; None for the duration of the script.
        cameras: paths of one or two videos of the run. Their tags file is written next to the first video.
        inputs: input files, which the output must not overwrite.
        advance: called with the number of new samples.
        durability: "disk" to force each written chunk to the disk at once.

    Raises:
        SpecificationError: a specification names missing objects or signals.
        UsageError: no such scenario, no simulator, a duration of 0, a specification that cannot be recorded.
        OutputError: the output cannot be written.
    """
    if duration_ns is not None and duration_ns <= 0:
        raise UsageError("a run of 0 s has no sample; give a longer duration")
    files = [default_specification(scenario)] if files is None else list(files)
    metadata = about_run(scenario, **conditions)
    # an error in the world or a missing name leaves the output untouched
    with closing(make_world(scenario, **conditions)) as world:
        refuse_unknown_names(files, world.sample())
        with (
            open_film(world, cameras, seed=conditions.get("seed", 0)) as film,
            run_log(output, files, metadata, inputs, durability=durability) as log,
        ):

            def observe(sample: Sample) -> None:
                log.write(sample)
                if film is not None:
                    film.take(sample)
                advance(1)

            world.attach(observe)
            result = world.follow(world.script(), duration_ns)
            if not log.samples:
                # a script without motions gives no sample, so the world at rest is recorded
                world.step()
        outcome = "stopped in the middle of its motion" if result is None else result.reason
        return SimulatedRun(log.samples, log.seconds, tuple(world.scene.bodies), outcome)


def simulate_script(scenario: str, **conditions: Unpack[Conditions]) -> list[Sample]:
    """Return the samples that `record_script` would record, without writing a log.

    Raises:
        UsageError: no such scenario, no simulator.
    """
    samples: list[Sample] = []
    with closing(make_world(scenario, **conditions)) as world:
        world.attach(samples.append)
        world.follow(world.script(), None)
    return samples


def about_run(scenario: str, **conditions: Unpack[Conditions]) -> dict[str, str]:
    """Return the metadata on the scenario and the conditions of a run."""
    seed, starts = conditions.get("seed", 0), conditions.get("starts", ())
    injections = [str(injection) for injection in conditions.get("injections", ())]
    options = {"seed": seed, "noise_m": conditions.get("noise_m", 0.0), "inject": injections}
    if starts:
        options["start"] = [str(start) for start in starts]
    # worlds are simulated in metres
    axes = Axes(unit="m").metadata()
    return {"source": scenario, "seed": str(seed), "options": json.dumps(options), **axes}
