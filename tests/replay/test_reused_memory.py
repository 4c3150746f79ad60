"""Arrays whose memory is used again: never while anything refers to it, and no more of it than asked for."""

from __future__ import annotations

from threading import Thread

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from spatial_replay.replay.reused_memory import ReusedMemory

LARGE = 1 << 20


def test_what_nothing_refers_to_any_more_is_used_again():
    memory = ReusedMemory(4 * LARGE)
    array = memory.empty((2, LARGE))
    place = array.ctypes.data
    del array
    assert memory.empty((LARGE, 2)).ctypes.data == place


def test_memory_is_not_used_again_while_a_part_of_an_array_is_referred_to():
    memory = ReusedMemory(8 * LARGE)
    array = memory.empty((4, LARGE))
    array[:] = 1.0
    part = array[2, ::7].reshape(-1, 1).view()
    del array
    memory.empty((4, LARGE))[:] = 2.0
    assert (part == 1.0).all()


def test_small_arrays_and_much_smaller_ones_have_memory_of_their_own():
    memory = ReusedMemory(16 * LARGE)
    array = memory.empty((8 * LARGE,))
    place = array.ctypes.data
    del array
    small, smaller = memory.empty((3, 4)), memory.empty((LARGE,))
    assert small.shape == (3, 4)
    assert place not in (small.ctypes.data, smaller.ctypes.data)


@examples(50)
@given(steps=st.lists(st.tuples(st.integers(0, 3), st.integers(LARGE, 3 * LARGE)), max_size=25))
def test_arrays_in_use_keep_their_numbers(steps):
    memory, kept = ReusedMemory(6 * LARGE), {}
    for step, (place, size) in enumerate(steps):
        kept[place] = step, memory.empty((size,))
        kept[place][1][:: LARGE // 2] = step
    for step, array in kept.values():
        assert (array[:: LARGE // 2] == step).all()


def test_what_was_free_for_longest_goes_first():
    memory = ReusedMemory(3 * LARGE)
    arrays = [memory.empty((LARGE,)) for _ in range(5)]
    newest = {array.ctypes.data for array in arrays[2:]}
    while arrays:
        arrays.pop(0)
    # what others ask for takes the place of what is held no longer
    others = [np.ones(LARGE) for _ in range(2)]
    again = [memory.empty((LARGE,)) for _ in range(3)]
    assert {array.ctypes.data for array in again} == newest
    assert newest.isdisjoint({array.ctypes.data for array in others})


def test_threads_never_share_what_is_in_use():
    memory, wrong = ReusedMemory(8 * LARGE), []

    def work(number):
        for _ in range(40):
            array = memory.empty((LARGE,))
            array[::4096] = number
            wrong.extend([number] if (array[::4096] != number).any() else [])
            del array

    threads = [Thread(target=work, args=(float(number),)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
