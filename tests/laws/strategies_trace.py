"""Traces to try laws on: objects that come and go, some of them unreadable, with and without extras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from laws.strategies_geometry import angles, footprints, radii
from spatial_replay import Sample, Trace, TrackedObject
from spatial_replay.trace.trace import ABSENT

NAMES = ("a", "B", "cup", "ä", "物", "𝄞", "very long name of an object " * 5)
names = st.sampled_from(NAMES)
unknown_numbers = st.sampled_from([np.nan, np.inf, -np.inf])
heights = st.tuples(st.integers(-8, 8), st.integers(0, 8)).map(lambda pair: (pair[0], pair[0] + pair[1]))

tracked_objects = st.builds(
    TrackedObject,
    footprints,
    class_name=st.sampled_from([None, "", "block", "Klötzchen"]),
    yaw=st.none() | angles,
    height=st.none() | heights,
    uncertainty=radii,
)
signals = st.dictionaries(st.sampled_from(["battery", "Kraft"]), st.floats(), max_size=2)


@st.composite
def increasing_times(draw, count):
    steps = draw(st.lists(st.integers(1, 2 * 10**9), min_size=count, max_size=count))
    return np.cumsum([draw(st.integers(0, 10**18)), *steps])[:count].tolist()


@st.composite
def certain_traces(draw, max_samples=6):
    """Traces in which every number is known."""
    count = draw(st.integers(0, max_samples))
    objects = st.dictionaries(names, tracked_objects, max_size=4)
    lasting = draw(st.sets(names, max_size=2))
    return Trace.from_samples(
        _reported(draw, Sample(time_ns, draw(objects), draw(signals), lasting=lasting))
        for time_ns in draw(increasing_times(count))
    )


def _reported(draw, sample):
    """The sample, with other times for some of its reports."""
    reported = sorted({*sample.objects, *sample.signals})
    few = draw(st.sets(st.sampled_from(reported))) if reported else ()
    return replace(sample, reported_ns={name: draw(st.integers(0, sample.time_ns)) for name in sorted(few)})


@st.composite
def traces(draw, max_samples=6):
    """Traces with observations that hold a number which is not finite."""
    trace = draw(certain_traces(max_samples))
    if not len(trace.footprints):
        return trace
    spoilt = draw(st.lists(st.integers(0, len(trace.footprints) - 1), max_size=3, unique=True))
    vertices, top = trace.footprints.vertices.copy(), trace.footprints.top.copy()
    radius, yaw = trace.footprints.radius.copy(), trace.yaw.copy()
    for row in spoilt:
        part = trace.footprints.part_start[row]
        places = {
            "vertices": (vertices, trace.footprints.vertex_start[part]),
            "radius": (radius, part),
            "yaw": (yaw, row),
        }
        if not np.isnan(top[row]):
            places["top"] = (top, row)
        column, index = places[draw(st.sampled_from(sorted(places)))]
        column[index] = draw(unknown_numbers)
    shapes = replace(trace.footprints, vertices=vertices, radius=radius, top=top)
    unreadable = np.isin(trace.rows, spoilt) & (trace.rows != ABSENT)
    return replace(trace, rows=np.where(unreadable, -2 - trace.rows, trace.rows), footprints=shapes, yaw=yaw)
