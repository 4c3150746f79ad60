"""The report of a long run: processor time of writing it, and latency from the cursor to the picture."""

from __future__ import annotations

import random
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

import spatial_replay as sr
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.source import MemorySource
from spatial_replay.report.write import write_report

SAMPLES = 100_000
OBJECTS = 4
MOVES = 200
SPECIFICATION = """
spec apart = G ((a dist b >= 0.1) and (c dist d >= 0.1) and (a dist d >= -2))
spec visits = (F (a leftof b)) and (F (c above d))
spec responds = G ((a above b) -> (F[0, 300] (b above a)))
spec task = apart and visits and responds
"""

_TIMES = """async (shares) => {
    const slider = document.querySelector(".slider");
    const taken = [];
    for (const share of shares) {
        await new Promise(requestAnimationFrame);
        const start = performance.now();
        slider.value = share * 1000;
        slider.dispatchEvent(new Event("input"));
        // styles and places count, too
        document.body.getBoundingClientRect();
        taken.push((performance.now() - start) / 1000);
    }
    return taken;
}"""


def bench_report(measure: Any) -> None:
    """A run of 100,000 samples with 4 objects and 24 nodes."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "run.html"
        specification = sr.parse_specification(SPECIFICATION)
        source = MemorySource(_run(SAMPLES))
        # the first run compiles
        write_report(source, [specification], page)
        start = time.process_time()
        write_report(source, [specification], page)
        taken = time.process_time() - start
        measure.quantile(f"{SAMPLES:,} samples, processor time", [taken], 0.5, unit="page", limit_s=10.0)
        chromium = shutil.which("chromium")
        if chromium is None:
            measure.remark("Chromium is not installed")
            return
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=chromium, args=["--no-sandbox", "--disable-gpu"]
            )
            opened = browser.new_page(viewport={"width": 1280, "height": 900})
            opened.goto(page.as_uri())
            opened.wait_for_selector("html[data-ready]")
            chosen = random.Random(7)
            times = opened.evaluate(_TIMES, [chosen.random() for _ in range(MOVES)])
            measure.quantile("cursor moved to picture", times, 0.5, unit="move", limit_s=0.016)
            browser.close()


def _run(count: int) -> sr.Trace:
    """Return a run of discs that swing next to each other, at 100 Hz."""
    times, phases = np.arange(count), np.arange(OBJECTS)
    x = np.sin(times[:, None] / 50 + phases) + 1.5 * phases
    y = np.cos(times[:, None] / 70 + 2 * phases)
    observations = count * OBJECTS
    unknown = np.full(observations, np.nan)
    discs = FootprintBatch(
        part_start=np.arange(observations + 1),
        vertex_start=np.arange(observations + 1),
        vertices=np.stack([x, y], axis=2).reshape(-1, 2),
        radius=np.full(observations, 0.3),
        bottom=unknown,
        top=unknown,
    )
    return sr.Trace(
        times_ns=times * 10**7,
        names=tuple("abcd"),
        rows=np.arange(observations).reshape(count, OBJECTS),
        footprints=discs,
        yaw=unknown,
        uncertainty=np.zeros(observations),
        class_code=np.zeros(observations, np.int64),
        classes=(None,),
    )
