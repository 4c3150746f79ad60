"""Serve: a log played to viewers over WebSocket, with the constants of its specifications as parameters.

`serving` starts and ends it all. `player` has what viewers share, and the thread that does what they request.
Requests arrive in `server` on threads of its library, through `relay`; `services` answers questions.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.serve.serving import Serving, open_server

__all__ = ["Serving", "open_server"]

__getattr__, __dir__ = loaded_when_used(globals(), {"serving": ("Serving", "open_server")})
