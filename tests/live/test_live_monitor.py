"""A running robot, over real connections: what a monitor makes of it, and what it leaves on the disk."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import aclosing, contextmanager, suppress
from pathlib import Path

import foxglove
import numpy as np
import pytest
from mcap.reader import make_reader
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

import spatial_replay as sr
from bags.bag_files import write_mcap
from cli.program import PROGRAM, environment
from live.robots import (
    MAPPING,
    MS,
    PATIENCE_S,
    SPEC,
    Player,
    bridge,
    drive,
    files,
    frame,
    messages_of,
    occurrences,
    playing,
    pose,
    robot,
    rude_server,
    until,
)
from spatial_replay import LogError, Sample, Trace, Trigger, UsageError
from spatial_replay.bags.open import open_messages
from spatial_replay.cli import run
from spatial_replay.live import LiveSession, LiveUpdate, monitor
from spatial_replay.live.client import LARGEST_FRAME, Client, Inbox, Received
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.topics import OBJECTS, ROBUSTNESS, SCENE

TURTLES = """
topics:
  /turtle1/pose: {shape: {disc: 0.5}}
  /turtle2/pose: {shape: {disc: 0.5}}
sample: {topic: /turtle2/pose}
"""
FRAMES = """
fixed_frame: world
topics:
  /tf: {shape: {disc: 0.5}}
"""
APART = "spec apart = G (turtle1 dist turtle2 >= 0.5)\nspec near = F (turtle1 dist turtle2 <= 9)\n"


async def updates_of(
    address: str,
    spec: Path,
    mapping: Path | None,
    until: int | Callable[[LiveUpdate], bool],
    **options: object,
) -> list[LiveUpdate]:
    """The first so many updates of a monitor, or those up to one that is wanted."""
    found: list[LiveUpdate] = []
    async with asyncio.timeout(PATIENCE_S):
        async with aclosing(monitor(address, sr.load_specification(spec), mapping, **options)) as updates:  # type: ignore[arg-type]
            async for update in updates:
                found.append(update)
                if until(update) if callable(until) else len(found) == until:
                    break
    return found


def last_of(expected: Trace) -> Callable[[LiveUpdate], bool]:
    """Say of an update whether it is that of the last sample."""
    return lambda update: update.time_ns == int(expected.times_ns[-1])


def assert_samples_of(found: list[LiveUpdate], expected: Trace) -> None:
    """The updates are those of a trace but for samples that came too late, which are counted."""
    seen = {update.time_ns for update in found}
    assert Trace.from_samples(update.sample for update in found) == Trace.from_samples(
        sample for sample in expected.samples() if sample.time_ns in seen
    )
    assert len(found) + found[-1].dropped == len(expected)


@pytest.mark.parametrize(
    ("name", "mapping", "topics"),
    [
        ("two_turtles.bag", TURTLES, ("/turtle1/pose", "/turtle2/pose")),
        ("two_turtles_mcap", FRAMES, ("/tf",)),
    ],
    ids=["ROS 1", "ROS 2, transforms"],
)
def test_a_bag_that_a_server_plays_gives_the_samples_of_the_bag(
    data_folder: Path, tmp_path: Path, name: str, mapping: str, topics: tuple[str, ...]
) -> None:
    bag, output = data_folder / "bags" / name, tmp_path / "live.mcap"
    mapped, spec = files(tmp_path, mapping, APART)
    whole = sr.read_trace(bag, mapping=mapped)
    first_ns = open_messages(bag).start_ns or 0
    expected = whole.slice(0, int((whole.times_ns < first_ns + 3 * 10**9).sum()))
    with playing(bag, *topics, end=3, speed=1.5) as player:
        found = asyncio.run(updates_of(player.address, spec, mapped, last_of(expected), output=output))
    assert_samples_of(found, expected)
    # the log of the run gives the same numbers as the monitor, and has the messages as they came
    replayed = sr.evaluate(sr.load_specification(spec), sr.read_trace(output))
    for node in ("apart", "near"):
        ours = np.array([(each.node(node).value, each.node(node).upper) for each in found]).T
        theirs = (replayed.node(node).value, replayed.node(node).upper)
        assert np.array_equal(ours, np.array(theirs), equal_nan=True)
    wanted = [
        (each.topic, each.log_time_ns, each.payload)
        for each in open_messages(bag).iter_messages(topics, None, int(expected.times_ns[-1]) + 1)
    ]
    assert set(wanted) <= set(messages_of(output))


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
@pytest.mark.parametrize(
    ("name", "mapping", "topics"),
    [
        ("two_turtles.bag", TURTLES, ("/turtle1/pose", "/turtle2/pose")),
        ("two_turtles_mcap", FRAMES, ("/tf",)),
    ],
    ids=["ROS 1", "ROS 2"],
)
def test_a_bridge_of_ros_gives_the_samples_of_the_bag_that_the_robot_records(
    data_folder: Path, tmp_path: Path, name: str, mapping: str, topics: tuple[str, ...], protocol: str
) -> None:
    bag = data_folder / "bags" / name
    mapped, spec = files(tmp_path, mapping, APART)
    whole = sr.read_trace(bag, mapping=mapped)
    first_ns = open_messages(bag).start_ns or 0
    expected = whole.slice(0, int((whole.times_ns < first_ns + 10**9).sum()))
    with bridge(bag, *topics, protocol=protocol, end=1, speed=2) as address:
        found = asyncio.run(updates_of(address, spec, mapped, last_of(expected)))
    assert_samples_of(found, expected)
    assert any("foxglove_bridge" in note for note in found[0].notes)
    assert any("Send buffer limit reached" in note for each in found for note in each.notes)


def test_a_server_of_ours_needs_no_mapping(tmp_path: Path) -> None:
    log = Path(__file__).parents[2] / "recordings" / "push.mcap"
    expected = sr.read_trace(log).slice(0, 20)
    spec = tmp_path / "far.spatial"
    spec.write_text("spec far = G (red dist blue >= 0)")
    with playing(log, OBJECTS, speed=2, end=2) as player:
        found = asyncio.run(updates_of(player.address, spec, None, last_of(expected)))
    assert_samples_of(found, expected)


def test_what_a_lost_connection_hides_is_unknown_until_it_is_back(data_folder: Path, tmp_path: Path) -> None:
    bag, output = data_folder / "bags" / "two_turtles.bag", tmp_path / "live.mcap"
    mapped, spec = files(tmp_path, TURTLES, APART)
    topics = ("/turtle1/pose", "/turtle2/pose")
    found: list[LiveUpdate] = []
    ends: list[str] = []

    async def watch(players: list[Player]) -> None:
        session = LiveSession(players[0].address, sr.load_specification(spec), mapped, recorders=[recorder])
        async with asyncio.timeout(PATIENCE_S):
            async for update in session.updates():
                found.append(update)
                if update.sample.unknown and len(players) == 1:
                    port = players[0].port
                    players.append(await asyncio.to_thread(Player, bag, *topics, begin=3, end=4, port=port))
                elif len(players) == 2 and len(found) > lost() + 20:
                    break
                elif len(players) == 1 and len(found) == 60:
                    # in the middle of a message, for all that is known
                    players[0].kill()
        ends.extend(str(each.verdict) for each in session.endings())

    def lost() -> int:
        return next((place for place, each in enumerate(found) if each.sample.unknown), 10**9)

    players = [Player(bag, *topics, end=2)]
    try:
        with sr.Recorder(output, specifications=[sr.load_specification(spec)]) as recorder:
            asyncio.run(watch(players))
    finally:
        for player in players:
            player.kill()
    gap = found[lost()]
    # the log says so, and a replay of it gives the same results
    assert [(each.time_ns, each.what) for each in occurrences(output)] == [
        (gap.sample.time_ns, "connection lost")
    ]
    assert run(["verify", str(output)]) == 0
    assert gap.sample.objects == {} and set(gap.sample.unknown) == {"turtle1", "turtle2"}
    assert gap.sample.time_ns > found[lost() - 1].sample.time_ns
    # samples that were waiting for their time may come before the gap, and bring the note
    notes = [note for each in found[: lost() + 1] for note in each.notes]
    assert any("is lost" in note and "unknown" in note for note in notes)
    assert set(found[-1].sample.objects) == {"turtle1", "turtle2"}
    # nothing was violated, and yet nothing is known of the time between
    assert ends == ["unknown", "satisfied"]
    replayed = sr.evaluate(sr.load_specification(spec), sr.read_trace(output))
    assert [str(each.verdict) for each in replayed.results] == ends
    assert len(messages_of(output)) > 2 * len(found)


def test_every_message_around_a_violation_is_in_its_clip(data_folder: Path, tmp_path: Path) -> None:
    bag, clips = data_folder / "bags" / "two_turtles.bag", tmp_path / "clips"
    mapped, spec = files(tmp_path, TURTLES, "spec apart = G (turtle1 dist turtle2 >= 1)")
    topics = ("/turtle1/pose", "/turtle2/pose")
    command = ["--mapping", str(mapped), "--spec", str(spec), "--clips", str(clips), "--before", "1s"]
    with playing(bag, *topics, end=8) as player:

        def end() -> None:
            player.wait()
            until(lambda: (clips / "0001-apart-violated.mcap").exists())
            os.kill(os.getpid(), signal.SIGINT)

        ending = threading.Thread(target=end)
        ending.start()
        assert run(["monitor", player.address, *command, "--after", "500ms"]) == 1
        ending.join()
    [clip] = sorted(clips.iterdir())
    assert clip.name == "0001-apart-violated.mcap"
    with clip.open("rb") as stream:
        records = {each.name: each.metadata for each in make_reader(stream).iter_metadata()}
    at_ns = int(records["spatial_replay_trigger"]["time_ns"])
    wanted = [
        (each.topic, each.log_time_ns, each.payload)
        for each in open_messages(bag).iter_messages(topics, at_ns - 10**9, at_ns + 5 * 10**8 + 1)
    ]
    kept = messages_of(clip)
    assert [each for each in kept if each[0] in topics] == sorted(wanted, key=lambda each: (each[1], each[0]))
    assert {SCENE, ROBUSTNESS, OBJECTS} <= {topic for topic, _, _ in kept}
    assert str(sr.evaluate(sr.load_specification(spec), sr.read_trace(clip)).verdict) == "violated"


def test_the_program_ends_at_the_violation_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    with robot() as own:
        driving = drive(own, range(120))
        code = run(
            ["monitor", own.address, "--mapping", str(mapped), "--spec", str(spec), "--until", "violated"]
        )
        driving.join()
    shown = capsys.readouterr().out
    assert code == 1
    assert "`clear` holds so far" in shown
    assert "vase" in shown.partition("violated")[2] and "too close to vase" in shown
    assert "clear  violated" in shown and "seen   satisfied" in shown
    assert "`seen` is permanently satisfied: `robot dist vase <= 9` holds by 8.2 at 0.000 s." in shown


def test_what_a_silent_topic_reported_is_unknown(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    with robot() as own:
        driving = drive(own, range(20))
        clips, event = tmp_path / "clips", Trigger("event", before_s=1, after_s=0)
        options = {"topic_timeout_s": 0.5, "clips": clips, "trigger": event}
        found = asyncio.run(
            updates_of(own.address, spec, mapped, lambda each: len(each.sample.unknown) == 2, **options)
        )
        driving.join()
    last, unknown = found[-1], [each for each in found if each.sample.unknown]
    assert set(last.sample.unknown) == {"robot", "vase"}
    assert last.node("clear").lower == float("-inf")
    assert unknown[0].sample.time_ns == found[found.index(unknown[0]) - 1].sample.time_ns + 1
    # it is an event, which a trigger may wait for
    silences = [each for clip in sorted(clips.iterdir()) for each in occurrences(clip)]
    assert "silence on /" in silences[0].what and silences[0].time_ns == unknown[0].sample.time_ns
    assert silences[0].sentence in unknown[0].notes


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_frames_that_break_the_protocol_are_left_out_and_said(tmp_path: Path, protocol: str) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    nonsense = ["{", "[]", '{"op": "advertise", "channels": [{"id": "x"}]}', b"", b"\x01\x02", b"\x63abc"]
    late = frame(1, 2**64 - 1, b"{}")
    sent = [
        pose(2, 0),
        pose(1, 0),
        *nonsense,
        late,
        frame(1, 5, b'{"x": "far"}'),
        frame(9, 5, b""),
        pose(1, 3),
    ]
    with rude_server(*sent, protocol=protocol) as address:
        found = asyncio.run(updates_of(address, spec, mapped, 2))
    assert [each.time_ns for each in found] == [1, 30_000_001]
    notes = " ".join(note for each in found for note in each.notes)
    assert "is not JSON" in notes and "such frames are left out" in notes


def test_a_server_that_goes_away_in_the_middle_of_a_message_leaves_a_whole_log(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    output = tmp_path / "live.mcap"
    with rude_server(pose(2, 0), pose(1, 0), breaks_off=True) as address:
        found = asyncio.run(updates_of(address, spec, mapped, 2, output=output))
    assert any("is lost: it broke off" in note for note in found[1].notes)
    assert set(found[1].sample.unknown) == {"robot", "vase"}
    assert len(sr.read_trace(output)) == 2
    assert [each.what for each in occurrences(output)] == ["connection lost"]


def test_a_huge_frame_ends_the_connection_and_not_the_run(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    huge = bytes(LARGEST_FRAME + 1)
    with rude_server(pose(2, 0), pose(1, 0), huge, pose(1, 1)) as address:
        found = asyncio.run(updates_of(address, spec, mapped, 2))
    assert any("a frame of more than 64 MB" in note for note in found[1].notes)
    assert set(found[1].sample.unknown) == {"robot", "vase"}


def test_what_a_server_floods_with_is_bounded_and_ctrl_c_ends_the_run(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    channel = {"topic": "/more", "encoding": "json", "schemaName": "", "schema": ""}
    status = json.dumps({"op": "status", "level": 1, "message": "look out"})
    sent: list[str | bytes] = []
    for tick in range(100):
        sent += [pose(2, tick), pose(1, tick)]
        for number in range(200):
            offered = {**channel, "id": 100 + 200 * tick + number}
            sent += [json.dumps({"op": "advertise", "channels": [offered]}), status]
    with rude_server(*sent) as address:
        command = [*PROGRAM, "monitor", address, "--mapping", str(mapped), "--spec", str(spec)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        with subprocess.Popen(command, env=environment(), text=True, **pipes) as process:
            assert process.stdout is not None
            said = next(line for line in process.stdout if "too many warnings" in line)
            process.send_signal(signal.SIGINT)
            rest, _ = process.communicate(timeout=PATIENCE_S)
    assert "look out" not in said + rest


def test_large_messages_that_wait_are_bounded_by_their_bytes() -> None:
    inbox = Inbox()
    for tick in range(100):
        inbox.put(Received(Channel("/camera", "json", None), tick, bytes(2**20), 0.0))
    waiting = [item.time_ns for item in inbox.take() if isinstance(item, Received)]
    assert waiting == list(range(36, 100))
    assert inbox.dropped == 36


def test_frames_of_a_server_that_reads_no_answer_wait_there() -> None:
    channels = [{"id": number, "topic": "/more", "encoding": "json"} for number in range(20_000)]
    advertised = json.dumps({"op": "advertise", "channels": channels, "more": "x" * 2**22})
    sent = 0

    async def offer(connection: ServerConnection) -> None:
        nonlocal sent
        with suppress(ConnectionClosed):
            while True:
                await connection.send(advertised)
                sent += 1

    async def sent_at_most() -> int:
        listening = socket.create_server(("127.0.0.1", 0))
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**16)
        protocols = [Subprotocol("foxglove.sdk.v1")]
        async with serve(offer, sock=listening, subprotocols=protocols, max_size=None, max_queue=1) as server:
            address = f"ws://127.0.0.1:{listening.getsockname()[1]}"
            client = asyncio.create_task(Client(address, lambda topic: True, Inbox()).run())
            last, turns = 0, 0
            # both are in this thread: nothing moves any more once many turns changed nothing
            while turns < 1_000 and sent < 50:
                await asyncio.sleep(0)
                last, turns = sent, (turns + 1 if last == sent > 0 else 0)
            client.cancel()
            for connection in server.connections:
                connection.transport.abort()
        return last

    # also those in buffers of the system
    assert asyncio.run(sent_at_most()) < 20


def test_definitions_without_end_end_the_connection(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    long = {"topic": "/more", "encoding": "json", "schemaName": "long", "schema": "x" * 2**24}
    advertised = [
        json.dumps({"op": "advertise", "channels": [{**long, "id": 100 + number}]}) for number in range(6)
    ]
    with rude_server(pose(2, 0), pose(1, 0), *advertised, pose(1, 1)) as address:
        found = asyncio.run(updates_of(address, spec, mapped, 2))
    assert any("bytes of definitions" in note for note in found[1].notes)


def test_a_clock_that_jumps_back_ends_the_run_with_a_whole_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    output = tmp_path / "live.mcap"
    sent = [*(pose(number, tick, 2.0) for tick in range(300, 310) for number in (2, 1)), pose(1, 5)]
    with rude_server(*sent) as address:
        code = run(["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "-o", str(output)])
    assert code == 3
    assert "time jumps back" in capsys.readouterr().err
    assert len(sr.read_trace(output)) == 10


def test_a_flood_drops_old_samples_counts_them_and_evaluates_the_newest(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    sent = [pose(number, tick, 2.0) for tick in range(12_000) for number in (2, 1)]
    status = []

    async def watch(address: str) -> None:
        session = LiveSession(address, sr.load_specification(spec), mapped)
        async with asyncio.timeout(PATIENCE_S):
            async for update in session.updates():
                if not session.status.dropped:
                    # a caller that is slower than the robot
                    time.sleep(0.02)
                if update.time_ns == 11_999 * 10 * 10**6 + 1:
                    break
        status.append(session.status)

    with rude_server(*sent) as address:
        asyncio.run(watch(address))
    assert status[0].dropped > 0
    assert status[0].samples + status[0].dropped <= 12_000


@pytest.mark.parametrize(
    ("address", "code", "said"),
    [
        ("ws://127.0.0.1:9", 3, "start foxglove_bridge or the server there first"),
        ("robot:8765", 2, "write it as ws://robot:8765"),
        ("http://127.0.0.1:8765", 2, "write it as ws://robot:8765"),
    ],
)
def test_a_server_that_is_not_there_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], address: str, code: int, said: str
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    assert run(["monitor", address, "--mapping", str(mapped), "--spec", str(spec)]) == code
    assert said in capsys.readouterr().err


def test_a_mapping_that_does_not_fit_the_server_is_an_error_with_a_hint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING.replace("/robot", "/robott"), SPEC)
    with robot() as own:
        assert run(["monitor", own.address, "--mapping", str(mapped), "--spec", str(spec)]) == 2
    assert "did you mean '/robot'?" in capsys.readouterr().err
    mapped, spec = files(tmp_path, MAPPING.replace("[x, y]", "[east, north]"), SPEC)
    with rude_server(*(pose(number, tick) for tick in range(120) for number in (2, 1))) as address:
        assert run(["monitor", address, "--mapping", str(mapped), "--spec", str(spec)]) == 2
    assert "east" in capsys.readouterr().err


def kept_by(folder: Path, trigger: Trigger, count: int = 60, **options: int) -> sr.Recorder:
    """Record samples every 100 ms, in which a cube comes nearer, and a message of a size with each."""
    spec = sr.parse_specification("spec far = G (cube dist wall >= 1)")
    recorder = sr.Recorder(folder, specifications=[spec], trigger=trigger)
    with recorder:
        camera = recorder.channel("/camera")
        for tick in range(count):
            box = {"cube": sr.Footprint.box(5 - tick / 10, 0, 5.1 - tick / 10, 1)}
            camera.write(tick * 10**8, {"picture": "x" * options.get("size", 10)})
            time.sleep(options.get("pause_ms", 0) / 1000)
            recorder.write(Sample(tick * 10**8, {**box, "wall": sr.Footprint.box(-1, 0, 0, 1)}))
    return recorder


@pytest.mark.parametrize(
    ("when", "name", "at"),
    [
        ("violated", "0001-far-violated.mcap", 41),
        ("far violated", "0001-far-violated.mcap", 41),
        ("far < 2.05", "0001-far-below-2-05.mcap", 20),
        ("event", "0001-event.mcap", 41),
    ],
)
def test_a_recorder_keeps_what_is_around_its_trigger(tmp_path: Path, when: str, name: str, at: int) -> None:
    recorder = kept_by(tmp_path, Trigger(when, before_s=1, after_s=0.5))
    [clip] = recorder.clips
    assert (clip.path.name, clip.time_ns, clip.held_s) == (name, at * 10**8, 1.0)
    trace = sr.read_trace(clip.path)
    assert trace.times_ns.tolist() == [tick * 10**8 for tick in range(at - 10, at + 6)]
    assert len([each for each in messages_of(clip.path) if each[0] == "/camera"]) == 16
    # seconds are those of the run, also when the clip is evaluated by itself
    (result,) = sr.replay_log(clip.path).results
    assert result.violated_at_ns is None or " 4.100 s" in result.explain()


@pytest.mark.parametrize(
    ("when", "at", "name"),
    [
        ("far < 2.05", 20, "0001-far-below-2-05.mcap"),
        ("far < 2.05 possible", 3, "0001-far-possibly-below-2-05.mcap"),
    ],
)
def test_a_trigger_fires_after_an_unknown_sample(tmp_path: Path, when: str, at: int, name: str) -> None:
    spec = sr.parse_specification("spec far = G (cube dist wall >= 1)")
    wall = sr.Footprint.box(-1, 0, 0, 1)
    with sr.Recorder(
        tmp_path, specifications=[spec], trigger=Trigger(when, before_s=1, after_s=0)
    ) as recorder:
        for tick in range(40):
            cube = {} if tick == 3 else {"cube": sr.Footprint.box(5 - tick / 10, 0, 5.1 - tick / 10, 1)}
            recorder.write(Sample(tick * 10**8, {**cube, "wall": wall}))
    [clip] = recorder.clips
    assert (clip.path.name, clip.time_ns) == (name, at * 10**8)


def test_clips_of_triggers_far_apart_have_no_holes(tmp_path: Path) -> None:
    spec = sr.parse_specification("spec low = G (load <= 1)\nspec lower = G (load <= 2)")
    trigger = Trigger(["low violated", "lower violated"], before_s=0.5, after_s=0.5)
    samples = [
        Sample(tick * 10**8, signals={"load": 2.0 * (tick >= 20) + (tick >= 80)}) for tick in range(120)
    ]
    with sr.Recorder(tmp_path, specifications=[spec], trigger=trigger) as recorder:
        # a loop that is faster than its clock
        for sample in samples:
            recorder.write(sample)
    first, second = (sr.read_trace(clip.path).times_ns.tolist() for clip in recorder.clips)
    assert first == [tick * 10**8 for tick in range(15, 26)]
    assert second == [tick * 10**8 for tick in range(75, 86)]


@pytest.mark.parametrize("period_ms", [10, 100])
def test_each_trigger_by_hand_keeps_what_is_around_its_own_sample(tmp_path: Path, period_ms: int) -> None:
    period_ns, near = period_ms * MS, 500 // period_ms
    firing = {100: "at100", 300: "at300", 500: "at500"}
    with sr.Recorder(tmp_path, trigger=Trigger("manual", before_s=0.5, after_s=0.5)) as recorder:
        recorder.trigger("start")
        # a loop that is faster than its clock
        for tick in range(600):
            recorder.write(Sample(tick * period_ns, signals={"load": 1.0}))
            if tick in firing:
                recorder.trigger(firing[tick])
    assert [(clip.reason, clip.time_ns) for clip in recorder.clips] == [
        ("start", 0),
        *((reason, tick * period_ns) for tick, reason in firing.items()),
    ]
    for tick, clip in zip((0, *firing), recorder.clips, strict=True):
        times_ns = sr.read_trace(clip.path).times_ns.tolist()
        assert times_ns == [at * period_ns for at in range(max(tick - near, 0), tick + near + 1)]


def test_a_trigger_by_hand_keeps_what_is_around_its_message_where_samples_stopped(tmp_path: Path) -> None:
    with sr.Recorder(tmp_path, trigger=Trigger("manual", before_s=0.5, after_s=0.5)) as recorder:
        camera = recorder.channel("/camera")
        recorder.write(Sample(0, signals={"load": 1.0}))
        for tick in range(600):
            camera.write(tick * 10**8, {"tick": tick})
            if tick == 300:
                recorder.trigger("looked odd")
    [clip] = recorder.clips
    assert clip.time_ns == 300 * 10**8
    ticks = [json.loads(data)["tick"] for topic, _, data in messages_of(clip.path) if topic == "/camera"]
    assert ticks == [*range(295, 306)]


def test_a_ring_stays_within_its_bytes_and_says_what_it_cannot_hold(tmp_path: Path) -> None:
    recorder = kept_by(
        tmp_path, Trigger("violated", before_s=3, after_s=0, most_bytes=2**21), size=2**18, pause_ms=10
    )
    [clip] = recorder.clips
    assert 0.2 < clip.held_s < 1.0
    [remark] = [each for each in recorder.take_remarks() if "the ring of" in each]
    assert "not the 3 s asked for" in remark
    kept = [json.loads(data)["picture"] for topic, _, data in messages_of(clip.path) if topic == "/camera"]
    assert all(len(each) == 2**18 for each in kept) and len(kept) in range(4, 9)


@pytest.mark.parametrize(
    ("when", "said"),
    [
        ("fra violated", "did you mean 'far'"),
        ("far", "is not understood"),
        ("far < low", "is not understood"),
    ],
)
def test_a_trigger_that_cannot_fire_is_an_error(tmp_path: Path, when: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        kept_by(tmp_path, Trigger(when))


def test_time_that_jumps_back_is_an_error_in_python(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    with (
        rude_server(pose(2, 300), pose(1, 300), pose(1, 5)) as address,
        pytest.raises(LogError, match="back"),
    ):
        asyncio.run(updates_of(address, spec, mapped, 9))


def test_every_sample_that_was_evaluated_is_in_the_log_however_slow_its_writer_is(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    output, safe = tmp_path / "live.mcap", sr.load_specification(spec)
    sent = [pose(number, tick, 2.0) for tick in range(1_500) for number in (2, 1)]
    found: list[LiveUpdate] = []

    async def watch(address: str) -> None:
        # of a queue this short, most samples find no place at once
        with sr.Recorder(output, specifications=[safe], waiting=8, block=False) as recorder:
            session = LiveSession(address, safe, mapped, recorders=[recorder])
            async with asyncio.timeout(PATIENCE_S), aclosing(session.updates()) as updates:
                async for update in updates:
                    found.append(update)
                    if update.time_ns == 1_499 * 10 * MS + 1:
                        break
            assert recorder.dropped == session.status.dropped

    with rude_server(*sent) as address:
        asyncio.run(watch(address))
    assert sr.read_trace(output) == Trace.from_samples(update.sample for update in found)


def last_tick_of(log: Path) -> int:
    """The tick of the last sample in a log that is being written."""
    times_ns = sr.read_trace(log, allow_damage=True).times_ns if log.stat().st_size else []
    return int(times_ns[-1]) // (10 * MS) if len(times_ns) else -1


def test_a_monitor_that_was_stopped_for_a_second_has_all_that_it_evaluated_in_its_log_and_clip(
    tmp_path: Path,
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    output, clips = tmp_path / "live.mcap", tmp_path / "clips"
    command = [sys.executable, "-m", "spatial_replay", "monitor", "", "--mapping", str(mapped)]
    command += ["--spec", str(spec), "-o", str(output), "--clips", str(clips), "--trigger", "manual"]
    with robot() as own:
        command[4] = own.address
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "SPATIAL_REPLAY_KERNELS": "interpreted"},
        )
        try:
            until(own.is_heard)
            for tick in range(300):
                own.drive(tick, 2.0)
                if tick == 100:
                    process.send_signal(signal.SIGSTOP)
                if tick == 240:
                    process.send_signal(signal.SIGCONT)
                time.sleep(0.01)
            until(lambda: last_tick_of(output) == 299)
            process.send_signal(signal.SIGUSR1)
            until(lambda: bool(list(clips.glob("*.mcap"))))
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    trace = sr.read_trace(output)
    assert process.returncode == 0
    assert f"{len(trace)} samples over" in said
    # one that had come when it was stopped may be too old afterwards: it is left out everywhere, and counted
    dropped = 300 - len(trace)
    assert {*trace.times_ns.tolist()} <= {tick * 10 * MS + 1 for tick in range(300)}
    assert (f"; dropped {dropped} sample" in said) == (dropped > 0)
    [clip] = clips.iterdir()
    assert sr.read_trace(clip) == trace
    for log in (output, clip):
        with log.open("rb") as stream:
            records = {each.name: each.metadata for each in make_reader(stream).iter_metadata()}
        assert records["spatial_replay_ending"]["dropped"] == str(dropped)


def test_a_short_run_still_says_which_topic_the_server_does_not_offer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING.replace("/robot", "/robott"), SPEC)
    command = ["--mapping", str(mapped), "--spec", str(spec), "--for", "300ms"]
    with robot() as own:
        assert run(["monitor", own.address, *command]) == 2
    assert "did you mean '/robot'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--before", "3s"], "--before is about clips; add --clips DIR"),
        (["--ring", "2MB"], "--ring is about clips; add --clips DIR"),
        (["--clips", "clips", "--ring", "10"], "--ring is 10 bytes"),
        (["--clips", "clips", "--trigger", "violatedd"], "--trigger: the trigger 'violatedd'"),
    ],
)
def test_options_of_clips_are_checked_before_anything_is_connected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    assert run(["monitor", "ws://127.0.0.1:9", "--mapping", str(mapped), "--spec", str(spec), *options]) == 2
    assert said in capsys.readouterr().err


def test_messages_that_do_not_fit_are_said_once_and_counted_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    bad = [frame(2, tick * 10 * MS + 2, b'{"x": "far"}') for tick in range(30)]
    good = [(pose(2, tick, 2.0), pose(1, tick)) for tick in range(31)]
    # the last sample is a violation, at which the run ends
    sent = [*good[0], *(each for pair in zip(bad, good[1:], strict=True) for each in (pair[0], *pair[1]))]
    with rude_server(*sent, pose(2, 40), pose(1, 40)) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "--until", "violated"]
        assert run(command) == 1
    said = [line for line in capsys.readouterr().out.splitlines() if ": /vase at " in line]
    assert len(said) == 2 and "and 29 more like this" in said[1]


def test_a_recorded_run_is_not_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    log = tmp_path / "live.mcap"
    log.write_bytes(b"a run that is over")
    # nothing listens there, and nothing is asked
    command = ["monitor", "ws://127.0.0.1:9", "--mapping", str(mapped), "--spec", str(spec), "-o", str(log)]
    assert run(command) == 2
    assert "live.mcap exists already; give another name, or --overwrite" in capsys.readouterr().err
    assert log.read_bytes() == b"a run that is over"
    assert run([*command, "--overwrite"]) == 3


def test_a_mode_is_compared_by_its_name_and_the_log_keeps_the_names(tmp_path: Path) -> None:
    keys = "signals: {mode: {field: mode, names: {0: MANUAL, 1: AUTO}}}"
    mapping = f"topics: {{/robot: {{{keys}}}, /vase: {{position: [x, y]}}}}\nsample: {{topic: /robot}}"
    mapped, spec = files(tmp_path, mapping, 'spec drives = F (mode == "AUTO")')
    log = tmp_path / "live.mcap"
    modes = [frame(1, tick * 10 * MS, b'{"mode": %d}' % (tick > 1)) for tick in range(4)]
    with rude_server(pose(2, 0), *modes) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "-o", str(log)]
        assert run([*command, "--until", "satisfied"]) == 0
    assert run(["replay", str(log), "--spec", str(spec)]) == 0


def test_a_name_that_the_robot_does_not_report_is_noted_once(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, "spec clear = G (robto dist vase >= 0.5)")
    with robot() as own:
        driving = drive(own, range(0, 700, 50))
        found = asyncio.run(updates_of(own.address, spec, mapped, lambda update: update.time_ns >= 6 * 10**9))
        driving.join()
    notes = [note for each in found for note in each.notes if "robto" in note]
    assert len(notes) == 1 and "in its first 5.000 s; did you mean 'robot'?" in notes[0]


def test_a_topic_that_comes_after_another_of_the_same_time_makes_samples_of_that_time(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, "spec clear = G (robot dist vase >= 0.5)")
    with robot() as own:

        def drive_apart() -> None:
            until(own.is_heard)
            for tick in range(30):
                own.send("/vase", tick * 50 * MS, x=0.0, y=0.0)
                time.sleep(0.005)
                own.send("/robot", tick * 50 * MS, x=2.0, y=0.0)
                time.sleep(0.02)

        driving = threading.Thread(target=drive_apart)
        driving.start()
        found = asyncio.run(updates_of(own.address, spec, mapped, 30))
        driving.join()
    assert [each.time_ns for each in found] == [tick * 50 * MS for tick in range(30)]
    assert all(set(each.sample.objects) == {"robot", "vase"} for each in found)


@pytest.mark.parametrize(
    ("formula", "until", "code", "said"),
    [
        ("F[0s, 50ms] (robot dist vase >= 9)", "satisfied", 1, "goal  violated"),
        ("F[0s, 50ms] (robot dist door >= 9)", "satisfied", 4, "goal  unknown"),
        ("F[0s, 50ms] (robot dist vase >= 1)", "violated", 0, "goal  satisfied"),
    ],
)
def test_a_run_ends_when_what_it_waits_for_cannot_come(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], formula: str, until: str, code: int, said: str
) -> None:
    mapped, spec = files(tmp_path, MAPPING, f"spec goal = {formula}")
    sent = [pose(number, tick, 2.0 * (number == 1)) for tick in range(30) for number in (2, 1)]
    with rude_server(*sent) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "--until", until]
        assert run(command) == code
    assert said in capsys.readouterr().out


def test_waiting_for_what_no_run_satisfies_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    command = ["monitor", "ws://127.0.0.1:9", "--mapping", str(mapped), "--spec", str(spec)]
    assert run([*command, "--until", "satisfied"]) == 2
    assert "--until satisfied: clear can be violated as long as the run goes on" in capsys.readouterr().err


def test_the_reason_of_an_unknown_result_is_printed_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(
        tmp_path, MAPPING, "spec clear = G (robot dist vase >= 0.5)\nspec seen = F (robot dist vase >= 9)"
    )
    output = tmp_path / "live.mcap"
    sent = [pose(number, tick, 2.0 * (number == 1)) for tick in range(20) for number in (2, 1)]
    with rude_server(*sent[:10], breaks_off=True) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "-o", str(output)]
        assert run([*command, "--for", "1s"]) == 4
    said = capsys.readouterr().out
    [reason] = [
        line.strip() for line in said.splitlines() if "`robot dist vase >= 0.5` is unknown at" in line
    ]
    assert run(["replay", str(output), "--spec", str(spec)]) == 4
    explained = capsys.readouterr().out
    assert reason.removesuffix(".") in explained
    assert "at 0.040 s: the connection was lost, or topics were silent." in explained
    assert "max_gap" not in said + explained


def test_a_topic_that_is_rarer_than_its_timeout_is_said(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    with robot() as own:

        def drive_slowly() -> None:
            until(own.is_heard)
            for tick in range(80):
                if tick % 20 == 0:
                    own.send("/vase", tick * 10 * MS, x=0.0, y=0.0)
                own.send("/robot", tick * 10 * MS + 1, x=2.0, y=0.0)
                time.sleep(0.02)

        driving = threading.Thread(target=drive_slowly)
        driving.start()
        found = asyncio.run(
            updates_of(
                own.address, spec, mapped, lambda each: each.time_ns > 79 * 10 * MS, topic_timeout_s=0.2
            )
        )
        driving.join()
    notes = [note for each in found for note in each.notes]
    assert any("no message on /vase for 0.2 s" in note for note in notes)
    assert any("a message on /vase again, after" in note for note in notes)
    assert len([note for note in notes if "/vase usually comes every" in note]) == 1


@pytest.mark.parametrize(("first", "code"), [(8, 0), (200, 4)])
def test_a_run_begins_where_its_recording_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], first: int, code: int
) -> None:
    mapped, spec = files(tmp_path, MAPPING.replace("10s", "1s"), "spec clear = G (robot dist vase >= 0.5)")
    output = tmp_path / "live.mcap"
    ticks = range(first + 20)
    sent = [pose(1, tick, 2.0) for tick in ticks if tick < first]
    sent += [pose(number, tick, 2.0 * (number == 1)) for tick in ticks[first:] for number in (2, 1)]
    # the last sample is not evaluated before the end, as no message follows
    with rude_server(*sent) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "-o", str(output)]
        assert run([*command, "--for", "4s"]) == code
    said = capsys.readouterr().out
    begin_ns = int(sr.read_trace(output).times_ns[0])
    if code:
        assert begin_ns == 1 and "the run begins although /vase cannot be judged yet" in said
    else:
        assert begin_ns == first * 10 * MS + 1
        assert (
            "8 samples at the beginning are left out, from -0.080 s to -0.010 s: /vase begins at 0.000 s"
            in said
        )
    assert run(["replay", str(output), "--spec", str(spec)]) == code


def test_remarks_of_a_run_count_times_from_its_first_sample(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING.replace("10s", "1s"), "spec clear = F (robot dist vase >= 0.5)")
    ticks = range(10_000, 10_300)
    sent = [
        pose(number, tick, 2.0 * (number == 1)) for tick in ticks for number in (2, 1)[: 2 - (tick > 10_010)]
    ]
    with rude_server(*sent) as address:
        assert run(["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "--for", "4s"]) == 0
    assert "samples are taken at /robot, which ends at 0.100 s" in capsys.readouterr().err


FRAMED = """
fixed_frame: map
sample: {topic: /odom}
topics:
  /odom: {name: robot, frame: odom, position: [x, y], shape: {disc: 0.1}}
"""


def placed_from(at: int) -> dict[str, object]:
    """A transform at a time in ms."""
    names = {"timestamp": {"sec": at // 1000, "nsec": at % 1000 * MS}, "parent_frame_id": "map"}
    rotation = {"x": 0, "y": 0, "z": 0, "w": 1}
    return names | {"child_frame_id": "odom", "translation": {"x": 0, "y": 0, "z": 0}, "rotation": rotation}


@contextmanager
def sending(messages: Sequence[tuple[str, int, dict[str, object]]]) -> Iterator[str]:
    """A server of the Foxglove SDK that sends messages at once, by topic and time in ms."""
    context = foxglove.Context()
    channels = {
        topic: foxglove.Channel(
            topic,
            schema=foxglove.Schema(
                name="foxglove.FrameTransform" if topic == "/tf" else "Pose",
                encoding="jsonschema",
                data=b"{}",
            ),
            message_encoding="json",
            context=context,
        )
        for topic in dict.fromkeys(topic for topic, _, _ in messages)
    }
    server = foxglove.start_server(name="robot", host="127.0.0.1", port=0, context=context)

    def send() -> None:
        until(lambda: all(channel.has_sinks() for channel in channels.values()))
        for topic, at, content in messages:
            channels[topic].log(json.dumps(content).encode(), log_time=at * MS)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield f"ws://127.0.0.1:{server.port}"
    finally:
        sender.join()
        server.stop()


def test_transforms_that_come_after_max_delay_are_said_with_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(
        tmp_path, FRAMED, "region home = circle((0, 0), 9)\nspec near = G (robot dist home <= 1)"
    )
    sent = [(topic, at, placed_from(at)) for at in range(1_000, 1_500, 100) for topic in ("/tf", "/odom")]
    # the transforms behind the last reports never come
    sent += [("/odom", at, {"x": 0, "y": 0}) for at in range(1_450, 2_600, 50)]
    messages = [(topic, at, content if topic == "/tf" else {"x": 0, "y": 0}) for topic, at, content in sent]
    with sending(messages) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec)]
        assert run([*command, "--for", "2s"]) == 4
    said = capsys.readouterr().out
    assert said.count("/odom is unknown where no transform of 'odom' came within 0.2 s") == 1
    assert "give --max-delay (max_delay_s) more" in said


@pytest.mark.parametrize(
    ("odom_ms", "tf_ms", "code", "left_out"),
    [
        (range(1_000, 2_000, 50), range(1_000, 2_000, 100), 0, "1 sample at the end is left out"),
        (range(1_000, 2_000, 50), range(1_000, 1_700, 100), 0, "7 samples at the end are left out"),
        (range(1_000, 4_000, 50), range(1_000, 1_700, 100), 4, ""),
    ],
    ids=["last sample", "transforms end earlier", "transforms end long before"],
)
def test_a_run_that_stops_sending_ends_where_its_recording_does(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    odom_ms: range,
    tf_ms: range,
    code: int,
    left_out: str,
) -> None:
    listed = [("/tf", at, placed_from(at)) for at in tf_ms]
    listed += [("/odom", at, {"x": 0.0, "y": 0.0}) for at in odom_ms]
    spec = "region home = circle((0, 0), 9)\nspec near = G (robot dist home <= 1)"
    assert_ends_alike(tmp_path, capsys, (FRAMED, spec), listed, code, left_out)


@pytest.mark.parametrize(
    ("vase_ms", "code", "left_out"),
    [
        (
            [range(1_000, 2_700, 100)],
            0,
            "3 samples at the end are left out, from 1.850 s to 1.950 s: /vase ends",
        ),
        ([range(1_000, 2_000, 100), range(2_300, 3_000, 100)], 4, ""),
        ([range(1_000, 2_400, 100)], 4, ""),
    ],
    ids=["a topic ends", "a hole", "a topic ends long before"],
)
def test_a_topic_that_ends_is_no_hole_in_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], vase_ms: list[range], code: int, left_out: str
) -> None:
    listed = [("/vase", at, {"x": 0.0, "y": 0.0}) for times in vase_ms for at in times]
    listed += [("/robot", at, {"x": 2.0, "y": 0.0}) for at in range(1_000, 3_000, 50)]
    spec = "spec clear = G (robot dist vase >= 0.5)"
    assert_ends_alike(tmp_path, capsys, (MAPPING.replace("10s", "200ms"), spec), listed, code, left_out)


def assert_ends_alike(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    texts: tuple[str, str],
    listed: Sequence[tuple[str, int, dict[str, object]]],
    code: int,
    left_out: str,
) -> None:
    """A run evaluates the samples of a bag of its messages, and leaves out the same ones."""
    messages = sorted(listed, key=lambda message: message[1])
    mapped, spec = files(folder, *texts)
    log, output = folder / "robot.mcap", folder / "live.mcap"
    channels = [
        (topic, "json", "foxglove.FrameTransform" if topic == "/tf" else "Pose", "jsonschema", b"{}")
        for topic in dict.fromkeys(topic for topic, _, _ in messages)
    ]
    write_mcap(log, channels, [(topic, at * MS, json.dumps(text).encode()) for topic, at, text in messages])
    options = ["--mapping", str(mapped), "--spec", str(spec)]
    assert run(["replay", str(log), *options, "--json", "-"]) == code
    replayed = capsys.readouterr()
    expected = json.loads(replayed.out)["log"]
    with sending(messages) as address:
        assert run(["monitor", address, *options, "--for", "2s", "-o", str(output)]) == code
    said = capsys.readouterr().out
    assert left_out in said and left_out in replayed.err
    assert bool(left_out) == ("at the end" in said) == ("at the end" in replayed.err)
    times_ns = sr.read_trace(output).times_ns
    assert (len(times_ns), int(times_ns[-1])) == (expected["samples"], expected["end_ns"])
    assert run(["replay", str(output), "--spec", str(spec)]) == code
    # the robot's own messages stay
    assert {topic for topic, _, _ in messages} <= {topic for topic, _, _ in messages_of(output)}
    assert max(time_ns for _, time_ns, _ in messages_of(output)) == messages[-1][1] * MS


def test_a_run_waits_as_long_as_start_within_says(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING.replace("10s", "1s"), "spec clear = G (robot dist vase >= 0.5)")
    sent = [pose(1, tick, 2.0) for tick in range(200)]
    sent += [pose(number, 200, 2.0 * (number == 1)) for number in (2, 1)]
    with rude_server(*sent) as address:
        [update] = asyncio.run(updates_of(address, spec, mapped, 1, start_within_s=5.0))
    assert update.time_ns == 200 * 10 * MS + 1


def test_a_message_that_comes_too_late_is_said(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    is_sampled = threading.Event()

    def is_last(update: LiveUpdate) -> bool:
        if update.time_ns == 100 * MS:
            is_sampled.set()
        return update.time_ns == 200 * MS

    with robot() as own:

        def drive_late() -> None:
            until(own.is_heard)
            for time_ns in (0, 100 * MS, 200 * MS):
                own.send("/robot", time_ns, x=2.0, y=0.0)
                if time_ns == 100 * MS:
                    until(is_sampled.is_set)
                own.send("/vase", time_ns, x=0.0, y=0.0)

        driving = threading.Thread(target=drive_late)
        driving.start()
        updates = asyncio.run(updates_of(own.address, spec, mapped, is_last))
        driving.join()
    assert [update.time_ns for update in updates] == [0, 100 * MS, 200 * MS]
    notes = [note for update in updates for note in update.notes if "it came after the samples" in note]
    assert len(notes) == 1 and "/vase at 0.100 s" in notes[0] and "the next sample has it" in notes[0]


@pytest.mark.parametrize(
    ("formula", "accept", "code", "said"),
    [
        ("F[0s, 50ms] (robot dist vase >= 1)", "", 4, "doubtful: /robot: its angles reach 200 "),
        ("F[0s, 50ms] (vase dist vase <= 1)", "", 0, "doubtful: /robot: its angles reach 200 "),
        ("F[0s, 50ms] (robot dist vase >= 1)", "accept: [radians]", 0, "accepted: /robot: its angles reach"),
        ("F[0s, 50ms] (robot dist vase >= 9)", "", 1, "doubtful: /robot"),
    ],
)
def test_a_run_is_doubtful_where_it_contradicts_its_mapping_and_its_log_keeps_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], formula: str, accept: str, code: int, said: str
) -> None:
    mapping = "topics: {/robot: {position: [x, y], yaw: yaw}, /vase: {position: [x, y]}}"
    mapped, spec = files(tmp_path, f"{mapping}\n{accept}", f"spec goal = {formula}")
    log = tmp_path / "live.mcap"
    turned = b'{"x": 2.0, "y": 0.0, "yaw": 200}'
    sent = [each for tick in range(30) for each in (pose(2, tick), frame(1, tick * 10 * MS, turned))]
    with rude_server(*sent) as address:
        command = ["monitor", address, "--mapping", str(mapped), "--spec", str(spec), "-o", str(log)]
        # it is left at a sample, before its end
        assert run([*command, "--until", "settled"]) == code
    output = capsys.readouterr()
    assert (said in output.err, "doubtful, robustness" in output.out) == (True, code != 0)
    assert run(["replay", str(log), "--spec", str(spec)]) == code
    assert said in capsys.readouterr().err


def test_the_log_of_a_run_that_is_left_in_python_is_doubtful_too(tmp_path: Path) -> None:
    mapping = "topics: {/robot: {position: [x, y], yaw: yaw}, /vase: {position: [x, y]}}"
    mapped, spec = files(tmp_path, mapping, "spec goal = F (robot dist vase >= 1)")
    turned = b'{"x": 2.0, "y": 0.0, "yaw": 200}'
    sent = [each for tick in range(30) for each in (pose(2, tick), frame(1, tick * 10 * MS, turned))]
    with rude_server(*sent) as address:
        asyncio.run(updates_of(address, spec, mapped, 9, output=tmp_path / "live.mcap"))
    assert [doubt.assumption for doubt in sr.read_trace(tmp_path / "live.mcap").doubts] == ["radians"]


def test_a_long_run_says_what_it_contradicts_before_its_end(tmp_path: Path) -> None:
    mapping = "topics: {/robot: {position: [x, y], yaw: yaw}, /vase: {position: [x, y]}}"
    mapped, spec = files(tmp_path, mapping, "spec goal = G (robot dist vase >= 1)")
    turned = b'{"x": 2.0, "y": 0.0, "yaw": 200}'
    sent = [each for tick in range(300) for each in (pose(2, tick), frame(1, tick * 10 * MS, turned))]
    with rude_server(*sent) as address:
        updates = asyncio.run(updates_of(address, spec, mapped, 250))
    notes = [note for update in updates for note in update.notes if "its angles reach 200" in note]
    # once, although the run is compared again and again
    assert len(notes) == 1
