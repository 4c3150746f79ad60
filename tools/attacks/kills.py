"""Killed recorders: less than the last second of their samples may be missing in the log."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import random
import signal
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

import spatial_replay as sr
from attacks.cases import Case, Outcome, memory_bytes
from spatial_replay.geometry.arrays import Integers

MOST_LOST_S = 1.0
RATES_HZ = (30, 100, 250, 500, 1000)
SPECIFICATION = "spec near = G (a dist b <= 50) and F (a leftof b)"
_COUNT, _WRITTEN = struct.Struct("<q"), struct.Struct("<qq")
PATIENCE_S = 60.0
"""How long the first sample of a recorder is waited for."""
AT_ONCE = 4
"""Recorders that are killed together: each is a load for the others."""
_MOST_SAMPLES = 20_000
_FORK = multiprocessing.get_context("fork")


class Kills:
    """A recorder in its own process, at up to 1 kHz, killed at a random moment on a busy machine."""

    name = "kills"
    most_cpu_s = None
    uses_files = True

    def ready(self) -> None:
        # a process that is forked finds all code loaded: a recorder records some samples when it begins
        from spatial_replay.sources.recover import recover_log

        assert recover_log
        with sr.Recorder(os.devnull, specifications=sr.parse_specification(SPECIFICATION)):
            pass

    def draw(self, rng: random.Random) -> Case:
        recorders = [
            {
                "rate_hz": rng.choice(RATES_HZ),
                "objects": rng.choice((2, 2, 5, 20)),
                "specified": rng.random() < 0.6,
                "beside": rng.random() < 0.3,
            }
            for _ in range(AT_ONCE)
        ]
        seconds, busy = round(rng.uniform(0.2, 2.5), 3), rng.choice((0, 0, 1))
        return {"recorders": recorders, "seconds": seconds, "busy": busy}

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        busy = [_FORK.Process(target=_compute, daemon=True) for _ in range(case["busy"])]
        runs = [_Run(folder / str(number), each) for number, each in enumerate(case["recorders"])]
        processes = [_FORK.Process(target=_record, args=(run,), daemon=True) for run in runs]
        for each in (*busy, *processes):
            each.start()
        try:
            begun_s = time.monotonic()
            while any(not run.count for run in runs) and time.monotonic() - begun_s < PATIENCE_S:
                time.sleep(0.005)
            time.sleep(max(0.0, case["seconds"] - 1.0))
            before = [_queueing_ns(process.pid) for process in processes]
            time.sleep(min(1.0, case["seconds"]))
            for run, process, earlier in zip(runs, processes, before, strict=True):
                later = _queueing_ns(process.pid)
                run.queued_s = max((later[task] - earlier.get(task, 0)) / 1e9 for task in later)
                run.memory_bytes = memory_bytes(process.pid)
                run.killed_ns = time.monotonic_ns()
                process.kill()
        finally:
            for each in (*busy, *processes):
                with suppress(ProcessLookupError):
                    each.kill()
                each.join()
        begun = [run for run in runs if run.count]
        outcome = Outcome(counts={"kills": len(begun), "not begun": len(runs) - len(begun)})
        for own in _in_fork(lambda: [_outcome(run) for run in begun]):
            outcome.take_in(own)
            outcome.problems += own.problems
        for run in runs:
            run.shared.close()
        return outcome


class _Run:
    """A recorder, and shared memory with the time of each sample and the time of its `write`."""

    def __init__(self, folder: Path, about: Case) -> None:
        folder.mkdir()
        self.folder, self.about = folder, about
        self.shared = mmap.mmap(-1, _COUNT.size + _MOST_SAMPLES * _WRITTEN.size)
        self.killed_ns = self.memory_bytes = 0
        self.queued_s = 0.0

    @property
    def count(self) -> int:
        return int(_COUNT.unpack_from(self.shared)[0])

    def add(self, number: int, time_ns: int) -> None:
        # a sample is the recorder's own once `write` has returned, which may have had to wait
        place = _COUNT.size + _WRITTEN.size * number
        _WRITTEN.pack_into(self.shared, place, time_ns, time.monotonic_ns())
        _COUNT.pack_into(self.shared, 0, number + 1)

    def written(self) -> Integers:
        """Return the time of each sample, and the time of its `write`."""
        end = _COUNT.size + _WRITTEN.size * self.count
        return np.frombuffer(bytes(self.shared[_COUNT.size : end]), "<i8").reshape(-1, 2)


def _queueing_ns(process: int | None) -> dict[str, int]:
    """Return the time that each thread of a process has waited for a processor, nanoseconds."""
    tasks = Path(f"/proc/{process}/task")
    return {task.name: int((task / "schedstat").read_text().split()[1]) for task in tasks.iterdir()}


def _in_fork(work: Callable[[], list[Outcome]]) -> list[Outcome]:
    """Return the findings of a forked process.

    Reading starts threads, and a process with threads cannot be forked safely. This process is forked again
    for the recorders of the next case, so it must not read.
    """
    ours, theirs = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=lambda: theirs.send(work()), daemon=True)
    process.start()
    theirs.close()
    try:
        return ours.recv()
    except EOFError:
        return [Outcome(["the process that reads the logs has died"])]
    finally:
        process.join()


def _outcome(run: _Run) -> Outcome:
    from spatial_replay.sources.recover import recover_log

    folder, written = run.folder, run.written()
    path = folder / "run.mcap"
    outcome = Outcome(counts={"samples": len(written)})
    recovery = None
    try:
        found = sr.read_trace(path, allow_damage=True).times_ns
        recovery = recover_log(path, folder / "recovered.mcap")
    except sr.LogError:
        # before the first flush there may be nothing to read
        found = np.zeros(0, np.int64)
    lost_ns = written[~np.isin(written[:, 0], found), 1]
    # while `write` waits nothing is recorded, so that what is lost does not grow
    lost_s = (int(lost_ns[-1]) - int(lost_ns[0])) / 1e9 if len(lost_ns) else 0.0
    age_s = (run.killed_ns - int(lost_ns[0])) / 1e9 if len(lost_ns) else 0.0
    held = max(run.memory_bytes, memory_bytes())
    outcome.worst = {
        "lost_s": lost_s,
        "lost_samples": len(lost_ns),
        "age_s": age_s,
        "memory_mb": held / 1e6,
        "queued_s": run.queued_s,
    }
    outcome.counts["older than 1 s"] = int(age_s > MOST_LOST_S)
    if lost_s > MOST_LOST_S:
        outcome.problems.append(
            f"{len(lost_ns)} samples of {lost_s:.2f} s are lost; a thread of the recorder had waited"
            f" {run.queued_s:.2f} s for a processor in the last second"
        )
    if recovery is not None:
        recovered = sr.read_trace(folder / "recovered.mcap")
        if not np.array_equal(recovered.times_ns, found):
            outcome.problems.append(f"{len(found)} samples can be read, and {len(recovered)} are recovered")
    return outcome


def _record(run: _Run) -> None:
    """Write samples at a rate until killed; store the time of each written sample in the shared memory."""
    about = run.about
    specifications = [sr.parse_specification(SPECIFICATION)] if about["specified"] else []
    boxes = [sr.Footprint.box(x, 0, x + 1, 1) for x in range(about["objects"])]
    names = ["a", "b", *(f"object{index}" for index in range(2, about["objects"]))]
    objects = dict(zip(names, boxes, strict=True))
    step_ns = 10**9 // about["rate_hz"]
    with sr.Recorder(run.folder / "run.mcap", specifications=specifications) as recorder:
        beside = recorder.channel("/joints") if about["beside"] else None
        due_ns = time.monotonic_ns()
        for number in range(_MOST_SAMPLES):
            now_ns = time.monotonic_ns()
            if now_ns < due_ns:
                time.sleep((due_ns - now_ns) / 1e9)
                now_ns = time.monotonic_ns()
            recorder.write(sr.Sample(now_ns, objects))
            if beside is not None:
                beside.write(now_ns, {"position": [0.1, 0.2]})
            run.add(number, now_ns)
            due_ns += step_ns
        signal.pause()


def _compute() -> None:
    # ends with the campaign, also if that is killed
    parent = os.getppid()
    while os.getppid() == parent:
        sum(range(10_000))
