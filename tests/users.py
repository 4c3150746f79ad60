"""Tests that go on as another user."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_PLAIN = 65534


@contextmanager
def plain_user() -> Iterator[None]:
    """Be a user who may not read everything, also in tests by root."""
    before = os.geteuid()
    if before == 0:
        os.seteuid(_PLAIN)
    try:
        yield
    finally:
        os.seteuid(before)
