"""Replays that write an annotated log."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from spatial_replay import __version__
from spatial_replay.annotate.certificate import described
from spatial_replay.annotate.foxglove_layout import LAYOUT
from spatial_replay.errors import UsageError
from spatial_replay.logs.mcap.writer import LogWriter
from spatial_replay.logs.messages import Sink
from spatial_replay.logs.output_file import replacing
from spatial_replay.logs.source import Source, reading_options
from spatial_replay.logs.topics import (
    AUTOMATA,
    AUTOMATA_PREFIX,
    CERTIFICATE,
    METADATA,
    RECORDED_PREFIX,
    REPLAYED_PREFIX,
)
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.replay.selection import Window
from spatial_replay.spec import load_specification, parse_specification
from spatial_replay.spec.formula import Specification

_REPLACED = (REPLAYED_PREFIX, AUTOMATA_PREFIX + REPLAYED_PREFIX)
"""What the names of attachments begin with that a replay writes anew."""


def run_replay(
    source: Source,
    files: Sequence[Specification],
    *,
    window: Window | None = None,
    each: Mapping[str, str] | None = None,
    semantics: Semantics = "ltlf",
    keep_series: bool = False,
    keep_leaves: bool = False,
    output: Path | None = None,
    inputs: Sequence[Path] = (),
    layer: bool = False,
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source and, if asked to, write the annotated log.

    Equal sources, specifications and options give equal results and an equal file; a replay of an annotated
    log gives what a replay of its source gives.

    Args:
        each: for each parameter of a template, the objects that it stands for: "all", "class:NAME".
        semantics: "ltlf", or "paper": Def. 16 of the paper to the letter.
        keep_series: keep every sample's numbers in memory.
        keep_leaves: keep every sample's atoms in memory, so that results can be inquired into.
        output: the annotated log; it replaces a file of that name only when it is whole.
        inputs: files that the output must not be.
        layer: leave the source's own messages, metadata and attachments out of the output.
        advance: told how many more samples are done.

    Raises:
        UsageError: an option that cannot work, no sample in the window, the output is an input.
        SpecificationError: names that the log never has.
        LogError: no sample in the log.
        OutputError: the output cannot be written.
    """
    check_parameters(files, each or {})
    replay = Replay(
        source,
        files,
        window=window,
        each=each,
        semantics=semantics,
        keep_series=keep_series,
        keep_leaves=keep_leaves,
    )
    with ExitStack() as stack:
        sink: LogWriter | None = None
        if output is not None:
            sink = stack.enter_context(LogWriter(stack.enter_context(replacing(output, inputs))))
            _begin(sink, source, replay, window or Window(), each or {}, semantics, layer=layer)
        for messages, samples in replay.iter_messages(annotate=sink is not None, layer=layer):
            if sink is not None:
                sink.write_messages(messages)
            advance(samples)
        replayed = replay.result()
        if sink is not None:
            layout = replay.layout()
            sink.add_attachment(layout.name, layout.media_type, layout.data)
            sink.add_metadata(CERTIFICATE, replayed.certificate)
    return replayed


def _begin(
    sink: Sink,
    source: Source,
    replay: Replay,
    window: Window,
    each: Mapping[str, str],
    semantics: Semantics,
    *,
    layer: bool,
) -> None:
    """Write what comes before the first message: our metadata, and what the source keeps."""
    before = dict(source.metadata()).get(METADATA, {})
    is_replayed = before.get("written_by") == "replay"
    about = {
        "version": __version__,
        "written_by": "replay",
        "semantics": semantics,
        "source": before.get("source", source.name) if is_replayed else source.name,
        "specifications": described(replay.files),
        "options": json.dumps(_options(source, window, each, layer=layer)),
    }
    recorded = {key: value for key, value in before.items() if key not in about and key != "source"}
    if not is_replayed and "options" in before:
        recorded["recorded_options"] = before["options"]
    sink.add_metadata(METADATA, {**about, **recorded})
    sink.add_metadata(AUTOMATA, replay.automata_metadata())
    if not layer:
        _copy_kept(sink, source)
    for attachment in replay.attachments():
        sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _copy_kept(sink: Sink, source: Source) -> None:
    """Copy what the source keeps beside its messages, but for what a replay writes anew."""
    for name, data in source.metadata():
        if name not in (METADATA, AUTOMATA, CERTIFICATE):
            sink.add_metadata(name, data)
    for attachment in source.attachments():
        if not attachment.name.startswith(_REPLACED) and attachment.name != LAYOUT:
            sink.add_attachment(attachment.name, attachment.media_type, attachment.data)


def _options(source: Source, window: Window, each: Mapping[str, str], *, layer: bool) -> dict[str, object]:
    """The options that differ from the defaults."""
    whole = Window()
    options: dict[str, object] = reading_options(source)
    options |= {
        name: getattr(window, name)
        for name in ("start_ns", "end_ns", "every")
        if getattr(window, name) != getattr(whole, name)
    }
    if each:
        options["each"] = dict(sorted(each.items()))
    if layer:
        options["layer"] = True
    return options


def load_files(paths: Sequence[Path], source: Source, *, profile: str | None = None) -> list[Specification]:
    """The specifications to evaluate: those named or, without any, those that the log was written with.

    A log that was replayed has the last replay's, another one those it was recorded with.

    Raises:
        UsageError: none was named and the log has none.
        SpecificationError: a specification with faults.
    """
    if paths:
        return [load_specification(path, profile=profile) for path in dict.fromkeys(paths)]
    attachments = source.attachments()
    for prefix in (REPLAYED_PREFIX, RECORDED_PREFIX):
        kept = [attachment for attachment in attachments if attachment.name.startswith(prefix)]
        if kept:
            return [
                parse_specification(
                    attachment.data.decode("utf-8", "replace"),
                    filename=attachment.name.removeprefix(prefix),
                    profile=profile,
                )
                for attachment in kept
            ]
    raise UsageError(f"{source.name} holds no specification of its own; give one with --spec FILE")


def check_parameters(files: Sequence[Specification], each: Mapping[str, str]) -> None:
    """That every choice of objects is for the parameter of some template.

    Raises:
        UsageError: one is not.
    """
    templates = [spec for file in files for spec in file.results if spec.parameter is not None]
    for parameter in each:
        if parameter not in {spec.parameter for spec in templates}:
            known = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            raise UsageError(f"no template has a parameter {parameter!r}; templates here: {known}")
