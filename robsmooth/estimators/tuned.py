r"""The classical smoother, and the one whose nominal system is tuned for the worst case.

The tuned slope of a nonlinearity changes the gain only: its copy runs as it is.
"""

import math
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter

import numpy as np
from scipy.linalg import LinAlgError
from scipy.optimize import minimize

from robsmooth._numerics.lyapunov import covariances
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.certificate import certify, problem_of
from robsmooth.estimators.constant import mean_square, worst_constant
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.estimators.loop import open_loop
from robsmooth.estimators.units import Natural
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.channels import with_feedback
from robsmooth.systems.system import UncertainSystem

AGAINST = ("constant", "admissible")
_ROUNDS = 5
_CLOSED = 1e-3  # relative: no other Delta is worse by more
_REFUSED = 1e2  # more than the logarithm of any error in natural units
_LITTLE_NOISE = -6.0  # through an uncertainty's channel, at the start: a logarithm
_SHIFTS = (0.0, 3.5, 7.0)  # of the measurement noises' logarithms, where searches start
_MORE = 7.0  # the largest change of a multiplier's logarithm
_STARTS = 8  # of the search for the worst Delta
_LOGARITHMS = (-15.0, 15.0)
_STEP = 0.1  # of the box, at first
_OPTIONS = {"maxfev": 300, "xatol": 1e-2, "fatol": 1e-5}


def classical(plant: AugmentedSystem, copies: bool = False) -> Estimator:
    """Return the classical fixed-lag smoother of a plant's nominal system."""
    system = plant.system
    nominal = UncertainSystem(system.A, system.B1, system.C0, system.C2, system.D21)
    return _with_gain(plant, nominal, nominal, copies)


def _with_gain(
    plant: AugmentedSystem, model: UncertainSystem, designed: UncertainSystem, copies: bool
) -> Estimator:
    """Return the smoother that runs a model with the gain of another, with or without copies."""
    (B, D), g, own = plant.known, plant.system.g, slice(plant.system.n)
    _, gain = kalman_gain(designed, plant.delay_model)
    A, C2 = plant.A_p.copy(), plant.C2_tilde[: plant.system.l].copy()
    A[own, own], C2[:, own] = model.A, model.C2
    A_c, B_c = A - gain @ C2, np.hstack([gain, np.where(copies, B - gain @ D, 0.0)])
    C_c = np.vstack([plant.C_p0, np.where(copies, plant.C1_tilde[-2 * g :][:g], 0.0)])
    found = Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=plant.C_p0)
    return found.of_nominal(model, designed)


@one_thread
def tuned_fixed_lag_smoother(
    plant: AugmentedSystem, against: str = "constant", output: str = "smoothed"
) -> Estimator:
    """Return the classical fixed-lag smoother whose nominal system is tuned for the worst case.

    The search is over the intensities of the measurement's noises, of a noise through each
    uncertainty's channel, and the nominal values of scalar uncertainties. The result is never worse
    than `fixed_lag_smoother`.

    Parameters
    ----------
    plant : AugmentedSystem
    against : {"constant", "admissible"}
        The error to minimise: worst constant, or certified worst against the delay model's output.
    output : {"smoothed", "filtered"}, which estimate is wanted

    Raises
    ------
    InfeasibleDesignError
        As in `minimax_smoother`, except that no guarantee is needed.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> tuned = rs.baselines.tuned_fixed_lag_smoother(plant)
    >>> round(rs.worst_case(tuned, loop="real").mean_square, 4)
    0.0838
    """
    validation.choice("against", against, AGAINST)
    natural = Natural.of(plant, output)
    family = _Family(natural)
    search = _least_constant if against == "constant" else _least_certified
    found = family(search(family))
    nominal = map(natural.units.back().system, found.nominal)
    return Estimator(**natural.restored(found)).of_nominal(*nominal)


def _least_constant(family: "_Family") -> np.ndarray:
    """Return a point with a small worst constant error, from a set of Delta that the worst join."""
    starts = family.untuned, *family.starts
    found = [(*worst_constant(family(start), "smoothed", _STARTS), start) for start in starts]
    least, _, best = min(found, key=itemgetter(0))
    Deltas = [Delta for _, Delta, _ in found]

    def objective(point: np.ndarray) -> float:
        with suppress(ArithmeticError, LinAlgError, InfeasibleDesignError):
            loop = open_loop(family(point), "smoothed", "real")
            return min(math.log(max(mean_square(loop, Delta) for Delta in Deltas)), _REFUSED)
        return _REFUSED

    point = np.maximum(best, family.starts[0])  # from -inf no step leads anywhere
    for _ in range(_ROUNDS):
        steps = np.where(point > 0.0, -_STEP, _STEP) * (family.box[:, 1] - family.box[:, 0])
        options = {**_OPTIONS, "initial_simplex": np.vstack([point, point + np.diag(steps)])}
        how = {"method": "Nelder-Mead", "bounds": family.box, "options": options}
        point = minimize(objective, point, **how).x
        lowest = objective(point)
        if lowest == _REFUSED:
            break  # each point has an infinite error
        value, Delta = worst_constant(family(point), "smoothed", _STARTS)
        Deltas.append(Delta)
        if value < least:
            least, best = value, point
        if value < (1.0 + _CLOSED) * math.exp(lowest):
            break
    return best


def _least_certified(family: "_Family") -> np.ndarray:
    """Return a point with a small certified error, by a search over it and the multipliers."""
    least, best, logarithms = math.inf, family.untuned, None
    for start in (family.untuned, *family.starts):
        value, _, theta = certify(problem_of(family(start)))
        if value < least:
            least, best, logarithms = value, start, np.log(theta)
    if logarithms is None:
        return best

    def objective(x: np.ndarray) -> float:
        point, theta = x[: len(best)], np.exp(x[len(best) :])
        with suppress(ArithmeticError, LinAlgError, InfeasibleDesignError):
            return math.log(problem_of(family(point)).at(theta).mean_square)
        return _REFUSED

    box = [*family.box, *zip(logarithms - _MORE, logarithms + _MORE, strict=True)]
    start = np.concatenate([np.maximum(best, family.starts[0]), logarithms])
    found = minimize(objective, start, method="L-BFGS-B", bounds=box)
    gains = found.fun < math.log(least) - 1e-6  # certificates leave gaps of that size
    return found.x[: len(best)] if gains else best


class _Family:
    """The classical smoothers of a plant in natural units, for other nominal systems.

    A point holds the logarithms of the measurement noises' factors and of the intensities of noise
    through the uncertainties, and the nominal slopes.
    """

    def __init__(self, natural: Natural) -> None:
        self.plant = natural.whole
        system, left = self.plant.system, natural.plant.system
        self.uncertain = [u for u in system.uncertainties if u.C.any()]
        covariance = covariances(left.A, left.B1).stationary
        self.sizes = [np.sqrt(np.trace(u.C @ covariance @ u.C.T)) for u in self.uncertain]
        single = [(u, 1.0) for u in self.uncertain if u.B.shape[1] == len(u.C) == 1]
        self.single = single + [(c, c.lipschitz) for c in system.nonlinearities]
        rest = [_LITTLE_NOISE] * len(self.uncertain) + [0.0] * len(self.single)
        self.starts = [np.array([shift] * system.l + rest) for shift in _SHIFTS]
        self.untuned = np.where(self.starts[0] == _LITTLE_NOISE, -math.inf, 0.0)
        intensities = system.l + len(self.uncertain)
        self.box = np.array([_LOGARITHMS] * intensities + [(-1.0, 1.0)] * len(self.single))

    def __call__(self, point: np.ndarray) -> Estimator:
        plant, system = self.plant, self.plant.system
        factors, noises, slopes = np.split(point, np.cumsum([system.l, len(self.uncertain)]))
        model = designed = system.A, system.C2
        for (channel, size), slope in zip(self.single, slopes, strict=True):
            rows = size * slope * channel.C
            designed = with_feedback(*designed, channel, rows)
            if channel in self.uncertain:
                model = with_feedback(*model, channel, rows)
        levels = [np.exp(log / 2) * size for log, size in zip(noises, self.sizes, strict=True)]
        channels = list(zip(levels, self.uncertain, strict=True))
        measured = np.exp(factors / 2)[:, None] * system.D21
        nominal = UncertainSystem(
            A=designed[0],
            B1=np.hstack([system.B1, *(level * u.B for level, u in channels)]),
            C0=system.C0,
            C2=designed[1],
            D21=np.hstack([measured, *(level * u.D for level, u in channels)]),
        )
        run = replace(nominal, A=model[0], C2=model[1])
        return _with_gain(plant, run, nominal, copies=system.g > 0)
