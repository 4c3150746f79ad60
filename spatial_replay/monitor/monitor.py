"""A monitor: a specification beside a running system, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.evaluation import no_such_node, require_specification
from spatial_replay.monitor.instances import find_instances
from spatial_replay.monitor.stream import EvaluationStream, Stretch
from spatial_replay.monitor.verdict import Verdict, online_verdict, worst_verdict
from spatial_replay.spec.formula import NamedSpec, Specification, iter_nodes
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.times import FOREVER
from spatial_replay.trace.trace import Trace


@dataclass(frozen=True, slots=True)
class NodeUpdate:
    """One node after one sample (see `NodeResult` for what the numbers mean)."""

    id: int
    name: str | None
    value: float
    now: float
    lower: float
    upper: float

    @property
    def verdict(self) -> Verdict:
        """Satisfied or violated where no continuation can change that, pending otherwise."""
        return online_verdict(self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class SpecUpdate:
    """One spec after one sample.

    Attributes:
        numbers: (N, 4): value, now, lower and upper of each node; None before the monitor's start.
    """

    spec: NamedSpec
    numbers: Floats | None

    @cached_property
    def nodes(self) -> tuple[NodeUpdate, ...]:
        """Every node, by id; none before the monitor's start."""
        if self.numbers is None:
            return ()
        return tuple(
            NodeUpdate(identifier, node.name, *numbers)
            for (identifier, _, node), numbers in zip(
                iter_nodes(self.spec.formula), self.numbers.tolist(), strict=True
            )
        )

    @property
    def verdict(self) -> Verdict:
        """The root's verdict; pending before the monitor's start."""
        if self.numbers is None:
            return Verdict.PENDING
        return online_verdict(float(self.numbers[0, 2]), float(self.numbers[0, 3]))


@dataclass(frozen=True, eq=False)
class Update:
    """What a monitor says after a sample."""

    time_ns: int
    specs: tuple[SpecUpdate, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of the specs'."""
        return worst_verdict(spec.verdict for spec in self.specs)

    def node(self, name: str) -> NodeUpdate:
        """The node of a named spec, wherever it stands.

        Raises:
            UsageError: no node has the name.
        """
        for spec in self.specs:
            for node in spec.nodes:
                if node.name == name:
                    return node
        names = {node.name for spec in self.specs for node in spec.nodes if node.name}
        raise UsageError(no_such_node(name, sorted(names)))


class Monitor:
    """Evaluates a specification as samples come.

    A sample costs the same however long the run is, and gives the same bits as a replay of its log.
    """

    def __init__(
        self, specification: Specification, *, semantics: str = "ltlf", start_ns: int | None = None
    ) -> None:
        """Start before the first sample.

        Args:
            start_ns: samples before this time are only there to be looked back at (`a[-3]`).

        Raises:
            UsageError: something else than a specification, unknown semantics, or a template: it stands
                for objects that are not known yet.
        """
        require_specification(specification)
        if semantics != "ltlf":
            raise UsageError(f"no semantics {semantics!r}; there is 'ltlf'")
        templates = [spec for spec in specification.results if spec.parameter is not None]
        if templates:
            names = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates)
            raise UsageError(f"{names} is a template; name its object, or evaluate it over a log")
        self._specs = specification.results
        instances = find_instances(specification, {}, (), start_ns or 0, FOREVER)
        self._stream = EvaluationStream(instances, specification.regions)

    def update(self, sample: Sample) -> Update:
        """Take in the next sample.

        Raises:
            TraceError: a time that does not come after the last one's.
        """
        stretches = self._stream.extend(Trace.from_samples([sample]))
        return Update(sample.time_ns, tuple(map(_spec_update, self._specs, stretches)))


def _spec_update(spec: NamedSpec, stretch: Stretch) -> SpecUpdate:
    return SpecUpdate(spec, stretch.series[:, :, -1] if len(stretch.times_ns) else None)
