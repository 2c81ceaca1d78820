"""Some tries of the attacks of tests/attacks: those run for longer by themselves."""

import random
from functools import partial

import pytest

from tests.attacks import fuzz_calls, interrupt_calls, kill_computations, mutate_files
from tests.helpers import trials


def test_random_calls_meet_only_errors_of_our_own(tmp_path, monkeypatch):
    """Arguments stay as they were, and results are read-only and not the caller's."""
    monkeypatch.chdir(tmp_path)
    outcomes, failures = trials.in_process(fuzz_calls.trial, 120, seed=1)
    assert not failures
    assert min(outcomes["accepted"], outcomes["refused"]) > 20


@pytest.mark.parametrize("kind", ["toml", "json", "csv", "npy", "parquet", "cells", "profiles"])
def test_a_damaged_file_is_read_or_refused_in_one_sentence(kind):
    outcomes, failures = trials.in_process(partial(mutate_files.trial, kind), 100, seed=1)
    assert not failures
    assert min(outcomes["read"], outcomes["refused"]) > 0


def test_the_attacks_see_what_is_wrong():
    """A failure is counted where an error is not ours, and where an array can be written."""
    assert trials.fault_of(ZeroDivisionError("division by zero")).startswith("raw")
    outcome, fault = fuzz_calls.attempt(lambda: [][0], {})
    assert (outcome, fault) == ("refused", "raw IndexError: 'list index out of range'")


@pytest.mark.parametrize("name", ["monte_carlo, long paths", "simulate, in Python"])
def test_an_interrupt_is_answered_and_the_next_call_works(name):
    found = interrupt_calls.interrupt(name, 1, random.Random(0), longest=1.0)
    assert not found.failures
    assert found.tries == 2


def test_a_killed_run_resumes_to_the_same_bits():
    name = "parameter_study: kill"
    found = kill_computations.attack(name, 1, random.Random(0), scale=0.2)
    assert not found.failures
    assert found.tries >= 1
