"""The connection to viewers: the only module that knows the library behind it."""

from __future__ import annotations

import ipaddress
import json
import logging
import socket
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from reprlib import repr as shortened
from threading import Thread
from types import MappingProxyType
from typing import Final

import foxglove
from foxglove import Parameter, Service, ServiceRequest
from foxglove import websocket as protocol

from spatial_replay.errors import SpatialReplayError, UsageError
from spatial_replay.logs.messages import Channel, Messages, Schema
from spatial_replay.serve.player import CONSTANTS, Level, Note
from spatial_replay.serve.services import SERVICES, Questions, answer, asset
from spatial_replay.serve.session import Session, State, Status

# what viewers send wrongly is told to them; nobody else has to read it
logging.getLogger("foxglove").addHandler(logging.NullHandler())

_LONGEST_TEXT: Final = 64
_LONGEST_NOTE: Final = 2_000
"""Characters of a duration, and of a note."""

_FAREWELL_S: Final = 1.0
"""How long the library, which waits for every viewer, may take to stop."""

_STATUS: Final = MappingProxyType(
    {
        Status.PLAYING: protocol.PlaybackStatus.Playing,
        Status.PAUSED: protocol.PlaybackStatus.Paused,
        Status.ENDED: protocol.PlaybackStatus.Ended,
    }
)
_LEVELS: Final = MappingProxyType(
    {
        Level.INFO: foxglove.StatusLevel.Info,
        Level.WARNING: foxglove.StatusLevel.Warning,
        Level.ERROR: foxglove.StatusLevel.Error,
    }
)
_CAPABILITIES: Final = (
    protocol.Capability.Parameters,
    protocol.Capability.PlaybackControl,
    protocol.Capability.Services,
    protocol.Capability.Time,
)


class LiveServer:
    """A session that viewers connect to over WebSocket; an `Outlet`.

    A viewer that does not take what it is sent loses the oldest of it, and is let go when it takes nothing.
    """

    def __init__(
        self, session: Session, questions: Questions, channels: Sequence[Channel], host: str, port: int
    ) -> None:
        """Listen.

        Args:
            questions: answers those of viewers.
            channels: all that there can be messages of.
            port: 0 for any that is free.

        Raises:
            UsageError: nothing can listen there.
        """
        self._session, self._questions = session, questions
        self._context = foxglove.Context()
        self._channels = self._sent(channels)
        self._host = f"[{host}]" if _is_v6(host) else host
        self._started: Future[protocol.WebSocketServer] = Future()
        try:
            self._started.set_result(self._start(port))
        except RuntimeError as error:
            reason = str(error).rpartition("bind port: ")[2].partition(" (os error")[0]
            raise UsageError(
                f"cannot listen at {host}, port {port}: {reason}; choose another with --port, 0 for any"
                if _is_own(host)
                else f"cannot listen at {host or 'no address'}: {reason}; choose an address of this machine "
                "with --host, 127.0.0.1 for programs on it alone, 0.0.0.0 for all of its addresses"
            ) from None

    @property
    def address(self) -> str:
        """What to connect to."""
        return f"ws://{self._host}:{self._server.port}"

    def stop(self) -> None:
        """Let all viewers go; one that takes nothing is not waited for longer than a moment."""
        stopping = Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(_FAREWELL_S)
        for channel in self._channels.values():
            channel.close()

    def wants(self, topic: str) -> bool:
        """See `Outlet.wants`."""
        return any(sent.has_sinks() for channel, sent in self._channels.items() if channel.topic == topic)

    def publish(self, messages: Messages) -> None:
        """See `Outlet.publish`."""
        wanted = {
            number: sent
            for number, channel in messages.channels.items()
            if (sent := self._channels.get(channel)) is not None and sent.has_sinks()
        }
        numbers, times_ns = messages.channel.tolist(), messages.log_time_ns.tolist()
        for number, time_ns, payload in zip(numbers, times_ns, messages.payloads, strict=True):
            if number in wanted:
                wanted[number].log(payload, log_time=time_ns)

    def tell_state(self, state: State) -> None:
        """See `Outlet.tell_state`."""
        self._server.broadcast_playback_state(_playback_state(state, None))

    def tell_time(self, time_ns: int) -> None:
        """See `Outlet.tell_time`."""
        self._server.broadcast_time(time_ns)

    def tell_values(self, values: Mapping[str, float | str]) -> None:
        """See `Outlet.tell_values`."""
        self._server.publish_parameter_values(_parameters(values))

    def tell(self, note: Note) -> None:
        """See `Outlet.tell`."""
        self._server.publish_status(note.text[:_LONGEST_NOTE], _LEVELS[note.level], note.about)

    def withdraw(self, about: str) -> None:
        """Show the note about something no longer."""
        self._server.remove_status([about])

    @property
    def _server(self) -> protocol.WebSocketServer:
        """The server; a fast viewer asks for something before it is known here."""
        return self._started.result()

    def _start(self, port: int) -> protocol.WebSocketServer:
        return foxglove.start_server(
            name=f"spatial-replay: {self._session.name}",
            host=self._host,
            port=port,
            capabilities=list(_CAPABILITIES),
            server_listener=_Listener(self._session, self),
            services=[self._service(name) for name in SERVICES],
            asset_handler=lambda uri: self._session.ask(partial(asset, uri=uri)),
            context=self._context,
            playback_time_range=self._session.span_ns,
        )

    def _sent(self, channels: Sequence[Channel]) -> dict[Channel, foxglove.Channel]:
        """What is offered to viewers: what can be read without a schema of its own, or has one."""
        sent: dict[tuple[str, str, Schema | None], foxglove.Channel] = {}
        found: dict[Channel, foxglove.Channel] = {}
        for channel in channels:
            if channel.schema is not None or channel.encoding == "json":
                # channels that only differ in who publishes on them are one to a viewer
                alike = channel.topic, channel.encoding, channel.schema
                if alike not in sent:
                    sent[alike] = self._channel(channel)
                found[channel] = sent[alike]
        return found

    def _channel(self, channel: Channel) -> foxglove.Channel:
        schema = channel.schema
        described = None
        if schema is not None:
            described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
        return foxglove.Channel(
            channel.topic, schema=described, message_encoding=channel.encoding, context=self._context
        )

    def _service(self, name: str) -> Service:
        described = SERVICES[name]
        request, response = (
            foxglove.MessageSchema(
                encoding="json",
                schema=foxglove.Schema(
                    name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode()
                ),
            )
            for schema in (described.request, described.response)
        )

        def handle(asked: ServiceRequest) -> bytes:
            return self._questions.ask(lambda tuned: answer(name, tuned, asked.payload))

        return Service(
            name, schema=foxglove.ServiceSchema(name, request=request, response=response), handler=handle
        )


class _Listener(protocol.ServerListener):
    """Hands on what viewers ask for; called on threads of the library."""

    def __init__(self, session: Session, server: LiveServer) -> None:
        self._session = session
        self._server = server

    def on_subscribe(self, client: protocol.Client, channel: protocol.ChannelView) -> None:
        self._session.show_again(channel.topic)

    def on_get_parameters(
        self, client: protocol.Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        chosen = _parameters(self._session.values)
        return [each for each in chosen if each.name in param_names] if param_names else chosen

    def on_set_parameters(
        self, client: protocol.Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        self._server.withdraw(CONSTANTS)
        try:
            self._session.change({each.name: _value(each) for each in parameters})
        except SpatialReplayError as error:
            self._server.tell(Note(CONSTANTS, Level.ERROR, str(error)))
        return _parameters(self._session.values)

    def on_playback_control_request(
        self, playback_control_request: protocol.PlaybackControlRequest
    ) -> protocol.PlaybackState:
        asked = playback_control_request
        state = self._session.control(
            is_playing=asked.playback_command == protocol.PlaybackCommand.Play,
            speed=asked.playback_speed,
            seek_ns=asked.seek_time,
        )
        return _playback_state(state, asked.request_id)


def _playback_state(state: State, request: str | None) -> protocol.PlaybackState:
    return protocol.PlaybackState(_STATUS[state.status], state.time_ns, state.speed, state.did_seek, request)


def _parameters(values: Mapping[str, float | str]) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in values.items()]


def _value(parameter: Parameter) -> float | str:
    """What a constant is to be.

    Raises:
        UsageError: neither a number nor a short text.
    """
    value = parameter.get_value()
    if isinstance(value, str) and len(value) <= _LONGEST_TEXT:
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    remedy = "give a number or, for a duration, a text such as '2s'"
    raise UsageError(f"{shortened(parameter.name)} cannot be {shortened(value)}: {remedy}")


def _is_v6(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).version == 6
    except ValueError:
        return False


def _is_own(host: str) -> bool:
    """Whether something can listen at an address, at a port that is free."""
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as probe:
            probe.bind(address)
    except (OSError, UnicodeError):
        return False
    return True
