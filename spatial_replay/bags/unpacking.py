"""Decompressed copies of files that cannot be read in place, and messages that are compressed each."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard

from spatial_replay.errors import LogError, OutputError
from spatial_replay.logs.mcap.index import LARGEST_CHUNK
from spatial_replay.logs.mcap.read import ALWAYS_ALLOWED, MOST_TIMES_LARGER
from spatial_replay.logs.output_file import open_output, output_error
from spatial_replay.logs.read_options import FaultList

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 2**20
_PACKED_PIECE = 2**12
"""Compressed bytes at a time: few, since each may stand for 32,000."""
_LEFT_FREE = 2**26
"""Bytes of a disk that are never filled; of a small one, a tenth."""


def temporary_folder(owner: object) -> Path:
    """Make a folder that is removed with its owner.

    Raises:
        OutputError: the machine cannot make it.
    """
    try:
        folder = tempfile.mkdtemp(prefix="spatial-replay-")
    except OSError as error:
        raise output_error(Path("a temporary folder"), error) from error
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def copy_beginning(path: Path, size: int, folder: Path) -> Path:
    """Copy the first `size` bytes of a file into a folder."""
    target = folder / path.name
    with path.open("rb") as source, open_output(target) as sink:
        while size > 0 and (piece := source.read(min(size, _PIECE))):
            sink.write(piece)
            size -= len(piece)
    return target


def unpack_file(packed: Path, folder: Path, faults: FaultList) -> Path:
    """Decompress a file into a folder; return its path there, without the suffix of the compression.

    Args:
        faults: takes where it breaks off.

    Raises:
        LogError: it does not decompress, or to something absurdly large.
        OutputError: the folder has no room for it.
    """
    target = folder / (packed.stem if packed.suffix in (".zstd", ".zst") else packed.name)
    most = packed.stat().st_size * MOST_TIMES_LARGER + ALWAYS_ALLOWED
    free = shutil.disk_usage(folder).free
    room = free - min(_LEFT_FREE, free // 10)
    written = 0
    damage = "breaks off"
    try:
        with packed.open("rb") as source, open_output(target) as sink:
            for piece, is_between in _decompressed(source):
                written += len(piece)
                if written > most:
                    raise LogError(
                        f"{packed.name} decompresses to more than {most} bytes; no recorder writes that"
                    )
                if written > room:
                    raise OutputError(
                        f"{packed.name} decompresses to more than fits in {folder.parent};"
                        " set TMPDIR to a folder with more room"
                    )
                sink.write(piece)
                damage = "" if is_between else "breaks off"
    except zstandard.ZstdError as error:
        damage = f"does not decompress to its end ({error})"
    if not written:
        raise LogError(f"{packed.name} {damage or 'is empty'}; nothing in it can be decompressed")
    if damage:
        faults.add(f"{packed.name} {damage}; {written} bytes could be decompressed")
    return target


def _decompressed(source: BinaryIO) -> Iterator[tuple[bytes, bool]]:
    """Yield what the frames of a file decompress to, and whether the last frame so far is whole."""
    frame, rest = None, b""
    while piece := rest or source.read(_PACKED_PIECE):
        frame = frame or zstandard.ZstdDecompressor().decompressobj()
        content, rest = frame.decompress(piece), b""
        if frame.eof:
            rest = frame.unused_data
            frame = None
        yield content, frame is None


def unpacked_size(payload: bytes) -> int:
    """Return how many bytes a message that may be compressed decompresses to, at most."""
    try:
        size = zstandard.frame_content_size(payload)
    except zstandard.ZstdError:
        return len(payload)
    return size if size >= 0 else ALWAYS_ALLOWED


def unpacked(payload: bytes) -> bytes:
    """Decompress a message that was compressed by itself.

    Raises:
        LogError: it does not decompress, or to more than a chunk of an MCAP log may.
    """
    try:
        size = zstandard.frame_content_size(payload)
        most = min(LARGEST_CHUNK, max(ALWAYS_ALLOWED, MOST_TIMES_LARGER * len(payload)))
        if size > most:
            raise LogError(f"a message claims to hold {size} bytes in {len(payload)}")
        return zstandard.ZstdDecompressor().decompress(payload, max_output_size=most)
    except zstandard.ZstdError as error:
        raise LogError(f"a message does not decompress ({error})") from None
