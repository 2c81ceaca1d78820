"""How long a user waits for what is asked for most, each with its aim, after a first call.

All but the sweep of many states are of the paper's example. The machine's speed drifts, so what
is kept for later runs to compare with is the ratio to a yardstick, a fixed piece of NumPy, SciPy
and Python, that is timed in the same rounds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur
from threadpoolctl import threadpool_limits

import robsmooth as rs
from benchmarks.growth import chain, covariance, sweep
from benchmarks.race import middle
from benchmarks.timing import interleaved
from robsmooth.paper import published
from robsmooth.paper.published import DELAY, ORDER

TAU, MULTIPLIERS = 1.0987e-6, (1.0, 0.4999, 1e-4, 1e-4)
SLOPES = np.linspace(-1.0, 1.0, 101)
STATES, QUICK_STATES = 50, 4  # of the sweep in units of a covariance
LAGS = np.linspace(0.5e-6, 5e-6, 5)


@dataclass(frozen=True)
class Target:
    """What is waited for.

    Attributes
    ----------
    name : str
    aim : float
        In s, of one of `parts`.
    prepare : callable
        Returns the call to time.
    parts : int
        Of which the call is made.
    """

    name: str
    aim: float
    prepare: Callable[[], Callable[[], object]]
    parts: int = 1


def _plant():
    return rs.augment(rs.homodyne.PAPER.uncertain_system(), DELAY, ORDER)


def _design() -> Callable:
    plant = _plant()
    return lambda: rs.design_smoother(plant, TAU, MULTIPLIERS)


def _sweep() -> Callable:
    smoother = _design()()
    return lambda: rs.delta_sweep(smoother, SLOPES)


def _lag_sweep() -> Callable:
    system = rs.homodyne.PAPER.uncertain_system()
    return lambda: rs.lag_sweep(system, LAGS, [2])


def _analysis_bound() -> Callable:
    smoother = _design()()
    return lambda: rs.analysis_bound(smoother)


def _worst_feedback() -> Callable:
    smoother = _design()()
    return lambda: rs.analysis_bound(smoother, "smoothed", loop="real").feedback


def _minimax() -> Callable:
    plant = rs.augment(chain(4, 1, 0), 1.0, 2)
    return lambda: rs.minimax_smoother(plant)


def _monte_carlo() -> Callable:
    smoother = published.recomputed_estimator()
    return lambda: rs.monte_carlo(rs.homodyne.PAPER, smoother)


TARGETS = (
    Target("design_smoother of the example", 1e-3, _design),
    Target("delta_sweep of 101 slopes, 3 states", 2e-3, _sweep),
    Target("lag_sweep, a design", 10e-3, _lag_sweep, parts=len(LAGS)),
    Target("analysis_bound", 30e-3, _analysis_bound),
    Target("analysis_bound of the real loop, with its worst feedback", 100e-3, _worst_feedback),
    Target("minimax_smoother, 6 states", 0.3, _minimax),
    Target("monte_carlo by default, all cores", 20e-3, _monte_carlo),
)
IMPORT = ("import robsmooth", 0.6)
IN_COVARIANCES = ("delta_sweep of 101 slopes, {} states, in covariances", 10.0)


def yardstick() -> None:
    """Do a fixed piece of work, of about a millisecond, like that of a design."""
    matrix = np.add.outer(np.arange(12.0), np.cos(np.arange(12.0)))
    for _ in range(20):
        form, basis = schur(matrix, sort="lhp")[:2]
        np.linalg.solve(basis + 13.0 * np.eye(12), form)


def targets(rounds: int, states: int = STATES) -> list[dict]:
    """Return the measured times and aims, and ratios to the yardstick; all interleaved."""
    calls = {target.name: target.prepare() for target in TARGETS}
    times = interleaved({"yardstick": yardstick, **calls}, rounds)
    rows = []
    for target in TARGETS:
        seconds, quartiles = middle(np.divide(times[target.name], target.parts))
        row = {"name": target.name, "aim": target.aim, "unit": "s", "measured": seconds}
        ratio, spread = middle(np.divide(times[target.name], times["yardstick"]) / target.parts)
        rows.append(row | {"quartiles": quartiles, "ratio": ratio, "ratio_quartiles": spread})
    return [*rows, in_covariances(max(rounds // 10, 1), states)]


def in_covariances(rounds: int, states: int) -> dict:
    """Return how many single covariances a sweep over 101 slopes costs, on one BLAS thread."""
    calls = {"one": covariance(states), "sweep": sweep(states, len(SLOPES))}
    with threadpool_limits(1):
        times = interleaved(calls, rounds)
    ratio, quartiles = middle(np.divide(times["sweep"], times["one"]))
    name, aim = IN_COVARIANCES
    row = {"name": name.format(states), "aim": aim, "unit": "", "measured": ratio}
    return row | {"quartiles": quartiles, "ratio": ratio, "ratio_quartiles": quartiles}


def import_time(seconds: float) -> dict:
    """Return the row of the import, which `scales` measures in new processes."""
    name, aim = IMPORT
    return {"name": name, "aim": aim, "unit": "s", "measured": seconds}
