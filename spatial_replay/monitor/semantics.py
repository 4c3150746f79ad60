"""The two semantics of a formula: the one place that chooses the evaluator by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple, Protocol, TypeAlias, cast, get_args

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Empty, Floats, Integers
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.step import ROOM, OnlineRun
from spatial_replay.monitor.paper import PaperRun, check_operators, left_out
from spatial_replay.spec.formula import Formula, Specification

Semantics: TypeAlias = Literal["ltlf", "paper"]
"""Robustness over finite traces, or the paper's Def. 16 to the letter."""


def checked_semantics(name: str, specifications: Iterable[Specification] = ()) -> Semantics:
    """Return a name as semantics that define all operators of some specifications.

    Raises:
        UsageError: an unknown name, or an operator without a meaning.
    """
    if name not in get_args(Semantics):
        known = " and ".join(repr(each) for each in get_args(Semantics))
        raise UsageError(f"no semantics {name!r}; there are {known}")
    if name == "paper":
        for specification in specifications:
            check_operators(specification)
    return cast(Semantics, name)


def require_ltlf(semantics: Semantics, what: str) -> None:
    """Check that results have signals, windows and witnesses, which only "ltlf" defines.

    Raises:
        UsageError: other semantics.
    """
    if semantics != "ltlf":
        raise UsageError(f"{what} is not defined under the semantics {semantics!r}; evaluate with 'ltlf'")


class Run(Protocol):
    """One formula on one stream of samples."""

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the log ends here."""

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples; return value, now, lower and upper of each node, (N, 4, T), as `empty` gives them."""

    def __len__(self) -> int:
        """Return how many samples were added."""


class Evaluator(NamedTuple):
    """A formula with its program, evaluated under some semantics.

    Attributes:
        program: of the formula; its leaves are evaluated under either semantics.
    """

    formula: Formula
    program: Program
    semantics: Semantics

    @property
    def has_open_end(self) -> bool:
        """Whether numbers before the end of a log are about its continuations, too."""
        return self.semantics == "ltlf"

    def begin(self, *, is_live: bool = False) -> Run:
        """Start a run before the first sample; samples of a live one come one by one."""
        if self.semantics == "paper":
            return PaperRun(self.formula, self.program.leaves)
        return OnlineRun(self.program, room=ROOM, tile=1) if is_live else OnlineRun(self.program)

    def leaves_within_log(
        self, leaves: Floats, positions: Integers, times_ns: Integers, first_ns: int
    ) -> Floats:
        """Return leaves with those that look back to before the log marked as the semantics require.

        Args:
            leaves: (C, A, T).
            positions: (T,), how many samples of the log come before each.
            times_ns: (T,).
            first_ns: time of the log's first sample.
        """
        if self.semantics == "paper":
            return left_out(leaves, self.program.leaves, positions, times_ns, first_ns)
        return leaves  # unknown there, which their intervals say
