"""Tuned specifications, comparisons and planner decisions in notebooks, as HTML and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from spatial_replay.annotate.scene.scene_template import outlines_of
from spatial_replay.compare.runs import LogDiff
from spatial_replay.compare.specifications import SpecDiff, SpecificationDiff
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint, moved_object
from spatial_replay.html import Html, element, quiet, table, verdict_mark
from spatial_replay.lazy import page_of
from spatial_replay.logs.output_file import replacing
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanCandidate, PlanDecision, PlanEdge, PlanTarget
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.notebook import html, plot
from spatial_replay.notebook.figures import INK, new_panel, new_panels, picture, plain, signed_colours
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.planning.decision_log import decision_lines, decision_message, target_message
from spatial_replay.planning.decisions import Step
from spatial_replay.planning.maps import FREE, REASONS, GradientMap
from spatial_replay.planning.read import LoggedStep
from spatial_replay.text import plural
from spatial_replay.trace.trace import Sample
from spatial_replay.tuning.tuned import Surface, Tuning

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from spatial_replay.planning.decisions import Target

_MOST_RUNS: Final = 50
"""Limit of runs in a table."""
_MOST_LINES: Final = 40
"""Limit of runs with a line at their change of verdict."""
_MOST_MARGINS: Final = 10_000
"""Limit of computed margins. With many runs, the limit lowers the resolution, but not below 25 values."""


@html.register(Tuning)
def tuning_html(tuning: Tuning) -> Html:
    """Return the tuned constants and the runs by margin, or the reason why no constants fit."""
    name = element("b", tuning.specification.filename)
    if tuning.conflict is not None:
        failure_text = "no values fit" if tuning.conflict.is_proven else "found no values that fit"
        conflict_text = " ".join(
            f"{heading.capitalize()}: {'; '.join(needs)}." for heading, needs in tuning.conflict.sections
        )
        return element("div", name, f": {failure_text} all runs. {conflict_text}")
    constant_rows = [
        (constant.name, str(constant.value), str(constant.written), f"{constant.low} to {constant.high}")
        for constant in tuning.constants
    ]
    closest_runs = sorted(tuning.runs, key=lambda run: run.margin)
    run_rows = [
        (run.name, "good" if run.is_good else "bad", verdict_mark(run.verdict), f"{run.robustness:.6g}")
        for run in closest_runs[:_MOST_RUNS]
    ]
    left_out_count = len(closest_runs) - len(run_rows)
    return element(
        "div",
        element(
            "div",
            name,
            f": margin {tuning.margin:.6g}{'' if tuning.is_widest else ', as far as was searched'}",
        ),
        table(["constant", "value", "as written", "every value that fits"], constant_rows),
        table(["run", "is", "verdict", "robustness"], run_rows),
        quiet(f"… and {plural(left_out_count, 'run')} more") if left_out_count else Html(""),
    )


@plot.register(Tuning)
def draw_tuning(tuning: Tuning, *names: str, points: int | None = None, ax: Axes | None = None) -> Axes:
    """Draw the margins over one or two constants.

    Args:
        names: the constants; without names, the first two.
        points: number of values per constant; None for 25 to 60 values, with more values for fewer runs.

    Raises:
        UsageError: a constant was not varied, or matplotlib is not installed.
    """
    if points is None:
        points = int(np.clip(math.sqrt(_MOST_MARGINS / len(tuning.runs)), 25, 60))
    return draw_surface(tuning.surface(*names, points=points), ax)


@plot.register(Surface)
def draw_surface(surface: Surface, ax: Axes | None = None) -> Axes:
    """Draw the values of constants for which runs have the right verdict.

    One constant gives a curve for each run. Two constants give the least margin as colours, and for each
    run a line at the change of its verdict. Lines of bad runs are dashed. A circle marks the tuned values.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = ax or new_panel((6.4, 4.4))
    (_draw_curves if len(surface.names) == 1 else _draw_colours)(surface, ax)
    ax.set_xlabel(_axis_label(surface, 0))
    _name_runs(surface, ax)
    return ax


def write_surface(tuning: Tuning, output: Path) -> None:
    """Write a picture (.png, .svg) of margins over the first two constants, or a page (.html) with a picture.

    Raises:
        UsageError: matplotlib is not installed.
        OutputError: the file cannot be written.
    """
    suffix = output.suffix.lower()
    data = picture(draw_tuning(tuning), "png" if suffix == ".png" else "svg")
    if suffix == ".html":
        drawing = data.decode("utf-8")
        head = '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Tuning</title></head>\n'
        body = f"<body style='font-family:system-ui,sans-serif'>{drawing[drawing.index('<svg') :]}\n"
        data = f"{head}{body}{tuning_html(tuning)}\n</body></html>\n".encode()
    with replacing(output) as stream:
        stream.write(data)


def _draw_curves(surface: Surface, ax: Axes) -> None:
    margins = _finite(surface.margins[:, 0])
    for (_, is_good), margin in zip(surface.runs, margins, strict=True):
        ax.plot(surface.x, margin, color=POSITIVE if is_good else NEGATIVE, linewidth=1, alpha=0.6)
    ax.plot(surface.x, margins.min(axis=0), color=INK, linewidth=2, label="least")
    ax.axhline(0.0, color=INK, linewidth=0.8, linestyle=":")
    if surface.found is not None:
        ax.axvline(surface.found[0], color=INK, linewidth=0.8)
    ax.set_ylabel("margin (robustness towards the right verdict)")
    ax.legend(loc="best", frameon=False)


def _draw_colours(surface: Surface, ax: Axes) -> None:
    least_margins = _finite(surface.least)
    colour_limit = float(np.abs(least_margins).max()) or 1.0
    # values that fit often have margins slightly above 0, and margins far below 0 would make them pale
    colour_limit = (
        min(colour_limit, 3 * float(least_margins.max())) if least_margins.max() > 0 else colour_limit
    )
    colour_mesh = ax.pcolormesh(
        surface.x,
        surface.y,
        least_margins,
        cmap=signed_colours(),
        vmin=-colour_limit,
        vmax=colour_limit,
        alpha=0.6,
        shading="nearest",
    )
    extend = "min" if least_margins.min() < -colour_limit else "neither"
    ax.figure.colorbar(colour_mesh, ax=ax, label="least margin of all runs (robustness)", extend=extend)
    for (_, is_good), margins in list(zip(surface.runs, surface.margins, strict=True))[:_MOST_LINES]:
        # matplotlib refuses contours of less than 2 x 2 values, and warns of levels outside the data
        if min(margins.shape) > 1 and margins.min() < 0.0 <= margins.max():
            ax.contour(
                surface.x,
                surface.y,
                _finite(margins),
                levels=[0.0],
                colors=[POSITIVE if is_good else NEGATIVE],
                linestyles="solid" if is_good else "dashed",
                linewidths=1,
            )
    if surface.found is not None:
        ax.plot(*surface.found, marker="o", markersize=7, color="white", markeredgecolor=INK)
    ax.set_ylabel(_axis_label(surface, 1))


def _axis_label(surface: Surface, axis: int) -> str:
    """Return the label of an axis: the constant, with the unit of a duration."""
    return plain(f"{surface.names[axis]} (s)" if surface.durations[axis] else surface.names[axis])


def _name_runs(surface: Surface, ax: Axes) -> None:
    good_count = sum(is_good for _, is_good in surface.runs)
    bad_count = len(surface.runs) - good_count
    runs_text = plural(good_count, "good run") + (f", {plural(bad_count, 'bad run')}" if bad_count else "")
    ax.set_title(plain(f"{runs_text}: margin over {' and '.join(surface.names)}"), loc="left", fontsize=10)


def _finite(margins: Floats) -> Floats:
    """Replace infinite margins by the largest finite magnitude."""
    magnitudes = np.abs(margins[np.isfinite(margins)])
    largest = float(magnitudes.max()) if len(magnitudes) else 1.0
    clipped: Floats = np.clip(margins, -largest, largest)
    return clipped


_MOST_PANELS: Final = 8
_WIDTH, _HEIGHT = 8.0, 2.4
"""Size of a panel, inches."""


class _Pair(NamedTuple):
    """Two named curves over the same time axis."""

    title: str
    names: tuple[str, str]
    seconds: tuple[Floats, Floats]
    values: tuple[Floats, Floats]


@html.register(SpecDiff)
def spec_diff_html(diff: SpecDiff) -> str:
    """Return the changes of one spec in sentences."""
    first_ns = diff.old.evidence.first_ns()
    return page_of([diff.title, *(f"  {sentence}" for sentence in diff.sentences(first_ns))])


@plot.register(SpecificationDiff)
def draw_specifications(diff: SpecificationDiff) -> tuple[Axes, ...]:
    """Draw the robustness of changed specs before and after the edit, in at most eight panels.

    Raises:
        UsageError: no spec changed, or matplotlib is not installed.
    """
    names = diff.old.filename, diff.new.filename
    return _draw([_before_and_after(spec, names) for spec in diff.specs if spec.edits or spec.is_different])


@plot.register(SpecDiff)
def draw_spec(diff: SpecDiff) -> Axes:
    """Draw the robustness of a spec before and after the edit.

    Raises:
        UsageError: matplotlib is not installed.
    """
    return _draw([_before_and_after(diff, ("before", "after"))])[0]


@plot.register(LogDiff)
def draw_runs(diff: LogDiff) -> tuple[Axes, ...]:
    """Draw the robustness of specs in both aligned runs, in at most eight panels.

    Raises:
        UsageError: no spec was evaluated, or matplotlib is not installed.
    """
    traces_and_indices = tuple(zip(diff.traces, (diff.alignment.a, diff.alignment.b), strict=True))
    seconds = (diff.traces[0].times_ns[diff.alignment.a] - diff.zeros_ns[0]) / 1e9
    pairs = []
    for spec in diff.specs:
        aligned_values = []
        for result, (trace, indices) in zip((spec.a, spec.b), traces_and_indices, strict=True):
            values = np.full(len(trace), np.nan)
            values[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
            aligned_values.append(values[indices])
        pairs.append(
            _Pair(spec.a.title, ("A", "B"), (seconds, seconds), (aligned_values[0], aligned_values[1]))
        )
    return _draw(pairs)


def _before_and_after(diff: SpecDiff, names: tuple[str, str]) -> _Pair:
    results = diff.old, diff.new
    first_ns = diff.old.evidence.first_ns()
    old_s, new_s = ((result.times_ns - first_ns) / 1e9 for result in results)
    return _Pair(diff.title, names, (old_s, new_s), (diff.old.series[0, 0], diff.new.series[0, 0]))


def _draw(pairs: Sequence[_Pair]) -> tuple[Axes, ...]:
    if not pairs:
        raise UsageError("there is nothing to draw: no spec differs, or none was evaluated")
    drawn_pairs = pairs[:_MOST_PANELS]
    panels = new_panels(len(drawn_pairs), 1, (_WIDTH, 0.4 + _HEIGHT * len(drawn_pairs)), same_x=True)
    for ax, pair in zip(panels, drawn_pairs, strict=True):
        ax.axhline(0.0, color=NEUTRAL, linewidth=0.8, zorder=1)
        for curve_index in range(2):
            values = np.where(np.isfinite(pair.values[curve_index]), pair.values[curve_index], np.nan)
            # the first curve is thicker, so that it stays visible below an equal second curve
            ax.plot(
                pair.seconds[curve_index],
                values,
                color=CURVES[2 + curve_index],
                linewidth=1.2 if curve_index else 3.0,
                label=pair.names[curve_index],
            )
        ax.set_title(pair.title, loc="left", fontsize=10)
        ax.set_ylabel("robustness")
        ax.legend(loc="best", fontsize=8, frameon=False)
        ax.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time from the first sample in s")
    return panels


_HATCHES: Final = ("", "////", "xxxx", "....", "oooo")
"""Hatches of blocked cells, by index in `REASONS`."""
_BLOCKED: Final = "#e4e4e4"
_HATCH: Final = "#9a9a9a"
_MOST_EDGES: Final = 4
_MOST_CANDIDATES: Final = 4
_PANEL: Final = 3.4
"""Side of a panel, inches."""
_LINE: Final = 40
"""Length of a title's line, characters."""


@html.register(GradientMap)
def map_html(gradient: GradientMap) -> Html:
    """Return the size of a map, its best robustness, and the number of blocked cells by reason."""
    grid = gradient.grid
    size = f"{grid.columns} x {grid.rows} cells of {grid.cell_size:g}"
    turns_text = f", {plural(len(gradient.turns), 'orientation')}" if len(gradient.turns) > 1 else ""
    best_robustness = gradient.best()
    best_text = (
        "no free cell"
        if best_robustness == -math.inf
        else f"robustness {best_robustness:.4g} at the best free cell"
    )
    blocked_counts = np.bincount(gradient.blocked.ravel(), minlength=len(REASONS)).tolist()
    rows = [(f"{count:,}", reason) for count, reason in zip(blocked_counts, REASONS, strict=True) if count]
    title = element("div", "gradient map of ", element("b", gradient.name), quiet(f" {size}{turns_text}"))
    return element("div", title, element("div", best_text), table(["cells", "which are"], rows))


@plot.register(GradientMap)
def draw_map(
    gradient: GradientMap,
    ax: Axes | None = None,
    *,
    turn: int | None = None,
    sample: Sample | None = None,
    target: Target | None = None,
    margin: float | None = None,
) -> Axes:
    """Draw a map: blue where the progress set would hold, vermillion elsewhere, blocked cells hatched.

    Obstacles of the workspace are grey, and regions are dotted.

    Args:
        turn: index of the orientation; None for the orientation of the target, or of the best free cell.
        sample: sample whose objects are drawn over the map.
        target: target of the object, drawn with its path.
        margin: robustness that a target needs, drawn as a line.

    Raises:
        UsageError: matplotlib is not installed.
    """
    ax = new_panel((6.4, 5.2)) if ax is None else ax
    if turn is None:
        turn = _best_turn(gradient, None if target is None else target.turn)
    image = _draw_cells(gradient, ax, turn, _colour_limit([gradient]), margin)
    _draw_scene(ax, gradient, sample)
    if target is not None:
        _draw_target(ax, target_message(target), sample)
    ax.figure.colorbar(image, ax=ax, label="robustness of what is to hold")
    ax.set_title(plain(f"where {gradient.name} could go"), loc="left", fontsize=10)
    ax.set_xlabel("x in the unit of the log")
    ax.set_ylabel("y in the unit of the log")
    if legend_entries := _hatch_keys(ax, [gradient]):
        legend_position = (0.0, -0.14)
        ax.legend(
            handles=legend_entries,
            loc="upper left",
            bbox_to_anchor=legend_position,
            ncols=2,
            frameon=False,
            fontsize=8.5,
        )
    return ax


def _best_turn(gradient: GradientMap, target_turn: float | None) -> int:
    """Return the index of the target's orientation; without a target, of the best free cell's orientation."""
    if target_turn is not None:
        return int(np.abs(gradient.turns - target_turn).argmin())
    best_by_turn = np.where(gradient.blocked == FREE, gradient.robustness, -np.inf).max(axis=(1, 2))
    return int(best_by_turn.argmax())


def _colour_limit(maps: Sequence[GradientMap]) -> float:
    """Return the greatest absolute robustness in some maps, which is drawn in the full colours."""
    values = np.abs(np.concatenate([gradient.values.ravel() for gradient in maps]))
    return float(values[np.isfinite(values)].max(initial=0.0)) or 1.0


def _draw_cells(
    gradient: GradientMap, ax: Axes, turn: int, colour_limit: float, margin: float | None
) -> AxesImage:
    """Draw the cells of one orientation.

    Args:
        colour_limit: absolute robustness with the full colours.
        margin: robustness at which a line is drawn.
    """
    grid = gradient.grid
    right, top = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
    ax.set_facecolor(_BLOCKED)
    image = ax.imshow(
        gradient.values[turn], cmap=signed_colours(), vmin=-colour_limit, vmax=colour_limit, origin="lower",
        extent=(grid.xmin, right, grid.ymin, top), interpolation="nearest",
    )  # fmt: skip
    x, y = (axis.reshape(grid.shape) for axis in grid.centres().T)
    values = gradient.values[turn]
    # matplotlib refuses contours of less than 2 x 2 cells, and warns of levels outside the data
    if margin is not None and min(values.shape) > 1 and np.nanmin(values, initial=margin) < margin:
        ax.contour(x, y, values, levels=[margin], colors=[INK], linewidths=[1.0])
    for reason, hatch in enumerate(_HATCHES):
        is_blocked = gradient.blocked[turn] == reason
        if hatch and is_blocked.any() and min(is_blocked.shape) > 1:
            contours = ax.contourf(x, y, is_blocked, levels=[0.5, 1.5], colors="none", hatches=[hatch])
            contours.set(edgecolor=_HATCH, linewidth=0.0)
    return image


def _draw_scene(ax: Axes, gradient: GradientMap, sample: Sample | None) -> None:
    """Draw obstacles in grey, regions dotted, and the objects of a sample; the moved object is bold."""
    current_maps = gradient.made_of.now
    for name, obstacle in current_maps.static.items():
        _draw_footprint(ax, obstacle, 1.0, colour=_HATCH)
        _name(ax, name, obstacle)
    for name, outline in current_maps.about.regions.items():
        region = footprint_from_outline(outline)
        _draw_footprint(ax, region, 1.0, ":")
        _name(ax, name, region)
    for name, tracked in (sample.objects if sample is not None else {}).items():
        _draw_footprint(ax, tracked.footprint, 2.0 if name == gradient.name else 1.0)
        _name(ax, name, tracked.footprint)


def _name(ax: Axes, name: str, footprint: Footprint) -> None:
    """Write a name at the upper right corner of a footprint."""
    x, y = np.concatenate(outlines_of(footprint)).max(axis=0).tolist()
    ax.annotate(
        plain(name, 24), (x, y), (2, 2), textcoords="offset points", fontsize=8.5, color=INK,
        annotation_clip=True,
    )  # fmt: skip


def _draw_target(ax: Axes, target: PlanTarget, sample: Sample | None) -> None:
    """Draw the target of an object and the path to it."""
    x, y = target.waypoints[::2], target.waypoints[1::2]
    ax.plot(x, y, color="white", linewidth=3.5, solid_capstyle="round")
    ax.plot(x, y, color=INK, linewidth=1.5, solid_capstyle="round")
    ax.plot(target.x, target.y, "o", color="white", markeredgecolor=INK, markersize=6)
    tracked = None if sample is None else sample.objects.get(target.object)
    if tracked is not None:
        moved_target = moved_object(tracked, target.x, target.y, target.turn)
        _draw_footprint(ax, moved_target.footprint, 1.5, "--")


def _hatch_keys(ax: Axes, maps: Sequence[GradientMap]) -> list[Artist]:
    """Return the legend's entries for the reasons that block cells in some maps."""
    reason_codes = np.unique(np.concatenate([gradient.blocked.ravel() for gradient in maps])).tolist()
    style: dict[str, Any] = {"facecolor": _BLOCKED, "edgecolor": _HATCH}
    patches = (
        ax.fill([], [], hatch=_HATCHES[reason], label=REASONS[reason], **style)
        for reason in reason_codes
        if reason != FREE
    )
    return [entry for (entry,) in patches]


def _draw_footprint(
    ax: Axes, footprint: Footprint, width: float, style: str = "-", colour: str = "none"
) -> None:
    for ring in outlines_of(footprint):
        ax.fill(*ring.T, facecolor=colour, edgecolor=INK, linewidth=width, linestyle=style)


@html.register(Step)
def step_html(step: Step) -> str:
    """Return a decision with the edges and objects that the planner considered."""
    return page_of(decision_lines(decision_message(step)))


@plot.register(Step)
def draw_step(step: Step, sample: Sample | None = None, *, margin: float | None = None) -> tuple[Axes, ...]:
    """Draw the maps of a step, with a row for each considered edge and a column for each object.

    Args:
        sample: sample of the decision, whose objects are drawn over the maps.
        margin: robustness that a target needs, drawn as a line.

    Returns:
        The axes of each map; an empty tuple if the step has no map.

    Raises:
        UsageError: matplotlib is not installed.
    """
    return _draw_decision(decision_message(step), _maps_of(step), sample, margin)


def _maps_of(step: Step) -> list[list[GradientMap]]:
    """Return the maps of a step by considered edge."""
    return [[candidate.map for candidate in edge.candidates] for edge in step.considered]


def _draw_decision(
    decision: PlanDecision, maps: Sequence[Sequence[GradientMap]], sample: Sample | None, margin: float | None
) -> tuple[Axes, ...]:
    """Draw the maps of a decision; see `draw_step`."""
    edge_numbers = [edge_number for edge_number, edge in enumerate(decision.considered) if edge.candidates][
        -_MOST_EDGES:
    ]
    edges = [decision.considered[edge_number] for edge_number in edge_numbers]
    if not edges:
        return ()
    column_count = min(max(len(edge.candidates) for edge in edges), _MOST_CANDIDATES)
    size = (0.8 + _PANEL * column_count, 0.5 + _PANEL * len(edges))
    panels = new_panels(len(edges), column_count, size)
    panel_contents = [
        (row * column_count + column, edge, candidate, gradient)
        for row, (edge_number, edge) in enumerate(zip(edge_numbers, edges, strict=True))
        for column, (candidate, gradient) in enumerate(
            zip(edge.candidates[:column_count], maps[edge_number][:column_count], strict=True)
        )
    ]
    drawn_maps = [gradient for *_, gradient in panel_contents]
    for panel in panels:
        panel.set_axis_off()
    used_panels = tuple(panels[panel_index] for panel_index, *_ in panel_contents)
    colour_limit = _colour_limit(drawn_maps)
    images = [
        _draw_candidate(panel, edge, candidate, gradient, sample, colour_limit, margin)
        for panel, (_, edge, candidate, gradient) in zip(used_panels, panel_contents, strict=True)
    ]
    used_panels[0].figure.colorbar(images[0], ax=panels, label="robustness of what is to hold", shrink=0.6)
    legend_entries = _hatch_keys(used_panels[0], drawn_maps)
    if legend_entries:
        used_panels[0].figure.legend(
            handles=legend_entries,
            loc="outside lower left",
            ncols=len(legend_entries),
            frameon=False,
            fontsize=8.5,
        )
    return used_panels


def _draw_candidate(
    ax: Axes,
    edge: PlanEdge,
    candidate: PlanCandidate,
    gradient: GradientMap,
    sample: Sample | None,
    colour_limit: float,
    margin: float | None,
) -> AxesImage:
    """Draw one map, with the planner's choice in its title."""
    target = candidate.target if candidate.HasField("target") else None
    ax.set_axis_on()
    turn = _best_turn(gradient, None if target is None else target.turn)
    image = _draw_cells(gradient, ax, turn, colour_limit, margin)
    _draw_scene(ax, gradient, sample)
    if target is not None:
        _draw_target(ax, target, sample)
    question = plain(f"{edge.source} → {edge.target}: move {candidate.object}?")
    ax.set_title(f"{question}\n{_choice_text(candidate)}", fontsize=9, loc="left")
    ax.tick_params(labelsize=7.5)
    return image


def _choice_text(candidate: PlanCandidate) -> str:
    """Return a candidate's choice and robustness in words, or the reason for its rejection."""
    if not candidate.HasField("target"):
        return "\n".join(wrap(plain(f"no: {candidate.rejected}", 90), _LINE))
    choice = "chosen" if candidate.chosen else "possible"
    return f"{choice}: robustness {candidate.target.robustness:.3g}"


@plot.register(LoggedStep)
def draw_logged_step(logged: LoggedStep) -> tuple[Axes, ...]:
    """Draw the maps of a logged step with the objects of its sample; see `draw_step`."""
    return _draw_decision(logged.message, _maps_of(logged.step), logged.sample, logged.message.margin)
