r"""Stationary mean square errors of the nonlinear loop in lock, without sampling.

With :math:`z = (\varphi, \hat x)`, the arguments :math:`s_k z` of the two sines of
`robsmooth.homodyne.loop` and their slopes :math:`\rho_k` by statistical linearisation, the loop is

.. math::

    dz = \Bigl[Az + \sum_k b_k\bigl(\sin s_kz - \rho_k s_kz\bigr)\Bigr]dt + Q^{1/2}\,dW,
    \qquad AP + PA' + Q = 0 .

Let :math:`z = S\xi` with :math:`P = SS'`, so that the linear part leaves :math:`N(0, I)` invariant
(`robsmooth.homodyne.whitening`), with :math:`h_\alpha` the normalised Hermite polynomials of
:math:`\xi` and :math:`a_i = \partial/\partial\xi_i` (`robsmooth._numerics.hermite`). The backward
Kolmogorov operator of the loop is

.. math::

    L = \sum_{ij}\tilde A_{ij}\,a_j^*a_i
        + \sum_k\bigl(\sin s_kS\xi - \rho_k s_kS\xi\bigr)\,\tilde b_k\cdot a,
    \qquad \tilde A = S^{-1}AS,\quad \tilde b_k = S^{-1}b_k .

With the matrix of L between the polynomials of total degree up to N, the stationary moments
:math:`m_\alpha = E\,h_\alpha(\xi)` solve

.. math::

    \sum_\alpha m_\alpha L_{\alpha\beta} = 0 \quad (0 < |\beta| \le N), \qquad m_0 = 1,

and a linear read-out :math:`w = pz` of the state has the expectation :math:`e^{Lt}w` a time t
later. With :math:`d = \varphi - C_a\hat x` and :math:`L\varphi = -\lambda\varphi` the smoothed
error is, free of cancellation when the phase wanders far,

.. math::

    E\bigl(\varphi(t - \delta) - C_a\hat x(t)\bigr)^2 = 2(1 - e^{-\lambda\delta})\,E\varphi^2
        + E\,d^2 + 2E\bigl[\varphi\,(e^{L\delta} - 1)d\bigr].

All terms are odd, so that moments of odd degree vanish and read-outs stay odd. Degree 2 is
statistical linearisation.

The polynomials look at the lock point at zero alone. Where a loop slips, the series ceases to
converge: the error in lock has a meaning only to about the probability that the loop is about to
slip, of the order of :math:`e^{-2/\sigma^2}` for a scalar loop with error variance
:math:`\sigma^2`. In the paper's example that is the ninth digit.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import expm_multiply, splu

from robsmooth._numerics.hermite import HermiteBasis, multiplication_matrix
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import Table
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.homodyne.whitening import Sine, WhitenedLoop, whitened

TOLERANCE = 1e-8  # relative truncation error at which the degree is high enough
LARGEST_TRUNCATION = 0.02  # relative truncation error above which there is no result
LEAST_DEGREE = 4  # of two, statistical linearisation, the truncation error is unknown
STEPS_WITHOUT_GAIN = 3  # in degree, after which higher ones are not tried
GAIN_OF_A_STEP = 10.0  # by which a step in degree is believed to reduce the truncation error
DEFAULT_UNKNOWNS, MOST_UNKNOWNS = 2500, 6000  # at most: of the default degree, and at all
DECAYED = 30.0  # time constants of the loop's slowest mode after which e^{Lt} is zero
_LARGEST_RESIDUAL = 1e-10  # relative residual up to which the moments are solved for
_ZERO_ENTRY = 1e-16  # of a matrix, relative to its largest entry, below which it is zero


@dataclass(frozen=True)
class StationaryErrors:
    """Mean square errors of the nonlinear loop in lock, computed by `stationary_errors`.

    Attributes
    ----------
    smoothed, filtered : float
        Mean square errors, rad^2.
    smoothed_truncation, filtered_truncation : float
        Estimates of the error that the finite degree, and rounding, make in them, rad^2.
    degree, unknowns : int
        Total degree of the polynomials, and the moments that were solved for.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> rs.stationary_errors(rs.homodyne.PAPER, kalman, degree=8).unknowns
    24
    """

    smoothed: float
    filtered: float
    smoothed_truncation: float
    filtered_truncation: float
    degree: int
    unknowns: int

    def __repr__(self) -> str:
        return (
            f"StationaryErrors(smoothed {self.smoothed:.10g} +- {self.smoothed_truncation:.1g} "
            f"rad^2, filtered {self.filtered:.10g} +- {self.filtered_truncation:.1g} rad^2; "
            f"degree {self.degree}, {self.unknowns} unknowns)"
        )

    def _repr_html_(self) -> str:
        rows = [
            ("smoothed", f"{self.smoothed:.10g}", self.smoothed_truncation),
            ("filtered", f"{self.filtered:.10g}", self.filtered_truncation),
        ]
        columns = ("estimate", "mean square error (rad²)", "truncation (rad²)")
        size = f"polynomials of degree {self.degree}, {self.unknowns} unknowns"
        return Table(columns, rows, f"The loop in lock: {size}.", digits=1).html()


@one_thread
def stationary_errors(
    parameters: HomodyneParameters,
    smoother: Estimator,
    degree: int | None = None,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    nonlinearity: str = "difference",
    shot_noise: float = 1.0,
) -> StationaryErrors:
    r"""Return the stationary mean square errors of an estimator in the nonlinear loop.

    They are those of continuous time, and of a loop in lock. The truncation error is estimated by
    what the last step of two in the degree changed, or a tenth of the change before that.

    Parameters
    ----------
    parameters, smoother
        As in `monte_carlo`.
    degree : int, optional
        Total degree of the polynomials, even and at least 4. Default: the least with a truncation
        error below 1e-8 of both errors, or the best one with at most 2500 unknowns.
    oscillator, copy, nonlinearity, shot_noise
        As in `monte_carlo`.

    Returns
    -------
    StationaryErrors

    Raises
    ------
    TypeError, ValueError
        For an argument that is not as described, or more than 6000 unknowns, before any work.
    UnstableLoopError
        Where the loop is unstable, or by statistical linearisation not in lock.
    ArithmeticError
        Where the loop is so noisy that the expansion does not converge to 2%, or its rates are so
        far apart that the linear loop's covariance is lost in rounding.

    See Also
    --------
    monte_carlo, statistical_linearisation : by simulation, and a first approximation.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> errors = rs.stationary_errors(rs.homodyne.PAPER, kalman)
    >>> print(f"{errors.filtered:.6f} rad^2")
    0.088235 rad^2
    """
    if degree is not None:
        degree = validation.integer("degree", degree, low=LEAST_DEGREE)
        if degree % 2:
            raise ValueError(f"degree must be even, got {degree}")
    loop = homodyne_loop(parameters, smoother, oscillator, copy, nonlinearity, shot_noise)
    least = degree or LEAST_DEGREE
    unknowns = _unknowns(1 + loop.order, least)
    if unknowns > MOST_UNKNOWNS:
        raise ValueError(
            f"degree {least} and the {loop.order} states of smoother make {unknowns} unknowns, of "
            f"which at most {MOST_UNKNOWNS} are solved for"
        )
    problem = whitened(loop)
    if not problem.dimension:  # nothing drives the loop
        return StationaryErrors(0.0, 0.0, 0.0, 0.0, least, 0)
    if degree is None:
        result = _converged(problem)
    else:
        degrees = range(max(2, degree - 4), degree + 1, 2)
        result = _result(problem, [_errors(problem, N) for N in degrees], degree)
    relative = _relative_truncation(result)
    if not relative <= LARGEST_TRUNCATION:
        raise ArithmeticError(
            "the loop is so noisy that it slips: the expansion does not converge (relative "
            f"truncation error {relative:.2g} at degree {result.degree}); use monte_carlo instead"
        )
    return result


def _unknowns(dimension: int, degree: int) -> int:
    """Number of polynomials of even degree, the constant left out."""
    return sum(math.comb(k + dimension - 1, k) for k in range(2, degree + 1, 2))


def _converged(problem: WhitenedLoop) -> StationaryErrors:
    """Raise the degree until the truncation error is small, or no longer gets smaller."""
    errors, degree = [_errors(problem, 2)], 2
    best, since = None, 0
    while since < STEPS_WITHOUT_GAIN:
        degree += 2
        errors.append(_errors(problem, degree))
        result = _result(problem, errors, degree)
        since += 1
        if best is None or _relative_truncation(result) < _relative_truncation(best):
            best, since = result, 0
        too_large = _unknowns(problem.dimension, degree + 2) > DEFAULT_UNKNOWNS
        if too_large or _relative_truncation(best) <= TOLERANCE:
            break
    return best


def _result(problem: WhitenedLoop, errors: list[NDArray], degree: int) -> StationaryErrors:
    """Return the last errors, with the truncation estimated from the last two steps in degree."""
    with np.errstate(invalid="ignore"):  # infinite errors make a truncation that is none
        steps = np.abs(np.diff(errors[-3:], axis=0))
        steps[:-1] /= GAIN_OF_A_STEP
        truncation = steps.max(axis=0) + problem.rounding * errors[-1]
    unknowns = _unknowns(problem.dimension, degree)
    return StationaryErrors(*errors[-1].tolist(), *truncation.tolist(), degree, unknowns)


def _relative_truncation(result: StationaryErrors) -> float:
    """The larger of both, infinite where the degree had no solution."""
    errors = np.array([result.smoothed, result.filtered])
    truncation = np.array([result.smoothed_truncation, result.filtered_truncation])
    if not np.isfinite(truncation).all():
        return math.inf
    return float(max(np.divide(truncation, errors, out=np.zeros(2), where=truncation > 0)))


def _errors(problem: WhitenedLoop, degree: int) -> NDArray[np.float64]:
    """Mean square errors, smoothed and filtered, infinite where the moments are of no law."""
    basis = HermiteBasis(problem.dimension, degree)
    generator = _generator(problem, basis)
    try:
        moments = _stationary_moments(generator[basis.even][:, basis.even])
    except (RuntimeError, ArithmeticError):  # a singular matrix
        return np.full(2, np.inf)
    # E[xi_i h_alpha], first for the alpha of degree one: the covariance of xi
    products = np.array([moments @ x[basis.even][:, basis.odd] for x in basis.coordinates])
    covariance = products[:, : problem.dimension]
    with np.errstate(over="ignore", invalid="ignore"):
        change = _change(problem, generator[basis.odd][:, basis.odd])
        filtered = problem.filtered @ covariance @ problem.filtered
        smoothed = (
            -2 * math.expm1(-problem.phase_decay * problem.delay) * problem.phase_variance
            + problem.smoothed @ covariance @ problem.smoothed
            + 2 * problem.phase @ products @ change
        )
    errors = np.array([smoothed, filtered])
    valid = np.isfinite(errors).all() and (errors >= 0).all()
    if not valid or np.linalg.eigvalsh(covariance)[0] < 0:
        return np.full(2, np.inf)
    return errors


def _generator(problem: WhitenedLoop, basis: HermiteBasis) -> sparse.csr_array:
    """The matrix of L."""
    linear = basis.lowering.T @ sparse.kron(problem.drift.T, basis.identity) @ basis.lowering
    terms = (_remainder(sine, basis) @ basis.derivative(sine.gain) for sine in problem.sines)
    generator = sum(terms, start=linear).tocsr()
    size = np.abs(generator.data)
    generator.data[size < _ZERO_ENTRY * size.max()] = 0.0  # they would only fill the factors
    generator.eliminate_zeros()
    return generator


def _remainder(sine: Sine, basis: HermiteBasis) -> sparse.csr_array:
    """The matrix of multiplication with sin(v) - slope v, v = row . (xi_1, xi_2)."""
    sines = [multiplication_matrix(np.sin, factor, basis.degree) for factor in sine.row]
    cosines = [multiplication_matrix(np.cos, factor, basis.degree) for factor in sine.row]
    if len(sine.row) == 1 or not sine.row[1]:
        product = basis.multiplication(sines[:1])
    else:
        product = basis.multiplication([sines[0], cosines[1]])
        product = product + basis.multiplication([cosines[0], sines[1]])
    linear = sum(factor * x for factor, x in zip(sine.row, basis.coordinates, strict=False))
    return product - sine.slope * linear


def _stationary_moments(generator: sparse.csr_array) -> NDArray[np.float64]:
    """Solve m L = 0, m_0 = 1, over the polynomials of even degree."""
    matrix = generator[1:, 1:].T.tocsc()
    right = -generator[[0], 1:].toarray()[0]
    moments = splu(matrix).solve(right)
    residual = np.abs(matrix @ moments - right).max()
    if not residual <= _LARGEST_RESIDUAL * max(1.0, np.abs(moments).max()):
        raise ArithmeticError(f"the moments were solved for to {residual:.2g} only")
    return np.array([1.0, *moments])


def _change(problem: WhitenedLoop, generator: sparse.csr_array) -> NDArray[np.float64]:
    """(e^{L delay} - 1) (phi - C_a x_hat) in the polynomials of odd degree."""
    error = np.zeros(generator.shape[0])
    error[: problem.dimension] = problem.smoothed
    slowest = -np.linalg.eigvals(problem.drift).real.max()
    if slowest * problem.delay > DECAYED:
        return -error
    return expm_multiply(generator * problem.delay, error) - error
