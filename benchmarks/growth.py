"""How time grows with the size of a system and the length of a record, as fitted exponents.

The system is a chain of masses on springs, driven and measured at its first one. Run as
``python -m benchmarks.alone growth``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from benchmarks.race import middle, say
from benchmarks.timing import interleaved

NOISE, SIZE = 0.3, 0.1  # of the measurement; of an uncertainty, of a spring's constant
DELAY, ORDER = 1.0, 2  # s
DT = 0.5  # s; at 0.01 a step of a long chain has denormal numbers, with which arithmetic is slow
TAU = 0.2
MULTIPLIERS = (1.0, 1.0, 0.01, 1.0, 0.01)


@dataclass(frozen=True)
class Curve:
    """What is measured against a size.

    Attributes
    ----------
    name : str
    against : str
        What the size is.
    sizes, quick_sizes : tuple of int
    prepare : callable
        From a size to a call.
    reason : str
        Why it grows as it does.
    """

    name: str
    against: str
    sizes: tuple[int, ...]
    quick_sizes: tuple[int, ...]
    prepare: Callable[[int], Callable[[], object]]
    reason: str


def chain(n: int, uncertainties: int = 1, nonlinearities: int = 1):
    """Return the system of n states, an even number, with springs that are not quite known."""
    import numpy as np

    from robsmooth import Nonlinearity, UncertainSystem, Uncertainty

    masses = n // 2
    springs = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    force, place = np.eye(masses), np.zeros((masses, masses))
    A = np.block([[place, force], [-springs, -force]])
    first, nothing = np.eye(1, n), np.zeros((1, 1))
    forces = [np.eye(1, n, masses + j % masses).T for j in range(n)]
    places = [SIZE * np.eye(1, n, j % masses) for j in range(n)]
    springs_known_to = [
        Uncertainty(forces[j % n], places[j % n], nothing) for j in range(uncertainties)
    ]
    sensor = Uncertainty(np.zeros((n, 1)), np.zeros((1, n)), [[NOISE]])  # it carries the noise
    bent = [Nonlinearity(forces[j % n], places[j % n], nothing, 1.0) for j in range(nonlinearities)]
    B1, D21 = np.hstack([forces[0], np.zeros((n, 1))]), np.array([[0.0, NOISE]])
    return UncertainSystem(A, B1, first, first, D21, [*springs_known_to, sensor], bent)


def design(n: int) -> Callable:
    """Return a design at given multipliers."""
    from robsmooth import augment, design_smoother

    plant = augment(chain(n), DELAY, ORDER)
    return lambda: design_smoother(plant, TAU, MULTIPLIERS)


def classical(n: int, order: int = ORDER):
    """Return the classical smoother of a chain."""
    from robsmooth.estimators import baselines

    return baselines.fixed_lag_smoother(chain(n), DELAY, order)


def design_of_order(order: int) -> Callable:
    """Return a design of the classical smoother with a delay model of an order."""
    return lambda: classical(4, order)


def covariance(n: int) -> Callable:
    """Return the covariance of the error under a constant uncertainty."""
    import numpy as np

    from robsmooth import error_covariance

    smoother = classical(n)
    springs = [0.3 * np.eye(1)] * 2
    Delta = smoother.plant.structured_delta(springs, [0.5])
    return lambda: error_covariance(smoother, Delta)


def sweep(n: int, points: int = 11) -> Callable:
    """Return a sweep over a nonlinearity's slope."""
    import numpy as np

    from robsmooth import delta_sweep

    smoother, slopes = classical(n), np.linspace(-1.0, 1.0, points)
    return lambda: delta_sweep(smoother, slopes)


def discretisation(n: int) -> Callable:
    """Return a discretisation with the delay's model."""
    smoother = classical(n)
    return lambda: smoother.discretize(DT, delay="model")


def samples(n: int) -> Callable:
    """Return a run over 2000 samples by an estimator of n states and those of the delay."""
    return record(2000, classical(n))


def record(rows: int, smoother=None) -> Callable:
    """Return a run over a record."""
    import numpy as np

    discrete = (smoother or classical(4)).discretize(DT, delay="model")
    y = np.random.default_rng(0).standard_normal((rows, 1))

    def run():
        discrete.reset()
        discrete.run(y)

    return run


def minimax(uncertainties: int = 1, nonlinearities: int = 0) -> Callable:
    """Return a design of the minimax smoother of a chain of four states and two of the delay."""
    from robsmooth import augment, minimax_smoother

    plant = augment(chain(4, uncertainties, nonlinearities), DELAY, ORDER)
    return lambda: minimax_smoother(plant)


DENSE = "dense matrix equations: at most cubic, and less where calls outweigh arithmetic"
FEW = "a convex programme whose matrices do not grow: fixed costs stand beside the channels'"
STEPS = "a matrix times a vector for each sample: square"
EACH = "the same work for each sample"
CURVES = (
    Curve("a design", "states n", (16, 32, 64, 128), (4, 8), design, DENSE),
    Curve("an error covariance", "states n", (16, 32, 64, 128), (4, 8), covariance, DENSE),
    Curve("a sweep of 11 slopes", "states n", (16, 32, 64), (4, 8), sweep, DENSE),
    Curve("a discretisation", "states n", (16, 32, 64, 128), (4, 8), discretisation, DENSE),
    Curve("2000 samples", "states n", (16, 32, 64, 128), (4, 8), samples, STEPS),
    Curve("a classical design", "order of the delay", (4, 8, 16), (1, 2), design_of_order, DENSE),
    Curve("a minimax design", "uncertainties k", (1, 2, 4, 8), (1, 2), minimax, FEW),
    Curve("a minimax design", "nonlinearities g", (1, 2, 4, 8), (1, 2), partial(minimax, 0), FEW),
    Curve("a record", "samples", (10**4, 10**5, 10**6), (10**3, 10**4), record, EACH),
)


def growth(rounds: int, quick: bool, curves: tuple[Curve, ...] = CURVES) -> list[dict]:
    """Return for each curve its times and the exponent that fits the rounds."""
    import numpy as np

    rows = []
    for curve in curves:
        say(f"{curve.name} against {curve.against}")
        sizes = curve.quick_sizes if quick else curve.sizes
        times = interleaved({str(size): curve.prepare(size) for size in sizes}, rounds)
        each = np.array(list(times.values()))
        upper = slice(-3, None)  # small sizes are calls, not arithmetic
        slopes = np.polyfit(np.log(sizes[upper]), np.log(each[upper]), 1)[0]
        exponent, quartiles = middle(slopes)
        row = {"name": curve.name, "against": curve.against, "sizes": list(sizes)}
        row |= {"seconds": np.median(each, axis=1).tolist(), "exponent": exponent}
        rows.append(row | {"quartiles": quartiles, "reason": curve.reason})
    return rows


def measure(quick: bool, _peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all."""
    return {"curves": growth(1 if quick else 3, quick)}
