"""Times of a monitor and a recorder within a loop, and other online monitors for comparison."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import spatial_replay as sr

MILLION = 1_000_000
SHORT = 100_000
STRETCH = 10_000
"""Number of samples per median or quantile."""


def _blocks() -> tuple[sr.Specification, list[sr.Sample]] | None:
    """Return the block-pushing specification with 27 nodes, and its camera recording of six objects."""
    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        return None
    text = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    samples = list(sr.read_trace(data / "blocks_moving_passage.jsonl.gz").samples())
    return sr.parse_specification(text), samples


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def bench_monitor(bench: Any) -> None:
    """`Monitor.update` from the first samples to the last of a long run."""
    blocks = _blocks()
    if blocks is None:
        return
    specification, samples = blocks
    count = MILLION if bench.full else SHORT
    monitor = sr.Monitor(specification)
    times = array("d", bytes(8 * count))
    resident = 0
    for k in range(count):
        sample = sr.Sample(k * 33_333_333, samples[k % len(samples)].objects)
        if k == 10:
            resident = _resident_bytes()
        start = time.perf_counter()
        monitor.update(sample)
        times[k] = time.perf_counter() - start
    grown = _resident_bytes() - resident
    pauses = sorted(_nothing_for(sorted(times[10:STRETCH])[STRETCH // 2]))
    is_quiet = pauses[int(len(pauses) * 0.999)] < 1e-3
    if not is_quiet:
        bench.remark("the machine is busy: doing nothing takes over 1 ms for one turn in 1000, too")
    starts = {10, SHORT - STRETCH, count - STRETCH}
    for start_at in sorted(starts):
        stretch = times[start_at : start_at + STRETCH]
        bench.quantile(f"from sample {start_at:,}: median", stretch, 0.5, limit_s=12e-6)
        bench.quantile(
            f"from sample {start_at:,}: 99.9 %", stretch, 0.999, limit_s=1e-3 if is_quiet else None
        )
    bench.quantile("doing nothing: 99.9 %", pauses, 0.999)
    passes = _passes_over_outlines(samples)
    bench.quantile("numpy over the same outlines", passes, 0.5)
    bench.ratio("median, to numpy's", _median(times[10:STRETCH]) / _median(passes), 4.0)
    bench.size(f"grown over {count:,} samples", grown, 5_000_000)

    def read_all(update: Any) -> object:
        return [
            (node.value, node.now, node.lower, node.upper, node.verdict) for node in update.specs[0].nodes
        ]

    after = iter(range(count, count + 100))
    bench.measure(
        "reading 27 nodes one by one",
        read_all,
        prepare=lambda: monitor.update(sr.Sample(next(after) * 33_333_333, samples[0].objects)),
        unit="sample",
        runs=51,
    )


def bench_update(bench: Any) -> None:
    """`Monitor.update` with one atom over a signal, and with the 27 nodes of block pushing."""
    signal = [sr.Sample(k * 1_000_000, signals={"p": math.sin(0.7 * k)}) for k in range(10_000)]
    cases = {"one atom": (sr.parse_specification("H[0,10] p >= 0"), signal)}
    if (blocks := _blocks()) is not None:
        specification, recorded = blocks
        cases["27 nodes"] = (
            specification,
            [sr.Sample(k * 33_333_333, recorded[k % len(recorded)].objects) for k in range(10_000)],
        )
    turn = 250
    for name, (specification, samples) in cases.items():
        monitor = sr.Monitor(specification, wait=True)
        turns = iter([samples[begin : begin + turn] for begin in range(0, len(samples), turn)])
        bench.measure(
            name,
            lambda some, monitor=monitor: [monitor.update(sample) for sample in some],
            prepare=lambda turns=turns: next(turns),
            per=turn,
            unit="sample",
            runs=len(samples) // turn - 4,
            warmups=4,
        )


_CROWD = """\
group people = class "person"
spec apart = G (forall p in people: p dist robot >= 0.5)
"""


_FIRST_START = """
import time
import spatial_replay as sr
begin = time.process_time()
monitor = sr.Monitor(sr.parse_specification("G (a dist b >= 0.1 -> F[0, 50] p >= 0)"))
print(time.process_time() - begin)
"""


def bench_first_start(bench: Any) -> None:
    """The first `Monitor` on a machine: processor time of its process before the first sample."""
    # a child process may still write into the folder
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
        spent_s = subprocess.run(
            [sys.executable, "-c", _FIRST_START],
            env=os.environ | {"SPATIAL_REPLAY_CACHE": cache},
            stdout=subprocess.PIPE,
            check=True,
        ).stdout
    bench.quantile("ready", [float(spent_s)], 0.5, unit="start", limit_s=0.7)


def bench_monitor_shapes(bench: Any) -> None:
    """Costs besides the update: building shapes and samples, and many known and unknown objects."""
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.3), (0.3, 0.3), (0.3, 1.0), (0.0, 1.0)]
    makers: dict[str, Callable[[], object]] = {
        "a box": lambda: sr.Footprint.box(0.0, 0.0, 1.0, 1.0),
        "a disc": lambda: sr.Footprint.disc(0.0, 0.0, 0.3),
        "an L, split in two": lambda: sr.Footprint.polygon(corners),
        "an object of it": lambda: sr.TrackedObject(box, height=(0.0, 1.0), yaw=0.3),
    }
    box = sr.Footprint.box(0.0, 0.0, 1.0, 1.0)
    for name, make in makers.items():
        count = 300
        bench.measure(
            name, lambda _, make=make, count=count: [make() for _ in range(count)], per=count, unit="object"
        )
    people = {f"p{k}": _person(1.0 + k % 20, k // 20) for k in range(200)}
    robot = {"robot": sr.TrackedObject(sr.Footprint.disc(0.0, 0.0, 0.3))}
    moments = iter(range(10**9))

    def sample(objects: Any, unknown: Any) -> sr.Sample:
        return sr.Sample(next(moments) * 1_000_000, objects, unknown=unknown)

    monitor = sr.Monitor(sr.parse_specification(_CROWD))
    for name, known, unknown in (
        ("six people", dict(list(people.items())[:6]), {}),
        ("200 people", people, {}),
        ("200 people, one of them unknown", people, {"unseen": "person"}),
    ):
        bench.measure(
            name,
            lambda given: [monitor.update(each) for each in given],
            prepare=lambda known=known, unknown=unknown: [
                sample({**known, **robot}, unknown) for _ in range(20)
            ],
            per=20,
            unit="sample",
            runs=21,
        )


def _person(x: float, y: float) -> sr.TrackedObject:
    return sr.TrackedObject(sr.Footprint.disc(3.0 * x, 3.0 * y, 0.3), class_name="person")


def _median(times: Sequence[float]) -> float:
    return sorted(times)[len(times) // 2]


def _passes_over_outlines(samples: list[sr.Sample]) -> list[float]:
    """Return times of numpy for joining the outlines of a sample's objects and taking a minimum."""
    outlines = [
        [part.vertices for each in sample.objects.values() for part in each.footprint.parts]
        for sample in samples
    ]
    times = []
    for k in range(STRETCH):
        of_sample = outlines[k % len(outlines)]
        start = time.perf_counter()
        np.concatenate(of_sample).min()
        times.append(time.perf_counter() - start)
    return times


def _nothing_for(duration_s: float) -> list[float]:
    """Return times of turns that only wait: the delay that the machine adds to any turn."""
    times = []
    for _ in range(STRETCH):
        start = now = time.perf_counter()
        while now < start + duration_s:
            now = time.perf_counter()
        times.append(now - start)
    return times


def bench_recorder(bench: Any) -> None:
    """`Recorder.write` in a loop: samples, scene and robustness are written by another thread."""
    blocks = _blocks()
    if blocks is None:
        return
    specification, samples = blocks
    monitor = sr.Monitor(specification)
    seconds = 10 if bench.full else 3
    for name, hertz, count, live in (
        ("30 Hz", 30, 30 * seconds, None),
        ("1 kHz", 1000, 1000 * seconds, None),
        ("1 kHz, with a monitor", 1000, 1000 * seconds, monitor),
        ("flat out", None, 10_000, None),
    ):
        given = [sr.Sample(k * 1_000_000, samples[k % len(samples)].objects) for k in range(count)]
        with tempfile.TemporaryDirectory() as folder:
            times, delays = _recorded(Path(folder) / "run.mcap", specification, given, hertz, live)
        bench.quantile(f"{name}: median", times, 0.5, limit_s=100e-6)
        bench.quantile(f"{name}: 99.9 %", times, 0.999)
        if delays:
            bench.quantile(f"{name}: loop late, 99 %", delays, 0.99)


def _recorded(
    path: Path,
    specification: sr.Specification,
    samples: list[sr.Sample],
    hertz: float | None,
    monitor: sr.Monitor | None,
) -> tuple[list[float], list[float]]:
    """Return the time that each sample cost the loop, and the delay of each turn of the loop."""
    times, delays = [], []
    with sr.Recorder(path, specifications=specification, overwrite=True) as recorder:
        begun = time.perf_counter()
        for k, sample in enumerate(samples):
            if hertz is not None:
                due = begun + k / hertz
                time.sleep(max(0.0, due - time.perf_counter()))
                delays.append(time.perf_counter() - due)
            start = time.perf_counter()
            if monitor is not None:
                monitor.update(sample)
            recorder.write(sample)
            times.append(time.perf_counter() - start)
    return times, delays


def bench_online_peers(bench: Any) -> None:
    """Our monitor against others on the minimum of a signal over a window; all give equal values."""
    values = random.Random(0)
    signal = [values.uniform(-1, 5) for _ in range(5000)]
    # short turns, so that few of them are interrupted
    turn = 250

    def turns(name: str, step: Callable[[int, float], object], limit_s: float | None = None) -> float:
        """Measure steps; each turn goes on where the one before has ended. Return what one takes at least."""
        begins = iter(range(0, len(signal), turn))

        def run(_: object) -> object:
            begin = next(begins)
            return [step(k, signal[k]) for k in range(begin, begin + turn)]

        runs = len(signal) // turn
        found = bench.measure(name, run, per=turn, unit="sample", runs=runs, warmups=0, limit_s=limit_s)
        return float(found.fastest_s)

    made_s = turns("making samples", lambda k, value: sr.Sample(k, signals={"p": value}))
    for window in (10, 1000):
        ours = _least_over(window, signal)
        expected = [ours(k, value) for k, value in enumerate(signal)]
        limit_s = 6e-6 if window == 10 else None
        own_s = turns(f"H over {window}: spatial-replay", _least_over(window, signal), limit_s)
        bench.ratio(f"H over {window}, fastest, to making samples", own_s / made_s, 3.0)
        for name, monitor_of in (("rtamt", _rtamt), ("reelay", _reelay)):
            if importlib.util.find_spec(name) is None:
                continue
            step = monitor_of(window)
            if [step(k, value) for k, value in enumerate(signal)] != expected:
                raise RuntimeError(f"{name} does not give the same values for a window of {window}")
            turns(f"H over {window}: {name}", monitor_of(window))
    for name in ("rtamt", "reelay"):
        if importlib.util.find_spec(name) is None:
            bench.remark(f"{name} is not installed, and not measured")


def _least_over(window: int, signal: Sequence[float]) -> Callable[[int, float], float]:
    monitor = sr.Monitor(sr.parse_specification(f"H[0,{window}] p >= 0"))
    samples = [sr.Sample(k, signals={"p": value}) for k, value in enumerate(signal)]
    return lambda k, value: float(monitor.update(samples[k]).specs[0].numbers[0, 1])


def _rtamt(window: int) -> Callable[[int, float], float]:
    import rtamt

    monitor = rtamt.StlDiscreteTimeSpecification()
    monitor.declare_var("p", "float")
    monitor.spec = f"historically[0:{window}](p >= 0)"
    monitor.parse()
    return lambda k, value: monitor.update(k, [("p", value)])


def _reelay(window: int) -> Callable[[int, float], float]:
    import reelay

    monitor = reelay.discrete_timed_monitor(
        pattern=f"historically[0:{window}]{{p >= 0}}", semantics="robustness", condense=False
    )
    return lambda k, value: monitor.update({"p": value})["value"]
