"""Replays: equal inputs give equal files, and a replay of a replay is the replay."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import NAMES, Recording, recordings, specifications
from replay.runs import PiecewiseSource, content_of, record, run, write_tracks
from spatial_replay import Recorder, Sample, Specification, SpecificationError, Trace, parse_specification
from spatial_replay.logs.topics import EVENT_LOG, EVENTS, RECENT_EVENTS
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.engine import Replayed, load_files, run_replay
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.sources import open_source

FEW = examples(25)


def _choices(spec: Specification) -> dict[str, str]:
    return {each.parameter: "all" for each in spec.results if each.parameter is not None}


@st.composite
def replays(draw: st.DrawFn) -> tuple[Trace, Specification]:
    """Samples, and a specification of which they have every name."""
    trace, spec = draw(recordings(max_size=8)).trace(), draw(specifications())
    tracked = run(1).observation(0)
    last = Sample(int(trace.times_ns[-1]) + 10**9, dict.fromkeys(NAMES, tracked), {"battery": 0.25})
    return Trace.concatenate([trace, Trace.from_samples([last])]), spec


@FEW
@given(replays())
def test_a_replay_of_a_replay_is_the_replay(replay: tuple[Trace, Specification]) -> None:
    trace, spec = replay
    with TemporaryDirectory() as folder:
        first, second, third = (Path(folder, name) for name in ("run.mcap", "once.mcap", "twice.mcap"))
        record(trace, first)
        once = run_replay(open_source(first), [spec], ReplayOptions(each=_choices(spec)), output=second)
        twice = run_replay(open_source(second), [spec], ReplayOptions(each=_choices(spec)), output=third)
        assert second.read_bytes() == third.read_bytes()
        assert once.certificate == twice.certificate
        own = load_files((), open_source(second))
        run_replay(open_source(second), own, ReplayOptions(each=_choices(spec)), output=third)
        assert second.read_bytes() == third.read_bytes()


@FEW
@given(replays(), st.integers(1, 4), st.integers(1, 3), st.data())
def test_how_a_source_is_split_into_blocks_changes_nothing(
    replay: tuple[Trace, Specification], size: int, every: int, data: st.DataObject
) -> None:
    trace, spec = replay
    at = data.draw(st.integers(0, len(trace) - 1))
    window = Window(start_ns=int(trace.times_ns[at // every * every]), every=every)
    with TemporaryDirectory() as folder:
        whole, pieces = Path(folder, "whole.mcap"), Path(folder, "pieces.mcap")
        results = [
            run_replay(
                PiecewiseSource(trace, blocks),
                [spec],
                ReplayOptions(window, _choices(spec)),
                output=output,
            )
            for blocks, output in ((len(trace), whole), (size, pieces))
        ]
        assert whole.read_bytes() == pieces.read_bytes()
        assert results[0].certificate == results[1].certificate


@FEW
@given(recordings(max_size=8))
def test_a_track_file_and_its_recorded_log_have_one_certificate_and_verdict(drawn: Recording) -> None:
    # track files have no objects that are unknown
    certain = Trace.from_samples(replace(each, unknown={}) for each in drawn.trace().samples())
    spec = parse_specification("spec s = G battery >= 1\nspec t = F battery <= 0.75")
    with TemporaryDirectory() as folder:
        tracks = write_tracks(certain, Path(folder, "run.jsonl"))
        log = Path(folder, "run.mcap")
        record_source(open_source(tracks), log)
        try:
            from_tracks = run_replay(open_source(tracks), [spec])
        except SpecificationError:
            assert "battery" not in certain.signals
            return
        from_log = run_replay(open_source(log), [spec])
        assert from_tracks.certificate == from_log.certificate
        assert _verdicts(from_tracks) == _verdicts(from_log)


@FEW
@given(replays())
def test_a_recorder_and_a_replay_give_the_same_results(replay: tuple[Trace, Specification]) -> None:
    trace, spec = replay
    if _choices(spec):
        return
    samples = list(trace.samples())
    with TemporaryDirectory() as folder:
        live, replayed = Path(folder, "live.mcap"), Path(folder, "replayed.mcap")
        with Recorder(live, specifications=[spec]) as recorder:
            for sample in samples:
                recorder.write(sample)
        run_replay(open_source(live), load_files((), open_source(live)), output=replayed)
        ours, theirs = content_of(live), content_of(replayed)
        assert by_topic(ours.messages) == by_topic(without_vacuous(theirs.messages))


def by_topic(messages: Sequence[tuple[str, int, int, int, bytes]]) -> list[tuple[str, int, int, int, bytes]]:
    """Messages topic by topic: a recorder writes a sample before its verdicts, a replay after them."""
    # recent events repeat the events that are compared
    return sorted((each for each in messages if each[0] != RECENT_EVENTS), key=lambda each: each[0])


def without_vacuous(
    messages: Sequence[tuple[str, int, int, int, bytes]],
) -> list[tuple[str, int, int, int, bytes]]:
    """Messages without the warnings about parts that decided nothing: only a replay sees the whole log."""
    warnings = {
        facts["message"] for topic, *_, data in messages if "vacuous" in (facts := facts_of(topic, data))
    }
    return [
        each
        for each in messages
        if "vacuous" not in facts_of(each[0], each[-1])
        and not (each[0] == EVENT_LOG and Log.FromString(each[-1]).message in warnings)
    ]


def facts_of(topic: str, data: bytes) -> dict[str, str]:
    return {each.key: each.value for each in Event.FromString(data).metadata} if topic == EVENTS else {}


def test_a_file_depends_neither_on_the_process_nor_on_its_hash_seed(tmp_path: Path) -> None:
    write_tracks(run(), tmp_path / "run.jsonl")
    (tmp_path / "a.spatial").write_text(
        "group all_of = all\nregion z = box(0, 0, 1, 1)\nregion a = box(1, 0, 3, 1)\n"
        "spec s = F (cube ovlp a or cube ovlp z)\nspec t = G exists o in all_of: o ovlp cube\n"
    )

    words = (
        "record tracks run.jsonl --spec a.spatial -o run.mcap",
        "replay run.mcap -o out.mcap --json out.json --series",
        "export out.mcap -o out.csv",
    )
    program = f"from spatial_replay.cli import run\nassert not any(run(each.split()) for each in {words})"
    files: list[Sequence[bytes]] = []
    for seed in (1, 2):
        command = [sys.executable, "-c", program]
        subprocess.run(command, cwd=tmp_path, env=_environment(seed), check=True, capture_output=True)
        files.append([(tmp_path / f).read_bytes() for f in ("run.mcap", "out.mcap", "out.json", "out.csv")])
    assert files[0] == files[1]


def _environment(seed: int) -> dict[str, str]:
    return {**os.environ, "PYTHONHASHSEED": str(seed)}


def _verdicts(replayed: Replayed) -> list[tuple[str, str | None, str, str]]:
    return [(r.name, r.object, str(r.verdict), repr(r.robustness)) for r in replayed.results]
