"""The program as a whole: streams, colours, signals, completion."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import spatial_replay
from cli.program import PROGRAM, environment, run_process, run_program, standard_error_on_terminal
from spatial_replay.cli.application import COMMANDS


def test_version_and_help_go_to_standard_output(tmp_path: Path) -> None:
    version = run_process("--version", cwd=tmp_path)
    assert (version.returncode, version.stdout, version.stderr) == (
        0,
        f"spatial-replay {spatial_replay.__version__}\n",
        "",
    )
    helped = run_program("--help", cwd=tmp_path)
    assert (helped.returncode, helped.stderr) == (0, "")
    for name, summary in COMMANDS.items():
        is_hidden = name in ("completion", "warmup")
        assert (f"  {name} " in helped.stdout, summary in helped.stdout) == (not is_hidden, not is_hidden)


def test_help_loads_no_command_and_no_numerical_library(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from spatial_replay.cli import run\n"
        "run(['--help'])\n"
        "heavy = {'numpy', 'numba', 'mcap', 'lark', 'rich', 'google.protobuf'} & set(sys.modules)\n"
        "sys.exit(', '.join(heavy) or 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_replay_of_a_short_log_loads_no_compiler_and_no_encoder(tmp_path: Path) -> None:
    recordings = Path(__file__).resolve().parents[2] / "recordings"
    arguments = ["replay", f"{recordings}/push.mcap", "--spec", f"{recordings}/push.spatial", "--to", "1s"]
    program = (
        "import sys\n"
        "from spatial_replay.cli import run\n"
        f"run({arguments!r})\n"
        "unneeded = {'numba', 'jsonschema', 'matplotlib', 'rich', 'rosbags', 'shapely', 'yaml',\n"
        "    'mcap_protobuf', "
        "'foxglove_schemas_protobuf', 'spatial_replay.annotate.annotator', 'spatial_replay.automata',\n"
        "    'spatial_replay.bags.open', 'spatial_replay.logs.mcap.write'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(unneeded)) or 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={key: value for key, value in os.environ.items() if key != "SPATIAL_REPLAY_KERNELS"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "push.mcap: 30 samples" in done.stdout


def test_a_group_without_a_command_prints_its_help_and_no_error(tmp_path: Path) -> None:
    done = run_program("record", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("Usage: spatial-replay record")
    assert "error:" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("chekc",), "no command is named 'chekc'; did you mean 'check'?"),
        (("record", "pshu", "-o", "a.mcap"), "no scenario is named 'pshu'; did you mean 'push'?"),
        (("record", "vido", "-o", "a.mcap"), "no scenario is named 'vido'; did you mean 'video'?"),
        (("record", "run.csv", "-o", "a.mcap"), "'run.csv'; `record tracks FILE` records a file"),
        (("check",), "Missing argument 'SPEC'"),
        (
            ("record", "-o", "a.mcap"),
            "Missing argument 'SCENARIO'. Choose from: push, pick-place, table-setting",
        ),
        (("check", "a.spatial", "--loog", "x"), "No such option"),
        (("check", "missing.spatial"), "missing.spatial"),
        (("info", "missing.mcap"), "missing.mcap"),
        (("completion", "tcsh"), "'tcsh' is not one of"),
    ],
)
def test_wrong_usage_is_reported_on_standard_error_with_code_2(
    tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    done = run_program(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("spatial-replay: error: ")
    assert said in done.stderr
    assert len(done.stderr.splitlines()) <= 3


def test_a_traceback_is_shown_on_request_only(tmp_path: Path) -> None:
    assert "Traceback" not in run_program("info", "missing.mcap", cwd=tmp_path).stderr
    shown = run_program("info", "missing.mcap", cwd=tmp_path, SPATIAL_REPLAY_DEBUG="1")
    assert shown.returncode == 2
    assert "Traceback" in shown.stderr


def test_colours_appear_on_terminals_unless_turned_off(tmp_path: Path) -> None:
    command = (*PROGRAM, "info", "missing.mcap")
    assert "\x1b[" not in run_program("info", "missing.mcap", cwd=tmp_path).stderr
    assert "\x1b[" in standard_error_on_terminal(command, tmp_path, {})
    assert "\x1b[" not in standard_error_on_terminal(command, tmp_path, {"NO_COLOR": "1"})


def test_a_broken_pipe_is_not_an_error(tmp_path: Path) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    try:
        done = subprocess.run(
            [*PROGRAM, "--help"],
            cwd=tmp_path,
            env=environment(),
            stdout=theirs,
            stderr=subprocess.PIPE,
            check=False,
        )
    finally:
        os.close(theirs)
    assert (done.returncode, done.stderr) == (141, b"")


def test_an_interrupt_ends_with_code_130_and_one_line(tmp_path: Path) -> None:
    endless = tmp_path / "endless.spatial"
    os.mkfifo(endless)
    process = subprocess.Popen(
        [*PROGRAM, "check", str(endless)], cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True
    )
    # opening waits until the program reads, so the signal meets it at work
    with process, endless.open("w"):
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert said.strip() == "spatial-replay: error: interrupted"


def test_a_shell_completes_commands_and_options(tmp_path: Path) -> None:
    script = run_process("completion", "bash", cwd=tmp_path)
    assert script.returncode == 0
    assert "complete -o nosort -F _spatial_replay_completion spatial-replay" in script.stdout
    for words, expected in (
        ("spatial-replay ch", "plain,check"),
        ("spatial-replay check --str", "plain,--strict-names"),
        ("spatial-replay record pu", "plain,push"),
        ("spatial-replay record vi", "plain,video"),
        ("spatial-replay record push --inj", "plain,--inject"),
        ("spatial-replay record video --hold", "plain,--hold-hidden"),
    ):
        completed = run_process(
            cwd=tmp_path,
            _SPATIAL_REPLAY_COMPLETE="bash_complete",
            COMP_WORDS=words,
            COMP_CWORD=str(words.count(" ")),
        )
        assert completed.stdout.split() == [expected]


_WORK = """
import sys, time
from spatial_replay.cli.terminal import progress
with progress("samples", total=3) as advance:
    for _ in range(3):
        time.sleep({pause})
        advance(1)
"""


def test_long_work_shows_a_bar_on_a_terminal_and_short_work_nothing(tmp_path: Path) -> None:
    def shown(pause: float) -> str:
        return standard_error_on_terminal((sys.executable, "-c", _WORK.format(pause=pause)), tmp_path, {})

    assert "samples" in shown(0.6)
    assert shown(0.0) == ""


def test_a_slow_first_step_already_shows_the_bar(tmp_path: Path) -> None:
    work = "import time\nfrom spatial_replay.cli.terminal import progress\n"
    work += "with progress('samples'):\n    time.sleep(2.5)\n"
    shown = standard_error_on_terminal((sys.executable, "-c", work), tmp_path, {})
    assert re.search(r"samples .* 0", shown), shown


def test_long_work_shows_nothing_in_a_cell_of_a_notebook(tmp_path: Path) -> None:
    work = (sys.executable, "-c", _WORK.format(pause=0.4))
    assert standard_error_on_terminal(work, tmp_path, {"JPY_PARENT_PID": "1"}) == ""


def test_long_work_shows_nothing_in_a_pipe(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WORK.format(pause=0.4)], cwd=tmp_path, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


_COMPILED = """
import time
from spatial_replay.cli.terminal import progress
from spatial_replay.compiled import compile_ahead, kernel

@kernel
def doubled(number):
    return 2 * number

compile_ahead()

with progress("samples") as advance:
    doubled(1)
    time.sleep(2)
"""


def test_the_bar_shows_that_code_is_being_compiled(tmp_path: Path) -> None:
    (tmp_path / "work.py").write_text(_COMPILED)
    command = (sys.executable, "work.py")
    # whatever this run of the tests asks for, and earlier runs have compiled
    variables = {"SPATIAL_REPLAY_KERNELS": "", "SPATIAL_REPLAY_CACHE": str(tmp_path / "cache")}
    assert "compiling, once on this machine" in standard_error_on_terminal(command, tmp_path, variables)
    said = standard_error_on_terminal(command, tmp_path, variables)
    assert "samples" in said
    assert "compiling" not in said


_LONG_COMPILED = """
import os
import spatial_replay.compiled as compiled
from spatial_replay.compiled import compile_ahead, kernel

@kernel
def doubled(number):
    return 2 * number

@kernel
def quadrupled(number):
    return doubled(doubled(number))

compile_ahead()
if "HASTE" in os.environ:
    compiled._WAIT_S = -1
print(quadrupled(1))
"""


def test_compiling_that_takes_long_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "work.py").write_text(_LONG_COMPILED)

    def said(**variables: str) -> str:
        own = environment(SPATIAL_REPLAY_KERNELS="", NUMBA_CACHE_DIR=str(tmp_path / "cache"), **variables)
        command = [sys.executable, "work.py"]
        done = subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, check=True)
        assert done.stdout == "4\n"
        return done.stderr

    line = "spatial-replay: compiling, once on this machine; `spatial-replay warmup` does it beforehand\n"
    assert said(HASTE="1") == line
    assert said(HASTE="1") == ""


def test_damaged_machine_code_is_compiled_again(tmp_path: Path) -> None:
    (tmp_path / "work.py").write_text(_LONG_COMPILED)
    own = environment(SPATIAL_REPLAY_KERNELS="", SPATIAL_REPLAY_CACHE=str(tmp_path / "cache"))
    for damaged in ("*.nb[ic]", "*.sha256", "*.nbi"):
        command = [sys.executable, "work.py"]
        done = subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (0, "4\n"), done.stderr
        code = [*(tmp_path / "cache").rglob(damaged)]
        assert code
        for path in code:
            path.write_bytes(bytes(byte ^ 0x80 for byte in path.read_bytes()))


_INTERRUPTED_IN_A_CALLBACK = """
import ctypes, os, signal, sys, time
from spatial_replay.cli.application import main
from spatial_replay.cli import warmup

def warm_up_kernels(*_, **__):
    # no exception can leave a callback, as those of the compiler
    ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGTERM))()
    time.sleep(60)

warmup.warm_up_kernels = warm_up_kernels
sys.argv = ["spatial-replay", "warmup"]
main()
"""


def test_an_interruption_that_comes_within_the_compiler_counts():
    done = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED_IN_A_CALLBACK],
        capture_output=True, text=True, check=False, timeout=50,
    )  # fmt: skip
    assert (done.returncode, done.stderr.strip()) == (130, "spatial-replay: error: interrupted")
