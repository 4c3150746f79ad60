"""The recorder in a loop: what is written stays, whatever happens to the process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader

import spatial_replay as sr
from replay.runs import PAST, SPECIFICATION, content_of, run, sample
from spatial_replay import (
    Footprint,
    GeometryError,
    OutputError,
    Recorder,
    Sample,
    TraceError,
    TrackedObject,
    UsageError,
    parse_specification,
    read_trace,
)
from spatial_replay.logs.topics import ENDING
from spatial_replay.replay.engine import load_files, run_replay
from spatial_replay.sources import open_source
from spatial_replay.spec import format_specification

SPEC = parse_specification(SPECIFICATION, filename="blocks.spatial")


def _ending(path: Path) -> dict[str, str]:
    return dict(content_of(path).metadata)[ENDING]


def test_samples_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, specifications=[SPEC], about={"seed": "7"}) as recorder:
        for index in range(12):
            recorder.write(sample(index))
    assert read_trace(path) == run(12)
    content = content_of(path)
    assert content.topics() == {
        "/spatial/automaton",
        "/spatial/events",
        "/spatial/frame",
        "/spatial/log",
        "/spatial/objects",
        "/spatial/recent_events",
        "/spatial/robustness",
        "/spatial/scene",
        "/spatial/specification",
        "/spatial/standing",
    }
    assert ("recorded/blocks.spatial", SPECIFICATION.encode()) in content.attachments
    assert content.metadata[0][0] == "spatial_replay"
    assert content.metadata[0][1]["seed"] == "7"
    assert _ending(path) == {"samples": "12", "dropped": "0", "interrupted": "false"}


def test_an_error_in_the_loop_closes_the_log_and_marks_it_as_interrupted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(ZeroDivisionError), Recorder(path) as recorder:
        recorder.write(sample(0))
        recorder.write(sample(1))
        raise ZeroDivisionError
    assert len(read_trace(path)) == 2
    assert _ending(path)["interrupted"] == "true"


def test_times_must_increase(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.write(sample(3))
        for late in (3, 2):
            with pytest.raises(TraceError, match="give times that increase"):
                recorder.write(sample(late))
        recorder.write(sample(4))
    assert len(read_trace(path)) == 2


def test_a_closed_recorder_refuses_samples_and_closes_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap")
    recorder.close()
    recorder.close()
    with pytest.raises(UsageError, match=r"run\.mcap is closed"):
        recorder.write(sample(0))


@pytest.mark.parametrize("waiting", [1, 2, 3000])
def test_a_loop_that_may_wait_loses_no_sample(tmp_path: Path, waiting: int) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, specifications=[SPEC], waiting=waiting) as recorder:
        for index in range(60):
            recorder.write(sample(index))
    assert (read_trace(path), recorder.dropped) == (run(60), 0)


def test_a_loop_that_may_not_wait_drops_samples_and_counts_them(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, specifications=[SPEC], waiting=1, block=False) as recorder:
        for index in range(3000):
            recorder.write(sample(index))
    kept = len(read_trace(path))
    assert kept + recorder.dropped == 3000
    assert _ending(path) == {"samples": str(kept), "dropped": str(recorder.dropped), "interrupted": "false"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"waiting": 0}, "waiting is 0"),
        (
            {"specifications": "safety.spatial"},
            r"'safety\.spatial'; give a Specification, from .*load_specification",
        ),
        ({"specifications": [parse_specification("spec s(ego) = F ego ovlp a")]}, "is a template"),
    ],
)
def test_invalid_options_leave_the_file_untouched(tmp_path: Path, options: dict[str, int], said: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"before")
    with pytest.raises(UsageError, match=said):
        Recorder(path, **options)  # type: ignore[arg-type]
    assert path.read_bytes() == b"before"


def test_a_full_disk_is_raised_in_the_loop() -> None:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    with pytest.raises(OutputError, match="no space left on the device"), Recorder("/dev/full") as recorder:
        for index in range(10**6):
            recorder.write(sample(index))


def test_a_name_that_no_log_can_hold_is_refused_alone(tmp_path: Path) -> None:
    box = Footprint.box(0, 0, 1, 1)
    for index, bad in enumerate(({"objects": {"\ud800": box}}, {"signals": {"\udfff": 1.0}})):
        path = tmp_path / f"run{index}.mcap"
        with Recorder(path) as recorder:
            recorder.write(sample(0))
            with pytest.raises(TraceError, match="lone surrogate"):
                recorder.write(Sample(5, **bad))
            with pytest.raises(GeometryError, match="lone surrogate"):
                TrackedObject(box, class_name="\ud83d")
            recorder.write(sample(1))
        assert read_trace(path) == run(2)
        assert _ending(path)["interrupted"] == "false"


def test_a_log_is_finished_whatever_goes_wrong_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    broken = sample(3)
    # as no constructor lets it be
    object.__setattr__(broken, "objects", {"a": None})
    with (
        pytest.raises(OutputError, match=r"run\.mcap ends here: .*AttributeError"),
        Recorder(path) as recorder,
    ):
        for index in range(3):
            recorder.write(sample(index))
        recorder.write(broken)
        recorder.write(sample(4))
    assert read_trace(path) == run(3)
    assert _ending(path) == {"samples": "3", "dropped": "0", "interrupted": "true", "failed": "true"}


def test_a_second_recorder_of_a_log_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.write(sample(0))
        with pytest.raises(OutputError, match="is being written by another recorder"):
            Recorder(path)
        recorder.write(sample(1))
    with pytest.raises(UsageError, match=r"run\.mcap exists already; give another name, or .*overwrite=True"):
        Recorder(path)
    assert read_trace(path) == run(2)
    Recorder(path, overwrite=True).close()
    assert len(open_source(path).metadata()) > 1
    with pytest.raises(UsageError, match=r"run\.jsonl: the output is a log .*name it run\.mcap"):
        Recorder(tmp_path / "run.jsonl")


def test_one_specification_needs_no_list(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", specifications=SPEC) as recorder:
        recorder.write(sample(0))
    attachments = content_of(tmp_path / "run.mcap").attachments
    assert ("recorded/blocks.spatial", SPECIFICATION.encode()) in attachments


def test_anything_but_a_sample_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder, pytest.raises(UsageError, match="3 is not a sample"):
        recorder.write(3)  # type: ignore[arg-type]


def test_metadata_is_written_before_the_first_sample(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, specifications=SPEC):
        begun = path.read_bytes()
    assert SPECIFICATION.encode() in begun


_CLOSING = """
import os, signal, threading, time
from spatial_replay import Footprint, Recorder, Sample, parse_specification
spec = parse_specification("G (cube dist cube >= 0) & F (cube ovlp cube)")
recorder = Recorder("run.mcap", specifications=spec)
for index in range(3000):
    recorder.write(Sample(index, {"cube": Footprint.box(0, 0, 1, 1)}))
interrupt = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
try:
    interrupt.start()
    recorder.close()
    # where closing was faster than the interruption
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted", flush=True)
recorder.close()
"""


def test_closing_is_not_interrupted(tmp_path: Path) -> None:
    # a process of its own: the interruption must not reach the one that runs the tests
    ended = subprocess.run(
        [sys.executable, "-c", _CLOSING],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    assert (ended.stdout, ended.stderr) == ("interrupted\n", "")
    path = tmp_path / "run.mcap"
    assert len(read_trace(path)) == 3000
    assert _ending(path) == {"samples": "3000", "dropped": "0", "interrupted": "false"}


def test_a_handler_for_sigterm_of_the_program_stays(tmp_path: Path) -> None:
    came: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        with Recorder(tmp_path / "run.mcap"):
            signal.raise_signal(signal.SIGTERM)
        assert came == [signal.SIGTERM]
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with Recorder(tmp_path / "run.mcap", overwrite=True):
            assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


_LOOP = """
import sys, time
from spatial_replay import Footprint, Recorder, Sample, parse_specification
spec = parse_specification("G (cube dist cube >= 0) & F (cube ovlp cube)")
with Recorder("run.mcap", specifications=spec) as recorder:
    while True:
        now_ns = time.monotonic_ns()
        recorder.write(Sample(now_ns, {"cube": Footprint.box(0, 0, 1, 1)}))
        print(now_ns, flush=True)
        time.sleep(0.01)
"""


def _loop(folder: Path) -> subprocess.Popen[str]:
    """A process that records a cube until it is ended, and says what it has written."""
    return subprocess.Popen(
        [sys.executable, "-c", _LOOP],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_terminated_process_leaves_a_complete_log(tmp_path: Path, number: signal.Signals) -> None:
    with _loop(tmp_path) as process:
        assert process.stdout is not None
        for _ in range(20):
            process.stdout.readline()
        process.send_signal(number)
        process.communicate(timeout=300)
    assert process.returncode == (143 if number == signal.SIGTERM else -signal.SIGINT)
    path = tmp_path / "run.mcap"
    count = len(read_trace(path))
    assert count >= 20
    assert _ending(path) == {"samples": str(count), "dropped": "0", "interrupted": "true"}


def test_samples_older_than_a_second_survive_a_kill(tmp_path: Path) -> None:
    with _loop(tmp_path) as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline())]
        while written[-1] - written[0] < 2 * 10**9:
            written.append(int(process.stdout.readline()))
        killed_ns = time.monotonic_ns()
        process.kill()
        process.communicate(timeout=300)
    safe = {time_ns for time_ns in written if time_ns < killed_ns - 10**9}
    assert safe
    path = tmp_path / "run.mcap"
    assert safe <= set(read_trace(path, allow_damage=True).times_ns.tolist())
    found = set()
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, Message):
                    found.add(record.log_time)
        except EndOfFile:
            # where the file breaks off
            pass
    assert safe <= found


_BUSY = """
import time
from spatial_replay import Footprint, Recorder, Sample, parse_specification
crowd = {f"p{k}": Footprint.box(2 * k, 0, 2 * k + 1, 1) for k in range(24)}
spec = parse_specification("G (forall x, y in all: x dist y >= 0.5)")
with Recorder("run.mcap", specifications=spec) as recorder:
    while True:
        now_ns = time.monotonic_ns()
        recorder.write(Sample(now_ns, crowd))
        print(now_ns, flush=True)
        time.sleep(0.001)
"""


def test_a_kill_costs_no_second_even_where_the_evaluation_cannot_keep_up(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _BUSY],
        cwd=tmp_path,
        # as slow as a machine that is very busy
        env={**os.environ, "SPATIAL_REPLAY_KERNELS": "interpreted"},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline())]
        while written[-1] - written[0] < 3 * 10**9:
            written.append(int(process.stdout.readline()))
        process.kill()
        written += [int(line) for line in process.communicate(timeout=300)[0].splitlines()]
    path = tmp_path / "run.mcap"
    read = read_trace(path, allow_damage=True).times_ns.tolist()
    assert read == written[: len(read)]
    assert written[-1] - read[-1] < 10**9


def test_the_disk_has_each_chunk_if_asked(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, durability="disk") as recorder:
        for index in range(30):
            recorder.write(sample(index))
    assert read_trace(path) == run(30)
    with pytest.raises(UsageError, match="durability is 'paper'; give 'process' or 'disk'"):
        Recorder(path, durability="paper")  # type: ignore[arg-type]


def test_metadata_is_text(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", specifications=[SPEC, parse_specification("F cube ovlp cube")]):
        pass
    about = dict(content_of(tmp_path / "run.mcap").metadata)["spatial_replay"]
    kept = json.loads(about["specifications"])
    assert [each["name"] for each in kept] == ["blocks.spatial", "text.spatial"]
    canonical = [format_specification(SPEC), format_specification(parse_specification("F cube ovlp cube"))]
    assert [each["sha256"] for each in kept] == [sha256(text.encode()).hexdigest() for text in canonical]
    assert json.loads(about["options"]) == {}


@pytest.mark.parametrize("count", [0, 1, 12])
def test_a_replay_of_a_recording_has_its_certificate(tmp_path: Path, count: int) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, specifications=[SPEC, parse_specification(PAST)]) as recorder:
        for index in range(count):
            recorder.write(sample(index))
    last, certificate = content_of(path).metadata[-1]
    assert last == "spatial_replay_certificate"
    if count:
        source = open_source(path)
        assert run_replay(source, load_files([], source)).certificate == certificate


def test_a_forked_process_leaves_the_log_of_its_parent_alone(tmp_path: Path) -> None:
    code = """
import os, sys
import spatial_replay as sr

box = {"a": sr.Footprint.box(0, 0, 1, 1)}
with sr.Recorder(sys.argv[1]) as recorder:
    words = recorder.channel("/words")
    for number in range(200):
        recorder.write(sr.Sample(number, box))
    child = os.fork()
    if not child:
        for write in (lambda: recorder.write(sr.Sample(999, box)), lambda: words.write(999, {})):
            try:
                write()
            except sr.UsageError as error:
                print(error, flush=True)
        recorder.close()
        sys.exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    for number in range(200, 400):
        recorder.write(sr.Sample(number, box))
"""
    log = tmp_path / "run.mcap"
    done = subprocess.run(
        [sys.executable, "-c", code, str(log)], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("run.mcap belongs to another process; open a recorder in this one") == 2
    trace = sr.read_trace(log)
    assert (len(trace), trace.faults) == (400, ())
