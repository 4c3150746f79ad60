"""The heads of the records in a chunk, found in one compiled pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Integers

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint64]

_RECORD_HEAD = 9
_MESSAGE_FIELDS = 22
_SCHEMA, _CHANNEL, _MESSAGE = 3, 4, 5


class RecordHeads(NamedTuple):
    """N schemas, channels and messages.

    Attributes:
        opcode: (N,) int64.
        begin, end: (N,) int64, where their bodies stand.
        channel, sequence, log_time, publish_time: (N,) uint64, of messages; 0 for other records.
    """

    opcode: Integers
    begin: Integers
    end: Integers
    channel: Words
    sequence: Words
    log_time: Words
    publish_time: Words


def walk_records(content: bytes) -> tuple[RecordHeads, bool]:
    """The schemas, channels and messages in some bytes, and whether the last record breaks off."""
    view = np.frombuffer(content, np.uint8)
    # counted first: room for as many as there could be is many times the bytes
    count, _ = _walk(view, np.empty((3, 0), np.int64), np.empty((4, 0), np.uint64))
    places = np.empty((3, count), np.int64)
    fields = np.empty((4, count), np.uint64)
    _, end = _walk(view, places, fields)
    return RecordHeads(*places, *fields), end < len(content)


@piece
def _word(content: Bytes, begin: int, size: int) -> int:
    """A little-endian number of `size` bytes."""
    word = np.uint64(0)
    for k in range(size):
        word |= np.uint64(content[begin + k]) << np.uint64(8 * k)
    return word  # type: ignore[return-value]


@kernel
def _walk(content: Bytes, places: Integers, fields: Words) -> tuple[int, int]:
    """Fill in as many as there is room for; how many there are, and where the last whole record ends."""
    size = content.shape[0]
    position = 0
    count = 0
    while position + _RECORD_HEAD <= size:
        length = _word(content, position + 1, 8)
        begin = position + _RECORD_HEAD
        if length > np.uint64(size - begin):
            break
        end = begin + int(length)
        opcode = content[position]
        is_message = opcode == _MESSAGE and end - begin >= _MESSAGE_FIELDS
        if is_message or _SCHEMA <= opcode <= _CHANNEL:
            if count < places.shape[1]:
                places[0, count], places[1, count], places[2, count] = opcode, begin, end
                fields[0, count] = fields[1, count] = fields[2, count] = fields[3, count] = 0
                if is_message:
                    fields[0, count] = _word(content, begin, 2)
                    fields[1, count] = _word(content, begin + 2, 4)
                    fields[2, count] = _word(content, begin + 6, 8)
                    fields[3, count] = _word(content, begin + 14, 8)
            count += 1
        position = end
    return count, position
