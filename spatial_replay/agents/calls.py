"""Calls of tools. Each call runs its commands in a new process, which ends with the call."""

from __future__ import annotations

import multiprocessing
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from typing import Any, NamedTuple, TypeAlias

import anyio
from anyio import to_thread

from spatial_replay.batch.forking import forking_context


class Call(NamedTuple):
    """The commands of one call.

    Attributes:
        commands: arguments of the program for each command, without the program's name.
        folder: current folder of the process.
        readable: folders that may be read and written.
        is_online: whether addresses may be read.
    """

    commands: Sequence[Sequence[str]]
    folder: str
    readable: Sequence[str]
    is_online: bool


class Outcome(NamedTuple):
    """The outcome of one command.

    Attributes:
        code: exit code.
        out, err: text on standard output and on standard error.
        document: result as values for JSON; None for a command without values.
    """

    code: int
    out: str
    err: str
    document: Any


class Outcomes(NamedTuple):
    """The outcomes of a call's commands.

    Attributes:
        outcomes: outcomes of the commands that ended.
        reason: reason for missing outcomes; "" if all commands ended.
    """

    outcomes: tuple[Outcome, ...]
    reason: str


Work: TypeAlias = Callable[[Connection, Call], None]
Report: TypeAlias = Callable[[str, int, int | None], Awaitable[None]]

_PRELOADED = (
    "spatial_replay.api",
    "spatial_replay.batch.run",
    "spatial_replay.sanity.differences",
    *(f"spatial_replay.cli.{name}" for name in ("check", "diff", "distinguish", "info", "replay", "tune")),
)
"""Modules that the fork server imports once for all calls."""


class Processes:
    """Starts a process for each call, and limits the number of concurrent processes."""

    def __init__(self, work: Work, limit_s: float, most: int) -> None:
        self._work, self._limit_s = work, limit_s
        self._limiter = anyio.CapacityLimiter(most)

    def start(self) -> None:
        """Start the fork server."""
        self._context()

    def _context(self) -> ForkServerContext:
        return forking_context([self._work.__module__, *_PRELOADED])

    async def run(self, call: Call, report: Report) -> Outcomes:
        """Run a call to its end or to the time limit. The process of a cancelled call is killed."""
        async with self._limiter:
            receiver, sender = multiprocessing.Pipe(duplex=False)
            process = self._context().Process(target=self._work, args=(sender, call), daemon=True)
            outcomes: list[Outcome] = []
            progress_text = ""
            try:
                # the first start waits for the imports of the fork server
                await to_thread.run_sync(process.start)
                sender.close()
                with anyio.move_on_after(self._limit_s):
                    while len(outcomes) < len(call.commands):
                        await anyio.wait_readable(receiver)
                        message = receiver.recv()
                        if message[0] == "result":
                            outcomes.append(Outcome(*message[1:]))
                        else:
                            _, label, steps, total = message
                            progress_text = f" after {steps:,} {label}"
                            await report(label, steps, total)
                    return Outcomes(tuple(outcomes), "")
                reason = f"the call took longer than {self._limit_s:g} s and was ended{progress_text}"
                return Outcomes(
                    tuple(outcomes), f"{reason}; give less, or start the server with a greater --limit"
                )
            except (EOFError, ConnectionError):
                reason = "the process of this call ended unexpectedly; is there memory enough?"
                return Outcomes(tuple(outcomes), f"{reason} Other calls are served as before")
            finally:
                receiver.close()
                # the process may not have been started
                with suppress(AttributeError, ValueError):
                    process.kill()
