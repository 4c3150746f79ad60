"""The interface of every log of messages: topics, raw messages, and a way to decode them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from spatial_replay.bags.columns import Columns, Message, iter_counted, one_by_one
from spatial_replay.bags.decoders import Decoder, Topic, decoder_of
from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Attachment, Channel
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile
from spatial_replay.text import encodable
from spatial_replay.trace.sample import LATEST_NS


class MessageReader(ABC):
    """A log of messages in a file or folder, which is read again for each iteration.

    Attributes:
        kind: the format, in a word.
    """

    kind: str

    def __init__(self, path: LogFile) -> None:
        # readers that open paths get none of a remote file
        self._path = path if isinstance(path, Path) else Path(path.name)
        self._faults = FaultList()

    @property
    @abstractmethod
    def _topics(self) -> tuple[Topic, ...]:
        """The topics that the log declares, by name."""

    @property
    def profile(self) -> str:
        """Return how an MCAP log with its messages names their origin."""
        return {"ROS 1 bag": "ros1", "ROS 2 bag": "ros2"}.get(self.kind, "")

    @property
    def _distribution(self) -> str | None:
        """The ROS release that the log names, for types that it does not define."""
        return None

    @property
    @abstractmethod
    def start_ns(self) -> int | None:
        """Log time of the first message."""

    @abstractmethod
    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        """Yield the messages of some topics logged from `first` up to, not including, `last`."""

    @abstractmethod
    def channels(self, topics: Collection[str]) -> Mapping[int, Channel]:
        """Return the channels of some topics by the numbers of `MessageColumns.channel`, which are dense.

        A copy of a log declares them: their schema, encoding and metadata are those of the log. ROS types
        without a definition in the log get that of the standard type, if there is one.
        """

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the files in the log; those that are damaged are left out."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log, with their names; those that are damaged are left out."""
        return ()

    @property
    def name(self) -> str:
        """The base name of its file or folder."""
        return encodable(self._path.name or self._path.absolute().name)

    def topics(self) -> tuple[Topic, ...]:
        """Return the topics, by name.

        Raises:
            LogError: the log is too damaged, or declares no topic.
        """
        if not self._topics:
            reason = next(iter(self._faults.take()), "it is empty")
            raise LogError(f"{self.name} holds no topic: {reason}")
        return self._topics

    def decoder(self, topic: str | Topic) -> Decoder:
        """Return a decoder for the messages of a topic, by its name or as given.

        The decoder raises LogError for a payload that does not fit, with the reason.

        Raises:
            LogError: the topic's definition is missing or cannot be understood.
        """
        if isinstance(topic, str):
            topic = next(each for each in self._topics if each.name == topic)
        return decoder_of(topic, self._distribution)

    def iter_messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of some topics in the order of their log time, as far as the log keeps it.

        Args:
            start_ns, end_ns: only those logged from `start_ns` up to, not including, `end_ns`.

        Raises:
            LogError: nothing can be read.
        """
        return one_by_one(self.iter_columns(topics, start_ns, end_ns))

    def iter_columns(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        as_recorded: bool = False,
    ) -> Columns:
        """Yield what `iter_messages` gives, as columns.

        Args:
            as_recorded: in the order of recording instead, which may jump back in time.
        """
        first, last = start_ns or 0, LATEST_NS + 1 if end_ns is None else min(end_ns, LATEST_NS + 1)
        columns = self._read(topics, first, last, as_recorded=as_recorded)
        yield from self._counted(columns, topics) if (first, last) == (0, LATEST_NS + 1) else columns

    def take_faults(self) -> tuple[str, ...]:
        """Return what was lost since the last call, each with its place, on the topics that were read."""
        return self._faults.take()

    def move_faults(self, other: FaultList) -> None:
        """Move what `take_faults` would return to another list, with the count of faults beyond its limit."""
        self._faults.move_to(other)

    def take_remarks(self) -> tuple[str, ...]:
        """Return what is wrong since the last call without a loss on the topics that were read."""
        return ()

    def _counted(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        """Yield all messages of some topics, then compare their number with what the log declares."""
        declared = {each.name: each.count for each in self._topics if each.name in topics}
        return iter_counted(columns, declared, name or self.name, self._faults)
