"""The report's page says what was found, holds what it needs, and lets nothing of the log run."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from report.report_pages import (
    RECORDINGS,
    Page,
    page_of,
    report_of_recording,
    report_of_samples,
    report_of_trace,
    two_discs,
)
from spatial_replay import UsageError
from spatial_replay.replay.engine import load_files, run_replay
from spatial_replay.replay.selection import Window
from spatial_replay.report.write import write_report
from spatial_replay.sources import open_source

HOSTILE = (
    "</script><img src=x onerror=alert(1)>",
    "<!--<script>",
    "]]>&amp;\"'`${alert(1)}",
    "line\u2028and\u2029paragraph",
)


def moving(count: int, name: str = "a") -> list[sr.Sample]:
    """A box that moves towards a disc, and away again."""
    return [
        sr.Sample(
            t * 10**8,
            {
                name: sr.Footprint.box(abs(t - count // 2), 0, abs(t - count // 2) + 1, 1),
                "b": sr.Footprint.disc(0, 2, 1),
            },
        )
        for t in range(count)
    ]


@pytest.fixture(scope="module")
def violated(tmp_path_factory: pytest.TempPathFactory) -> Page:
    output = tmp_path_factory.mktemp("pages") / "violated.html"
    return report_of_recording(output, "table.jsonl", "table_edited.spatial")


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Page:
    return report_of_recording(tmp_path_factory.mktemp("pages") / "planned.html", "push.mcap")


# ---------------------------------------------------------------------------------- what the page says


NEARING = [
    sr.Sample(index * 10**9, {"a": sr.Footprint.disc(index, 0, 0.5), "b": sr.Footprint.disc(8, 0, 0.5)})
    for index in range(6)
]
NEARING_SPECS = """
spec late = F (a dist b <= 1)
spec soon = (a dist b <= 9) -> F[0s, 2s] (a dist b <= 3)
spec far = G (a dist b >= 4)
"""


def test_of_a_missed_response_all_is_about_what_came_nearest(tmp_path: Path) -> None:
    page = report_of_samples(tmp_path / "run.html", NEARING, NEARING_SPECS)
    soon = page.facts["results"][0]
    assert soon["title"] == "soon"
    pointer = soon["pointer"]
    assert (pointer["text"], pointer["label"], pointer["time"]) == ("a dist b <= 3", "-2", 2.0)
    assert soon["nodes"][soon["decided"]]["text"] == "a dist b <= 3"
    [event] = [each for each in page.facts["events"] if each["specification"] == "soon"]
    assert "held: a dist b <= 3 fails by 2." in "".join(event["parts"])


PAST = ("O %s", "O[0s, 2s] %s", "H %s", "H[1s, 3s] %s", "Y %s", "%s S (q >= 0)", "%s S[0s, 2s] (q >= 0)")
PAST_SPECS = "".join(
    f"spec right_{k} = G ((c >= 0) -> {past % '(p >= 0)'})\n"
    f"spec left_{k} = G (({past % '(p >= 0)'}) -> (c >= 0))\n"
    f"spec alone_{k} = G ({past % '(p >= 0)'})\n"
    for k, past in enumerate(PAST)
)


@examples(6)
@given(st.lists(st.tuples(*[st.integers(-9, 9)] * 3), min_size=8, max_size=8))
def test_what_asks_for_the_past_is_shown_when_it_failed_and_was_worst_when_its_curve_was(
    numbers: list[tuple[int, int, int]],
) -> None:
    samples = [
        sr.Sample(k * 10**9, {}, dict(zip("pqc", map(float, each), strict=True)))
        for k, each in enumerate(numbers)
    ]
    with TemporaryDirectory() as folder:
        page = report_of_samples(Path(folder) / "run.html", samples, PAST_SPECS)
    shown = {each["title"]: each for each in page.facts["results"]}
    for result in sr.evaluate(sr.parse_specification(PAST_SPECS), sr.Trace.from_samples(samples)):
        if (since_ns := result.violated_at_ns) is None:
            continue
        curve, since = result.nodes[0].value, since_ns // 10**9
        worst_ns = since_ns if result.least_at_ns is None else result.least_at_ns
        first = since + curve[since:].tolist().index(result.robustness)
        assert worst_ns == first * 10**9
        assert since_ns / 1e9 <= shown[result.title]["fault"] <= worst_ns / 1e9


def test_each_violated_result_has_an_arrow_of_its_own(tmp_path: Path) -> None:
    page = report_of_samples(tmp_path / "run.html", NEARING, NEARING_SPECS)
    assert [each["title"] for each in page.facts["results"]] == ["soon", "far", "late"]
    found = page.facts["scene"]["violations"]
    frames = page.numbers(found["frames"]).tolist()
    results = page.numbers(found["places"]).reshape(-1, 2)[:, 0].tolist()
    labels = dict(zip(zip(frames, results, strict=True), found["labels"], strict=True))
    assert labels[2, 0] == "a dist b <= 3 now: -2"
    assert labels[5, 0] == "a dist b <= 3 at 2.000 s: -2"
    assert labels[5, 1] == "a dist b >= 4 now: -2"


def test_of_equal_times_what_was_certain_comes_before_what_only_the_end_decided(tmp_path: Path) -> None:
    text = "spec late = F (a dist b <= 1)\nspec seen = G (c dist b >= 1)\nspec last = G (a dist b >= 2.5)\n"
    page = report_of_samples(tmp_path / "run.html", NEARING, text + "spec soon = F[0s, 1s] (a dist b <= 3)")
    assert [each["title"] for each in page.facts["results"]] == ["soon", "last", "late", "seen"]
    said = page.within("section#verdicts")
    rows = [
        said.index(f"{verdict}{name}robustness")
        for verdict, name in [
            ("violated", "soon"),
            ("violated", "last"),
            ("violated", "late"),
            ("unknown", "seen"),
        ]
    ]
    assert rows == sorted(rows)


def test_verdicts_and_explanations_can_be_read_without_scripts(violated: Page) -> None:
    said = violated.within("section#verdicts")
    assert "violatedtable_setrobustness \N{MINUS SIGN}0.1552," in said
    assert "which fails by 0.1552 at 4.000 s" in said
    assert "with 0.2353 or more instead of 0.08" in said


def test_the_page_says_which_run_it_is_of(violated: Page) -> None:
    header = violated.within("header#")
    assert "table.jsonl" in header
    assert "table_edited.spatial · 9.967 s · 300 samples · semantics ltlf · spatial-replay" in header
    assert "const deadline = 4s" in violated.within("footer#")
    assert "results_sha256" in violated.within("footer#")


def test_a_run_on_the_calendar_says_when_it_was(tmp_path: Path, violated: Page) -> None:
    noon_ns = 1_769_860_800 * 10**9
    samples = [sr.Sample(noon_ns + each.time_ns, each.objects) for each in moving(3)]
    header = report_of_samples(tmp_path / "run.html", samples, "F (a ovlp b)").within("header#")
    assert "2026-01-31 12:00:00 UTC · 0.200 s · 3 samples" in header
    assert "UTC" not in violated.within("header#")


def test_numbers_are_those_of_the_evaluation(violated: Page) -> None:
    trace = sr.read_trace(RECORDINGS / "table.jsonl")
    evaluation = sr.evaluate(sr.load_specification(RECORDINGS / "table_edited.spatial"), trace)
    assert np.array_equal(violated.numbers(violated.facts["times"]), trace.times_ns / 1e9)
    for result, found in zip(violated.facts["results"], evaluation, strict=True):
        assert (result["name"], result["verdict"]) == (found.name, found.verdict)
        series = violated.numbers(result["series"]).reshape(found.series.shape)
        assert np.array_equal(series, found.series.astype(np.float32), equal_nan=True)


def test_nodes_show_their_own_part_of_the_formula(violated: Page) -> None:
    nodes = {node["name"]: node for node in violated.facts["results"][0]["nodes"] if node["name"]}
    assert nodes["laid"]["head"] == "F[0s, 4s] …"
    assert nodes["plate_first"]["head"] == "… U …"
    assert nodes["table_set"]["head"] == "and"
    assert nodes["table_set"]["initial"]


def test_below_a_temporal_operator_a_node_counts_at_every_sample(tmp_path: Path) -> None:
    text = "spec s = (a leftof b) and G (not (a ovlp b))"
    nodes = report_of_samples(tmp_path / "run.html", moving(5), text).facts["results"][0]["nodes"]
    assert [(node["head"], node["initial"]) for node in nodes] == [
        ("and", True), ("a leftof b", True), ("G …", True), ("not", False), ("a ovlp b", False),
    ]  # fmt: skip


def test_events_are_those_of_an_annotated_log(violated: Page) -> None:
    events = violated.facts["events"]
    assert [event["time"] for event in events] == sorted(event["time"] for event in events)
    found = next(
        event
        for event in events
        if event["parts"][1] == "table_set" and "is permanently violated" in event["parts"][2]
    )
    assert (found["time"], found["status"], found["specification"]) == (4.0, "violated", "table_set")


def test_the_scene_is_that_of_the_messages(tmp_path: Path) -> None:
    text = "region here = box(-1, -1, 3, 3)\nspec s = G (a enclosedin here)"
    page = report_of_samples(tmp_path / "run.html", moving(9), text)
    scene = page.facts["scene"]
    assert [(each["kind"], each["name"]) for each in scene["entities"]] == [
        ("region", "here"), ("object", "a"), ("object", "b"),
    ]  # fmt: skip
    low, size = np.array(scene["low"]), np.array(scene["high"]) - scene["low"]
    assert low.tolist() == [-1.0, -1.0]
    box = scene["entities"][1]
    corners = low + page.numbers(box["points"]).reshape(9, 4, 2) / 65535 * size
    assert np.allclose(corners[0].min(axis=0), [4, 0], atol=1e-3)
    assert np.allclose(corners[4].min(axis=0), [0, 0], atol=1e-3)
    # the first and the last two samples violate it, and are pointed at
    assert page.numbers(scene["violations"]["frames"]).tolist() == [0, 1, 7, 8]
    assert scene["violations"]["labels"][0] == "a enclosedin here now: -2"
    assert page.numbers(scene["violations"]["robustness"])[0] == -2
    [result] = page.facts["results"]
    places = page.numbers(scene["violations"]["places"]).reshape(-1, 2).tolist()
    assert places == [[0, result["requirements"][0]["node"]]] * 4


PEOPLE = "group people = left, near, far"


def test_of_several_results_each_colours_objects_as_if_it_were_the_only_one(tmp_path: Path) -> None:
    names = {"left": -3.0, "near": -0.5, "far": 2.0}
    samples = [
        sr.Sample(t * 10**8, {
            "car": sr.Footprint.box(t, 0, t + 1, 1),
            **{name: sr.Footprint.box(x + 3, 1.5, x + 4, 2.5) for name, x in names.items()},
        })
        for t in range(8)
    ]  # fmt: skip
    lines = [
        "spec each = G (forall p in people: p dist car >= 1)",
        "spec both = G (near dist car >= 1 and far dist car >= 0.7)",
        "spec there = F (left dist car >= 4)",
    ]
    several = report_of_samples(tmp_path / "several.html", samples, "\n".join([PEOPLE, *lines]))
    scene = several.facts["scene"]
    palette = several.numbers(scene["shades"]).reshape(256, 3).astype(int)
    assert len(scene["entities"]) == 4
    for place, result in enumerate(several.facts["results"]):
        [line] = [each for each in lines if f"spec {result['name']} " in each]
        alone = report_of_samples(tmp_path / f"{place}.html", samples, f"{PEOPLE}\n{line}")
        for drawn, own in zip(scene["entities"], alone.facts["scene"]["entities"], strict=True):
            assert own["shades"] is None
            shades = several.numbers(drawn["shades"]).reshape(-1, len(lines))[:, place]
            expected = alone.numbers(own["colours"]).reshape(-1, 3)
            assert np.abs(palette[shades] - expected).max() <= 1, (line, drawn["name"])


def test_exact_comparisons_are_drawn_beside_others(tmp_path: Path) -> None:
    objects = {"car": sr.Footprint.disc(0, 0, 1), "bus": sr.Footprint.disc(4, 0, 1)}
    samples = [sr.Sample(t, objects, {"mode": "AUTO"}) for t in range(3)]
    lines = (
        'spec a = G (mode == "AUTO" -> car dist bus >= 1)',
        'spec b = G (mode == "AUTO" and car dist bus >= 3)',
    )
    page = report_of_samples(tmp_path / "both.html", samples, "\n".join(lines))
    assert [each["verdict"] for each in page.facts["results"]] == ["violated", "satisfied"]


def test_a_page_says_where_results_are_too_many_for_colours_of_each(tmp_path: Path) -> None:
    discs = {f"o{number}": sr.Footprint.disc(3 * number, 0, 0.3) for number in range(64)}
    page = tmp_path / "run.html"
    for count in (64, 65):
        lines = [f"spec s{k} = G (o{k % 64} dist o{(k + 1) % 64} >= {1 + k / 10})" for k in range(count)]
        drawn = report_of_samples(page, [sr.Sample(0, discs)], "\n".join(lines)).facts["scene"]["entities"]
        is_alike = "the colours of all results together" in page.read_text(encoding="utf-8")
        assert is_alike == (count > 64) == all(each["shades"] is None for each in drawn)


def test_an_absent_object_leaves_its_last_outline(tmp_path: Path) -> None:
    samples = [
        each if t != 2 else sr.Sample(each.time_ns, {"a": each.objects["a"]})
        for t, each in enumerate(moving(5))
    ]
    page = report_of_samples(tmp_path / "run.html", samples, "spec s = F (a ovlp b)")
    entity = next(each for each in page.facts["scene"]["entities"] if each["name"] == "b")
    assert page.numbers(entity["form"]).tolist() == [0, 0, 1, 0, 0]
    assert entity["last"] == [1]
    points = page.numbers(entity["points"]).reshape(5, -1)
    assert points[2].tolist() == points[1].tolist()


def test_decisions_for_another_specification_are_marked_so(tmp_path: Path) -> None:
    for name, is_marked in (("push.spatial", False), ("push_edited.spatial", True)):
        report_of_recording(tmp_path / "run.html", "push.mcap", name)
        said = "made for another specification: push.spatial" in (tmp_path / "run.html").read_text("utf-8")
        annotated = tmp_path / f"{name}.mcap"
        source = open_source(RECORDINGS / "push.mcap")
        run_replay(source, load_files([RECORDINGS / name], source), output=annotated)
        layout = next(each for each in open_source(annotated).attachments() if each.name == "layout.json")
        marked = (
            b"decided so, for push.spatial as recorded",
            b"(map of push.spatial as recorded: vermillion",
        )
        assert said == is_marked == all(each in layout.data for each in marked)


def test_the_automaton_is_drawn_as_it_leads_on(planned: Page) -> None:
    automaton = planned.facts["results"][0]["automaton"]
    columns = {state["number"]: state["at"][0] for state in automaton["states"]}
    assert columns[0] == 0
    assert all(
        columns[move["source"]] < columns[move["target"]]
        for move in automaton["moves"]
        if move["source"] != move["target"]
    )
    path = [automaton["sets"][code] for code in planned.numbers(automaton["path"])]
    assert path[0] != path[-1]
    assert path[-1][0] in {state["number"] for state in automaton["states"] if state["accepting"]}


def test_a_result_without_automaton_says_why(violated: Page) -> None:
    result = violated.facts["results"][0]
    assert result["automaton"] is None
    assert result["no_automaton"] == ["", "F[0s, 4s]", " counts seconds, an automaton counts samples"]


def test_decisions_come_with_their_maps(planned: Page) -> None:
    decisions = planned.facts["decisions"]
    first = decisions[0]
    assert first["reason"].startswith("red moves: red above blue")
    assert first["outcome"]["succeeded"]
    assert [each["chosen"] for each in first["maps"]].count(True) == 1
    chosen = next(each for each in first["maps"] if each["chosen"])
    assert (chosen["title"], chosen["edge"]) == ("red", 1)
    assert chosen["target"]["at"] == first["target"]["at"]
    assert [each["title"] for each in first["maps"] if each["edge"] == 0] == ["green", "red", "blue"]
    logged = [
        Grid.FromString(payload)
        for payloads, _ in open_source(RECORDINGS / "push.mcap").iter_payloads("/plan/gradient_map")
        for payload in payloads
    ]
    drawn = [each for decision in decisions for each in decision["maps"]]
    assert len(drawn) == len(logged)
    for grid, each in zip(logged, drawn, strict=True):
        cells = np.frombuffer(grid.data, np.uint8).reshape(-1, grid.cell_stride)[:, :4]
        assert each["columns"] == grid.column_count
        assert np.array_equal(planned.numbers(each["values"]), cells.copy().view("<f4")[:, 0], equal_nan=True)


def test_instances_of_a_template_have_their_own_results(tmp_path: Path) -> None:
    page = report_of_samples(
        tmp_path / "run.html", moving(6), "spec calm(ego) = G (ego dist b >= 0)", each={"ego": "all"}
    )
    assert [result["title"] for result in page.facts["results"]] == ["calm(b)", "calm(a)"]
    assert [result["verdict"] for result in page.facts["results"]] == ["violated", "satisfied"]
    assert page.facts["results"][0]["nodes"][-1]["text"] == "b dist b >= 0"
    assert "calm(a)" in page.within("section#verdicts")


def test_an_unknown_run_says_which_window_leaves_out_what_is_missing(tmp_path: Path) -> None:
    disc = sr.Footprint.disc
    samples = [
        sr.Sample(t * 10**9, {"a": disc(0, 0, 1)} | ({"b": disc(5, 0, 1)} if 3 <= t < 6 else {}))
        for t in range(7)
    ]
    page = report_of_samples(tmp_path / "run.html", samples, "spec apart = G (a dist b >= 1)")
    assert "--from 3.000s --to 6.000s leaves them out." in page.within("header#")
    seen = report_of_samples(
        tmp_path / "seen.html", samples, "spec apart = G (a dist b >= 1)", window=Window(3 * 10**9, 6 * 10**9)
    )
    assert "leaves them out" not in seen.text


def test_arrows_of_the_automaton_have_the_words_of_its_drawing(planned: Page) -> None:
    automaton = planned.facts["results"][0]["automaton"]
    assert "p1: red above blue" in automaton["legend"]
    assert {"not p2"} < {move["label"] for move in automaton["moves"]}


def test_a_unit_that_is_declared_is_shown(tmp_path: Path, data_folder: Path) -> None:
    (tmp_path / "turtles.yaml").write_text(
        "topics:\n"
        "  /turtle1/pose: {shape: {disc: 0.5}, signals: {speed: {field: linear_velocity, unit: m/s}}}\n"
    )
    source = open_source(data_folder / "bags/two_turtles.bag", mapping=tmp_path / "turtles.yaml")
    specs = [sr.parse_specification("spec slow = G (speed <= 9)\nspec never_fast = slow")]
    run_replay(source, specs, output=tmp_path / "annotated.mcap")
    again = open_source(tmp_path / "annotated.mcap")
    for log, page in ((source, "run.html"), (again, "again.html")):
        write_report(log, specs, tmp_path / page)
        assert page_of(tmp_path / page).facts["results"][0]["nodes"][0]["unit"] == "m/s"
        numbers = re.findall(r'class="numbers">robustness ([^<,]*)', (tmp_path / page).read_text("utf-8"))
        assert [each.split()[-1] for each in numbers] == ["m/s", "m/s"]


def test_a_damaged_log_is_said_to_be_so_first(tmp_path: Path) -> None:
    log = tmp_path / "broken.mcap"
    log.write_bytes((RECORDINGS / "push.mcap").read_bytes()[:900_000])
    source = open_source(log)
    write_report(source, load_files([RECORDINGS / "push.spatial"], source), tmp_path / "run.html")
    page = page_of(tmp_path / "run.html")
    assert "The log is damaged: verdicts are over what could be read." in page.within("header#")
    assert any(each.get("role") == "alert" for each in page.tags("div"))


def test_under_the_papers_semantics_nothing_is_explained(tmp_path: Path) -> None:
    page = report_of_samples(tmp_path / "run.html", moving(6), "F (a ovlp b)", semantics="paper")
    assert not page.facts["settles"]
    assert "What decides" not in page.within("section#verdicts")
    assert "semantics paper" in page.within("header#")
    assert "Explanations are given under the semantics ltlf alone." in page.within("header#")


TASK = """\
spec safe "REQ-3: nothing is bumped into" = G (robot dist vase >= 0.05)
spec powered "REQ-4: the battery never runs low" = G (battery >= 0.2)
spec delivered "REQ-1: the robot ends in the bin" = F (robot enclosedin bin)
spec task "the whole job" = safe and delivered and powered
"""


def driving(count: int = 40) -> list[sr.Sample]:
    """A robot that passes a vase too closely on its way to a bin, which it never reaches."""
    things = {"vase": sr.Footprint.disc(3, 0.7, 0.25), "bin": sr.Footprint.box(6, 0, 7, 1)}
    return [
        sr.Sample(
            t * 10**8,
            {"robot": sr.Footprint.box(t / 10, 0, t / 10 + 0.5, 0.5), **things},
            {"battery": 0.9 - t / 100},
        )
        for t in range(count)
    ]


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> Page:
    return report_of_samples(tmp_path_factory.mktemp("pages") / "task.html", driving(), TASK)


def test_the_headline_is_what_settled_the_verdict_and_says_which_part_is_least(task: Page) -> None:
    said = task.within("section#verdicts")
    assert "robustness \N{MINUS SIGN}2.1, violated since 2.300 s" in said
    assert "first satisfied" not in said
    assert "task is violated: robustness \N{MINUS SIGN}2.1, certain since 2.300 s" in said
    assert "(the least robustness is that of delivered)" in said
    assert said.index("robot dist vase >= 0.05") < said.index("robot enclosedin bin")


def test_the_page_opens_with_an_arrow_at_what_the_first_cause_came_to(task: Page) -> None:
    [result] = task.facts["results"]
    assert result["pointer"]["time"] == result["fault"] > 2.3
    assert result["pointer"]["text"] == "robot dist vase >= 0.05"
    assert result["pointer"]["label"] == "-0.1"


def test_a_goal_that_is_still_to_come_has_no_arrow(task: Page) -> None:
    scene = task.facts["scene"]
    frames = task.numbers(scene["violations"]["frames"])
    times = task.numbers(scene["times"])
    assert times[frames].min() == 2.3
    [result] = task.facts["results"]
    is_early = task.numbers(task.facts["times"]) < 2.3
    violated = 2
    for requirement in result["requirements"]:
        assert violated not in task.numbers(requirement["standing"])[is_early]


def test_named_specs_have_a_row_each_with_their_requirement_and_number(task: Page) -> None:
    said = task.within("ul#")
    assert (
        "violatedREQ-3safenothing is bumped intorobustness \N{MINUS SIGN}0.1, violated since 2.300 s" in said
    )
    assert "violatedREQ-1deliveredthe robot ends in the binrobustness \N{MINUS SIGN}2.1" in said
    assert "satisfiedREQ-4poweredthe battery never runs lowrobustness 0.31" in said


def test_what_is_written_as_a_def_has_that_name_in_the_tree_and_its_parts_below(tmp_path: Path) -> None:
    text = """\
def far(x, y) = x dist y >= 0.1
def parted(x, y) = far(x, y) or not (x ovlp y)
spec apart = G (far(a, b) and parted(a, b) and a dist b >= 0.2)
"""
    nodes = report_of_samples(tmp_path / "run.html", moving(6), text).facts["results"][0]["nodes"]
    heads = {node["head"]: node["text"] for node in nodes}
    assert heads["far(a, b)"] == "a dist b >= 0.1"
    assert heads["parted(a, b)"] == "(a dist b >= 0.1) or (not (a ovlp b))"
    assert {"a dist b >= 0.1", "not", "a ovlp b", "a dist b >= 0.2"} < set(heads)


def test_the_units_that_a_minimum_is_over_are_named(task: Page) -> None:
    assert "the least of numbers in different units: lengths and battery." in task.within("section#verdicts")


def test_the_scene_says_where_y_points(task: Page) -> None:
    assert "Seen from above, y up." in task.within("section#scene")


def test_a_result_that_decided_nothing_is_marked(tmp_path: Path) -> None:
    page = report_of_samples(tmp_path / "run.html", driving(3), "spec late = G[60s, 90s] robot ovlp vase")
    said = page.within("section#verdicts")
    assert "tested by nothing" in said
    assert 'class="chip is-vacuous">satisfied' in page.text
    assert 'class="chip is-satisfied"' not in page.text
    assert "no sample of the log lies in its window" in said
    assert [event["status"] for event in page.facts["events"]][-1] == "vacuous"


# ------------------------------------------------------------------------------- what the page is made of


def test_texts_of_logs_and_specifications_stay_texts(tmp_path: Path) -> None:
    for number, name in enumerate(HOSTILE):
        quoted = '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
        text = f"# {name.splitlines()[0]} </pre><script>alert(1)</script>\nspec s = F ({quoted} ovlp b)\n"
        page = report_of_samples(tmp_path / f"{number}.html", moving(6, name), text)
        assert {
            tag for tag, _ in page.elements if tag in ("img", "iframe", "object", "embed", "link")
        } == set()
        assert len(page.tags("script")) == 4
        assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)
        assert name in {entity["name"] for entity in page.facts["scene"]["entities"]}
        assert "<!--" not in page.text
        assert "\u2028" not in page.script("facts")


def test_signs_that_do_not_show_give_way_to_spaces(tmp_path: Path) -> None:
    text = 'spec s = F ("left\u202eright" ovlp b)\n'
    page = report_of_samples(tmp_path / "run.html", moving(6, "left\u202eright"), text)
    assert "left right" in page.within("section#verdicts")
    assert "\u202e" not in page.text
    assert 'spec s = F ("left right" ovlp b)\n' in page.within("footer#")


@pytest.mark.parametrize("name", ["a`b", "`", "a` b", "a `b", "`a`", '"`', "`, "])
def test_backquotes_in_names_leave_text_and_code_apart(tmp_path: Path, name: str) -> None:
    quoted = '"' + name.replace('"', '\\"') + '"'
    page = report_of_samples(tmp_path / "run.html", moving(6, name), f"spec s = F ({quoted} dist b <= -9)")
    codes = [text for inside, text in page.texts if "section#verdicts" in inside and inside[-1] == "code#"]
    assert codes[:2] == ["s", f"{quoted} dist b <= -9"]
    assert " is violated, for the log has ended: robustness " in page.within("section#verdicts")
    parts = next(each["parts"] for each in page.facts["events"] if "violated" in each["parts"][2])
    assert parts[1] == "s"
    assert f"{quoted} dist b <= -9" in parts


def test_a_file_name_that_is_no_text_is_shown_with_an_escape(tmp_path: Path) -> None:
    log = tmp_path / os.fsdecode(b"run\xff.jsonl")
    log.write_bytes((RECORDINGS / "table.jsonl").read_bytes())
    source = open_source(log)
    write_report(source, load_files([RECORDINGS / "table.spatial"], source), tmp_path / "run.html")
    assert r"run\udcff.jsonl" in page_of(tmp_path / "run.html").within("header#")


def test_nothing_is_loaded_and_nothing_else_may_run(violated: Page) -> None:
    policy = next(each["content"] for each in violated.tags("meta") if "http-equiv" in each) or ""
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    for code in [*violated.scripts(), violated.within("style#")]:
        digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    assert len(violated.scripts()) == 2
    assert not any("src" in attributes for _, attributes in violated.elements)
    assert [each["href"] for each in violated.tags("a")] == ["#main"]


def test_scripts_never_take_texts_for_html(violated: Page) -> None:
    for code in violated.scripts():
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", code)


def test_equal_runs_give_equal_pages(tmp_path: Path, violated: Page) -> None:
    again = report_of_recording(tmp_path / "elsewhere.html", "table.jsonl", "table_edited.spatial")
    assert again.text == violated.text
    assert str(tmp_path) not in again.text
    assert str(RECORDINGS) not in again.text


def test_an_annotated_log_gives_the_page_of_its_source(tmp_path: Path, planned: Page) -> None:
    annotated = tmp_path / "push.mcap"
    source = open_source(RECORDINGS / "push.mcap")
    run_replay(source, load_files([], source), output=annotated)
    source = open_source(annotated)
    write_report(source, load_files([], source), tmp_path / "run.html")
    assert page_of(tmp_path / "run.html").text == planned.text


def test_a_large_run_keeps_less_and_says_so(tmp_path: Path) -> None:
    large = "spec large = G (" + " and ".join(f"a dist b >= {k / 100}" for k in range(100)) + ")"
    specs = "\n".join([large, *(f"spec s{k} = G (a dist b >= {k / 100})" for k in range(29))])
    page = report_of_trace(tmp_path / "run.html", two_discs(12_000), specs)
    kept = page.numbers(page.facts["times"])
    assert len(page.facts["results"]) == 24
    assert len(kept) < 12_000
    assert sum(result["series"]["length"] for result in page.facts["results"]) <= 4_000_000
    assert (kept[0], kept[-1]) == (0.0, 119.99)
    assert page.facts["scene"]["times"]["length"] <= 3_000
    header = page.within("header#")
    assert f"Curves and tree have {len(kept):,} of 12,000 samples" in header
    assert "24 of 30 results, the worst" in header
    assert "messages of /spatial/scene" in header
    assert page.within("section#verdicts").count("robustness") >= 30


def test_the_sample_that_made_a_result_violated_is_kept(tmp_path: Path) -> None:
    parts = " and ".join(f"(a dist b >= {k / 1000})" for k in range(100))
    page = report_of_trace(
        tmp_path / "run.html", two_discs(12_000), f"spec s = G ({parts} and a dist b >= 0.5)"
    )
    (result,) = page.facts["results"]
    times = page.numbers(page.facts["times"])
    assert len(times) < 12_000
    assert result["fault"] in times
    assert f"at {result['fault']:.3f} s" in page.within("section#verdicts")
    satisfied = report_of_trace(tmp_path / "run.html", two_discs(9), "spec s = G (a dist b >= 0)")
    assert satisfied.facts["results"][0]["fault"] is None


def test_the_scene_of_a_long_run_has_every_sample_that_a_sentence_is_about(tmp_path: Path) -> None:
    # at 100 Hz: /spatial/scene has every second sample, and the page some of these
    trace = two_discs(12_000)
    page = report_of_trace(tmp_path / "run.html", trace, "spec apart = G (a dist b >= 0.00001)")
    (result,) = page.facts["results"]
    scene = page.facts["scene"]
    times = page.numbers(scene["times"])
    assert scene["stride"] >= 2
    assert {result["fault"], *(event["time"] for event in page.facts["events"])} <= set(times)
    (violated,) = [event["time"] for event in page.facts["events"] if event["status"] == "violated"]
    # the picture at the cursor is that of the sentence: where the discs overlap most
    low, size = np.array(scene["low"]), np.array(scene["high"]) - scene["low"]
    drawn = next(entity for entity in scene["entities"] if entity["name"] == "a")
    points = low + page.numbers(drawn["points"]).reshape(len(times), -1, 2) / 65535 * size
    right = points[..., 0].max(axis=1) - 1.0
    for time in (result["fault"], violated):
        assert right[times.tolist().index(time)] == pytest.approx(np.sin(time * 2), abs=1e-3)
    assert round(result["fault"] * 100) % 4 != 0
    assert "every sample that decides, is least or begins an event" in page.within("header#")


def test_of_a_large_tree_the_uppermost_nodes_are_shown(tmp_path: Path) -> None:
    deep = " and ".join(f"(F (a dist b >= {k}) or G (a dist b <= {k}))" for k in range(150))
    page = report_of_samples(tmp_path / "run.html", moving(3), f"spec s = {deep}")
    nodes = page.facts["results"][0]["nodes"]
    assert len(nodes) == 400
    assert sum(node["head"] in ("F …", "G …") for node in nodes) > 150
    assert all(node["parent"] is None or node["parent"] < place for place, node in enumerate(nodes))
    assert "the uppermost 400 are shown" in page.within("header#")


def test_remarks_on_the_samples_are_shown(tmp_path: Path) -> None:
    log = tmp_path / "run.jsonl"
    square = '{"name": "%s", "polygon": [[0, 0], [1, 0], [%s, 1]]}'
    rows = [
        f'{{"time_ns": {t}, "objects": [{square % ("a", 1)}, {square % ("b", "null" if t == 3 else 2)}]}}'
        for t in range(5)
    ]
    log.write_text("\n".join(rows))
    write_report(open_source(log), [sr.parse_specification("G (a ovlp b)")], tmp_path / "run.html")
    assert "1 observation holds no finite number: unknown there." in page_of(tmp_path / "run.html").within(
        "header#"
    )


def test_a_template_without_instances_is_listed(tmp_path: Path) -> None:
    car = sr.TrackedObject(sr.Footprint.disc(0, 0, 1), class_name="car")
    samples = [sr.Sample(t, {} if t else {"a": car}) for t in range(4)]
    page = report_of_samples(
        tmp_path / "run.html",
        samples,
        "spec calm(ego) = G (ego dist ego >= 0)",
        each={"ego": "class:car"},
        window=Window(start_ns=1),
    )
    assert page.facts["results"] == []
    assert "The templates matched no objects." in page.within("section#verdicts")
    assert "calm(ego) was never evaluated" in page.within("section#verdicts")


def test_objects_far_away_are_drawn(tmp_path: Path) -> None:
    samples = [sr.Sample(t, {"a": sr.Footprint.disc((-1) ** t * 1e99, 0, 1)}) for t in range(4)]
    scene = report_of_samples(tmp_path / "run.html", samples, "G (a ovlp a)").facts["scene"]
    assert np.isfinite(scene["low"] + scene["high"]).all()


def test_the_page_never_replaces_an_input(tmp_path: Path) -> None:
    output = tmp_path / "run.html"
    output.write_text("mine")
    with pytest.raises(UsageError, match="is an input too"):
        report_of_samples(output, moving(3), "F (a ovlp b)", inputs=[output])
    assert output.read_text() == "mine"


def test_of_a_large_automaton_the_states_of_the_run_are_drawn(tmp_path: Path) -> None:
    page = report_of_samples(tmp_path / "run.html", moving(20), "spec s = F[90, 100] (a ovlp b)")
    automaton = page.facts["results"][0]["automaton"]
    shown = [state["number"] for state in automaton["states"]]
    assert len(shown) == 60
    assert automaton["left_out"] > 0
    path = {state for code in page.numbers(automaton["path"]) for state in automaton["sets"][code]}
    assert path <= set(shown)
    assert {move["source"] for move in automaton["moves"]} >= path
    assert len({tuple(state["at"]) for state in automaton["states"]}) == 60
