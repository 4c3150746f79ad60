"""Why a result fails: what settled it comes first, online and over a finished log."""

from __future__ import annotations

import math
import tracemalloc

import pytest

import spatial_replay as sr

SECOND = 10**9
TASK = """\
spec safe = G (red dist vase >= 0.1)
spec charged = G (battery >= 0.2)
spec deliver = F (red enclosedin bin)
spec task = safe and charged and deliver
"""


def box(x: float) -> sr.Footprint:
    return sr.Footprint.box(x, 0, x + 1, 1)


def stopped_robot() -> list[sr.Sample]:
    """It comes too close to the vase at 3 s, and never reaches the bin; then it runs out of battery."""
    return [
        sr.Sample(
            k * SECOND,
            {"red": box(0.31 * k), "vase": box(2), "bin": box(9)},
            {"battery": 0.9 - 0.19 * k},
        )
        for k in range(5)
    ]


def evaluated(text: str = TASK) -> sr.Evaluation:
    return sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(stopped_robot()))


def test_what_is_said_of_a_violation_that_grew_has_its_robustness_and_then_how_it_began() -> None:
    result = evaluated("spec safe = G (red dist vase >= 0.1)").result()
    said = result.reason(0)
    assert said.startswith(f"`red dist vase >= 0.1` fails by {-result.robustness:.4g} at 4.000 s")
    assert said.endswith("It was violated first at 3.000 s, by 0.03.")
    assert "first" not in evaluated("spec charged = G (battery >= 0.2)").result().reason(0)


def test_what_settled_the_verdict_comes_before_a_goal_that_was_never_reached() -> None:
    result = evaluated().result()
    assert [cause.spec for cause in result.causes] == ["safe", "charged", "deliver"]
    assert [cause.settled_ns for cause in result.causes] == [3 * SECOND, 4 * SECOND, None]
    assert result.violated_at_ns == 3 * SECOND
    assert result.satisfied_at_ns is None
    first = result.causes[0].witness
    assert first is not None
    assert first.deciding is not None
    assert (first.time_ns, first.deciding.text) == (3 * SECOND, "red dist vase >= 0.1")
    assert first.deciding.objects == ("red", "vase")
    assert first.deciding.value == pytest.approx(-0.03)


def test_the_least_part_is_named_where_it_is_not_the_first_cause() -> None:
    result = evaluated().result()
    assert result.least is not None
    assert result.least.name == "deliver"
    assert result.least.robustness == result.robustness
    assert evaluated("spec near = F (red enclosedin bin)").result().least is None


def test_a_cause_is_that_of_the_moment_and_not_what_became_worse_later() -> None:
    text = "spec safe = G (red dist vase >= 0.5)"
    (cause,) = evaluated(text).result().causes
    whole = evaluated(text).witness()
    assert cause.witness is not None
    assert (cause.settled_ns, cause.witness.time_ns, whole.time_ns) == (2 * SECOND, 2 * SECOND, 4 * SECOND)
    assert cause.robustness == whole.upper


def test_satisfaction_that_nothing_can_undo_has_its_time() -> None:
    result = evaluated("spec drained = F (battery <= 0.6)").result()
    assert (result.satisfied_at_ns, result.violated_at_ns, result.causes) == (2 * SECOND, None, ())
    only_the_end = evaluated("spec safe = G (red dist bin >= 0.1)").result()
    assert (only_the_end.verdict, only_the_end.satisfied_at_ns) == ("satisfied", None)


def test_an_unknown_name_is_a_cause_and_leaves_the_other_specs_their_verdicts() -> None:
    text = "spec typo = G (read dist vase >= 0.1)\nspec far = G (red dist bin >= 0.1)\n"
    evaluation = evaluated(text)
    assert [(each.name, each.verdict) for each in evaluation] == [("typo", "unknown"), ("far", "satisfied")]
    (cause,) = evaluation.result("typo").causes
    assert (cause.spec, cause.verdict, cause.settled_ns) == ("typo", "unknown", None)
    (remark,) = evaluation.remarks
    assert (remark.severity, remark.message) == ("warning", "the log never has the object 'read'")
    assert "red" in remark.hint
    with pytest.raises(sr.SpecificationError, match="never has the object 'read'"):
        sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(stopped_robot()), strict_names=True)


def test_a_violation_that_grows_later_says_when_it_was_worst() -> None:
    result = evaluated("spec safe = G (red dist vase >= 0.1)").result()
    assert (result.violated_at_ns, result.least_at_ns) == (3 * SECOND, 4 * SECOND)
    assert result.explain().startswith(
        "`safe` is violated: robustness -0.34, certain since 3.000 s, least at 4.000 s.\n"
    )
    assert evaluated("spec charged = G (battery >= 0.2)").result().least_at_ns is None


def test_explanations_name_every_cause_and_what_would_have_prevented_it() -> None:
    assert evaluated().explain().splitlines() == [
        "`task` is violated: robustness -7.76, certain since 3.000 s (the least robustness is that of "
        "`deliver`).",
        "`safe` is permanently violated from 3.000 s on.",
        "What decides is `red dist vase >= 0.1`, which fails by 0.34 at 4.000 s (its least within `safe`): "
        "red and vase overlap by 0.24.",
        "It was violated first at 3.000 s, by 0.03.",
        "No distance in `red dist vase >= 0.1` makes it satisfied: the objects touch or overlap.",
        "It is violated from 3.000 s to 4.000 s.",
        "`charged` is permanently violated from 4.000 s on.",
        "What decides is `battery >= 0.2`, which fails by 0.06 at 4.000 s (within `charged`): "
        "battery is 0.14.",
        "It would be satisfied with 0.14 or less instead of 0.2 in `battery >= 0.2`.",
        "`deliver` is violated, for the log has ended: robustness -7.76.",
        "What decides is `red enclosedin bin`, which fails by 7.76 at 4.000 s (its greatest within "
        "`deliver`): red sticks out of bin by 7.76.",
        "It would be satisfied with `red enclosedin enlarge(bin, 7.76)` instead of `red enclosedin bin`.",
    ]


def test_a_result_is_explained_alone_and_a_satisfied_one_by_what_holds() -> None:
    evaluation = evaluated("spec safe = G (red dist vase >= 0.1)\nspec far = G (red dist bin >= 0.1)\n")
    texts = [result.explain() for result in evaluation]
    assert evaluation.explain() == "\n\n".join(texts)
    assert texts[0].startswith(
        "`safe` is violated: robustness -0.34, certain since 3.000 s, least at 4.000 s."
    )
    assert texts[1].startswith("`far` is satisfied: robustness 6.66.\nWhat decides is `red")


def test_the_semantics_of_the_paper_has_causes_without_witnesses_and_no_vacuous_parts() -> None:
    evaluation = sr.evaluate(
        sr.parse_specification(TASK), sr.Trace.from_samples(stopped_robot()), semantics="paper"
    )
    result = evaluation.result()
    assert [(each.spec, each.settled_ns, each.witness) for each in result.causes] == [
        ("deliver", None, None),
        ("safe", None, None),
        ("charged", None, None),
    ]
    assert (result.violated_at_ns, result.vacuous) == (None, ())
    assert evaluation.explain().splitlines()[0] == "`task` is violated: robustness -7.76."


# ------------------------------------------------------------------------------------------- online


def test_an_update_names_what_stopped_the_robot() -> None:
    monitor = sr.Monitor(sr.parse_specification(TASK))
    updates = [monitor.update(sample) for sample in stopped_robot()]
    assert [len(update.violations) for update in updates] == [0, 0, 0, 1, 2]
    (violation,) = updates[3].violations
    assert str(violation) == (
        "red is 0.03 too close to vase: `red dist vase >= 0.1` fails by 0.03 at 3.000 s"
    )
    assert (violation.spec, violation.objects, violation.time_ns) == ("safe", ("red", "vase"), 3 * SECOND)
    assert violation.value == pytest.approx(-0.03)
    assert violation.threshold is not None
    assert violation.threshold.flips_at == pytest.approx(0.07)
    assert str(updates[4].violations[1]).startswith("battery is 0.06 too low: `battery >= 0.2` fails")


def test_a_monitor_and_a_replay_name_the_same_atoms() -> None:
    causes = evaluated().result().causes
    monitor = sr.Monitor(sr.parse_specification(TASK))
    *_, last = map(monitor.update, stopped_robot())
    found = [(each.spec, each.node, each.time_ns, each.witness) for each in last.violations]
    settled = [each for each in causes if each.settled_ns is not None]
    assert [each[:3] for each in found] == [(each.spec, each.node, each.settled_ns) for each in settled]
    for (*_, online), cause in zip(found, settled, strict=True):
        assert online is not None
        assert cause.witness is not None
        assert online.deciding == cause.witness.deciding
        assert online.path == cause.witness.path


def test_what_was_never_to_happen_is_said_the_other_way_round() -> None:
    monitor = sr.Monitor(sr.parse_specification("spec apart = G not (red closeto[0.1] vase)"))
    *_, last = map(monitor.update, stopped_robot())
    said = "red is 0.03 too close to vase: `red closeto[0.1] vase` must not hold, and holds by 0.03"
    assert str(last.violations[0]).startswith(said)


def test_a_window_that_closed_names_the_best_attempt_in_it_after_a_long_run() -> None:
    monitor = sr.Monitor(sr.parse_specification("spec often = G (F[0, 3] (p >= 0.5))"))
    values = [1.0] * 2000 + [0.1, 0.4, 0.2, 0.3, 0.0]
    update = None
    for k, value in enumerate(values):
        update = monitor.update(sr.Sample(k * SECOND, {}, {"p": value}))
        if update.verdict is sr.Verdict.VIOLATED:
            break
    assert update is not None
    (violation,) = update.violations
    assert violation.witness is not None
    assert (violation.time_ns, violation.witness.time_ns) == (2003 * SECOND, 2001 * SECOND)
    assert violation.value == pytest.approx(-0.1)


def test_the_semantics_of_the_paper_reports_no_violation_online() -> None:
    monitor = sr.Monitor(sr.parse_specification(TASK), semantics="paper")
    *_, last = map(monitor.update, stopped_robot())
    assert last.violations == ()


# ------------------------------------------------------------------------------------------- vacuous


@pytest.mark.parametrize(("formula", "tested"), [("G (p >= 0)", "cut"), ("F (p >= 0)", "full")])
def test_one_sample_shows_nothing_that_lasts(formula: str, tested: str) -> None:
    trace = sr.Trace.from_samples([sr.Sample(SECOND, {}, {"p": 1.0})])
    result = sr.evaluate(sr.parse_specification(f"spec s = {formula}"), trace).result()
    assert (result.verdict, result.tested) == (sr.Verdict.SATISFIED, tested)


@pytest.mark.parametrize(
    ("formula", "reason", "message"),
    [
        (
            "G[60s, 90s] (p >= 0)",
            "empty window",
            "`G[60s, 90s] (p >= 0)` was never tested: no sample of the log lies in its window.",
        ),
        (
            "G ((p >= 9) -> F (q >= 0))",
            "antecedent never held",
            "`(p >= 9) -> (F (q >= 0))` was never tested: `p >= 9` never held.",
        ),
        (
            "G ((p <= 1) -> ((p >= 3) -> (q >= 0)))",
            "antecedent never held",
            "`(p >= 3) -> (q >= 0)` was never tested: `p >= 3` never held where it counts.",
        ),
        (
            "G ((p >= 3) -> (G[1s, 2s] (q >= 0)))",
            "empty window",
            "`G[1s, 2s] (q >= 0)` was never tested: no sample of the log lies in its window where it counts.",
        ),
        (
            "G ((p <= 1) -> (H[1s, 2s] (q >= 0)))",
            "empty window",
            "`H[1s, 2s] (q >= 0)` was never tested: no sample of the log lies in its window where it counts.",
        ),
        (
            "G ((p <= 1) -> not (Y (q >= 0)))",
            "empty window",
            "`Y (q >= 0)` was never tested: the log has no sample before where it counts.",
        ),
        (
            "G ((p >= 3) -> (WX (q >= 0)))",
            "empty window",
            "`WX (q >= 0)` was never tested: the log has no next sample where it counts.",
        ),
        (
            "G ((p >= 2) -> (G[2, 3] (q >= 0)))",
            "empty window",
            "`G[2, 3] (q >= 0)` was never tested: no sample of the log lies in its window where it counts.",
        ),
        (
            "G (not (p >= 9) or q >= 0)",
            "antecedent never held",
            "`(not (p >= 9)) or (q >= 0)` was never tested: `p >= 9` never held.",
        ),
        (
            "G (not (p >= 9 and not (q >= 0)))",
            "antecedent never held",
            "`not ((p >= 9) and (not (q >= 0)))` was never tested: `p >= 9` never held.",
        ),
        (
            "G (not (p >= 9 and q >= 0))",
            "antecedent never held",
            "`not ((p >= 9) and (q >= 0))` was never tested: `(p >= 9) or (q >= 0)` never held.",
        ),
        (
            "G (forall x in people: x dist y >= 1)",
            "no members",
            "`forall x in people: (x dist y >= 1)` decided nothing: no object was ever in `people`.",
        ),
        (
            "F (WX (p >= 9))",
            "past the end",
            "`WX (p >= 9)` decides at 2.000 s, where it looks past the end of the log.",
        ),
    ],
)
def test_a_pass_that_tested_nothing_is_marked(formula: str, reason: str, message: str) -> None:
    text = f'group people = class "person"\nspec s = {formula}'
    samples = [sr.Sample(k * SECOND, {}, {"p": 1.0 + k, "q": -1.0}) for k in range(3)]
    evaluation = sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(samples))
    result = evaluation.result()
    assert (result.verdict, result.tested) == (sr.Verdict.SATISFIED, "nothing")
    assert [(part.reason, part.message) for part in result.vacuous] == [(reason, message)]
    assert message in evaluation.explain()


@pytest.mark.parametrize(
    "formula",
    [
        "G ((p >= 3) -> F[0s, 2s] (q >= 0))",
        # one of two conditions meets a sample in its window
        "G ((p <= 2) -> (H[1s, 2s] (q >= 0)))",
        # one part was measured while the other held
        "G (not (p >= 9 and q >= 0))",
        "G (not (q >= 9))",
        "F (p >= 3 or q >= 9)",
        "F (not (q >= 9) or q >= 12)",
    ],
)
def test_a_pass_that_tested_something_is_not_marked(formula: str) -> None:
    samples = [sr.Sample(k * SECOND, {}, {"p": 1.0 + k, "q": 1.0}) for k in range(3)]
    evaluation = sr.evaluate(sr.parse_specification(f"spec s = {formula}"), sr.Trace.from_samples(samples))
    result = evaluation.result()
    assert (result.verdict, result.tested, result.vacuous) == (sr.Verdict.SATISFIED, "full", ())


def test_a_template_that_no_object_fits_is_marked() -> None:
    spec = sr.parse_specification("spec clear(r) = G (r dist vase >= 0.1)\nspec far = G (red dist bin >= 0)")
    trace = sr.Trace.from_samples(stopped_robot())
    (entry,) = sr.evaluate(spec, trace, each={"r": "class:robot"}).vacuous
    assert (entry.node, entry.text, entry.reason) == (None, "clear(r)", "no instances")
    assert sr.evaluate(spec, trace, each={"r": "all"}).vacuous == ()


def test_infinite_and_missing_numbers_are_said_plainly() -> None:
    result = evaluated("spec s = G (missing >= 1)").result()
    assert math.isnan(result.robustness)
    assert "there is no signal 'missing'" in result.explain()


def test_a_violation_says_amounts_in_the_units_of_the_log_and_the_time_of_its_atom():
    text = "scale force = 15\nspec soft = G (force <= 14)\nspec soon = F[0s, 1s] (force >= 20)"
    monitor = sr.Monitor(sr.parse_specification(text))
    for half_seconds in range(4):
        force = 14.2 if half_seconds == 2 else 13.0
        update = monitor.update(sr.Sample(half_seconds * SECOND // 2, {}, {"force": force}))
    soft, soon = map(str, update.violations)
    assert soft.startswith("force is 0.2 too high: `force <= 14` fails") and soft.endswith("at 1.000 s")
    late = sr.Monitor(sr.parse_specification("G (rate(force) <= 0.1)"))
    for tenths in range(30):
        update = late.update(sr.Sample(tenths * SECOND // 10, {}, {"force": 0.01 * tenths}))
    (residue,) = map(str, update.violations)
    assert residue.startswith("rate(force) is just too high: `rate(force) <= 0.1` fails by rounding at ")
    # the best attempt before the window closed
    assert soon.startswith("force is 5.8 too low: `force >= 20` fails") and soon.endswith("at 1.000 s")


def test_advice_on_a_constant_changes_every_place_that_names_it():
    text = "const near = 0.1\nspec safe = G (red dist vase >= near and battery >= near)\n"
    (cause,) = evaluated(text).result().causes
    assert cause.witness is not None and cause.witness.threshold is not None
    threshold = cause.witness.threshold
    assert (threshold.constant, threshold.value, threshold.flips_at) == ("near", 0.1, -0.2401)
    # a region follows from the constant, too: the advice is then on the number of one atom
    region = "region here = box(0, 0, near, near)\n"
    (cause,) = evaluated(f"{region}{text}").result().causes
    assert cause.witness is not None and cause.witness.threshold is not None
    assert cause.witness.threshold.constant == ""


def test_within_an_open_group_the_missed_response_is_named_and_not_its_condition() -> None:
    near = "agv dist p <= 2 -> speed(agv) <= 0.5"
    text = f"group people = class person\nspec slow = G (forall p in people: {near})"
    person = sr.TrackedObject(box(9), class_name="person")
    samples = [sr.Sample(k * SECOND, {"agv": box(0.8 * k), "ann": person}) for k in range(9)]
    result = sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(samples)).result()
    assert result.verdict == "violated"
    assert result.reason(0).startswith(
        "`speed(agv) <= 0.5` did not hold at 8.000 s, when its condition `agv dist ann <= 2` held:"
        " it fails by 0.3 at 8.000 s"
    )


def test_a_missed_response_is_measured_first_and_a_past_condition_at_its_own_time() -> None:
    text = "spec slow = G ((Y red dist vase <= 2.5) -> F[0s, 1s] (speed <= 0.5))"
    samples = [
        sr.Sample(k * SECOND, {"red": box(4 - k), "vase": box(0)}, {"speed": 1.2 - 0.1 * (k == 3)})
        for k in range(6)
    ]
    said = sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(samples)).result().explain()
    assert said.splitlines()[1:4] == [
        "`F[0s, 1s] (speed <= 0.5)` did not hold at 2.000 s, when its condition `Y (red dist vase <= 2.5)`"
        " held.",
        "`speed <= 0.5` came closest at 3.000 s: speed is 1.1.",
        "The condition held: red and vase are 2 apart at 1.000 s.",
    ]


def test_memory_to_find_the_closest_of_many_does_not_grow_with_their_pairs() -> None:
    line = sr.Trace.from_samples([sr.Sample(0, {f"o{n}": box(2 * n - 0.5 * (n == 399)) for n in range(400)})])
    text = "group movers = all\nspec apart = G (forall a, b in movers: a dist b >= 3)"
    evaluation = sr.evaluate(sr.parse_specification(text), line)
    tracemalloc.start()
    try:
        assert evaluation.result().causes[0].witness is not None
        assert tracemalloc.get_traced_memory()[1] < 1.5e6
    finally:
        tracemalloc.stop()
