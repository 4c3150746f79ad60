"""Recorders that are killed: whatever was written more than a second before has to be in the log."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import random
import signal
import struct
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

import spatial_replay as sr
from attacks.cases import Case, Outcome

MOST_LOST_S = 1.0
RATES_HZ = (30, 100, 250, 500, 1000)
SPECIFICATION = "spec near = G (a dist b <= 50) and F (a leftof b)"
_TIMES = struct.Struct("<qq")
_ROOM = 8 * 20_000


class Kills:
    """A recorder in a process of its own, at up to 1 kHz, killed at a random moment while others compute."""

    name = "kills"
    most_cpu_s = None

    def ready(self) -> None:
        # a process that is forked finds all code loaded
        from spatial_replay.recording.recorder import warm_up
        from spatial_replay.sources.recover import recover_log

        assert recover_log
        recording = sr.parse_specification(SPECIFICATION)
        with sr.Recorder(os.devnull, specifications=[recording]):
            warm_up([], [])

    def draw(self, rng: random.Random) -> Case:
        return {
            "rate_hz": rng.choice(RATES_HZ),
            "objects": rng.choice((2, 2, 5, 20)),
            "specified": rng.random() < 0.6,
            "beside": rng.random() < 0.3,
            "seconds": round(rng.uniform(0.2, 3.0), 3),
            "busy": rng.choice((0, 1, 2)),
        }

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        path = folder / "run.mcap"
        fork = multiprocessing.get_context("fork")
        busy = [fork.Process(target=_compute, daemon=True) for _ in range(case["busy"])]
        with mmap.mmap(-1, _TIMES.size + _ROOM) as shared:
            recorder = fork.Process(target=_record, args=(path, case, shared), daemon=True)
            for each in (*busy, recorder):
                each.start()
            try:
                _wait_for_samples(recorder, shared, case["seconds"])
                killed_ns = time.monotonic_ns()
                recorder.kill()
                recorder.join()
            finally:
                for each in (*busy, recorder):
                    with suppress(ProcessLookupError):
                        each.kill()
                    each.join()
            count = _TIMES.unpack_from(shared)[0]
            written = np.frombuffer(bytes(shared[_TIMES.size : _TIMES.size + 8 * count]), "<i8")
        return _outcome(path, folder, written, killed_ns)


def _wait_for_samples(recorder: multiprocessing.Process, shared: mmap.mmap, seconds: float) -> None:  # type: ignore[name-defined]
    while not _TIMES.unpack_from(shared)[0] and recorder.is_alive():
        time.sleep(0.005)
    time.sleep(seconds)


def _outcome(path: Path, folder: Path, written: np.ndarray, killed_ns: int) -> Outcome:  # type: ignore[type-arg]
    from spatial_replay.sources.recover import recover_log

    outcome = Outcome(counts={"samples": len(written)})
    try:
        found = sr.read_trace(path, allow_damage=True).times_ns
        recovery = recover_log(path, folder / "recovered.mcap")
    except sr.LogError as error:
        # before the first flush there may be nothing to read
        found, recovery = np.zeros(0, np.int64), None
        if len(written) and killed_ns - written[0] > MOST_LOST_S * 1e9:
            outcome.problems.append(f"nothing can be read: {error}")
    lost = np.setdiff1d(written, found)
    late_s = (killed_ns - int(lost[0])) / 1e9 if len(lost) else 0.0
    outcome.worst = {"lost_s": late_s, "lost_samples": len(lost)}
    if late_s > MOST_LOST_S:
        outcome.counts["over"] = 1
        outcome.problems.append(f"{len(lost)} samples are lost, the first {late_s:.2f} s before the kill")
    if recovery is not None:
        recovered = sr.read_trace(folder / "recovered.mcap")
        if not np.array_equal(recovered.times_ns, found):
            outcome.problems.append(f"{len(found)} samples can be read, and {len(recovered)} are recovered")
    return outcome


def _record(path: Path, case: Case, shared: mmap.mmap) -> None:
    """Write samples at a rate until killed; each time is in the shared memory once it was written."""
    specifications = [sr.parse_specification(SPECIFICATION)] if case["specified"] else []
    boxes = [sr.Footprint.box(x, 0, x + 1, 1) for x in range(case["objects"])]
    names = ["a", "b", *(f"object{index}" for index in range(2, case["objects"]))]
    objects = dict(zip(names, boxes, strict=True))
    step_ns = 10**9 // case["rate_hz"]
    count = 0
    with sr.Recorder(path, specifications=specifications) as recorder:
        beside = recorder.channel("/joints") if case["beside"] else None
        due_ns = time.monotonic_ns()
        while count * 8 < _ROOM:
            now_ns = time.monotonic_ns()
            if now_ns < due_ns:
                time.sleep((due_ns - now_ns) / 1e9)
                now_ns = time.monotonic_ns()
            recorder.write(sr.Sample(now_ns, objects))
            if beside is not None:
                beside.write(now_ns, {"position": [0.1, 0.2]})
            struct.pack_into("<q", shared, _TIMES.size + 8 * count, now_ns)
            count += 1
            struct.pack_into("<q", shared, 0, count)
            due_ns += step_ns
        signal.pause()


def _compute() -> None:
    while True:
        sum(range(10_000))
