"""A member that leaves within reach and comes back is reported once, however a log is divided."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from spatial_replay.logs.source import MemorySource
from spatial_replay.monitor.departures import Departures
from spatial_replay.replay.engine import Replay
from spatial_replay.replay.selection import DEFAULT_OPTIONS, Selection

OF_CLASS = sr.parse_specification(
    'group people = class "person"\nspec safe = G (forall p in people: cart dist p >= 0.5)'
)
PRESENT = sr.parse_specification(
    "spec of_p = G (present(p) -> (p dist cart >= 0.5))\n"
    "spec of_q = G ((q dist cart >= 0.5) or not present(q))"
)
ENLARGED = sr.parse_specification(
    'spec safe = G (forall p in class "person": not (enlarge(p, 0.25) ovlp enlarge(cart, 0.25)))'
)
OVERLAP = sr.parse_specification('spec safe = G (forall p in class "person": not (p ovlp cart))')
STEP_NS = 300_000_000


@st.composite
def visits(draw) -> list[dict[str, tuple[float, str]]]:
    """Per sample, the place and the class of each person in it."""
    samples = []
    for _ in range(draw(st.integers(1, 10))):
        names = draw(st.sets(st.sampled_from(["p", "q"])))
        places = st.sampled_from([0.25, 0.375, 0.75, 1.5, 2.0])
        samples.append(
            {name: (draw(places), draw(st.sampled_from(["person"] * 4 + ["dog"]))) for name in names}
        )
    return samples


def trace_of(samples: list[dict[str, tuple[float, str]]]) -> sr.Trace:
    return sr.Trace.from_samples(
        sr.Sample(
            k * STEP_NS,
            {"cart": sr.Footprint.disc(0, 0, 0.125)}
            | {
                name: sr.TrackedObject(sr.Footprint.disc(x, 0, 0.125), class_name=class_name)
                for name, (x, class_name) in people.items()
            },
        )
        for k, people in enumerate(samples)
    )


def expected(
    samples: list[dict[str, tuple[float, str]]], classes: tuple[str, ...], threshold: float
) -> set[tuple[str, int, int]]:
    """Name, first sample without it and sample of its return, one object after the other."""
    departures = set()
    for name in ("p", "q"):
        distances = {
            k: people[name][0] - 0.25
            for k, people in enumerate(samples)
            if name in people and people[name][1] in classes
        }
        members = list(distances)
        for last, back in pairwise(members):
            if back == last + 1:
                continue
            # the approach over the last second, which is three steps
            early = min(k for k in members if last - 3 <= k <= last)
            speed = (distances[early] - distances[last]) / (last - early) if early < last else 0.0
            near = threshold or 0.25  # the diameter of each disc
            reach = max(near, speed * (back - last))
            if distances[last] - threshold < reach or distances[back] - threshold < near:
                departures.add((name, (last + 1) * STEP_NS, back * STEP_NS))
    return departures


@pytest.mark.parametrize(
    ("specification", "classes", "threshold"),
    [
        (OF_CLASS, ("person",), 0.5),
        (PRESENT, ("person", "dog"), 0.5),
        (ENLARGED, ("person",), 0.5),
        (OVERLAP, ("person",), 0.0),
    ],
    ids=["of a class", "present", "enlarged", "overlap"],
)
@examples(200)
@given(samples=visits(), data=st.data())
def test_departures_do_not_depend_on_how_a_log_is_divided(specification, classes, threshold, samples, data):
    trace = trace_of(samples)
    replayed = Replay(MemorySource(trace), [specification], certify=False).run()
    departures = {(leave.name, leave.start_ns, leave.end_ns) for leave in replayed.left}
    assert departures == expected(samples, classes, threshold)
    instances = Selection(MemorySource(trace), [specification], DEFAULT_OPTIONS).instances(specification)
    by_block = Departures(instances, specification.regions)
    cuts = data.draw(st.sets(st.integers(1, len(trace))))
    for begin, end in pairwise([0, *sorted(cuts), len(trace)]):
        by_block.add(trace.slice(begin, end))
    assert set(by_block.departures) == set(replayed.left)


def test_a_member_infinitely_far_from_an_empty_group_is_no_departure():
    samples = [{"p": (0.25, "person")}, {"p": (0.25, "person")}, {}, {"p": (0.25, "person")}]
    away = sr.parse_specification('G (forall p in class "person": p dist (class "dog") >= 0.5)')
    assert not Replay(MemorySource(trace_of(samples)), [away], certify=False).run().left
