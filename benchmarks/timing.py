"""Calls timed in turn, so that a machine that drifts is as fast for each of them."""

import gc
import time
from collections.abc import Callable, Mapping


def interleaved(calls: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Return the seconds of each call, one a round; a round before them is not counted."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    gc.freeze()  # what is there before is not looked through again before each call
    for number in range(rounds + 1):
        for name, call in calls.items():
            gc.collect()
            started = time.perf_counter()
            call()
            if number:
                times[name].append(time.perf_counter() - started)
    gc.unfreeze()
    return times
