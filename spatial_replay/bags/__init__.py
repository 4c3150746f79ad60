"""Logs of messages that other software recorded: ROS 1 and ROS 2 bags, MCAP in any encoding.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.bags.decoders import Decoder, Topic
    from spatial_replay.bags.open import open_messages
    from spatial_replay.bags.reader import Message, MessageReader

__all__ = ["Decoder", "Message", "MessageReader", "Topic", "open_messages"]

__getattr__, __dir__ = loaded_when_used(globals())
