"""Changes of verdicts and of signs → messages of /spatial/events and /spatial/log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.timestamp_pb2 import Timestamp

from spatial_replay.inspection.attained import Attained, LeavesBelow, attained, leaves_below
from spatial_replay.inspection.specification import ReportedTree
from spatial_replay.inspection.standings import (
    FAILING,
    HOLDING,
    OF_CANDIDATE,
    OF_STANDING,
    SATISFIED,
    VIOLATED,
    Change,
    Period,
    Standings,
    follow,
)
from spatial_replay.inspection.words import number_text
from spatial_replay.monitor.channels import low_and_high
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.signal_table import looks_ahead
from spatial_replay.monitor.stream import Stretch
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, Specification, TrackedName, iter_nodes
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.terms import substitute


class Watched(NamedTuple):
    """A node whose changes are told.

    Attributes:
        node: its id.
        title: what it is called in a sentence.
        name: the spec's name.
        line: where the spec stands in its file, from 1; 0 if nowhere.
        below: its leaves.
    """

    node: int
    title: str
    name: str
    line: int
    below: LeavesBelow


class Told(NamedTuple):
    """One change, encoded for both topics, and when it was confirmed."""

    time_ns: int
    event: bytes
    log: bytes


class EventTeller:
    """Tells the changes of one result's root and of the specs that it is made of.

    What it keeps from one stretch of samples to the next is a few numbers for each of these.
    """

    def __init__(
        self, tree: ReportedTree, instance: Instance, file: Specification, semantics: Semantics = "ltlf"
    ) -> None:
        """Before the first sample."""
        self._settles = semantics == "ltlf"  # the paper's knows no continuation, and so no verdict that stays
        self._tree, self._filename = tree, "" if file.filename == "<text>" else file.filename
        self._watched = _watched(tree, instance, file)
        self._nodes = np.array([each.node for each in self._watched], np.int64)
        self._leaves = instance.program.leaves
        self._bindings = {variable: TrackedName(name) for variable, name in instance.bindings.items()}
        self._relations = RELATION_NAMES | file.relations
        self._standings = Standings.begin(len(self._watched))
        self._carried: dict[tuple[int, int], Attained | None] = {}

    def tell(self, stretch: Stretch) -> list[Told]:
        """Take in the next samples; the changes that they confirm, by node, then in the order of time."""
        if not len(stretch.times_ns) or self._standings.are_final:
            return []
        followed = follow(
            self._standings, stretch.times_ns, stretch.series, self._nodes, settles=self._settles
        )
        self._standings = followed.standings
        told = [self._told(change, stretch) for change in followed.changes]
        carried = {}
        for node, places in enumerate(followed.places.tolist()):
            codes = followed.standings.integers[node, [0, 3]].tolist()
            for slot, (code, place) in enumerate(zip(codes, places, strict=True)):
                period = Period(code, 0, 0, float(followed.standings.worst[node, slot]), place)
                carried[node, (OF_STANDING, OF_CANDIDATE)[slot]] = self._attained(node, period, stretch)
        self._carried = carried
        return told

    def _attained(self, node: int, period: Period, stretch: Stretch) -> Attained | None:
        """The leaf that a period's worst number is that of, if it is one's at the sample in which it came."""
        if period.place < 0:
            return self._carried.get((node, period.place))
        leaves = stretch.leaves[:, :, period.place]
        low, high = low_and_high(len(leaves), wide=period.code in (SATISFIED, VIOLATED))
        ends = leaves[low], leaves[high]
        return attained(self._watched[node].below, ends, period.worst, low=period.code != VIOLATED)

    def _told(self, change: Change, stretch: Stretch) -> Told:
        watched, after, before = self._watched[change.node], change.after, change.before
        witness = self._words(self._attained(change.node, after, stretch))
        sentence = _sentence(watched.title, after, witness)
        facts = self._facts(watched) | self._facts_of(after, witness, "")
        if before is not None:
            witness = self._words(self._attained(change.node, before, stretch), past=True)
            sentence += _before(before, after.start_ns, witness)
            facts |= self._facts_of(before, witness, "_before")
            facts |= {"start_ns_before": str(before.start_ns), "end_ns_before": str(before.end_ns)}
        event = Event(start_time=_stamp(after.start_ns), end_time=_stamp(after.end_ns))
        for key, text in (facts | {"message": sentence}).items():
            event.metadata.add(key=key, value=text)
        time_ns = int(stretch.times_ns[change.sample])
        log = Log(
            timestamp=_stamp(time_ns),
            level=_LEVELS[after.code],
            message=sentence,
            name=watched.name,
            file=self._filename,
            line=watched.line,
        )
        return Told(time_ns, *(each.SerializeToString(deterministic=True) for each in (event, log)))

    def _words(self, found: Attained | None, *, past: bool = False) -> str:
        """A leaf and its number, as in "`a closeto[1] b` fails by 3.2"; "" for none."""
        if found is None:
            return ""
        leaf: Formula = substitute(self._leaves[found.leaf], self._bindings)
        text = format_formula(leaf, relations=self._relations)
        if found.number == 0.0:
            return f"`{text}` just {'held' if past else 'holds'}"
        holds, fails = ("held", "failed") if past else ("holds", "fails")
        return f"`{text}` {holds if found.number > 0.0 else fails} by {number_text(abs(found.number))}"

    def _facts(self, watched: Watched) -> dict[str, str]:
        of = {} if self._tree.object is None else {"object": self._tree.object}
        return {"specification": self._tree.name, **of, "node": str(watched.node), "name": watched.name}

    def _facts_of(self, period: Period, witness: str, suffix: str) -> dict[str, str]:
        sign = "positive" if period.code in (HOLDING, SATISFIED) else "negative"
        verdict = "pending"
        if not self._settles or period.code in (SATISFIED, VIOLATED):
            verdict = "satisfied" if sign == "positive" else "violated"
        facts = {"verdict": verdict, "sign": sign, "robustness": repr(period.worst)}
        if witness:
            facts["witness"] = witness
        return {f"{key}{suffix}": text for key, text in facts.items()}


def _watched(tree: ReportedTree, instance: Instance, file: Specification) -> list[Watched]:
    """The root, and each named part that later samples can change, once."""
    below = leaves_below(tree.formula, instance.program.leaves)
    lines = {spec.name: _line(file.source, spec.span.start, spec.span.end) for spec in file.specs}
    found: list[Watched] = []
    names: set[str] = set()
    for identifier, parent, node in iter_nodes(tree.formula):
        if parent is None:
            title = f"`{tree.name}`" + (f" for {tree.object}" if tree.object is not None else "")
        elif node.name and node.name not in names and looks_ahead(node):
            title = f"`{node.name}` in {found[0].title}"
        else:
            continue
        name = tree.name if parent is None else node.name or ""
        names.add(node.name or name)
        found.append(Watched(identifier, title, name, lines.get(node.name or name, 0), below[identifier]))
    return found


def _line(source: str, start: int, end: int) -> int:
    return source.count("\n", 0, start) + 1 if end > start else 0


# ---------------------------------------------------------------------------------------------- words

_NOW: Final[Mapping[int, str]] = {
    HOLDING: "holds so far",
    FAILING: "fails so far",
    SATISFIED: "is satisfied, whatever comes",
    VIOLATED: "is violated, whatever comes",
}
_LEVELS: Final[Mapping[int, Log.Level.ValueType]] = {
    HOLDING: Log.INFO,
    FAILING: Log.WARNING,
    SATISFIED: Log.INFO,
    VIOLATED: Log.ERROR,
}


def _sentence(title: str, after: Period, witness: str) -> str:
    because = f", by {number_text(abs(after.worst))}" if math.isfinite(after.worst) else ""
    if witness:
        because = f": {witness}"
    return f"{title} {_NOW[after.code]}{because}."


def _before(before: Period, until_ns: int, witness: str) -> str:
    did = "held" if before.code == HOLDING else "failed"
    seconds = f"{(until_ns - before.start_ns) / 1e9:.3f} s"
    worst = ""
    if witness:
        worst = f"; its worst was that {witness}"
    elif math.isfinite(before.worst):
        number = number_text(abs(before.worst))
        worst = f", by {number} or more" if before.code == HOLDING else f", by up to {number}"
    return f" Before, it {did} for {seconds}{worst}."


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)
