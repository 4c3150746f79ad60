"""Options of all commands, and how long their help is."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest

from spatial_replay.cli.application import application

COLUMNS = 100
MOST_LINES = 50
MOST_OPTIONS = 320


def commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    """Every command that can be typed, with its words; `record` is a command, and a group of others."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        if not isinstance(command, click.Group) or command.params:
            yield f"{path} {name}", command
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {name}")


COMMANDS = dict(commands(application, "spatial-replay"))


@pytest.mark.parametrize("path", COMMANDS)
def test_the_help_of_a_command_fits_a_screen(path: str) -> None:
    context = click.Context(COMMANDS[path], info_name=path, terminal_width=COLUMNS)
    context.help_option_names = ["-h", "--help"]
    help_lines = COMMANDS[path].get_help(context).splitlines()
    assert max(map(len, help_lines)) <= COLUMNS
    assert len(help_lines) <= MOST_LINES


def test_commands_have_few_options() -> None:
    counts = {
        path: sum(isinstance(parameter, click.Option) for parameter in command.params)
        for path, command in COMMANDS.items()
    }
    assert {"spatial-replay record", "spatial-replay record video", "spatial-replay plan"} <= counts.keys()
    assert sum(counts.values()) <= MOST_OPTIONS, counts
