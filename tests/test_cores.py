"""Work that is handed out is done once, by one thread or another, and no thread waits forever."""

from __future__ import annotations

import os
import signal
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


def handed_out(run, *, waits=False):
    work = Work(run, waits=waits)
    work.hand_out()
    return work


def leaves(tree):
    return sum(map(leaves, tree)) if tree else 1


def count(done, tree):
    done.append(tree)
    parts = [handed_out(partial(count, done, each), waits=bool(each)) for each in tree]
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
    works = [handed_out(partial(divmod, 7, divisor)) for divisor in (2, 0, 4)]
    assert works[2].result() == (1, 3)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            works[1].result()
    assert works[1].is_done
    assert works[0].result() == (3, 1)


@pytest.mark.parametrize("waits", [False, True])
def test_an_interruption_reaches_the_thread_that_it_came_to(waits):
    main, runs = threading.get_ident(), []

    def interrupted_here():
        runs.append(threading.get_ident())
        if runs[-1] == main:
            raise KeyboardInterrupt
        return 3

    work = Work(interrupted_here, waits=waits)
    with pytest.raises(KeyboardInterrupt):
        work.result()
    if waits:  # what may not be repeated is over
        with pytest.raises(KeyboardInterrupt):
            work.result()
    else:
        while not work.is_done:
            threading.Event().wait(0.001)
        assert work.result() == 3
    assert len(runs) == 1 + (not waits)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="the system has no timers that interrupt")
def test_interrupted_at_any_step_nothing_waits_forever_and_no_work_of_others_is_lost():
    program = """
import signal, sys, threading, time, random
from spatial_replay.cores import Work, drop, first_result

def handed_out(run, **options):
    works.append(Work(run, **options))
    works[-1].hand_out()
    return works[-1]

def others(count):
    for n in range(count):
        own = [Work(lambda n=n: n * n) for _ in range(3)]
        for each in own: each.hand_out()
        assert [each.result() for each in own] == [n * n] * 3
        done.append(n)

done, interruptions, mixed = [], 0, random.Random(2)
thread = threading.Thread(target=others, args=(20_000,))
thread.start()
signal.signal(signal.SIGALRM, signal.default_int_handler)
end = time.monotonic() + 3
while time.monotonic() < end:
    works = []
    try:
        signal.setitimer(signal.ITIMER_REAL, mixed.uniform(5e-5, 2e-3))
        try:
            for n in range(1_000):
                short = [handed_out(lambda n=n: n + 1) for _ in range(3)]
                before = handed_out(lambda: 1, waits=True)
                after = handed_out(lambda: before.result() + 1, waits=True)
                assert first_result(short) == n + 1 and after.result() == 2
        finally:
            drop(works)
        signal.setitimer(signal.ITIMER_REAL, 0)
    except KeyboardInterrupt:
        interruptions += 1
signal.setitimer(signal.ITIMER_REAL, 0)
thread.join()
print(interruptions > 10, len(done))
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (result.stdout.split(), result.returncode) == (["True", "20000"], 0), result.stderr


def test_dropped_work_is_not_done_and_what_was_begun_is_over():
    begun, may_end, did = threading.Event(), threading.Event(), []

    def long():
        begun.set()
        assert may_end.wait(60)
        did.append("long")

    # more than there are threads, so that none is left for the last
    works = [handed_out(long) for _ in range(32)] + [handed_out(partial(did.append, "never"), waits=True)]
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
        "import atexit; atexit.register(lambda: print(handed_out(lambda: 6).result()))",
        pytest.param(
            "import os\n"
            "if os.fork() == 0: print(handed_out(lambda: 6).result(), flush=True); os._exit(0)\n"
            "os.wait()",
            marks=pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork processes"),
        ),
    ],
    ids=["ending", "forked"],
)
def test_work_is_done_where_no_thread_takes_any(program):
    program = f"""
from spatial_replay.cores import Work

def handed_out(run):
    work = Work(run)
    work.hand_out()
    return work

handed_out(int).result()
{program}
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (result.stdout.strip(), result.returncode) == ("6", 0), result.stderr
