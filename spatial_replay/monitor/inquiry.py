"""One result over a finished log, to be asked for more than its numbers: signals, windows, reasons."""

from __future__ import annotations

from dataclasses import dataclass

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.finished import full_signal, window_signal
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.witness import Witness, find_witness


@dataclass(frozen=True, eq=False)
class Inquiry:
    """What an instance was evaluated from; each question is worked out when it is asked.

    Attributes:
        evidence: the samples, to be looked at again.
        times_ns: (T,) int64, their times.
        leaves: (C, A, T), the instance's leaves in them.
        semantics: what the formula meant; only "ltlf" has answers.

    Raises:
        UsageError: by every question, under other semantics.
    """

    evidence: Evidence
    times_ns: Integers
    leaves: Floats
    semantics: Semantics

    def full_signal(self) -> Floats:
        """(N, T): each node's robustness at each sample, from there to the end; NaN where not determined."""
        self._require_ltlf("the signal of a whole log")
        instance = self.evidence.instance
        return full_signal(instance.formula, instance.program.leaves, self.leaves, self.times_ns)

    def window_signal(self, width_ns: int) -> Floats:
        """(N, T): each node's robustness over the samples in (t - width, t], for the sample at each t.

        Past operators start where the window does; `a[-3]` may look before it. NaN where not determined.

        Raises:
            UsageError: a width below 1 ns.
        """
        self._require_ltlf("a sliding window")
        instance = self.evidence.instance
        return window_signal(instance.formula, instance.program.leaves, self.leaves, self.times_ns, width_ns)

    def witness(self, node: int = 0) -> Witness:
        """What decides a node's verdict over the whole log.

        Raises:
            UsageError: no node has that id.
        """
        self._require_ltlf("a witness")
        nodes = len(self.evidence.instance.program.reports)
        if not 0 <= node < nodes:
            raise UsageError(f"no node has the id {node}; they go from 0 to {nodes - 1}")
        return find_witness(self.evidence, self.leaves, self.times_ns, node)

    def _require_ltlf(self, what: str) -> None:
        if self.semantics != "ltlf":
            raise UsageError(
                f"{what} is not defined under the semantics {self.semantics!r}; evaluate with 'ltlf'"
            )
