"""`spatial-replay doctor`: what is wrong with a specification before any run."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.check import Form, finding_format_option, findings_of, show_findings
from spatial_replay.cli.options import (
    JsonCommand,
    LogPath,
    constants_option,
    load_spec_options,
    profile_option,
)
from spatial_replay.cli.terminal import show, show_json
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.logs.remote import LogFile, local_files

if TYPE_CHECKING:
    from spatial_replay.sanity.examine import Examination

_UNSAFE: Final = re.compile(r"[^\w-]+")


@click.command(cls=JsonCommand)
@click.argument("specification", metavar="SPEC", type=LogPath())
@constants_option
@profile_option
@click.option(
    "-o",
    "--output",
    metavar="DIR/",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the shortest runs, as tracks (JSONL).",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@finding_format_option
def doctor(
    specification: LogFile,
    constants: Mapping[str, float | str],
    profile: str | None,
    output: Path | None,
    as_json: bool,
    form: Form,
) -> int:
    """Find what is wrong with a specification before any run.

    Finds specs that no run can satisfy, that every run satisfies, that follow from another one or contradict
    it. It also finds implications whose antecedent never holds. It uses the automaton and laws of geometry.
    For each result prints the shortest run that satisfies it, and the shortest that violates it. Exits with 1
    if it finds something, otherwise with 0.

    \b
    Examples:
      spatial-replay doctor blocks.spatial
      spatial-replay doctor blocks.spatial -o examples
      spatial-replay doctor blocks.spatial --format github
    """
    # imported here so that --help stays fast
    from spatial_replay.sanity import doctor as examine

    if form != "text" and as_json:
        raise UsageError(f"--format {form} writes to standard output; remove --json")
    shown = str(specification)
    with findings_of(shown, form):
        (parsed,) = load_spec_options([specification], profile, constants)
    found = examine(parsed, examples=form == "text" or output is not None)
    files = {} if output is None else _write(found, output, local_files([specification]))
    show_findings(form, shown, [each.diagnostic for each in found.findings])
    if as_json:
        show_json({"file": parsed.filename, **found.document})
    elif form == "text":
        show(*found.lines(files))
    return ExitCode.VIOLATED if found.findings else ExitCode.SATISFIED


def _write(found: Examination, output: Path, inputs: list[Path]) -> dict[tuple[str, str], Path]:
    """Write the samples of all examples; return the files."""
    from spatial_replay.logs.output_file import replacing

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be made: {error.strerror}; choose another folder") from error
    files: dict[tuple[str, str], Path] = {}
    stems: Counter[str] = Counter()
    for spec in found.specs:
        stem = _UNSAFE.sub("-", spec.name).strip("-") or "spec"
        stems[stem] += 1
        if stems[stem] > 1:
            stem += f"-{stems[stem]}"
        for example in (spec.satisfied, spec.violated):
            if example is not None and example.samples is not None:
                path = output / f"{stem}.{example.verdict}.jsonl"
                with replacing(path, inputs) as stream:
                    stream.write(example.jsonl.encode())
                files[spec.name, example.verdict] = path
    return files
