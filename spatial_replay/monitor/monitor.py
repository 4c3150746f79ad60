"""Monitor a running system: a specification evaluated sample by sample."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from spatial_replay.compiled import compile_ahead
from spatial_replay.errors import SpecificationError, TraceError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.result import no_such_node
from spatial_replay.monitor.semantics import checked_semantics
from spatial_replay.monitor.stream import LiveStream
from spatial_replay.monitor.verdict import Verdict, final_verdict, online_verdict, worst_verdict
from spatial_replay.monitor.violation import Settled, Violation, ViolationLog, rehearse
from spatial_replay.spec.checks import check_names, object_names, signal_names, with_numbers
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import NamedSpec, Specification, iter_nodes
from spatial_replay.spec.load import require_specification
from spatial_replay.spec.walks import declared_unit
from spatial_replay.text import counted, named_arguments, time_text, times_apart
from spatial_replay.trace.trace import Sample, duration_ns_from_text, require_sample, require_time
from spatial_replay.trace.units import checked_units

_MOST_KNOWN: Final = 1000
"""Names that a missing one is compared with, of each kind."""


class NodeUpdate(NamedTuple):
    """One node after one sample (see `NodeResult` for the meaning of the numbers)."""

    id: int
    name: str | None
    value: float
    now: float
    lower: float
    upper: float

    @property
    def verdict(self) -> Verdict:
        """Satisfied or violated if no continuation can change that, pending otherwise."""
        return online_verdict(self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class SpecUpdate:
    """One spec after one sample.

    Attributes:
        numbers: (N, 4): value, now, lower and upper of each node; None before the monitor's start.
        names: the name of each node, or None.
        unit: the declared one of its robustness, or "".
    """

    spec: NamedSpec
    numbers: Floats | None
    names: tuple[str | None, ...] = field(repr=False)
    unit: str = ""

    @cached_property
    def nodes(self) -> tuple[NodeUpdate, ...]:
        """Every node, by id; none before the monitor's start."""
        if self.numbers is None:
            return ()
        columns = zip(range(len(self.names)), self.names, *self.numbers.T.tolist(), strict=True)
        return tuple(map(NodeUpdate._make, columns))

    def node(self, identifier: int) -> NodeUpdate:
        """Return the node with an id, once the monitor has started."""
        if self.numbers is None:
            raise UsageError(f"{self.spec.name!r} has no numbers yet; the monitor's start is still to come")
        return NodeUpdate(identifier, self.names[identifier], *self.numbers[identifier].tolist())

    @property
    def verdict(self) -> Verdict:
        """The root's verdict; pending before the monitor's start."""
        if self.numbers is None:
            return Verdict.PENDING
        return online_verdict(self.numbers.item(0, 2), self.numbers.item(0, 3))


class Monitored(NamedTuple):
    """The specifications of a monitor, the same after every sample.

    Attributes:
        specs: the result specs, with the names of their nodes and the unit of each.
        places: for each name of a node, its index in `specs` and its node.
    """

    specs: tuple[tuple[NamedSpec, tuple[str | None, ...], str], ...]
    places: Mapping[str, tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Update:
    """The numbers and verdicts after a sample.

    Attributes:
        numbers: for each result spec (N, 4), as in `SpecUpdate`.
        monitored: what they are numbers of.
        settled: what `violations` are found from.
        satisfied: the specs that are permanently satisfied; why is found when asked for (`reason`).
        remarks: a warning for each object and signal of the specification that is missing for too long.
    """

    time_ns: int
    numbers: Sequence[Floats | None]
    monitored: Monitored
    settled: tuple[Settled, ...] = ()
    satisfied: tuple[Settled, ...] = ()
    remarks: tuple[Diagnostic, ...] = ()

    @cached_property
    def specs(self) -> tuple[SpecUpdate, ...]:
        """One for each result spec, in the order of the text."""
        of_specs = zip(self.monitored.specs, self.numbers, strict=True)
        return tuple([SpecUpdate(spec, numbers, names, unit) for (spec, names, unit), numbers in of_specs])

    @property
    def places(self) -> Mapping[str, tuple[int, int]]:
        """For each name, its index in `specs` and its node."""
        return self.monitored.places

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """Permanent violations, in the order in which they became certain; computed on demand.

        The parts of a conjunction are reported apart. None under the paper's semantics, where later samples
        may change every verdict.
        """
        return tuple(each.violation for each in self.settled)

    @property
    def verdict(self) -> Verdict:
        """The worst of the specs'."""
        return worst_verdict(spec.verdict for spec in self.specs)

    def __repr__(self) -> str:
        return f"<Update: {self.verdict} at {self.time_ns} ns>"

    def node(self, name: str) -> NodeUpdate:
        """Return the root node of a named spec, wherever it occurs.

        Raises:
            UsageError: no node has the name.
        """
        if name not in self.places:
            raise UsageError(no_such_node(name, sorted(self.places)))
        spec, identifier = self.places[name]
        return self.specs[spec].node(identifier)


class Ending(NamedTuple):
    """The result of one spec if a run ends with its newest sample, as a replay of its log reports it.

    Attributes:
        robustness: the value of the root on the samples so far; NaN if it is not determined.
        lower, upper: the ends of the value's interval over the finished log.
        unit: the declared one of these, or "".
    """

    spec: NamedSpec
    verdict: Verdict
    robustness: float
    lower: float
    upper: float
    unit: str = ""


@named_arguments
class Monitor:
    """Evaluates a specification as samples come.

    Gives the same bits as a replay of the log. Time per sample and memory depend on the specification alone,
    not on the length of the run: on the samples that windows and delays (`a[-3]`) span. Only the paper's
    semantics makes temporal operators below others read every sample again.
    """

    def __init__(
        self,
        specification: Specification,
        *,
        semantics: str = "ltlf",
        start_ns: int | None = None,
        units: Mapping[str, str] | None = None,
        missing_after: str | int | None = "5s",
        strict_names: bool = False,
    ) -> None:
        """Start before the first sample, with everything compiled: the first time on a machine, that takes
        many seconds.

        Args:
            start_ns: samples before this time are only there to be looked back at (`a[-3]`).
            units: for sentences: of signals by their names, of lengths by "".
            missing_after: a time ("5s") or a number of samples; updates after it warn of each object and
                signal that has never come so far. None for no warnings.
            strict_names: a missing name is an error of `update` then.

        Raises:
            UsageError: not a specification, unknown semantics, an invalid start, units that are not texts, or
                a template, whose objects are not known yet.
        """
        require_specification(specification)
        checked = checked_semantics(semantics, [specification])
        require_time(start_ns, "start_ns")
        known = checked_units(units)
        specification = with_numbers(specification, known)
        templates = [spec for spec in specification.results if spec.parameter is not None]
        if templates:
            names = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates)
            raise UsageError(f"{names} is a template; name its object, or evaluate it over a log")
        self._specs = specification.results
        node_names = tuple(tuple(node.name for _, _, node in iter_nodes(s.formula)) for s in self._specs)
        self._units = tuple(declared_unit(spec.formula, known) for spec in self._specs)
        self._monitored = Monitored(
            tuple(zip(self._specs, node_names, self._units, strict=True)), _places_of_names(node_names)
        )
        compile_ahead()
        # a trial run loads every kernel now, so that no sample has to wait for one
        trial = LiveStream(specification, checked, 0)
        for time_ns in range(2):
            trial.extend(Sample(time_ns))
        if checked == "ltlf":
            rehearse(specification)
        self._live = LiveStream(specification, checked, start_ns or 0)
        self._violations = ViolationLog(specification, start_ns or 0, known) if checked == "ltlf" else None
        self._awaited = _AwaitedNames(specification, missing_after, strict=strict_names)
        self._last_ns = -1
        self._numbers: list[Floats | None] = [None] * len(self._specs)

    def endings(self) -> tuple[Ending, ...]:
        """Return the result of each spec if the run ends here; unknown before the first sample."""
        known = zip(self._specs, self._live.finals, self._numbers, self._units, strict=True)
        return tuple(_ending(spec, final, last, unit) for spec, final, last, unit in known)

    def update(self, sample: Sample) -> Update:
        """Add the next sample and return its numbers and verdicts.

        Raises:
            TraceError: a time that does not come after the last one's.
            UsageError: not a sample; more objects in open groups than can be bound.
            SpecificationError: with `strict_names`, a name that is missing for too long.
        """
        require_sample(sample)
        time_ns = sample.time_ns
        if time_ns <= self._last_ns:
            at, last = times_apart(time_ns, self._last_ns)
            raise TraceError(
                f"a sample at {at} follows one at {last}; give samples in the order of their times"
            )
        remarks = self._awaited.extend(sample) if self._awaited.is_open else ()
        self._last_ns = time_ns
        self._numbers = numbers = self._live.extend(sample)
        settled: tuple[Settled, ...] = ()
        satisfied: tuple[Settled, ...] = ()
        if self._violations is not None:
            self._violations.extend(sample, numbers)
            settled, satisfied = self._violations.settled, self._violations.satisfied
        return Update(time_ns, numbers, self._monitored, settled, satisfied, remarks)


class _AwaitedNames:
    """The objects and signals of a specification that have not come yet."""

    def __init__(self, specification: Specification, after: str | int | None, *, strict: bool) -> None:
        is_count = isinstance(after, int) and not isinstance(after, bool) and after > 0
        if not (is_count or after is None or isinstance(after, str)):
            remedy = "give a time such as '5s', or a number of samples"
            raise UsageError(f"missing_after is {shortened(after)}; {remedy}")
        self._specification, self._strict = specification, strict
        self._after = duration_ns_from_text(after) if isinstance(after, str) else after
        self._is_time = isinstance(after, str)
        self._first_ns: int | None = None
        self._samples = 0
        self._objects, self._signals = set(object_names(specification)), set(signal_names(specification))
        self._known: tuple[set[str], set[str], set[str]] = (set(), set(), set())
        self._remarks: tuple[Diagnostic, ...] = ()
        self.is_open = after is not None and bool(self._objects or self._signals)
        """Whether any is still to come."""

    def extend(self, sample: Sample) -> tuple[Diagnostic, ...]:
        """Return a warning for each that has not come by this sample, which is late by now."""
        self._samples += 1
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        missing = len(self._objects) + len(self._signals)
        objects, signals = {*sample.objects, *sample.unknown}, sample.signals.keys()
        self._learn(
            objects, signals, {each.class_name for each in sample.objects.values() if each.class_name}
        )
        self._objects -= objects
        self._signals -= signals
        self.is_open = bool(self._objects or self._signals)
        elapsed = sample.time_ns - self._first_ns if self._is_time else self._samples
        if self._after is None or elapsed < self._after:
            return ()
        if not self._remarks or len(self._objects) + len(self._signals) < missing:
            self._remarks = self._found()
        if self._strict and self._remarks:
            raise SpecificationError(self._remarks)
        return self._remarks

    def _learn(self, *names: Collection[str]) -> None:
        """Keep names, for hints."""
        if not self._remarks:
            for known, new in zip(self._known, names, strict=True):
                if len(known) < _MOST_KNOWN:
                    known.update(new)

    def _found(self) -> tuple[Diagnostic, ...]:
        after = self._after or 0
        during = time_text(after) if self._is_time else counted(after, "sample")
        objects, signals, classes = self._known
        found = check_names(
            self._specification,
            sorted(objects.union(object_names(self._specification)) - self._objects),
            sorted(signals.union(signal_names(self._specification)) - self._signals),
            where="run",
            during=f"in its first {during}",
            classes=sorted(classes),
        )
        severity: Literal["error", "warning"] = "error" if self._strict else "warning"
        return tuple(replace(each, severity=severity) for each in found if each.severity == "error")


def _places_of_names(names: tuple[tuple[str | None, ...], ...]) -> Mapping[str, tuple[int, int]]:
    """Map each name to its spec and node; to the first if several have it."""
    places: dict[str, tuple[int, int]] = {}
    for index, of_spec in enumerate(names):
        for identifier, name in enumerate(of_spec):
            if name is not None:
                places.setdefault(name, (index, identifier))
    return MappingProxyType(places)


def _ending(spec: NamedSpec, final: Floats | None, last: Floats | None, unit: str) -> Ending:
    """Return a result from the interval (N, 2) of each node at the end and the numbers after a sample."""
    if final is None:
        return Ending(spec, Verdict.UNKNOWN, _robustness(last), float("-inf"), float("inf"), unit)
    lower, upper = final[0].tolist()
    return Ending(spec, final_verdict(lower, upper), _robustness(last), lower, upper, unit)


def _robustness(numbers: Floats | None) -> float:
    return float("nan") if numbers is None else float(numbers[0, 0])
