"""The commands by name, each imported when it is used.

`--help` lists them without loading any: importing one may load the compiler and the readers of logs.
"""

from __future__ import annotations

from importlib import import_module

import click

COMMANDS: dict[str, str] = {
    "check": "Check a specification and show its tree.",
    "completion": "Print the script that completes commands in a shell.",
    "explain": "Say why a verdict is what it is.",
    "export": "Write an annotated log's numbers as a table.",
    "info": "Say what a log holds.",
    "plan": "Plan a run in a simulated world.",
    "record": "Record a run as a log.",
    "replay": "Evaluate specifications over a log.",
    "report": "Write what a run did as one page.",
    "serve": "Look at a replay in a viewer, and change constants there.",
    "verify": "Say whether a log is what it says it is.",
}
"""Name and summary; `spatial_replay/cli/NAME.py` holds the command under its name."""


class LazyCommands(click.Group):
    """A group of the commands in `COMMANDS`."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = getattr(import_module(f"spatial_replay.cli.{cmd_name}"), cmd_name)
        if not isinstance(command, click.Command):
            raise TypeError(f"spatial_replay.cli.{cmd_name}.{cmd_name} is no command but {command!r}")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))
