"""CRC-32 checksums, as MCAP logs and our caches have them."""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import elementwise, inlined, kernel
from spatial_replay.geometry.arrays import Integers

try:
    # with the processor's product of polynomials, ten times as fast as zlib
    from isal.isal_zlib import crc32
except ImportError:
    # it is not built for all processors
    from zlib import crc32

_POLYNOMIAL = 0xEDB88320
"""Of CRC-32, the highest power in the lowest bit."""

__all__ = ["crc32", "joined_checksum"]


def joined_checksum(checksums: list[int], sizes: list[int]) -> int:
    """Return the CRC-32 of contents one after the other, from the CRC-32 of each and their sizes in bytes."""
    return int(_joined(np.array(checksums, np.int64), np.array(sizes, np.int64)))


@elementwise
@kernel
def _joined(checksums: Integers, sizes: Integers) -> int:
    joined = 0
    for i in range(checksums.shape[0]):
        # x to the power of the bits of this content, modulo the polynomial, by squaring
        power, square, rest = 1 << 31, 1 << 23, sizes[i]
        while rest > 0:
            if rest & 1:
                power = _product(square, power)
            square = _product(square, square)
            rest >>= 1
        joined = _product(power, joined) ^ checksums[i]
    return joined


@inlined
def _product(a: int, b: int) -> int:
    """Multiply two polynomials over bits, modulo that of CRC-32."""
    product = 0
    for _ in range(32):
        if a & 0x80000000:
            product ^= b
        a = (a << 1) & 0xFFFFFFFF
        b = (b >> 1) ^ _POLYNOMIAL if b & 1 else b >> 1
    return product
