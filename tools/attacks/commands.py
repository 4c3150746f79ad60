"""Commands on logs with hostile names on a terminal, and interrupted commands."""

from __future__ import annotations

import json
import random
import re
import signal
from pathlib import Path
from tempfile import TemporaryDirectory

from attacks.cases import Case, Outcome
from attacks.program import interrupt_after, on_terminal, said_by, unprintable

_STEERING = (
    "\x1b[45m", "\x1b]0;title\x07", "\x1b[2J", "\x9b31m", "\x90q\x9c", "\r", "\n", "\x08", "\x85", "\u202e",
    "\u2066", "\u2028", "\ufeff", "\x7f", "\x00", "\t", "\v", "\x1bc", "\x1b[6n", "\udc80",
)  # fmt: skip
_PLAIN = ("cup", "é物", "a b", '"', "'", "\\", "%s", "{x}", "../..", "-o", "=", ",", "x" * 300, "")
_RECORDING = Path(__file__).parents[2] / "recordings" / "push.mcap"
_SIGNALS = (signal.SIGINT, signal.SIGINT, signal.SIGTERM)


class Names:
    """Names with control sequences in logs and specifications: none may reach the terminal unescaped."""

    name = "names"
    most_cpu_s = None
    uses_files = True

    def ready(self) -> None:
        # what is loaded now, no process that is forked has to load
        with TemporaryDirectory(prefix="campaign-") as folder:
            for arguments in _commands(Path(folder), "a", "b", "c", "s"):
                said_by(arguments)

    def draw(self, rng: random.Random) -> Case:
        names = [
            "".join(rng.choice((*_STEERING, *_PLAIN)) for _ in range(rng.randint(1, 4))) for _ in range(4)
        ]
        return {"names": names}

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        outcome = Outcome(counts={"commands": 0, "bytes": 0})
        for arguments in _commands(folder, *case["names"]):
            code, written = on_terminal(arguments)
            outcome.counts["commands"] += 1
            text = written.decode("utf-8", "backslashreplace")
            if wrong := unprintable(text):
                outcome.counts["bytes"] += len(wrong)
                outcome.problems.append(f"{arguments[0]} prints {wrong!r} to a terminal")
            if code not in (0, 1, 2, 3, 4) or "internal error" in text:
                outcome.problems.append(f"{arguments[0]} exits with {code}: {text[-400:]!r}")
            # long lines are broken at spaces, and go on further in
            if re.search(r"^forged", text, re.MULTILINE):
                outcome.problems.append(f"{arguments[0]} begins a line with a name")
        return outcome


def _commands(folder: Path, name: str, other: str, third: str, signal_name: str) -> list[list[str]]:
    """Write a log and a specification with these names; return commands that print them."""
    square = [[0, 0], [1, 0], [1, 1]]
    objects = [
        {"name": f"{name}\nforged", "class": f"{other}\nforged", "polygon": square},
        {"name": third or "plate", "polygon": [[x + 2, y] for x, y in square]},
    ]
    samples = [
        {"time_ns": n * 10**8, "objects": objects, "signals": {signal_name or "s": n}} for n in range(4)
    ]
    log = folder / "run.jsonl"
    log.write_text("".join(f"{json.dumps(sample)}\n" for sample in samples))
    spec, wrong = folder / "s.spatial", folder / "wrong.spatial"
    written = re.sub(r'[\r\n"\\\ud800-\udfff]', " ", name)
    title = re.sub(r'[\r\n"\\\ud800-\udfff]', " ", other)
    spec.write_text(f'use paper\nspec near(ego) "{title}" = G (ego dist "{written}" <= 0.5)\n', newline="")
    wrong.write_text(f'spec a = G "{written}" foo "{title}"', newline="")
    each, mcap = ["--spec", str(spec), "--each", "ego=all"], str(folder / "out.mcap")
    return [
        ["check", str(spec), "--log", str(log)],
        ["check", str(wrong)],
        ["info", str(log)],
        ["replay", str(log), *each, "-o", mcap],
        ["explain", str(log), *each],
        ["info", mcap],
        ["verify", mcap],
        ["recover", mcap, "-o", str(folder / "again.mcap")],
    ]


class Interrupts:
    """Commands with Ctrl-C or SIGTERM at a random moment: exit code 130, and no partial file."""

    name = "interrupts"
    most_cpu_s = None
    uses_files = True

    def ready(self) -> None:
        said_by(["--help"])

    def draw(self, rng: random.Random) -> Case:
        return {
            "command": rng.randrange(len(_interruptible(Path(), Path()))),
            "seconds": round(rng.uniform(0.0, 1.5), 4),
            "signal": int(rng.choice(_SIGNALS)),
        }

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        from spatial_replay.errors import LogError
        from spatial_replay.sources.recover import recover_log

        out = folder / "out"
        out.mkdir()
        log, arguments = _log(folder), _interruptible(folder, out)[case["command"]]
        before = log.read_bytes()
        code, written = on_terminal(arguments, interrupt_after(case["seconds"], case["signal"]))
        text = written.decode("utf-8", "backslashreplace")
        outcome = Outcome(counts={f"exit {code}": 1})
        # a signal that comes before the program has set its handlers ends it as it ends any
        if code not in (0, 1, 4, 130, 143, -case["signal"]):
            outcome.problems.append(f"{arguments[0]} exits with {code}: {text[-400:]!r}")
        if "internal error" in text or ("Traceback" in text and code != -case["signal"]):
            outcome.problems.append(f"{arguments[0]} has an internal error: {text[-600:]!r}")
        if log.read_bytes() != before:
            outcome.problems.append(f"{arguments[0]} changed its input")
        for path in out.iterdir():
            if path.name.startswith(".") or "partial" in path.name:
                outcome.problems.append(f"{arguments[0]} leaves {path.name}")
            elif path.suffix == ".mcap":
                try:
                    is_whole = recover_log(path, folder / "whole.mcap").is_whole
                except LogError as error:
                    is_whole = "holds no topic" in str(error)
                if not is_whole:
                    outcome.problems.append(f"{arguments[0]} leaves a partial log")
        return outcome


def _log(folder: Path) -> Path:
    square = [[0, 0], [1, 0], [1, 1]]
    log = folder / "run.jsonl"
    with log.open("w") as stream:
        for n in range(6_000):
            boxes = [
                {"name": name, "polygon": [[x + k + n % 7, y] for x, y in square]}
                for k, name in enumerate("ab")
            ]
            stream.write(json.dumps({"time_ns": n * 10**8, "objects": boxes}) + "\n")
    (folder / "s.spatial").write_text("spec s = G (a dist b <= 9) and F (a leftof b)\n")
    return log


def _interruptible(folder: Path, out: Path) -> list[list[str]]:
    log, spec = str(folder / "run.jsonl"), ["--spec", str(folder / "s.spatial")]
    return [
        ["replay", log, *spec, "-o", str(out / "annotated.mcap")],
        ["replay", log, *spec, "--json", str(out / "result.json")],
        ["record", "tracks", log, *spec, "-o", str(out / "recorded.mcap")],
        ["report", log, *spec, "-o", str(out / "page.html")],
        ["export", str(_RECORDING), "-o", str(out / "table.csv")],
        ["clip", log, *spec, "-o", str(out / "clip.mcap")],
        ["recover", str(_RECORDING), "-o", str(out / "recovered.mcap")],
        ["explain", log, *spec],
        ["info", log],
    ]
