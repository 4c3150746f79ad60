"""Changes of verdicts and signs from sample to sample, each with its reason in a sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.annotate.event_sentences import change_sentence
from spatial_replay.annotate.verdict_changes import FAILING, HOLDING, SATISFIED, VIOLATED, NodeStates, track
from spatial_replay.monitor.monitor import SpecUpdate, Update
from spatial_replay.spec.formula import Specification
from spatial_replay.text import requirement_text

_WORDS: Final = {HOLDING: "holds", FAILING: "pending", SATISFIED: "satisfied", VIOLATED: "violated"}


class VerdictChange(NamedTuple):
    """The verdict of a spec, or the sign of its value while it is pending, is another than before.

    A verdict counts at once; a sign once it lasts three samples, as in the events of a log.

    Attributes:
        time_ns: of the sample that confirms it.
        spec: its name.
        state: "satisfied" and "violated" whatever comes; "holds" and "pending" so far.
        sentence: what changed and why.
        is_first: whether nothing was known before.
    """

    time_ns: int
    spec: str
    state: str
    sentence: str
    is_first: bool


class VerdictChanges:
    """The states of the results of some specifications, from sample to sample."""

    def __init__(self, files: Sequence[Specification]) -> None:
        """Start before the first sample."""
        self._states = [[NodeStates.begin(1) for _ in file.results] for file in files]
        self._root = np.zeros(1, np.int64)

    def after(self, updates: Sequence[Update]) -> Iterator[VerdictChange]:
        """Yield what changed with a sample, from the update of each file."""
        for states, update in zip(self._states, updates, strict=True):
            for place, spec in enumerate(update.specs):
                if spec.numbers is None or states[place].are_final:
                    continue
                times_ns = np.array([update.time_ns], np.int64)
                before = states[place]
                tracked = track(before, times_ns, spec.numbers[:1, :, None].copy(), self._root)
                states[place] = tracked.states
                is_first = not before.integers[0, 0] and tracked.states.integers[0, 0]
                if tracked.changes or is_first:
                    yield self._change(tracked.states, spec, update, is_first=bool(is_first))

    def _change(
        self, states: NodeStates, spec: SpecUpdate, update: Update, *, is_first: bool
    ) -> VerdictChange:
        period = states.period(0)
        name = spec.spec.name
        about = requirement_text(spec.spec.id, spec.spec.title)
        title = f"`{name}` ({about})" if about else f"`{name}`"
        reasons = [each.reason for each in update.satisfied if each.spec is spec.spec]
        sentence = change_sentence(
            title, period, reasons[0] if period.code == SATISFIED and reasons else "", spec.unit
        )
        if period.code == VIOLATED:
            own = {node for node in spec.names if node is not None} | {name}
            reasons = [str(each) for each in update.violations if each.spec in own]
            sentence = f"{title} is violated, whatever comes: {'; '.join(reasons)}." if reasons else sentence
        return VerdictChange(update.time_ns, name, _WORDS[period.code], sentence, is_first)
