"""What a replay found, for people and for machines."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.times import text_from_duration_ns
from spatial_replay.wording import counted

if TYPE_CHECKING:
    from spatial_replay.replay import Replayed, ReplayedSpec

_COLOURS = {"satisfied": "blue", "violated": "red", "unknown": "yellow"}


def print_verdicts(replayed: Replayed, output: Path | None, window_ns: int | None = None) -> None:
    """One line for each result, worst news easy to see, on standard output; another one for a window."""
    seconds = (replayed.end_ns - replayed.start_ns) / 1e9
    damaged = ", damaged: verdicts are over what could be read" if replayed.faults else ""
    click.echo(f"{replayed.log}: {counted(replayed.samples, 'sample')} over {seconds:.3f} s{damaged}")
    titles = [_title(result) for result in replayed.results]
    width = max(map(len, titles), default=0)
    for title, result in zip(titles, replayed.results, strict=True):
        verdict = click.style(f"{result.verdict:<9}", fg=_COLOURS[result.verdict], bold=True)
        click.echo(f"  {title:<{width}}  {verdict}  {_numbers(result, replayed.first_ns)}")
        if result.verdict == "unknown" and result.inquiry is not None and replayed.semantics == "ltlf":
            click.echo(f"  {'':<{width}}  {_why_unknown(result, replayed.first_ns)}")
        if window_ns is not None:
            click.echo(f"  {'':<{width}}  {_over_window(result, replayed.first_ns, window_ns)}")
    if not replayed.results:
        click.echo("  no object was there for a template to stand for")
    if output is not None:
        click.echo(f"wrote {output}")


def write_document(
    replayed: Replayed, file: str, inputs: Sequence[Path], *, signal: bool, window_ns: int | None
) -> None:
    """Write everything found as one JSON object to a file, or to standard output for "-"."""
    from spatial_replay.logs.output import replacing
    from spatial_replay.replay import document

    text = json.dumps(
        document(replayed, signal=signal, window_ns=window_ns), ensure_ascii=False, allow_nan=False
    )
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


def _why_unknown(result: ReplayedSpec, first_ns: int) -> str:
    """What was not known, or not surely enough."""
    from spatial_replay.inspection.words import sentences_of

    if result.inquiry is None:
        return ""
    _, reason = sentences_of(result.inquiry.witness(), first_ns=first_ns)
    return reason


def _over_window(result: ReplayedSpec, first_ns: int, window_ns: int) -> str:
    """How often, and when first, a spec did not hold over the samples of the last so many seconds."""
    if result.inquiry is None:
        return ""
    values, times_ns = result.inquiry.window_signal(window_ns)[0], result.inquiry.times_ns
    over = f"over the last {text_from_duration_ns(window_ns)}"
    failing = (values < 0.0).nonzero()[0]
    if not len(failing):
        return f"{over} never violated; robustness at the end {_shown(float(values[-1]))}"
    first = text_from_duration_ns(int(times_ns[failing[0]]) - first_ns)
    count = f"{len(failing):,} of {counted(len(values), 'sample')}"
    return f"{over} violated at {count}, first at {first}; robustness at the end {_shown(float(values[-1]))}"


def _shown(number: float) -> str:
    return "not determined" if math.isnan(number) else f"{number:.6g}"
