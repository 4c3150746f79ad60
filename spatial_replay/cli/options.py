"""Options that several commands have."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar

import click

from spatial_replay.errors import UsageError

if TYPE_CHECKING:
    from spatial_replay.spec.formula import Specification

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


semantics_option = click.option(
    "--semantics",
    type=click.Choice(["ltlf", "paper"]),
    default="ltlf",
    show_default=True,
    help="What a formula means: robustness over finite traces, or the paper's Def. 16 to the letter.",
)

profile_option = click.option(
    "--profile",
    type=click.Choice(["paper", "spatial_spec"]),
    help="Relation profile of files without a `use` line.  [default: paper]",
)


def refuse_several(specification: Specification, of: str | None) -> None:
    """That it is clear which result of a specification is meant.

    Raises:
        UsageError: it has several, and none was chosen.
    """
    if of is None and len(specification.results) > 1:
        names = ", ".join(spec.name for spec in specification.results)
        raise UsageError(f"{specification.filename} has several results; choose one with --of: {names}")


_READING = (
    click.option(
        "--mapping",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Which topics of a log by others carry which objects (YAML).",
    ),
    click.option(
        "--on-time-jump",
        type=click.Choice(["error", "split"]),
        default="error",
        help="What becomes of a log of messages whose clock jumps back.  [default: error]",
    ),
    click.option(
        "--rate", metavar="N", type=float, help="Frames a second of drone annotations.  [default: 30]"
    ),
    click.option(
        "--lost",
        type=click.Choice(["drop", "keep"]),
        default="drop",
        help="What becomes of drone annotations marked as lost.  [default: drop]",
    ),
    click.option(
        "--concave",
        type=click.Choice(["decompose", "hull"]),
        default="decompose",
        help="A polygon that is not convex becomes convex parts, or its hull.  [default: decompose]",
    ),
)


class Reading(TypedDict):
    """How a log is to be read: what `open_source` takes beside its path."""

    mapping: Path | None
    on_time_jump: Literal["error", "split"]
    rate: float | None
    lost: Literal["drop", "keep"]
    concave: Literal["decompose", "hull"]


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say how a log is read; the command takes them together, as `reading`."""

    @wraps(command)
    def with_reading(**given: Any) -> Any:
        reading: dict[str, Any] = {name: given.pop(name) for name in Reading.__annotations__}
        return command(reading=reading, **given)

    decorated: Callable[..., Any] = with_reading
    for option in reversed(_READING):
        decorated = option(decorated)
    return decorated
