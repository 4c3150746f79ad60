"""Valid and broken specification texts: each is parsed, or refused with a typed error, within a second."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import spatial_replay as sr
from attacks.cases import Case, Outcome
from spatial_replay.spec import format_specification

RELATIONS = (
    "ovlp", "enclosedin", "partovlp", "leftof", "rightof", "below", "above", "partleftof", "partrightof",
    "partbelow", "partabove",
)  # fmt: skip
NUMBERED = ("closeto", "farfrom", "touch", "moved")
FUTURE, PAST = ("F", "G", "X"), ("O", "H")
WINDOWS = ("", "", "", "[0, 5]", "[2, 9]", "[0s, 3s]", "[500ms, 2s]", "[1s, 1s]")
HOSTILE = (
    "\x00", "\x1b[2J", "\u202e", "\ud800", "\ufeff", "\u2028", "(" * 300, "not " * 300, "[" * 50, "1" * 400,
    "1e999", "-0.0", "F[0, 99999999999999999999]", "F[5, 2]", '"', "\\", "#", "def f(a) = f(a)\n",
    "X" * 5_000, "box(0,0,0,0)", "polygon((0,0))", "use nothing\n",
    "spec spec = spec", "forall", "in", "->", "&&&",
)  # fmt: skip


class Texts:
    """Random specifications; about half of them have random edits."""

    name = "texts"
    most_cpu_s = 1.0
    uses_files = False

    def ready(self) -> None:
        sr.parse_specification("G (a ovlp b)")

    def draw(self, rng: random.Random) -> Case:
        text = _file(rng)
        for _ in range(rng.choice((0, 0, 0, 1, 1, 2, 5))):
            text = _edited(rng, text)
        return {"text": text, "formatted": rng.random() < 0.1}

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        text = case["text"]
        try:
            parsed = sr.parse_specification(text)
        except sr.SpecificationError as error:
            message = str(error)
            outcome = Outcome(counts={"refused": 1})
            if not message or len(message) > 200_000:
                outcome.problems.append(f"its message has {len(message)} characters")
            return outcome
        outcome = Outcome(counts={"valid": 1})
        # formatting takes as long as parsing again
        if case.get("formatted", True):
            written = format_specification(parsed)
            if format_specification(sr.parse_specification(written)) != written:
                outcome.problems.append("what it is formatted as is not what that is formatted as")
        return outcome


def _file(rng: random.Random) -> str:
    """Return a valid specification, with or without definitions."""
    if rng.random() < 0.6:
        return _formula(rng, rng.randint(0, 3), ("a", "b"))
    lines, terms = [], ["a", "b", "cup"]
    if rng.random() < 0.4:
        lines.append(f"const near = {rng.randint(1, 90)}" + rng.choice(("", " in [0, 100]")))
    if rng.random() < 0.4:
        x = rng.randint(-9, 9)
        lines.append(f"region goal = box({x}, 0, {x + 3}, {rng.uniform(1, 9):.2f})")
        terms.append("goal")
    if rng.random() < 0.2:
        lines.append("group blocks = a, b")
    names = []
    for index in range(rng.choice((1, 1, 2, 3))):
        title = rng.choice(("", "", ' "REQ-1: no one is hit"'))
        used = f" and {rng.choice(names)}" if names and rng.random() < 0.4 else ""
        lines.append(f"spec s{index}{title} = ({_formula(rng, rng.randint(0, 3), terms)}){used}")
        names.append(f"s{index}")
    if rng.random() < 0.2:
        lines.append("# a comment: é 物")
    return "\n".join(lines) + rng.choice(("", "\n", "\r\n"))


def _formula(rng: random.Random, depth: int, terms: Sequence[str]) -> str:
    if depth == 0:
        return _atom(rng, terms)
    inner = _formula(rng, depth - 1, terms)
    kind = rng.randrange(8)
    if kind < 3:
        return f"{rng.choice((*FUTURE[:2], *PAST))}{rng.choice(WINDOWS)} ({inner})"
    if kind == 3:
        return f"not ({inner})"
    if kind == 4:
        return f"({inner}) U{rng.choice(WINDOWS)} ({_formula(rng, depth - 1, terms)})"
    return f"({inner}) {rng.choice(('and', 'or', '->', 'xor', '<->'))} ({_formula(rng, depth - 1, terms)})"


def _atom(rng: random.Random, terms: Sequence[str]) -> str:
    a, b = rng.choice(terms[:3]), rng.choice(terms)
    if rng.random() < 0.15:
        a = f"enlarge({a}, {rng.randint(0, 5)})"
    match rng.randrange(5):
        case 0:
            return f"{a} dist {b} {rng.choice(('<=', '<', '>=', '>'))} {rng.uniform(0, 99):.3g}"
        case 1:
            return f"{a} closeto[{rng.randint(1, 50)}] {b}"
        case 2:
            return f"battery {rng.choice(('<=', '>='))} {rng.random():.2f}"
    return f"{a} {rng.choice(RELATIONS)} {b}"


def _edited(rng: random.Random, text: str) -> str:
    """Return a text with a part deleted, inserted, repeated, swapped or replaced."""
    at, to = sorted((rng.randint(0, len(text)), rng.randint(0, len(text))))
    to = min(to, at + 30)
    words = text.split(" ")
    match rng.randrange(7):
        case 0:
            return text[:at] + text[to:]
        case 1:
            return text[:at] + text[at:to] * rng.choice((2, 3, 40)) + text[to:]
        case 2:
            return text[:at] + rng.choice(HOSTILE) + text[at:]
        case 3:
            return (
                text[:at] + chr(rng.choice((rng.randrange(128), rng.randrange(0x11_0000)))) + text[at + 1 :]
            )
        case 4:
            rng.shuffle(words)
            return " ".join(words)
        case 5:
            words[rng.randrange(len(words))] = rng.choice(words)
            return " ".join(words)
    return text + rng.choice(("\n", " and ", " U ")) + text
