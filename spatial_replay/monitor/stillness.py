"""Find objects that may be lost by a tracker: they never change while all others of their class move."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.text import plural, printable
from spatial_replay.trace.trace import Trace

_LEAST_REPORTS: Final = 20
"""Minimum number of reports of an object without changes."""
_MOSTLY: Final = 0.95
"""Minimum fraction of reports in which every other object changes.

With 20 reports and 95 %, 151 recorded logs have no remark.
"""
_LEAST_OTHERS: Final = {True: 1, False: 3}
"""Minimum number of other objects, by whether they have a class.

The number is larger without a class: a goal or a tray may rest while a hand and a cube move.
"""


@dataclass(slots=True)
class _Reports:
    """The reports of an object after its first report.

    Attributes:
        last_numbers: (3,), numbers of the newest report, see `_numbers`.
    """

    report_count: int = 0
    change_count: int = 0
    class_name: str | None = None
    last_numbers: Floats = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def mostly_changes(self) -> bool:
        return self.report_count >= _LEAST_REPORTS and self.change_count >= _MOSTLY * self.report_count


class Stillness:
    """Counts the changes between consecutive reports of each object, block by block."""

    def __init__(self) -> None:
        """Start before the first sample."""
        self._reports: dict[str, _Reports] = defaultdict(_Reports)
        self._lasting: set[str] = set()

    def add(self, trace: Trace) -> None:
        """Add the next samples."""
        self._lasting |= trace.lasting
        observation_numbers = _numbers(trace)
        for column, name in enumerate(trace.names):
            rows = trace.rows[:, column]
            is_new = rows >= 0
            if trace.reported_ns is not None:
                report_times_ns = trace.reported_ns[:, column]
                # samples repeat a report until the next report comes
                is_new &= np.concatenate([[True], report_times_ns[1:] != report_times_ns[:-1]])
            rows = rows[is_new]
            if not len(rows):
                continue
            reports = self._reports[name]
            report_numbers = np.concatenate([reports.last_numbers[None], observation_numbers[rows]])
            # the first report of an object has no previous report to differ from
            is_first = bool(np.isnan(report_numbers[0]).all())
            # NaN differs from itself, but a missing yaw is no change
            is_changed = (
                (report_numbers[1:] != report_numbers[:-1])
                & ~(np.isnan(report_numbers[1:]) & np.isnan(report_numbers[:-1]))
            ).any(axis=1)
            reports.report_count += len(rows) - is_first
            reports.change_count += int(is_changed[is_first:].sum())
            reports.class_name = trace.classes[trace.class_code[rows[-1]]]
            reports.last_numbers = report_numbers[-1]

    def remarks(self) -> Iterator[str]:
        """Yield a sentence on each object that never changed while all others of its class mostly changed."""
        by_class: dict[str | None, dict[str, _Reports]] = defaultdict(dict)
        for name, reports in self._reports.items():
            # a lasting object, such as a latched map, may have a single report
            if name not in self._lasting:
                by_class[reports.class_name][name] = reports
        for class_name, objects in by_class.items():
            still_names = [name for name, reports in objects.items() if not reports.change_count]
            other_reports = [reports for name, reports in objects.items() if name not in still_names]
            if len(still_names) != 1 or len(other_reports) < _LEAST_OTHERS[bool(class_name)]:
                continue
            report_count = objects[still_names[0]].report_count
            if report_count >= _LEAST_REPORTS and all(reports.mostly_changes for reports in other_reports):
                class_text = f"of the class {printable(class_name)!r}" if class_name else "without a class"
                stillness_text = f"never changes by a bit in {plural(report_count + 1, 'report')}"
                others_move = f"while all other objects {class_text} move"
                yield f"{printable(still_names[0])} {stillness_text}, {others_move}: is it still tracked?"


def _numbers(trace: Trace) -> Floats:
    """Return each observation's sum of vertex x, sum of vertex y, and yaw, (R, 3)."""
    batch = trace.footprints
    vertex_starts = batch.vertex_start[batch.part_start]
    sums = np.zeros((len(trace.yaw), 3))
    if len(trace.yaw):
        sums[:, :2] = np.add.reduceat(batch.vertices, vertex_starts[:-1].astype(np.intp))
        sums[:, 2] = trace.yaw
    return sums
