"""Many logs: a suite of cases in, rows of results out.

`suite` says what is evaluated, `prepare` checks it all, with `spec_files` and `log_files`; `rows`
evaluates one log with all its specifications, `run` does so for all of them with the processes of `workers`,
and `data_set` keeps what comes out. The other modules show it.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.batch.rows import ResultRow, Task, rows_from_task
    from spatial_replay.batch.suite import Case, Conditions, Expectation, LogPattern, Suite, load_suite

__all__ = [
    "Case",
    "Conditions",
    "Expectation",
    "LogPattern",
    "ResultRow",
    "Suite",
    "Task",
    "load_suite",
    "rows_from_task",
]

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "rows": ("ResultRow", "Task", "rows_from_task"),
        "suite": ("Case", "Conditions", "Expectation", "LogPattern", "Suite", "load_suite"),
    },
)
