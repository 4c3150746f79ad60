"""Shortest runs by example: in words, and as samples that evaluate to the verdict."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from spatial_replay.errors import SpatialReplayError
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.monitor.evaluate import Evaluation, evaluate
from spatial_replay.sanity.conditions import Fact
from spatial_replay.sanity.placement import MAX_TURNED, CannotPlaceError, Placements, Setting
from spatial_replay.sanity.readings import conjuncts
from spatial_replay.sanity.shortest_words import Word, WordSearch
from spatial_replay.spec.checks import object_names, signal_names
from spatial_replay.spec.formula import (
    Atom,
    Formula,
    Misalignment,
    NamedSpec,
    Projection,
    RegionName,
    Specification,
    TrackedName,
)
from spatial_replay.spec.walks import base_of, iter_expressions, iter_formulas, measured_terms, terms_of
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

MAX_SAMPLES: Final = 40
"""Longer runs are shown in words only."""

MAX_WORDS: Final = 20
"""How many runs of one length are tried until one can be placed."""

_SECOND_NS: Final = 10**9
_TENTH_NS: Final = 10**8


@dataclass(frozen=True, slots=True)
class Example:
    """The shortest run that satisfies a spec, or violates it.

    Attributes:
        verdict: what it is evaluated to.
        sentences: what has to hold in each sample; everything else may hold or not.
        samples: objects placed so, one second apart; None if no placement was found.
        robustness: of these samples; None without any.
        note: why there are only words, or "".
    """

    verdict: Literal["satisfied", "violated"]
    sentences: tuple[str, ...]
    samples: tuple[Sample, ...] | None = None
    robustness: float | None = None
    note: str = ""

    @property
    def jsonl(self) -> str:
        """The samples as a track file (JSONL); "" without any."""
        return "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in self.rows)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The lines of that file."""
        return [_row(each) for each in self.samples or ()]


def shortest_example(
    specification: Specification,
    spec: NamedSpec,
    search: WordSearch,
    word: Word,
    satisfied: bool,
    *,
    is_exact: bool = True,
    another: Callable[[Sequence[Word]], Word | None] = lambda avoided: None,
) -> Example | None:
    """Return a run with what has to hold in its samples, placed if it can be.

    Args:
        is_exact: otherwise the word is only a guess: without a placement that confirms it, there is no run.
        another: returns a word that is as short, and has nothing of what could not be placed.
    """
    verdict: Literal["satisfied", "violated"] = "satisfied" if satisfied else "violated"
    first: Example | None = None
    avoided: list[Word] = []
    while len(avoided) < MAX_WORDS:
        facts = [[(search.fact(number), value) for number, value in sorted(cube.items())] for cube in word]
        sentences = tuple(
            # two facts of one quantity may read the same
            " and ".join(dict.fromkeys(fact.texts[0 if value else 1] for fact, value in each)) or "any sample"
            for each in facts
        )
        placing = _Placing(specification, spec, facts, verdict)
        try:
            found = placing.placed(is_exact=is_exact)
        except CannotPlaceError as reason:
            found, first = None, first or Example(verdict, sentences, note=str(reason))
        if found is not None:
            return Example(verdict, sentences, *found)
        first = first or Example(verdict, sentences, note="no placement of boxes was found")
        if placing.core is None:
            break
        numbers = [sorted(cube) for cube in word]
        blamed = tuple(
            {
                numbers[index][place]: word[index][numbers[index][place]]
                for at, place in placing.core
                if at == index
            }
            for index in range(len(word))
        )
        avoided.append(tuple(filter(None, blamed)) if sum(map(bool, blamed)) == 1 else blamed)
        following = another(avoided)
        if following is None:
            break
        word = following
    return first if is_exact else None


class _Placing:
    """One word that is placed.

    Attributes:
        core: facts, by sample and place, that cannot be placed together; None if that is not known.
    """

    core: frozenset[tuple[int, int]] | None = None

    def __init__(
        self,
        specification: Specification,
        spec: NamedSpec,
        facts: Sequence[Sequence[tuple[Fact, bool]]],
        verdict: str,
    ) -> None:
        self._specification, self._spec, self._facts, self._verdict = specification, spec, facts, verdict

    def placed(self, *, is_exact: bool) -> tuple[tuple[Sample, ...], float] | None:
        """Return samples that evaluate to the verdict, and their robustness; None if none are found.

        Raises:
            CannotPlaceError: there is something that is not placed, or cannot be evaluated.
        """
        if self._spec.parameter is not None:
            raise CannotPlaceError("a template is about the objects of a log")
        if len(self._facts) > MAX_SAMPLES:
            raise CannotPlaceError(f"it takes {len(self._facts)} samples")
        setting, reason = _setting(self._specification, self._spec), None
        for period_ns in (_SECOND_NS,) if is_exact else (_SECOND_NS, _TENTH_NS):
            placements = Placements(setting, self._facts, period_ns)
            for samples in placements:
                try:
                    found, robustness = _evaluated(
                        self._specification, self._spec, Trace.from_samples(samples)
                    )
                except SpatialReplayError as error:
                    reason = error
                    continue
                if found == self._verdict:
                    return samples, robustness
                reason = None
            self.core = placements.core
        if reason is not None:
            raise CannotPlaceError(f"it cannot be evaluated: {reason}")
        return None


def _evaluated(specification: Specification, spec: NamedSpec, trace: Trace) -> tuple[str, float]:
    """Return the verdict and the robustness of a spec; of its parts, where it nests too much for a whole."""

    def evaluated(*formulas: Formula) -> Evaluation:
        specs = [
            replace(spec, name=f"{spec.name}_{number}", formula=each, is_result=True)
            for number, each in enumerate(formulas)
        ]
        return evaluate(replace(specification, specs=tuple(specs)), trace)

    try:
        evaluation = evaluated(spec.formula)
    except SpatialReplayError:
        evaluation = evaluated(*conjuncts(spec.formula))
    return str(evaluation.verdict), min(each.robustness for each in evaluation)


def _setting(specification: Specification, spec: NamedSpec) -> Setting:
    """Return what there is to place: what the other specs are about, too, so that they can be evaluated."""
    own = _atoms(spec)
    every = [*own, *(atom for each in specification.results for atom in _atoms(each))]
    upright = any(
        isinstance(part, Projection) and part.axis == "z"
        for atom in every
        for part in iter_expressions(atom.expression)
    )
    turned = dict.fromkeys(_turned(own))
    if len({*turned, *_turned(every)}) <= MAX_TURNED:
        turned.update(dict.fromkeys(_turned(every)))
    bases = [base_of(term) for atom in own for term in terms_of(atom.expression)]
    regions = [base.name for base in bases if isinstance(base, RegionName)]
    named = {name: specification.regions[name] for name in dict.fromkeys(regions)}
    objects, signals = object_names(specification), signal_names(specification)
    return Setting(objects, signals, named, upright, tuple(turned))


def _atoms(spec: NamedSpec) -> list[Atom]:
    return [each for each in iter_formulas(spec.formula) if isinstance(each, Atom)]


def _turned(atoms: Iterable[Atom]) -> list[str]:
    """Return the objects whose orientations are compared."""
    parts = (part for atom in atoms for part in iter_expressions(atom.expression))
    terms = (term for part in parts if isinstance(part, Misalignment) for term in measured_terms(part))
    bases = map(base_of, terms)
    return [base.name for base in bases if isinstance(base, TrackedName)]


def _row(sample: Sample) -> dict[str, Any]:
    objects = []
    for name, tracked in sample.objects.items():
        assert isinstance(tracked, TrackedObject)
        (part,) = tracked.footprint.parts
        row: dict[str, Any] = {"name": name, "polygon": part.vertices.tolist()}
        if tracked.yaw is not None:
            row["yaw"] = tracked.yaw
        if tracked.height is not None:
            row["height"] = list(tracked.height)
        objects.append(row)
    signals = {"signals": dict(sample.signals)} if sample.signals else {}
    return {"time_ns": sample.time_ns, "objects": objects, **signals}
