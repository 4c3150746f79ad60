"""Compiled code loaded before the first sample, so that no sample waits for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.contacts import contacts
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.geometry.measure import Operand
from spatial_replay.inspection.automata import KeptAutomaton
from spatial_replay.logs.sink import MemorySink
from spatial_replay.recording.recording import Recording
from spatial_replay.spec import object_names, signal_names
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace


def warm_up(files: Sequence[Specification], automata: Sequence[KeptAutomaton]) -> None:
    """Record some samples into nothing, as the specifications will have it done.

    With nothing in the compiler's cache this takes many seconds, otherwise a fraction of one.

    Args:
        automata: those of the specifications.
    """
    recording = Recording(MemorySink(), files, known=automata)
    objects = ["object", *(name for file in files for name in object_names(file))]
    signals = {name: 0.0 for file in files for name in signal_names(file)}
    samples = [
        Sample(
            time_s * 10**9,
            {
                name: _tracked(index + time_s, 0.1 * index + time_s)
                for index, name in enumerate(dict.fromkeys(objects))
            },
            signals,
        )
        for time_s in range(4)
    ]
    recording.add(Trace.from_samples(samples[:1]))
    recording.add(Trace.from_samples(samples[1:]))
    # nothing is known: what may be takes code of its own
    recording.add(Trace.from_samples([Sample(10**10, {})]))
    recording.end()
    # what draws an arrow at a violation, of which these samples may have none
    shapes = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in range(2)])
    contacts(shapes, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=False)


def _tracked(kind: int, x: float) -> TrackedObject:
    box, disc = Footprint.box(x, 0, x + 1, 1), Footprint.disc(x + 0.5, 0.5, 0.5)
    footprint = (box, disc, Footprint((*box.parts, *disc.parts)))[kind % 3]
    return TrackedObject(footprint, class_name="thing", yaw=x, height=(0.0, 1.0), uncertainty=0.01)
