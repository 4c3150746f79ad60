"""Events of a run: which changes are reported, when, and in which words."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap.records import Message

import spatial_replay as sr
from spatial_replay.logs.schemas.Robustness_pb2 import RecentEvents
from spatial_replay.logs.source import MemorySource
from spatial_replay.replay.engine import run_replay
from spatial_replay.replay.selection import ReplayOptions, Window

STEP_NS = 10**8


Found = list[tuple[int, Event, Log]]
END = "for the log has ended"


def events_of(tmp_path: Path, text: str, *charges: float | None, **options: object) -> Found:
    """The events and sentences of a run of batteries, with the number of the sample they are logged at, but
    for what its end brings."""
    found = written(tmp_path, text, batteries(*charges), **options)
    return [each for each in found if END not in each[2].message]


def events_at_end(tmp_path: Path, text: str, *charges: float | None, **options: object) -> Found:
    """What the end of such a run brings."""
    found = written(tmp_path, text, batteries(*charges), **options)
    return [each for each in found if END in each[2].message]


def batteries(*charges: float | None) -> list[sr.Sample]:
    return [
        sr.Sample(10**9 + t * STEP_NS, {}, {} if charge is None else {"battery": charge})
        for t, charge in enumerate(charges)
    ]


def written(tmp_path: Path, text: str, samples: list[sr.Sample], **options: object) -> Found:
    output = tmp_path / "annotated.mcap"
    files = [sr.parse_specification(text, filename="battery.spatial")]
    run_replay(MemorySource.from_samples(samples), files, ReplayOptions(**options), output=output)
    events, lines = (_messages(output, topic) for topic in ("/spatial/events", "/spatial/log"))
    found = []
    for event, line in zip(events, lines, strict=True):
        assert event.log_time == line.log_time == line.publish_time
        number = (event.log_time - samples[0].time_ns) // STEP_NS
        found.append((number, Event.FromString(event.data), Log.FromString(line.data)))
    return found


def test_a_viewer_that_seeks_gets_the_newest_events_in_one_message(tmp_path):
    charges = [charge for _ in range(25) for charge in (1.0, 1.0, 1.0, -1.0, -1.0, -1.0)]
    found = written(tmp_path, "spec last = F G battery >= 0", batteries(*charges))
    recent = _messages(tmp_path / "annotated.mcap", "/spatial/recent_events")
    assert [each.log_time for each in recent] == [line.timestamp.ToNanoseconds() for *_, line in found]
    listed = [(each.at, each.event) for each in RecentEvents.FromString(recent[30].data).events]
    newest = [line for *_, line in found[30:10:-1]]
    seconds = [(line.timestamp.ToNanoseconds() - 10**9) / 1e9 for line in newest]
    assert listed == [(s, line.message) for s, line in zip(seconds, newest, strict=True)]


def _messages(log: Path, topic: str) -> list[Message]:
    with log.open("rb") as stream:
        return [message for *_, message in make_reader(stream).iter_messages([topic])]


def facts(event: Event) -> dict[str, str]:
    return {pair.key: pair.value for pair in event.metadata}


def test_a_sign_is_reported_when_it_lasts_three_samples(tmp_path):
    charges = [1.0, -1.0, -2.0, 1.0, -3.0, -4.0, -2.0, -1.0, 5.0]
    [(number, event, line)] = events_of(tmp_path, "spec last = F G battery >= 0", *charges)
    assert number == 6
    assert event.start_time.ToNanoseconds() == 10**9 + 4 * STEP_NS
    assert event.end_time.ToNanoseconds() == line.timestamp.ToNanoseconds() == 10**9 + 6 * STEP_NS
    assert facts(event) == {
        "specification": "last",
        "node": "0",
        "name": "last",
        "verdict": "pending",
        "sign": "negative",
        "robustness": "-4.0",
        "witness": "`battery >= 0` fails by 4",
        "verdict_before": "pending",
        "sign_before": "positive",
        "robustness_before": "1.0",
        "witness_before": "`battery >= 0` held by 1",
        "start_ns_before": "1000000000",
        "end_ns_before": "1300000000",
        "message": line.message,
    }
    assert line.message == (
        "`last` is pending: `battery >= 0` fails by 4. "
        "Before, it held for 0.400 s; its worst was that `battery >= 0` held by 1."
    )
    assert (line.level, line.name, line.file, line.line) == (Log.INFO, "last", "battery.spatial", 1)


def test_a_verdict_is_reported_at_once(tmp_path):
    text = "# a comment\nspec kept = G battery >= 0"
    [(number, event, line)] = events_of(tmp_path, text, 2.0, 1.0, -1.0, 5.0, -7.0)
    assert number == 2
    assert event.start_time == event.end_time
    assert facts(event)["verdict"] == "violated"
    assert (line.level, line.line) == (Log.ERROR, 2)
    assert line.message.startswith("`kept` is permanently violated: `battery >= 0` fails by 1.")


def test_a_verdict_of_the_first_sample_has_nothing_before(tmp_path):
    [(number, event, line)] = events_of(tmp_path, "spec kept = G battery >= 0", -1.0, 1.0)
    assert number == 0
    assert not any(key.endswith("_before") for key in facts(event))
    assert line.message == "`kept` is permanently violated: `battery >= 0` fails by 1."


def test_how_it_begins_is_no_change(tmp_path):
    assert not events_of(tmp_path, "spec last = F G battery >= 0", 1.0, 1.0, 1.0, 1.0)


def test_samples_that_say_nothing_are_no_sign(tmp_path):
    charges = [1.0, -1.0, None, -1.0, -1.0, None, -1.0, -1.0, -1.0]
    [(number, *_)] = events_of(tmp_path, "spec last = F G battery >= 0", *charges)
    assert number == 8


def test_what_decided_may_lie_before_the_sample_that_settles_a_verdict(tmp_path):
    # what decides is the second sample; that it does is known when the window closes
    [(number, event, line)] = events_of(
        tmp_path, "spec soon = F[0s, 0.3s] battery >= 5", 1.0, 4.0, 3.0, 2.0, 1.0
    )
    assert number == 3
    assert (facts(event)["witness"], facts(event)["witness_ns"]) == (
        "`battery >= 5` failed by 1",
        "1100000000",
    )
    assert line.message.startswith(
        "`soon` is permanently violated: `battery >= 5` failed by 1 (0.200 s earlier)."
    )


def test_what_settled_a_verdict_is_reported_rather_than_what_is_least(tmp_path):
    text = "spec kept = G battery >= 0\nspec filled = F battery >= 50\nspec task = filled and kept"
    charges = [2.0, -1.0, 3.0, 3.0]
    task = [
        (number, event) for number, event, line in events_of(tmp_path, text, *charges) if line.name == "task"
    ]
    [(number, event)] = task
    assert number == 1
    assert facts(event)["witness"] == "`battery >= 0` fails by 1"
    assert not [line for *_, line in events_at_end(tmp_path, text, *charges) if line.name == "task"]


def test_named_parts_that_later_samples_can_change_are_reported_too(tmp_path):
    text = (
        "spec full = battery >= 1\nspec filled = F full\nspec never_empty = G battery >= 0\n"
        "spec both = filled and never_empty"
    )
    names = [(line.name, line.message) for *_, line in events_of(tmp_path, text, 0.5, 2.0, 2.0, 2.0, 2.0)]
    assert [name for name, _ in names] == ["filled", "both"]
    assert names[0][1].startswith("`filled` in `both` is permanently satisfied")


def test_a_template_says_for_whom(tmp_path):
    samples = [
        sr.Sample(t * STEP_NS, {"a": sr.Footprint.box(0, 0, 1, 1), "b": sr.Footprint.box(t, 0, t + 1, 1)})
        for t in range(6)
    ]
    found = written(tmp_path, "spec near(x) = G x closeto[2] a", samples, each={"x": "all"})
    [(_, event, line)] = [each for each in found if END not in each[2].message]
    assert facts(event)["object"] == "b"
    assert line.message.startswith("`near` for b is permanently violated: `b closeto[2] a` fails by 1.")


def test_negated_and_implied_atoms_are_witnesses_in_their_own_sign(tmp_path):
    [(_, event, _)] = events_of(tmp_path, "spec spared = G not battery >= 2", 1.0, 3.0)
    assert facts(event)["robustness"] == "-1.0"
    assert facts(event)["witness"] == "`battery >= 2` must not hold, and holds by 1"


def test_a_quantifier_is_named_by_the_objects_that_decide_it(tmp_path):
    def at(sample: int, a: float, c: float) -> sr.Sample:
        cars = {"a": sr.Footprint.disc(a, 0, 0.5), "c": sr.Footprint.disc(c, 0, 0.5)}
        objects = {name: sr.TrackedObject(each, class_name="car") for name, each in cars.items()}
        return sr.Sample(10**9 + sample * STEP_NS, objects | {"b": sr.Footprint.disc(0, 0, 0.5)})

    samples = [at(0, 9, 5), at(1, 8, 6), at(2, 7, 7), at(3, 3, 8), at(4, 4, 9), at(5, 5, 9)]
    text = """
        group cars = class "car"
        spec safe = G forall o in cars: (o dist b >= 3)
        spec apart = G forall o in cars: !(o dist b < 3)
        spec near = F forall o in cars: (o dist b <= 3)
        spec each(ego) = F[0s, 0.2s] exists o in cars: (o dist ego <= -1)
    """
    events = written(tmp_path, text, samples, each={"ego": "b"})
    found = {facts(event)["specification"]: event for _, event, _ in events}
    assert {name: facts(event)["witness"] for name, event in found.items()} == {
        "safe": "`a dist b >= 3` fails by 1",
        "apart": "`a dist b < 3` must not hold, and holds by 1",
        "near": "`a dist b <= 3` failed by 3",  # three samples before the last one
        "each": "`c dist b <= -1` failed by 5",
    }
    assert facts(found["safe"])["witness_before"] == "`c dist b >= 3` held by 1"


def test_the_paper_semantics_knows_signs_only(tmp_path):
    found = events_of(tmp_path, "spec kept = G battery >= 0", 2.0, -1.0, -1.0, -1.0, semantics="paper")
    [(number, event, _)] = found
    assert (number, facts(event)["verdict"], facts(event)["sign"]) == (3, "violated", "negative")


@pytest.mark.parametrize("semantics", ["ltlf", "paper"])
def test_events_come_in_the_order_of_time(tmp_path, semantics):
    text = "spec last = F G battery >= 0\nspec high = F battery >= 3\nspec kept = G battery >= -4"
    charges = [1.0, *[-1.0] * 4, *[2.0] * 4, *[-2.0] * 4, *[3.0] * 4, *[-5.0] * 3]
    numbers = [number for number, *_ in events_of(tmp_path, text, *charges, semantics=semantics)]
    assert len(numbers) >= 5
    assert all(first <= second for first, second in pairwise(numbers))


def test_what_is_pending_is_decided_by_the_end(tmp_path):
    charges = [-3.0, -1.0, -2.0, -5.0]
    [(number, event, line)] = events_at_end(tmp_path, "spec full = F battery >= 0", *charges)
    assert number == 3
    assert event.start_time == event.end_time == line.timestamp
    assert line.timestamp.ToNanoseconds() == 10**9 + 3 * STEP_NS
    assert facts(event) == {
        "specification": "full",
        "node": "0",
        "name": "full",
        "verdict": "violated",
        "sign": "negative",
        "robustness": "-1.0",
        "witness": "`battery >= 0` failed by 1",
        "witness_node": "1",
        "witness_ns": "1100000000",
        "verdict_before": "pending",
        "sign_before": "negative",
        "robustness_before": "-3.0",
        "witness_before": "`battery >= 0` failed by 3",
        "start_ns_before": "1000000000",
        "end_ns_before": "1300000000",
        "message": line.message,
    }
    assert line.message == (
        "`full` is violated, for the log has ended: `battery >= 0` failed by 1 (0.200 s earlier). "
        "Before, it was pending for 0.300 s."
    )
    assert (line.level, line.name, line.file, line.line) == (Log.ERROR, "full", "battery.spatial", 1)


def test_what_no_sample_could_change_is_not_repeated_at_the_end(tmp_path):
    text = "spec full = F battery >= 5\nspec kept = G battery >= 0\nspec both = full or kept"
    assert [line.message for *_, line in events_at_end(tmp_path, text, 1.0, 6.0, 2.0)] == [
        "`kept` in `both` is satisfied, for the log has ended: `battery >= 0` held by 1 (0.200 s earlier). "
        "Before, it held for 0.200 s; its worst was that `battery >= 0` held by 1."
    ]


def test_the_end_finds_the_witness_in_whichever_part_decides(tmp_path):
    text = "spec both = not F battery >= 5 and (G battery >= -4 or F (battery <= -8 and F battery >= 9))"
    [(_, event, _)] = events_at_end(tmp_path, text, 1.0, 3.0, -2.0, 4.0, 0.0)
    assert facts(event)["robustness"] == "1.0"
    assert facts(event)["witness"] == "`battery >= 5` failed by 1"


def test_what_decided_the_end_may_be_the_first_sample(tmp_path):
    text = "spec later = F (battery <= 2 and F battery >= 8)"
    [(_, event, line)] = events_at_end(tmp_path, text, 3.0, 9.0, 9.0)
    assert facts(event)["witness_ns"] == "1000000000"
    assert line.message.startswith(
        "`later` is violated, for the log has ended: `battery <= 2` failed by 1 (0.200 s earlier). Before, "
    )


def test_what_stays_unknown_is_said_at_the_end(tmp_path):
    [(number, event, line)] = events_at_end(tmp_path, "spec kept = G battery >= 0", 1.0, None, 2.0)
    assert number == 2
    assert facts(event)["verdict"] == "unknown"
    assert not {"sign", "robustness", "witness"} & set(facts(event))
    assert line.level == Log.WARNING
    assert line.message.startswith("`kept` is unknown, for the log has ended: robustness between -inf and 1.")


def test_a_run_of_one_sample_has_nothing_before_its_end(tmp_path):
    [(_, event, line)] = events_at_end(tmp_path, "spec full = F battery >= 0", -1.0)
    assert not any(key.endswith("_before") for key in facts(event))
    assert line.message == "`full` is violated, for the log has ended: `battery >= 0` fails by 1."


def test_under_the_paper_semantics_the_end_reports_every_verdict(tmp_path):
    text = "spec kept = G battery >= 0\nspec full = F battery >= 3"
    found = events_at_end(tmp_path, text, 2.0, -1.0, 1.0, semantics="paper")
    assert [facts(event)["verdict"] for _, event, _ in found] == ["violated", "violated"]
    assert [facts(event)["robustness"] for _, event, _ in found] == ["-1.0", "-1.0"]


def test_the_end_of_a_window_is_an_end(tmp_path):
    window = Window(end_ns=10**9 + 3 * STEP_NS)
    [(number, *_)] = events_at_end(tmp_path, "spec full = F battery >= 5", *range(6), window=window)
    assert number == 2


def test_the_verdict_of_an_object_that_left_is_reported_at_the_end_and_is_of_its_time(tmp_path):
    box = sr.Footprint.box(0, 0, 1, 1)
    samples = [sr.Sample(10**9 + t * STEP_NS, {"a": box, **({"b": box} if t < 3 else {})}) for t in range(6)]
    found = written(tmp_path, "spec away(x) = F not x closeto[2] a", samples, each={"x": "all"})
    [(number, event, line)] = [each for each in found if facts(each[1]).get("object") == "b"]
    assert number == 5
    assert event.end_time.ToNanoseconds() == 10**9 + 2 * STEP_NS
    assert line.message.startswith("`away` for b is violated, for the log has ended: ")


def test_an_event_names_the_requirement_that_its_spec_stands_for(tmp_path):
    text = 'spec kept "REQ-7: the battery never runs empty" = G battery >= 0'
    [(_, event, line)] = events_of(tmp_path, text, 2.0, -1.0)
    assert facts(event)["requirement"] == "REQ-7"
    assert facts(event)["title"] == "the battery never runs empty"
    assert line.message.startswith("`kept` (REQ-7: the battery never runs empty) is permanently violated: ")


def test_a_part_that_decided_nothing_is_a_warning_at_the_end(tmp_path):
    [*_, (number, event, line)] = written(tmp_path, "G[60s, 90s] battery >= 0", batteries(1.0, 1.0, 1.0))
    assert number == 2
    assert (facts(event)["vacuous"], facts(event)["verdict"]) == ("empty window", "satisfied")
    assert line.level == Log.WARNING
    assert line.message == facts(event)["message"]
    assert line.message.startswith("`G[60s, 90s] (battery >= 0)` was never tested: ")


def test_a_goal_that_is_still_to_come_is_neither_pointed_at_nor_red(tmp_path):
    samples = [
        sr.Sample(
            t * STEP_NS,
            {"robot": sr.Footprint.box(t, 0, t + 1, 1), "bin": sr.Footprint.box(90, 0, 95, 5)},
        )
        for t in range(4)
    ]
    output = tmp_path / "annotated.mcap"
    spec = sr.parse_specification("spec delivered = F robot enclosedin bin")
    run_replay(MemorySource.from_samples(samples), [spec], output=output)
    *pending, ended = [
        {each.id: each for each in SceneUpdate.FromString(message.data).entities}
        for message in _messages(output, "/spatial/scene")
    ]
    for entities in pending:
        assert "witness" not in entities
        colour = entities["object/robot"].lines[0].color
        assert colour.r == colour.b
    # the end of the log violates it
    colour = ended["object/robot"].lines[0].color
    assert colour.r > colour.b
    assert ended["witness"].texts[-1].text.strip() == "robot enclosedin bin now: -87"


def test_a_result_that_becomes_unknown_is_an_event(tmp_path):
    values = (2.0, 1.0, None, None, None, 1.0, 3.0)
    said = [each[2].message for each in events_of(tmp_path, "spec full = F battery >= 3", *values)]
    assert said == [
        "`full` is unknown: `battery >= 3` is unknown. Before, it was pending for 0.200 s.",
        "`full` is permanently satisfied: `battery >= 3` just holds. Before, it was unknown for 0.400 s.",
    ]


def test_an_uncertain_atom_has_one_number_everywhere(tmp_path):
    discs = [
        {
            "a": sr.TrackedObject(sr.Footprint.disc(0, 0, 0), uncertainty=0.25),
            "b": sr.TrackedObject(sr.Footprint.disc(x, 0, 0)),
        }
        for x in (3.0, 1.5)
    ]
    samples = [sr.Sample(index * STEP_NS, objects) for index, objects in enumerate(discs)]
    number = "fails by 0.5, at least 0.25 with what is uncertain"
    [(_, _, line)] = written(tmp_path, "spec far = G a dist b >= 2", samples)[:1]
    assert line.message.startswith(f"`far` is permanently violated: `a dist b >= 2` {number}.")
    [result] = sr.evaluate(
        sr.parse_specification("spec far = G a dist b >= 2"), sr.Trace.from_samples(samples)
    )
    assert f"`a dist b >= 2`, which {number} at 0.100 s" in result.explain()
