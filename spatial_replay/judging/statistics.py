"""Statistics of rates and pairs of episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import importing

if TYPE_CHECKING:
    from spatial_replay.geometry.arrays import Integers

SIGNIFICANCE: Final = 0.05
"""Largest p-value of a decision between two sets of episodes."""
EVIDENCE: Final = 1.0 / SIGNIFICANCE
"""Least e-value of a decision."""
_POWER: Final = 0.8
"""Required probability of a decision with the estimated number of pairs."""
_MOST_PAIRS: Final = 100_000


class Interval(NamedTuple):
    """Bounds of a rate, from 0 to 1."""

    low: float
    high: float


class Rate(NamedTuple):
    """A success rate: numbers of successes and of episodes."""

    successes: int
    episodes: int

    @property
    def value(self) -> float | None:
        """The rate; None without episodes."""
        return self.successes / self.episodes if self.episodes else None

    @property
    def interval(self) -> Interval | None:
        """Wilson's score interval, 95 %; None without episodes."""
        if not self.episodes:
            return None
        interval = _scipy().binomtest(*self).proportion_ci(0.95, method="wilson")
        return Interval(float(interval.low), float(interval.high))


def mcnemar_p(won: int, lost: int) -> float:
    """Return the p-value of McNemar's exact test.

    Args:
        won, lost: numbers of pairs in which only the one side, or only the other side, succeeds.
    """
    return float(_scipy().binomtest(won, won + lost).pvalue) if won + lost else 1.0


def e_value(won: int, lost: int) -> float:
    """Return the e-value for one side winning more often. It may be checked after every episode.

    The e-value is a ratio of likelihoods: a uniformly distributed chance of winning against a chance of 1/2.
    """
    _scipy()
    from scipy.special import betaln

    # computed with logarithms, because the power of 2 overflows from 1,024 pairs on
    return math.exp((won + lost) * math.log(2.0) + float(betaln(won + 1, lost + 1)))


def more_pairs(won: int, lost: int, pairs: int) -> int | None:
    """Return the number of further pairs for a significant difference with a probability of 80 %.

    The shares of won and lost pairs are assumed constant. None if neither side is ahead, or if more than
    100,000 pairs are needed.
    """
    if won == lost:
        return None
    high = max(pairs, 1)
    while _power(high, won, lost, pairs) < _POWER:
        high *= 2
        if high > _MOST_PAIRS:
            return None
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _power(middle, won, lost, pairs) >= _POWER else (middle, high)
    # the test is discrete, so its power is not monotone in the number of pairs
    while high > 1 and _power(high - 1, won, lost, pairs) >= _POWER:
        high -= 1
    return max(high - pairs, 0)


def _power(pair_count: int, won: int, lost: int, observed_pairs: int) -> float:
    """Return the probability of a decision by the exact test of `pair_count` pairs."""
    binom = _scipy().binom
    differing_pairs = np.arange(pair_count + 1)
    weights = binom.pmf(differing_pairs, pair_count, (won + lost) / observed_pairs)
    # numbers of pairs far from the mean have weights too small to change the sum
    differing_pairs, weights = differing_pairs[weights > 1e-17], weights[weights > 1e-17]
    limits = _critical(differing_pairs)
    win_share = won / (won + lost)
    chances = binom.cdf(limits, differing_pairs, win_share) + binom.sf(
        differing_pairs - limits - 1, differing_pairs, win_share
    )
    return float(np.sum(weights * np.where(limits < 0, 0.0, chances)))


def _critical(differing_pairs: Integers) -> Integers:
    """Return the losing side's greatest number of wins in a decided test; -1 if no number decides.

    Args:
        differing_pairs: (N,) numbers of pairs in which only one side succeeds.
    """
    binom = _scipy().binom
    # `ppf` is the least number whose cdf reaches the level, and may be too large by 1
    limits = binom.ppf(SIGNIFICANCE / 2.0, differing_pairs, 0.5)
    is_above = binom.cdf(limits, differing_pairs, 0.5) > SIGNIFICANCE / 2.0
    return np.asarray(np.where(is_above, limits - 1, limits), int)


class SignedRank(NamedTuple):
    """Wilcoxon's test: the statistic and its p-value."""

    statistic: float
    p: float


def wilcoxon(new: Sequence[float], old: Sequence[float]) -> SignedRank | None:
    """Return Wilcoxon's signed-rank test of paired margins; None if no pair differs."""
    if list(new) == list(old):
        return None
    test: Any = _scipy().wilcoxon(new, old)
    return SignedRank(float(test.statistic), float(test.pvalue))


def pass_hat_k(successes: int, runs: int, k: int) -> float:
    """Return the estimated probability that `k` runs with the same start all succeed."""
    return math.comb(successes, k) / math.comb(runs, k)


@cache
def _scipy() -> Any:
    with importing("intervals and tests need SciPy", extra="tune"):
        from scipy import stats
    return stats
