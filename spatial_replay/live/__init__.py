"""A running robot, monitored: messages over Foxglove's WebSocket protocol in; verdicts, logs and clips out.

    client   one connection: it is kept up, and its messages wait in a bounded inbox
    session  messages to samples, samples to verdicts, logs, clips and viewers

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.live.session import LiveSession, LiveUpdate, SessionStatus, monitor, open_recorders

__all__ = ["LiveSession", "LiveUpdate", "SessionStatus", "monitor", "open_recorders"]

__getattr__, __dir__ = lazy_attributes(globals())
