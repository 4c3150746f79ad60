"""A suite before it runs: its logs found, its specifications read, and all that is wrong with it, at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from spatial_replay.batch.log_files import FoundLog, find_logs
from spatial_replay.batch.rows import parsed_specifications
from spatial_replay.batch.spec_files import SpecFile, choice_faults, read_specification_text, spec_file
from spatial_replay.batch.suite import Case, Suite
from spatial_replay.batch.workers import Progress, no_progress
from spatial_replay.errors import Diagnosis, SpecificationError, UsageError
from spatial_replay.mapping.mapping_file import load_mapping
from spatial_replay.mapping.yaml_document import MOST_FAULTS
from spatial_replay.spec.overrides import SpecificationText


@dataclass(frozen=True, slots=True)
class PreparedCase:
    """A case with the logs that its patterns stand for, and its specification files, checked."""

    case: Case
    logs: tuple[FoundLog, ...]
    files: tuple[SpecFile, ...]


def prepare(suite: Suite, progress: Progress = no_progress) -> tuple[PreparedCase, ...]:
    """Find the logs of each case of a suite, and read and check its specifications and mappings.

    Raises:
        SpecificationError: nothing is wrong but specifications; all of their errors are in it.
        UsageError: patterns without a log, files that cannot be used, templates without objects, what else
            is wrong in the suite; all of it is listed, with lines.
        RemoteError: a bucket cannot be listed.
    """
    faults = _Faults(suite)
    texts: dict[Path | str, SpecificationText | None] = {}
    cases = []
    with progress("finding logs", None):
        for case in suite.cases:
            logs: list[FoundLog] = []
            try:
                logs = find_logs(case.logs, suite.folder)
            except UsageError as error:
                for line in str(error).split("\n"):
                    faults.add(line)
            cases.append(PreparedCase(case, tuple(logs), _files(case, suite.folder, texts, faults)))
    faults.check()
    return tuple(cases)


@dataclass(slots=True)
class _Faults:
    """What is wrong with a suite, as far as it is known; each fault once."""

    suite: Suite
    lines: dict[str, None] = field(default_factory=dict)
    diagnoses: dict[str, Diagnosis] = field(default_factory=dict)

    def add(self, text: str) -> None:
        self.lines[text] = None

    def check(self) -> None:
        """Raise all."""
        name = "" if self.suite.path is None else self.suite.path.name
        lines = [*(f"{name}:{line}: {fault}" for line, fault in self.suite.faults), *self.lines]
        if self.diagnoses and not lines:
            raise SpecificationError(list(self.diagnoses.values()))
        if lines:
            lines = [*sorted(lines, key=self._line), *map(_in_one_line, self.diagnoses.values())]
            more = [f"… and {len(lines) - MOST_FAULTS} more"] if len(lines) > MOST_FAULTS else []
            raise UsageError("\n".join(lines[:MOST_FAULTS] + more))

    def _line(self, fault: str) -> float:
        """Return the line of the suite that a fault is in; others come last."""
        name, _, rest = fault.partition(":")
        number = rest.partition(":")[0]
        is_own = self.suite.path is not None and name == self.suite.path.name and number.isdecimal()
        return int(number) if is_own else float("inf")


def _in_one_line(diagnosis: Diagnosis) -> str:
    """Return an error of a specification without the line it is in, whose mark would be out of place."""
    head, hint = str(diagnosis).split("\n")[0], getattr(diagnosis, "hint", "")
    return f"{head}; {hint}" if hint else head


def _files(
    case: Case, folder: Path, texts: dict[Path | str, SpecificationText | None], faults: _Faults
) -> tuple[SpecFile, ...]:
    """Return the specification files of a case, or those of them that can be read."""
    for path in case.specs:
        if path in texts:
            continue
        texts[path] = None
        try:
            texts[path] = read_specification_text(path)
        except SpecificationError as error:
            faults.diagnoses.update((str(each), each) for each in error.diagnoses)
        except UsageError as error:
            faults.add(f"{case.place('specs')}{error}")
    if case.conditions.mapping is not None:
        try:
            load_mapping(case.conditions.mapping)
        except UsageError as error:
            faults.add(str(error))
    own = tuple(text for path in case.specs if (text := texts[path]) is not None)
    if not case.is_whole or len(own) < len(case.specs):
        return ()
    try:
        parsed = parsed_specifications(own, case.conditions)
    except SpecificationError as error:
        faults.diagnoses.update((str(each), each) for each in error.diagnoses)
        return ()
    except UsageError as error:
        faults.add(f"{case.place('constants')}{error}")
        return ()
    for fault in choice_faults(case, parsed):
        faults.add(f"{case.place('each')}{fault}")
    return tuple(spec_file(*each, folder) for each in zip(case.specs, own, parsed, strict=True))
