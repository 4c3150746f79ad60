"""Open any log: the content of a file decides its format, and `FORMATS` names the reader of each.

Readers that take long to load are loaded when there is a log for them.
"""

from __future__ import annotations

import os
import re
import shlex
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from reprlib import repr as shortened
from stat import S_ISDIR, S_ISREG
from typing import NamedTuple, Unpack
from urllib.parse import quote

from spatial_replay.errors import LogError, MissingFileError, RemoteError, SpatialReplayError, UsageError
from spatial_replay.logs.formats.datasets import data_set_address, open_data_set
from spatial_replay.logs.formats.tracks import (
    CSV_COLUMNS,
    FRAMES_A_SECOND,
    is_annotations,
    iter_annotations,
    iter_csv,
    iter_jsonl,
    open_text,
)
from spatial_replay.logs.read_options import Reading, ReadOptions, count_of
from spatial_replay.logs.remote import (
    BAG_METADATA,
    LogFile,
    RemoteFile,
    download,
    download_files,
    is_web,
    log_file,
)
from spatial_replay.logs.source import IterTraces, Source, TrackSource
from spatial_replay.logs.topics import MAGIC
from spatial_replay.text import counted_from, plural, printable
from spatial_replay.trace.doubts import distinct_doubts
from spatial_replay.trace.trace import Trace
from spatial_replay.trace.units import OUR_AXES, Axes

_BAG_FILE = re.compile(r"^metadata\.yaml$|\.(db3|mcap)(\.zstd)?$")

LOG_ENDINGS = (".mcap", ".bag", ".db3", ".jsonl", ".jsonl.gz", ".csv", ".xml")
"""Endings of the names of logs."""
_MOST_LOOKED_AT = 20
"""Entries of a folder without a log, in which a data set is looked for."""
_HEAD = 4096
"""Bytes by which a file's format is recognised."""


def open_source(path: str | PathLike[str], **reading: Unpack[Reading]) -> Source:
    """Open the log in a file of any format; the content decides, not the name.

    Only the needed parts of an MCAP log at an address are read; a log of another format is downloaded once.

    Args:
        path: on this machine, or an address: s3://bucket/run.mcap, gs://…, az://container/…, https://…. An
            episode of a data set is the set's path with a number: push_v3#17.
        reading: how to read it; see `ReadOptions`.

    Raises:
        UsageError: no path was given, an option that means nothing to this format, or a file in none of the
            known formats.
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: the file has the name of a log, and is none.
        RemoteError: an address does not answer.
    """
    argument: object = path
    if not isinstance(argument, (str, PathLike)):
        remedy = "give the path of a log; Trace.from_samples(samples) takes samples"
        raise UsageError(f"path is {shortened(argument)}; {remedy}")
    options = ReadOptions(**reading)
    if (address := data_set_address(path)) is not None:
        return _open_episode(*address, options)
    path = readable_file(path)
    if isinstance(path, Path) and is_bag_folder(path):
        options.refuse_except(_MESSAGES, "ROS 2 bag", path.name)
        return _open_messages(path, "ROS 2 bag", options)
    if isinstance(path, Path) and path.suffix == ".json":
        _refuse_description(path)
    kind = format_of(path)
    if kind is not None:
        options.refuse_except(FORMATS[kind].options, kind, path.name)
        return FORMATS[kind].open(path, kind, options)
    if not _head(path):
        raise LogError(f"{path.name} is empty; give a log with at least one sample")
    if isinstance(path, Path) and path.name.endswith((".db3.zstd", ".mcap.zstd")):
        raise LogError(
            f"{path.name} is a compressed file of a ROS 2 bag; give its folder, {path.absolute().parent}"
        )
    if path.name.endswith(".spatial"):
        raise UsageError(f"{path.name} is a specification, not a log; give it by --spec, behind the log")
    if isinstance(path, Path):
        _refuse_data_set(path)
    message = (
        f"{path.name} is not a log in a known format; known formats are {', '.join(FORMATS)}; "
        "a video becomes a log by `record video`"
    )
    # one that is called a log is a damaged one
    raise LogError(message) if path.name.lower().endswith(LOG_ENDINGS) else UsageError(message)


def read_trace(path: str | PathLike[str], *, allow_damage: bool = False, **reading: Unpack[Reading]) -> Trace:
    """Read a whole log into memory.

    Args:
        path: a log in any format that `open_source` knows.
        allow_damage: return the readable part of a damaged log, with its `faults`.
        reading: how to read it; see `ReadOptions`.

    Raises:
        UsageError: no path was given, or an option that means nothing to this format.
        MissingFileError: there is no such file.
        LogError: the file is not a log, or is damaged and `allow_damage` is not set.
    """
    source = open_source(path, **reading)
    blocks = source.keeping().iter_blocks()
    traces = [replace(block.trace, remarks=block.remarks, doubts=block.doubts) for block in blocks]
    trace = Trace.concatenate(traces)
    first_ns = int(trace.times_ns[0]) if len(trace) else 0
    faults, doubts = counted_from(trace.faults, first_ns), distinct_doubts(trace.doubts, first_ns)
    remarks = (
        *(doubt.remark(source.name) for doubt in doubts),
        *counted_from(trace.remarks, first_ns),
    )
    if faults and not allow_damage:
        others = count_of(trace.faults) - 1
        more = f"\n… and {others} more" if others else ""
        raise LogError(f"{faults[0]}{more}; allow_damage=True reads the rest")
    return replace(trace, remarks=remarks, doubts=doubts, faults=faults, units=source.axes.units)


def readable_file(path: str | PathLike[str]) -> LogFile:
    """Return the file of a log; a remote one that cannot be read in parts is downloaded.

    Raises:
        UsageError: an address that names no file, or obstore is not installed.
        MissingFileError, RemoteError: the address cannot be read.
        LogError: the file is too large to be downloaded, or a named pipe or another that may never end.
    """
    file = log_file(path)
    if isinstance(file, RemoteFile) and (metadata := bag_metadata_at(file)) is not None:
        return downloaded_bag(metadata)
    if not isinstance(file, RemoteFile):
        try:
            _refuse_endless(file)
        except (OSError, ValueError) as error:
            raise MissingFileError.of(path, error) from None
        if file.name == BAG_METADATA and is_bag_folder(file.absolute().parent):
            # the bag, by one of its files
            return file.absolute().parent
        if file.is_dir() and not is_bag_folder(file):
            names = sorted(entry.name for entry in file.iterdir())
            _refuse_data_set(file)
            if {"format.json", "rows"}.issubset(names):
                remedy = "`results` shows them, and compares two such folders"
                raise MissingFileError(f"{path}: this folder has results of a batch; {remedy}")
            logs = [name for name in names if name.endswith((".mcap", ".bag", ".jsonl", ".jsonl.gz", ".csv"))]
            what = "no file of a ROS 2 bag (.db3, .mcap)" if names else "nothing"
            such = f", such as {printable(str(file / logs[0]))}; batch takes a folder" if logs else ""
            if inside := _data_set_in(file):
                such = f"; {printable(str(inside))} is a data set of episodes"
            raise MissingFileError(f"{path}: there is {what} in this folder; give the path of a log{such}")
        return file
    if not file.version.has_ranges:
        return download(file, "its server does not give parts of files")
    with file.open() as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return download(file, "only MCAP logs are read in parts")
        from spatial_replay.logs.mcap.index import has_summary

        if not has_summary(stream):
            return download(file, "it has no index, so all of it is read")
    return file


def _refuse_data_set(path: Path) -> None:
    """Refuse a data set of episodes, each of which is a log.

    Raises:
        UsageError: it is one.
    """
    data_set = open_data_set(path)
    if data_set is not None and data_set.episodes:
        first = printable(f"{path}#{data_set.episodes[0].number}")
        raise UsageError(
            f"{path} is a {data_set.kind} data set of {plural(len(data_set.episodes), 'episode')}; give one,"
            f" such as {first}, or all of them to `batch` or `judge`"
        )


def _refuse_description(path: Path) -> None:
    """Refuse the JSON file next to the trajectories of ManiSkill.

    Raises:
        UsageError: it is one.
    """
    trajectories = path.with_suffix(".h5")
    data_set = open_data_set(trajectories)
    if data_set is not None and data_set.kind == "ManiSkill":
        raise UsageError(f"{path.name} describes the episodes of {trajectories.name}; give {trajectories}")


def _data_set_in(folder: Path) -> Path | None:
    """Return the first data set in a folder, such as the name space of Minari's; None without one."""
    for path in sorted(folder.iterdir())[:_MOST_LOOKED_AT]:
        with suppress(SpatialReplayError):
            if open_data_set(path) is not None:
                return path
    return None


def _open_episode(path: str, number: int, options: ReadOptions) -> Source:
    """Open an episode of a data set.

    Raises:
        UsageError: there is no such episode, or no mapping although the data set needs one.
    """
    data_set = open_data_set(path)
    if data_set is None:
        raise UsageError(f"{path} is no data set of episodes; leave out #{number}")
    data_set.episode(number)
    options.refuse_except(frozenset({"mapping", "max_gap"}), data_set.kind, data_set.name)
    if options.mapping is None and not data_set.names_bodies:
        from spatial_replay.mapping.suggest_features import why_poseless

        if reason := why_poseless(data_set):
            raise UsageError(reason)
        raise UsageError(
            f"{data_set.name} is a {data_set.kind} data set, which does not say what its objects are; give a"
            " mapping file that does, with --mapping FILE or mapping=FILE; for a first one, see:"
            f" spatial-replay info {shlex.quote(path)} --suggest-mapping"
        )
    from spatial_replay.mapping.episode_source import EpisodeSource
    from spatial_replay.mapping.mapping_file import load_mapping

    mapping = None if options.mapping is None else load_mapping(options.mapping)
    if mapping is not None and mapping.topics:
        raise UsageError(
            f"{mapping.name}: topics: {data_set.name} is a data set of episodes, which has none; name its"
            " `features`"
        )
    return EpisodeSource(data_set, number, mapping, options)


def _refuse_endless(path: Path) -> None:
    """Refuse pipes, sockets and devices: to read one may wait for ever.

    Raises:
        LogError: it is one, or a folder of a bag holds one.
        OSError: there is no such file.
    """
    mode = path.stat().st_mode
    if not (S_ISREG(mode) or S_ISDIR(mode)):
        raise LogError(f"{path.name} is no regular file but a pipe, a socket or a device; give a file")
    if is_bag_folder(path):
        for file in path.iterdir():
            if _BAG_FILE.search(file.name) and file.exists() and not file.is_dir():
                _refuse_endless(file)


def bag_metadata_at(file: RemoteFile) -> RemoteFile | None:
    """Return the metadata of the ROS 2 bag whose folder is at an address; None if that is a file.

    Raises:
        MissingFileError, RemoteError: there is neither.
    """
    if file.name == BAG_METADATA:
        return file
    try:
        _ = file.version
    except MissingFileError:
        # a folder, written without the slash
        inside = RemoteFile(f"{os.fspath(file)}/{BAG_METADATA}")
        with suppress(MissingFileError, RemoteError):
            _ = inside.version
            return inside
        raise
    return None


def bag_files_at(metadata: RemoteFile) -> list[RemoteFile]:
    """Return the files of a ROS 2 bag at an address: its metadata, and those that this lists.

    Raises:
        LogError: the metadata cannot be used.
        MissingFileError, RemoteError: it cannot be read.
    """
    from spatial_replay.bags.sqlite import LARGEST_METADATA, bag_metadata_from_bytes

    folder = os.fspath(metadata).removesuffix(BAG_METADATA)
    try:
        names = bag_metadata_from_bytes(metadata.read(0, LARGEST_METADATA + 1)).files
    except MissingFileError as error:
        raise MissingFileError(
            f"{error}; a ROS 2 bag is the address of its folder, and any other log that of one file, such as "
            "s3://bucket/run.mcap"
        ) from None
    except LogError as error:
        raise LogError(f"{metadata} cannot be used: {error}; copy the bag to this machine") from None
    if is_web(metadata):
        names = tuple(map(quote, names))
    return [metadata, *(RemoteFile(folder + name) for name in names)]


def downloaded_bag(metadata: RemoteFile) -> Path:
    """Return the folder with a copy of the ROS 2 bag at an address; see `download`."""
    address = str(metadata).removesuffix(BAG_METADATA)
    name = address.rstrip("/").rpartition("/")[2].strip(".") or "bag"
    reason = "the files of a ROS 2 bag are read together"
    return download_files(bag_files_at(metadata), address, reason, name)


def format_of(path: LogFile) -> str | None:
    """Return the name of a file's format, or None if it is in none of the known ones.

    Raises:
        MissingFileError: the file cannot be opened.
    """
    head = _head(path)
    return next((kind for kind, log_format in FORMATS.items() if log_format.recognise(head)), None)


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder holds what a ROS 2 bag is made of."""
    try:
        return path.is_dir() and any(_BAG_FILE.search(entry.name) for entry in path.iterdir())
    except (OSError, ValueError):
        return False


def _head(path: LogFile) -> bytes:
    """Read the first bytes of a file, decompressed; what is missing from a broken one is left out."""
    try:
        with open_text(path) if isinstance(path, Path) else path.open() as stream:
            return stream.read(_HEAD)
    except (EOFError, ValueError, zlib.error):
        return b"{"
    except OSError as error:
        raise MissingFileError.of(path, error) from None


def _is_jsonl(head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def _is_scenario(head: bytes) -> bool:
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return text.startswith((b"<?xml", b"<!--", b"<!DOCTYPE", b"<commonRoad"))


def _is_csv(head: bytes) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    return any(name.encode() in first.split(b",") for name in CSV_COLUMNS)


class Format(NamedTuple):
    """A format of logs.

    Attributes:
        recognise: whether a file that begins with the given bytes is of this format.
        open: a source of the file, given what the format is called.
        options: the names of the `ReadOptions` that apply to it, but for `concave`.
    """

    recognise: Callable[[bytes], bool]
    open: Callable[[LogFile, str, ReadOptions], Source]
    options: frozenset[str] = frozenset()


def _track_source(
    path: LogFile, kind: str, options: ReadOptions, iter_traces: IterTraces, usual: Axes = OUR_AXES
) -> Source:
    """Return the source of a file, with the axes that are usual in its format unless options say others."""
    axes = usual if options.y_down is None else replace(usual, y="down" if options.y_down else "up")
    return TrackSource(path, kind, options, iter_traces=iter_traces, axes=axes)


def _open_annotations(path: LogFile, kind: str, options: ReadOptions) -> Source:
    rate = FRAMES_A_SECOND if options.rate is None else options.rate
    reader = partial(iter_annotations, rate=rate, lost=options.lost)
    return _track_source(path, kind, options, reader, Axes("down"))


def _open_scenario(path: LogFile, kind: str, options: ReadOptions) -> Source:
    from spatial_replay.logs.formats.commonroad import iter_scenario

    return _track_source(path, kind, options, iter_scenario, Axes(unit="m"))


def _open_messages(path: LogFile, kind: str, options: ReadOptions) -> Source:
    """Open an external log of messages."""
    if options.mapping is None:
        if isinstance(path, Path) and path.is_dir() and not (path / BAG_METADATA).exists():
            first = min(entry.name for entry in path.iterdir() if _BAG_FILE.search(entry.name))
            raise UsageError(
                f"{path.name} is a folder without {BAG_METADATA}; give one of its logs, such as "
                f"{printable(str(path / first))}, or all of them to `spatial-replay batch`; "
                "a ROS 2 bag needs a mapping file, too: --mapping FILE or mapping=FILE"
            )
        raise UsageError(
            f"{path.name} is a {kind}, which does not say what its objects are; give a mapping file that"
            " does, with --mapping FILE or mapping=FILE; for a first one, see: spatial-replay info "
            f"{shlex.quote(str(path))} --suggest-mapping"
        )
    # readers of external logs are loaded when there is one
    from spatial_replay.mapping.mapped_source import MappedSource
    from spatial_replay.mapping.mapping_file import load_mapping

    return MappedSource(path, kind, options, mapping=load_mapping(options.mapping))


def _open_mcap(path: LogFile, kind: str, options: ReadOptions) -> Source:
    """Open our own log, which names its objects, or an external one, given a mapping."""
    from spatial_replay.logs.mcap.read import McapSource

    source = McapSource(path, kind, options)
    if not options.non_defaults().keys() - {"max_gap"}:
        return source
    if source.has_samples:
        options.refuse_except(frozenset({"max_gap"}), kind, path.name)
    return _open_messages(path, kind, options)


_MESSAGES = frozenset({"mapping", "on_time_jump", "max_lateness", "max_gap"})
_TRACKS = frozenset({"y_down", "max_gap"})

FORMATS: dict[str, Format] = {
    "MCAP": Format(lambda head: head.startswith(MAGIC), _open_mcap, _MESSAGES),
    "ROS 1 bag": Format(lambda head: head.startswith(b"#ROSBAG V2.0\n"), _open_messages, _MESSAGES),
    "ROS 2 bag": Format(lambda head: head.startswith(b"SQLite format 3\x00"), _open_messages, _MESSAGES),
    "track JSONL": Format(_is_jsonl, partial(_track_source, iter_traces=iter_jsonl), _TRACKS),
    "track CSV": Format(_is_csv, partial(_track_source, iter_traces=iter_csv), _TRACKS),
    "drone annotations": Format(is_annotations, _open_annotations, _TRACKS | {"rate", "lost"}),
    "CommonRoad scenario": Format(_is_scenario, _open_scenario, frozenset({"max_gap"})),
}
