"""Read the samples of one instance again on request, and find their gaps."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene, tail
from spatial_replay.monitor.online.codes import joined_channels
from spatial_replay.monitor.stream import Instance
from spatial_replay.spec.formula import Earlier, Formula, Group, Outline, Quantified, Term, TrackedName
from spatial_replay.spec.walks import base_of, iter_atoms, logged_signals, named_members, substitute
from spatial_replay.trace.trace import ABSENT, Trace, window_of


@dataclass(frozen=True, slots=True)
class Gap:
    """The samples that lack an object or a signal, or pauses of all samples.

    Attributes:
        name: title of the object or signal (see `NamedPart`); None for pauses.
        missing: number of samples without the object or signal; for pauses, number of samples that fill them.
        samples: number of all samples.
        first_ns, last_ns: times of the first and the last of the missing samples.
        window: start and end (not included) of the samples with the object or signal. The start is
            None if the first sample is not missing. The end is None if the last sample is not missing. The
            window is None if missing samples are not all at the ends of the log, or all samples are missing.
            It is also None for an object with a class, if the object is absent from a sample.
        longest_ns: times of the first sample of the longest gap, and of the first sample after the gap.
        is_filled: whether the longest gap is filled to its end, as by `max_gap`. A lost connection adds a
            sample only at the beginning of a gap.
    """

    name: str | None
    missing: int
    samples: int
    first_ns: int
    last_ns: int
    window: tuple[int | None, int | None] | None
    longest_ns: tuple[int, int]
    is_filled: bool = False


class Evidence:
    """The samples of one instance, read again on each request, so that a log need not fit into memory."""

    def __init__(
        self,
        instance: Instance,
        regions: Mapping[str, Outline],
        traces: Callable[[], Iterable[Trace]],
        units: Mapping[str, str] = MappingProxyType({}),
        zero_ns: int | None = None,
    ) -> None:
        """Store how to read the samples.

        Args:
            traces: iterates over the samples in blocks of any length, with the earlier samples that terms
                look back at.
            units: declared units of signals by name; the unit of lengths under "".
            zero_ns: reference time of sentences; None for the time of the first sample.
        """
        self._zero_ns = zero_ns
        self.instance = instance
        self.units = dict(units)
        self._regions = regions
        self._traces = traces
        self._reach = instance.reach

    def bound(self, formula: Formula) -> Formula:
        """Replace variables of a formula by the object of the instance."""
        return substitute(formula, self.instance.bindings)

    def scene(self, time_ns: int) -> TraceScene:
        """Return the sample at a time, with the earlier samples that terms look back at.

        Raises:
            LookupError: there is no sample at the time, because the log changed since its evaluation.
        """
        return self.scenes([time_ns])[time_ns]

    def scenes(self, times_ns: Collection[int]) -> dict[int, TraceScene]:
        """Return a scene for each of several times (see `scene`), in one pass over the log."""
        # times are in descending order, so that `pop` removes the earliest time
        pending_ns, scenes = sorted(times_ns, reverse=True), dict[int, TraceScene]()
        for scene in self._scenes() if pending_ns else ():
            trace = scene.trace
            while pending_ns and pending_ns[-1] <= trace.times_ns[-1]:
                time_ns = pending_ns.pop()
                begin, end = window_of(trace.times_ns, time_ns, time_ns + 1)
                if begin == end:
                    raise LookupError(f"the log has no sample at {time_ns} ns any more")
                earlier_samples = (
                    tail(trace.slice(0, begin), self._reach) if begin and self._reach else trace.slice(0, 0)
                )
                sample_trace = Trace.concatenate([earlier_samples, trace.slice(begin, end)])
                scenes[time_ns] = TraceScene(sample_trace, self._regions, len(earlier_samples))
            if not pending_ns:
                return scenes
        raise LookupError(f"the log has no sample at {pending_ns[-1]} ns any more")

    def columns(self, formulas: Sequence[Formula]) -> Floats:
        """Compute K formulas without temporal operators in each sample, (C, K, T) (see `leaf_values`)."""
        scenes = self._scenes()
        blocks = [self._columns(scene, formulas)[:, :, self._evaluated_slice(scene)] for scene in scenes]
        return joined_channels(blocks, axis=2)

    def _columns(self, scene: TraceScene, formulas: Sequence[Formula]) -> Floats:
        bindings = self.instance.bindings
        if not any(isinstance(formula, Quantified) for formula in formulas):
            return leaf_values(scene, formulas, bindings)
        # one call per formula, because the limit of bindings counts all formulas of a call
        return joined_channels([leaf_values(scene, [formula], bindings) for formula in formulas], axis=1)

    def first_ns(self) -> int:
        """Return `zero_ns`; if it is None, the time of the first sample of all traces."""
        if self._zero_ns is not None:
            return self._zero_ns
        return next(int(trace.times_ns[0]) for trace in self._traces() if len(trace))

    def times_ns(self) -> Integers:
        """Return the times of the samples, (T,)."""
        scenes = self._scenes()
        return np.concatenate(
            [scene.trace.times_ns[scene.skip :][self._evaluated_slice(scene)] for scene in scenes]
        )

    def gaps(self, formula: Formula, time_ns: int = -1) -> tuple[Gap, ...]:
        """Return the gaps of all objects and signals in a formula that are ever missing.

        Args:
            time_ns: a pause that contains this time is reported as the longest pause.
        """
        formula_parts = named_parts(formula)
        missing_blocks: list[NDArray[np.bool_]] = []
        classified_parts, absent_parts = set[NamedPart](), set[NamedPart]()
        for scene in self._scenes():
            trace = scene.trace.slice(scene.skip, len(scene.trace))
            missing_columns = [trace.filling, *(is_missing(trace, part) for part in formula_parts)]
            missing_blocks.append(np.stack(missing_columns)[:, self._evaluated_slice(scene)])
            classified_parts.update(part for part in formula_parts if _is_classified(trace, part))
            absent_parts.update(
                part for part in formula_parts if _is_absent(trace, part)[self._evaluated_slice(scene)].any()
            )
        times_ns = self.times_ns()
        is_filling, *missing_columns = np.concatenate(missing_blocks, axis=1)
        is_recorded = ~is_filling
        gaps = [_gap(None, is_filling, times_ns, time_ns)] if is_filling.any() else []
        for part, is_part_missing in zip(formula_parts, missing_columns, strict=True):
            if is_part_missing[is_recorded].any():
                gap = _gap(part.title, is_part_missing[is_recorded], times_ns[is_recorded])
                comes_and_goes = part in classified_parts and part in absent_parts
                gaps.append(replace(gap, window=None) if comes_and_goes else gap)
        return tuple(gaps)

    def members(self, groups: Sequence[Group | Earlier]) -> NDArray[np.bool_]:
        """Return whether each open group has, or may have, a member in each sample, (G, T)."""
        blocks: list[NDArray[np.bool_]] = []
        for scene in self._scenes() if groups else ():
            evaluated_samples = self._evaluated_slice(scene)
            memberships = [scene.members(group) for group in groups]
            blocks.append(
                np.stack(
                    [
                        (members.any(axis=1) | may_have_member)[evaluated_samples]
                        for _, members, may_have_member in memberships
                    ]
                )
            )
        return np.concatenate(blocks, axis=1) if blocks else np.empty((0, 0), np.bool_)

    def _evaluated_slice(self, scene: TraceScene) -> slice:
        """Return the range of the scene's samples over which the instance is evaluated."""
        times_ns = scene.trace.times_ns[scene.skip :]
        return slice(*window_of(times_ns, self.instance.start_ns, self.instance.end_ns))

    def _scenes(self) -> Iterator[TraceScene]:
        """Iterate over the samples in blocks, with the earlier samples that terms look back at."""
        previous_trace: Trace | None = None
        for trace in self._traces():
            if len(trace) and trace.times_ns[0] >= self.instance.end_ns:
                # the instance of a template may end long before the log
                return
            skip = 0
            if previous_trace is not None and self._reach:
                recent_trace = tail(previous_trace, self._reach)
                skip = len(recent_trace)
                trace = Trace.concatenate([recent_trace, trace])
            previous_trace = trace if len(trace) else previous_trace
            if len(trace) and trace.times_ns[-1] >= self.instance.start_ns:
                yield TraceScene(trace, self._regions, skip)


class NamedPart(NamedTuple):
    """An object or a signal in a formula."""

    name: str
    is_signal: bool

    @property
    def title(self) -> str:
        """Name of the part in sentences."""
        return f"signal {self.name!r}" if self.is_signal else self.name


def named_parts(formula: Formula) -> list[NamedPart]:
    """Return the distinct signals and objects that a formula names."""
    atoms = list(iter_atoms(formula))
    parts = [NamedPart(name, True) for atom in atoms for name in logged_signals(atom.expression)]
    terms = [term for atom in atoms if atom.relation != "present" for term in atom.terms]
    parts += [NamedPart(name, False) for term in terms for name in _object_names(base_of(term))]
    return list(dict.fromkeys(parts))


def _object_names(base: Term) -> tuple[str, ...]:
    """Return the named objects of a term, members of groups included."""
    if isinstance(base, Group):
        return named_members(base)
    return (base.name,) if isinstance(base, TrackedName) else ()


def is_missing(trace: Trace, part: NamedPart) -> NDArray[np.bool_]:
    """Return for each sample whether the position of an object or the value of a signal is missing, (T,)."""
    name = part.name
    if part.is_signal:
        values = trace.signals.get(name)
        return np.ones(len(trace), np.bool_) if values is None else ~np.isfinite(values)
    if name not in trace.names:
        return np.ones(len(trace), np.bool_)
    return np.asarray(trace.rows[:, trace.names.index(name)] < 0)


def _is_absent(trace: Trace, part: NamedPart) -> NDArray[np.bool_]:
    """Return for each sample whether an object is absent, (T,). An unknown position is no absence."""
    if part.is_signal or part.name not in trace.names:
        return np.full(len(trace), not part.is_signal)
    return np.asarray(trace.rows[:, trace.names.index(part.name)] == ABSENT)


def _is_classified(trace: Trace, part: NamedPart) -> bool:
    if part.is_signal or part.name not in trace.names:
        return False
    rows = trace.rows[:, trace.names.index(part.name)]
    rows = rows[rows != ABSENT]
    codes = trace.class_code[np.where(rows < 0, -2 - rows, rows)]
    return any(trace.classes[code] is not None for code in np.unique(codes).tolist())


def _gap(name: str | None, is_gap: NDArray[np.bool_], times_ns: Integers, time_ns: int = -1) -> Gap:
    last_index = len(is_gap) - 1
    boundaries = np.flatnonzero(np.diff(is_gap, prepend=False, append=False))
    starts, ends = boundaries[::2], boundaries[1::2]
    # whether only leading and trailing samples are missing
    is_at_ends = bool(((starts == 0) | (ends > last_index)).all()) and not is_gap.all()
    window_start = int(times_ns[ends[0]]) if starts[0] == 0 and is_at_ends else None
    window_end = int(times_ns[starts[-1]]) if ends[-1] > last_index else None
    # a gap at the end of the log has no sample after it
    spans = np.stack((times_ns[starts], times_ns[np.minimum(ends, last_index)]))
    contains_time = (spans[0] <= time_ns) & (time_ns < spans[1])
    longest_span = spans[:, (contains_time if contains_time.any() else np.diff(spans, axis=0)).argmax()]
    return Gap(
        name,
        int(is_gap.sum()),
        len(is_gap),
        int(times_ns[starts[0]]),
        int(times_ns[ends[-1] - 1]),
        (window_start, window_end) if is_at_ends else None,
        (int(longest_span[0]), int(longest_span[1])),
        int(longest_span[1]) - 1 in times_ns[is_gap][1:],
    )
