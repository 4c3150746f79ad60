"""The server for agents, and the SDK's own client, from code that does not wait by `await`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema
from anyio.from_thread import BlockingPortal, start_blocking_portal
from mcp import Client
from mcp.client.stdio import StdioServerParameters, stdio_client

from cli.program import environment

OLDER = "2025-06-18"
"""The last protocol before the client's newest one with a handshake."""


@dataclass(frozen=True)
class Answer:
    """An answer of a tool.

    Attributes:
        error: its sentence; "" for none.
        values: structured content; empty with an error.
    """

    text: str
    error: str
    values: dict[str, Any]
    size: int

    @property
    def document(self) -> dict[str, Any]:
        assert not self.error, self.error
        document: dict[str, Any] = self.values["document"]
        return document


class Agent:
    """A client of a running server. Every answer is held against the schema of its tool."""

    def __init__(self, portal: BlockingPortal, client: Client) -> None:
        self.portal, self.client = portal, client
        self.tools = {tool.name: tool for tool in portal.call(client.list_tools).tools}

    def call(self, tool: str, **arguments: Any) -> Answer:
        return self.begin(tool, **arguments).result()

    def begin(
        self, tool: str, progress: Callable[..., Any] | None = None, **arguments: Any
    ) -> Future[Answer]:
        return self.portal.start_task_soon(self._call, tool, arguments, progress)

    async def _call(
        self, tool: str, arguments: dict[str, Any], progress: Callable[..., Any] | None
    ) -> Answer:
        result = await self.client.call_tool(tool, arguments, progress_callback=progress)
        text = "\n".join(part.text for part in result.content)
        if not result.is_error:
            jsonschema.validate(result.structured_content, self.tools[tool].output_schema)
        size = len(
            json.dumps(
                result.model_dump(mode="json", by_alias=True, exclude_none=True), ensure_ascii=False
            ).encode()
        )
        return Answer(text, text if result.is_error else "", result.structured_content or {}, size)

    def read(self, uri: str) -> str:
        (content,) = self.portal.call(self.client.read_resource, uri).contents
        return content.text


@contextmanager
def agent(*arguments: object, protocol: str = "auto", **variables: str) -> Iterator[Agent]:
    """Start a server, with some environment variables, and connect a client to it."""
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "spatial_replay", "mcp", *map(str, arguments)],
        env=environment(**variables),
    )
    transport = _older(server) if protocol == OLDER else server
    client = Client(transport, mode="legacy" if protocol == OLDER else protocol)
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(client) as connected:
        assert protocol in ("auto", connected.protocol_version)
        yield Agent(portal, connected)


@asynccontextmanager
async def _older(server: StdioServerParameters) -> AsyncIterator[tuple[Any, Any]]:
    """A connection that asks for an older protocol than the newest one that has a handshake."""
    async with stdio_client(server) as (read, write):
        yield read, _Handshake(write)


class _Handshake:
    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    async def __aenter__(self) -> _Handshake:
        await self._stream.__aenter__()
        return self

    async def __aexit__(self, *error: Any) -> Any:
        return await self._stream.__aexit__(*error)

    async def send(self, message: Any) -> None:
        if getattr(message.message, "method", "") == "initialize":
            message.message.params["protocolVersion"] = OLDER
        await self._stream.send(message)


def processes_of(server: int) -> list[int]:
    """The processes below one, and those below them."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            number, _, rest = stat.read_text().partition(" (")
            children.setdefault(int(rest.rpartition(") ")[2].split()[1]), []).append(int(number))
        except (OSError, ProcessLookupError):
            continue
    below = list(children.get(server, []))
    for process in below:
        below += children.get(process, [])
    return below


def is_running(process: int) -> bool:
    """Whether a process is there, and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0] not in "ZX"
    except (OSError, ProcessLookupError):
        return False


def wait_until(condition: Callable[[], object], most_s: float = 60.0) -> None:
    """Wait for another process."""
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)
