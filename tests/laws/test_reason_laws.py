"""Result, JSON, event, arrow and report name the same atom at the same time as the reason of a violation."""

from __future__ import annotations

import math

from foxglove_schemas_protobuf.Event_pb2 import Event
from hypothesis import given, reject, settings

from laws.strategies_monitor import Recording, recordings, specifications
from spatial_replay import Replayed, Specification, SpecificationError, SpecResult
from spatial_replay.annotate.scene_update import DrawnViolation, SceneFrames
from spatial_replay.logs import MemorySource, Messages
from spatial_replay.logs.topics import EVENTS
from spatial_replay.replay import Replay, document_from_replay
from spatial_replay.spec import format_formula
from spatial_replay.spec.formula import Atom, Formula, Quantified, iter_nodes


class Run:
    """A replay with its events and the arrows of its scene."""

    def __init__(self, spec: Specification, recording: Recording) -> None:
        self.events: list[dict[str, str]] = []
        self.arrows: dict[int, DrawnViolation | None] = {}
        source = MemorySource(recording.trace())
        self.replay = Replay(source, [spec], keep_series=True, keep_leaves=True, show=self._show)
        self.replayed: Replayed = self.replay.run(self._write)
        [self.result] = self.replayed.results

    def _write(self, messages: Messages) -> None:
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        for channel, payload in zip(messages.channel.tolist(), messages.payloads, strict=True):
            if topics[channel] == EVENTS:
                facts = {pair.key: pair.value for pair in Event.FromString(payload).metadata}
                self.events.append(facts)

    def _show(self, frames: SceneFrames) -> None:
        for index, time_ns in enumerate(frames.times_ns.tolist()):
            self.arrows[time_ns] = frames.frame(index).violation

    @property
    def last_event(self) -> dict[str, str]:
        own = [each for each in self.events if each["node"] == "0" and "vacuous" not in each]
        return own[-1]

    def leaf(self, index: int) -> Formula:
        return self.result.evidence.instance.program.leaves[index]


def run_of(spec: Specification, recording: Recording) -> Run:
    """The run of a recording that has everything the specification names."""
    try:
        return Run(spec, recording)
    except SpecificationError:
        reject()


def leaf_of(result: SpecResult) -> Formula | None:
    """The leaf that the first cause names; None if that has no number."""
    witness = result.causes[0].witness
    assert witness is not None
    node = _node(result, witness.path[-1].node)
    return node if math.isfinite(witness.upper) and isinstance(node, Atom | Quantified) else None


def _node(result: SpecResult, node: int) -> Formula:
    return next(each for identifier, _, each in iter_nodes(result.formula) if identifier == node)


@settings(max_examples=40)
@given(specifications(templates=False), recordings(max_size=8))
def test_json_and_the_last_event_name_what_the_first_cause_names(
    spec: Specification, recording: Recording
) -> None:
    run = run_of(spec, recording)
    if run.result.verdict != "violated":
        return
    cause = run.result.causes[0]
    assert cause.witness is not None
    worst = document_from_replay(run.replayed)["specifications"][0]["worst"]
    assert (worst["node"], worst["time_ns"]) == (cause.node, cause.witness.time_ns)
    event, leaf = run.last_event, leaf_of(run.result)
    assert event["verdict"] == "violated"
    if leaf is None:
        assert "witness" not in event
    else:
        assert event["witness_ns"] == str(cause.witness.time_ns)
        assert event["witness"].startswith(f"`{format_formula(leaf)}`")


@settings(max_examples=40)
@given(specifications(templates=False), recordings(max_size=8))
def test_the_arrow_names_what_the_first_cause_names_and_no_pending_goal(
    spec: Specification, recording: Recording
) -> None:
    run = run_of(spec, recording)
    settled_ns = run.result.violated_at_ns
    for time_ns, arrow in run.arrows.items():
        assert arrow is None or (settled_ns is not None and time_ns >= settled_ns)
    if settled_ns is None:
        return
    [first, *_] = run.result.causes
    arrow = run.arrows[settled_ns]
    assert first.settled_ns == settled_ns
    assert first.witness is not None
    if arrow is not None:
        assert first.witness.time_ns == settled_ns
        leaf = leaf_of(run.result)
        assert isinstance(leaf, Atom | Quantified)
        assert format_formula(run.leaf(arrow.leaf)) == format_formula(leaf)
