"""The gate of the live server: which requests come in, by where they come from and by a token.

The library behind it looks at no header. So it listens at an address of this machine drawn by lot, and what
connects to the server's own address has to pass here first.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qs, urlsplit

from spatial_replay.errors import UsageError

VIEWERS: Final = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
"""Where viewers come from: Foxglove in a browser, and programs whose pages lie on this machine."""

_TOKEN_BYTES: Final = 16


def checked_origins(origins: Iterable[str]) -> tuple[str, ...]:
    """Return origins as browsers write them.

    Raises:
        UsageError: a text that is no origin.
    """
    for origin in origins:
        parts = urlsplit(origin)
        if not parts.scheme or not parts.netloc or parts.path.strip("/") or parts.query:
            raise UsageError(
                f"{origin!r} is not the origin of a page; give it as in https://viewer.example.org:8080"
            )
    return tuple(origin.rstrip("/").lower() for origin in origins)


def is_loopback(host: str) -> bool:
    """Return whether only programs on this machine reach a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True, slots=True)
class Gate:
    """What requests have to say.

    Attributes:
        origins: of pages that may connect, besides those of this machine.
        token: what requests have to carry, as in `?token=…`; None for nothing.
    """

    origins: frozenset[str]
    token: str | None

    @classmethod
    def of(cls, host: str, origins: Iterable[str]) -> Gate:
        """Return the gate of a server, with a new token if other machines can reach it.

        Raises:
            UsageError: a text that is no origin.
        """
        token = None if is_loopback(host) else secrets.token_urlsafe(_TOKEN_BYTES)
        return cls(frozenset((*VIEWERS, *checked_origins(tuple(origins)))), token)

    def refusal(self, head: bytes) -> str | None:
        """Return the status that answers a request that may not come in; None for one that may."""
        request, *lines = head.decode("latin-1").split("\r\n")
        split = (line.partition(":") for line in lines)
        fields = [(name.strip().lower(), value.strip()) for name, _, value in split]
        words = request.split(" ")
        if len(words) != 3 or words[0] != "GET" or dict(fields).get("upgrade", "").lower() != "websocket":
            return "426 Upgrade Required"
        if not all(self._is_allowed(value) for name, value in fields if name == "origin"):
            return "403 Origin Not Allowed"
        if self.token is not None:
            given = parse_qs(urlsplit(words[1]).query).get("token", [""])[0]
            if not hmac.compare_digest(given.encode(), self.token.encode()):
                return "401 Token Missing Or Wrong"
        return None

    def without_token(self, head: bytes) -> bytes:
        """Return a request as it is passed on."""
        return b"GET / HTTP/1.1\r\n" + head.partition(b"\r\n")[2]

    def _is_allowed(self, origin: str) -> bool:
        if origin.lower() in self.origins:
            return True
        try:
            parts = urlsplit(origin)
            return parts.scheme in ("http", "https") and is_loopback(parts.hostname or "")
        except ValueError:
            return False
