"""Damaged logs of messages: what is left is read, and what is lost is reported."""

from __future__ import annotations

import gc
import random
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple

import pytest

from bags.bag_files import (
    MAPPING,
    SECOND,
    START_NS,
    TEXT,
    Sent,
    drive,
    text,
    write_json_mcap,
    write_mcap,
    write_ros1,
    write_ros2,
)
from spatial_replay import LogError, read_trace
from spatial_replay.bags.open import open_messages
from spatial_replay.bags.reader import Message
from spatial_replay.cli import run

SENT = drive(60)


class Log(NamedTuple):
    """A way to write a log of one file.

    Attributes:
        is_checked: whether its container has checksums, so that no change of its messages goes unseen.
    """

    write: Callable[[Path], Path]
    is_checked: bool


LOGS = {
    "ros1": Log(lambda folder: write_ros1(folder / "drive.bag", SENT), False),
    "ros1 bz2": Log(lambda folder: write_ros1(folder / "drive.bag", SENT, compression="bz2"), True),
    "ros1 lz4": Log(lambda folder: write_ros1(folder / "drive.bag", SENT, compression="lz4"), False),
    "mcap cdr": Log(lambda folder: next(write_ros2(folder / "drive", SENT).glob("*.mcap")), False),
    "db3": Log(
        lambda folder: next(write_ros2(folder / "drive", SENT, storage="sqlite3").glob("*.db3")), False
    ),
    "mcap json": Log(
        lambda folder: write_json_mcap(
            folder / "drive.mcap", [(each.topic, each.time_ns, {"x": 1}) for each in SENT]
        ),
        True,
    ),
}


class Outcome(NamedTuple):
    messages: list[Message]
    reported: tuple[str, ...]


def read(path: Path, *, decodes: bool = True) -> Outcome:
    """Return everything that can be read and decoded, and all that is reported about the rest."""
    reader = open_messages(path)
    try:
        topics = reader.topics()
        reported = [topic.unreadable for topic in topics if topic.unreadable]
        messages = list(reader.iter_messages([topic.name for topic in topics]))
        reported += reader.take_faults()
        decodable = [topic.name for topic in topics if decodes and not topic.unreadable]
        decoders = {topic: reader.decoder(topic) for topic in decodable}
    except LogError as error:
        return Outcome([], (str(error),))
    for message in messages:
        try:
            if message.topic in decoders:
                decoders[message.topic](message.payload)
        except LogError as error:
            reported.append(str(error))
    return Outcome(messages, tuple(reported))


@pytest.fixture(scope="module", params=LOGS.values(), ids=LOGS)
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Log]:
    log: Log = request.param
    path = log.write(tmp_path_factory.mktemp("sound"))
    assert read(path).reported == ()
    return path, log


def test_a_log_cut_anywhere_is_reported(sound: tuple[Path, Log], tmp_path: Path) -> None:
    path, _ = sound
    data, whole = path.read_bytes(), read(path).messages
    randomly = random.Random(1)
    cut = tmp_path / path.name
    for size in {randomly.randrange(16, len(data)) for _ in range(60)}:
        cut.write_bytes(data[:size])
        messages, reported = read(cut)
        assert reported, f"cut after {size} bytes"
        assert set(messages) <= set(whole), f"cut after {size} bytes"


def test_a_flipped_bit_is_reported_or_changes_only_itself(sound: tuple[Path, Log], tmp_path: Path) -> None:
    path, log = sound
    data, whole = path.read_bytes(), read(path).messages
    randomly = random.Random(2)
    flipped = tmp_path / path.name
    for _ in range(100):
        position, bit = randomly.randrange(16, len(data)), randomly.randrange(8)
        changed = bytearray(data)
        changed[position] ^= 1 << bit
        flipped.write_bytes(changed)
        messages, reported = read(flipped)
        where = f"bit {bit} of byte {position}"
        if not reported:
            assert len(messages) == len(whole), where
            differing = len(set(messages) - set(whole))
            assert differing == 0 if log.is_checked else differing <= 60, where


def test_a_damaged_chunk_of_a_bag_costs_only_itself(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "drive.bag", SENT, compression="bz2")
    data = bytearray(path.read_bytes())
    middle = data.index(b"BZh9", len(data) // 2)
    data[middle + 20] ^= 0xFF
    path.write_bytes(data)
    messages, reported = read(path)
    assert 150 < len(messages) < 180
    assert "are lost" in reported[0] and "at byte" in reported[0]
    assert any("declares 60 messages on '/a'" in each for each in reported)


def test_a_damaged_chunk_among_chunks_that_overlap_costs_only_itself(tmp_path: Path) -> None:
    # words come a second late, so each chunk holds some from before the one before
    late = sorted(SENT, key=lambda each: each.time_ns + SECOND * (each.topic == "/words"))
    path = write_ros1(tmp_path / "drive.bag", late, compression="bz2")
    whole, reported = read(path)
    assert (len(whole), reported) == (len(SENT), ())
    data = bytearray(path.read_bytes())
    middle = data.index(b"BZh9", len(data) // 2)
    data[middle + 20] ^= 0xFF
    path.write_bytes(data)
    messages, reported = read(path)
    assert 150 < len(messages) < len(whole)
    assert messages == [each for each in whole if each in messages]
    assert "are lost" in reported[0]


def test_a_bag_without_its_index_is_read(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "drive.bag", SENT)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.6)])
    messages, reported = read(path)
    assert len(messages) > 60
    assert "no index" in reported[0] and "cannot be read" in reported[1]


def test_a_damaged_page_of_a_database_costs_only_its_own_messages(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "drive", drive(600), storage="sqlite3").glob("*.db3"))
    whole, _ = read(path)
    data = bytearray(path.read_bytes())
    for page in range(len(data) // 3 // 4096 * 4096, len(data) // 3 // 4096 * 4096 + 2 * 4096, 4096):
        data[page : page + 8] = b"\xff" * 8
    path.write_bytes(data)
    messages, reported = read(path)
    missing = [each for each in whole if each not in messages]
    assert 10 < len(missing) < 200
    assert messages == [each for each in whole if each in messages]
    assert "the database is damaged" in reported[0] and " are lost: rows " in reported[0]
    assert any("declares 600 messages on '/a'" in each for each in reported)


def test_a_database_with_a_damaged_index_loses_no_message(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "drive", drive(600), storage="sqlite3").glob("*.db3"))
    whole, _ = read(path)
    with closing(sqlite3.connect(path)) as database:
        ((page,),) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'timestamp_idx'")
        ((size,),) = database.execute("PRAGMA page_size")
    data = bytearray(path.read_bytes())
    data[(page - 1) * size : page * size] = b"\xff" * size
    path.write_bytes(data)
    messages, reported = read(path)
    assert messages == whole
    assert "every message could be read" in reported[0]


def test_changed_metadata_are_reported_or_harmless(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", SENT[:9])
    metadata = folder / "metadata.yaml"
    said, whole = metadata.read_bytes(), read(folder).messages
    randomly = random.Random(5)
    for _ in range(300):
        changed = bytearray(said)
        for _ in range(randomly.randrange(1, 4)):
            changed[randomly.randrange(len(changed))] = randomly.choice(
                b"0123456789:-[]{}&*!|>'\"#\n abcz\xff"
            )
        metadata.write_bytes(
            changed[: randomly.randrange(len(changed))] if randomly.random() < 0.2 else changed
        )
        messages, reported = read(folder, decodes=False)
        assert reported or messages == whole


def test_a_decompression_bomb_is_refused(tmp_path: Path) -> None:
    nothing = b" " * 2**27
    log = write_mcap(tmp_path / "a.mcap", [("/a", "json", "", "", b"")], [("/a", START_NS, nothing)])
    assert log.stat().st_size < 2**16
    messages, reported = read(log)
    assert not messages
    assert "claims to hold" in reported[0]
    bag = write_ros1(tmp_path / "a.bag", [Sent("/a", TEXT, START_NS, text(" " * 2**27))], compression="bz2")
    assert bag.stat().st_size < 2**16
    messages, reported = read(bag)
    assert not messages
    assert "claims to hold" in reported[0]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_message_that_decompresses_to_a_thousand_times_its_size_is_refused_alone(
    tmp_path: Path, storage: Literal["mcap", "sqlite3"]
) -> None:
    sent = [
        Sent("/a", TEXT, START_NS + number, text(" " * size)) for number, size in enumerate((9, 2**27, 9))
    ]
    bag = write_ros2(tmp_path / "bag", sent, storage=storage, compression="message")
    assert sum(each.stat().st_size for each in bag.iterdir()) < 2**16
    messages, reported = read(bag)
    assert [each.log_time_ns - START_NS for each in messages] == [0, 2]
    assert "a message claims to hold" in reported[0]


@pytest.mark.parametrize("junk", [b"", b"\x00" * 5_000, b"\xff" * 5_000, bytes(range(256)) * 20])
@pytest.mark.parametrize("magic", [b"#ROSBAG V2.0\n", b"SQLite format 3\x00", b"\x89MCAP0\r\n"])
def test_junk_after_a_good_beginning_is_reported(tmp_path: Path, magic: bytes, junk: bytes) -> None:
    path = tmp_path / "junk"
    path.write_bytes(magic + junk)
    messages, reported = read(path)
    assert not messages and reported


def test_a_refused_bag_is_closed_by_whatever_thread_collects_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = [*drive(40), *drive(20)]
    folder = write_ros2(tmp_path / "drive", sent, storage="sqlite3")
    (tmp_path / "m.yaml").write_text("topics: {/a: {position: [x, y], shape: {disc: 1}}}\n")
    (tmp_path / "s.spatial").write_text("G (a ovlp a)\n")
    ignored: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    spec = ["--spec", str(tmp_path / "s.spatial"), "--mapping", str(tmp_path / "m.yaml")]
    assert run(["replay", str(folder), *spec]) == 3
    gc.collect()
    assert not ignored


def unindexed(path: Path, *unknown: tuple[int, bytes]) -> Path:
    """A log of 60 messages without an index, with records of unknown kinds at its beginning."""
    whole = write_json_mcap(path, [(each.topic, each.time_ns, {"x": 1}) for each in SENT]).read_bytes()
    head = 8 + 9 + int.from_bytes(whole[9:17], "little")
    added = b"".join(bytes([kind]) + len(body).to_bytes(8, "little") + body for kind, body in unknown)
    footer = whole[-37:-8]
    data = whole[: int.from_bytes(footer[9:17], "little")]
    path.write_bytes(data[:head] + added + data[head:] + footer[:9] + bytes(20) + whole[-8:])
    return path


def test_records_of_kinds_that_are_not_known_yet_are_skipped(tmp_path: Path) -> None:
    log = unindexed(tmp_path / "a.mcap", (0x42, b"something new"), (0x7F, b""))
    reader = open_messages(log)
    messages = list(reader.iter_messages({"/a", "/b", "/words"}))
    assert (len(messages), reader.take_faults()) == (len(SENT), ())
    assert reader.take_remarks() == ("a.mcap: 2 records of kinds that MCAP reserves for later skipped",)
    assert run(["info", str(log)]) == 0
    assert run(["recover", str(log), "-o", str(tmp_path / "whole.mcap")]) == 0
    whole = open_messages(tmp_path / "whole.mcap")
    assert len(list(whole.iter_messages({"/a", "/b", "/words"}))) == len(SENT)
    # a chunk under the number of another kind is damage
    data = log.read_bytes()
    place = next(at for at in range(len(data)) if data[at] == 6 and data[at + 41 : at + 45] == b"zstd")
    log.write_bytes(data[:place] + b"\x46" + data[place + 1 :])
    reader = open_messages(log)
    assert len(list(reader.iter_messages({"/a", "/b", "/words"}))) < len(SENT)
    assert "there is no record (opcode 70)" in reader.take_faults()[0]


def test_a_write_ahead_log_is_read_with_its_database(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "drive", drive(60), storage="sqlite3").glob("*.db3"))
    killed = tmp_path / "killed"
    killed.mkdir()
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA wal_autocheckpoint=0")
        last = database.execute("SELECT max(id), max(timestamp) FROM messages").fetchone()
        database.execute(
            "INSERT INTO messages SELECT id + ?, topic_id, timestamp + ?, data FROM messages",
            (last[0], last[1] - START_NS + 1),
        )
        for ending in ("", "-wal"):
            copy = killed / (path.name + ending)
            copy.write_bytes(path.with_name(path.name + ending).read_bytes())
    before = {each.name: each.read_bytes() for each in killed.iterdir()}
    reader = open_messages(killed / path.name)
    assert len(list(reader.iter_messages({"/a", "/b", "/words"}))) == 2 * 180
    assert reader.take_faults() == ()
    assert "drive.db3-wal was read, too" in reader.take_remarks()[0]
    assert {each.name: each.read_bytes() for each in killed.iterdir()} == before


@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
def test_a_compressed_file_that_was_cut_is_named(tmp_path: Path, share: float) -> None:
    folder = write_ros2(tmp_path / "drive", drive(3000), compression="file")
    packed = next(folder.glob("*.zstd"))
    packed.write_bytes(packed.read_bytes()[: int(share * packed.stat().st_size)])
    reader = open_messages(folder)
    try:
        count = len(list(reader.iter_messages({"/a", "/b", "/words"})))
        faults = "\n".join(reader.take_faults())
    except LogError as error:
        count, faults = 0, str(error)
    assert f"{packed.name} breaks off" in faults
    assert (count > 0) == (share > 0.1)


def test_a_mapped_topic_that_a_cut_file_lost_is_refused_with_the_file(tmp_path: Path) -> None:
    sent = sorted(drive(3000), key=lambda message: message.topic == "/a")
    folder = write_ros2(tmp_path / "drive", sent, compression="file")
    packed = next(folder.glob("*.zstd"))
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size * 2 // 5])
    mapping = tmp_path / "drive.yaml"
    mapping.write_text(MAPPING)
    with pytest.raises(
        LogError, match=f"'/a' is in none of the bag's files\n(.*\n)*.*{packed.name} breaks off"
    ):
        read_trace(folder, mapping=mapping)
