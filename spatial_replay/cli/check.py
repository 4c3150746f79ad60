"""`spatial-replay check`: is this specification right, and how is it read?

`check --dfa`: automata on standard output, or in a file of the kind that its name says.

The tree of a formula as lines of text, and as rows for machines.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import MappingProxyType

import click

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton, chosen_spec
from spatial_replay.automata.dot_hoa import dot_text, hoa_text, size_words, svg_text, words_text
from spatial_replay.cli.application import say
from spatial_replay.cli.options import Reading, profile_option, reading_options, refuse_several
from spatial_replay.cli.progress import progress
from spatial_replay.errors import NoAutomatonError, SpecificationError, UsageError
from spatial_replay.logs.output_file import refuse_inputs, replacing
from spatial_replay.spec import check_names, load_specification
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_formula, iter_branches, label_of
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operator_of


def iter_tree_lines(formula: Formula) -> Iterator[str]:
    """One line for each node: its id, branches down to it, its name and what it is."""
    branches = list(iter_branches(formula))
    width = len(str(len(branches) - 1))
    for identifier, stem, node in branches:
        yield f"{identifier:>{width}}  {stem}{label_of(node)}"


def node_rows(formula: Formula) -> list[dict[str, object]]:
    """The nodes as rows of a table: id, parent, operator, name, text."""
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


@click.command()
@click.argument("specification", metavar="SPEC", type=click.Path(path_type=Path))
@click.option("--log", type=click.Path(path_type=Path), help="Also compare names with what this log holds.")
@profile_option
@reading_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@click.option(
    "--dfa",
    metavar="FILE|-",
    help="Write the automaton to a file that ends in .dot, .hoa or .svg; - shows it in words.",
)
@click.option("--of", metavar="NAME", help="Whose automaton it is, where SPEC has several results.")
def check(
    specification: Path,
    log: Path | None,
    profile: str | None,
    as_json: bool,
    dfa: str | None,
    of: str | None,
    reading: Reading,
) -> None:
    """Check a specification and show its tree.

    Faults and warnings go to standard error, the tree with the id of every node to standard output.
    Exits with 0, or with 2 if there is a fault.

    \b
    Example:
      spatial-replay check blocks.spatial --log run.mcap
      spatial-replay check blocks.spatial --dfa blocks.svg
    """
    if of is not None and dfa is None:
        raise UsageError("--of is about an automaton; add --dfa FILE")
    if as_json and dfa == "-":
        raise UsageError("--json and --dfa - both write to standard output; give --dfa a file")
    if log is None and reading["mapping"] is not None:
        raise UsageError("--mapping is about a log to compare with; add --log LOG")
    parsed = load_specification(specification, profile=profile)
    inputs = [specification] if log is None else [specification, log]
    if dfa is not None:
        # a mere check does without what compiles and writes

        refuse_automata(parsed, of, dfa, inputs)
    remarks = [*parsed.warnings, *(_compared_with_log(parsed, log, reading) if log is not None else ())]
    faults = [remark for remark in remarks if remark.severity == "error"]
    for remark in remarks:
        if remark.severity == "warning":
            click.echo(remark, err=True)
    if faults:
        raise SpecificationError(faults)
    click.echo(_json_of(parsed, remarks) if as_json else _text_of(parsed))
    if dfa is not None:
        show_automata(parsed, of, dfa, inputs, quiet=as_json)


def _compared_with_log(specification: Specification, log: Path, reading: Reading) -> tuple[Diagnostic, ...]:
    # readers of logs load the numerical libraries, which a mere check does without
    from spatial_replay.sources.open_log import open_source

    names: set[str] = set()
    signals: set[str] = set()
    with progress("samples") as advance:
        for block in open_source(log, **reading).iter_blocks():
            names.update(block.trace.names)
            signals.update(block.trace.signals)
            for fault in block.trace.faults:
                say("warning", fault, colour="yellow")
            advance(len(block.trace))
    return check_names(specification, sorted(names), sorted(signals))


def _heading(spec: NamedSpec) -> str:
    return f"spec {spec.name}" if spec.parameter is None else f"spec {spec.name}({spec.parameter})"


def _text_of(specification: Specification) -> str:
    blocks = [
        "\n".join([_heading(spec), *(f"  {line}" for line in iter_tree_lines(spec.formula))])
        for spec in specification.results
    ]
    return "\n\n".join(blocks)


def _json_of(specification: Specification, remarks: list[Diagnostic]) -> str:
    return json.dumps(
        {
            "file": specification.filename,
            "profile": specification.profile,
            "specifications": [
                {"name": spec.name, "parameter": spec.parameter, "nodes": node_rows(spec.formula)}
                for spec in specification.results
            ],
            "warnings": [
                {"line": remark.line, "column": remark.column, "message": remark.message, "hint": remark.hint}
                for remark in remarks
            ],
        },
        indent=2,
        ensure_ascii=False,
    )


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
