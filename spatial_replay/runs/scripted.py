"""Runs of simulated worlds: their log, and runs by the script of a world."""

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
"""Samples that are written together. The written part can be read even if the process is killed."""


class RunLog:
    """A log being written: samples as they arrive, and messages about decisions in between.

    Equal samples, specifications and messages give equal bytes. Use `run_log` to make one.

    Attributes:
        samples: the number of samples so far.
        newest_ns: the time of the newest one.
    """

    def __init__(self, writer: LogWriter, recording: Recording) -> None:
        self._writer = writer
        self._recording = recording
        self._waiting: list[Sample] = []
        self._beside: list[Messages] = []
        self._first_ns = self.newest_ns = self.samples = 0
        self._written = Counter[str]()

    @property
    def seconds(self) -> float:
        """The time from the first sample to the last."""
        return (self.newest_ns - self._first_ns) / 1e9

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
        if not self.samples:
            self._first_ns = sample.time_ns
        self.newest_ns = sample.time_ns
        self.samples += 1
        if len(self._waiting) >= _STRETCH:
            # flushed only when the next sample arrives: messages about the newest sample have its time
            self.flush()
        self._waiting.append(sample)

    def write_messages(self, messages: Messages) -> None:
        """Write messages of other channels, at the time of the newest sample."""
        self._beside.append(messages)

    def write_payload(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        """Write the next message of another channel."""
        number = self._written[channel.topic]
        self.write_messages(messages_of(channel, np.array([time_ns], np.int64), [payload], number))
        self._written[channel.topic] += 1

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
        """Write everything so far, so that it can be read even if the process is killed."""
        with uninterrupted():
            self.write_waiting()
            self._writer.flush()

    def write_waiting(self) -> None:
        """Write what was not written yet."""
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
    with (
        leaving(output),
        terminable(),
        open_output(output, durability) as stream,
        recording_in(stream, files, about, known) as opened,
    ):
        log = RunLog(*opened)
        try:
            yield log
        finally:
            with uninterrupted():
                log.write_waiting()


def refuse_unknown_names(files: Iterable[Specification], sample: Sample) -> None:
    """Check that a world has the objects and signals that specifications name.

    Args:
        sample: a sample of the world, which always shows all objects.

    Raises:
        SpecificationError: with every missing name.
    """
    objects, signals = sorted(sample.objects), sorted(sample.signals)
    remarks = [remark for file in files for remark in check_names(file, objects, signals, where="world")]
    missing = [remark for remark in remarks if remark.severity == "error"]
    if missing:
        raise SpecificationError(missing)


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """The result of a simulated run.

    Attributes:
        samples: number of samples.
        seconds: from the first to the last.
        objects: their names.
        outcome: how the robot's motion ended, in words.
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
        files: specifications to evaluate during the run; None takes that of the scenario.
        duration_ns: duration in simulated time; None ends with the script.
        cameras: one or two videos to make of the run; beside the first, their tags file is written.
        inputs: files that the output must not be.
        advance: called with the number of new samples.
        durability: "disk" for a log of which the disk has each chunk as soon as it is written.

    Raises:
        SpecificationError: names that the world does not have.
        UsageError: no such scenario, no simulator, a duration of 0, a specification that cannot be recorded.
        OutputError: the output cannot be written.
    """
    if duration_ns is not None and duration_ns <= 0:
        raise UsageError("a run of 0 s has no sample; give a longer duration")
    files = [default_specification(scenario)] if files is None else list(files)
    about = about_run(scenario, **conditions)
    # an error in the world or a missing name leaves the output untouched
    with closing(make_world(scenario, **conditions)) as world:
        refuse_unknown_names(files, world.sample())
        with (
            open_film(world, cameras, seed=conditions.get("seed", 0)) as film,
            run_log(output, files, about, inputs, durability=durability) as log,
        ):

            def observe(sample: Sample) -> None:
                log.write(sample)
                if film is not None:
                    film.take(sample)
                advance(1)

            world.attach(observe)
            result = world.follow(world.script(), duration_ns)
            if not log.samples:
                # without a motion there is no sample: take the one of the world at rest
                world.step()
        outcome = "stopped in the middle of its motion" if result is None else result.reason
        return SimulatedRun(log.samples, log.seconds, tuple(world.scene.bodies), outcome)


def simulate_script(scenario: str, **conditions: Unpack[Conditions]) -> list[Sample]:
    """Return the samples of a scripted run without a log; those that `record_script` records.

    Raises:
        UsageError: no such scenario, no simulator.
    """
    samples: list[Sample] = []
    with closing(make_world(scenario, **conditions)) as world:
        world.attach(samples.append)
        world.follow(world.script(), None)
    return samples


def about_run(scenario: str, **conditions: Unpack[Conditions]) -> dict[str, str]:
    """Return the metadata about how a run was made."""
    seed, starts = conditions.get("seed", 0), conditions.get("starts", ())
    injections = [str(injection) for injection in conditions.get("injections", ())]
    options = {"seed": seed, "noise_m": conditions.get("noise_m", 0.0), "inject": injections}
    if starts:
        options["start"] = [str(start) for start in starts]
    # worlds are simulated in metres
    axes = Axes(unit="m").metadata()
    return {"source": scenario, "seed": str(seed), "options": json.dumps(options), **axes}
