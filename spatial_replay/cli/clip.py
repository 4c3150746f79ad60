"""`spatial-replay clip` and `recover`: the smallest part of a log, and what can be read of a damaged one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    EvaluationArguments,
    LogPath,
    evaluation_options,
    log_output_option,
    naming_option,
    open_inputs,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.logs.remote import LogFile
from spatial_replay.text import counted, time_text
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.compare.clips import Clip
    from spatial_replay.sources.recover import Recovery, SampleGap


@click.command()
@evaluation_options
@log_output_option("Clip to write (MCAP).")
@click.option(
    "--result",
    "of",
    metavar="NAME",
    multiple=True,
    help="Spec to keep the verdict of; repeat for several.  [default: the violated ones, or all]",
)
@click.option(
    "--around", metavar="T", default="0s", help="Keep at least T before and after the samples that decide."
)
@click.option(
    "--topics",
    metavar="PATTERN",
    multiple=True,
    help="Topics to keep, such as '/camera/*'; repeat for several.  [default: all]",
)
def clip(
    request: EvaluationArguments, output: Path, of: tuple[str, ...], around: str, topics: tuple[str, ...]
) -> int:
    """Copy the smallest part of a log that shows a verdict, for a bug report.

    The clip has the same verdicts, robustness and witnesses as the log, of the results that are violated or,
    where none is, of all. It is an annotated log: every
    viewer plays it, and `replay` evaluates it without other files. Messages of all topics are cut to its
    time; before it come the last message of each topic and the last transform of each frame, with their own
    times.

    T is 5s or 500ms. Exits with 0 if the clip was written, 3 if the log is damaged.

    \b
    Examples:
      spatial-replay clip run.mcap --spec blocks.spatial -o bug.mcap
      spatial-replay clip run.mcap --spec blocks.spatial --result passage --around 5s -o bug.mcap
    """
    # imported here so that --help stays fast
    from spatial_replay.compare.clips import cut_clip
    from spatial_replay.logs.output_file import refuse_inputs

    refuse_inputs(output, request.inputs)
    with naming_option("--around"):
        around_ns = duration_ns_from_text(around)
    inputs = open_inputs(request)
    with progress("samples") as advance:
        found = cut_clip(
            inputs.source,
            inputs.files,
            output,
            inputs.options(keep=topics),
            around_ns=around_ns,
            of=of,
            inputs=request.inputs,
            advance=advance,
        )
    warn_of_input(found.whole)
    print_verdicts(found.replayed, output)
    show(_summary(found))
    if found.left_out and not of:
        show(f"  not kept, since nothing failed there: {', '.join(found.left_out)}; --result NAME keeps one")
    for title in (each for each in found.changed if of or each not in found.left_out):
        warn(f"{title} has another verdict in the clip than in the log; only {', '.join(found.kept)} is kept")
    if found.added:
        warn(f"{', '.join(found.added)}: fails in the clip alone, which has not all samples of the log")
    return ExitCode.DAMAGED if found.whole.faults else ExitCode.SATISFIED


def _summary(found: Clip) -> str:
    first_ns = found.whole.first_ns
    if found.is_whole:
        return "  nothing smaller has these verdicts and witnesses: the clip holds every sample of the log"
    window = " to ".join(time_text(at, first_ns) for at in (found.start_ns, found.end_ns))
    size = f"{found.clip_bytes:,} bytes"
    if found.source_bytes and found.clip_bytes >= found.source_bytes:
        size += f"; the log itself, {found.source_bytes:,} bytes, is smaller than its schemas and annotations"
    elif found.source_bytes:
        size += f", {found.clip_bytes / found.source_bytes:.2%} of the log's {found.source_bytes:,}"
    samples = f"{found.replayed.samples:,} of {counted(found.whole.samples, 'sample')}"
    return f"  {', '.join(found.kept)}: {samples}, {window} of the log; {size}"


_MOST_LISTED = 20


@click.command()
@click.argument("log", type=LogPath())
@log_output_option("Recovered log to write (MCAP).")
def recover(log: LogFile, output: Path) -> int:
    """Save all that can be read of a damaged log, and list what is missing.

    Takes MCAP logs, ours and external ones, and ROS bags: truncated, damaged, or left without an index by a
    recorder that was killed. The output is a proper log with an index: every message byte for byte, in the
    order of time, with metadata and attachments. The list of what is missing is also a metadata record of
    the output, and whatever reads the output later warns of it.

    Exits with 0 if nothing is missing, with 3 if something is.

    \b
    Examples:
      spatial-replay recover broken.mcap -o run.mcap
      spatial-replay recover drive_bag/ -o drive.mcap
    """
    # imported here so that --help stays fast
    from spatial_replay.sources.recover import recover_log

    with progress("messages") as advance:
        recovery = recover_log(log, output, advance)
    warn(*recovery.faults, *recovery.remarks)
    show(*_lines(recovery, output))
    return ExitCode.SATISFIED if recovery.is_whole else ExitCode.DAMAGED


def _lines(recovery: Recovery, output: Path) -> Iterator[str]:
    topics = sum(count > 0 for count in recovery.saved.values())
    saved = f"{counted(recovery.messages, 'message')} on {counted(topics, 'topic')}"
    if recovery.is_whole:
        yield f"{recovery.name}: nothing is missing; {output.name} holds {saved}"
        return
    yield f"{recovery.name}: {saved} saved in {output.name}; {recovery.losses}"
    yield from _listed("time", (_span(*span, recovery) for span in recovery.spans))
    yield from _listed("samples", (_gap(gap, recovery.start_ns) for gap in recovery.samples))
    counts = ((topic, missing + recovery.saved[topic]) for topic, missing in recovery.missing.items())
    yield from _listed(
        "topic",
        (f"{topic}: {recovery.missing[topic]:,} of {counted(all_, 'message')}" for topic, all_ in counts),
    )


def _listed(what: str, entries: Iterable[str]) -> Iterator[str]:
    lines = list(entries)
    yield from (f"  {what:<8} {entry}" for entry in lines[:_MOST_LISTED])
    if len(lines) > _MOST_LISTED:
        yield f"  {what:<8} and {len(lines) - _MOST_LISTED:,} more, in the metadata of the output"


def _span(start_ns: int, end_ns: int, recovery: Recovery) -> str:
    start, end = (time_text(at, recovery.start_ns) for at in (start_ns, end_ns))
    if start_ns >= recovery.end_ns:
        return f"from {start} on"
    return f"at {start}" if start_ns == end_ns else f"{start} to {end}"


def _gap(gap: SampleGap, first_ns: int) -> str:
    numbers = f"{gap.first} to {gap.last}" if gap.last > gap.first else str(gap.first)
    sides = (("after", gap.after_ns), ("before", gap.before_ns))
    known = " and ".join(f"{word} {time_text(at, first_ns)}" for word, at in sides if at is not None)
    return f"{numbers}, {known}" if known else numbers
