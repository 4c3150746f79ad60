"""Figures for notebooks. The first figure imports matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Final, Literal

from spatial_replay.errors import UsageError, importing
from spatial_replay.palette import MAP
from spatial_replay.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

INK: Final = "#24292f"
"""Colour of text on light backgrounds, in light and dark pages."""


def new_panels(
    rows: int, columns: int, size: tuple[float, float], *, same_x: bool = False
) -> tuple[Axes, ...]:
    """Return the axes of a new figure, row by row.

    Args:
        size: width and height of the figure in inches.
        same_x: whether all axes share the time axis.

    Raises:
        UsageError: matplotlib is not installed.
    """
    with importing("figures need matplotlib", extra="notebook"):
        from matplotlib import pyplot
    _, grid = pyplot.subplots(rows, columns, figsize=size, squeeze=False, sharex=same_x, layout="constrained")
    return tuple(grid.flat)


def new_panel(size: tuple[float, float]) -> Axes:
    """Return the axes of a new figure with one panel.

    Args:
        size: width and height of the figure in inches.

    Raises:
        UsageError: matplotlib is not installed.
    """
    return new_panels(1, 1, size)[0]


def picture(ax: Axes, kind: Literal["png", "svg"]) -> bytes:
    """Close the figure of some axes, and return it as the bytes of a file. Equal figures give equal bytes."""
    from matplotlib import pyplot, rc_context

    stream, figure = BytesIO(), ax.get_figure(root=True)
    if figure is None:
        raise UsageError("these axes are in no figure; draw into new ones")
    # ids in an SVG are random without a salt, and its metadata has the time of writing:
    # https://matplotlib.org/stable/users/explain/customizing.html
    with rc_context({"svg.hashsalt": "spatial-replay"}):
        figure.savefig(stream, format=kind, dpi=144, metadata={"Date": None} if kind == "svg" else None)
    pyplot.close(figure)
    return stream.getvalue()


def signed_colours() -> Colormap:
    """Return a colour map from vermillion over almost white to blue, for signed numbers."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("robustness", MAP)


def draw_curve(ax: Axes, points: Sequence[tuple[float, float]], colour: str) -> None:
    """Draw n joined cubic Bézier curves through 1 + 3n points."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = [Path.MOVETO, *[Path.CURVE4] * (len(points) - 1)]
    ax.add_patch(PathPatch(Path(points, codes), fill=False, edgecolor=colour, linewidth=1.0))


def draw_disc(ax: Axes, centre: tuple[float, float], radius: float, colour: str) -> None:
    """Draw a disc with an outline."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle(centre, radius, facecolor=colour, edgecolor=INK, linewidth=1.0, zorder=3))


def plain(text: str, longest: int = 72) -> str:
    """Return text without control characters or formulas of matplotlib, cut after `longest` characters."""
    return printable(text, longest).replace("$", r"\$")
