"""Serve: a log played to viewers over WebSocket, with the constants of its specifications as parameters.

`server` starts and ends it all. `player` has what viewers share, and the thread that does what they request.
Requests arrive in `server` on threads of its library, through `relay`.
"""
