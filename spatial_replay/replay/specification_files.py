"""Specification files of a running command: read when they are saved, and their constants written."""

from __future__ import annotations

import stat
from collections.abc import Mapping
from pathlib import Path

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.logs.output_file import replacing
from spatial_replay.spec import parse_specification

_MARK = b"\xef\xbb\xbf"


def write_constants(
    path: Path, values: Mapping[str, float | str], *, profile: str | None = None
) -> tuple[str, ...]:
    """Write values of constants into a specification file, and change nothing but these numbers.

    Args:
        values: numbers and, as texts, durations, by name; one that the file has already stays as written.

    Returns:
        The names of the constants that changed.

    Raises:
        MissingFileError: the file cannot be read.
        SpecificationError: the file has errors, now or with these values.
        UsageError: a constant that the file does not have, or that it computes from others.
        OutputError: the file cannot be written.
    """
    try:
        content = path.read_bytes()
        mode = stat.S_IMODE(path.stat().st_mode)
        text = content.removeprefix(_MARK).decode("utf-8")
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from error
    before = parse_specification(text, filename=path.name, profile=profile)
    after = parse_specification(text, filename=path.name, profile=profile, constants=values)
    changed = {
        name: value for name, value in values.items() if before.constants[name] != after.constants[name]
    }
    if not changed:
        return ()
    computed = [name for name in changed if before.constants[name].is_computed]
    if computed:
        raise UsageError(
            f"{path.name} computes {', '.join(computed)} from other constants; "
            "change those, or write a number there"
        )
    written = parse_specification(text, filename=path.name, profile=profile, constants=changed)
    mark = _MARK if content.startswith(_MARK) else b""
    with replacing(path) as stream:
        stream.write(mark + written.source.encode("utf-8"))
    path.chmod(mode)
    return tuple(changed)
