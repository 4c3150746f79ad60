"""A viewer of the live server: a WebSocket client of `foxglove.sdk.v1` or `foxglove.websocket.v1`."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from spatial_replay.logs.schemas.Curves_pb2 import Curves

PROTOCOL = Subprotocol("foxglove.sdk.v1")
OLD_PROTOCOL = Subprotocol("foxglove.websocket.v1")
"""Of viewers that know no playback state: Lichtblick, which offers both names, and older ones."""

PATIENCE_S = 60.0
"""How long a viewer waits for what has to come."""

PLAYING, PAUSED, ENDED = 0, 1, 3
_CALL, _CONTROL = 2, 3


class Message(NamedTuple):
    """A message on a topic."""

    topic: str
    time_ns: int
    data: bytes


class State(NamedTuple):
    """What the playback does."""

    status: int
    time_ns: int
    speed: float
    did_seek: bool
    request: str


class Asset(NamedTuple):
    """The answer to a request for a file: its content, or why there is none."""

    request: int
    error: str
    data: bytes


Received = Message | State | Asset | dict[str, Any] | int


@dataclass
class Viewer:
    """A connection, and the messages received over it that were not read yet."""

    connection: ClientConnection
    channels: dict[str, int] = field(default_factory=dict)
    services: dict[str, int] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    _subscribed: set[str] = field(default_factory=set)
    _waiting: list[Received] = field(default_factory=list)
    _record: list[Received] = field(default_factory=list)
    _received: asyncio.Queue[Received] = field(default_factory=asyncio.Queue)

    async def listen(self) -> None:
        """Take in what comes, until the connection ends."""
        async for raw in self.connection:
            received = json.loads(raw) if isinstance(raw, str) else self._decoded(raw)
            match received:
                case {"op": "serverInfo"}:
                    self.info = received
                case {"op": "advertise", "channels": channels}:
                    self.channels |= {each["topic"]: each["id"] for each in channels}
                case {"op": "advertiseServices", "services": services}:
                    self.services |= {each["name"]: each["id"] for each in services}
            self._record.append(received)
            self._received.put_nowait(received)

    def record(self) -> list[Received]:
        """All that comes from now on, as it comes."""
        return self._record

    async def until(self, is_wanted: Callable[[Any], bool]) -> list[Received]:
        """All that comes up to the first that is wanted, which is the last of the list."""
        found: list[Received] = []
        async with asyncio.timeout(PATIENCE_S):
            while not found or not is_wanted(found[-1]):
                found.append(await self._next())
        return found

    async def next_of(self, kind: type[Any], is_wanted: Callable[[Any], bool] = lambda each: True) -> Any:
        """Return the next wanted message of a kind; others stay to be read later."""
        passed: list[Received] = []
        async with asyncio.timeout(PATIENCE_S):
            while True:
                received = await self._next()
                if isinstance(received, kind) and is_wanted(received):
                    self._waiting = passed + self._waiting
                    return received
                passed.append(received)

    async def message(self, topic: str, is_wanted: Callable[[Message], bool] = lambda each: True) -> Message:
        """The next message on a topic."""
        found: Message = await self.next_of(Message, lambda each: each.topic == topic and is_wanted(each))
        return found

    async def note(self, about: str, says: str = "") -> str:
        """The text of the next note about something."""
        found = await self.next_of(
            dict, lambda each: each["op"] == "status" and each.get("id") == about and says in each["message"]
        )
        text: str = found["message"]
        return text

    async def rejected(self) -> str:
        """Why the last value was rejected, once that is known."""
        async with asyncio.timeout(PATIENCE_S):
            while not (text := str((await self.parameters())["rejected"])):
                await asyncio.sleep(0)
        return text

    async def summary(self, says: str = "") -> str:
        """What the next message about the whole log says that it comes to."""
        if "/spatial/curves" not in self._subscribed:
            await self.subscribe(["/spatial/curves"])
        found = await self.message(
            "/spatial/curves", lambda each: says in Curves.FromString(each.data).summary
        )
        return Curves.FromString(found.data).summary

    async def subscribe(self, topics: Iterable[str] | None = None) -> None:
        """Subscribe to topics, or to all."""
        chosen = list(self.channels if topics is None else topics)
        self._subscribed.update(chosen)
        subscriptions = [{"id": self.channels[topic], "channelId": self.channels[topic]} for topic in chosen]
        await self.send(op="subscribe", subscriptions=subscriptions)

    async def send(self, **request: Any) -> None:
        await self.connection.send(json.dumps(request))

    async def control(
        self, *, play: bool = False, speed: float = 1.0, seek_ns: int | None = None, request: str = "control"
    ) -> State:
        """Play or pause; the state that answers it."""
        await self.ask(play=play, speed=speed, seek_ns=seek_ns, request=request)
        found: State = await self.next_of(State, lambda each: each.request == request)
        return found

    async def ask(
        self, *, play: bool = False, speed: float = 1.0, seek_ns: int | None = None, request: str = "control"
    ) -> None:
        """Ask to play or pause."""
        head = struct.pack("<BBfBQ", _CONTROL, not play, speed, seek_ns is not None, seek_ns or 0)
        await self.connection.send(head + struct.pack("<I", len(request)) + request.encode())

    async def set(self, **values: Any) -> dict[str, Any]:
        """Give constants other values; the values that they have then."""
        return constants_of(await self.steer(**values))

    async def constants(self) -> dict[str, Any]:
        return constants_of(await self.parameters())

    async def steer(self, **values: Any) -> dict[str, Any]:
        """Set parameters, `play` for `playback.play`; the values of all of them then."""
        own = {"time", "play", "speed", "loop"}
        parameters = [
            {"name": f"playback.{name}" if name in own else name, "value": value}
            for name, value in values.items()
        ]
        await self.send(op="setParameters", parameters=parameters, id="set")
        return await self._parameters("set")

    async def parameters(self) -> dict[str, Any]:
        await self.send(op="getParameters", parameterNames=[], id="get")
        return await self._parameters("get")

    async def call(self, service: str, request: Any, *, raw: bytes | None = None) -> Any:
        """The answer of a service; raises ValueError with its error."""
        payload = json.dumps(request).encode() if raw is None else raw
        head = struct.pack("<BIII", _CALL, self.services[service], 7, len("json"))
        await self.connection.send(head + b"json" + payload)
        answer = await self.next_of(
            dict, lambda each: each["op"] in ("serviceCallFailure", "serviceCallResponse")
        )
        if answer["op"] == "serviceCallFailure":
            raise ValueError(answer["message"])
        return answer["response"]

    async def fetch(self, uri: str) -> Asset:
        await self.send(op="fetchAsset", uri=uri, requestId=3)
        found: Asset = await self.next_of(Asset)
        return found

    async def _next(self) -> Received:
        return self._waiting.pop(0) if self._waiting else await self._received.get()

    async def _parameters(self, request: str) -> dict[str, Any]:
        found = await self.next_of(
            dict, lambda each: each["op"] == "parameterValues" and each.get("id") == request
        )
        return {each["name"]: each["value"] for each in found["parameters"]}

    def _decoded(self, raw: bytes) -> Received:
        match raw[0]:
            case 1:
                channel, time_ns = struct.unpack_from("<IQ", raw, 1)
                topics = {number: topic for topic, number in self.channels.items()}
                return Message(topics[channel], time_ns, raw[13:])
            case 2:
                time_ns = struct.unpack_from("<Q", raw, 1)[0]
                return int(time_ns)
            case 3:
                length = struct.unpack_from("<I", raw, 9)[0]
                return {"op": "serviceCallResponse", "response": json.loads(raw[13 + length :])}
            case 4:
                request, failed, length = struct.unpack_from("<IBI", raw, 1)
                text = raw[10 : 10 + length].decode() if failed else ""
                return Asset(request, text, b"" if failed else raw[10 + length :])
            case 5:
                status, time_ns, speed, did_seek, length = struct.unpack_from("<BQfBI", raw, 1)
                return State(status, time_ns, speed, bool(did_seek), raw[19 : 19 + length].decode())
        raise ValueError(f"{raw[0]} is no message of a server")


def constants_of(parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters that do not steer the playback."""
    return {
        name: value
        for name, value in parameters.items()
        if not name.startswith(("playback.", "scene.", "rejected"))
    }


@asynccontextmanager
async def viewer(address: str, *protocols: Subprotocol) -> AsyncIterator[Viewer]:
    """Connect, and wait until the server has said what it has."""
    async with connect(address, subprotocols=protocols or [PROTOCOL], max_size=None) as connection:
        own = Viewer(connection)
        listening = asyncio.create_task(own.listen())
        try:
            await own.next_of(dict, lambda each: each["op"] == "advertiseServices")
            yield own
        finally:
            listening.cancel()
