"""What a replay found, for people and for machines."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.times import text_from_duration_ns

if TYPE_CHECKING:
    from spatial_replay.replay import Replayed, ReplayedSpec

_COLOURS = {"satisfied": "blue", "violated": "red", "unknown": "yellow"}


def print_verdicts(replayed: Replayed, output: Path | None) -> None:
    """One line for each result, worst news easy to see, on standard output."""
    seconds = (replayed.end_ns - replayed.start_ns) / 1e9
    damaged = ", damaged: verdicts are over what could be read" if replayed.faults else ""
    click.echo(f"{replayed.log}: {counted(replayed.samples, 'sample')} over {seconds:.3f} s{damaged}")
    titles = [_title(result) for result in replayed.results]
    width = max(map(len, titles), default=0)
    for title, result in zip(titles, replayed.results, strict=True):
        verdict = click.style(f"{result.verdict:<9}", fg=_COLOURS[result.verdict], bold=True)
        click.echo(f"  {title:<{width}}  {verdict}  {_numbers(result, replayed.first_ns)}")
    if not replayed.results:
        click.echo("  no object was there for a template to stand for")
    if output is not None:
        click.echo(f"wrote {output}")


def write_document(replayed: Replayed, file: str, inputs: Sequence[Path]) -> None:
    """Write everything found as one JSON object to a file, or to standard output for "-"."""
    from spatial_replay.logs.output import replacing
    from spatial_replay.replay import document

    text = json.dumps(document(replayed), ensure_ascii=False, allow_nan=False)
    if file == "-":
        click.echo(text)
        return
    with replacing(Path(file), inputs) as stream:
        stream.write(text.encode() + b"\n")


def _title(result: ReplayedSpec) -> str:
    return result.name if result.object is None else f"{result.name}({result.object})"


def _numbers(result: ReplayedSpec, first_ns: int) -> str:
    robustness = float(result.robustness[0])
    parts = [f"robustness {_shown(robustness)}"]
    lower, upper = result.final[0].tolist()
    if not (lower == upper == robustness or math.isnan(lower)):
        parts.append(f"between {_shown(lower)} and {_shown(upper)}")
    if robustness == 0.0:
        parts.append("marginal")
    if result.first_satisfied_ns is not None:
        parts.append(f"first satisfied at {text_from_duration_ns(result.first_satisfied_ns - first_ns)}")
    return ", ".join(parts)


def _shown(number: float) -> str:
    return "not determined" if math.isnan(number) else f"{number:.6g}"


def counted(count: int, noun: str) -> str:
    """A number of things: "1 sample", "1,579 samples"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
