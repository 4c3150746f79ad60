"""Bounds of a server for agents: the files that it reads, and the size of its answers."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

from spatial_replay.errors import UsageError
from spatial_replay.text import escape_text, plural

MOST_BYTES: Final = 20_000
"""Size limit of an answer as JSON, bytes."""
MOST_TEXT: Final = 100_000
"""Length limit of a text argument, characters."""

_LINES: Final = 4_000
"""Size limit of an answer's lines, bytes. The lines are sent twice: as text and as values."""
_WARNINGS: Final = 1_500
_ROW: Final = 3_000
"""Size limit of a row, bytes."""
_OTHERS: Final = 3_000
"""Size limit of all values except the rows, bytes."""
_MOST_ENTRIES: Final = 20_000
"""Maximum number of entries in a folder. All of them are checked for links."""
_ADDRESSES: Final = "://"


@dataclass(frozen=True, slots=True)
class Bounds:
    """Folders and addresses that a server reads, and the folder that it writes.

    Attributes:
        folders: readable folders, with links resolved.
        addresses: readable addresses of folders; each ends in "/".
        output: output folder; None if nothing may be written.
    """

    folders: tuple[Path, ...]
    addresses: tuple[str, ...] = ()
    output: Path | None = None

    @classmethod
    def of(cls, roots: Iterable[str], output: Path | None = None) -> Bounds:
        """Return the bounds of a command line.

        Raises:
            UsageError: a root, or the output, is not a folder.
        """
        folders, addresses = [], []
        for root in roots:
            if _ADDRESSES in root:
                addresses.append(root.rstrip("/") + "/")
            elif Path(root).is_dir():
                folders.append(Path(root).resolve())
            else:
                raise UsageError(f"--root {root} is not a folder; give the folder with the logs")
        if output is not None and not output.is_dir():
            raise UsageError(f"--output {output} is not a folder; make it with mkdir {output}")
        return cls(tuple(folders), tuple(addresses), None if output is None else output.resolve())

    @property
    def names(self) -> str:
        """The roots as a text."""
        return ", ".join([*map(str, self.folders), *self.addresses])

    def place(self, text: str, argument: str) -> str:
        """Return the path of an input with all links resolved, or its address.

        Args:
            text: absolute path, path relative to a root, or address; `push_v3#17` is an episode.
            argument: name of the argument, for errors.

        Raises:
            UsageError: the input is missing, outside the roots, or neither a file nor a folder.
        """
        if not text:
            raise UsageError(f"{argument} is empty; give a path below {self.names}")
        if _ADDRESSES in text:
            # a server may resolve .. to an address outside
            if ".." not in text and text.startswith(self.addresses or ("\0",)):
                return text
            raise UsageError(f"{argument}: {_quote(text)} is outside the roots, which are {self.names}")
        path, episode_suffix = self._path(text, argument), ""
        if path is None and "#" in text:
            text, _, episode_suffix = text.rpartition("#")
            path, episode_suffix = self._path(text, argument), f"#{episode_suffix}"
        if path is None:
            raise UsageError(
                f"{argument}: {_quote(text)} is not a file below the roots; list_logs names the logs"
            )
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            self._check_links(path, argument)
        elif not stat.S_ISREG(mode):
            raise UsageError(f"{argument}: {_quote(text)} is neither a file nor a folder; give a log")
        return f"{path}{episode_suffix}"

    def _path(self, text: str, argument: str) -> Path | None:
        """Return the path of a file or folder, with links resolved; None if it is missing.

        Raises:
            UsageError: the path is outside the roots.
        """
        is_outside = False
        try:
            # an absolute path is the same below every root
            for root in self.folders:
                path = (root / text).resolve()
                if not any(map(path.is_relative_to, self.folders)):
                    is_outside = True
                elif path.exists():
                    return path
        except (OSError, ValueError, RuntimeError):
            # the name is too long or has a null character, or links form a circle
            raise UsageError(
                f"{argument}: {_quote(text)} cannot be a path; give one that list_logs names"
            ) from None
        if is_outside:
            raise UsageError(f"{argument}: {_quote(text)} is outside the roots, which are {self.names}")
        return None

    def _check_links(self, folder: Path, argument: str) -> None:
        """Refuse a folder with a link to the outside, or with a pipe, because a pipe blocks its reader."""
        entry_count, pending_folders, visited_folders = 0, [str(folder)], {str(folder)}
        while pending_folders:
            for parent, folders, file_names in os.walk(pending_folders.pop()):
                entry_count += len(folders) + len(file_names)
                if entry_count > _MOST_ENTRIES:
                    raise UsageError(
                        f"{argument}: {folder.name} has over {_MOST_ENTRIES:,} entries; give a folder in it"
                    )
                for path in map(Path(parent).joinpath, (*folders, *file_names)):
                    target = self._inside(path, argument)
                    # a linked folder may contain links, too
                    if target is not None and target not in visited_folders and os.path.isdir(target):  # noqa: PTH112
                        visited_folders.add(target)
                        pending_folders.append(target)

    def _inside(self, path: Path, argument: str) -> str | None:
        """Return the target of a link; None for a file or a folder.

        Raises:
            UsageError: the target is outside the roots, or the path is no link, file or folder.
        """
        target = None
        try:
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                target = os.path.realpath(path)
                mode = os.stat(target).st_mode  # noqa: PTH116
        except OSError:
            # the file has just been removed, or the link has no target
            mode = stat.S_IFREG
        if target is not None and not any(map(Path(target).is_relative_to, self.folders)):
            raise UsageError(
                f"{argument}: {_quote(path.name)} is a link to outside the roots; remove the link"
            )
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UsageError(f"{argument}: {_quote(path.name)} is neither a file nor a folder; remove it")
        return target

    def relative(self, path: str) -> str:
        """Return a path as an argument of tools: relative to a single root, otherwise absolute."""
        root = str(self.folders[0]) if len(self.folders) == 1 and not self.addresses else ""
        return os.path.relpath(path, root) if root and path.startswith(root) else path

    def output_path(self, name: str, ending: str) -> Path:
        """Return the path of a result in the output folder.

        Raises:
            UsageError: there is no output folder, or the name is no name of a file in this folder.
        """
        if self.output is None:
            raise UsageError("nothing can be written; start the server with --output FOLDER")
        path = self.output / (name if name.endswith(ending) else f"{name}{ending}")
        is_file_name = name.isprintable() and len(path.name) < 200 and path.name == os.path.basename(path)  # noqa: PTH119
        if not is_file_name or "/" in name or name.startswith(".") or (path.exists() and not path.is_file()):
            raise UsageError(f"name: {_quote(name)} is not the name of a file; give one such as run{ending}")
        if path.is_symlink():
            raise UsageError(f"name: {_quote(name)} is a link; give another name")
        return path


def _quote(text: str) -> str:
    text = escape_text(text)
    return repr(text if len(text) <= 80 else f"{text[:79]}…")


class Files:
    """A temporary folder with the texts of one call as files."""

    def __init__(self, parent: str, bounds: Bounds, texts: Mapping[str, str]) -> None:
        self._bounds, self._texts = bounds, texts
        self._temporary = TemporaryDirectory(dir=parent, ignore_cleanup_errors=True)
        self.folder = self._temporary.name

    def __enter__(self) -> Files:
        return self

    def __exit__(self, *error: object) -> None:
        self._temporary.cleanup()

    def path(self, name: str) -> str:
        """Return the path that an argument gives, or the path of a new file with the argument's text.

        Raises:
            UsageError: the text is empty, too long, or the path of a file outside the roots.
        """
        text = self._texts[name]
        ending, *_ = endings = (".yaml", ".yml") if name == "mapping" else (".spatial",)
        if len(text) > MOST_TEXT:
            raise UsageError(
                f"{name} has {len(text):,} characters, at most {MOST_TEXT:,} are read; give a shorter one"
            )
        if not text.strip():
            raise UsageError(f"{name} is empty; give a text, or the path of a file that ends in {ending}")
        if "\n" not in text and text.endswith(endings):
            return self._bounds.place(text, name)
        Path(self.folder, f"{name}{ending}").write_text(text, "utf-8", "surrogateescape")
        return f"{name}{ending}"

    def option(self, option: str, name: str) -> list[str]:
        """Return an option with the `path` of an argument; an empty list for an empty argument."""
        return [option, self.path(name)] if self._texts.get(name) else []

    def json(self, command: Sequence[str]) -> Any:
        """Return the values that a command wrote with --json; None without a file."""
        for option, file in pairwise(command):
            path = Path(self.folder, file)
            if option == "--json" and path.is_file():
                return json.loads(path.read_text("utf-8"))
        return None


class Page(NamedTuple):
    """The part of an answer that fits into the limits.

    Attributes:
        lines: lines of the text.
        warnings: warnings; the first part has all of them.
        document: the document with a part of its rows.
        left_off: notes on cut values.
        next: argument for the next part; "" for the last part.
    """

    lines: list[str]
    warnings: list[str]
    document: dict[str, Any]
    left_off: list[str]
    next: str


def page_of(
    lines: Sequence[str], warnings: Sequence[str], document: Mapping[str, Any], rows_key: str, start: str
) -> Page:
    """Return the part of an answer that begins at `start`.

    Args:
        rows_key: key of the long list in the document.
        start: `next` of the previous part; "" for the first part.

    Raises:
        UsageError: `start` is not the `next` of a part.
    """
    first_line, first_row = _place(start)
    left_off: list[str] = []
    cut_lines = [_cut(line, "line", 1_000, 0, []) for line in lines]
    page_lines = list(_prefix(cut_lines[first_line:], _LINES))
    page_warnings: list[str] = []
    if not start:
        cut_warnings = [_cut(warning, "warning", 400, 0, []) for warning in warnings]
        page_warnings = list(_prefix(cut_warnings, _WARNINGS))
        if len(page_warnings) < len(cut_warnings):
            left_off.append(f"{plural(len(cut_warnings) - len(page_warnings), 'line')} of the warnings")
    rows = list(document.get(rows_key) or ())
    other_values = {key: value for key, value in document.items() if key != rows_key}
    page_document = _fit(other_values, _OTHERS, left_off)
    # lines and warnings are sent twice; 1,000 bytes are for the other fields
    spent_bytes = 2 * (_size(page_lines) + _size(page_warnings)) + _size(page_document) + 1_000
    fitted_rows = [_fit(row, _ROW, left_off) for row in rows[first_row : first_row + 200]]
    page_rows = list(_prefix(fitted_rows, MOST_BYTES - spent_bytes))
    if rows_key in document:
        page_document[rows_key] = page_rows
    end_line, end_row = first_line + len(page_lines), first_row + len(page_rows)
    is_last = end_line >= len(lines) and end_row >= len(rows)
    next_start = "" if is_last else f"{end_line}.{end_row}"
    return Page(page_lines, page_warnings, page_document, list(dict.fromkeys(left_off))[:10], next_start)


def _place(start: str) -> tuple[int, int]:
    line, _, row = (start or "0.0").partition(".")
    if not (line.isascii() and line.isdecimal() and row.isascii() and row.isdecimal() and len(start) < 20):
        raise UsageError(
            f"next: {_quote(start)} is not a place in an answer; give the `next` of the previous part"
        )
    return int(line), int(row)


def _prefix(values: Iterable[Any], max_bytes: int) -> Iterator[Any]:
    """Yield the first values that fit into `max_bytes`, but at least one value."""
    total_bytes = 0
    for index, value in enumerate(values):
        total_bytes += _size(value) + 1
        if total_bytes > max_bytes and index:
            return
        yield value


def _size(value: Any) -> int:
    return len(json.dumps(value, ensure_ascii=False).encode("utf-8", "replace"))


_LIMITS: Final = ((1_000, 100), (300, 30), (200, 10), (120, 4), (80, 2), (40, 1))
"""Limits of the characters of a text and of the entries of a list, from loose to strict."""


def _fit(value: Any, max_bytes: int, left_off: list[str]) -> Any:
    """Return a value cut to `max_bytes`. `left_off` gets notes on the cut lists and values."""
    part, notes = value, list[str]()
    for characters, entries in _LIMITS:
        notes = []
        part = _cut(value, "", characters, entries, notes)
        if _size(part) <= max_bytes:
            break
    # if the strictest limits are not enough, the largest values are dropped
    keys_by_size = sorted(part, key=lambda key: _size(part[key])) if isinstance(part, dict) else []
    while keys_by_size and _size(part) > max_bytes:
        key = keys_by_size.pop()
        notes.append(key)
        part = {name: entry for name, entry in part.items() if name != key}
    left_off += notes
    return part


def _cut(value: Any, name: str, characters: int, entries: int, notes: list[str]) -> Any:
    """Return a value with shorter texts and lists, and with escapes for unprintable characters."""
    match value:
        case str():
            text = escape_text(value)
            return text if len(text) <= characters else f"{text[: characters - 1]}…"
        case list() | tuple():
            if len(value) > entries:
                notes.append(f"{name or 'rows'}: {len(value) - entries:,} of {len(value):,}")
            return [_cut(entry, name, characters, entries, notes) for entry in value[:entries]]
        case dict():
            return {
                _cut(str(key), "", characters, 0, []): _cut(entry, str(key)[:40], characters, entries, notes)
                for key, entry in value.items()
            }
    return value
