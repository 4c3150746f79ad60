"""Doubts about how a log was read: which results rest on them, and what keeps them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from spatial_replay import Footprint, Sample, Trace, TrackedObject, evaluate, parse_specification, read_trace
from spatial_replay.logs.source import MemorySource
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.document import document_from_replay
from spatial_replay.replay.engine import Replayed, run_replay
from spatial_replay.replay.loaded_log import LoadedLog
from spatial_replay.replay.selection import ReplayOptions
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.sources import open_source
from spatial_replay.text import Instant, Sentence
from spatial_replay.trace.doubts import Doubt

SECOND = 10**9
SPECIFICATION = """
region zone = box(-9, -9, 9, 9)
group people = class "Person"
group everything = all
spec named = G (robot enclosedin zone)
spec other = G (cart enclosedin zone)
spec classed = G (forall p in people: p enclosedin zone)
spec any = G (forall a in everything: a enclosedin zone)
spec gone = F present(robot) and F present(cart)
spec charged = G ("battery" > 0)
spec each(ego) = G (ego enclosedin zone)
"""
EACH = {"ego": "all"}
STEPS = Doubt("jumps", "/tracks", Sentence("/tracks: walker jumps at ", Instant(6 * SECOND, 0)))


def run(*doubts: Doubt) -> Trace:
    """A robot, a cart, and a walker who is a person at first, five seconds after the epoch."""
    samples = []
    for number in range(3):
        classes = {"robot": "robot", "cart": "cart", "walker": "Person" if number == 0 else "bicycle"}
        objects = {
            name: TrackedObject(Footprint.disc(number, place, 0.5), class_name=class_name)
            for place, (name, class_name) in enumerate(classes.items())
        }
        samples.append(Sample((5 + number) * SECOND, objects, {"battery": 1.0}))
    return replace(Trace.from_samples(samples), doubts=doubts)


def doubtful(replayed: Replayed) -> set[str]:
    return {result.title for result in replayed.results if result.doubts}


def replay(trace: Trace) -> Replayed:
    files = [parse_specification(SPECIFICATION)]
    return run_replay(MemorySource(trace), files, ReplayOptions(each=EACH))


@pytest.mark.parametrize(
    ("about", "results"),
    [
        ({"objects": {"robot"}}, {"named", "gone", "any", "each(robot)"}),
        # of the class in one sample only
        ({"objects": {"walker"}}, {"classed", "any", "each(walker)"}),
        ({"signals": {"battery"}}, {"charged"}),
        ({}, set()),
        ({"objects": {"robot"}, "is_accepted": True}, set()),
    ],
)
def test_results_rest_on_the_doubts_about_their_objects_classes_and_signals(about, results):
    doubt = replace(STEPS, **{k: v if isinstance(v, bool) else frozenset(v) for k, v in about.items()})
    replayed = replay(run(doubt))
    assert doubtful(replayed) == results
    document = document_from_replay(replayed)
    named = {
        result["name"] if result["object"] is None else f"{result['name']}({result['object']})": result
        for result in document["specifications"]
    }
    assert {name for name, result in named.items() if result["doubts"] == ["jumps"]} == results
    (entry,) = document["log"]["doubts"]
    assert (entry["assumption"], entry["accepted"]) == ("jumps", doubt.is_accepted)
    word = "accepted" if doubt.is_accepted else "doubtful"
    # the first remark, with its time since the first sample
    assert document["log"]["remarks"][0].startswith(f"memory: {word}: /tracks: walker jumps at 1.000 s")
    evaluated = evaluate(parse_specification(SPECIFICATION), run(doubt), each=EACH)
    assert {result.title for result in evaluated if result.doubts} == results
    frame = evaluated.to_pandas()
    assert [bool(names) for names in frame["doubts"]] == [result.title in results for result in evaluated]


def test_a_log_in_memory_has_the_doubts_of_a_replay():
    doubt = replace(STEPS, objects=frozenset({"walker"}))
    files = [parse_specification(SPECIFICATION)]
    loaded = LoadedLog(MemorySource(run(doubt)), files, ReplayOptions(each=EACH))
    replayed = loaded.evaluate().replayed
    assert doubtful(replayed) == {"classed", "any", "each(walker)"}
    assert replayed.remarks[0] == replay(run(doubt)).remarks[0]


@given(
    st.lists(
        st.builds(
            Doubt,
            st.sampled_from(["jumps", "order"]),
            st.sampled_from(["", "/tracks"]),
            st.text(max_size=9).map(Sentence),
            st.frozensets(st.sampled_from(["robot", "cart", "walker"])),
            st.frozensets(st.just("battery")),
            st.booleans(),
        ),
        unique_by=lambda doubt: doubt.title,
        max_size=3,
    )
)
def test_recordings_and_annotated_logs_keep_doubts(tmp_path_factory, doubts):
    folder = tmp_path_factory.mktemp("logs")
    files = [parse_specification(SPECIFICATION)]
    replayed = replay(run(*doubts))
    recorded = record_source(MemorySource(run(*doubts)), folder / "run.mcap")
    assert len(recorded.remarks) == len(doubts)
    source = open_source(folder / "run.mcap")
    options = ReplayOptions(each=EACH)
    again = run_replay(source, files, options, output=folder / "annotated.mcap")
    annotated = open_source(folder / "annotated.mcap")
    last = run_replay(annotated, files, options)
    for later in (again, last):
        assert doubtful(later) == doubtful(replayed)
        assert later.certificate == replayed.certificate
    assert verify_certificate(annotated).differences == ()
    assert {doubt.title for doubt in read_trace(folder / "annotated.mcap").doubts} == {
        d.title for d in doubts
    }


def test_the_certificate_and_the_verdicts_of_an_annotated_log_name_its_doubts(tmp_path: Path):
    record_source(MemorySource(run(replace(STEPS, objects=frozenset({"robot"})))), tmp_path / "run.mcap")
    files = [parse_specification("region zone = box(-9, -9, 9, 9)\nspec fits = G (robot enclosedin zone)")]
    run_replay(open_source(tmp_path / "run.mcap"), files, output=tmp_path / "annotated.mcap")
    with (tmp_path / "annotated.mcap").open("rb") as stream:
        metadata = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert metadata["spatial_replay_certificate"]["doubts"] == "jumps /tracks"
    assert metadata["spatial_replay_verdicts"]["fits"].startswith("satisfied, doubtful, robustness")
    assert json.loads(metadata["spatial_replay_doubts"]["jumps /tracks"])["objects"] == ["robot"]
