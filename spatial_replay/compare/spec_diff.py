"""One spec before and after an edit: what changed, since when, and which edit did it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.compare.declarations import DeclarationChange, TextPlace
from spatial_replay.compare.edit_cause import EditOutcome
from spatial_replay.compare.edits import Edit, TreeDiff
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import reason_sentence
from spatial_replay.text import Instant, Sentence, counted, json_number, with_unit


class FirstDifference(NamedTuple):
    """The first sample with another value of a result, and both values (NaN: not determined)."""

    time_ns: int
    old: float
    new: float


@dataclass(frozen=True, eq=False)
class SpecDiff(Displayed):
    """One spec before and after the edit, or one object's instance of a template.

    Attributes:
        name: in the new file; `old_name` in the old one.
        old, new: its results over the log.
        tree: the edits between the two formulas, and what the old one becomes with some of them.
        cause: the edits that changed the verdict or, if that stayed, the robustness; none if both stayed.
            Making only these gives the new outcome, making all others the old one.
        alone: for each edit of the cause, the outcome with that edit only; None if it cannot be made alone.
        old_places, new_places: the declarations or lines that were edited in the two texts, by edit.
    """

    name: str
    old_name: str
    old: SpecResult
    new: SpecResult
    tree: TreeDiff
    cause: tuple[Edit, ...]
    alone: tuple[EditOutcome | None, ...]
    old_places: Mapping[Edit, TextPlace]
    new_places: Mapping[Edit, TextPlace]

    @property
    def edits(self) -> tuple[Edit, ...]:
        """The edits between the two formulas, named specs within them included."""
        return self.tree.edits

    @property
    def is_flipped(self) -> bool:
        """Whether the verdict changed."""
        return self.old.verdict is not self.new.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdict or a final number changed."""
        return not EditOutcome.of(self.old).same_as(EditOutcome.of(self.new))

    @cached_property
    def first(self) -> FirstDifference | None:
        """The first sample with another value; None if there is none."""
        if self.old.times_ns.shape != self.new.times_ns.shape:
            return None
        one, other = self.old.series[0, 0], self.new.series[0, 0]
        differs = np.flatnonzero((one != other) & ~(np.isnan(one) & np.isnan(other)))
        if not len(differs):
            return None
        at = int(differs[0])
        return FirstDifference(int(self.old.times_ns[at]), float(one[at]), float(other[at]))

    @property
    def title(self) -> str:
        """Its name with the object that it is about, and its old name if that was another."""
        title = self.name if self.old.object is None else f"{self.name}({self.old.object})"
        return title if self.name == self.old_name else f"{title} (was {self.old_name})"

    def sentences(self, first_ns: int, shown: Collection[DeclarationChange] = ()) -> Iterator[Sentence]:
        """Yield what changed, one sentence each, with times counted from `first_ns`.

        Args:
            shown: declarations whose lines need not be repeated.
        """
        outcome = _outcome_text(self.old)
        yield Sentence(
            f"{outcome} → {_outcome_text(self.new)}" if self.is_different else f"{outcome}, the same"
        )
        if self.first is not None:
            old, new = with_unit(self.first.old, self.old.unit), with_unit(self.first.new, self.new.unit)
            values = f"{old} → {new}"
            yield Sentence("first differs at ", Instant(self.first.time_ns, first_ns), f": {values}")
        for edit, alone in zip(self.cause, self.alone, strict=True):
            more = max(len(edit.old_nodes), len(edit.new_nodes)) - 1
            elsewhere = f" (and {counted(more, 'more node')})" if more else ""
            yield Sentence(f"because: {edit}, in `{edit.spec}`{elsewhere}")
            yield from self._lines_of(edit, shown)
            if alone is not None:
                number = with_unit(alone.robustness, self.old.unit)
                yield Sentence(f"  with this edit alone: {alone.verdict}, robustness {number}")
        if len(self.cause) > 1:
            yield Sentence(self._together())
        if self.is_flipped and self.new.causes and self.new.causes[0].witness is not None:
            yield reason_sentence(self.new.causes[0].witness, first_ns=first_ns)
        others = [edit for edit in self.edits if edit not in self.cause]
        for edit in others[:_MOST_LISTED]:
            what = "edited, too: " if self.cause else "edited, without effect on the result: "
            yield Sentence(f"{'' if edit.kind == 'renamed' else what}{edit}")
            if edit.kind != "renamed":
                yield from self._lines_of(edit, shown)
        if len(others) > _MOST_LISTED:
            yield Sentence(f"and {counted(len(others) - _MOST_LISTED, 'other edit')}")

    def _together(self) -> str:
        """Say how the edits of a cause bring it about, if there are several."""
        new = EditOutcome.of(self.new)
        enough = sum(
            each is not None and each.same_as(new, verdict_only=self.is_flipped) for each in self.alone
        )
        count, what = len(self.cause), "verdict" if self.is_flipped else "robustness"
        if not enough:
            return f"it takes these {count} edits together"
        which = f"each of these {count} edits" if enough == count else f"{enough} of these {count} edits"
        all_of_them = "both" if count == 2 else f"all {count}"
        return f"{which} is enough by itself; to get the old {what} back, undo {all_of_them}"

    def _lines_of(self, edit: Edit, shown: Collection[DeclarationChange]) -> Iterator[Sentence]:
        if edit.change in shown:
            return
        for sign, places in (("-", self.old_places), ("+", self.new_places)):
            if edit in places:
                place = places[edit]
                yield Sentence(f"  {sign} {place.filename}:{place.line}: {place.text}")

    @property
    def document(self) -> dict[str, Any]:
        """The same as values for JSON."""
        first = self.first
        return {
            "name": self.name,
            "old_name": self.old_name,
            "object": self.old.object,
            "flipped": self.is_flipped,
            "old": EditOutcome.of(self.old).document,
            "new": EditOutcome.of(self.new).document,
            "first_difference": None
            if first is None
            else {"time_ns": first.time_ns, "old": json_number(first.old), "new": json_number(first.new)},
            "cause": [
                {**self._edit_value(edit), "alone": None if alone is None else alone.document}
                for edit, alone in zip(self.cause, self.alone, strict=True)
            ],
            "edits": [self._edit_value(edit) for edit in self.edits],
        }

    def _edit_value(self, edit: Edit) -> dict[str, Any]:
        old, new = self.old_places.get(edit), self.new_places.get(edit)
        return {
            "kind": edit.kind,
            "spec": edit.spec,
            "subject": edit.subject,
            "old": edit.old,
            "new": edit.new,
            "old_nodes": list(edit.old_nodes),
            "new_nodes": list(edit.new_nodes),
            "old_line": None if old is None else old.line,
            "new_line": None if new is None else new.line,
            "old_text": None if old is None else old.text,
            "new_text": None if new is None else new.text,
        }

    def __repr__(self) -> str:
        return f"<{self.title}: {_outcome_text(self.old)} → {_outcome_text(self.new)}>"


_MOST_LISTED: Final = 8
"""Edits without effect that are listed; JSON has all."""


def _outcome_text(result: SpecResult) -> str:
    return f"{result.verdict} ({with_unit(result.robustness, result.unit)})"
