"""Replays that write an annotated log: the source's messages with those of the evaluation beside them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from spatial_replay import __version__
from spatial_replay.annotate.certificate import specifications_json
from spatial_replay.errors import UsageError
from spatial_replay.logs.messages import Sink
from spatial_replay.logs.source import Source, reading_options, units_metadata
from spatial_replay.logs.topics import (
    AUTOMATA,
    AUTOMATA_PREFIX,
    CERTIFICATE,
    LAYOUT,
    METADATA,
    RECORDED_PREFIX,
    REPLAYED_PREFIX,
    VERDICTS,
)
from spatial_replay.monitor.result import worst_first
from spatial_replay.monitor.sentences import verdict_text
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.replay.kept_messages import KEEP_ALL
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions, Window
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.overrides import SpecificationText, load_specifications

_REPLACED = (REPLAYED_PREFIX, AUTOMATA_PREFIX + REPLAYED_PREFIX)
"""Prefixes of the attachments that a replay replaces."""


def run_replay(
    source: Source,
    files: Sequence[Specification],
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    keep_series: bool = False,
    keep_leaves: bool = False,
    output: Path | None = None,
    inputs: Sequence[Path] = (),
    layer: bool = False,
    certify: bool = True,
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source and, if asked to, write the annotated log.

    Equal sources, specifications and options give equal results and an equal file; a replay of an annotated
    log gives what a replay of its source gives.

    Args:
        keep_series: keep every sample's numbers in memory.
        keep_leaves: keep every sample's atoms in memory, for witnesses and signals.
        output: the annotated log; it replaces a file of that name only when it is complete.
        inputs: files that the output must not be.
        layer: leave the source's own messages, metadata and attachments out of the output.
        certify: hash what is read and what comes out, as for every output; for that, messages are read, too.
        advance: called with the number of samples of each block that is done.

    Raises:
        UsageError: an option that cannot work, no sample in the window, the output is an input.
        SpecificationError: names that the log never has, if names are strict.
        LogError: no sample in the log.
        OutputError: the output cannot be written.
    """
    if options.keep is None and output is not None and not layer:
        options = replace(options, keep=KEEP_ALL)
    replay = Replay(
        source,
        files,
        options,
        keep_series=keep_series,
        keep_leaves=keep_leaves,
        certify=certify or output is not None,
    )
    if output is None:
        return replay.run(advance=advance)
    # imported here since a replay without an annotated log needs no writer
    from spatial_replay.logs.mcap.write import WHOLE_CHUNK_NS, LogWriter
    from spatial_replay.logs.output_file import replacing

    with ExitStack() as stack:
        sink = stack.enter_context(
            LogWriter(stack.enter_context(replacing(output, inputs)), chunk_ns=WHOLE_CHUNK_NS)
        )
        _begin(sink, source, replay, options, layer=layer)
        replayed = replay.run(sink.write_messages, layer=layer, advance=advance)
        layout = replay.layout()
        sink.add_attachment(layout.name, layout.media_type, layout.data)
        texts = {
            each.title: verdict_text(each.verdict, each.robustness, each.unit)
            for each in (replayed.results[place] for place in worst_first(replayed.results))
        }
        sink.add_metadata(VERDICTS, texts)
        sink.add_metadata(CERTIFICATE, replayed.certificate)
    return replayed


def load_files(
    paths: Sequence[Path],
    source: Source,
    *,
    profile: str | None = None,
    constants: Mapping[str, float | str] | None = None,
) -> list[Specification]:
    """Load the named specifications or, without any, those that the log was written with.

    A replayed log gives those of the last replay, another log those that it was recorded with.

    Args:
        constants: values in place of those that the specifications have; see `load_specifications`.

    Raises:
        UsageError: none was named and the log has none, or no specification has one of the constants.
        SpecificationError: a specification with errors.
    """
    named: Sequence[Path | SpecificationText] = tuple(dict.fromkeys(paths)) or recorded_texts(source)
    if not named:
        raise UsageError(f"{source.name} holds no specification of its own; give one with --spec FILE")
    return load_specifications(named, profile=profile, constants=constants)


def recorded_texts(source: Source) -> list[SpecificationText]:
    """Return the specifications that a log was written with, as they were written.

    A replayed log gives those of the last replay, another log those that it was recorded with.
    """
    attachments = source.attachments()
    for prefix in (REPLAYED_PREFIX, RECORDED_PREFIX):
        texts = [
            SpecificationText(each.data.decode("utf-8", "replace"), each.name.removeprefix(prefix))
            for each in attachments
            if each.name.startswith(prefix)
        ]
        if texts:
            return texts
    return []


def _begin(sink: Sink, source: Source, replay: Replay, options: ReplayOptions, *, layer: bool) -> None:
    """Write what comes before the first message: our metadata, and that of the source."""
    before = dict(source.metadata()).get(METADATA, {})
    is_replayed = before.get("written_by") == "replay"
    about = {
        "version": __version__,
        "written_by": "replay",
        "semantics": options.semantics,
        # a replay of a replay says what a replay of the first source says
        "source": before.get("source", source.name) if is_replayed else source.name,
        "specifications": specifications_json(replay.files),
        "options": json.dumps(_recorded_options(source, options, layer=layer)),
    }
    about |= units_metadata(source)
    recorded = {key: value for key, value in before.items() if key not in about and key != "source"}
    if not is_replayed and "options" in before:
        recorded["recorded_options"] = before["options"]
    sink.add_metadata(METADATA, {**about, **recorded})
    sink.add_metadata(AUTOMATA, replay.automata_metadata())
    if not layer:
        _copy_attached(sink, source)
    for attachment in replay.attachments():
        sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _copy_attached(sink: Sink, source: Source) -> None:
    """Copy the source's metadata and attachments, except those that a replay replaces."""
    for name, data in source.metadata():
        if name not in (METADATA, AUTOMATA, VERDICTS, CERTIFICATE):
            sink.add_metadata(name, data)
    for attachment in source.attachments():
        if not attachment.name.startswith(_REPLACED) and attachment.name != LAYOUT:
            sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _recorded_options(source: Source, options: ReplayOptions, *, layer: bool) -> dict[str, object]:
    """Return the options that differ from the defaults, as `verification` reads them back."""
    whole = Window()
    recorded: dict[str, object] = reading_options(source)
    recorded |= {
        name: getattr(options.window, name)
        for name in ("start_ns", "end_ns", "every")
        if getattr(options.window, name) != getattr(whole, name)
    }
    if options.each:
        recorded["each"] = dict(sorted(options.each.items()))
    if options.arrow:
        recorded["arrow"] = options.arrow
    if layer:
        recorded["layer"] = True
    elif options.keep not in (None, KEEP_ALL):
        recorded["keep"] = list(options.keep or ())
    return recorded
