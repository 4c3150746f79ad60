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
    """Return the bounding box of an outline: (least, greatest) along x and y."""
    vertices, radius = np.array(outline.vertices, np.float64), outline.radius
    limits = zip(vertices.min(axis=0) - radius, vertices.max(axis=0) + radius, strict=True)
    return tuple((float(low), float(high)) for low, high in limits)


def inside(footprint: Footprint) -> tuple[tuple[float, float], ...]:
    """Return the largest box that lies inside one part of a footprint (see `_box_in`)."""
    boxes = [_box_in(part) for part in footprint.parts]
    return max(boxes, key=lambda box: math.prod(high - low for low, high in box))


def _box_in(part: ConvexPart) -> tuple[tuple[float, float], ...]:
    """Return the largest box in a part that has the centroid and the proportions of the part."""
    x, y = centre_of(Footprint((part,)))
    if len(part.vertices) < 3:
        half_side = part.radius / math.sqrt(2.0)
        return (x - half_side, x + half_side), (y - half_side, y + half_side)
    width, height = np.ptp(part.vertices, axis=0).tolist()
    next_vertices = np.roll(part.vertices, -1, axis=0)
    # the corners are in counter-clockwise order, so these normals point outwards
    normals = np.column_stack(
        [next_vertices[:, 1] - part.vertices[:, 1], part.vertices[:, 0] - next_vertices[:, 0]]
    )
    edge_distances = (normals * (part.vertices - (x, y))).sum(axis=1)
    scale = float((edge_distances / (np.abs(normals) @ (width / 2.0, height / 2.0))).min())
    return (x - scale * width / 2.0, x + scale * width / 2.0), (
        y - scale * height / 2.0,
        y + scale * height / 2.0,
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
"""By number of axes: greatest gap along each axis with which the distance stays below 1."""

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
"""Facts that exclude each other, as pairs: index of a sample, index of a fact in the sample."""


def placements(
    setting: Setting, facts: Sequence[Sequence[tuple[Fact, bool]]], period_ns: int
) -> Iterator[tuple[tuple[Sample, ...] | None, Core | None]]:
    """Yield placements in which facts have given values, from wide to narrow margins.

    Each item has the samples of a placement, or the facts that exclude each other. (None, None) stands
    for an attempt that reached `MAX_SOLUTIONS`.

    Args:
        facts: facts of each sample with their values.

    Raises:
        CannotPlaceError: a fact mentions something that cannot be placed.
    """
    unit = _unit(setting, facts)
    yaws_by_sample = [_turns(setting, sample_facts) for sample_facts in facts]
    fact_positions = [
        (sample_index, fact_index)
        for sample_index, sample_facts in enumerate(facts)
        for fact_index in range(len(sample_facts))
    ]
    # margins and sizes in units: from easy to hard to see
    for margin, spread in ((0.2, 2.0), (0.04, 4.0), (0.04, 20.0), (0.005, 50.0)):
        attempt = _Attempt(setting, unit, margin * unit, spread)
        required: list[Inequality] = list(attempt.sizes())
        choices: list[Ways] = []
        for label, (sample_index, fact_index) in enumerate(fact_positions):
            fact, value = facts[sample_index][fact_index]
            ways = [
                [inequality._replace(label=label) for inequality in way]
                for way in attempt.ways(fact, value, sample_index)
            ]
            if len(ways) == 1:
                required += ways[0]
            elif ways:
                choices.append(ways)
        solution = attempt.solve(required, choices, len(facts))
        if not isinstance(solution, frozenset):
            yield (
                tuple(
                    attempt.sample(solution, number, yaws, period_ns)
                    for number, yaws in enumerate(yaws_by_sample)
                ),
                None,
            )
        else:
            yield (
                None,
                frozenset(fact_positions[label] for label in solution) if attempt.is_finished else None,
            )


def _unit(setting: Setting, facts: Sequence[Sequence[tuple[Fact, bool]]]) -> float:
    """Return a typical length of boxes, from the regions or else from the thresholds of distances."""
    lengths = [
        high - low for name in setting.regions for low, high in setting.region_box(name, outer=False)[:2]
    ]
    if lengths:
        return min(lengths) / 4.0 or 1.0
    thresholds = [
        abs(float(fact.threshold))
        for sample_facts in facts
        for fact, _ in sample_facts
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
        self._solutions_left = MAX_SOLUTIONS

    def sizes(self) -> Iterator[Inequality]:
        """Yield limits of the sizes of boxes, so that no box is too small or too large to see."""
        for name, axis in product(self._setting.objects, self._setting.axes):
            size = _Amount({("size", name, axis): 1.0})
            yield size.at_least(self._unit / self._spread)
            yield size.at_most(self._unit * self._spread)

    def ways(self, fact: Fact, value: bool, index: int) -> Ways:
        """Return the alternatives that give a fact its value in a sample; [] if no inequality is needed.

        Raises:
            CannotPlaceError: the fact mentions something that cannot be placed.
        """
        if not fact.weights:
            # placed objects have no class, so a quantifier over a class has no members
            if fact.alone is value:
                return []
            raise CannotPlaceError(f"objects are not placed for `{fact.texts[0]}`")
        is_lower_limit = (fact.side != "<=") == value
        margin = 0.0 if value and fact.side != ">" else self._margin
        bound = float(fact.threshold) + (margin if is_lower_limit else -margin)
        quantities = [quantity for quantity, _ in fact.weights]
        if isinstance(quantities[0], Misalignment):
            # `_turns` has already decided the orientations
            return []
        if all(isinstance(quantity, (Projection, CentroidProjection, Signal)) for quantity in quantities):
            weighted_sum = _Amount({})
            for quantity, weight in fact.weights:
                weighted_sum = weighted_sum.plus(self._amount(quantity, index), float(weight))
            return [[weighted_sum.at_least(bound) if is_lower_limit else weighted_sum.at_most(bound)]]
        if len(quantities) == 1:
            return self._relation(quantities[0], is_lower_limit, bound, index)
        if len(quantities) == 2 and fact.weights[1][1] == -1:
            # d1 - d2 >= bound follows from d1 >= middle + bound and d2 <= middle
            return [
                [*first_way, *second_way]
                for middle in (0.0, self._unit, 3.0 * self._unit)
                for first_way in self._relation(quantities[0], is_lower_limit, middle + bound, index)
                for second_way in self._relation(quantities[1], not is_lower_limit, middle, index)
            ]
        raise CannotPlaceError(f"`{fact.texts[0]}` compares several distances")

    @property
    def is_finished(self) -> bool:
        """Whether the search ended before its limit."""
        return self._solutions_left > 0

    def solve(
        self, required: list[Inequality], choices: Sequence[Ways], samples: int
    ) -> Mapping[Any, float] | frozenset[int]:
        """Return values of the unknowns, or the labels of facts that exclude each other.

        The search branches on the first choice that the current values do not fulfil. If a conflict does not
        contain this choice, the other alternatives of the choice are not tried, because they also fail.
        """
        self._solutions_left -= 1
        start_values = self._start(samples)
        solution = solve(required, exact=False, start=start_values)
        if solution.values is None:
            if solution.conflict is None:
                self._solutions_left = 0
            return solution.conflict or frozenset()
        values = {**start_values, **{key: float(value) for key, value in solution.values.items()}}
        ways = next((ways for ways in choices if not any(_all_hold(way, values) for way in ways)), None)
        if ways is None:
            return values
        label = ways[0][0].label
        conflict_labels: frozenset[int] = frozenset()
        # the alternative with the least violation comes first
        for way in sorted(ways, key=lambda way: _missing(way, values)):
            if self._solutions_left <= 0:
                break
            result = self.solve([*required, *way], choices, samples)
            if not isinstance(result, frozenset) or label not in result:
                return result
            conflict_labels |= result
        return conflict_labels

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
        left_edge = min((box[0][0] for box in boxes), default=0.0)
        bottom = min((box[1][0] for box in boxes), default=0.0) - 2.0 * self._unit
        start_values: dict[Any, float] = {}
        for object_index, name in enumerate(self._setting.objects):
            position = {"x": left_edge + 2.0 * object_index * self._unit, "y": bottom, "z": 0.0}
            for axis in self._setting.axes:
                start_values["size", name, axis] = self._unit
                start_values.update({("at", name, axis, index): position[axis] for index in range(samples)})
        start_values.update(
            {("signal", name, index): 0.0 for name in self._setting.signals for index in range(samples)}
        )
        return start_values

    def _relation(self, quantity: Quantity, is_lower_limit: bool, bound: float, sample_index: int) -> Ways:
        """Return alternatives that bound a distance or protrusion from below (`is_lower_limit`) or above."""
        if isinstance(quantity, SignedDistance):
            first_term, second_term = plain(quantity.first), plain(quantity.second)
            bound += float(radius_of(first_term) + radius_of(second_term))
        elif isinstance(quantity, Protrusion):
            first_term, second_term = plain(quantity.inner), plain(quantity.outer)
            bound += float(radius_of(second_term) - radius_of(first_term))
        else:
            raise CannotPlaceError("it compares quantities of several kinds")
        # a box replaces a region and makes the relation harder: around the region for far, inside it for near
        use_outer_boxes = (
            (is_lower_limit, is_lower_limit)
            if isinstance(quantity, SignedDistance)
            else (not is_lower_limit, is_lower_limit)
        )
        first_sides = self._sides(first_term, sample_index, outer=use_outer_boxes[0])
        second_sides = self._sides(second_term, sample_index, outer=use_outer_boxes[1])
        gaps: list[_Amount] = []
        for (a_low, a_high), (b_low, b_high) in zip(first_sides, second_sides, strict=False):
            if isinstance(quantity, SignedDistance):
                gaps += [b_low.plus(a_high, -1.0), a_low.plus(b_high, -1.0)]
            else:
                gaps += [a_high.plus(b_high, -1.0), b_low.plus(a_low, -1.0)]
        if is_lower_limit:
            return [[gap.at_least(bound)] for gap in gaps]
        gap_share = _SHARES[min(len(first_sides), len(second_sides))] if bound > 0.0 else 1.0
        return [[gap.at_most(gap_share * bound) for gap in gaps]]

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
        object_name, sample_index = _object(term, index)
        sides = []
        for axis in self._setting.axes:
            low = _Amount({("at", object_name, axis, sample_index): 1.0})
            sides.append((low, low.plus(_Amount({("size", object_name, axis): 1.0}))))
        return sides

    def _amount(self, quantity: Quantity, sample_index: int) -> _Amount:
        if isinstance(quantity, Rate):
            raise CannotPlaceError("rates of change are not drawn")
        if isinstance(quantity, Signal):
            return _Amount({("signal", quantity.name, sample_index): 1.0})
        assert isinstance(quantity, (Projection, CentroidProjection))
        axis_index = "xyz".index(quantity.axis)
        if isinstance(quantity, CentroidProjection) and isinstance(quantity.term, RegionName):
            footprint = footprint_from_outline(self._setting.regions[quantity.term.name])
            centre_coordinates = [centre_of(Footprint((part,)))[axis_index] for part in footprint.parts]
            return _Amount({}, min(centre_coordinates) if quantity.side == "min" else max(centre_coordinates))
        sides = self._sides(quantity.term, sample_index, outer=True)
        if axis_index >= len(sides):
            raise CannotPlaceError("a region without a height is compared along z")
        low, high = sides[axis_index]
        if isinstance(quantity, CentroidProjection):
            return _Amount({}).plus(low, 0.5).plus(high, 0.5)
        return low if quantity.side == "min" else high


def _object(term: Term, sample_index: int) -> tuple[str, int]:
    """Return the object of a term, and the index of its sample."""
    if isinstance(term, Earlier):
        if term.samples is None or not isinstance(term.term, TrackedName) or term.samples > sample_index:
            raise CannotPlaceError("it looks back over a time, or before the first sample")
        return term.term.name, sample_index - term.samples
    if isinstance(term, TrackedName):
        return term.name, sample_index
    raise CannotPlaceError("a group of a class, or of all objects, is not placed")


def _turns(setting: Setting, facts: Sequence[tuple[Fact, bool]]) -> dict[str, float]:
    """Return yaws, in multiples of 90 degrees, that give facts about orientations their values.

    Raises:
        CannotPlaceError: there are no such yaws, or too many objects.
    """
    orientation_facts = [
        (fact, value)
        for fact, value in facts
        if fact.weights and isinstance(fact.weights[0][0], Misalignment)
    ]
    if len(setting.turned) > MAX_TURNED:
        raise CannotPlaceError(f"more than {MAX_TURNED} objects have orientations")
    for quarters in product(range(4), repeat=len(setting.turned)):
        yaws = {name: math.pi / 2.0 * quarter for name, quarter in zip(setting.turned, quarters, strict=True)}
        if all(_is_turned(fact, value, yaws) for fact, value in orientation_facts):
            return yaws
    raise CannotPlaceError("no turns by quarters fit")


def _is_turned(fact: Fact, value: bool, yaws: Mapping[str, float]) -> bool:
    weighted_sum = 0.0
    for quantity, weight in fact.weights:
        if not isinstance(quantity, Misalignment):
            raise CannotPlaceError("it compares quantities of several kinds")
        (first_name, first_index), (second_name, second_index) = (
            _object(quantity.first, 0),
            _object(quantity.second, 0),
        )
        if first_index or second_index:
            raise CannotPlaceError("it compares orientations over time")
        weighted_sum += float(weight) * (1.0 - math.cos(yaws[first_name] - yaws[second_name]))
    is_lower_limit = (fact.side != "<=") == value
    return weighted_sum > float(fact.threshold) if is_lower_limit else weighted_sum < float(fact.threshold)


def _all_hold(way: Sequence[Inequality], values: Mapping[Any, float]) -> bool:
    return _missing(way, values) <= _TOLERANCE


def _missing(way: Sequence[Inequality], values: Mapping[Any, float]) -> float:
    """Return the greatest violation of some inequalities; 0 if all hold."""
    excesses = (
        sum(weight * values[key] for key, weight in inequality.coefficients) - inequality.bound
        for inequality in way
    )
    return float(max(0.0, *excesses)) if len(way) > 1 else float(max(0.0, next(excesses)))


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
        is_exact: whether the word certainly has the verdict. If not, the result is None unless a placement
            confirms the verdict.
        rate_hz: sample rate of the run, Hz.
        another: function that receives words to avoid and returns another word of the same length. It returns
            None if there is no such word.
    """
    verdict: Literal["satisfied", "violated"] = "satisfied" if satisfied else "violated"
    # a guess about bounds in seconds may be right at only one rate
    periods_ns = (_SECOND_NS,) if is_exact else (_SECOND_NS, _TENTH_NS)
    if rate_hz is not None:
        periods_ns = (round(_SECOND_NS / rate_hz),)
    first_example: Example | None = None
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
        first_example = first_example or Example(verdict, sentences, note=note)
        if core is None:
            break
        fact_numbers = [sorted(cube) for cube in word]
        conflict_word = tuple(
            {
                fact_numbers[index][fact_index]: word[index][fact_numbers[index][fact_index]]
                for sample_index, fact_index in core
                if sample_index == index
            }
            for index in range(len(word))
        )
        # a conflict within one sample excludes its facts in every sample
        avoided.append(
            tuple(filter(None, conflict_word)) if sum(map(bool, conflict_word)) == 1 else conflict_word
        )
        next_word = another(avoided)
        if next_word is None:
            break
        word = next_word
    return first_example if is_exact else None


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
        for samples, conflict in placements(setting, facts, period_ns):
            core = conflict
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
    """Return verdict and robustness of a spec; a spec that is too deeply nested is evaluated per conjunct."""

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
    """Return the setting of a spec, with the objects and signals of all results, which are evaluated, too."""
    own_atoms = _atoms(spec)
    all_atoms = [*own_atoms, *(atom for result in specification.results for atom in _atoms(result))]
    is_upright = is_about_heights(all_atoms)
    turned_names = dict.fromkeys(_turned_names(own_atoms))
    if len({*turned_names, *_turned_names(all_atoms)}) <= MAX_TURNED:
        turned_names.update(dict.fromkeys(_turned_names(all_atoms)))
    bases = [base_of(term) for atom in own_atoms for term in terms_of(atom.expression)]
    region_names = [base.name for base in bases if isinstance(base, RegionName)]
    regions_by_name = {name: specification.regions[name] for name in dict.fromkeys(region_names)}
    objects, signals = object_names(specification), signal_names(specification)
    return Setting(objects, signals, regions_by_name, is_upright, tuple(turned_names))


def _atoms(spec: NamedSpec) -> list[Atom]:
    return [part for part in iter_formulas(spec.formula) if isinstance(part, Atom)]


def _turned_names(atoms: Iterable[Atom]) -> list[str]:
    """Return the objects whose orientations are compared."""
    expressions = (expression for atom in atoms for expression in iter_expressions(atom.expression))
    measurements = (
        expression
        for expression in expressions
        if isinstance(expression, Measurement) and expression.needs_orientation
    )
    bases = (base_of(term) for measurement in measurements for term in measurement.terms)
    return [base.name for base in bases if isinstance(base, TrackedName)]


def _row(sample: Sample) -> dict[str, Any]:
    object_rows = []
    for name, tracked_object in sample.objects.items():
        (part,) = tracked_object.footprint.parts
        row: dict[str, Any] = {"name": name, "polygon": part.vertices.tolist()}
        if tracked_object.yaw is not None:
            row["yaw"] = tracked_object.yaw
        if tracked_object.height is not None:
            row["height"] = list(tracked_object.height)
        object_rows.append(row)
    signals = {"signals": dict(sample.signals)} if sample.signals else {}
    return {"time_ns": sample.time_ns, "objects": object_rows, **signals}
