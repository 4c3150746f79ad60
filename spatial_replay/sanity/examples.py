"""Shortest runs by example: in words, and as samples that evaluate to the verdict."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from spatial_replay.errors import SpatialReplayError
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.monitor.evaluate import evaluate
from spatial_replay.sanity.conditions import Fact
from spatial_replay.sanity.placement import MAX_TURNED, CannotPlaceError, Setting, place
from spatial_replay.sanity.shortest_words import Word, WordSearch
from spatial_replay.spec.checks import object_names, signal_names
from spatial_replay.spec.formula import (
    Atom,
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
) -> Example | None:
    """Return a run with what has to hold in its samples, placed if it can be.

    Args:
        is_exact: otherwise the word is only a guess: without a placement that confirms it, there is no run.
    """
    verdict: Literal["satisfied", "violated"] = "satisfied" if satisfied else "violated"
    facts = [[(search.fact(number), value) for number, value in sorted(cube.items())] for cube in word]
    sentences = tuple(
        # two facts of one quantity may read the same
        " and ".join(dict.fromkeys(fact.texts[0 if value else 1] for fact, value in each)) or "any sample"
        for each in facts
    )
    words = Example(verdict, sentences)
    try:
        found = _placed(specification, spec, facts, verdict, is_exact=is_exact)
    except CannotPlaceError as reason:
        return replace(words, note=str(reason)) if is_exact else None
    if found is not None:
        return replace(words, samples=found[0], robustness=found[1])
    return replace(words, note="no placement of boxes was found") if is_exact else None


def _placed(
    specification: Specification,
    spec: NamedSpec,
    facts: Sequence[Sequence[tuple[Fact, bool]]],
    verdict: str,
    *,
    is_exact: bool,
) -> tuple[tuple[Sample, ...], float] | None:
    if spec.parameter is not None:
        raise CannotPlaceError("a template is about the objects of a log")
    if len(facts) > MAX_SAMPLES:
        raise CannotPlaceError(f"it takes {len(facts)} samples")
    alone = replace(specification, specs=(replace(spec, is_result=True),))
    setting = _setting(specification, spec)
    for period_ns in (_SECOND_NS,) if is_exact else (_SECOND_NS, _TENTH_NS):
        for samples in place(setting, facts, period_ns):
            try:
                result = evaluate(alone, Trace.from_samples(samples)).results[0]
            except SpatialReplayError:
                continue
            if result.verdict == verdict and result.robustness is not None:
                return samples, result.robustness
    return None


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
