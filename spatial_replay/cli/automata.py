"""`check --dfa`: automata on standard output, or in a file of the kind that its name says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from spatial_replay.automata.compiling import automaton
from spatial_replay.automata.drawing import dot_text, hoa_text, size_words, svg_text, words_text
from spatial_replay.cli.options import refuse_several
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.logs.output import replacing
from spatial_replay.spec.formula import Specification

STANDARD_OUTPUT = "-"


def show_automata(
    specification: Specification,
    name: str | None,
    file: str,
    inputs: Sequence[Path] = (),
    *,
    quiet: bool = False,
) -> None:
    """Write the automaton of a spec to a file; to standard output, in words, those of all results.

    Args:
        name: which spec.
        file: "-", or a file that ends in .dot, .hoa or .svg.
        inputs: files that the output must not be.
        quiet: leave standard output to others.

    Raises:
        NoAutomatonError: one has none; if several are shown, after the others.
        UsageError: a file of another ending, no such spec, several to choose from.
        OutputError: the file cannot be written.
    """
    if file == STANDARD_OUTPUT:
        _show(specification, [name] if name else [spec.name for spec in specification.results])
        return
    written = {".dot": dot_text, ".hoa": hoa_text, ".svg": svg_text}
    path = Path(file)
    if path.suffix not in written:
        raise UsageError(
            f"{file}: write an automaton to a file that ends in .dot, .hoa or .svg, or in words to -"
        )
    refuse_several(specification, name)
    chosen = automaton(specification, name)
    text = written[path.suffix](chosen)
    with replacing(path, inputs) as stream:
        stream.write(text.encode())
    click.echo(f"wrote {path}: {size_words(chosen)}", err=quiet)


def _show(specification: Specification, names: Sequence[str]) -> None:
    faults = []
    for name in names:
        try:
            click.echo("\n" + words_text(automaton(specification, name)))
        except NoAutomatonError as error:
            faults.append(str(error))
    if faults:
        raise NoAutomatonError("\n".join(faults))
