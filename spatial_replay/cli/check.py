"""`spatial-replay check`: parse a specification; print its tree, or write its automaton."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import click

from spatial_replay.cli.application import warn
from spatial_replay.cli.options import (
    ReadArguments,
    constants_option,
    load_spec_options,
    profile_option,
    reading_options,
    require_choice,
)
from spatial_replay.cli.progress import progress
from spatial_replay.errors import NoAutomatonError, SpecificationError, UsageError
from spatial_replay.spec import check_names, format_formula
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import iter_branches, label_of, title_text
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operator_of
from spatial_replay.spec.tokens import quoted

_STANDARD_OUTPUT = "-"
_AUTOMATON_FILES = (".dot", ".hoa", ".svg")


@click.command()
@click.argument("specification", metavar="SPEC", type=click.Path(path_type=Path))
@click.option(
    "--log",
    type=click.Path(path_type=Path),
    help="Log whose objects and signals to compare names with.",
)
@constants_option
@profile_option
@reading_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@click.option(
    "--dfa",
    metavar="FILE|-",
    help="Automaton to write, as .dot, .hoa or .svg; - prints it as text.",
)
@click.option("--of", metavar="NAME", help="With --dfa: which result, if SPEC has several.")
def check(
    specification: Path,
    log: Path | None,
    constants: Mapping[str, float | str],
    profile: str | None,
    as_json: bool,
    dfa: str | None,
    of: str | None,
    reading: ReadArguments,
) -> None:
    """Check a specification and print its tree.

    The tree, with the id of every node, goes to standard output; errors and warnings go to standard error.
    Exits with 0, or with 2 if there is an error.

    \b
    Examples:
      spatial-replay check blocks.spatial --log run.mcap
      spatial-replay check blocks.spatial --dfa blocks.svg
    """
    if of is not None and dfa is None:
        raise UsageError("--of chooses an automaton; add --dfa FILE")
    if as_json and dfa == "-":
        raise UsageError("--json and --dfa - both write to standard output; give --dfa a file")
    if log is None and reading["mapping"] is not None:
        raise UsageError("--mapping applies to the log to compare with; add --log LOG")
    (parsed,) = load_spec_options([specification], profile, constants)
    inputs = [specification] if log is None else [specification, log]
    if dfa is not None:
        _check_automaton_options(parsed, of, dfa, inputs)
    compared, windows = _compare_with_log(parsed, log, reading) if log is not None else ((), ())
    diagnostics = [*parsed.warnings, *compared]
    errors = [each for each in diagnostics if each.severity == "error"]
    for each in diagnostics:
        if each.severity == "warning":
            click.echo(each, err=True)
    if errors:
        raise SpecificationError(errors)
    click.echo(_json_of(parsed, diagnostics, windows) if as_json else _text_of(parsed, windows))
    if dfa is not None:
        _write_automata(parsed, of, dfa, inputs, quiet=as_json)


def _compare_with_log(
    specification: Specification, log: Path, reading: ReadArguments
) -> tuple[tuple[Diagnostic, ...], Sequence[str]]:
    """Return what does not fit the log, and its windows in samples as seconds."""
    # only needed with --log: log readers load the numerical libraries
    from spatial_replay.sources.open_log import open_source
    from spatial_replay.trace.plausibility import LogNumbers, plausibility_warnings, window_lines

    numbers = LogNumbers()
    names: set[str] = set()
    signals: set[str] = set()
    classes: set[str] = set()
    with progress("samples") as advance:
        for block in open_source(log, **reading).iter_blocks():
            names.update(block.trace.names)
            signals.update(block.trace.signals)
            classes.update(name for name in block.trace.classes if name is not None)
            numbers = numbers.extended(block.trace)
            warn(*block.trace.faults)
            advance(len(block.trace))
    unknown = check_names(specification, sorted(names), sorted(signals), classes=sorted(classes))
    doubtful = plausibility_warnings(specification, numbers)
    return (*unknown, *doubtful), window_lines(specification, numbers)


def _heading(spec: NamedSpec) -> str:
    head = f"spec {spec.name}" if spec.parameter is None else f"spec {spec.name}({spec.parameter})"
    return head if spec.title is None else f"{head} {quoted(title_text(spec))}"


def _text_of(specification: Specification, windows: Sequence[str]) -> str:
    blocks = [
        "\n".join([_heading(spec), *(f"  {line}" for line in _tree_lines(spec.formula))])
        for spec in specification.results
    ]
    return "\n\n".join([*blocks, "\n".join(windows)] if windows else blocks)


def _tree_lines(formula: Formula) -> Iterator[str]:
    """Yield a line for each node: its id, the branches down to it, its name and operator."""
    branches = list(iter_branches(formula))
    width = len(str(len(branches) - 1))
    for identifier, stem, node in branches:
        yield f"{identifier:>{width}}  {stem}{label_of(node)}"


def _json_of(specification: Specification, diagnostics: list[Diagnostic], windows: Sequence[str]) -> str:
    return json.dumps(
        {
            "file": specification.filename,
            "profile": specification.profile,
            "specifications": [
                {
                    "name": spec.name,
                    "parameter": spec.parameter,
                    "requirement": spec.id,
                    "title": spec.title,
                    "nodes": _node_rows(spec.formula),
                }
                for spec in specification.results
            ],
            "constants": {
                name: {"value": each.value, "duration_ns": each.duration_ns, "range": each.range}
                for name, each in specification.constants.items()
            },
            "windows": list(windows),
            "warnings": [
                {"line": each.line, "column": each.column, "message": each.message, "hint": each.hint}
                for each in diagnostics
            ],
        },
        indent=2,
        ensure_ascii=False,
    )


def _node_rows(formula: Formula) -> list[dict[str, object]]:
    """Return the nodes as rows of a table: id, parent, operator, name, text."""
    return [
        {
            "id": identifier,
            "parent": parent,
            "operator": operator_of(node),
            "name": node.name,
            "text": format_formula(node),
        }
        for identifier, parent, node in iter_nodes(formula)
    ]


def _check_automaton_options(
    specification: Specification, name: str | None, file: str, inputs: Sequence[Path]
) -> None:
    """Check, before anything is printed, that `_write_automata` can do its work.

    Raises:
        UsageError: an unknown file type, a file that is an input, no such spec, several to choose from.
    """
    from spatial_replay.automata.compile import chosen_spec
    from spatial_replay.logs.output_file import refuse_inputs

    if name is not None:
        chosen_spec(specification, name)
    if file == _STANDARD_OUTPUT:
        return
    path = Path(file)
    if path.suffix not in _AUTOMATON_FILES:
        raise UsageError(f"{file}: automata are written to .dot, .hoa or .svg files, or as text to -")
    require_choice(specification, name)
    refuse_inputs(path, inputs)


def _write_automata(
    specification: Specification, name: str | None, file: str, inputs: Sequence[Path], *, quiet: bool
) -> None:
    """Write the automaton of one spec to a file, or print those of all results.

    Args:
        quiet: keep the message about the file off standard output.

    Raises:
        NoAutomatonError: a spec has none; if several are printed, after the others.
        UsageError: Graphviz is not installed.
        OutputError: the file cannot be written.
    """
    from spatial_replay.automata.compile import automaton
    from spatial_replay.automata.dot_hoa import dot_text, hoa_text, size_words, svg_text
    from spatial_replay.logs.output_file import replacing

    if file == _STANDARD_OUTPUT:
        _print_automata(specification, [name] if name else [spec.name for spec in specification.results])
        return
    path = Path(file)
    chosen = automaton(specification, name)
    text = dict(zip(_AUTOMATON_FILES, (dot_text, hoa_text, svg_text), strict=True))[path.suffix](chosen)
    with replacing(path, inputs) as stream:
        stream.write(text.encode())
    click.echo(f"wrote {path}: {size_words(chosen)}", err=quiet)


def _print_automata(specification: Specification, names: Sequence[str]) -> None:
    from spatial_replay.automata.compile import automaton
    from spatial_replay.automata.dot_hoa import words_text

    faults = []
    for name in names:
        try:
            click.echo("\n" + words_text(automaton(specification, name)))
        except NoAutomatonError as error:
            faults.append(str(error))
    if faults:
        raise NoAutomatonError("\n".join(faults))
