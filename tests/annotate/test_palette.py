"""Colours of the states of results: everybody distinguishes any two of them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import pytest

from spatial_replay.annotate.scene.scene_frames import STANDING_WORDS
from spatial_replay.palette import SIGNS
from spatial_replay.report.page import DARK, LIGHT

# Machado, Oliveira and Fernandes 2009, for sight without red or green cones
SIGHTS = {
    "normal": np.eye(3),
    "protanope": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranope": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
# from linear red, green and blue to X, Y and Z by those of white (D65)
TO_XYZ = np.array(
    [[0.4339530, 0.3762192, 0.1898252], [0.2126729, 0.7151522, 0.0721750], [0.0177566, 0.1094680, 0.8727754]]
)


def lab(colour: tuple[float, float, float], sight: np.ndarray) -> np.ndarray:
    """L, a and b of a colour (CIE 1976) as a sight sees it."""
    shares = np.array(colour)
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(TO_XYZ @ np.clip(sight @ linear, 0.0, 1.0))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("sight", SIGHTS)
def test_the_colours_of_any_two_states_differ_by_fifteen(sight: str) -> None:
    seen = {words: lab(colour, SIGHTS[sight]) for words, colour in STANDING_WORDS.values()}
    assert len(seen) == 5
    differences = {pair: np.linalg.norm(seen[pair[0]] - seen[pair[1]]) for pair in combinations(seen, 2)}
    assert min(differences.values()) >= 15.0, differences


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("colours", [{**SIGNS, **LIGHT}, {**SIGNS, **LIGHT, **DARK}], ids=["light", "dark"])
def test_the_colours_of_any_two_states_on_pages_differ_by_fifteen(
    colours: Mapping[str, str], sight: str
) -> None:
    pages = [
        ("positive", "negative", "pending", "neutral"),
        ("positive-line", "negative-line", "pending", "quiet"),
        ("positive-text", "negative-text", "pending", "quiet"),
    ]
    for names in pages:
        seen = [
            lab(tuple(int(colours[name][place : place + 2], 16) / 255 for place in (1, 3, 5)), SIGHTS[sight])
            for name in names
        ]
        differences = {
            pair: np.linalg.norm(seen[pair[0]] - seen[pair[1]]) for pair in combinations(range(4), 2)
        }
        assert min(differences.values()) >= 15.0, (names, differences)
