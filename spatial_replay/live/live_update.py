"""What a session reports: how it goes, and what each sample gives."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from spatial_replay.errors import UsageError
from spatial_replay.monitor.monitor import NodeUpdate, SpecUpdate, Update
from spatial_replay.monitor.result import no_such_node
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.monitor.violation import Violation
from spatial_replay.recording.changes import VerdictChange
from spatial_replay.trace.sample import Sample


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """How a session goes.

    Attributes:
        server: the name that the server gives itself, or None before it is connected.
        is_connected: whether the connection stands.
        waits_for: topics that the server does not offer yet.
        samples, messages: evaluated, and received.
        dropped: samples that were dropped because evaluation fell behind.
        messages_dropped: messages that were dropped before they made samples.
        overdue: observations whose transforms did not come within `max_delay`.
        delay_s: of the newest sample, from the arrival of its message to its verdict; NaN before.
        time_ns: of the newest sample; None before the first.
    """

    server: str | None
    is_connected: bool
    waits_for: tuple[str, ...]
    samples: int
    messages: int
    dropped: int
    messages_dropped: int
    overdue: int
    delay_s: float
    time_ns: int | None


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """What one sample gives.

    Attributes:
        sample: the objects and signals.
        changes: verdicts and signs that changed with this sample, each with its reason.
        notes: what happened besides since the last update: a connection that was lost, a topic that fell
            silent.
        delay_s: from the arrival of the message that completed it to its verdict.
        dropped: how many samples were dropped so far.
        updates: of each specification file, what its monitor gives.
    """

    sample: Sample
    changes: tuple[VerdictChange, ...]
    notes: tuple[str, ...]
    delay_s: float
    dropped: int
    updates: tuple[Update, ...] = field(repr=False)

    @property
    def time_ns(self) -> int:
        """The time of the sample."""
        return self.sample.time_ns

    @property
    def verdict(self) -> Verdict:
        """The worst of the specs'."""
        return worst_verdict(each.verdict for each in self.updates)

    @property
    def specs(self) -> tuple[SpecUpdate, ...]:
        """Every result spec."""
        return tuple(spec for update in self.updates for spec in update.specs)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """What is violated whatever comes; see `Update.violations`."""
        return tuple(each for update in self.updates for each in update.violations)

    def node(self, name: str) -> NodeUpdate:
        """Return the root node of a named spec, wherever it occurs.

        Raises:
            UsageError: no node has the name.
        """
        for update in self.updates:
            if name in update.places:
                return update.node(name)
        known = sorted(each for update in self.updates for each in update.places)
        raise UsageError(no_such_node(name, known))
