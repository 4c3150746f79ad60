"""A second read of a large log takes its samples from columns that the first one left."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest

from spatial_replay import LogError, Trace, read_trace
from spatial_replay.cli import run
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.logs import LogWriter, encode_objects
from spatial_replay.logs.messages import messages_of
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.source import samples_only
from spatial_replay.logs.topics import OBJECTS, protobuf_channel
from spatial_replay.sources import open_source

SAMPLES, SIGNALS = 9_000, 140


def measured(count, seed=1):
    """One object that appears late and is lost at times, and many signals, half of which begin late."""
    numbers = np.random.default_rng(seed)
    rows = np.arange(count)
    rows[:5] = -1
    rows[7::50] = -2 - rows[7::50]
    vertices = numbers.normal(size=(count, 2))
    vertices[7::50, 0] = np.nan
    none = np.full(count, np.nan)
    return Trace(
        times_ns=10**15 + np.cumsum(numbers.integers(1, 10**8, count)),
        names=("cup",),
        rows=rows.reshape(-1, 1),
        footprints=FootprintBatch(
            np.arange(count + 1), np.arange(count + 1), vertices, np.full(count, 0.5), none, none
        ),
        yaw=none,
        uncertainty=np.zeros(count),
        class_code=np.zeros(count, np.int64),
        classes=(None,),
        signals={f"s{n}": _late(numbers.normal(size=count), n % 2) for n in range(SIGNALS)},
    )


def _late(values, unknown):
    values[:unknown] = np.nan
    return values


def write(path, trace):
    with path.open("wb") as stream, LogWriter(stream) as writer:
        channel = protobuf_channel(OBJECTS, ObjectStates)
        writer.write_messages(messages_of(channel, trace.times_ns, encode_objects(trace), 0))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "run.mcap"
    write(path, measured(SAMPLES))
    return path


@pytest.fixture
def log(written, tmp_path):
    return shutil.copy(written, tmp_path / "run.mcap")


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """What is kept, by name; never that of another test, or of the user."""
    monkeypatch.setenv("SPATIAL_REPLAY_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SPATIAL_REPLAY_SAMPLES", raising=False)
    return lambda: sorted((tmp_path / "cache" / "samples").glob("*"))


def test_a_second_read_gives_the_same_samples_from_what_the_first_one_kept(log, kept):
    first = read_trace(log)
    (entry,) = kept()
    os.utime(entry, (1, 1))
    assert read_trace(log) == first == measured(SAMPLES).compact()
    assert entry.stat().st_mtime > 1, "the entry was not used"
    assert read_trace(log, concave="hull") == first
    assert len(kept()) == 2, "how a log is read is part of its key"


def test_a_window_of_what_was_kept_is_the_window_of_the_log(log, kept, monkeypatch):
    source = samples_only(open_source(log))
    times = measured(SAMPLES).times_ns
    windows = [(None, int(times[70])), (int(times[8_195]), int(times[8_200])), (int(times[-3]), None)]
    read = [Trace.concatenate([block.trace for block in source.iter_blocks(*each)]) for each in windows]
    assert not kept(), "a part of a log is no entry"
    read_trace(log)
    again = [Trace.concatenate([block.trace for block in source.iter_blocks(*each)]) for each in windows]
    assert again == read
    assert list(map(len, read)) == [70, 5, 3]


def test_a_log_that_changes_is_read_again_though_its_size_and_time_stay(log, kept):
    state = log.stat()
    read_trace(log)
    write(log, measured(SAMPLES, seed=2))
    with log.open("ab") as stream:
        stream.truncate(state.st_size)
    os.utime(log, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert read_trace(log, allow_damage=True).times_ns[3] == measured(SAMPLES, seed=2).times_ns[3]


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_entry_is_never_believed(log, kept, seed):
    first = read_trace(log)
    (entry,) = kept()
    whole = entry.read_bytes()
    content = bytearray(whole)
    place = int(np.random.default_rng(seed).integers(len(content)))
    if seed % 2:
        content[place] ^= 1 << seed
    else:
        del content[place:]
    entry.write_bytes(content)
    assert read_trace(log) == first
    # the next read of the whole log writes it again
    assert read_trace(log) == first
    assert kept()[0].read_bytes() == whole


def test_only_a_log_that_was_read_to_its_end_without_damage_is_kept(log, kept):
    blocks = samples_only(open_source(log)).iter_blocks()
    next(blocks)
    blocks.close()
    assert not kept()
    log.write_bytes(log.read_bytes()[:-200])
    for _ in range(2):
        with pytest.raises(LogError, match="its writer was interrupted"):
            read_trace(log)
        assert len(read_trace(log, allow_damage=True)) > 8_000
    assert not kept()


def test_small_logs_leave_nothing_behind(tmp_path, kept):
    write(tmp_path / "small.mcap", measured(200))
    read_trace(tmp_path / "small.mcap")
    assert not kept()


def test_a_replay_prints_the_same_with_the_cache_and_without(log, kept, tmp_path, capsys):
    spec = tmp_path / "near.spatial"
    spec.write_text("spec near = F (s1 >= 3) and G (s3 <= 9)")
    printed = []
    for options in (["--no-cache"], [], [], ["--no-cache"]):
        code = run(["replay", str(log), "--spec", str(spec), *options])
        printed.append((code, capsys.readouterr()))
        assert len(kept()) == (0 if len(printed) == 1 else 1)
    assert printed[1:] == printed[:1] * 3
    assert "SPATIAL_REPLAY_SAMPLES" not in os.environ


def test_what_was_not_used_for_longest_makes_room_unless_it_was_used_lately(log, kept, tmp_path, monkeypatch):
    monkeypatch.setenv("SPATIAL_REPLAY_SAMPLES", "0.04")
    logs = [shutil.copy(log, tmp_path / f"{n}.mcap") for n in range(3)]
    read_trace(logs[0])
    (first,) = kept()
    os.utime(first, (1, 1))
    read_trace(logs[1])
    (second,) = set(kept()) - {first}
    os.utime(second, (2, 2))
    read_trace(logs[2])
    (third,) = set(kept()) - {first, second}
    assert first not in kept(), "the oldest one is still there"
    assert sum(entry.stat().st_size for entry in kept()) <= 40_000_000
    for entry in kept():
        os.utime(entry)
    read_trace(logs[0])
    assert set(kept()) == {second, third}
    monkeypatch.setenv("SPATIAL_REPLAY_SAMPLES", "0")
    os.utime(third, (3, 3))
    read_trace(logs[2])
    assert third.stat().st_mtime == 3, "there was to be no cache"
