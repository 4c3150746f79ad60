"""The extension's panels in a page that simulates a viewer: latency from seek or pointer to picture."""

from __future__ import annotations

import contextlib
import io
import random
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

import spatial_replay as sr
from spatial_replay.cli import run

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from browser.viewer_page import differences, write_viewer_page  # noqa: E402

SEEKS = 1_000
MOVES = 200
PARTS = 250
"""Number of parts of a spec, which then has 2 PARTS + 1 nodes."""
SAMPLES = 200

_TIMES = """async ([times, isHover]) => {
    const taken = [];
    for (const seconds of times) {
        const time = {sec: Math.floor(seconds), nsec: Math.round(seconds % 1 * 1e9)};
        const frame = viewer.frameAt(time);
        // from one picture on, so that no time is lost until the next
        await new Promise(requestAnimationFrame);
        const start = performance.now();
        if (isHover) viewer.hover(seconds);
        else viewer.render({currentFrame: frame, currentTime: time, didSeek: true, previewTime: undefined});
        await viewer.drawn();
        taken.push((performance.now() - start) / 1000);
    }
    return taken;
}"""


def bench_viewer_panels(measure: Any) -> None:
    """A spec of 501 nodes, and a table setting whose numbers are compared at 1,000 times."""
    chromium = shutil.which("chromium")
    if chromium is None:
        measure.remark("Chromium is not installed")
        return
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        large = _page(browser, _large(Path(folder) / "large.mcap"))
        for name, is_hover in (("seek to picture", False), ("pointer to picture", True)):
            chosen = random.Random(5)
            times = [chosen.uniform(0.0, (SAMPLES - 1) / 10) for _ in range(MOVES)]
            measure.quantile(
                f"{name}, {2 * PARTS + 1} nodes",
                large.evaluate(_TIMES, [times, is_hover]),
                0.5,
                unit="move",
                limit_s=0.05,
            )
        large.close()
        log, specification = Path(folder) / "table.mcap", ROOT / "recordings" / "table_edited.spatial"
        table = ROOT / "recordings" / "table.jsonl"
        with contextlib.redirect_stdout(io.StringIO()):
            run(["replay", str(table), "--spec", str(specification), "-o", str(log)])
        page = _page(browser, log)
        results = sr.evaluate(sr.load_specification(specification), sr.read_trace(table)).results
        found = [
            each
            for result in results
            for each in differences(page, result, SEEKS // len(results) + 1, random.Random(11))
        ]
        measure.ratio(f"of {SEEKS:,} seeks, wrong numbers", len(found), 0)
        browser.close()


def _large(log: Path) -> Path:
    """Write a log whose specification has `PARTS` parts."""
    parts = " and ".join(f"(G (a dist b >= {k / 100}))" for k in range(PARTS))
    specification = sr.parse_specification(f"spec apart = {parts}")
    with sr.Recorder(log, specifications=[specification]) as recorder:
        for t in range(SAMPLES):
            objects = {"a": sr.Footprint.disc(5 - t / 40, 0, 1), "b": sr.Footprint.disc(0, 0, 1)}
            recorder.write(sr.Sample(t * 10**8, objects))
    return log


def _page(browser: Browser, log: Path) -> Page:
    """Return the specification panel in a viewer with the log."""
    write_viewer_page(log, log.with_suffix(".html"), topics=("specification", "robustness", "events"))
    page = browser.new_page(viewport={"width": 700, "height": 800})
    page.goto(log.with_suffix(".html").as_uri())
    page.evaluate(
        """async () => {
            window.viewer = new Viewer(CODE, MESSAGES, "foxglove");
            await viewer.show("spatial-replay specification", document.getElementById("panel"));
        }"""
    )
    return page
