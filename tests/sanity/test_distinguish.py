"""Which run shows that two specifications mean different things."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import spatial_replay as sr
from cli.program import run_program

BOWL = "region bowl = box(0, 0, 1, 1)\n"
SPEC = f"{BOWL}spec s = "
IN_BOWL, LEFT = "cup enclosedin bowl", "cup leftof mug"


@pytest.mark.parametrize(
    ("first", "second", "relation", "only_first", "only_second"),
    [
        # on finite runs both ask for the last sample
        (f"F G ({IN_BOWL})", f"G F ({IN_BOWL})", "same", None, None),
        (
            f"({LEFT}) U ({IN_BOWL})",
            f"({LEFT}) W ({IN_BOWL})",
            "stricter",
            None,
            [f"{LEFT} and not ({IN_BOWL})"],
        ),
        (
            f"F[0, 5] ({IN_BOWL})",
            f"F[0s, 5s] ({IN_BOWL})",
            "stricter",
            None,
            [*[f"not ({IN_BOWL})"] * 6, IN_BOWL],
        ),
        (f"F ({IN_BOWL})", f"F G ({IN_BOWL})", "weaker", [IN_BOWL, f"not ({IN_BOWL})"], None),
        (
            f"G ({IN_BOWL})",
            "G (center(cup) enclosedin bowl)",
            "stricter",
            None,
            [f"not ({IN_BOWL}) and center(cup) enclosedin bowl"],
        ),
        (
            f"{BOWL}spec a = F ({IN_BOWL})\nspec b = F ({LEFT})",
            f"(F {IN_BOWL}) and (F {LEFT})",
            "same",
            None,
            None,
        ),
        # a prefix operator reaches to the end
        (
            f"F ({IN_BOWL}) and F ({LEFT})",
            f"(F {IN_BOWL}) and (F {LEFT})",
            "stricter",
            None,
            [f"not ({IN_BOWL}) and {LEFT}", f"{IN_BOWL} and not ({LEFT})"],
        ),
        (
            f"F {LEFT}",
            f"F {IN_BOWL}",
            "different",
            [f"{LEFT} and not ({IN_BOWL})"],
            [f"not ({LEFT}) and {IN_BOWL}"],
        ),
    ],
)
def test_runs_that_only_one_specification_accepts(
    first: str, second: str, relation: str, only_first: list[str] | None, only_second: list[str] | None
) -> None:
    pair = [
        sr.parse_specification(text if text.startswith("region") else SPEC + text) for text in (first, second)
    ]
    distinction = sr.distinguish(*pair)
    assert distinction.relation == relation
    runs = distinction.only_first, distinction.only_second
    assert [run and list(run.sentences) for run in runs] == [only_first, only_second]
    for run, accepting, rejecting in zip(runs, pair, pair[::-1], strict=True):
        if run is not None:
            assert run.samples is not None
            trace = sr.Trace.from_samples(run.samples)
            assert [sr.evaluate(spec, trace).verdict for spec in (accepting, rejecting)] == [
                "satisfied",
                "violated",
            ]


def test_the_command_says_which_one_is_stricter_and_what_it_does_not_know(tmp_path: Path) -> None:
    for name, text in {
        "until": f"({LEFT}) U ({IN_BOWL})",
        "unless": f"({LEFT}) W ({IN_BOWL})",
        "once": f"G ({LEFT} -> O ({IN_BOWL}))",
        "lately": f"G ({LEFT} -> O[0, 5] ({IN_BOWL}))",
    }.items():
        (tmp_path / f"{name}.spatial").write_text(SPEC + text, "utf-8")
    (tmp_path / "template.spatial").write_text(f"{BOWL}spec s(o) = G (o enclosedin bowl)", "utf-8")
    moved = f"region bowl = box(0, 0, 2, 1)\nspec s = F ({IN_BOWL})"
    (tmp_path / "moved.spatial").write_text(moved, "utf-8")

    def compare(first: str, second: str, *options: str) -> tuple[int, str]:
        run = run_program("distinguish", f"{first}.spatial", f"{second}.spatial", *options, cwd=tmp_path)
        return run.returncode, run.stdout or run.stderr

    code, printed = compare("until", "unless")
    assert (code, printed.splitlines()[0]) == (
        1,
        "until.spatial is stricter than unless.spatial: it rejects runs that unless.spatial accepts",
    )
    code, printed = compare("until", "unless", "--json")
    document = json.loads(printed)
    assert (code, document["relation"], document["only_first"]) == (1, "stricter", None)
    assert document["only_second"]["samples"] == [f"{LEFT} and not ({IN_BOWL})"]
    assert compare("until", "until")[0] == 0
    code, printed = compare("once", "lately")
    assert (code, "there is no automaton for past operators" in printed) == (4, True)
    assert compare("template", "until") == (
        2,
        "spatial-replay: error: s(o) is a template; write forall o in a group\n",
    )
    code, printed = compare("moved", "until")
    assert (code, "region bowl is not the same in moved.spatial and until.spatial" in printed) == (2, True)
