"""What the leaves of a monitor are computed from, found once for samples with the same objects.

To a monitor most samples look alike: other numbers, the same names. A plan holds what follows from the names,
as index arrays, so that a sample costs little more than its numbers. It serves every sample whose members of
open groups are among its own, under whatever names; an object that is not in a sample is only a flag to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import nan
from typing import cast

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.measure import QUANTITY_CODES
from spatial_replay.monitor.leaf_code import LeafCode
from spatial_replay.monitor.measurements import quantity_of, terms_of
from spatial_replay.monitor.operands import footprint_from_outline
from spatial_replay.monitor.plan_kernel import ABSENT, PlanArrays, leaves_of_sample, packed
from spatial_replay.monitor.plan_rows import Frame, Member, Rows
from spatial_replay.spec.formula import Enlarged, Misalignment, Term
from spatial_replay.trace.sample import Sample


class LeafPlan:
    """How the leaves of formulas follow from a sample and the earlier ones that it looks back at."""

    def __init__(self, frame: Frame, members: frozenset[Member]) -> None:
        """Plan for samples that hold no other members of open groups.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        self._classes = frame.classes
        rows = Rows(frame, members)
        code = LeafCode(rows)
        outputs = [number for leaves in frame.leaves for number in code.add_leaves(leaves, {})]
        self._arrays = packed(_arrays(frame, rows, code, outputs))
        self._places = tuple(rows.places)
        self._signals = tuple(code.signals)

    @property
    def nbytes(self) -> int:
        """How much memory its arrays take."""
        return sum(array.nbytes for array in self._arrays)

    def leaf_values(self, samples: Sequence[Sample | None], stands_for: Mapping[str, str]) -> Floats:
        """Each leaf of each formula, one after the other.

        Args:
            samples: the one at each of the frame's delays; None before the first.
            stands_for: the objects that go by another name among the plan's members.

        Returns:
            (C, A, 1), in as many channels as `leaves.leaf_values` would give.
        """
        seen = [
            None if (sample := samples[number]) is None else sample.objects.get(stands_for.get(name, name))
            for number, name in self._places
        ]
        newest = cast(Sample, samples[0]).signals
        whole, numbers, vertices = self._flattened(cast(list[TrackedObject | None], seen))
        return leaves_of_sample(
            self._arrays,
            np.array([ABSENT if sample is None else 0 for sample in samples] + whole, np.int64),
            np.array(numbers + [newest.get(name, nan) for name in self._signals], np.float64),
            np.concatenate(vertices).ravel(),
        )

    def _flattened(self, seen: list[TrackedObject | None]) -> tuple[list[int], list[float], list[Floats]]:
        """What the objects at the plan's places are made of (see `leaves_of_sample`)."""
        classes: list[int] = []
        counts: list[int] = []
        sizes: list[int] = []
        numbers: list[float] = []
        radii: list[float] = []
        vertices: list[Floats] = [_NO_VERTICES]
        for tracked in seen:
            if tracked is None:
                classes.append(ABSENT)
                counts.append(0)
                numbers += _NO_NUMBERS
                continue
            classes.append(class_code(tracked, self._classes))
            bottom, top = tracked.height or _NO_HEIGHT
            numbers += (bottom, top, nan if tracked.yaw is None else tracked.yaw, tracked.uncertainty)
            parts = tracked.footprint.parts
            counts.append(len(parts))
            for part in parts:
                sizes.append(len(part.vertices))
                radii.append(part.radius)
                vertices.append(part.vertices)
        return classes + counts + sizes, numbers + radii, vertices


_NO_HEIGHT = (nan, nan)
_NO_NUMBERS = (nan, nan, nan, 0.0)
_NO_VERTICES = np.empty((0, 2))


def class_code(tracked: TrackedObject, classes: Mapping[str, int]) -> int:
    """The code of an object's class."""
    return classes.get((tracked.class_name or "").casefold(), 0) if classes else 0


def _arrays(frame: Frame, rows: Rows, code: LeafCode, outputs: Sequence[int]) -> PlanArrays:
    measurements = list(code.measurements)
    operands: dict[Term, int] = {}
    geometric = [k for k, each in enumerate(measurements) if not isinstance(each, Misalignment)]
    pairs = [
        [operands.setdefault(term, len(operands)) for term in terms_of(measurements[k])] for k in geometric
    ]
    yaws = [
        [k, *(rows.of_term(term)[0].row for term in terms_of(each))]
        for k, each in enumerate(measurements)
        if isinstance(each, Misalignment)
    ]
    operand_rows = [rows.of_term(term) for term in operands]
    required = [[row for term in terms_of(each) for row in rows.required(term)] for each in measurements]
    members = [rows.of_membership(each) for each in code.members]
    regions = FootprintBatch.from_footprints(
        [footprint_from_outline(outline) for outline in frame.regions.values()],
        [outline.height for outline in frame.regions.values()],
    )
    return PlanArrays(
        extent=_whole([len(frame.delays), len(frame.regions), len(rows.places), len(code.signals)]),
        region_parts=np.diff(regions.part_start),
        region_sizes=np.diff(regions.vertex_start),
        region_radius=regions.radius.copy(),
        region_vertices=regions.vertices.ravel(),
        region_heights=np.stack((regions.bottom, regions.top), axis=1),
        operand_start=_starts(operand_rows),
        operand_rows=_whole(each.row for among in operand_rows for each in among),
        operand_classes=_whole(each.class_code for among in operand_rows for each in among),
        enlargement=np.array([_enlargement(term) for term in operands], np.float64),
        geometric=_whole(geometric),
        quantity=_whole(QUANTITY_CODES[quantity_of(measurements[k])] for k in geometric),
        first=_whole(pair[0] for pair in pairs),
        second=_whole(pair[1] if len(pair) > 1 else ABSENT for pair in pairs),
        yaws=np.array(yaws, np.int64).reshape(len(yaws), 3),
        required_start=_starts(required),
        required=_whole(row for among in required for row in among),
        member_start=_starts(members),
        member_rows=_whole(each.row for among in members for each in among),
        member_classes=_whole(each.class_code for among in members for each in among),
        is_group=_whole(not each.chosen for each in code.members),
        code=np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        constants=np.array(list(code.constants), np.float64),
        outputs=_whole(outputs),
    )


def _whole(numbers: Iterable[int]) -> Integers:
    return np.array(list(numbers), np.int64)


def _starts(among: Sequence[Sequence[object]]) -> Integers:
    return np.concatenate(([0], np.cumsum([len(each) for each in among], dtype=np.int64)))


def _enlargement(term: Term) -> float:
    """How much a term is enlarged in all, added in the order in which a scene does."""
    return _enlargement(term.term) + term.radius if isinstance(term, Enlarged) else 0.0
