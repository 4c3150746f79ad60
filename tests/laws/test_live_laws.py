"""A monitor equals an evaluation while objects appear and disappear."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import NAMES, WORDS, specifications, tracked_objects
from spatial_replay import Footprint, Monitor, Sample, Trace, TrackedObject, evaluate, parse_specification
from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.reader import Message
from spatial_replay.mapping.assemble import Assembler, LiveAssembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan

PASSERS_BY = (*(f"p{number}" for number in range(5)), "?", "?(0,) 0", "?(1,) 0")
ANYONE = st.sets(st.sampled_from((*NAMES, *PASSERS_BY)), max_size=6)

LOOKING_BACK = """\
group people = class "person"
group everyone = all
spec alone = G forall x in people: x dist (everyone except x) >= 1
spec apart = G forall x, y in people: x dist y >= 0.5
spec going = F exists x in everyone: x dist x[-{samples}] >= 1
spec parted = H[0, {samples}] forall x in people[-{duration}ms]: x dist a[-{duration}ms] >= 0.5
spec slow = G (speed(a) <= 1 and forall x in people: speed(x) <= 1)
spec nearing = F (0.5 <= speed(enlarge(a, 0.1), everyone except a))
spec draining = O[0, {samples}] (rate(battery) <= 0.1)
spec near = (everyone[-{samples}] dist b <= 3) S[0, {duration}ms] (a oriented[0.5] c)
"""


@st.composite
def crowds(draw, max_size=10):
    """Samples in which objects appear and vanish, change their shape and class, new names come up, and
    some are there, though not known where."""
    shapes = draw(st.lists(tracked_objects(certain=draw(st.booleans())), min_size=2, max_size=5))
    time_ns, samples = draw(st.integers(0, 10**9)), []
    for _ in range(draw(st.integers(1, max_size))):
        objects = {name: draw(st.sampled_from(shapes)) for name in sorted(draw(ANYONE))}
        hidden = draw(ANYONE) if draw(st.booleans()) else ()
        unknown = {name: each.class_name for name, each in objects.items() if name in hidden}
        known = {name: each for name, each in objects.items() if name not in hidden}
        samples.append(
            Sample(time_ns, known, {"battery": draw(st.floats(0, 2))} if draw(st.booleans()) else {}, unknown)
        )
        time_ns += draw(st.sampled_from([100, 250, 400])) * 10**6
    return samples


@st.composite
def specifications_looking_back(draw):
    samples, duration = draw(st.integers(1, 3)), draw(st.sampled_from([100, 250, 600]))
    return parse_specification(LOOKING_BACK.format(samples=samples, duration=duration))


def assert_monitor_agrees(specification, samples):
    """Every node of every spec on every prefix, bit for bit."""
    monitor = Monitor(specification)
    updates = [monitor.update(sample) for sample in samples]
    for number, result in enumerate(evaluate(specification, Trace.from_samples(samples))):
        live = np.stack([update.specs[number].numbers for update in updates], axis=2)
        assert live.tobytes() == result.series.tobytes()


@examples(60)
@given(specification=specifications_looking_back(), samples=crowds())
def test_a_monitor_equals_an_evaluation_while_objects_appear_and_disappear(specification, samples):
    assert_monitor_agrees(specification, samples)


@examples(60)
@given(
    specification=specifications(words=replace(WORDS, objects=(*NAMES, "p0")), templates=False),
    samples=crowds(),
)
def test_a_monitor_equals_an_evaluation_over_many_objects(specification, samples):
    assert_monitor_agrees(specification, samples)


def test_more_kinds_of_crowds_than_a_monitor_has_plans_for():
    kinds = [f"k{number}" for number in range(6)]
    specification = parse_specification(
        "".join(f'spec s{kind} = G forall x in class "{kind}": x dist a >= 3\n' for kind in kinds)
    )
    chosen, shape = Random(0), Footprint.disc(4, 0, 0.5)
    crowds = [[kind for kind in kinds for _ in range(chosen.randrange(4))] for _ in range(400)]
    samples = [
        Sample(
            t,
            {
                "a": Footprint.box(0, t % 5, 1, 9),
                **{f"p{t % 7}{n}": TrackedObject(shape, class_name=kind) for n, kind in enumerate(crowd)},
            },
        )
        for t, crowd in enumerate([*crowds, *reversed(crowds)])
    ]
    assert_monitor_agrees(specification, samples)


CLOSEST = """\
group people = class "person"
group everyone = all
spec apart = G (forall x, y in people: {apart})
spec met = F (exists x, y in everyone: {met})
"""


@examples(40)
@given(
    samples=crowds(max_size=4),
    distance=st.integers(-8, 40).map(lambda value: value / 8),
    grown=st.sampled_from([0, 0.5]),
)
def test_the_closest_two_decide_as_all_pairs_do(samples, distance, grown):
    apart = f"not (enlarge(y, {grown}) dist x <= {distance})"
    met = f"x dist enlarge(y, {grown}) <= {distance}"
    closest = parse_specification(CLOSEST.format(apart=apart, met=met))
    # a conjunction has more than one distance, so that every pair is measured
    pairwise = parse_specification(CLOSEST.format(apart=f"{apart} and {apart}", met=f"{met} and {met}"))
    trace = Trace.from_samples(samples)
    for quick, thorough in zip(evaluate(closest, trace), evaluate(pairwise, trace), strict=True):
        assert quick.series.tobytes() == thorough.series.tobytes()
        assert (quick.lower, quick.upper, quick.verdict) == (thorough.lower, thorough.upper, thorough.verdict)
        by_closest, by_pairs = (each.witness().deciding for each in (quick, thorough))
        assert (by_closest and by_closest.objects) == (by_pairs and by_pairs.objects)
    assert_monitor_agrees(closest, samples)


def test_the_closest_of_many_decide_as_all_pairs_do():
    at, everyone = Random(1), "group people = all\nspec apart = G (forall x, y in people: {body})"
    body = "x dist y >= 0.25"
    closest = parse_specification(everyone.format(body=body))
    pairwise = parse_specification(everyone.format(body=f"{body} and {body}"))
    shapes = (
        lambda x, y: Footprint.disc(x, y, 0.25),
        lambda x, y: Footprint.box(x, y, x + at.uniform(0.1, 2), y + 0.5),
        lambda x, y: Footprint.polygon([(x, y), (x + 2, y), (x + 2, y + 2), (x + 1, y + 0.5)]),
    )
    samples = []
    for number in range(6):
        size = 40 if number % 2 else 8  # sparse, and so crowded that most overlap
        objects = {
            f"p{each}": TrackedObject(
                at.choice(shapes)(at.uniform(-size, size), at.uniform(-size, size)),
                uncertainty=at.choice((0.0, 0.3)) if number > 2 else 0.0,
            )
            for each in range(24)
        }
        samples.append(Sample(number * 10**8, objects))
    trace = Trace.from_samples(samples)
    (quick,), (thorough,) = evaluate(closest, trace), evaluate(pairwise, trace)
    assert quick.series.tobytes() == thorough.series.tobytes()
    assert quick.witness().deciding.objects == thorough.witness().deciding.objects


ROBOT = """
clock: {clock}
max_age: 100ms
sample: {sample}
topics:
  /robot: {{name: robot, position: [x, y], shape: {{disc: 0.1}}, stamp: {{field: t, unit: ns}}}}
  /people:
    objects: "of[*]"
    name: "p{{id}}"
    position: [x, y]
    shape: {{disc: 0.2}}
    stamp: {{field: $.t, unit: ns}}
  /marks:
    name: "m{{id}}"
    position: [x, y]
    shape: {{disc: 0.3}}
    stamp: {{field: t, unit: ns}}
    max_age: forever
  /charge: {{signals: {{charge: x}}, stamp: {{field: t, unit: ns}}}}
"""
TOPICS = ("/robot", "/people", "/marks", "/charge")
DELAY_S = 0.2


@st.composite
def arrivals(draw):
    """Messages of several topics, often at equal times, each with when it arrives: within `DELAY_S`, and in
    the order of its topic."""
    messages, arrived_ns = [], dict.fromkeys(TOPICS, 0)
    time_ns = 10**9
    for _ in range(draw(st.integers(1, 25))):
        topic = draw(st.sampled_from(["/robot", *TOPICS]))
        x = draw(st.integers(0, 9)) / 8
        content = {"x": x, "y": 0, "t": time_ns, "id": draw(st.integers(0, 2))}
        if topic == "/people":
            ids = sorted(draw(st.sets(st.integers(0, 2))))
            content = {"t": time_ns, "of": [{"id": each, "x": x, "y": each} for each in ids]}
        # a topic has one message at a time, unless each has an object of its own
        if topic == "/marks" or all(row[:2] != (topic, time_ns) for row in messages):
            delay_ns = draw(st.sampled_from([0, 0, 1, 30, 199])) * 10**6
            arrived_ns[topic] = max(arrived_ns[topic] + 1, time_ns + delay_ns)
            messages.append((topic, time_ns, arrived_ns[topic], content))
        # both sampled topics pause, for longer than others wait for them
        time_ns += draw(st.sampled_from([0, 0, 5, 20, 60, 300, 900, 4_000])) * 10**6
    return messages


@examples(150)
@given(
    messages=arrivals(),
    clock=st.sampled_from(["log", "header"]),
    sample=st.sampled_from(["{topic: /robot}", "{topic: /people}", "{every: 20ms}"]),
)
def test_a_live_run_has_the_samples_of_its_log_however_topics_interleave(messages, clock, sample):
    mapping = parse_mapping(ROBOT.format(clock=clock, sample=sample))
    contents = [content for *_, content in messages]
    plan = ReadingPlan.of(mapping, [Topic(topic, "", "json") for topic in TOPICS])

    def decoder(topic):
        return lambda payload: contents[int(payload)]

    def message(number):
        topic, time_ns, arrived_ns, _ = messages[number]
        log_ns = time_ns if clock == "log" else arrived_ns
        return Message(topic, log_ns, log_ns, 0, str(number).encode())

    order = sorted(range(len(messages)), key=lambda number: messages[number][2])
    live = LiveAssembler(plan, decoder, name="robot", max_delay_s=DELAY_S)
    traces = []
    for number in order:
        now_s = messages[number][2] / 1e9
        while (due_s := live.due_s()) is not None and due_s < now_s:
            traces.append(live.add([], due_s))
        traces.append(live.add([message(number)], now_s))
    traces.append(live.finish())
    log = Assembler(plan, decoder, name="robot.mcap")
    logged = sorted(map(message, range(len(messages))), key=lambda each: each.log_time_ns)
    assert Trace.concatenate(traces) == Trace.concatenate([log.add(logged), log.finish()])
    assert live.late == 0
