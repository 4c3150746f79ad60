"""`check --dfa`: automata on standard output, or in a file of the kind that its name says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import MappingProxyType

import click

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compiling import automaton, chosen_spec
from spatial_replay.automata.drawing import dot_text, hoa_text, size_words, svg_text, words_text
from spatial_replay.cli.options import refuse_several
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.logs.output import refuse_inputs, replacing
from spatial_replay.spec.formula import Specification

STANDARD_OUTPUT = "-"

_TEXTS: MappingProxyType[str, Callable[[Automaton], str]] = MappingProxyType(
    {".dot": dot_text, ".hoa": hoa_text, ".svg": svg_text}
)


def show_automata(
    specification: Specification,
    name: str | None,
    file: str,
    inputs: Sequence[Path] = (),
    *,
    quiet: bool = False,
) -> None:
    """Write the automaton of a spec to a file; to standard output, in words, those of all results.

    What is asked for has passed `refuse_automata`.

    Args:
        name: which spec.
        file: "-", or a file that ends in .dot, .hoa or .svg.
        inputs: files that the output must not be.
        quiet: leave standard output to others.

    Raises:
        NoAutomatonError: one has none; if several are shown, after the others.
        UsageError: there is no Graphviz to draw with.
        OutputError: the file cannot be written.
    """
    if file == STANDARD_OUTPUT:
        _show(specification, [name] if name else [spec.name for spec in specification.results])
        return
    path = Path(file)
    chosen = automaton(specification, name)
    text = _TEXTS[path.suffix](chosen)
    with replacing(path, inputs) as stream:
        stream.write(text.encode())
    click.echo(f"wrote {path}: {size_words(chosen)}", err=quiet)


def refuse_automata(
    specification: Specification, name: str | None, file: str, inputs: Sequence[Path] = ()
) -> None:
    """That `show_automata` can do what it is asked for, as far as options tell.

    Raises:
        UsageError: a file of another ending or one that is an input, no such spec, several to choose from.
    """
    if name is not None:
        chosen_spec(specification, name)
    if file == STANDARD_OUTPUT:
        return
    path = Path(file)
    if path.suffix not in _TEXTS:
        raise UsageError(
            f"{file}: write an automaton to a file that ends in .dot, .hoa or .svg, or in words to -"
        )
    refuse_several(specification, name)
    refuse_inputs(path, inputs)


def _show(specification: Specification, names: Sequence[str]) -> None:
    faults = []
    for name in names:
        try:
            click.echo("\n" + words_text(automaton(specification, name)))
        except NoAutomatonError as error:
            faults.append(str(error))
    if faults:
        raise NoAutomatonError("\n".join(faults))
