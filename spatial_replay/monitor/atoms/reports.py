"""Reports of objects and signals in samples: the previous report, and the time since that report.

Consecutive samples may show the same report. The first report after a sample without a report has no previous
report.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf, isfinite, nan
from typing import Any, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.geometry.footprint import (
    FootprintBatch,
    TrackedObject,
    centre_of,
    packed_centre,
    shift_rows,
)
from spatial_replay.spec.formula import ANY_CLASS, ComputedSignal, Group, Signal, Term, TrackedName
from spatial_replay.spec.relations import computed_signal
from spatial_replay.spec.walks import named_members
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import Sample, Trace


def before_last_reports(trace: Trace) -> Integers:
    """Return the last sample before the newest report, for each object and signal with report times."""
    columns = [(trace.rows >= 0, trace.reported_ns)] if trace.reported_ns is not None else []
    for name, reported_ns in trace.signals_reported_ns.items():
        columns.append((is_signal_known(trace.signals[name])[:, None], reported_ns[:, None]))
    sample_arrays = [np.empty(0, np.int64)]
    for is_known, reported_ns in columns:
        is_begin = _begins(is_known, reported_ns)[:, is_known[-1]]
        first_samples = len(trace) - 1 - np.argmax(is_begin[::-1], axis=0)
        sample_arrays.append(first_samples[first_samples > 0] - 1)
    return np.concatenate(sample_arrays).astype(np.int64)


def is_signal_known(values: Floats) -> Booleans:
    """Return whether each value of a signal is a number, not a text."""
    return np.asarray(np.isfinite(values) & (values > TEXTS))


def _begins(is_known: Booleans, reported_ns: Integers) -> Booleans:
    """Return whether a report begins with each sample. Both arguments, and the result, are (T, ...)."""
    is_begin = is_known.copy()
    is_begin[1:] &= ~is_known[:-1] | (reported_ns[1:] != reported_ns[:-1])
    return is_begin


class Reports(NamedTuple):
    """The previous report of an object or a signal, in each sample.

    Attributes:
        before: (T,), last sample with the previous report; -1 without a previous report, such as after a
            sample without a report.
        seconds: (T,), time from the previous to the current report, s; NaN if it is not positive, or without
            a previous report.
    """

    before: Integers
    seconds: Floats

    @classmethod
    def of(cls, is_known: Booleans, reported_ns: Integers) -> Reports:
        # the sample before the begin of a report shows the previous report
        begin_samples = np.where(_begins(is_known, reported_ns), np.arange(len(is_known)), -1)
        previous_samples = np.where(is_known, np.maximum.accumulate(begin_samples) - 1, -1)
        previous_samples = np.where(
            (previous_samples >= 0) & is_known[previous_samples], previous_samples, -1
        )
        step_ns = np.where(previous_samples < 0, 0, reported_ns - reported_ns[previous_samples])
        seconds = np.where(step_ns > 0, step_ns / 1e9, np.nan)
        return cls(previous_samples.astype(np.int64), seconds)


@dataclass(slots=True)
class LatestReport:
    """The report that a sample shows of an object or a signal (see `Reports`).

    Attributes:
        value: the object, or the number of the signal.
        reported_ns: time of the report.
        before: previous report, or None.
        seconds: time from the previous report to this report, s; NaN if it is not positive, or without a
            previous report.
        centre: packed centre of an object; None until it is needed.
    """

    value: Any
    reported_ns: int
    before: LatestReport | None = None
    seconds: float = nan
    centre: tuple[bytes, bytes] | None = None

    def follow(self, value: Any, reported_ns: int) -> LatestReport:
        """Return the report of the next sample; this report itself if the report times are equal."""
        if reported_ns == self.reported_ns:
            return LatestReport(value, reported_ns, self.before, self.seconds)
        step_ns = reported_ns - self.reported_ns
        self.before = None  # only two reports are compared, and a longer chain would never be freed
        return LatestReport(value, reported_ns, self, step_ns / 1e9 if step_ns > 0 else nan)


class RecentReports:
    """The reports of objects and signals in the newest sample, with their previous reports.

    Args:
        objects: names of the objects; None for all objects.
        signals: the signals.
    """

    def __init__(self, objects: frozenset[str] | None, signals: Iterable[Signal]) -> None:
        self._objects = objects
        self._signals = tuple(signals)
        self.latest: dict[str | Signal, LatestReport] = {}

    def add(self, sample: Sample) -> None:
        """Add the next sample. Objects and signals without a report lose their history."""
        latest: dict[str | Signal, LatestReport] = {}
        objects, report_times_ns = sample.objects, sample.reported_ns
        for name in objects if self._objects is None else self._objects:
            if name in objects:
                latest[name] = self._next(name, objects[name], report_times_ns.get(name, sample.time_ns))
        for signal in self._signals:
            time_ns = sample.time_ns
            if isinstance(signal, ComputedSignal):
                value = computed_signal(signal, sample)
            else:
                value, time_ns = (
                    sample.signals.get(signal.name, nan),
                    report_times_ns.get(signal.name, time_ns),
                )
            if isfinite(value) and value > TEXTS:
                latest[signal] = self._next(signal, value, time_ns)
        self.latest = latest

    def _next(self, key: str | Signal, value: Any, reported_ns: int) -> LatestReport:
        latest = self.latest.get(key)
        return LatestReport(value, reported_ns) if latest is None else latest.follow(value, reported_ns)

    def step(self, terms: Iterable[Term], sample: Sample) -> float:
        """Return the shortest time between two reports of the terms' objects, s.

        Lasting objects without two reports are ignored. If another object lacks two reports, return NaN.
        """
        shortest_s, latest = inf, self.latest
        for term in terms:
            for name in (term.name,) if isinstance(term, TrackedName) else _members_in(term, sample):
                step_s = latest[name].seconds if name in latest else nan
                if step_s < shortest_s:
                    shortest_s = step_s
                elif step_s != step_s and name not in sample.lasting:
                    return nan
        return shortest_s if isfinite(shortest_s) else nan

    def packed_centre(self, name: str, tracked: TrackedObject) -> tuple[bytes, bytes]:
        """Return the packed centre of an object, computed once for each report."""
        latest = self.latest.get(name)
        for report in () if latest is None else (latest, latest.before):
            if report is not None and report.value is tracked:
                # computed once per report: with report times computed once per rate, an update of `speed(r)`
                # fell from 157 to 26 µs
                report.centre = report.centre or packed_centre(tracked)
                return report.centre
        return packed_centre(tracked)

    def moved_back(self, name: str, sample: Sample, shortest: float) -> TrackedObject | None:
        """Return an object moved back by its velocity; None without a previous report.

        Args:
            shortest: time by which the object is moved back, s.
        """
        latest = self.latest.get(name)
        if latest is None:
            return None
        previous_report, step_s = latest.before, latest.seconds
        current_object: TrackedObject = latest.value
        if previous_report is None or step_s != step_s:
            return current_object if name in sample.lasting else None
        previous_object: TrackedObject = previous_report.value
        # the earlier report itself, because arithmetic would change bits
        if step_s == shortest:
            return previous_object
        if not step_s > shortest:
            return None
        (x, y), (previous_x, previous_y) = (
            centre_of(tracked.footprint) for tracked in (current_object, previous_object)
        )
        fraction = shortest / step_s
        shift = np.array([[(previous_x - x) * fraction, (previous_y - y) * fraction]])
        moved_batch = shift_rows(FootprintBatch.from_footprints([current_object.footprint]), shift)
        uncertainty = max(current_object.uncertainty, previous_object.uncertainty)
        return replace(current_object, footprint=moved_batch.footprint(0), uncertainty=uncertainty)


def _members_in(term: Term, sample: Sample) -> Iterable[str]:
    if not isinstance(term, Group):
        return (term.name,)  # type: ignore[union-attr]
    if not term.is_open:
        return named_members(term)
    group_class, excluded_names = (term.class_name or "").casefold(), left_out_of(term)
    classes = {name: tracked.class_name for name, tracked in sample.objects.items()} | dict(sample.unknown)
    return [
        name
        for name, class_name in classes.items()
        if name not in excluded_names
        and (term.class_name == ANY_CLASS or (class_name or "").casefold() == group_class)
    ]


def left_out_of(group: Group) -> frozenset[str]:
    return frozenset(term.name for term in group.excluded)
