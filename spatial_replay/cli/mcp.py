"""`spatial-replay mcp`: a server of the commands for agents, and the work of one call."""

from __future__ import annotations

import errno
import io
import json
import os
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from spatial_replay.cli.application import run
from spatial_replay.cli.terminal import Listener, listening
from spatial_replay.errors import importing
from spatial_replay.spec.relations import PLUGINS_VARIABLE

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from spatial_replay.agents.calls import Call

_PROGRESS_S: Final = 0.2
"""Least time between two reports of progress, seconds."""


@click.command()
@click.option(
    "--root",
    "roots",
    metavar="FOLDER",
    multiple=True,
    required=True,
    help="Folder or address with logs that may be read; repeat for several.",
)
@click.option(
    "--output",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="Folder for reports and annotated logs.",
)
@click.option(
    "--limit",
    metavar="SECONDS",
    type=click.FloatRange(min=1.0),
    default=60.0,
    show_default=True,
    help="Longest time of one call.",
)
def mcp(roots: tuple[str, ...], output: Path | None, limit: float) -> None:
    """Serve the commands to agents as tools, by the Model Context Protocol.

    The server speaks over standard input and output, until the client closes them. Only files below the roots
    are read. Data leaves this machine only to the client. Plug-ins are off.

    \b
    Examples:
      spatial-replay mcp --root logs --output reports
      claude mcp add spatial-replay -- spatial-replay mcp --root logs --output reports
    """
    from spatial_replay.agents.bounds import Bounds

    bounds = Bounds.of(roots, output)
    with importing("a server for agents needs the package mcp", extra="agents"):
        from spatial_replay.agents.server import serve
    serve(bounds, limit, work)


def work(channel: Connection, call: Call) -> None:
    """Run the commands of one call in this process, and send results and progress.

    Sends `("progress", label, steps, total)`, and for each command `("result", exit code, lines of standard
    output, lines of standard error, document)`.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # plug-ins stay off, even if the user allows them elsewhere: an agent's specification runs no code
    os.environ.pop(PLUGINS_VARIABLE, None)
    os.chdir(call.folder)
    # temporary files need a folder that the guard allows
    tempfile.tempdir = call.folder
    # installed before any code of the call runs
    sys.addaudithook(_guard(call.readable, is_online=call.is_online))
    last_report_s = time.monotonic()

    def report(label: str, steps: int, total: int | None) -> None:
        nonlocal last_report_s
        if (now_s := time.monotonic()) - last_report_s > _PROGRESS_S:
            last_report_s = now_s
            channel.send(("progress", label, steps, total))

    for command in call.commands:
        documents: list[Any] = []
        output, errors = io.StringIO(), io.StringIO()
        with redirect_stdout(output), redirect_stderr(errors), listening(Listener(documents.append, report)):
            exit_code = _list_logs(command[1:], documents) if command[0] == "list" else run(command)
        document = json.loads(json.dumps(documents[-1])) if documents else None
        channel.send(("result", int(exit_code), output.getvalue(), errors.getvalue(), document))
    channel.close()


def _end_with_parent() -> None:
    """End this process when the server ends, even if it is killed."""
    if (parent := parent_process()) is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _list_logs(folders: Sequence[str], documents: list[Any]) -> int:
    """Append a list of logs, and of data sets with numbers of episodes, in the folders to `documents`."""
    from spatial_replay.batch.run import find_logs
    from spatial_replay.batch.suite import LogPattern
    from spatial_replay.errors import UsageError
    from spatial_replay.logs.formats.datasets import data_set_address

    counts: dict[str, int] = {}
    for folder in folders:
        try:
            logs = find_logs([LogPattern(folder)], Path(folder))
        except UsageError:
            # a root without logs
            continue
        for log in logs:
            address = data_set_address(log.path)
            path = address[0] if address else log.path
            counts[path] = counts.get(path, 0) + (address is not None)
    documents.append([{"path": path, "episodes": count or None} for path, count in sorted(counts.items())])
    return 0


def _guard(readable: Sequence[str], *, is_online: bool) -> Callable[[str, tuple[Any, ...]], None]:
    """Return an audit hook (PEP 578) that refuses connections, and files outside some folders.

    The hook also refuses further files that mappings, bags and data sets name. Libraries in C that open files
    themselves bypass the hook.
    """
    folders = [*readable, sys.prefix, sys.base_prefix, *sysconfig.get_paths().values(), *_SYSTEM]
    folders += [str(Path(__file__).parents[1]), *filter(None, map(os.environ.get, _CACHES))]
    folders.append(str(Path.home() / ".cache"))
    folder_prefixes = tuple(f"{os.path.realpath(folder)}/" for folder in dict.fromkeys(folders))

    def guard(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if not f"{path}/".startswith(folder_prefixes):
                reason = "outside the roots of this server"
                raise PermissionError(errno.EACCES, reason, os.path.basename(path))  # noqa: PTH119
        elif event == "socket.connect" and not is_online:
            raise PermissionError(errno.EACCES, "addresses are no roots of this server")

    return guard


_SYSTEM: Final = ("/dev", "/proc", "/sys", "/usr", "/lib", "/lib64")
"""Folders that the interpreter and libraries read."""
_CACHES: Final = ("SPATIAL_REPLAY_CACHE", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
"""Environment variables that name folders of machine code."""
