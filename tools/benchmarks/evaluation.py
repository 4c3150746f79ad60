"""Evaluation of specifications in memory: the first time, and after an edit."""

from __future__ import annotations

import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.compiled import only
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure

PUBLISHED_S = 34.3e-3
"""Time of the published implementation for one sample of the blocks recording, every prefix, on a similar
machine. It grows with the number of earlier samples."""

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
    with only("compiled"):
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


def box_trace(count: int, boxes: int, side: float = 0.1) -> sr.Trace:
    """Return turned boxes at random places, some of which overlap and some of which are far apart."""
    random = np.random.default_rng(3)
    corners = 0.5 * side * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    turns = random.uniform(0.0, 2.0 * np.pi, (count, boxes))
    places = random.uniform(-0.5, 0.5, (count, boxes, 2))
    rows = np.arange(count * boxes)
    turning = np.array([[np.cos(turns), -np.sin(turns)], [np.sin(turns), np.cos(turns)]])
    vertices = np.einsum("xytk,cy->tkcx", turning, corners) + places[:, :, None]
    return sr.Trace(
        times_ns=np.arange(count) * 10_000_000,
        names=tuple(f"o{number}" for number in range(boxes)),
        rows=rows.reshape(count, boxes),
        footprints=FootprintBatch(
            part_start=np.arange(len(rows) + 1),
            vertex_start=4 * np.arange(len(rows) + 1),
            vertices=vertices.reshape(-1, 2),
            radius=np.zeros(len(rows)),
            bottom=np.full(len(rows), np.nan),
            top=np.full(len(rows), np.nan),
        ),
        yaw=turns.reshape(-1),
        uncertainty=np.zeros(len(rows)),
        class_code=np.zeros(len(rows), np.int64),
        classes=(None,),
    )


def bench_box_distances(bench: Any) -> None:
    """Distances of all pairs of six boxes, without a specification."""
    trace = box_trace(3000, 6)
    operands = [Operand(column[:, None]) for column in trace.rows.T]
    requests = [
        MeasureRequest("signed_distance", first, second)
        for first, second in itertools.combinations(range(6), 2)
    ]
    with only("compiled"):
        bench.measure(
            "boxes alone",
            lambda _: measure(trace.footprints, operands, requests),
            per=len(trace) * len(requests),
            unit="pair",
            runs=11,
            limit_s=0.3e-6,
        )


CORNERS = 1000


def bench_corners(bench: Any) -> None:
    """Signed distances and protrusions of all pairs of objects with 1,000 corners."""
    at, turns = np.random.default_rng(1), np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    circle = np.column_stack((np.cos(turns), np.sin(turns)))
    star = circle * (1 + 0.3 * np.sin(9 * turns))[:, None]
    # outline, largest offset of its centre, ratio of consecutive sizes, number of samples
    shapes = {
        "convex": (circle, 9.0, 1.0, 20),
        "convex, overlapping": (circle, 0.5, 1.0, 20),
        "convex, around one centre": (circle, 0.0, 0.9, 20),
        "concave": (star, 9.0, 1.0, 1),
    }
    for shape, (outline, around, smaller, count) in shapes.items():
        samples = [
            sr.Sample(
                number,
                {
                    f"o{each}": sr.TrackedObject(sr.Footprint.polygon(outline * smaller**each + place))
                    for each, place in enumerate(at.uniform(-around, around, (12, 2)))
                },
            )
            for number in range(count)
        ]
        trace, objects = sr.Trace.from_samples(samples), list(samples[0].objects)
        pairs = [(a, b) for a in objects for b in objects if a < b]
        for relation in ("dist", "enclosedin"):
            atoms = [f"{a} dist {b} >= 0" if relation == "dist" else f"{a} enclosedin {b}" for a, b in pairs]
            specification = sr.parse_specification(" or ".join(atoms))
            sr.evaluate(specification, replace(trace))
            bench.measure(
                f"{shape}, {relation}",
                lambda fresh, specification=specification: sr.evaluate(specification, fresh),
                prepare=lambda trace=trace: replace(trace),
                per=len(pairs) * count,
                unit="pair",
                runs=11,
                limit_s=2e-5 if outline is circle else None,
            )


CROWD = """
group people = class "person"
spec apart = G (forall p, q in people: p dist q >= 0.5)
"""


def bench_crowd(bench: Any) -> None:
    """A quantifier over pairs of 200 people: 39,800 bindings per sample."""
    at = np.random.default_rng(1)
    places, steps = at.uniform(0, 60, (200, 2)), at.normal(0, 0.1, (200, 2))
    samples = []
    for number in range(300):
        objects = {
            f"p{each}": sr.TrackedObject(sr.Footprint.disc(x, y, 0.25), class_name="person")
            for each, (x, y) in enumerate((places + number * steps).tolist())
        }
        samples.append(sr.Sample(number * 10**8, objects))
    trace, specification = sr.Trace.from_samples(samples), sr.parse_specification(CROWD)

    def all_centres(_: object) -> None:
        for number in range(100):
            now = places + number * steps
            np.hypot(*(now[:, None] - now[None]).transpose(2, 0, 1))

    centres = bench.measure("all centres by numpy alone", all_centres, per=100, unit="sample", runs=11)
    sr.evaluate(specification, replace(trace))
    bench.measure(
        "evaluated",
        lambda fresh: sr.evaluate(specification, fresh),
        prepare=lambda: replace(trace),
        per=len(trace),
        unit="sample",
        runs=11,
        limit_s=0.001,
        reference_s=centres.median_s,
    )

    def monitored(_: object) -> None:
        monitor = sr.Monitor(specification)
        for sample in samples:
            monitor.update(sample)

    monitored(None)
    bench.measure(
        "monitored",
        monitored,
        per=len(samples),
        unit="sample",
        runs=5,
        limit_s=0.001,
        reference_s=centres.median_s,
    )
