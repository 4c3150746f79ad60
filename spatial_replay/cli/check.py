"""`spatial-replay check`: is this specification right, and how is it read?"""

from __future__ import annotations

import json
from pathlib import Path

import click

from spatial_replay.cli.failures import say
from spatial_replay.cli.options import Reading, profile_option, reading_options
from spatial_replay.cli.progress import progress
from spatial_replay.cli.tree import iter_tree_lines, node_rows
from spatial_replay.errors import SpecificationError, UsageError
from spatial_replay.spec import check_names, load_specification
from spatial_replay.spec.formula import Diagnostic, NamedSpec, Specification


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
        from spatial_replay.cli.automata import refuse_automata

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
        from spatial_replay.cli.automata import show_automata

        show_automata(parsed, of, dfa, inputs, quiet=as_json)


def _compared_with_log(specification: Specification, log: Path, reading: Reading) -> tuple[Diagnostic, ...]:
    # readers of logs load the numerical libraries, which a mere check does without
    from spatial_replay.logs.source import open_source

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
