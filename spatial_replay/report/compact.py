"""The compact forms of what a page carries: arrays, JSON, and sentences with formulas in them.

Arrays are little-endian bytes one after the other, compressed, in Base64.
"""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Mapping
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Kind: TypeAlias = Literal["f8", "f4", "i4", "u2", "u1"]
"""Numbers of an array in the page: float64, float32, int32, uint16, uint8."""
Reference: TypeAlias = Mapping[str, Any]
"""Where an array lies in the page: its kind, the offset of its first byte, how many numbers it has."""

_ALIGNMENT: Final = 8
_LEVEL: Final = 6


class Packing:
    """Collects the arrays of one page."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0

    def add(self, array: NDArray[Any], kind: Kind) -> Reference:
        """Take in an array, flattened by rows, and return where the page finds it."""
        data = np.ascontiguousarray(array, f"<{kind}").tobytes()
        reference = {"kind": kind, "offset": self._size, "length": int(np.size(array))}
        self._pieces += [data, bytes(-len(data) % _ALIGNMENT)]
        self._size += len(data) + len(self._pieces[-1])
        return reference

    def text(self) -> str:
        """Return everything taken in as a text without characters that HTML interprets."""
        return base64.b64encode(zlib.compress(b"".join(self._pieces), _LEVEL)).decode("ascii")


def singles(numbers: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return numbers in single precision; one below 0 stays below 0, however near."""
    with np.errstate(over="ignore", under="ignore"):
        near = numbers.astype(np.float32)
    smallest = np.finfo(np.float32).smallest_subnormal
    return np.where((numbers < 0.0) & (near == 0.0), -smallest, near)


def json_text(value: Any) -> str:
    """Return JSON that is safe within a script element, with any texts in it."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


_CODE: Final = re.compile(
    r"""
    (?<![^\s(]) `                           # what quotes a formula follows a space or a parenthesis
    ( (?: "(?:[^"\\]|\\.)*" | [^`"] )*    # a name in its own quotes may have such signs in it
      (?: "[^"]*… )? )                       # and may be cut short
    ` (?= [\s,.:;)] | $ )
    """,
    re.VERBOSE,
)


def sentence_parts(sentence: str) -> list[str]:
    """Split a sentence into text and code, in turn, beginning with text.

    Code is between backquotes, which names of objects may contain, too.
    """
    return _CODE.split(sentence)
