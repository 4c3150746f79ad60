"""MCAP records to and from bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BytesIO
from typing import TypeVar

from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the body that follows."""

_Record = TypeVar("_Record")


class DamageError(Exception):
    """Bytes that are not what they should be; its text says what is wrong, the catcher knows where."""


def encoded(*several: records.McapRecord) -> bytes:
    """Records one after the other, each with its head."""
    builder = RecordBuilder()
    for record in several:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def decoded(read: Callable[[ReadDataStream], _Record], body: bytes) -> _Record:
    """The record in a body.

    Raises:
        DamageError: the body is too short, or holds impossible lengths or texts that are not UTF-8.
    """
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise DamageError(f"a record cannot be read ({type(error).__name__}: {error})") from None
