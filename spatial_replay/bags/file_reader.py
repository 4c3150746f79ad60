"""What readers of logs in one file have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from pathlib import Path

from spatial_replay.bags.columns import Columns, one_by_one
from spatial_replay.bags.decoders import decoder_of
from spatial_replay.bags.reader import Decoder, Message, Topic
from spatial_replay.errors import LogError
from spatial_replay.logs.read_options import FaultList


class OneFile(ABC):
    """A log in one file; see `MessageReader` and `ColumnReader`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._faults = FaultList()

    @property
    @abstractmethod
    def _topics(self) -> tuple[Topic, ...]:
        """The topics that the file tells of."""

    @abstractmethod
    def iter_columns(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        as_recorded: bool = False,
    ) -> Columns:
        """See `ColumnReader.iter_columns`."""

    @property
    def name(self) -> str:
        return self._path.name

    def topics(self) -> tuple[Topic, ...]:
        """See `MessageReader.topics`."""
        if not self._topics:
            reason = next(iter(self._faults.take()), "it is empty")
            raise LogError(f"{self.name} holds no topic: {reason}")
        return self._topics

    def decoder(self, topic: str) -> Decoder:
        """See `MessageReader.decoder`."""
        return decoder_of(next(each for each in self._topics if each.name == topic))

    def take_faults(self) -> tuple[str, ...]:
        """See `MessageReader.take_faults`."""
        return self._faults.take()

    def move_faults(self, other: FaultList) -> None:
        """See `MessageReader.move_faults`."""
        self._faults.move_to(other)

    def take_remarks(self) -> tuple[str, ...]:
        """See `MessageReader.take_remarks`; a single file gives rise to none."""
        return ()

    def iter_messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """See `MessageReader.iter_messages`."""
        return one_by_one(self.iter_columns(topics, start_ns, end_ns))
