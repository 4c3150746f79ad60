"""The runs of a search in a file: a line for each, from which a search that ended goes on."""

from __future__ import annotations

import json
from pathlib import Path

from spatial_replay.errors import LogError
from spatial_replay.falsification.failures import SearchedRun
from spatial_replay.falsification.parameters import Case, key_of
from spatial_replay.logs.output_file import output_error


class RunFile:
    """Runs by their cases, kept in a file; a process for one search, which must be the only one.

    A line is written at once, and one that was not written to its end is dropped when the file is read again.
    """

    def __init__(self, path: Path) -> None:
        """Read what an earlier search has left.

        Raises:
            LogError: a line cannot be read.
            OutputError: the file cannot be written.
        """
        self._path = path
        self._known: dict[str, SearchedRun] = {}
        data = path.read_bytes() if path.exists() else b""
        whole = data[: data.rfind(b"\n") + 1]
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                run = SearchedRun.from_document(json.loads(line))
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise LogError(
                    f"{path}:{number}: this line is no run ({error}); delete the file, and search again"
                ) from None
            self._known[key_of(run.case)] = run
        try:
            self._stream = path.open("ab")
            # what a killed search has begun to write
            self._stream.truncate(len(whole))
        except OSError as error:
            raise output_error(path, error) from error

    def get(self, case: Case) -> SearchedRun | None:
        """Return the run of a case, if it is known."""
        return self._known.get(key_of(case))

    def __contains__(self, case: Case) -> bool:
        return key_of(case) in self._known

    def add(self, run: SearchedRun) -> None:
        """Keep a run.

        Raises:
            OutputError: it cannot be written.
        """
        line = json.dumps(run.document, allow_nan=False).encode() + b"\n"
        try:
            self._stream.write(line)
            self._stream.flush()
        except OSError as error:
            raise output_error(self._path, error) from error
        self._known[key_of(run.case)] = run

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
