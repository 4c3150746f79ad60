"""Shortest runs that one of two specifications accepts and the other rejects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

from spatial_replay.automata.ltlf import counts_seconds
from spatial_replay.errors import UsageError
from spatial_replay.lazy import Printed
from spatial_replay.sanity.conditions import FactDiagrams
from spatial_replay.sanity.examine import example_document, reason_of
from spatial_replay.sanity.examples import Example, shortest_example
from spatial_replay.sanity.shortest_words import (
    Answer,
    UndecidedError,
    WordSearch,
    joint,
    reading_of,
)
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Boolean,
    Formula,
    NamedSpec,
    Outline,
    Specification,
)
from spatial_replay.spec.load import require_specification
from spatial_replay.text import named_arguments, number_text, plural

Relation: TypeAlias = Literal["same", "stricter", "weaker", "different", "unknown"]

_RATES_HZ: Final = (1.0, 10.0)
"""Sample rates for bounds in seconds, Hz."""

_MEANINGS: Final[Mapping[Relation, str]] = MappingProxyType(
    {
        "same": "{first} and {second} accept the same runs",
        "stricter": "{first} is stricter than {second}: it rejects runs that {second} accepts",
        "weaker": "{first} is weaker than {second}: it accepts runs that {second} rejects",
        "different": "{first} and {second} accept different runs",
        "unknown": "it is not decided whether {first} and {second} accept the same runs",
    }
)


@dataclass(frozen=True)
class Distinction(Printed):
    """Difference of two specifications; a specification accepts a run that satisfies all its results.

    Attributes:
        first, second: names of the specifications.
        relation: relation of the first to the second: "same", "stricter", "weaker", "different", "unknown".
        only_first: shortest run that only the first accepts; None if none was found.
        only_second: shortest run that only the second accepts; None if none was found.
        rates_hz: sample rates of the comparison, Hz; empty if no bound is in seconds.
        reason: reason why the relation is "same", or why a search for a run is undecided; else "".
    """

    first: str
    second: str
    relation: Relation
    only_first: Example | None = None
    only_second: Example | None = None
    rates_hz: tuple[float, ...] = ()
    reason: str = ""

    @property
    def sentence(self) -> str:
        """The difference as a sentence."""
        meaning = _MEANINGS[self.relation].format(first=self.first, second=self.second)
        rates = " and ".join(f"{number_text(rate)} Hz" for rate in self.rates_hz)
        at_rates = f", at {rates}" if rates else ""
        return f"{meaning}{at_rates}{f' ({self.reason})' if self.reason else ''}"

    def lines(self) -> Iterator[str]:
        """Yield the sentence of the difference, and the runs that show it."""
        yield self.sentence
        yield from _run_lines(self.first, self.second, self.only_first)
        yield from _run_lines(self.second, self.first, self.only_second)

    @property
    def document(self) -> dict[str, Any]:
        """The difference as values for JSON."""
        return {
            "first": self.first,
            "second": self.second,
            "relation": self.relation,
            "sentence": self.sentence,
            "rates_hz": self.rates_hz,
            "only_first": example_document(self.only_first),
            "only_second": example_document(self.only_second),
        }


def _run_lines(accepting: str, rejecting: str, example: Example | None) -> Iterator[str]:
    if example is None:
        return
    length_text = plural(len(example.sentences), "sample")
    note = f", in words only: {example.note}" if example.note else ""
    yield ""
    yield f"accepted by {accepting}, rejected by {rejecting}: {length_text}{note}"
    first_index = 0
    for sentence, samples in groupby(example.sentences):
        last_index = first_index + len(list(samples)) - 1
        yield f"  {first_index if first_index == last_index else f'{first_index}-{last_index}'}  {sentence}"
        first_index = last_index + 1


@named_arguments
def distinguish(first: Specification, second: Specification, *, rate_hz: float | None = None) -> Distinction:
    """Find the shortest runs that one specification accepts and the other rejects.

    The search uses automata and laws of geometry, as `doctor` does.

    Args:
        rate_hz: sample rate for bounds in seconds, Hz; without it, 1 Hz and then 10 Hz are tried.

    Raises:
        UsageError: not specifications, a specification with a template or without results, two shapes of one
            region, or a rate outside of 1e-6 to 1e9.
    """
    specifications = first, second
    for specification in specifications:
        require_specification(specification)
    if rate_hz is not None and not 1e-6 <= rate_hz <= 1e9:
        raise UsageError(f"a rate of {rate_hz!r} Hz; give samples a second, from 1e-6 to 1e9")
    joint_specification = _together(first, second)
    file_names = _names(specifications)
    formulas = tuple(spec.formula for spec in joint_specification.specs)
    if format_formula(formulas[0]) == format_formula(formulas[1]):
        return Distinction(*file_names, "same", reason="they are the same formula")
    rates: Sequence[float | None] = (None,)
    if any(map(counts_seconds, formulas)):
        rates = _RATES_HZ if rate_hz is None else (rate_hz,)
    distinctions = []
    for rate in rates:
        distinction = _Comparison(joint_specification, rate).distinction(*file_names)
        if distinction.relation not in ("same", "unknown"):
            return distinction
        distinctions.append(distinction)
    # an undecided rate leaves the whole comparison undecided
    *_, decisive = sorted(distinctions, key=lambda distinction: distinction.relation == "unknown")
    return replace(decisive, rates_hz=tuple(rate for rate in rates if rate is not None))


def _names(specifications: Sequence[Specification]) -> tuple[str, str]:
    first_name, second_name = (specification.filename for specification in specifications)
    return (first_name, second_name) if first_name != second_name else ("the first", "the second")


def _together(first: Specification, second: Specification) -> Specification:
    """Return one specification with two specs: the conjunctions of the results of both specifications.

    Raises:
        UsageError: a specification with a template or without results, or two shapes of one region.
    """
    regions: dict[str, Outline] = {**first.regions, **second.regions}
    for name, outline in first.regions.items():
        if regions[name] != outline:
            raise UsageError(
                f"region {name} is not the same in {first.filename} and {second.filename}; "
                "write the same numbers in both, or give the regions two names"
            )
    specs = []
    for name, specification in zip(("first", "second"), (first, second), strict=True):
        for spec in specification.results:
            if spec.parameter is not None:
                raise UsageError(
                    f"{spec.name}({spec.parameter}) is a template; write forall {spec.parameter} in a group"
                )
        formulas = tuple(spec.formula for spec in specification.results)
        if not formulas:
            raise UsageError(f"{specification.filename} has no result; give it a spec")
        specs.append(NamedSpec(name, formulas[0] if len(formulas) == 1 else Boolean("and", formulas)))
    return replace(first, specs=tuple(specs), regions=regions, source="")


class _Comparison:
    """Comparison of two specs in both directions at one sample rate."""

    def __init__(self, together: Specification, rate_hz: float | None) -> None:
        self._specification, self._rate_hz = together, rate_hz
        formulas = [spec.formula for spec in together.specs]
        self._search = WordSearch(FactDiagrams(formulas, together.regions))
        self._readings = [reading_of(together, spec.name, spec.formula, rate_hz) for spec in together.specs]

    def distinction(self, first: str, second: str) -> Distinction:
        outcomes = [self._difference(0, 1), self._difference(1, 0)]
        examples = [outcome if isinstance(outcome, Example) else None for outcome in outcomes]
        answers = [outcome for outcome in outcomes if isinstance(outcome, Answer)]
        obstacles = [outcome for outcome in outcomes if isinstance(outcome, str)]
        relation: Relation = "same"
        if all(examples) or (any(examples) and obstacles):
            relation = "different"
        elif any(examples):
            relation = "weaker" if examples[0] else "stricter"
        elif obstacles:
            relation = "unknown"
        reason = ""
        if obstacles:
            reason = obstacles[0]
            if any(examples):
                # the other direction is undecided
                accepting, rejecting = (second, first) if examples[0] else (first, second)
                reason = f"not decided is whether {accepting} accepts runs that {rejecting} rejects: {reason}"
        elif relation == "same":
            reason = reason_of(joint(answers))
        rates = () if self._rate_hz is None else (self._rate_hz,)
        return Distinction(first, second, relation, examples[0], examples[1], rates, reason)

    def _difference(self, accepting: int, rejecting: int) -> Example | Answer | str:
        """Return a run that only one spec accepts, an answer without a run, or the reason for indecision."""
        accepted_reading, rejected_reading = self._readings[accepting], self._readings[rejecting]
        obstacle = accepted_reading.reason or rejected_reading.reason
        if accepted_reading.satisfying is None or rejected_reading.violating is None:
            return obstacle
        run_sets = accepted_reading.satisfying, rejected_reading.violating
        try:
            answer = self._search.shortest(*run_sets)
        except UndecidedError:
            return "it takes too many steps"
        if answer.word is None:
            return answer
        word_length = len(answer.word)
        example = shortest_example(
            self._specification,
            NamedSpec("difference", self._difference_formula(accepting, rejecting)),
            self._search,
            answer.word,
            True,
            is_exact=not obstacle,
            rate_hz=self._rate_hz,
            another=lambda avoided: self._search.another(word_length, avoided, *run_sets),
        )
        return example or obstacle

    def _difference_formula(self, accepting: int, rejecting: int) -> Formula:
        specs = self._specification.specs
        return Boolean("and", (specs[accepting].formula, Boolean("not", (specs[rejecting].formula,))))
