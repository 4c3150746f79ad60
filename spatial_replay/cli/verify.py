"""`spatial-replay verify`: recompute a log's certificate and compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import LogPath, plugin_option, reading_options
from spatial_replay.cli.terminal import progress, show, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted, counted_from

if TYPE_CHECKING:
    from spatial_replay.logs.read_options import Reading


@click.command()
@click.argument("log", type=LogPath())
@click.option(
    "--source",
    metavar="SOURCE",
    type=LogPath(),
    help="Evaluate the log that LOG was made from instead of LOG.",
)
@click.option("--decisions", is_flag=True, help="Also recompute the decisions of a planned run.")
@click.option("--explain", is_flag=True, help="Say which part differs, and where first.")
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
@plugin_option
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
    """Recompute a log's certificate and compare it with the recorded one.

    The log is evaluated with its own specifications and options. With --decisions, every planner decision is
    recomputed from the recorded samples, with all its maps, and compared bit for bit; with --source, the
    decisions in the source. With --sign, a certificate that is right is signed with your SSH key, into
    LOG.sig; with --signer, this signature is checked. Exits with 0 if all is equal, otherwise with 1.

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
    from spatial_replay.replay.selection import known_start_ns
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
    own = open_source(log)
    original = None
    if source is not None:
        # what is given here has precedence over what the log was made with
        given = ReadOptions(**reading).given()
        original = open_source(source, **{**reading, **recorded_reading(own, source.name), **given})
    with progress("samples") as advance:
        verified = verify_certificate(own, original, advance, explain=explain)
    faults = list(verified.faults)
    differences = [f"{log.name}: {each}" for each in verified.differences]
    if verified.recorded and not differences:
        show(f"{log.name}: samples, messages, specifications and results match")
        show(*(f"{log.name}: {each}" for each in verified.notes if not decisions))
    if decisions:
        planned = own if original is None else original
        with progress("samples") as advance:
            recomputed = recompute_decisions(planned, advance)
        faults += counted_from(recomputed.faults, known_start_ns(planned) if recomputed.faults else 0)
        differences += [f"{planned.name}: {each}" for each in recomputed.differences]
        if not recomputed.differences:
            show(
                f"{planned.name}: {counted(recomputed.decisions, 'decision')} recomputed with "
                f"{counted(recomputed.maps, 'map')}, all match"
            )
    warn(*dict.fromkeys(faults))
    for difference in differences:
        show(difference)
    show(*(f"  {line}" for line in verified.explanation))
    if signer is not None and verified.recorded:
        signed_by = signer_of(verified.recorded, signature, signer)
        if signed_by is None:
            differences.append("the signature")
            show(
                f"{log.name}: {signature.name} is no signature of its certificate by anyone in {signer.name}"
            )
        else:
            show(f"{log.name}: its certificate is signed by {signed_by}")
    if sign is not None and differences:
        warn(f"{log.name} was not signed: only a log whose certificate is right is")
    elif sign is not None:
        with replacing(signature, local_files([log, sign])) as stream:
            stream.write(sign_certificate(verified.recorded, sign))
        show(f"{log.name}: signed in {signature}")
    return ExitCode.VIOLATED if differences else ExitCode.SATISFIED
