"""Exact satisfiability of linear inequalities: a solution, or inequalities that exclude each other.

The method is the simplex of SMT solvers (Dutertre and de Moura, "A Fast Linear-Arithmetic Solver for
DPLL(T)", 2006, https://doi.org/10.1007/11817963_11). Strict inequalities need infinitesimals: a pair (a, b)
is the number a + b * epsilon, where epsilon is a positive infinitesimal.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from fractions import Fraction
from itertools import compress
from operator import not_
from typing import Final, NamedTuple, TypeAlias

Real: TypeAlias = Fraction | float
"""Number: fractions and integers give exact answers, floats fast answers."""

Coefficients: TypeAlias = tuple[tuple[Hashable, Real], ...]
"""Pairs of a quantity and its factor; each quantity occurs once."""

_Pair: TypeAlias = tuple[Real, Real]

MAX_PIVOTS: Final = 4000
"""Maximum number of pivots of one search."""

_TOLERANCE: Final = 1e-9
"""Tolerance of bounds for floats."""


class Inequality(NamedTuple):
    """Weighted sum of quantities that is at most a bound.

    Attributes:
        is_strict: whether the sum must be less than the bound.
        label: identifier in conflicts; None if conflicts do not list it.
    """

    coefficients: Coefficients
    bound: Real
    is_strict: bool = False
    label: int | None = None


class Solution(NamedTuple):
    """Answer of `solve`; both attributes are None if the search reached its limit.

    Attributes:
        values: values of all quantities that keep every inequality; a strict inequality can be at its bound.
        conflict: labels of inequalities that exclude each other.
    """

    values: Mapping[Hashable, Real] | None
    conflict: frozenset[int] | None


def solve(
    inequalities: Sequence[Inequality],
    laws: Sequence[Inequality] = (),
    *,
    exact: bool = True,
    start: Mapping[Hashable, Real] | None = None,
) -> Solution:
    """Return values that keep all inequalities, or the labels of inequalities that exclude each other.

    Args:
        laws: further inequalities; a law is added once the current values violate it, because few of many
            laws matter to one question.
        exact: whether to compute with fractions; floats have a tolerance.
        start: initial values of quantities, 0 by default. A value changes only if an inequality requires it.
    """
    tableau = _Tableau(0.0 if exact else _TOLERANCE, start or {})
    active_inequalities, pending_laws = list(inequalities), list(laws)
    conflict = tableau.extend(active_inequalities, 0)
    while conflict is None:
        kept_flags = [tableau.keeps(law) for law in pending_laws]
        if all(kept_flags):
            return Solution(tableau.values(), None)
        violated_laws = list(compress(pending_laws, map(not_, kept_flags)))
        pending_laws = list(compress(pending_laws, kept_flags))
        active_inequalities += violated_laws
        conflict = tableau.extend(violated_laws, len(active_inequalities) - len(violated_laws))
    if not conflict:
        return Solution(None, None)
    labels = (active_inequalities[index].label for index in conflict)
    return Solution(None, frozenset(label for label in labels if label is not None))


def _ratio(value: Real, factor: Real) -> Real:
    """Return the quotient, exact for exact numbers; division by ±1 keeps integers, which is faster."""
    if factor in (1, -1):
        return value * factor
    if isinstance(value, float) or isinstance(factor, float):
        return value / factor
    return Fraction(value) / factor


class _Tableau:
    """Variables with bounds; some variables are sums of others. `conflict` is set once two bounds cross."""

    def __init__(self, tolerance: float, start: Mapping[Hashable, Real]) -> None:
        self.conflict: set[int] | None = None
        self._start = start
        self._tolerance = tolerance
        self._sum_variables: dict[Hashable, int] = {}
        self._quantity_variables: dict[Hashable, int] = {}
        # for each variable that is a sum, the factors of its summands
        self._rows: dict[int, dict[int, Real]] = {}
        self._values: list[_Pair] = []
        self._lower: list[tuple[_Pair, int] | None] = []
        self._upper: list[tuple[_Pair, int] | None] = []

    def extend(self, inequalities: Sequence[Inequality], first_index: int) -> set[int] | None:
        """Add bounds with indices from `first_index` on, and search again; return a conflict or None."""
        for index, inequality in enumerate(inequalities, first_index):
            if not self.add(inequality, index):
                return self.conflict
        return self.search()

    def keeps(self, inequality: Inequality) -> bool:
        """Return whether the current values keep an inequality that is not strict."""
        real_part, epsilon_part = self._sum(
            {self._quantity(quantity): factor for quantity, factor in inequality.coefficients}
        )
        return not self._below((inequality.bound, 0), (real_part, epsilon_part))

    def add(self, inequality: Inequality, index: int) -> bool:
        """Add a bound; return False if it contradicts the opposite bound."""
        coefficients, bound, is_strict, _ = inequality
        if not coefficients:
            if bound < -self._tolerance or (is_strict and bound <= 0):
                self.conflict = {index}
            return self.conflict is None
        factor = coefficients[0][1]
        normal_coefficients = tuple((key, _ratio(value, factor)) for key, value in coefficients)
        variable = self._variable(normal_coefficients)
        limit = (_ratio(bound, factor), (-1 if factor > 0 else 1) if is_strict else 0)
        if factor > 0:
            previous_bound = self._upper[variable]
            if previous_bound is None or limit < previous_bound[0]:
                self._upper[variable] = limit, index
        else:
            previous_bound = self._lower[variable]
            if previous_bound is None or limit > previous_bound[0]:
                self._lower[variable] = limit, index
        lower, upper = self._lower[variable], self._upper[variable]
        if lower is not None and upper is not None and self._below(upper[0], lower[0]):
            self.conflict = {lower[1], upper[1]}
        return self.conflict is None

    def search(self) -> set[int] | None:
        """Move all variables into their bounds.

        Returns:
            None if all variables are in their bounds, else the indices of conflicting inequalities. The set
            is empty after `MAX_PIVOTS` steps.
        """
        for variable in range(len(self._values)):
            if variable not in self._rows:
                self._enter(variable)
        for variable, row in self._rows.items():
            self._values[variable] = self._sum(row)
        for _ in range(MAX_PIVOTS):
            violated = self._violation()
            if violated is None:
                return None
            variable, must_rise = violated
            violated_bound = self._lower[variable] if must_rise else self._upper[variable]
            if violated_bound is None:
                return set()
            row = self._rows[variable]
            # the lowest number first (Bland's rule)
            entering_variable = next(
                (
                    candidate
                    for candidate in sorted(row)
                    if self._can_move(candidate, row[candidate], must_rise)
                ),
                None,
            )
            if entering_variable is None:
                blocking_bounds = [
                    self._upper[candidate] if (factor > 0) == must_rise else self._lower[candidate]
                    for candidate, factor in row.items()
                ]
                return {violated_bound[1], *(bound[1] for bound in blocking_bounds if bound is not None)}
            self._pivot(variable, entering_variable, violated_bound[0])
        return set()

    def values(self) -> dict[Hashable, Real]:
        """Return the values of the quantities, without infinitesimals."""
        return {key: self._values[number][0] for key, number in self._quantity_variables.items()}

    def _variable(self, normal: Coefficients) -> int:
        """Return the variable of a normalized sum: its first factor is 1."""
        if len(normal) == 1:
            return self._quantity(normal[0][0])
        sum_variable = self._sum_variables.get(normal)
        if sum_variable is None:
            # quantities get their numbers before their sums
            summands = [(self._quantity(key), factor) for key, factor in normal]
            sum_variable = self._sum_variables[normal] = self._new()
            row: dict[int, Real] = {}
            for quantity_variable, factor in summands:
                # a quantity that a pivot turned into a sum is replaced by this sum
                summand_row: dict[int, Real] = self._rows.get(quantity_variable, {quantity_variable: 1})
                for variable, weight in summand_row.items():
                    row[variable] = row.get(variable, 0) + factor * weight
            self._rows[sum_variable] = {
                variable: weight
                for variable, weight in row.items()
                if weight > self._tolerance or weight < -self._tolerance
            }
        return sum_variable

    def _quantity(self, key: Hashable) -> int:
        if key not in self._quantity_variables:
            self._quantity_variables[key] = self._new(self._start.get(key, 0))
        return self._quantity_variables[key]

    def _new(self, value: Real = 0) -> int:
        self._values.append((value, 0))
        self._lower.append(None)
        self._upper.append(None)
        return len(self._values) - 1

    def _enter(self, variable: int) -> None:
        """Move a variable that is not a sum into its bounds."""
        lower, upper = self._lower[variable], self._upper[variable]
        if lower is not None and self._values[variable] < lower[0]:
            self._values[variable] = lower[0]
        elif upper is not None and self._values[variable] > upper[0]:
            self._values[variable] = upper[0]

    def _sum(self, row: Mapping[int, Real]) -> _Pair:
        real_part: Real = 0
        epsilon_part: Real = 0
        for variable, factor in row.items():
            value = self._values[variable]
            real_part += factor * value[0]
            epsilon_part += factor * value[1]
        return real_part, epsilon_part

    def _below(self, left: _Pair, right: _Pair) -> bool:
        return left[0] < right[0] - self._tolerance if self._tolerance else left < right

    def _violation(self) -> tuple[int, bool] | None:
        """Return the first sum outside of its bounds, and whether the sum must rise; None if all fit."""
        # the lowest number first (Bland's rule), so that the pivots cannot cycle
        for variable in sorted(self._rows):
            value, lower, upper = self._values[variable], self._lower[variable], self._upper[variable]
            if lower is not None and self._below(value, lower[0]):
                return variable, True
            if upper is not None and self._below(upper[0], value):
                return variable, False
        return None

    def _can_move(self, variable: int, factor: Real, must_rise: bool) -> bool:
        """Return whether a variable can move so that a sum with it rises (`must_rise`) or falls."""
        is_upward = (factor > 0) == must_rise
        bound = self._upper[variable] if is_upward else self._lower[variable]
        value = self._values[variable]
        return bound is None or (self._below(value, bound[0]) if is_upward else self._below(bound[0], value))

    def _pivot(self, leaving: int, entering: int, bound: _Pair) -> None:
        """Set a sum to a bound by changing one of its variables; the sum and the variable exchange roles."""
        row = self._rows.pop(leaving)
        factor = row.pop(entering)
        change = tuple(_ratio(to - at, factor) for to, at in zip(bound, self._values[leaving], strict=True))
        self._values[leaving] = bound
        old_value = self._values[entering]
        self._values[entering] = (old_value[0] + change[0], old_value[1] + change[1])
        entering_row = {variable: _ratio(-value, factor) for variable, value in row.items()}
        entering_row[leaving] = _ratio(1, factor)
        for sum_variable, sum_row in self._rows.items():
            weight = sum_row.pop(entering, 0)
            if weight:
                old_sum = self._values[sum_variable]
                self._values[sum_variable] = (
                    old_sum[0] + weight * change[0],
                    old_sum[1] + weight * change[1],
                )
                for variable, value in entering_row.items():
                    new_factor = sum_row.get(variable, 0) + weight * value
                    # with floats, factors that cancel leave tiny remainders
                    if new_factor > self._tolerance or new_factor < -self._tolerance:
                        sum_row[variable] = new_factor
                    else:
                        sum_row.pop(variable, None)
        self._rows[entering] = entering_row
