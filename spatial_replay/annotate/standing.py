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
"""Rank of each number of `Standing`; 0 is the worst."""


def worst_results(codes: Codes, violated_ns: Integers) -> Integers:
    """Return (S,), the index of the worst of R results in each of S samples.

    Among violated results, the one with the earliest certain violation is the worst. Robustness is not
    compared, because units may differ.

    Args:
        codes: (R, S), numbers of `Standing`.
        violated_ns: (R, S), time since which each result is violated, or `LATEST_NS`.
    """
    ranks = _RANKS[codes]
    since_ns = np.where(codes == VIOLATED, violated_ns, LATEST_NS)
    # minus 1 puts the worst rank before other ranks, also without a violation
    order = np.where(ranks == ranks.min(axis=0), since_ns - 1, LATEST_NS)
    return np.asarray(order.argmin(axis=0), np.int64)


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
        standing: number of `Standing`: satisfied, violated or unknown.
        by: magnitude of the deciding end of its interval; NaN if unknown.
        at: time of the least upper end of its interval.
        unit: unit of the robustness.
    """

    standing: int
    by: float
    at: Instant
    unit: str


class StandingEncoder:
    """Encodes the standing of results, sample by sample.

    Between blocks it stores the last numbers of each result. Messages do not depend on the cut into blocks.

    Attributes:
        outcomes: outcome of each result after `end`; before it empty.
        order: indices of results after `end`, the worst first; earlier violations come first.
        zero_ns: zero of the seconds; None before it is known.
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
        self._last = [np.full((len(list(iter_nodes(tree.formula))), 4, 1), np.nan) for tree in trees]
        self._words = [""] * len(trees)
        self._violated_ns = [LATEST_NS] * len(trees)
        self._least, self._least_ns = [math.inf] * len(trees), [0] * len(trees)
        self.zero_ns: int | None = None
        self._written_ns: int | None = None
        self._template = lru_cache(_MOST_TEMPLATES)(self._made_template)
        self.outcomes: tuple[FinalStanding, ...] = ()
        self.order: Sequence[int] = ()

    def encode(
        self, times_ns: Integers, blocks: Sequence[SeriesBlock], over: Sequence[str]
    ) -> tuple[Integers, Sequence[bytes]]:
        """Add the next samples, and return the times and contents of their messages.

        Args:
            times_ns: (T,), times of all samples.
            blocks: block of each tree; an instance for an object may have fewer samples.
            over: deciding atom of each tree up to the last of these samples; "" without a verdict.
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
        for index, block in enumerate(blocks):
            nodes = [entry.node for entry in self._entries if entry.tree == index]
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
        series, words, since, least = [], [], [], []
        for index, block in enumerate(blocks):
            at = np.searchsorted(block.times_ns, shown_ns, side="right")
            series.append(self._numbers(index, block, at))
            words.append(self._descriptions(index, block, at))
            since.append(np.append(self._violated_ns[index], self._violated_since(index, block))[at])
            least.append(np.append(self._least_ns[index], self._became_least(index, block))[at])
        self.pass_over(blocks)
        if not len(shown_ns):
            return []
        return self._messages(shown_ns, series, words, np.array([since, least]), over)

    def _numbers(self, index: int, block: SeriesBlock, at: Integers) -> Floats:
        """Return (N, 4, S), the numbers of a result after `at` samples of a block.

        At 0 they are the numbers of the last sample before the block.
        """
        if not len(block.times_ns):
            return np.repeat(self._last[index], len(at), axis=2)
        numbers = block.series[:, :, np.maximum(at - 1, 0)]
        numbers[:, :, at == 0] = self._last[index]
        return numbers

    def pass_over(self, blocks: Sequence[SeriesBlock]) -> None:
        """Add the next samples, and write no messages for them."""
        for index, block in enumerate(blocks):
            if not len(block.times_ns):
                continue
            self._violated_ns[index] = int(self._violated_since(index, block)[-1])
            self._least_ns[index] = int(self._became_least(index, block)[-1])
            self._least[index] = float(np.fmin.reduce(block.series[0, 3], initial=self._least[index]))
            self._last[index] = block.series[:, :, -1:].copy()
            run = self._runs[index]
            if run is not None:
                self._words[index] = run.latest_words

    def _violated_since(self, index: int, block: SeriesBlock) -> Integers:
        """Return (T,), the start of the violation at each sample of a block; `LATEST_NS` without one."""
        is_violated = block.series[0, 3] < 0.0
        begins = is_violated & ~np.append(self._violated_ns[index] < LATEST_NS, is_violated)[:-1]
        begun = np.maximum.accumulate(np.where(begins, np.arange(len(begins)), -1))
        since_ns = np.where(begun < 0, self._violated_ns[index], block.times_ns[begun])
        return np.where(is_violated, since_ns, LATEST_NS)

    def _became_least(self, index: int, block: SeriesBlock) -> Integers:
        """Return (T,), the time of the least upper end of a result so far, at each sample of a block."""
        upper = np.append(self._least[index], block.series[0, 3])
        is_less = upper[1:] < np.fmin.accumulate(upper)[:-1]
        return np.maximum.accumulate(np.where(is_less, block.times_ns, self._least_ns[index]))

    def end(self, time_ns: int, finals: Sequence[Floats], over: Sequence[str]) -> bytes:
        """Return the message about the finished log.

        Args:
            time_ns: time of the last sample.
            finals: for each tree, (N, 2), lower and upper end of each node's value over the finished log.
            over: deciding atom of each tree, or "".
        """
        zero_ns = time_ns if self.zero_ns is None else self.zero_ns
        since_ns = self._violated_ns
        for place, final in enumerate(finals):
            if final[0, 1] < self._least[place]:
                self._least_ns[place] = time_ns
        outcomes, series = [], []
        for last, final in zip(self._last, finals, strict=True):
            ended = last.copy()
            ended[:, 2:, 0] = final
            series.append(ended)
        for unit, ended, least_ns in zip(self._units, series, self._least_ns, strict=True):
            code = int(standing_codes(ended[:1], final=True)[0, 0])
            low, high = ended[0, 2:, 0].tolist()
            by = -high if code == VIOLATED else low if code == SATISFIED else math.nan
            outcomes.append(FinalStanding(code, by, Instant(min(least_ns, time_ns), zero_ns), unit))
        self.outcomes, codes = tuple(outcomes), [outcome.standing for outcome in outcomes]
        since = [at_ns if code == VIOLATED else 0 for code, at_ns in zip(codes, since_ns, strict=True)]
        self.order = np.lexsort((np.array(since), _RANKS[codes])).tolist()
        words, times_ns = [([text], np.zeros(1, np.int64)) for text in self._words], np.array([time_ns])
        instants = np.array([since_ns, self._least_ns])[:, :, None]
        [payload] = self._messages(times_ns, series, words, instants, over, final=True)
        return payload

    def _descriptions(self, index: int, block: SeriesBlock, at: Integers) -> tuple[list[str], Integers]:
        """Return the states of an automaton in words, and (S,) the index of the words after `at` samples."""
        run = self._runs[index]
        if run is None or not len(block.times_ns):
            return [self._words[index]], np.zeros(len(at), np.int64)
        texts, which = run.words()
        return [self._words[index], *texts], np.append(0, which + 1)[at]

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
            instants_ns: (2, R, S), time since which each result is violated, and time of its least upper end.
        """
        since_ns = instants_ns[0]
        codes = [standing_codes(node_series, final=final) for node_series in series]
        of_results = np.array([node_codes[0] for node_codes in codes])
        worst = worst_results(of_results, since_ns)
        # the earliest violation first
        order = np.argsort(
            np.where(of_results == VIOLATED, np.minimum(since_ns, LATEST_NS - 1), LATEST_NS),
            axis=0,
            kind="stable",
        )
        counts = (of_results == VIOLATED).sum(axis=0)
        marks = [codes[entry.tree][entry.node, :, None] for entry in self._entries]
        numbers = [_finite(series[entry.tree][entry.node, entry.number, :, None]) for entry in self._entries]
        encoded, of_violated = [], dict[int, tuple[Floats, Floats, Floats]]()
        is_listed = np.arange(len(order))[:, None] < counts
        keys = [worst, *(which for _, which in words), *np.where(is_listed, order, -1)]
        for members in equal_places(combined_code(keys, len(times_ns))):
            first = int(members[0])
            violated = tuple((place, over[place]) for place in order[: counts[first], first].tolist())
            said = tuple(texts[which[first]] for texts, which in words)
            layout = _Layout(int(worst[first]), said, violated, final)
            columns = [column[members] for column in (times_ns[:, None], *numbers)]
            stamps = np.divmod(times_ns[members, None], 10**9)
            for place, _ in layout.violated:
                if place not in of_violated:
                    seconds = (np.minimum(instants_ns[:, place], times_ns) - (self.zero_ns or 0)) / 1e9
                    since, at = np.round(seconds, 3)[:, :, None]
                    of_violated[place] = since, round_numbers(_finite(-series[place][0, 3, :, None])), at
                columns += [column[members] for column in of_violated[place]]
            own_marks = np.concatenate([mark[members] for mark in marks], axis=1)
            columns += [numbers.astype(np.float64) for numbers in stamps]
            encoded.append((members, self._template(layout).encode(words_of(columns), own_marks)))
        return join_in_order(encoded)

    def _made_template(self, layout: _Layout) -> WireTemplate:
        """Return a template with a value in every field that differs between samples."""
        # each number that is set becomes a slot, whatever its value
        worst, words, violated, final = layout
        message = StandingUpdate(time_ns=1, worst=self._trees[worst].title, final=final)
        for number, (title, unit, *_) in enumerate(self._entries):
            said = words[number] if number < len(words) else ""
            message.results.add(name=title, standing=UNKNOWN, robustness=1.0, unit=unit, automaton=said)
        for index, over in violated:
            name, unit = self._trees[index].title, self._units[index]
            message.violated.add(name=name, since=1.0, by=1.0, unit=unit, over=over, at=1.0)
        # viewers draw no table without rows
        if not violated:
            message.violated.add(name="nothing is violated")
        message.header.stamp.sec = message.header.stamp.nsec = 1.0
        return WireTemplate.of(message)


def _finite(numbers: Floats) -> Floats:
    """Return numbers with NaN instead of infinite ones, which curves and tables cannot show."""
    return np.where(np.isinf(numbers), np.nan, numbers)


def part_title(part: Formula, tree: ReportedTree) -> str:
    """Return the title of a named spec within a result."""
    return f"{part.name} in {tree.title}"
