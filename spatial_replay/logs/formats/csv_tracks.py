"""Track CSV: one oriented box a line; lines of equal time make a sample."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from math import cos, isfinite, nan, sin
from pathlib import Path

from spatial_replay.errors import LogError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.formats.tracks import ObjectReport, ReportedSample, iter_lines, iter_traces
from spatial_replay.logs.read_options import FaultList
from spatial_replay.text import Instant, Sentence, times_apart
from spatial_replay.trace.sample import LATEST_NS
from spatial_replay.trace.trace import Trace

COLUMNS = ("time_ns", "name", "class", "x", "y", "yaw", "length", "width")


class _NoObjectError(Exception):
    """A line that is not an object; the text says why and what to give instead."""


def iter_csv(path: Path, faults: FaultList, *, concave: Concave = "decompose") -> Iterator[Trace]:
    """Yield the samples of a track CSV in blocks.

    A sample with a line that cannot be read is left out as a whole and goes to `faults`.

    Raises:
        LogError: the first line does not name the columns.
    """
    return iter_traces(_samples(path, faults), faults, concave)


def _samples(path: Path, faults: FaultList) -> Iterator[ReportedSample]:
    lines = iter_lines(path, faults)
    order = _column_order(path, next(lines, (1, ""))[1])
    time_ns, place, reports, broken = -1, "", dict[str, ObjectReport](), False
    for number, line in lines:
        here = f"{path.name}:{number}"
        try:
            row = _row(line, order)
            at = _time(row["time_ns"])
            if at < time_ns:
                this, last = times_apart(at, time_ns)
                what = Sentence("its time is ", this, ", before ", last, "; give times that do not go back")
                raise _NoObjectError(what)
        except _NoObjectError as error:
            faults.add(Sentence(f"{here}: ", *error.args))
            continue
        if at > time_ns:
            if reports and not broken:
                yield time_ns, place, list(reports.values()), {}
            time_ns, place, reports, broken = at, here, {}, False
        try:
            report = _report(row)
            if report.name in reports:
                raise _NoObjectError(f"object {report.name!r} is there twice; name each object once a sample")
            reports[report.name] = report
        except _NoObjectError as error:
            faults.add(Sentence(f"{here}: {error}; the sample at ", Instant(at, 0), " is left out"))
            broken = True
    if reports and not broken:
        yield time_ns, place, list(reports.values()), {}


def _column_order(path: Path, header: str) -> list[str]:
    order = [name.strip() for name in header.strip().split(",")]
    if sorted(order) != sorted(COLUMNS):
        raise LogError(
            f"{path.name}:1: the columns are {', '.join(order)[:200]!r}; a track CSV has {','.join(COLUMNS)}"
        )
    return order


def _row(line: str, order: list[str]) -> dict[str, str]:
    try:
        cells = next(csv.reader([line], strict=True))
    except (csv.Error, StopIteration) as error:
        raise _NoObjectError(f"the line is not CSV ({error}); a quoted cell ends on its own line") from None
    if len(cells) != len(order):
        raise _NoObjectError(f"the line has {len(cells)} cells; give {len(order)}")
    return dict(zip(order, cells, strict=True))


def _time(text: str) -> int:
    try:
        time_ns = int(text)
    except ValueError:
        time_ns = -1
    if not 0 <= time_ns <= LATEST_NS:
        raise _NoObjectError(f"time_ns is {text[:60]!r}; give integer nanoseconds from 0 to 2**63 - 1")
    return time_ns


def _report(row: dict[str, str]) -> ObjectReport:
    if not row["name"]:
        raise _NoObjectError("the name is empty; give each object a name")
    x, y, length, width = (_number(row, column) for column in ("x", "y", "length", "width"))
    yaw = _number(row, "yaw") if row["yaw"].strip() else nan
    if length < 0 or width < 0:
        raise _NoObjectError(f"length and width are {length:g} and {width:g}; give sizes of at least 0")
    # the cosine and sine of an orientation that is not finite make the box unknown
    c, s = (1.0, 0.0) if not row["yaw"].strip() else (cos(yaw), sin(yaw)) if isfinite(yaw) else (nan, nan)
    vertices: list[float] = []
    for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
        vertices += (x + a * length * c + b * width * -s, y + a * length * s + b * width * c)
    return ObjectReport(row["name"], row["class"] or None, vertices, [4], [0.0], yaw=yaw)


def _number(row: dict[str, str], column: str) -> float:
    """Return the number in a cell; an empty one stands for an unknown number."""
    text = row[column].strip()
    try:
        return float(text) if text else nan
    except ValueError:
        wanted = "a number, or nothing where it is not known"
        raise _NoObjectError(f"{column} is {text[:60]!r}; give {wanted}") from None
