"""Stationary mean square errors of the nonlinear loop in lock, without sampling.

Moments of Hermite polynomials up to the degree N solve linear equations, of the backward Kolmogorov
operator L of the loop (`docs/source/simulation.md`). All terms are odd: odd moments are zero, and
read-outs stay odd. The error in lock is defined to about the probability of a slip.
"""

import math
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy import sparse
from scipy.linalg import qr, solve_triangular
from scipy.sparse.linalg import expm_multiply, splu

from robsmooth._numerics.hermite import HermiteBasis, multiplication_matrix
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import Loop, homodyne_loop
from robsmooth.homodyne.parameters import HomodyneParameters

TOLERANCE = 1e-8  # of the relative truncation error: the degree is high enough
LARGEST_TRUNCATION = 0.02  # of a result, relative
LEAST_DEGREE = 4  # degree 2, statistical linearisation, has no estimate of its truncation error
STEPS_WITHOUT_GAIN = 3  # in degree, then no higher ones are tried
GAIN_OF_A_STEP = 10.0  # assumed factor between the truncation errors of two degrees
DEFAULT_UNKNOWNS, MOST_UNKNOWNS = 2500, 6000  # for degrees above the least, and for that
DECAYED = 30.0  # time constants of the loop's slowest mode, then e^{Lt} is zero
_LARGEST_RESIDUAL = 1e-10  # of the moments, relative
LARGEST_DEVIATION = math.pi / 2  # standard deviation of a sine's argument in lock, rad
_NEGLIGIBLE_REMAINDER = 1e-15  # effect of sin(v) - v on the state in a time constant
_LARGEST_ROUNDING = 1e-4  # of the covariance in white coordinates
_NEGLIGIBLE_DEVIATION = 1e-10  # of a direction without noise, relative


@dataclass(frozen=True)
class StationaryErrors(Frozen):
    """Mean square errors of the nonlinear loop in lock, computed by `stationary_errors`.

    Attributes
    ----------
    smoothed, filtered : float, mean square errors, rad^2
    smoothed_truncation, filtered_truncation : float, estimates of their numerical errors, rad^2
    degree : int, total, of the polynomials
    """

    smoothed: float
    filtered: float
    smoothed_truncation: float
    filtered_truncation: float
    degree: int

    @property
    def _relative_truncation(self) -> float:
        """The larger of the two, infinite if the degree had no solution."""
        both = self.smoothed_truncation / self.smoothed, self.filtered_truncation / self.filtered
        return math.inf if math.isnan(max(both)) else max(both)

    def __repr__(self) -> str:
        smoothed = f"smoothed {self.smoothed:.10g} +- {self.smoothed_truncation:.1g} rad^2"
        filtered = f"filtered {self.filtered:.10g} +- {self.filtered_truncation:.1g} rad^2"
        return f"StationaryErrors({smoothed}, {filtered}; degree {self.degree})"


@dataclass(frozen=True, eq=False)
class WhitenedLoop:
    """The loop in the coordinates xi, with its fastest time constant as the unit of time."""

    drift: Matrix
    sines: list[tuple[Matrix, float, Matrix]]  # v = row . (xi_1, xi_2), slope, gain (n,)
    phase: Matrix  # rows of phase and errors
    filtered: Matrix  # phi - C_f x_hat
    smoothed: Matrix  # phi - C_a x_hat
    phase_change: float  # its mean square over the delay, rad^2
    delay: float
    rounding: float  # relative error of the covariance


@one_thread
def stationary_errors(
    parameters: HomodyneParameters,
    smoother: Estimator,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    shot_noise: float = 1.0,
) -> StationaryErrors:
    r"""Return the stationary mean square errors of an estimator in the nonlinear loop in lock.

    The truncation error is the change in the last step of two in degree, or a tenth of the change
    before that. The degree is the least with a truncation error below 1e-8 of both errors, or the
    best one with at most 2500 unknowns.

    Parameters
    ----------
    parameters, smoother, oscillator, copy, shot_noise : as in `monte_carlo`

    Raises
    ------
    ValueError
        Where there are more than 6000 unknowns.
    UnstableLoopError
        Where the loop is unstable, or by statistical linearisation not in lock.
    ArithmeticError
        Where noise keeps the expansion from converging to 2%, or rates so far apart that rounding
        spoils the linear loop's covariance.

    Examples
    --------
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.stationary_errors(rs.homodyne.PAPER, kalman).filtered, 6)
    0.088235
    """
    loop = homodyne_loop(parameters, smoother, oscillator, copy, shot_noise)
    states = len(loop.drift)
    unknowns = _unknowns(states, LEAST_DEGREE)
    if unknowns > MOST_UNKNOWNS:
        made = f"the {states - 1} states of smoother make {unknowns} unknowns at the least degree"
        raise ValueError(f"{made}; at most {MOST_UNKNOWNS} are allowed")
    result = _converged(whitened(loop))
    relative = result._relative_truncation
    if not relative <= LARGEST_TRUNCATION:
        what = "the loop is so noisy that it slips: the expansion does not converge"
        error = f"relative truncation error {relative:.2g} at degree {result.degree}"
        raise ArithmeticError(f"{what} ({error}); use monte_carlo instead")
    return result


def _unknowns(dimension: int, degree: int) -> int:
    """Number of polynomials of even degree above zero."""
    return sum(math.comb(k + dimension - 1, k) for k in range(2, degree + 1, 2))


def _converged(problem: WhitenedLoop) -> StationaryErrors:
    """Raise the degree until the truncation error is small or stops to decrease."""
    errors, results = [_errors(problem, 2)], []
    for degree in count(LEAST_DEGREE, 2):
        errors.append(_errors(problem, degree))
        results.append(_result(problem, errors, degree))
        best = min(results, key=lambda result: result._relative_truncation)
        gains_nothing = degree >= best.degree + 2 * STEPS_WITHOUT_GAIN
        too_large = _unknowns(len(problem.drift), degree + 2) > DEFAULT_UNKNOWNS
        if gains_nothing or too_large or best._relative_truncation <= TOLERANCE:
            return best


def _result(problem: WhitenedLoop, errors: list[Matrix], degree: int) -> StationaryErrors:
    """Return the last errors, with the truncation estimated from the last two steps in degree."""
    with np.errstate(invalid="ignore"):  # infinite errors have the truncation nan
        steps = np.abs(np.diff(errors[-3:], axis=0))
        steps[:-1] /= GAIN_OF_A_STEP
        truncation = steps.max(axis=0) + problem.rounding * errors[-1]
    return StationaryErrors(*errors[-1].tolist(), *truncation.tolist(), degree)


def _errors(problem: WhitenedLoop, degree: int) -> Matrix:
    """Mean square errors, smoothed and filtered; infinite if no law has these moments."""
    basis = HermiteBasis(len(problem.drift), degree)
    generator = _generator(problem, basis)
    try:
        moments = _stationary_moments(generator[basis.even][:, basis.even])
    except (RuntimeError, ArithmeticError):  # a singular matrix
        return np.full(2, np.inf)
    # E[xi_i h_alpha]; the alpha of degree one, which are first, give the covariance of xi
    products = np.array([moments @ x[basis.even][:, basis.odd] for x in basis.coordinates])
    covariance = products[:, : len(problem.drift)]
    with np.errstate(over="ignore", invalid="ignore"):
        change = _change(problem, generator[basis.odd][:, basis.odd])
        filtered = problem.filtered @ covariance @ problem.filtered
        smoothed = problem.phase_change + problem.smoothed @ covariance @ problem.smoothed
        smoothed += 2 * problem.phase @ products @ change
    errors = np.array([smoothed, filtered])
    positive = ((errors >= 0) & (errors < np.inf)).all()
    valid = positive and np.linalg.eigvalsh(covariance)[0] >= 0
    return errors if valid else np.full(2, np.inf)


def _generator(problem: WhitenedLoop, basis: HermiteBasis) -> sparse.csr_array:
    """The matrix of L."""
    columns = zip(basis.lowering, problem.drift.T, strict=True)
    terms = [a.T @ basis.derivative(column) for a, column in columns]
    for row, slope, gain in problem.sines:
        terms.append(_remainder(row, slope, basis) @ basis.derivative(gain))
    return sum(terms).tocsr()


def _remainder(row: Matrix, slope: float, basis: HermiteBasis) -> sparse.csr_array:
    """The matrix of multiplication with sin(v) - slope v, v = row . (xi_1, xi_2)."""
    product = -slope * sum(factor * x for factor, x in zip(row, basis.coordinates, strict=False))
    row = row[: 1 + row[1:].any()]
    for functions in ((np.sin, np.cos), (np.cos, np.sin))[: len(row)]:
        pairs = zip(functions, row, strict=False)
        factors = [multiplication_matrix(f, factor, basis.degree) for f, factor in pairs]
        product = product + basis.multiplication(factors)
    return product


def _stationary_moments(generator: sparse.csr_array) -> Matrix:
    """Solve m L = 0, m_0 = 1, over the polynomials of even degree."""
    matrix = generator[1:, 1:].T.tocsc()
    right = -generator[[0], 1:].toarray()[0]
    moments = splu(matrix).solve(right)
    residual = np.abs(matrix @ moments - right).max()
    if not residual <= _LARGEST_RESIDUAL * max(1.0, np.abs(moments).max()):
        raise ArithmeticError(f"the moments were solved for to {residual:.2g} only")
    return np.array([1.0, *moments])


def _change(problem: WhitenedLoop, generator: sparse.csr_array) -> Matrix:
    """(e^{L delay} - 1) (phi - C_a x_hat) in the polynomials of odd degree."""
    error = np.pad(problem.smoothed, (0, generator.shape[0] - len(problem.drift)))
    slowest = -np.linalg.eigvals(problem.drift).real.max()
    if slowest * problem.delay > DECAYED:
        return -error
    return expm_multiply(generator * problem.delay, error) - error


def whitened(loop: Loop) -> WhitenedLoop:
    """Return the loop in white coordinates; raise UnstableLoopError if it is not in lock."""
    rate = np.abs(np.linalg.eigvals(loop.linearised_drift())).max()
    slopes = np.array(loop.equivalent_slopes())
    S, inverse, rounding = _white_coordinates(loop, slopes)
    rows = loop.arguments @ S
    deviations = np.linalg.norm(rows, axis=1)
    # Far out of lock there are slopes again: the noise averages the sine to zero.
    largest = deviations[loop.arguments[:, 1:].any(axis=1)].max(initial=0.0)
    if largest > LARGEST_DEVIATION:
        what = "by statistical linearisation the argument of its sine has the standard deviation"
        got = f"{largest:.3g} rad, which must be at most pi/2"
        raise UnstableLoopError(f"the loop is not in lock: {what} {got}")
    # The arguments of the sines that matter span the first coordinates.
    gains = inverse @ loop.gains / rate
    active = deviations**3 * np.linalg.norm(gains, axis=0) > _NEGLIGIBLE_REMAINDER
    rotation, arguments = np.linalg.qr(rows[active].T, mode="complete")
    S, inverse = S @ rotation, rotation.T @ inverse
    phase_variance = -(loop.noise[0, 0] ** 2) / (2 * loop.drift[0, 0])
    sines = zip(arguments.T[:, :2], slopes[active], gains.T[active] @ rotation, strict=True)
    return WhitenedLoop(
        drift=inverse @ (loop.linearised_drift(*slopes) / rate) @ S,
        sines=list(sines),
        phase=S[0],
        filtered=S[0] - loop.readout[0] @ S[1:],
        smoothed=S[0] - loop.readout[1] @ S[1:],
        phase_change=-2 * math.expm1(loop.drift[0, 0] * loop.delay) * phase_variance,
        delay=loop.delay * rate,
        rounding=rounding,
    )


def _white_coordinates(loop: Loop, slopes: Matrix) -> tuple[Matrix, Matrix, float]:
    """Return S with P = S S', a left inverse, and the distance from I of the covariance of xi."""
    # A direction without noise has no coordinate. A triangular factor does not mix different rates.
    from_error, to_error = loop.error_coordinates()
    root = loop.stationary_root(slopes, from_error, to_error)
    deviations = np.linalg.norm(root, axis=1)
    deviations[deviations == 0.0] = 1.0
    triangle, order = qr((root / deviations[:, None]).T, mode="r", pivoting=True)
    rank = np.count_nonzero(np.abs(triangle.diagonal()) > _NEGLIGIBLE_DEVIATION)
    scaled = np.empty((len(root), rank))
    scaled[order] = triangle[:rank].T
    S = from_error * deviations @ scaled
    moving = (to_error / deviations[:, None])[order[:rank]]
    inverse = solve_triangular(triangle[:rank, :rank].T, moving, lower=True)
    white = loop.stationary_root(slopes, S, inverse)
    rounding = np.abs(white @ white.T - np.eye(rank)).max(initial=0.0)
    if rounding > _LARGEST_ROUNDING:
        why = "its rates, or the scales of the estimator's states, are too far apart"
        raise ArithmeticError(f"the covariance of the linearised loop is lost in rounding: {why}")
    return S, inverse, rounding
