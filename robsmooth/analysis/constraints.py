r"""The exact worst case of a given estimator under the paper's constraints.

How large can the error of a *given* estimator become? The constraints (eqIQC1) to (eqIQC4) speak of
mean energies of inputs :math:`\tilde\xi` that may depend on all that has happened. For multipliers
:math:`\theta \ge 0` and the stabilising solution of

.. math::

    \mathbf A'P + P\mathbf A + C'C + C_\zeta' N(\theta) C_\zeta +
    P B_\xi M(\theta)^{-1} B_\xi' P = 0, \qquad C = C_w - C_s,

Ito's formula for :math:`X'PX` gives :math:`E|e|^2 \le \operatorname{tr}\mathbf B'P\mathbf B` for
every admissible uncertainty. The right hand side is convex in :math:`\theta`. Its infimum is not
only a bound: inputs may be mixed by a coin tossed at the start, so that the mean energies that can
be reached form a convex set, and there is no duality gap. The worst input is the feedback
:math:`\tilde\xi = M^{-1}B_\xi'PX`, which spends energy where and when it does most harm, and whose
own energies are the gradient: at the minimum it meets the constraints.

A design's V is this bound with :math:`\theta = \tau\lambda` and more noise: :math:`2V =
\operatorname{tr} B_\xi M(\lambda)^{-1}B_\xi'P`, where :math:`M(\lambda)^{-1} \ge JJ'` and
:math:`B_\xi JJ'B_\xi' = \mathbf{BB}'`.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, solve_continuous_lyapunov
from scipy.optimize import minimize

from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import table_of_values
from robsmooth._support.validation import Matrix, frozen
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, guarantee, open_loop, which_loop
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.delay import pade_delay

_LEAST_START = 1e-6  # of the nominal error: what a multiplier is worth, at least, at the start
_LEAST_ENERGY = 1e-12  # of the largest that an output could have: one that no noise excites
_LARGEST_CHANGE = 14.0  # of a multiplier in one search, in natural logarithms
_INFEASIBLE = 1e2  # the objective, a logarithm, where the Riccati equation has no solution
_LEAST_DECREASE = 1e-10  # a search that lowers the bound by less, relatively, is the last
_CONTINUATION_ITERATIONS = 10  # of the search at a fraction of the uncertainty
_MULTIPLES = 4.0 ** np.arange(10)  # of theta: the more, the more the uncertainty counts
_SMALLEST_STEP = 1e-3  # in the fraction of the uncertainty


@dataclass(frozen=True, eq=False)
class AnalysisBound:
    """The least bound on an estimator's error, and what attains it: see `analysis_bound`.

    Attributes
    ----------
    mean_square : float
        Above the mean square error under every admissible uncertainty, in the squared unit of w;
        infinity where no multipliers give a bound.
    gap : float
        The share of `mean_square` that no admissible input was shown to reach, to first order.
    fraction : float
        The share of the uncertainty for which there is a bound: 0 for a loop unstable without it.
    guarantee : float or None, twice the bound V of the design, where that is for this error
    multipliers : (k + 3g,) array
        theta, s (unit of w)^2; infinity for a constraint that allows its input no energy.
    feedback : (r + 2g, N) array
        The worst input as a feedback of the states X. Both are empty where there is no bound.

    Examples
    --------
    >>> import robsmooth as rs
    >>> bound = rs.analysis_bound(rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system()))
    >>> bound.mean_square < bound.guarantee, bound.gap < 1e-6  # an admissible input reaches it
    (True, True)
    """

    mean_square: float
    gap: float
    fraction: float
    guarantee: float | None
    multipliers: NDArray[np.float64]
    feedback: Matrix

    def __repr__(self) -> str:
        given = "none" if self.guarantee is None else f"{self.guarantee:.5g}"
        return (
            f"AnalysisBound(mean_square={self.mean_square:.5g}, gap={self.gap:.1g}, "
            f"fraction={self.fraction:.3g}, guarantee={given})"
        )

    def _repr_html_(self) -> str:
        rows = [
            ("largest mean square error, (unit of $w$)²", self.mean_square),
            ("share of it that no input was shown to reach", self.gap),
            ("share of the uncertainty for which there is a bound", self.fraction),
            ("guarantee, $2V$", self.guarantee),
            (r"multipliers $\theta$, s (unit of $w$)²", f"${notation.vector(self.multipliers)}$"),
        ]
        caption = "The worst that the constraints on the uncertainty allow."
        return table_of_values(rows, caption, digits=5).html()


@one_thread
def analysis_bound(
    smoother: Estimator,
    output: str = "guaranteed",
    loop: str = "theory",
    *,
    copy_noise: bool | None = None,
    delay_order: int = 10,
) -> AnalysisBound:
    """Return the largest error that the constraints on the uncertainty allow an estimator.

    Parameters
    ----------
    smoother, output, loop, copy_noise
        As in `error_covariance`.
    delay_order : int
        Pade order of the delay of w where `output` is "smoothed": the true delay has no finite
        state. The result is for that model, whose states follow those of the loop.

    Returns
    -------
    AnalysisBound

    See Also
    --------
    worst_case, minimize_bound : the worst constant uncertainty; the paper's own bound.

    References
    ----------
    I. R. Petersen, V. A. Ugrinovskii and A. V. Savkin, *Robust Control Design Using H-infinity
    Methods*, Springer, 2000, on the S-procedure for stochastic uncertainty constraints.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.analysis_bound(ngcf, "filtered", loop="real").mean_square, 4)
    0.1388
    """
    opened = open_loop(smoother, output, which_loop(loop, copy_noise))
    delay_order = validation.integer("delay_order", delay_order, low=1)
    if opened.delay > 0.0:
        opened = _with_delay_model(opened, delay_order)
    problem = _Problem(opened, smoother.plant)
    fraction, theta = _continuation(problem)
    proven = guarantee(smoother, output)
    if fraction < 1.0:
        return AnalysisBound(math.inf, math.nan, fraction, proven, np.empty(0), np.empty((0, 0)))
    before = math.inf  # the search starts anew until it gains nothing
    while (point := problem.at(theta)).bound < (1.0 - _LEAST_DECREASE) * before:
        before, theta = point.bound, _quasi_newton(problem, theta)
    multipliers = np.full(len(smoother.plant.M_i), math.inf)
    multipliers[problem.active] = theta
    # what the worst input leaves of its constraints, weighted by their multipliers
    gap = float(theta @ np.maximum(point.slack, 0.0)) / point.bound
    feedback = frozen(problem.free @ point.feedback)
    return AnalysisBound(point.bound, gap, 1.0, proven, frozen(multipliers), feedback)


def _with_delay_model(loop: OpenLoop, order: int) -> OpenLoop:
    """Return the loop with its delay of the truth as a Pade model, in states of its own."""
    model = pade_delay(loop.delay, order, len(loop.truth))
    below, beside = ((0, len(model.F)), (0, 0)), ((0, 0), (0, len(model.F)))
    return replace(
        loop,
        A=np.vstack([np.pad(loop.A, beside), np.hstack([model.G @ loop.truth, model.F])]),
        B=np.pad(loop.B, below),
        inputs=np.pad(loop.inputs, below),
        outputs=np.pad(loop.outputs, beside),
        truth=np.hstack([model.J @ loop.truth, model.H]),
        estimate=np.pad(loop.estimate, beside),
        delay=0.0,
    )


class _Point(NamedTuple):
    """The bound at one theta, its gradient, and the input that is worst there."""

    bound: float
    slack: np.ndarray  # the gradient: how much less energy than allowed that input has
    feedback: Matrix


class _Problem:
    """The convex problem: the loop, with the inputs and constraints that are not void.

    A constraint whose right hand side is zero forbids its input: `free` spans the inputs that are
    left, and M (between these) and N (between states) are those of the `active` constraints.
    """

    def __init__(self, loop: OpenLoop, plant: AugmentedSystem):
        constraints, inputs = len(plant.M_i), loop.inputs.shape[1]
        M = np.reshape(plant.M_i, (constraints, inputs, inputs))
        N = [loop.outputs.T @ N_i @ loop.outputs for N_i in plant.N_i]
        N = np.reshape(N, (constraints, *loop.A.shape))
        self.A, self.B, self.C = loop.A, loop.B, loop.truth - loop.estimate
        self.active = N.any(axis=(1, 2))
        self.free = null_space(M[~self.active].sum(axis=0))
        self.inputs = loop.inputs @ self.free
        self.M, self.N = self.free.T @ M[self.active] @ self.free, N[self.active]

    def at(self, theta: np.ndarray, fraction: float = 1.0) -> _Point:
        """Evaluate the bound with the outputs scaled; a RiccatiError says that there is none."""
        weighted = np.tensordot(theta, self.N, axes=1)
        gain = fraction * np.linalg.solve(np.tensordot(theta, self.M, axes=1), self.inputs.T)
        P = solve_riccati(self.A, self.C.T @ self.C + fraction * weighted, -self.inputs @ gain).X
        feedback = gain @ P
        covariance = solve_continuous_lyapunov(self.A + self.inputs @ feedback, -self.B @ self.B.T)
        allowed = fraction * np.tensordot(self.N, covariance, axes=2)
        used = np.tensordot(self.M, feedback @ covariance @ feedback.T, axes=2) / fraction
        return _Point(float(np.trace(self.B.T @ P @ self.B)), allowed - used, feedback)

    def initial_multipliers(self) -> np.ndarray:
        """Return the best theta for a vanishing uncertainty, each constraint by itself."""
        P = solve_continuous_lyapunov(self.A.T, -self.C.T @ self.C)
        covariance = solve_continuous_lyapunov(self.A, -self.B @ self.B.T)
        largest = np.trace(self.N, axis1=1, axis2=2) * np.trace(covariance)
        allowed = np.maximum(np.tensordot(self.N, covariance, axes=2), _LEAST_ENERGY * largest)
        sensitivity = self.inputs.T @ P
        used = np.tensordot(self.M, sensitivity @ covariance @ sensitivity.T, axes=2)
        nominal = np.tensordot(self.C.T @ self.C, covariance, axes=2)
        return np.sqrt(np.maximum(used, 0.0) / allowed) + _LEAST_START * nominal / allowed


def _continuation(problem: _Problem) -> tuple[float, np.ndarray]:
    """Return the largest fraction of the uncertainty that has a bound, at most 1, and its theta.

    A good theta for some of the uncertainty, or a multiple of it, gives a bound for a little more.
    """
    if not np.linalg.eigvals(problem.A).real.max() < 0.0:
        return 0.0, np.empty(0)
    theta, fraction, step = problem.initial_multipliers(), 0.0, 1.0
    while fraction < 1.0 and step > _SMALLEST_STEP:
        trial = min(1.0, fraction + step)
        feasible = _feasible_multiple(problem, theta, trial)
        if feasible is None:
            step /= 2.0
        else:
            theta = _quasi_newton(problem, feasible, trial, iterations=_CONTINUATION_ITERATIONS)
            fraction = trial
    return fraction, theta


def _feasible_multiple(problem: _Problem, theta: np.ndarray, fraction: float) -> np.ndarray | None:
    """Return the smallest of some multiples of theta that give a bound, or None."""
    for multiple in _MULTIPLES:
        with suppress(RiccatiError):
            problem.at(multiple * theta, fraction)
            return multiple * theta
    return None


def _quasi_newton(
    problem: _Problem, theta: np.ndarray, fraction: float = 1.0, iterations: int = 200
) -> np.ndarray:
    """Return a theta with a lower bound, by a quasi-Newton search over its logarithm."""
    if not theta.size:
        return theta

    def objective(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        trial = np.exp(logarithms)
        try:
            point = problem.at(trial, fraction)
        except RiccatiError:
            return _INFEASIBLE, np.zeros_like(trial)
        return math.log(point.bound), point.slack * trial / point.bound

    start = np.log(theta)
    bounds = np.array([start - _LARGEST_CHANGE, start + _LARGEST_CHANGE]).T
    options = {"maxiter": iterations, "ftol": 1e-15, "gtol": 1e-11}
    result = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.exp(result.x) if result.fun <= objective(start)[0] else theta
