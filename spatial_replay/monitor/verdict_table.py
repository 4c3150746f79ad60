"""Evaluations in notebooks: verdicts, and trees with the numbers at the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Final

from spatial_replay.markup import Html, element, folded, quiet, table, verdict_mark
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec.picture import tree_cell
from spatial_replay.spec.tree import iter_branches
from spatial_replay.wording import counted

if TYPE_CHECKING:
    from spatial_replay.monitor.evaluation import Evaluation, SpecResult

_MOST_RESULTS: Final = 50
_MOST_NODES: Final = 300
"""Nodes in the trees of all results together."""


def evaluation_html(evaluation: Evaluation) -> Html:
    """The verdict, a table of results, and the tree of each with its numbers at the end."""
    name = element("b", evaluation.specification.filename)
    title = element("div", name, " ", verdict_mark(evaluation.verdict))
    shown = worst_of(evaluation.results, _MOST_RESULTS)
    left_out = len(evaluation.results) - len(shown)
    more = quiet(f"… and {counted(left_out, 'result')} more, none of them worse") if left_out else Html("")
    return element("div", title, _results_table(shown), more, *_trees(shown))


def result_html(result: SpecResult) -> Html:
    """A result as a table, and its tree with the numbers at the end."""
    return element("div", _results_table([result]), *_trees([result]))


def title_of(result: SpecResult) -> str:
    """What a result is called: the name, and the object that it is about."""
    return result.name if result.object is None else f"{result.name} for {result.object}"


def robustness_text(value: float, lower: float, upper: float) -> str:
    """A robustness that is known, or the interval that it lies in."""
    return f"{value:.4g}" if value == value else f"{lower:.4g} to {upper:.4g}"


def _results_table(results: Sequence[SpecResult]) -> Html:
    rows = [
        (
            element("b", title_of(each)),
            verdict_mark(each.verdict),
            robustness_text(each.robustness, each.lower, each.upper),
            _first_satisfied(each),
        )
        for each in results
    ]
    return table(["result", "verdict", "robustness", "first satisfied"], rows)


def _first_satisfied(result: SpecResult) -> str:
    at_ns = result.first_satisfied_ns
    return "never" if at_ns is None else f"{(at_ns - int(result.times_ns[0])) / 1e9:.3f} s"


def _trees(results: Sequence[SpecResult]) -> Iterator[Html]:
    """The tree of each result, as far as there is room."""
    left = _MOST_NODES
    for result in results:
        if left <= 0:
            return
        rows = list(islice(_tree_rows(result), left))
        left -= len(rows)
        left_out = len(result.final) - len(rows)
        more = quiet(f"… and {counted(left_out, 'node')} more") if left_out else Html("")
        nodes = table(["verdict", "robustness", "node"], rows)
        yield folded(f"tree of {title_of(result)}, each node at the first sample", nodes, more)


def _tree_rows(result: SpecResult) -> Iterator[tuple[str, str, str]]:
    for identifier, stem, node in iter_branches(result.formula):
        lower, upper = result.final[identifier].tolist()
        value = float(result.series[identifier, 0, -1])
        verdict = verdict_mark(final_verdict(lower, upper))
        yield verdict, robustness_text(value, lower, upper), tree_cell(stem, node)


def worst_of(results: Sequence[SpecResult], most: int) -> Sequence[SpecResult]:
    """The results, or so many of the worst where there are more."""
    if len(results) <= most:
        return results
    severity = {Verdict.VIOLATED: 0, Verdict.UNKNOWN: 1}
    return sorted(results, key=lambda result: severity.get(result.verdict, 2))[:most]
