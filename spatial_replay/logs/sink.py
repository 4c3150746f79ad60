"""Sinks: where messages go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from spatial_replay.logs.block import Messages


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file kept in a log."""

    name: str
    media_type: str
    data: bytes = field(repr=False)


class Sink(Protocol):
    """A log being written."""

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record."""

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file to be kept in the log."""

    def write_messages(self, messages: Messages) -> None:
        """Add messages, in the order given."""


class MemorySink:
    """A log in memory, for tests and for whoever wants messages rather than a file."""

    def __init__(self) -> None:
        self.metadata: list[tuple[str, Mapping[str, str]]] = []
        self.attachments: list[Attachment] = []
        self.messages: list[Messages] = []

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """See `Sink`."""
        self.metadata.append((name, dict(data)))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """See `Sink`."""
        self.attachments.append(Attachment(name, media_type, data))

    def write_messages(self, messages: Messages) -> None:
        """See `Sink`."""
        self.messages.append(messages)
