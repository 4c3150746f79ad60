"""Annotations of drone videos: what is read, and what is reported about the rest."""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import (
    Footprint,
    LogError,
    SpatialReplayError,
    UsageError,
    evaluate,
    parse_specification,
    read_trace,
)
from spatial_replay.logs.source import BLOCK_SAMPLES
from spatial_replay.recording.source_recording import record_source
from spatial_replay.sources import open_source

Write = Callable[..., Path]


@pytest.fixture
def annotations(tmp_path: Path) -> Write:
    def write(*lines: str) -> Path:
        path = tmp_path / "annotations.txt"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def row(
    number: object, frame: object, box: str = "0 0 10 20", flags: str = "0 0 0", label: str = "Biker"
) -> str:
    return f'{number} {box} {frame} {flags} "{label}"'


def test_a_frame_is_a_sample_of_named_boxes(annotations: Write) -> None:
    path = annotations(row(7, 0), row(7, 3, "1 2 3 4"), row(12, 3, label="Golf Cart"))
    # the numbers of the file are easier to compare as they are
    first, second = read_trace(path, y_down=False).samples()
    assert (first.time_ns, second.time_ns) == (0, 100_000_000)
    assert first.objects["7"].footprint == Footprint.box(0, 0, 10, 20)
    assert second.objects["7"].footprint == Footprint.box(1, 2, 3, 4)
    assert [each.class_name for each in second.objects.values()] == ["Golf Cart", "Biker"]
    assert first.objects["7"].yaw is None


def test_files_are_ordered_by_object_and_samples_by_time(annotations: Write) -> None:
    path = annotations(*(row(number, frame) for number in (3, 1) for frame in range(20)))
    trace = read_trace(path)
    assert trace.names == ("1", "3")
    assert trace.times_ns.tolist() == [round(frame * 10**9 / 30) for frame in range(20)]
    assert (trace.rows >= 0).all()


@pytest.mark.parametrize(("rate", "second_ns"), [(25, 40_000_000), (29.97, 33_366_700), (0.1, 10**10)])
def test_another_rate_scales_the_times(annotations: Write, rate: float, second_ns: int) -> None:
    assert read_trace(annotations(row(0, 0), row(0, 1)), rate=rate).times_ns.tolist() == [0, second_ns]


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf"), 1e10, "30"])
def test_an_impossible_rate_is_refused(annotations: Write, rate: float) -> None:
    with pytest.raises(UsageError, match="frames a second"):
        read_trace(annotations(row(0, 0)), rate=rate)


def test_the_frame_of_lost_rows_stays(annotations: Write) -> None:
    path = annotations(row(0, 0), row(0, 1, flags="1 0 0"), row(0, 2, flags="0 1 1"))
    dropped, with_lost = read_trace(path), read_trace(path, lost="keep")
    assert len(dropped) == len(with_lost) == 3
    assert dropped.rows[:, 0].tolist() == [0, -1, 1]
    assert (with_lost.rows >= 0).all()
    with pytest.raises(UsageError, match="drop, keep"):
        read_trace(path, lost="maybe")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("bad", "reported"),
    [
        (row("x", 1), "id is 'x'"),
        (row(-1, 1), "id is '-1'"),
        (row("9" * 30, 1), "id is '999"),
        (row(1, 1, box="0 0 ten 20"), "give four numbers"),
        (row(1, 1, box="10 0 0 20"), "give xmin ymin xmax ymax"),
        (row(1, 1, flags="2 0 0"), "lost is '2'"),
    ],
)
def test_a_bad_row_costs_its_frame(annotations: Write, bad: str, reported: str) -> None:
    path = annotations(row(0, 0), row(0, 1), row(0, 2), bad)
    trace = read_trace(path, allow_damage=True)
    assert trace.times_ns.tolist() == [0, 66_666_667]
    (fault,) = trace.faults
    assert fault.startswith("annotations.txt:4: ")
    assert reported in fault
    assert fault.endswith("frame 1 is left out")
    with pytest.raises(LogError, match=r"annotations\.txt:4"):
        read_trace(path)


@pytest.mark.parametrize(
    "bad", ["", "hello", row(1, "x"), row(1, -1), row(1, "1" * 25), row(1, "1.5"), "0 0 0 0 0 0"]
)
def test_a_row_without_a_frame_costs_only_itself(annotations: Write, bad: str) -> None:
    trace = read_trace(annotations(row(0, 0), bad, row(0, 1)), allow_damage=True)
    assert len(trace) == 2
    assert len(trace.faults) == (bad != "")
    assert all(fault.startswith("annotations.txt:2: ") for fault in trace.faults)


def test_a_file_of_bad_rows_alone_says_what_is_wrong(annotations: Write) -> None:
    with pytest.raises(LogError, match=r"annotations\.txt:1: the box is '5 0 1 9'"):
        read_trace(annotations(row(0, 0, box="5 0 1 9"), row(0, 1, box="5 0 1 9")), allow_damage=True)


def test_an_object_twice_in_a_frame_costs_the_frame(annotations: Write) -> None:
    trace = read_trace(annotations(row(0, 5), row(0, 5), row(0, 6)), allow_damage=True)
    assert len(trace) == 1
    assert trace.faults == ("annotations.txt: frame 5: object '0' is there twice; name each object once",)


def test_numbers_that_are_not_known_make_the_object_unknown(annotations: Write) -> None:
    trace = read_trace(annotations(row(0, 0, box="nan 0 1 1")))
    assert (trace.unreadable_count, trace.faults) == (1, ())


def test_annotations_are_recognised_by_content(annotations: Write, tmp_path: Path) -> None:
    packed = tmp_path / "video.csv"
    packed.write_bytes(gzip.compress((row(0, 0) + "\n").encode()))
    assert len(read_trace(packed)) == 1
    assert open_source(annotations("damaged", row(0, 0))).kind == "drone annotations"
    with pytest.raises(UsageError, match="not a log in a known format"):
        open_source(annotations("0 0 0 0 0 0 0 0 0", "a b c d e f g h i j"))


def test_options_of_other_formats_are_refused(annotations: Write, tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match=r"--mapping a\.yaml \(mapping='a\.yaml'\) does not apply to .*leave it out"
    ):
        open_source(annotations(row(0, 0)), mapping="a.yaml")
    tracks = tmp_path / "run.jsonl"
    tracks.write_text('{"time_ns": 0}\n')
    for options in ({"rate": 25.0}, {"lost": "keep"}, {"on_time_jump": "split"}):
        with pytest.raises(UsageError, match=r"does not apply to run\.jsonl \(track JSONL\)"):
            open_source(tracks, **options)  # type: ignore[arg-type]


def test_blocks_are_bounded_and_windows_are_exact(annotations: Write) -> None:
    path = annotations(*(row(frame // 5000, frame) for frame in range(20_000)))
    blocks = [block.trace for block in open_source(path, rate=1000).iter_blocks()]
    assert max(map(len, blocks)) <= BLOCK_SAMPLES
    assert sum(map(len, blocks)) == 20_000
    (window,) = (b.trace for b in open_source(path, rate=1000).iter_blocks(10**7, 3 * 10**7) if len(b.trace))
    assert window.times_ns.tolist() == list(range(10**7, 3 * 10**7, 10**6))


def test_a_recording_says_how_annotations_were_read(annotations: Write, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    path = annotations(row(0, 0), row(0, 1, flags="1 0 0"))
    record_source(open_source(path, rate=25, lost="keep"), log)
    metadata = dict(open_source(log).metadata())
    assert json.loads(metadata["spatial_replay"]["options"]) == {"rate": 25, "lost": "keep"}
    assert read_trace(log) == read_trace(path, rate=25, lost="keep")


def test_the_dataset_is_read_whole(data_folder: Path) -> None:
    path = data_folder / "sdd" / "quad_video1_annotations.txt"
    trace, with_lost = read_trace(path), read_trace(path, lost="keep")
    assert (len(trace), len(trace.names), trace.classes) == (509, 17, ("Biker", "Pedestrian"))
    assert np.count_nonzero(with_lost.rows >= 0) == 7153
    assert np.count_nonzero(trace.rows >= 0) == 7153 - 949


@pytest.mark.parametrize("name", ["close_dist15", "ovlp", "respond_dist", "F60_notovlp"])
def test_published_values_over_the_dataset_are_reproduced(data_folder: Path, name: str) -> None:
    """Every object as ego, against the union of all others in view, on each prefix that was published."""
    published = json.loads((data_folder / "sdd" / "quad1_0_200.json").read_text())
    formula = published["specs"][name].replace("others", "(anyone except ego)")
    text = f"use spatial_spec\ngroup anyone = all\nspec social(ego) = {formula}\n"
    first, last = published["window"]
    trace = read_trace(data_folder / "sdd" / "quad_video1_annotations.txt").slice(first, last + 1)
    evaluation = evaluate(parse_specification(text), trace, semantics="paper", each={"ego": "all"})
    expected = published["values"][name]
    found = {result.object: result.nodes[0].value for result in evaluation.results}
    assert expected.keys() <= found.keys()
    for ego, values in expected.items():
        samples = [int(frame) for frame in values]
        np.testing.assert_allclose(found[ego][samples], list(values.values()), atol=1e-6, err_msg=ego)


def test_damage_anywhere_is_reported_or_harmless(annotations: Write) -> None:
    """Changed anywhere, a file gives the frames that can be read and says which cannot, or is refused."""
    path = annotations(
        *(row(number, frame, f"{frame} 0 {frame + 9} 20") for number in (1, 2) for frame in range(9))
    )
    content = path.read_bytes()
    whole = read_trace(path)
    chance = random.Random(7)
    for _ in range(300):
        damaged = bytearray(content)
        damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            trace = read_trace(path, allow_damage=True)
        except SpatialReplayError:
            continue
        assert len(trace) >= len(whole) - 1 or trace.faults
