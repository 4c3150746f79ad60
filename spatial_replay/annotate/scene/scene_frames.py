"""What messages of the scene show, as values, for a page that draws them itself; and the scene's colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spatial_replay.annotate.rings import Rings
from spatial_replay.annotate.scene.scene_template import OBJECT, REGION, Banner, CauseText, Region, border_of
from spatial_replay.annotate.scene.scene_text import ArrowTexts
from spatial_replay.annotate.violations import Presence, Violations
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE

_LEAST: Final = 0.4
"""How far the colour of the slightest robustness is from grey, so that its sign shows."""

_OPACITY: Final = 0.6
"""Of a map's cells, so that the scene above them stays visible."""


def colours(robustness: ArrayLike, scale: ArrayLike) -> Floats:
    """Return the colours (..., 3) of robustness (...): full at `scale`, grey where NaN.

    Args:
        scale: above 0, in the unit of the robustness; one, or an array that goes with it.
    """
    values = np.asarray(robustness, np.float64)[..., None]
    share = _LEAST + (1.0 - _LEAST) * np.minimum(np.abs(values) / np.asarray(scale)[..., None], 1.0)
    hue = np.where(values >= 0.0, POSITIVE, NEGATIVE)
    mixed = np.where(np.isnan(values), NEUTRAL, NEUTRAL + share * (hue - NEUTRAL))
    # the steps of a screen: finer ones are invisible and compress badly
    return np.asarray(np.round(mixed * 255.0) / 255.0)


def cell_colours(robustness: Floats) -> NDArray[np.uint8]:
    """Return the colours (..., 4) of cells (...): full where the map is largest, transparent where NaN."""
    largest = float(np.abs(robustness[np.isfinite(robustness)]).max(initial=0.0))
    opacity = np.where(np.isnan(robustness), 0.0, _OPACITY)
    shares = np.concatenate([colours(robustness, largest or 1.0), opacity[..., None]], axis=-1)
    return np.asarray(np.round(255.0 * shares), np.uint8)


ABSENT, DELETED, FIRST_FORM = -1, 0, 1
"""What an object is in a message: not there, just gone, or drawn in one of the forms from here on."""


class DrawnEntity(NamedTuple):
    """An object or a region in one message.

    Attributes:
        rings: its outlines, (n, 2) each.
        colour: red, green and blue, 0 to 255.
        class_name: of an object that has one.
    """

    rings: tuple[Floats, ...]
    colour: tuple[int, int, int]
    class_name: str | None = None


class DrawnViolation(NamedTuple):
    """The arrow at the first violation of a result in one message.

    Attributes:
        ends: (2, 2), from where to where it points.
        label: what decides it and the robustness, as it is written beside the arrow.
        result: which of the results is violated.
        node: id of the requirement that is violated, or of the atom that settled the violation.
        robustness: that of the requirement, in the sign that counts.
        leaf: what decides it, an index among the leaves of the result's program.
        moment_ns: the time of the earlier sample that the number is of, which settled the violation; None if
            it is of this one.
        holds: whether it is an atom that holds and should not.
    """

    ends: Floats
    label: str
    result: int
    node: int
    robustness: float
    leaf: int = -1
    moment_ns: int | None = None
    holds: bool = False


class Arrows(NamedTuple):
    """The arrows of one result in S messages.

    Attributes:
        result: which of the results it is.
        violations: of the S samples.
        texts: what decides each, and its number.
    """

    result: int
    violations: Violations
    texts: ArrowTexts

    def at(self, index: int) -> DrawnViolation | None:
        """Return the arrow in one message, if there is one."""
        found = self.violations
        if not found.is_shown[index]:
            return None
        robustness, holds = float(found.robustness[index]), bool(found.holds[index])
        label = self.texts.label(index)
        moment_ns = int(found.moment_ns[index]) if found.moment_ns[index] >= 0 else None
        node, leaf = int(found.node[index]), int(found.leaf[index])
        return DrawnViolation(
            found.points[index], label, self.result, node, robustness, leaf, moment_ns, holds
        )


class SceneFrame(NamedTuple):
    """What one message shows.

    Attributes:
        entities: by their ids.
        violations: of each result that an arrow can show it of.
    """

    entities: Mapping[str, DrawnEntity]
    violations: tuple[DrawnViolation, ...]

    @property
    def corners(self) -> int:
        """How many corners its outlines have."""
        return sum(len(ring) for each in self.entities.values() for ring in each.rings)


@dataclass(frozen=True, eq=False)
class SceneFrames:
    """What S messages show.

    Attributes:
        times_ns: (S,) int64.
        objects, regions: (S, objects) and (S, regions), the worst robustness of their requirements.
        object_colours, region_colours: the same with a last axis of red, green and blue, 0 to 1.
        scale: the robustness at which colours are full.
    """

    times_ns: Integers
    objects: Floats
    regions: Floats
    object_colours: Floats
    region_colours: Floats
    scale: float
    _presence: Presence
    _content: SceneContent
    _regions: tuple[Region, ...]
    _find_arrows: Callable[[], Sequence[Arrows]]

    @cached_property
    def _arrows(self) -> Sequence[Arrows]:
        return self._find_arrows()

    def frame(self, index: int) -> SceneFrame:
        """Return what one of the messages shows."""
        entities = {
            REGION + region.name: DrawnEntity(tuple(border_of(region)), _bytes(colour))
            for region, colour in zip(self._regions, self.region_colours[index], strict=True)
        }
        content = self._content
        for column, name in enumerate(content.names):
            if content.forms[index, column] >= FIRST_FORM:
                rings = content.rings.rings_of(int(content.observations[index, column]))
                colour = _bytes(self.object_colours[index, column])
                code = int(self._presence.class_code[index, column])
                class_name = self._presence.classes[code] if code >= 0 else None
                entities[OBJECT + name] = DrawnEntity(rings, colour, class_name)
        arrows = (each.at(index) for each in self._arrows)
        violations = tuple(each for each in arrows if each is not None)
        return SceneFrame(entities, violations)


class SceneContent(NamedTuple):
    """What S messages hold.

    Attributes:
        names: objects that are shown, or have just been.
        rows: (S, names), rows of the trace; below 0 where an object is absent.
        forms: (S, names), `ABSENT`, `DELETED`, or from `FIRST_FORM` on the number of its form.
        styles: (S, names), its level, and whether it has a label as the last bit; -1 where it is absent.
        observations: (S, names), rows of `rings` and `footprints`.
        violations: of the S samples.
        arrow: (S,), the same as `forms` for the arrow at the worst violation; its forms are `causes`.
        causes: what decides violations, in words.
        numbers: of each violation that is shown, its number with its unit.
        banner: (S,), which of `banners`.
    """

    names: tuple[str, ...]
    rows: Integers
    forms: Integers
    styles: Integers
    observations: Integers
    footprints: FootprintBatch
    rings: Rings
    violations: Violations
    arrow: Integers
    causes: tuple[CauseText, ...]
    numbers: Sequence[bytes]
    banner: Integers
    banners: tuple[Banner | None, ...]


def _bytes(colour: Floats) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * share) for share in colour.tolist())
    return red, green, blue
