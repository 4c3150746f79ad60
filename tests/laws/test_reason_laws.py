"""Result, JSON, event, arrow and report name the same atom at the same time as the reason of a verdict."""

from __future__ import annotations

import math

from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, reject
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import HEADER, WORDS, Recording, formula_texts, recordings, specifications
from spatial_replay import Specification, SpecificationError, parse_specification
from spatial_replay.annotate.scene.scene_frames import DrawnViolation, SceneFrames
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import EVENT_LOG, EVENTS
from spatial_replay.monitor.result import SpecResult
from spatial_replay.replay.document import document_from_replay
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.spec import format_formula
from spatial_replay.spec.formula import Atom, Formula, Quantified, iter_nodes
from spatial_replay.text import time_text


class Run:
    """A replay with its events and the arrows of its scene."""

    def __init__(self, spec: Specification, recording: Recording) -> None:
        self.events: list[dict[str, str]] = []
        self.messages: list[tuple[int, int, dict[str, str]]] = []
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
            elif topics[channel] == EVENT_LOG:
                log = Log.FromString(payload)
                # the topics carry the same changes in the same order
                facts = self.events[len(self.messages)]
                self.messages.append((log.timestamp.ToNanoseconds(), log.level, facts))

    def _show(self, frames: SceneFrames) -> None:
        for index, time_ns in enumerate(frames.times_ns.tolist()):
            self.arrows[time_ns] = frames.frame(index).violation(0)

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


@st.composite
def negations(draw) -> Specification:
    """A negation of a named spec, alone or with another one."""
    first, second = draw(formula_texts(WORDS)), draw(formula_texts(WORDS))
    whole = draw(st.sampled_from(["not part", "not (part and other)", "other and not part"]))
    text = f"{HEADER}spec part = {first}\nspec other = {second}\nspec whole = {whole}\n"
    # each result alone: `other` is one, too, where the whole does not use it
    return parse_specification(text if "other" in whole else text.replace(f"spec other = {second}\n", ""))


SPECIFICATIONS = st.one_of(specifications(templates=False), negations())


def leaf_of(result: SpecResult) -> Formula | None:
    """The leaf that decides the verdict; None if that has no number."""
    witness = result.worst
    assert witness is not None
    node = _node(result, witness.path[-1].node)
    number = witness.lower if result.verdict == "satisfied" else witness.upper
    return node if math.isfinite(number) and isinstance(node, Atom | Quantified) else None


def _node(result: SpecResult, node: int) -> Formula:
    return next(each for identifier, _, each in iter_nodes(result.formula) if identifier == node)


@examples(80)
@given(SPECIFICATIONS, recordings(max_size=8))
def test_json_headline_and_the_last_event_name_what_settled_the_verdict(
    spec: Specification, recording: Recording
) -> None:
    run = run_of(spec, recording)
    if run.result.verdict == "unknown":
        return
    witness = run.result.worst
    assert witness is not None
    settled_ns = run.result.certain_ns()
    assert settled_ns is None or witness.time_ns <= settled_ns == witness.settled_ns
    worst = document_from_replay(run.replayed)["specifications"][0]["worst"]
    assert (worst["node"], worst["time_ns"]) == (witness.node, witness.time_ns)
    if witness.deciding is not None:
        headline = " ".join(run.result.sentences(run.replayed.first_ns))
        assert f"is `{witness.deciding.text}`, which " in headline
        assert f" at {time_text(witness.time_ns, run.replayed.first_ns)}" in headline
    event, leaf = run.last_event, leaf_of(run.result)
    assert event["verdict"] == run.result.verdict
    if leaf is None:
        assert "witness" not in event
    else:
        assert event["witness_ns"] == str(witness.time_ns)
        texts = [format_formula(leaf)]
        if isinstance(leaf, Quantified) and witness.deciding is not None:
            # the atom of the object that decided it, where that is known
            texts.append(witness.deciding.text)
        assert event["witness"].startswith(tuple(f"`{text}`" for text in texts))


@examples(60)
@given(SPECIFICATIONS, recordings(max_size=8))
def test_the_log_is_calm_about_what_is_pending_and_about_parts_that_need_not_hold(
    spec: Specification, recording: Recording
) -> None:
    run = run_of(spec, recording)
    settled_ns = run.result.violated_at_ns
    for time_ns, level, facts in run.messages:
        assert "fail" not in facts["message"].split(":")[0]
        if "vacuous" in facts or facts["verdict"] == "unknown":
            continue
        since_ns = run.replayed.end_ns if settled_ns is None else settled_ns
        is_late = run.result.verdict == "violated" and time_ns >= since_ns
        assert level == Log.INFO or (is_late and facts["verdict"] == "violated")


@examples(60)
@given(SPECIFICATIONS, recordings(max_size=8))
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
