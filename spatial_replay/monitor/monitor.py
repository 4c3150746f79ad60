"""Monitor a running system: evaluate a specification sample by sample and report permanent violations."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import isfinite
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from spatial_replay import compiled
from spatial_replay.errors import SpecificationError, TraceError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.monitor.atoms.terms import look_back
from spatial_replay.monitor.online.program import Program, compile_formula
from spatial_replay.monitor.result import no_such_node
from spatial_replay.monitor.semantics import checked_semantics
from spatial_replay.monitor.sentences import (
    Conjunct,
    conjuncts_of,
    divisor_of,
    how_text,
    measurement_clause,
    missed_sentences,
    reason_sentence,
    sentences_of,
    without_residue,
)
from spatial_replay.monitor.stream import Instance, LiveStream
from spatial_replay.monitor.verdict import Semantics, Verdict, final_verdict, online_verdict, worst_verdict
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import DecidingAtom, End
from spatial_replay.monitor.witness.threshold import Threshold
from spatial_replay.monitor.witness.witness import Witness, find_witness
from spatial_replay.spec.checks import check_names, object_names, signal_names, with_numbers
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    NamedSpec,
    Number,
    Product,
    Scaled,
    Signal,
    Specification,
    iter_nodes,
)
from spatial_replay.spec.load import require_specification
from spatial_replay.spec.walks import declared_unit, iter_expressions
from spatial_replay.text import Instant, Sentence, named_arguments, plural, time_text, times_apart, with_unit
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.trace import (
    FOREVER,
    Sample,
    Trace,
    checked_units,
    duration_ns_from_text,
    require_sample,
    require_time,
)

_MOST_KNOWN: Final = 1000
"""Maximum number of names of each kind that are stored for spelling hints."""


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
        """Satisfied or violated if no continuation can change the verdict; else pending."""
        return online_verdict(self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class SpecUpdate:
    """One spec after one sample.

    Attributes:
        numbers: (N, 4), value, now, lower and upper of each node; None before the monitor's start.
        names: name of each node, or None.
        unit: declared unit of the spec's robustness, or "".
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
        """Return the node with an id.

        Raises:
            UsageError: the monitor has not evaluated a sample.
        """
        if self.numbers is None:
            raise UsageError(
                f"{self.spec.name!r} has no numbers before the monitor's start; add more samples"
            )
        return NodeUpdate(identifier, self.names[identifier], *self.numbers[identifier].tolist())

    @property
    def verdict(self) -> Verdict:
        """The root's verdict; pending before the monitor's start."""
        if self.numbers is None:
            return Verdict.PENDING
        return online_verdict(self.numbers.item(0, 2), self.numbers.item(0, 3))


class Monitored(NamedTuple):
    """The specs of a monitor, which are the same after every sample.

    Attributes:
        specs: each result spec with the names of its nodes and the unit of its robustness.
        places: index in `specs` and node id, by the name of the node.
    """

    specs: tuple[tuple[NamedSpec, tuple[str | None, ...], str], ...]
    places: Mapping[str, tuple[int, int]]


class Settlement(NamedTuple):
    """The state of a monitor apart from its numbers. Most samples do not change this state.

    Attributes:
        settled: settled verdicts from which `Update.violations` is computed.
        satisfied, remarks: see `Update`.
    """

    settled: tuple[Settled, ...] = ()
    satisfied: tuple[Settled, ...] = ()
    remarks: tuple[Diagnostic, ...] = ()


class Update:
    """The numbers and verdicts after one sample. Later samples do not change this object."""

    # a frozen dataclass takes 0.5 µs more to construct, at every sample
    __slots__ = ("_monitored", "_numbers", "_settlement", "_specs", "_time_ns")

    def __init__(
        self, time_ns: int, numbers: Sequence[Floats | None], monitored: Monitored, settlement: Settlement
    ) -> None:
        """Store the numbers (N, 4) of each result spec."""
        self._time_ns = time_ns
        self._numbers = numbers
        self._monitored = monitored
        self._settlement = settlement
        self._specs: tuple[SpecUpdate, ...] | None = None

    @property
    def time_ns(self) -> int:
        return self._time_ns

    @property
    def numbers(self) -> Sequence[Floats | None]:
        """The numbers (N, 4) of each result spec, as in `SpecUpdate`; read-only."""
        for numbers in self._numbers:
            if numbers is not None:
                numbers.setflags(write=False)
        return self._numbers

    @property
    def specs(self) -> tuple[SpecUpdate, ...]:
        """One update for each result spec, in the order of the text."""
        if self._specs is None:
            spec_rows = zip(self._monitored.specs, self.numbers, strict=True)
            self._specs = tuple(
                [SpecUpdate(spec, rows, names, unit) for (spec, names, unit), rows in spec_rows]
            )
        return self._specs

    @property
    def places(self) -> Mapping[str, tuple[int, int]]:
        """Index in `specs` and node id, by the name of the node."""
        return self._monitored.places

    @property
    def violations(self) -> tuple[Violation, ...]:
        """Permanent violations, in the order in which they became certain; computed on demand.

        Each conjunct is reported separately. The paper's semantics has no permanent violations, because later
        samples may change every verdict.
        """
        return tuple([settled.violation for settled in self._settlement.settled])

    @property
    def satisfied(self) -> tuple[Settled, ...]:
        """The permanently satisfied specs. A `reason` is computed on demand."""
        return self._settlement.satisfied

    @property
    def remarks(self) -> tuple[Diagnostic, ...]:
        """Warnings about objects and signals of the specification that have been missing for too long."""
        return self._settlement.remarks

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the specs."""
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
        spec_index, identifier = self.places[name]
        return self.specs[spec_index].node(identifier)


class Ending(NamedTuple):
    """The result of one spec if a run ends with its newest sample, as in a replay of the run's log.

    Attributes:
        robustness: value of the root on the samples so far; NaN if undetermined.
        lower, upper: ends of the value's interval over the finished log.
        unit: declared unit of `robustness`, `lower` and `upper`, or "".
        reason: explanation of an unknown verdict; "" for other verdicts, and without `note_unknown`.
        doubts: assumptions that the verdict depends on, and that the run contradicts.
    """

    spec: NamedSpec
    verdict: Verdict
    robustness: float
    lower: float
    upper: float
    unit: str = ""
    reason: str = ""
    doubts: tuple[Doubt, ...] = ()


@named_arguments
class Monitor:
    """Evaluates a specification sample by sample, with exactly the numbers of a replay of the log.

    Time per sample and memory depend on the samples in windows and delays (`a[-3]`), not on the length of the
    run. The paper's semantics is an exception: its nested temporal operators read all samples again.
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
        wait_for: Collection[str] = (),
        start_within: str | None = "1s",
        wait: bool = False,
    ) -> None:
        """Start before the first sample.

        On first use on a machine, a child process compiles the code. Updates are interpreted until then.

        Args:
            start_ns: time of the first evaluated sample; terms may look back (`a[-3]`) at earlier samples.
            units: declared units for sentences: units of signals by name, the unit of lengths under "".
            missing_after: time ("5s") or number of samples after which updates warn of each object and
                signal that has not come yet. None for no warnings.
            strict_names: whether `update` raises an error for a missing name instead of a warning.
            wait_for: names of objects and signals. Evaluation begins at the first sample by which all these
                names have come. Earlier samples are not evaluated.
            start_within: longest wait for these names after the first sample ("1s"). Evaluation then begins
                without the missing names (`late`). None for no limit.
            wait: whether to compile in this process before the first sample, for loops above 500 Hz. On first
                use on a machine, this takes many seconds.

        Raises:
            UsageError: not a specification, unknown semantics, an invalid start, units that are not texts,
                names that are not texts, or a template, whose objects are not known yet.
        """
        require_specification(specification)
        known_semantics = checked_semantics(semantics, [specification])
        require_time(start_ns, "start_ns")
        declared_units = checked_units(units)
        specification = with_numbers(specification, declared_units)
        templates = [spec for spec in specification.results if spec.parameter is not None]
        if templates:
            template_names = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates)
            raise UsageError(f"{template_names} is a template; name its object, or evaluate it over a log")
        self._specs = specification.results
        node_names = tuple(tuple(node.name for _, _, node in iter_nodes(s.formula)) for s in self._specs)
        self._units = tuple(declared_unit(spec.formula, declared_units) for spec in self._specs)
        self._monitored = Monitored(
            tuple(zip(self._specs, node_names, self._units, strict=True)), _places_of_names(node_names)
        )
        # the two semantics have different kernels to compile
        task = "paper" if known_semantics == "paper" else "monitor"
        compiled.start(task, partial(_run_trial, specification, known_semantics), wait=wait)
        first_ns = start_ns or 0
        self._new_stream = partial(LiveStream, specification, known_semantics, first_ns)
        # no violation is permanent under the paper's semantics
        self._new_violation_log: Callable[[], ViolationLog | None] = lambda: None
        if known_semantics == "ltlf":
            self._new_violation_log = partial(ViolationLog, specification, first_ns, declared_units)
        self._new_awaited_names = partial(_AwaitedNames, specification, missing_after, strict=strict_names)
        self._new_start = partial(_Start, wait_for, start_within)
        self.reset()

    def reset(self) -> None:
        """Begin another run, like a new monitor. The next sample is the first sample of that run."""
        # this takes 0.55 ms; a new monitor, which compiles and rehearses, takes 7.5 ms
        self._live = self._new_stream()
        self._violations = self._new_violation_log()
        self._awaited = self._new_awaited_names()
        self._start = self._new_start()
        self._last_ns = -1
        self._numbers: list[Floats | None] = [None] * len(self._specs)
        self._settlement = Settlement()
        self._unknown: dict[int, Settled] = {}

    def note_unknown(self) -> None:
        """Store the newest samples of results that became unknown, so that `endings` can explain them."""
        if self._violations is None:
            return
        for index, final in enumerate(self._live.finals):
            if final is None or final_verdict(*final[0]) is not Verdict.UNKNOWN:
                self._unknown.pop(index, None)
            # later samples cannot say why the result became unknown
            elif index not in self._unknown:
                self._unknown[index] = self._violations.unknown(self._specs[index])

    @property
    def begin_ns(self) -> int | None:
        """Time of the first evaluated sample; None before that sample."""
        return self._start.begin_ns

    @property
    def late(self) -> tuple[str, ...]:
        """The names of `wait_for` that had not come when evaluation began."""
        return tuple(sorted(self._start.missing)) if self._start.begin_ns is not None else ()

    def endings(self) -> tuple[Ending, ...]:
        """Return the result of each spec if the run ends here; unknown before the first evaluated sample."""
        results = zip(self._specs, self._live.finals, self._numbers, self._units, strict=True)
        endings = (_ending(spec, final, numbers, unit) for spec, final, numbers, unit in results)
        return tuple(
            ending._replace(reason=self._unknown[index].reason) if index in self._unknown else ending
            for index, ending in enumerate(endings)
        )

    @property
    def names(self) -> Collection[str]:
        """The names of all named specs, nested specs included."""
        return self._monitored.places.keys()

    def interval(self, name: str) -> tuple[float, float]:
        """Return the interval of a named spec's value if the run ends here, over all unknown values.

        Raises:
            UsageError: no node has the name.
        """
        if name not in self.names:
            raise UsageError(no_such_node(name, sorted(self.names)))
        spec_index, identifier = self._monitored.places[name]
        final = self._live.finals[spec_index]
        if final is None:
            return float("-inf"), float("inf")
        lower, upper = final[identifier].tolist()
        return lower, upper

    def leaves(self, place: int = 0) -> Floats:
        """Return the leaves (C, A, 1) of the newest sample, as in `SpecResult.leaves` of the run's log.

        Args:
            place: index of the spec in `Update.specs`.

        Raises:
            UsageError: no sample has been evaluated, or the semantics is the paper's.
        """
        return self._live.leaves(place)

    def update(self, sample: Sample) -> Update:
        """Add the next sample and return its numbers and verdicts.

        Raises:
            TraceError: the sample is not later than the previous sample.
            UsageError: not a sample, or more objects in open groups than can be bound.
            SpecificationError: with `strict_names`, a name has been missing for too long.
        """
        require_sample(sample)
        time_ns = sample.time_ns
        if time_ns <= self._last_ns:
            new_text, last_text = times_apart(time_ns, self._last_ns)
            raise TraceError(
                f"a sample at {new_text} follows one at {last_text}; give samples in the order of their times"
            )
        remarks = self._awaited.extend(sample) if self._awaited.is_open else ()
        # `extend` returns the same tuple until a name arrives, so identity suffices
        if remarks is not self._settlement.remarks:
            self._settlement = self._settlement._replace(remarks=remarks)
        self._last_ns = time_ns
        if self._start.begin_ns is not None or self._start.has_begun(sample):
            self._numbers = self._live.extend(sample)
            violation_log = self._violations
            if violation_log is not None and violation_log.extend(sample, self._numbers):
                self._settlement = Settlement(violation_log.settled, violation_log.satisfied, remarks)
        return Update(time_ns, self._numbers, self._monitored, self._settlement)


class _Start:
    """Decides when evaluation begins.

    Attributes:
        begin_ns: time of the first evaluated sample; None before that sample.
        missing: the names that have not come yet.
    """

    def __init__(self, wait_for: Collection[str], within: str | None) -> None:
        names = [] if isinstance(wait_for, str) else list(wait_for)
        if isinstance(wait_for, str) or not all(isinstance(name, str) for name in names):
            remedy = "give a list of names, such as ['cup', 'battery']"
            raise UsageError(f"wait_for is {shortened(wait_for)}; {remedy}")
        if within is not None and not isinstance(within, str):
            raise UsageError(f"start_within is {shortened(within)}; give a time such as '1s', or None")
        self.missing = set(names)
        self.begin_ns: int | None = None
        self._within_ns = None if within is None else duration_ns_from_text(within)
        self._first_ns: int | None = None

    def has_begun(self, sample: Sample) -> bool:
        """Return whether evaluation has begun or begins with the next sample, `sample`."""
        if self.begin_ns is not None:
            return True
        self._first_ns = sample.time_ns if self._first_ns is None else self._first_ns
        self.missing -= {*sample.objects, *sample.signals}
        waited_ns = sample.time_ns - self._first_ns
        if not self.missing or (self._within_ns is not None and waited_ns > self._within_ns):
            self.begin_ns = sample.time_ns
        return self.begin_ns is not None


class _AwaitedNames:
    """The objects and signals of a specification that have not come yet."""

    def __init__(self, specification: Specification, after: str | int | None, *, strict: bool) -> None:
        is_count = isinstance(after, int) and not isinstance(after, bool) and after > 0
        if not (is_count or after is None or isinstance(after, str)):
            remedy = "give a time such as '5s', or a number of samples"
            raise UsageError(f"missing_after is {shortened(after)}; {remedy}")
        self._specification, self._is_strict = specification, strict
        self._limit = duration_ns_from_text(after) if isinstance(after, str) else after
        self._is_limit_time = isinstance(after, str)
        self._first_ns: int | None = None
        self._sample_count = 0
        self._missing_objects = set(object_names(specification))
        self._missing_signals = set(signal_names(specification))
        self._names_so_far: tuple[set[str], set[str], set[str]] = (set(), set(), set())
        self._remarks: tuple[Diagnostic, ...] = ()
        self.is_open = after is not None and bool(self._missing_objects or self._missing_signals)
        """Whether any name is still missing."""

    def extend(self, sample: Sample) -> tuple[Diagnostic, ...]:
        """Add a sample, and return a warning for each missing name; none before the limit."""
        self._sample_count += 1
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        missing_count = len(self._missing_objects) + len(self._missing_signals)
        # an object with unknown position is not missing
        objects, signals = {*sample.objects, *sample.unknown}, sample.signals.keys()
        self._learn(
            objects,
            signals,
            {tracked.class_name for tracked in sample.objects.values() if tracked.class_name},
        )
        self._missing_objects -= objects
        self._missing_signals -= signals
        self.is_open = bool(self._missing_objects or self._missing_signals)
        elapsed = sample.time_ns - self._first_ns if self._is_limit_time else self._sample_count
        if self._limit is None or elapsed < self._limit:
            return ()
        if not self._remarks or len(self._missing_objects) + len(self._missing_signals) < missing_count:
            self._remarks = self._diagnose_missing_names()
        if self._is_strict and self._remarks:
            raise SpecificationError(self._remarks)
        return self._remarks

    def _learn(self, *names: Collection[str]) -> None:
        """Store names as candidates for spelling hints."""
        if not self._remarks:
            # the names are limited, because a run may bring a new track name at every sample
            for names_so_far, new_names in zip(self._names_so_far, names, strict=True):
                if len(names_so_far) < _MOST_KNOWN:
                    names_so_far.update(new_names)

    def _diagnose_missing_names(self) -> tuple[Diagnostic, ...]:
        limit = self._limit or 0
        limit_text = time_text(limit) if self._is_limit_time else plural(limit, "sample")
        objects, signals, classes = self._names_so_far
        diagnostics = check_names(
            self._specification,
            sorted(objects.union(object_names(self._specification)) - self._missing_objects),
            sorted(signals.union(signal_names(self._specification)) - self._missing_signals),
            where="run",
            during=f"in its first {limit_text}",
            classes=sorted(classes),
        )
        severity: Literal["error", "warning"] = "error" if self._is_strict else "warning"
        return tuple(
            replace(diagnostic, severity=severity)
            for diagnostic in diagnostics
            if diagnostic.severity == "error"
        )


def _places_of_names(names: tuple[tuple[str | None, ...], ...]) -> Mapping[str, tuple[int, int]]:
    """Map each name to the index of its spec and its node id. A repeated name maps to its first node."""
    places: dict[str, tuple[int, int]] = {}
    for spec_index, spec_names in enumerate(names):
        for identifier, name in enumerate(spec_names):
            if name is not None:
                places.setdefault(name, (spec_index, identifier))
    return MappingProxyType(places)


def _ending(spec: NamedSpec, final: Floats | None, last: Floats | None, unit: str) -> Ending:
    """Return the result of a spec, given its final intervals (N, 2) and its last numbers (N, 4)."""
    if final is None:
        return Ending(spec, Verdict.UNKNOWN, _robustness(last), float("-inf"), float("inf"), unit)
    lower, upper = final[0].tolist()
    return Ending(spec, final_verdict(lower, upper), _robustness(last), lower, upper, unit)


def _robustness(numbers: Floats | None) -> float:
    return float("nan") if numbers is None else float(numbers[0, 0])


REMEMBERED = 1024
"""Number of newest samples that a monitor stores to find the deciding atom of a violation."""
_AT_ONCE = 64
"""Limit on samples that are searched at once. Longer runs are searched from the newest sample back."""


@dataclass(frozen=True, eq=False)
class Violation:
    """A part of a specification that is permanently violated. `str()` is a sentence on the violation.

    Attributes:
        spec: innermost named spec that contains the part.
        node: node id of the part in the tree of the result.
        text: canonical text of the part.
        time_ns: time of the sample that made the violation certain.
        robustness: upper bound of the part's robustness over all continuations; below 0.
        witness: the atom that settled the violation, and the change that would flip the verdict. None if the
            atom is older than the samples that the monitor stores.
        first_ns: reference time of the sentences, the time of the monitor's first sample.
        unit: declared unit of `robustness`, or "".
    """

    spec: str
    node: int
    text: str
    time_ns: int
    robustness: float
    witness: Witness | None
    first_ns: int
    unit: str = ""

    @property
    def atom(self) -> DecidingAtom | None:
        """The atom that settled the violation, with its objects, value and measurements."""
        return None if self.witness is None else self.witness.deciding

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects, regions and groups of the atom."""
        return () if self.atom is None else self.atom.objects

    @property
    def value(self) -> float:
        """The robustness of the atom with every uncertainty at 0; NaN without an atom."""
        return float("nan") if self.atom is None else self.atom.value

    @property
    def threshold(self) -> Threshold | None:
        """The change of the atom's number that would have prevented the violation, or None."""
        return None if self.witness is None else self.witness.threshold

    @property
    def sentences(self) -> tuple[Sentence, ...]:
        """The deciding atom and the change that would flip the verdict, as in `SpecResult.explain`."""
        return () if self.witness is None else sentences_of(self.witness, first_ns=self.first_ns)

    def __str__(self) -> str:
        if self.atom is None or self.witness is None:
            since_time = Instant(self.time_ns, self.first_ns)
            return (
                f"`{self.spec}` is violated since {since_time}, by {with_unit(-self.robustness, self.unit)}"
            )
        missed_response = self.witness.missed
        if missed_response is not None and missed_response.is_condition:
            return " ".join(missed_sentences(self.witness, missed_response, self.first_ns)).removesuffix(".")
        settling_number = _settling_number(self.atom)
        amount = abs(without_residue(settling_number, self.atom.atom)) * divisor_of(self.atom.atom)
        unit = declared_unit(self.atom.atom, self.witness.units, is_scaled=False)
        description = _short(self.atom, self.spec, with_unit(amount, unit) if amount else "just")
        return f"{description}: {_deciding_words(self.atom, self.witness, self.first_ns)}"


def _has_factor(atom: Atom) -> bool:
    """Return whether an atom multiplies its signal, so that its robustness has another scale."""
    expression = atom.expression.operand if isinstance(atom.expression, Scaled) else atom.expression
    return any(isinstance(part, Product | Scaled) for part in iter_expressions(expression))


def _settling_number(atom: DecidingAtom) -> float:
    return atom.upper if atom.end is End.HIGH else atom.lower


def _deciding_words(atom: DecidingAtom, witness: Witness, first_ns: int) -> str:
    """Return a clause with the atom, its margin, and the time at which it decided."""
    is_violated = witness.verdict is Verdict.VIOLATED
    outcome = how_text(_settling_number(atom), atom.atom, witness.units, is_violated=is_violated)
    return f"`{atom.text}` {outcome} at {Instant(witness.time_ns, first_ns)}"


def _short(atom: DecidingAtom, spec: str, amount: str) -> str:
    """Return a short description of a violation, such as "cup is 0.03 m too close to edge"."""
    signed_parts = [(sign, part) for sign, part in atom.branch if not isinstance(part, Number)]
    if _has_factor(atom.atom):
        signed_parts = []
    # only a single distance or signal can be called too small or too great
    if len(signed_parts) == 1 and len(atom.measured) == 1:
        (sign, part), *_ = signed_parts
        (measurement,) = atom.measured
        # an atom that fails (high end) has to rise; an atom that must not hold has to fall
        needs_more = (sign > 0) == (atom.end is End.HIGH)
        if measurement.quantity == "signed_distance":
            first_name, second_name = measurement.names
            misplacement = f"too close to {second_name}" if needs_more else f"too far from {second_name}"
            return f"{first_name} is {amount} {misplacement}"
        # an equality with a text has infinite robustness, so it has no amount
        if measurement.quantity == "signal" and not isfinite(_settling_number(atom)):
            return measurement_clause(atom, {}, 0)
        if isinstance(part, Signal):
            return f"{part.name} is {amount} too {'low' if needs_more else 'high'}"
    return f"`{spec}` is violated"


@dataclass(frozen=True, eq=False)
class Settled:
    """A verdict of a monitor, with the samples in which its deciding atom is searched.

    Attributes:
        verdict: permanently satisfied, permanently violated, or unknown at the end of a run.
        number: robustness bound that settles the verdict: the lower end for a satisfied part, the upper end
            for a violated part.
        samples: newest samples of the run.
        start: index in `samples` of the first evaluated sample.
        is_whole: whether `samples` begins with the first sample of the run.
    """

    spec: NamedSpec
    program: Program
    specification: Specification
    conjunct: Conjunct
    verdict: Verdict
    number: float
    samples: tuple[Sample, ...]
    start: int
    is_whole: bool
    first_ns: int
    units: Mapping[str, str]

    @cached_property
    def violation(self) -> Violation:
        return Violation(
            self.conjunct.spec,
            self.conjunct.node,
            format_formula(self.conjunct.formula),
            self.samples[-1].time_ns,
            self.number,
            self.witness,
            self.first_ns,
            declared_unit(self.conjunct.formula, self.units),
        )

    @property
    def reason(self) -> str:
        """The deciding atom and its margin in words; "" if the atom was not found."""
        witness = self.witness
        if witness is not None and self.verdict is Verdict.UNKNOWN:
            return str(reason_sentence(witness, first_ns=self.first_ns))
        if witness is None or witness.deciding is None:
            return ""
        return _deciding_words(witness.deciding, witness, self.first_ns)

    @cached_property
    def witness(self) -> Witness | None:
        """The witness on the newest samples, or None.

        It uses the smallest tried number of newest samples on which the part has `verdict` and `number`.
        """
        for begin in self._begins():
            witness = self._witness_from(begin)
            number = witness.upper if self.verdict is Verdict.VIOLATED else witness.lower
            is_same = self.verdict is Verdict.UNKNOWN or number == self.number
            if witness.verdict is self.verdict and is_same:
                return witness
        return None

    def _begins(self) -> Iterator[int]:
        """Yield first samples for the evaluation, the latest first, because few samples often suffice."""
        sample_count = len(self.samples)
        if self.is_whole and sample_count - self.start <= _AT_ONCE:
            yield self.start
            return
        # an obligation for every sample (`G`) has the same deciding atom for any first sample
        for newest_count in (1, 8, _AT_ONCE, REMEMBERED // 2):
            if newest_count < sample_count - self.start:
                yield sample_count - newest_count
        yield self.start

    def _witness_from(self, begin: int) -> Witness:
        reach_samples, reach_ns, reach_reports = look_back([self.spec.formula])
        start_ns = self.samples[begin].time_ns
        first_sample = max(begin - max(reach_samples, reach_reports), 0)
        # samples repeat reports, so the previous report may be any number of samples back
        if reach_reports and any(sample.reported_ns for sample in self.samples):
            first_sample = 0
        while reach_ns and first_sample > 0 and self.samples[first_sample].time_ns > start_ns - reach_ns:
            first_sample -= 1
        trace = Trace.from_samples(self.samples[first_sample:])
        instance = Instance(self.spec, None, self.program, {}, start_ns, FOREVER)
        evidence = Evidence(instance, self.specification.regions, lambda: [trace], self.units)
        leaves = evidence.columns(self.program.leaves)
        goes_on = self.verdict is not Verdict.UNKNOWN
        return find_witness(evidence, leaves, evidence.times_ns(), self.conjunct.node, goes_on=goes_on)


def rehearse(specification: Specification) -> None:
    """Explain trial violations, so that the code is loaded and compiled before a real violation."""
    box = TrackedObject(Footprint.box(0.0, 0.0, 1.0, 1.0), height=(0.0, 1.0), yaw=0.0)
    objects = dict.fromkeys(object_names(specification), box)
    sample = Sample(0, objects, dict.fromkeys(signal_names(specification), 0.0))
    for spec in specification.results:
        program = compile_formula(spec.formula)
        for conjunct in conjuncts_of(spec.formula, spec.name):
            trial = Settled(
                spec, program, specification, conjunct, Verdict.VIOLATED, 0.0, (sample,), 0, True, 0, {}
            )
            # `sentences` and `reason` are computed when they are read
            _ = trial.violation.sentences, trial.reason


def _run_trial(specification: Specification, semantics: Semantics) -> None:
    """Load every kernel before the first sample."""
    trial = LiveStream(specification, semantics, 0)
    # the second sample takes branches that the first sample does not take
    for time_ns in range(2):
        trial.extend(Sample(time_ns))
    if semantics == "ltlf":
        rehearse(specification)


class ViolationLog:
    """The newest samples of one monitor, and the verdicts that became certain.

    Attributes:
        settled: the violations, one for each conjunct.
        satisfied: the satisfied results.
    """

    def __init__(self, specification: Specification, start_ns: int, units: Mapping[str, str]) -> None:
        """Start before the first sample, with the declared units."""
        self._units = units
        self._specification = specification
        self._start_ns = start_ns
        self._samples: deque[Sample] = deque(maxlen=REMEMBERED)
        self._first_ns: int | None = None
        self._open_specs = [
            (index, spec, list(conjuncts_of(spec.formula, spec.name)))
            for index, spec in enumerate(specification.results)
        ]
        self._unsatisfied = dict(enumerate(specification.results))
        self.settled: tuple[Settled, ...] = ()
        self.satisfied: tuple[Settled, ...] = ()

    def extend(self, sample: Sample, numbers: Sequence[Floats | None]) -> bool:
        """Add a sample and the numbers (N, 4) of each result after it. Return whether a verdict settled."""
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        self._samples.append(sample)
        earlier_settled, earlier_satisfied = self.settled, self.satisfied
        for index, spec, conjuncts in self._open_specs:
            spec_numbers = numbers[index]
            if spec_numbers is None:
                continue
            if conjuncts and spec_numbers.item(0, 3) < 0.0:
                self._settle(spec, conjuncts, spec_numbers)
            elif index in self._unsatisfied and spec_numbers.item(0, 2) >= 0.0:
                del self._unsatisfied[index]
                conjunct = Conjunct(0, spec.name, spec.formula)
                newly_satisfied = self._verdict_with_samples(
                    spec, conjunct, Verdict.SATISFIED, float(spec_numbers[0, 2])
                )
                self.satisfied = (*self.satisfied, newly_satisfied)
        return self.settled is not earlier_settled or self.satisfied is not earlier_satisfied

    def unknown(self, spec: NamedSpec) -> Settled:
        """Return the unknown verdict of a spec for a run that ends with the newest sample."""
        conjunct = Conjunct(0, spec.name, spec.formula)
        return self._verdict_with_samples(spec, conjunct, Verdict.UNKNOWN, float("nan"))

    def _settle(self, spec: NamedSpec, conjuncts: list[Conjunct], numbers: Floats) -> None:
        for conjunct in tuple(conjuncts):
            upper = float(numbers[conjunct.node, 3])
            if upper < 0.0:
                conjuncts.remove(conjunct)
                newly_violated = self._verdict_with_samples(spec, conjunct, Verdict.VIOLATED, upper)
                # a new tuple, because earlier updates refer to the old tuple
                self.settled = (*self.settled, newly_violated)

    def _verdict_with_samples(
        self, spec: NamedSpec, conjunct: Conjunct, verdict: Verdict, number: float
    ) -> Settled:
        samples = tuple(self._samples)
        first_ns = self._first_ns or 0
        return Settled(
            spec,
            compile_formula(spec.formula),
            self._specification,
            conjunct,
            verdict,
            number,
            samples,
            # terms only look back at samples before the start
            next(k for k, sample in enumerate(samples) if sample.time_ns >= self._start_ns),
            samples[0].time_ns == first_ns,
            first_ns,
            self._units,
        )
