"""`spatial-replay info`: the contents of a log."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from spatial_replay.cli.application import ExitCode
from spatial_replay.cli.evidence import evidence_lines
from spatial_replay.cli.options import JsonCommand, LogPath, input_files, output_option, reading_options
from spatial_replay.cli.output import MANY, WORST_FIRST, align_rows
from spatial_replay.cli.terminal import printing_to, progress, show, show_file, show_json, show_result, warn
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile
from spatial_replay.monitor.verdict import counts_text
from spatial_replay.text import counted_from, json_fields, json_value, plural, requirement_text
from spatial_replay.trace.doubts import json_doubt

if TYPE_CHECKING:
    from spatial_replay.logs.mcap.read import LogSummary
    from spatial_replay.logs.read_options import Reading
    from spatial_replay.logs.source import Source
    from spatial_replay.sources.overview import Overview, Survey
    from spatial_replay.spec.formula import NamedSpec
    from spatial_replay.spec.load import SpecificationText

_EXTENSION = "spatial-replay.foxe"
"""File name of the extension for Foxglove and Lichtblick."""
_EPOCH_LIKELY_NS = 10**18
"""Limit in 2001, ns: smaller times count from the start of the run, other times from 1970."""


_OF_MESSAGES = frozenset({"mapping", "on_time_jump", "max_lateness", "max_gap"})
"""Reading options of external logs."""


@click.command(cls=JsonCommand)
@click.argument("log", type=LogPath(), required=False)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
@click.option("--suggest-mapping", is_flag=True, help="Print a first mapping file (YAML) instead.")
@click.option(
    "--fit",
    is_flag=True,
    help="Print the section `requires` of a suite file instead: rates, gaps and known objects.",
)
@click.option(
    "--decisions",
    metavar="[NUMBER]",
    is_flag=False,
    flag_value="",
    help="Print the decisions of a planned run instead; NUMBER selects one decision, in five lines.",
)
@click.option(
    "--specification",
    metavar="[NAME]",
    is_flag=False,
    flag_value="",
    help="Print the recorded specification instead; NAME selects a file or a spec.",
)
@click.option("--layout", is_flag=True, help="Print the layout for a viewer instead.")
@click.option("--panels", is_flag=True, help="With --layout: add the panels of the extension.")
@click.option(
    "--blueprint",
    is_flag=True,
    help="Write a Rerun blueprint to the file of -o instead; an .rrd file also has the log and its scene.",
)
@click.option(
    "--panel",
    is_flag=True,
    help="Write the viewer extension instead, without a LOG: all logs have the same extension.",
)
@output_option("Output file.  [default: standard output; spatial-replay.foxe for --panel]")
@reading_options
def info(
    log: LogFile | None,
    as_json: bool,
    suggest_mapping: bool,
    fit: bool,
    decisions: str | None,
    specification: str | None,
    layout: bool,
    panels: bool,
    blueprint: bool,
    panel: bool,
    output: Path | None,
    reading: Reading,
) -> int:
    """Show the contents of a log: samples, objects, signals, topics, attachments.

    For an external log, it shows the topics and a possible mapping. With a mapping, it shows the mapped
    objects. For a data set, it shows tasks, labels and features. push_v3#2 is the address of one episode.

    The command reads the whole log. The exit code is 0, or 3 for a damaged log. Damage is reported on
    standard error.

    \b
    Examples:
      spatial-replay info annotated.mcap
      spatial-replay info blocks.jsonl.gz --json
      spatial-replay info drive.bag --suggest-mapping -o drive.yaml
      spatial-replay info drive.bag --mapping drive.yaml --fit
      spatial-replay info push_v3 --suggest-mapping -o push.yaml
      spatial-replay info push_v3#2
      spatial-replay info push.mcap --decisions
      spatial-replay info push.mcap --decisions 3
      spatial-replay info annotated.mcap --specification -o used.spatial
      spatial-replay info annotated.mcap --layout -o layout.json
      spatial-replay info annotated.mcap --layout --panels -o layout.json
      spatial-replay info annotated.mcap --blueprint -o run.rbl
      spatial-replay info annotated.mcap --blueprint -o run.rrd
      spatial-replay info --panel
    """
    options = {
        "--suggest-mapping": suggest_mapping,
        "--fit": fit,
        "--decisions": decisions is not None,
        "--specification": specification is not None,
        "--layout": layout,
        "--blueprint": blueprint,
        "--panel": panel,
    }
    given_options = [name for name, is_given in options.items() if is_given]
    if len(given_options) > 1:
        raise UsageError(f"{' and '.join(given_options)} print different things; give one of them")
    if as_json and given_options and decisions is None:
        raise UsageError(f"{given_options[0]} prints no JSON; remove --json")
    if decisions and not decisions.isdecimal():
        raise UsageError(
            f"--decisions takes the number of a decision, not {decisions!r}; name the log before it"
        )
    if panels and not layout:
        raise UsageError("--panels chooses a layout; add --layout")
    if panel and log is not None:
        raise UsageError("--panel writes the extension, which is the same for every log; remove the log")
    if log is None:
        if not panel:
            raise click.MissingParameter(param_hint="'LOG'", param_type="argument")
        from spatial_replay.logs.output_file import replacing

        output = output or Path(_EXTENSION)
        with replacing(output) as stream:
            stream.write(resources.files("spatial_replay.annotate").joinpath(_EXTENSION).read_bytes())
        show(f"wrote {output}")
        return ExitCode.SATISFIED
    if blueprint:
        return _write_blueprint(log, output)
    with printing_to(output, input_files(log, reading=reading)):
        code = _print_data_set(log, as_json, suggest_mapping, given_options, reading)
        if code is not None:
            return code
        if layout:
            return _print_layout(log, panels=panels)
        if specification is not None:
            return _print_specification(log, specification)
        if decisions is not None:
            return _print_decisions(log, decisions, as_json)
        if suggest_mapping:
            return _print_mapping(log)
        if fit:
            return _print_fitness(log, reading)
        return _print_overview(log, as_json, reading)


def _print_data_set(
    log: LogFile, as_json: bool, suggest_mapping: bool, given_options: Sequence[str], reading: Reading
) -> int | None:
    """Print the contents of a data set, or of an episode without a mapping; None for other logs.

    Raises:
        UsageError: only single episodes have the requested content.
    """
    from spatial_replay.cli.data_sets import show_data_set, show_episode
    from spatial_replay.logs.formats.datasets import data_set_address, open_data_set

    if not isinstance(log, Path):
        return None
    path, episode_number = data_set_address(log) or (log, None)
    data_set = open_data_set(path)
    if data_set is None:
        return None
    if suggest_mapping:
        from spatial_replay.mapping.suggest_features import suggest_feature_mapping

        show_file(suggest_feature_mapping(data_set))
        return ExitCode.SATISFIED
    if episode_number is None:
        if given_options or reading.get("mapping") is not None:
            first_number = data_set.episodes[0].number if data_set.episodes else 0
            option = given_options[0] if given_options else "--mapping"
            raise UsageError(f"{option} is about one episode; give its address: {path}#{first_number}")
        return show_data_set(data_set, as_json)
    if given_options or reading.get("mapping") is not None or data_set.names_bodies:
        return None
    return show_episode(data_set, episode_number, as_json)


def _print_overview(log: LogFile, as_json: bool, reading: Reading) -> int:
    # imported here so that --help stays fast
    from spatial_replay.logs.read_options import ReadOptions
    from spatial_replay.sources.open_log import open_source
    from spatial_replay.sources.overview import messages_in, overview_of, overview_of_survey, survey

    reader = messages_in(log)
    surveyed, specs, episode_facts = None, {}, {}
    if reader is not None:
        with progress("messages") as advance:
            surveyed = survey(reader, advance)
    if surveyed is not None and reading.get("mapping") is None:
        ReadOptions(**reading).refuse_except(_OF_MESSAGES, surveyed.kind, surveyed.name)
        overview = overview_of_survey(log, surveyed)
    else:
        with progress("samples") as advance:
            source = open_source(log, **reading)
            overview = overview_of(source, advance)
        specs, episode_facts = _requirements(source), _episode_facts(source)
    faults = tuple(dict.fromkeys((*overview.faults, *(surveyed.faults if surveyed else ()))))
    remarks = (*(surveyed.remarks if surveyed else ()), *overview.remarks)
    faults, remarks = (counted_from(texts, overview.start_ns or 0) for texts in (faults, remarks))
    warn(*dict.fromkeys((*faults, *remarks)))

    def lines() -> Iterator[str]:
        heading, *other_lines = _lines(overview, surveyed, bool(faults), specs)
        yield heading
        yield from (f"{name:<8} {fact}" for name, fact in episode_facts.items() if fact is not None)
        yield from other_lines

    show_result(lambda: {**_document(overview, surveyed, faults, specs), **episode_facts}, lines, as_json)
    return ExitCode.DAMAGED if faults else ExitCode.SATISFIED


def _episode_facts(source: Source) -> dict[str, str | None]:
    """Return the task and the label of a data set's episode. Other logs have neither."""
    from spatial_replay.mapping.episode_source import EpisodeSource

    if not isinstance(source, EpisodeSource):
        return {}
    label = source.columns().label
    task = source.data_set.episode(source.number).task
    return {"task": task, "label": None if label is None else "success" if label else "failure"}


def _print_decisions(log: LogFile, number: str, as_json: bool) -> int:
    """Print all decisions of a planned run; a number selects one decision."""
    from spatial_replay.planning.read import read_decisions
    from spatial_replay.replay.selection import known_zero_ns
    from spatial_replay.sources.open_log import open_source

    recorded = read_decisions(log)
    warn(*counted_from(recorded.faults, known_zero_ns(open_source(log)) if recorded.faults else 0))
    if number:
        recorded = recorded._replace(decisions=(recorded.decision(int(number)),))
    if as_json:
        show_json(recorded.document)
    else:
        show(*(recorded.brief(int(number)) if number else recorded.lines()))
    return ExitCode.DAMAGED if recorded.faults else ExitCode.SATISFIED


def _print_fitness(log: LogFile, reading: Reading) -> int:
    """Print the section `requires` of a suite, with the rates, gaps and objects of this log."""
    from spatial_replay.sources.open_log import open_source
    from spatial_replay.sources.overview import Regularity, fitness_of

    def rows(regularities: Mapping[str, Regularity]) -> Iterator[str]:
        for name, regularity in regularities.items():
            # a message that comes once, such as a map, has no rate
            rate, max_gap = regularity.rate, regularity.max_gap
            rate_text = f"rate: {rate:g}, max_gap: {max_gap:g}s" if rate else ""
            yield f"{name}: {{{rate_text}}}  # {regularity.count:,}"

    with progress("messages"):
        fitness = fitness_of(log, open_source(log, **reading))
    topics = {json.dumps(name, ensure_ascii=False): regularity for name, regularity in fitness.topics.items()}
    lines = ["requires:", *(f"  {row}" for row in rows({"samples": fitness.samples}))]
    lines += ["  topics:"] * bool(topics) + [f"    {row}" for row in rows(topics)]
    lines += ["  objects:  # the share of samples in which each is known"] * bool(fitness.objects)
    for name, share in fitness.objects.items():
        lines.append(f"    {json.dumps(name, ensure_ascii=False)}: {share:g}")
    show(*lines)
    return ExitCode.SATISFIED


def _write_blueprint(log: LogFile, output: Path | None) -> int:
    """Write the panels that show an annotated log in Rerun."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    from spatial_replay.annotate.rerun_blueprint import blueprint_rows, write_blueprint
    from spatial_replay.logs.mcap.read import McapSource
    from spatial_replay.logs.output_file import refuse_inputs
    from spatial_replay.logs.remote import is_address
    from spatial_replay.logs.schemas.Robustness_pb2 import StandingUpdate
    from spatial_replay.logs.topics import SCENE, STANDING
    from spatial_replay.sources.open_log import open_source

    if output is None:
        raise UsageError("--blueprint writes a file that is no text; name it with -o run.rbl")
    refuse_inputs(output, [Path(str(log))])
    source = open_source(log)
    payload = None
    if isinstance(source, McapSource):
        payload = next((payload for batch, _ in source.iter_payloads(STANDING) for payload in batch), None)
    if not isinstance(source, McapSource) or payload is None:
        raise UsageError(f"{source.name} has no results to show; replay -o writes a log that has them")
    if output.suffix == ".rrd" and is_address(str(log)):
        raise UsageError(
            f"Rerun reads files; download {source.name}, or write a blueprint alone with -o run.rbl"
        )
    rows = blueprint_rows(StandingUpdate.FromString(payload))
    scene_updates = (
        SceneUpdate.FromString(payload) for batch, _ in source.iter_payloads(SCENE) for payload in batch
    )
    write_blueprint(rows, Path(str(log)), output, scene_updates)
    show(f"wrote {output}")
    return ExitCode.SATISFIED


def _print_layout(log: LogFile, *, panels: bool) -> int:
    """Print the layout in a log. With `panels`, print its variant for viewers with the extension."""
    from spatial_replay.annotate.foxglove_layout import layout_text, with_panels
    from spatial_replay.logs.topics import LAYOUT
    from spatial_replay.replay.engine import planned_result
    from spatial_replay.sources.open_log import open_source

    source = open_source(log)
    for attachment in source.attachments():
        if attachment.name == LAYOUT:
            layout_json = attachment.data.decode("utf-8", "replace")
            if panels:
                layout_json = layout_text(with_panels(json.loads(layout_json), planned_result(source)))
            show_file(layout_json)
            return ExitCode.SATISFIED
    raise UsageError(
        f"{source.name} has no layout; logs written by spatial-replay record or replay -o have one"
    )


def _print_specification(log: LogFile, name: str) -> int:
    """Print the texts of the recorded specifications; a name selects one text."""
    from spatial_replay.replay.engine import recorded_texts
    from spatial_replay.sources.open_log import open_source

    source = open_source(log)
    texts = recorded_texts(source)
    if not texts:
        raise UsageError(
            f"{source.name} holds no specification; logs written by spatial-replay record --spec or "
            "replay -o have them"
        )
    matches = [text for text in texts if name in ("", text.filename, Path(text.filename).stem)]
    matches = matches or [text for text in texts if name in _names_of(text)]
    if not matches:
        files = ", ".join(text.filename for text in texts)
        specs = ", ".join(dict.fromkeys(name for text in texts for name in _names_of(text)))
        raise UsageError(f"{source.name} has no specification {name!r}; files: {files}; specs: {specs}")
    for text in matches:
        if len(matches) > 1:
            show(f"# {text.filename}")
        show_file(text.text)
    return ExitCode.SATISFIED


def _names_of(text: SpecificationText) -> list[str]:
    return [spec.name for spec in _specs_of(text)]


def _requirements(source: Source) -> dict[str, NamedSpec]:
    """Return a log's specs with requirements, by result name."""
    from spatial_replay.replay.engine import recorded_texts

    specs_by_file = [(Path(text.filename).stem, _specs_of(text)) for text in recorded_texts(source)]
    spec_names = [spec.name for _, specs in specs_by_file for spec in specs]
    specs_by_result: dict[str, NamedSpec] = {}
    for stem, specs in specs_by_file:
        for spec in specs:
            if spec.id or spec.title:
                name = f"{stem}.{spec.name}" if spec_names.count(spec.name) > 1 else spec.name
                # logs of a recorder have the id before the name
                specs_by_result |= {name: spec, f"{spec.id} {name}": spec}
    return specs_by_result


def _verdicts(container: LogSummary, specs: Mapping[str, NamedSpec]) -> Iterator[dict[str, str | None]]:
    """Yield the verdicts stored in a log, each with its requirement."""
    from spatial_replay.logs.topics import VERDICTS

    for verdicts in (verdicts for name, verdicts in container.metadata if name == VERDICTS):
        for result, verdict in verdicts.items():
            # the result of a template has the object in its name: reach(cup)
            spec = specs.get(result) or specs.get(result.partition("(")[0])
            requirement, title = (None, None) if spec is None else (spec.id, spec.title)
            yield {"name": result, "verdict": verdict, "requirement": requirement, "title": title}


def _specs_of(text: SpecificationText) -> Sequence[NamedSpec]:
    from spatial_replay.errors import SpecificationError
    from spatial_replay.spec import parse_specification

    try:
        return parse_specification(text.text, filename=text.filename).specs
    except SpecificationError:
        # a text with relations defined in Python can be printed, but not parsed here
        return ()


def _print_mapping(log: LogFile) -> int:
    """Print a first version of a mapping file for an external log."""
    from spatial_replay.sources.open_log import open_source
    from spatial_replay.sources.overview import messages_in, survey

    reader = messages_in(log)
    if reader is None:
        source = open_source(log)
        raise UsageError(f"{source.name} needs no mapping: it names its objects")
    with progress("messages") as advance:
        surveyed = survey(reader, advance, whole=False)
    warn(*counted_from((*surveyed.faults, *surveyed.remarks), surveyed.start_ns or 0))
    show_file(surveyed.mapping)
    return ExitCode.DAMAGED if surveyed.faults else ExitCode.SATISFIED


def _document(
    overview: Overview, survey: Survey | None, faults: tuple[str, ...], specs: Mapping[str, NamedSpec]
) -> dict[str, object]:
    container = overview.container
    document: dict[str, object] = {
        **json_fields(overview, "name", "kind", "samples", "start_ns", "end_ns", "objects", "signals"),
        "damaged": bool(faults),
        "faults": faults,
        "axes": {"y": "up", "source": _declarations(json_fields(overview.axes))},
    }
    if survey is not None:
        document["messages"] = {"count": survey.messages, **json_fields(survey, "start_ns", "end_ns")}
        document["topics"] = [
            {
                "topic": topic.topic.name,
                "schema": topic.topic.type,
                "encoding": topic.topic.encoding,
                "messages": topic.messages,
                "mapping": topic.entry or None,
                "unreadable": topic.topic.unreadable,
            }
            for topic in survey.topics
        ]
    elif container is not None:
        document["topics"] = [
            {
                "topic": topic,
                "schema": schema,
                "encoding": encoding,
                "messages": sum(messages),
                "publishers": len(messages),
            }
            for (topic, schema, encoding), messages in _topics(container).items()
        ]
    if overview.facts:
        document["evidence"] = [json_fields(facts) for facts in overview.facts]
    if overview.doubts or overview.facts:
        document["doubts"] = [json_doubt(doubt) for doubt in overview.doubts]
    if container is not None:
        document["verdicts"] = list(_verdicts(container, specs))
        document["metadata"] = [{"name": name, "data": dict(data)} for name, data in container.metadata]
        document["attachments"] = json_value(container.attachments)
    return document


def _declarations(axes: dict[str, object]) -> dict[str, object]:
    """Return axes as JSON, without undeclared units."""
    return {name: value for name, value in axes.items() if value or name not in ("unit", "signals")}


def _topics(container: LogSummary) -> Mapping[tuple[str, str, str], Sequence[int]]:
    """Return the message count of each channel, by topic, schema and encoding.

    Each publisher of a topic may have its own channel.
    """
    message_counts: dict[tuple[str, str, str], list[int]] = {}
    for summary in container.channels:
        channel = summary.channel
        schema = channel.schema.name if channel.schema is not None else ""
        message_counts.setdefault((channel.topic, schema, channel.encoding), []).append(summary.messages)
    return message_counts


def _lines(
    overview: Overview, survey: Survey | None, is_damaged: bool, specs: Mapping[str, NamedSpec]
) -> Iterator[str]:
    count_text = plural(overview.samples, "sample")
    if survey is not None and not overview.samples:
        count_text = plural(survey.messages, "message")
    yield f"{overview.name}: {overview.kind}, {count_text}{', damaged' if is_damaged else ''}"
    start_ns, end_ns = overview.start_ns, overview.end_ns
    if survey is not None and start_ns is None:
        start_ns, end_ns = survey.start_ns, survey.end_ns
    if start_ns is not None and end_ns is not None:
        yield f"time     {_clock(start_ns)} to {_clock(end_ns)} ({(end_ns - start_ns) / 1e9:.3f} s)"
    if period_s := overview.period_ns / 1e9:
        samples_ahead = max(round(1.0 / period_s), 1)
        window_text = f"F[0, {samples_ahead}] looks {samples_ahead * period_s:.3g} s ahead"
        yield f"rate     {1.0 / period_s:.4g} samples a second: {window_text}"
    if overview.samples:
        yield f"axes     {overview.axes}"
    if overview.objects:
        yield "objects"
        yield from align_rows(
            (
                tracked.name,
                ", ".join(tracked.classes),
                plural(tracked.samples, "sample"),
                f"{tracked.unreadable:,} unknown" if tracked.unreadable else "",
            )
            for tracked in overview.objects
        )
    if overview.signals:
        yield f"signals  {', '.join(overview.signals)}"
    if survey is not None:
        yield from _survey_lines(survey, is_mapped=bool(overview.samples))
    if overview.facts:
        yield "evidence"
        yield from (f"  {line}" for line in evidence_lines(overview))
    if overview.container is not None:
        yield from _container_lines(overview.container, specs, lists_topics=survey is None)


def _survey_lines(survey: Survey, *, is_mapped: bool) -> Iterator[str]:
    if survey.topics:
        yield "topics"
        yield from align_rows(
            (topic.topic.name, topic.topic.type, topic.topic.encoding, plural(topic.messages, "message"))
            for topic in survey.topics
        )
    mapping_entries = [(f"{topic.topic.name}:", topic.entry) for topic in survey.topics if topic.entry]
    if mapping_entries and not is_mapped:
        yield "could map to objects"
        yield from align_rows(mapping_entries)
        yield f"to write a first mapping: spatial-replay info {shlex.quote(survey.name)} --suggest-mapping"


def _container_lines(
    container: LogSummary, specs: Mapping[str, NamedSpec], *, lists_topics: bool
) -> Iterator[str]:
    from spatial_replay.logs.topics import VERDICTS

    if verdicts := list(_verdicts(container, specs)):
        kinds = [(verdict["verdict"] or "").split(",")[0] for verdict in verdicts]
        is_known = set(kinds) <= set(WORST_FIRST)
        # the sort is stable: violations keep the log's order, by time except in logs of earlier versions
        worst_first = sorted(
            range(len(kinds)), key=lambda place: WORST_FIRST.index(kinds[place]) if is_known else 0
        )
        yield f"verdicts: {counts_text(kinds)}" if is_known and len(kinds) > MANY else "verdicts"
        yield from align_rows(
            (
                verdict["name"] or "",
                verdict["verdict"] or "",
                requirement_text(verdict["requirement"], verdict["title"]),
            )
            for verdict in (verdicts[place] for place in worst_first)
        )
    if lists_topics:
        yield "topics"
        yield from align_rows(
            (
                *names,
                plural(sum(message_counts), "message"),
                plural(len(message_counts), "publisher") if len(message_counts) > 1 else "",
            )
            for names, message_counts in _topics(container).items()
        )
    for name, entries in container.metadata:
        if name != VERDICTS:
            yield f"metadata {name}"
            entry_rows = [(key, _shorten(value)) for key, value in list(entries.items())[:_MOST_ENTRIES]]
            yield from align_rows(entry_rows)
            if len(entries) > _MOST_ENTRIES:
                yield f"  … and {len(entries) - _MOST_ENTRIES:,} more; --json prints all"
    if container.attachments:
        yield "attachments"
        yield from align_rows(
            (attachment.name, attachment.media_type, plural(attachment.size, "byte"))
            for attachment in container.attachments
        )


_MOST_ENTRIES: Final = 20
"""Maximum number of printed entries of a metadata record."""
_LONGEST_ENTRY: Final = 120


def _shorten(text: str) -> str:
    """Return a metadata value. A long value is cut, and its length is added."""
    if len(text) <= _LONGEST_ENTRY:
        return text
    return f"{text[:_LONGEST_ENTRY]}… ({len(text):,} characters; --json prints all)"


def _clock(time_ns: int) -> str:
    if time_ns < _EPOCH_LIKELY_NS:
        return f"{time_ns / 1e9:.3f} s"
    seconds, fraction_ns = divmod(time_ns, 10**9)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{fraction_ns // 10**6:03d}Z"
