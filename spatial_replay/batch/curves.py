"""Robustness curves for the page over all logs: one drawing per spec, one curve per log with a page."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.html import Html, element
from spatial_replay.report.panels import unpack_array, with_signs
from spatial_replay.text import number_text, with_unit

MOST_CURVES: Final = 60
"""Curves per drawing; the worst are kept."""
_MOST_POINTS: Final = 120
_WIDTH: Final = 480.0
_HEIGHT: Final = 120.0
_FACTS: Final = re.compile(rb'<script type="application/json" id="facts">(.*?)</script>', re.DOTALL)
_NUMBERS: Final = re.compile(
    rb'<script type="application/octet-stream" id="numbers">(.*?)</script>', re.DOTALL
)


class Curve(NamedTuple):
    """The robustness of one result of a log, for the prefix up to each sample.

    Attributes:
        title: name of the log, with the object of a template.
        address: address of the page about the log.
        spec: name of the result.
        times, values: (N,) each; NaN where the robustness is unknown.
    """

    title: str
    address: str
    spec: str
    verdict: str
    times: Floats
    values: Floats


def read_curves(page: Path, log: str, address: str) -> Iterator[Curve]:
    """Yield the curves in a page about a log.

    Args:
        address: address of the page, relative to the page over all logs.
    """
    content = page.read_bytes()
    facts, numbers = _FACTS.search(content), _NUMBERS.search(content)
    if facts is None or numbers is None:
        return
    run, data = json.loads(facts[1]), zlib.decompress(base64.b64decode(numbers[1]))
    times = unpack_array(run["times"], data)
    for number, result in enumerate(run["results"]):
        samples = result["samples"]
        places = np.unique(np.linspace(0, samples - 1, min(samples, _MOST_POINTS)).astype(np.int64))
        if not samples:
            continue
        # the series of the root holds the robustness of the prefix up to each sample
        values = unpack_array(result["series"], data)[:samples].astype(np.float64)
        title = f"{log}: {result['object']}" if result["object"] else log
        yield Curve(
            title,
            f"{quote(address)}#r={number}",
            result["name"],
            result["verdict"],
            times[result["first"] + places],
            values[places],
        )


def draw_curves(curves: Sequence[Curve], unit: str) -> Html:
    """Return the curves of a spec as SVG. The worst is on top, and each curve links to its page."""
    finite = [curve for curve in curves if np.isfinite(curve.values).any()]
    # SVG draws later elements on top
    worst_last = sorted(finite, key=lambda curve: -_final(curve))[-MOST_CURVES:]
    if not worst_last:
        return Html("")
    end = max(float(curve.times[-1]) for curve in worst_last) or 1.0
    numbers = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in worst_last])
    low, high = min(float(numbers.min()), 0.0), max(float(numbers.max()), 0.0)
    size = high - low or 1.0
    zero = _HEIGHT * high / size
    links = [
        element(
            "a",
            *_lines(curve, end, high, size),
            href=curve.address,
            **{"aria-label": f"{curve.title}, {curve.verdict}"},
        )
        for curve in worst_last
    ]
    bottom = f"{_HEIGHT + 12:.0f}"
    parts = [
        element("line", x1="0", x2=f"{_WIDTH:.0f}", y1=f"{zero:.2f}", y2=f"{zero:.2f}"),
        *links,
        element("text", with_unit(high, unit), x="0", y="9"),
        element("text", "0 s", x="0", y=bottom),
        element("text", f"{number_text(end)} s", x=f"{_WIDTH:.0f}", y=bottom, **{"text-anchor": "end"}),
    ]
    if low < 0.0:
        parts.append(element("text", with_signs(with_unit(low, unit)), x="0", y=f"{_HEIGHT - 3:.0f}"))
    view = f"0 0 {_WIDTH:.0f} {_HEIGHT + 16:.0f}"
    return element(
        "svg", *parts, viewBox=view, role="group", **{"aria-label": "Robustness over time", "class": "curves"}
    )


def _final(curve: Curve) -> float:
    return float(curve.values[np.isfinite(curve.values)][-1])


def _lines(curve: Curve, end: float, high: float, size: float) -> Iterator[Html]:
    """Yield the tooltip of a curve, a wide invisible line to point at, and the line itself."""
    yield element("title", f"{curve.title}, {curve.verdict}")
    pieces, is_open = list[str](), False
    for time, value in zip(curve.times, curve.values, strict=True):
        if math.isfinite(value):
            letter = "L" if is_open else "M"
            pieces.append(f"{letter}{_WIDTH * time / end:.1f} {_HEIGHT * (high - value) / size:.1f}")
        is_open = math.isfinite(value)
    line = "".join(pieces)
    yield element("path", d=line, **{"class": "area"})
    yield element("path", d=line, **{"class": "bad" if curve.verdict == "violated" else "quiet"})
