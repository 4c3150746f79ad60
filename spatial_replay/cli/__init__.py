"""The command line. The file of a command parses options, calls one function, and prints the result.

Commands import the numerical libraries inside their functions, so that `--help` answers at once.
"""

from __future__ import annotations

from spatial_replay.cli.application import main, run

__all__ = ["main", "run"]
