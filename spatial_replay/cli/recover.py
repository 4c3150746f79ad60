"""`spatial-replay recover`: save all that can be read of a damaged log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import LogPath, log_output_option
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.logs.remote import LogFile
from spatial_replay.text import counted, time_text

if TYPE_CHECKING:
    from spatial_replay.sources.recover import Recovery, SampleGap

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
