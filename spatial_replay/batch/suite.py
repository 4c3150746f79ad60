"""Suites: logs with their specifications and the expected results.

A suite is read from a YAML file, or built from a command line. A suite names logs by patterns, folders and
addresses, and `run.find_logs` finds the logs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias, TypeVar

from spatial_replay.errors import UsageError
from spatial_replay.logs.read_options import KEYS
from spatial_replay.logs.remote import is_address, sendable
from spatial_replay.mapping.yaml_document import (
    Document,
    Place,
    document_from_text,
    faults_by_place,
    numbered_faults,
    read_yaml_text,
    schema_of,
)
from spatial_replay.monitor.verdict import Semantics, Verdict
from spatial_replay.trace.trace import time_point_from_text

LARGEST_SUITE: Final = 8 * 2**20
"""Size limit of a suite file, bytes."""
_Value = TypeVar("_Value")
Pairs: TypeAlias = tuple[tuple[str, _Value], ...]
"""A table as a tuple, which can be hashed and sent to another process."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Options of reading logs and of evaluating specifications.

    Attributes:
        mapping: path or address of the mapping file, or None.
        reading: further keyword arguments of `open_source`.
        start, end: window of evaluation, as texts; None for the ends of the log.
        every: step between evaluated samples: 1 for all samples.
        each: parameters of templates and their objects: "all", "class:NAME" or a name.
        semantics: "ltlf" or "paper".
        strict_names: whether names that are missing in a log are errors.
        constants: names and values of changed constants.
        requires: requirements on a log, as JSON; "" without requirements.
    """

    mapping: Path | str | None = None
    reading: Pairs[Any] = ()
    start: str | None = None
    end: str | None = None
    every: int = 1
    each: Pairs[str] = ()
    semantics: Semantics = "ltlf"
    strict_names: bool = False
    constants: Pairs[float | str] = ()
    requires: str = ""

    @classmethod
    def from_tables(
        cls,
        reading: Mapping[str, Any],
        each: Mapping[str, str] | None,
        constants: Mapping[str, float | str] | None,
        **others: Any,
    ) -> Conditions:
        """Return conditions from tables.

        Args:
            reading: keyword arguments of `open_source`, with the mapping.
            others: further attributes.
        """
        options = dict(reading)
        mapping = options.pop("mapping", None)
        return cls(
            mapping=None if mapping is None else sendable(mapping),
            reading=_pairs(options),
            each=_pairs(each or {}),
            constants=_pairs(constants or {}),
            **others,
        )


DEFAULT_CONDITIONS: Final = Conditions()


# beginnings of failures that are no violations
UNTESTED: Final = "tested by nothing"
VACUOUS: Final = "vacuous"
DOUBTFUL: Final = "doubtful"
DROPPED: Final = "the recorder dropped"
DAMAGED: Final = "the log is damaged"


class Outcome(Protocol):
    """The values of a result that decide between pass and failure; see `ResultRow`."""

    @property
    def verdict(self) -> str | None: ...
    @property
    def lower(self) -> float: ...
    @property
    def tested(self) -> str | None: ...
    @property
    def untested(self) -> Sequence[str]: ...
    @property
    def vacuous(self) -> Sequence[str]: ...
    @property
    def left(self) -> Sequence[str]: ...
    @property
    def doubtful(self) -> Sequence[str]: ...
    @property
    def dropped(self) -> str | None: ...
    @property
    def faults(self) -> Sequence[str]: ...


@dataclass(frozen=True, slots=True)
class Expectation:
    """Expectations of a case for every result.

    Attributes:
        verdict: expected verdict.
        at_least: least expected robustness, instead of a verdict; None without a limit.
        tolerance: accepted loss below the limit, for rounding.
        allow_unknown: whether an unknown verdict passes, too.
        allow: kinds of inconclusive results that pass: "vacuous", "dropped" and "doubtful".
    """

    verdict: Verdict = Verdict.SATISFIED
    at_least: float | None = None
    tolerance: float = 0.0
    allow_unknown: bool = False
    allow: frozenset[str] = frozenset()

    @property
    def text(self) -> str:
        """The expectation in words."""
        unknown_text = " or unknown" if self.allow_unknown else ""
        if self.at_least is not None:
            return f"robustness of at least {self.at_least:.6g}{unknown_text}"
        return f"{self.verdict}{unknown_text}"

    def verdict_of(self, verdict: str | None, lower: float) -> str | None:
        """Return the verdict of a result. A violation within the tolerance becomes "satisfied"."""
        has_tolerance = self.verdict is Verdict.SATISFIED and self.at_least is None and self.tolerance > 0.0
        if has_tolerance and verdict == Verdict.VIOLATED and lower >= -self.tolerance:
            return str(Verdict.SATISFIED)
        return verdict

    def failure(self, outcome: Outcome, fail_on: AbstractSet[str] = frozenset()) -> str | None:
        """Return the reason for the failure of a result with a verdict; None if the result passes.

        Args:
            fail_on: kinds of results that fail even if the case allows them, see `FAILING_KINDS`.
        """
        failure = self._difference(outcome)
        is_unknown = outcome.verdict == Verdict.UNKNOWN
        if failure is None and "unknown" in fail_on and is_unknown:
            failure = "unknown"
        elif (failure is None or is_unknown) and "vacuous" in fail_on and outcome.vacuous:
            failure = f"{VACUOUS}: {outcome.vacuous[0]}"
        elif failure is None and "cut" in fail_on and outcome.tested == "cut":
            failure = f"cut: {outcome.untested[0]}"
        elif failure is None and "left" in fail_on and outcome.left:
            failure = f"left: {outcome.left[0]}"
        elif failure is None and outcome.doubtful and "doubtful" not in self.allow - fail_on:
            failure = f"{DOUBTFUL}: {outcome.doubtful[0]}"
        elif failure is None and "vacuous" not in self.allow and outcome.tested == "nothing":
            failure = f"{UNTESTED}: {outcome.untested[0]}"
        elif failure is None and "dropped" not in self.allow and outcome.dropped:
            failure = outcome.dropped
        damage = f"{DAMAGED}: {outcome.faults[0]}" if outcome.faults else None
        return "; ".join(filter(None, (failure, damage))) or None

    def _difference(self, outcome: Outcome) -> str | None:
        """Return the difference from the expected verdict or robustness; None without a difference."""
        if outcome.verdict == Verdict.UNKNOWN and self.allow_unknown:
            return None
        if self.verdict is Verdict.SATISFIED and (self.at_least is not None or self.tolerance):
            # the lower end of the interval equals the robustness if nothing is unknown
            if outcome.lower >= (self.at_least or 0.0) - self.tolerance:
                return None
            if self.at_least is not None:
                return f"robustness {outcome.lower:.6g}, expected at least {self.at_least:.6g}"
        if outcome.verdict != self.verdict:
            return f"{outcome.verdict}, expected {self.verdict}"
        return None


DEFAULT_EXPECTATION: Final = Expectation()


@dataclass(frozen=True, slots=True)
class LogPattern:
    """A file, a folder, a pattern or an address of logs in a suite.

    Attributes:
        place: file and line of the text, for errors; "" for a command line.
    """

    text: str
    place: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Logs that are evaluated with the same specifications under the same conditions.

    Attributes:
        name: name of the case, unique in its suite.
        logs: patterns of logs, relative to the suite's folder.
        specs: paths or addresses of the specification files.
        requirements: ids of the case's requirements, for specs without an id.
        at_least_logs: least number of logs; fewer logs are a fault.
        places: file and line of each key, for errors; empty for a command line.
        is_whole: whether specs, constants and objects of parameters are complete. Faulty values are left out.
    """

    name: str
    logs: tuple[LogPattern, ...]
    specs: tuple[Path | str, ...]
    conditions: Conditions = DEFAULT_CONDITIONS
    expectation: Expectation = DEFAULT_EXPECTATION
    requirements: tuple[str, ...] = ()
    at_least_logs: int = 1
    places: Pairs[str] = ()
    is_whole: bool = True

    def place(self, key: str) -> str:
        """Return the beginning of an error: the place of a key and the case; "" for a command line."""
        places = dict(self.places)
        return f"{places.get(key, places[''])}: case {self.name[:60]!r}: " if places else ""


@dataclass(frozen=True, slots=True)
class Suite:
    """The cases of a batch.

    Attributes:
        name: name in reports: the stem of the suite's file.
        folder: base of relative log paths.
        cases: one case or more, with different names.
        path: path of the suite's file; None for a command line.
        faults: lines and messages of faults in the file; `prepare` raises them with all other faults.
    """

    name: str
    folder: Path
    cases: tuple[Case, ...]
    path: Path | None = None
    faults: tuple[tuple[int, str], ...] = ()

    def allowing(self, kinds: AbstractSet[str]) -> Suite:
        """Return the suite with further allowed kinds of inconclusive results in every case."""
        cases = [
            replace(case, expectation=replace(case.expectation, allow=case.expectation.allow | kinds))
            for case in self.cases
        ]
        return replace(self, cases=tuple(cases))

    @classmethod
    def of_logs(
        cls,
        logs: Sequence[str],
        specs: Sequence[Path | str],
        conditions: Conditions = DEFAULT_CONDITIONS,
    ) -> Suite:
        """Return a suite with one case, named "logs". Paths are relative to the current folder."""
        patterns = tuple(LogPattern(log) for log in logs)
        return cls("batch", Path(), (Case("logs", patterns, tuple(specs), conditions),))


def load_suite(path: str | PathLike[str]) -> Suite:
    """Load a suite file (YAML; `schemas/suite.schema.json`).

    Keys next to `cases` are the defaults of all cases. Paths are relative to the file. Faults of the file are
    in `Suite.faults`, and `prepare` raises them with all other faults.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not UTF-8.
    """
    path = Path(path)
    text = read_yaml_text(path, LARGEST_SUITE)

    def find(document: Document) -> list[tuple[Place, str]]:
        return list(_contradictions(document.value, path.parent))

    document = document_from_text(text, "a suite", LARGEST_SUITE)
    by_place = faults_by_place(document, schema_of("batch", "suite"), find)
    faults = tuple(numbered_faults(document, by_place))
    return Suite(
        path.stem.removesuffix(".replay"), path.parent, tuple(_cases(document, by_place, path)), path, faults
    )


def _cases(document: Document, faults: Mapping[Place, str], path: Path) -> Iterator[Case]:
    """Yield the cases of a suite, without faulty values."""
    suite_values = document.value if isinstance(document.value, dict) else {}
    entries = suite_values.get("cases")
    faulty_places = {place[:end] for place in faults for end in range(1, len(place) + 1)}
    for index, entry in enumerate(entries if isinstance(entries, list) else ()):
        if isinstance(entry, dict):
            case_place: Place = ("cases", index)
            places: dict[str, Place] = {key: (key,) for key in suite_values if key != "cases"}
            places |= {key: (*case_place, key) for key in entry}
            yield _case({**suite_values, **entry}, {"": case_place, **places}, faulty_places, document, path)


def _case(
    entry: Mapping[str, Any],
    places: Mapping[str, Place],
    faults: AbstractSet[Place],
    document: Document,
    path: Path,
) -> Case:
    """Return a case from an entry.

    Args:
        places: places of the case (key "") and of its keys.
        faults: places of faults, and all places that contain a fault.
    """
    folder = path.parent
    line_texts = {key: f"{path.name}:{document.line_of(place)}" for key, place in places.items()}

    def texts_of(key: str) -> Iterator[tuple[Place, str]]:
        for index, text in enumerate(_as_list(entry.get(key))):
            place = (*places[key], index)
            if isinstance(text, str) and place not in faults:
                yield place, text

    logs = [LogPattern(log, f"{path.name}:{document.line_of(place)}") for place, log in texts_of("logs")]
    specs = dict.fromkeys(spec for _, spec in texts_of("specs"))
    is_whole = bool(specs) and not any(places.get(key) in faults for key in ("specs", "each", "constants"))
    name = str(entry.get("name", ""))
    entry = {key: text for key, text in entry.items() if places.get(key) not in faults}
    mapping = entry.get("mapping")
    # YAML reads a time such as 5 as a number
    start, end = entry.get("from"), entry.get("to")
    return Case(
        name=name,
        logs=tuple(logs),
        specs=tuple(_file(spec, folder) for spec in specs),
        conditions=Conditions(
            mapping=None if mapping is None else _file(mapping, folder),
            reading=tuple((key, entry[key]) for key in KEYS if key in entry),
            start=None if start is None else str(start),
            end=None if end is None else str(end),
            every=entry.get("every", 1),
            each=_pairs(entry.get("each", {})),
            semantics=entry.get("semantics", "ltlf"),
            strict_names=entry.get("strict_names", False),
            constants=_pairs(entry.get("constants", {})),
            # as a text, because conditions have to be hashable
            requires=json.dumps(entry["requires"], sort_keys=True) if entry.get("requires") else "",
        ),
        expectation=Expectation(
            Verdict(entry.get("expect", "satisfied")),
            entry.get("at_least"),
            entry.get("tolerance", 0.0),
            entry.get("allow_unknown", False),
            frozenset(_as_list(entry.get("allow"))),
        ),
        requirements=tuple(_as_list(entry.get("requirements"))),
        at_least_logs=entry.get("at_least_logs", 1),
        places=tuple(line_texts.items()),
        is_whole=is_whole,
    )


def _contradictions(value: Any, folder: Path) -> Iterator[tuple[Place, str]]:
    """Yield the faults in a suite that a schema cannot express. The value may have any type."""
    if not isinstance(value, dict):
        return
    yield from _wrong_values(value, (), folder)
    cases = value.get("cases")
    first_indices: dict[str, int] = {}
    for index, entry in enumerate(cases if isinstance(cases, list) else ()):
        if not isinstance(entry, dict):
            continue
        yield from _wrong_values(entry, ("cases", index), folder)
        name = entry.get("name")
        if isinstance(name, str) and first_indices.setdefault(name, index) != index:
            yield ("cases", index, "name"), f"there is a case {name[:60]!r} already; give it another name"
        if "specs" not in entry and "specs" not in value:
            yield ("cases", index), "it has no specs; give it some, or the whole suite"
        case_values = {**value, **entry}
        if case_values.get("expect", "satisfied") != "satisfied" and "at_least" in case_values:
            message = (
                f"at_least is a least robustness, and {case_values['expect']} results are expected; "
                "remove one"
            )
            yield ("cases", index, "at_least"), message


def _wrong_values(entry: Mapping[str, Any], place: Place, folder: Path) -> Iterator[tuple[Place, str]]:
    """Yield invalid times and missing files."""
    for key in ("from", "to"):
        if isinstance(entry.get(key), str | int):
            try:
                time_point_from_text(str(entry[key]))
            except UsageError as error:
                yield (*place, key), str(error)
    specs = entry.get("specs")
    files = [((*place, "mapping"), entry.get("mapping"))]
    files += [
        ((*place, "specs", index), spec)
        for index, spec in enumerate(specs if isinstance(specs, list) else [specs])
    ]
    for file_place, name in files:
        if isinstance(name, str) and name and not is_address(name) and not _is_file(folder / name):
            yield file_place, f"there is no file {name[:200]!r}; paths are relative to the suite's file"


def _file(name: str, folder: Path) -> Path | str:
    """Return the path of a file in a suite; an address is unchanged."""
    return name if is_address(name) else folder / name


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _pairs(table: Mapping[str, _Value]) -> Pairs[_Value]:
    return tuple(sorted(table.items()))


def _as_list(value: Any) -> Sequence[Any]:
    """Return the values of a key with one text or a list. Other types have no values."""
    return [value] if isinstance(value, str) else value if isinstance(value, list) else ()
