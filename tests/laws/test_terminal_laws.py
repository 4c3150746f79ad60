"""Names from a log or a specification cannot steer the terminal that they are printed to."""

from __future__ import annotations

import json
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, example, given
from hypothesis import strategies as st

from examples import examples
from spatial_replay.cli import run

_STEERING = st.sampled_from(
    ["\x1b[31m", "\x1b]0;title\x07", "\x9b2J", "\r", "\n", "\x85", "\u202e", "\u2028", "\x7f"]
)
_NAMES = st.tuples(st.text("ab é", max_size=2), _STEERING, st.text("ab", max_size=2)).map("".join)


@examples(6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(_NAMES, _NAMES)
@example("cup\x1b]0;x\x07\x1b[2J", "\x9b31mfull\u202e\r\n")
def test_only_what_is_printable_is_printed(capsys: pytest.CaptureFixture[str], name: str, other: str) -> None:
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        commands = _commands(folder, name, other)
        for command in commands:
            code = run(command)
            printed = "".join(capsys.readouterr())
            assert code in (0, 1, 2, 4), printed
            assert all(line.isprintable() for line in printed.split("\n")), (command, printed)
            # a name cannot begin a line of its own
            assert not re.search(r"^\s*forged", printed, re.MULTILINE), (command, printed)


def _commands(folder: Path, name: str, other: str) -> list[list[str]]:
    """Write a log and specifications of these names; return what is to be run on them."""
    box = {"name": f"{name}\nforged", "class": f"{other}\nforged", "polygon": [[0, 0], [1, 0], [1, 1]]}
    plate = {"name": "plate", "polygon": [[2, 0], [3, 0], [3, 1]]}
    samples = [{"time_ns": 10**9 * n, "objects": [box, plate], "signals": {other: n}} for n in range(3)]
    log, mcap = folder / "run.jsonl", folder / "out.mcap"
    log.write_text("".join(f"{json.dumps(sample)}\n" for sample in samples))
    spec, wrong = folder / "s.spatial", folder / "wrong.spatial"
    written = re.sub(r"[\r\n]", " ", name)
    spec.write_text(
        f'use paper\nspec near(ego) "{written}" = G (ego dist plate <= 0.5)\n'
        f'spec held = G ("{written}" dist plate <= 5)\n',
        newline="",
    )
    wrong.write_text(f'spec a = G "{written}" foo "{written}{written}"\nspec b = "{written}"', newline="")
    each = ["--spec", str(spec), "--each", "ego=all"]
    return [
        ["check", str(spec), "--log", str(log)],
        ["check", str(spec), "--json"],
        ["check", str(wrong)],
        ["info", str(log)],
        ["info", str(log), "--json"],
        ["replay", str(log), *each, "-o", str(mcap)],
        ["replay", str(log), *each, "--json", "-"],
        ["replay", str(log), "--spec", str(spec), "--each", f"ego=class:{name}"],
        ["replay", str(log), "--spec", str(folder / name.replace("/", " "))],
        ["explain", str(mcap), "--each", "ego=all"],
        ["explain", str(log), *each, "--json"],
        ["explain", str(log), *each, "--result", name],
        ["info", str(mcap)],
        ["verify", str(mcap)],
        ["report", str(log), *each, "-o", str(folder / "page.html")],
        ["export", str(mcap), "-o", str(folder / "table.csv")],
        ["record", "tracks", str(log), "-o", str(folder / "again.mcap")],
    ]
