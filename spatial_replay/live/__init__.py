"""Monitor a running robot over Foxglove's WebSocket protocol.

    client   connection with reconnects, and a bounded inbox of its messages
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
