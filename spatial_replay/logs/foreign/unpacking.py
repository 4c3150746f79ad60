"""Files that cannot be read in place: decompressed, or without a broken end. Messages compressed each."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from pathlib import Path

import zstandard

from spatial_replay.errors import LogError
from spatial_replay.logs.mcap_chunks import LARGEST_CHUNK

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 2**20
_MOST_TIMES_LARGER = 1_000
_ALWAYS_ALLOWED = 2**26


def temporary_folder(owner: object) -> Path:
    """A folder that goes away with its owner."""
    folder = tempfile.mkdtemp(prefix="spatial-replay-")
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def copy_beginning(path: Path, size: int, folder: Path) -> Path:
    """Copy the first `size` bytes of a file into a folder."""
    target = folder / path.name
    with path.open("rb") as source, target.open("wb") as sink:
        while size > 0 and (piece := source.read(min(size, _PIECE))):
            sink.write(piece)
            size -= len(piece)
    return target


def unpack_file(packed: Path, folder: Path) -> Path:
    """Decompress a file into a folder; what its name is there, without the ending of the compression.

    Raises:
        LogError: it does not decompress, or to something absurdly large.
    """
    target = folder / (packed.stem if packed.suffix in (".zstd", ".zst") else packed.name)
    most = packed.stat().st_size * _MOST_TIMES_LARGER + _ALWAYS_ALLOWED
    written = 0
    try:
        with packed.open("rb") as source, target.open("wb") as sink:
            reader = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
            while piece := reader.read(_PIECE):
                written += len(piece)
                if written > most:
                    raise LogError(
                        f"{packed.name} decompresses to more than {most} bytes; no recorder's file does"
                    )
                sink.write(piece)
    except zstandard.ZstdError as error:
        if not written:
            raise LogError(f"{packed.name} does not decompress ({error})") from None
        # what came before the damage is a log that breaks off, and is reported as one
    return target


def unpacked(payload: bytes) -> bytes:
    """A message that was compressed by itself.

    Raises:
        LogError: it does not decompress.
    """
    try:
        size = zstandard.frame_content_size(payload)
        if size > LARGEST_CHUNK:
            raise LogError(f"a message claims to hold {size} bytes")
        most = size if size >= 0 else min(LARGEST_CHUNK, len(payload) * _MOST_TIMES_LARGER + _PIECE)
        return zstandard.ZstdDecompressor().decompress(payload, max_output_size=most)
    except zstandard.ZstdError as error:
        raise LogError(f"a message does not decompress ({error})") from None
