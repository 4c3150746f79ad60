"""Printable sheets of tags in true size, and calibration of cameras from frames with these tags.

Only this module imports fpdf2.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.errors import LogError, OutputError, UsageError, importing
from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.opencv import Calibration, Camera, Frame, TagDetector, calibrate, tag_cells
from spatial_replay.perception.tags_file import MountedTag
from spatial_replay.text import plural

# ------------------------------------------------------------------------------------------------ calibration

_LEAST_TAGS: Final = 4
_LEAST_VIEWS: Final = 6
_MOST_VIEWS: Final = 60
_APART: Final = 0.04
"""Least shift of a tag between two views, fraction of the image's width; equal views add nothing."""

_LOOSE: Final = 0.02
"""Largest relative standard deviation of the focal length; above it, the views are too similar."""

_WRONG: Final = 8.0
"""Largest root mean square error of corners, pixels. A larger error means that the frames show another sheet.

The error of a bent sheet is far smaller.
"""

_WIDE: Final = 0.6
"""Least share of the image's width and height that the tags of all views should cover."""


class Calibrated(NamedTuple):
    """A calibration with remarks on its quality.

    Attributes:
        views: number of frames that the calibration uses.
        remarks: advice for a better calibration.
    """

    calibration: Calibration
    views: int
    remarks: tuple[str, ...]


def calibrate_camera(
    name: str, frames: Iterable[Frame], family: str, references: Sequence[MountedTag]
) -> Calibrated:
    """Calibrate a camera from frames that show tags from several sides.

    Args:
        name: name of the source of the frames, for errors.
        references: tags at their places on one plane.

    Raises:
        LogError: there is no frame.
        UsageError: too few frames show enough tags from different sides, or the tags are not at the places
            of the references.
    """
    detector = TagDetector(family)
    references_by_id = {tag.id: tag.corners for tag in references}
    plane_points: list[Floats] = []
    view_pixels: list[Floats] = []
    views: list[dict[int, Floats]] = []
    size_px: tuple[int, int] | None = None
    tagged_frame_count = 0
    for frame in frames:
        if frame.detections is not None:
            raise UsageError(f"{name} has detections without images; a camera is calibrated from its images")
        size_px = frame.image.shape[1], frame.image.shape[0]
        view = {
            detection.id: detection.corners
            for detection in detector.detect(frame.image)
            if detection.id in references_by_id
        }
        tagged_frame_count += len(view) >= _LEAST_TAGS
        if len(view) < _LEAST_TAGS or not _is_new(view, views, _APART * size_px[0]):
            continue
        views.append(view)
        reference_corners = np.concatenate([references_by_id[tag_id] for tag_id in view])
        plane_points.append(
            np.concatenate([reference_corners, np.zeros((len(reference_corners), 1))], axis=1)
        )
        view_pixels.append(np.concatenate(list(view.values())))
        if len(views) == _MOST_VIEWS:
            break
    if size_px is None:
        raise LogError(f"{name} has no frame that can be read")
    if len(views) < _LEAST_VIEWS:
        raise UsageError(
            f"{name}: {plural(tagged_frame_count, 'frame')} with {_LEAST_TAGS} or more of the tags, in"
            f" {plural(len(views), 'different view')}; {_LEAST_VIEWS} views are needed: tilt the sheet, or"
            " move the camera around the table, near and far"
        )
    calibration = calibrate(plane_points, view_pixels, size_px)
    if not calibration.rms < _WRONG or not np.isfinite(calibration.deviations).all():
        raise UsageError(
            f"{name}: no camera sees the tags like that: with the best one, corners are off by"
            f" {calibration.rms:.1f} pixels; give --family, --ids, --size and --paper as the sheet was"
            " printed, or check the places of the reference tags"
        )
    return Calibrated(calibration, len(views), tuple(_remarks(calibration, view_pixels, size_px)))


def _is_new(
    corners_by_id: dict[int, Floats], views: Sequence[dict[int, Floats]], least_shift_px: float
) -> bool:
    """Return whether the tags are at other places than in each earlier view."""
    for earlier_view in views:
        shared_ids = [tag_id for tag_id in corners_by_id if tag_id in earlier_view]
        shifts_px = [
            float(np.linalg.norm(corners_by_id[tag_id] - earlier_view[tag_id], axis=1).mean())
            for tag_id in shared_ids
        ]
        if shifts_px and max(shifts_px) < least_shift_px:
            return False
    return True


def _remarks(calibration: Calibration, view_pixels: Sequence[Floats], size_px: tuple[int, int]) -> list[str]:
    remarks = []
    (fx, fy), deviations = calibration.camera.focal, calibration.deviations
    if max(deviations[0] / fx, deviations[1] / fy) > _LOOSE:
        remarks.append("the views are too much alike to measure the focal length: tilt the sheet more")
    all_pixels = np.concatenate(view_pixels)
    covered_shares = (all_pixels.max(axis=0) - all_pixels.min(axis=0)) / np.array(size_px)
    if covered_shares.min() < _WIDE:
        remarks.append(
            f"tags were seen in {covered_shares[0]:.0%} of the image's width and {covered_shares[1]:.0%} of"
            " its height: bring them to its corners, where a lens bends most"
        )
    if calibration.rms > 1.0:
        remarks.append(
            f"corners are off by {calibration.rms:.1f} pixels: is the sheet flat, printed at 100 %, the"
            " picture sharp?"
        )
    return remarks


def camera_text(camera: Camera) -> str:
    """Return the part of a tags file that describes a camera."""
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.centre, camera.size
    lines = [
        "camera:",
        f"  size: [{width}, {height}]",
        f"  focal: [{fx:.3f}, {fy:.3f}]",
        f"  centre: [{cx:.3f}, {cy:.3f}]",
    ]
    if camera.distortion:
        lines.append(
            f"  distortion: [{', '.join(f'{coefficient:.6g}' for coefficient in camera.distortion)}]"
        )
    return "\n".join(lines) + "\n"


# ----------------------------------------------------------------------------------------------------- sheets

PAPERS: Final[Mapping[str, tuple[float, float]]] = MappingProxyType(
    {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
)
"""Width and height of papers, millimetres."""

MOST_TAGS: Final = 1000
_MARGIN: Final = 12.0
"""Free margin around a page, millimetres."""

_FOOT: Final = 14.0
"""Height above the lower margin that is free for the ruler, millimetres."""

_CAPTION: Final = 5.0
_RULER: Final = 100.0


@dataclass(frozen=True, slots=True)
class TagSheet:
    """Tags on pages, in rows from the top.

    Attributes:
        ids: numbers of the tags, in their order.
        size: edge of the black squares, metres.
        paper: one of `PAPERS`.

    Raises:
        UsageError: no tag, too many tags, a tag twice, or a size that does not fit the paper.
    """

    family: str
    ids: tuple[int, ...]
    size: float
    paper: str = "a4"

    def __post_init__(self) -> None:
        if not 0 < len(self.ids) <= MOST_TAGS:
            raise UsageError(f"give 1 to {MOST_TAGS} tags; these are {len(self.ids)}")
        repeated_ids = [tag_id for tag_id, count in Counter(self.ids).items() if count > 1]
        if repeated_ids:
            raise UsageError(f"tag {repeated_ids[0]} is given more than once; name each tag once")
        if self.paper not in PAPERS:
            raise UsageError(f"there is no paper {self.paper!r}; known are {', '.join(PAPERS)}")
        if not (math.isfinite(self.size) and self.size > 0) or not self._columns or not self._rows:
            raise UsageError(
                f"tags of {self.size * 1e3:g} mm do not fit on {self.paper}; give a smaller --size, above 0"
            )

    @property
    def per_page(self) -> int:
        """Number of tags on a page."""
        return self._columns * self._rows

    def references(self) -> tuple[MountedTag, ...]:
        """Return the tags of the first page. Places are in metres from the page's lower left corner, y up."""
        _, page_height_mm = PAPERS[self.paper]
        return tuple(
            MountedTag(tag_id, self.size, x_mm / 1e3, (page_height_mm - y_mm) / 1e3)
            for tag_id, (x_mm, y_mm) in zip(self.ids[: self.per_page], self._centres(), strict=False)
        )

    def write(self, output: Path) -> int:
        """Write the sheets as a PDF, and return the number of pages. Equal sheets give equal bytes.

        Raises:
            UsageError: fpdf2 is not installed, or the family lacks a tag.
            OutputError: the file cannot be written.
        """
        with importing("sheets of tags need fpdf2", extra="vision"):
            from fpdf import FPDF
        width_mm, height_mm = PAPERS[self.paper]
        pdf = FPDF(unit="mm", format=(width_mm, height_mm))
        pdf.set_auto_page_break(False)
        # a fixed date, so that equal sheets give equal bytes
        pdf.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))
        pdf.set_title(f"AprilTags {self.family}, {self._millimetres:g} mm")
        pdf.set_font("helvetica", size=8)
        pages = [
            self.ids[first_index : first_index + self.per_page]
            for first_index in range(0, len(self.ids), self.per_page)
        ]
        for page in pages:
            pdf.add_page()
            for tag_id, (x_mm, y_mm) in zip(page, self._centres(), strict=False):
                edge_mm = self._millimetres
                left_mm, top_mm = x_mm - edge_mm / 2, y_mm - edge_mm / 2
                cells = tag_cells(self.family, tag_id)
                cell_mm = edge_mm / len(cells)
                for row, row_cells in enumerate(cells):
                    for begin_column, end_column in _runs(row_cells.tolist()):
                        run_left_mm, run_mm = begin_column * cell_mm, (end_column - begin_column) * cell_mm
                        pdf.rect(left_mm + run_left_mm, top_mm + row * cell_mm, run_mm, cell_mm, "F")
                caption = f"{self.family}   {tag_id}   {edge_mm:g} mm"
                pdf.text(left_mm, top_mm + edge_mm + cell_mm + _CAPTION - 1.5, caption)
            y_mm = height_mm - _MARGIN
            pdf.line(_MARGIN, y_mm, _MARGIN + _RULER, y_mm)
            for tick in range(11):
                pdf.line(_MARGIN + 10 * tick, y_mm, _MARGIN + 10 * tick, y_mm - (4 if tick % 5 == 0 else 2))
            pdf.text(_MARGIN + _RULER + 3, y_mm, "100 mm: print at 100 %, and measure")
        try:
            output.write_bytes(bytes(pdf.output()))
        except OSError as error:
            raise OutputError(f"{output}: {(error.strerror or str(error)).lower()}") from None
        return len(pages)

    @property
    def _millimetres(self) -> float:
        return round(self.size * 1e3, 6)

    @property
    def _pitch(self) -> tuple[float, float]:
        """Distances of tags across and down, millimetres, with white rims and a caption below."""
        side = self._millimetres * 1.4
        return side, side + _CAPTION

    @property
    def _columns(self) -> int:
        return int((PAPERS[self.paper][0] - 2 * _MARGIN) // self._pitch[0])

    @property
    def _rows(self) -> int:
        return int((PAPERS[self.paper][1] - 2 * _MARGIN - _FOOT) // self._pitch[1])

    def _centres(self) -> Sequence[tuple[float, float]]:
        """Return the centres of all tags of a page, in millimetres from its upper left corner."""
        pitch_x, pitch_y = self._pitch
        return [
            (_MARGIN + (column + 0.5) * pitch_x, _MARGIN + row * pitch_y + pitch_x / 2)
            for row in range(self._rows)
            for column in range(self._columns)
        ]


def _runs(row_cells: Sequence[int]) -> list[tuple[int, int]]:
    """Return the begin and end of each run of black cells in a row."""
    runs: list[tuple[int, int]] = []
    for column, brightness in enumerate(row_cells):
        if brightness:
            continue
        if runs and runs[-1][1] == column:
            runs[-1] = runs[-1][0], column + 1
        else:
            runs.append((column, column + 1))
    return runs
