"""What the arrow of a scene says in every message: numbers that are true where they are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

import spatial_replay as sr
from spatial_replay.logs.source import MemorySource
from spatial_replay.logs.topics import SCENE
from spatial_replay.replay.engine import run_replay

STEP_NS = 100_000_000


def labels(folder: Path, text: str, gaps: list[float], unit: str = "") -> list[str]:
    """The arrow's label in each message, where two boxes are that far apart at 10 Hz."""
    samples = [
        sr.Sample(
            index * STEP_NS,
            {"a": sr.Footprint.box(0, 0, 1, 1), "b": sr.Footprint.box(1 + gap, 0, 2 + gap, 1)},
        )
        for index, gap in enumerate(gaps)
    ]
    trace = replace(sr.Trace.from_samples(samples), units={"": unit} if unit else {})
    output = folder / "annotated.mcap"
    run_replay(MemorySource(trace, "run"), [sr.parse_specification(text)], output=output)
    found = []
    with output.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(["/spatial/scene"]):
            drawn = SceneUpdate.FromString(message.data).entities
            found.append("".join(entity.texts[-1].text for entity in drawn if entity.id == "witness"))
    return found


def test_an_arrow_with_a_past_number_joins_the_places_of_then_and_marks_what_failed(tmp_path: Path) -> None:
    samples = [
        sr.Sample(index * STEP_NS, {"a": sr.Footprint.box(0, 0, 1, 1), "b": sr.Footprint.box(x, 0, x + 1, 1)})
        for index, x in enumerate((3.0, 4.0, 5.0, 6.0, 7.0, 8.0))
    ]
    output, log = tmp_path / "annotated.mcap", MemorySource(sr.Trace.from_samples(samples), "run")
    run_replay(log, [sr.parse_specification("spec s = F[0s, 0.3s] (a dist b <= 1.5)")], output=output)
    with output.open("rb") as stream:
        drawn = [SceneUpdate.FromString(each.data) for *_, each in make_reader(stream).iter_messages([SCENE])]
    for message in drawn[4:]:
        entities = {each.id: each for each in message.entities}
        [arrow], [*names, label], [then] = (
            getattr(entities["witness"], part) for part in ("arrows", "texts", "lines")
        )
        # at 0 s the boxes were 2 apart
        assert label.text == "a dist b <= 1.5 at 0.000 s: -0.5"
        assert (arrow.pose.position.x, arrow.shaft_length + arrow.head_length) == (1.0, 2.0)
        assert (min(each.x for each in then.points), max(each.x for each in then.points)) == (0.0, 4.0)
        assert [name.text for name in names] == ["a ✕", "b ✕"]
        assert not any(entities[f"object/{name}"].texts for name in "ab")
    assert [each.texts[0].text for each in drawn[0].entities if each.id == "object/a"] == ["a"]


NEARING = [5.0 - step / 4 for step in range(20)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        # only the first sample is asked: the number stays that which decided
        (
            "(a dist b <= 6) -> F[0s, 0.4s] (a dist b <= 1.5)",
            {
                3: "",
                4: "a dist b <= 1.5 now: -2.5",
                **dict.fromkeys((5, 18), "a dist b <= 1.5 at 0.400 s: -2.5"),
            },
        ),
        (
            "(a dist b >= 6) and F (a dist b <= 0.5)",
            {0: "a dist b >= 6 now: -1", **dict.fromkeys((1, 10, 19), "a dist b >= 6 at 0.000 s: -1")},
        ),
        # what had to follow was missed then, even where the condition is false by now (from sample 13 on)
        (
            "G ((a dist b >= 2) -> F[0s, 0.4s] (a dist b <= 0.5))",
            {
                3: "",
                4: "a dist b <= 0.5 now: -3.5",
                **dict.fromkeys((5, 13, 18), "a dist b <= 0.5 at 0.400 s: -3.5"),
            },
        ),
        # an atom that should not hold is not written as if it failed
        (
            "G not (a dist b <= 4)",
            {
                4: "",
                5: "a dist b <= 4 now: must not hold, holds by 0.25",
                10: "a dist b <= 4 now: must not hold, holds by 1.5",
            },
        ),
    ],
    ids=["deadline", "first sample", "response", "negation"],
)
def test_what_the_arrow_says_is_true_in_every_sample(
    tmp_path: Path, text: str, expected: dict[int, str]
) -> None:
    found = labels(tmp_path, f"spec s = {text}", NEARING)
    assert {index: found[index] for index in expected} == expected


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (
            "forall p, q in boxes: p dist q >= 2.5",
            {10: "", 11: "a dist b >= 2.5 now: -0.25", 19: "a dist b >= 2.5 now: -2.25"},
        ),
        (
            "not (exists p in boxes: p dist b <= 2.5 and not (p ovlp b))",
            {9: "", 10: "", 19: ""},
        ),
        (
            "not (exists p in (boxes except b): p dist b <= 2.5)",
            {
                9: "",
                11: "a dist b <= 2.5 now: must not hold, holds by 0.25",
                19: "a dist b <= 2.5 now: must not hold, holds by 2.25",
            },
        ),
        (
            "(forall p in (boxes except b): p dist b >= 2.5) and a dist b >= 1",
            {11: "a dist b >= 2.5 now: -0.25", 19: "a dist b >= 2.5 now: -2.25"},
        ),
    ],
    ids=["two objects", "no single atom", "exists", "conjunction"],
)
def test_the_arrow_of_a_quantifier_names_the_objects_that_decide_it(
    tmp_path: Path, asked: str, expected: dict[int, str]
) -> None:
    found = labels(tmp_path, f"group boxes = all\nspec s = G ({asked})", NEARING)
    assert {index: found[index] for index in expected} == expected


def test_every_label_of_an_arrow_has_its_unit_and_three_digits(tmp_path: Path) -> None:
    sizes = [2.5534e-05, 0.00141421, 0.0517, 0.132, 12.3456, 987654.0]
    found = labels(tmp_path, "spec s = G (a dist b >= 987655)", [987655 - 1.5, 987000.0], unit="mm")
    assert found[0] == "a dist b >= 987655 now: -1.5 mm"
    for index, size in enumerate(sizes):
        folder = tmp_path / str(index)
        folder.mkdir()
        [label, *_] = labels(folder, "spec s = G (a dist b <= 0)", [size], unit="µm")
        prefix, _, number = label.partition(": ")
        assert (prefix, number.endswith(" µm")) == ("a dist b <= 0 now", True)
        assert np.isclose(float(number.removesuffix(" µm")), -size, rtol=5e-3)
