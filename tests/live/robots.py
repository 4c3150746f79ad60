"""Servers for monitors: a log played by another process, a robot in this one, one that keeps no rules."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import foxglove
from foxglove_schemas_protobuf.Event_pb2 import Event
from mcap.reader import make_reader
from websockets.exceptions import WebSocketException
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

from spatial_replay.bags.decoders import channel_of
from spatial_replay.bags.open import open_messages
from spatial_replay.logs.topics import EVENTS

PATIENCE_S = 300.0
PLAYER = Path(__file__).with_name("player.py")
MS = 10**6

MAPPING = """
topics:
  /robot: {name: robot, position: [x, y], shape: {disc: 0.1}}
  /vase: {name: vase, position: [x, y], shape: {disc: 0.1}}
sample: {topic: /robot}
max_age: 10s
"""
SPEC = "spec clear = G (robot dist vase >= 0.5)\nspec seen = F (robot dist vase <= 9)\n"


class Player:
    """A process that plays a log; see player.py."""

    def __init__(
        self, log: Path, *topics: str, speed: float = 3, begin: float = 0, end: float = 1e6, port: int = 0
    ) -> None:
        arguments = [str(each) for each in (log, port, speed, begin, end, *topics)]
        self.process = subprocess.Popen(
            [sys.executable, str(PLAYER), *arguments], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline())
        self.address = f"ws://127.0.0.1:{self.port}"

    def wait(self) -> None:
        """Wait until everything was played."""
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "played\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@contextmanager
def playing(log: Path, *topics: str, **options: float) -> Iterator[Player]:
    player = Player(log, *topics, **options)  # type: ignore[arg-type]
    try:
        yield player
    finally:
        player.kill()


class Robot:
    """A server of the Foxglove SDK with a robot that drives past a vase, as JSON."""

    def __init__(self) -> None:
        self._context = foxglove.Context()
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema={"type": "object", "title": "Pose"},
                message_encoding="json",
                context=self._context,
            )
            for topic in ("/robot", "/vase", "/note")
        }
        self.server = foxglove.start_server(name="robot", host="127.0.0.1", port=0, context=self._context)
        self.address = f"ws://127.0.0.1:{self.server.port}"

    def is_heard(self) -> bool:
        return all(self._channels[topic].has_sinks() for topic in ("/robot", "/vase"))

    def send(self, topic: str, time_ns: int, **fields: object) -> None:
        self._channels[topic].log(json.dumps(fields).encode(), log_time=time_ns)

    def drive(self, tick: int, x: float = 0.0) -> None:
        """Report both poses at a tick of 10 ms, the vase at the origin."""
        self.send("/vase", tick * 10 * MS, x=0.0, y=0.0)
        self.send("/robot", tick * 10 * MS + 1, x=x, y=0.0)


@contextmanager
def robot() -> Iterator[Robot]:
    own = Robot()
    try:
        yield own
    finally:
        stopping = threading.Thread(target=own.server.stop, daemon=True)
        stopping.start()
        stopping.join(1.0)


ADVERTISED = {
    "op": "advertise",
    "channels": [
        {
            "id": number,
            "topic": topic,
            "encoding": "json",
            "schemaName": "Pose",
            "schema": '{"type":"object"}',
        }
        for number, topic in enumerate(("/robot", "/vase"), 1)
    ],
}


def frame(number: int, time_ns: int, payload: bytes) -> bytes:
    return struct.pack("<BIQ", 1, number, time_ns) + payload


def pose(number: int, tick: int, x: float = 0.0) -> bytes:
    return frame(number, tick * 10 * MS + (number == 1), json.dumps({"x": x, "y": 0.0}).encode())


@contextmanager
def _served(serving: Callable[[ServerConnection], None], protocol: str) -> Iterator[str]:
    with serve(serving, "127.0.0.1", 0, subprotocols=[Subprotocol(protocol)], max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(5)


@contextmanager
def bridge(bag: Path, *topics: str, protocol: str, end: float, speed: float) -> Iterator[str]:
    """A server that speaks as foxglove_bridge does, with the messages of a bag.

    It announces each topic in a frame of its own, as ROS finds them. Between messages it sends what a monitor
    has no use for: times, parameters, services, the graph of nodes, what it says about itself.
    """
    reader = open_messages(bag)
    first_ns = reader.start_ns or 0
    messages = list(reader.iter_messages(topics, None, first_ns + round(end * 1e9)))
    declared = {topic.name: channel_of(topic) for topic in reader.topics()}
    numbers = {topic: number for number, topic in enumerate(declared, 1)}
    asides: list[str | bytes] = [
        json.dumps({"op": "parameterValues", "parameters": [{"name": "/use_sim_time", "value": False}]}),
        json.dumps(
            {"op": "advertiseServices", "services": [{"id": 1, "name": "/reset", "type": "std_srvs/Empty"}]}
        ),
        json.dumps(
            {
                "op": "connectionGraphUpdate",
                "publishedTopics": [{"name": topic, "publisherIds": ["/sim"]} for topic in topics],
                "subscribedTopics": [],
                "advertisedServices": [],
                "removedTopics": [],
                "removedServices": [],
            }
        ),
        json.dumps({"op": "status", "level": 1, "message": "Send buffer limit reached", "id": "buffer"}),
        json.dumps({"op": "removeStatus", "statusIds": ["buffer"]}),
        struct.pack("<BQ", 2, first_ns),
        struct.pack("<BIII", 3, 1, 1, 4) + b"cdr" + bytes(1),
    ]

    def serving(connection: ServerConnection) -> None:
        with suppress(WebSocketException, OSError):
            info = {
                "op": "serverInfo",
                "name": "foxglove_bridge",
                "capabilities": [
                    "clientPublish",
                    "connectionGraph",
                    "parametersSubscribe",
                    "parameters",
                    "services",
                ],
                "supportedEncodings": [declared[topics[0]].encoding],
                "metadata": {"ROS_DISTRO": "humble"},
                "sessionId": "1700000000",
            }
            connection.send(json.dumps(info))
            subscribed: dict[str, int] = {}
            for topic, channel in declared.items():
                schema = channel.schema
                assert schema is not None
                described = {
                    "id": numbers[topic],
                    "topic": topic,
                    "encoding": channel.encoding,
                    "schemaName": schema.name,
                    "schema": schema.data.decode(),
                    "schemaEncoding": schema.encoding,
                }
                connection.send(json.dumps({"op": "advertise", "channels": [described]}))
            while set(subscribed) != set(topics):
                request = json.loads(connection.recv(30))
                assert set(request) == {"op", "subscriptions"} and request["op"] == "subscribe"
                for each in request["subscriptions"]:
                    assert set(each) == {"id", "channelId"}
                    subscribed |= {
                        topic: each["id"] for topic in topics if numbers[topic] == each["channelId"]
                    }
            with suppress(TimeoutError):
                connection.recv(0.6)
            began = time.monotonic()
            for place, message in enumerate(messages):
                due_s = began + (message.log_time_ns - first_ns) / 1e9 / speed
                time.sleep(max(0.0, due_s - time.monotonic()))
                connection.send(asides[place % len(asides)])
                connection.send(frame(subscribed[message.topic], message.log_time_ns, message.payload))
            connection.recv(60)

    with _served(serving, protocol) as address:
        yield address


@contextmanager
def rude_server(
    *sent: str | bytes, protocol: str = "foxglove.websocket.v1", breaks_off: bool = False
) -> Iterator[str]:
    """A server that sends what it is given once it is subscribed to, whatever it is.

    Args:
        breaks_off: go away in the middle of another message.
    """

    def serving(connection: ServerConnection) -> None:
        with suppress(WebSocketException, OSError):
            connection.send(json.dumps({"op": "serverInfo", "name": "rude", "capabilities": []}))
            connection.send(json.dumps(ADVERTISED))
            assert json.loads(connection.recv(30))["op"] == "subscribe"
            # a monitor begins once no further topics are offered
            with suppress(TimeoutError):
                connection.recv(0.6)
            for each in sent:
                connection.send(each)
            if breaks_off:
                # a binary frame of 126 bytes, of which 10 come
                connection.socket.sendall(bytes([0x82, 126, 0, 126]) + bytes(10))
                connection.socket.shutdown(socket.SHUT_RDWR)
            connection.recv(60)

    with _served(serving, protocol) as address:
        yield address


def files(folder: Path, mapping: str, spec: str) -> tuple[Path, Path]:
    (folder / "map.yaml").write_text(mapping)
    (folder / "safe.spatial").write_text(spec)
    return folder / "map.yaml", folder / "safe.spatial"


def until(is_over: Callable[[], bool]) -> None:
    """Wait for something that another thread or process does."""
    limit = time.monotonic() + PATIENCE_S
    while not is_over():
        assert time.monotonic() < limit
        time.sleep(0.005)


def messages_of(path: Path) -> list[tuple[str, int, bytes]]:
    """The messages of a log, as the stock library reads them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=True)
        ]


class Occurrence(NamedTuple):
    """An event that no specification has."""

    time_ns: int
    what: str
    sentence: str


def occurrence(time_ns: int, data: bytes) -> Occurrence | None:
    """Decode an event; None for a change of a result."""
    facts = {each.key: each.value for each in Event.FromString(data).metadata}
    return Occurrence(time_ns, facts["occurrence"], facts["message"]) if "occurrence" in facts else None


def occurrences(path: Path) -> list[Occurrence]:
    """What happened to a run, as its log says."""
    events = [occurrence(time_ns, data) for topic, time_ns, data in messages_of(path) if topic == EVENTS]
    return [each for each in events if each is not None]


def drive(own: Robot, ticks: range, pause_s: float = 0.004) -> threading.Thread:
    """Let a robot drive towards the vase, once it is listened to, from x = 1 by a centimetre each tick."""

    def run_ticks() -> None:
        until(own.is_heard)
        for tick in ticks:
            own.drive(tick, 1.0 - tick / 100)
            time.sleep(pause_s)

    driving = threading.Thread(target=run_ticks)
    driving.start()
    return driving
