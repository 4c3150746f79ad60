"""The command line: one file per command; each parses, calls one function, and shows the result."""

from __future__ import annotations

from spatial_replay.cli.application import main

__all__ = ["main"]
