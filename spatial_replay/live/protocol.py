"""Decode frames of Foxglove's WebSocket protocol, which are bytes or texts."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterable
from typing import Any, Final, NamedTuple, TypeAlias

from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.trace.trace import LATEST_NS

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Subprotocols in order of preference: of the Foxglove SDK, and of early versions of foxglove_bridge."""

_SCHEMA_ENCODINGS: Final = {
    "json": "jsonschema",
    "protobuf": "protobuf",
    "flatbuffer": "flatbuffer",
    "ros1": "ros1msg",
    "cdr": "ros2msg",
}
"""Encodings of schemas by the encoding of messages, for servers that name no schema encoding."""

_BINARY_SCHEMAS: Final = frozenset({"protobuf", "flatbuffer"})
# a binary frame with a message: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
_MESSAGE: Final = 1
_HEAD: Final = struct.Struct("<IQ")
_LONGEST_TEXT: Final = 200


class Connected(NamedTuple):
    """The connection is open; channels are advertised next."""

    server: str


class Warned(NamedTuple):
    """A warning of the server, or a warning about a frame that breaks the protocol."""

    text: str


class Advertised(NamedTuple):
    """Channels that a server offers, by their numbers in this connection."""

    channels: dict[int, Channel]


class Unadvertised(NamedTuple):
    """Numbers of channels that a server no longer offers."""

    numbers: tuple[int, ...]


class MessageData(NamedTuple):
    """A message of a subscription."""

    subscription: int
    time_ns: int
    payload: bytes


Frame: TypeAlias = Connected | Advertised | Unadvertised | Warned | MessageData


def decode_frame(raw: str | bytes) -> Frame | None:
    """Decode a frame of a server; None for a frame that a monitor does not need.

    Raises:
        LogError: the frame breaks the protocol.
    """
    if isinstance(raw, str):
        return _decode_text(raw)
    if not raw:
        raise LogError("a binary frame is empty")
    if raw[0] != _MESSAGE:
        return None
    if len(raw) < 1 + _HEAD.size:
        raise LogError(f"a message has {len(raw)} bytes; its head alone has {1 + _HEAD.size}")
    subscription, time_ns = _HEAD.unpack_from(raw, 1)
    if time_ns > LATEST_NS:
        raise LogError(f"a message has the time {time_ns} ns; times of a log end at 2**63 - 1")
    return MessageData(subscription, time_ns, raw[1 + _HEAD.size :])


def subscribe(numbers: Iterable[int]) -> str:
    """Return the request to subscribe to channels; a subscription gets the number of its channel."""
    subscriptions = [{"id": number, "channelId": number} for number in numbers]
    return json.dumps({"op": "subscribe", "subscriptions": subscriptions})


def _decode_text(raw: str) -> Frame | None:
    try:
        frame: Any = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise LogError(f"a text frame is not JSON: {error!s:.100}") from None
    try:
        match frame:
            case {"op": "serverInfo"}:
                return Connected(str(frame.get("name", ""))[:_LONGEST_TEXT])
            case {"op": "advertise", "channels": channels}:
                return Advertised({_number(offer["id"]): _channel(offer) for offer in channels})
            case {"op": "unadvertise", "channelIds": numbers}:
                return Unadvertised(tuple(map(_number, numbers)))
            case {"op": "status", "message": text}:
                # level 0 is information, such as about a subscription
                return Warned(str(text)[:_LONGEST_TEXT]) if int(frame.get("level", 0)) > 0 else None
            case {"op": _}:
                return None
        raise ValueError("it has no `op`")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise LogError(f"a text frame breaks the protocol: {reason:.200}") from None


def _number(value: object) -> int:
    # in Python, true is an integer
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**32:
        raise ValueError(f"{value!r:.40} is not the number of a channel")
    return value


def _channel(offer: Any) -> Channel:
    topic, encoding = offer["topic"], offer["encoding"]
    schema_name, schema_text = offer.get("schemaName") or "", offer.get("schema") or ""
    for value in (topic, encoding, schema_name, schema_text):
        if not isinstance(value, str):
            raise ValueError(f"{value!r:.40} in a channel is not a text")
    schema_encoding = offer.get("schemaEncoding") or _SCHEMA_ENCODINGS.get(encoding, "")
    if not schema_name and not schema_text:
        return Channel(topic, encoding, None)
    # JSON can spell lone surrogates, which are not UTF-8
    schema_data = schema_text.encode("utf-8", "replace")
    if schema_encoding in _BINARY_SCHEMAS:
        try:
            schema_data = base64.b64decode(schema_text, validate=True)
        except binascii.Error as error:
            raise ValueError(f"the schema of {topic!r:.100} is not Base64: {error}") from None
    return Channel(topic, encoding, Schema(schema_name, str(schema_encoding), schema_data))
