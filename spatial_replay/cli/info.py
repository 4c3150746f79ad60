"""`spatial-replay info`: what is in this log?"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.exit_codes import ExitCode
from spatial_replay.cli.failures import say
from spatial_replay.cli.progress import progress
from spatial_replay.cli.verdicts import counted

if TYPE_CHECKING:
    from spatial_replay.logs.mcap_info import LogSummary
    from spatial_replay.logs.overview import Overview

_EPOCH_LIKELY_NS = 10**18
"""Clocks beyond this count from 1970 (2001 or later); others count from the start of something."""


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
def info(log: Path, as_json: bool) -> int:
    """Say what a log holds: samples, objects, signals, topics, attachments.

    The whole log is read. Exits with 0, or with 3 if it is damaged; what is wrong goes to standard error.

    \b
    Examples:
      spatial-replay info annotated.mcap
      spatial-replay info blocks.jsonl.gz --json
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.logs.overview import overview_of
    from spatial_replay.logs.source import open_source

    with progress("samples") as advance:
        overview = overview_of(open_source(log), advance)
    for fault in overview.faults:
        say("warning", fault, colour="yellow")
    if as_json:
        click.echo(json.dumps(_document(overview), indent=2, ensure_ascii=False))
    else:
        for line in _lines(overview):
            click.echo(line)
    return ExitCode.DAMAGED if overview.faults else ExitCode.SATISFIED


def _document(overview: Overview) -> dict[str, object]:
    container = overview.container
    document: dict[str, object] = {
        "name": overview.name,
        "kind": overview.kind,
        "samples": overview.samples,
        "start_ns": overview.start_ns,
        "end_ns": overview.end_ns,
        "damaged": bool(overview.faults),
        "faults": overview.faults,
        "objects": [asdict(each) for each in overview.objects],
        "signals": overview.signals,
    }
    if container is not None:
        document["topics"] = [
            {"topic": topic, "schema": schema, "encoding": encoding, "messages": messages}
            for topic, schema, encoding, messages in _topics(container)
        ]
        document["metadata"] = [{"name": name, "data": dict(data)} for name, data in container.metadata]
        document["attachments"] = [asdict(each) for each in container.attachments]
    return document


def _topics(container: LogSummary) -> Iterator[tuple[str, str, str, int]]:
    for each in container.channels:
        schema = each.channel.schema.name if each.channel.schema is not None else ""
        yield each.channel.topic, schema, each.channel.encoding, each.messages


def _lines(overview: Overview) -> Iterator[str]:
    damaged = ", damaged" if overview.faults else ""
    yield f"{overview.name}: {overview.kind}, {counted(overview.samples, 'sample')}{damaged}"
    if overview.start_ns is not None and overview.end_ns is not None:
        seconds = (overview.end_ns - overview.start_ns) / 1e9
        yield f"time     {_clock(overview.start_ns)} to {_clock(overview.end_ns)} ({seconds:.3f} s)"
    if overview.objects:
        yield "objects"
        yield from _table(
            (
                each.name,
                ", ".join(each.classes),
                counted(each.samples, "sample"),
                _unreadable(each.unreadable),
            )
            for each in overview.objects
        )
    if overview.signals:
        yield f"signals  {', '.join(overview.signals)}"
    if overview.container is not None:
        yield from _container_lines(overview.container)


def _container_lines(container: LogSummary) -> Iterator[str]:
    yield "topics"
    yield from _table((*names, counted(messages, "message")) for *names, messages in _topics(container))
    for name, data in container.metadata:
        yield f"metadata {name}"
        yield from _table(data.items())
    if container.attachments:
        yield "attachments"
        yield from _table(
            (each.name, each.media_type, counted(each.size, "byte")) for each in container.attachments
        )


def _clock(time_ns: int) -> str:
    if time_ns < _EPOCH_LIKELY_NS:
        return f"{time_ns / 1e9:.3f} s"
    seconds, fraction_ns = divmod(time_ns, 10**9)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{fraction_ns // 10**6:03d}Z"


def _unreadable(count: int) -> str:
    return f"{count:,} not finite" if count else ""


def _table(rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """Rows as lines, their columns aligned."""
    cells = list(rows)
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        yield "  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
