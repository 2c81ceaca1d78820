from tests.attacks import kill_runs


def test_a_run_whose_worker_is_killed_leaves_nothing_and_the_next_is_as_ever():
    assert kill_runs.attack(tries=1, seed=0, names="kill a worker") == []
