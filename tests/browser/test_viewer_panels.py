"""The extension's panels in a page that stands for a viewer: right at any time, in either viewer."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from playwright.sync_api import Browser, BrowserContext, Page, expect

import spatial_replay as sr
from browser.ticked import write_ticked_log
from browser.viewer_page import TOPICS, differences, write_viewer_page
from spatial_replay.cli import run
from spatial_replay.monitor.result import SpecResult
from spatial_replay.planning import read_decisions
from spatial_replay.spec.formula import iter_nodes

RECORDINGS = Path(__file__).parent.parent.parent / "recordings"
MINUS = "\N{MINUS SIGN}"
SEEKS = 100

Open = Callable[..., Page]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """Annotated logs, each beside its viewer page."""
    folder = tmp_path_factory.mktemp("panels")
    made = {name: folder / f"{name}.mcap" for name in ("table", "push")}
    table, edited = str(RECORDINGS / "table.jsonl"), str(RECORDINGS / "table_edited.spatial")
    assert run(["replay", table, "--spec", edited, "-o", str(made["table"])]) == 1
    assert run(["replay", str(RECORDINGS / "push.mcap"), "-o", str(made["push"])]) == 0
    for path in made.values():
        write_viewer_page(path, path.with_suffix(".html"))
    return made


@pytest.fixture
def open_panel(context: BrowserContext, logs: Mapping[str, Path]) -> Iterator[Open]:
    """Opens a panel over a log; a test fails if something is written to the console."""
    opened: list[Page] = []
    problems: list[str] = []

    def open_one(
        log: str,
        panel: str,
        api: str = "foxglove",
        state: Mapping[str, Any] | None = None,
        logs: Mapping[str, Path] = logs,
    ) -> Page:
        page = context.new_page()
        page.set_viewport_size({"width": 700, "height": 800})
        opened.append(page)
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(logs[log].with_suffix(".html").as_uri())
        page.evaluate(
            """async ([panel, api, state]) => {
                window.viewer = new Viewer(CODE, MESSAGES, api);
                await viewer.show(`spatial-replay ${panel}`, document.getElementById("panel"), state);
            }""",
            [panel, api, state],
        )
        return page

    yield open_one
    for page in opened:
        # every call of a panel was answered
        assert page.evaluate("viewer.open") == 0
        page.close()
    assert problems == []


def seek(page: Page, time_ns: int) -> None:
    sec, nsec = divmod(time_ns, 10**9)
    page.evaluate("([sec, nsec]) => viewer.seek({sec, nsec})", [sec, nsec])


@pytest.fixture(scope="module")
def results() -> list[SpecResult]:
    """What Python says of the table."""
    trace = sr.read_trace(RECORDINGS / "table.jsonl")
    return list(sr.evaluate(sr.load_specification(RECORDINGS / "table_edited.spatial"), trace).results)


def states_of(log: Path) -> Iterator[tuple[int, list[int]]]:
    """The states of the run after each sample."""
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, message, decoded in reader.iter_decoded_messages(topics=["/spatial/automaton"]):
            yield message.log_time, list(decoded.states)


def number_text(number: float) -> str:
    return f"{number:.4g}".replace("-", MINUS)


@pytest.mark.parametrize("api", ["foxglove", "lichtblick"])
def test_after_a_jump_anywhere_the_tree_shows_the_numbers_of_that_sample(
    open_panel: Open, results: list[SpecResult], api: str
) -> None:
    page = open_panel("table", "specification", api)
    for result in results:
        assert differences(page, result, SEEKS // len(results), random.Random(7)) == []


def test_the_path_of_a_pending_result_ends_at_the_atom_that_has_its_number(
    open_panel: Open, results: list[SpecResult]
) -> None:
    page = open_panel("table", "specification")
    [result] = [each for each in results if each.name == "parallel"]
    page.locator("select").select_option(label=result.name)
    page.evaluate("viewer.settled()")
    for sample in (20, 90, 141, 260):
        seek(page, int(result.times_ns[sample]))
        *_, last = map(int, str(page.locator(".panel-body").get_attribute("data-deciding")).split())
        assert not any(parent == last for _, parent, _ in iter_nodes(result.formula))
        seen = result.series[last, 1, : sample + 1]
        assert result.series[0, 0, sample] in np.concatenate([seen, -seen])


def test_the_path_to_what_decided_a_violation_is_lit_and_unfolded(
    open_panel: Open, results: list[SpecResult]
) -> None:
    page = open_panel("table", "specification")
    [violated] = [each for each in results if each.verdict == "violated"]
    witness = violated.causes[0].witness
    assert witness is not None
    # of several results the violated one is shown first
    expect(page.locator("select")).to_have_value("0")
    seek(page, violated.violated_at_ns or 0)
    lit = [int(each) for each in str(page.locator(".panel-body").get_attribute("data-deciding")).split()]
    steps = [each.node for each in witness.path]
    assert lit[-len(steps) :] == steps
    expect(page.locator(".row.lit").last).to_be_visible()
    expect(page.locator(".row.lit").last).to_contain_text("spoon dist plate <= 0.08")
    expect(page.locator(".chip")).to_have_text("violated")
    # what holds is folded
    expect(page.get_by_text("cup ovlp mat", exact=True)).to_be_hidden()


def test_a_pointer_on_the_time_line_shows_that_time_until_it_leaves(
    open_panel: Open, results: list[SpecResult]
) -> None:
    page = open_panel("table", "specification")
    times_ns = results[0].times_ns
    shown = [number_text(results[0].series[0, 1, sample]) for sample in (30, 200)]
    now = page.locator(".tree .row").first.locator(".number").last
    seek(page, int(times_ns[30]))
    expect(now).to_have_text(shown[0])
    page.evaluate("seconds => viewer.hover(seconds)", int(times_ns[200]) / 1e9)
    expect(now).to_have_text(shown[1])
    expect(page.locator(".panel-head")).to_contain_text("under the pointer")
    page.evaluate("viewer.hover(undefined)")
    expect(now).to_have_text(shown[0])


def test_a_live_source_is_followed_and_may_jump_back(open_panel: Open, results: list[SpecResult]) -> None:
    page = open_panel("table", "specification", "live")
    expect(page.locator(".note")).to_contain_text("No specification here")
    times_ns = results[0].times_ns.tolist()
    now = page.locator(".tree .row").first.locator(".number").last
    for before, sample in [(0, 10), (10, 50), (20, 35)]:
        window = [[*divmod(times_ns[before] - (before == 0), 10**9)], [*divmod(times_ns[sample], 10**9)]]
        page.evaluate(
            """([from, to]) => viewer.play(
                {sec: from[0], nsec: from[1]}, {sec: to[0], nsec: to[1]})""",
            window,
        )
        page.evaluate("viewer.drawn()")
        expect(now).to_have_text(number_text(results[0].series[0, 1, sample]))


@pytest.mark.parametrize("topic", ["/spatial/events", "/spatial/recent_events"])
def test_a_panel_that_joins_late_has_the_time_of_the_log_and_all_events(open_panel: Open, topic: str) -> None:
    """After a seek all events come again; in a run the last message with the newest ones does."""
    page = open_panel("table", "specification", "live")
    count = page.evaluate(
        """(topic) => {
            const late = {sec: 4, nsec: 0};
            const of = (topic) => MESSAGES
                .filter((each) => each.topic === topic && compare(each.receiveTime, late) <= 0)
                .map((each) => ({...each, receiveTime: late}));
            const events = of(topic).slice(topic === "/spatial/events" ? 0 : -1);
            const numbers = of("/spatial/robustness").slice(-3);
            viewer.render({startTime: late, currentTime: late, currentFrame: [...events, ...numbers]});
            viewer.render({currentFrame: of("/spatial/specification")});
            return of("/spatial/events").length;
        }""",
        topic,
    )
    assert count > 1
    expect(page.locator(".panel-head")).to_contain_text("at 4.000 s")
    expect(page.locator(".events summary")).to_have_text(f"{count} events")


def test_a_node_shows_its_curve_and_an_event_is_one_click_away(open_panel: Open) -> None:
    page = open_panel("table", "specification")
    seek(page, 4 * 10**9)
    expect(page.locator(".event")).to_have_count(9)
    page.locator(".event", has_text="parallel holds so far").click()
    assert page.evaluate("viewer.sought.at(-1)") == {"sec": 4, "nsec": 666_666_667}
    expect(page.locator("select")).to_have_value("1")
    expect(page.locator(".u-over")).to_have_count(0)
    page.locator(".tree .row").first.locator(".what").click(position={"x": 80, "y": 8})
    chart = page.locator(".u-over")
    box = chart.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    assert page.evaluate("viewer.previews.at(-1)") == pytest.approx(9.9667 / 2, abs=0.05)
    page.mouse.click(box["x"] + box["width"] / 4, box["y"] + 20)
    sought = page.evaluate("viewer.sought.at(-1)")
    assert sought["sec"] + sought["nsec"] / 1e9 == pytest.approx(9.9667 / 4, abs=0.05)
    # another viewer's layout keeps what was chosen
    state = page.evaluate("Object.assign({}, ...viewer.saved)")
    again = open_panel("table", "specification", "lichtblick", state)
    expect(again.locator(".u-over")).to_be_visible()
    expect(again.locator("select")).to_have_value("1")
    page.evaluate("viewer.close()")
    expect(page.locator(".spatial-replay")).to_have_count(0)


def test_the_automaton_is_where_the_run_is_and_says_what_is_left_to_be_done(
    open_panel: Open, logs: Mapping[str, Path]
) -> None:
    page = open_panel("push", "automaton")
    recorded = list(states_of(logs["push"]))
    for time_ns, states in random.Random(3).sample(recorded, SEEKS // 4):
        seek(page, time_ns)
        assert page.locator(".panel-body").get_attribute("data-states") == " ".join(map(str, states))
        here = page.locator(".state.here text").all_text_contents()
        assert here == [str(state) for state in states]
    moves = [at for at in pairwise(recorded) if at[0][1] != at[1][1]]
    rows = page.locator(".event")
    assert rows.count() == len(moves)
    for row, ((_, [source]), (time_ns, [target])) in zip(rows.all(), moves, strict=True):
        expect(row).to_contain_text(f"{time_ns / 1e9:.3f} s")
        expect(row).to_contain_text(f"{source} → {target}")
        row.click()
        assert page.evaluate("viewer.sought.at(-1)") == dict(
            zip(("sec", "nsec"), divmod(time_ns, 10**9), strict=True)
        )
    seek(page, 8 * 10**9)
    tasks = page.locator(".tasks")
    expect(tasks).to_contain_text(
        re.compile(
            r"Still to be done.*green rightof red.*state 3.*Must not happen.*green dist red", re.DOTALL
        )
    )
    places = page.locator(".state").evaluate_all("all => all.map((each) => each.getAttribute('transform'))")
    seek(page, recorded[-1][0])
    expect(tasks).to_contain_text("Accepted if the run ends here")
    # the drawing stays as it is
    assert (
        page.locator(".state").evaluate_all("all => all.map((each) => each.getAttribute('transform'))")
        == places
    )


def test_the_decision_before_the_cursor_shows_candidates_maps_and_edges_given_up(
    open_panel: Open, logs: Mapping[str, Path]
) -> None:
    page = open_panel("push", "decisions")
    decisions = read_decisions(logs["push"]).decisions
    seek(page, decisions[-1].time_ns)
    expect(page.locator(".event .sentence").first).to_contain_text("0: move red to")
    seek(page, decisions[0].time_ns)
    # candidates are folded until the reader unfolds them
    expect(page.locator(".candidate").first).to_be_hidden()
    page.locator(".card summary").click()
    for number, decision in reversed(list(enumerate(decisions))):
        seek(page, decision.time_ns)
        expect(page.locator(".decision-title")).to_contain_text(f"Decision {number}")
        text = page.locator(".card").inner_text().replace(MINUS, "-")
        for edge in decision.considered:
            for candidate in edge.candidates:
                assert candidate.object in text
                assert (candidate.rejected or candidate.object) in text
        for each in decision.pruned:
            expect(page.locator(".tasks")).to_contain_text(f"{each.source} → {each.target}")
    expect(page.locator(".card .key")).to_contain_text("at least 0.012 m, as a target needs")
    expect(page.locator(".card")).to_contain_text("Done at 10.467 s")
    expect(page.locator(".card")).to_contain_text("Planned next: green to (")
    maps = sum(len(each.maps) for edge in decisions[0].considered for each in edge.candidates)
    # that of the target stands beside the decision
    expect(page.locator(".candidate canvas")).to_have_count(maps - 1)
    made = page.locator(".card > figure canvas")
    expect(made).to_have_count(1)
    expect(page.locator(".candidate", has_text="red chosen").locator(".bars")).to_contain_text(
        "limited by: red above blue"
    )
    made.press("ArrowUp")
    edge, answer = decisions[0].considered[-1], page.locator(".card > figure .answer")
    conjuncts = next(each for each in edge.candidates if each.chosen).conjuncts
    expect(answer.locator("tbody tr")).to_have_count(len(conjuncts) + 1)
    expect(answer).to_contain_text("red above blue: met by")
    # a cell next to the target, nearer to the end of the shortest way
    made.press("ArrowRight")
    expect(answer).to_contain_text("The target is a more robust place near its end.")
    # a live source has neither numbers of maps nor, before it is played, the outcome
    live = open_panel("push", "decisions", "live")
    live.evaluate("viewer.play({sec: -1, nsec: 0}, {sec: 1, nsec: 0})")
    expect(live.locator("canvas")).to_have_count(maps)
    expect(live.get_by_text("Done at")).to_have_count(0)


def test_a_map_has_the_objects_of_a_scene_that_arrives_after_its_decision(
    open_panel: Open, logs: Mapping[str, Path], tmp_path: Path
) -> None:
    write_viewer_page(logs["push"], tmp_path / "push.html", topics=(*TOPICS, "scene"))
    page = open_panel("push", "decisions", logs={"push": tmp_path / "push.mcap"})
    first, second, *_ = read_decisions(logs["push"]).decisions
    drawing = page.locator(".card > figure canvas")
    seek(page, second.time_ns)
    expect(page.locator(".decision-title")).to_contain_text("Decision 1")
    page.evaluate("viewer.drawn()")
    expected = drawing.evaluate("canvas => canvas.toDataURL()")
    seek(page, first.time_ns)
    expect(page.locator(".decision-title")).to_contain_text("Decision 0")
    sec, nsec = divmod(second.time_ns, 10**9)
    page.evaluate(
        """async time => {
          viewer.render({currentFrame: [], currentTime: time, didSeek: true});
          for (let frame = 0; frame < 5; frame++) await viewer.drawn();
          viewer.render({currentFrame: viewer.frameAt(time), currentTime: time, didSeek: false});
        }""",
        {"sec": sec, "nsec": nsec},
    )
    page.wait_for_function(
        "expected => document.querySelector('.card > figure canvas').toDataURL() === expected", arg=expected
    )


def test_the_behaviour_tree_has_the_statuses_of_the_cursor(open_panel: Open, tmp_path: Path) -> None:
    write_ticked_log(tmp_path / "ticks.mcap")
    write_viewer_page(tmp_path / "ticks.mcap", tmp_path / "ticks.html")
    page = open_panel("ticks", "decisions", logs={"ticks": tmp_path / "ticks.mcap"})
    for second, status in ((2, "success"), (1, "failure"), (0, "running")):
        seek(page, second * 10**9)
        expect(page.locator(".nodes li")).to_contain_text(
            [f"motion Sequence, {status}", f"carry Action, {status}"]
        )
    expect(page.locator(".note")).to_have_count(0)


def test_texts_of_a_log_are_shown_as_text(open_panel: Open, logs: Mapping[str, Path], tmp_path: Path) -> None:
    name = "<img src=x onerror=alert(1)>"
    samples = [
        sr.Sample(t * 10**8, {name: sr.Footprint.disc(t, 0, 1), "b": sr.Footprint.disc(9, 0, 1)})
        for t in range(9)
    ]
    log, spec = tmp_path / "hostile.mcap", sr.parse_specification(f'spec near = F ("{name}" dist b <= 3)')
    with sr.Recorder(log, specifications=[spec]) as recorder:
        for sample in samples:
            recorder.write(sample)
    write_viewer_page(log, log.with_suffix(".html"))
    page = open_panel("hostile", "specification", logs={"hostile": log})
    seek(page, 5 * 10**8)
    expect(page.locator(".tree")).to_contain_text(name)
    expect(page.locator("img")).to_have_count(0)


def test_the_result_violated_first_is_shown_unless_the_reader_chose(
    open_panel: Open, logs: Mapping[str, Path], tmp_path: Path
) -> None:
    log = tmp_path / "several.mcap"
    later = "spec late = G (a dist b >= 3)"
    text = f"spec near = F (a dist b <= 30)\n{later}\nspec apart = G (a dist b >= 4)\nspec met = F (a ovlp b)"
    specification = sr.parse_specification(text)
    with sr.Recorder(log, specifications=[specification]) as recorder:
        for t in range(40):
            objects = {"a": sr.Footprint.disc(9 - t / 8, 0, 1), "b": sr.Footprint.disc(0, 0, 1)}
            recorder.write(sr.Sample(t * 10**8, objects))
    write_viewer_page(log, log.with_suffix(".html"))
    for panel in ("specification", "automaton"):
        page = open_panel("several", panel, logs={"several": log})
        expect(page.locator("select option:checked")).to_have_text("apart")
        seek(page, 39 * 10**8)
        expect(page.locator(".row.lit, .state.here").first).to_be_visible()
        page.locator("select").select_option(label="near")
        page.evaluate("viewer.settled()")
        expect(page.locator("select option:checked")).to_have_text("near")
        if panel == "specification":
            page.locator("select").select_option(label="met")
            page.evaluate("viewer.settled()")
            # nothing can come after the last sample
            for time_ns, words in ((38 * 10**8, "pending"), (39 * 10**8, "violated")):
                seek(page, time_ns)
                expect(page.locator(".chip")).to_have_text(words)
        assert page.evaluate("viewer.ranges.length") < 10


def test_the_list_of_results_has_the_worst_first(
    open_panel: Open, logs: Mapping[str, Path], tmp_path: Path
) -> None:
    log = tmp_path / "ordered.mcap"
    text = """
        spec met = F (a dist b <= 4)
        spec late = F (a dist b <= 0.5)
        spec unseen = G (a dist c >= 1)
        spec last = G (a dist b >= 3.5)
        spec early = G (a dist b >= 5)
    """
    with sr.Recorder(log, specifications=[sr.parse_specification(text)]) as recorder:
        for t in range(5):
            objects = {"a": sr.Footprint.disc(9 - t, 0, 1), "b": sr.Footprint.disc(0, 0, 1)}
            recorder.write(sr.Sample(t * 10**8, objects))
    write_viewer_page(log, log.with_suffix(".html"))
    page = open_panel("ordered", "specification", logs={"ordered": log})
    expect(page.locator("select option")).to_have_text(["early", "last", "late", "unseen", "met"])


LONG = """async (count) => {
    const {message: specification} = MESSAGES.find((each) => each.topic === "/spatial/specification");
    const [{name, object, nodes}] = specification.results;
    const stamp = (place) => ({sec: Math.floor(place / 1000), nsec: place % 1000 * 1e6});
    const messages = [{topic: "/spatial/specification", receiveTime: stamp(0), message: specification}];
    for (let place = 0; place < count; place++) {
        messages.push({topic: "/spatial/robustness", receiveTime: stamp(place), message: {
            specification: name, object,
            get nodes() {
                const number = place / 1000;
                return nodes.map(({id}) => ({id, value: number, now: number, lower: number, upper: number}));
            },
        }});
    }
    window.viewer = new Viewer(CODE, messages, "foxglove");
    await viewer.show("spatial-replay specification", document.getElementById("panel"));
}"""


def test_of_a_run_too_long_to_keep_the_sample_before_is_shown_and_named(
    browser: Browser, logs: Mapping[str, Path]
) -> None:
    page = browser.new_page(viewport={"width": 700, "height": 800})
    page.goto(logs["table"].with_suffix(".html").as_uri())
    samples = 200_000
    page.evaluate(LONG, samples)
    now = page.locator(".tree .row").first.locator(".number").last
    shown = []
    for sample in (0, 77_777, 123_456, samples - 1):
        seek(page, sample * 10**6)
        # a jump gives the sample itself; without it, a pointer finds the one before
        assert now.text_content() == number_text(sample / 1000)
        page.evaluate("viewer.hover(undefined)")
    for sample in (40_001, 40_002, 99_999, samples - 2):
        page.evaluate("seconds => viewer.hover(seconds)", sample / 1000)
        said = page.locator(".panel-head").inner_text()
        [kept] = re.findall(r"at (\d+\.\d+) s, under the pointer", said)
        shown.append(sample - round(float(kept) * 1000))
        assert now.text_content() == number_text((sample - shown[-1]) / 1000)
    assert all(0 <= behind <= 4 for behind in shown)
    assert any(shown)
    page.close()


def test_of_an_unknown_result_the_path_ends_at_what_is_unknown_and_moves_name_all_states(
    open_panel: Open, logs: Mapping[str, Path], tmp_path: Path
) -> None:
    log = tmp_path / "unseen.mcap"
    with sr.Recorder(
        log, specifications=[sr.parse_specification("spec apart = G (a dist b >= 5)")]
    ) as recorder:
        for t in range(12):
            objects = {"a": sr.Footprint.disc(9 - t / 2, 0, 1)}
            seen = {} if 3 <= t < 6 else {"b": sr.Footprint.disc(0, 0, 1)}
            recorder.write(sr.Sample(t * 10**8, objects | seen))
    write_viewer_page(log, log.with_suffix(".html"))
    page = open_panel("unseen", "specification", logs={"unseen": log})
    seek(page, 4 * 10**8)
    expect(page.locator(".chip")).to_have_text("unknown")
    expect(page.locator(".row.lit").last).to_contain_text("a dist b >= 5")
    page = open_panel("unseen", "automaton", logs={"unseen": log})
    seek(page, 11 * 10**8)
    expect(page.locator(".sentence").first).to_contain_text("0 → 0 or 1")
    expect(page.locator(".sentence").last).to_contain_text("0 or 1 → 1")
