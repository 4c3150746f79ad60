"""Records of ROS 1 bags: heads with named fields, chunks with records inside."""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mcap_chunks import LARGEST_CHUNK
from spatial_replay.logs.mcap_records import DamageError

BAG_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
LONGEST_HEAD = 2**20
_ALWAYS_ALLOWED, _MOST_TIMES_LARGER = 2**26, 1_000
"""Bytes, and times its own size, that a chunk may decompress to: no recorder's chunk needs more."""
_SECOND_NS = 1_000_000_000
# op=, conn=, time= begin with these
_C, _I, _O, _P, _T = b"ciopt"


class RecordTable(NamedTuple):
    """N records of a chunk, in the order in which they stand.

    Attributes:
        opcode, connection, time_ns: (N,) int64; -1 where the head does not say.
        head: (N,) int64, where the head's fields begin.
        begin, end: (N,) int64, where the data stand.
    """

    opcode: Integers
    connection: Integers
    time_ns: Integers
    head: Integers
    begin: Integers
    end: Integers


def fields_of(head: bytes) -> dict[str, bytes]:
    """The fields of a record's head, or of a connection's data, by name.

    Raises:
        DamageError: they do not fill it exactly.
    """
    fields: dict[str, bytes] = {}
    for field in _iter_fields(head):
        name, separator, value = field.partition(b"=")
        if not separator:
            raise DamageError("a field of a record's head has no name")
        fields[name.decode("latin-1")] = value
    return fields


def _iter_fields(head: bytes) -> Iterator[bytes]:
    position = 0
    while position < len(head):
        length = int.from_bytes(head[position : position + 4], "little")
        position += 4 + length
        if position > len(head):
            raise DamageError("a record's head breaks off")
        yield head[position - length : position]


def number(fields: dict[str, bytes], name: str, size: int = 4) -> int:
    """A field that is a little-endian number of so many bytes.

    Raises:
        DamageError: it is missing, or of another size.
    """
    value = fields.get(name, b"")
    if len(value) != size:
        raise DamageError(f"a record has no field {name!r} of {size} bytes")
    return int.from_bytes(value, "little")


def time_from(value: int) -> int:
    """Nanoseconds from seconds in the lower and nanoseconds in the upper half of a word."""
    return (value & 0xFFFFFFFF) * _SECOND_NS + (value >> 32)


def decompressed(compression: bytes, data: bytes, size: int) -> bytes:
    """The records of a chunk.

    Raises:
        DamageError: it does not decompress to `size` bytes.
    """
    most = max(_ALWAYS_ALLOWED, _MOST_TIMES_LARGER * len(data))
    if size > LARGEST_CHUNK or (compression != b"none" and size > most):
        raise DamageError(f"the chunk claims to hold {size} bytes in {len(data)}")
    try:
        match compression:
            case b"none":
                content = data
            case b"bz2":
                content = bz2.BZ2Decompressor().decompress(data, size + 1)
            case b"lz4":
                content = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
            case _:
                raise DamageError(f"the chunk is compressed as {compression!r:.40}; known are none, bz2, lz4")
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise DamageError(f"the chunk does not decompress ({error})") from None
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    return content


def record_table(content: bytes) -> tuple[RecordTable, bool]:
    """The records in a chunk's content, and whether the last of them breaks off."""
    view = np.frombuffer(content, np.uint8)
    count, _ = _walk(view, np.empty((6, 0), np.int64))
    table = np.empty((6, count), np.int64)
    _, end = _walk(view, table)
    return RecordTable(*table), end < len(content)


@piece
def _u32(content: NDArray[np.uint8], at: int) -> int:
    """A little-endian word."""
    word = 0
    for k in range(4):
        word += int(content[at + k]) << (8 * k)
    return word


@piece
def _head(content: NDArray[np.uint8], head: int, data: int) -> tuple[int, int, int]:
    """Opcode, connection and time in the fields of a head, each -1 where it is missing."""
    opcode = connection = time_ns = -1
    at = head
    while at + 4 <= data:
        length = _u32(content, at)
        at += 4
        if at + length > data:
            break
        first, second = content[at], content[at + 1]
        if length == 4 and first == _O and second == _P:
            opcode = int(content[at + 3])
        elif length == 9 and first == _C and second == _O:
            connection = _u32(content, at + 5)
        elif length == 13 and first == _T and second == _I:
            time_ns = _u32(content, at + 5) * _SECOND_NS + _u32(content, at + 9)
        at += length
    return (opcode if at == data else -1), connection, time_ns


@kernel
def _walk(content: NDArray[np.uint8], table: NDArray[np.int64]) -> tuple[int, int]:
    """Fill in as many records as there is room for; how many there are, and where the last whole one ends."""
    size = content.shape[0]
    position = 0
    count = 0
    while position + 8 <= size:
        head = position + 4
        data = head + _u32(content, position)
        if data + 4 > size:
            break
        begin = data + 4
        end = begin + _u32(content, data)
        if end > size:
            break
        opcode, connection, time_ns = _head(content, head, data)
        if opcode < 0:
            break
        if count < table.shape[1]:
            table[0, count], table[1, count], table[2, count] = opcode, connection, time_ns
            table[3, count], table[4, count], table[5, count] = head, begin, end
        position = end
        count += 1
    return count, position
