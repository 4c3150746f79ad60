"""`spatial-replay plan --redo LOG`: what the planner of a log would have decided otherwise."""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spatial_replay.cli.application import ExitCode, most_severe
from spatial_replay.cli.decisions import choice_text, decision_rows, fitted_lines
from spatial_replay.cli.options import load_spec_options, require_choice
from spatial_replay.cli.progress import progress
from spatial_replay.cli.terminal import show, show_json, warn
from spatial_replay.logs.remote import LogFile, local_files
from spatial_replay.text import counted, counted_from, time_text

if TYPE_CHECKING:
    from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanCandidate, PlanDecision
    from spatial_replay.logs.source import Source
    from spatial_replay.planning.read import Replanned


def redo(
    log: LogFile,
    output: Path | None,
    spec: LogFile | None,
    of: str | None,
    constants: Mapping[str, float | str],
    profile: str | None,
    changes: Mapping[str, Any],
    as_json: bool,
) -> int:
    """Decide again on the samples of a log, and show the first decision that differs."""
    # imported here so that --help stays fast
    from spatial_replay.planning.read import ReplannedSource, redo_decisions
    from spatial_replay.replay import ReplayOptions, known_start_ns, load_files, run_replay
    from spatial_replay.sources.open_log import open_source

    source = open_source(log)
    named = [] if spec is None else [spec]
    file = next(iter(load_spec_options(named, profile, constants, lambda: _recorded(source))), None)
    if file is not None:
        require_choice(file, of)
    with progress("samples") as advance:
        redone = redo_decisions(source, file, changes, name=of, advance=advance)
    warn(*counted_from(redone.faults, known_start_ns(source) if redone.faults else 0))
    if output is not None:
        files = load_files((), source) if file is None else [file]
        beside = ReplannedSource(source, redone.messages)
        run_replay(beside, files, ReplayOptions(), output=output, inputs=local_files([log, *named]))
    if as_json:
        show_json(_document(redone))
    else:
        width = shutil.get_terminal_size((100, 24)).columns
        show(*fitted_lines(_lines(redone), width), *_maps_side_by_side(redone, (width - 13) // 2))
        if output is not None:
            show(f"wrote {output}: {shlex.join(['spatial-replay', 'report', str(output)])} shows both")
    code = ExitCode.VIOLATED if redone.is_different else ExitCode.SATISFIED
    return most_severe([code, ExitCode.DAMAGED]) if redone.faults else code


def _recorded(source: Source) -> Any:
    from spatial_replay.planning.read import planner_of

    return planner_of(source).specification


def _document(redone: Replanned) -> dict[str, Any]:
    sides = {
        side: None if step is None else decision_rows([step.message])[0]
        for side, step in (("recorded", redone.recorded), ("redone", redone.redone))
    }
    return {
        "name": redone.name,
        "damaged": bool(redone.faults),
        "changes": redone.changes,
        "decisions": redone.decisions,
        "same": redone.same,
        "alike": redone.alike,
        "differs_ns": None if redone.sample is None else redone.sample.time_ns,
        **sides,
    }


def _lines(redone: Replanned) -> Iterator[str]:
    yield f"{redone.name}: {counted(redone.decisions, 'decision')}, redone with {_changes(redone)}"
    if redone.same:
        yield f"{_first(redone.same, redone.decisions)} the same, byte for byte, with all maps"
    if redone.alike > redone.same:
        number = redone.alike - redone.same
        also = "then " if redone.same else ""
        verb = "does" if number == 1 else "do"
        yield f"{also}{counted(number, 'decision')} {verb} the same, with other maps or reasons"
    if redone.redone is None or redone.sample is None:
        return
    at = time_text(redone.sample.time_ns)
    new = redone.redone.message
    if redone.recorded is None:
        yield f"at {at}, where the log has no decision, the wait is over:"
    else:
        old = redone.recorded.message
        yield f"decision {old.number} at {at} differs"
        yield f"  recorded  {choice_text(old)}"
    yield f"  redone    {choice_text(new)}"
    if new.HasField("lost") and new.lost.text:
        yield f"            at {time_text(new.lost.time_ns)}: {new.lost.text}"


def _changes(redone: Replanned) -> str:
    return ", ".join(redone.changes) if redone.changes else "nothing changed"


def _first(count: int, of: int) -> str:
    if count == of:
        return "all decisions are" if of > 1 else "the decision is"
    return f"the first {counted(count, 'decision')} are" if count > 1 else "the first decision is"


def _maps_side_by_side(redone: Replanned, column: int) -> Iterator[str]:
    """Yield what the maps of the last edges say, of each object in two columns.

    Args:
        column: characters of a column.
    """
    if redone.recorded is None or redone.redone is None:
        return
    messages = redone.recorded.message, redone.redone.message
    sides = [{each.object: each for each in _candidates(message)} for message in messages]
    for name in dict.fromkeys((*sides[0], *sides[1])):
        yield f"{f'map of {name}':<13}{'recorded':<{column}}redone"
        rows = [_rows(side.get(name)) for side in sides]
        for key in dict.fromkeys((*rows[0], *rows[1])):
            ours, theirs = ([_cut(text, column) for text in row.get(key, ())] for row in rows)
            for place in range(max(len(ours), len(theirs))):
                left, right = (each[place] if place < len(each) else "" for each in (ours, theirs))
                yield f"  {key if not place else '':<11}{left:<{column}}{right}".rstrip()


def _cut(text: str, column: int) -> str:
    return text if len(text) < column else f"{text[: column - 2]}…"


def _candidates(message: PlanDecision) -> list[PlanCandidate]:
    return list(message.considered[-1].candidates) if message.considered else []


def _rows(candidate: PlanCandidate | None) -> dict[str, list[str]]:
    from spatial_replay.planning.decisions import candidate_lines

    if candidate is None:
        return {}
    best = "nowhere free" if math.isinf(candidate.best) else f"{candidate.best:.4g}"
    rows = {"best": [best]}
    if candidate.HasField("target"):
        target = candidate.target
        rows["target"] = [f"({target.x:.4g}, {target.y:.4g}), robustness {target.robustness:.4g}"]
    elif candidate.rejected:
        rows["rejected"] = [candidate.rejected]
    for key, line in candidate_lines(candidate):
        rows.setdefault(key, []).append(line)
    return rows
