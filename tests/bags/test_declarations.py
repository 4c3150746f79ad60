"""What logs of messages declare, compared with what a replay reads of them; and what it does not read."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.records import Statistics
from mcap.writer import Writer

from bags.bag_files import (
    POINT,
    SECOND,
    START_NS,
    Sent,
    drive,
    point,
    write_mcap,
    write_ros1,
    write_ros2,
)
from spatial_replay import LogError, read_trace
from spatial_replay.bags.open import McapLog
from spatial_replay.cli import run
from spatial_replay.logs.read_options import FaultList, count_of

MAPPING = "topics: {/a: {position: [x, y], shape: {disc: 0.5}}}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a mapping and a specification that holds."""
    (tmp_path / "m.yaml").write_text(MAPPING)
    (tmp_path / "s.spatial").write_text("G (a dist a <= 1)")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def code_of(command: str, log: Path) -> int:
    return run([command, str(log), "--mapping", "m.yaml", "--spec", "s.spatial"])


def lying_metadata(folder: Path) -> Path:
    bag = write_ros2(folder / "drive", drive(20), storage="sqlite3")
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 20", "message_count: 21"))
    return bag


def lying_type(folder: Path) -> Path:
    bag = write_ros2(folder / "drive", drive(20))
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(POINT, "own_msgs/msg/Point"))
    return bag


def lost_row(folder: Path) -> Path:
    bag = write_ros2(folder / "drive", drive(20), storage="sqlite3")
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        database.execute("DELETE FROM messages WHERE id = 10")
    database.close()
    return bag


def flipped_opcode(folder: Path) -> Path:
    """A message whose record says that it is of a kind that readers pass over."""
    log = write_ros1(folder / "drive.bag", drive(20), chunk_bytes=10**6)
    data = log.read_bytes()
    at = data.index(b"op=\x02", data.index(b"op=\x05"))
    log.write_bytes(data[: at + 3] + b"\x09" + data[at + 4 :])
    return log


def cut(folder: Path) -> Path:
    log = write_ros1(folder / "drive.bag", drive(20))
    log.write_bytes(log.read_bytes()[:-600])
    return log


def mcap_declaring(folder: Path, change: Callable[[Statistics], None]) -> Path:
    """An MCAP log of ten messages whose statistics were changed."""
    path = folder / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for index in range(10):
            writer.add_message(channel, START_NS + index, b'{"x": 1, "y": 2}', START_NS + index, index)
        change(writer._Writer__statistics)  # type: ignore[attr-defined]
        writer.finish()
    return path


def total_lies(statistics: Statistics) -> None:
    statistics.message_count = 12


def only_total(statistics: Statistics) -> None:
    statistics.channel_message_counts.clear()


def only_total_lies(statistics: Statistics) -> None:
    total_lies(statistics)
    only_total(statistics)


@pytest.mark.parametrize("command", ["replay", "explain"])
@pytest.mark.parametrize(
    ("write", "reported"),
    [
        (lying_metadata, "it declares 21 messages on '/a'; 20 could be read"),
        (lying_type, "it declares messages of 'own_msgs/msg/Point' on '/a'"),
        (lost_row, "it declares 20 messages on '/a'; 19 could be read"),
        (flipped_opcode, "it declares 20 messages on '/a'; 19 could be read"),
        (cut, "drive.bag"),
        (lambda folder: mcap_declaring(folder, total_lies), "12 messages, and 10 on its channels"),
        (lambda folder: mcap_declaring(folder, only_total_lies), "12 messages in all; 10 could be read"),
    ],
)
def test_a_log_that_does_not_hold_what_it_declares_is_damaged(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    write: Callable[[Path], Path],
    reported: str,
    command: str,
) -> None:
    assert code_of(command, write(folder)) == 3
    assert reported in " ".join(capsys.readouterr().err.split())


def test_a_sound_log_is_not_damaged(folder: Path) -> None:
    assert code_of("replay", write_ros1(folder / "drive.bag", drive(20))) == 0
    assert code_of("replay", write_ros2(folder / "drive", drive(20))) == 0
    assert code_of("replay", mcap_declaring(folder, only_total)) == 0


def other_type_name(folder: Path) -> Path:
    bag = write_ros2(folder / "drive", drive(20))
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(POINT, POINT.replace("/msg/", "/")))
    return bag


def later_fields(folder: Path) -> Path:
    """An attachment with bytes behind the fields that are known; the log was cut before its index."""
    log = folder / "drive.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for tick in range(9):
            writer.add_message(channel, START_NS + tick * SECOND // 10, b'{"x": 0, "y": 0}', START_NS)
        writer.add_attachment(0, 0, "é.txt", "text/plain", b"some")
        writer.finish()
    data = log.read_bytes()
    at = data.index("é.txt".encode()) - 29
    length = int.from_bytes(data[at + 1 : at + 9], "little")
    end = at + 9 + length
    record = data[at : at + 1] + (length + 4).to_bytes(8, "little") + data[at + 9 : end] + b"more"
    log.write_bytes(data[:at] + record + data[end:])
    return log


def test_a_type_without_its_middle_part_is_the_same_type(folder: Path) -> None:
    assert code_of("replay", other_type_name(folder)) == 0


def test_an_attachment_with_fields_of_a_later_version_is_sound(folder: Path) -> None:
    log = later_fields(folder)
    assert [each.data for each in McapLog(log).attachments()] == [b"some"]


def test_messages_that_are_plain_although_compression_is_declared_are_read(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_ros2(folder / "drive", drive(200), storage="sqlite3", compression="message")
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        rows = database.execute("SELECT id, data FROM messages WHERE id > 90").fetchall()
        plain = [(zstandard.ZstdDecompressor().decompress(data), row) for row, data in rows]
        database.executemany("UPDATE messages SET data = ? WHERE id = ?", plain)
    database.close()
    assert code_of("replay", bag) == 0
    assert "messages on '/a' are plain, the first at" in capsys.readouterr().err


@pytest.mark.parametrize("first", [0, 90])
def test_messages_that_do_not_decompress_are_counted_together(
    folder: Path, first: int, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_ros2(folder / "drive", drive(200), storage="sqlite3", compression="message")
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET data = 'junk' WHERE id > ?", (first,))
        database.execute("UPDATE messages SET data = CAST(data AS BLOB)")
    database.close()
    assert code_of("replay", bag) == 3
    said = capsys.readouterr().err
    assert "a message does not decompress" in said
    assert "more up to" in said
    assert len(said.splitlines()) < 10


def test_a_log_without_a_sample_says_why(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_mcap(folder / "a.mcap", [("/a", "json", "", "", b"")], [("/a", START_NS, b"{")])
    assert code_of("replay", log) == 3
    assert "holds no sample" in capsys.readouterr().err


@pytest.mark.parametrize("count", [40, 4_000])
def test_a_clock_set_far_back_is_detected(folder: Path, count: int) -> None:
    """The two passes share no time: one comes before the other in either order."""
    sent = [
        Sent(
            "/a",
            POINT,
            START_NS + (3600 * SECOND if index < count // 3 else 0) + index * SECOND // 20,
            point(1, 2),
        )
        for index in range(count)
    ]
    log = write_ros1(folder / "a.bag", sent, chunk_bytes=1_000)
    with pytest.raises(LogError, match="time jumps back"):
        read_trace(log, mapping="m.yaml")
    assert code_of("replay", log) == 3
    first = read_trace(log, mapping="m.yaml", on_time_jump="split")
    assert len(first) == count // 3


def test_unmapped_topics_that_cannot_be_decoded_are_remarks(folder: Path) -> None:
    event = b"own_msgs/Request[<=1] request\n" + b"=" * 80 + b"\nMSG: own_msgs/Request\nint32 x\n"
    log = write_mcap(
        folder / "a.mcap",
        [
            ("/a", "json", "", "", b""),
            ("/odd", "sponge", "", "", b""),
            ("/silent", "sponge", "", "", b""),
            ("/ask", "cdr", "own_msgs/srv/Ask_Event", "ros2idl", event),
        ],
        [("/a", START_NS, b'{"x": 1, "y": 2}'), *[("/odd", START_NS + n, b"") for n in range(3)]],
    )
    trace = read_trace(log, mapping="m.yaml")
    (remark,) = trace.remarks
    assert "topic '/odd'" in remark
    assert remark.endswith("messages not read: 3")


def test_faults_are_counted_however_many_there_are(folder: Path) -> None:
    log = write_mcap(
        folder / "a.mcap",
        [("/a", "json", "", "", b"")],
        [("/a", START_NS + n, b'{"x": 1, "y": 2}' if n == 0 else b"{") for n in range(251)],
    )
    faults = read_trace(log, mapping="m.yaml", allow_damage=True).faults
    assert len(faults) == 101
    assert faults[-1].startswith("… and 150 more faults")
    with pytest.raises(LogError, match="… and 249 more;"):
        read_trace(log, mapping="m.yaml")


def test_a_count_goes_from_list_to_list() -> None:
    one, other = FaultList(), FaultList()
    for number in range(70):
        other.add(f"other {number}")
    for number in range(120):
        one.add(f"one {number}")
        if number % 50 == 0:
            one.move_to(other)
    one.move_to(other)
    faults = other.take(last=True)
    assert (len(faults), count_of(faults)) == (101, 190)
    single = FaultList()
    for number in range(101):
        single.add(f"{number}")
    assert "1 more fault of" in single.take(last=True)[-1]


def test_a_full_disk_is_not_a_wrong_path(folder: Path) -> None:
    """The machine is at fault, not the log: its files may not become larger than 10 kB here."""
    bag = write_ros2(folder / "drive", drive(2_000), storage="sqlite3", compression="file")
    program = (
        "import resource, sys; from spatial_replay.cli.application import run;"
        " resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000)); sys.exit(run(sys.argv[1:]))"
    )
    arguments = ["replay", str(bag), "--mapping", "m.yaml", "--spec", "s.spatial"]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False, cwd=folder
    )
    assert done.returncode == 70, done.stderr
    assert "could not be written" in done.stderr
