"""Which messages of a log its copies keep: all, those that make the samples, or those of some topics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from spatial_replay.bags.topic import ALL, MAPPED, is_kept
from spatial_replay.errors import UsageError
from spatial_replay.logs.mcap.reader import McapSource
from spatial_replay.logs.messages import Attachment, Block, Messages, select
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import OBJECTS

KEEP_ALL: Final = (ALL,)
"""What a copy keeps unless it is given something else."""

_SAMPLES: Final = frozenset({OBJECTS})
"""The topics of our own logs that make the samples."""


def source_keeping(source: Source, keep: Sequence[str] | None) -> Source:
    """Return a source whose blocks hold the messages that a copy keeps, besides the samples.

    Args:
        keep: "all", "mapped" for the topics that the samples are made of, or patterns of topics such as
            "/camera/*"; several add up. None leaves the source as it is.

    Raises:
        UsageError: a pattern that no topic of the log fits.
    """
    if keep is None:
        return source
    patterns = [each for each in keep if each not in (ALL, MAPPED)]
    if patterns:
        _check_patterns(source, patterns)
    if hasattr(source, "keep"):
        # an external log reads only what is kept
        return cast(Source, replace(cast(Any, source), keep=tuple(keep)))
    return source if ALL in keep else _KeptSource(source, tuple(keep))


@dataclass(frozen=True)
class _KeptSource:
    """Our own log, without the messages that a copy does not keep."""

    source: Source
    keep: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def kind(self) -> str:
        return self.source.kind

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        for block in self.source.iter_blocks(start_ns, end_ns):
            yield replace(block, messages=self._kept(block.messages))

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return self.source.attachments()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return self.source.metadata()

    def _kept(self, messages: Messages) -> Messages:
        # the samples of our own log are messages, too
        keep = (*self.keep, OBJECTS)
        channels = {
            number: channel
            for number, channel in messages.channels.items()
            if is_kept(channel.topic, keep, _SAMPLES)
        }
        chosen = select(messages, np.flatnonzero(np.isin(messages.channel, list(channels))))
        return replace(chosen, channels=channels)


def _check_patterns(source: Source, patterns: Sequence[str]) -> None:
    """Check that every pattern fits a topic: with a misspelt one, what was meant would be lost."""
    topics = _topics(source)
    if not topics:
        raise UsageError(f"{source.name} has no messages to keep; it holds samples only")
    for pattern in patterns:
        if not any(is_kept(topic, (pattern,), ()) for topic in topics):
            listed = ", ".join(topics[:8]) + (", …" if len(topics) > 8 else "")
            raise UsageError(
                f"no topic of {source.name} fits {pattern!r}; it has {listed}; "
                "'all' keeps everything, 'mapped' the topics that make the samples"
            )


def _topics(source: Source) -> list[str]:
    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            return sorted({channel.topic for channel in walk.channels.values()})
    path = getattr(source, "path", None)
    if hasattr(source, "keep") and isinstance(path, Path):
        # readers of external logs are loaded when there is one
        from spatial_replay.bags.open import open_messages

        return [topic.name for topic in open_messages(path).topics()]
    return []
