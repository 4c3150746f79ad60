"""A monitor equals an evaluation while objects appear and disappear."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from laws.strategies_monitor import NAMES, WORDS, specifications, tracked_objects
from spatial_replay import Footprint, Monitor, Sample, Trace, TrackedObject, evaluate, parse_specification

PASSERS_BY = (*(f"p{number}" for number in range(5)), "?", "?(0,) 0", "?(1,) 0")
ANYONE = st.sets(st.sampled_from((*NAMES, *PASSERS_BY)), max_size=6)

LOOKING_BACK = """\
group people = class "person"
group everyone = all
spec alone = G forall x in people: x dist (everyone except x) >= 1
spec going = F exists x in everyone: x dist x[-{samples}] >= 1
spec parted = H[0, {samples}] forall x in people[-{duration}ms]: x dist a[-{duration}ms] >= 0.5
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
        samples.append(Sample(time_ns, known, {"battery": 1.5} if draw(st.booleans()) else {}, unknown))
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


@settings(max_examples=60)
@given(specification=specifications_looking_back(), samples=crowds())
def test_a_monitor_equals_an_evaluation_while_objects_appear_and_disappear(specification, samples):
    assert_monitor_agrees(specification, samples)


@settings(max_examples=60)
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
