"""Events: which changes are reported, and that cutting a run changes none."""

from __future__ import annotations

import contextlib
import math
from itertools import pairwise

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_monitor import Recording, cuts, recordings, specifications
from spatial_replay import Specification, UsageError, evaluate, parse_specification
from spatial_replay.annotate.deciding_leaf import NewestSamples
from spatial_replay.annotate.events import (
    LASTING,
    SATISFIED,
    START,
    UNKNOWN,
    VIOLATED,
    EncodedEvent,
    EventReporter,
    NodeStates,
    track,
)
from spatial_replay.annotate.specification import reported_trees
from spatial_replay.monitor.semantics import checked_semantics
from spatial_replay.monitor.stream import EvaluationStream, find_instances
from spatial_replay.monitor.verdict import Semantics

_VALUES = st.one_of(st.sampled_from([-2.0, -1.0, 0.0, 1.0, math.inf, -math.inf]), st.just(math.nan))
_SETTLED = st.sampled_from([None] * 12 + [0.5, -0.5])


@st.composite
def stands(draw: st.DrawFn) -> np.ndarray:
    """(1, 4, T) numbers of a node: mostly pending, perhaps settled from some sample on."""
    values = draw(st.lists(_VALUES, min_size=1, max_size=30))
    settled = draw(_SETTLED)
    since = draw(st.integers(0, len(values)))
    series = np.full((1, 4, len(values)), np.nan)
    series[0, 0] = values
    series[0, 2], series[0, 3] = -np.inf, np.inf
    if settled is not None:
        series[0, :, since:] = settled
    return series


def _expected(series: np.ndarray) -> list[tuple[int, int, int, float]]:
    """Confirmed at, code, since, worst: by reading the rule aloud."""
    codes = []
    for value, _, lower, upper in series[0].T:
        sign = START if math.isnan(value) else 1 if value >= 0 else 2
        codes.append(SATISFIED if lower >= 0 else VIOLATED if upper < 0 else sign)
    current, found = START, []
    for t, code in enumerate(codes):
        if current >= SATISFIED or code == current or (current == UNKNOWN and code == START):
            continue
        lasts = t >= LASTING - 1 and set(codes[t - LASTING + 1 : t + 1]) == {code}
        if code >= SATISFIED:
            found.append((t, code, t, float(series[0, 2, t])))
        elif current == START:
            pass
        elif lasts:
            since = t - LASTING + 1
            code = code or UNKNOWN
            worst = math.inf if code == UNKNOWN else float(series[0, 0, since : t + 1].min())
            found.append((t, code, since, worst))
        else:
            continue
        current = code
    return found


@given(stands(), st.data())
def test_a_verdict_counts_at_once_and_a_sign_when_it_lasts(series: np.ndarray, data: st.DataObject) -> None:
    count = series.shape[2]
    times_ns = np.arange(count, dtype=np.int64) * 10
    ends = data.draw(cuts(count))
    states, found = NodeStates.begin(1), []
    for begin, end in pairwise(ends):
        part = np.ascontiguousarray(series[:, :, begin:end])
        tracked = track(states, times_ns[begin:end], part, np.array([0]))
        states = tracked.states
        found += [
            (begin + each.sample, each.after.code, each.after.start_ns // 10, each.after.worst)
            for each in tracked.changes
        ]
    assert found == _expected(series)


def _choices(spec: Specification) -> dict[str, str]:
    return {one.parameter: "all" for one in spec.results if one.parameter is not None}


def _all_events(
    spec: Specification, recording: Recording, ends: list[int], semantics: Semantics = "ltlf"
) -> list[EncodedEvent]:
    """The events of each result, one after the other, including its end."""
    trace = recording.trace()
    instances = find_instances(spec, _choices(spec), [trace], 0, 2**63 - 1)
    evaluation = EvaluationStream(instances, spec.regions, semantics)
    trees = reported_trees([spec], [instances])
    samples = NewestSamples()
    reporters = [
        EventReporter(tree, stream.instance, spec, semantics, samples=samples)
        for tree, stream in zip(trees, evaluation.streams, strict=True)
    ]
    events: list[list[EncodedEvent]] = [[] for _ in reporters]
    for begin, end in pairwise(ends):
        piece = trace.slice(begin, end)
        samples.extend(piece)
        for own, reporter, stretch in zip(events, reporters, evaluation.extend(piece), strict=True):
            own += reporter.extend(stretch)
    last_ns = int(trace.times_ns[-1])
    for own, reporter, stream in zip(events, reporters, evaluation.streams, strict=True):
        own += reporter.end(last_ns, stream.final)
    return [one for own in events for one in sorted(own, key=lambda each: each.time_ns)]


def _facts(event: EncodedEvent) -> dict[str, str]:
    return {pair.key: pair.value for pair in Event.FromString(event.event).metadata}


@examples(60)
@given(specifications(), recordings(max_size=12), st.data())
def test_how_a_run_is_cut_changes_no_event(
    spec: Specification, recording: Recording, data: st.DataObject
) -> None:
    count = len(recording.trace())
    whole = _all_events(spec, recording, [0, count])
    assert _all_events(spec, recording, list(range(count + 1))) == whole
    assert _all_events(spec, recording, data.draw(cuts(count))) == whole


@examples(60)
@given(specifications(), recordings(max_size=12), st.sampled_from(["ltlf", "paper"]))
def test_the_last_event_of_a_result_is_its_verdict(
    spec: Specification, recording: Recording, semantics: Semantics
) -> None:
    with contextlib.suppress(UsageError):
        checked_semantics(semantics, [spec])
        result = evaluate(spec, recording.trace(), each=_choices(spec), semantics=semantics)
        events = map(_facts, _all_events(spec, recording, [0, len(recording.trace())], semantics))
        last = {(each["name"], each.get("object")): each["verdict"] for each in events if each["node"] == "0"}
        assert last == {(each.name, each.object): each.verdict for each in result.results}


@examples(40)
@given(recordings(max_size=12))
def test_the_witness_of_a_change_has_its_number(recording: Recording) -> None:
    spec = parse_specification("spec s = F battery >= 0.5\nspec t = G not battery >= 0.75")
    for event in _all_events(spec, recording, [0, len(recording.trace())]):
        facts = _facts(event)
        if facts["verdict"] == "unknown":
            continue
        number = abs(float(facts["robustness"]))
        assert facts["witness"].endswith("just holds" if number == 0 else f"by {number:.6g}")
