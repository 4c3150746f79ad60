"""Our own logs and the track formats: messages, samples, and files of both.

Names are loaded when they are first used: a command that reads a track file needs no MCAP.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.logs.mcap.read import McapSource, summarise_mcap
    from spatial_replay.logs.mcap.write import LogWriter
    from spatial_replay.logs.messages import (
        Attachment,
        Block,
        Channel,
        MemorySink,
        MemorySource,
        Messages,
        Schema,
        Source,
    )
    from spatial_replay.logs.objects import decode_objects, encode_objects

__all__ = [
    "Attachment",
    "Block",
    "Channel",
    "LogWriter",
    "McapSource",
    "MemorySink",
    "MemorySource",
    "Messages",
    "Schema",
    "Source",
    "decode_objects",
    "encode_objects",
    "summarise_mcap",
]

__getattr__, __dir__ = loaded_when_used(globals())
