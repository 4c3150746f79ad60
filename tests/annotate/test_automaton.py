"""What messages of /spatial/automaton and the files beside them say."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from replay.runs import PiecewiseSource, content_of
from spatial_replay import Footprint, Recorder, Sample, Trace, automaton, parse_specification
from spatial_replay.annotate.specification import ReportedTree, encode_specification
from spatial_replay.automata import stored_text
from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import Propositions
from spatial_replay.logs.messages import Attachment, MemorySink
from spatial_replay.logs.schemas import AutomatonState_pb2
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.schemas.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.recording.log import Recording
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.selection import ReplayOptions
from spatial_replay.sources import open_source

FALSE, TRUE, UNKNOWN = (
    AutomatonState_pb2.TRUTH_FALSE,
    AutomatonState_pb2.TRUTH_TRUE,
    AutomatonState_pb2.TRUTH_UNKNOWN,
)
TEXT = """\
region goal = box(0, 0, 10, 10)
spec reach = F cube enclosedin goal
spec safe = G battery >= 0.2
spec done = reach and safe
"""
SPEC = parse_specification(TEXT, filename="done.spatial")


def sample(index: int, x: float | None, battery: float = 1.0) -> Sample:
    """A cube at some place, or unseen."""
    objects = {} if x is None else {"cube": Footprint.box(x, 1, x + 1, 2)}
    return Sample(index * 10**9, objects, {"battery": battery})


RUN = [sample(0, 20), sample(1, 20), sample(2, 3), sample(3, 20), sample(4, 20, 0.1), sample(5, 3)]
LARGE = parse_specification("spec late = G (battery >= 1 -> F[0, 200] battery >= 2)")
HIDDEN = [sample(0, 20), sample(1, None), sample(2, 20), sample(3, 3)]


def states_of(samples: list[Sample], text: str = TEXT, pieces: int | None = None) -> list[AutomatonState]:
    sink = MemorySink()
    recording = Recording(sink, [parse_specification(text)])
    trace = Trace.from_samples(samples)
    for begin in range(0, len(trace), pieces or len(trace)):
        recording.add(trace.slice(begin, begin + (pieces or len(trace))))
    return [
        AutomatonState.FromString(payload)
        for block in sink.messages
        for channel, payload in zip(block.channel.tolist(), block.payloads, strict=True)
        if block.channels[channel].topic == "/spatial/automaton"
    ]


def test_every_sample_says_where_the_automaton_is() -> None:
    machine = automaton(SPEC)
    state = machine.initial
    messages = states_of(RUN)
    symbols = [(False, True), (False, True), (True, True), (False, True), (False, False), (True, True)]
    for index, (message, symbol) in enumerate(zip(messages, symbols, strict=True)):
        assert (message.time_ns, message.specification) == (index * 10**9, "done")
        assert message.source == state
        state = machine.step(state, symbol)
        assert list(message.states) == [state]
        assert list(message.propositions) == [TRUE if value else FALSE for value in symbol]
        assert message.accepting == (TRUE if state in machine.accepting else FALSE)
        assert message.can_accept == (TRUE if state in machine.can_accept else FALSE)
        assert message.can_reject == (TRUE if state in machine.can_reject else FALSE)


def test_the_guard_of_a_change_is_in_words() -> None:
    assert [message.guard for message in states_of(RUN)] == [
        "", "", "cube enclosedin goal and battery >= 0.2", "", "not (battery >= 0.2)", "",
    ]  # fmt: skip


def test_what_was_not_seen_leaves_several_states_until_it_is_decided() -> None:
    messages = states_of(HIDDEN)
    assert [len(message.states) for message in messages] == [1, 2, 2, 1]
    assert [message.propositions[0] for message in messages] == [FALSE, UNKNOWN, FALSE, TRUE]
    assert [message.accepting for message in messages] == [FALSE, UNKNOWN, UNKNOWN, TRUE]
    assert [message.HasField("source") for message in messages] == [True, True, False, False]
    assert [message.can_accept for message in messages] == [TRUE] * 4


def test_the_sign_of_what_is_not_determined_may_be_known() -> None:
    # the second of the two is unknown in a sample, the first holds
    text = "region goal = box(0, 0, 10, 10)\nspec s = F (battery >= 0.5 or cube enclosedin goal)"
    messages = states_of([sample(0, 20, 0.1), sample(1, None, 0.9)], text)
    assert [list(message.propositions) for message in messages] == [[FALSE], [TRUE]]
    assert messages[-1].accepting == TRUE


@pytest.mark.parametrize("samples", [RUN, HIDDEN])
def test_how_samples_come_changes_nothing(samples: list[Sample]) -> None:
    assert states_of(samples) == states_of(samples, pieces=1) == states_of(samples, pieces=2)


def test_the_propositions_are_nodes_of_the_specification() -> None:
    sink = MemorySink()
    Recording(sink, [SPEC]).add(Trace.from_samples(RUN))
    (payload,) = [
        payload
        for block in sink.messages
        for channel, payload in zip(block.channel.tolist(), block.payloads, strict=True)
        if block.channels[channel].topic == "/spatial/specification"
    ]
    (result,) = SpecificationMessage.FromString(payload).results
    assert [result.nodes[number].text for number in result.propositions] == [
        "cube enclosedin goal",
        "battery >= 0.2",
    ]


def test_a_log_keeps_automata_as_files() -> None:
    sink = MemorySink()
    Recording(sink, [SPEC])
    kept = {each.name: each.data.decode() for each in sink.attachments}
    assert kept["automata/recorded/done.dot"] == automaton(SPEC).to_dot()
    assert kept["automata/recorded/done.hoa"] == automaton(SPEC).to_hoa()
    assert json.loads(kept["automata/recorded/done.json"])["version"] == 1
    assert dict(sink.metadata)["spatial_replay_automata"] == {"done": "3 states, 2 propositions"}


def test_a_log_says_why_there_is_no_automaton() -> None:
    text = "spec a = G (O battery >= 0.2)\nspec b = F battery >= 1"
    sink = MemorySink()
    recording = Recording(sink, [parse_specification(text)])
    recording.add(Trace.from_samples(RUN))
    about = dict(sink.metadata)["spatial_replay_automata"]
    assert about["a"] == "none: `O` looks back: there is no automaton for past operators"
    assert about["b"] == "2 states, 1 proposition"
    assert not any("/a." in each.name for each in sink.attachments)


@dataclass(frozen=True)
class WithAttachment(PiecewiseSource):
    """A source that keeps a file beside its samples."""

    kept: tuple[Attachment, ...] = ()

    def attachments(self) -> tuple[Attachment, ...]:
        return self.kept


def about_automata(path: Path) -> dict[str, str]:
    return dict(content_of(path).metadata)["spatial_replay_automata"]


def test_a_replay_takes_over_what_was_compiled_before(tmp_path: Path) -> None:
    # only MONA compiles this one; distinguished from a wrong result: it accepts everything
    text = "spec done = G (battery >= 0.1 -> F[13, 13] battery >= 0.5)"
    spec = parse_specification(text, filename="done.spatial")
    propositions = tuple(Propositions(spec.results[0].formula).all)
    wrong = Automaton("done", propositions, frozenset({0}), (~0,), ())
    stored = stored_text(wrong, spec, spec.results[0])
    attachment = Attachment("automata/recorded/done.json", "application/json", stored.encode())
    source = WithAttachment(Trace.from_samples(RUN), 4, kept=(attachment,))
    output = tmp_path / "out.mcap"
    run_replay(source, [spec], output=output)
    assert about_automata(output) == {"done": "1 state, 2 propositions"}


def test_a_replay_believes_no_automaton_that_it_can_compile_itself(tmp_path: Path) -> None:
    wrong = Automaton("done", automaton(SPEC).propositions, frozenset({0}), (~0,), ())
    stored = stored_text(wrong, SPEC, SPEC.results[0])
    attachment = Attachment("automata/recorded/done.json", "application/json", stored.encode())
    source = WithAttachment(Trace.from_samples(RUN), 4, kept=(attachment,))
    output = tmp_path / "out.mcap"
    run_replay(source, [SPEC], output=output)
    assert about_automata(output) == {"done": "3 states, 2 propositions"}


def test_a_replay_of_a_replay_has_the_same_automata(tmp_path: Path) -> None:
    log, once, twice = (tmp_path / name for name in ("run.mcap", "once.mcap", "twice.mcap"))
    with Recorder(log, specifications=[SPEC]) as recorder:
        for each in RUN:
            recorder.write(each)
    run_replay(open_source(log), [SPEC], output=once)
    run_replay(open_source(once), [SPEC], output=twice)
    assert once.read_bytes() == twice.read_bytes()
    names = [name for name, _ in content_of(twice).attachments if name.startswith("automata/")]
    assert sorted(names) == sorted(
        f"automata/{of}/done.{kind}" for of in ("recorded", "replayed") for kind in ("dot", "hoa", "json")
    )
    recorded, replayed = (content_of(path).of("/spatial/automaton") for path in (log, once))
    assert recorded == replayed


def test_under_the_papers_semantics_there_is_none(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with Recorder(log) as recorder:
        for each in RUN:
            recorder.write(each)
    run_replay(open_source(log), [SPEC], ReplayOptions(semantics="paper"), output=tmp_path / "out.mcap")
    assert "/spatial/automaton" not in content_of(tmp_path / "out.mcap").topics()
    assert about_automata(tmp_path / "out.mcap")["done"].startswith("none: ")


def test_the_specification_has_its_automaton_as_it_is_drawn() -> None:
    sink = MemorySink()
    recording = Recording(sink, [SPEC, parse_specification("spec before = O battery >= 0")])
    recording.add(Trace.from_samples(RUN))
    [payload] = [
        payload
        for block in sink.messages
        for channel, payload in zip(block.channel.tolist(), block.payloads, strict=True)
        if block.channels[channel].topic == "/spatial/specification"
    ]
    results = {each.name: each for each in SpecificationMessage.FromString(payload).results}
    assert not results["before"].HasField("automaton")
    drawn, expected = results["done"].automaton, automaton(SPEC)
    assert [each.number for each in drawn.states] == list(expected.states)
    assert len({(each.column, each.row) for each in drawn.states}) == len(drawn.states)
    for each in drawn.states:
        assert each.accepting == (each.number in expected.accepting)
        assert each.can_reject == (each.number in expected.can_reject)
        # acceptance is as far as the shortest path to it; from a trap there is none
        shortest = next(expected.paths(each.number), None)
        assert each.HasField("distance") == (each.number in expected.can_accept) == (shortest is not None)
        assert each.distance == len(shortest or ())
    moves = [(each.source, each.target, each.guard) for each in drawn.moves]
    assert sorted(moves) == sorted(
        (each.source, each.target, expected.guard_words(each)) for each in expected.transitions
    )


def test_of_a_large_automaton_the_states_nearest_to_the_start_are_drawn() -> None:
    message = SpecificationMessage.FromString(
        encode_specification(
            [LARGE],
            [ReportedTree("late", None, 0, LARGE.specs[0].formula)],
            automata=[automaton(LARGE)],
        )
    )
    drawn = message.results[0].automaton
    assert (len(drawn.states), drawn.left_out) == (60, len(automaton(LARGE).states) - 60)
    assert [each.number for each in drawn.states] == list(range(60))
    assert len(drawn.moves) <= 300
