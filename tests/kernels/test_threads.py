"""The threads beside the one that calls a compiled function: their errors, their memory, and who waits for whom."""

from __future__ import annotations

import threading
import time
import weakref

import numpy as np
import pytest
import torch

pytest.importorskip("numba")

from legs_loss.kernels import compiling


@pytest.fixture(autouse=True)
def two_threads(monkeypatch):
    monkeypatch.setattr(compiling, "_MOST", 2)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_an_error_in_a_helping_thread_is_raised():
    caller, began = threading.get_ident(), threading.Event()

    def work(counter, tasks):
        if threading.get_ident() == caller:
            assert began.wait(30)
        else:
            began.set()
            raise ValueError("of a helper")

    with pytest.raises(ValueError, match="of a helper"):
        compiling.in_threads(work, 2)


def test_who_has_begun_is_waited_for_and_who_has_not_is_not():
    caller, began, ended = threading.get_ident(), threading.Event(), []

    def work(counter, tasks):
        if threading.get_ident() != caller:
            began.set()
            time.sleep(0.2)
            ended.append(True)
        elif tasks == 2:
            assert began.wait(30)

    compiling.in_threads(work, 2)
    assert ended == [True]
    release, over, seen = threading.Event(), threading.Event(), []

    def busy():
        seen.append(release.wait(30))
        over.set()

    for _ in compiling._helpers:  # all of them
        compiling._tasks.put(([(busy, tuple, ())], compiling.SimpleQueue()))
    compiling.in_threads(lambda counter, tasks: None, 3)
    release.set()
    assert over.wait(30) and seen[0]


def test_nothing_of_a_task_is_kept():
    for _ in range(200):  # a thread that held a tensor longer would free it, at exit too
        values = np.zeros(8)
        seen = weakref.ref(values)
        compiling.in_threads(lambda counter, tasks, given: given.sum(), 2, values)
        del values
        assert seen() is None


def test_each_thread_is_given_memory_of_its_own():
    caller, began, seen = threading.get_ident(), threading.Event(), []

    def work(first, second, counter, tasks, given):
        seen.append((first, second))
        if threading.get_ident() == caller:
            assert began.wait(30)
        began.set()

    compiling.in_threads(work, 2, 7, own=lambda: (np.zeros(2), np.zeros(3)))
    (first, second), (first_too, second_too) = seen
    assert first is not first_too and second is not second_too
    assert [first.size, second.size, first_too.size, second_too.size] == [2, 3, 2, 3]
