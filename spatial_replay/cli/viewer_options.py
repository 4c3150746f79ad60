"""Options of commands that serve viewers over WebSocket: where, and who may connect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar, cast

import click

from spatial_replay.cli.terminal import warn

_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class ServingArguments:
    """Where a server of viewers listens, and who may connect besides those of this machine."""

    host: str
    port: int
    origins: tuple[str, ...]

    def warn_of_access(self, what: str) -> None:
        """Say what is open to whom, when other machines can reach the server."""
        # imported here so that --help stays fast
        from spatial_replay.serve.gate import is_loopback

        if not is_loopback(self.host):
            warn(f"who has this address, with its token, can {what}")


def serving_options(port: int, only_with: str = "") -> Callable[[_Command], _Command]:
    """Add the options of a server of viewers; the command takes them as `serving`.

    Args:
        port: the default.
        only_with: what the help of each begins with: "With --serve: ".
    """

    def help_of(text: str) -> str:
        return f"{only_with}{text[0].lower() if only_with else text[0]}{text[1:]}"

    options = [
        click.option(
            "--port",
            metavar="P",
            type=click.IntRange(0, 65535),
            default=port,
            show_default=True,
            help=help_of("Port to listen on; 0 for any free port."),
        ),
        click.option(
            "--host",
            metavar="ADDRESS",
            default="127.0.0.1",
            show_default=True,
            help=help_of(
                "Address to listen on; beyond this machine, viewers need the token in the printed address."
            ),
        ),
        click.option(
            "--allow-origin",
            "origins",
            metavar="ORIGIN",
            multiple=True,
            help=help_of(
                "Web page that may connect, such as https://viewer.example.org; repeat for several."
            ),
        ),
    ]

    def add(command: _Command) -> _Command:
        @wraps(command)
        def run(*arguments: Any, host: str, port: int, origins: tuple[str, ...], **named: Any) -> Any:
            return command(*arguments, serving=ServingArguments(host, port, origins), **named)

        decorated: Callable[..., Any] = run
        for option in reversed(options):
            decorated = option(decorated)
        return cast(_Command, decorated)

    return add
