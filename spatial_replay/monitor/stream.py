"""Evaluate instances of specifications over samples: one per spec, and one per object of a template.

A monitor adds single samples, a replay adds blocks, and `evaluate` adds a whole trace. Their results are
identical to the bit.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import cast

import numpy as np

from spatial_replay.errors import TraceError, UsageError
from spatial_replay.geometry.arrays import Empty, Floats, Integers, join_arrays
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import Bindings, Reach, TraceScene, look_back, tail
from spatial_replay.monitor.online.codes import distinct_channels, joined_channels
from spatial_replay.monitor.online.program import Program, compile_formula
from spatial_replay.monitor.online.step import OnlineRun
from spatial_replay.monitor.semantics import Evaluator
from spatial_replay.monitor.verdict import Semantics, Verdict, final_verdict
from spatial_replay.spec.formula import Formula, NamedSpec, Outline, Specification, TrackedName
from spatial_replay.text import times_apart
from spatial_replay.trace.trace import ABSENT, Sample, Trace, window_of


@dataclass(frozen=True, eq=False)
class Instance:
    """One formula to evaluate.

    Attributes:
        spec: `spec` statement of the formula.
        object: object for which a template is evaluated; None for other specs.
        bindings: the object by the name of the template's parameter; empty for other specs.
        start_ns, end_ns: samples from `start_ns` to before `end_ns` are evaluated.
        named: all specs of the spec's file, by name.
    """

    spec: NamedSpec
    object: str | None
    program: Program
    bindings: Bindings
    start_ns: int
    end_ns: int
    named: Mapping[str, NamedSpec] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def formula(self) -> Formula:
        return self.spec.formula

    @cached_property
    def reach(self) -> Reach:
        """How far the formula's terms look back."""
        return look_back([self.formula])


@dataclass(frozen=True, slots=True)
class Choice:
    """The objects that a template is evaluated for: all objects, a class, or one named object.

    Attributes:
        class_name: class of the objects, compared without case; None for any class.
        name: name of the single object; None for any name.
    """

    class_name: str | None
    name: str | None = None

    @classmethod
    def parse(cls, parameter: str, text: str) -> Choice:
        """Read `all`, `class:NAME`, or the name of an object.

        Raises:
            UsageError: the text has no name.
        """
        if text == "all":
            return cls(None)
        kind, colon, name = text.partition(":")
        if colon and kind == "class" and name:
            return cls(name)
        if text and not (colon and kind == "class"):
            return cls(None, text)
        raise UsageError(
            f"{parameter}={text!r} chooses no objects; write {parameter}=all, {parameter}=class:NAME or"
            f" {parameter}=OBJECT"
        )

    def fits(self, name: str, class_name: str | None) -> bool:
        if self.name is not None:
            return self.name == name
        return self.class_name is None or (class_name or "").casefold() == self.class_name.casefold()


def find_instances(
    specification: Specification, each: Mapping[str, str], traces: Iterable[Trace], start_ns: int, end_ns: int
) -> list[Instance]:
    """Return the instances of a specification over the samples from `start_ns` to before `end_ns`.

    A template has one instance per chosen object, in order of names. The instance covers the samples from the
    object's first to its last appearance.

    Args:
        each: choice of objects by template parameter: "all", "class:NAME" or an object's name.
        traces: the samples, in blocks; read only for templates.

    Raises:
        UsageError: a template parameter has no choice, or a choice is for an unknown parameter.
    """
    templates = [spec for spec in specification.results if spec.parameter is not None]
    check_choices(templates, each)
    choices = {
        spec.parameter: Choice.parse(spec.parameter or "", each[spec.parameter or ""]) for spec in templates
    }
    spans_by_parameter = _appearances(choices, traces, start_ns, end_ns) if choices else {}
    instances: list[Instance] = []
    spec_by_name = {spec.name: spec for spec in specification.specs}
    for spec in specification.results:
        program = compile_formula(spec.formula)
        if spec.parameter is None:
            instances.append(Instance(spec, None, program, {}, start_ns, end_ns, spec_by_name))
            continue
        for name, (first_ns, last_ns) in sorted(spans_by_parameter[spec.parameter].items()):
            bindings = {spec.parameter: TrackedName(name)}
            instances.append(Instance(spec, name, program, bindings, first_ns, last_ns + 1, spec_by_name))
    return instances


def check_choices(templates: list[NamedSpec], each: Mapping[str, str]) -> None:
    """Check that every template parameter, and no other name, has a choice of objects."""
    for spec in templates:
        if spec.parameter not in each:
            raise UsageError(
                f"{spec.name}({spec.parameter}) is a template: say what {spec.parameter} stands for, "
                f"--each {spec.parameter}=class:NAME, --each {spec.parameter}=OBJECT or"
                f" --each {spec.parameter}=all"
            )
    check_parameters(templates, each)


def check_parameters(templates: list[NamedSpec], each: Mapping[str, str]) -> None:
    """Check that every choice of objects names the parameter of a template."""
    for parameter in each:
        if parameter not in {spec.parameter for spec in templates}:
            template_names = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            raise UsageError(f"no template has a parameter {parameter!r}; templates here: {template_names}")


def _appearances(
    choices: Mapping[str | None, Choice], traces: Iterable[Trace], start_ns: int, end_ns: int
) -> dict[str | None, dict[str, tuple[int, int]]]:
    """Return for each parameter the chosen objects, with the times of their first and last samples."""
    spans: dict[str, tuple[int, int]] = {}
    names_by_parameter: dict[str | None, set[str]] = {parameter: set() for parameter in choices}
    for trace in traces:
        begin, end = window_of(trace.times_ns, start_ns, end_ns)
        times_ns = trace.times_ns[begin:end]
        for name, rows in zip(trace.names, trace.rows[begin:end].T, strict=True):
            present_samples = np.flatnonzero(rows != ABSENT)
            if not len(present_samples):
                continue
            first_ns = spans[name][0] if name in spans else int(times_ns[present_samples[0]])
            spans[name] = (first_ns, int(times_ns[present_samples[-1]]))
            # a row below `ABSENT` stands for observation -2 - row, an object with unknown position
            codes = np.unique(trace.class_code[np.where(rows < ABSENT, -2 - rows, rows)[present_samples]])
            for parameter, choice in choices.items():
                # an object may change its class, and a single fitting sample suffices
                if any(choice.fits(name, trace.classes[code]) for code in codes.tolist()):
                    names_by_parameter[parameter].add(name)
    return {
        parameter: {name: spans[name] for name in names} for parameter, names in names_by_parameter.items()
    }


NEVER = -1
"""Entry of `settled_ns` for a verdict that no sample settled."""


@dataclass(frozen=True, eq=False)
class SeriesBlock:
    """The numbers of one instance in consecutive samples.

    Attributes:
        times_ns: (T,) int64; T may be 0.
        series: (N, 4, T): value, now, lower and upper of each node.
        leaves: (C, A, T), leaves from which the series is computed (see `leaf_values`).
    """

    times_ns: Integers
    series: Floats
    leaves: Floats

    def between(self, start_ns: int, end_ns: int) -> SeriesBlock:
        """Return the samples from `start_ns` to before `end_ns`."""
        begin, end = window_of(self.times_ns, start_ns, end_ns)
        return SeriesBlock(
            self.times_ns[begin:end], self.series[:, :, begin:end], self.leaves[:, :, begin:end]
        )


def join_blocks(blocks: Sequence[SeriesBlock]) -> SeriesBlock:
    """Join one or more consecutive blocks of the same instance."""
    return SeriesBlock(
        join_arrays([block.times_ns for block in blocks]),
        join_arrays([block.series for block in blocks], axis=2),
        joined_channels([block.leaves for block in blocks], axis=2),
    )


class InstanceStream:
    """One instance evaluated over the samples so far.

    Attributes:
        semantics: semantics of the evaluation.
        first_satisfied_ns: time of the first sample at which the root's value is at least 0, or None.
        settled_ns: (N, 2), times at which each node's satisfaction and violation became certain. The time is
            `NEVER` if only the end of the log decides, and under the paper's semantics.
        robustness: (N,), value of each node on the samples so far.
    """

    def __init__(self, instance: Instance, semantics: Semantics = "ltlf", samples: int | None = None) -> None:
        """Start before the first sample.

        Args:
            samples: number of all samples of the run, if known.
        """
        self.instance = instance
        self.semantics: Semantics = semantics
        self._evaluator = Evaluator(instance.formula, instance.program, semantics)
        self._samples = samples
        self._run = self._evaluator.begin(samples=samples)
        self._begin()

    def restart(self) -> None:
        """Restart before the first sample. The previous run's `final` is lost."""
        if isinstance(self._run, OnlineRun):
            self._run.restart()
        else:
            self._run = self._evaluator.begin(samples=self._samples)
        self._begin()

    def _begin(self) -> None:
        # new arrays, because results of the previous run still refer to the old arrays
        self.first_satisfied_ns: int | None = None
        self.robustness = np.full(len(self.instance.program.reports), np.nan)
        self.settled_ns = np.full((len(self.instance.program.reports), 2), NEVER, np.int64)

    def __len__(self) -> int:
        """Return the number of samples evaluated."""
        return len(self._run)

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the log ends here."""
        return self._run.final

    @property
    def verdict(self) -> Verdict:
        """The root's verdict if the log ends here; unknown before the first sample."""
        return final_verdict(*self.final[0]) if len(self) else Verdict.UNKNOWN

    def extend(self, scene: TraceScene, empty: Empty = np.empty) -> SeriesBlock:
        """Add the samples of a scene from the instance's `start_ns` to before its `end_ns`.

        Args:
            empty: allocator of the series.
        """
        times_ns = scene.trace.times_ns[scene.skip :]
        begin, end = window_of(times_ns, self.instance.start_ns, self.instance.end_ns)
        times_ns = times_ns[begin:end]
        program = self.instance.program
        if not len(times_ns):
            no_series = np.empty((len(program.reports), 4, 0))
            return SeriesBlock(times_ns, no_series, np.empty((1, len(program.leaves), 0)))
        leaves = leaf_values(scene, program.leaves, self.instance.bindings)[:, :, begin:end]
        # positions in the scene suffice, because it starts with the log or as far back as any term looks
        positions = np.arange(scene.skip + begin, scene.skip + end, dtype=np.int64)
        first_ns = int(scene.trace.times_ns[0])
        leaves = self._evaluator.leaves_within_log(leaves, positions, times_ns, first_ns)
        return self.extend_leaves(leaves, times_ns, empty)

    def extend_leaves(self, leaves: Floats, times: Integers, empty: Empty = np.empty) -> SeriesBlock:
        """Add one or more samples by their leaves."""
        series = self._run.extend(leaves, times, empty)
        self.robustness = series[:, 0, -1].copy()
        if self._evaluator.has_open_end:
            self._settle(times, series)
        if self.first_satisfied_ns is None:
            satisfied_samples = np.flatnonzero(series[0, 0] >= 0.0)
            self.first_satisfied_ns = int(times[satisfied_samples[0]]) if len(satisfied_samples) else None
        return SeriesBlock(times, series, leaves)

    def _settle(self, times_ns: Integers, series: Floats) -> None:
        """Set `settled_ns` of the nodes that became certain in the given samples."""
        newest_series = series[:, :, -1]
        for column, is_settled in enumerate((newest_series[:, 2] >= 0.0, newest_series[:, 3] < 0.0)):
            # certainty is permanent, so only nodes that are certain at the newest sample are searched, once
            for node in np.flatnonzero(is_settled & (self.settled_ns[:, column] == NEVER)):
                self.settled_ns[node, column] = times_ns[_first_certain(series[node], column)]


def _first_certain(node_series: Floats, column: int) -> int:
    """Return the first sample at which a node is certainly satisfied (column 0) or violated (column 1).

    Args:
        node_series: (4, T), series of the node, which is certain at the last sample.
    """
    ends, is_violation = node_series[2 + column], bool(column)
    return bisect_left(range(len(ends)), True, key=lambda k: bool(ends[k] >= 0.0) != is_violation)


class EvaluationStream:
    """The instances of a specification, and the recent samples that their terms look back at."""

    def __init__(
        self,
        instances: Iterable[Instance],
        regions: Mapping[str, Outline],
        semantics: Semantics = "ltlf",
        samples: int | None = None,
    ) -> None:
        """Start before the first sample.

        Args:
            samples: number of all samples of the run, if known.
        """
        self.streams = tuple(InstanceStream(instance, semantics, samples) for instance in instances)
        self._regions = regions
        self._reach = look_back([stream.instance.formula for stream in self.streams])
        self._last_trace: Trace | None = None

    def extend(self, trace: Trace, empty: Empty = np.empty) -> list[SeriesBlock]:
        """Add the next samples, and return one block for each of `streams`.

        Args:
            empty: allocator of the series.

        Raises:
            TraceError: the samples are not later than the previous samples.
        """
        if not len(trace):
            return [stream.extend(TraceScene(trace, self._regions)) for stream in self.streams]
        skip = 0
        if self._last_trace is not None:
            last_ns = self._last_trace.times_ns[-1]
            if last_ns >= trace.times_ns[0]:
                time_text, last_text = times_apart(int(trace.times_ns[0]), int(last_ns))
                raise TraceError(
                    f"a sample at {time_text} follows one at {last_text};"
                    " give samples in the order of their times"
                )
            # a term that looks back reads footprints of earlier samples
            if self._reach:
                recent_trace = tail(self._last_trace, self._reach)
                skip = len(recent_trace)
                trace = Trace.concatenate([recent_trace, trace])
        self._last_trace = trace
        scene = TraceScene(trace, self._regions, skip)
        return [stream.extend(scene, empty) for stream in self.streams]


def one_after_another(traces: Sequence[Trace]) -> Trace:
    """Join traces regardless of their times. The time of a sample is replaced by its index."""
    renumbered_traces, first_index = [], 0
    for trace in traces:
        # times of different traces overlap, but the times of a trace must increase
        times_ns = np.arange(first_index, first_index + len(trace), dtype=np.int64)
        renumbered_traces.append(
            replace(trace, times_ns=times_ns, reported_ns=None, signals_reported_ns={}, spans=(), doubts=())
        )
        first_index += len(trace)
    return Trace.concatenate(renumbered_traces)


def run_together(
    instances: Sequence[Instance], scene: TraceScene, traces: Sequence[Trace], semantics: Semantics
) -> Iterator[tuple[list[InstanceStream], list[SeriesBlock]]]:
    """Evaluate instances over many traces. The leaves of all traces are measured together.

    Args:
        instances: instances without bindings, whose terms do not look back.
        scene: scene of the joined traces (see `one_after_another`).

    Yields:
        the streams at the end of each trace, and one block of numbers per stream. The streams restart for the
        next trace.
    """
    leaves_by_instance = [leaf_values(scene, instance.program.leaves, {}) for instance in instances]
    longest_length = max(map(len, traces), default=0)
    streams = [InstanceStream(instance, semantics, longest_length) for instance in instances]
    begin = 0
    for trace in traces:
        end = begin + len(trace)
        for stream in streams if begin else ():
            stream.restart()
        blocks = [
            # leaves that are measured together may have more channels than this trace needs
            stream.extend_leaves(distinct_channels(leaves[:, :, begin:end]), trace.times_ns)
            for stream, leaves in zip(streams, leaves_by_instance, strict=True)
        ]
        yield streams, blocks
        begin = end


class LiveStream:
    """The results of a specification, evaluated sample by sample."""

    def __init__(self, specification: Specification, semantics: Semantics, start_ns: int) -> None:
        """Start before the first sample.

        Args:
            start_ns: time of the first evaluated sample; terms may look back at earlier samples.
        """
        formulas = [spec.formula for spec in specification.results]
        self._evaluators = [Evaluator(formula, compile_formula(formula), semantics) for formula in formulas]
        programs = [evaluator.program for evaluator in self._evaluators]
        self._leaves = SampleLeaves([program.leaves for program in programs], specification.regions)
        self._runs = [evaluator.begin(is_live=True) for evaluator in self._evaluators]
        self._leaf_ranges = _ranges(len(program.leaves) for program in programs)
        self._is_online = semantics == "ltlf"
        first_leaves = [leaf_range.start for leaf_range in self._leaf_ranges]
        # the pairs are made once, because `extend` reads them at every sample (not in the paper's semantics)
        self._online_runs = list(zip(cast(list[OnlineRun], self._runs), first_leaves, strict=True))
        self._start_ns = start_ns
        self._first_ns: int | None = None
        self._position = -1

    @property
    def finals(self) -> list[Floats | None]:
        """Lower and upper end of each node's value if the log ends here, (N, 2) for each formula.

        The entry of a formula is None before the first evaluated sample.
        """
        return [run.final if len(run) else None for run in self._runs]

    def extend(self, sample: Sample) -> list[Floats | None]:
        """Add the next sample, which is later than the previous sample.

        Returns:
            (N, 4) for each formula: value, now, lower and upper of each node. Before `start_ns`, the entry
            of a formula is None, or NaN numbers under the paper's semantics.
        """
        if not self._is_online:
            return self._extend_apart(sample)
        time_ns = sample.time_ns
        if time_ns < self._start_ns:
            self._leaves.look_at(sample)
            return [None] * len(self._evaluators)
        room = self._leaves.fill_room(sample)
        node_numbers: list[Floats | None] = []
        for run, first_leaf in self._online_runs:
            node_numbers.append(run.add_sample(room, first_leaf, time_ns))
        return node_numbers

    def leaves(self, place: int) -> Floats:
        """Return the leaves (C, A, 1) of a formula in the newest evaluated sample.

        Args:
            place: index of the formula among the specification's results.

        Raises:
            UsageError: no sample has been evaluated, or the semantics is the paper's.
        """
        room = self._leaves.room
        if not (room.channels and self._is_online):
            raise UsageError("leaves need an evaluated sample and the semantics 'ltlf'; add a sample")
        return room.leaves[: room.channels, self._leaf_ranges[place]].copy()

    def _extend_apart(self, sample: Sample) -> list[Floats | None]:
        self._position += 1
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        if sample.time_ns < self._start_ns:
            self._leaves.look_at(sample)
            return [np.full((len(evaluator.program.reports), 4), np.nan) for evaluator in self._evaluators]
        # `PaperRun` needs positions in the log, because it excludes leaves that look beyond the log's start
        values = self._leaves.fill_room(sample).measure()
        position, time_ns = np.array([self._position]), np.array([sample.time_ns])
        results: list[Floats | None] = []
        for evaluator, run, leaf_range in zip(self._evaluators, self._runs, self._leaf_ranges, strict=True):
            leaves = evaluator.leaves_within_log(values[:, leaf_range], position, time_ns, self._first_ns)
            results.append(run.extend(leaves, time_ns)[:, :, 0])
        return results


def _ranges(lengths: Iterable[int]) -> list[slice]:
    return [slice(*ends) for ends in pairwise(accumulate(lengths, initial=0))]
