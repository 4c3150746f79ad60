"""Certificates: equal content has equal hashes, other content has others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from replay.runs import SPECIFICATION, PiecewiseSource, run, sample
from spatial_replay import Footprint, Sample, Trace, TrackedObject, parse_specification
from spatial_replay.replay.engine import run_replay


def _certificate(trace: Trace, text: str = SPECIFICATION) -> Mapping[str, str]:
    return run_replay(PiecewiseSource(trace, 4), [parse_specification(text)]).certificate


def _with_cube(**changes: object) -> Trace:
    samples = [sample(index) for index in range(12)]
    cube = samples[5].objects["cube"]
    assert isinstance(cube, TrackedObject)
    changed = Sample(
        samples[5].time_ns,
        {**samples[5].objects, "cube": replace(cube, **changes)},  # type: ignore[arg-type]
        samples[5].signals,
    )
    return Trace.from_samples([*samples[:5], changed, *samples[6:]])


@pytest.mark.parametrize(
    "changes",
    [
        {"footprint": Footprint.box(2.5, 0, 3.5, 1.0000001)},
        {"class_name": "block"},
        {"class_name": None},
        {"yaw": 0.0},
        {"height": None},
        {"uncertainty": 0.02},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_part_of_a_sample_shows(changes: dict[str, object]) -> None:
    before, after = _certificate(run()), _certificate(_with_cube(**changes))
    assert before["samples_sha256"] != after["samples_sha256"]
    assert before["messages_sha256"] != after["messages_sha256"]


def test_the_specification_is_known_by_its_meaning() -> None:
    spaced = SPECIFICATION.replace("spec reach", "# how far\n\nspec   reach")
    assert _certificate(run()) == _certificate(run(), spaced)
    edited = _certificate(run(), SPECIFICATION.replace("0.5", "0.6"))
    before = _certificate(run())
    assert edited["specification_sha256"] != before["specification_sha256"]
    assert edited["results_sha256"] != before["results_sha256"]
    assert edited["samples_sha256"] == before["samples_sha256"]


def test_a_sample_more_shows_in_every_hash_but_the_specification_s() -> None:
    shorter, longer = _certificate(run(12)), _certificate(run(13))
    assert {key for key in shorter if shorter[key] == longer[key]} == {
        "specification_sha256",
        "spatial_replay_version",
    }
