"""Annotated copies of logs by other software: every message of the source is in them, byte for byte."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import spatial_replay as sr
from bags.bag_files import SECOND, START_NS, TEXT, Sent, drive, text, write_ros1, write_ros2
from replay.runs import content_of, sample
from spatial_replay import UsageError
from spatial_replay.cli import run
from spatial_replay.logs.source import MemorySource
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.loaded_log import LoadedLog, Playback
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.sources import open_source

TURTLES = """\
sample: {topic: /turtle1/pose}
topics:
  /turtle1/pose: {name: a, position: [x, y], shape: {disc: 0.5}}
  /turtle2/pose: {name: b, position: [x, y], shape: {disc: 0.5}}
"""
TAGS = "topics: {/detector/tags: {objects: 'apriltags[*]', name: 'tag{id}', polygon: corners}}"
POSE = "topics: {/pose: {shape: {disc: 0.5}}}"
TALKER = "sample: {topic: /topic}\ntopics: {/rosout: {signals: {level: level}}}"
CARS = """\
topics:
  ground_truth:
    objects: "moving_object[*]"
    name: "vehicle{id}"
    position: base.position
    shape: {box: [base.dimension.length, base.dimension.width, base.dimension.height]}
"""
DRIVE = """\
sample: {topic: /b}
topics:
  /a: {position: [x, y], shape: {disc: 0.5}}
  /b: {position: [x, y], shape: {box: [1, 1]}}
"""
RECORDED: Mapping[str, tuple[str, str]] = {
    "bags/two_turtles.bag": (TURTLES, "F (a dist b >= 1)"),
    "bags/two_turtles_mcap": (TURTLES, "F (a dist b >= 1)"),
    "bags/apriltags_table.bag": (TAGS, "F (tag0 dist tag1 >= 1)"),
    "bags/pose_db3": (POSE, "F (pose dist pose >= 0)"),
    "bags/talker_mcap": (TALKER, "true"),
    "bags/talker_sqlite3": (TALKER, "true"),
    "osi/osi_centerline_example.mcap": (CARS, "F (vehicle192 dist vehicle192 >= 0)"),
}
SPEC = sr.parse_specification("F (a dist b >= 1)")

Written = Counter[tuple[str, int, bytes]]


def _mcap(path: Path) -> Written:
    with path.open("rb") as stream:
        read = make_reader(stream).iter_messages()
        return Counter(
            (channel.topic, each.log_time, each.data)
            for _, channel, each in read
            if not channel.topic.startswith("/spatial/")
        )


def _original(log: Path) -> Written:
    """Read a log with the libraries of its container alone."""
    for file in [log] if log.suffix == ".mcap" else log.glob("*.mcap"):
        return _mcap(file)
    for file in log.glob("*.db3"):
        with closing(sqlite3.connect(file)) as database:
            query = "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id"
            return Counter(database.execute(query).fetchall())
    with Reader1(log) as reader:
        return Counter((each.topic, time_ns, bytes(data)) for each, time_ns, data in reader.messages())


def _write(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def _copy(log: Path, mapping: str, formula: str, folder: Path, *keep: str) -> Path:
    source = open_source(log, mapping=_write(folder / "m.yaml", mapping))
    output = folder / "annotated.mcap"
    spec = sr.parse_specification(formula)
    run_replay(source, [spec], ReplayOptions(keep=keep or ("all",)), output=output)
    return output


@pytest.fixture(scope="module", params=RECORDED)
def recorded(
    request: pytest.FixtureRequest, data_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """The name of a published log, and an annotated copy of it."""
    name: str = request.param
    return name, _copy(data_folder / name, *RECORDED[name], tmp_path_factory.mktemp("copy"))


def test_an_annotated_copy_holds_every_message_of_its_source(
    data_folder: Path, recorded: tuple[str, Path]
) -> None:
    name, copy = recorded
    log = data_folder / name
    assert _mcap(copy) == _original(log)
    again = copy.with_name("again.mcap")
    run_replay(open_source(copy), [sr.parse_specification(RECORDED[name][1])], output=again)
    assert _mcap(again) == _original(log)
    source = open_source(log, mapping=copy.with_name("m.yaml"))
    assert verify_certificate(open_source(copy)).differences == ()
    assert verify_certificate(open_source(copy), source).differences == ()


def test_stock_libraries_decode_every_topic_of_the_copy(
    data_folder: Path, recorded: tuple[str, Path]
) -> None:
    name, copy = recorded
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_FOXY)
    decoded = set()
    with copy.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic in decoded:
                continue
            assert schema is not None
            if channel.message_encoding == "protobuf":
                decode = DecoderFactory().decoder_for("protobuf", schema)
                assert decode is not None
                decode(message.data)
            else:
                is_ros1 = channel.message_encoding == "ros1"
                assert schema.encoding == ("ros1msg" if is_ros1 else "ros2msg")
                type_name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
                store = ros1 if is_ros1 else ros2
                definitions = get_types_from_msg(schema.data.decode(), type_name)
                store.register({key: each for key, each in definitions.items() if key not in store.types})
                if (name, channel.topic) != ("bags/talker_sqlite3", "/rosout"):
                    # that one is in no encoding that anything knows, also in the source
                    (store.deserialize_ros1 if is_ros1 else store.deserialize_cdr)(message.data, type_name)
            decoded.add(channel.topic)
    assert {topic for topic, *_ in _original(data_folder / name)} <= decoded


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    sent = [*drive(), Sent("/camera/left", TEXT, START_NS + 60 * SECOND, text("an image"))]
    _write(tmp_path / "drive.yaml", DRIVE)
    return write_ros1(tmp_path / "drive.bag", sent)


@pytest.mark.parametrize(
    ("keep", "topics"),
    [
        ([], {"/a", "/b", "/words", "/camera/left"}),
        (["all"], {"/a", "/b", "/words", "/camera/left"}),
        (["mapped"], {"/a", "/b"}),
        (["/camera/*"], {"/camera/left"}),
        (["mapped", "/w*"], {"/a", "/b", "/words"}),
    ],
)
def test_keep_says_which_messages_are_copied_and_the_copy_verifies(
    bag: Path, monkeypatch: pytest.MonkeyPatch, keep: list[str], topics: set[str]
) -> None:
    monkeypatch.chdir(bag.parent)
    _write(Path("s.spatial"), "spec s = F (a dist b >= 1)\n")
    options = [option for each in keep for option in ("--topics", each)]
    reading = ["--mapping", "drive.yaml"]
    assert run(["replay", "drive.bag", *reading, "--spec", "s.spatial", "-o", "copy.mcap", *options]) == 0
    expected = {each: count for each, count in _original(bag).items() if each[0] in topics}
    assert _mcap(Path("copy.mcap")) == expected
    assert run(["verify", "copy.mcap"]) == 0
    assert run(["verify", "copy.mcap", "--source", "drive.bag", *reading]) == 0
    about = dict(content_of(Path("copy.mcap")).metadata)["spatial_replay"]
    assert json.loads(about["options"]).get("keep", ["all"]) == (keep or ["all"])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_ros_2_bag_stays_readable_by_rosbags_next_to_what_a_replay_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], storage: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ros2(Path("drive"), drive(), storage=storage)  # type: ignore[arg-type]
    _write(Path("m.yaml"), DRIVE)
    _write(Path("s.spatial"), "spec s = F (a dist b >= 1)\n")

    def read_by_rosbags() -> list[tuple[str, int, bytes]]:
        with Reader2("drive") as reader:
            return [(each.topic, time_ns, bytes(data)) for each, time_ns, data in reader.messages()]

    before, files = read_by_rosbags(), sorted(Path("drive").iterdir())
    replaying = ["replay", "drive", "--mapping", "m.yaml", "--spec", "s.spatial", "-o"]
    assert run([*replaying, "ours.mcap"]) == 0
    assert "ours.mcap is opened next to it" in capsys.readouterr().err
    assert read_by_rosbags() == before
    assert sorted(Path("drive").iterdir()) == files
    assert len(before) == len(drive())
    assert not _mcap(Path("ours.mcap"))
    # ours stands for itself
    for command in ("replay", "explain", "verify"):
        assert run([command, "ours.mcap"]) == 0
    assert run(["verify", "ours.mcap", "--source", "drive", "--mapping", "m.yaml"]) == 0
    assert run([*replaying, "both.mcap", "--topics", "all"]) == 0
    assert _mcap(Path("both.mcap")) == Counter(before)


def test_a_recording_of_a_bag_verifies_against_the_bag(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(bag.parent)
    reading = ["--mapping", "drive.yaml"]
    assert run(["record", "tracks", "drive.bag", *reading, "-o", "run.mcap"]) == 0
    assert run(["verify", "run.mcap", "--source", "drive.bag", *reading]) == 0


def test_a_window_keeps_the_messages_in_it(bag: Path, tmp_path: Path) -> None:
    source = open_source(bag, mapping=tmp_path / "drive.yaml")
    window = Window(START_NS + SECOND, START_NS + 2 * SECOND)
    run_replay(source, [SPEC], ReplayOptions(window), output=tmp_path / "copy.mcap")
    inside = {each: n for each, n in _original(bag).items() if window.start_ns <= each[1] < window.end_ns}
    assert _mcap(tmp_path / "copy.mcap") == inside


def test_keep_applies_to_own_logs_too_and_samples_always_stay(tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        for index in range(4):
            recorder.write(sample(index))
            for topic in ("/joints", "/camera/left", "/camera/right"):
                recorder.channel(topic).write(sample(index).time_ns, {"index": index})
    spec = sr.parse_specification("F (cube dist cube >= 0)")
    for keep, topics in (
        (None, {"/joints", "/camera/left", "/camera/right"}),
        (("mapped",), set()),
        (("/camera/*",), {"/camera/left", "/camera/right"}),
    ):
        copy = tmp_path / "copy.mcap"
        run_replay(open_source(tmp_path / "run.mcap"), [spec], ReplayOptions(keep=keep), output=copy)
        assert {topic for topic, *_ in _mcap(copy)} == topics
        assert sr.read_trace(copy) == sr.read_trace(tmp_path / "run.mcap")
        assert verify_certificate(open_source(copy)).differences == ()
        assert verify_certificate(open_source(copy), open_source(tmp_path / "run.mcap")).differences == ()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-o", "c.mcap", "--topics", "/camrea/*"], "no topic of drive.bag fits '/camrea/*'; it has /a, /b"),
        (["--topics", "all"], "--topics applies to the annotated log; add -o FILE"),
        (["-o", "c.mcap", "--layer", "--topics", "all"], "--layer copies no messages"),
    ],
)
def test_a_keep_that_cannot_work_is_refused(
    bag: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(bag.parent)
    _write(Path("s.spatial"), "F (a dist b >= 1)\n")
    assert run(["replay", "drive.bag", "--mapping", "drive.yaml", "--spec", "s.spatial", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not Path("c.mcap").exists()


def test_keep_is_there_in_python_too(bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    sr.replay_log(bag, SPEC, output=copy, keep=["/camera/*"], mapping=tmp_path / "drive.yaml")
    assert {topic for topic, *_ in _mcap(copy)} == {"/camera/left"}
    with pytest.raises(UsageError, match="give output"):
        sr.replay_log(bag, SPEC, keep="mapped", mapping=tmp_path / "drive.yaml")


def test_a_log_without_messages_has_none_to_keep() -> None:
    samples = [sample(0), sample(1)]
    with pytest.raises(UsageError, match="memory has no messages to keep; it holds samples only"):
        run_replay(MemorySource.from_samples(samples), [SPEC], ReplayOptions(keep=("/a",)))


@pytest.mark.parametrize("keep", [None, ("mapped",)])
def test_a_live_playback_sends_what_a_copy_keeps(
    bag: Path, tmp_path: Path, keep: tuple[str, ...] | None
) -> None:
    source = open_source(bag, mapping=tmp_path / "drive.yaml")
    playback = Playback(LoadedLog(source, [SPEC], ReplayOptions(keep=keep)).evaluate())
    sent: Written = Counter()
    for messages in (playback.seek(playback.start_ns), playback.advance_to(playback.end_ns)):
        for number, time_ns, data in zip(
            messages.channel.tolist(), messages.log_time_ns.tolist(), messages.payloads, strict=True
        ):
            if not messages.channels[number].topic.startswith("/spatial/"):
                sent[messages.channels[number].topic, time_ns, data] += 1
    output = tmp_path / "copy.mcap"
    run_replay(source, [SPEC], ReplayOptions(keep=keep), output=output)
    after = {each: count for each, count in _mcap(output).items() if each[1] >= playback.start_ns}
    assert {each: count for each, count in sent.items() if each[1] >= playback.start_ns} == after


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_of_one_topic_and_time_keep_their_order(tmp_path: Path, storage: str) -> None:
    same = [Sent("/words", TEXT, START_NS + SECOND, text(words)) for words in ("zebra", "ape", "bee")]
    log = write_ros2(tmp_path / "bag", [*drive(), *same], storage=storage)  # type: ignore[arg-type]
    with Reader2(log) as reader:
        wanted = Counter(bytes(data) for each, _, data in reader.messages() if each.topic == "/words")
    first = _copy(log, DRIVE, "F (a dist b >= 1)", tmp_path)
    run_replay(open_source(first), [SPEC], output=tmp_path / "again.mcap")
    orders = []
    for copy in (first, tmp_path / "again.mcap"):
        with copy.open("rb") as stream:
            found = [each.data for _, _, each in make_reader(stream).iter_messages(topics="/words")]
        assert Counter(found) == wanted
        orders.append(found)
    assert orders[0] == orders[1]
    assert verify_certificate(open_source(first)).differences == ()
