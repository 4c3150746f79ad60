from __future__ import annotations

import numpy as np
import pytest

import spatial_replay as sr
from monitor.scenes import judged, numbers, points
from pages import shown
from spatial_replay import UsageError

RISING = numbers(x=[-2.0, -1.0, 1.0, 2.0])
PARTS = "spec up = F x >= 0\nspec low = G x <= 1\nspec both = up and low\nspec other = F x >= 2"


def titles(axes):
    return [ax.get_title(loc="left") for ax in axes]


def names_in(ax):
    """What is written beside the curves, from the top."""
    names = [text for text in ax.texts if text.get_text() != "■"]
    return [text.get_text() for text in sorted(names, key=lambda text: -text.xy[1])]


def test_a_page_shows_verdicts_and_numbers():
    text = shown(judged(PARTS, RISING))
    for word in ("■ violated", "both", "-1", "2.000 s", "other", "■ satisfied", "3.000 s", "low = G"):
        assert word in text


def test_a_page_of_a_result_shows_no_other_result():
    evaluation = judged(PARTS, RISING)
    assert "both" not in shown(evaluation.result("other"))


def test_a_page_shows_the_interval_of_an_unknown_robustness():
    text = shown(judged("G a dist b <= 1", points(a=[0, None], b=[0, 0])))
    assert "■ unknown" in text
    assert "not known" in text
    assert "between -inf and" in text


def test_texts_of_logs_are_escaped():
    trace = sr.Trace.from_samples([sr.Sample(0, {"<b>a</b>": sr.Footprint.disc(0, 0, 1)})])
    evaluation = judged("spec seen(x) = G x dist x <= 0", trace, each={"x": "all"})
    assert "seen(<b>a</b>)" in shown(evaluation)


def test_a_page_of_many_results_shows_the_worst_and_counts_the_others():
    specs = [f"spec s{number} = F x >= {number - 990}" for number in range(1000)]
    evaluation = judged("\n".join(specs), RISING)
    text = shown(evaluation)
    assert "… and 950 results more, none of them worse" in text
    assert "s999" in text
    assert len(evaluation._repr_html_()) < 250_000


@pytest.mark.usefixtures("figures")
def test_a_figure_has_axes_for_each_result():
    axes = judged(PARTS, RISING).plot()
    assert titles(axes) == ["both: violated, robustness -1", "other: satisfied, robustness 0"]
    assert axes[-1].get_xlabel() == "time from the first sample in s"


@pytest.mark.usefixtures("figures")
def test_curves_are_the_values_of_a_result_and_its_named_parts():
    result = judged(PARTS, RISING).result("both")
    ax = result.plot()
    drawn = [tuple(line.get_ydata()) for line in ax.lines if len(line.get_xdata()) == 4]
    assert set(drawn) == {tuple(result.node(name).value) for name in ("both", "up", "low")}
    assert all(tuple(line.get_xdata()) == (0, 1, 2, 3) for line in ax.lines if len(line.get_xdata()) == 4)
    assert names_in(ax) == ["up", "low", "both", "still possible"]


@pytest.mark.usefixtures("figures")
def test_the_band_spans_the_values_still_possible():
    ax = judged("spec low = G x <= 1", RISING).result().plot()
    bottom, top = ax.get_ylim()
    band = ax.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose([band[:, 1].min(), band[:, 1].max()], [bottom, 3.0])
    assert top > 3.0


@pytest.mark.usefixtures("figures")
@pytest.mark.parametrize("semantics", ["ltlf", "paper"])
def test_names_of_curves_do_not_cover_each_other(semantics):
    names = [f"spec part{number} = G x <= {number}" for number in range(9)]
    text = "\n".join([*names, "spec whole = " + " and ".join(f"part{number}" for number in range(9))])
    ax = judged(text, RISING, semantics=semantics).result().plot()
    heights = sorted(text.xy[1] for text in ax.texts if text.get_text() != "■")
    assert len(heights) == (7 if semantics == "ltlf" else 6)
    assert min(np.diff(heights)) >= 0.1
    assert max(heights) <= 1.0
    ax.figure.canvas.draw()


@pytest.mark.usefixtures("figures")
def test_a_robustness_that_is_never_known_is_drawn_too():
    ax = judged("G a dist b <= 1", points(a=[None, None], b=[0, 0])).result().plot()
    ax.figure.canvas.draw()
    assert "unknown, robustness between -inf and inf" in ax.get_title(loc="left")


@pytest.mark.usefixtures("figures")
def test_of_many_results_the_worst_are_drawn():
    specs = [f"spec s{number} = F x >= {number - 10}" for number in range(20)]
    axes = judged("\n".join(specs), RISING).plot()
    assert len(axes) == 8
    assert titles(axes)[0].startswith("s13: violated")
    assert "and 12 results more" in axes[-1].get_xlabel()


@pytest.mark.usefixtures("figures")
def test_figures_go_into_given_axes():
    evaluation = judged(PARTS, RISING)
    given = evaluation.plot()
    assert evaluation.plot(ax=given) == given
    assert evaluation.result("both").plot(ax=given[0]) is given[0]
    with pytest.raises(UsageError, match="ax has 1 axes for 2 results"):
        evaluation.plot(ax=given[0])
