"""Assertions for users' tests: a log satisfies a specification, or the test fails with the reason."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any, Unpack

from spatial_replay.api import Evaluating, Log, Specifications, replay_log
from spatial_replay.batch.suite import Expectation
from spatial_replay.replay.engine import Replayed
from spatial_replay.text import requirement_text


def assert_satisfied(
    log: Log,
    specifications: Specifications | None = None,
    *,
    at_least: float | None = None,
    tolerance: float = 0.0,
    allow: Iterable[str] = (),
    **options: Unpack[Evaluating],
) -> Replayed:
    """Evaluate specifications over a log, and fail unless every result is satisfied.

    Args:
        log: a file in any format, an address, or a trace.
        specifications: one or several, parsed or as files; None for the specifications in the log.
        at_least: least robustness of a passing result, instead of a verdict, in the units of the formula.
        tolerance: accepted loss below the limit, for rounding.
        allow: "vacuous", "dropped" and "doubtful": kinds of results that pass although nothing tested them,
            the recorder dropped samples, or the log contradicts an assumption.
        options: options of evaluation and reading, as for `replay_log`.

    Returns:
        The results of `replay_log`, for further assertions.

    Raises:
        AssertionError: a result is violated, unknown, less robust, doubtful, or tested by nothing, or the log
            is damaged. The message has the sentences of `explain`.
        UsageError, SpecificationError, LogError: the log cannot be evaluated.
    """
    # pytest leaves this frame out of tracebacks
    __tracebackhide__ = True
    replayed = replay_log(log, specifications, **options)
    expectation = Expectation(at_least=at_least, tolerance=tolerance, allow=frozenset(allow))
    reasons = []
    for result in replayed.results:
        # the fields of a batch's row that decide between pass and failure
        outcome: Any = SimpleNamespace(
            verdict=result.verdict,
            lower=result.lower,
            tested=result.tested,
            untested=[part.message for part in result.untested],
            vacuous=result.vacuous,
            doubtful=[doubt.text for doubt in result.doubts],
            dropped=replayed.dropped.text,
            faults=(),
        )
        failure = expectation.failure(outcome)
        if failure is not None:
            title = result.name if result.object is None else f"{result.name}[{result.object}]"
            explanation = result.sentences(replayed.first_ns) if result.can_explain else ()
            requirement = requirement_text(result.spec.id, result.spec.title)
            lines = [f"{replayed.log}: {title}: {failure}", requirement, *map(str, explanation)]
            reasons.append("\n".join(filter(None, lines)))
    if "vacuous" not in expectation.allow:
        reasons += [f"{replayed.log}: {part.message}" for part in replayed.vacuous]
    reasons += [f"{replayed.log} is damaged: {fault}" for fault in replayed.faults[:1]]
    if reasons:
        raise AssertionError("\n\n".join(reasons))
    return replayed
