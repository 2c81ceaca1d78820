"""The limit of one BLAS thread, under nested calls, threads and errors."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import robsmooth as rs
from robsmooth._support.blas import _OneThread, one_thread


def threads():
    return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield
        assert set(threads()) == {2}


@one_thread
def seen(then=threads):
    return then()


def test_a_call_has_one_thread_and_leaves_the_callers_number_alone():
    assert set(seen()) == {1}
    assert set(threads()) == {2}


def test_the_end_of_an_inner_call_leaves_the_outer_one_its_limit():
    @one_thread
    def outer():
        seen()
        return threads()

    assert set(outer()) == {1}


def test_an_error_takes_the_limit_back():
    with pytest.raises(ZeroDivisionError):
        seen(lambda: 1 / 0)


STEPS = {each.__code__ for each in (_OneThread._enter, _OneThread._leave, _OneThread._set)}


def interrupted(step):
    """Make a call that is interrupted at a step of its beginning or end; return whether it was."""
    steps = 0

    def trace(frame, event, _):
        nonlocal steps
        # a lock is taken and given back in one step each, on the first line
        locks = event == "line" and frame.f_lineno == frame.f_code.co_firstlineno + 1
        if frame.f_code in STEPS and not locks:
            steps += event in ("call", "line")
            if steps == step + 1:
                steps += 1
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        seen(list)
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_an_interrupt_at_any_step_leaves_the_callers_number_alone():
    step = 0
    while interrupted(step):
        assert set(threads()) == {2}, step
        assert not one_thread._calls, step
        step += 1
    assert step > 12
    assert set(seen()) == {1}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_child_keeps_the_calls_of_the_thread_that_forked_alone():
    inside, done = threading.Event(), threading.Event()

    def wait():
        inside.set()
        done.wait(10)

    def forked():
        if not (child := os.fork()):
            good = set(threads()) == {1} and len(one_thread._calls) == 1
            os._exit(not good)
        return os.waitpid(child, 0)[1]

    other = threading.Thread(target=seen, args=(wait,))
    other.start()
    inside.wait(10)
    try:
        assert seen(forked) == 0
        if not (child := os.fork()):
            good = set(seen()) == {1} and set(threads()) == {2} and not one_thread._calls
            os._exit(not good)
        assert os.waitpid(child, 0)[1] == 0
    finally:
        done.set()
        other.join()


def test_a_system_that_cannot_fork_has_the_limit_too(monkeypatch):
    monkeypatch.delattr(os, "register_at_fork")  # as on Windows
    assert set(_OneThread()(threads)()) == {1}


def test_calls_that_overlap_have_one_thread_until_the_last_one_ends():
    """The call that began first ends first: its end must not lift the other one's limit."""
    begun, ended, found = threading.Event(), threading.Event(), []

    def second():
        begun.set()
        ended.wait(10)
        found.extend(threads())

    def first():
        other = threading.Thread(target=seen, args=(second,))
        other.start()
        begun.wait(10)
        return other

    other = seen(first)
    ended.set()
    other.join()
    assert set(found) == {1}


def test_eight_threads_that_design_at_once_find_the_same_bits():
    plants = [
        rs.augment(rs.homodyne.PAPER.uncertain_system(), delay, 2)
        for delay in np.linspace(1e-6, 5e-6, 16)
    ]

    def design(plant):
        smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-4, 1e-4])
        return smoother.A_c, rs.delta_sweep(smoother, [-0.5, 0.5]).covariances

    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(design, plants))
    for plant, found in zip(plants, together, strict=True):
        for one, other in zip(found, design(plant), strict=True):
            assert np.array_equal(one, other)
