"""Access control of a server, and the relay through which all viewers connect."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import re
import secrets
from collections.abc import Coroutine, Iterable
from contextlib import suppress
from dataclasses import dataclass
from threading import Thread
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

from spatial_replay.errors import UsageError

VIEWERS: Final = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
"""Origins of viewers: Foxglove in a browser, and programs whose pages are local files."""

_TOKEN_BYTES: Final = 16


def is_loopback(host: str) -> bool:
    """Return whether a host is reachable only from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True, slots=True)
class Gate:
    """Access rules for requests.

    Attributes:
        origins: origins of pages that may connect, in addition to pages of this machine.
        token: token that each request must carry as `?token=…`; None if no token is needed.
    """

    origins: frozenset[str]
    token: str | None

    @classmethod
    def of(cls, host: str, origins: Iterable[str]) -> Gate:
        """Return the gate of a server, with a new token if other machines can reach the server.

        Raises:
            UsageError: an origin is malformed.
        """
        allowed = set(VIEWERS)
        for origin in origins:
            url = urlsplit(origin)
            if not url.scheme or not url.netloc or url.path.strip("/") or url.query:
                raise UsageError(
                    f"{origin!r} is not the origin of a page; give it as in https://viewer.example.org:8080"
                )
            allowed.add(origin.rstrip("/").lower())
        return cls(frozenset(allowed), None if is_loopback(host) else secrets.token_urlsafe(_TOKEN_BYTES))

    def refusal(self, head: bytes) -> str | None:
        """Return the HTTP status for a refused request; None for an accepted request."""
        request, *lines = head.decode("latin-1").split("\r\n")
        split_lines = (line.partition(":") for line in lines)
        fields = [(name.strip().lower(), value.strip()) for name, _, value in split_lines]
        words = request.split(" ")
        if len(words) != 3 or words[0] != "GET" or dict(fields).get("upgrade", "").lower() != "websocket":
            return "426 Upgrade Required"
        # browsers name the origin of a page, other programs name none: RFC 6454, section 7
        if not all(self._is_allowed(value) for name, value in fields if name == "origin"):
            return "403 Origin Not Allowed"
        if self.token is not None:
            token = parse_qs(urlsplit(words[1]).query).get("token", [""])[0]
            # the comparison takes constant time, so that response times do not reveal the token
            if not hmac.compare_digest(token.encode(), self.token.encode()):
                return "401 Token Missing Or Wrong"
        return None

    def _is_allowed(self, origin: str) -> bool:
        if origin.lower() in self.origins:
            return True
        try:
            url = urlsplit(origin)
            return url.scheme in ("http", "https") and is_loopback(url.hostname or "")
        except ValueError:
            return False


OLD_PROTOCOL: Final = "foxglove.websocket.v1"
PROTOCOL: Final = "foxglove.sdk.v1"

_OFFER: Final = re.compile(rb"^sec-websocket-protocol:[ \t]*(.*?)[ \t]*\r\n", re.IGNORECASE | re.MULTILINE)
_MOST_HEAD: Final = 1 << 16
_PIECE: Final = 1 << 16
_MOST_CONNECTIONS: Final = 64
_PATIENCE_S: Final = 10.0
"""Timeout of a viewer's request, and of each wait for a viewer that does not read, seconds."""

_MOST_TEXT: Final = 1 << 20
"""Limit of a text message that the relay decodes, bytes; longer messages pass unchanged."""

# bits and opcodes in the first byte of a frame: RFC 6455, section 5.2
_FINAL: Final = 0x80
_TEXT: Final = 1
_BINARY: Final = 2
_CONTROL_REQUEST: Final = 3
_EXACT_DIGITS: Final = 15
"""Digits up to which every integer is exact as a float."""
_PLAYBACK_STATE: Final = 5
"""First byte of the server's message with the state of the playback."""


class Relay:
    """Listens for viewers on a separate thread, and connects each viewer to the server."""

    def __init__(self, host: str, port: int, behind: tuple[str, int], gate: Gate) -> None:
        """Listen at an address.

        Args:
            port: TCP port; 0 for any free port.
            behind: host and port of the server on this machine.
            gate: access rules for requests.

        Raises:
            OSError: the address cannot be used.
        """
        # asyncio takes an empty host for all interfaces:
        # https://docs.python.org/3/library/asyncio-eventloop.html#asyncio.loop.create_server
        if not host:
            raise OSError("it is empty")
        self._behind, self._gate = behind, gate
        self._loop = asyncio.new_event_loop()
        self._connections: set[asyncio.Task[None]] = set()
        self._thread = Thread(target=self._loop.run_forever, name="relay", daemon=True)
        self._thread.start()
        start = asyncio.start_server(self._accept, host, port, limit=_MOST_HEAD)
        try:
            self._server = asyncio.run_coroutine_threadsafe(start, self._loop).result()
        except BaseException:
            self._end()
            raise
        self.port: int = self._server.sockets[0].getsockname()[1]

    def stop(self) -> None:
        """Close all connections and stop listening."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._end()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        for task in self._connections:
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            await self._connect(reader, writer)
        except (OSError, EOFError, TimeoutError, ValueError):
            pass  # the viewer or the server disconnected, or the request is malformed
        finally:
            self._connections.discard(task)
            # close() would wait until a viewer that does not read has read the buffer
            writer.transport.abort()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_PATIENCE_S):
            request = await reader.readuntil(b"\r\n\r\n")
        is_full = len(self._connections) > _MOST_CONNECTIONS
        refusal = "503 Too Many Viewers" if is_full else self._gate.refusal(request)
        if refusal is not None:
            writer.write(f"HTTP/1.1 {refusal}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode())
            writer.close()
            await writer.wait_closed()
            return
        request = b"GET / HTTP/1.1\r\n" + request.partition(b"\r\n")[2]
        offered_protocols = {
            protocol.strip() for header in _OFFER.findall(request) for protocol in header.decode().split(",")
        }
        # the SDK accepts only the name of the newer protocol; an old viewer expects the name that it offered
        is_old = OLD_PROTOCOL in offered_protocols
        if is_old and PROTOCOL not in offered_protocols:
            request = _OFFER.sub(f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n".encode(), request)
        server_reader, server_writer = await asyncio.open_connection(*self._behind, limit=_MOST_HEAD)
        try:
            server_writer.write(request)
            response = await server_reader.readuntil(b"\r\n\r\n")
            if is_old and PROTOCOL not in offered_protocols:
                response = response.replace(PROTOCOL.encode(), OLD_PROTOCOL.encode())
            writer.write(response)
            viewer = _Viewer(understands_state=not is_old)
            await _until_one_ends(
                _from_viewer(reader, server_writer, viewer), _to_viewer(server_reader, writer, viewer)
            )
            # the server's last frames, such as the reason for closing
            await _drain(writer)
        finally:
            server_writer.transport.abort()


class _Viewer:
    """State of a viewer: whether it understands playback states."""

    def __init__(self, *, understands_state: bool) -> None:
        self.understands_state = understands_state


async def _until_one_ends(*directions: Coroutine[Any, Any, None]) -> None:
    tasks = [asyncio.create_task(direction) for direction in directions]
    try:
        finished_tasks, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in finished_tasks:
            with suppress(OSError, EOFError, TimeoutError):
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _from_viewer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, viewer: _Viewer) -> None:
    """Pass on a viewer's frames until it disconnects, with numbers of parameters as exact texts."""
    while True:
        frame = await _read_head(reader)
        viewer.understands_state |= frame.kind == (_BINARY, _CONTROL_REQUEST)
        if frame.is_whole_text and frame.rest < _MOST_TEXT:
            frame_mask, first_byte = frame.begin[-5:-1], frame.begin[-1:]
            request = _unmask(first_byte + await reader.readexactly(frame.rest), frame_mask)
            writer.write(_text_frame(with_exact_numbers(request)))
            await _drain(writer)
        else:
            await _pass_on(frame, reader, writer)


def with_exact_numbers(text: bytes) -> bytes:
    """Return a request with numbers of parameters in hexadecimal, because the SDK rounds long decimals.

    The SDK changed the last bit of 24 of 200 random decimals with 16 or 17 digits.
    """
    if b'"setParameters"' not in text:
        return text
    try:
        request = json.loads(text, parse_float=lambda number: float(number).hex(), parse_int=_exact_integer)
        for parameter in request["parameters"]:
            # the hexadecimal number is a text, which the type would contradict
            if isinstance(parameter["value"], str) and parameter.get("type") == "float64":
                del parameter["type"]
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        # the SDK answers the request with the fault
        return text
    return json.dumps(request).encode()


def _exact_integer(number: str) -> int | str:
    return int(number) if len(number) <= _EXACT_DIGITS else float(number).hex()


def _unmask(content: bytes, mask: bytes) -> bytes:
    return bytes(byte ^ mask[index % 4] for index, byte in enumerate(content))


def _text_frame(content: bytes) -> bytes:
    """Return an unsplit text frame of a client, masked with zeros: RFC 6455, sections 5.2 and 5.3."""
    size = len(content)
    if size < 126:
        length_bytes = bytes([0x80 | size])
    elif size < 1 << 16:
        length_bytes = b"\xfe" + size.to_bytes(2, "big")
    else:
        length_bytes = b"\xff" + size.to_bytes(8, "big")
    return bytes([_FINAL | _TEXT]) + length_bytes + bytes(4) + content


async def _to_viewer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, viewer: _Viewer) -> None:
    """Pass on the server's frames until it disconnects.

    States of the playback are skipped until the viewer understands them.
    """
    while not viewer.understands_state:
        frame = await _read_head(reader)
        is_known = viewer.understands_state or frame.kind != (_BINARY, _PLAYBACK_STATE)
        await _pass_on(frame, reader, writer if is_known else None)
    await _copy(reader, writer)


class _Frame(NamedTuple):
    """The head of a WebSocket frame. Neither side splits its messages.

    Attributes:
        begin: bytes of the frame up to the first byte of its content.
        rest: number of bytes after `begin`.
        kind: opcode and first byte of the content, -1 for empty content.
    """

    begin: bytes
    rest: int
    kind: tuple[int, int]

    @property
    def is_whole_text(self) -> bool:
        """Whether the frame is an unsplit text of a client and is not empty."""
        return self.begin[0] == _FINAL | _TEXT and self.begin[1] & 0x80 > 0 and self.kind[1] >= 0


async def _read_head(reader: asyncio.StreamReader) -> _Frame:
    head_bytes = await reader.readexactly(2)
    is_masked, length = head_bytes[1] & 0x80, head_bytes[1] & 0x7F
    if length >= 126:
        head_bytes += await reader.readexactly(2 if length == 126 else 8)
        length = int.from_bytes(head_bytes[2:], "big")
    mask = await reader.readexactly(4) if is_masked else b"\0"
    first_byte = await reader.readexactly(min(length, 1))
    content_byte = first_byte[0] ^ mask[0] if first_byte else -1
    head_bytes += (mask if is_masked else b"") + first_byte
    return _Frame(head_bytes, length - len(first_byte), (head_bytes[0] & 0x0F, content_byte))


async def _pass_on(frame: _Frame, reader: asyncio.StreamReader, writer: asyncio.StreamWriter | None) -> None:
    """Pass on a frame; without a writer, skip it."""
    if writer is not None:
        writer.write(frame.begin)
    left_bytes = frame.rest
    while left_bytes:
        piece = await reader.readexactly(min(left_bytes, _PIECE))
        left_bytes -= len(piece)
        if writer is not None:
            writer.write(piece)
            await _drain(writer)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while piece := await reader.read(_PIECE):
        writer.write(piece)
        await _drain(writer)


async def _drain(writer: asyncio.StreamWriter) -> None:
    async with asyncio.timeout(_PATIENCE_S):
        await writer.drain()
