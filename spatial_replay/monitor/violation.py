"""Violations that a monitor reports while samples come: what was violated for certain, and by which atom."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.monitor.atoms.delays import look_back
from spatial_replay.monitor.causes import Conjunct, conjuncts_of
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.program import Program, compile_formula
from spatial_replay.monitor.sentences import (
    divisor_of,
    how_text,
    missed_text,
    sentences_of,
    what_was_measured,
    without_residue,
)
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.witness.atom import DecidingAtom
from spatial_replay.monitor.witness.evidence import Evidence
from spatial_replay.monitor.witness.path import End
from spatial_replay.monitor.witness.threshold import Threshold
from spatial_replay.monitor.witness.witness import Witness, find_witness
from spatial_replay.spec.checks import object_names, signal_names
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import NamedSpec, Number, Signal, Specification
from spatial_replay.spec.walks import declared_unit
from spatial_replay.text import Instant, Sentence, with_unit
from spatial_replay.trace.trace import FOREVER, Sample, Trace

REMEMBERED = 1024
"""Samples that a monitor keeps to look for the atom that settled a violation."""
_AT_ONCE = 64
"""As many samples are searched as a whole; of more, the newest first."""


@dataclass(frozen=True, eq=False)
class Violation:
    """A part of a specification that is permanently violated. `str()` is a sentence on it.

    Attributes:
        spec: the innermost named spec that it belongs to.
        node: its id in the tree of the result.
        text: its canonical text.
        time_ns: of the sample that made it certain.
        robustness: below 0: the most that the part can still reach.
        witness: the atom that settled it, and what would flip it; None if that lies further back than the
            samples that the monitor keeps.
        first_ns: the time that the sentences count from: that of the monitor's first sample.
        unit: the declared one of `robustness`, or "".
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
        """The atom that settled it: its objects, its value, what was measured."""
        return None if self.witness is None else self.witness.deciding

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects, regions and groups that the atom is about."""
        return () if self.atom is None else self.atom.objects

    @property
    def value(self) -> float:
        """The robustness of the atom with every uncertainty at 0; NaN if there is none."""
        return float("nan") if self.atom is None else self.atom.value

    @property
    def threshold(self) -> Threshold | None:
        """The change of the atom's number that would have prevented it, if there is one."""
        return None if self.witness is None else self.witness.threshold

    @property
    def sentences(self) -> tuple[Sentence, ...]:
        """The deciding atom and the change that would flip it, as in `SpecResult.explain`."""
        return () if self.witness is None else sentences_of(self.witness, first_ns=self.first_ns)

    def __str__(self) -> str:
        if self.atom is None or self.witness is None:
            since = Instant(self.time_ns, self.first_ns)
            return f"`{self.spec}` is violated since {since}, by {with_unit(-self.robustness, self.unit)}"
        missed = self.witness.missed
        if missed is not None and missed.is_condition:
            return missed_text(missed, self.first_ns)
        number = _settling(self.atom)
        amount = abs(without_residue(number, self.atom.atom)) * divisor_of(self.atom.atom)
        unit = declared_unit(self.atom.atom, self.witness.units, is_scaled=False)
        short = _short(self.atom, self.spec, with_unit(amount, unit) if amount else "just")
        return f"{short}: {_deciding_words(self.atom, self.witness, self.first_ns)}"


def _settling(atom: DecidingAtom) -> float:
    return atom.upper if atom.end is End.HIGH else atom.lower


def _deciding_words(atom: DecidingAtom, witness: Witness, first_ns: int) -> str:
    """Return an atom, its number, and when it decided."""
    how = how_text(_settling(atom), atom.atom, witness.units)
    return f"`{atom.text}` {how} at {Instant(witness.time_ns, first_ns)}"


def _short(atom: DecidingAtom, spec: str, amount: str) -> str:
    """Return what is wrong in a few words: in which direction a distance or a signal is off."""
    signed = [(sign, part) for sign, part in atom.branch if not isinstance(part, Number)]
    if len(signed) == 1 and len(atom.measured) == 1:
        (sign, part), *_ = signed
        (measured,) = atom.measured
        needs_more = (sign > 0) == (atom.end is End.HIGH)
        if measured.quantity == "signed_distance":
            first, second = measured.names
            where = f"too close to {second}" if needs_more else f"too far from {second}"
            return f"{first} is {amount} {where}"
        if measured.quantity == "signal" and not isfinite(_settling(atom)):
            return what_was_measured(atom, {})
        if isinstance(part, Signal):
            return f"{part.name} is {amount} too {'low' if needs_more else 'high'}"
    return f"`{spec}` is violated"


@dataclass(frozen=True, eq=False)
class Settled:
    """A verdict that a monitor has seen, with the samples to find its atom in.

    Attributes:
        verdict: permanently satisfied or violated.
        number: the end of the interval that settles it: the lower one of what is satisfied.
        samples: the newest; from `start` on they count, and they are all of them if `is_whole`.
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
        """The atom that settled it and by how much, in words; "" if it was not found."""
        found = self.witness
        if found is None or found.deciding is None:
            return ""
        return _deciding_words(found.deciding, found, self.first_ns)

    @cached_property
    def witness(self) -> Witness | None:
        """Return the witness on the fewest of the newest samples that give the part its number."""
        for begin in self._begins():
            found = self._witness_from(begin)
            number = found.upper if self.verdict is Verdict.VIOLATED else found.lower
            if found.verdict is self.verdict and number == self.number:
                return found
        return None

    def _begins(self) -> Iterator[int]:
        """Iterate over the samples to evaluate from, as if the log began there."""
        count = len(self.samples)
        if self.is_whole and count - self.start <= _AT_ONCE:
            yield self.start
            return
        # an obligation that holds at every sample has the same atom wherever the evaluation starts
        for newest in (1, 8, _AT_ONCE, REMEMBERED // 2):
            if newest < count - self.start:
                yield count - newest
        yield self.start

    def _witness_from(self, begin: int) -> Witness:
        samples, duration_ns = look_back([self.spec.formula])
        start_ns = self.samples[begin].time_ns
        first = max(begin - samples, 0)
        while duration_ns and first > 0 and self.samples[first].time_ns > start_ns - duration_ns:
            first -= 1
        trace = Trace.from_samples(self.samples[first:])
        instance = Instance(self.spec, None, self.program, {}, start_ns, FOREVER)
        evidence = Evidence(instance, self.specification.regions, lambda: [trace], self.units)
        leaves = evidence.columns(self.program.leaves)
        return find_witness(evidence, leaves, evidence.times_ns(), self.conjunct.node, goes_on=True)


def rehearse(specification: Specification) -> None:
    """Explain trial violations, so that a real one waits for no code to be loaded or compiled."""
    box = TrackedObject(Footprint.box(0.0, 0.0, 1.0, 1.0), height=(0.0, 1.0), yaw=0.0)
    objects = dict.fromkeys(object_names(specification), box)
    sample = Sample(0, objects, dict.fromkeys(signal_names(specification), 0.0))
    for spec in specification.results:
        program = compile_formula(spec.formula)
        for conjunct in conjuncts_of(spec.formula, spec.name):
            trial = Settled(
                spec, program, specification, conjunct, Verdict.VIOLATED, 0.0, (sample,), 0, True, 0, {}
            )
            _ = trial.violation.sentences, trial.reason


class ViolationLog:
    """The newest samples of one monitor, and what they made certain.

    Attributes:
        settled: the violations, of each part of a conjunction its own.
        satisfied: the results that are satisfied.
    """

    def __init__(self, specification: Specification, start_ns: int, units: Mapping[str, str]) -> None:
        """Start before the first sample; `units` are those that are declared."""
        self._units = units
        self._specification = specification
        self._start_ns = start_ns
        self._samples: deque[Sample] = deque(maxlen=REMEMBERED)
        self._first_ns = 0
        self._dropped = False
        self._open = [
            (index, spec, list(conjuncts_of(spec.formula, spec.name)))
            for index, spec in enumerate(specification.results)
        ]
        self._unsatisfied = dict(enumerate(specification.results))
        self.settled: tuple[Settled, ...] = ()
        self.satisfied: tuple[Settled, ...] = ()

    def extend(self, sample: Sample, numbers: Sequence[Floats | None]) -> None:
        """Take in a sample and the numbers (N, 4) of each result after it."""
        samples = self._samples
        if len(samples) == REMEMBERED:
            self._dropped = True
        elif not samples:
            self._first_ns = sample.time_ns
        samples.append(sample)
        for index, spec, conjuncts in self._open:
            after = numbers[index]
            if after is None:
                continue
            if after.item(0, 3) < 0.0 and conjuncts:
                self._settle(spec, conjuncts, after)
            elif after.item(0, 2) >= 0.0 and index in self._unsatisfied:
                del self._unsatisfied[index]
                whole = Conjunct(0, spec.name, spec.formula)
                found = self._settled(spec, whole, Verdict.SATISFIED, float(after[0, 2]))
                self.satisfied = (*self.satisfied, found)

    def _settle(self, spec: NamedSpec, conjuncts: list[Conjunct], numbers: Floats) -> None:
        for conjunct in tuple(conjuncts):
            upper = float(numbers[conjunct.node, 3])
            if upper < 0.0:
                conjuncts.remove(conjunct)
                found = self._settled(spec, conjunct, Verdict.VIOLATED, upper)
                self.settled = (*self.settled, found)

    def _settled(self, spec: NamedSpec, conjunct: Conjunct, verdict: Verdict, number: float) -> Settled:
        samples = tuple(self._samples)
        return Settled(
            spec,
            compile_formula(spec.formula),
            self._specification,
            conjunct,
            verdict,
            number,
            samples,
            next(k for k, each in enumerate(samples) if each.time_ns >= self._start_ns),
            not self._dropped,
            self._first_ns,
            self._units,
        )
