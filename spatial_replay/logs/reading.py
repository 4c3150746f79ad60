"""Sources as they are read: how, and what is said when that fails."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from spatial_replay.errors import LogError
from spatial_replay.logs.block import Block
from spatial_replay.logs.source import Source


def read_blocks(
    source: Source, start_ns: int | None = None, end_ns: int | None = None
) -> Generator[Block, None, None]:
    """The blocks of a source, as `Source.iter_blocks` gives them.

    Raises:
        LogError: what that raises, and when the machine cannot read the source: a disk that fails or is gone.
    """
    try:
        yield from source.iter_blocks(start_ns, end_ns)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{source.name} could not be read: {reason}; copy it to another disk") from error


def read_ahead(blocks: Generator[Block, None, None]) -> Iterator[Block]:
    """The same blocks, each read on a thread of its own while the one before is worked on.

    Most of reading leaves the interpreter to others, so that on two cores it costs a replay little time.
    """
    with ThreadPoolExecutor(1, "reading") as thread:
        try:
            waiting = thread.submit(next, blocks, None)
            while (block := waiting.result()) is not None:
                waiting = thread.submit(next, blocks, None)
                yield block
        finally:
            # by the thread that read them, which alone may close a database; after an interruption while that
            # began, and when the interpreter ends, by whoever drops them last
            with suppress(ValueError, RuntimeError):
                thread.submit(blocks.close).result()


def reading_options(source: Source) -> dict[str, object]:
    """How a source is read, where that is not the default, as a log's metadata says it."""
    concave = getattr(source, "concave", "decompose")
    return dict(getattr(source, "options", {})) | ({} if concave == "decompose" else {"concave": concave})
