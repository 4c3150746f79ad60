"""Traces in notebooks."""

from __future__ import annotations

import pytest

import spatial_replay as sr
from pages import shown

SAMPLES = [
    sr.Sample(
        index * 10**8,
        {"mover": sr.Footprint.box(index, 0, index + 1, 1), "post": sr.Footprint.disc(3, 4, 0.5)},
    )
    for index in range(5)
]


@pytest.mark.usefixtures("figures")
def test_a_trace_is_drawn_with_start_end_trails_and_regions() -> None:
    specification = sr.parse_specification("region goal = box(4, 0, 6, 2)\nspec s = F mover enclosedin goal")
    ax = sr.Trace.from_samples(SAMPLES).plot(specification=specification)
    assert {text.get_text() for text in ax.texts} == {"mover", "post", "goal"}
    trail = ax.lines[0].get_xydata()
    assert trail[[0, -1]].tolist() == [[0.5, 0.5], [4.5, 0.5]]
    assert "footprint units" in ax.get_xlabel()
    assert ax.get_title("left") == "5 samples over 0.400 s"


@pytest.mark.usefixtures("figures")
def test_names_of_objects_that_end_at_one_place_are_not_written_over_each_other() -> None:
    names = [f"object {number}" for number in range(4)]
    sample = sr.Sample(0, {name: sr.Footprint.disc(3, 4, 0.5) for name in names})
    ax = sr.Trace.from_samples([sample]).plot()
    ax.figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts]
    assert len(boxes) == len(names)
    assert not any(one.overlaps(other) for one in boxes for other in boxes if one is not other)


def test_a_page_says_in_how_many_samples_an_object_is() -> None:
    text = shown(sr.Trace.from_samples(SAMPLES[:3]))
    assert "3 samples over 0.200 s" in text
    assert "mover3" in text
