"""Open any log. A file's content decides its format; `FORMATS` lists the reader of each format.

Readers with slow imports are imported when a log first needs them.
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

# rosbag2 adds .zstd to the name of a file that it compresses as a whole
_BAG_FILE = re.compile(r"^metadata\.yaml$|\.(db3|mcap)(\.zstd)?$")

LOG_ENDINGS = (".mcap", ".bag", ".db3", ".jsonl", ".jsonl.gz", ".csv", ".xml")
"""File endings of logs."""
_MOST_LOOKED_AT = 20
"""Limit of folder entries searched for a data set."""
_HEAD = 4096
"""Number of first bytes that identify a file's format."""


def open_source(path: str | PathLike[str], **reading: Unpack[Reading]) -> Source:
    """Open a log in any format. The file's content decides the format; the file's name does not matter.

    Only the needed parts of an MCAP log at an address are read. A log of another format is downloaded once.

    Args:
        path: a local path, or an address: s3://bucket/run.mcap, gs://…, az://container/…, https://…. The path
            of a data set's episode is the set's path with a number: push_v3#17.
        reading: options; see `ReadOptions`.

    Raises:
        UsageError: `path` is not a path, an option does not apply to the format, or the format is unknown.
        MissingFileError: there is no such file, or it cannot be opened.
        LogError: the file has the ending of a log, but not the content of a log.
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
    format_name = format_of(path)
    if format_name is not None:
        options.refuse_except(FORMATS[format_name].options, format_name, path.name)
        return FORMATS[format_name].open(path, format_name, options)
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
    # a file with the ending of a log is probably a damaged log
    raise LogError(message) if path.name.lower().endswith(LOG_ENDINGS) else UsageError(message)


def read_trace(path: str | PathLike[str], *, allow_damage: bool = False, **reading: Unpack[Reading]) -> Trace:
    """Read a whole log into memory.

    Args:
        path: a log in any format that `open_source` reads.
        allow_damage: whether to return the readable part of a damaged log, with its `faults`.
        reading: options; see `ReadOptions`.

    Raises:
        UsageError: `path` is not a path, or an option does not apply to the format.
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
        other_count = count_of(trace.faults) - 1
        more_text = f"\n… and {other_count} more" if other_count else ""
        raise LogError(f"{faults[0]}{more_text}; allow_damage=True reads the rest")
    return replace(trace, remarks=remarks, doubts=doubts, faults=faults, units=source.axes.units)


def readable_file(path: str | PathLike[str]) -> LogFile:
    """Return the file of a log. Download a remote file first if it cannot be read in parts.

    Raises:
        UsageError: the address has no file name, or obstore is not installed.
        MissingFileError, RemoteError: the address cannot be read.
        LogError: the file is too large to be downloaded, or it is a pipe, a socket or a device.
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
            # the metadata file stands for its bag
            return file.absolute().parent
        if file.is_dir() and not is_bag_folder(file):
            entry_names = sorted(entry.name for entry in file.iterdir())
            _refuse_data_set(file)
            if {"format.json", "rows"}.issubset(entry_names):
                remedy = "`results` shows them, and compares two such folders"
                raise MissingFileError(f"{path}: this folder has results of a batch; {remedy}")
            log_names = [name for name in entry_names if name.lower().endswith(LOG_ENDINGS)]
            content = "no file of a ROS 2 bag (.db3, .mcap)" if entry_names else "nothing"
            example = (
                f", such as {printable(str(file / log_names[0]))}; batch takes a folder" if log_names else ""
            )
            if data_set_path := _data_set_in(file):
                example = f"; {printable(str(data_set_path))} is a data set of episodes"
            raise MissingFileError(
                f"{path}: there is {content} in this folder; give the path of a log{example}"
            )
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
    """Refuse a data set of episodes, because a log is one episode.

    Raises:
        UsageError: the path is a data set.
    """
    data_set = open_data_set(path)
    if data_set is not None and data_set.episodes:
        first_episode = printable(f"{path}#{data_set.episodes[0].number}")
        raise UsageError(
            f"{path} is a {data_set.kind} data set of {plural(len(data_set.episodes), 'episode')}; give one,"
            f" such as {first_episode}, or all of them to `batch` or `judge`"
        )


def _refuse_description(path: Path) -> None:
    """Refuse the JSON file next to ManiSkill's trajectories.

    Raises:
        UsageError: the path is such a JSON file.
    """
    trajectories = path.with_suffix(".h5")
    data_set = open_data_set(trajectories)
    if data_set is not None and data_set.kind == "ManiSkill":
        raise UsageError(f"{path.name} describes the episodes of {trajectories.name}; give {trajectories}")


def _data_set_in(folder: Path) -> Path | None:
    """Return the first data set in a folder, such as a namespace folder of Minari, or None."""
    for path in sorted(folder.iterdir())[:_MOST_LOOKED_AT]:
        with suppress(SpatialReplayError):
            if open_data_set(path) is not None:
                return path
    return None


def _open_episode(path: str, number: int, options: ReadOptions) -> Source:
    """Open an episode of a data set.

    Raises:
        UsageError: there is no such episode, the data set needs a mapping, or the mapping is for topics.
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
    """Refuse pipes, sockets and devices, because reading them may never end.

    Raises:
        LogError: the path is a pipe, a socket or a device, or the folder of a bag holds one.
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
    """Return the metadata file of the ROS 2 bag at an address; None if the address is another file.

    Raises:
        MissingFileError, RemoteError: the address is neither a bag nor a file.
    """
    if file.name == BAG_METADATA:
        return file
    try:
        # the server gives the version, so that a missing file raises an error here
        _ = file.version
    except MissingFileError:
        # the address may name a folder, without a slash at the end
        metadata = RemoteFile(f"{os.fspath(file)}/{BAG_METADATA}")
        with suppress(MissingFileError, RemoteError):
            _ = metadata.version
            return metadata
        raise
    return None


def bag_files_at(metadata: RemoteFile) -> list[RemoteFile]:
    """Return the files of a ROS 2 bag at an address: its metadata file, and the files that it lists.

    Raises:
        LogError: the metadata cannot be used.
        MissingFileError, RemoteError: the metadata cannot be read.
    """
    from spatial_replay.bags.sqlite import LARGEST_METADATA, bag_metadata_from_bytes

    folder = os.fspath(metadata).removesuffix(BAG_METADATA)
    try:
        file_names = bag_metadata_from_bytes(metadata.read(0, LARGEST_METADATA + 1)).files
    except MissingFileError as error:
        raise MissingFileError(
            f"{error}; give the address of a bag's folder for a ROS 2 bag, and of one file for any other log,"
            " such as s3://bucket/run.mcap"
        ) from None
    except LogError as error:
        raise LogError(f"{metadata} cannot be used: {error}; copy the bag to this machine") from None
    # paths in web addresses are percent-encoded, keys in buckets are not
    if is_web(metadata):
        file_names = tuple(map(quote, file_names))
    return [metadata, *(RemoteFile(folder + name) for name in file_names)]


def downloaded_bag(metadata: RemoteFile) -> Path:
    """Return the folder with a copy of the ROS 2 bag at an address; see `download`."""
    address = str(metadata).removesuffix(BAG_METADATA)
    name = address.rstrip("/").rpartition("/")[2].strip(".") or "bag"
    reason = "the files of a ROS 2 bag are read together"
    return download_files(bag_files_at(metadata), address, reason, name)


def format_of(path: LogFile) -> str | None:
    """Return the name of a file's format; None for an unknown format.

    Raises:
        MissingFileError: the file cannot be opened.
    """
    head = _head(path)
    return next((kind for kind, log_format in FORMATS.items() if log_format.recognise(head)), None)


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder holds a file of a ROS 2 bag."""
    try:
        return path.is_dir() and any(_BAG_FILE.search(entry.name) for entry in path.iterdir())
    except (OSError, ValueError):
        return False


def _head(path: LogFile) -> bytes:
    """Return the first bytes of a file, decompressed.

    A damaged gzip file counts as track JSONL, because the JSONL reader reports the place of the damage.
    """
    try:
        with open_text(path) if isinstance(path, Path) else path.open() as stream:
            return stream.read(_HEAD)
    except (EOFError, ValueError, zlib.error):
        return b"{"
    except OSError as error:
        raise MissingFileError.of(path, error) from None


def _is_jsonl(head: bytes) -> bool:
    # some editors write a byte order mark in front
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def _is_scenario(head: bytes) -> bool:
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return text.startswith((b"<?xml", b"<!--", b"<!DOCTYPE", b"<commonRoad"))


def _is_csv(head: bytes) -> bool:
    first_line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    return any(name.encode() in first_line.split(b",") for name in CSV_COLUMNS)


class Format(NamedTuple):
    """A format of logs.

    Attributes:
        recognise: function that returns whether a file with the given first bytes has this format.
        open: function that opens a file, given the name of the format and options.
        options: names of the `ReadOptions` that apply to the format, except `concave`, which always applies.
    """

    recognise: Callable[[bytes], bool]
    open: Callable[[LogFile, str, ReadOptions], Source]
    options: frozenset[str] = frozenset()


def _track_source(
    path: LogFile,
    format_name: str,
    options: ReadOptions,
    iter_traces: IterTraces,
    usual_axes: Axes = OUR_AXES,
) -> Source:
    """Return the source of a track file; option `y_down` overrides the usual axes of the format."""
    axes = usual_axes if options.y_down is None else replace(usual_axes, y="down" if options.y_down else "up")
    return TrackSource(path, format_name, options, iter_traces=iter_traces, axes=axes)


def _open_annotations(path: LogFile, format_name: str, options: ReadOptions) -> Source:
    rate = FRAMES_A_SECOND if options.rate is None else options.rate
    reader = partial(iter_annotations, rate=rate, lost=options.lost)
    return _track_source(path, format_name, options, reader, Axes("down"))


def _open_scenario(path: LogFile, format_name: str, options: ReadOptions) -> Source:
    from spatial_replay.logs.formats.commonroad import iter_scenario

    return _track_source(path, format_name, options, iter_scenario, Axes(unit="m"))


def _open_messages(path: LogFile, format_name: str, options: ReadOptions) -> Source:
    if options.mapping is None:
        if isinstance(path, Path) and path.is_dir() and not (path / BAG_METADATA).exists():
            first_name = min(entry.name for entry in path.iterdir() if _BAG_FILE.search(entry.name))
            raise UsageError(
                f"{path.name} is a folder without {BAG_METADATA}; give one of its logs, such as "
                f"{printable(str(path / first_name))}, or all of them to `spatial-replay batch`; "
                "a ROS 2 bag needs a mapping file, too: --mapping FILE or mapping=FILE"
            )
        raise UsageError(
            f"{path.name} is a {format_name}, which does not say what its objects are; give a mapping file"
            " that does, with --mapping FILE or mapping=FILE; for a first one, see: spatial-replay info "
            f"{shlex.quote(str(path))} --suggest-mapping"
        )
    # the import is here, because readers of external logs are slow to import
    from spatial_replay.mapping.mapped_source import MappedSource
    from spatial_replay.mapping.mapping_file import load_mapping

    return MappedSource(path, format_name, options, mapping=load_mapping(options.mapping))


def _open_mcap(path: LogFile, format_name: str, options: ReadOptions) -> Source:
    """Open an MCAP log: our own log, which names its objects, or an external log with a mapping."""
    from spatial_replay.logs.mcap.read import McapSource

    source = McapSource(path, format_name, options)
    if not options.non_defaults().keys() - {"max_gap"}:
        return source
    if source.has_samples:
        options.refuse_except(frozenset({"max_gap"}), format_name, path.name)
    return _open_messages(path, format_name, options)


_MESSAGES = frozenset({"mapping", "on_time_jump", "max_lateness", "max_gap"})
_TRACKS = frozenset({"y_down", "max_gap"})

FORMATS: dict[str, Format] = {
    # first bytes: https://mcap.dev/spec#magic, https://wiki.ros.org/Bags/Format/2.0 and
    # https://www.sqlite.org/fileformat2.html#magic_header_string
    "MCAP": Format(lambda head: head.startswith(MAGIC), _open_mcap, _MESSAGES),
    "ROS 1 bag": Format(lambda head: head.startswith(b"#ROSBAG V2.0\n"), _open_messages, _MESSAGES),
    "ROS 2 bag": Format(lambda head: head.startswith(b"SQLite format 3\x00"), _open_messages, _MESSAGES),
    "track JSONL": Format(_is_jsonl, partial(_track_source, iter_traces=iter_jsonl), _TRACKS),
    "track CSV": Format(_is_csv, partial(_track_source, iter_traces=iter_csv), _TRACKS),
    "drone annotations": Format(is_annotations, _open_annotations, _TRACKS | {"rate", "lost"}),
    "CommonRoad scenario": Format(_is_scenario, _open_scenario, frozenset({"max_gap"})),
}
