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


def open_messages(path: LogFile) -> MessageReader:
    """Return a reader of the log in a file or a folder; the content decides, not the name.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: it is not a log of messages.
    """
    try:
        if isinstance(path, Path) and path.is_dir():
            return BagFolder(path)
        with open_file(path) as stream:
            head = stream.read(len(SQLITE_MAGIC))
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    for magic, reader in READERS.items():
        if head.startswith(magic):
            return reader(path)
    raise LogError(f"{path.name} is neither a ROS bag nor an MCAP log")
