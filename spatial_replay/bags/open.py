"""Logs of messages by what a file or folder holds."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Protocol

from spatial_replay.bags.columns import Columns
from spatial_replay.bags.folder import BagFolder
from spatial_replay.bags.mcap_log import McapLog
from spatial_replay.bags.reader import MessageReader
from spatial_replay.bags.ros1 import Ros1Bag
from spatial_replay.bags.ros1_index import BAG_MAGIC
from spatial_replay.bags.sqlite import SQLITE_MAGIC, SqliteBag
from spatial_replay.errors import LogError, MissingFileError
from spatial_replay.logs.mcap.chunks import MAGIC


class ColumnReader(MessageReader, Protocol):
    """A reader that hands on many messages at once."""

    def iter_columns(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        as_recorded: bool = False,
    ) -> Columns:
        """What `iter_messages` gives, as columns.

        Args:
            as_recorded: in the order of recording instead, which may jump back in time.
        """


def open_messages(path: Path) -> ColumnReader:
    """A reader of the log in a file or a folder; the content decides, not the name.

    Raises:
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: it is no log of messages.
    """
    try:
        if path.is_dir():
            return BagFolder(path)
        with path.open("rb") as stream:
            head = stream.read(len(SQLITE_MAGIC))
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    if head.startswith(BAG_MAGIC):
        return Ros1Bag(path)
    if head.startswith(SQLITE_MAGIC):
        return SqliteBag(path)
    if head.startswith(MAGIC):
        return McapLog(path)
    raise LogError(f"{path.name} is no ROS bag and no MCAP log")
