"""Options that several commands have."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])


class _OutputFile(click.Path):
    """A path to write to; "-" is none."""

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        if value == "-":
            self.fail("- is no file; name one. `replay … --json -` writes to standard output", param, ctx)
        return super().convert(value, param, ctx)


def output_option(text: str, *, required: bool = False) -> Callable[[_Command], _Command]:
    """`-o FILE`, with its help."""
    return click.option("-o", "--output", type=_OutputFile(path_type=Path), required=required, help=text)


profile_option = click.option(
    "--profile",
    type=click.Choice(["paper", "spatial_spec"]),
    help="Relation profile of files without a `use` line.  [default: paper]",
)

concave_option = click.option(
    "--concave",
    type=click.Choice(["decompose", "hull"]),
    default="decompose",
    show_default=True,
    help="A polygon that is not convex becomes convex parts, or its hull.",
)
