"""Small traces to evaluate specifications over, one sample a second."""

from __future__ import annotations

from dataclasses import replace

from spatial_replay import Footprint, Sample, Trace, TrackedObject, evaluate, parse_specification

SECOND = 10**9


def numbers(**signals):
    """A trace of numeric signals, by name; None where one is not known."""
    size = len(next(iter(signals.values())))
    return Trace.from_samples(
        Sample(
            t * SECOND, signals={name: values[t] for name, values in signals.items() if values[t] is not None}
        )
        for t in range(size)
    )


def points(*, classes=None, uncertainty=0.0, signals=None, **places):
    """A trace of points on the x axis: for each object its x in each sample, None where it is not seen."""
    size = len(next(iter(places.values())))
    classes = classes or {}
    return Trace.from_samples(
        Sample(
            t * SECOND,
            {
                name: TrackedObject(
                    Footprint.disc(x[t], 0, 0), class_name=classes.get(name), uncertainty=uncertainty
                )
                for name, x in places.items()
                if x[t] is not None
            },
            {name: values[t] for name, values in (signals or {}).items()},
        )
        for t in range(size)
    )


def with_unreadable(trace, t, name):
    """The trace with an observation whose coordinates could not be read."""
    rows = trace.rows.copy()
    at = (t, trace.names.index(name))
    rows[at] = -2 - rows[at]
    return replace(trace, rows=rows)


def judged(text, trace, **options):
    """The evaluation of a specification's text."""
    return evaluate(parse_specification(text), trace, **options)


def root(text, trace, **options):
    """The root's numbers of the only result of a specification's text."""
    return judged(text, trace, **options).result().nodes[0]
