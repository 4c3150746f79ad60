"""Work that is handed out is done once, by one thread or another, and no thread waits forever."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.cores import Work, drop

# work within work, as nested lists: each hands out what is in it
TREES = st.recursive(st.just([]), lambda inner: st.lists(inner, max_size=4), max_leaves=30)


def leaves(tree):
    return sum(map(leaves, tree)) if tree else 1


def count(done, tree):
    done.append(tree)
    parts = [Work(partial(count, done, each), waits=bool(each)) for each in tree]
    # the last one first: that of which nothing is done, more likely
    return sum(part.result() for part in reversed(parts)) if tree else 1


@given(st.lists(TREES, min_size=1, max_size=4))
def test_work_within_work_is_done_once_on_one_thread_or_another(trees):
    done = [[] for _ in trees]
    with ThreadPoolExecutor(len(trees)) as threads:
        counted = list(threads.map(count, done, trees))
    assert counted == [leaves(tree) for tree in trees]
    assert [len(each) for each in done] == [nodes(tree) for tree in trees]


def nodes(tree):
    return 1 + sum(map(nodes, tree))


def test_an_error_is_raised_where_the_result_is_needed():
    works = [Work(partial(divmod, 7, divisor)) for divisor in (2, 0, 4)]
    assert works[2].result() == (1, 3)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            works[1].result()
    assert works[1].is_done
    assert works[0].result() == (3, 1)


def test_an_interruption_reaches_the_thread_that_it_came_to():
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Work(interrupted).result()
    assert Work(lambda: 3).result() == 3


def test_dropped_work_is_not_done_and_what_was_begun_is_over():
    begun, may_end, did = threading.Event(), threading.Event(), []

    def long():
        begun.set()
        assert may_end.wait(60)
        did.append("long")

    # more than there are threads, so that none is left for the last
    works = [Work(long) for _ in range(32)] + [Work(partial(did.append, "never"), waits=True)]
    assert begun.wait(60)

    def end_once_the_last_is_dropped():
        while not works[-1].is_done:
            may_end.wait(0.001)
        may_end.set()

    ending = threading.Thread(target=end_once_the_last_is_dropped)
    ending.start()
    drop(works)
    ending.join()
    assert did
    assert set(did) == {"long"}
    results = 0
    for work in works:
        with suppress(CancelledError):
            results += work.result() is None
    assert results == len(did) < 32


@pytest.mark.parametrize(
    "program",
    [
        # the last words of a process come after those of its threads
        "import atexit; atexit.register(lambda: print(Work(lambda: 6).result()))",
        pytest.param(
            "import os\nWork(int).result()\n"
            "if os.fork() == 0: print(Work(lambda: 6).result(), flush=True); os._exit(0)\n"
            "os.wait()",
            marks=pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork processes"),
        ),
    ],
    ids=["ending", "forked"],
)
def test_work_is_done_where_no_thread_takes_any(program):
    program = f"from spatial_replay.cores import Work\nWork(int).result()\n{program}"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (result.stdout.strip(), result.returncode) == ("6", 0), result.stderr
