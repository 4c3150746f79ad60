"""The report's page in a real browser: the run can be looked at, by mouse and by keys, on any screen."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Error, Locator, Page, expect

import spatial_replay as sr
from browser.ticked import write_ticked_log
from perception.filmed import write_approach
from planning.plans import record_plan_of
from planning.test_map_layers import OBJECTS, SPEC, TIDYING, messages
from report.report_pages import (
    RECORDINGS,
    report_of_recording,
    report_of_samples,
    report_of_trace,
    two_discs,
)
from spatial_replay.perception import load_tags, open_frames
from spatial_replay.planning import read_decisions
from spatial_replay.planning.decision_log import map_fields
from spatial_replay.replay.engine import load_files
from spatial_replay.report.write import write_report
from spatial_replay.runs.record_video import record_cameras
from spatial_replay.sources import open_source

Open = Callable[..., Page]
HOSTILE = (
    "</script><img src=x onerror=alert(1)>",
    "<svg onload=alert(1)>",
    "`${alert(1)}`",
    "javascript:alert(1)//\"'",
    "no end " * 30,
)
MINUS = "\N{MINUS SIGN}"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The pages of some runs, by what is special about them."""
    folder = tmp_path_factory.mktemp("pages")
    report_of_recording(folder / "violated.html", "table.jsonl", "table_edited.spatial")
    report_of_recording(folder / "satisfied.html", "table.jsonl", "table.spatial")
    report_of_recording(folder / "planned.html", "push.mcap")
    corner = sr.Footprint.polygon([(3.7, 3.7), (3.9, 3.7), (3.9, 3.9), (3.7, 3.9)])
    settings = replace(TIDYING, workspace=replace(TIDYING.workspace, obstacles=(corner,)))
    record_plan_of(folder / "layers.mcap", SPEC, OBJECTS, settings)
    files = [
        sr.parse_specification(f"region mat = box(0, 0, 1, 1)\nspec first = G (cup dist pan >= 0)\n{SPEC}")
    ]
    write_report(open_source(folder / "layers.mcap"), files, folder / "layers.html")
    report_of_recording(folder / "edited.html", "push.mcap", "push_edited.spatial")
    write_ticked_log(folder / "ticks.mcap")
    write_report(open_source(folder / "ticks.mcap"), [], folder / "ticks.html")
    broken = folder / "broken.mcap"
    broken.write_bytes((RECORDINGS / "push.mcap").read_bytes()[:900_000])
    source = open_source(broken)
    files = load_files([RECORDINGS / "push.spatial"], source)
    write_report(source, files, folder / "damaged.html")
    crowd = [
        sr.Sample(
            t * 10**8, {f"p{k}": sr.Footprint.disc(3 * k + t * (k % 2), k, 1) for k in range(t // 4, 8)}
        )
        for t in range(20)
    ]
    report_of_samples(
        folder / "template.html",
        crowd,
        "spec calm(ego) = G (ego dist (all except ego) >= 1)",
        each={"ego": "all"},
    )
    text = "spec apart = G (a dist b >= 0.1)\nspec meet = F (a dist b <= 0.01)\nspec s = apart and meet"
    report_of_trace(folder / "long.html", two_discs(100_000), text)
    parts = " and ".join(f"(a dist b >= {k / 1000})" for k in range(100))
    report_of_trace(folder / "thinned.html", two_discs(12_000), f"spec s = F[0s, 1s] ({parts})")
    pressed = [
        sr.Sample(
            t * 10**8,
            {"a": sr.Footprint.disc(0, 0, 1), "b": sr.Footprint.disc(3 + t / 10, 0, 1)},
            signals={"force": 400.0 - 10 * t},
        )
        for t in range(20)
    ]
    report_of_trace(
        folder / "units.html",
        sr.Trace.from_samples(pressed, units={"": "m", "force": "N"}),
        "spec apart = G (a dist b >= 1)\nspec soft = G (force <= 300)\nspec s = apart and soft",
    )
    unseen = [
        sr.Sample(
            t * 10**8,
            {"a": sr.Footprint.disc(0, 0, 1)} | ({"b": sr.Footprint.disc(5, 0, 1)} if t < 10 else {}),
            signals={"battery": 1 - t / 40 if t < 20 else 0.4},
        )
        for t in range(21)
    ]
    text = "spec apart = G (a dist b >= 1)\nspec power = G (battery >= 0.5)"
    report_of_samples(folder / "unseen.html", unseen, text)
    meeting = [
        sr.Sample(t * 10**8, {"a": sr.Footprint.disc(5 - t, 0, 1), "b": sr.Footprint.disc(0, 0, 1)})
        for t in range(6)
    ]
    report_of_samples(folder / "reached.html", meeting, "spec meet = F (a ovlp b)")
    report_of_samples(folder / "touched.html", meeting, "spec clear = G (not (a ovlp b))")
    report_of_samples(folder / "braking.html", _braking(), BRAKING)
    unsure = [
        sr.Sample(
            t * 10**8,
            {
                "a": sr.Footprint.disc(t - 4, 0, 1),
                "ghost": sr.TrackedObject(sr.Footprint.disc(0, 2.6, 1), uncertainty=0.3),
            },
        )
        for t in range(9)
    ]
    report_of_samples(folder / "unsure.html", unsure, "spec ghosts = G (a dist ghost >= 0.5)")
    people = [
        sr.Sample(
            t * 10**8,
            {"car": sr.Footprint.disc(0, 0, 1)}
            | {
                name: sr.TrackedObject(sr.Footprint.disc(x, 0, 1), "person")
                for name, x in (("ann", 20), ("bob", 9 - t), ("cy", -12 + 2 * t))
            },
        )
        for t in range(9)
    ]
    spec = 'group people = class "person"\nspec calm = G (forall p in people: p dist car >= 1)'
    report_of_samples(folder / "quantifier.html", people, spec)
    _film(folder)
    hostile = [
        sr.Sample(t * 10**8, {name: sr.Footprint.disc(3 * k, t, 1) for k, name in enumerate(HOSTILE)})
        for t in range(9)
    ]
    ovlp = " or ".join(f"({quoted(name)} ovlp {quoted(HOSTILE[0])})" for name in HOSTILE[1:])
    report_of_samples(folder / "hostile.html", hostile, f"spec {'s' * 200} = F ({ovlp})")
    return {page.stem: page for page in folder.glob("*.html")}


BRAKING = "spec stops = G ((a dist b <= 2) -> F[0s, 0.3s] (speed <= 1))"


def _braking() -> list[sr.Sample]:
    """A run in which two discs come near at 0.5 s, and the one brakes too late."""
    return [
        sr.Sample(
            t * 10**8,
            {"a": sr.Footprint.disc(5 - t / 2, 0, 1), "b": sr.Footprint.disc(0, 0, 1)},
            signals={"speed": 3 - t / 5 if t < 15 else 0.2},
        )
        for t in range(20)
    ]


def _film(folder: Path) -> None:
    """Write the pages of a run filmed by one camera and by two, if what that takes is installed."""
    if find_spec("av") is None or find_spec("cv2") is None:
        return
    write_approach(folder, 12)
    (folder / "other.mp4").write_bytes((folder / "table.mp4").read_bytes())
    for page, videos in (("filmed", ["table.mp4"]), ("filmed_twice", ["table.mp4", "other.mp4"])):
        log, specifications = folder / f"{page}.mcap", [sr.load_specification(folder / "apart.spatial")]
        cameras = [open_frames(folder / video) for video in videos]
        record_cameras(cameras, load_tags(folder / "tags.yaml"), log, specifications)
        source = open_source(log)
        write_report(source, load_files([], source), folder / f"{page}.html")


def quoted(name: str) -> str:
    return '"' + name.replace('"', '\\"') + '"'


@pytest.fixture
def open_page(context: BrowserContext, pages: Mapping[str, Path]) -> Iterator[Open]:
    """Opens a page and waits until it is there; any complaint or request of it fails the test in the end."""
    complaints: list[str] = []

    def heard(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            complaints.append(message.text)

    def failed(error: Error) -> None:
        complaints.append(str(error))

    def opened(
        name: str,
        *,
        width: int = 1280,
        height: int = 900,
        scheme: str = "light",
        at: str = "",
        script: str = "",
    ) -> Page:
        page = context.new_page()
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme)
        page.add_init_script(script)
        page.on("console", heard)
        page.on("pageerror", failed)
        page.on("dialog", lambda dialog: complaints.append(dialog.message))
        page.on("request", lambda request: complaints.append(request.url) if request.url != url else None)
        url = pages[name].as_uri()
        page.goto(url + at)
        page.wait_for_selector("html[data-ready]")
        return page

    yield opened
    for page in context.pages:
        page.close()
    assert complaints == []


def row(page: Page, name: str) -> Locator:
    """The row of a named node in the tree."""
    return page.locator(".tree .row", has=page.locator("b", has_text=re.compile(f"^{name}$")))


def readout(page: Page) -> Locator:
    return page.locator(".transport output")


def colour_of(page: Page, locator: Locator) -> str:
    return str(locator.evaluate("each => getComputedStyle(each).color"))


def test_the_run_is_first_shown_where_it_went_wrong(open_page: Open) -> None:
    page = open_page("violated")
    expect(readout(page)).to_have_text("4.000 s / 9.967 s")
    expect(page.locator(".caption")).to_contain_text("fails by")
    expect(page.locator("#scene .key").last).to_contain_text(
        "trail of spoon and plate: spoon dist plate <= 0.08"
    )
    page = open_page("violated", at="#t=2")
    expect(readout(page)).to_have_text("2.000 s / 9.967 s")
    expect(readout(open_page("satisfied"))).to_have_text("9.967 s / 9.967 s")


def test_when_the_run_has_ended_the_tree_shows_verdicts(open_page: Open) -> None:
    page = open_page("violated")
    page.keyboard.press("End")
    expect(readout(page)).to_have_text("9.967 s / 9.967 s")
    expect(row(page, "laid").locator(".mark")).to_have_class("mark is-violated")
    expect(row(page, "served").locator(".mark")).to_have_class("mark is-satisfied")
    expect(row(page, "table_set").locator(".number").first).to_have_text(f"{MINUS}0.1552")


def test_the_tree_shows_how_things_stand_at_the_cursor(open_page: Open) -> None:
    page = open_page("violated", at="#t=9")
    mark = row(page, "plate_first").locator(".mark")
    satisfied = colour_of(page, mark)
    page.keyboard.press("Home")
    expect(readout(page)).to_have_text("0.000 s / 9.967 s")
    expect(mark).to_have_class("mark is-pending")
    assert colour_of(page, mark) != satisfied
    ground = "mark => getComputedStyle(mark).backgroundColor"
    assert mark.evaluate(ground) == "rgb(217, 196, 0)"
    expect(page.locator("#timeline .key .block.pending")).to_have_css("background-color", "rgb(217, 196, 0)")
    expect(row(page, "plate_first").locator(".number").first).to_have_text(f"{MINUS}0.2802")
    # what is pending is no violation: its number is grey
    expect(row(page, "plate_first").locator(".number").first).to_have_class("number is-unknown")
    expect(row(page, "plate_first").locator(".what")).to_contain_text("pending")
    expect(page.locator("#tree .head")).to_contain_text("between")
    expect(row(page, "plate_first").locator(".number").nth(1)).to_contain_text("…")
    # each node has its own lane, and a press on it moves the time
    lane = row(page, "plate_first").locator("canvas")
    lane.click(position={"x": 1, "y": 4})
    expect(page.locator("#tree .which")).to_contain_text(re.compile(r"at 0\.[01]"))
    expect(row(page, "plate_first").locator("xpath=..")).to_have_attribute("open", "")


def test_choosing_an_event_goes_there(open_page: Open) -> None:
    page = open_page("violated")
    event = page.locator(".event", has_text="parallel").first
    event.click()
    expect(readout(page)).to_have_text("4.667 s / 9.967 s")
    expect(event).to_have_attribute("aria-current", "true")
    expect(page.locator("#tree .which")).to_contain_text("parallel at 4.667 s")
    page.locator(".event", has_text="is permanently violated").first.focus()
    page.keyboard.press("Enter")
    expect(readout(page)).to_have_text("4.000 s / 9.967 s")
    # a press below the slider goes to the nearest event
    ticks = page.locator(".ticks")
    box = ticks.bounding_box()
    assert box is not None
    ticks.click(position={"x": box["width"] * 0.61, "y": 6})
    expect(readout(page)).to_have_text("6.000 s / 9.967 s")


def test_what_is_violated_is_explained_at_once(open_page: Open) -> None:
    page = open_page("violated")
    expect(page.locator(".verdict[open]")).to_have_count(1)
    # its line has said the verdict, the number and the time
    expect(page.locator(".verdict[open]")).not_to_contain_text("is violated:")
    expect(page.locator(".verdict[open] .numbers").first).to_have_text(
        f"robustness {MINUS}0.1552, violated since 4.000 s"
    )
    page.locator(".verdict", has_text="poured").locator("summary").click()
    expect(page.get_by_text("milk and cup are 0.1137 apart")).to_be_visible()
    expect(open_page("satisfied").locator(".verdict[open]")).to_have_count(3)


def test_a_time_in_an_explanation_leads_there(open_page: Open) -> None:
    page = open_page("violated", at="#t=9")
    page.locator(".verdict").first.get_by_role("button", name="4.000 s").last.click()
    expect(readout(page)).to_have_text("4.000 s / 9.967 s")
    expect(page.locator("#tree .which")).to_contain_text("table_set at 4.000 s")


def test_keys_move_the_cursor(open_page: Open) -> None:
    page = open_page("violated")
    for key, time in (
        ("Home", "0.000"), ("ArrowRight", "0.033"), ("ArrowRight", "0.067"), ("ArrowLeft", "0.033"),
        ("Shift+ArrowRight", "1.033"), ("n", "2.133"), ("n", "4.000"), ("p", "2.133"), ("End", "9.967"),
    ):  # fmt: skip
        page.keyboard.press(key)
        expect(readout(page)).to_have_text(f"{time} s / 9.967 s")


def test_everything_can_be_reached_by_the_tab_key(open_page: Open) -> None:
    page = open_page("satisfied")
    reached = set()
    for _ in range(120):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.className || document.activeElement.tagName"))
        if "button help" in reached:
            break
    assert {
        "skip",
        "summary",
        "row",
        "lane-name ",
        "event",
        "slider",
        "button play",
        "button help",
    } <= reached
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_it_plays_and_pauses(open_page: Open) -> None:
    page = open_page("violated")
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    expect(readout(page)).not_to_have_text("9.967 s / 9.967 s")
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    page.get_by_label("Speed").select_option("50")
    page.get_by_role("button", name="Play").click()
    # it stops by itself where the run ends
    expect(readout(page)).to_have_text("9.967 s / 9.967 s")
    expect(page.get_by_role("button", name="Play")).to_be_visible()


def test_the_address_keeps_the_time(open_page: Open) -> None:
    page = open_page("violated", at="#t=5&r=2")
    expect(readout(page)).to_have_text("5.000 s / 9.967 s")
    expect(page.locator("#tree .which")).to_contain_text("poured at 5.000 s")
    page.keyboard.press("Home")
    page.wait_for_url("**#t=0&r=2")


def test_pressing_on_a_lane_or_the_curves_moves_the_cursor(open_page: Open) -> None:
    page = open_page("violated")
    for place in (page.locator(".lane .strip").first, page.locator(".u-over")):
        box = place.bounding_box()
        assert box is not None
        place.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        assert abs(page.evaluate("Number(document.querySelector('.slider').value)") - 500) < 5
        page.keyboard.press("End")


def test_lanes_and_curves_share_one_time_axis(open_page: Open) -> None:
    for width in (1280, 360):
        page = open_page("violated", width=width)
        edges = [
            page.locator(place).first.evaluate(
                "each => [each.getBoundingClientRect().left, each.clientWidth]"
            )
            for place in (".lane .strip", ".u-over")
        ]
        assert np.allclose(*edges, atol=1.5)


def test_each_unit_has_an_axis_of_its_own(open_page: Open) -> None:
    page = open_page("units")
    # time, the result over both units, and each of these
    assert page.locator(".curves .u-axis").count() == 4
    left, width = page.locator(".u-over").evaluate(
        "each => [each.getBoundingClientRect().left, each.clientWidth]"
    )
    assert page.locator(".lane .strip").first.evaluate("each => each.getBoundingClientRect().left") == left
    assert width > 0
    assert open_page("violated").locator(".curves .u-axis").count() == 2


def test_looking_closer_keeps_the_cursor_in_sight(open_page: Open) -> None:
    page = open_page("violated", at="#t=4")
    for _ in range(3):
        page.keyboard.press("+")
    labels = page.evaluate("document.querySelector('.lanes .cursor').style.left")
    assert 0 <= float(labels.removesuffix("%")) <= 100
    page.keyboard.press("End")
    assert page.locator(".lanes .cursor").is_visible()
    page.keyboard.press("0")
    assert page.evaluate("document.querySelector('.lanes .cursor').style.left") == "100%"


def test_states_and_decisions_have_lanes_of_their_own(open_page: Open) -> None:
    page = open_page("planned", at="#t=1")
    lanes = page.locator(".lane-name")
    expect(lanes).to_have_text(
        [f"{MINUS}push", f"{MINUS}beside", f"{MINUS}order", "+gaps", "state", "decision 0 ↓"]
    )
    # the lane and the header lead to the cards
    page.get_by_role("button", name="decision 0 ↓").click()
    card = page.locator(".card").nth(0)
    expect(card).to_be_in_viewport()
    page.evaluate("window.scrollTo(0, 0)")
    expect(card).not_to_be_in_viewport()
    page.locator(".top").get_by_role("link", name=" decisions").click()
    expect(card).to_be_in_viewport()
    # a result without an automaton has no states
    expect(open_page("violated").locator("span.lane-name")).to_have_count(0)


def test_the_scene_changes_with_the_cursor(open_page: Open) -> None:
    page = open_page("violated")
    picture = "document.querySelector('.stage').toDataURL()"
    last = page.evaluate(picture)
    page.keyboard.press("Home")
    first = page.evaluate(picture)
    assert first != last
    page.keyboard.press("n")
    for layer in ("names", "trails"):
        before = page.evaluate(picture)
        page.get_by_label(layer).uncheck()
        assert page.evaluate(picture) != before


def test_the_scene_says_what_is_violated_now(open_page: Open) -> None:
    caption = open_page("violated", at="#t=1").locator(".caption")
    expect(caption).to_have_text(
        "nothing is violated now; plate enclosedin mat of table_set is still to come, and 2 more"
    )
    caption = open_page("violated", at="#t=9.9").locator(".caption")
    expect(caption).to_have_text(
        "the arrow: spoon dist plate <= 0.08 of table_set failed by 0.1552 at 4.000 s, "
        "what decided the verdict"
    )


def test_the_scene_calls_nothing_to_come_that_nothing_asks_for(open_page: Open) -> None:
    """A response without its condition, a condition itself, and all after the end."""
    for time, words in (
        (0.1, "nothing is violated now"),
        (0.4, "nothing is violated now; speed <= 1 of stops is still to come"),
        (1.9, "nothing is violated now; stops was before"),
    ):
        expect(open_page("braking", at=f"#t={time}").locator(".caption")).to_have_text(words)


def test_the_scene_names_what_decided_where_no_arrow_can_show_it(open_page: Open) -> None:
    page = open_page("braking")
    expect(page.locator(".caption")).to_have_text(
        "what decided the verdict: speed <= 1 of stops fails by 0.8 now; no arrow shows it"
    )
    said = page.locator(".verdict").first
    expect(said).to_contain_text("speed <= 1 came closest at 0.600 s: speed is 1.8.")


def test_the_tree_and_the_curve_of_a_quantifier_name_the_object_that_decided(open_page: Open) -> None:
    page = open_page("quantifier", at="#t=0.8")
    decided = "cy dist car >= 1"
    expect(page.locator(".row.decides").last).to_contain_text(f"decided at 0.600 s by {decided}")
    expect(page.locator(".legend-entry", has_text=decided)).to_contain_text(
        f"{decided} of it decided at 0.600 s"
    )
    caption = open_page("quantifier").locator(".caption")
    expect(caption).to_contain_text(f"what decided the verdict: {decided}")


def test_a_link_to_a_result_unfolds_it_and_scrolls_to_it(open_page: Open) -> None:
    chosen = open_page("template", at="#t=1&r=7").locator(".verdict.chosen")
    expect(chosen).to_have_attribute("data-result", "7")
    expect(chosen.locator("p").first).to_be_visible()
    in_sight = """chosen => {
      const box = chosen.getBoundingClientRect();
      const frame = document.getElementById("verdicts-body").getBoundingClientRect();
      return box.top >= frame.top - 1 && box.top < frame.bottom;
    }"""
    assert chosen.evaluate(in_sight)


def test_the_keys_step_through_the_kept_samples_of_a_thinned_run(open_page: Open) -> None:
    for name, words in (("thinned", "a kept sample back, on"), ("violated", "a sample back, on")):
        page = open_page(name)
        page.get_by_role("button", name="Keys").click()
        expect(page.locator(".keys")).to_contain_text(words)


def test_a_violation_without_an_arrow_is_reported_too(open_page: Open) -> None:
    for time, words in (
        (0.5, "power: nothing is violated now"),
        (2, "what decided the verdict: battery >= 0.5 of power fails by 0.1 now; no arrow shows it"),
    ):
        caption = open_page("unseen", at=f"#t={time}").locator(".caption")
        expect(caption).to_have_text(words)
    caption = open_page("unseen", at="#t=1.2&r=1").locator(".caption")
    expect(caption).to_have_text("no violation is known now; a dist b >= 1 of apart is unknown")
    caption = open_page("reached", at="#t=9").locator(".caption")
    expect(caption).to_have_text(
        "no more requirements on the objects: blue ones have fulfilled theirs, grey ones had none"
    )


def test_the_automaton_shows_where_the_run_is(open_page: Open) -> None:
    page = open_page("planned")
    here = page.locator(".state.here text")
    expect(page.locator(".moves")).to_contain_text("accepting")
    last = here.text_content()
    page.keyboard.press("Home")
    expect(here).to_have_count(1)
    assert here.text_content() != last
    expect(page.locator(".move.ahead").first).to_be_attached()


def test_conditions_at_the_arrows_of_an_automaton_cover_neither_states_nor_each_other(
    open_page: Open,
) -> None:
    """The guards of a large automaton are those of its present moves, and no other of these crosses them."""
    page = open_page("planned")
    page.keyboard.press("Home")
    assert 0 < page.locator("#automaton .guard").count() <= page.locator("#automaton .move.ahead").count()
    covered = """() => {
        const box = (each) => each.getBoundingClientRect();
        const labels = [...document.querySelectorAll("#automaton .guard")].map(box);
        const all = [...labels, ...[...document.querySelectorAll("#automaton circle")].map(box)];
        const apart = (a, b) => a.right <= b.left + 1 || b.right <= a.left + 1
            || a.bottom <= b.top + 2 || b.bottom <= a.top + 2;
        return labels.flatMap((a, i) => all.slice(i + 1).filter((b) => !apart(a, b)).map((b) => [a, b]));
    }"""
    assert page.evaluate(covered) == []
    crossed = """() => {
        const along = (move) => Array.from({length: 200},
            (_, step) => move.getPointAtLength(step / 199 * move.getTotalLength()));
        const moves = [...document.querySelectorAll("#automaton .move.ahead")].map(along);
        return [...document.querySelectorAll("#automaton .guard")].filter((label) => {
            const {x, y, width, height} = label.getBBox();
            return moves.filter((points) => points.some((point) => x + 1 < point.x && point.x < x + width - 1
                && y + 3 < point.y && point.y < y + height - 3)).length > 1;
        }).length;
    }"""
    assert page.evaluate(crossed) == 0


def test_a_result_without_an_automaton_says_why(open_page: Open) -> None:
    expect(open_page("violated").locator("#automaton")).to_contain_text(
        "table_set has no automaton: F[0s, 4s] counts seconds, an automaton counts samples."
    )


def test_a_behaviour_tree_has_the_statuses_of_the_cursor_and_leads_to_failures(open_page: Open) -> None:
    page = open_page("ticks")
    panel = page.locator("#ticks")
    failures = panel.locator(".event")
    expect(failures).to_have_count(2)
    failures.last.click()
    expect(readout(page)).to_have_text("1.000 s / 3.000 s")
    expect(panel.locator(".nodes li")).to_have_text(["✕motion Sequence, failure", "✕carry Action, failure"])
    page.keyboard.press("End")
    expect(panel.locator(".nodes li").last).to_have_attribute("data-status", "success")


def test_decisions_show_what_was_tried_and_lead_to_their_time(open_page: Open) -> None:
    page = open_page("planned")
    card = page.locator(".card").nth(0)
    card.get_by_role("button").click()
    expect(readout(page)).to_have_text("0.033 s / 18.167 s")
    expect(card).to_have_attribute("aria-current", "true")
    card.locator("summary").click()
    expect(card).to_contain_text("Given up: no object can do it.")
    # how many cells each demand limits, and each cause blocks
    rows = card.locator(".candidate", has_text="red chosen").locator(".bars tr")
    expect(rows.first).to_contain_text("limited by: red above blue")
    shares = [
        float(text.rstrip(" %")) for text in rows.locator("td.number").all_text_contents() if "<" not in text
    ]
    assert shares[0] > 50 and sum(shares) <= 101
    assert card.locator("canvas").first.evaluate(
        "each => each.getContext('2d').getImageData(0, 0, each.width, each.height).data.some(Boolean)"
    )
    with_map = page.evaluate("document.querySelector('.stage').toDataURL()")
    page.get_by_label("map", exact=True).uncheck()
    assert page.evaluate("document.querySelector('.stage').toDataURL()") != with_map


def test_a_map_shows_each_relation_and_answers_for_every_cell(
    open_page: Open, pages: Mapping[str, Path]
) -> None:
    page = open_page("layers")
    # of satisfied results, the one that was planned for is shown
    expect(page.locator("#tree .which")).to_contain_text("tidy at 0.100 s")
    words = [
        "fails, 0, holds",
        "at least 0.05, as a target needs",
        "blocked",
        "obstacle",
        "region",
        "way and target",
    ]
    expect(page.locator("#decisions-body > .key span")).to_have_text(words)
    expect(page.locator("#scene .key").first).to_contain_text("obstacle")
    # that of the target, beside the decision
    figure = page.locator(".card").nth(0).locator("> figure")
    made, choice, answer = (
        figure.locator("canvas"),
        figure.get_by_label("Layer of the map"),
        figure.locator(".answer"),
    )
    titles = choice.locator("option").all_text_contents()
    assert titles[0] == "all that has to hold" and len(titles) > 1
    pictures = []
    for title in titles:
        choice.select_option(label=title)
        expect(choice).to_have_attribute("title", title)
        # it is drawn with the next frame of the screen
        page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        pictures.append(made.evaluate("each => each.toDataURL()"))
    assert len(set(pictures)) == len(titles)
    log = pages["layers"].with_suffix(".mcap")
    candidate = read_decisions(log).decisions[0].considered[-1].candidates[0]
    number = next(turned.number for turned in candidate.maps if turned.turn == candidate.target.turn)
    grid = messages(log)[number]
    fields = map_fields(grid)
    demands = {conjunct.words.replace("`", ""): conjunct.text for conjunct in candidate.conjuncts}
    robustness, margin = fields["robustness"], read_decisions(log).decisions[0].margin
    enough, higher = (robustness >= margin).sum(), (robustness > candidate.target.robustness).sum()
    expect(figure.locator(".why")).to_contain_text(
        f"Why there? {enough:,} of {robustness.size:,} cells will do, {higher or 'none'} with a higher "
        f"robustness than the target. {candidate.rule.capitalize()}."
    )
    box = made.bounding_box()
    assert box is not None
    # by keys, the first cell is that of the target
    made.press("ArrowUp")
    answers = {_checked_answer(answer, grid, fields, demands)}
    for row in range(2, 8, 2):
        for column in range(2, 6):
            made.click(position={"x": box["width"] * column / 8, "y": box["height"] * row / 8})
            answers.add(_checked_answer(answer, grid, fields, demands))
    assert {"Blocked", "fails", "holds"} == answers
    # from where it is, keys go on by a cell, and the time stays
    time, heading = readout(page).text_content(), answer.locator("thead").text_content()
    made.press("ArrowLeft")
    assert answer.locator("thead").text_content() != heading
    _checked_answer(answer, grid, fields, demands)
    assert readout(page).text_content() == time


def _checked_answer(
    answer: Locator, grid: GridMessage, fields: Mapping[str, np.ndarray], demands: Mapping[str, str]
) -> str:
    """Compare the table of a cell with the log, and return what it says: blocked, fails or holds.

    Args:
        demands: conjunct of each demand.
    """
    heads, words, *rows = answer.evaluate(
        """answer => [answer.querySelector("thead").textContent, answer.querySelector("p").textContent,
            ...Array.from(answer.querySelectorAll("tbody th"),
                (head) => [head.textContent, head.nextElementSibling.textContent])]"""
    )
    x, y = map(float, re.findall(r"-?[\d.]+", heads.replace(MINUS, "-"))[:2])
    row, column = (
        int((at - low) / size)
        for at, low, size in (
            (y, grid.pose.position.y, grid.cell_size.y),
            (x, grid.pose.position.x, grid.cell_size.x),
        )
    )
    marks = {name.partition(" limits")[2] for name, _ in rows if " limits" in name}
    # the table names the demand that limits the target, and the one that limits a free cell
    assert {" here and at the target"} == marks or " at the target" in marks
    numbers = {name.partition(" limits")[0]: float(text.replace(MINUS, "-")) for name, text in rows}
    layers = {demand: fields[f"{place}: {text}"] for place, (demand, text) in enumerate(demands.items(), 1)}
    varying = {demand: layer[row, column] for demand, layer in layers.items() if np.ptp(layer)}
    for demand, number in varying.items():
        np.testing.assert_allclose(numbers[demand], number, rtol=1e-3, atol=1e-3)
    # a demand that is the same everywhere is counted, and listed only where it limits the cell or the target
    limiting = list(demands)[fields["limited_by"][row, column] - 1]
    assert len(set(numbers) - {*varying, "all that has to hold"}) <= 2
    robustness = fields["robustness"][row, column]
    assert np.isnan(robustness) == words.startswith("Blocked: ")
    if np.isnan(robustness):
        return "Blocked"
    np.testing.assert_allclose(numbers["all that has to hold"], robustness, rtol=1e-3, atol=1e-3)
    assert min(numbers.values()) == numbers["all that has to hold"]
    assert limiting in words
    return "fails" if robustness < 0 else "holds"


def test_each_object_of_a_template_can_be_looked_into(open_page: Open) -> None:
    page = open_page("template")
    # the first that is violated is looked into at once
    expect(page.locator(".tree .mark").first).to_have_class("mark is-violated")
    expect(page.locator("button.lane-name")).to_have_count(8)
    page.locator(".lane-name", has_text="calm(p0)").click()
    # it left long before the run ended, and stands as it did then
    page.keyboard.press("End")
    expect(page.locator("#tree .which")).to_contain_text("calm(p0)")
    expect(page.locator(".tree .row .number").nth(2)).to_have_text("")
    page.keyboard.press("Home")
    expect(page.locator(".tree .row .number").nth(2)).not_to_have_text("")


def test_text_arrow_tree_and_curve_are_of_one_atom_when_the_page_opens(open_page: Open) -> None:
    page = open_page("violated", height=1400)
    atom, number = "spoon dist plate <= 0.08", f"{MINUS}0.1552"
    expect(page.locator(".verdict.chosen")).to_contain_text(f"{atom}, which fails by 0.1552")
    expect(page.locator(".caption")).to_contain_text(f"{atom} of table_set fails by 0.1552")
    decides = page.locator(".tree .row.decides").last
    expect(decides).to_be_in_viewport()
    expect(decides).to_contain_text(atom)
    expect(decides.locator(".number").nth(2)).to_have_text(number)
    expect(page.locator(".legend-entry", has_text=atom).locator(".number")).to_have_text(number)


RECORD_TEXTS = """
window.drawn = [];
const fill = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...at) {
  window.drawn.push(text);
  return fill.call(this, text, ...at);
};
"""


@pytest.mark.parametrize(
    ("name", "label"), [("touched", "a ovlp b: must not hold, holds by "), ("violated", f": {MINUS}0.1552")]
)
def test_the_arrow_of_an_atom_that_holds_and_should_not_says_that_it_holds(
    open_page: Open, name: str, label: str
) -> None:
    drawn = open_page(name, script=RECORD_TEXTS).evaluate("window.drawn")
    assert [text for text in drawn if label in text], drawn


def test_a_missing_object_leaves_its_last_outline_and_a_failed_one_keeps_its_mark(open_page: Open) -> None:
    drawn = open_page("unseen", at="#t=1.5", script=RECORD_TEXTS).evaluate("window.drawn")
    assert "b, last seen" in drawn
    page = open_page("violated", at="#t=2", script=RECORD_TEXTS)
    page.evaluate("window.drawn = []")
    page.keyboard.press("ArrowRight")
    expect(readout(page)).to_have_text("2.033 s / 9.967 s")
    assert "spoon ✕" not in page.evaluate("window.drawn")
    page.keyboard.press("End")
    expect(readout(page)).to_have_text("9.967 s / 9.967 s")
    assert "spoon ✕" in page.evaluate("window.drawn")


def test_the_legend_names_the_grey_band_and_buttons_are_large_enough(open_page: Open) -> None:
    page = open_page("violated", width=390)
    expect(page.locator(".legend")).to_contain_text("what table_set may still become")
    for button in page.locator(".transport .button:visible").all():
        box = button.bounding_box()
        assert box is not None
        assert min(box["width"], box["height"]) >= 36


def test_a_printed_page_has_the_specification_open(open_page: Open) -> None:
    page = open_page("violated")
    page.emulate_media(media="print")
    text = page.locator(".foot pre").first
    assert text.bounding_box() is not None
    assert (text.bounding_box() or {})["height"] > 50


def test_what_uncertainty_leaves_open_is_shown_as_open(open_page: Open) -> None:
    page = open_page("unsure")
    between = f"between {MINUS}0.2 and 0.4"
    expect(page.locator(".verdict")).to_contain_text(f"a dist ghost >= 0.5 lies {between} at 0.400 s")
    expect(page.locator(".caption")).to_have_text(
        "the grey arrow, what leaves the verdict open: a dist ghost >= 0.5 of ghosts lies " + between
    )
    expect(page.locator(".tree .row.decides .mark")).to_have_text(["?", "?"])
    page.keyboard.press("Home")
    expect(page.locator(".tree .row.decides .mark")).to_have_text(["+", "+"])


def test_many_results_are_counted_sorted_and_filtered(open_page: Open) -> None:
    page = open_page("template")
    expect(page.locator("#counts")).to_contain_text(re.compile(r"\d violated, \d satisfied"))
    verdicts = page.locator(".verdict").evaluate_all("all => all.map((each) => each.dataset.verdict)")
    assert verdicts == sorted(verdicts, reverse=True)
    page.get_by_role("combobox", name="Verdict").select_option("satisfied")
    expect(page.locator(".verdict:visible")).to_have_count(verdicts.count("satisfied"))
    page.get_by_role("searchbox", name="Name").fill("p0")
    expect(page.locator(".verdict:visible")).to_have_count(1)
    # the lane of the chosen result stays
    expect(page.locator("button.lane-name")).to_have_count(2)
    expect(page.locator("#counts [role=status]")).to_have_text("1 of 8 listed")


def test_the_scene_is_coloured_for_the_chosen_result(open_page: Open) -> None:
    page = open_page("violated", at="#t=9.9")
    picture = "document.querySelector('.stage').toDataURL()"
    before = page.evaluate(picture)
    page.locator(".lane-name", has_text="parallel").click()
    assert page.evaluate(picture) != before
    expect(page.locator(".caption")).to_contain_text("parallel")


def test_the_heading_of_an_unfolded_result_chooses_it_and_folds_it_once_it_is_chosen(open_page: Open) -> None:
    page = open_page("unseen")
    first, second = page.locator(".verdict").all()
    expect(first).to_have_class("verdict chosen")
    for use in (lambda heading: heading.click(), lambda heading: heading.press("Enter")):
        for other in (second, first, second, first):
            use(other.locator("summary"))
            expect(other).to_have_class("verdict chosen")
            expect(other).to_have_attribute("open", "")
            expect(page.locator("#tree .which")).to_contain_text(other.locator(".name").first.inner_text())
        use(first.locator("summary"))
        expect(first).not_to_have_attribute("open", "")
        use(first.locator("summary"))
        expect(first).to_have_attribute("open", "")


def test_numbers_of_a_thinned_run_are_those_of_the_time_that_is_named(open_page: Open) -> None:
    page = open_page("thinned")
    numbers = two_discs(12_000)
    for wanted in (17.003, 40.444, 99.991):
        page.evaluate("at => { location.hash = `#t=${at}`; }", wanted)
        expect(readout(page)).not_to_have_text("0.000 s / 119.990 s")
        seconds = float(readout(page).inner_text().split(" ")[0])
        assert seconds <= wanted
        sample = round(seconds * 100)
        assert sample == pytest.approx(seconds * 100)
        x = numbers.footprints.vertices[2 * sample, 0]
        shown = page.locator(".tree .row.leaf", has_text="a dist b >= 0.001").locator(".number").nth(2)
        assert float(shown.inner_text().replace(MINUS, "-")) == pytest.approx(1 - x - 0.001, abs=6e-4)


def test_of_events_at_once_the_one_of_the_chosen_result_is_marked(open_page: Open) -> None:
    page = open_page("violated")
    marked = page.locator("#events [aria-current] .sentence")
    # one of its named parts is violated at the same time
    expect(marked).to_have_text(re.compile("^table_set is permanently violated"))


def test_a_damaged_log_is_announced(open_page: Open) -> None:
    page = open_page("damaged")
    expect(page.get_by_role("alert")).to_contain_text("The log is damaged")


@pytest.mark.parametrize(
    "name", ["violated", "satisfied", "planned", "damaged", "template", "long", "hostile"]
)
def test_nothing_is_wider_than_the_screen(open_page: Open, name: str) -> None:
    page = open_page(name, width=360)
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    for width in (360, 1280):
        page.set_viewport_size({"width": width, "height": 760})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.locator(".transport").evaluate("each => each.getBoundingClientRect().bottom") <= 760


# what each canvas writes, in the order in which it does: the text, where, and how wide
WRITTEN = """
const fill = CanvasRenderingContext2D.prototype.fillText;
window.written = new Map();
const clear = CanvasRenderingContext2D.prototype.clearRect;
CanvasRenderingContext2D.prototype.clearRect = function (...box) {
  window.written.set(this.canvas, []);
  return clear.apply(this, box);
};
CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
  window.written.get(this.canvas)?.push([text, x, y, this.measureText(text).width]);
  return fill.call(this, text, x, y);
};
"""


@pytest.mark.parametrize("name", ["violated", "edited"])
def test_the_label_of_the_arrow_covers_no_name_on_a_narrow_screen(open_page: Open, name: str) -> None:
    page = open_page(name, width=390, script=WRITTEN)
    page.get_by_label("trails").uncheck()
    *names, (label, x, y, width) = page.evaluate("written.get(document.querySelector('.stage'))")
    assert " dist " in label
    assert x - width / 2 >= 0
    assert x + width / 2 <= page.locator(".stage").evaluate("each => each.clientWidth")
    for other, left, top, size in names:
        assert abs(y - top) >= 13 or abs(x - left) >= (width + size) / 2, other


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_stand_out_from_their_ground(open_page: Open, scheme: str) -> None:
    page = open_page("violated", scheme=scheme, at="#t=3")
    assert page.evaluate(CONTRASTS) == []
    assert page.evaluate(SMALL_TARGETS) == []


def test_light_and_dark_can_be_chosen(open_page: Open) -> None:
    page = open_page("satisfied", scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.get_by_role("button", name="Light").click()
    assert page.evaluate(ground) != dark
    page.get_by_role("button", name="Dark").click()
    assert page.evaluate(ground) == dark


@pytest.mark.parametrize("name", ["filmed", "filmed_twice"])
def test_the_picture_at_the_cursor_is_shown_and_one_of_the_strip_leads_to_its_time(
    name: str, open_page: Open
) -> None:
    pytest.importorskip("av")
    pytest.importorskip("cv2")
    page = open_page(name)
    picture, strip = page.locator(".picture"), page.locator(".pictures button")
    expect(strip).to_have_count(12)
    page.keyboard.press("Home")
    expect(picture).to_have_attribute("alt", "What the camera saw at 0.000 s")
    assert picture.evaluate("each => each.decode().then(() => each.naturalWidth)") == 320
    strip.nth(5).click()
    expect(readout(page)).to_have_text("0.200 s / 0.440 s")
    expect(picture).to_have_attribute("alt", "What the camera saw at 0.200 s")
    expect(strip.nth(5)).to_have_attribute("aria-current", "true")
    assert picture.get_attribute("src") == strip.nth(5).locator("img").get_attribute("src")


def test_without_scripts_verdicts_can_be_read(browser: Browser, pages: Mapping[str, Path]) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(pages["violated"].as_uri())
    expect(page.locator("#verdicts")).to_contain_text("which fails by 0.1552 at 4.000 s")
    assert page.locator("noscript").bounding_box() is not None
    context.close()


def test_names_are_shown_as_they_are(open_page: Open) -> None:
    page = open_page("hostile")
    for key in ("Home", "n", "End"):
        page.keyboard.press(key)
    for name in HOSTILE:
        expect(page.locator("#tree")).to_contain_text(quoted(name))
    assert page.locator("img, svg svg, [onload], [onerror]").count() == 0


def test_a_hundred_thousand_samples_can_be_gone_through(open_page: Open) -> None:
    page = open_page("long")
    page.keyboard.press("Home")
    for key in ("n", "+", "+", "ArrowRight", "0", "End", "Home"):
        page.keyboard.press(key)
    expect(readout(page)).to_have_text("0.000 s / 999.990 s")
    page.keyboard.press("ArrowRight")
    expect(readout(page)).to_have_text("0.010 s / 999.990 s")


SMALL_TARGETS = """() => [...document.querySelectorAll("a, button, select, input, summary")]
  .filter((target) => target.checkVisibility() && !target.closest(".skip"))
  .filter((target) => {
    const {width, height} = (target.closest("label") ?? target).getBoundingClientRect();
    return Math.min(width, height) < 24;
  }).map((target) => target.outerHTML)"""
CONTRASTS = """() => {
  const canvas = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
  const parts = (colour) => {
    canvas.clearRect(0, 0, 1, 1);
    canvas.fillStyle = colour;
    canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data];
  };
  const luminance = ([r, g, b]) => [r, g, b].map((part) => part / 255)
    .map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
    .reduce((sum, part, index) => sum + part * [0.2126, 0.7152, 0.0722][index], 0);
  const ground = (each) => {
    for (; each; each = each.parentElement) {
      const found = parts(getComputedStyle(each).backgroundColor);
      if (found[3] === 255) return found;
    }
    return [255, 255, 255, 255];
  };
  const faint = [];
  for (const each of document.querySelectorAll("body *:not(script):not(style)")) {
    const hasText = [...each.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    if (!hasText || !each.checkVisibility() || each.closest("svg, .u-wrap")) continue;
    const [light, dark] = [luminance(parts(getComputedStyle(each).color)), luminance(ground(each))]
      .sort((one, other) => other - one);
    const contrast = (light + 0.05) / (dark + 0.05);
    if (contrast < 4.5) faint.push(`${each.className}: ${contrast.toFixed(2)}`);
  }
  return faint;
}"""
