"""Where a session tells viewers what it has to say."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple, Protocol

from spatial_replay.logs.block import Messages
from spatial_replay.runs.live.transport import State


class Level(Enum):
    """How much a note matters."""

    INFO = auto()
    WARNING = auto()
    ERROR = auto()


class Note(NamedTuple):
    """A sentence that viewers show beside the data; it takes the place of one about the same."""

    about: str
    level: Level
    text: str


class Outlet(Protocol):
    """All viewers together. Nothing here waits for a viewer, nor fails because of one."""

    def wants(self, topic: str) -> bool:
        """Whether anybody has subscribed to a topic."""

    def publish(self, messages: Messages) -> None:
        """Send messages to whoever has subscribed to their topics."""

    def tell_state(self, state: State) -> None:
        """Say what the playback does, where that is not the answer to a viewer."""

    def tell_time(self, time_ns: int) -> None:
        """Say at which time of the log the playback is."""

    def tell_values(self, values: Mapping[str, float | str]) -> None:
        """Say what the constants are, where that is not the answer to a viewer."""

    def tell(self, note: Note) -> None:
        """Show a note."""
