"""Examples of shortest runs: in words, and as samples with the expected verdict.

Objects are axis-aligned boxes. So a relation is a set of linear inequalities between sides of boxes, or a
choice between several sets. A placement is evaluated before it is shown.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.errors import SpatialReplayError
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject, centre_of
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.monitor.result import Evaluation, evaluate
from spatial_replay.sanity.conditions import (
    Fact,
    Quantity,
    is_about_heights,
    plain,
    radius_of,
    without_radius,
)
from spatial_replay.sanity.linear import Inequality, solve
from spatial_replay.sanity.shortest_words import Word, WordSearch, conjuncts
from spatial_replay.spec.checks import object_names, signal_names
from spatial_replay.spec.formula import (
    Atom,
    Axis,
    Centre,
    CentroidProjection,
    Earlier,
    Formula,
    Measurement,
    Misalignment,
    NamedSpec,
    Outline,
    Projection,
    Protrusion,
    Rate,
    RegionName,
    Signal,
    SignedDistance,
    Specification,
    Term,
    TrackedName,
)
from spatial_replay.spec.walks import base_of, iter_expressions, iter_formulas, terms_of
from spatial_replay.trace.trace import Sample, Trace

# ------------------------------------------------------------------------------------------- regions as boxes


def around(outline: Outline) -> tuple[tuple[float, float], ...]:
    vertices, radius = np.array(outline.vertices, np.float64), outline.radius
    limits = zip(vertices.min(axis=0) - radius, vertices.max(axis=0) + radius, strict=True)
    return tuple((float(low), float(high)) for low, high in limits)


def inside(footprint: Footprint) -> tuple[tuple[float, float], ...]:
    """Return the largest of the boxes in the parts of a footprint (see `_box_in`)."""
    boxes = [_box_in(part) for part in footprint.parts]
    return max(boxes, key=lambda box: math.prod(high - low for low, high in box))


def _box_in(part: ConvexPart) -> tuple[tuple[float, float], ...]:
    """Return the largest box in a part that has the part's centroid and the shape of its bounding box."""
    x, y = centre_of(Footprint((part,)))
    if len(part.vertices) < 3:
        half = part.radius / math.sqrt(2.0)
        return (x - half, x + half), (y - half, y + half)
    width, height = np.ptp(part.vertices, axis=0).tolist()
    after = np.roll(part.vertices, -1, axis=0)
    # the corners are in counter-clockwise order, so these normals point outwards
    normals = np.column_stack([after[:, 1] - part.vertices[:, 1], part.vertices[:, 0] - after[:, 0]])
    room = (normals * (part.vertices - (x, y))).sum(axis=1)
    share = float((room / (np.abs(normals) @ (width / 2.0, height / 2.0))).min())
    return (x - share * width / 2.0, x + share * width / 2.0), (
        y - share * height / 2.0,
        y + share * height / 2.0,
    )


# -------------------------------------------------------------------------------------------------- placement

MAX_SOLUTIONS: Final = 300
"""Maximum number of systems of inequalities that one placement solves."""

MAX_TURNED: Final = 5
"""Maximum number of objects with an orientation; all combinations of their four candidate yaws are tried."""

_TOLERANCE: Final = 1e-9
"""Tolerance of bounds."""

_DIGITS: Final = 9
"""Significant digits of coordinates, in the samples and in their file."""

_SHARES: Final = {2: 0.7, 3: 0.57}
"""Limit of the gap along each of two or three axes that keeps the distance below 1."""

Ways: TypeAlias = list[list[Inequality]]
"""Alternatives: all inequalities of at least one list must hold."""


class CannotPlaceError(Exception):
    """No placement is possible; the message is the reason as part of a sentence."""


class _Amount(NamedTuple):
    """Weighted sum of unknowns plus a constant."""

    weights: dict[Any, float]
    constant: float = 0.0

    def plus(self, other: _Amount, factor: float = 1.0) -> _Amount:
        weights = dict(self.weights)
        for key, value in other.weights.items():
            weights[key] = weights.get(key, 0.0) + factor * value
        return _Amount(weights, self.constant + factor * other.constant)

    def at_most(self, bound: float) -> Inequality:
        return Inequality(
            tuple((key, value) for key, value in self.weights.items() if value), bound - self.constant
        )

    def at_least(self, bound: float) -> Inequality:
        return _Amount({}).plus(self, -1.0).at_most(-bound)


@dataclass(frozen=True)
class Setting:
    """Objects and signals to place, and the regions around them.

    Attributes:
        objects: names of tracked objects.
        signals: names of signals.
        regions: shapes by name.
        upright: whether objects have heights.
        turned: names of the objects with an orientation.
    """

    objects: Sequence[str]
    signals: Sequence[str]
    regions: Mapping[str, Outline]
    upright: bool = False
    turned: Sequence[str] = ()
    _boxes: dict[tuple[str, bool], tuple[tuple[float, float], ...]] = field(default_factory=dict)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of the boxes."""
        return ("x", "y", "z") if self.upright else ("x", "y")

    def region_box(self, name: str, *, outer: bool) -> tuple[tuple[float, float], ...]:
        """Return a box around a region (`outer`) or inside it: limits along x, y and, with a height, z."""
        key = (name, outer)
        if key not in self._boxes:
            outline = self.regions[name]
            limits = around(outline) if outer else inside(footprint_from_outline(outline))
            self._boxes[key] = limits if outline.height is None else (*limits, outline.height)
        return self._boxes[key]


Core: TypeAlias = frozenset[tuple[int, int]]
"""Facts that exclude each other, as pairs: index of the sample, index among its facts."""


def placements(
    setting: Setting, facts: Sequence[Sequence[tuple[Fact, bool]]], period_ns: int
) -> Iterator[tuple[tuple[Sample, ...] | None, Core | None]]:
    """Yield placements in which facts have given values, those with the widest margins first.

    Each item has the samples of a placement, or the facts that exclude each other. Both are None if an
    attempt reaches its limit.

    Args:
        facts: facts of each sample with their values.

    Raises:
        CannotPlaceError: a fact mentions something that cannot be placed.
    """
    unit = _unit(setting, facts)
    turns = [_turns(setting, sample_facts) for sample_facts in facts]
    places = [(index, place) for index, sample in enumerate(facts) for place in range(len(sample))]
    # margins and sizes in units: easy to see at first, then less so
    for margin, spread in ((0.2, 2.0), (0.04, 4.0), (0.04, 20.0), (0.005, 50.0)):
        attempt = _Attempt(setting, unit, margin * unit, spread)
        required: list[Inequality] = list(attempt.sizes())
        choices: list[Ways] = []
        for label, (index, place) in enumerate(places):
            fact, value = facts[index][place]
            ways = [
                [inequality._replace(label=label) for inequality in way]
                for way in attempt.ways(fact, value, index)
            ]
            if len(ways) == 1:
                required += ways[0]
            elif ways:
                choices.append(ways)
        solution = attempt.solve(required, choices, len(facts))
        if not isinstance(solution, frozenset):
            yield tuple(attempt.sample(solution, at, turn, period_ns) for at, turn in enumerate(turns)), None
        else:
            yield None, frozenset(places[label] for label in solution) if attempt.is_finished else None


def _unit(setting: Setting, facts: Sequence[Sequence[tuple[Fact, bool]]]) -> float:
    """Return a typical length of boxes, from the regions or else from the thresholds of distances."""
    lengths = [
        high - low for name in setting.regions for low, high in setting.region_box(name, outer=False)[:2]
    ]
    if lengths:
        return min(lengths) / 4.0 or 1.0
    thresholds = [
        abs(float(fact.threshold))
        for sample in facts
        for fact, _ in sample
        if any(isinstance(quantity, (SignedDistance, Protrusion)) for quantity, _ in fact.weights)
    ]
    return max(thresholds, default=0.0) or 1.0


class _Attempt:
    """Attempt of one placement; unknowns are sizes of boxes, and lower sides and signals in each sample."""

    def __init__(self, setting: Setting, unit: float, margin: float, spread: float) -> None:
        self._setting = setting
        self._unit = unit
        self._margin = margin
        self._spread = spread
        self._left = MAX_SOLUTIONS

    def sizes(self) -> Iterator[Inequality]:
        """Yield limits of the sizes of boxes, so that no box is too small or too large to see."""
        for name, axis in product(self._setting.objects, self._setting.axes):
            size = _Amount({("size", name, axis): 1.0})
            yield size.at_least(self._unit / self._spread)
            yield size.at_most(self._unit * self._spread)

    def ways(self, fact: Fact, value: bool, index: int) -> Ways:
        """Return the alternatives that give a fact its value in a sample; none if it needs no inequality.

        Raises:
            CannotPlaceError: the fact mentions something that cannot be placed.
        """
        if not fact.weights:
            # placed objects have no class, so a quantifier over a class has no members
            if fact.alone is value:
                return []
            raise CannotPlaceError(f"objects are not placed for `{fact.texts[0]}`")
        rises = (fact.side != "<=") == value
        margin = 0.0 if value and fact.side != ">" else self._margin
        bound = float(fact.threshold) + (margin if rises else -margin)
        quantities = [quantity for quantity, _ in fact.weights]
        if isinstance(quantities[0], Misalignment):
            # `_turns` decided the orientations before
            return []
        if all(isinstance(quantity, (Projection, CentroidProjection, Signal)) for quantity in quantities):
            total = _Amount({})
            for quantity, weight in fact.weights:
                total = total.plus(self._amount(quantity, index), float(weight))
            return [[total.at_least(bound) if rises else total.at_most(bound)]]
        if len(quantities) == 1:
            return self._relation(quantities[0], rises, bound, index)
        if len(quantities) == 2 and fact.weights[1][1] == -1:
            # d1 - d2 >= bound follows from d1 >= middle + bound and d2 <= middle
            return [
                [*first_way, *second_way]
                for middle in (0.0, self._unit, 3.0 * self._unit)
                for first_way in self._relation(quantities[0], rises, middle + bound, index)
                for second_way in self._relation(quantities[1], not rises, middle, index)
            ]
        raise CannotPlaceError(f"`{fact.texts[0]}` compares several distances")

    @property
    def is_finished(self) -> bool:
        """Whether the search ended before its limit."""
        return self._left > 0

    def solve(
        self, required: list[Inequality], choices: Sequence[Ways], samples: int
    ) -> Mapping[Any, float] | frozenset[int]:
        """Return values of the unknowns, or the labels of facts that exclude each other.

        The search branches on the first choice that the current values do not fulfil. A conflict without
        that choice ends the branch, because it excludes all alternatives of the choice.
        """
        self._left -= 1
        start = self._start(samples)
        solution = solve(required, exact=False, start=start)
        if solution.values is None:
            if solution.conflict is None:
                self._left = 0
            return solution.conflict or frozenset()
        values = {**start, **{key: float(value) for key, value in solution.values.items()}}
        ways = next((ways for ways in choices if not any(_all_hold(way, values) for way in ways)), None)
        if ways is None:
            return values
        label = ways[0][0].label
        conflicts: frozenset[int] = frozenset()
        # the alternative with the least violation comes first
        for way in sorted(ways, key=lambda way: _missing(way, values)):
            if self._left <= 0:
                break
            outcome = self.solve([*required, *way], choices, samples)
            if not isinstance(outcome, frozenset) or label not in outcome:
                return outcome
            conflicts |= outcome
        return conflicts

    def sample(
        self, values: Mapping[Any, float], index: int, turns: Mapping[str, float], period_ns: int
    ) -> Sample:
        """Return a sample with the boxes and signals of a solution."""
        objects: dict[str, TrackedObject | Footprint] = {}
        for name in self._setting.objects:
            limits = []
            for axis in self._setting.axes:
                low = values["at", name, axis, index]
                limits.append((_round(low), _round(low + values["size", name, axis])))
            (xmin, xmax), (ymin, ymax), *height = limits
            objects[name] = TrackedObject(
                Footprint.box(xmin, ymin, xmax, ymax),
                yaw=turns.get(name),
                height=height[0] if height else None,
            )
        signals = {name: _round(values["signal", name, index]) for name in self._setting.signals}
        return Sample(index * period_ns, objects, signals)

    def _start(self, samples: int) -> dict[Any, float]:
        """Return the initial values of the unknowns: objects in a row below all regions, signals at 0."""
        boxes = [self._setting.region_box(name, outer=True) for name in self._setting.regions]
        left = min((box[0][0] for box in boxes), default=0.0)
        bottom = min((box[1][0] for box in boxes), default=0.0) - 2.0 * self._unit
        start: dict[Any, float] = {}
        for number, name in enumerate(self._setting.objects):
            place = {"x": left + 2.0 * number * self._unit, "y": bottom, "z": 0.0}
            for axis in self._setting.axes:
                start["size", name, axis] = self._unit
                start.update({("at", name, axis, index): place[axis] for index in range(samples)})
        start.update(
            {("signal", name, index): 0.0 for name in self._setting.signals for index in range(samples)}
        )
        return start

    def _relation(self, quantity: Quantity, rises: bool, bound: float, index: int) -> Ways:
        """Return the alternatives that bound a distance or a protrusion from below (`rises`) or above."""
        if isinstance(quantity, SignedDistance):
            first, second = plain(quantity.first), plain(quantity.second)
            bound += float(radius_of(first) + radius_of(second))
        elif isinstance(quantity, Protrusion):
            first, second = plain(quantity.inner), plain(quantity.outer)
            bound += float(radius_of(second) - radius_of(first))
        else:
            raise CannotPlaceError("it compares quantities of several kinds")
        # a box replaces a region so that the relation gets harder: around it to be far, inside it to be near
        outers = (rises, rises) if isinstance(quantity, SignedDistance) else (not rises, rises)
        a = self._sides(first, index, outer=outers[0])
        b = self._sides(second, index, outer=outers[1])
        gaps: list[_Amount] = []
        for (a_low, a_high), (b_low, b_high) in zip(a, b, strict=False):
            if isinstance(quantity, SignedDistance):
                gaps += [b_low.plus(a_high, -1.0), a_low.plus(b_high, -1.0)]
            else:
                gaps += [a_high.plus(b_high, -1.0), b_low.plus(a_low, -1.0)]
        if rises:
            return [[gap.at_least(bound)] for gap in gaps]
        share = _SHARES[min(len(a), len(b))] if bound > 0.0 else 1.0
        return [[gap.at_most(share * bound) for gap in gaps]]

    def _sides(self, term: Term, index: int, *, outer: bool) -> list[tuple[_Amount, _Amount]]:
        """Return the least and the greatest coordinate of a term along each axis."""
        term = without_radius(term)
        if isinstance(term, RegionName):
            limits = self._setting.region_box(term.name, outer=outer)
            return [(_Amount({}, low), _Amount({}, high)) for low, high in limits]
        if isinstance(term, Centre):
            sides = self._sides(term.term, index, outer=outer)
            middles = [_Amount({}).plus(low, 0.5).plus(high, 0.5) for low, high in sides]
            return [(middle, middle) for middle in middles]
        name, at = _object(term, index)
        sides = []
        for axis in self._setting.axes:
            low = _Amount({("at", name, axis, at): 1.0})
            sides.append((low, low.plus(_Amount({("size", name, axis): 1.0}))))
        return sides

    def _amount(self, quantity: Quantity, index: int) -> _Amount:
        if isinstance(quantity, Rate):
            raise CannotPlaceError("rates of change are not drawn")
        if isinstance(quantity, Signal):
            return _Amount({("signal", quantity.name, index): 1.0})
        assert isinstance(quantity, (Projection, CentroidProjection))
        axis = "xyz".index(quantity.axis)
        if isinstance(quantity, CentroidProjection) and isinstance(quantity.term, RegionName):
            footprint = footprint_from_outline(self._setting.regions[quantity.term.name])
            centres = [centre_of(Footprint((part,)))[axis] for part in footprint.parts]
            return _Amount({}, min(centres) if quantity.side == "min" else max(centres))
        sides = self._sides(quantity.term, index, outer=True)
        if axis >= len(sides):
            raise CannotPlaceError("a region without a height is compared along z")
        low, high = sides[axis]
        if isinstance(quantity, CentroidProjection):
            return _Amount({}).plus(low, 0.5).plus(high, 0.5)
        return low if quantity.side == "min" else high


def _object(term: Term, index: int) -> tuple[str, int]:
    """Return the object of a term, and the index of its sample."""
    if isinstance(term, Earlier):
        if term.samples is None or not isinstance(term.term, TrackedName) or term.samples > index:
            raise CannotPlaceError("it looks back over a time, or before the first sample")
        return term.term.name, index - term.samples
    if isinstance(term, TrackedName):
        return term.name, index
    raise CannotPlaceError("a group of a class, or of all objects, is not placed")


def _turns(setting: Setting, facts: Sequence[tuple[Fact, bool]]) -> dict[str, float]:
    """Return yaws, in multiples of 90 degrees, that give facts about orientations their values.

    Raises:
        CannotPlaceError: there are no such yaws, or too many objects.
    """
    asked = [
        (fact, value)
        for fact, value in facts
        if fact.weights and isinstance(fact.weights[0][0], Misalignment)
    ]
    if len(setting.turned) > MAX_TURNED:
        raise CannotPlaceError(f"more than {MAX_TURNED} objects have orientations")
    for quarters in product(range(4), repeat=len(setting.turned)):
        turns = {
            name: math.pi / 2.0 * quarter for name, quarter in zip(setting.turned, quarters, strict=True)
        }
        if all(_is_turned(fact, value, turns) for fact, value in asked):
            return turns
    raise CannotPlaceError("no turns by quarters fit")


def _is_turned(fact: Fact, value: bool, turns: Mapping[str, float]) -> bool:
    total = 0.0
    for quantity, weight in fact.weights:
        if not isinstance(quantity, Misalignment):
            raise CannotPlaceError("it compares quantities of several kinds")
        (first_name, first_index), (second_name, second_index) = (
            _object(quantity.first, 0),
            _object(quantity.second, 0),
        )
        if first_index or second_index:
            raise CannotPlaceError("it compares orientations over time")
        total += float(weight) * (1.0 - math.cos(turns[first_name] - turns[second_name]))
    rises = (fact.side != "<=") == value
    return total > float(fact.threshold) if rises else total < float(fact.threshold)


def _all_hold(way: Sequence[Inequality], values: Mapping[Any, float]) -> bool:
    return _missing(way, values) <= _TOLERANCE


def _missing(way: Sequence[Inequality], values: Mapping[Any, float]) -> float:
    """Return the greatest violation of some inequalities; 0 if all hold."""
    sums = (
        sum(weight * values[key] for key, weight in inequality.coefficients) - inequality.bound
        for inequality in way
    )
    return float(max(0.0, *sums)) if len(way) > 1 else float(max(0.0, next(sums)))


def _round(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


# --------------------------------------------------------------------------------------------------- examples

MAX_SAMPLES: Final = 40
"""Maximum number of samples of a placed run; longer runs are shown only in words."""

MAX_WORDS: Final = 20
"""Maximum number of runs of one length whose placement is tried."""

_SECOND_NS: Final = 10**9
_TENTH_NS: Final = 10**8


@dataclass(frozen=True, slots=True)
class Example:
    """Shortest run that satisfies or violates a spec.

    Attributes:
        verdict: verdict of the run.
        sentences: requirements on each sample; other facts do not matter.
        samples: samples of a placement; None if no placement was found.
        robustness: robustness of the samples; None without samples.
        note: reason why there is no placement, or "".
    """

    verdict: Literal["satisfied", "violated"]
    sentences: tuple[str, ...]
    samples: tuple[Sample, ...] | None = None
    robustness: float | None = None
    note: str = ""

    @property
    def jsonl(self) -> str:
        """The samples as a track file (JSONL); "" without samples."""
        return "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in self.rows)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The lines of the track file as values for JSON."""
        return [_row(sample) for sample in self.samples or ()]


def shortest_example(
    specification: Specification,
    spec: NamedSpec,
    search: WordSearch,
    word: Word,
    satisfied: bool,
    *,
    is_exact: bool = True,
    rate_hz: float | None = None,
    another: Callable[[Sequence[Word]], Word | None] = lambda avoided: None,
) -> Example | None:
    """Return the example of a word, with samples if a placement is found.

    Args:
        is_exact: whether the word certainly has the verdict; if not, the result is None without a placement
            that confirms it.
        rate_hz: sample rate of the run, Hz.
        another: function that returns another word of the same length, without the given words that cannot
            be placed.
    """
    verdict: Literal["satisfied", "violated"] = "satisfied" if satisfied else "violated"
    # a guess about bounds in seconds may be right at only one rate
    periods_ns = (_SECOND_NS,) if is_exact else (_SECOND_NS, _TENTH_NS)
    if rate_hz is not None:
        periods_ns = (round(_SECOND_NS / rate_hz),)
    first: Example | None = None
    avoided: list[Word] = []
    while len(avoided) < MAX_WORDS:
        facts = [[(search.fact(number), value) for number, value in sorted(cube.items())] for cube in word]
        sentences = tuple(
            # two facts of one quantity can have the same text
            " and ".join(dict.fromkeys(fact.texts[0 if value else 1] for fact, value in sample_facts))
            or "any sample"
            for sample_facts in facts
        )
        try:
            placement, note, core = _place(specification, spec, facts, verdict, periods_ns)
        except CannotPlaceError as reason:
            placement, note, core = None, str(reason), None
        if placement is not None:
            return Example(verdict, sentences, *placement)
        first = first or Example(verdict, sentences, note=note)
        if core is None:
            break
        numbers = [sorted(cube) for cube in word]
        blamed = tuple(
            {numbers[index][place]: word[index][numbers[index][place]] for at, place in core if at == index}
            for index in range(len(word))
        )
        # a conflict within one sample excludes its facts in every sample
        avoided.append(tuple(filter(None, blamed)) if sum(map(bool, blamed)) == 1 else blamed)
        following = another(avoided)
        if following is None:
            break
        word = following
    return first if is_exact else None


def _place(
    specification: Specification,
    spec: NamedSpec,
    facts: Sequence[Sequence[tuple[Fact, bool]]],
    verdict: str,
    periods_ns: Sequence[int],
) -> tuple[tuple[tuple[Sample, ...], float] | None, str, Core | None]:
    """Return samples that evaluate to the verdict, and their robustness.

    Returns:
        Samples and robustness, or None if there are none; the reason for None; the facts that cannot be
        placed together, if known.

    Raises:
        CannotPlaceError: the run contains something that cannot be placed.
    """
    if spec.parameter is not None:
        raise CannotPlaceError("a template is about the objects of a log")
    if len(facts) > MAX_SAMPLES:
        raise CannotPlaceError(f"it takes {len(facts)} samples")
    setting, note = _setting(specification, spec), ""
    core: Core | None = None
    for period_ns in periods_ns:
        for samples, excluded in placements(setting, facts, period_ns):
            core = excluded
            if samples is None:
                continue
            try:
                evaluated_verdict, robustness = _evaluate(specification, spec, Trace.from_samples(samples))
            except SpatialReplayError as error:
                note = f"it cannot be evaluated: {error}"
                continue
            if evaluated_verdict == verdict:
                return (samples, robustness), "", None
            note = ""
    return None, note or "no placement of boxes was found", core


def _evaluate(specification: Specification, spec: NamedSpec, trace: Trace) -> tuple[str, float]:
    """Return verdict and robustness of a spec; a spec that is too deeply nested is evaluated by conjuncts."""

    def evaluation_of(*formulas: Formula) -> Evaluation:
        specs = [
            replace(spec, name=f"{spec.name}_{number}", formula=formula, is_result=True)
            for number, formula in enumerate(formulas)
        ]
        return evaluate(replace(specification, specs=tuple(specs)), trace)

    try:
        evaluation = evaluation_of(spec.formula)
    except SpatialReplayError:
        evaluation = evaluation_of(*conjuncts(spec.formula))
    return str(evaluation.verdict), min(result.robustness for result in evaluation)


def _setting(specification: Specification, spec: NamedSpec) -> Setting:
    """Return the setting of a spec, with the objects and signals of all specs, so that all are evaluated."""
    own_atoms = _atoms(spec)
    every = [*own_atoms, *(atom for result in specification.results for atom in _atoms(result))]
    upright = is_about_heights(every)
    turned = dict.fromkeys(_turned_names(own_atoms))
    if len({*turned, *_turned_names(every)}) <= MAX_TURNED:
        turned.update(dict.fromkeys(_turned_names(every)))
    bases = [base_of(term) for atom in own_atoms for term in terms_of(atom.expression)]
    regions = [base.name for base in bases if isinstance(base, RegionName)]
    named = {name: specification.regions[name] for name in dict.fromkeys(regions)}
    objects, signals = object_names(specification), signal_names(specification)
    return Setting(objects, signals, named, upright, tuple(turned))


def _atoms(spec: NamedSpec) -> list[Atom]:
    return [part for part in iter_formulas(spec.formula) if isinstance(part, Atom)]


def _turned_names(atoms: Iterable[Atom]) -> list[str]:
    """Return the objects whose orientations are compared."""
    parts = (part for atom in atoms for part in iter_expressions(atom.expression))
    measurements = (part for part in parts if isinstance(part, Measurement) and part.needs_orientation)
    bases = (base_of(term) for measurement in measurements for term in measurement.terms)
    return [base.name for base in bases if isinstance(base, TrackedName)]


def _row(sample: Sample) -> dict[str, Any]:
    objects = []
    for name, tracked in sample.objects.items():
        (part,) = tracked.footprint.parts
        row: dict[str, Any] = {"name": name, "polygon": part.vertices.tolist()}
        if tracked.yaw is not None:
            row["yaw"] = tracked.yaw
        if tracked.height is not None:
            row["height"] = list(tracked.height)
        objects.append(row)
    signals = {"signals": dict(sample.signals)} if sample.signals else {}
    return {"time_ns": sample.time_ns, "objects": objects, **signals}
