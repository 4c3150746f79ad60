"""Workers that die, batches that are killed, and clusters."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

import spatial_replay as sr
from batch.dying import work
from batch.fleet import command, write_fleet
from cli.interruptions import interrupted
from cli.program import PROGRAM, environment
from spatial_replay.batch.workers import LocalProcesses, WorkerLost

LOGS = 20


def test_the_task_of_a_worker_that_dies_runs_once_more_and_no_other_is_lost(tmp_path: Path) -> None:
    kinds = ["fine"] * 6 + ["dies once"] + ["fine"] * 3 + ["dies"] + ["fine"] * 6
    tasks = [(kind, str(tmp_path / str(number))) for number, kind in enumerate(kinds)]
    results = list(LocalProcesses(2).results(work, tasks))
    assert sorted(task for task, _ in results) == sorted(tasks)
    for (kind, file), result in results:
        if kind == "dies":
            assert isinstance(result, WorkerLost)
            # by itself, and in the pool with others if that lived long enough
            assert Path(file).read_text() in ("begun\n", "begun\n" * 2)
        else:
            assert result == kind


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_fleet(tmp_path, [0.2 + 0.01 * number for number in range(LOGS)])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SPATIAL_REPLAY_KERNELS", "interpreted")
    return tmp_path


def keys_of(folder: Path) -> Counter[tuple[str, str]]:
    """How often each key and spec is stored."""
    from pyarrow import parquet

    tables = [parquet.read_table(file) for file in folder.glob("rows/*.parquet")]
    columns = [(table.column("key").to_pylist(), table.column("spec").to_pylist()) for table in tables]
    return Counter(pair for keys, specs in columns for pair in zip(keys, specs, strict=True))


def processes_in(folder: Path) -> list[int]:
    """The processes that work in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and (entry / "cwd").readlink() == folder:
                found.append(int(entry.name))
        except OSError:
            continue
    return [pid for pid in found if pid != os.getpid()]


def start() -> subprocess.Popen[str]:
    # no forkserver of an earlier run is there, so a kill may meet it at any stage
    arguments = ["batch", "logs", "--spec", "gate.spatial", "--jobs", "2"]
    return subprocess.Popen(
        [*PROGRAM, *arguments],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_batch_that_is_killed_loses_no_row_and_has_none_twice(fleet: Path) -> None:
    chance = random.Random(7)
    # as if a batch had been killed before it had written anything
    (fleet / "results").mkdir()
    (fleet / "results/.format.json.x.partial").touch()
    stored = 0
    for number in (signal.SIGINT, signal.SIGKILL):
        with start() as process:
            # at work: beyond the rows that were there before
            until = stored + chance.randrange(1, 3)
            while sum(keys_of_files(fleet)) < until and process.poll() is None:
                time.sleep(0.005)
            process.send_signal(number)
            _, said = process.communicate(timeout=60)
        assert process.returncode in (130, -signal.SIGKILL, 1), said
        if process.returncode == 130:
            assert "the same command continues from them" in said
        stored = sum(keys_of_files(fleet))
        assert stored >= 1
    deadline = time.monotonic() + 30
    while processes_in(fleet) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert processes_in(fleet) == []
    result = sr.evaluate_logs("logs", "gate.spatial", output="results")
    assert result.evaluated <= LOGS - 1
    pairs = Counter(zip(result.table["log"].to_pylist(), result.table["spec"].to_pylist(), strict=True))
    assert len(pairs) == 2 * LOGS
    assert set(pairs.values()) == {1}
    assert not result.table["error"].drop_null()
    stored_pairs = keys_of(fleet / "results")
    assert len(stored_pairs) == 2 * LOGS
    assert set(stored_pairs.values()) == {1}
    assert not list(fleet.glob("results/**/*.partial"))


@pytest.mark.parametrize("processes", [2, 4])
def test_ctrl_c_while_workers_start_prints_no_traceback(fleet: Path, processes: int) -> None:
    arguments = ["batch", "logs", "--spec", "gate.spatial", "--jobs", "3"]
    with subprocess.Popen(
        [*PROGRAM, *arguments],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        # as a terminal does it: to the first process, the server of workers, and those that are there so far
        while len(processes_in(fleet)) < processes and process.poll() is None:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in said) == (130, False), said


def test_a_log_that_ends_its_worker_takes_none_of_its_group_with_it(fleet: Path) -> None:
    # so many that a worker is given two at once
    shutil.rmtree("logs")
    write_fleet(fleet, [9.0 if number == 77 else 0.5 for number in range(140)])
    Path("cell.py").write_text(
        "import os\n"
        "def crowd(sample):\n"
        "    if sample.objects['person'].footprint.parts[0].vertices[:, 1].max() > 5:\n"
        "        os._exit(9)\n"
        "    return 1.0\n"
        "SIGNALS = {'crowd': crowd}\n"
    )
    Path("few.spatial").write_text("use cell\nspec few = G (crowd <= 3)\n")
    arguments = [
        "batch",
        "logs",
        "--spec",
        "few.spatial",
        "--plugin",
        "cell.py",
        "--jobs",
        "2",
        "--json",
        "-",
    ]
    # in a process of its own: the server of workers has what was allowed when it started
    reply = subprocess.run([*PROGRAM, *arguments], env=environment(), capture_output=True, text=True)
    rows = [json.loads(line) for line in reply.stdout.splitlines()]
    assert [row["log"] for row in rows if row["verdict"] is None] == ["logs/run-77.jsonl"]
    assert len(rows) == 140


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_sigterm_ends_a_batch_whose_workers_wait_for_ever(fleet: Path, jobs: str) -> None:
    os.mkfifo("never")
    Path("cell.py").write_text(
        "from pathlib import Path\n"
        "def crowd(sample):\n"
        "    Path('at_work').touch()\n"
        "    return float(Path('never').read_text())\n"
        "SIGNALS = {'crowd': crowd}\n"
    )
    Path("few.spatial").write_text("use cell\nspec few = G (crowd <= 3)\n")
    arguments = ["batch", "logs", "--spec", "few.spatial", "--plugin", "cell.py", "--jobs", jobs]
    code, said = interrupted([*PROGRAM, *arguments], signal.SIGTERM, fleet, Path("at_work").exists)
    assert (code, "the same command continues from them" in said) == (130, True), said


def test_a_pipe_is_the_error_of_its_log(fleet: Path) -> None:
    os.mkfifo("logs/pipe.jsonl")
    whole = command("batch", "logs", "--spec", "gate.spatial", "--jobs", "1")
    assert (whole.code, "not to be read: logs/pipe.jsonl" in whole.err) == (3, True), whole.err
    single = command("batch", "logs/pipe.jsonl", "--spec", "gate.spatial", "--jobs", "1")
    assert (single.code, "pipe.jsonl is no regular file" in single.out) == (3, True), single.err
    replayed = command("replay", "logs/pipe.jsonl", "--spec", "gate.spatial")
    assert (replayed.code, "pipe.jsonl is no regular file" in replayed.err) == (3, True)


def keys_of_files(folder: Path) -> list[int]:
    """One for each file with rows."""
    return [1 for _ in folder.glob("results/rows/*.parquet")]


def test_rows_that_a_kill_left_in_two_files_count_once_and_small_files_are_joined(fleet: Path) -> None:
    first = sr.evaluate_logs("logs", "gate.spatial", output="results")
    files = list(Path("results/rows").iterdir())
    # as if processes had died between writing a joined file and removing its parts
    for number in range(60):
        shutil.copy(files[0], f"results/rows/{number}.parquet")
    again = sr.evaluate_logs("logs", "gate.spatial", output="results")
    assert again.evaluated == 0
    assert again.table.equals(first.table)
    assert len(keys_of_files(fleet)) == 1
    assert set(keys_of(fleet / "results").values()) == {1}


def test_a_full_disk_ends_a_batch_and_what_was_written_stays(fleet: Path) -> None:
    sr.evaluate_logs("logs/run-1*.jsonl", "gate.spatial", output="results")
    code = (
        "import resource, sys; from spatial_replay.cli.application import run;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, 12_000)); sys.exit(run(sys.argv[1:]))"
    )
    arguments = ["batch", "logs", "--spec", "gate.spatial", "--jobs", "1"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, "could not be written" in done.stderr) == (70, True), done.stderr
    assert sr.evaluate_logs("logs", "gate.spatial", output="results").evaluated < LOGS


CLUSTER = """
import sys, distributed
cluster = distributed.LocalCluster(
    n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
)
print(cluster.scheduler_address, *(worker.pid for worker in cluster.workers.values()), flush=True)
sys.stdin.read()
"""


def when_stored(folder: Path, rows: int, pid: int) -> threading.Thread:
    """Start to wait until so many files of rows are there, and then kill a process."""

    def kill() -> None:
        while len(keys_of_files(folder)) < rows:
            time.sleep(0.005)
        os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    return killer


def test_a_cluster_evaluates_a_batch_outlives_a_worker_and_ends_with_its_scheduler(fleet: Path) -> None:
    pytest.importorskip("distributed")
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER],
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        address, victim, _ = process.stdout.readline().split()
        # with so many logs, the cluster hashes them, evaluates them, and writes the reports
        arguments = ["batch", "logs", "--spec", "gate.spatial", "--dask", address]
        killer = when_stored(fleet, 1, int(victim))
        done = command(*arguments, "--html", "pages")
        killer.join(60)
        assert done.code == 1, done.err
        assert f"{2 * LOGS} results: 30 satisfied, 10 violated" in done.out
        assert set(keys_of(fleet / "results").values()) == {1}
        assert len(list(fleet.glob("pages/reports/*.html"))) == 10

        shutil.rmtree(fleet / "results")
        killer = when_stored(fleet, 1, process.pid)
        done = command(*arguments)
        killer.join(60)
    assert (done.code, "the scheduler stopped answering" in done.err) == (70, True), done.err
    assert "Traceback" not in done.err
    assert sr.evaluate_logs("logs", "gate.spatial", output="results").evaluated < LOGS


def test_a_cluster_without_workers_says_so_and_goes_on_with_the_first(fleet: Path) -> None:
    pytest.importorskip("distributed")
    late = CLUSTER.replace("n_workers=2", "n_workers=0").replace("stdin.read()", "stdin.readline()")
    words = ["batch", "logs/run-1*.jsonl", "--spec", "gate.spatial", "--dask"]
    with subprocess.Popen(
        [sys.executable, "-c", f"{late}\ncluster.scale(1)\nsys.stdin.read()"],
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as cluster:
        assert cluster.stdin is not None and cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        with subprocess.Popen(
            [sys.executable, "-m", "spatial_replay", *words, address],
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as gate:
            assert gate.stderr is not None
            said = gate.stderr.readline()
            assert "the scheduler has no workers" in said and f"`dask worker {address}`" in said
            cluster.stdin.write("start\n")
            cluster.stdin.flush()
            assert gate.wait(60) == 1, gate.stderr.read()
        cluster.stdin.close()


def test_a_scheduler_that_does_not_answer_is_an_error(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    done = command("batch", "logs", "--spec", "gate.spatial", "--dask", "tcp://nowhere")
    assert (done.code, "no scheduler answers" in done.err) == (2, True), done.err
    # a process of its own, since a client that was not closed complains when Python ends
    words = ["batch", "logs", "--spec", "gate.spatial", "--dask", "nonsense"]
    ended = subprocess.run(
        [sys.executable, "-m", "spatial_replay", *words], capture_output=True, text=True, check=False
    )
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 2 and "--dask nonsense: no scheduler answers" in line
