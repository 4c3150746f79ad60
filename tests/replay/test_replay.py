"""Replays: what stays, what is added, which samples count, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from replay.runs import PAST, SPECIFICATION, STEP_NS, PiecewiseSource, content_of, record, run, sample
from spatial_replay import (
    Footprint,
    LogError,
    OutputError,
    Sample,
    SpecificationError,
    Trace,
    UsageError,
    load_specification,
    parse_specification,
)
from spatial_replay.logs.messages import Block
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.document import document_from_replay, explain_results
from spatial_replay.replay.engine import Replayed, load_files, run_replay
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.sources import open_source

SPEC = parse_specification(SPECIFICATION, filename="blocks.spatial")
ANNOTATION = {
    "/spatial/scene",
    "/spatial/frame",
    "/spatial/specification",
    "/spatial/standing",
    "/spatial/robustness",
    "/spatial/automaton",
    "/spatial/events",
    "/spatial/log",
    "/spatial/recent_events",
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return record(run(), tmp_path / "run.mcap")


@pytest.fixture
def foreign(log: Path, tmp_path: Path) -> Path:
    """The samples among messages of others, as another program wrote them: other numbers, another order."""
    path = tmp_path / "foreign.mcap"
    with log.open("rb") as stream:
        objects = list(make_reader(stream).iter_messages(topics=["/spatial/objects"]))
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=400, compression=CompressionType.LZ4)
        writer.start(profile="other", library="another program")
        notes = writer.register_channel("/notes", "json", 0, {"by": "someone"})
        schema, _, _ = objects[0]
        assert schema is not None
        samples = writer.register_channel(
            "/spatial/objects", "protobuf", writer.register_schema(schema.name, schema.encoding, schema.data)
        )
        early = writer.register_channel("/a", "json", writer.register_schema("A", "jsonschema", b"{}"))
        for number, (_, _, message) in enumerate(objects):
            note, published_ns = b'{"n": %d}' % number, message.log_time + 7
            writer.add_message(notes, message.log_time, note, published_ns, 90 - number)
            writer.add_message(samples, message.log_time, message.data, message.publish_time, number)
            writer.add_message(early, message.log_time, b"{}", message.log_time, 3)
        writer.add_metadata("theirs", {"b": "1", "a": "2"})
        writer.add_attachment(1, 2, "photo.png", "image/png", b"\x89PNG")
        writer.finish()
    return path


def test_external_messages_metadata_and_attachments_are_copied(foreign: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    run_replay(open_source(foreign), [SPEC], output=output)
    before, after = content_of(foreign), content_of(output)
    theirs = before.topics()
    assert sorted(after.of(*theirs)) == sorted(before.messages)
    assert after.topics() == theirs | ANNOTATION
    assert ("theirs", {"b": "1", "a": "2"}) in after.metadata
    assert ("photo.png", b"\x89PNG") in after.attachments
    again = tmp_path / "again.mcap"
    run_replay(open_source(output), [SPEC], output=again)
    assert output.read_bytes() == again.read_bytes()


def test_messages_are_in_order_of_time_then_topic_and_those_of_the_end_come_last(
    foreign: Path, tmp_path: Path
) -> None:
    output = tmp_path / "out.mcap"
    run_replay(open_source(foreign), [SPEC], output=output)
    read = [(time_ns, topic) for topic, time_ns, *_ in content_of(output).messages]
    assert [time_ns for time_ns, _ in read] == sorted(time_ns for time_ns, _ in read)
    # in chunks of their own, so that others come before or after them at the same time
    every = [each for each in read if each[1].startswith("/spatial/")]
    ours, ended = every[:-7], every[-7:]
    theirs = [each for each in read if not each[1].startswith("/spatial/")]
    assert ours == sorted(ours) and theirs == sorted(theirs)
    topics = ("events", "log", "recent_events", "robustness", "robustness", "scene", "standing")
    assert ended == [(ours[-1][0], f"/spatial/{topic}") for topic in topics]


def test_our_metadata_comes_first_and_the_certificate_last(log: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    replayed = run_replay(open_source(log), [SPEC], output=output)
    (first, about), *_, (last, certificate) = content_of(output).metadata
    assert (first, last) == ("spatial_replay", "spatial_replay_certificate")
    assert about["source"] == "run.mcap"
    assert [each["name"] for each in json.loads(about["specifications"])] == ["blocks.spatial"]
    assert certificate == dict(replayed.certificate)


def test_a_layer_holds_only_the_messages_of_the_evaluation(foreign: Path, tmp_path: Path) -> None:
    layer, whole = tmp_path / "layer.mcap", tmp_path / "whole.mcap"
    in_layer = run_replay(open_source(foreign), [SPEC], output=layer, layer=True)
    in_whole = run_replay(open_source(foreign), [SPEC], output=whole)
    assert content_of(layer).topics() == ANNOTATION
    assert content_of(layer).messages == content_of(whole).of(*ANNOTATION)
    assert "photo.png" not in dict(content_of(layer).attachments)
    assert "theirs" not in dict(content_of(layer).metadata)
    assert in_layer.certificate == in_whole.certificate


def _spans(replayed: Replayed) -> list[int]:
    (result,) = replayed.results
    assert result.times_ns is not None
    return (result.times_ns // STEP_NS).tolist()


def _replayed(text: str, window: Window) -> Replayed:
    return run_replay(
        PiecewiseSource(run(), 3), [parse_specification(text)], ReplayOptions(window), keep_series=True
    )


@pytest.mark.parametrize("size", [1, 7, 40])
def test_an_annotated_log_does_not_depend_on_the_blocks_it_is_read_in(size: int, tmp_path: Path) -> None:
    # few samples are encoded one by one, many as columns: objects come and go, verdicts and arrows change
    specification = parse_specification(f"{SPECIFICATION}spec far = G (cube dist goal >= 1)\n{PAST}")
    for name, pieces in (("whole.mcap", 90), ("cut.mcap", size)):
        run_replay(PiecewiseSource(run(90), pieces), [specification], output=tmp_path / name)
    assert (tmp_path / "cut.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def test_a_window_is_from_a_time_to_before_another() -> None:
    replayed = _replayed(PAST, Window(3 * STEP_NS, 7 * STEP_NS))
    assert _spans(replayed) == [3, 4, 5, 6]
    assert (replayed.samples, replayed.start_ns, replayed.end_ns) == (4, 3 * STEP_NS, 6 * STEP_NS)


def test_terms_look_before_a_window() -> None:
    (result,) = _replayed(PAST, Window(3 * STEP_NS)).results
    assert result.verdict == "satisfied"
    (at_the_start,) = _replayed(PAST, Window()).results
    assert at_the_start.verdict == "unknown"


def test_every_nth_sample_of_the_log_counts() -> None:
    assert _spans(_replayed(PAST, Window(every=5))) == [0, 5, 10]
    assert _spans(_replayed(PAST, Window(4 * STEP_NS, every=5))) == [5, 10]


def test_bounds_and_delays_in_samples_count_selected_ones() -> None:
    text = "spec s = F[1, 1] (cube[-1] leftof cube)"
    (all_samples,) = _replayed(text, Window()).results
    (selected,) = _replayed(text, Window(every=4)).results
    # the cube is a unit wide and moves half a unit a sample
    assert all_samples.robustness == pytest.approx(0.5 - 1)
    assert selected.robustness == pytest.approx(4 * 0.5 - 1)


def test_an_every_below_one_and_an_empty_window_are_refused() -> None:
    with pytest.raises(UsageError, match="every is 0"):
        Window(every=0)
    with pytest.raises(UsageError, match="empty"):
        Window(5, 5)


def test_an_empty_window_names_the_times_of_the_log() -> None:
    with pytest.raises(UsageError, match=r"no sample in the requested window.*from 0.000 s to 2.750 s"):
        _replayed(PAST, Window(10**12))


def test_a_template_is_evaluated_for_each_chosen_object() -> None:
    spec = parse_specification("spec near(ego) = G (ego dist cube <= 9)")
    source = PiecewiseSource(run(), 4)
    everyone = run_replay(source, [spec], ReplayOptions(each={"ego": "all"}))
    assert [(r.name, r.object) for r in everyone.results] == [("near", "cube"), ("near", "cup 物")]
    dishes = run_replay(source, [spec], ReplayOptions(each={"ego": "class:DISH"}))
    assert [r.object for r in dishes.results] == ["cup 物"]


class Counted(PiecewiseSource):
    """A source that counts how often it is read."""

    passes = 0

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        object.__setattr__(self, "passes", self.passes + 1)
        return super().iter_blocks(start_ns, end_ns)


def test_the_objects_of_templates_take_one_pass() -> None:
    spec = parse_specification("spec near(a) = G (a dist cube <= 9)\nspec far(b) = F (b dist cube >= 1)")
    source = Counted(run(), 4)
    run_replay(source, [spec], ReplayOptions(each={"a": "class:dish", "b": "class:block"}))
    assert source.passes == 2


@pytest.mark.parametrize(
    ("each", "said"),
    [
        ({}, "near.ego. is a template"),
        ({"egg": "all"}, "no template has a parameter 'egg'"),
        ({"ego": "class:"}, "ego='class:' chooses no objects"),
    ],
)
def test_invalid_choices_of_objects_are_reported(each: dict[str, str], said: str) -> None:
    spec = parse_specification("spec near(ego) = G (ego dist cube <= 9)")
    with pytest.raises(UsageError, match=said):
        run_replay(PiecewiseSource(run(), 4), [spec], ReplayOptions(each=each))


def test_explaining_many_results_of_a_template_reads_the_log_no_further_time() -> None:
    spec = parse_specification("spec near(ego) = G (ego dist p0 <= 2)")
    crowd = Trace.from_samples(
        Sample(i * 10**8, {f"p{k}": Footprint.box(k + 0.1 * i, 0, k + 0.1 * i + 0.5, 1) for k in range(40)})
        for i in range(800)
    )
    assert crowd.nbytes > 2**22
    source = Counted(crowd, 350)
    replayed = run_replay(
        source, [spec], ReplayOptions(each={"ego": "all"}), keep_series=True, keep_leaves=True
    )
    passes = source.passes
    assert len(explain_results(replayed)) == 40
    document_from_replay(replayed)
    assert source.passes == passes == 2


def test_a_template_is_evaluated_for_one_object_by_its_name() -> None:
    spec = parse_specification("spec near(ego) = G (ego dist cube <= 9)")
    replayed = run_replay(PiecewiseSource(run(), 4), [spec], ReplayOptions(each={"ego": "cup 物"}))
    assert [result.object for result in replayed.results] == ["cup 物"]
    missing = run_replay(PiecewiseSource(run(), 4), [spec], ReplayOptions(each={"ego": "cupe"}))
    assert (missing.results, [part.reason for part in missing.vacuous]) == ((), ["no instances"])
    assert "never has the object 'cupe'" in missing.missing[0].message
    assert "did you mean 'cube'" in str(missing.missing[0])


def test_a_class_that_the_log_never_has_gives_a_warning_and_no_result() -> None:
    text = "spec near(ego) = G (ego dist cube <= 9)\nspec held = F (cube ovlp hand)"
    each = {"ego": "class:dosh"}
    replayed = run_replay(PiecewiseSource(run(), 4), [parse_specification(text)], ReplayOptions(each=each))
    assert [result.name for result in replayed.results] == ["held"]
    assert [part.reason for part in replayed.vacuous] == ["no instances"]
    (missing,) = (each for each in replayed.missing if "class" in each.message)
    assert (missing.line, missing.message) == (1, "the log never has the class 'dosh'")
    assert missing.hint == "did you mean 'dish'? its classes are Block, dish"
    with pytest.raises(SpecificationError, match="never has the class 'dosh'"):
        run_replay(
            PiecewiseSource(run(), 4),
            [parse_specification(text)],
            ReplayOptions(each=each, strict_names=True),
        )


def test_a_class_that_appears_only_outside_the_window_gives_no_result() -> None:
    spec = parse_specification("spec near(ego) = G (ego dist cube <= 9)")
    only_cube = Window(3 * STEP_NS, 4 * STEP_NS)
    replayed = run_replay(PiecewiseSource(run(), 4), [spec], ReplayOptions(only_cube, {"ego": "class:dish"}))
    assert replayed.results == ()


def test_all_names_that_the_log_never_has_are_reported_together() -> None:
    spec = parse_specification("spec s = F (cub ovlp hand)\nspec t = batery >= 1")
    with pytest.raises(SpecificationError) as error:
        run_replay(PiecewiseSource(run(), 4), [spec], ReplayOptions(strict_names=True))
    said = str(error.value)
    assert [d.line for d in error.value.diagnoses] == [1, 1, 2]
    assert "'cube'" in said
    assert "cube, cup 物" in said
    assert "'battery'" in said


def test_a_name_need_not_be_in_the_window() -> None:
    replayed = run_replay(PiecewiseSource(run(), 4), [SPEC], ReplayOptions(Window(3 * STEP_NS, 4 * STEP_NS)))
    assert [str(r.verdict) for r in replayed.results] == ["violated", "unknown"]


def test_results_of_files_with_the_same_name_stay_apart(tmp_path: Path) -> None:
    paths = [tmp_path / folder / "a.spatial" for folder in ("one", "two")]
    for path, bound in zip(paths, (1, 20), strict=True):
        path.parent.mkdir()
        path.write_text(f"region goal = box(-1, -1, {bound}, 2)\nspec s = G cube enclosedin goal\n")
    log = record(run(), tmp_path / "run.mcap")
    files = load_files(paths, open_source(log))
    once = run_replay(open_source(log), files, output=tmp_path / "once.mcap")
    assert [(r.name, str(r.verdict)) for r in once.results] == [("a.s", "violated"), ("a-2.s", "satisfied")]
    own = load_files((), open_source(tmp_path / "once.mcap"))
    run_replay(open_source(log), own, output=tmp_path / "own.mcap")
    assert (tmp_path / "own.mcap").read_bytes() == (tmp_path / "once.mcap").read_bytes()


def test_a_specification_with_a_chosen_profile_is_read_back_with_that_profile(
    log: Path, tmp_path: Path
) -> None:
    text = tmp_path / "published.txt"
    text.write_text('F (cube closeto "cup 物")')
    spec = load_specification(text, profile="spatial_spec")
    run_replay(open_source(log), [spec], output=tmp_path / "once.mcap")
    annotated = open_source(tmp_path / "once.mcap")
    assert load_files((), annotated) == [spec]
    run_replay(annotated, load_files((), annotated), output=tmp_path / "own.mcap")
    assert (tmp_path / "own.mcap").read_bytes() == (tmp_path / "once.mcap").read_bytes()


def test_the_specification_of_the_last_replay_takes_precedence_over_the_recorded_one(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    record_source(PiecewiseSource(run(), 5), log, [SPEC])
    assert load_files((), open_source(log)) == [SPEC]
    edited = parse_specification(PAST, filename="edited.spatial")
    run_replay(open_source(log), [edited], output=tmp_path / "out.mcap")
    assert load_files((), open_source(tmp_path / "out.mcap")) == [edited]
    assert ("recorded/blocks.spatial", SPEC.source.encode()) in content_of(tmp_path / "out.mcap").attachments


def test_a_log_without_a_specification_names_the_missing_option(log: Path) -> None:
    with pytest.raises(
        UsageError, match=r"run\.mcap holds no specification of its own; give one with --spec"
    ):
        load_files((), open_source(log))


def test_a_source_without_samples_is_an_error() -> None:
    with pytest.raises(LogError, match="run has no sample"):
        run_replay(PiecewiseSource(Trace.from_samples(()), 3), [SPEC])


@pytest.mark.parametrize("last_ns", [2**63 - 1, 2**62])
def test_times_may_be_as_large_as_a_log_holds(last_ns: int, tmp_path: Path) -> None:
    late = Trace.from_samples(replace(sample(i), time_ns=last_ns - 10 + 5 * i) for i in range(3))
    log = record(late, tmp_path / "late.mcap")
    replayed = run_replay(open_source(log), [SPEC], output=tmp_path / "out.mcap", keep_series=True)
    assert (replayed.samples, replayed.end_ns) == (3, last_ns)
    times = replayed.results[0].times_ns
    assert times is not None
    assert np.array_equal(times, late.times_ns)


class TestOutputs:
    def test_an_output_that_is_an_input_is_refused(self, log: Path) -> None:
        before = log.read_bytes()
        with pytest.raises(UsageError, match="is an input too"):
            run_replay(open_source(log), [SPEC], output=log, inputs=[log])
        link = log.with_name("link.mcap")
        link.symlink_to(log)
        with pytest.raises(UsageError, match="is an input too"):
            run_replay(open_source(log), [SPEC], output=link, inputs=[log])
        assert log.read_bytes() == before

    def test_a_folder_or_a_file_in_a_missing_folder_is_refused(self, log: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="is a folder"):
            run_replay(open_source(log), [SPEC], output=tmp_path)
        with pytest.raises(UsageError, match="there is no folder"):
            run_replay(open_source(log), [SPEC], output=tmp_path / "none" / "out.mcap")

    def test_an_output_behind_a_link_is_written_there(self, log: Path, tmp_path: Path) -> None:
        link = tmp_path / "latest.mcap"
        link.symlink_to("out.mcap")
        run_replay(open_source(log), [SPEC], output=link)
        assert link.is_symlink()
        assert content_of(tmp_path / "out.mcap").topics() >= ANNOTATION

    def test_a_failed_replay_leaves_the_former_file(self, log: Path, tmp_path: Path) -> None:
        output = tmp_path / "out.mcap"
        output.write_bytes(b"before")
        with pytest.raises(SpecificationError):
            options = ReplayOptions(strict_names=True)
            run_replay(open_source(log), [parse_specification("G ghost ovlp cube")], options, output=output)
        assert output.read_bytes() == b"before"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out.mcap", "run.mcap"]

    def test_a_full_device_is_reported_and_stays_a_device(self, log: Path) -> None:
        full = Path("/dev/full")
        if not full.is_char_device():
            pytest.skip("no /dev/full here")
        with pytest.raises(OutputError, match="no space left on the device"):
            run_replay(open_source(log), [SPEC], output=full)
        assert full.is_char_device()


def test_messages_of_many_results_do_not_depend_on_how_samples_are_cut(tmp_path):
    # more than 65,536 samples times results are annotated in parts
    names = (f"spec s{number} = G (battery >= {number})" for number in range(110))
    specification = parse_specification("\n".join(names))
    for name, size in (("whole", 600), ("cut", 250)):
        run_replay(PiecewiseSource(run(600), size), [specification], output=tmp_path / name)
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "cut").read_bytes()
