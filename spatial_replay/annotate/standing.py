"""The standing of all results in one message of /spatial/standing.

One message has the numbers of every result, so viewers need no other topic for them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.annotate.automaton_state import AutomatonRun
from spatial_replay.annotate.robustness import Codes, curved_nodes, standing_codes
from spatial_replay.annotate.scene.scene_frames import STANDING_WORDS
from spatial_replay.annotate.scene.scene_update import samples_to_write
from spatial_replay.annotate.specification import ReportedTree, unit_of
from spatial_replay.geometry.arrays import Floats, Integers, combined_code, equal_places
from spatial_replay.logs.schemas.Robustness_pb2 import SATISFIED, UNKNOWN, VIOLATED, StandingUpdate
from spatial_replay.logs.wire import WireTemplate, join_in_order, round_numbers, words_of
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.formula import Formula, iter_nodes
from spatial_replay.spec.walks import looks_ahead
from spatial_replay.text import Instant
from spatial_replay.trace.trace import LATEST_NS

_MOST_TEMPLATES: Final = 1024

_RANKS: Final = np.full(256, 2, np.uint8)
for _rank, _code in enumerate(STANDING_WORDS):
    _RANKS[_code] = _rank
_RANKS.flags.writeable = False
"""Rank of each value of `Standing`; 0 is the worst."""


def worst_results(codes: Codes, violated_ns: Integers) -> Integers:
    """Return (S,), the index of the worst of R results in each of S samples.

    Among violated results, the result with the earliest certain violation is the worst. Robustness is not
    compared, because units may differ.

    Args:
        codes: (R, S), values of `Standing`.
        violated_ns: (R, S), start of each result's violation, or `LATEST_NS`.
    """
    ranks = _RANKS[codes]
    since_ns = np.where(codes == VIOLATED, violated_ns, LATEST_NS)
    # minus 1 puts results of the worst rank before the other results, which get `LATEST_NS`
    priorities = np.where(ranks == ranks.min(axis=0), since_ns - 1, LATEST_NS)
    return np.asarray(priorities.argmin(axis=0), np.int64)


class _Entry(NamedTuple):
    """An entry of `results` in every message: a result, or a named spec within a result.

    Attributes:
        title, unit: title and unit in messages.
        tree: index of the result.
        node: id of the node in the result's tree.
        number: index of the number to show: 0 for the value, 1 for `now` of a named spec without look-ahead.
    """

    title: str
    unit: str
    tree: int
    node: int = 0
    number: int = 0


class _Layout(NamedTuple):
    """The part of a message that a template fixes: texts, and the lengths of lists.

    Attributes:
        worst: index of the worst result.
        words: states of automata in words.
        violated: indices of the violated results, with their deciding atoms.
        final: whether the log is finished.
    """

    worst: int
    words: tuple[str, ...]
    violated: tuple[tuple[int, str], ...]
    final: bool


class FinalStanding(NamedTuple):
    """Outcome of a result over the finished log.

    Attributes:
        standing: value of `Standing` for satisfied, violated or unknown.
        by: magnitude of the interval's deciding end; NaN if unknown.
        at: time at which the upper end of the robustness interval reached its minimum.
        unit: unit of the robustness.
    """

    standing: int
    by: float
    at: Instant
    unit: str


class StandingEncoder:
    """Encodes the standing of results, sample by sample.

    Between blocks the encoder stores the last numbers of each result. Messages do not depend on the cut into
    blocks.

    Attributes:
        outcomes: outcome of each result; empty before `end`.
        order: indices of the results, the worst first, with earlier violations first; empty before `end`.
        zero_ns: zero of the seconds; None before the first sample.
    """

    def __init__(
        self, trees: Sequence[ReportedTree], runs: Sequence[AutomatonRun | None], units: Mapping[str, str]
    ) -> None:
        """Start before the first sample.

        Args:
            runs: run of each tree's automaton, extended by the caller; None without an automaton.
            units: declared units, see `unit_of`.
        """
        self._trees, self._runs = trees, runs
        self._units = [unit_of(tree.formula, units) for tree in trees]
        self._entries = [
            _Entry(tree.title, unit, index)
            for index, (tree, unit) in enumerate(zip(trees, self._units, strict=True))
        ]
        for index, tree in enumerate(trees):
            for node, formula in curved_nodes(tree.formula).items():
                title, unit = part_title(formula, tree), unit_of(formula, units)
                if node:
                    self._entries.append(_Entry(title, unit, index, node, 0 if looks_ahead(formula) else 1))
        self._last_series = [np.full((len(list(iter_nodes(tree.formula))), 4, 1), np.nan) for tree in trees]
        self._automaton_words = [""] * len(trees)
        self._violated_since_ns = [LATEST_NS] * len(trees)
        self._least_ends, self._least_ns = [math.inf] * len(trees), [0] * len(trees)
        self.zero_ns: int | None = None
        self._written_ns: int | None = None
        self._cached_template = lru_cache(_MOST_TEMPLATES)(self._made_template)
        self.outcomes: tuple[FinalStanding, ...] = ()
        self.order: Sequence[int] = ()

    def encode(
        self, times_ns: Integers, blocks: Sequence[SeriesBlock], over: Sequence[str]
    ) -> tuple[Integers, Sequence[bytes]]:
        """Add the next samples, and return the times and contents of their messages.

        Args:
            times_ns: (T,), times of all samples.
            blocks: block of each tree; an instance for an object may have fewer samples.
            over: deciding atom of each tree after the last of these samples; "" without a verdict.
        """
        shown_ns = times_ns[samples_to_write(times_ns, self._written_ns)]
        if len(shown_ns):
            self._written_ns = int(shown_ns[-1])
        return shown_ns, self._encode_at(shown_ns, blocks, over)

    def encode_changes(
        self, blocks: Sequence[SeriesBlock], over: Sequence[str], most: int
    ) -> tuple[Integers, Sequence[bytes]]:
        """Add the next samples, and return the times and contents of one message per change.

        A change is the first of the samples, or a sample in which the standing of an entry differs from the
        previous sample. Only the last `most` changes have messages.

        Args:
            over: deciding atoms, as for `encode`.
            most: limit of changes.
        """
        changes_ns = [np.empty(0, np.int64)]
        for tree_index, block in enumerate(blocks):
            nodes = [entry.node for entry in self._entries if entry.tree == tree_index]
            codes = standing_codes(block.series[nodes])
            is_change = np.ones(len(block.times_ns), np.bool_)
            is_change[1:] = (codes[:, 1:] != codes[:, :-1]).any(axis=0)
            changes_ns.append(block.times_ns[is_change])
        shown_ns = np.unique(np.concatenate(changes_ns))[-most:]
        return shown_ns, self._encode_at(shown_ns, blocks, over)

    def _encode_at(
        self, shown_ns: Integers, blocks: Sequence[SeriesBlock], over: Sequence[str]
    ) -> Sequence[bytes]:
        """Add the next samples, and return the messages at `shown_ns`."""
        series, automaton_words, since_ns, least_ns = [], [], [], []
        for tree_index, block in enumerate(blocks):
            sample_counts = np.searchsorted(block.times_ns, shown_ns, side="right")
            series.append(self._numbers(tree_index, block, sample_counts))
            automaton_words.append(self._descriptions(tree_index, block, sample_counts))
            since_ns.append(
                np.append(self._violated_since_ns[tree_index], self._violated_since(tree_index, block))[
                    sample_counts
                ]
            )
            least_ns.append(
                np.append(self._least_ns[tree_index], self._became_least(tree_index, block))[sample_counts]
            )
        self.pass_over(blocks)
        if not len(shown_ns):
            return []
        return self._messages(shown_ns, series, automaton_words, np.array([since_ns, least_ns]), over)

    def _numbers(self, tree_index: int, block: SeriesBlock, sample_counts: Integers) -> Floats:
        """Return (N, 4, S), a result's numbers after the first `sample_counts` (S,) samples of a block.

        A count of 0 gives the numbers of the last sample before the block.
        """
        if not len(block.times_ns):
            return np.repeat(self._last_series[tree_index], len(sample_counts), axis=2)
        numbers = block.series[:, :, np.maximum(sample_counts - 1, 0)]
        numbers[:, :, sample_counts == 0] = self._last_series[tree_index]
        return numbers

    def pass_over(self, blocks: Sequence[SeriesBlock]) -> None:
        """Add the next samples without writing messages."""
        for tree_index, block in enumerate(blocks):
            if not len(block.times_ns):
                continue
            self._violated_since_ns[tree_index] = int(self._violated_since(tree_index, block)[-1])
            self._least_ns[tree_index] = int(self._became_least(tree_index, block)[-1])
            self._least_ends[tree_index] = float(
                np.fmin.reduce(block.series[0, 3], initial=self._least_ends[tree_index])
            )
            self._last_series[tree_index] = block.series[:, :, -1:].copy()
            run = self._runs[tree_index]
            if run is not None:
                self._automaton_words[tree_index] = run.latest_words

    def _violated_since(self, tree_index: int, block: SeriesBlock) -> Integers:
        """Return (T,), the start of the violation at each sample of a block; `LATEST_NS` if not violated."""
        is_violated = block.series[0, 3] < 0.0
        is_begin = is_violated & ~np.append(self._violated_since_ns[tree_index] < LATEST_NS, is_violated)[:-1]
        last_begins = np.maximum.accumulate(np.where(is_begin, np.arange(len(is_begin)), -1))
        since_ns = np.where(last_begins < 0, self._violated_since_ns[tree_index], block.times_ns[last_begins])
        return np.where(is_violated, since_ns, LATEST_NS)

    def _became_least(self, tree_index: int, block: SeriesBlock) -> Integers:
        """Return (T,), at each sample of a block, the time at which a result's upper end was least so far."""
        upper = np.append(self._least_ends[tree_index], block.series[0, 3])
        is_less = upper[1:] < np.fmin.accumulate(upper)[:-1]
        return np.maximum.accumulate(np.where(is_less, block.times_ns, self._least_ns[tree_index]))

    def end(self, time_ns: int, finals: Sequence[Floats], over: Sequence[str]) -> bytes:
        """Return the message about the finished log.

        Args:
            time_ns: time of the last sample.
            finals: for each tree, (N, 2), lower and upper end of each node's value over the finished log.
            over: deciding atom of each tree, or "".
        """
        zero_ns = time_ns if self.zero_ns is None else self.zero_ns
        since_ns = self._violated_since_ns
        for tree_index, final in enumerate(finals):
            if final[0, 1] < self._least_ends[tree_index]:
                self._least_ns[tree_index] = time_ns
        outcomes, series = [], []
        for last, final in zip(self._last_series, finals, strict=True):
            final_series = last.copy()
            final_series[:, 2:, 0] = final
            series.append(final_series)
        for unit, final_series, least_ns in zip(self._units, series, self._least_ns, strict=True):
            code = int(standing_codes(final_series[:1], final=True)[0, 0])
            low, high = final_series[0, 2:, 0].tolist()
            magnitude = -high if code == VIOLATED else low if code == SATISFIED else math.nan
            outcomes.append(FinalStanding(code, magnitude, Instant(min(least_ns, time_ns), zero_ns), unit))
        self.outcomes, codes = tuple(outcomes), [outcome.standing for outcome in outcomes]
        order_ns = [at_ns if code == VIOLATED else 0 for code, at_ns in zip(codes, since_ns, strict=True)]
        self.order = np.lexsort((np.array(order_ns), _RANKS[codes])).tolist()
        words, times_ns = (
            [([text], np.zeros(1, np.int64)) for text in self._automaton_words],
            np.array([time_ns]),
        )
        instants_ns = np.array([since_ns, self._least_ns])[:, :, None]
        [payload] = self._messages(times_ns, series, words, instants_ns, over, final=True)
        return payload

    def _descriptions(
        self, tree_index: int, block: SeriesBlock, sample_counts: Integers
    ) -> tuple[list[str], Integers]:
        """Return an automaton's states in words, and (S,), the index of the words after `sample_counts`."""
        run = self._runs[tree_index]
        if run is None or not len(block.times_ns):
            return [self._automaton_words[tree_index]], np.zeros(len(sample_counts), np.int64)
        texts, text_indices = run.words()
        return [self._automaton_words[tree_index], *texts], np.append(0, text_indices + 1)[sample_counts]

    def _messages(
        self,
        times_ns: Integers,
        series: Sequence[Floats],
        words: Sequence[tuple[list[str], Integers]],
        instants_ns: Integers,
        over: Sequence[str],
        *,
        final: bool = False,
    ) -> Sequence[bytes]:
        """Encode messages.

        Args:
            instants_ns: (2, R, S), start of each result's violation, and time of each result's least upper
                end.
        """
        since_ns = instants_ns[0]
        codes_by_tree = [standing_codes(node_series, final=final) for node_series in series]
        result_codes = np.array([node_codes[0] for node_codes in codes_by_tree])
        worst = worst_results(result_codes, since_ns)
        # the earliest violation first
        violation_order = np.argsort(
            np.where(result_codes == VIOLATED, np.minimum(since_ns, LATEST_NS - 1), LATEST_NS),
            axis=0,
            kind="stable",
        )
        violated_counts = (result_codes == VIOLATED).sum(axis=0)
        mark_columns = [codes_by_tree[entry.tree][entry.node, :, None] for entry in self._entries]
        robustness_columns = [
            _finite(series[entry.tree][entry.node, entry.number, :, None]) for entry in self._entries
        ]
        indices_and_payloads, columns_by_tree = [], dict[int, tuple[Floats, Floats, Floats]]()
        is_listed = np.arange(len(violation_order))[:, None] < violated_counts
        layout_keys = [
            worst,
            *(text_indices for _, text_indices in words),
            *np.where(is_listed, violation_order, -1),
        ]
        for sample_indices in equal_places(combined_code(layout_keys, len(times_ns))):
            first_sample = int(sample_indices[0])
            violated_entries = tuple(
                (tree_index, over[tree_index])
                for tree_index in violation_order[: violated_counts[first_sample], first_sample].tolist()
            )
            automaton_words = tuple(texts[text_indices[first_sample]] for texts, text_indices in words)
            layout = _Layout(int(worst[first_sample]), automaton_words, violated_entries, final)
            columns = [column[sample_indices] for column in (times_ns[:, None], *robustness_columns)]
            stamps = np.divmod(times_ns[sample_indices, None], 10**9)
            for tree_index, _ in layout.violated:
                if tree_index not in columns_by_tree:
                    seconds = (np.minimum(instants_ns[:, tree_index], times_ns) - (self.zero_ns or 0)) / 1e9
                    since_s, least_s = np.round(seconds, 3)[:, :, None]
                    columns_by_tree[tree_index] = (
                        since_s,
                        round_numbers(_finite(-series[tree_index][0, 3, :, None])),
                        least_s,
                    )
                columns += [column[sample_indices] for column in columns_by_tree[tree_index]]
            sample_marks = np.concatenate([mark[sample_indices] for mark in mark_columns], axis=1)
            columns += [robustness_columns.astype(np.float64) for robustness_columns in stamps]
            indices_and_payloads.append(
                (sample_indices, self._cached_template(layout).encode(words_of(columns), sample_marks))
            )
        return join_in_order(indices_and_payloads)

    def _made_template(self, layout: _Layout) -> WireTemplate:
        """Return a template with a value in every field that differs between samples."""
        # each number that is set here becomes a slot; its value does not matter
        worst, words, violated, final = layout
        message = StandingUpdate(time_ns=1, worst=self._trees[worst].title, final=final)
        for entry_index, (title, unit, *_) in enumerate(self._entries):
            entry_words = words[entry_index] if entry_index < len(words) else ""
            message.results.add(
                name=title, standing=UNKNOWN, robustness=1.0, unit=unit, automaton=entry_words
            )
        for index, over in violated:
            name, unit = self._trees[index].title, self._units[index]
            message.violated.add(name=name, since=1.0, by=1.0, unit=unit, over=over, at=1.0)
        # viewers draw no table without rows
        if not violated:
            message.violated.add(name="nothing is violated")
        message.header.stamp.sec = message.header.stamp.nsec = 1.0
        return WireTemplate.of(message)


def _finite(numbers: Floats) -> Floats:
    """Replace infinite numbers by NaN, because curves and tables cannot show infinity."""
    return np.where(np.isinf(numbers), np.nan, numbers)


def part_title(part: Formula, tree: ReportedTree) -> str:
    """Return the title of a named spec within a result."""
    return f"{part.name} in {tree.title}"
