"""Files recorded as logs."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from replay.runs import SPECIFICATION, PiecewiseSource, content_of, run, write_tracks
from spatial_replay import LogError, OutputError, Recorder, Trace, UsageError, parse_specification, read_trace
from spatial_replay.logs.messages import Block
from spatial_replay.logs.topics import ENDING, VERDICTS
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.engine import run_replay
from spatial_replay.sources import open_source


def test_a_track_file_becomes_a_log_of_the_same_samples(tmp_path: Path) -> None:
    tracks = write_tracks(run(), tmp_path / "run.jsonl")
    done: list[int] = []
    recorded = record_source(open_source(tracks), tmp_path / "run.mcap", advance=done.append)
    assert read_trace(tmp_path / "run.mcap") == run() == read_trace(tracks)
    assert (recorded.samples, recorded.objects, recorded.faults) == (12, ("cube", "cup 物"), ())
    assert sum(done) == 12


def test_how_the_source_is_split_into_blocks_changes_no_byte(tmp_path: Path) -> None:
    spec = parse_specification(SPECIFICATION)
    for size in (1, 4, 100):
        record_source(PiecewiseSource(run(40), size), tmp_path / f"{size}.mcap", [spec])
    assert len({(tmp_path / f"{size}.mcap").read_bytes() for size in (1, 4, 100)}) == 1


def test_the_reading_of_polygons_is_recorded_in_the_log_and_its_copies(tmp_path: Path) -> None:
    tracks, log = tmp_path / "run.jsonl", tmp_path / "run.mcap"
    polygon = [[0, 0], [2, 0], [2, 2], [1, 1]]
    tracks.write_text(json.dumps({"time_ns": 0, "objects": [{"name": "cube", "polygon": polygon}]}))
    record_source(open_source(tracks, concave="hull"), log)
    assert json.loads(_about(log)["options"]) == {"concave": "hull"}
    spec = parse_specification("F cube ovlp cube")
    for source in (open_source(tracks, concave="hull"), open_source(log)):
        run_replay(source, [spec], output=tmp_path / f"{source.name}.out")
    assert json.loads(_about(tmp_path / "run.jsonl.out")["options"]) == {"concave": "hull"}
    copy = tmp_path / "run.mcap.out"
    assert json.loads(_about(copy)["options"]) == {}
    assert json.loads(_about(copy)["recorded_options"]) == {"concave": "hull"}
    run_replay(open_source(copy), [spec], output=tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == copy.read_bytes()


def _about(path: Path) -> dict[str, str]:
    return dict(content_of(path).metadata)["spatial_replay"]


def test_units_stay_with_a_log_its_copies_and_its_verdicts(tmp_path: Path) -> None:
    tracks, spec = write_tracks(run(), tmp_path / "run.jsonl"), parse_specification(SPECIFICATION)
    record_source(open_source(tracks), tmp_path / "bare.mcap", [spec])
    record_source(open_source(tracks), tmp_path / "run.mcap", [spec], unit="m")
    run_replay(open_source(tmp_path / "run.mcap"), [spec], output=tmp_path / "again.mcap")
    for log in (tmp_path / "run.mcap", tmp_path / "again.mcap"):
        assert read_trace(log).units == {"": "m"}
        assert read_trace(log) == read_trace(tmp_path / "bare.mcap")
        verdicts = dict(open_source(log).metadata())[VERDICTS]
        assert verdicts["reach"].endswith(" m")
    assert b"source_axes" not in (tmp_path / "bare.mcap").read_bytes()
    with pytest.raises(UsageError, match="declares lengths in m, not in px"):
        record_source(open_source(tmp_path / "run.mcap"), tmp_path / "px.mcap", unit="px")
    with Recorder(tmp_path / "own.mcap", specifications=spec, units={"": "m", "battery": "V"}) as recorder:
        for sample in run().samples():
            recorder.write(sample)
    assert read_trace(tmp_path / "own.mcap").units == {"": "m", "battery": "V"}


def test_names_that_no_sample_has_are_reported(tmp_path: Path) -> None:
    spec = parse_specification("F cub ovlp cube")
    recorded = record_source(PiecewiseSource(run(), 4), tmp_path / "run.mcap", [spec])
    assert [remark.message for remark in recorded.missing] == ["the log never has the object 'cub'"]


def test_an_interruption_leaves_a_shorter_log_marked_as_interrupted(tmp_path: Path) -> None:
    def interrupt_after_two_blocks(samples: int) -> None:
        done.append(samples)
        if len(done) == 2:
            raise KeyboardInterrupt

    done: list[int] = []
    path = tmp_path / "run.mcap"
    with pytest.raises(KeyboardInterrupt):
        record_source(PiecewiseSource(run(), 5), path, advance=interrupt_after_two_blocks)
    assert read_trace(path) == run(10)
    assert dict(content_of(path).metadata)[ENDING] == {
        "samples": "10",
        "dropped": "0",
        "interrupted": "true",
    }


def test_an_error_before_the_first_sample_leaves_the_output_untouched(tmp_path: Path) -> None:
    output = tmp_path / "run.mcap"
    output.write_bytes(b"before")
    template = parse_specification("spec s(ego) = F ego ovlp cube")
    with pytest.raises(UsageError, match="is a template"):
        record_source(PiecewiseSource(run(), 5), output, [template])
    with pytest.raises(LogError, match="run has no sample"):
        record_source(PiecewiseSource(Trace.from_samples(()), 5), output)
    with pytest.raises(UsageError, match="is an input too"):
        record_source(PiecewiseSource(run(), 5), output, inputs=[output])
    assert output.read_bytes() == b"before"


@dataclass(frozen=True)
class _FailingDisk(PiecewiseSource):
    """A source whose disk fails after its first block."""

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        yield next(super().iter_blocks(start_ns, end_ns))
        raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_source_that_fails_is_named_and_its_samples_up_to_there_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    with pytest.raises(LogError, match=r"^run could not be read: .*; copy it"):
        record_source(_FailingDisk(run(), 5), path)
    assert read_trace(path) == run(5)
    assert dict(content_of(path).metadata)[ENDING]["interrupted"] == "true"


def test_a_replay_of_a_source_that_fails_names_it_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"^run could not be read: "):
        run_replay(_FailingDisk(run(), 5), [parse_specification(SPECIFICATION)], output=tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_reported() -> None:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    with pytest.raises(OutputError, match="/dev/full could not be written: no space left on the device"):
        record_source(PiecewiseSource(run(), 5), Path("/dev/full"))
