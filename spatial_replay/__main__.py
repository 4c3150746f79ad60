"""`python -m spatial_replay` is `spatial-replay`."""

from __future__ import annotations

from spatial_replay.cli import main

if __name__ == "__main__":
    main()
