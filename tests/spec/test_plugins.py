"""Own relations and signals: a module runs only where its user allows it, and logs name it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import (
    Footprint,
    Monitor,
    Recorder,
    Sample,
    Trace,
    TrackedObject,
    evaluate,
    load_specification,
)
from spatial_replay.cli import run
from spatial_replay.sources import open_source

PAGE = (Path(__file__).parents[2] / "docs/language.md").read_text()
SECTION = PAGE[PAGE.index("### Own relations and signals") :]
MODULE = re.findall(r"```python\n(.*?)```", SECTION, re.DOTALL)[0]
SPECIFICATION = re.findall(r"```\n(use cell\n.*?)```", SECTION, re.DOTALL)[0]
RAN = "from pathlib import Path\nPath('ran').touch()\n"


def scene() -> list[Sample]:
    """An arm that comes within reach of a cup, and a person who comes in."""
    samples = []
    for index in range(8):
        objects = {
            "robot": TrackedObject(Footprint.disc(0.3 * index, 0.0, 0.1), "robot"),
            "cup": TrackedObject(Footprint.disc(2.6, 0.0, 0.1), "cup"),
        }
        if index > 3:
            objects["ann"] = TrackedObject(Footprint.disc(0.0, 4.0, 0.3), "person")
        samples.append(Sample(index * 10**8, objects))
    return samples


@pytest.fixture(autouse=True)
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of the page, in a folder; the module leaves a file behind when it runs."""
    monkeypatch.chdir(tmp_path)
    Path("cell.py").write_text(RAN + MODULE)
    Path("cell.spatial").write_text(SPECIFICATION)
    with Recorder("cell.mcap") as recorder:
        for sample in scene():
            recorder.write(sample)


REPLAY = ("replay", "cell.mcap", "--spec", "cell.spatial")


def test_a_specification_loads_no_module_by_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (REPLAY, ("check", "cell.spatial")):
        assert run([*command]) == 2
        said = capsys.readouterr().err
        assert "'cell' is neither a profile (paper, spatial_spec) nor an allowed plug-in" in said
        assert 'if you trust the module: plugins = ["cell"] in pyproject.toml' in said
        assert "or --plugin cell of check, replay and batch" in said
    assert not Path("ran").exists()


@pytest.mark.parametrize("module", ["cell", "cell.py", "./cell.py"])
def test_the_command_line_allows_a_module_for_its_command_alone(
    module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*REPLAY, "--plugin", module]) == 0
    assert re.search(r"picks +satisfied +robustness 0.3,", capsys.readouterr().out)
    assert run([*REPLAY]) == 2


def test_a_project_allows_modules_that_specifications_name(capsys: pytest.CaptureFixture[str]) -> None:
    Path("pyproject.toml").write_text('[tool.spatial-replay]\nplugins = ["cell"]\n')
    assert run([*REPLAY]) == 0
    Path("cell.spatial").write_text(SPECIFICATION.replace("use cell", ""))
    assert run([*REPLAY]) == 2
    assert "unknown relation 'within_reach'" in capsys.readouterr().err
    Path("pyproject.toml").write_text("[tool.spatial-replay]\nplugins = 3\n")
    Path("cell.spatial").write_text(SPECIFICATION)
    assert run([*REPLAY]) == 2
    assert "pyproject.toml: plugins is 3; give a list of modules" in capsys.readouterr().err


def test_a_log_names_the_plugin_and_runs_it_only_if_it_is_allowed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("cell.spatial").write_text(SPECIFICATION.replace("use cell", ""))
    assert run([*REPLAY, "--plugin", "cell", "-o", "annotated.mcap"]) == 0
    about = dict(open_source(Path("annotated.mcap")).metadata())["spatial_replay"]
    (listed,) = json.loads(about["specifications"])
    assert list(listed["plugins"]) == ["cell"]
    assert len(listed["plugins"]["cell"]) == 64
    Path("ran").unlink()
    for command in ("replay", "explain", "verify", "report"):
        assert run([command, "annotated.mcap"]) == 2
        assert "'cell' is neither a profile" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert run(["verify", "annotated.mcap", "--plugin", "cell"]) == 2
    assert "no option --plugin; allow the module in pyproject.toml" in capsys.readouterr().err
    Path("pyproject.toml").write_text('[tool.spatial-replay]\nplugins = ["cell"]\n')
    assert run(["verify", "annotated.mcap"]) == 0
    Path("cell.py").write_text(MODULE + "\n# changed\n")
    # another process, as commands are: one process reads a file once
    program = [sys.executable, "-m", "spatial_replay", "verify", "annotated.mcap"]
    verified = subprocess.run(program, capture_output=True, text=True, check=False)
    assert verified.returncode == 1
    assert "another specification" in verified.stdout


def test_a_batch_evaluates_logs_again_whatever_a_plugin_imports() -> None:
    Path("cell.py").write_text(MODULE + "\nimport floor\nSIGNALS = {'crowd': lambda sample: floor.CROWD}\n")
    Path("crowd.spatial").write_text("use cell\nspec few = G (crowd <= 3)\n")
    batch = ["batch", "cell.mcap", "--spec", "crowd.spatial", "--jobs", "1", "--plugin", "cell.py"]
    path = os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])
    for crowd, code in ((2, 0), (4, 1)):
        Path("floor.py").write_text(f"CROWD = {crowd}\n")
        # another process, as commands are: one process reads a file once
        program = [sys.executable, "-m", "spatial_replay", *batch]
        environment = {**os.environ, "PYTHONPATH": path}
        done = subprocess.run(program, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, "(all evaluated now" in done.stdout) == (code, True), done.stderr


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("1 / 0", "cannot be loaded: ZeroDivisionError: division by zero"),
        ("", "has no relations and signals; define RELATIONS or SIGNALS"),
        ("SIGNALS = 3", "has a SIGNALS that is not a dictionary of functions by name"),
        (MODULE + "\nSIGNALS = {'crowd': lambda sample: 1 / 0}", "fails for the signal 'crowd' at 0 ns"),
        (MODULE + "\nSIGNALS = {'crowd': lambda sample: 'many'}", "fails for the signal 'crowd' at 0 ns"),
    ],
)
def test_a_plugin_that_fails_is_named_with_the_reason(
    content: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bad.py").write_text(content)
    Path("cell.spatial").write_text(SPECIFICATION.replace("use cell", "use bad"))
    assert run([*REPLAY, "--plugin", "bad"]) == 2
    assert said in capsys.readouterr().err


def test_a_monitor_computes_the_signals_of_a_replay(capsys: pytest.CaptureFixture[str]) -> None:
    Path("pyproject.toml").write_text('[tool.spatial-replay]\nplugins = ["cell"]\n')
    specification = load_specification("cell.spatial")
    monitor = Monitor(specification)
    updates = [monitor.update(sample) for sample in scene()]
    for number, result in enumerate(evaluate(specification, Trace.from_samples(scene()))):
        live = np.stack([update.specs[number].numbers for update in updates], axis=2)
        assert live.tobytes() == result.series.tobytes()
        assert result.verdict == "satisfied"
    assert run(["explain", "cell.mcap", "--spec", "cell.spatial"]) == 0
    assert "crowd is 1" in capsys.readouterr().out
