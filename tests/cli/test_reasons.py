"""What `replay` and `explain` say about why a verdict is what it is, and about what decided nothing."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

import spatial_replay as sr
from spatial_replay.cli import run

LOG = Path(__file__).parent.parent.parent / "recordings" / "table.jsonl"
MISSION = """\
spec safe = G (cup dist plate >= 0.2)
spec goal = F (fork ovlp plate)
spec mission "REQ-7: done and safe" = safe and goal
"""
IDLE = """\
spec late = G[60s, 90s] (cup ovlp plate)
spec polite = G (cup ovlp plate -> fork ovlp plate)
spec calm = G (forall d in class "dragon": d ovlp plate)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission.spatial").write_text(MISSION)
    (tmp_path / "idle.spatial").write_text(IDLE)
    return tmp_path


def _document(folder: Path, spec: str, *options: str) -> tuple[int, dict[str, Any]]:
    code = run(["replay", str(LOG), "--spec", spec, *options, "--json", "out.json"])
    loaded: dict[str, Any] = json.loads((folder / "out.json").read_text())
    return code, loaded


def test_every_failing_spec_has_a_cause_and_the_settled_one_is_the_worst(folder: Path) -> None:
    code, document = _document(folder, "mission.spatial")
    (mission,) = document["specifications"]
    assert (code, mission["verdict"]) == (1, "violated")
    assert [each["spec"] for each in mission["causes"]] == ["safe", "goal"]
    settled, pending = mission["causes"]
    assert settled["settled_ns"] == mission["violated_at_ns"] == 5_533_333_333
    assert pending["settled_ns"] is None, "only the end of the log decided that the goal was missed"
    assert mission["worst"] == settled["witness"]
    assert mission["worst"]["atom"]["text"] == "cup dist plate >= 0.2"
    assert mission["worst"]["time_ns"] == mission["violated_at_ns"]
    assert mission["satisfied_at_ns"] is None


def test_the_text_says_when_a_violation_became_certain_and_why(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(LOG), "--spec", "mission.spatial"]) == 1
    printed = capsys.readouterr().out
    _, first, title, safe, goal = printed.splitlines()
    assert "mission [REQ-7]  violated" in first
    assert "certain since 5.533 s" in first
    assert title.strip() == "done and safe"
    assert safe.strip().startswith("safe: `cup dist plate >= 0.2` fails by 0.1449 at 9.767 s ")
    assert safe.endswith(" It was violated first at 5.533 s, by 0.001284.")
    assert goal.strip().startswith("goal: `fork ovlp plate` fails by ")
    assert "first satisfied" not in printed


def test_the_requirements_of_a_result_its_parts_and_causes_are_in_every_output(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = MISSION.replace("spec safe =", 'spec safe "REQ-3: keeps its distance" =')
    (folder / "mission.spatial").write_text(text)
    (mission,) = _document(folder, "mission.spatial")[1]["specifications"]
    assert (mission["requirement"], mission["title"]) == ("REQ-7", "done and safe")
    named = {node["name"]: (node["requirement"], node["title"]) for node in mission["nodes"] if node["name"]}
    about = ("REQ-3", "keeps its distance")
    assert named == {"mission": ("REQ-7", "done and safe"), "safe": about, "goal": (None, None)}
    assert (mission["causes"][0]["requirement"], mission["causes"][0]["title"]) == about
    assert "safe [REQ-3: keeps its distance]: " in capsys.readouterr().out
    run(["explain", str(LOG), "--spec", "mission.spatial"])
    said = capsys.readouterr().out
    assert "`safe` (REQ-3: keeps its distance) is permanently violated from 5.533 s" in said


def test_on_a_terminal_a_violation_leads_to_explain(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["replay", str(LOG), "--spec", "mission.spatial"]
    run(arguments)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    run(arguments)
    assert "`spatial-replay explain` with the same log" in capsys.readouterr().err


def test_many_results_are_counted_and_the_worst_come_first(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "apart.spatial").write_text(
        'spec apart(t) "REQ-8: nothing is on the fork" = G (t dist fork >= 0.05)\n'
        "spec distant(t) = G (t dist fork >= 0.02)\n"
    )
    assert run(["replay", str(LOG), "--spec", "apart.spatial", "--each", "t=all"]) == 1
    head, *lines = capsys.readouterr().out.splitlines()
    verdicts = [line.split()[1:3] for line in lines if "  robustness " in line]
    found = ["violated" if "violated" in each else "satisfied" for each in verdicts]
    violated = found.count("violated")
    assert found == sorted(found, reverse=True)
    assert head.endswith(f"over 9.967 s: {violated} violated, {len(found) - violated} satisfied")
    assert sum("nothing is on the fork" in line for line in lines) == 1


def test_explain_has_one_object_of_facts_for_each_result(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(["explain", str(LOG), "--spec", "mission.spatial", "--json"])
    (found,) = json.loads(capsys.readouterr().out)
    (mission,) = _document(folder, "mission.spatial")[1]["specifications"]
    for key in (
        "verdict",
        "robustness",
        "lower",
        "upper",
        "requirement",
        "title",
        "causes",
        "vacuous",
        "worst",
    ):
        assert found[key] == mission[key]
    assert (found["specification"], found["name"], found["node"]) == ("mission", "mission", 0)
    assert found["since_ns"] == mission["violated_at_ns"] == found["time_ns"]
    assert found["atom"] == mission["worst"]["atom"]
    assert found["explanation"][0].startswith("`mission` is violated: robustness -0.1449, certain since")


def test_a_failed_implication_names_the_response_that_was_missing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = "G (cup dist plate <= 0.3 -> F[0s, 1s] (fork dist plate <= 0.02))"
    (folder / "respond.spatial").write_text(f"spec respond = {formula}\n")
    response, condition = "`F[0s, 1s] (fork dist plate <= 0.02)`", "`cup dist plate <= 0.3`"
    missed = f"{response} did not hold at 5.267 s, when its condition {condition} held."
    measured = "The condition held: cup and plate are 0.2902 apart."
    run(["replay", str(LOG), "--spec", "respond.spatial", "-o", "out.mcap"])
    closest = "`fork dist plate <= 0.02` came closest at "
    out = " ".join(capsys.readouterr().out.split())
    assert f"{missed} {closest}" in out
    assert measured in out
    run(["explain", str(LOG), "--spec", "respond.spatial"])
    out = capsys.readouterr().out
    assert {missed, measured} <= set(out.splitlines())
    [line] = [line for line in out.splitlines() if line.startswith(closest)]
    trace = sr.read_trace(LOG)
    fork = sr.evaluate(sr.parse_specification("spec near = F fork dist plate <= 0.02"), trace).results[0]
    now = fork.nodes[1].now[(trace.times_ns >= 5_266_000_000) & (trace.times_ns <= 6_267_000_000)]
    assert line.endswith(f": fork and plate are {0.02 - now.max():.4g} apart.")
    assert "holds by" not in out
    (respond,) = _document(folder, "respond.spatial")[1]["specifications"]
    assert respond["worst"]["missed"]["response"] == "F[0s, 1s] (fork dist plate <= 0.02)"


def test_amounts_are_said_in_the_unit_of_the_log_where_scale_divides_them(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "scaled.spatial").write_text("scale lengths = 0.5\nspec safe = G (cup dist plate >= 0.2)\n")
    run(["replay", str(LOG), "--spec", "scaled.spatial"])
    said = capsys.readouterr().out
    assert "It was violated first at 5.533 s, by 0.001284 (0.002568 on its scale of 0.5)." in said


def test_explain_lists_every_failing_spec_the_settled_one_first(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", str(LOG), "--spec", "mission.spatial"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "REQ-7: done and safe"
    assert lines[1].startswith("`mission` is violated: robustness -0.1449, certain since 5.533 s")
    assert lines[2] == "`safe` is permanently violated from 5.533 s on."
    assert any(line.startswith("`goal` is violated, for the log has ended: ") for line in lines[3:])


def test_explain_names_the_part_with_the_least_robustness(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "stopped.spatial").write_text(
        "spec safe = G (cup dist plate >= 0.06)\nspec goal = F (fork dist cup >= 5)\nspec s = safe and goal\n"
    )
    assert run(["explain", str(LOG), "--spec", "stopped.spatial"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("(the least robustness is that of `goal`).")
    assert lines[1].startswith("`safe` is permanently violated from ")


def test_a_named_part_is_explained_by_what_settled_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", str(LOG), "--spec", "mission.spatial", "--result", "safe"]) == 1
    assert capsys.readouterr().out.startswith(
        "`safe` is violated: robustness -0.1449, certain since 5.533 s, least at 9.767 s."
    )


def test_parts_that_decided_nothing_are_marked_and_can_fail_a_gate(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, document = _document(folder, "idle.spatial")
    assert code == 4
    assert [each["tested"] for each in document["specifications"]] == ["nothing"] * 3
    assert all(each["untested"] == each["vacuous"] for each in document["specifications"])
    reasons = {
        each["name"]: [part["reason"] for part in each["vacuous"]] for each in document["specifications"]
    }
    assert reasons == {
        "late": ["empty window"],
        "polite": ["antecedent never held"],
        "calm": ["no members"],
    }
    shown = capsys.readouterr().out
    assert (shown.count("vacuous: `"), shown.count("satisfied  tested by nothing, ")) == (3, 3)
    assert _document(folder, "idle.spatial", "--allow", "vacuous")[0] == 0
    assert _document(folder, "idle.spatial", "--fail-on", "vacuous")[0] == 1


def test_a_template_without_objects_is_vacuous(folder: Path) -> None:
    (folder / "t.spatial").write_text(
        "spec near(t) = G (t dist plate >= 0)\nspec s = F (cup dist plate >= 0)\n"
    )
    none = ("--each", "t=class:drink", "--to", "2s")
    code, document = _document(folder, "t.spatial", *none)
    assert code == 4
    assert [(each["reason"], each["text"]) for each in document["vacuous"]] == [("no instances", "near(t)")]
    assert _document(folder, "t.spatial", *none, "--allow", "vacuous")[0] == 0
    assert _document(folder, "t.spatial", *none, "--fail-on", "vacuous")[0] == 1


def test_a_window_that_the_end_of_the_log_cut_is_said_where_it_decides(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "hold.spatial").write_text(
        "spec parked = F G[0s, 2s] (cup dist plate >= 0)\nspec near = F (cup dist plate >= 0)\n"
    )
    last = ("--from", "9s")
    code, document = _document(folder, "hold.spatial", *last)
    parked, near = document["specifications"]
    assert (code, parked["tested"], near["tested"]) == (0, "cut", "full")
    (part,) = parked["untested"]
    assert (part["node"], part["reason"], part["text"]) == (
        1,
        "cut window",
        "G[0s, 2s] (cup dist plate >= 0)",
    )
    assert part["time_ns"] >= document["log"]["start_ns"]
    shown = capsys.readouterr().out
    assert "  cut: `G[0s, 2s] (cup dist plate >= 0)` decides at 9" in shown
    assert _document(folder, "hold.spatial", *last, "--fail-on", "cut")[0] == 1
    assert _document(folder, "hold.spatial", "--to", "5s", "--fail-on", "cut")[0] == 0


@pytest.mark.parametrize(
    "body",
    [
        "x ovlp plate -> x dist cup >= 1",
        "not (x ovlp plate) or x dist cup >= 1",
        "not (x ovlp plate and not (x dist cup >= 1))",
    ],
)
def test_an_antecedent_that_held_for_no_member_tests_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], body: str
) -> None:
    body = f"forall x in (all except plate): ({body})"
    (folder / "each.spatial").write_text(f"spec polite = G ({body})\n")
    code, document = _document(folder, "each.spatial")
    (polite,) = document["specifications"]
    assert (code, polite["verdict"], polite["tested"]) == (4, "satisfied", "nothing")
    assert [each["reason"] for each in polite["vacuous"]] == ["antecedent never held"]
    assert "`x ovlp plate` never held" in capsys.readouterr().out
    assert _document(folder, "each.spatial", "--fail-on", "vacuous")[0] == 1


@pytest.mark.parametrize(
    ("formula", "tested"),
    [
        ("not (F (cup ovlp plate and not (fork ovlp plate)))", "nothing"),
        ("G (not (F[0s, 1s] (cup ovlp plate and fork ovlp plate)))", "nothing"),
        ("not (F (fork dist plate <= 1 and cup ovlp plate))", "full"),
        ("not (F (cup ovlp plate))", "full"),
        ("F (not (cup ovlp plate) or fork ovlp plate)", "full"),
        ("not (G (not (not (cup ovlp plate) or fork ovlp plate)))", "full"),
    ],
)
def test_what_never_may_happen_is_tested_as_its_opposite_always_is(
    folder: Path, formula: str, tested: str
) -> None:
    (folder / "never.spatial").write_text(f"spec never = {formula}\n")
    code, document = _document(folder, "never.spatial")
    (never,) = document["specifications"]
    assert (code, never["verdict"]) == (4 if tested == "nothing" else 0, "satisfied")
    assert never["tested"] == tested


def test_a_pair_of_members_that_never_was_does_not_empty_their_group(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pairs = 'forall x, y in ((class "dish") except cup): x dist y >= 0'
    (folder / "pairs.spatial").write_text(f"spec pairs = G ({pairs})\n")
    assert run(["replay", str(LOG), "--spec", "pairs.spatial"]) == 4
    assert "where fewer than 2 objects are in its group." in capsys.readouterr().out


def test_an_antecedent_that_never_held_fails_a_gate_under_the_semantics_of_the_paper(folder: Path) -> None:
    (folder / "polite.spatial").write_text("spec polite = G (cup ovlp plate -> fork ovlp plate)\n")
    paper = ("--semantics", "paper")
    code, document = _document(folder, "polite.spatial", *paper)
    (polite,) = document["specifications"]
    assert (code, polite["verdict"], polite["tested"]) == (4, "satisfied", "nothing")
    assert _document(folder, "polite.spatial", *paper, "--fail-on", "vacuous")[0] == 1
    assert _document(folder, "polite.spatial", *paper, "--allow", "vacuous")[0] == 0


def _without_plate(*stretches: slice, with_class: bool = False) -> list[str]:
    """The lines of the log, of which some lack the plate."""
    samples = [json.loads(line) for line in LOG.read_text().splitlines()]
    for sample in samples:
        for item in sample["objects"]:
            if item["name"] == "plate" and not with_class:
                del item["class"]
    for stretch in stretches:
        for sample in samples[stretch]:
            sample["objects"] = [item for item in sample["objects"] if item["name"] != "plate"]
    return list(map(json.dumps, samples))


def test_a_member_of_a_class_that_comes_later_drops_no_samples(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "near.spatial").write_text("spec near = G (cup dist plate >= 0)\n")
    (folder / "later.jsonl").write_text("\n".join(_without_plate(slice(0, 30), with_class=True)))
    assert run(["explain", str(folder / "later.jsonl"), "--spec", "near.spatial"]) == 4
    said = capsys.readouterr().out
    assert "plate is missing in 30 of 300 samples, all from 0.000 s to 1.000 s" in said
    assert "--from" not in said


def test_replay_names_the_option_that_leaves_out_what_is_missing_at_the_start(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "near.spatial").write_text("spec near = G (cup dist plate >= 0)\n")
    (folder / "late.jsonl").write_text("\n".join(_without_plate(slice(0, 1))))
    log = str(folder / "late.jsonl")
    assert run(["replay", log, "--spec", "near.spatial"]) == 4
    said = capsys.readouterr().out
    assert "plate is missing in 1 of 300 samples, all before 0.033 s: --from 0.033s leaves them out." in said
    assert run(["replay", log, "--spec", "near.spatial", "--from", "0.033s"]) == 0


def test_replay_names_the_options_that_leave_out_what_is_missing_at_both_ends(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "near.spatial").write_text("spec near = G (cup dist plate >= 0)\n")
    (folder / "both.jsonl").write_text("\n".join(_without_plate(slice(0, 1), slice(-2, None))))
    log = str(folder / "both.jsonl")
    assert run(["replay", log, "--spec", "near.spatial"]) == 4
    remedy = "--from 0.033s --to 9.933s"
    expected = (
        f"missing in 3 of 300 samples, all before 0.033 s or from 9.933 s on: {remedy} leaves them out."
    )
    assert expected in capsys.readouterr().out
    assert run(["replay", log, "--spec", "near.spatial", *remedy.split()]) == 0


def test_an_unknown_verdict_can_fail_a_gate(folder: Path) -> None:
    (folder / "unknown.spatial").write_text("spec s = G (cupp ovlp plate)\n")
    assert _document(folder, "unknown.spatial")[0] == 4
    assert _document(folder, "unknown.spatial", "--fail-on", "vacuous,unknown")[0] == 1
    assert _document(folder, "mission.spatial", "--fail-on", "vacuous,unknown")[0] == 1


def test_a_kind_of_failure_that_there_is_not_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(LOG), "--spec", "idle.spatial", "--fail-on", "vacous"]) == 2
    assert "--fail-on: 'vacous' is not a kind of result; did you mean 'vacuous'?" in capsys.readouterr().err


def _point(name: str, x: float, class_name: str) -> dict[str, object]:
    return {"name": name, "class": class_name, "parts": [{"vertices": [[x, 0.0]], "radius": 0.0}]}


def test_a_member_that_leaves_within_reach_is_remarked_and_can_fail_a_gate(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = []
    for k in range(60):
        objects = [_point("cart", 0.0, "robot"), _point("person_5", 0.7, "dog" if 41 <= k < 50 else "person")]
        people = [_point("person_3", 0.6, "person"), _point("person_4", 9.0, "person")]
        objects += [] if 22 <= k < 38 else people
        objects += [] if 30 <= k < 58 else [_point("person_6", 9.0 if k < 30 else 0.8, "person")]
        samples.append({"time_ns": k * 100_000_000, "objects": objects})
    (folder / "visits.jsonl").write_text("\n".join(map(json.dumps, samples)))
    (folder / "safe.spatial").write_text(
        'group people = class "person"\nspec safe = G (forall p in people: cart dist p >= 0.5)\n'
    )
    arguments = ["replay", "visits.jsonl", "--spec", "safe.spatial", "--json", "-"]
    assert run(arguments) == 0
    left = json.loads(capsys.readouterr().out)["log"]["left"]
    assert [departure["message"] for departure in left] == [
        "person_3 was not in the log from 2.200 s to 3.800 s; it was 0.6 away before, from cart",
        "person_6 was not in the log from 3.000 s to 5.800 s; it was 0.8 away after, from cart",
        "person_5 was not of the class 'person' but 'dog' from 4.100 s to 5.000 s; it was 0.7 away before,"
        " from cart",
    ]
    assert [departure["distance"] for departure in left] == [0.6, 0.8, 0.7]
    assert run([*arguments, "--fail-on", "left"]) == 1
    assert left[0]["message"] in capsys.readouterr().err
    assert run(["batch", "visits.jsonl", "--spec", "safe.spatial", "--fail-on", "left", "-o", "out"]) == 1
    assert f"left: {left[0]['message']}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("specification", "each"),
    [
        ("spec s = G (present(person_3) -> (person_3 dist cart >= 0.5))\n", []),
        ("spec s(p) = G (present(p) -> (p dist cart >= 0.5))\n", ["--each", "p=class:person"]),
        ('spec s = G (forall p in class "person": not (enlarge(p, 0.4) ovlp cart))\n', []),
    ],
)
def test_an_object_that_may_be_absent_is_remarked_when_it_leaves_within_reach(
    folder: Path, capsys: pytest.CaptureFixture[str], specification: str, each: list[str]
) -> None:
    samples = []
    for k in range(60):
        objects = [_point("cart", 0.0, "robot")]
        people = [_point("person_3", 0.6, "person"), _point("person_4", 9.0, "person")]
        objects += [] if 22 <= k < 38 else people
        samples.append({"time_ns": k * 100_000_000, "objects": objects})
    (folder / "visits.jsonl").write_text("\n".join(map(json.dumps, samples)))
    (folder / "seen.spatial").write_text(specification)
    arguments = ["replay", "visits.jsonl", "--spec", "seen.spatial", *each, "--json", "-"]
    assert run(arguments) == 0
    message = "person_3 was not in the log from 2.200 s to 3.800 s; it was 0.6 away before, from cart"
    assert [leave["message"] for leave in json.loads(capsys.readouterr().out)["log"]["left"]] == [message]
    assert run([*arguments, "--fail-on", "left"]) == 1
    capsys.readouterr()
    batch = ["batch", "visits.jsonl", "--spec", "seen.spatial", *each, "--fail-on", "left", "-o", "out"]
    assert run(batch) == 1
    assert f"left: {message}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("class_name", "others", "is_remarked"),
    [("person", 1, True), ("person", 0, False), ("", 3, True), ("", 2, False)],
)
def test_an_object_that_never_changes_by_a_bit_while_its_kind_moves_is_remarked(
    folder: Path, capsys: pytest.CaptureFixture[str], class_name: str, others: int, is_remarked: bool
) -> None:
    kind = {"class": class_name} if class_name else {}

    def at(name: str, x: float, y: float) -> dict[str, object]:
        return {"name": name, "parts": [{"vertices": [[x, y]], "radius": 0.125}], **kind}

    samples = [
        {"time_ns": k * 10**8, "objects": [at("stuck", 0, 9), *(at(f"o{n}", k, n) for n in range(others))]}
        for k in range(30)
    ]
    (folder / "still.jsonl").write_text("\n".join(map(json.dumps, samples)))
    assert run(["replay", "still.jsonl", "--spec", "G (stuck dist stuck <= 1)"]) == 0
    said = "stuck never changes by a bit in 30 reports, while all other objects"
    assert (said in capsys.readouterr().err) is is_remarked


@pytest.mark.parametrize(
    ("bottom", "formula", "is_remarked"),
    [
        (0.05, "G (robot dist zone >= 0.03)", True),
        (0.05, "G (forall r in class robot: r farfrom[0.03] zone)", True),
        (0.05, "G not (robot ovlp zone)", True),
        # too near also in space, apart also from above, and on one level
        (0.05, "G (robot dist zone >= 0.21)", False),
        (0.05, "G (robot dist post >= 0.2)", False),
        (0.0, "G (robot dist zone >= 0.03)", False),
    ],
)
def test_a_comparison_that_heights_decide_is_remarked(
    folder: Path, capsys: pytest.CaptureFixture[str], bottom: float, formula: str, is_remarked: bool
) -> None:
    def box(name: str, x: float, low: float, high: float) -> dict[str, object]:
        corners = [[x - 0.5, -0.5], [x + 0.5, -0.5], [x + 0.5, 0.5], [x - 0.5, 0.5]]
        return {"name": name, "class": name, "polygon": corners, "height": [low, high]}

    samples = [
        {
            "time_ns": k * 10**8,
            "objects": [
                box("robot", k / 10, bottom, 0.5),
                box("zone", 2.0, 0.0, 0.01),
                box("post", 9.0, 0.0, 2.0),
            ],
        }
        for k in range(30)
    ]
    (folder / "heights.jsonl").write_text("\n".join(map(json.dumps, samples)))
    run(["replay", "heights.jsonl", "--spec", formula])
    said = "because of heights: seen from above it"
    assert (said in capsys.readouterr().err) is is_remarked
