"""`spatial-replay explain`: what decided a verdict, and what would flip it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import click

from spatial_replay.cli.application import exit_code_from_verdicts
from spatial_replay.cli.options import (
    EvaluationArguments,
    EvaluationInputs,
    JsonCommand,
    evaluation_options,
    naming_option,
    open_inputs,
    warn_of_input,
)
from spatial_replay.cli.output import MANY, VERDICT_COLOURS, others_text, worst_of
from spatial_replay.cli.terminal import (
    Coloured,
    Line,
    progress,
    show,
    show_json,
    warn,
)
from spatial_replay.errors import UsageError
from spatial_replay.monitor.verdict import counts_text
from spatial_replay.text import requirement_text, time_text
from spatial_replay.trace.trace import time_point_from_text

if TYPE_CHECKING:
    from spatial_replay.monitor.result import SpecResult
    from spatial_replay.replay.document import Explanation


@click.command(cls=JsonCommand)
@evaluation_options
@click.option(
    "--result",
    metavar="NAME[@OBJECT]",
    default="",
    help="Named spec to explain; NAME@OBJECT for one object of a template.  [default: all results]",
)
@click.option("--at", metavar="T", help="Explain the verdict at time T, on the samples up to it.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def explain(request: EvaluationArguments, result: str, at: str | None, as_json: bool) -> int:
    """Explain a verdict in plain sentences.

    For each result: which sample, objects and relation decided it, by how much, since when, and which change
    of a constant would flip it. For an unknown verdict: the missing parts.

    Write a time T as 12.5s or 1500ms after the first sample, 5250000000ns on the log's clock, or
    2026-01-31T12:00:00Z. Exits with the code of the explained verdicts, as `replay` does. A verdict
    that is still pending at the time --at counts as unknown (4).

    \b
    Examples:
      spatial-replay explain run.mcap --spec blocks.spatial
      spatial-replay explain run.mcap --spec blocks.spatial --result reach --at 12.3s
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.messages import MAPPED
    from spatial_replay.replay.document import explain_results, idle_document, verdict_of
    from spatial_replay.replay.engine import run_replay
    from spatial_replay.replay.selection import has_samples_from

    name, _, object_of = result.partition("@")
    node, object_name = name or None, object_of or None
    if at is not None and request.end is not None:
        raise UsageError("--at and --to both set the last sample; give only one")
    inputs = _until(open_inputs(request), at)
    with progress("samples") as advance:
        replayed = run_replay(
            inputs.source,
            inputs.files,
            inputs.options(keep=(MAPPED,)),
            keep_series=True,
            keep_leaves=True,
            certify=False,
            advance=advance,
        )
    warn_of_input(replayed)
    goes_on = at is not None and has_samples_from(inputs.source, inputs.window.end_ns)
    if at is not None and not goes_on and replayed.end_ns < inputs.window.end_ns - 1:
        warn(f"--at {at} is after the last sample, at {time_text(replayed.end_ns, replayed.first_ns)}")
    others: Sequence[SpecResult] = ()
    counts = ""
    if not as_json and object_name is None:
        fitting = [each for each in replayed.results if verdict_of(each, node, goes_on=goes_on) is not None]
        # where none fits, the nearest name is looked for among all
        shown, others = worst_of(fitting) if fitting else (replayed.results, ())
        if len(fitting) > MANY:
            verdicts_of_all = [verdict_of(each, node, goes_on=goes_on) for each in fitting]
            counts = f"{len(fitting):,} results: {counts_text(map(str, verdicts_of_all))}"
        replayed = replace(replayed, results=tuple(shown))
    verdicts_of_others = [str(verdict_of(each, node, goes_on=goes_on)) for each in others]
    results = explain_results(replayed, node=node, object=object_name, goes_on=goes_on)
    idle = replayed.vacuous if node is None and object_name is None else ()
    if as_json:
        show_json([*(each.document for each in results), *map(idle_document, idle)])
    else:
        texts = [*([[counts]] if counts else []), *_texts(results)]
        if idle:
            texts.append([each.message for each in idle])
        if others:
            texts.append([others_text(others, verdicts_of_others)])
        for number, lines in enumerate(texts):
            show(*([""] if number else []), *map(_coloured, lines))
    verdicts = [*(each.verdict for each in results), *verdicts_of_others]
    return exit_code_from_verdicts(verdicts, bool(replayed.faults))


def _coloured(line: str) -> Line:
    """Return a line with verdicts in their colours."""
    pieces = enumerate(re.split(_VERDICT, line))
    return tuple(Coloured(piece, VERDICT_COLOURS[piece]) if number % 2 else piece for number, piece in pieces)


_VERDICT: Final = re.compile(r"(?<=is )(satisfied|violated|unknown)\b")


def _texts(explanations: Sequence[Explanation]) -> Iterator[list[str]]:
    """Yield each explanation below the requirement that it is about, which several in a row share."""
    before = None
    for each in explanations:
        spec = each.document["specification"], each.document["node"]
        requirement = requirement_text(each.document["requirement"], each.document["title"])
        heading = [requirement] if requirement and spec != before else []
        yield [*heading, *each.sentences]
        before = spec


def _until(inputs: EvaluationInputs, at: str | None) -> EvaluationInputs:
    """Return the same inputs with a window that ends with the samples at a time."""
    from spatial_replay.replay.selection import first_sample_ns

    if at is None:
        return inputs
    with naming_option("--at"):
        at_ns = time_point_from_text(at).absolute_ns(first_sample_ns(inputs.source))
    if at_ns < inputs.window.start_ns:
        raise UsageError(f"--at {at} is before --from; no sample is left")
    return replace(inputs, window=replace(inputs.window, end_ns=at_ns + 1))
