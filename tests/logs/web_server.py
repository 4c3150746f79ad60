"""A web server that gives ranges of files, notes what it is asked, and misbehaves on request."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock, Thread


@dataclass
class WebServer:
    """Files by name, and what was asked of them.

    Attributes:
        asked: for each answered request, the bytes from the first up to, not including, the second.
        fault: called for each request with its number; an answer such as 503, "cut" for half of the content,
            or None for what was asked.
        dated: a date that all files have in place of tags.
    """

    files: dict[str, bytes]
    address: str = ""
    asked: list[tuple[int, int]] = field(default_factory=list)
    fault: Callable[[int], int | str | None] = lambda number: None
    requests: int = 0
    dated: str = ""

    def url(self, name: str) -> str:
        return f"{self.address}/logs/{name}"

    def version(self, content: bytes) -> dict[str, str]:
        """The header that distinguishes versions of a file."""
        tag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
        return {"Last-Modified": self.dated} if self.dated else {"ETag": tag}

    @property
    def sent(self) -> int:
        """How many bytes it was asked for."""
        return sum(end - begin for begin, end in self.asked)


@contextmanager
def serving(files: dict[str, bytes]) -> Iterator[WebServer]:
    """Serve files under /logs/ on a port of this machine."""
    server, lock = WebServer(files), Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            with lock:
                server.requests += 1
                fault = server.fault(server.requests)
            content = server.files.get(self.path.partition("?")[0].removeprefix("/logs/"))
            if content is None or isinstance(fault, int):
                self._answer(404 if content is None else fault, b"", {})
                return
            version = server.version(content)
            if self.headers.get("If-Match", version.get("ETag")) != version.get("ETag"):
                self._answer(412, b"", {})
                return
            begin, end = self._range(len(content))
            with lock:
                server.asked.append((begin, end))
            ranged = {"Content-Range": f"bytes {begin}-{end - 1}/{len(content)}"} | version
            self._answer(206, content[begin:end], ranged, cut=fault == "cut")

        def do_HEAD(self) -> None:
            content = server.files.get(self.path.removeprefix("/logs/"))
            length = {"Content-Length": str(len(content or b""))} | server.version(content or b"")
            self._answer(404 if content is None else 200, b"", length)

        def _range(self, size: int) -> tuple[int, int]:
            first, _, last = self.headers["Range"].removeprefix("bytes=").partition("-")
            if not first:
                return max(0, size - int(last)), size
            return int(first), min(int(last) + 1, size)

        def _answer(self, status: int, content: bytes, headers: dict[str, str], *, cut: bool = False) -> None:
            self.send_response(status)
            for name, value in ({"Content-Length": str(len(content))} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content[: len(content) // 2] if cut else content)
            self.close_connection = self.close_connection or cut

        def log_message(self, *arguments: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        daemon_threads = True
        request_queue_size = 64

        def handle_error(self, *arguments: object) -> None:
            pass

    with Server(("127.0.0.1", 0), Handler) as listening:
        thread = Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        server.address = f"http://127.0.0.1:{listening.server_port}"
        try:
            yield server
        finally:
            listening.shutdown()
            thread.join()
