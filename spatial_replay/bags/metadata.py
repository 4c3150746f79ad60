"""The metadata.yaml of a ROS 2 bag, which declares what the bag holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, Literal, cast

from spatial_replay.errors import LogError

Compression = Literal["", "file", "message"]

LARGEST_METADATA = 2**23
_DEEPEST = 32
_MOST = 2**63


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """What a bag declares.

    Attributes:
        files: names of its files, without folders, in order.
        types: of each topic.
        counts: messages of each topic.
        compression: of whole files, of each message, or none.
        distribution: the ROS release that wrote it, if it is named.
    """

    files: tuple[str, ...]
    types: Mapping[str, str]
    counts: Mapping[str, int]
    compression: Compression
    distribution: str | None


def bag_metadata_from_text(text: str) -> BagMetadata:
    """Parse a metadata.yaml.

    Raises:
        LogError: it is not YAML, or does not describe a bag.
    """
    document = _plain(text)
    about = document.get("rosbag2_bagfile_information", document) if isinstance(document, dict) else None
    if not isinstance(about, dict):
        raise LogError("it does not describe a bag; it has no 'rosbag2_bagfile_information'")
    topics = [_topic(each) for each in _list(about, "topics_with_message_count")]
    files = [_text(each, "relative_file_paths") for each in _list(about, "relative_file_paths")]
    distribution = about.get("ros_distro")
    return BagMetadata(
        files=tuple(dict.fromkeys(_base_name(each) for each in files)),
        types={name: type_name for name, type_name, _ in topics},
        counts={name: count for name, _, count in topics},
        compression=_compression(about),
        distribution=distribution if isinstance(distribution, str) else None,
    )


def _plain(text: str) -> Any:
    """Parse a YAML text without aliases, with which a short text could stand for a very long one."""
    import yaml

    if len(text) > LARGEST_METADATA:
        raise LogError(f"it has {len(text)} characters; up to {LARGEST_METADATA} are read")
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise LogError("it refers to parts of itself, or is nested too deep; no recorder writes that")
        return yaml.load(text, Loader=loader)  # the loader makes plain values only
    # malformed numbers and dates raise ValueError and its kin
    except (yaml.YAMLError, ValueError, OverflowError, TypeError, KeyError) as error:
        raise LogError(f"it is no YAML ({' '.join(str(error).split()):.200})") from None


def _topic(each: object) -> tuple[str, str, int]:
    if not isinstance(each, dict) or not isinstance(each.get("topic_metadata"), dict):
        raise LogError("a topic in it has no 'topic_metadata'")
    about = cast("dict[str, object]", each["topic_metadata"])
    name, count = _text(about.get("name"), "name"), each.get("message_count")
    if not isinstance(count, int) or not 0 <= count < _MOST:
        raise LogError(f"the message_count of topic {name!r:.100} is {count!r:.100}; give a number")
    return name, _text(about.get("type"), "type"), count


def _compression(about: dict[str, object]) -> Compression:
    mode = str(about.get("compression_mode") or "none").lower()
    form = str(about.get("compression_format") or "")
    if mode == "none":
        return ""
    if mode not in ("file", "message") or form != "zstd":
        raise LogError(
            f"the bag is compressed by {mode!r:.40} with {form!r:.40}; zstd by file or message is read"
        )
    return "file" if mode == "file" else "message"


def _list(about: dict[str, object], name: str) -> list[object]:
    value = about.get(name)
    if not isinstance(value, list):
        raise LogError(f"{name!r} in it is not a list")
    return value


def _text(value: object, name: str) -> str:
    if not isinstance(value, str):
        raise LogError(f"{name!r} in it is {value!r:.100}; give a string")
    return value


def _base_name(path: str) -> str:
    """Return the last part of a path; early releases wrote the folder too, and no path may lead out of it."""
    name = PureWindowsPath(PurePosixPath(path).name).name
    if name in ("", "..") or "\x00" in name:
        raise LogError(f"{path!r:.100} in it is not a file name")
    return name
