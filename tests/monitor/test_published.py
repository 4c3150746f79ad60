"""The figures published for the paper's scenes, and vectors made by another implementation."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from spatial_replay import (
    ConvexPart,
    Footprint,
    Monitor,
    Sample,
    Trace,
    TrackedObject,
    evaluate,
    parse_specification,
    read_trace,
)

TOLERANCE = 1e-6


SCENES = (
    "blocks_moving_passage",
    "blocks_move_violation",
    "table_scene5_parked",
    "table_scene5_parked_modified",
)


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_of_the_paper_at_every_sample(data_folder, scene):
    expected = json.loads((data_folder / "paper" / "expected.json").read_text())[scene]
    trace = read_trace(data_folder / "paper" / f"{scene.removesuffix('_modified')}.jsonl.gz")
    start = expected["start_sample"]
    result = evaluate(
        parse_specification(expected["spec"]), trace, start_ns=int(trace.times_ns[start])
    ).result()
    np.testing.assert_allclose(result.nodes[0].value, expected["value"], rtol=0, atol=TOLERANCE)
    assert result.robustness == pytest.approx(expected["final"], abs=TOLERANCE)
    first = expected["first_satisfied_sample"]
    assert result.first_satisfied_ns == (None if first is None else trace.times_ns[first])
    assert result.verdict == ("satisfied" if expected["final"] >= 0 else "violated")


def test_the_passage_of_the_paper(data_folder):
    expected = json.loads((data_folder / "paper" / "expected.json").read_text())["blocks_moving_passage"]
    assert expected["final"] == pytest.approx(15.35, abs=0.005)
    assert expected["first_satisfied_sample"] == 1505


def test_vectors_of_another_implementation(data_folder):
    cases = json.loads((data_folder / "vectors" / "semantics.json").read_text())["cases"]
    chosen = [case for case in cases if case["semantics"] == "ltlf"]
    assert len(chosen) > 100
    for case in chosen:
        samples = list(map(sample_from_frame, case["frames"]))
        start_ns = samples[case["start_sample"]].time_ns
        # these give an equality of signals a margin: that of both of its comparisons
        text = re.sub(r"\(force == ([-.0-9]+)\)", r"((force <= \1) and (force >= \1))", case["spec"])
        specification = parse_specification(text)
        result = evaluate(specification, Trace.from_samples(samples), start_ns=start_ns).result()
        for name in ("value", "now", "lower", "upper"):
            np.testing.assert_allclose(
                getattr(result.nodes[0], name),
                [np.nan if number is None else float(number) for number in case[name]],
                rtol=0, atol=TOLERANCE, err_msg=f"{name} of {case['spec']}",
            )  # fmt: skip
        assert result.verdict == case["verdict"], case["spec"]
        monitor = Monitor(specification, start_ns=start_ns)
        updates = [monitor.update(sample).specs[0].numbers for sample in samples][case["start_sample"] :]
        assert np.stack(updates, axis=-1).tobytes() == result.series.tobytes(), case["spec"]


def sample_from_frame(frame):
    return Sample(
        frame["time_ns"],
        {
            seen["name"]: TrackedObject(
                Footprint(tuple(ConvexPart(part["vertices"], part["radius"]) for part in seen["parts"])),
                class_name=seen.get("class"),
                yaw=seen.get("yaw"),
                height=tuple(seen["height"]) if "height" in seen else None,
                uncertainty=seen.get("uncertainty", 0.0),
            )
            for seen in frame["objects"]
        },
        frame.get("signals", {}),
    )
