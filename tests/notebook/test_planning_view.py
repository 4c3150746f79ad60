from __future__ import annotations

import numpy as np
import pytest

import spatial_replay as sr
from pages import shown
from planning.kinematics import BLOCKS, PUSHING, block, run
from planning.plans import PUSH, record_plan_of
from spatial_replay import LogError, Planner, Settings, UsageError
from spatial_replay.planning import Grid, Workspace, read_steps, redo_decisions
from spatial_replay.planning.maps import FREE, gradient_map, proposition_maps
from spatial_replay.sources import open_source

SAMPLE = sr.Sample(
    0, {"cup": block(1, 1, size=1), "mat": block(6, 6, size=4), "<jug>": sr.Footprint.disc(1, 6, 1)}
)
REACHED = Workspace(Grid.over(0, 0, 10, 10, 0.5), base=(5.0, 5.0), farthest=6.0, supports=frozenset({"mat"}))
ON_THE_MAT = sr.parse_specification("cup enclosedin mat").specs[0].formula


@pytest.fixture(scope="module")
def run_log(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "run.mcap"
    return path, record_plan_of(path)


def mat_map(workspace=REACHED):
    maps = proposition_maps([ON_THE_MAT], {}, SAMPLE, "cup", workspace)
    return gradient_map(maps, (((0, True),),), (), workspace)


def test_a_page_of_a_map_counts_its_cells():
    found = mat_map()
    text = shown(found)
    assert "gradient map of cup" in text
    assert f"{int((found.blocked == FREE).sum())}free" in text
    assert "an obstacle is there" in text
    assert "out of reach" in text


@pytest.mark.usefixtures("figures")
def test_a_map_is_drawn_over_its_grid():
    found = mat_map()
    ax = found.plot(sample=SAMPLE)
    (image,) = ax.images
    assert image.get_extent() == [0, 10, 0, 10]
    np.testing.assert_array_equal(image.get_array().filled(np.nan), found.values[0])
    assert {text.get_text() for text in ax.texts} == {"cup", "mat", "<jug>"}
    said = {text.get_text() for text in ax.get_legend().get_texts()}
    assert said == {"an obstacle is there", "out of reach"}


@pytest.mark.usefixtures("figures")
def test_the_colours_of_a_map_are_symmetric_around_zero():
    (image,) = mat_map().plot().images
    least, greatest = image.get_clim()
    assert least == -greatest
    assert image.to_rgba(greatest)[2] > image.to_rgba(greatest)[0]
    assert image.to_rgba(least)[0] > image.to_rgba(least)[2]


@pytest.mark.usefixtures("figures")
def test_a_line_is_where_a_map_reaches_the_margin():
    gradient = mat_map()
    values = gradient.values[0]
    margin = float(np.nanquantile(values, 0.6))
    (line,) = gradient.plot(margin=margin).collections[:1]
    x, y = (axis.reshape(gradient.grid.shape) for axis in gradient.grid.centres().T)
    for path in line.get_paths():
        for corner in path.vertices:
            near = np.hypot(x - corner[0], y - corner[1]) <= gradient.grid.cell_size
            assert np.nanmin(values[near]) <= margin <= np.nanmax(values[near])
    assert sum(len(path.vertices) for path in line.get_paths()) > 4
    # without a margin, or where every cell reaches it, there is no line
    assert len(gradient.plot().collections) == len(gradient.plot(margin=-1e3).collections)
    assert len(gradient.plot(margin=margin).collections) == len(gradient.plot().collections) + 1


@pytest.mark.usefixtures("figures")
def test_the_target_orientation_of_a_map_is_drawn():
    workspace = Workspace(Grid.over(0, 0, 10, 10, 0.5), yaws=(0.0, 0.785), supports=frozenset({"mat"}))
    found = mat_map(workspace)
    drawn = found.plot().images[0].get_array().filled(np.nan)
    np.testing.assert_array_equal(drawn, found.values[0])
    other = found.plot(turn=1).images[0].get_array().filled(np.nan)
    np.testing.assert_array_equal(other, found.values[1])


@pytest.mark.usefixtures("figures")
def test_a_map_without_a_free_cell_is_drawn_too():
    found = mat_map(Workspace(Grid.over(0, 0, 10, 10, 0.5), farthest=0.1))
    found.plot().figure.canvas.draw()
    assert "no free cell" in shown(found)


@pytest.mark.usefixtures("figures")
def test_a_step_draws_a_map_for_each_object_and_edge():
    (step, *_), table = run(Planner(sr.parse_specification(PUSHING), PUSH), BLOCKS)
    axes = step.plot(table.samples[0])
    assert len(axes) == sum(len(edge.candidates) for edge in step.considered)
    chosen = [ax for ax in axes if "chosen" in ax.get_title(loc="left")]
    assert len(chosen) == 1
    assert [text.get_text() for text in chosen[0].texts] == list(BLOCKS)
    axes[0].figure.canvas.draw()


def test_a_page_of_a_step_shows_the_decision():
    (step, *_), _ = run(Planner(sr.parse_specification(PUSHING), PUSH), BLOCKS)
    text = shown(step)
    for word in ("decision 0 at ", step.target.name, "given up: no object can do it", "chosen"):
        assert word in text


@pytest.mark.usefixtures("figures")
def test_a_step_without_maps_draws_none():
    steps, _ = run(Planner(sr.parse_specification(PUSHING), PUSH), BLOCKS)
    assert steps[-1].plot() == ()


def test_the_steps_of_a_log_are_those_of_the_run(run_log):
    path, steps = run_log
    logged = read_steps(path)
    assert [each.step.reason for each in logged] == [step.reason for step in steps]
    for each, step in zip(logged, steps, strict=True):
        assert each.step.target == step.target
        for one, other in zip(each.step.candidates, step.candidates, strict=True):
            np.testing.assert_array_equal(one.map.values, other.map.values)


def test_the_steps_of_a_log_have_outcomes(run_log):
    first, *_, last = read_steps(run_log[0])
    assert first.sample.time_ns == first.step.time_ns
    assert first.message.outcome.succeeded
    assert first.message.outcome.end_ns > first.step.time_ns
    assert len(first.message.outcome.travelled) > 2
    assert last.step.kind == "hold" and not last.message.HasField("outcome")
    assert "done at" in shown(first)


@pytest.mark.usefixtures("figures")
def test_a_logged_step_is_drawn_with_the_objects_as_they_were(run_log):
    first, *_ = read_steps(run_log[0])
    assert [text.get_text() for text in first.plot()[0].texts] == list(first.sample.objects)


def test_what_would_have_been_decided_stands_beside_what_was(run_log):
    same = shown(redo_decisions(open_source(run_log[0])))
    count = len(run_log[1])
    assert f"{count} decisions, redone with nothing changed" in same
    assert "all decisions are the same, byte for byte" in same
    other = redo_decisions(open_source(run_log[0]), changes={"margin": 0.02})
    text = shown(other)
    assert "margin 0.01 -> 0.02" in text
    for step in (other.recorded.step, other.redone.step):
        assert step.reason.partition(":")[0] in text


def test_a_log_without_a_plan_has_no_steps(tmp_path):
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write(SAMPLE)
    with pytest.raises(UsageError, match="holds no decisions"):
        read_steps(tmp_path / "run.mcap")


def test_a_log_of_other_decisions_is_refused(tmp_path):
    other = Settings(PUSH.workspace, "push", margin=0.02, constraint_margin=0.005)
    record_plan_of(tmp_path / "run.mcap", recorded_settings=other)
    with pytest.raises(LogError, match="verify --decisions"):
        read_steps(tmp_path / "run.mcap")
