"""How long a Kalman-Bucy filter takes to design, beside python-control, SLICOT and SciPy.

The systems are those of `benchmarks.growth`. The gains are compared with robsmooth's, which also
checks the system, certifies its solution, and has the equations of an estimator. Run as
``python -m benchmarks.alone riccati``.
"""

from collections.abc import Callable

from benchmarks.race import middle
from benchmarks.timing import interleaved

OURS = "robsmooth, kalman_bucy"
STATES, QUICK_STATES = (2, 10, 50), (2, 10)
ROUNDS, QUICK_ROUNDS = 15, 3
AGREEMENT = 1e-8  # of the largest entry of the gain
SKIPPED = "slycot is not installed"


def contenders(system) -> dict[str, Callable]:
    """Return functions without an argument that return the gain."""
    import control
    import numpy as np
    from scipy.linalg import solve_continuous_are

    from robsmooth.estimators import baselines

    A, B, C = system.A, system.B1, system.C2
    Q, R = np.eye(B.shape[1]), system.D21 @ system.D21.T

    def scipy_gain():
        P = solve_continuous_are(A.T, C.T, B @ B.T, R)
        return P @ C.T @ np.linalg.inv(R)

    def lqe(method):
        return lambda: control.lqe(A, B, C, Q, R, method=method)[0]

    def slicot_gain():
        return control.care(A.T, C.T, B @ B.T, R, method="slycot")[2].T

    found = {
        OURS: lambda: baselines.kalman_bucy(system).B_c[:, :1],
        "scipy.linalg.solve_continuous_are": scipy_gain,
        "control.lqe, SciPy": lqe("scipy"),
    }
    if has_slycot():
        found |= {"control.lqe, slycot": lqe("slycot"), "control.care, slycot": slicot_gain}
    return found


def has_slycot() -> bool:
    """Tell whether python-control can use SLICOT."""
    from control.exception import slycot_check

    return slycot_check()


def designs(states=STATES, rounds: int = ROUNDS) -> dict:
    """Measure all at each number of states; a ratio is the median over the rounds."""
    import numpy as np

    from benchmarks.growth import chain

    rows = []
    for n in states:
        calls = contenders(chain(n))
        expected = calls[OURS]()
        times = interleaved(calls, rounds)
        for name, call in calls.items():
            off = float(np.abs(call() - expected).max() / np.abs(expected).max())
            seconds, quartiles = middle(times[name])
            ratio, ratio_quartiles = middle(np.divide(times[name], times[OURS]))
            row = {"states": n, "name": name, "off": off, "agrees": off < AGREEMENT}
            row |= {"seconds": seconds, "quartiles": quartiles}
            rows.append(row | {"ratio": ratio, "ratio_quartiles": ratio_quartiles})
    skipped = {} if has_slycot() else {"control, slycot": SKIPPED}
    return {"rounds": rounds, "rows": rows, "skipped": skipped}


def measure(quick: bool, _peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all."""
    return designs(QUICK_STATES, QUICK_ROUNDS) if quick else designs()
