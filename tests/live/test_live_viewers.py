"""A running robot as viewers see it while it is monitored: clients of the same protocol."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import threading
import time
from pathlib import Path

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

import spatial_replay as sr
from live.robots import MAPPING, SPEC, Robot, files, messages_of, occurrence, robot, until
from serve.viewer import PROTOCOL, viewer
from spatial_replay.cli import run
from spatial_replay.live.session import open_viewing
from spatial_replay.logs.schemas.Robustness_pb2 import RecentEvents, Robustness
from spatial_replay.logs.topics import (
    AUTOMATON,
    EVENTS,
    OBJECTS,
    RECENT_EVENTS,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    STANDING,
)

SHOWN = (OBJECTS, ROBUSTNESS, STANDING, AUTOMATON, SCENE)


def test_a_viewer_sees_the_run_and_a_service_fires_the_trigger(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    clips = tmp_path / "clips"
    port = free_port()
    command = ["monitor", "", "--mapping", str(mapped), "--spec", str(spec), "--serve", "--port", str(port)]
    command += ["--clips", str(clips), "--trigger", "manual", "--after", "0s", "--topics", "/*"]
    command += ["--for", "60s"]
    offered: set[str] = set()
    moving, over = threading.Event(), threading.Event()

    def drive_when_seen() -> None:
        until(own.is_heard)
        for tick in range(6000):
            own.drive(tick, 0.1 if moving.is_set() else 1.0)
            time.sleep(0.01)
            if over.is_set():
                return

    async def look() -> None:
        async with viewer(f"ws://127.0.0.1:{port}") as own:
            await own.subscribe([*SHOWN, EVENTS])
            for topic in SHOWN:
                await own.message(topic)
            offered.update(own.channels)
            assert await own.call("trigger", {"reason": "looked odd"}) == {"fired": True}
            moving.set()
            await own.message(EVENTS, lambda each: b"`clear` is permanently violated" in each.data)

    with robot() as own:

        def watch() -> None:
            try:
                asyncio.run(look())
                # a trigger that fires while a clip is open would make that one longer
                until(lambda: any(each.read_bytes().endswith(b"\x89MCAP0\r\n") for each in clips.iterdir()))
                os.kill(os.getpid(), signal.SIGUSR1)
                until(lambda: len(list(clips.iterdir())) > 1)
            finally:
                over.set()
                os.kill(os.getpid(), signal.SIGINT)

        command[1] = own.address
        driving = threading.Thread(target=drive_when_seen)
        driving.start()
        watching = threading.Thread(target=watch)
        waiting = threading.Thread(target=lambda: (until(lambda: listens(port)), watching.start()))
        waiting.start()
        assert run(command) == 1
        watching.join()
        driving.join()
    # all that the layout draws is there
    capsys.readouterr()
    assert run([*command, "--layout"]) == 0
    drawn = set(re.findall(r'"(/spatial/[a-z_]+)', capsys.readouterr().out))
    assert {STANDING, SCENE} <= drawn <= offered
    assert [each.name for each in sorted(clips.iterdir())][:2] == [
        "0001-looked-odd.mcap",
        "0002-SIGUSR1.mcap",
    ]
    assert all({"/robot", "/vase", OBJECTS} <= {m[0] for m in messages_of(each)} for each in clips.iterdir())


def test_a_viewer_hears_that_the_robot_falls_silent(tmp_path: Path) -> None:
    mapped, spec = files(tmp_path, MAPPING, SPEC)
    port = free_port()
    heard: list[str] = []
    is_seen = threading.Event()

    def drive_until_seen(own: Robot) -> None:
        until(own.is_heard)
        for tick in range(6000):
            if is_seen.is_set():
                return
            own.drive(tick, 1.0)
            time.sleep(0.01)

    async def look() -> None:
        async with viewer(f"ws://127.0.0.1:{port}") as own:
            await own.subscribe([OBJECTS, EVENTS])
            await own.message(OBJECTS)
            is_seen.set()
            found = await own.message(EVENTS, lambda each: occurrence(each.time_ns, each.data) is not None)
            heard.append(str(occurrence(found.time_ns, found.data)))

    def watch() -> None:
        try:
            until(lambda: listens(port))
            asyncio.run(look())
        finally:
            is_seen.set()
            os.kill(os.getpid(), signal.SIGINT)

    command = ["--mapping", str(mapped), "--spec", str(spec), "--topic-timeout", "500ms", "--for", "60s"]
    command += ["--clips", str(tmp_path / "clips"), "--trigger", "manual"]
    with robot() as own:
        threads = [threading.Thread(target=drive_until_seen, args=[own]), threading.Thread(target=watch)]
        for thread in threads:
            thread.start()
        assert run(["monitor", own.address, *command, "--serve", "--port", str(port)]) == 4
        for thread in threads:
            thread.join()
    assert "silence on /" in heard[0] and "what it reports is unknown" in heard[0]


def test_a_viewer_that_joins_while_nothing_comes_sees_the_last_state() -> None:
    shown = [STANDING, SCENE, ROBUSTNESS, RECENT_EVENTS, SPECIFICATION]

    async def look(address: str) -> None:
        async with viewer(address) as first, viewer(address) as own:
            await first.subscribe([SCENE, EVENTS])
            await first.message(SCENE, lambda each: each.time_ns == 3 * 10**9)
            await own.subscribe([*shown, EVENTS])
            found = {topic: await own.message(topic) for topic in shown}
            assert {each.time_ns for each in found.values()} == {3 * 10**9}
            other = await own.message(ROBUSTNESS)
            names = {Robustness.FromString(each.data).specification for each in (found[ROBUSTNESS], other)}
            assert names == {"kept", "full"}
            [event] = RecentEvents.FromString(found[RECENT_EVENTS].data).events
            assert event.event.startswith("`kept` is permanently violated: `battery >= 1` fails by 1.")
            # nothing that has happened is sent as if it happened again
            viewing.write(sr.Sample(4 * 10**9, {}, {"battery": -10.0}))
            for each in (first, own):
                assert (
                    await each.message(EVENTS, lambda each: each.time_ns > 2 * 10**9)
                ).time_ns == 4 * 10**9

    file = sr.parse_specification("spec kept = G battery >= 1\nspec full = G battery >= -5")
    with open_viewing([file], None, host="127.0.0.1", port=0, fire=str) as viewing:
        for t in range(1, 4):
            viewing.write(sr.Sample(t * 10**9, {}, {"battery": 2.0 - t}))
        asyncio.run(look(viewing.address))


def test_only_who_has_the_token_and_comes_from_an_allowed_page_sees_a_robot_from_elsewhere() -> None:
    async def status(address: str, origin: str | None) -> int:
        try:
            headers = {} if origin is None else {"Origin": origin}
            async with connect(address, subprotocols=[PROTOCOL], additional_headers=headers) as connection:
                return 101 if json.loads(await connection.recv())["op"] == "serverInfo" else 0
        except InvalidStatus as refused:
            return refused.response.status_code

    page = "https://viewer.example.org"
    with open_viewing([sr.parse_specification(SPEC)], None, host="0.0.0.0", port=0, origins=[page]) as own:
        address = own.address.replace("0.0.0.0", "127.0.0.1")
        tokenless = address.partition("/?token=")[0]
        assert [asyncio.run(status(each, None)) for each in (address, tokenless)] == [101, 401]
        assert asyncio.run(status(address, page)) == 101
        assert asyncio.run(status(address, "https://elsewhere.example.org")) == 403


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
