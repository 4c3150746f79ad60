"""`spatial-replay check` and `doctor`: faults of a specification, its tree, and its automaton."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias
from urllib.parse import quote

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.options import (
    READING_KEYS,
    JsonCommand,
    LogPath,
    constants_option,
    load_spec_options,
    plugin_option,
    reading_options,
    refuse_values,
    require_choice,
    strict_names_option,
)
from spatial_replay.cli.terminal import (
    PROGRAM,
    progress,
    show,
    show_diagnostics,
    show_json,
    show_result,
    warn,
)
from spatial_replay.errors import Diagnosis, NoAutomatonError, OutputError, SpecificationError, UsageError
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.spec import format_formula
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.diagnostics import Diagnostic, SourceText
from spatial_replay.spec.format import iter_branches, label_of, title_text
from spatial_replay.spec.formula import Formula, NamedSpec, Specification, iter_nodes, operator_of
from spatial_replay.spec.tokens import quote_name
from spatial_replay.spec.walks import nodes_of
from spatial_replay.text import Sentence, counted_from, json_fields, plural
from spatial_replay.version import __version__

if TYPE_CHECKING:
    from spatial_replay.logs.read_options import Reading
    from spatial_replay.logs.source import Source
    from spatial_replay.monitor.ends import RunEnds
    from spatial_replay.monitor.plausibility import ThresholdRange
    from spatial_replay.monitor.stream import SeriesBlock
    from spatial_replay.sanity.examine import Examination
    from spatial_replay.trace.doubts import Doubt
    from spatial_replay.trace.trace import Trace


Form: TypeAlias = Literal["text", "github", "sarif"]

finding_format_option = click.option(
    "--format",
    "form",
    type=click.Choice(["text", "github", "sarif"]),
    default="text",
    help="github, sarif: print only errors and warnings, as GitHub annotations or for code scanning."
    "  [default: text]",
)


@contextmanager
def findings_of(specification: str, form: Form) -> Iterator[None]:
    """Also print the errors of an unparsable specification in the requested form."""
    try:
        yield
    except SpecificationError as error:
        show_findings(form, specification, error.diagnoses)
        raise


def show_findings(form: Form, path: str, diagnoses: Sequence[Diagnosis]) -> None:
    """Print errors and warnings as GitHub workflow commands, or as one SARIF object.

    The form "text" prints nothing here.

    Args:
        path: path or address of the specification, as given.
    """
    if form == "github":
        # imported here so that --help stays fast
        from spatial_replay.batch.github import annotation, repository_path

        for diagnosis in diagnoses:
            file = repository_path(path)
            show(
                annotation(
                    _level(diagnosis), file, diagnosis.line, _message(diagnosis), column=diagnosis.column
                )
            )
    elif form == "sarif":
        from spatial_replay.batch.github import repository_path

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
            "level": _level(diagnosis),
            "message": {"text": _message(diagnosis)},
            "locations": [
                {
                    "physicalLocation": {
                        "artifactLocation": {"uri": quote(path)},
                        "region": {
                            "startLine": diagnosis.line,
                            "startColumn": diagnosis.column,
                            "endColumn": diagnosis.column + getattr(diagnosis, "width", 1),
                        },
                    }
                }
            ],
        }
        for diagnosis in diagnoses
    ]
    return {
        "$schema": "https://json.schemastore.org/sarif-2.1.0.json",
        "version": "2.1.0",
        "runs": [{"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}],
    }


_STANDARD_OUTPUT = "-"
_AUTOMATON_FILES = (".dot", ".hoa", ".svg")


@click.command(cls=JsonCommand)
@click.argument("specification", metavar="SPEC", type=LogPath())
@click.option("--log", type=LogPath(), help="Log to compare names, thresholds and windows with.")
@constants_option
@strict_names_option
@plugin_option
@reading_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@finding_format_option
@click.option(
    "--dfa", metavar="FILE|-", help="File for the automaton: .dot, .hoa or .svg; '-' prints it as text."
)
@click.option("--result", "of", metavar="NAME", help="With --dfa: the result, if SPEC has several.")
@click.option(
    "--hz",
    metavar="N",
    type=float,
    help="With --dfa: samples per second, to turn bounds in seconds into samples.",
)
def check(
    specification: LogFile,
    log: LogFile | None,
    constants: Mapping[str, float | str],
    strict_names: bool,
    as_json: bool,
    form: Form,
    dfa: str | None,
    of: str | None,
    hz: float | None,
    reading: Reading,
) -> None:
    """Check a specification and print its tree.

    The tree, with the id of every node, goes to standard output; errors and warnings go to standard error.
    Exits with 0, or with 2 if there is an error.

    \b
    Examples:
      spatial-replay check blocks.spatial --log run.mcap
      spatial-replay check blocks.spatial --dfa blocks.svg
      spatial-replay check blocks.spatial --format github
    """
    # imported here so that --help stays fast
    from spatial_replay.sanity import doctor as examine
    from spatial_replay.spec.checks import last_sample_warnings

    if dfa is None:
        options = {"--result": of is not None, "--hz": hz is not None}
        refuse_values(options, "is for an automaton; add --dfa FILE")
    if as_json and dfa == "-":
        raise UsageError("--json and --dfa - both write to standard output; give --dfa a file")
    if form != "text" and (as_json or dfa == "-"):
        raise UsageError(
            f"--format {form} writes to standard output; remove {'--json' if as_json else '--dfa -'}"
        )
    if log is None:
        _refuse_log_options(reading, strict_names)
    path = str(specification)
    with findings_of(path, form):
        (parsed,) = load_spec_options([specification], constants)
    inputs = local_files([specification] if log is None else [specification, log])
    if dfa is not None:
        _check_automaton_options(parsed, of, dfa, inputs)
    comparison = _compare_with_log(parsed, log, reading, strict_names) if log is not None else _Compared()
    findings = examine(parsed, examples=False).findings
    diagnostics = [
        *parsed.warnings,
        *last_sample_warnings(parsed),
        *comparison.diagnostics,
        *(finding.diagnostic for finding in findings),
    ]
    show_diagnostics(diagnostics)
    show_findings(form, path, diagnostics)
    if any(diagnostic.severity == "error" for diagnostic in diagnostics):
        raise SpecificationError([diagnostic for diagnostic in diagnostics if diagnostic.severity == "error"])
    if form == "text":
        show_result(
            lambda: _document(parsed, diagnostics, comparison), lambda: _lines(parsed, comparison), as_json
        )
    if dfa is not None:
        _write_automata(parsed, of, dfa, inputs, hz, quiet=as_json)


@dataclass(frozen=True, slots=True)
class _Compared:
    """Findings of a comparison with a log.

    Attributes:
        diagnostics: errors and warnings.
        windows: time windows in samples, converted to seconds.
        ranges: ranges of the numbers that are compared with thresholds.
        summary: summary in one line.
    """

    diagnostics: tuple[Diagnostic, ...] = ()
    windows: Sequence[str] = ()
    ranges: Sequence[ThresholdRange] = ()
    summary: str = ""


def _refuse_log_options(reading: Reading, strict_names: bool) -> None:
    """Refuse options about a log if no log is given."""
    for name in [*reading, *(["strict_names"] if strict_names else [])]:
        option = f"--read {name}" if name in READING_KEYS else f"--{name.replace('_', '-')}"
        raise UsageError(f"{option} applies to the log to compare with; add --log LOG")


def _compare_with_log(
    specification: Specification, log: LogFile, reading: Reading, strict_names: bool
) -> _Compared:
    """Compare names, thresholds, regions and windows with the contents of a log."""
    # only needed with --log: log readers load the numerical libraries
    from spatial_replay.monitor.ends import Needs, RunEnds
    from spatial_replay.monitor.plausibility import LogNumbers, plausibility_warnings, window_lines
    from spatial_replay.replay.selection import LogNames, Window, log_zero_ns
    from spatial_replay.sources.open_log import open_source

    source = open_source(log, **reading)
    specification = with_numbers(specification, source.axes.units)
    log_numbers, log_names = LogNumbers(specification), LogNames()
    cut_results = _CutResults(specification)
    run_ends = RunEnds(Needs.of([specification], {}))
    faults: list[str] = []
    doubts: list[Doubt] = []

    def compare(traces: Iterable[Trace]) -> None:
        for trace in traces:
            log_numbers.add(trace)
            cut_results.add(trace)

    with progress("samples") as advance:
        for block in source.keeping().iter_blocks():
            log_names.add(block.trace)
            compare(run_ends.add(block.trace))
            faults += block.trace.faults
            doubts += block.doubts
            advance(len(block.trace))
    compare(run_ends.finish())
    remarks = [doubt.remark(source.name) for doubt in dict.fromkeys(doubts)]
    remarks += [Sentence(f"{source.name}: ", remark) for remark in run_ends.remarks]
    zero_ns = log_zero_ns(source, Window(), run_ends)
    warn(*counted_from((*faults, *remarks), zero_ns))
    unknown_names = log_names.check(specification, {})
    missing_count = sum(diagnostic.severity == "error" for diagnostic in unknown_names)
    if not strict_names:
        unknown_names = tuple(replace(diagnostic, severity="warning") for diagnostic in unknown_names)
    log_warnings = (
        *plausibility_warnings(specification, log_numbers, zero_ns),
        *cut_results.warnings(source, run_ends, zero_ns),
    )
    count_texts = [plural(missing_count, "name") + " that it never has"] if missing_count else []
    other_count = len(unknown_names) - missing_count + len(log_warnings)
    count_texts += (
        [plural(other_count, "other warning" if missing_count else "warning")] if other_count else []
    )
    summary = (
        f"compared with {plural(log_numbers.samples, 'sample')} of {source.name} over "
        f"{log_numbers.seconds:.3f} s: "
    )
    return _Compared(
        (*unknown_names, *log_warnings),
        window_lines(specification, log_numbers),
        log_numbers.ranges,
        summary + (" and ".join(count_texts) or "all names, thresholds and windows fit"),
    )


class _CutResults:
    """Finds results whose deciding window is cut by the end of the log. Templates are left out."""

    def __init__(self, specification: Specification) -> None:
        # only needed with --log: the monitor loads the numerical libraries
        from spatial_replay.monitor.stream import EvaluationStream, find_instances
        from spatial_replay.trace.trace import FOREVER

        self._specification = specification
        plain_specs = tuple(spec for spec in specification.specs if spec.parameter is None)
        instances = find_instances(replace(specification, specs=plain_specs), {}, [], 0, FOREVER)
        self._stream = EvaluationStream(instances, specification.regions)
        self._blocks_by_instance: list[list[SeriesBlock]] = [[] for _ in instances]

    def add(self, trace: Trace) -> None:
        """Evaluate the next samples."""
        for blocks, block in zip(self._blocks_by_instance, self._stream.extend(trace), strict=True):
            # only leaves are needed; an empty view instead of a copy would keep the whole series in memory
            blocks.append(replace(block, series=block.series[..., :0].copy()))

    def warnings(self, source: Source, ends: RunEnds, zero_ns: int) -> Iterator[Diagnostic]:
        """Yield a warning for each result with a cut window. The zero of printed times is `zero_ns`."""
        from spatial_replay.monitor.result import SpecResult
        from spatial_replay.monitor.stream import join_blocks
        from spatial_replay.monitor.witness.evidence import Evidence

        def traces() -> Iterator[Trace]:
            return (ends.trim(block.trace) for block in source.keeping().iter_blocks())

        specification, units = self._specification, source.axes.units
        source_text = SourceText.of(specification.source, specification.filename)
        for stream, blocks in zip(self._stream.streams, self._blocks_by_instance, strict=True):
            if not len(stream):
                continue
            evidence = Evidence(stream.instance, specification.regions, traces, units, zero_ns)
            result = SpecResult.from_stream(stream, evidence, join_blocks(blocks), has_series=False)
            for part in result.untested if result.tested == "cut" else ():
                node = nodes_of(result.formula)[part.node or 0]
                message = f"{result.name} would be {result.verdict}: {str(part.message).removesuffix('.')}"
                hint = "record a longer log; `replay --fail-on cut` fails such a result"
                yield source_text.diagnostic("warning", node.span, message, hint)


def _heading(spec: NamedSpec) -> str:
    head = f"spec {spec.name}" if spec.parameter is None else f"spec {spec.name}({spec.parameter})"
    return head if spec.title is None else f"{head} {quote_name(title_text(spec))}"


def _lines(specification: Specification, comparison: _Compared) -> Iterator[str]:
    for index, spec in enumerate(specification.results):
        if index:
            yield ""
        yield _heading(spec)
        branches = list(iter_branches(spec.formula))
        id_width = len(str(len(branches) - 1))
        for node_id, branch_lines, node in branches:
            yield f"  {node_id:>{id_width}}  {branch_lines}{label_of(node)}"
    if comparison.summary:
        yield from ("", *comparison.windows, *map(str, comparison.ranges), comparison.summary)


def _document(
    specification: Specification, diagnostics: list[Diagnostic], comparison: _Compared
) -> dict[str, object]:
    return {
        "file": specification.filename,
        "profile": specification.profile,
        "specifications": [
            {
                **json_fields(spec, "name", "parameter", "title"),
                "requirement": spec.id,
                "nodes": _node_rows(spec.formula),
            }
            for spec in specification.results
        ],
        "constants": {
            name: json_fields(constant, "value", "duration_ns", "range")
            for name, constant in specification.constants.items()
        },
        "windows": list(comparison.windows),
        "thresholds": [
            {
                "atom": atom_range.atom.text,
                **json_fields(atom_range, "objects", "known", "holding", "failing", "empty"),
                **json_fields(atom_range, "least", "greatest"),
                **({} if atom_range.least <= atom_range.greatest else {"least": None, "greatest": None}),
            }
            for atom_range in comparison.ranges
        ],
        "warnings": [
            json_fields(diagnostic, "line", "column", "message", "hint") for diagnostic in diagnostics
        ],
    }


def _node_rows(formula: Formula) -> list[dict[str, object]]:
    """Return the nodes as rows of a table: id, parent, operator, name, text."""
    columns = ("id", "parent", "operator", "name", "text")
    nodes = iter_nodes(formula)
    rows = ((*ids, operator_of(node), node.name, format_formula(node)) for *ids, node in nodes)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def _check_automaton_options(
    specification: Specification, spec_name: str | None, file: str, inputs: Sequence[Path]
) -> None:
    """Check the options of `_write_automata` before anything is printed.

    Raises:
        UsageError: the file type is unknown, the file is an input, or the spec is missing or ambiguous.
    """
    from spatial_replay.automata.compile import chosen_spec
    from spatial_replay.logs.output_file import refuse_inputs

    if spec_name is not None:
        chosen_spec(specification, spec_name)
    if file == _STANDARD_OUTPUT:
        return
    path = Path(file)
    if path.suffix not in _AUTOMATON_FILES:
        raise UsageError(f"{file}: automata are written to .dot, .hoa or .svg files, or as text to -")
    require_choice(specification, spec_name)
    refuse_inputs(path, inputs)


def _write_automata(
    specification: Specification,
    spec_name: str | None,
    file: str,
    inputs: Sequence[Path],
    hz: float | None,
    *,
    quiet: bool,
) -> None:
    """Write the automaton of one spec to a file, or print the automata of all results.

    Args:
        quiet: whether the message about the file goes to standard error.

    Raises:
        NoAutomatonError: a spec has no automaton; raised after all other automata are printed.
        UsageError: Graphviz is not installed.
        OutputError: the file cannot be written.
    """
    from spatial_replay.automata.automaton import Automaton, size_words
    from spatial_replay.automata.compile import automaton, chosen_spec
    from spatial_replay.automata.drawing import svg_text
    from spatial_replay.automata.ltlf import bounds_in_samples
    from spatial_replay.logs.output_file import replacing

    if file == _STANDARD_OUTPUT:
        spec_names = [spec_name] if spec_name else [spec.name for spec in specification.results]
        _print_automata(specification, spec_names, hz)
        return
    path = Path(file)
    dfa = automaton(specification, spec_name, rate_hz=hz)
    writers = Automaton.to_dot, Automaton.to_hoa, svg_text
    automaton_text = dict(zip(_AUTOMATON_FILES, writers, strict=True))[path.suffix](dfa)
    with replacing(path, inputs) as stream:
        stream.write(automaton_text.encode())
    show(f"wrote {path}: {size_words(dfa)}", err=quiet)
    bounds = "" if hz is None else bounds_in_samples(chosen_spec(specification, spec_name).formula, hz)
    if bounds:
        show(bounds, err=quiet)


def _print_automata(specification: Specification, spec_names: Sequence[str], hz: float | None) -> None:
    from spatial_replay.automata.automaton import words_text
    from spatial_replay.automata.compile import automaton, chosen_spec
    from spatial_replay.automata.ltlf import bounds_in_samples

    faults = []
    for spec_name in spec_names:
        try:
            automaton_text = words_text(automaton(specification, spec_name, rate_hz=hz))
            bounds = (
                "" if hz is None else bounds_in_samples(chosen_spec(specification, spec_name).formula, hz)
            )
            show("", *automaton_text.split("\n"), *([bounds] if bounds else []))
        except NoAutomatonError as error:
            faults.append(str(error))
    if faults:
        raise NoAutomatonError("\n".join(faults))


_UNSAFE: Final = re.compile(r"[^\w-]+")


@click.command(cls=JsonCommand)
@click.argument("specification", metavar="SPEC", type=LogPath())
@constants_option
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
    output: Path | None,
    as_json: bool,
    form: Form,
) -> int:
    """Find faults of a specification before any run.

    Faults are specs that no run can satisfy, that every run satisfies, or that follow from another spec or
    contradict it. Implications whose antecedent never holds are faults, too. Automata and laws of geometry
    prove the faults. For each result, the command prints the shortest satisfying run and the shortest
    violating run. Exits with 1 if there is a fault, otherwise with 0.

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
    path = str(specification)
    with findings_of(path, form):
        (parsed,) = load_spec_options([specification], constants)
    examination = examine(parsed, examples=form == "text" or output is not None)
    files = {} if output is None else _write(examination, output, local_files([specification]))
    show_findings(form, path, [finding.diagnostic for finding in examination.findings])
    if as_json:
        show_json({"file": parsed.filename, **examination.document})
    elif form == "text":
        show(*examination.lines(files))
    return ExitCode.VIOLATED if examination.findings else ExitCode.SATISFIED


def _write(examination: Examination, output: Path, inputs: list[Path]) -> dict[tuple[str, str], Path]:
    """Write the samples of all examples; return the files by spec and verdict."""
    from spatial_replay.logs.output_file import replacing

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be made: {error.strerror}; choose another folder") from error
    files: dict[tuple[str, str], Path] = {}
    stem_counts: Counter[str] = Counter()
    for spec in examination.specs:
        file_stem = _UNSAFE.sub("-", spec.name).strip("-") or "spec"
        stem_counts[file_stem] += 1
        if stem_counts[file_stem] > 1:
            file_stem += f"-{stem_counts[file_stem]}"
        for example in (spec.satisfied, spec.violated):
            if example is not None and example.samples is not None:
                path = output / f"{file_stem}.{example.verdict}.jsonl"
                with replacing(path, inputs) as stream:
                    stream.write(example.jsonl.encode())
                files[spec.name, example.verdict] = path
    return files
