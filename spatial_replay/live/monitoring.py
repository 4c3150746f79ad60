"""Monitor a running robot in one call, with the logs that are written beside."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from os import PathLike
from pathlib import Path
from typing import ClassVar

from spatial_replay.errors import UsageError
from spatial_replay.live.live_session import MAX_DELAY_S, LiveSession
from spatial_replay.live.live_update import LiveUpdate
from spatial_replay.mapping import LogMapping, load_mapping
from spatial_replay.recording.recorder import Recorder
from spatial_replay.recording.trigger import Trigger
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import listed_specifications

_WAITING = 65_536
"""Samples, and messages, that may wait for a recorder: a robot waits for no disk."""


class _RunRecorder(Recorder):
    """A recorder of a run that goes on whatever the disk does: it leaves out nothing that it can hold."""

    most_lost_s: ClassVar[float] = math.inf


@contextmanager
def open_recorders(
    files: Sequence[Specification],
    mapping: LogMapping | None,
    output: Path | None = None,
    trigger: Trigger | None = None,
    clips: Path | None = None,
    *,
    overwrite: bool = False,
) -> Iterator[list[Recorder]]:
    """Open the log of a whole run, and the recorder of clips, as far as they are wanted.

    Raises:
        UsageError: a trigger without a folder, or the other way around, or one that is not understood; an
            output that exists, unless it may be overwritten.
        OutputError: something cannot be written.
    """
    if (trigger is None) != (clips is None):
        raise UsageError("clips take a trigger and a folder; give both")
    about = _about(mapping)
    with ExitStack() as opened:
        recorders: list[Recorder] = [
            opened.enter_context(
                _RunRecorder(
                    path,
                    specifications=files,
                    about=about,
                    waiting=_WAITING,
                    block=False,
                    trigger=own,
                    overwrite=overwrite,
                )
            )
            for path, own in ((output, None), (clips, trigger))
            if path is not None
        ]
        yield recorders


def _about(mapping: LogMapping | None) -> Mapping[str, str]:
    """Return what a log says about a run: nothing that depends on where it took place."""
    if mapping is None:
        return {"source": "live"}
    named = {"mapping": mapping.name, "mapping_sha256": mapping.sha256}
    return {"source": "live", **named, **mapping.metadata()}


async def monitor(
    address: str,
    specifications: Specification | Sequence[Specification],
    mapping: LogMapping | str | PathLike[str] | None = None,
    *,
    output: str | PathLike[str] | None = None,
    trigger: Trigger | None = None,
    clips: str | PathLike[str] | None = None,
    topics: Sequence[str] = (),
    max_delay_s: float = MAX_DELAY_S,
    dead_man_s: float | None = None,
    overwrite: bool = False,
) -> AsyncIterator[LiveUpdate]:
    """Monitor a running robot; yield an update for each sample.

    The connection is made again whenever it is lost; everything is unknown until it is back. Leave the loop
    to end; what happened last is then evaluated and the log closed.

    Args:
        address: of foxglove_bridge or another server of Foxglove's WebSocket protocol: ws://robot:8765.
        mapping: as for a log of the same topics; without one, the server has the topic /spatial/objects.
        output: a log to write, as `Recorder` does, with the messages that came beside the samples.
        trigger, clips: when to write which part of the run to a log of its own, and the folder of these.
        topics: patterns of the topics whose messages are written; those that are mapped by default.
        max_delay_s: how long a sample waits for transforms, and for topics whose stamps lag behind.
        dead_man_s: after so much silence of a topic, what it reported is unknown.
        overwrite: replace an output that exists.

    Raises:
        UsageError: a template, options that do not work, a mapping that does not fit what is sent, an output
            that exists.
        RemoteError: the first connection fails.
        LogError: time jumps back by more than a second.
        OutputError: the log cannot be written.
    """
    files = listed_specifications(specifications)
    if mapping is not None and not isinstance(mapping, LogMapping):
        mapping = load_mapping(mapping)
    written = None if output is None else Path(output), trigger, None if clips is None else Path(clips)
    with open_recorders(files, mapping, *written, overwrite=overwrite) as recorders:
        session = LiveSession(
            address,
            files,
            mapping,
            recorders=recorders,
            topics=topics,
            max_delay_s=max_delay_s,
            dead_man_s=dead_man_s,
        )
        async for update in session.updates():
            yield update
        if session.failure is not None:
            raise session.failure
