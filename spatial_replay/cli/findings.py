"""Errors and warnings about a specification, for programs that show them at its lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeAlias
from urllib.parse import quote

import click

from spatial_replay import __version__
from spatial_replay.cli.terminal import PROGRAM, show, show_json
from spatial_replay.errors import Diagnosis, SpecificationError

Form: TypeAlias = Literal["text", "github", "sarif"]

finding_format_option = click.option(
    "--format",
    "form",
    type=click.Choice(["text", "github", "sarif"]),
    default="text",
    help="Print only errors and warnings, for GitHub's annotations or for code scanning.  [default: text]",
)


@contextmanager
def findings_of(specification: str, form: Form) -> Iterator[None]:
    """Print the errors of a specification that cannot be parsed in the form that was asked for, too."""
    try:
        yield
    except SpecificationError as error:
        show_findings(form, specification, error.diagnoses)
        raise


def show_findings(form: Form, path: str, diagnoses: Sequence[Diagnosis]) -> None:
    """Print errors and warnings as workflow commands of GitHub, or as one SARIF object; not as text.

    Args:
        path: the file that they are about, or its address, as it was given.
    """
    if form == "github":
        # imported here so that --help stays fast
        from spatial_replay.batch.outputs import annotation, repository_path

        for each in diagnoses:
            file = repository_path(path)
            show(annotation(_level(each), file, each.line, _message(each), column=each.column))
    elif form == "sarif":
        from spatial_replay.batch.outputs import repository_path

        show_json(_sarif(repository_path(path), diagnoses))


def _level(diagnosis: Diagnosis) -> Literal["error", "warning"]:
    return "warning" if getattr(diagnosis, "severity", "error") == "warning" else "error"


def _message(diagnosis: Diagnosis) -> str:
    hint = getattr(diagnosis, "hint", "")
    return f"{diagnosis.message}; {hint}" if hint else diagnosis.message


def _sarif(path: str, diagnoses: Sequence[Diagnosis]) -> dict[str, Any]:
    """Return a SARIF 2.1.0 log with one run."""
    driver = {"name": PROGRAM, "version": __version__, "rules": [{"id": "specification"}]}
    results = [
        {
            "ruleId": "specification",
            "level": _level(each),
            "message": {"text": _message(each)},
            "locations": [
                {
                    "physicalLocation": {
                        "artifactLocation": {"uri": quote(path)},
                        "region": {
                            "startLine": each.line,
                            "startColumn": each.column,
                            "endColumn": each.column + getattr(each, "width", 1),
                        },
                    }
                }
            ],
        }
        for each in diagnoses
    ]
    return {
        "$schema": "https://json.schemastore.org/sarif-2.1.0.json",
        "version": "2.1.0",
        "runs": [{"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}],
    }
