"""`spatial-replay completion`: commands and options at the press of a key."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from spatial_replay.errors import UsageError


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script that completes commands in a shell.

    \b
    Example, for the current shell (write it to ~/.bashrc for all):
      eval "$(spatial-replay completion bash)"
    """
    kind = get_completion_class(shell)
    if kind is None:
        raise UsageError(f"no completion for {shell!r}; there is bash, zsh and fish")
    root = context.find_root()
    click.echo(kind(root.command, {}, "spatial-replay", "_SPATIAL_REPLAY_COMPLETE").source())
