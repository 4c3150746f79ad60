"""Open a log of messages: the content of the file or folder decides which reader."""

from __future__ import annotations

from pathlib import Path

from spatial_replay.bags.folder import BagFolder
from spatial_replay.bags.mcap_log import McapLog
from spatial_replay.bags.reader import MessageReader
from spatial_replay.bags.ros1 import Ros1Bag
from spatial_replay.bags.ros1_index import BAG_MAGIC
from spatial_replay.bags.sqlite import SQLITE_MAGIC, SqliteBag
from spatial_replay.errors import LogError, MissingFileError
from spatial_replay.logs.remote import LogFile, open_file
from spatial_replay.logs.topics import MAGIC

READERS: dict[bytes, type[MessageReader]] = {BAG_MAGIC: Ros1Bag, SQLITE_MAGIC: SqliteBag, MAGIC: McapLog}
"""The reader of a file, by its first bytes."""


def is_log(path: LogFile) -> bool:
    """Return whether a file or a folder looks like a log of messages.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
    """
    head = _head(path)
    return head is None or any(head.startswith(magic) for magic in READERS)


def open_messages(path: LogFile) -> MessageReader:
    """Return a reader of the log in a file or a folder; the content decides, not the name.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: it is not a log of messages.
    """
    head = _head(path)
    if head is None and isinstance(path, Path):
        return BagFolder(path)
    for magic, reader in READERS.items():
        if head is not None and head.startswith(magic):
            return reader(path)
    raise LogError(f"{path.name} is neither a ROS bag nor an MCAP log")


def _head(path: LogFile) -> bytes | None:
    """Return the first bytes of a file; None of a folder.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
    """
    try:
        if isinstance(path, Path) and path.is_dir():
            return None
        with open_file(path) as stream:
            return stream.read(len(SQLITE_MAGIC))
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
