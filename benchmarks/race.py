"""All peers on one core, interleaved: each round runs each of them once.

The machine's speed drifts, so a peer is compared with robsmooth within a round, and the ratio is
the median over the rounds. Run as ``python -m benchmarks.alone race``.
"""

import math
import sys
import time
from dataclasses import dataclass

OURS = ("robsmooth, single", "robsmooth, mixed")
CHECKED_STEPS = 2000  # 20 us: the loop forgets its start in 2
REFERENCE_SEED = 2**32
FEWEST_PATHS = 100
SIGMAS = 4.5  # a correct peer is further off once in 150 000 times


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes
    ----------
    rounds : int
    seconds : float
        For a peer in a round.
    check_seconds : float
        For the check of a peer's statistics.
    reference_paths : int
        For the reference of the check.
    """

    rounds: int
    seconds: float
    check_seconds: float
    reference_paths: int


FULL = Effort(rounds=15, seconds=0.25, check_seconds=0.8, reference_paths=1_000_000)
QUICK = Effort(rounds=3, seconds=0.02, check_seconds=0.05, reference_paths=10_000)


def race(effort: Effort, names: list[str]) -> dict:
    """Check and measure the peers whose names contain any of `names`."""
    import numpy as np

    from benchmarks.peers import PEERS
    from benchmarks.problem import Unavailable, literal_problem

    problem = literal_problem()
    reference = PEERS[0].prepare(problem)(effort.reference_paths, CHECKED_STEPS, REFERENCE_SEED)
    runners, found, skipped = {}, {}, {}
    for peer in PEERS:
        if peer.name not in OURS and not any(name in peer.name for name in names):
            continue
        say(f"checking {peer.name}")
        try:
            simulate = peer.prepare(problem)
            check = checked(peer, simulate, reference, effort.check_seconds)
        except Unavailable as reason:
            skipped[peer.name] = str(reason)
            continue
        paths, steps = workload(peer, check["rate"], effort.seconds)
        timed(simulate, paths, steps, 0)  # JAX compiles for each number of steps
        runners[peer.name] = (simulate, paths, steps)
        found[peer.name] = {**check, "paths": paths, "steps": steps}

    rates = {name: [] for name in runners}
    for number in range(1, effort.rounds + 1):
        say(f"round {number} of {effort.rounds}")
        for name, (simulate, paths, steps) in runners.items():
            rates[name].append(timed(simulate, paths, steps, number)[0])
    for name, peer in found.items():
        peer["rate"], peer["rate_quartiles"] = middle(rates[name])
        for ours in OURS:
            quotients = np.divide(rates[ours], rates[name])
            label = ours.split()[-1]
            peer[f"ratio_{label}"], peer[f"ratio_{label}_quartiles"] = middle(quotients)
    return {
        "rounds": effort.rounds,
        "seconds": effort.seconds,
        "reference_paths": effort.reference_paths,
        "peers": found,
        "skipped": skipped,
    }


def timed(simulate, paths: int, steps: int, seed: int) -> tuple:
    """Return the rate in path-steps a second, and the sample."""
    started = time.perf_counter()
    sample = simulate(paths, steps, seed)
    seconds = sample.seconds or time.perf_counter() - started
    return sample.paths * steps / seconds, sample


def checked(peer, simulate, reference, seconds: float) -> dict:
    """Simulate for about so long; compare with the reference, and return the rate."""
    paths = peer.width
    simulate(paths, CHECKED_STEPS, 1)  # compiles
    while True:
        rate, sample = timed(simulate, paths, CHECKED_STEPS, 2)
        wanted = max(rate * seconds / CHECKED_STEPS, FEWEST_PATHS)
        if sample.paths >= wanted / 2:
            break
        paths = peer.width * math.ceil(max(2 * paths, wanted) / peer.width)
    off = {}
    for output in ("filtered", "smoothed"):
        expected, found = getattr(reference, output), getattr(sample, output)
        # the reference knows the spread better than a peer with few paths
        error = expected.standard_error * (1 + reference.paths / sample.paths) ** 0.5
        off[output] = (found.mean_square - expected.mean_square) / error
    return {
        "rate": rate,
        "checked_paths": sample.paths,
        "standard_errors_off": off,
        "agrees": all(abs(value) < SIGMAS for value in off.values()),
    }


def workload(peer, rate: float, seconds: float) -> tuple[int, int]:
    """Return paths and steps that take about so long.

    Where whole paths do not fit in, there are fewer steps rather than fewer paths side by side.
    """
    from benchmarks.problem import STEPS

    steps = min(STEPS, max(500, int(rate * seconds / peer.width)))
    return peer.width * max(1, round(rate * seconds / (steps * peer.width))), steps


def middle(values) -> tuple[float, list[float]]:
    """Return median and quartiles."""
    import numpy as np

    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    return float(median), [float(low), float(high)]


def say(text: str) -> None:
    """Tell how far it is, on the terminal only."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def measure(quick: bool, peers: str) -> dict:
    """Race as much as for a test of the benchmarks, or all."""
    return race(QUICK if quick else FULL, peers.split(","))
