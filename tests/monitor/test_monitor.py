"""A monitor beside a running system."""

from __future__ import annotations

import gc
import itertools
import os
import subprocess
import sys
import tracemalloc
from math import inf

import numpy as np
import pytest

from monitor.scenes import SECOND
from spatial_replay import (
    Footprint,
    Monitor,
    Sample,
    SpecificationError,
    TraceError,
    TrackedObject,
    UsageError,
    parse_specification,
)


def at(second, **signals):
    return Sample(second * SECOND, signals=signals)


def test_a_verdict_settles_as_samples_come():
    monitor = Monitor(
        parse_specification("spec up = F p >= 0\nspec steady = G q >= 0\nspec s = up and steady")
    )
    first = monitor.update(at(0, p=-1, q=2))
    assert (first.time_ns, first.verdict) == (0, "pending")
    assert first.node("up").upper == inf
    second = monitor.update(at(1, p=1, q=1))
    assert (second.node("up").verdict, second.node("steady").verdict) == ("satisfied", "pending")
    assert (second.node("s").value, second.node("s").now) == (1, 1)
    third = monitor.update(at(2, p=-5, q=-2))
    assert (third.verdict, third.node("s").upper) == ("violated", -2)
    assert third.node("up").value == 1


@pytest.mark.parametrize(
    ("text", "at", "reason"),
    [
        ("F (robot dist vase <= 1)", 3, "`robot dist vase <= 1` just holds at 3.000 s"),
        ("G[0s,2s] (robot dist vase >= 1.5)", 2, "`robot dist vase >= 1.5` holds by 0.5 at 2.000 s"),
        (
            "F (robot dist vase <= 2.5 and robot dist vase >= 0)",
            2,
            "`robot dist vase <= 2.5` holds by 0.5 at 2.000 s",
        ),
    ],
)
def test_a_satisfied_verdict_says_which_atom_decided_it(text: str, at: int, reason: str) -> None:
    monitor = Monitor(parse_specification(f"spec wanted = {text}"))
    for second in range(at + 1):
        robot = Footprint.box(5 - second, 0, 6 - second, 1)
        vase = Footprint.box(0, 0, 1, 1)
        update = monitor.update(Sample(second * SECOND, {"robot": robot, "vase": vase}))
        assert len(update.satisfied) == (second >= at)
    assert [each.reason for each in update.satisfied] == [reason]
    assert update.violations == ()
    assert repr(update) == f"<Update: satisfied at {update.time_ns} ns>"


def test_terms_look_back_before_the_start_of_a_monitor():
    monitor = Monitor(parse_specification("H a dist a[-1] <= 2"), start_ns=SECOND)
    before = monitor.update(Sample(0, {"a": Footprint.disc(0, 0, 0)}))
    assert (before.verdict, before.specs[0].nodes) == ("pending", ())
    started = monitor.update(Sample(SECOND, {"a": Footprint.disc(1.5, 0, 0)}))
    assert (started.verdict, started.specs[0].nodes[0].value) == ("satisfied", 0.5)


def test_a_monitor_refuses_invalid_arguments_and_samples():
    with pytest.raises(UsageError, match=r"s\(ego\) is a template; name its object"):
        Monitor(parse_specification("spec s(ego) = G ego ovlp ego"))
    with pytest.raises(UsageError, match="no semantics 'stl'"):
        Monitor(parse_specification("p >= 0"), semantics="stl")
    monitor = Monitor(parse_specification("spec low = p >= 0"), start_ns=SECOND)
    with pytest.raises(UsageError, match=r"'low' has no numbers before the monitor's start"):
        monitor.update(at(0, p=1)).node("low")
    monitor.update(at(2, p=1))
    with pytest.raises(UsageError, match=r"no node is named 'high'; there are low"):
        monitor.update(at(3, p=1)).node("high")
    with pytest.raises(TraceError, match="give samples in the order of their times"):
        monitor.update(at(3, p=1))
    with pytest.raises(UsageError, match=r"start_ns is 1\.5; give integer nanoseconds"):
        Monitor(parse_specification("p >= 0"), start_ns=1.5)


@pytest.mark.parametrize(("after", "during"), [("5s", "in its first 5.000 s"), (6, "in its first 6 samples")])
def test_a_name_that_does_not_come_is_remarked_with_the_nearest_one(after: str | int, during: str) -> None:
    specification = parse_specification("spec apart = G (cub dist vase >= 1)\nspec full = G charge >= 0.2")
    monitor, strict = (
        Monitor(specification, missing_after=after, strict_names=each) for each in (False, True)
    )
    objects = {name: Footprint.disc(place, 0, 0) for place, name in enumerate(("cube", "vase"))}
    samples = [Sample(second * SECOND, objects, {"charg": 0.5}) for second in range(6)]
    for sample in samples[:5]:
        assert monitor.update(sample).remarks == strict.update(sample).remarks == ()
    cube, charge = monitor.update(samples[5]).remarks
    assert (cube.severity, cube.line, cube.column) == ("warning", 1, 17)
    assert cube.message == f"the run never has the object 'cub' {during}"
    assert cube.hint.startswith("did you mean 'cube'? its objects are cube, vase")
    assert "did you mean 'charg'?" in charge.hint
    with pytest.raises(SpecificationError, match="never has the object 'cub'"):
        strict.update(samples[5])
    came = Sample(6 * SECOND, {**objects, "cub": objects["vase"]})
    assert [each.message for each in monitor.update(came).remarks] == [charge.message]
    assert not monitor.update(at(7, charge=1)).remarks


def test_evaluation_begins_when_awaited_names_have_come() -> None:
    specification = parse_specification("spec apart = G (cube dist vase >= 1 and charge >= 0.2)")
    objects = {name: Footprint.disc(place, 0, 0) for place, name in enumerate(("cube", "vase"))}
    tenths = [
        Sample(
            at * SECOND // 10,
            objects if at >= 3 else {"cube": objects["cube"]},
            {"charge": 0.5} if at >= 2 else {},
        )
        for at in range(30)
    ]
    plain, waiting = Monitor(specification), Monitor(specification, wait_for=["vase", "charge"])
    for sample in tenths:
        plain.update(sample)
        waiting.update(sample)
    assert plain.endings()[0].verdict == "unknown"
    assert waiting.endings()[0].verdict == "satisfied"
    assert (waiting.begin_ns, waiting.late) == (3 * SECOND // 10, ())
    # what does not come in time is not waited for, and is named
    late = Monitor(specification, wait_for=["vase", "robot"], start_within="1s")
    for sample in tenths:
        late.update(sample)
    assert (late.begin_ns, late.late) == (11 * SECOND // 10, ("robot",))
    patient = Monitor(specification, wait_for=["robot"], start_within=None)
    assert patient.update(tenths[-1]).verdict == "pending"
    assert patient.begin_ns is None
    with pytest.raises(UsageError, match=r"wait_for is 'vase'; give a list of names"):
        Monitor(specification, wait_for="vase")


def test_names_are_awaited_for_a_time_or_a_number_of_samples() -> None:
    specification = parse_specification("G p >= 0")
    assert Monitor(specification, missing_after=None).update(at(99, q=1)).remarks == ()
    for wrong in (0, True, 2.5):
        with pytest.raises(UsageError, match="give a time such as '5s', or a number of samples"):
            Monitor(specification, missing_after=wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="'5' is not a duration"):
        Monitor(specification, missing_after="5")


def test_the_first_violation_waits_for_no_code():
    # in a process of its own, where nothing has been compiled for others
    program = """
import sys
from spatial_replay import Footprint, Monitor, Sample, parse_specification
from spatial_replay.compiled import kernels

apart = "region bin = box(0, 0, 9, 9)\\nspec apart = G (cup dist jug >= 1)\\nspec light = G (load <= 1)"
inside = "spec inside = G (cup enclosedin bin and cup oriented[0.5] jug)"
safe = "spec safe = apart and light and inside"
monitor = Monitor(parse_specification(f"{apart}\\n{inside}\\n{safe}"))
ready = {each.__name__ for each in kernels() if each.is_compiled}
objects = {"cup": Footprint.box(0, 0, 1, 1), "jug": Footprint.box(1.5, 0, 9.5, 1)}
found = monitor.update(Sample(0, objects, {"load": 2.0})).violations
print(*found)
sys.exit(", ".join({each.__name__ for each in kernels() if each.is_compiled} - ready) or 0)
"""
    environment = {key: value for key, value in os.environ.items() if key != "SPATIAL_REPLAY_KERNELS"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "cup is 0.5 too close to jug" in done.stdout


def test_memory_does_not_grow_with_the_samples():
    # as many samples as a violation may be looked for in come before the start: they are cheap
    begin = 1100
    monitor = Monitor(
        parse_specification(
            "group everything = all\n"
            "spec s = G (F[0, 20] a dist a[-5] >= 0) and F exists x in everything: x dist a[-300ms] <= 9"
        ),
        start_ns=begin * SECOND // 10,
    )

    def memory_after(first, last):
        for t in range(first, last):
            place = Footprint.disc(t % 10, 0, 1)
            monitor.update(Sample(t * SECOND // 10, {"a": place, f"b{t % 30}": place, f"new{t}": place}))
        # garbage that waits for its collection is no growth
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        memory = [memory_after(0, begin + 200)]
        memory += [memory_after(first, first + 200) for first in range(begin + 200, begin + 800, 200)]
    finally:
        tracemalloc.stop()
    # a table that doubles takes memory once, what is kept of every sample takes it every time
    growth = min(after - before for before, after in itertools.pairwise(memory))
    assert growth < 200 * 60  # an object kept of every sample would take more


def test_nodes_are_read_one_by_one_or_as_numbers():
    monitor = Monitor(
        parse_specification("spec low = G p >= 0\nspec high = F q >= 3\nspec odd = low xor high")
    )
    spec = monitor.update(at(0, p=2, q=1)).specs[0]
    assert [(node.id, node.name) for node in spec.nodes[:2]] == [(0, "odd"), (1, "low")]
    assert [list(node[2:]) for node in spec.nodes] == spec.numbers.tolist()
    assert spec.nodes[1].verdict == "pending"
    assert spec.node(1) == spec.nodes[1]
    with pytest.raises(ValueError, match="read-only"):
        spec.numbers[0, 0] = 1
    with pytest.raises(UsageError, match="3 is not a sample"):
        monitor.update(3)


def test_updates_and_leaves_that_are_held_stay_as_they_are() -> None:
    """Unknown and uncertain values, violations and a warning come while earlier updates are held."""
    text = "spec near = G (a dist b <= 2)\nspec high = F[0, 2] (p >= 1)"
    samples = [
        Sample(k, {"a": Footprint.disc(k, 0, 0.1), "b": thing}, {"p": float("nan") if k % 5 == 2 else k % 3})
        for k, thing in enumerate(
            [Footprint.disc(0, 1, 0.1)] * 4 + [TrackedObject(Footprint.disc(3, 1, 0.1), uncertainty=0.25)] * 8
        )
    ]
    monitor = Monitor(parse_specification(text), missing_after=None)
    held = [(monitor.update(sample), monitor.leaves(1)) for sample in samples]
    for count, (update, leaves) in enumerate(held, start=1):
        again = Monitor(parse_specification(text), missing_after=None)
        *_, newest = [again.update(sample) for sample in samples[:count]]
        assert update.time_ns == samples[count - 1].time_ns
        for before, after in zip(update.numbers, newest.numbers, strict=True):
            assert before.tobytes() == after.tobytes()
        assert leaves.tobytes() == again.leaves(1).tobytes()
        assert list(map(str, update.violations)) == list(map(str, newest.violations))
    with pytest.raises(AttributeError):
        held[0][0].time_ns = 5


def test_a_monitor_that_is_reset_is_as_good_as_new() -> None:
    specification = parse_specification("spec near = G (a dist b <= 1)\nspec rising = F (a[-1] dist a >= 1)")
    monitor = Monitor(specification)
    apart = {"a": Footprint.disc(0, 0, 0.1), "b": Footprint.disc(5, 0, 0.1)}
    for time_ns in (10, 20):
        monitor.update(Sample(time_ns, apart, {"z": float(time_ns)}))
    assert monitor.update(Sample(30, apart, {"z": 0.0})).violations
    monitor.reset()
    assert [ending.verdict for ending in monitor.endings()] == ["unknown", "unknown"]
    fresh = Monitor(specification)
    near = {name: Footprint.disc(0, 0, 0.1) for name in "ab"}
    for time_ns in (0, 10):
        sample = Sample(time_ns, near, {"z": 0.0})
        reset, new = monitor.update(sample), fresh.update(sample)
        for numbers, expected in zip(reset.numbers, new.numbers, strict=True):
            np.testing.assert_array_equal(numbers, expected)
        assert not reset.violations
        assert str(monitor.endings()) == str(fresh.endings())
