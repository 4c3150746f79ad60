"""Names in the report's scene: at a violation they cover no object that decides it, and no other name."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser

import spatial_replay as sr
from report.report_pages import report_of_samples

# what a canvas shows since it was cleared: boxes of filled paths with their colours, and of texts
RECORDED = """
const paths = CanvasRenderingContext2D.prototype, drawn = window.drawn = {};
const around = (name, hear) => {
  const original = paths[name];
  paths[name] = function (...given) { hear(this, ...given); return original.apply(this, given); };
};
const corner = (context, x, y) => {
  const [left, top, right, bottom] = context.box;
  context.box = [Math.min(left, x), Math.min(top, y), Math.max(right, x), Math.max(bottom, y)];
};
around("clearRect", (context) => { drawn[context.canvas.className] = {fills: [], texts: []}; });
around("beginPath", (context) => { context.box = [Infinity, Infinity, -Infinity, -Infinity]; });
around("moveTo", corner);
around("lineTo", corner);
around("fill", (context) => drawn[context.canvas.className]?.fills.push([context.fillStyle, context.box]));
around("fillText", (context, text, x, y) => {
  const half = context.measureText(text).width / 2;
  drawn[context.canvas.className]?.texts.push([text, [x - half, y - 6, x + half, y + 6]]);
});
"""
FRAMES = 30


def scenes() -> list[sr.Sample]:
    """Boxes of all sizes, anywhere; `c` is no concern of the specification."""
    draw = np.random.default_rng(7)

    def outline() -> sr.Footprint:
        x, y = draw.uniform(0.0, 40.0, 2)
        width, height = draw.choice([0.2, 1.0, 4.0, 15.0], 2)
        return sr.Footprint.box(x, y, x + width, y + height)

    return [sr.Sample(time * 10**8, {name: outline() for name in "abc"}) for time in range(FRAMES)]


def is_of_deciding_object(colour: str) -> bool:
    """Whether a filled path is of an object that is not grey: an arrow has another opacity."""
    match re.findall(r"[\d.]+", colour):
        case [red, green, _, "0.4"]:
            return bool(red != green)
    return False


def meet(one: list[float], other: list[float]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def test_names_at_a_violation_cover_no_deciding_object_and_no_other_name(
    browser: Browser, tmp_path: Path
) -> None:
    report_of_samples(tmp_path / "run.html", scenes(), "spec apart = G (a dist b >= 99)")
    page = browser.new_page()
    page.add_init_script(RECORDED)
    page.goto((tmp_path / "run.html").as_uri())
    page.keyboard.press("Home")
    for _ in range(FRAMES):
        drawn: dict[str, Any] = page.evaluate("window.drawn.stage")
        names = {text.removesuffix(" ✕"): box for text, box in drawn["texts"] if len(text) <= 3}
        assert names.keys() == {"a", "b"}, drawn["texts"]
        deciding = [box for colour, box in drawn["fills"] if is_of_deciding_object(colour)]
        assert len(deciding) == 2
        assert not any(meet(name, box) for name in names.values() for box in deciding)
        assert not any(meet(one, other) for (_, one), (_, other) in combinations(drawn["texts"], 2))
        page.keyboard.press("ArrowRight")
    page.close()
