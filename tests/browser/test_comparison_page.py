"""The page of a diff in a real browser: both sides follow one time cursor."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

import spatial_replay as sr
from compare.planned_runs import with_another_decision

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
HOSTILE = "</script><img src=x onerror=alert(1)>"


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1300, "height": 1400}, offline=True)
    opened = context.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("dialog", lambda dialog: errors.append(dialog.message))
    yield opened
    context.close()
    assert not errors


def test_two_specifications_are_shown_at_the_sample_at_which_they_part(page: Page, tmp_path: Path) -> None:
    old, new = (RECORDINGS / name for name in ("table.spatial", "table_edited.spatial"))
    sr.diff_specifications(RECORDINGS / "table.jsonl", old, new, output=tmp_path / "diff.html")
    page.goto((tmp_path / "diff.html").as_uri())
    expect(page.locator("html[data-ready]")).to_have_count(1)
    expect(page.locator("#verdicts-body")).to_contain_text("F[0s, 4s]")
    # flipped results come first, with both verdicts
    expect(page.locator(".change .summary").first).to_contain_text(
        re.compile("satisfied → .*violated.*table_set")
    )
    expect(page.locator(".now")).to_contain_text("5.433 s")
    expect(page.locator("#scene-a h2")).to_have_css("text-transform", "none")
    # the curves part here: the legend reads both
    expect(page.locator(".legend-entry").nth(0)).to_contain_text("0.1543")
    expect(page.locator(".legend-entry").nth(1)).to_contain_text("0.1552")
    page.get_by_role("button", name="4.000 s").click()
    expect(page.locator(".now")).to_contain_text("4.000 s")
    for side in ("#scene-a", "#scene-b"):
        expect(page.locator(f"{side} canvas")).to_be_visible()


def test_a_run_that_starts_later_is_shown_beside_the_other(page: Page, tmp_path: Path) -> None:
    shutil.copy(RECORDINGS / "table.spatial", tmp_path / "a.spatial")
    trace = sr.read_trace(RECORDINGS / "table.jsonl")
    later = replace(trace.slice(0, 200), times_ns=trace.times_ns[:200] + 7 * 10**9)
    names = tuple(sorted(HOSTILE if name == "cup" else name for name in trace.names))
    order = [trace.names.index("cup" if name == HOSTILE else name) for name in names]
    trace = replace(trace, names=names, rows=trace.rows[:, order])
    sr.diff_logs(trace, later, tmp_path / "a.spatial", output=tmp_path / "diff.html")
    page.goto((tmp_path / "diff.html").as_uri())
    expect(page.locator("html[data-ready]")).to_have_count(1)
    expect(page.locator("#verdicts-body")).to_contain_text(HOSTILE)
    page.get_by_role("button", name="To the first sample").click()
    expect(page.locator(".now")).to_contain_text("0.000 s")
    readings = page.locator(".legend-entry .number")
    assert readings.nth(1).inner_text() != "?"


def test_the_decisions_that_differ_stand_side_by_side_with_their_maps(page: Page, tmp_path: Path) -> None:
    run = RECORDINGS / "push.mcap"
    diff = sr.diff_logs(
        run, with_another_decision(run, tmp_path / "other.mcap"), output=tmp_path / "diff.html"
    )
    assert diff.decision is not None
    assert diff.decision.a_ns is not None
    page.goto((tmp_path / "diff.html").as_uri())
    expect(page.locator("html[data-ready]")).to_have_count(1)
    seconds = (diff.decision.a_ns - diff.zeros_ns[0]) / 1e9
    expect(page.locator(".now")).to_contain_text(f"{seconds:.3f} s")
    for side in ("#decision-a", "#decision-b"):
        expect(page.locator(f"{side} .candidate canvas").first).to_be_visible()
        assert page.locator(f"{side} .candidate").count() == page.locator("#decision-a .candidate").count()
    expect(page.locator("#decision-b")).to_contain_text("differently:")
    page.get_by_role("button", name="To the first sample").click()
    page.locator("#decision-b .decision-title").click()
    expect(page.locator(".now")).to_contain_text(f"{seconds:.3f} s")
