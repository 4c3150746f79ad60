"""Playback of a log to viewers over WebSocket, with the constants of its specifications as parameters.

`server` starts and stops the server. `player` has the state that all viewers share, and the thread that
performs their requests. Requests pass `relay` and arrive in `server` on threads of the Foxglove SDK.
"""
