"""The page over all logs of a batch in a real browser: its table is sorted, its links lead to reports."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from batch.fleet import batch, write_fleet, write_log


def logs_of(page: Page) -> list[str]:
    """The logs of the table, from top to bottom."""
    names = page.locator("#matrix tbody td:first-child").all_inner_texts()
    return [name.removeprefix("logs/") for name in names]


def test_logs_are_sorted_by_what_is_pressed_and_lead_to_their_reports(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_fleet(tmp_path, [0.5, 0.2, 0.4])
    write_log(tmp_path / "logs/run-10.jsonl", 0.1)
    assert batch("logs", "--spec", "gate.spatial", "--html", "pages").code == 1
    context = browser.new_context(offline=True)
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto((tmp_path / "pages/index.html").as_uri())
    failing = ["run-1.jsonl", "run-10.jsonl"]
    worst_first = ["run-10.jsonl", "run-1.jsonl", "run-2.jsonl", "run-0.jsonl"]
    assert logs_of(page) == worst_first
    page.get_by_role("button", name="log").click()
    # numbers in names count as numbers
    assert logs_of(page) == ["run-0.jsonl", "run-1.jsonl", "run-2.jsonl", "run-10.jsonl"]
    apart = page.locator("#matrix th").filter(has_text="apart")
    apart.get_by_role("button").click()
    assert logs_of(page) == worst_first
    apart.get_by_role("button").click()
    assert logs_of(page) == worst_first[::-1]
    expect(apart).to_have_attribute("aria-sort", "descending")
    for link in page.locator("td a").all():
        assert (link.bounding_box() or {})["height"] >= 24
    # rows are filtered, and those that fail are gone through
    page.get_by_label("Name of a log").fill("RUN-1")
    expect(page.get_by_role("status")).to_have_text("2 of 4 listed")
    page.get_by_label("Name of a log").fill("")
    page.get_by_label("only failing").check()
    expect(page.locator("#matrix tbody tr:visible")).to_have_count(len(failing))
    for name in failing:
        page.get_by_role("button", name="Next failing").click()
        expect(page.locator("#matrix tr.here")).to_contain_text(name)
        expect(page.locator("#matrix a:focus")).to_have_text(f"logs/{name}")
    # the curves of a spec are on one axis, the worst on top
    curves = page.locator("figure", has_text="apart").locator(".curves a")
    expect(curves).to_have_count(len(failing))
    expect(curves.last).to_have_attribute("aria-label", "logs/run-10.jsonl, violated")
    curves.last.focus()
    page.keyboard.press("Enter")
    expect(page.locator("html[data-ready]")).to_have_count(1)
    expect(page.locator("#verdicts-body")).to_contain_text("cart and person are 0.1 apart")
    # the report leads on to the others that fail, and back
    neighbours = page.get_by_role("navigation", name="Logs that fail")
    expect(neighbours).to_have_text("All logs1 of 2 that failNext: logs/run-1.jsonl")
    neighbours.get_by_role("link", name="Next").click()
    expect(page.locator("h1")).to_have_text("run-1.jsonl")
    expect(neighbours).to_have_text("All logs2 of 2 that failPrevious: logs/run-10.jsonl")
    for link in neighbours.get_by_role("link").all():
        assert (link.bounding_box() or {})["height"] >= 24
    neighbours.get_by_role("link", name="All logs").click()
    assert logs_of(page) == worst_first
    context.close()
    assert not errors
