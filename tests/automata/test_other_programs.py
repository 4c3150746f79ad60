"""Automata through programs of others: MONA, which compiles them, and Graphviz, which draws them."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given

from automata.golden import FORMULAS
from examples import examples
from laws.strategies_automaton import compiled, formulas_with_automata
from spatial_replay import (
    NoAutomatonError,
    OutputError,
    Recorder,
    Sample,
    UsageError,
    automaton,
    parse_specification,
)
from spatial_replay.automata import automaton_from, stored_text, svg_text
from spatial_replay.automata.automaton import Automaton

needs_mona = pytest.mark.skipif(shutil.which("mona") is None, reason="MONA is not installed")
needs_graphviz = pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")


@needs_mona
@examples(60)
@given(formulas_with_automata)
def test_both_compilers_give_equal_automata(formula) -> None:
    assert compiled(formula, "own") == compiled(formula, "mona")


def _deeper(calls: int, call: Callable[[], Automaton]) -> Automaton:
    return call() if calls == 0 else _deeper(calls - 1, call)


@needs_mona
@pytest.mark.parametrize("text", ["F[220, 220] p >= 0", "G[0, 110] p >= 0", "(p >= 0) U[0, 73] (q >= 0)"])
def test_mona_compiles_what_nests_220_deep_however_deep_its_caller_is(text: str) -> None:
    specification = parse_specification(text)
    result = _deeper(500, lambda: automaton(specification, compiler="mona"))
    assert result == automaton(specification, compiler="own")


@needs_mona
def test_a_state_may_depend_on_any_of_many_propositions() -> None:
    text = "p39 >= 0"
    for number in reversed(range(39)):
        text = f"(p{number} >= 0) and X ({text})"
    specification = parse_specification(text)
    assert automaton(specification, compiler="mona") == automaton(specification, compiler="own")


def _through_mona(text: str) -> Automaton:
    return automaton(parse_specification(text), compiler="mona")


@needs_mona
def test_several_processes_compile_at_once() -> None:
    texts = [FORMULAS[number % len(FORMULAS)] for number in range(100)]
    with ProcessPoolExecutor(4) as pool:
        results = list(pool.map(_through_mona, texts))
    assert results == [automaton(parse_specification(text)) for text in texts]


@needs_mona
def test_mona_takes_over_where_this_package_reaches_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # whether it was so in each of the last 13 samples, and a trap
    specification = parse_specification("G ((p >= 0) -> F[13, 13] q >= 0)")
    with pytest.raises(NoAutomatonError, match="more than 5000 states"):
        automaton(specification, compiler="own")
    assert len(automaton(specification).states) == 2**13 + 1
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NoAutomatonError, match=r"more than 5000 states; MONA: .*apt-get install mona"):
        automaton(specification)


@needs_mona
def test_without_the_translator_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ltlf2dfa", None)
    with pytest.raises(NoAutomatonError, match=r"pip install 'spatial-replay\[mona\]'"):
        automaton(parse_specification("F a ovlp b"), compiler="mona")


def _program(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("cat >/dev/null; echo 'out of memory'; exit 3", "code 3: out of memory"),
        ("exit 1", "code 1"),
        ("cat >/dev/null; echo hello", "printed no automaton"),
        ("kill -9 $$", "ended after"),
    ],
)
def test_failures_of_mona_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
    _program(tmp_path, "mona", script)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(NoAutomatonError, match=message):
        _through_mona("F p >= 0")


def test_a_recording_compiles_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _program(tmp_path, "mona", f"cat >/dev/null; echo asked >>{tmp_path}/asked; exit 3")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    specification = parse_specification("G ((p >= 0) -> F[13, 13] q >= 0)")
    with Recorder(tmp_path / "run.mcap", specifications=[specification]) as recorder:
        recorder.write(Sample(0, {}, {"p": 0.0, "q": 0.0}))
    assert (tmp_path / "asked").read_text() == "asked\n"


@needs_mona
def test_an_automaton_that_is_too_large_is_reported() -> None:
    # 2^11 sets of what has been seen already
    text = " and ".join(f"(F p{number} >= 0)" for number in range(11))
    with pytest.raises(NoAutomatonError, match=r"MONA: .* states and more than 100000 moves"):
        automaton(parse_specification(text), compiler="mona")
    assert len(automaton(parse_specification(text)).states) == 2**11


@needs_graphviz
def test_an_automaton_is_drawn() -> None:
    text = svg_text(automaton(parse_specification('F "a<b\\"\\\\" ovlp q')))
    root = ElementTree.fromstring(text)
    words = "".join(root.itertext())
    assert "not p0" in words
    assert 'p0: "a<b\\"\\\\" ovlp q' in words


def test_without_graphviz_the_error_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = automaton(parse_specification("F p >= 0"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="apt-get install graphviz"):
        svg_text(machine)


def test_failures_of_graphviz_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _program(tmp_path, "dot", "cat >/dev/null; echo 'no fonts' >&2; exit 2")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(OutputError, match="code 2: no fonts"):
        svg_text(automaton(parse_specification("F p >= 0")))


@needs_mona
def test_a_large_automaton_is_read_back() -> None:
    specification = parse_specification("G ((x >= 0.03) -> F[12, 12] y >= 0)")
    result = automaton(specification)
    assert len(result.states) > 4000
    data = stored_text(result, specification, specification.specs[0]).encode()
    assert automaton_from(data, specification, specification.specs[0]) == result
