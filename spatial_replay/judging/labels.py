"""Success labels of episodes, from files and from data sets."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple

from spatial_replay.batch.run import FoundLog
from spatial_replay.errors import LogError, MissingFileError, UsageError
from spatial_replay.logs.formats.datasets import DATA_SET_ENDINGS, data_set_address, open_data_set
from spatial_replay.logs.formats.episodes import AS_STORED, DataSet, EpisodeReading
from spatial_replay.logs.remote import is_address
from spatial_replay.sources.open_log import LOG_ENDINGS
from spatial_replay.text import first_lines, listing, nearest_hint, plural

LABEL_FILES: Final = ("labels.json", "labels.csv")
"""Names of label files next to logs."""
_LARGEST: Final = 256 * 2**20
"""Size limit of a label file, bytes."""
_MOST_FAULTS: Final = 20
_FRAME_KEYS: Final = ("frame_index", "frame", "step", "timestamp", "time_ns")
_TRUTHS: Final[Mapping[str, bool | None]] = {
    **dict.fromkeys(("true", "1", "1.0", "yes", "success"), True),
    **dict.fromkeys(("false", "0", "0.0", "no", "failure"), False),
    **dict.fromkeys(("none", ""), None),
}


class SuccessLabel(NamedTuple):
    """The success label of an episode.

    Attributes:
        success: whether the label is a success; None without a label.
        is_unstored: whether the label describes the state after the last frame. That state is not stored.
        task, seed: values in the data set, or None.
    """

    success: bool | None
    is_unstored: bool = False
    task: str | None = None
    seed: int | None = None


class Labels(NamedTuple):
    """Labels of logs.

    Attributes:
        by_path: labels by the paths of logs.
        files: label files.
        remarks: remarks on data sets.
    """

    by_path: Mapping[str, SuccessLabel]
    files: tuple[Path, ...] = ()
    remarks: tuple[str, ...] = ()


def read_labels(
    logs: Sequence[FoundLog], labels: str | None = None, reading: EpisodeReading = AS_STORED
) -> Labels:
    """Read the labels of episodes.

    Args:
        labels: path of a JSON or CSV file, or name of a field of the data set. By default, labels are in
            `labels.json` or `labels.csv` next to the logs, or in the data set.
        reading: reading options of data sets, from a mapping.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the data set lacks the field, or entries name unknown episodes, frames, or an episode
            twice. The message lists all such entries.
    """
    is_file = labels is not None and (labels.lower().endswith((".json", ".csv")) or Path(labels).is_file())
    if labels is not None and not is_file:
        reading = reading._replace(label=labels)
    labels_by_path: dict[str, SuccessLabel] = {}
    folders: dict[Path, None] = {}
    remarks: dict[str, None] = {}
    for log in logs:
        address = data_set_address(log.path)
        data_set = None if address is None else open_data_set(address[0])
        if address is not None and data_set is not None:
            remarks |= dict.fromkeys(f"{data_set.name}: {remark}" for remark in data_set.remarks)
            label = _stored_label(data_set, address[1], reading)
            # a file replaces all labels of the data set, because a rate over mixed labels has no meaning
            labels_by_path[log.path] = label._replace(success=None, is_unstored=False) if is_file else label
        elif labels is not None and not is_file:
            raise UsageError(f"--labels {labels}: no such file, and {log.name} has no such field")
        elif not is_address(log.path) and not log.path.lower().endswith(DATA_SET_ENDINGS):
            # an unreadable data set has no episodes for labels
            folders[Path(log.path).parent] = None
    candidates = [folder / name for folder in folders for name in LABEL_FILES]
    label_files = [Path(labels or "")] if is_file else [file for file in candidates if file.is_file()]
    for file in label_files:
        successes = _labels_of(file, logs)
        if is_file and not successes:
            raise UsageError(f"--labels {file}: it has no entry for a judged episode; give another file")
        for path, success in successes.items():
            labels_by_path[path] = labels_by_path.get(path, SuccessLabel(None))._replace(
                success=success, is_unstored=False
            )
    return Labels(labels_by_path, tuple(label_files), tuple(remarks))


def _stored_label(data_set: DataSet, number: int, reading: EpisodeReading) -> SuccessLabel:
    """Return the label of an episode in its data set. An unreadable episode has no label."""
    episode, label = data_set.episode(number), data_set.label
    unlabelled = SuccessLabel(None, task=episode.task, seed=episode.seed)
    field = reading.label
    try:
        success = data_set.success(number, reading)
    except LogError:
        return unlabelled
    if success is None or not success.size:
        return unlabelled
    # a label before the last frame describes a state that is stored
    is_last = success.ndim == 1 and not success[:-1].any()
    is_own = field is None or (label is not None and label.field == field)
    is_about_next = label is not None and label.is_about_next if is_own else str(field).startswith("next.")
    is_stored = label is not None and label.is_stored
    return unlabelled._replace(
        success=bool(success.any()), is_unstored=is_last and is_about_next and not is_stored
    )


def _labels_of(file: Path, logs: Sequence[FoundLog]) -> dict[str, bool | None]:
    """Return the labels in a file, by path. Entries of existing logs outside the judgement are left out."""
    paths_by_name = _paths_by_name(logs)
    labels: dict[str, bool | None] = {}
    places: dict[str, str] = {}
    faults = []
    for place, entry in _entries(file):
        try:
            path, success = _entry_path(entry, paths_by_name, file), _success(entry)
            if path is None:
                continue
            if path in labels:
                raise UsageError(_repetition(entry, places[path]))
            labels[path], places[path] = success, place
        except UsageError as error:
            faults.append(f"{file}, {place}: {error}")
    if faults:
        raise UsageError("\n".join(first_lines(faults, _MOST_FAULTS)))
    return labels


def _repetition(entry: Mapping[str, Any], place: str) -> str:
    frame_key = next((key for key in _FRAME_KEYS if key in entry), None)
    if frame_key is not None:
        return f"a label for each frame ({frame_key!r}); give one entry per episode"
    return f"{place} labels this episode already; keep one of them"


def _entries(file: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the place of each entry in a label file, and the entry."""
    try:
        with file.open("rb") as stream:
            content = stream.read(_LARGEST + 1)
        # spreadsheets write CSV with a byte order mark
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{file} is not UTF-8; save it as UTF-8") from None
    except (OSError, ValueError) as error:
        raise MissingFileError.of(file, error) from None
    if len(content) > _LARGEST:
        raise UsageError(f"{file} is larger than {_LARGEST // 2**20} MB; labels have one entry per episode")
    if file.suffix.lower() == ".csv":
        rows = csv.DictReader(text.splitlines())
        yield from ((f"line {rows.line_num}", row) for row in rows)
        return
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{file} is not JSON: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UsageError(f'{file} is no list of objects; write [{{"log": "000.mcap", "success": true}}, …]')
    yield from ((f"entry {number}", entry) for number, entry in enumerate(entries, 1))


def _success(entry: Mapping[str, Any]) -> bool | None:
    if "success" not in entry:
        raise UsageError(f"it has no 'success'; it has {listing([str(key) for key in entry]) or 'nothing'}")
    word = str(entry["success"]).strip().lower()
    if word not in _TRUTHS:
        raise UsageError(f"success is {word!r:.60}; write true or false")
    return _TRUTHS[word]


def _entry_path(
    entry: Mapping[str, Any], paths_by_name: Mapping[str, Sequence[str]], file: Path
) -> str | None:
    """Return the path of the log that an entry names; None for an existing log outside the judgement."""
    log_value = entry.get("log") if entry.get("log") is not None else entry.get("episode")
    # a bool is an int in Python
    if not isinstance(log_value, str | int) or isinstance(log_value, bool):
        raise UsageError("it names no episode; give 'log', a path, or 'episode', a number or name")
    log_name = str(log_value).strip()
    # logs next to the label file have priority, because other folders may have logs of the same name
    paths = paths_by_name.get(_stem(str(file.parent / log_name))) or paths_by_name.get(_stem(log_name)) or []
    if len(paths) > 1:
        raise UsageError(f"{log_name!r:.100} names {plural(len(paths), 'log')}; write more of the path")
    if paths:
        neighbour, path = file.parent / log_name, Path(paths[0])
        has_same_name = neighbour.name == path.name and neighbour.is_file() and path.is_file()
        if has_same_name and not neighbour.samefile(path):
            raise UsageError(
                f"{log_name!r:.100} is the log next to this file, not {path}; copy the file next to the"
                " logs that it labels"
            )
        return paths[0]
    if "\0" not in log_name and (file.parent / log_name).exists():
        return None
    hint = nearest_hint(log_name, paths_by_name) or "remove this entry, or judge that episode"
    raise UsageError(f"no judged episode is named {log_name!r:.100}; {hint}")


def _paths_by_name(logs: Sequence[FoundLog]) -> Mapping[str, list[str]]:
    """Return the paths of logs by possible names in label files: ends of paths, and numbers of episodes."""
    paths_by_name = defaultdict[str, list[str]](list)
    for log in logs:
        parts = PurePosixPath(log.path).parts
        names = {_stem(log.name), *(_stem("/".join(parts[start:])) for start in range(len(parts)))}
        if data_set_address(log.path) is not None:
            names.add(log.path.rpartition("#")[2])
        for name in names | {_stem(log.path)}:
            paths_by_name[name].append(log.path)
    return paths_by_name


def _stem(name: str) -> str:
    """Remove the ending of a log from a path."""
    ending = max((end for end in LOG_ENDINGS if name.lower().endswith(end)), key=len, default="")
    return str(PurePosixPath(name[: len(name) - len(ending)]))
