"""Evaluating specifications in memory: the first time, and after an edit."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import spatial_replay as sr

PUBLISHED_S = 34.3e-3
"""What the published implementation of the logic takes for one sample of the blocks recording, every prefix,
on a machine like this one; it grows with the number of samples before."""

EDITED = (("G ((red1", "G not not ((red1"), ("F (red2", "F[0,inf] (red2"))


def bench_blocks(measure: Any) -> None:
    """The block-pushing specification over its camera recording: every node, every prefix."""
    import json

    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        return
    text = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    trace = sr.read_trace(data / "blocks_moving_passage.jsonl.gz")
    specification = sr.parse_specification(text)
    edited_text = text
    for old, new in EDITED:
        edited_text = edited_text.replace(old, new)
    edited = sr.parse_specification(edited_text)
    sr.evaluate(specification, trace)
    measure(
        "first time",
        lambda fresh: sr.evaluate(specification, fresh),
        prepare=lambda: replace(trace),
        per=len(trace),
        unit="sample",
        runs=21,
        limit_s=3e-6,
        reference_s=PUBLISHED_S,
    )
    measure(
        "temporal part edited",
        lambda _: sr.evaluate(edited, trace),
        per=len(trace),
        unit="sample",
        runs=21,
        limit_s=1e-6,
        reference_s=PUBLISHED_S,
    )
