"""A log served to viewers, over real connections."""

from __future__ import annotations

import asyncio
import json
import random
import socket
import struct
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from operator import eq
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.typing import Origin, Subprotocol

import spatial_replay as sr
from replay.runs import STEP_NS, PiecewiseSource, content_of, record, run
from serve.viewer import (
    ENDED,
    OLD_PROTOCOL,
    PATIENCE_S,
    PAUSED,
    PLAYING,
    PROTOCOL,
    Message,
    Received,
    State,
    Viewer,
    viewer,
)
from spatial_replay import UsageError
from spatial_replay.annotate.robustness import MOST_POINTS
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.logs.objects import encode_objects
from spatial_replay.logs.output_file import open_output
from spatial_replay.logs.schemas.Curves_pb2 import Curves
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.schemas.Robustness_pb2 import Robustness, StandingUpdate
from spatial_replay.logs.schemas.Specification_pb2 import Specification
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import (
    CURVES_TOPIC,
    OBJECTS,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    STANDING,
    protobuf_channel,
)
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.loaded_log import LoadedLog
from spatial_replay.serve.server import Serving, open_server
from spatial_replay.sources import open_source

TEXT = """\
const far = 0.5
const soon = 10s
region goal = box(4, -1, 9, 2)
spec reach = F[0s, soon] (cube enclosedin goal)
spec apart = G (cube dist "cup 物" >= far)
"""
COUNT = 24
END_NS = (COUNT - 1) * STEP_NS
FAST = 50.0


def specification() -> sr.Specification:
    return sr.parse_specification(TEXT, filename="blocks.spatial")


@contextmanager
def served(count: int = COUNT) -> Iterator[Serving]:
    loaded = LoadedLog(PiecewiseSource(run(count), 7), [specification()])
    with open_server(loaded.evaluate(), port=0) as server:
        yield server


@pytest.fixture
def server() -> Iterator[Serving]:
    with served() as running:
        yield running


def watch(server: Serving, looking: Callable[[Viewer], Awaitable[None]]) -> None:
    """Look at a server through one viewer."""

    async def session() -> None:
        async with viewer(server.address) as own:
            await looking(own)

    asyncio.run(session())


def value(message: Message) -> tuple[str, float]:
    """The specification that a message on robustness is about, and the number of its root."""
    robustness = Robustness.FromString(message.data)
    return robustness.specification, robustness.nodes[0].value


def test_a_server_lists_its_capabilities_and_topics(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        assert own.info["name"] == "spatial-replay: run"
        assert {"parameters", "playbackControl", "services", "time", "assets"} <= {*own.info["capabilities"]}
        assert own.info["dataEndTime"] == {"sec": 5, "nsec": 750_000_000}
        assert {OBJECTS, SCENE, ROBUSTNESS, SPECIFICATION, CURVES_TOPIC} <= {*own.channels}

    watch(server, looking)


def test_a_new_subscriber_gets_the_first_sample_and_the_curves_of_the_whole_log(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        await own.subscribe()
        found = await own.until(lambda each: isinstance(each, Message) and each.topic == SCENE)
        messages = [each for each in found if isinstance(each, Message)]
        assert {each.time_ns for each in messages} == {0}
        [drawn] = [each for each in messages if each.topic == SCENE]
        ids = {entity.id for entity in SceneUpdate.FromString(drawn.data).entities}
        assert {"object/cube", "object/cup 物", "region/goal"} <= ids

    watch(server, looking)

    async def counting(own: Viewer) -> None:
        await own.subscribe([CURVES_TOPIC])
        curves = Curves.FromString((await own.message(CURVES_TOPIC)).data)
        assert list(curves.time) == [index * STEP_NS / 1e9 for index in range(COUNT)]
        assert [(each.name, each.verdict) for each in curves.specifications] == [
            ("reach", "satisfied"),
            ("apart", "unknown"),
        ]
        evaluated = sr.evaluate(specification(), run(COUNT))
        for each in curves.specifications:
            assert list(each.nodes[0].value) == pytest.approx(evaluated.node(each.name).value, nan_ok=True)

    watch(server, counting)


def test_a_log_played_from_the_start_is_the_annotated_log(server: Serving, tmp_path: Path) -> None:
    output = tmp_path / "annotated.mcap"
    run_replay(PiecewiseSource(run(COUNT), 7), [specification()], output=output)
    expected = [(topic, time_ns, data) for topic, time_ns, _, _, data in content_of(output).messages]
    last = expected[-1]

    async def looking(own: Viewer) -> None:
        await own.subscribe(topic for topic in own.channels if topic != CURVES_TOPIC)
        await own.message(SCENE)
        assert (await own.control(play=True, speed=10.0, seek_ns=0, request="play")).status == PLAYING
        found = await own.until(lambda each: isinstance(each, Message) and tuple(each) == last)
        # a new subscriber may be sent the first sample twice
        assert {tuple(each) for each in found if isinstance(each, Message)} == set(expected)

    watch(server, looking)


def test_play_pause_seek_and_speed_get_a_reply(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        await own.subscribe([ROBUSTNESS])
        sought = await own.control(seek_ns=3 * STEP_NS + 1, request="seek")
        assert sought == State(PAUSED, 3 * STEP_NS + 1, 1.0, False, "seek")
        assert (await own.next_of(State, lambda each: each.did_seek)).time_ns == 3 * STEP_NS + 1
        assert (await own.message(ROBUSTNESS, lambda each: each.time_ns > 0)).time_ns == 3 * STEP_NS
        playing = await own.control(play=True, speed=FAST, request="play")
        assert (playing.status, playing.speed, playing.did_seek) == (PLAYING, FAST, False)
        ended = await own.next_of(State, lambda each: each.status == ENDED)
        assert (ended.time_ns, ended.request) == (END_NS, "")
        again = await own.control(play=True, speed=1.0, request="again")
        assert again == State(PLAYING, 0, 1.0, False, "again")
        paused = await own.control(speed=1.0, request="pause")
        assert (paused.status, paused.did_seek) == (PAUSED, False)

    watch(server, looking)


def test_every_seek_leaves_all_that_is_shown_at_its_time(server: Serving) -> None:
    """A viewer drops what it has when the time steps back, or when a state says that it jumped."""
    shown: dict[str, Message] = {}
    now = 0

    def show(received: Received) -> None:
        nonlocal now
        match received:
            case int():
                if received < now:
                    shown.clear()
                now = received
            case State(did_seek=True):
                shown.clear()
            case Message():
                shown[received.topic] = received

    def shows(seek_ns: int, request: str) -> Callable[[Received], bool]:
        answers: list[Received] = []

        def is_complete(received: Received) -> bool:
            show(received)
            if received == seek_ns or (isinstance(received, State) and received.request == request):
                answers.append(received)
            there = {seek_ns, seek_ns - seek_ns % STEP_NS}
            drawn = {topic for topic, each in shown.items() if each.time_ns in there}
            # the answer, the time before and after what is shown, and after it is shown once more
            return len(answers) >= 4 and drawn >= {SCENE, STANDING, ROBUSTNESS, CURVES_TOPIC}

        return is_complete

    async def looking(own: Viewer) -> None:
        await own.subscribe([SCENE, STANDING, ROBUSTNESS, SPECIFICATION, CURVES_TOPIC])
        draw = random.Random(5)
        for number in range(30):
            seek_ns = draw.randrange(END_NS)
            await own.ask(seek_ns=seek_ns, request=f"{number}")
            await own.until(shows(seek_ns, f"{number}"))
            assert SPECIFICATION in shown

    watch(server, looking)


def test_a_seek_shows_how_results_stood_before_the_cursor(server: Serving, tmp_path: Path) -> None:
    """A viewer draws a strip between changes, each at the time in the header of its message."""
    run_replay(PiecewiseSource(run(COUNT), 7), [specification()], output=tmp_path / "annotated.mcap")
    results = {
        time_ns: results_of(data)
        for topic, time_ns, _, _, data in content_of(tmp_path / "annotated.mcap").messages
        if topic == STANDING
    }

    async def looking(own: Viewer) -> None:
        await own.subscribe([STANDING])
        await own.message(STANDING)
        for place in (20, 9, 22):
            seek_ns = place * STEP_NS
            await own.ask(seek_ns=seek_ns)
            # viewers drop what they have once the time steps back
            await own.until(partial(eq, 0))
            await own.until(is_message_at(seek_ns))
            again = await own.until(is_message_at(seek_ns))
            strip = {
                stamp_ns(message.data): results_of(message.data)
                for message in again
                if isinstance(message, Message)
            }
            before_ns = range(0, seek_ns, STEP_NS)
            changes_ns = [at_ns for at_ns in before_ns if results[at_ns] != results.get(at_ns - STEP_NS)]
            assert len(changes_ns) > 2
            assert strip == {at_ns: results[at_ns] for at_ns in [*changes_ns, seek_ns]}

    watch(server, looking)


def is_message_at(time_ns: int) -> Callable[[Received], bool]:
    return lambda received: isinstance(received, Message) and received.time_ns == time_ns


def stamp_ns(data: bytes) -> int:
    stamp = StandingUpdate.FromString(data).header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nsec)


def results_of(data: bytes) -> list[tuple[str, int]]:
    """How each result and named spec stands, in one message."""
    return [(result.name, result.standing) for result in StandingUpdate.FromString(data).results]


@pytest.mark.parametrize(
    ("speed", "becomes"), [(float("nan"), 1.0), (0.0, 1.0), (-2.0, 1.0), (float("inf"), 1.0), (1e9, 100.0)]
)
def test_impossible_speeds_are_bounded(server: Serving, speed: float, becomes: float) -> None:
    async def looking(own: Viewer) -> None:
        assert (await own.control(speed=speed)).speed == becomes
        assert (await own.control(speed=1.0, seek_ns=2**63, request="far")).time_ns == END_NS

    watch(server, looking)


def test_viewers_get_the_time_while_it_plays(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        await own.control(play=True, speed=FAST)
        times = [await own.next_of(int) for _ in range(2)]
        assert 0 <= times[0] < times[1] <= END_NS

    watch(server, looking)


def test_a_changed_constant_changes_the_verdict_the_curves_and_the_messages(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        assert await own.constants() == {"far": 0.5, "soon": 10}
        await own.subscribe([CURVES_TOPIC, ROBUSTNESS, SPECIFICATION])
        before = Curves.FromString((await own.message(CURVES_TOPIC)).data)
        await own.control(seek_ns=2 * STEP_NS)
        assert await own.set(far=3.0) == {"far": 3.0, "soon": 10}
        changed = await own.message(CURVES_TOPIC, lambda each: Curves.FromString(each.data) != before)
        curves = Curves.FromString(changed.data)
        assert "`apart` is violated" in curves.summary
        assert "(far = 3)" in curves.summary
        assert [each.verdict for each in before.specifications] == ["satisfied", "unknown"]
        assert [each.verdict for each in curves.specifications] == ["satisfied", "violated"]
        edited = sr.parse_specification(TEXT.replace("far = 0.5", "far = 3.0"))
        expected = ("apart", sr.evaluate(edited, run(COUNT)).node("apart").value[2])
        shown = await own.message(ROBUSTNESS, lambda each: value(each) == expected)
        assert shown.time_ns == 2 * STEP_NS
        await own.message(
            SPECIFICATION, lambda each: "const far = 3" in Specification.FromString(each.data).files[0].source
        )

    watch(server, looking)


@pytest.mark.parametrize("kind", [{}, {"type": "float64"}])
@pytest.mark.parametrize("protocol", [PROTOCOL, OLD_PROTOCOL])
def test_a_number_that_a_viewer_sets_stays_to_its_last_bit(
    server: Serving, protocol: Subprotocol, kind: dict[str, str]
) -> None:
    async def looking() -> None:
        chance = random.Random(3)
        async with viewer(server.address, protocol) as own:
            for _ in range(40):
                number = chance.random() * 10.0 ** chance.randint(-8, -4)
                parameter = {"name": "far", "value": number, **kind}
                # long enough for each form of a frame's length
                rest = "x" * chance.choice([0, 200, 70_000])
                await own.send(op="setParameters", parameters=[parameter], rest=rest)
                assert (await own.constants())["far"] == number
            assert await own.set(far=7) == {"far": 7, "soon": 10}

    asyncio.run(looking())


def test_a_changed_constant_makes_viewers_drop_what_they_show(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        await own.control(seek_ns=STEP_NS)
        assert (await own.set(soon=1))["soon"] == 1
        state = await own.next_of(State, lambda each: each.did_seek)
        assert (state.time_ns, state.request) == (STEP_NS, "")
        assert "`reach` is violated" in await own.summary("(soon = 1s)")

    watch(server, looking)


@pytest.mark.parametrize("protocols", [(OLD_PROTOCOL,), (OLD_PROTOCOL, PROTOCOL)])
def test_a_viewer_without_playback_control_steers_by_parameters(
    server: Serving, protocols: tuple[Subprotocol, ...]
) -> None:
    async def session() -> None:
        async with viewer(server.address, *protocols) as own:
            received = own.record()
            assert own.connection.subprotocol in protocols
            await own.subscribe([ROBUSTNESS, STANDING])
            before = {"playback.time": 0.0, "playback.play": False, "playback.speed": 1.0}
            assert (await own.parameters()).items() >= before.items()
            assert (await own.steer(time=2.0, speed=FAST))["playback.time"] == 2.0
            assert (await own.message(ROBUSTNESS, lambda each: each.time_ns > 0)).time_ns == 2 * 10**9
            assert (await own.steer(play=True))["playback.play"] is True
            last = await own.message(STANDING, lambda each: each.time_ns == END_NS)
            assert StandingUpdate.FromString(last.data).results
            # it begins again at the end
            await own.steer(loop=True, play=True)
            await own.message(ROBUSTNESS, lambda each: each.time_ns == END_NS)
            await own.message(ROBUSTNESS, lambda each: each.time_ns == 0)
            assert (await own.steer(play=False, loop=False))["playback.play"] is False
            assert not any(isinstance(each, State) for each in received)
            # one that asks for playback control understands it
            assert (await own.control(seek_ns=STEP_NS)).time_ns == STEP_NS

    asyncio.run(session())


def test_a_viewer_chooses_the_result_that_the_arrow_is_about() -> None:
    text = "spec near = G a closeto[1] b\nspec apart = G a farfrom[20] b"
    places = {"a": sr.Footprint.box(0, 0, 1, 1), "b": sr.Footprint.box(5, 0, 6, 1)}
    source = MemorySource.from_samples([sr.Sample(time_ns, places) for time_ns in (0, STEP_NS)], "run")

    def arrow(message: Message) -> list[str]:
        drawn = SceneUpdate.FromString(message.data).entities
        return [entity.texts[-1].text.strip() for entity in drawn if entity.id == "witness"]

    async def looking(own: Viewer) -> None:
        await own.subscribe([SCENE])
        assert arrow(await own.message(SCENE)) == ["a closeto[1] b now: -3"]
        assert (await own.parameters())["scene.arrow"] == ""
        await own.steer(**{"scene.arrow": "apart"})
        assert arrow(await own.message(SCENE)) == ["a farfrom[20] b now: -16"]
        await own.steer(**{"scene.arrow": "apar"})
        assert "did you mean 'apart'?" in await own.rejected()
        assert (await own.parameters())["scene.arrow"] == "apart"

    loaded = LoadedLog(source, [sr.parse_specification(text)])
    with open_server(loaded.evaluate(), port=0) as server:
        watch(server, looking)


def objects_of(schema: Any) -> Iterator[dict[str, Any]]:
    """Every object that a JSON schema describes."""
    if isinstance(schema, dict):
        if schema.get("type") == "object":
            yield schema
        for each in schema.values():
            yield from objects_of(each)


@pytest.mark.parametrize("protocol", [OLD_PROTOCOL, PROTOCOL])
def test_a_viewer_steers_by_calling_services(server: Serving, protocol: Subprotocol) -> None:
    async def session() -> None:
        async with viewer(server.address, protocol) as own:
            await own.subscribe([ROBUSTNESS])
            assert (await own.call("seek", {"time": 2.0}))["time"] == 2.0
            await own.message(ROBUSTNESS, lambda each: each.time_ns == 2 * 10**9)
            assert (await own.call("speed", {"speed": FAST}))["speed"] == FAST
            assert (await own.call("play", {}))["play"] is True
            await own.message(ROBUSTNESS, lambda each: each.time_ns == END_NS)
            stopped = await own.call("pause", None, raw=b"")
            assert stopped == {"time": END_NS / 1e9, "play": False, "speed": FAST, "loop": False}
            [advertised] = [
                each["services"]
                for each in own.record()
                if isinstance(each, dict) and each["op"] == "advertiseServices"
            ]
            for each in advertised:
                for described in (each["request"], each["response"]):
                    assert described["encoding"] == "json"
                    assert described["schemaEncoding"] == "jsonschema"
                    # Lichtblick fails at a service with an object that does not list its properties
                    assert all("properties" in found for found in objects_of(json.loads(described["schema"])))
            for service, request in (("seek", {}), ("seek", {"time": -1}), ("speed", {"speed": 1000})):
                with pytest.raises(ValueError, match=r"^failed: the request"):
                    await own.call(service, request)
            assert await own.call("pause", {}) == stopped

    asyncio.run(session())


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("time", -1.0),
        ("time", "soon"),
        ("play", 1.0),
        ("loop", "x"),
        ("speed", True),
        ("speed", 0.0),
        ("speed", 1000.0),
    ],
)
def test_a_playback_that_cannot_be_is_refused(server: Serving, name: str, given: object) -> None:
    async def looking(own: Viewer) -> None:
        before = await own.parameters()
        after = await own.steer(**{name: given})
        assert f"playback.{name} cannot be" in str(after.pop("rejected"))
        assert after | {"rejected": ""} == before
        assert (await own.steer(speed=2.0))["rejected"] == "", "an accepted value takes the error away"

    watch(server, looking)


def test_a_specification_without_constants_has_parameters_too() -> None:
    loaded = LoadedLog(PiecewiseSource(run(5), 7), [sr.parse_specification("spec reach = F cube ovlp cube")])
    with open_server(loaded.evaluate(), port=0) as server:

        async def looking(own: Viewer) -> None:
            names = [
                "playback.time",
                "playback.play",
                "playback.speed",
                "playback.loop",
                "scene.arrow",
                "rejected",
            ]
            assert sorted(await own.parameters()) == sorted(names)

        watch(server, looking)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"fat": 1.0}, "did you mean 'far'"),
        ({"far": "near"}, "it is a number"),
        ({"soon": -3}, "soon"),
        ({"soon": "later"}, "soon"),
        ({"soon": "9" * 5000}, "soon"),
        ({"far": True}, "far"),
        ({"far": {"a": [1]}}, "far"),
        ({"far": [1.0]}, "far"),
        ({"far": 1.0, "soon": "x"}, "soon"),
    ],
)
def test_invalid_values_change_nothing(server: Serving, values: dict[str, object], reason: str) -> None:
    async def looking(own: Viewer) -> None:
        await own.send(
            op="setParameters",
            parameters=[{"name": name, "value": given} for name, given in values.items()],
            id="set",
        )
        assert reason in await own.rejected()
        assert await own.constants() == {"far": 0.5, "soon": 10}

    watch(server, looking)


def test_a_change_that_fails_in_evaluation_restores_the_former_values() -> None:
    text = "const wide = 1\nregion goal = box(0, 0, wide, 1)\nspec reach = F (cube ovlp goal)\n"
    loaded = LoadedLog(PiecewiseSource(run(5), 7), [sr.parse_specification(text)])
    with open_server(loaded.evaluate(), port=0) as server:

        async def looking(own: Viewer) -> None:
            await own.send(op="subscribeParameterUpdates", parameterNames=["wide"])
            await own.set(wide=1e300)
            assert "1e+300" in await own.rejected()
            await own.next_of(dict, lambda each: [of["value"] for of in each.get("parameters", ())] == [1])
            assert await own.constants() == {"wide": 1}
            assert await own.set(wide=2) == {"wide": 2}
            await own.summary("(wide = 2)")

        watch(server, looking)


def test_constants_are_not_written_into_files_that_are_not_watched(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        with pytest.raises(ValueError, match="give --spec FILE and --watch"):
            await own.call("write_constants", {"constants": {"far": 0.2}})

    watch(server, looking)


def test_the_last_of_many_changes_counts(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        for number in range(50):
            await own.send(op="setParameters", parameters=[{"name": "far", "value": number / 10}])
        await own.summary("(far = 4.9)")
        assert (await own.constants())["far"] == 4.9

    watch(server, looking)


def test_viewers_share_one_time_and_one_set_of_constants(server: Serving) -> None:
    async def session() -> None:
        async with viewer(server.address) as first, viewer(server.address) as second:
            await second.send(op="subscribeParameterUpdates", parameterNames=["far"])
            await second.subscribe([CURVES_TOPIC])
            await second.message(CURVES_TOPIC)
            await first.control(seek_ns=STEP_NS, request="mine")
            assert (await second.next_of(State, lambda each: each.did_seek)).time_ns == STEP_NS
            await first.set(far=3.0)
            update = await second.next_of(dict, lambda each: each["op"] == "parameterValues")
            assert update["parameters"] == [{"name": "far", "type": "float64", "value": 3.0}]
            await second.summary("(far = 3)")

    asyncio.run(session())


NONSENSE = [
    "{{{",
    '{"op": "no such thing"}',
    '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99999}]}',
    '{"op": "subscribe"}',
    "[" * 10_000,
    b"",
    b"\x09garbage",
    b"\x03\x00",
    struct.pack("<BBfBQI", 3, 9, 1.0, 0, 0, 0),
    struct.pack("<BBfBQI", 3, 0, 1.0, 0, 0, 2**31),
    struct.pack("<BIII", 2, 77, 1, 4) + b"json{}",
    b"\x01" + bytes(4) + b"data",
    bytes(1 << 22),
]


def test_malformed_requests_and_lost_connections_disturb_no_other_viewer(server: Serving) -> None:
    async def session() -> None:
        async with viewer(server.address) as sane:
            await sane.subscribe([ROBUSTNESS])
            await sane.message(ROBUSTNESS)
            for raw in NONSENSE:
                async with viewer(server.address) as insane:
                    await insane.connection.send(raw)
                    insane.connection.transport.abort()
            with pytest.raises((WebSocketException, OSError)):
                async with connect(server.address):
                    pass
            raw_socket = socket.create_connection(("127.0.0.1", int(server.address.rpartition(":")[2])))
            raw_socket.sendall(b"GET / HTTP/1.1\r\n\r\n\x00\xff")
            raw_socket.close()
            await sane.control(play=True, speed=FAST)
            await sane.next_of(State, lambda each: each.status == ENDED)

    asyncio.run(session())


def test_a_viewer_that_reads_nothing_delays_neither_others_nor_the_end() -> None:
    async def session() -> None:
        with served(600) as server:
            async with viewer(server.address) as sane:
                stuck = await connect(server.address, subprotocols=[PROTOCOL])
                every = [{"id": number, "channelId": number} for number in sane.channels.values()]
                await stuck.send(json.dumps({"op": "subscribe", "subscriptions": every}))
                stuck.transport.pause_reading()
                await sane.subscribe([ROBUSTNESS])
                await sane.control(play=True, speed=100.0)
                await sane.next_of(State, lambda each: each.status == ENDED)
        stuck.transport.abort()

    asyncio.run(session())


def test_services_answer_in_json(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        shown = await own.call("evaluate", {})
        assert [each["verdict"] for each in shown["specifications"]] == ["satisfied", "unknown"]
        assert "series" not in shown["specifications"][0]
        assert shown["constants"] == {"far": 0.5, "soon": 10}
        other = await own.call("evaluate", {"constants": {"far": 3.0, "soon": "1s"}})
        assert [each["verdict"] for each in other["specifications"]] == ["violated", "violated"]
        assert other["constants"] == {"far": 3, "soon": 1}
        assert (await own.call("evaluate", {"constants": {"soon": 1}}))["constants"]["soon"] == 1
        assert await own.constants() == {"far": 0.5, "soon": 10}
        [why] = (await own.call("explain", {"node": "apart"}))["explanations"]
        assert why["explanation"][0].startswith("`apart` is unknown")
        assert len((await own.call("explain", None, raw=b""))["explanations"]) == 2

    watch(server, looking)


def test_services_answer_with_the_constants_that_were_set_before(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        await own.subscribe([CURVES_TOPIC, ROBUSTNESS, SCENE])
        for number in range(10):
            # the player is busy with showing the former values
            far = (await own.set(far=number / 7))["far"]
            assert (await own.call("evaluate", {}))["constants"]["far"] == far

    watch(server, looking)


def test_advice_names_a_constant_that_a_viewer_changed() -> None:
    text = "const near = 4\nregion goal = box(4, -1, 9, 2)\nspec close = G (cube dist goal <= near)\n"
    loaded = LoadedLog(PiecewiseSource(run(5), 7), [sr.parse_specification(text)])
    with open_server(loaded.evaluate(), port=0) as server:

        async def looking(own: Viewer) -> None:
            await own.set(near=1.5)
            answer = await own.call("explain", {})
            assert answer["constants"] == {"near": 1.5}
            texts = answer["explanations"][0]["explanation"]
            assert any("or more instead of 1.5 for `near`" in text for text in texts)

        watch(server, looking)


@pytest.mark.parametrize(
    ("service", "raw", "said"),
    [
        ("evaluate", b"{", "not JSON"),
        ("evaluate", b"[" * 60_000, "not JSON"),
        ("evaluate", b"[]", "not of type 'object'"),
        ("evaluate", b'{"constant": {}}', "'constant' was unexpected"),
        ("evaluate", b'{"constants": {"fat": 1}}', "did you mean 'far'"),
        ("evaluate", b'{"constants": {"far": NaN}}', "finite"),
        ("evaluate", b" " * 100_000, "bytes"),
        ("explain", b'{"node": "apat"}', "apart"),
        ("explain", b'{"object": "ghost"}', "ghost"),
    ],
)
def test_services_name_the_error_in_a_request(server: Serving, service: str, raw: bytes, said: str) -> None:
    async def looking(own: Viewer) -> None:
        with pytest.raises(ValueError, match=said):
            await own.call(service, None, raw=raw)

    watch(server, looking)


def test_only_known_files_can_be_fetched(server: Serving) -> None:
    async def looking(own: Viewer) -> None:
        layout = json.loads((await own.fetch("spatial-replay://layout.json")).data)
        assert "Parameters!constants" in layout["configById"]
        text = (await own.fetch("spatial-replay://specification/blocks.spatial")).data.decode()
        assert sr.parse_specification(text) == specification()
        assert (await own.fetch("spatial-replay://automaton/apart.dot")).data.startswith(b"digraph")
        for uri in ("", "../pyproject.toml", "specification/../blocks.spatial", "automaton//etc/passwd"):
            assert (await own.fetch(f"spatial-replay://{uri}")).error
        assert (await own.fetch("file:///etc/passwd")).error

    watch(server, looking)


def test_messages_of_other_programs_are_played_if_viewers_can_decode_them(tmp_path: Path) -> None:
    schema = Schema("any.Thing", "ros1msg", b"int32 number")
    first, second = (Channel("/tf", "ros1", schema, {"by": name}) for name in ("arm", "base"))
    notes, secret = Channel("/notes", "json", None), Channel("/secret", "ros1", None)
    objects = protobuf_channel(OBJECTS, ObjectStates)
    log = tmp_path / "run.mcap"
    with open_output(log) as stream, LogWriter(stream) as writer:
        for index, payload in enumerate(encode_objects(run(COUNT))):
            writer.write(objects, index * STEP_NS, payload)
            for channel in (first, second, notes, secret):
                writer.write(channel, index * STEP_NS, b"12")
    loaded = LoadedLog(open_source(log), [specification()])
    with open_server(loaded.evaluate(), port=0) as server:

        async def looking(own: Viewer) -> None:
            assert {"/tf", "/notes"} <= {*own.channels}
            assert "/secret" not in own.channels
            await own.subscribe(["/tf", "/notes"])
            await own.control(play=True, speed=FAST, seek_ns=10 * STEP_NS)
            after = [index * STEP_NS for index in range(11, COUNT)]
            for topic, publishers in (("/tf", 2), ("/notes", 1)):
                expected = sorted(after * publishers)
                found = [await own.message(topic, lambda each: each.time_ns > 10 * STEP_NS) for _ in expected]
                assert [each.time_ns for each in found] == expected

        watch(server, looking)


def test_a_log_that_can_no_longer_be_read_is_reported(tmp_path: Path) -> None:
    log = record(run(COUNT), tmp_path / "run.mcap")
    with open_server(LoadedLog(open_source(log), [specification()]).evaluate(), port=0) as server:
        log.unlink()

        async def looking(own: Viewer) -> None:
            await own.control(play=True, seek_ns=10 * STEP_NS)
            assert "could not be read" in await own.note("log")
            assert (
                await own.next_of(State, lambda each: not each.request and not each.did_seek)
            ).status == PAUSED
            assert await own.constants() == {"far": 0.5, "soon": 10}

        watch(server, looking)


async def _status(address: str, origin: str | None) -> int:
    """The answer to a viewer from somewhere: 101 if it may come in."""
    try:
        async with connect(address, subprotocols=[PROTOCOL], origin=Origin(origin) if origin else None):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_only_viewers_and_pages_of_this_machine_may_connect() -> None:
    own = LoadedLog(PiecewiseSource(run(COUNT), 7), [specification()]).evaluate()
    may = [None, "https://app.foxglove.dev", "http://localhost:8080", "http://127.0.0.1:3000", "http://[::1]"]
    may += ["https://viewer.example.org", "file://"]
    may_not = [
        "https://evil.example",
        "https://app.foxglove.dev.evil.example",
        "null",
        "http://localhost.evil",
    ]
    may_not += ["http://app.foxglove.dev", "https://viewer.example.org:444", "ftp://localhost"]
    with open_server(own, port=0, origins=["https://viewer.example.org/"]) as server:

        async def trying() -> None:
            assert {each: await _status(server.address, each) for each in may} == dict.fromkeys(may, 101)
            found = {each: await _status(server.address, each) for each in may_not}
            assert found == dict.fromkeys(may_not, 403)

        asyncio.run(trying())
    with (
        pytest.raises(UsageError, match="'evil' is not the origin of a page"),
        open_server(own, origins=["evil"]),
    ):
        pass


def test_beyond_this_machine_a_token_is_needed() -> None:
    own = LoadedLog(PiecewiseSource(run(COUNT), 7), [specification()]).evaluate()
    with open_server(own, port=0, host="0.0.0.0") as server:
        address = server.address.replace("0.0.0.0", "127.0.0.1")
        bare = address.partition("/?")[0]

        async def trying() -> None:
            assert await _status(address, "https://app.foxglove.dev") == 101
            assert await _status(address, "https://evil.example") == 403
            assert [await _status(f"{bare}{each}", None) for each in ("", "/?token=", "/?token=no")] == [
                401
            ] * 3
            async with viewer(address) as looking:
                assert looking.info["name"] == "spatial-replay: run"

        asyncio.run(trying())


def test_what_is_no_request_of_a_viewer_is_refused_or_dropped(server: Serving) -> None:
    port = int(server.address.rpartition(":")[2])
    for sent, answered in ((b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", b"426"), (b"x" * 10**5, b"")):
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection, suppress(OSError):
            connection.sendall(sent)
            assert answered in connection.recv(1000)

    async def looking(own: Viewer) -> None:
        assert own.info["name"] == "spatial-replay: run"

    watch(server, looking)


@pytest.mark.parametrize("host", ["8.8.8.8", "no.such.host.invalid", "a..b", "::2", ""])
def test_an_address_of_another_machine_is_an_error(host: str) -> None:
    loaded = LoadedLog(PiecewiseSource(run(3), 7), [specification()])
    expected = f"cannot listen at {host or 'no address'}: .*; choose an address of this machine with --host"
    with pytest.raises(UsageError, match=expected), open_server(loaded.evaluate(), host=host, port=0):
        pass


def test_a_port_in_use_is_an_error(server: Serving) -> None:
    port = int(server.address.rpartition(":")[2])
    loaded = LoadedLog(PiecewiseSource(run(3), 7), [specification()])
    with (
        pytest.raises(UsageError, match=f"port {port}: .*; choose another"),
        open_server(loaded.evaluate(), port=port),
    ):
        pass


def test_long_logs_have_thinned_curves() -> None:
    with served(3 * MOST_POINTS) as server:

        async def looking(own: Viewer) -> None:
            await own.subscribe([CURVES_TOPIC])
            curves = Curves.FromString((await own.message(CURVES_TOPIC)).data)
            assert len(curves.time) == MOST_POINTS
            assert list(curves.time) == sorted(curves.time)
            for each in curves.specifications:
                for node in each.nodes:
                    assert len(node.value) == MOST_POINTS
                    assert len(node.now) in (0, MOST_POINTS)

        watch(server, looking)


def test_viewers_are_disconnected_at_the_end() -> None:
    async def session() -> None:
        with served() as server:
            connection = await connect(server.address, subprotocols=[PROTOCOL])
        await asyncio.wait_for(connection.wait_closed(), PATIENCE_S)

    asyncio.run(session())
