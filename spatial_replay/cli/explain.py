"""`spatial-replay explain`: what decided a verdict, and what would flip it?"""

from __future__ import annotations

import json
from dataclasses import replace

import click

from spatial_replay.cli.application import exit_code_from_verdicts, say
from spatial_replay.cli.options import (
    Request,
    Task,
    evaluation_options,
    prepared,
    read_for,
    report_reading,
    text_from_duration_ns,
    time_point_from_text,
)
from spatial_replay.cli.progress import progress
from spatial_replay.errors import UsageError


@click.command()
@evaluation_options
@click.option("--node", metavar="NAME", help="Explain a named spec, wherever it stands.  [default: results]")
@click.option("--object", "object_name", metavar="NAME", help="Of a template, explain this object's result.")
@click.option("--at", metavar="T", help="Explain what was so at this time, on the samples up to it.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def explain(
    request: Request, node: str | None, object_name: str | None, at: str | None, as_json: bool
) -> int:
    """Say in plain sentences why a verdict is what it is.

    Which sample, which objects and which relation decided it, by how much, since when, and which change of
    which number would flip it; of an unknown verdict, what was not known.

    T is 12.5s or 1500ms after the first sample, integer nanoseconds, or 2026-01-31T12:00:00Z. Exits with the
    code of the verdicts explained, as `replay` does.

    \b
    Examples:
      spatial-replay explain run.mcap --spec blocks.spatial
      spatial-replay explain run.mcap --spec blocks.spatial --node reach --at 12.3s
    """
    # the numerical libraries load when there is work for them
    from spatial_replay.replay import ReplayOptions, explain_results, has_samples_from, run_replay

    if at is not None and request.end is not None:
        raise UsageError("--at and --to both say where the samples end; give one of them")
    task = _until(prepared(request), at)
    with progress("samples") as advance:
        replayed = run_replay(
            task.source,
            task.files,
            ReplayOptions(task.window, task.each),
            keep_series=True,
            keep_leaves=True,
            advance=advance,
        )
    report_reading(replayed)
    goes_on = at is not None and has_samples_from(task.source, task.window.end_ns)
    if at is not None and not goes_on and replayed.end_ns < task.window.end_ns - 1:
        last = text_from_duration_ns(replayed.end_ns - replayed.first_ns)
        say("warning", f"--at {at} lies after the last sample, at {last}", colour="yellow")
    found = explain_results(replayed, node=node, object=object_name, goes_on=goes_on)
    if as_json:
        click.echo(json.dumps([each.document for each in found], indent=2, ensure_ascii=False))
    else:
        click.echo("\n\n".join("\n".join(each.sentences) for each in found))
    return exit_code_from_verdicts((each.verdict for each in found), bool(replayed.faults))


def _until(task: Task, at: str | None) -> Task:
    """The same over the samples up to a time, that included."""
    from spatial_replay.replay import first_sample_ns

    if at is None:
        return task
    with read_for("--at"):
        at_ns = time_point_from_text(at).absolute_ns(first_sample_ns(task.source))
    if at_ns < task.window.start_ns:
        raise UsageError(f"--at {at} lies before --from; no sample is left")
    return replace(task, window=replace(task.window, end_ns=at_ns + 1))
