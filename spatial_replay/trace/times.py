"""The times that samples can have: whole nanoseconds that fit a signed 64-bit number."""

from __future__ import annotations

LATEST_NS = 2**63 - 1
"""The latest time of a sample."""

FOREVER = LATEST_NS + 1
"""A time after every sample."""
