"""How many samples a second a smoother takes, beside SciPy, python-control and its own C.

The smoother is the fixed-lag smoother of the example, of three states. All that run it without
copies of the sine give the same estimates. Run as
``python -m benchmarks.alone throughput``.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.race import middle, say

OURS = "robsmooth"
DT = 1e-7  # s
AGREEMENT = 1e-9  # of the largest estimate


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes
    ----------
    rounds : int
    seconds : float
        For a contender in a round.
    """

    rounds: int
    seconds: float


FULL = Effort(rounds=15, seconds=0.1)
QUICK = Effort(rounds=3, seconds=0.01)
CHECKED = 2000  # samples
MOST = 2_000_000  # samples of a round: 16 MB


def contenders() -> dict[str, Callable]:
    """Return the ways to run a record (N, 1), each from a state of zero."""
    import numpy as np
    from numba import njit

    from benchmarks import exported
    from robsmooth import homodyne
    from robsmooth.estimators import baselines
    from robsmooth.paper.published import DELAY

    parameters = homodyne.PAPER
    system = parameters.uncertain_system()
    estimator = baselines.fixed_lag_smoother(system, DELAY, 2)
    with_copies = baselines.fixed_lag_smoother(system, DELAY, 2, copies=True)
    alpha, beta, gamma = parameters.alpha, parameters.beta, parameters.gamma

    @njit
    def psi(nu):
        error = nu / (2 * alpha * gamma)
        return 2 * alpha * (np.sin(error) - beta * error)

    ours = estimator.discretize(DT, delay="model")
    exact = estimator.discretize(DT)
    compiled = with_copies.discretize(DT, functions=[psi], delay="model")
    interpreted = with_copies.discretize(DT, delay="model")

    def run(smoother):
        def simulate(y):
            smoother.reset()
            return smoother.run(y)

        return simulate

    def with_gaps(y):
        y = y.copy()
        y[::10] = np.nan
        return run(ours)(y)

    library = exported.compiled(ours, compiled, parameters)
    in_c = {"C, to_c": exported.looped(library.run_linear)} if library else {}

    return {
        OURS: run(ours),
        **in_c,
        **others(estimator),
        "robsmooth, exact delay": run(exact),
        "robsmooth, a gap in ten": with_gaps,
        "robsmooth, compiled copies": run(compiled),
        "robsmooth, copies in Python": run(interpreted),
    }


def others(estimator) -> dict[str, Callable]:
    """Return other packages' ways to run a linear system in discrete time."""
    import control
    import numpy as np
    from scipy import signal

    matrices = (estimator.A_c, estimator.B_c[:, :1], estimator.C_a, [[0.0]])
    A, B, C, _, _ = signal.cont2discrete(matrices, DT)
    sampled = (A, B, C @ A, C @ B, DT)  # the estimate at the end of a sample is of that sample
    numerator, denominator = signal.ss2tf(*sampled[:4])
    plant = control.ss(*sampled)

    def forced_response(y):
        times = DT * np.arange(len(y))
        return control.forced_response(plant, times, y[:, 0]).outputs[:, None]

    return {
        "scipy.signal.lfilter": lambda y: signal.lfilter(numerator[0], denominator, y, axis=0),
        "scipy.signal.dlsim": lambda y: signal.dlsim(sampled, y)[1],
        "control.forced_response": forced_response,
    }


def throughput(effort: Effort) -> dict:
    """Measure all contenders."""
    found = raced(contenders(), OURS, effort, AGREEMENT)
    return {"rounds": effort.rounds, "contenders": found}


def raced(
    runs: dict[str, Callable], ours: str, effort: Effort, agreement: float
) -> dict[str, dict]:
    """Compare what runs a record with `ours`, and measure all, interleaved.

    A ratio is the median over the rounds. Names that begin as `OURS` may do other work.
    """
    import numpy as np

    y = np.random.default_rng(0).standard_normal((MOST, 1))
    expected = np.ravel(runs[ours](y[:CHECKED]))
    found, lengths = {}, {}
    for name, run in runs.items():
        say(f"checking {name}")
        off = np.abs(np.ravel(run(y[:CHECKED])) - expected) / np.abs(expected).max()
        found[name] = {"off": float(off.max()), "off_late": float(off[CHECKED // 2 :].max())}
        found[name] |= {"agrees": name.startswith(OURS) or found[name]["off"] < agreement}
        rate = measured(run, y[:CHECKED])
        lengths[name] = int(min(max(rate * effort.seconds, CHECKED // 10), MOST))
        run(y[: lengths[name]])  # JAX compiles for each length
    rates = {name: [] for name in runs}
    for number in range(1, effort.rounds + 1):
        say(f"round {number} of {effort.rounds}")
        for name, run in runs.items():
            rates[name].append(measured(run, y[: lengths[name]]))
    for name, contender in found.items():
        contender["rate"], contender["rate_quartiles"] = middle(rates[name])
        quotients = np.divide(rates[ours], rates[name])
        contender["ratio"], contender["ratio_quartiles"] = middle(quotients)
        contender["samples"] = lengths[name]
    return found


def measured(run: Callable, y) -> float:
    """Return the rate in samples a second."""
    started = time.perf_counter()
    run(y)
    return len(y) / (time.perf_counter() - started)


def measure(quick: bool, _peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all."""
    return throughput(QUICK if quick else FULL)
