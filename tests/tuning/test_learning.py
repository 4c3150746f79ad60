"""Specifications learned from runs, as users see them: what is written, its evidence, refusals."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from replay.runs import write_tracks
from spatial_replay import UsageError
from spatial_replay.cli import run
from spatial_replay.spec import format_formula
from spatial_replay.tuning.learned import Learned

STEP_NS = 200_000_000
CLEAR = (0.52, 0.54, 0.57, 0.6, 0.56)


def box(x: float, y: float, size: float = 0.1) -> sr.Footprint:
    return sr.Footprint.box(x, y, x + size, y + size)


def delivery(clear: float, end: float = 2.0, *, cup_first: bool = True, names: str = "{}") -> sr.Trace:
    """A cup and a plate are brought to a table, one after the other, past a person at some distance."""
    samples = []
    for index in range(31):
        first, later = min(index / 10, 1.0), min(max((index - 15) / 10, 0.0), 1.0)
        cup, plate = (first, later) if cup_first else (later, first)
        objects = {
            "cup": sr.TrackedObject(box(end * cup, clear + 0.5), class_name="dish"),
            "plate": sr.TrackedObject(box(end * plate, clear + 0.7), class_name="dish"),
            "person": sr.TrackedObject(box(1.0, 0.0, 0.5), class_name="person"),
            "table": sr.TrackedObject(box(1.8, 0.9, 1.0)),
        }
        samples.append(sr.Sample(index * STEP_NS, {names.format(key): each for key, each in objects.items()}))
    return sr.Trace.from_samples(samples)


GOOD = [delivery(each, 2.0 + index / 50) for index, each in enumerate(CLEAR)]
BAD = [delivery(0.42, 2.03), delivery(0.43, 2.02), delivery(0.6, 1.2), delivery(0.7, cup_first=False)]


def verdicts(learned: Learned, traces: Sequence[sr.Trace]) -> list[str]:
    assert learned.specification is not None
    return [str(sr.evaluate(learned.specification, trace).verdict) for trace in traces]


def test_what_bad_runs_do_otherwise_is_written_with_who_does_it() -> None:
    learned = sr.learn(GOOD, BAD)
    assert learned.is_found
    assert verdicts(learned, GOOD) == ["satisfied"] * len(GOOD)
    assert verdicts(learned, BAD) == ["violated"] * len(BAD)
    # the distance to the person is between that of the good runs and that of the bad ones, in the middle
    near = next(line for line in learned.specs if "dist person >=" in line.text)
    assert near.title == "every dish and person are always at least 0.474 apart"
    assert near.violated_by == ("bad run 1", "bad run 2")
    assert (near.lowest, near.lowest_run) == (pytest.approx(0.52 - 0.474), "good run 1")
    (first,) = learned.specs[:1]
    assert (first.title, first.violated_by) == ("every dish ends inside table", ("bad run 3",))
    assert any(line.pattern == "before" and "bad run 4" in line.violated_by for line in learned.specs)


def test_good_runs_alone_say_how_they_end_and_what_they_keep() -> None:
    learned = sr.learn(GOOD)
    assert verdicts(learned, GOOD) == ["satisfied"] * len(GOOD)
    found = {line.text for line in learned.specs}
    # both dishes are brought to the table, so their class is
    assert 'F (G (forall a in class "dish": (a enclosedin table)))' in found
    assert 'G (forall a in class "dish": (a dist person >= 0.5))' in found
    assert verdicts(learned, BAD)[0] == verdicts(learned, BAD)[2] == "violated"


def breakfast(off: float) -> sr.Trace:
    """A bun is put on a plate, cups beside it, and sugar between a tin and a can far from it, one by one."""
    ends = {"bun": (0.0, off), "cup": (0.2 + off, 0.0), "mug": (-0.2, off), "sugar": (0.9 - off, 0.15)}
    stays = {"plate": box(-0.05, -0.05, 0.2), "tin": box(1.0, 0.0), "can": box(1.0, 0.3)}
    samples = []
    for index in range(80):
        objects = dict(stays)
        for place, (name, (x, y)) in enumerate(ends.items()):
            share = min(max((index - 20 * place) / 4, 0.0), 1.0)
            objects[name] = box(share * x + (1 - share) * 0.3 * place, share * y - (1 - share), 0.05)
        samples.append(sr.Sample(index * STEP_NS, objects))
    return sr.Trace.from_samples(samples)


def test_where_objects_end_is_said_by_what_they_are_put_into_beside_and_far_from() -> None:
    lines = sr.learn([breakfast(each) for each in (0.0, 0.004, 0.01, 0.013, 0.02)]).specs
    assert "bun ends inside plate" in [line.title for line in lines]
    for distance in ("sugar dist tin", "can dist sugar", "plate dist sugar"):
        assert any(line.pattern == "finally" and distance in line.text for line in lines)
    # in all runs, nothing is put down sooner
    assert any(line.title.endswith(" apart until bun is inside plate") for line in lines)


def test_objects_with_other_names_in_every_run_are_compared_by_their_class() -> None:
    good = [delivery(each, names=f"{{}} {index}") for index, each in enumerate(CLEAR)]
    bad = [delivery(0.4, names="{} x"), delivery(0.3, names="{} y")]
    learned = sr.learn(good, bad)
    assert verdicts(learned, good + bad) == ["satisfied"] * 5 + ["violated"] * 2
    (text,) = [line.text for line in learned.specs if line.pattern == "always"]
    assert text.startswith('G (forall a in class "dish": (forall b in class "person": (a dist b >= 0.4')


def test_the_range_of_a_signal_is_learned_from_bad_runs() -> None:
    def with_battery(least: float) -> sr.Trace:
        values = (1.0, 0.8, least, 0.7)
        return sr.Trace.from_samples(
            sr.Sample(index * STEP_NS, {}, {"battery": value}) for index, value in enumerate(values)
        )

    learned = sr.learn([with_battery(each) for each in (0.5, 0.52, 0.55)], [with_battery(0.1)])
    assert [line.text for line in learned.specs] == ["G (battery >= 0.424)"]


def test_runs_left_out_in_turn_say_what_is_found_of_what_was_not_seen() -> None:
    learned = sr.learn(GOOD, BAD)
    # it is the only one of its kind
    assert [run.name for run in learned.checked if not run.is_right] == ["bad run 4"]
    again = sr.learn(GOOD, [*BAD, delivery(0.65, 1.1), delivery(0.75, cup_first=False)])
    assert all(run.is_right for run in again.checked if not run.is_good)


@examples(5)
@given(
    st.lists(st.floats(0.45, 1.2), min_size=2, max_size=4, unique=True),
    st.lists(st.tuples(st.floats(0.05, 1.2), st.floats(1.0, 2.2), st.booleans()), max_size=2, unique=True),
)
def test_whatever_the_runs_each_line_has_its_evidence(
    clear: list[float], others: list[tuple[float, float, bool]]
) -> None:
    good = [delivery(each) for each in clear]
    bad = [delivery(each, end, cup_first=first) for each, end, first in others]
    if any(one == other for one in good for other in bad):
        return
    learned = sr.learn(good, bad)
    assert learned.text == sr.learn(good, bad).text
    if learned.specification is None:
        return
    assert not learned.specification.warnings
    assert verdicts(learned, good) == ["satisfied"] * len(good)
    for spec, line in zip(learned.specification.specs, learned.specs, strict=True):
        # written as it would be formatted, below its evidence
        assert (
            f'spec {spec.name} "{spec.id}: {spec.title}" = {format_formula(spec.formula)}\n' in learned.text
        )
        own = sr.parse_specification(line.text)
        lowest = min(sr.evaluate(own, trace).results[0].lower for trace in good)
        assert line.lowest == lowest >= 0.0
        violated = [n for n, trace in enumerate(bad, 1) if sr.evaluate(own, trace).verdict == "violated"]
        assert list(line.violated_by) == [f"bad run {n}" for n in violated]
        assert violated or not bad
    assert set(learned.missed) == {f"bad run {n}" for n in range(1, len(bad) + 1)} - {
        name for line in learned.specs for name in line.violated_by
    }


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folders of good and of bad runs."""
    for kind, traces in (("good", GOOD), ("bad", BAD)):
        (tmp_path / kind).mkdir()
        for number, trace in enumerate(traces):
            write_tracks(trace, tmp_path / kind / f"{kind}-{number}.jsonl")
    monkeypatch.chdir(tmp_path)
    return tmp_path


LOGS = (*(f"good/good-{n}.jsonl" for n in range(5)), "--bad", *(f"bad/bad-{n}.jsonl" for n in range(4)))


def test_the_command_writes_what_check_takes_and_replay_evaluates(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["learn", *LOGS, "-o", "learned.spatial"]) == 0
    said = capsys.readouterr().out
    assert re.match(r"learned \d+ specs from 5 good runs and 4 bad runs:\n", said)
    assert "every dish ends inside table" in said
    assert said.endswith("wrote learned.spatial\n")
    text = Path("learned.spatial").read_text()
    assert "# Violated by 2 of 4 bad runs: bad-0.jsonl, bad-1.jsonl.\nspec " in text
    assert str(folder) not in text
    assert run(["learn", *LOGS]) == 0
    assert capsys.readouterr().out == text
    assert run(["check", "learned.spatial"]) == 0
    # a line about the end of a run asks for its last sample, which check says
    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning: " in line]
    assert all("`F G p` asks for the last sample" in line for line in warnings)
    assert run(["replay", "good/good-3.jsonl", "--spec", "learned.spatial"]) == 0
    assert run(["replay", "bad/bad-3.jsonl", "--spec", "learned.spatial"]) == 1
    capsys.readouterr()
    assert run(["learn", *LOGS, "--lines", "1", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert len(document["lines"]) == 1
    assert document["missed"]
    assert not document["found"]


def test_bad_runs_that_no_line_is_violated_by_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tracks(delivery(0.68, 2.05), Path("as-good.jsonl"))
    assert run(["learn", *LOGS, "as-good.jsonl", "-o", "learned.spatial"]) == 1
    assert "as-good.jsonl violates none of these lines" in capsys.readouterr().out
    assert "# 1 bad run violates none of these lines: as-good.jsonl." in Path("learned.spatial").read_text()


def moved_apart(trace: sr.Trace, factor: float) -> sr.Trace:
    return sr.Trace.from_samples(
        sr.Sample(
            each.time_ns,
            {
                name: sr.Footprint.polygon(
                    [(x * factor, y * factor) for x, y in found.footprint.parts[0].vertices]
                )
                for name, found in each.objects.items()
            },
        )
        for each in trace.samples()
    )


@pytest.mark.parametrize(
    ("good", "bad", "said"),
    [
        (GOOD[:1], BAD, "good run 1 is the only good run; give at least two, better five"),
        ([], BAD, "there is no good run"),
        (GOOD[:2], [GOOD[1]], "the bad run bad run 1 holds the same samples as the good run good run 2"),
        (
            [*GOOD[:2], GOOD[0]],
            [],
            "the good run good run 3 holds the same samples as the good run good run 1",
        ),
        ([GOOD[0], GOOD[1].slice(0, 2)], [], "good run 2 is too short to learn from: it has 2 samples"),
        ([GOOD[0], moved_apart(GOOD[1], 1000.0)], [], "1,000 times as large in good run 2"),
        (
            [moved_apart(delivery(0.5, names="a {}"), 1.0), moved_apart(delivery(0.6, names="b {}"), 1.0)],
            [],
            "no two objects, classes or signals are in all good runs, so there is nothing to compare: "
            "good run 1 has a cup, a person, a plate, a table; good run 2 has b cup",
        ),
    ],
)
def test_runs_to_learn_nothing_from_are_refused(good: list[sr.Trace], bad: list[sr.Trace], said: str) -> None:
    with pytest.raises(UsageError, match=re.escape(said)):
        sr.learn(good, bad)


def test_an_object_that_some_good_runs_lack_is_named() -> None:
    def without_plate(trace: sr.Trace) -> sr.Trace:
        return sr.Trace.from_samples(
            sr.Sample(each.time_ns, {k: v for k, v in each.objects.items() if k != "plate"})
            for each in trace.samples()
        )

    learned = sr.learn([*GOOD[:4], without_plate(GOOD[4])])
    assert learned.left_out == ("plate, which is missing in 1 of 5 good runs",)
    assert "# Not compared: plate, which is missing in 1 of 5 good runs." in learned.text


def test_of_lines_that_the_same_bad_runs_violate_the_shorter_ones_come_first() -> None:
    lengths: dict[tuple[str, ...], list[int]] = {}
    for line in sr.learn(GOOD, BAD).specs:
        lengths.setdefault(line.violated_by, []).append(len(line.text.split()))
    assert any(len(each) > 1 for each in lengths.values())
    assert all(each == sorted(each) for each in lengths.values())


def test_limits_that_good_runs_come_near_are_numbers_that_people_write() -> None:
    good = [delivery(0.5 + part) for part in (0.004, 0.011, 0.019, 0.026, 0.038)]
    found = {line.text for line in sr.learn(good).specs}
    assert 'G (forall a in class "dish": (a dist person >= 0.5))' in found


def test_what_is_not_compared_is_said() -> None:
    def crowd(shift: float) -> sr.Trace:
        return sr.Trace.from_samples(
            sr.Sample(n * STEP_NS, {f"o{i:02}": box(i + shift * n * (i == 0), 0) for i in range(64)})
            for n in range(3)
        )

    learned = sr.learn([crowd(0.1), crowd(0.11), crowd(0.12)], [crowd(-0.3)])
    assert learned.left_out[0] == "4 objects beyond the first 60 by name"
    assert learned.left_out[1] == "1,370 pairs of objects that come less near than 400 others"
    assert "# Not compared: 4 objects beyond the first 60 by name." in learned.text
