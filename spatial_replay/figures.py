"""The one place that knows the library behind figures; it loads when something is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from spatial_replay.errors import UsageError
from spatial_replay.palette import NEGATIVE, POSITIVE
from spatial_replay.wording import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

INK: Final = "#24292f"
"""Of texts on light colours, whatever the style of the page."""
_MIDDLE: Final = (0.96, 0.96, 0.96)


def new_panels(
    rows: int, columns: int, size: tuple[float, float], *, same_x: bool = False
) -> tuple[Axes, ...]:
    """Axes in a new figure, row by row.

    Args:
        size: width and height of the figure in inches.
        same_x: whether all show the same times.

    Raises:
        UsageError: the library is not installed.
    """
    _, grid = _pyplot().subplots(
        rows, columns, figsize=size, squeeze=False, sharex=same_x, layout="constrained"
    )
    return tuple(grid.flat)


def new_panel(size: tuple[float, float]) -> Axes:
    """Axes that are alone in a new figure of some width and height in inches.

    Raises:
        UsageError: the library is not installed.
    """
    return new_panels(1, 1, size)[0]


def signed_colours() -> Colormap:
    """From vermillion over almost white to blue: for numbers whose sign matters."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("robustness", [NEGATIVE, _MIDDLE, POSITIVE])


def draw_curve(ax: Axes, points: Sequence[tuple[float, float]], colour: str) -> None:
    """A chain of cubic Bézier curves, each from where the last one ends: 1 + 3n points."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = [Path.MOVETO, *[Path.CURVE4] * (len(points) - 1)]
    ax.add_patch(PathPatch(Path(points, codes), fill=False, edgecolor=colour, linewidth=1.0))


def draw_disc(ax: Axes, centre: tuple[float, float], radius: float, colour: str) -> None:
    """A disc with an outline."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle(centre, radius, facecolor=colour, edgecolor=INK, linewidth=1.0, zorder=3))


def plain(text: str, longest: int = 72) -> str:
    """A text that a figure shows as it stands, cut after so many characters."""
    return printable(text, longest).replace("$", r"\$")


def _pyplot() -> Any:
    try:
        from matplotlib import pyplot
    except ImportError:
        raise UsageError(
            "figures take matplotlib, which is not installed: pip install 'spatial-replay[notebook]'"
        ) from None
    return pyplot
