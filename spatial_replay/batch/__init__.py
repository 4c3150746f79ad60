"""Many logs: a suite of cases in, rows of results out.

`suite` reads the cases, `logs` finds logs and specifications, and `rows` evaluates one log. `run` does all of
them with the processes of `workers`. `store` keeps rows; `outputs` and `baseline` show and compare them.

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
