"""`spatial-replay clip`, `recover` and `verify`: parts of logs, damaged logs, and certificates."""

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
    reading_options,
    warn_of_input,
)
from spatial_replay.cli.output import print_verdicts
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted_from, plural, time_text
from spatial_replay.trace.trace import duration_ns_from_text

if TYPE_CHECKING:
    from spatial_replay.compare.clips import Clip
    from spatial_replay.logs.read_options import Reading
    from spatial_replay.sources.recover import Recovery, SampleGap


@click.command()
@evaluation_options
@log_output_option("Clip to write (MCAP).")
@click.option(
    "--result",
    "of",
    metavar="NAME",
    multiple=True,
    help="Spec whose verdict is kept; repeat for several.  [default: violated specs, or all]",
)
@click.option(
    "--around", metavar="T", default="0s", help="Keep at least T before and after the deciding samples."
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

    Violated results have the same verdicts, robustness and witnesses in the clip as in the log. Without a
    violation, this holds for all results. The clip is an annotated log: every viewer plays it, and `replay`
    evaluates it without other files. The clip has the messages of all topics in its time. The last earlier
    message of each topic and the last earlier transform of each frame are in the clip, too, with their times.

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
        clip = cut_clip(
            inputs.source,
            inputs.files,
            output,
            inputs.options(keep=topics),
            around_ns=around_ns,
            of=of,
            inputs=request.inputs,
            advance=advance,
        )
    warn_of_input(clip.whole)
    print_verdicts(clip.replayed, output)
    show(_summary(clip), *(f"  {reason}" for reason in clip.reasons))
    if clip.left_out and not of:
        show(f"  not kept, since nothing failed there: {', '.join(clip.left_out)}; --result NAME keeps one")
    left_out = () if of else clip.left_out
    for title in (title for title in clip.changed if title not in left_out):
        warn(f"{title} has another verdict in the clip than in the log; only {', '.join(clip.kept)} is kept")
    if clip.added:
        warn(f"{', '.join(clip.added)}: fails in the clip alone, which has not all samples of the log")
    return ExitCode.DAMAGED if clip.whole.faults else ExitCode.SATISFIED


def _summary(cut: Clip) -> str:
    first_ns = cut.whole.first_ns
    if cut.is_whole:
        return "  nothing smaller has these verdicts and witnesses: the clip holds every sample of the log"
    window_text = " to ".join(time_text(at, first_ns) for at in (cut.start_ns, cut.end_ns))
    size = f"{cut.clip_bytes:,} bytes"
    if cut.source_bytes and cut.clip_bytes >= cut.source_bytes:
        size += f"; the log itself, {cut.source_bytes:,} bytes, is smaller than its schemas and annotations"
    elif cut.source_bytes:
        size += f", {cut.clip_bytes / cut.source_bytes:.2%} of the log's {cut.source_bytes:,}"
    samples_text = f"{cut.replayed.samples:,} of {plural(cut.whole.samples, 'sample')}"
    return f"  {', '.join(cut.kept)}: {samples_text}, {window_text} of the log; {size}"


_MOST_LISTED = 20


@click.command()
@click.argument("log", type=LogPath())
@log_output_option("Recovered log to write (MCAP).")
def recover(log: LogFile, output: Path) -> int:
    """Save the readable part of a damaged log, and list the missing data.

    The input is an MCAP log, ours or an external one, or a ROS bag: truncated, damaged, or left without an
    index by a killed recorder. The output is a proper log with an index. Every readable message is in the
    output byte for byte, in the order of time, with metadata and attachments. The list of missing data is
    also a metadata record of the output, and later readers of the output warn of it.

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
    topic_count = sum(count > 0 for count in recovery.saved.values())
    saved_text = f"{plural(recovery.messages, 'message')} on {plural(topic_count, 'topic')}"
    if recovery.is_whole:
        yield f"{recovery.name}: nothing is missing; {output.name} holds {saved_text}"
        return
    yield f"{recovery.name}: {saved_text} saved in {output.name}; {recovery.losses}"
    yield from _entry_lines("time", (_span(*span, recovery) for span in recovery.spans))
    yield from _entry_lines("samples", (_gap(gap, recovery.start_ns) for gap in recovery.samples))
    totals = ((topic, missing + recovery.saved[topic]) for topic, missing in recovery.missing.items())
    yield from _entry_lines(
        "topic",
        (f"{topic}: {recovery.missing[topic]:,} of {plural(total, 'message')}" for topic, total in totals),
    )


def _entry_lines(label: str, entries: Iterable[str]) -> Iterator[str]:
    lines = list(entries)
    yield from (f"  {label:<8} {entry}" for entry in lines[:_MOST_LISTED])
    if len(lines) > _MOST_LISTED:
        yield f"  {label:<8} and {len(lines) - _MOST_LISTED:,} more, in the metadata of the output"


def _span(start_ns: int, end_ns: int, recovery: Recovery) -> str:
    start, end = (time_text(time_ns, recovery.start_ns) for time_ns in (start_ns, end_ns))
    if start_ns >= recovery.end_ns:
        return f"from {start} on"
    return f"at {start}" if start_ns == end_ns else f"{start} to {end}"


def _gap(gap: SampleGap, first_ns: int) -> str:
    sample_numbers = f"{gap.first} to {gap.last}" if gap.last > gap.first else str(gap.first)
    sides = (("after", gap.after_ns), ("before", gap.before_ns))
    time_bounds = " and ".join(f"{word} {time_text(at, first_ns)}" for word, at in sides if at is not None)
    return f"{sample_numbers}, {time_bounds}" if time_bounds else sample_numbers


@click.command()
@click.argument("log", type=LogPath())
@click.option(
    "--source",
    metavar="SOURCE",
    type=LogPath(),
    help="Evaluate SOURCE, the log from which LOG was made, instead of LOG.",
)
@click.option("--decisions", is_flag=True, help="Also recompute the decisions of a planned run.")
@click.option("--explain", is_flag=True, help="Show the different part, and its first difference.")
@click.option(
    "--sign",
    metavar="KEY",
    type=click.Path(path_type=Path),
    help="Sign the certificate, if all is equal, with an OpenSSH key, such as ~/.ssh/id_ed25519.",
)
@click.option(
    "--signer",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Also check that one of these people signed it: public keys, or an allowed_signers file.",
)
@click.option(
    "--signature",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The signature to write or check.  [default: LOG.sig]",
)
@reading_options
def verify(
    log: LogFile,
    source: LogFile | None,
    decisions: bool,
    explain: bool,
    sign: Path | None,
    signer: Path | None,
    signature: Path | None,
    reading: Reading,
) -> int:
    """Recompute a log's certificate, and compare it with the recorded certificate.

    The log is evaluated with its own specifications and options. With --decisions, every planner decision is
    recomputed from the recorded samples, with all its maps, and compared bit for bit. With --source, the
    decisions of the source are recomputed. With --sign, a correct certificate is signed with your SSH key,
    into LOG.sig. With --signer, this signature is checked. Exits with 0 if all is equal, otherwise with 1.

    \b
    Examples:
      spatial-replay verify annotated.mcap
      spatial-replay verify annotated.mcap --source run.mcap
      spatial-replay verify push.mcap --decisions
      spatial-replay verify annotated.mcap --sign ~/.ssh/id_ed25519
      spatial-replay verify annotated.mcap --signer colleague.pub
    """
    # imported here so that --help stays fast
    from spatial_replay.logs.output_file import replacing
    from spatial_replay.logs.read_options import ReadOptions
    from spatial_replay.planning.read import recompute_decisions
    from spatial_replay.replay.selection import known_zero_ns
    from spatial_replay.replay.verification import (
        recorded_reading,
        sign_certificate,
        signer_of,
        verify_certificate,
    )
    from spatial_replay.sources.open_log import open_source

    if signature is not None and sign is None and signer is None:
        raise UsageError("--signature names the file of --sign or --signer; add one of them")
    if signature is None:
        signature = Path(f"{log}.sig") if isinstance(log, Path) else Path(f"{log.name}.sig")
    if source is None and reading.get("mapping") is not None:
        raise UsageError("--mapping applies to the source of the log; add --source SOURCE")
    annotated = open_source(log)
    original = None
    if source is not None:
        # options of the command line have precedence over recorded options
        options = ReadOptions(**reading).non_defaults()
        original = open_source(source, **{**reading, **recorded_reading(annotated, source.name), **options})
    with progress("samples") as advance:
        verification = verify_certificate(annotated, original, advance, explain=explain)
    faults = list(verification.faults)
    differences = [f"{log.name}: {difference}" for difference in verification.differences]
    if verification.recorded and not differences:
        show(f"{log.name}: samples, messages, specifications and results match")
        show(*(f"{log.name}: {note}" for note in verification.notes if not decisions))
    if decisions:
        plan_log = annotated if original is None else original
        with progress("samples") as advance:
            recomputed = recompute_decisions(plan_log, advance)
        faults += counted_from(recomputed.faults, known_zero_ns(plan_log) if recomputed.faults else 0)
        differences += [f"{plan_log.name}: {difference}" for difference in recomputed.differences]
        if not recomputed.differences:
            show(
                f"{plan_log.name}: {plural(recomputed.decisions, 'decision')} recomputed with "
                f"{plural(recomputed.maps, 'map')}, all match"
            )
    warn(*dict.fromkeys(faults))
    for difference in differences:
        show(difference)
    show(*(f"  {line}" for line in verification.explanation))
    if signer is not None and verification.recorded:
        signer_name = signer_of(verification.recorded, signature, signer)
        if signer_name is None:
            differences.append("the signature")
            show(
                f"{log.name}: {signature.name} is no signature of its certificate by anyone in {signer.name}"
            )
        else:
            show(f"{log.name}: its certificate is signed by {signer_name}")
    if sign is not None and differences:
        warn(f"{log.name} was not signed, because its certificate does not match")
    elif sign is not None:
        with replacing(signature, local_files([log, sign])) as stream:
            stream.write(sign_certificate(verification.recorded, sign))
        show(f"{log.name}: signed in {signature}")
    return ExitCode.VIOLATED if differences else ExitCode.SATISFIED
