"""Client of a robot's Foxglove server: its connection, and an inbox of unread messages."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

from spatial_replay.errors import LogError, RemoteError, UsageError, importing, system_reason
from spatial_replay.live.protocol import (
    SUBPROTOCOLS,
    Advertised,
    Connected,
    MessageData,
    Unadvertised,
    Warned,
    decode_frame,
    subscribe,
)
from spatial_replay.logs.messages import Channel

with importing("a running robot is listened to with websockets", extra="live"):
    from websockets.asyncio.client import ClientConnection, connect
    from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
    from websockets.typing import Subprotocol

LARGEST_FRAME: Final = 64 * 2**20
"""Largest frame, bytes; a server that sends a larger frame is disconnected."""

MOST_WAITING: Final = 8_192
"""Limit of messages that wait for evaluation; the oldest messages are dropped first."""

MOST_WAITING_BYTES: Final = 64 * 2**20
"""Limit of the messages that wait for evaluation, bytes; the oldest messages are dropped first."""

MOST_WARNINGS: Final = 1_000
"""Maximum number of shown warnings of a server in one run."""

_MOST_CHANNELS: Final = 100_000
_MOST_DEFINITION_BYTES: Final = 64 * 2**20
"""Limit of all channels' definitions together, bytes."""
_FRAMES: Final = 4
"""Maximum number of frames of up to `LARGEST_FRAME` bytes that wait to be decoded."""
_LONGEST_TURN_S: Final = 0.02
_OPEN_S: Final = 10.0
"""Timeout of a connection attempt, seconds."""
_ALIVE_S: Final = 10.0
"""Interval of pings and timeout of each ping, seconds."""

_FIRST_PAUSE_S: Final = 0.25
"""Pause before the first reconnect, seconds; each later pause is twice as long as the previous pause."""
_LONGEST_PAUSE_S: Final = 8.0
"""Longest pause before a reconnect, seconds."""


class Received(NamedTuple):
    """A message with its arrival time on the monotonic clock."""

    channel: Channel
    time_ns: int
    payload: bytes
    arrived_s: float


class Offered(NamedTuple):
    """All channels that the server offers now, after a change."""

    channels: Collection[Channel]


class Disconnected(NamedTuple):
    """Loss of the connection; the inbox has all earlier messages of the server before this item."""

    reason: str
    arrived_s: float


Arrival: TypeAlias = Received | Connected | Offered | Disconnected | Warned


class Inbox:
    """Unread items in order of arrival; `MOST_WAITING` limits the messages.

    Attributes:
        dropped: number of messages that were dropped for lack of room.
    """

    def __init__(self) -> None:
        self._items: deque[Arrival] = deque()
        self._message_count = self._message_bytes = 0
        self._earlier_items: list[Arrival] = []
        self._latest_offer: Offered | None = None
        self._warning_count = 0
        self.dropped = 0
        self.filled = asyncio.Event()

    def put(self, arrival: Arrival) -> None:
        """Add an item; if there is no room, drop the oldest messages."""
        if isinstance(arrival, Received):
            self._message_count += 1
            self._message_bytes += len(arrival.payload)
            while self._message_count > 1 and (
                self._message_count > MOST_WAITING or self._message_bytes > MOST_WAITING_BYTES
            ):
                self._drop()
        if isinstance(arrival, Offered):
            # the channels are a live view: an unread item with the same view already shows the new channels
            if self._latest_offer is not None and self._latest_offer.channels is arrival.channels:
                return
            self._latest_offer = arrival
        if isinstance(arrival, Warned):
            self._warning_count += 1
            if self._warning_count == MOST_WARNINGS:
                arrival = Warned("the server sends too many warnings; further ones are left out")
            elif self._warning_count > MOST_WARNINGS:
                return
        self._items.append(arrival)
        self.filled.set()

    def take(self) -> list[Arrival]:
        """Remove and return all unread items."""
        arrivals = [*self._earlier_items, *self._items]
        self._items.clear()
        self._earlier_items.clear()
        self._latest_offer = None
        self._message_count = self._message_bytes = 0
        self.filled.clear()
        return arrivals

    def _drop(self) -> None:
        # only messages may be lost, so other items before the oldest message are kept
        while not isinstance(oldest := self._items.popleft(), Received):
            self._earlier_items.append(oldest)
        self._message_count -= 1
        self._message_bytes -= len(oldest.payload)
        self.dropped += 1


@dataclass(frozen=True, slots=True)
class Client:
    """A client that connects to a server, subscribes, and connects again when the connection is lost.

    Attributes:
        wants: function that returns whether to subscribe to a topic.
        record: receiver of each message at its arrival, even of messages that are dropped before evaluation.
    """

    address: str
    wants: Callable[[str], bool]
    inbox: Inbox
    record: Callable[[Received], None] = lambda received: None

    async def run(self) -> None:
        """Fill the inbox until cancelled.

        Raises:
            UsageError: `address` is not the address of a server.
            RemoteError: the first connection fails.
        """
        pause_s, was_connected = _FIRST_PAUSE_S, False
        while True:
            try:
                async with connect(
                    self.address,
                    subprotocols=[Subprotocol(protocol) for protocol in SUBPROTOCOLS],
                    compression=None,
                    max_size=LARGEST_FRAME,
                    max_queue=_FRAMES,
                    open_timeout=_OPEN_S,
                    ping_interval=_ALIVE_S,
                    ping_timeout=_ALIVE_S,
                    close_timeout=1.0,
                    proxy=None,
                ) as connection:
                    if connection.subprotocol is None:
                        raise RemoteError(
                            f"{self.address}: this server speaks none of {', '.join(SUBPROTOCOLS)}; give the"
                            " address of foxglove_bridge or of a Foxglove SDK server"
                        )
                    was_connected, pause_s = True, _FIRST_PAUSE_S
                    reason = await self._listen(connection)
                self.inbox.put(Disconnected(reason, time.monotonic()))
            except (OSError, InvalidHandshake, InvalidURI, EOFError, RemoteError, ValueError) as error:
                if not was_connected:
                    raise _connecting_error(self.address, error) from None
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    async def _listen(self, connection: ClientConnection) -> str:
        """Put all items into the inbox until the connection ends; return the reason of its end."""
        offered_channels: dict[int, Channel] = {}
        current_channels = offered_channels.values()
        subscribed_channels: dict[int, Channel] = {}
        has_warned = False
        definition_bytes = 0
        turn_start_s = time.monotonic()
        try:
            async for raw in connection:
                arrived_s = time.monotonic()
                if arrived_s - turn_start_s > _LONGEST_TURN_S:
                    # a flood of messages must not block Ctrl-C and the evaluation
                    await asyncio.sleep(0)
                    turn_start_s = arrived_s
                try:
                    frame = decode_frame(raw)
                except LogError as error:
                    if not has_warned:
                        has_warned = True
                        self.inbox.put(Warned(f"{self.address}: {error}; such frames are left out"))
                    continue
                match frame:
                    case MessageData(number, time_ns, payload):
                        channel = subscribed_channels.get(number)
                        if channel is not None:
                            received = Received(channel, time_ns, payload, arrived_s)
                            self.record(received)
                            self.inbox.put(received)
                    case Connected():
                        self.inbox.put(frame)
                    case Advertised(channels):
                        offered_channels |= channels
                        if len(offered_channels) > _MOST_CHANNELS:
                            return f"it offers more than {_MOST_CHANNELS} channels"
                        definition_bytes += sum(map(_definition_bytes, channels.values()))
                        if definition_bytes > _MOST_DEFINITION_BYTES:
                            return (
                                f"its channels have more than {_MOST_DEFINITION_BYTES} bytes of definitions"
                            )
                        new_channels = {
                            n: channel for n, channel in channels.items() if self.wants(channel.topic)
                        }
                        if new_channels:
                            subscribed_channels |= new_channels
                            await connection.send(subscribe(new_channels))
                        self.inbox.put(Offered(current_channels))
                    case Unadvertised(numbers):
                        for number in numbers:
                            offered_channels.pop(number, None)
                            subscribed_channels.pop(number, None)
                        self.inbox.put(Offered(current_channels))
                    case Warned(text):
                        self.inbox.put(Warned(f"{self.address} says: {text}"))
                    case _:
                        pass
        except ConnectionClosed as closed:
            return _closing_reason(closed)
        return "the server closed it"


def _definition_bytes(channel: Channel) -> int:
    size = len(channel.topic) + len(channel.encoding)
    return size if channel.schema is None else size + len(channel.schema.name) + len(channel.schema.data)


def _closing_reason(closed: ConnectionClosed) -> str:
    # 1009: message too big: https://www.rfc-editor.org/rfc/rfc6455#section-7.4.1
    if closed.sent is not None and closed.sent.code == 1009:
        return f"it sent a frame of more than {LARGEST_FRAME // 2**20} MB; subscribe to fewer topics"
    if closed.sent is not None and closed.rcvd is None:
        return f"it broke the protocol or did not answer ({closed.sent.code} {closed.sent.reason})".rstrip()
    if closed.rcvd is not None:
        return f"the server closed it ({closed.rcvd.code} {closed.rcvd.reason:.100})".replace(" )", ")")
    return "it broke off"


def _connecting_error(address: str, error: Exception) -> Exception:
    match error:
        case RemoteError():
            return error
        case InvalidURI() | ValueError():
            return UsageError(f"{address} is not the address of a server; write it as ws://robot:8765")
        case InvalidStatus():
            return RemoteError(
                f"{address}: the server refuses the connection (HTTP {error.response.status_code}); it speaks"
                f" neither {' nor '.join(SUBPROTOCOLS)}"
            )
        case TimeoutError():
            reason = f"no answer within {_OPEN_S:.0f} s"
        case OSError():
            reason = system_reason(error)
        case _:
            reason = f"it does not answer as a WebSocket server ({error!s:.100})"
    return RemoteError(
        f"{address}: {reason}; start foxglove_bridge or the server there first, and check host and port"
    )
