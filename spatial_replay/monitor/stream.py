"""A specification evaluated over samples as they come, in stretches of any length.

A monitor feeds it sample by sample, a replay block by block, `evaluate` a whole trace at once: all three get
the same bits.

Formulas evaluated sample by sample, each sample as it comes: what a monitor runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Protocol

import numpy as np

from spatial_replay.errors import TraceError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.monitor.atoms.live_rows import iter_delays
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.step import OnlineRun
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace, window_of


@dataclass(frozen=True, eq=False)
class SeriesBlock:
    """What one instance says about some samples.

    Attributes:
        times_ns: (T,) int64; T may be 0.
        series: (N, 4, T): value, now, lower and upper of each node.
        leaves: (C, A, T), what the numbers were made of: `leaf_values` of the same samples.
    """

    times_ns: Integers
    series: Floats
    leaves: Floats

    def between(self, start_ns: int, end_ns: int) -> SeriesBlock:
        """The samples from the first at or after `start_ns` to the last before `end_ns`."""
        begin, end = window_of(self.times_ns, start_ns, end_ns)
        return SeriesBlock(
            self.times_ns[begin:end], self.series[:, :, begin:end], self.leaves[:, :, begin:end]
        )


def join_blocks(stretches: Sequence[SeriesBlock]) -> SeriesBlock:
    """One stretch of one or more of the same instance that follow each other."""
    channels = max(len(stretch.leaves) for stretch in stretches)
    return SeriesBlock(
        np.concatenate([stretch.times_ns for stretch in stretches]),
        np.concatenate([stretch.series for stretch in stretches], axis=2),
        np.concatenate([in_channels(stretch.leaves, channels) for stretch in stretches], axis=2),
    )


class InstanceEvaluation(Protocol):
    """One instance on its way through the samples, under some semantics."""

    @property
    def instance(self) -> Instance: ...

    @property
    def first_satisfied_ns(self) -> int | None:
        """The first sample with a value of at least 0 at the root."""

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the log ends here."""

    @property
    def robustness(self) -> Floats:
        """(N,): each node's value on the samples so far."""

    @property
    def verdict(self) -> Verdict:
        """The root's verdict if the log ends here; unknown before the first sample."""

    def extend(self, scene: TraceScene) -> SeriesBlock:
        """Take in the samples of a scene that fall into the instance's window."""

    def __len__(self) -> int:
        """How many samples it was evaluated over."""


class InstanceStream:
    """One instance on its way through the samples, and what is known of it so far."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        self.first_satisfied_ns: int | None = None
        self._run = OnlineRun(instance.program)
        self._robustness = np.full(len(instance.program.reports), np.nan)

    def __len__(self) -> int:
        """How many samples it was evaluated over."""
        return len(self._run)

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the log ends here."""
        return self._run.final

    @property
    def robustness(self) -> Floats:
        """(N,): each node's value on the samples so far."""
        return self._robustness.copy()

    @property
    def verdict(self) -> Verdict:
        """The root's verdict if the log ends here; unknown before the first sample."""
        return final_verdict(*self.final[0]) if len(self) else Verdict.UNKNOWN

    def extend(self, scene: TraceScene) -> SeriesBlock:
        """Take in the samples of a scene that fall into the instance's window."""
        times = scene.trace.times_ns[scene.skip :]
        begin, end = window_of(times, self.instance.start_ns, self.instance.end_ns)
        times = times[begin:end]
        if not len(times):
            no_leaves = np.empty((1, len(self.instance.program.leaves), 0))
            return SeriesBlock(times, np.empty((len(self._robustness), 4, 0)), no_leaves)
        leaves = leaf_values(scene, self.instance.program.leaves, self.instance.bindings)[:, :, begin:end]
        series = self._run.extend(leaves, times)
        self._robustness = series[:, 0, -1].copy()
        if self.first_satisfied_ns is None:
            satisfied = np.flatnonzero(series[0, 0] >= 0.0)
            self.first_satisfied_ns = int(times[satisfied[0]]) if len(satisfied) else None
        return SeriesBlock(times, series, leaves)


class EvaluationStream:
    """The instances of a specification, and the recent samples that they may still look back at."""

    def __init__(
        self,
        instances: Sequence[Instance],
        regions: Mapping[str, Outline],
        begin: Callable[[Instance], InstanceEvaluation] = InstanceStream,
    ) -> None:
        """Start before the first sample.

        Args:
            begin: how each instance is evaluated.
        """
        self.streams = tuple(begin(instance) for instance in instances)
        self._regions = regions
        self._reach = look_back([instance.formula for instance in instances])
        self._before: Trace | None = None

    def extend(self, trace: Trace) -> list[SeriesBlock]:
        """Take in the next samples; one stretch for each of `streams`.

        Raises:
            TraceError: samples that do not come after those before.
        """
        if not len(trace):
            return [stream.extend(TraceScene(trace, self._regions)) for stream in self.streams]
        skip = 0
        if self._before is not None:
            before_ns = self._before.times_ns[-1]
            if before_ns >= trace.times_ns[0]:
                raise TraceError(
                    f"a sample at {trace.times_ns[0]} ns follows one at {before_ns} ns; "
                    "give samples in the order of their times"
                )
            if self._reach != (0, 0):
                recent = tail(self._before, *self._reach)
                skip = len(recent)
                trace = Trace.concatenate([recent, trace])
        self._before = trace
        scene = TraceScene(trace, self._regions, skip)
        return [stream.extend(scene) for stream in self.streams]


def tail(trace: Trace, samples: int, duration_ns: int) -> Trace:
    """The samples that the next one may look back at."""
    begin = len(trace) - samples
    if duration_ns:
        at_or_before = (
            int(np.searchsorted(trace.times_ns, trace.times_ns[-1] - duration_ns, side="right")) - 1
        )
        begin = min(begin, at_or_before)
    return trace.slice(max(begin, 0), len(trace))


def look_back(formulas: Sequence[Formula]) -> tuple[int, int]:
    """How far terms look back: the most samples (`a[-3]`) and the longest duration in ns (`a[-2s]`)."""
    delays = list(iter_delays(formulas))
    samples = max((delay.samples or 0 for delay in delays), default=0)
    duration_ns = max((delay.duration_ns or 0 for delay in delays), default=0)
    return samples, duration_ns


ROOM = 64
"""Recent samples that there is room for at first: few, so that they stay in the processor's cache."""


class LiveEvaluation(Protocol):
    """Some formulas under some semantics, on their way through the samples."""

    def take(self, sample: Sample) -> list[Floats | None]:
        """Take in the next sample, whose time comes after the last one's.

        Returns:
            (N, 4) for each formula: value, now, lower and upper of each node; None before the start.
        """


class LiveRuns:
    """The programs of some formulas, fed by plans that samples of the same objects share."""

    def __init__(self, programs: Sequence[Program], regions: Mapping[str, Outline], start_ns: int) -> None:
        """Start before the first sample; those before `start_ns` are only there to be looked back at."""
        ends = accumulate((len(program.leaves) for program in programs), initial=0)
        self._runs = [
            (OnlineRun(program, room=ROOM, tile=1), slice(*ends))
            for program, ends in zip(programs, pairwise(ends), strict=True)
        ]
        self._leaves = SampleLeaves([program.leaves for program in programs], regions)
        self._start_ns = start_ns

    def take(self, sample: Sample) -> list[Floats | None]:
        samples = self._leaves.look_at(sample)
        if sample.time_ns < self._start_ns:
            return [None] * len(self._runs)
        leaves, times_ns = self._leaves.values(samples), np.array([sample.time_ns])
        return [run.extend(leaves[:, own], times_ns)[:, :, 0] for run, own in self._runs]
