"""A member that leaves within reach and comes back is reported once, however a log is divided."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from spatial_replay.logs.messages import MemorySource
from spatial_replay.monitor.departures import Departures
from spatial_replay.replay.engine import Replay
from spatial_replay.replay.selection import DEFAULT_OPTIONS, Selection

SPECIFICATION = sr.parse_specification(
    'group people = class "person"\nspec safe = G (forall p in people: cart dist p >= 0.5)'
)
STEP_NS = 300_000_000


@st.composite
def visits(draw) -> list[dict[str, tuple[float, str]]]:
    """Per sample, the place and the class of each person in it."""
    samples = []
    for _ in range(draw(st.integers(1, 10))):
        names = draw(st.sets(st.sampled_from(["p", "q"])))
        places = st.sampled_from([0.25, 0.75, 1.5, 2.0])
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


def expected(samples: list[dict[str, tuple[float, str]]]) -> set[tuple[str, int, int]]:
    """Name, first sample without it and sample of its return, one object after the other."""
    departures = set()
    for name in ("p", "q"):
        distances = {
            k: people[name][0] - 0.25
            for k, people in enumerate(samples)
            if name in people and people[name][1] == "person"
        }
        members = list(distances)
        for last, back in pairwise(members):
            if back == last + 1:
                continue
            # the approach over the last second, which is three steps
            early = min(k for k in members if last - 3 <= k <= last)
            speed = (distances[early] - distances[last]) / (last - early) if early < last else 0.0
            reach = max(0.5, speed * (back - last))
            if distances[last] - 0.5 < reach or distances[back] - 0.5 < 0.5:
                departures.add((name, (last + 1) * STEP_NS, back * STEP_NS))
    return departures


@examples(200)
@given(samples=visits(), data=st.data())
def test_departures_do_not_depend_on_how_a_log_is_divided(samples, data):
    trace = trace_of(samples)
    replayed = Replay(MemorySource(trace), [SPECIFICATION], certify=False).run()
    assert {(leave.name, leave.start_ns, leave.end_ns) for leave in replayed.left} == expected(samples)
    instances = Selection(MemorySource(trace), [SPECIFICATION], DEFAULT_OPTIONS).instances(SPECIFICATION)
    departures = Departures(instances, SPECIFICATION.regions)
    cuts = data.draw(st.sets(st.integers(1, len(trace))))
    for begin, end in pairwise([0, *sorted(cuts), len(trace)]):
        departures.add(trace.slice(begin, end))
    assert set(departures.departures) == set(replayed.left)


def test_a_member_infinitely_far_from_an_empty_group_is_no_departure():
    samples = [{"p": (0.25, "person")}, {"p": (0.25, "person")}, {}, {"p": (0.25, "person")}]
    away = sr.parse_specification('G (forall p in class "person": p dist (class "dog") >= 0.5)')
    assert not Replay(MemorySource(trace_of(samples)), [away], certify=False).run().left
