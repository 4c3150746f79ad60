"""Options and fixtures that every area of the tests shares."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

import spatial_replay
from examples import ALL

# a law is about values, not about how busy the machine is
settings.register_profile("thorough", deadline=None, max_examples=ALL, print_blob=True)
# a tenth finds nearly all that is wrong with a change; CI tries the same examples each time
settings.register_profile("quick", settings.get_profile("thorough"), max_examples=ALL // 10)
settings.register_profile("ci", settings.get_profile("quick"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "quick")


# a tenth of the time went into collections of a heap that holds every module
gc.set_threshold(100_000, 50, 100)

# programs under test run the package that these tests import, wherever they start
if not os.environ.get("SPATIAL_REPLAY_INSTALLED"):
    os.environ["PYTHONPATH"] = str(Path(spatial_replay.__file__).parents[1])

# a shell may start the tests in the background with interruptions ignored, which programs under test inherit
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--forbid-skips", action="store_true", help="a skipped test fails the run")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    if not session.config.getoption("--forbid-skips"):
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and reporter.stats.get("skipped") and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("--forbid-skips") and terminalreporter.stats.get("skipped"):
        terminalreporter.section("skipped tests", sep="=", red=True)
        terminalreporter.line("--forbid-skips was given, and tests were skipped: the run fails")


@pytest.fixture(scope="session", autouse=True)
def _unannounced() -> Iterator[None]:
    """What tests read from standard error does not depend on what the machine has compiled before."""
    from spatial_replay.compiled import compilations

    with compilations(lambda: None):
        yield


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of recordings to compare with; the test skips where there is none."""
    folder = os.environ.get("SPATIAL_REPLAY_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("SPATIAL_REPLAY_DATA names no folder of recordings")
    return Path(folder)


@pytest.fixture
def figures() -> Iterator[None]:
    """Figures are drawn into memory, and gone after the test."""
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("Agg")
    yield
    pyplot.close("all")
