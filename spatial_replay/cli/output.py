"""Results as text and as JSON: verdicts of a replay, decisions of a planned run."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from spatial_replay.cli.terminal import Coloured, Line, show, show_json
from spatial_replay.monitor.verdict import counts_text
from spatial_replay.text import counted_from, escape_text, plural, requirement_text, time_text, with_unit

if TYPE_CHECKING:
    from spatial_replay.monitor.monitor import Ending
    from spatial_replay.monitor.result import SpecResult
    from spatial_replay.recording.log import VerdictChange
    from spatial_replay.replay.engine import Replayed

WORST_FIRST: Final = ("violated", "unknown", "satisfied")
MANY: Final = 6
"""Number of results above which results are also counted by verdict."""
_MOST_SHOWN: Final = 20
"""Number of results up to which all results are printed; above, the worst `_SHOWN` results are printed."""
_SHOWN: Final = 12
VERDICT_COLOURS: Final = MappingProxyType({"satisfied": "blue", "violated": "red", "unknown": "yellow"})
_CHANGE_COLOURS: Final = MappingProxyType({**VERDICT_COLOURS, "holds": "blue", "pending": "yellow"})


def change_line(change: VerdictChange, first_ns: int) -> Line:
    """Return a change of a verdict as a line.

    Args:
        first_ns: zero of printed times.
    """
    label = Coloured(f"{change.state:<9}", _CHANGE_COLOURS[change.state])
    return f"{time_text(change.time_ns, first_ns):>12}  ", label, f"  {change.sentence}"


def ending_lines(endings: Sequence[Ending]) -> Iterator[Line]:
    """Yield a line for the result of each spec when a run ends."""
    width = max((len(escape_text(ending.spec.name)) for ending in endings), default=0)
    for ending in endings:
        verdict = Coloured(f"{ending.verdict:<9}", _CHANGE_COLOURS[str(ending.verdict)])
        yield f"  {escape_text(ending.spec.name):<{width}}  ", verdict, f"  {_ending_numbers(ending)}"
        if ending.reason:
            yield f"  {'':<{width}}  {ending.reason}"


def _ending_numbers(ending: Ending) -> str:
    robustness, lower, upper = ending.robustness, ending.lower, ending.upper
    lower_text, upper_text = with_unit(lower, ending.unit), with_unit(upper, ending.unit)
    doubtful = "doubtful, " if ending.doubts else ""
    if math.isnan(robustness):
        return f"{doubtful}robustness not determined, between {lower_text} and {upper_text}"
    bounds_text = "" if lower == upper == robustness else f", between {lower_text} and {upper_text}"
    return f"{doubtful}robustness {with_unit(robustness, ending.unit)}{bounds_text}"


def print_verdicts(replayed: Replayed, output: Path | None, window_ns: int | None = None) -> None:
    """Print one line for each result, and a further line for a sliding window."""
    span_text = time_text(replayed.end_ns, replayed.start_ns)
    notes = ", damaged: verdicts are over what could be read" if replayed.faults else ""
    verdicts = [result.verdict for result in replayed.results]
    count_text = f": {counts_text(verdicts)}" if len(verdicts) > MANY else ""
    notes += f"; {replayed.dropped.text}" if replayed.dropped.count else ""
    show(f"{replayed.log}: {plural(replayed.samples, 'sample')} over {span_text}{notes}{count_text}")
    results, other_results = worst_of(replayed.results)
    # escaped before the widths are measured, because escapes are wider
    titles = [
        escape_text(f"{result.title} [{result.spec.id}]" if result.spec.id else result.title)
        for result in results
    ]
    title_width = max(map(len, titles), default=0)
    titled_specs: set[str] = set()
    for title, result in zip(titles, results, strict=True):
        verdict = Coloured(f"{result.verdict:<9}", VERDICT_COLOURS[result.verdict])
        show((f"  {title:<{title_width}}  ", verdict, f"  {_numbers(result, replayed.first_ns)}"))
        # results of one template share its title
        if result.spec.title and result.name not in titled_specs:
            show(f"  {'':<{title_width}}  {result.spec.title}")
            titled_specs.add(result.name)
        for line in _below(result, replayed.first_ns):
            show(f"  {'':<{title_width}}  {line}")
        if window_ns is not None:
            show(f"  {'':<{title_width}}  {_over_window(result, replayed.first_ns, window_ns)}")
    if other_results:
        show(f"  {others_text(other_results)}")
    for part in replayed.vacuous:
        show(f"  vacuous: {part.message}")
    if output is not None:
        show(f"wrote {output}")


def write_document(
    replayed: Replayed, file: str, inputs: Sequence[Path], *, signal: bool, window_ns: int | None
) -> None:
    """Write all results as one JSON object to a file, or to standard output for "-"."""
    from spatial_replay.logs.output_file import replacing
    from spatial_replay.replay.document import document_from_replay

    document = document_from_replay(replayed, signal=signal, window_ns=window_ns)
    if file == "-":
        show_json(document, indent=None)
        return
    text = json.dumps(document, ensure_ascii=False, allow_nan=False)
    with replacing(Path(file), inputs) as stream:
        stream.write(text.encode() + b"\n")


def worst_of(results: Sequence[SpecResult]) -> tuple[Sequence[SpecResult], Sequence[SpecResult]]:
    """Return the results to print, the worst first, and the results that are only counted."""
    # imported here since it loads numerical libraries
    from spatial_replay.monitor.result import worst_first

    results = [results[place] for place in worst_first(results)]
    printed_count = _SHOWN if len(results) > _MOST_SHOWN else len(results)
    return results[:printed_count], results[printed_count:]


def others_text(others: Sequence[SpecResult], verdicts: Sequence[str] | None = None) -> str:
    """Return the line about results that are not printed.

    Args:
        verdicts: verdicts of these results; by default the final verdicts.
    """
    hint = ", --each VAR=OBJECT shows one" if any(result.object is not None for result in others) else ""
    count_text = counts_text([result.verdict for result in others] if verdicts is None else verdicts)
    return f"… and {len(others):,} more: {count_text}; --json has all{hint}"


def _numbers(result: SpecResult, first_ns: int) -> str:
    robustness, lower, upper = result.robustness, result.lower, result.upper
    facts = ["doubtful"] if result.doubts else []
    facts += ["tested by nothing"] if result.tested == "nothing" else []
    facts.append(f"robustness {_number_text(robustness, result.unit)}")
    if not (lower == upper == robustness or math.isnan(lower)):
        facts.append(f"between {_number_text(lower, result.unit)} and {_number_text(upper, result.unit)}")
    if robustness == 0.0:
        facts.append("marginal")
    certain_ns = result.certain_ns()
    if result.verdict != "violated" and result.first_satisfied_ns not in (None, certain_ns):
        state_text = "held so far" if result.verdict == "unknown" else "first satisfied"
        facts.append(f"{state_text} at {time_text(result.first_satisfied_ns or 0, first_ns)}")
    if certain_ns is not None:
        facts.append(f"certain since {time_text(certain_ns, first_ns)}")
    if result.least is not None and result.verdict == "violated":
        facts.append(f"the least robustness is that of `{result.least.name}`")
    elif result.least_at_ns is not None:
        least_time = time_text(result.least_at_ns, first_ns)
        facts += [f"least at {least_time}"] if f"certain since {least_time}" not in facts else []
    return ", ".join(facts)


def _below(result: SpecResult, first_ns: int) -> Iterator[str]:
    """Yield lines about the verdict's causes, its gaps, and its vacuous and cut parts."""
    # imported here so that --help stays fast
    from spatial_replay.monitor.sentences import cause_reason, gap_sentence

    for cause in result.causes:
        is_own_spec = cause.spec == result.name
        at_text = (
            "" if cause.settled_ns is None or cause.least else f" at {time_text(cause.settled_ns, first_ns)}"
        )
        requirement = "" if is_own_spec else requirement_text(cause.requirement, cause.title)
        requirement = f" [{requirement}]" if requirement else ""
        label = f"{cause.spec}{requirement}{at_text}: " if len(result.causes) > 1 or not is_own_spec else ""
        if cause.witness is not None:
            yield f"{label}{cause_reason(cause, first_ns)}"
        elif label:
            yield f"{label}{cause.verdict}, robustness {_number_text(cause.robustness)}"
    witness = result.worst
    for gap in () if witness is None else witness.gaps:
        if gap.missing < gap.samples:
            yield gap_sentence(gap, first_ns)
    cut_parts = result.untested if result.tested == "cut" else ()
    for label, parts in (("vacuous", result.vacuous), ("cut", cut_parts)):
        for message in counted_from((part.message for part in parts), first_ns):
            yield f"{label}: {message}"
    yield from result.goals_at_the_start


def _over_window(result: SpecResult, first_ns: int, window_ns: int) -> str:
    """Return the number of violations over the sliding window, and the first violation's time, as text."""
    if result.leaves is None:
        return ""
    robustness, times_ns = result.window_signal(window_ns)[0], result.times_ns
    window_text = f"over the last {time_text(window_ns)}"
    violated_indices = (robustness < 0.0).nonzero()[0]
    end_text = _number_text(float(robustness[-1]), result.unit)
    if not len(violated_indices):
        return f"{window_text} never violated; robustness at the end {end_text}"
    first_violated = time_text(int(times_ns[violated_indices[0]]), first_ns)
    violated_text = f"{len(violated_indices):,} of {plural(len(robustness), 'sample')}"
    return (
        f"{window_text} violated at {violated_text}, first at {first_violated}; "
        f"robustness at the end {end_text}"
    )


def _number_text(number: float, unit: str = "") -> str:
    return "not determined" if math.isnan(number) else with_unit(number, unit)


def align_rows(rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """Yield rows as lines with aligned columns."""
    # escaped before the widths are measured, because escapes are wider
    escaped_rows = [tuple(map(escape_text, row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*escaped_rows, strict=True)]
    for row in escaped_rows:
        yield "  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
