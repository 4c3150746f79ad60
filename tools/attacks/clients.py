"""Hostile clients of the live server; the server must serve the next viewer."""

from __future__ import annotations

import json
import random
import socket
import struct
from base64 import b64encode
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import spatial_replay as sr
from attacks.cases import Case, Outcome

PROTOCOL = "foxglove.sdk.v1"
PATIENCE_S = 20.0
_TEXT, _BINARY, _CLOSE, _PING = 1, 2, 8, 9
_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2**63, 1e308, -1e-320, "", "NaN", "1s", "x" * 10_000, [], [[]] * 50, {},
    {"a": {}}, "\u0000",
)  # fmt: skip
_URIS = ("file:///etc/passwd", "package://../../etc/passwd", "http://127.0.0.1:1/", "", "\u202e", "x" * 5_000)
_OPS = (
    "subscribe", "unsubscribe", "advertise", "setParameters", "getParameters", "fetchAsset", "serverInfo",
    "subscribeParameterUpdates", "subscribeConnectionGraph", "playback", "", "\u0000",
)  # fmt: skip


class Clients:
    """Broken handshakes, frames and requests, and clients that leave; then a correct viewer."""

    name = "clients"
    most_cpu_s = None
    uses_files = False

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._address = ("", 0)
        self._serving: Any = None

    def ready(self) -> None:
        from spatial_replay.logs.source import MemorySource
        from spatial_replay.replay.loaded_log import LoadedLog
        from spatial_replay.serve.server import open_server

        samples = [
            sr.Sample(n * 10**8, {"a": sr.Footprint.box(n, 0, n + 1, 1), "b": sr.Footprint.disc(5, 5, 1)})
            for n in range(30)
        ]
        specification = sr.parse_specification("const near = 9\nspec s = G (a dist b <= near)")
        loaded = LoadedLog(MemorySource.from_samples(samples), [specification])
        self._serving = self._stack.enter_context(open_server(loaded.evaluate(), port=0))
        host, port = self._serving.address.removeprefix("ws://").split("/")[0].rsplit(":", 1)
        self._address = host, int(port)

    def close(self) -> None:
        """Stop the server."""
        self._stack.close()

    def draw(self, rng: random.Random) -> Case:
        return {"sent": [_connection(rng) for _ in range(rng.randint(1, 4))]}

    def kept(self, case: Case, folder: Path) -> Case:
        return case

    def run(self, case: Case, folder: Path) -> Outcome:
        outcome = Outcome(counts={"connections": len(case["sent"])})
        # several are open at once
        with ExitStack() as stack:
            for sent in case["sent"]:
                with suppress(OSError):
                    connection = stack.enter_context(socket.create_connection(self._address, timeout=2))
                    for each in sent:
                        connection.sendall(bytes.fromhex(each))
                    connection.settimeout(0.02)
                    with suppress(TimeoutError):
                        connection.recv(65_536)
        try:
            self._serving.check()
            self._look()
        except Exception as error:
            outcome.problems.append(f"the next viewer is not served: {type(error).__name__}: {error}")
        return outcome

    def _look(self) -> None:
        """Connect like a viewer, and ask for the constants.

        Raises:
            Exception: the server gives no correct answer.
        """
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        host, port = self._address
        with connect(
            f"ws://{host}:{port}",
            subprotocols=[Subprotocol(PROTOCOL)],
            open_timeout=PATIENCE_S,
            max_size=None,
        ) as viewer:
            viewer.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "look"}))
            for _ in range(10_000):
                received = viewer.recv(timeout=PATIENCE_S)
                if isinstance(received, str) and json.loads(received).get("id") == "look":
                    return
        raise RuntimeError("it never answers")


def _connection(rng: random.Random) -> list[str]:
    """Return the bytes that a client sends, in hexadecimal."""
    if rng.random() < 0.3:
        return [_handshake(rng, is_sound=False).hex()]
    frames = [_frame(rng) for _ in range(rng.randint(1, 6))]
    return [_handshake(rng, is_sound=True).hex(), *(frame.hex() for frame in frames)]


def _handshake(rng: random.Random, *, is_sound: bool) -> bytes:
    key = b64encode(rng.randbytes(16)).decode()
    lines = [
        "GET / HTTP/1.1",
        "Host: 127.0.0.1",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {key}",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Protocol: {PROTOCOL}",
    ]
    if is_sound:
        return "\r\n".join([*lines, "", ""]).encode()
    match rng.randrange(7):
        case 0:
            return rng.randbytes(rng.choice((1, 100, 5_000)))
        case 1:
            lines.insert(2, "X-Long: " + "x" * rng.choice((1_000, 100_000)))
        case 2:
            lines[rng.randrange(len(lines))] = "\x00\xff: \x1b[2J"
        case 3:
            lines = lines[: rng.randint(1, len(lines))]
            return "\r\n".join(lines).encode("latin-1")
        case 4:
            lines[-1] = "Sec-WebSocket-Protocol: nothing"
        case 5:
            lines[0] = rng.choice(("GET /../../etc/passwd HTTP/1.1", "POST / HTTP/1.1", "GET / HTTP/9.9"))
        case 6:
            lines += ["Origin: http://evil.example", "Content-Length: 99999999999"]
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


def _frame(rng: random.Random) -> bytes:
    match rng.randrange(8):
        case 0:
            return rng.randbytes(rng.choice((2, 30, 2_000)))
        case 1:
            # a frame that claims to be very long, and is not
            return (
                bytes([0x82, 0xFF])
                + struct.pack(">Q", rng.choice((2**62, 2**40, 10**9)))
                + b"mask"
                + b"x" * 50
            )
        case 2:
            return _masked(rng, _BINARY, rng.randbytes(rng.randint(0, 60)))
        case 3:
            # opcode of a service call or of playback control, then noise
            return _masked(
                rng, _BINARY, bytes([rng.choice((1, 2, 3, 4))]) + rng.randbytes(rng.randint(0, 40))
            )
        case 4:
            return _masked(rng, rng.choice((_PING, _CLOSE, 3, 11)), rng.randbytes(rng.randint(0, 125)))
        case 5:
            return _masked(rng, _TEXT, rng.choice((b"", b"{", b"[1", b"\xff\xfe", b"[" * 5_000, b"null")))
    return _masked(rng, _TEXT, json.dumps(_request(rng)).encode())


def _request(rng: random.Random) -> dict[str, Any]:
    request: dict[str, Any] = {"op": rng.choice(_OPS), "id": rng.choice(_VALUES)}
    request["subscriptions"] = [{"id": rng.choice(_VALUES), "channelId": rng.choice((1, 2, 3, *_VALUES))}]
    request["parameters"] = [{"name": rng.choice(("near", "", "x")), "value": rng.choice(_VALUES)}]
    request["parameterNames"] = rng.choice((["near"], [], [1], "near", None))
    request["uri"], request["requestId"] = rng.choice(_URIS), rng.choice((1, *_VALUES))
    for key in list(request):
        if key != "op" and rng.random() < 0.3:
            del request[key]
    return request


def _masked(rng: random.Random, opcode: int, payload: bytes) -> bytes:
    """Return a masked frame, which a client sends."""
    mask, size = rng.randbytes(4), len(payload)
    if size < 126:
        head = bytes([0x80 | opcode, 0x80 | size])
    else:
        head = bytes([0x80 | opcode, 0x80 | 126]) + struct.pack(">H", size)
    return head + mask + bytes(each ^ mask[n % 4] for n, each in enumerate(payload))
