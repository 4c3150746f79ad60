"""What samples say of propositions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.monitor.leaf_plans import SampleLeaves
from spatial_replay.spec.formula import Formula, Outline, Specification
from spatial_replay.trace.sample import Sample

Symbol: TypeAlias = tuple[bool | None, ...]
"""For each proposition whether it is true; None where that is not known."""


class Observer:
    """Propositions in sample after sample: true where their robustness is at least 0.

    As for a `value`, uncertainty does not count: a robot acts on what is most likely.
    """

    def __init__(self, formulas: Sequence[Formula], regions: Mapping[str, Outline]) -> None:
        # what evaluates leaves takes all formulas without temporal operators
        leaves: list[Any] = list(formulas)
        self._leaves = SampleLeaves([leaves], regions)

    def symbol(self, sample: Sample) -> Symbol:
        """What a sample says of each proposition."""
        values = self._leaves.values(self._leaves.look_at(sample))
        lower, upper = values[0, :, 0].tolist(), values[min(1, len(values) - 1), :, 0].tolist()
        return tuple(
            None if low < 0.0 <= high else low >= 0.0 for low, high in zip(lower, upper, strict=True)
        )


def refuse_template(specification: Specification, name: str) -> None:
    """That a spec is about objects that are known.

    Raises:
        UsageError: a template, since it stands for objects that only a whole log has.
    """
    for spec in specification.specs:
        if spec.name == name and spec.parameter is not None:
            raise UsageError(
                f"{name}({spec.parameter}) in {specification.filename} is a template: it stands for objects "
                "that are not known before the end; plan for a spec that names its objects"
            )
