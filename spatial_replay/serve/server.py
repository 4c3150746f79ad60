"""The WebSocket server. Only this module uses the Foxglove SDK."""

from __future__ import annotations

import ipaddress
import json
import logging
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from reprlib import repr as shortened
from threading import Thread
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import foxglove
from foxglove import Parameter, Service, ServiceRequest
from foxglove import websocket as protocol
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from spatial_replay.annotate.automaton_state import automata_attachments
from spatial_replay.annotate.robustness import CURVES_CHANNEL
from spatial_replay.errors import SpatialReplayError, UsageError, system_reason
from spatial_replay.logs.messages import Channel, Messages, Schema
from spatial_replay.logs.topics import EVENT_LOG, EVENTS, LAYOUT
from spatial_replay.replay.document import document_from_replay, explain_results
from spatial_replay.replay.loaded_log import EditedFiles, Evaluated, Playback, constant_values
from spatial_replay.serve.player import (
    ARROW,
    CONSTANTS,
    FASTEST,
    PLAYBACK,
    SLOWEST,
    SPECIFICATION,
    Note,
    PlaybackState,
    Player,
    Questions,
    Session,
    Status,
    Values,
)
from spatial_replay.serve.relay import Gate, Relay
from spatial_replay.spec.format import format_duration
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import duration_ns_from_text

_MOST_BYTES: Final = 1 << 16


class _ServiceDefinition(NamedTuple):
    """A service of a session.

    Attributes:
        request, response: JSON schemas.
        answer: function that computes the response to a request.
    """

    request: Mapping[str, Any]
    response: Mapping[str, Any]
    answer: Callable[[LiveServer, Mapping[str, Any]], Mapping[str, Any]]


def _request(name: str, payload: bytes, schema: Mapping[str, Any]) -> Mapping[str, Any]:
    if len(payload) > _MOST_BYTES:
        raise UsageError(f"a request of {len(payload)} bytes; {name} takes at most {_MOST_BYTES}")
    try:
        request = json.loads(payload or b"{}")
    except (ValueError, RecursionError):
        raise UsageError(f"the request is not JSON; {name} takes an object, such as {{}}") from None
    fault = best_match(Draft202012Validator(schema).iter_errors(request))
    if fault is not None:
        place = "/".join(map(str, fault.absolute_path))
        raise UsageError(f"the request{f' at {place}' if place else ''}: {fault.message}")
    request_object: Mapping[str, Any] = request
    return request_object


def _evaluate(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replay with other constants; viewers still see the present evaluation."""
    changed_values = _constants_in(request, evaluated)
    if changed_values:
        evaluated = evaluated.loaded.evaluate({**evaluated.edited.given, **changed_values})
    results = tuple(replace(result, has_series=False) for result in evaluated.replayed.results)
    document = document_from_replay(replace(evaluated.replayed, results=results))
    return {**document, "constants": _constants_of(evaluated)}


def _explain(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    explanations = explain_results(evaluated.replayed, node=request.get("node"), object=request.get("object"))
    documents = [explanation.document for explanation in explanations]
    return {"explanations": documents, "constants": _constants_of(evaluated)}


def _write_constants(evaluated: Evaluated, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """Write constants from viewers and from the request into the specification files."""
    new_values = {**evaluated.edited.given, **_constants_in(request, evaluated)}
    written_values = evaluated.loaded.write_constants(new_values)
    return {
        "written": _in_seconds(written_values),
        "constants": _constants_of(evaluated) | _in_seconds(new_values),
    }


def _constants_in(request: Mapping[str, Any], evaluated: Evaluated) -> Values:
    return _stored_values(request.get("constants", {}), constant_values(evaluated.edited.constants))


def _constants_of(evaluated: Evaluated) -> dict[str, float]:
    return _in_seconds(constant_values(evaluated.edited.constants))


def _object(title: str, **properties: Mapping[str, Any]) -> Mapping[str, Any]:
    # some viewers fail at an object that does not list its properties
    return {"title": title, "type": "object", "properties": properties, "additionalProperties": False}


_CONSTANTS = {
    "description": "Numbers by name of the constant, durations in seconds. Other constants stay unchanged.",
    "type": "object",
    "properties": {},
    "additionalProperties": {"type": ["number", "string"]},
}

_TIME, _PLAY, _SPEED, _ = PLAYBACK
_SECONDS = {"description": "Seconds after the zero of the log.", "type": "number", "minimum": 0}
_TIMES = {
    "description": "Seconds of the log per second.",
    "type": "number",
    "minimum": SLOWEST,
    "maximum": FASTEST,
}
_PLAYBACK_STATE: Final[Mapping[str, Any]] = _object(
    "spatial_replay.PlaybackState",
    time=_SECONDS,
    play={"type": "boolean"},
    speed=_TIMES,
    loop={"type": "boolean"},
)

_SERVICES: Final[Mapping[str, _ServiceDefinition]] = MappingProxyType(
    {
        "evaluate": _ServiceDefinition(
            _object("spatial_replay.EvaluateRequest", constants=_CONSTANTS),
            {"title": "spatial_replay.EvaluateResponse", "type": "object", "properties": {}},
            lambda server, request: server.ask(_evaluate, request),
        ),
        "explain": _ServiceDefinition(
            _object(
                "spatial_replay.ExplainRequest",
                node={"description": "Name of a spec, a result or a part of one.", "type": "string"},
                object={"description": "Object of a template's instance.", "type": "string"},
            ),
            {
                "title": "spatial_replay.ExplainResponse",
                "type": "object",
                "properties": {
                    "explanations": {"type": "array", "items": {"type": "object", "properties": {}}}
                },
            },
            lambda server, request: server.ask(_explain, request),
        ),
        "write_constants": _ServiceDefinition(
            _object("spatial_replay.WriteConstantsRequest", constants=_CONSTANTS),
            {
                "title": "spatial_replay.WriteConstantsResponse",
                "type": "object",
                "properties": {"written": _CONSTANTS},
            },
            lambda server, request: server.ask(_write_constants, request),
        ),
        # for viewers without controls of their own
        "play": _ServiceDefinition(
            _object("spatial_replay.PlayRequest"),
            _PLAYBACK_STATE,
            lambda server, _: server.steer(_PLAY, True),
        ),
        "pause": _ServiceDefinition(
            _object("spatial_replay.PauseRequest"),
            _PLAYBACK_STATE,
            lambda server, _: server.steer(_PLAY, False),
        ),
        "seek": _ServiceDefinition(
            {**_object("spatial_replay.SeekRequest", time=_SECONDS), "required": ["time"]},
            _PLAYBACK_STATE,
            lambda server, request: server.steer(_TIME, request["time"]),
        ),
        "speed": _ServiceDefinition(
            {**_object("spatial_replay.SpeedRequest", speed=_TIMES), "required": ["speed"]},
            _PLAYBACK_STATE,
            lambda server, request: server.steer(_SPEED, request["speed"]),
        ),
    }
)

_PREFIX = "spatial-replay://"


def asset(evaluated: Evaluated, uri: str) -> bytes | None:
    """Return a file: the layout, a specification with its present constants, or an automaton for Graphviz.

    Returns:
        None if there is no such file.
    """
    asset_kind, _, asset_name = uri.removeprefix(_PREFIX).partition("/")
    if not uri.startswith(_PREFIX):
        return None
    if (asset_kind, asset_name) == (LAYOUT, ""):
        return evaluated.layout.data
    if asset_kind == "specification":
        return {file.filename: file.source.encode() for file in evaluated.edited.files}.get(asset_name)
    if asset_kind == "automaton" and asset_name.endswith(".dot"):
        automata = automata_attachments(evaluated.evaluation.automata, "")
        return {automaton.name.rpartition("/")[2]: automaton.data for automaton in automata}.get(asset_name)
    return None


# viewers get their errors in replies; the SDK would print them on standard error, too
logging.getLogger("foxglove").addHandler(logging.NullHandler())

_LONGEST_TEXT: Final = 64
"""Limit of a parameter's text and of a trigger's reason, characters."""
_LONGEST_NOTE: Final = 2_000
"""Limit of a note, characters."""

_REJECTED: Final = "rejected"
"""Name of the parameter with the last rejected value and the reason; "" after an accepted value."""

_HEXADECIMAL: Final = re.compile(r"-?0x[01]\.[0-9a-f]+p[+-][0-9]+")

_MOST_S: Final = 9e9
"""Limit of a duration, seconds; int64 nanoseconds reach 9.2e9 s."""

_STOP_S: Final = 1.0
"""Timeout of the SDK's `stop`, which waits for every viewer, seconds."""

_STATUS: Final = MappingProxyType(
    {
        Status.PLAYING: protocol.PlaybackStatus.Playing,
        Status.PAUSED: protocol.PlaybackStatus.Paused,
        Status.ENDED: protocol.PlaybackStatus.Ended,
    }
)
_CAPABILITIES: Final = (
    protocol.Capability.Parameters,
    protocol.Capability.PlaybackControl,
    protocol.Capability.Services,
    protocol.Capability.Time,
)


class PublishingServer:
    """A WebSocket server that sends new messages to viewers.

    No method waits for a viewer or fails because of a viewer. A slow viewer loses the oldest messages. A
    viewer that reads nothing is disconnected.
    """

    def __init__(
        self, name: str, channels: Sequence[Channel], host: str, port: int, origins: Sequence[str] = ()
    ) -> None:
        """Listen.

        Args:
            channels: channels that are known at the start; other channels are added with their first message.
            port: TCP port; 0 for any free port.
            origins: origins of pages that may connect, in addition to `VIEWERS` and pages of this machine.

        Raises:
            UsageError: the address cannot be used, or an origin is malformed.
        """
        self._gate = Gate.of(host, origins)
        self._context = foxglove.Context()
        self._channel_by_key: dict[tuple[str, str, Schema | None], foxglove.Channel] = {}
        self._channels: dict[Channel, foxglove.Channel] = {}
        for channel in channels:
            self._advertise(channel)
        self._host = f"[{host}]" if _is_v6(host) else host
        self._sdk_server: Future[protocol.WebSocketServer] = Future()
        self._sdk_host = _inner_host()
        sdk_server = foxglove.start_server(
            name=name,
            host=self._sdk_host,
            port=0,
            supported_encodings=["json"],
            context=self._context,
            **self._options(),
        )
        self._sdk_server.set_result(sdk_server)
        try:
            self._relay = Relay(host, port, (self._sdk_host, self._server.port), self._gate)
        except (OSError, UnicodeError) as error:
            self._server.stop()
            reason = "no such name" if isinstance(error, UnicodeError) else system_reason(error)
            raise UsageError(
                f"cannot listen at {host}, port {port}: {reason}; choose another with --port, 0 for any"
                if _is_own(host)
                else f"cannot listen at {host or 'no address'}: {reason}; choose an address of this machine "
                "with --host, 127.0.0.1 for programs on it alone, 0.0.0.0 for all of its addresses"
            ) from None

    @property
    def address(self) -> str:
        """The address that viewers connect to, with its token if other machines can reach the server."""
        token = "" if self._gate.token is None else f"/?token={self._gate.token}"
        return f"ws://{self._host}:{self._relay.port}{token}"

    def stop(self) -> None:
        """Disconnect all viewers, and wait at most `_STOP_S` for their responses."""
        stop_thread = Thread(target=self._server.stop, daemon=True)
        stop_thread.start()
        stop_thread.join(_STOP_S)
        self._relay.stop()
        for channel in self._channels.values():
            channel.close()

    def wants(self, topic: str) -> bool:
        """Return whether a viewer has subscribed to a topic."""
        return any(
            sdk_channel.has_sinks()
            for channel, sdk_channel in self._channels.items()
            if channel.topic == topic
        )

    def publish(self, messages: Messages) -> None:
        """Send messages to the viewers that have subscribed to their topics."""
        sdk_channels = {
            number: sdk_channel
            for number, channel in messages.channels.items()
            if (sdk_channel := self._channels.get(channel)) is not None and sdk_channel.has_sinks()
        }
        channel_numbers, times_ns = messages.channel.tolist(), messages.log_time_ns.tolist()
        for number, time_ns, payload in zip(channel_numbers, times_ns, messages.payloads, strict=True):
            if number in sdk_channels:
                sdk_channels[number].log(payload, log_time=time_ns)

    def send_time(self, time_ns: int) -> None:
        """Send the present time of the log."""
        self._server.broadcast_time(time_ns)

    def send_note(self, note: Note) -> None:
        """Send a note, shortened to `_LONGEST_NOTE`."""
        self._server.publish_status(note.text[:_LONGEST_NOTE], foxglove.StatusLevel.Error, note.about)

    def remove_note(self, about: str) -> None:
        """Remove the note about a subject."""
        self._server.remove_status([about])

    @property
    def _server(self) -> protocol.WebSocketServer:
        """The SDK's server; waits for `start_server`, because a viewer may send a request earlier."""
        return self._sdk_server.result()

    def _options(self) -> dict[str, Any]:
        """Return the keyword arguments of `foxglove.start_server` that differ between servers."""
        raise NotImplementedError

    def _advertise(self, channel: Channel) -> None:
        """Offer a channel if viewers can decode it: with a schema, or in JSON."""
        if channel.schema is None and channel.encoding != "json":
            return
        # for viewers, channels that differ only in their publisher are one channel
        viewer_key = channel.topic, channel.encoding, channel.schema
        if viewer_key not in self._channel_by_key:
            self._channel_by_key[viewer_key] = self._channel(channel)
        self._channels[channel] = self._channel_by_key[viewer_key]

    def _channel(self, channel: Channel) -> foxglove.Channel:
        schema = channel.schema
        sdk_schema = None
        if schema is not None:
            sdk_schema = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
        return foxglove.Channel(
            channel.topic, schema=sdk_schema, message_encoding=channel.encoding, context=self._context
        )


class LiveServer(PublishingServer, protocol.ServerListener):
    """The server of a session. Viewers' requests arrive on threads of the SDK."""

    def __init__(
        self,
        session: Session,
        questions: Questions,
        channels: Sequence[Channel],
        host: str,
        port: int,
        origins: Sequence[str] = (),
    ) -> None:
        """Listen.

        Args:
            questions: queue of requests to the services.
            channels: all channels that may have messages.
            port: TCP port; 0 for any free port.

        Raises:
            UsageError: the address cannot be used, or an origin is malformed.
        """
        self._session, self._questions = session, questions
        self._rejection = ""
        super().__init__(f"spatial-replay: {session.name}", channels, host, port, origins)

    def send_note(self, note: Note) -> None:
        """Send a note. Some viewers keep notes, so a rejected value is sent as the parameter `rejected`."""
        if note.about not in (CONSTANTS, ARROW):
            super().send_note(note)
        elif note.text != self._rejection:
            self._rejection = note.text[:_LONGEST_NOTE]
            self.send_playback()

    def remove_note(self, about: str) -> None:
        """Remove the note about a subject."""
        if about not in (CONSTANTS, ARROW):
            super().remove_note(about)
        elif self._rejection:
            self._rejection = ""
            self.send_playback()

    def send_state(self, state: PlaybackState) -> None:
        """Send the playback's state to all viewers; handlers of requests return it to a single viewer."""
        self._server.broadcast_playback_state(_playback_state(state, None))

    def send_values(self, values: Values) -> None:
        """Send the constants to all viewers; handlers of requests return them to a single viewer."""
        self._server.publish_parameter_values(_constants(values))

    def send_playback(self) -> None:
        """Send the playback's parameters to all viewers; handlers of requests return them to one viewer."""
        self._server.publish_parameter_values(_parameters(self.steering))

    @property
    def steering(self) -> Mapping[str, float | str | bool]:
        """All parameters except constants."""
        return {**self._session.playback, ARROW: self._session.arrow, _REJECTED: self._rejection}

    def ask(
        self,
        compute: Callable[[Evaluated, Mapping[str, Any]], Mapping[str, Any]],
        request: Mapping[str, Any],
    ) -> Mapping[str, Any]:
        """Compute a response from the present evaluation, after the earlier questions of all viewers."""
        return self._questions.ask(lambda evaluated: compute(evaluated, request))

    def steer(self, name: str, value: float | bool) -> Mapping[str, float | bool]:
        """Set a parameter of the playback; return its state."""
        self.send_state(self._session.steer({name: value}))
        self.send_playback()
        return {key.partition(".")[2]: value for key, value in self._session.playback.items()}

    def _options(self) -> dict[str, Any]:
        return {
            "capabilities": list(_CAPABILITIES),
            "server_listener": self,
            "services": [self._service(name, *served) for name, served in _SERVICES.items()],
            "asset_handler": lambda uri: asset(self._session.wait_for_evaluation(), uri),
            "playback_time_range": self._session.span_ns,
        }

    def _service(
        self,
        name: str,
        request: Mapping[str, Any],
        response: Mapping[str, Any],
        answer: Callable[[LiveServer, Mapping[str, Any]], Mapping[str, Any]],
    ) -> Service:
        def handle(call: ServiceRequest) -> bytes:
            response_object = answer(self, _request(name, call.payload, request))
            return json.dumps(response_object, ensure_ascii=False, allow_nan=False).encode()

        return _json_service(name, request, response, handle)

    def on_subscribe(self, client: protocol.Client, channel: protocol.ChannelView) -> None:
        self._session.resend(channel.topic)

    def on_get_parameters(
        self, client: protocol.Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        parameters = [*_parameters(self.steering), *_constants(self._session.values)]
        return (
            [parameter for parameter in parameters if parameter.name in param_names]
            if param_names
            else parameters
        )

    def on_set_parameters(
        self, client: protocol.Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        self.remove_note(CONSTANTS)
        self.remove_note(ARROW)
        try:
            values = {
                parameter.name: _value(parameter) for parameter in parameters if parameter.name != _REJECTED
            }
            playback_values = {name: value for name, value in values.items() if name in PLAYBACK}
            constants = {
                name: value for name, value in values.items() if name not in PLAYBACK and name != ARROW
            }
            if ARROW in values:
                self._session.point_at(values[ARROW])
            if constants:
                self._session.set_constants(_stored_values(constants, self._session.values))
            if playback_values:
                self.send_state(self._session.steer(playback_values))
        except SpatialReplayError as error:
            self.send_note(Note(CONSTANTS, str(error)))
        return self.on_get_parameters(client, [])

    def on_playback_control_request(
        self, playback_control_request: protocol.PlaybackControlRequest
    ) -> protocol.PlaybackState:
        request = playback_control_request
        state = self._session.control(
            is_playing=request.playback_command == protocol.PlaybackCommand.Play,
            speed=request.playback_speed,
            seek_ns=request.seek_time,
        )
        return _playback_state(state, request.request_id)


class RunServer(PublishingServer, protocol.ServerListener):
    """A server of a live run. Late viewers get each topic's last message, and a service fires triggers."""

    def __init__(
        self,
        channels: Sequence[Channel],
        host: str,
        port: int,
        fire: Callable[[str], None] | None,
        origins: Sequence[str] = (),
    ) -> None:
        """Listen; see `PublishingServer`.

        Args:
            fire: function that the service `trigger` calls with a reason; None for no service.
        """
        self._fire = fire
        self._latest: dict[int, tuple[foxglove.Channel, int, list[bytes]]] = {}
        self._time_ns = 0
        super().__init__("spatial-replay: live", channels, host, port, origins)

    def publish(self, messages: Messages) -> None:
        """Send messages, after offering their new channels."""
        for channel in messages.channels.values():
            if channel not in self._channels:
                self._advertise(channel)
        super().publish(messages)
        for channel, message_indices in messages.by_channel():
            if channel in self._channels and _is_state(channel):
                time_ns = int(messages.log_time_ns[message_indices[-1]])
                newest_indices = message_indices[messages.log_time_ns[message_indices] == time_ns].tolist()
                sdk_channel = self._channels[channel]
                self._latest[sdk_channel.id()] = (
                    sdk_channel,
                    time_ns,
                    [messages.payloads[index] for index in newest_indices],
                )

    def send_time(self, time_ns: int) -> None:
        """Send the time of the newest sample."""
        self._time_ns = time_ns
        super().send_time(time_ns)

    def on_subscribe(self, client: protocol.Client, channel: protocol.ChannelView) -> None:
        """Send the last messages of a channel again, at the newest sample's time, if there is a sample."""
        latest = None
        # `publish` may store newer messages on another thread while these are sent
        while latest is not self._latest.get(channel.id):
            latest = self._latest[channel.id]
            sdk_channel, time_ns, payloads = latest
            newest_ns = self._time_ns or time_ns
            for payload in payloads:
                sdk_channel.log(payload, log_time=newest_ns)
            super().send_time(newest_ns)

    def _options(self) -> dict[str, Any]:
        services = [] if self._fire is None else [_trigger_service(self._fire)]
        capabilities = [protocol.Capability.Time, *([protocol.Capability.Services] if services else [])]
        return {"capabilities": capabilities, "services": services, "server_listener": self}


def _is_state(channel: Channel) -> bool:
    """Return whether a channel's last message is its whole state, unlike an event or a frame of a video."""
    schema = "" if channel.schema is None else channel.schema.name
    return channel.topic not in (EVENTS, EVENT_LOG) and not schema.endswith("Video")


def _trigger_service(fire: Callable[[str], None]) -> Service:
    def handle(request: ServiceRequest) -> bytes:
        try:
            arguments = json.loads(request.payload or b"{}")
        except (ValueError, RecursionError):
            arguments = {}
        reason = arguments.get("reason") if isinstance(arguments, dict) else None
        fire(reason[:_LONGEST_TEXT] if isinstance(reason, str) and reason else "service call")
        return b'{"fired": true}'

    request = {"title": "TriggerRequest", "type": "object", "properties": {"reason": {"type": "string"}}}
    response = {"title": "TriggerResponse", "type": "object", "properties": {"fired": {"type": "boolean"}}}
    return _json_service("trigger", request, response, handle)


def _json_service(
    name: str,
    request: Mapping[str, Any],
    response: Mapping[str, Any],
    handle: Callable[[ServiceRequest], bytes],
) -> Service:
    request_schema, response_schema = (
        foxglove.MessageSchema(
            encoding="json",
            schema=foxglove.Schema(
                name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode()
            ),
        )
        for schema in (request, response)
    )

    def respond(call: ServiceRequest) -> bytes:
        try:
            return handle(call)
        except SpatialReplayError as error:
            raise _FailureError(str(error)) from None

    return Service(
        name,
        schema=foxglove.ServiceSchema(name, request=request_schema, response=response_schema),
        handler=respond,
    )


class _FailureError(Exception):
    """The failure of a service. The SDK writes the qualified name of the class before the reason."""

    __qualname__ = "failed"


def _playback_state(state: PlaybackState, request: str | None) -> protocol.PlaybackState:
    return protocol.PlaybackState(_STATUS[state.status], state.time_ns, state.speed, state.did_seek, request)


def _parameters(values: Mapping[str, float | str | bool]) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in values.items()]


def _constants(values: Values) -> list[Parameter]:
    return _parameters(_in_seconds(values))


def _in_seconds(values: Values) -> dict[str, float]:
    """Return constants with durations as numbers of seconds, because viewers type no quotes."""
    return {
        name: duration_ns_from_text(value) / 1e9 if isinstance(value, str) else value
        for name, value in values.items()
    }


def _value(parameter: Parameter) -> float | str | bool:
    """Return the value that a viewer sets.

    Raises:
        UsageError: the value is not a number, a short text, true or false.
    """
    value = parameter.get_value()
    if isinstance(value, str) and _HEXADECIMAL.fullmatch(value):
        # the relay sends numbers in hexadecimal, see `with_exact_numbers`
        return float.fromhex(value)
    if isinstance(value, bool) or (isinstance(value, str) and len(value) <= _LONGEST_TEXT):
        return value
    if isinstance(value, (int, float)):
        return float(value)
    raise _misfit(parameter.name, value)


def _stored_values(values: Mapping[str, float | str | bool], present: Values) -> Values:
    """Return values of constants as in a specification, with durations as texts instead of seconds.

    Raises:
        UsageError: a value is true or false.
    """
    values_by_name: dict[str, float | str] = {}
    for name, value in values.items():
        if isinstance(value, bool):
            raise _misfit(name, value)
        is_seconds = (
            isinstance(present.get(name), str) and not isinstance(value, str) and 0 <= value < _MOST_S
        )
        values_by_name[name] = format_duration(round(float(value) * 1e9)) if is_seconds else value
    return values_by_name


def _misfit(name: str, value: object) -> UsageError:
    remedy = "give a number, for a duration in seconds"
    return UsageError(f"{shortened(name)} cannot be {shortened(value)}: {remedy}")


def _inner_host() -> str:
    """Return a random loopback address for the SDK, so that no web page finds its port by trying."""
    address = f"127.{'.'.join(str(1 + secrets.randbelow(254)) for _ in range(3))}"
    # some systems, such as macOS, have only one loopback address
    return address if _is_own(address) else "127.0.0.1"


def _is_v6(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).version == 6
    except ValueError:
        return False


def _is_own(host: str) -> bool:
    """Return whether an address belongs to this machine, by binding a socket to it."""
    try:
        family, socket_type, number, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket_type, number) as probe:
            probe.bind(address)
    except (OSError, UnicodeError):
        return False
    return True


LOOPBACK = "127.0.0.1"
PORT = 8765
"""Default port of viewers and servers."""

_LAST_S = 0.25
"""Timeout of a running evaluation when the server stops, seconds."""


@dataclass(frozen=True)
class Serving:
    """A running server.

    Attributes:
        address: address that viewers connect to, such as ws://127.0.0.1:8765.
    """

    address: str
    _loop: Future[None]
    _session: Session
    _server: LiveServer

    def wait(self) -> None:
        """Wait for the error that ends the server, and raise it."""
        self._loop.result()

    def check(self) -> None:
        """Raise the error that ended the server, if it ended."""
        if self._loop.done():
            self._loop.result()

    @property
    def edited(self) -> EditedFiles:
        """The specifications with the constants as viewers set them."""
        return self._session.edited

    def show_specifications(self, files: Sequence[Specification]) -> Evaluated:
        """Evaluate saved specifications, show the evaluation to viewers, and return it.

        A constant that a viewer changed keeps the viewer's value, unless its file changed, too. After an
        error, viewers keep the former evaluation and see the error.

        Raises:
            SpatialReplayError: the specifications cannot be evaluated over this log.
        """
        try:
            loaded = self.edited.loaded.with_files(files)
            self._session.replace_log(loaded)
            evaluated = self._session.wait_for_evaluation()
            if evaluated.loaded is not loaded and self._session.failure is not None:
                raise self._session.failure
        except SpatialReplayError as error:
            self.show_error(error)
            raise
        self._server.remove_note(SPECIFICATION)
        return evaluated

    def show_error(self, error: SpatialReplayError) -> None:
        """Show viewers the error of a saved specification."""
        self._server.send_note(Note(SPECIFICATION, str(error)))


@contextmanager
def open_server(
    evaluated: Evaluated,
    *,
    host: str = LOOPBACK,
    port: int = PORT,
    play: bool = False,
    origins: Sequence[str] = (),
) -> Iterator[Serving]:
    """Serve a log to viewers. Viewers play the log and change the constants of its specifications.

    Args:
        evaluated: the evaluation to show first, with the constants of the files.
        host: address to listen at. Viewers on other machines need the token in the printed address.
        port: TCP port; 0 for any free port.
        play: whether to play at once; otherwise a viewer starts the playback.
        origins: origins of web pages that may connect, in addition to Foxglove and pages of this machine.

    Raises:
        UsageError: the address cannot be used, or an origin is malformed.
        LogError: the log cannot be read.
    """
    playback = Playback(evaluated)
    playback.seek(playback.start_ns)
    session = Session(evaluated.loaded, playback.start_ns, playback.end_ns)
    questions = Questions(session.wait_for_evaluation)
    server = LiveServer(session, questions, (*playback.channels, CURVES_CHANNEL), host, port, origins)
    player_future = _in_background(Player(playback, session, server).run, "player")
    questions_future = _in_background(questions.run, "questions")
    try:
        if play:
            session.control(is_playing=True, speed=1.0)
        yield Serving(server.address, player_future, session, server)
    finally:
        session.stop()
        questions.stop()
        wait([player_future, questions_future], _LAST_S)
        server.stop()


def _in_background(work: Callable[[], None], name: str) -> Future[None]:
    """Do work on a daemon thread, so that the end of the process does not wait for it."""
    future: Future[None] = Future()

    def run() -> None:
        try:
            work()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(None)

    Thread(target=run, name=name, daemon=True).start()
    return future
