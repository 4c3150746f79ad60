"""Lines of a text file, plain or gzip, that may be damaged anywhere."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from spatial_replay.logs.faults import FaultList

GZIP_MAGIC = b"\x1f\x8b"
LONGEST_LINE = 16 * 2**20
"""Bytes; a line beyond this is no sample but a file of another kind, or damage."""


def open_text(path: Path) -> BinaryIO:
    """The file's bytes, decompressed if it begins as a gzip file does, whatever its name."""
    with path.open("rb") as stream:
        magic = stream.read(len(GZIP_MAGIC))
    return cast(BinaryIO, gzip.open(path, "rb")) if magic == GZIP_MAGIC else path.open("rb")


def iter_lines(path: Path, faults: FaultList) -> Iterator[tuple[int, str]]:
    """Each line that is not blank with its number, counted from 1; what cannot be read goes to `faults`."""
    number = 0
    with open_text(path) as stream:
        while True:
            number += 1
            try:
                line = stream.readline(LONGEST_LINE)
                too_long = len(line) == LONGEST_LINE and not line.endswith(b"\n")
                while too_long and (rest := stream.readline(LONGEST_LINE)) and not rest.endswith(b"\n"):
                    pass
            except (EOFError, zlib.error, gzip.BadGzipFile) as error:
                faults.add(f"{path.name}:{number}: the compressed data breaks off here ({error})")
                return
            if not line:
                return
            if too_long:
                faults.add(f"{path.name}:{number}: the line is longer than {LONGEST_LINE} bytes")
                continue
            try:
                text = line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                faults.add(f"{path.name}:{number}: byte {error.start + 1} of the line is not UTF-8")
                continue
            if not text.isspace():
                yield number, text
