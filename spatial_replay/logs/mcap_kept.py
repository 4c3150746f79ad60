"""What an MCAP log keeps beside its messages: attachments and metadata."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import BinaryIO

from mcap import records

from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.mcap_directory import Directory
from spatial_replay.logs.mcap_records import RECORD_HEAD, DamageError, decoded
from spatial_replay.logs.sink import Attachment


def iter_attachments(
    stream: BinaryIO, directory: Directory, faults: FaultList, name: str
) -> Iterator[Attachment]:
    """The attachments of a file that can be read; the others go to `faults`."""
    for offset, length in directory.attachments:
        stream.seek(offset + RECORD_HEAD.size)
        body = stream.read(length - RECORD_HEAD.size)
        checksum = int.from_bytes(body[-4:], "little")
        try:
            if checksum and zlib.crc32(body[:-4]) != checksum:
                raise DamageError("an attachment's checksum does not fit")
            record = decoded(records.Attachment.read, body)
        except DamageError as damage:
            faults.add(f"{name}: at byte {offset}: {damage}; the attachment is lost")
            continue
        yield Attachment(record.name, record.media_type, record.data)


def iter_metadata(
    stream: BinaryIO, directory: Directory, faults: FaultList, name: str
) -> Iterator[tuple[str, Mapping[str, str]]]:
    """The metadata records of a file that can be read, with their names; the others go to `faults`."""
    for offset, length in directory.metadata:
        stream.seek(offset + RECORD_HEAD.size)
        try:
            record = decoded(records.Metadata.read, stream.read(length - RECORD_HEAD.size))
        except DamageError as damage:
            faults.add(f"{name}: at byte {offset}: {damage}; the metadata is lost")
            continue
        yield record.name, MappingProxyType(record.metadata)


def check_kept(stream: BinaryIO, directory: Directory, faults: FaultList, name: str) -> None:
    """Tell `faults` what cannot be read: whoever copies the log loses it."""
    for kept in (iter_attachments, iter_metadata):
        for _ in kept(stream, directory, faults, name):
            pass
