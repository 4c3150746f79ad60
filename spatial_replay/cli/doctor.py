"""`spatial-replay doctor`: what is wrong with a specification before any run."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

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
from spatial_replay.cli.terminal import Line, show, show_json
from spatial_replay.errors import OutputError, UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted, json_number, number_text

if TYPE_CHECKING:
    from spatial_replay.sanity.examine import Examination, Finding, SpecExamination
    from spatial_replay.sanity.examples import Example

_UNSAFE: Final = re.compile(r"[^\w-]+")
_ENDS: Final[Mapping[str, str]] = MappingProxyType({"unsatisfiable": "satisfied", "always true": "violated"})
"""The verdict that no run has, by the kind of the finding."""


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
    it, and implications whose antecedent never holds: by the automaton and by laws of geometry. For each
    result prints the shortest run that satisfies it, and the shortest that violates it. Exits with 1 if it
    finds something, otherwise with 0.

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
        show_json(_document(parsed.filename, found))
    elif form == "text":
        show(*_lines(found, files))
    return ExitCode.VIOLATED if found.findings else ExitCode.SATISFIED


def _lines(found: Examination, files: Mapping[tuple[str, str], Path]) -> Iterator[Line]:
    for finding in found.findings:
        yield from str(finding.diagnostic).split("\n")
    if found.findings:
        yield ""
    ends = {(each.specs[0], _ENDS[each.kind]) for each in found.findings if each.kind in _ENDS}
    for spec in found.specs:
        yield spec.name
        yield from (f"  {line}" for line in _remarks(spec))
        for verdict, example in (("satisfied", spec.satisfied), ("violated", spec.violated)):
            if (spec.name, verdict) in ends:
                yield f"  {verdict} by no run"
            elif example is not None:
                yield from (f"  {line}" for line in _example(example, files.get((spec.name, verdict))))
            elif spec.reason:
                why = "without an automaton runs are guesses, and none was confirmed"
                yield f"  {verdict}: no run is shown, since {why}"
        yield ""
    yield from found.notes
    if found.findings:
        yield f"{counted(len(found.findings), 'finding')} in {counted(len(found.specs), 'result')}"
    else:
        whole = not any(spec.reason or spec.undecided for spec in found.specs)
        yield "nothing found" if whole else "nothing found in what could be decided"


def _remarks(spec: SpecExamination) -> Iterator[str]:
    """Yield how far a spec was examined."""
    if spec.reason:
        yield f"no automaton: {spec.reason}"
        yield "  examined with its bounds and past operators read loosely: what that excludes is excluded"
    for question in spec.undecided:
        yield f"not decided: {question}"
    for text in spec.unrelated:
        yield f"decided by logic alone, since geometry says nothing about it: {text}"


def _example(example: Example, file: Path | None) -> Iterator[str]:
    length = counted(len(example.sentences), "sample")
    if example.robustness is None:
        yield f"{example.verdict} by {length}, in words only: {example.note}"
    else:
        where = "" if file is None else f": {file}"
        yield f"{example.verdict} by {length}, robustness {number_text(example.robustness)}{where}"
    for number, sentence in enumerate(example.sentences):
        yield f"  {number}  {sentence}"


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


def _document(filename: str, found: Examination) -> dict[str, Any]:
    return {
        "file": filename,
        "findings": [_finding(each) for each in found.findings],
        "specifications": [
            {
                "name": spec.name,
                "automaton": not spec.reason,
                "reason": spec.reason,
                "undecided": spec.undecided,
                "by_logic_alone": spec.unrelated,
                "satisfied": _example_document(spec.satisfied),
                "violated": _example_document(spec.violated),
            }
            for spec in found.specs
        ],
        "notes": found.notes,
    }


def _finding(finding: Finding) -> dict[str, Any]:
    place = finding.diagnostic
    return {
        "kind": finding.kind,
        "specifications": finding.specs,
        "message": place.message,
        "hint": place.hint,
        "reason": finding.reason,
        "exclusions": finding.exclusions,
        "line": place.line,
        "column": place.column,
    }


def _example_document(example: Example | None) -> dict[str, Any] | None:
    if example is None:
        return None
    return {
        "samples": example.sentences,
        "robustness": None if example.robustness is None else json_number(example.robustness),
        "tracks": example.rows,
        "note": example.note,
    }
