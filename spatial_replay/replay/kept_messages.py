"""Which messages of a log its copies keep: all, those that make the samples, or those of some topics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from spatial_replay.errors import UsageError
from spatial_replay.logs.remote import LogFile
from spatial_replay.logs.source import Source, reading_only
from spatial_replay.logs.topics import ALL, MAPPED, is_kept

KEEP_ALL: Final = (ALL,)
"""What a copy keeps unless it is given something else."""


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
    return reading_only(source, tuple(keep))


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
    from spatial_replay.logs.mcap.read import McapSource

    if isinstance(source, McapSource):
        with source.open_walk() as walk:
            return sorted({channel.topic for channel in walk.channels.values()})
    path = getattr(source, "path", None)
    if hasattr(source, "keep") and isinstance(path, LogFile):
        # readers of external logs are loaded when there is one
        from spatial_replay.bags.open import open_messages

        return [topic.name for topic in open_messages(path).topics()]
    return []
