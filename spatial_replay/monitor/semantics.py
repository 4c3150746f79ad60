"""The two meanings that a formula can have, by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, TypeAlias, cast, get_args

from spatial_replay.errors import UsageError
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.online.program import compile_formula
from spatial_replay.monitor.paper.evaluator import PaperRuns, PaperStream, check_operators
from spatial_replay.monitor.stream import InstanceEvaluation, InstanceStream, LiveEvaluation, LiveRuns
from spatial_replay.spec.formula import Specification

Semantics: TypeAlias = Literal["ltlf", "paper"]
"""Robustness over finite traces, or the paper's Def. 16 to the letter."""


def checked_semantics(name: str, specifications: Iterable[Specification] = ()) -> Semantics:
    """The semantics of a name, which has a meaning for all operators of some specifications.

    Raises:
        UsageError: there is none of that name, or it lacks an operator.
    """
    if name not in get_args(Semantics):
        known = " and ".join(repr(each) for each in get_args(Semantics))
        raise UsageError(f"no semantics {name!r}; there are {known}")
    if name == "paper":
        for specification in specifications:
            check_operators(specification)
    return cast(Semantics, name)


def instance_evaluation(instance: Instance, semantics: Semantics = "ltlf") -> InstanceEvaluation:
    """An instance before its first sample, to be evaluated in stretches."""
    return PaperStream(instance) if semantics == "paper" else InstanceStream(instance)


def live_evaluation(specification: Specification, semantics: Semantics, start_ns: int) -> LiveEvaluation:
    """The results of a specification before the first sample, to be evaluated sample by sample.

    Args:
        start_ns: samples before this time are only there to be looked back at.
    """
    formulas = [spec.formula for spec in specification.results]
    programs = [compile_formula(formula) for formula in formulas]
    if semantics == "paper":
        return PaperRuns(formulas, programs, specification.regions, start_ns)
    return LiveRuns(programs, specification.regions, start_ns)
