"""Robustness curves of the page over all logs: a drawing for each spec, with a curve for each failing log."""

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
"""Maximum number of curves in a drawing. The worst curves are drawn."""
_MOST_POINTS: Final = 120
_WIDTH: Final = 480.0
_HEIGHT: Final = 120.0
_FACTS: Final = re.compile(rb'<script type="application/json" id="facts">(.*?)</script>', re.DOTALL)
_NUMBERS: Final = re.compile(
    rb'<script type="application/octet-stream" id="numbers">(.*?)</script>', re.DOTALL
)


class Curve(NamedTuple):
    """The robustness of one result over the prefixes of a log.

    Attributes:
        title: name of the log, with the object of a template.
        address: address of the page about the log.
        spec: name of the result.
        times, values: (N,) each: end of each prefix, seconds, and its robustness; NaN if unknown.
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
    facts_match, numbers_match = _FACTS.search(content), _NUMBERS.search(content)
    if facts_match is None or numbers_match is None:
        return
    run, array_bytes = json.loads(facts_match[1]), zlib.decompress(base64.b64decode(numbers_match[1]))
    times = unpack_array(run["times"], array_bytes)
    for result_index, result in enumerate(run["results"]):
        samples = result["samples"]
        sample_indices = np.unique(np.linspace(0, samples - 1, min(samples, _MOST_POINTS)).astype(np.int64))
        if not samples:
            continue
        # the root node's series has the robustness of the prefix up to each sample
        robustness = unpack_array(result["series"], array_bytes)[:samples].astype(np.float64)
        title = f"{log}: {result['object']}" if result["object"] else log
        yield Curve(
            title,
            f"{quote(address)}#r={result_index}",
            result["name"],
            result["verdict"],
            times[result["first"] + sample_indices],
            robustness[sample_indices],
        )


def draw_curves(curves: Sequence[Curve], unit: str) -> Html:
    """Return the curves of a spec as SVG. The worst curve is on top, and each curve links to its page."""
    finite_curves = [curve for curve in curves if np.isfinite(curve.values).any()]
    # SVG draws later elements on top
    worst_last = sorted(finite_curves, key=lambda curve: -_final(curve))[-MOST_CURVES:]
    if not worst_last:
        return Html("")
    end_s = max(float(curve.times[-1]) for curve in worst_last) or 1.0
    robustness = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in worst_last])
    low, high = min(float(robustness.min()), 0.0), max(float(robustness.max()), 0.0)
    span = high - low or 1.0
    zero_y = _HEIGHT * high / span
    links = [
        element(
            "a",
            *_lines(curve, end_s, high, span),
            href=curve.address,
            **{"aria-label": f"{curve.title}, {curve.verdict}"},
        )
        for curve in worst_last
    ]
    label_y = f"{_HEIGHT + 12:.0f}"
    parts = [
        element("line", x1="0", x2=f"{_WIDTH:.0f}", y1=f"{zero_y:.2f}", y2=f"{zero_y:.2f}"),
        *links,
        element("text", with_unit(high, unit), x="0", y="9"),
        element("text", "0 s", x="0", y=label_y),
        element("text", f"{number_text(end_s)} s", x=f"{_WIDTH:.0f}", y=label_y, **{"text-anchor": "end"}),
    ]
    if low < 0.0:
        parts.append(element("text", with_signs(with_unit(low, unit)), x="0", y=f"{_HEIGHT - 3:.0f}"))
    view_box = f"0 0 {_WIDTH:.0f} {_HEIGHT + 16:.0f}"
    return element(
        "svg",
        *parts,
        viewBox=view_box,
        role="group",
        **{"aria-label": "Robustness over time", "class": "curves"},
    )


def _final(curve: Curve) -> float:
    return float(curve.values[np.isfinite(curve.values)][-1])


def _lines(curve: Curve, end_s: float, high: float, span: float) -> Iterator[Html]:
    """Yield a curve's tooltip, a wide invisible line for the pointer, and the visible line."""
    yield element("title", f"{curve.title}, {curve.verdict}")
    commands, is_open = list[str](), False
    for time_s, robustness in zip(curve.times, curve.values, strict=True):
        if math.isfinite(robustness):
            letter = "L" if is_open else "M"
            commands.append(
                f"{letter}{_WIDTH * time_s / end_s:.1f} {_HEIGHT * (high - robustness) / span:.1f}"
            )
        is_open = math.isfinite(robustness)
    path = "".join(commands)
    yield element("path", d=path, **{"class": "area"})
    yield element("path", d=path, **{"class": "bad" if curve.verdict == "violated" else "quiet"})
