"""The smallest part of a log that still shows why a verdict is what it is, as a log of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spatial_replay.compare.clip_window import ClipSearch, chosen_nodes
from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import RemoteFile
from spatial_replay.logs.source import Source
from spatial_replay.monitor.semantics import require_ltlf
from spatial_replay.replay.annotated import run_replay
from spatial_replay.replay.clipped_source import clipped_source
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.replay.kept_messages import KEEP_ALL
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions, Window
from spatial_replay.spec.formula import Specification


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip that was written.

    Attributes:
        whole, replayed: the replay of the log, without a certificate, and that of the clip.
        start_ns, end_ns: times of the first and the last sample of the clip.
        kept: the titles of the results, and names of specs within them, that are as in the log.
        source_bytes, clip_bytes: sizes of the files; None for a log that is not one file here.
    """

    whole: Replayed
    replayed: Replayed
    start_ns: int
    end_ns: int
    kept: tuple[str, ...]
    source_bytes: int | None
    clip_bytes: int

    @property
    def left_out(self) -> tuple[str, ...]:
        """The titles of results of which nothing is kept, in the order of the log."""
        kept = {*self.kept}
        return tuple(
            each.title
            for each in self.whole.results
            if kept.isdisjoint({each.title, *(node.name for node in each.nodes if node.name)})
        )

    @property
    def is_whole(self) -> bool:
        """Whether nothing smaller has the same verdict and witness."""
        return self.replayed.samples == self.whole.samples

    @property
    def changed(self) -> tuple[str, ...]:
        """The titles of results with another verdict than in the log; none of `kept`."""
        verdicts = {result.title: result.verdict for result in self.whole.results}
        return tuple(
            result.title
            for result in self.replayed.results
            if verdicts.get(result.title) is not result.verdict
        )

    @property
    def added(self) -> tuple[str, ...]:
        """The named parts that fail in the clip alone, of results with the verdict of the log."""
        known = {result.title: result for result in self.whole.results}
        parts = (
            cause.spec
            for result in self.replayed.results
            if result.title not in self.changed
            for cause in result.causes
            if cause.spec not in {each.spec for each in known[result.title].causes}
        )
        return tuple(dict.fromkeys(parts))


def cut_clip(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    around_ns: int = 0,
    of: Sequence[str] = (),
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Clip:
    """Write the smallest part of a log that has its verdicts, robustness and witnesses.

    Neither end can be cut further, by one sample or by any power of two, without another result. Messages are
    those in the window, and before it the last of each topic and the last transform of each frame. Times
    stay.

    Args:
        options: what is evaluated; `keep` chooses the topics.
        around_ns: keep at least so much before and after the samples that decide.
        of: names of the specs to keep; without it the violated results, or all where none is violated.
        inputs: files that the output must not be.

    Raises:
        UsageError: no such spec, an option that cannot work, an output that is an input.
        LogError: no sample in the log. OutputError: the output cannot be written.
    """
    if options.window.every != 1:
        raise UsageError("a clip keeps every sample; leave out --every")
    require_ltlf(options.semantics, "a clip")
    first_pass = replace(options, keep=())
    whole = Replay(source, files, first_pass, keep_leaves=True, certify=False).run(advance=advance)
    chosen = chosen_nodes(whole.results, of)
    search = ClipSearch(source, files, first_pass, chosen, around_ns)
    start_ns, end_ns = search.window()
    keep = KEEP_ALL if options.keep is None else options.keep
    about = {
        "source": source.name,
        "samples": str(whole.samples),
        "start_ns": str(start_ns),
        "end_ns": str(end_ns),
        "keep": json.dumps(list(keep)),
        "kept": ", ".join(each.title for each in chosen),
    }
    clipped = clipped_source(source, about)
    replayed = run_replay(
        clipped,
        files,
        replace(options, window=Window(), keep=None),
        keep_leaves=True,
        output=output,
        inputs=inputs,
    )
    return Clip(
        whole,
        replayed,
        start_ns,
        end_ns,
        tuple(each.title for each in chosen),
        _size_of(source),
        output.stat().st_size,
    )


def _size_of(source: Source) -> int | None:
    """Return the size of a log that is one file."""
    path = getattr(source, "path", None)
    if isinstance(path, RemoteFile):
        return path.size
    return path.stat().st_size if isinstance(path, Path) and path.is_file() else None
