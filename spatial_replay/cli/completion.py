"""`spatial-replay completion`: shell completion of commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from spatial_replay.cli.application import COMPLETION_VARIABLE
from spatial_replay.cli.terminal import PROGRAM, show_file
from spatial_replay.errors import UsageError


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print a shell completion script.

    \b
    Example, for the current shell (add it to ~/.bashrc to keep it):
      eval "$(spatial-replay completion bash)"
    """
    completion_class = get_completion_class(shell)
    if completion_class is None:
        raise UsageError(f"no completion for {shell!r}; choose bash, zsh or fish")
    show_file(completion_class(context.find_root().command, {}, PROGRAM, COMPLETION_VARIABLE).source())
