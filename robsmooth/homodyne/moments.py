r"""Stationary mean square errors of the nonlinear loop in lock, without sampling.

With :math:`z = (\varphi, \hat x)`, the arguments :math:`s_k z` of the loop's two sines (the
detector's and the copy's, `robsmooth.homodyne.loop`) and their slopes :math:`\rho_k` by statistical
linearisation, the loop is

.. math::

    dz = \Bigl[Az + \sum_k b_k\bigl(\sin s_kz - \rho_k s_kz\bigr)\Bigr]dt + Q^{1/2}\,dW,
    \qquad AP + PA' + Q = 0 .

Let :math:`z = S\xi` with :math:`P = SS'`, so that the linear part leaves :math:`N(0, I)` invariant,
:math:`h_\alpha` the normalised Hermite polynomials of :math:`\xi`, :math:`a_i = \partial/\partial
\xi_i` and :math:`a_i^*` its adjoint: :math:`a_ih_\alpha = \sqrt{\alpha_i}\,h_{\alpha - e_i}` and
:math:`\xi_i = a_i + a_i^*`. The backward Kolmogorov operator of the loop is

.. math::

    L = \sum_{ij}\tilde A_{ij}\,a_j^*a_i
        + \sum_k\bigl(\sin s_kS\xi - \rho_k s_kS\xi\bigr)\,\tilde b_k\cdot a,
    \qquad \tilde A = S^{-1}AS,\quad \tilde b_k = S^{-1}b_k .

Its first part keeps the degree of a polynomial; the second is small where the loop is in lock. With
the matrix of L between the polynomials of total degree up to N, the stationary moments
:math:`m_\alpha = E\,h_\alpha(\xi)` solve

.. math::

    \sum_\alpha m_\alpha L_{\alpha\beta} = 0 \quad (0 < |\beta| \le N), \qquad m_0 = 1,

and a linear read-out :math:`w = pz` of the state has the expectation :math:`e^{Lt}w` a time t
later. With :math:`d = \varphi - C_a\hat x` and :math:`L\varphi = -\lambda\varphi` the smoothed
error is free of the cancellation of :math:`E\varphi^2 = \kappa/2\lambda` when the phase wanders
far,

.. math::

    E\bigl(\varphi(t - \delta) - C_a\hat x(t)\bigr)^2 = 2(1 - e^{-\lambda\delta})\,E\varphi^2
        + E\,d^2 + 2E\bigl[\varphi\,(e^{L\delta} - 1)d\bigr].

All terms are odd, so that moments of odd degree vanish and read-outs stay odd. Degree 2 is
statistical linearisation.

The polynomials look at one lobe of the stationary law, that of the lock point at zero. A loop that
slips by whole turns has more, which they see, if at all, as a series that ceases to converge: the
mean square error in lock has a meaning only to about the probability that the loop is about to
slip, of the order of :math:`e^{-2/\sigma^2}` for a scalar loop with error variance
:math:`\sigma^2`. In the paper's example that is the ninth digit.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh_tridiagonal, matrix_balance, qr, solve_triangular
from scipy.sparse.linalg import expm_multiply, splu
from scipy.special import comb

from robsmooth._numerics import linearisation
from robsmooth._numerics.lyapunov import stationary_root
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.tables import Table
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import Loop, check_stationary, homodyne_loop
from robsmooth.homodyne.parameters import HomodyneParameters

TOLERANCE = 1e-8  # relative truncation error at which the degree is high enough
USELESS = 0.02  # relative truncation error above which there is no result
LEAST_DEGREE = 4  # of two, statistical linearisation, the truncation error is unknown
PATIENCE = 3  # degrees without a gain after which higher ones are not tried
TRUSTED_GAIN = 10.0  # by which a step in degree is believed to reduce the truncation error
AFFORDABLE, LARGEST = 2500, 6000  # unknowns: of the default degree, and at all
FARTHEST = math.pi / 2  # standard deviation of the argument of a sine in lock, rad
FORGOTTEN = 30.0  # time constants of the loop's slowest mode after which e^{Lt} is zero
_NEGLIGIBLE = 1e-15  # of what sin(v) - v does to the state in the loop's fastest time constant
_SELF_CONSISTENT = 1e-9  # of the slopes
_UNRELIABLE = 1e-4  # of the covariance in white coordinates
_ILL_CONDITIONED = (
    "the covariance of the linearised loop is lost in rounding: its rates, or the scales of the "
    "estimator's states, are too far apart"
)
_DEGENERATE = 1e-10  # of a standard deviation, relative: the direction does not move
_RESIDUAL_TOLERANCE = 1e-10
_ROUNDING = 1e-16  # of the entries of a matrix, relative to the largest


@dataclass(frozen=True)
class StationaryErrors:
    """Mean square errors of the nonlinear loop in lock, computed by `stationary_errors`.

    Attributes
    ----------
    smoothed, filtered : float
        Mean square errors, rad^2.
    smoothed_truncation, filtered_truncation : float
        Estimates of the error that the finite degree, and rounding, make in them, rad^2.
    degree : int
        Total degree of the polynomials.
    unknowns : int
        Moments that were solved for.
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
        caption = (
            f"The loop in lock: polynomials of degree {self.degree}, {self.unknowns} unknowns."
        )
        return Table(columns, rows, caption, digits=1).html()


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

    They are those of continuous time, and of a loop in lock: see the module's docstring. The
    truncation error of a degree is estimated by what the last step of two in the degree changed, or
    a tenth of what the step before it changed if that is more.

    Parameters
    ----------
    parameters : HomodyneParameters
        The optical loop; any object with the numbers ``lam``, ``kappa``, ``alpha``, ``beta`` and
        ``gamma`` will do.
    smoother : RobustSmoother
        The estimator; any object that `monte_carlo` simulates will do.
    degree : int, optional
        Total degree of the polynomials, even and at least 4. Default: the least with a truncation
        error below 1e-8 of both errors, or the best one with at most 2500 unknowns.
    oscillator : {"filtered", "smoothed"}
        The estimate that the local oscillator's phase follows.
    copy : bool
        Whether the estimator runs its copy of the nonlinearity; without, its input is zero.
    nonlinearity : {"difference", "literal"}
        As in `monte_carlo`.
    shot_noise : float
        Power of the photocurrent's noise, :math:`s` in :math:`\sqrt s\,dW`.

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
        Where the loop is so noisy that the expansion does not converge to 2%, or its
        numbers are so far apart in scale that the linear loop's covariance is lost in rounding.
    """
    if degree is not None:
        degree = validation.integer("degree", degree, low=LEAST_DEGREE)
        if degree % 2:
            raise ValueError(f"degree must be even, got {degree}")
    loop = homodyne_loop(
        parameters,
        smoother,
        oscillator=oscillator,
        copy=copy,
        nonlinearity=nonlinearity,
        shot_noise=shot_noise,
    )
    least = degree or LEAST_DEGREE
    unknowns = _unknowns(1 + loop.order, least)
    if unknowns > LARGEST:
        raise ValueError(
            f"degree {least} and the {loop.order} states of smoother make {unknowns} unknowns, of "
            f"which at most {LARGEST} are solved for"
        )
    problem = _whitened(loop)
    if not problem.dimension:  # nothing drives the loop
        return StationaryErrors(0.0, 0.0, 0.0, 0.0, least, 0)
    result = _converged(problem) if degree is None else _at_degree(problem, degree)
    relative = _relative_truncation(result)
    if not relative <= USELESS:
        raise ArithmeticError(
            "the loop is so noisy that it slips: the expansion does not converge (relative "
            f"truncation error {relative:.2g} at degree {result.degree}); use monte_carlo instead"
        )
    return result


# --- the degree -----------------------------------------------------------------------------------


def _unknowns(dimension: int, degree: int) -> int:
    """Number of polynomials of even degree, the constant left out."""
    return sum(math.comb(k + dimension - 1, k) for k in range(2, degree + 1, 2))


def _at_degree(problem: "_Whitened", degree: int) -> StationaryErrors:
    """Solve at the degree, and at the two even ones below it for its truncation."""
    degrees = range(max(2, degree - 4), degree + 1, 2)
    return _result(problem, [_errors(problem, N) for N in degrees], degree)


def _converged(problem: "_Whitened") -> StationaryErrors:
    """Raise the degree until the truncation error is small, or no longer gets smaller."""
    errors, degree = [_errors(problem, 2)], 2
    best, since = None, 0
    while since < PATIENCE:
        degree += 2
        errors.append(_errors(problem, degree))
        result = _result(problem, errors, degree)
        if best is None or _relative_truncation(result) < _relative_truncation(best):
            best, since = result, 0
        else:
            since += 1
        if _relative_truncation(best) <= TOLERANCE:
            break
        if _unknowns(problem.dimension, degree + 2) > AFFORDABLE:
            break
    return best


def _result(problem: "_Whitened", errors: list[NDArray], degree: int) -> StationaryErrors:
    """Return the last errors, with the truncation estimated from the last two steps in degree."""
    with np.errstate(invalid="ignore"):  # infinite errors make a truncation that is none
        steps = np.abs(np.diff(errors[-3:], axis=0))
        steps[:-1] /= TRUSTED_GAIN
        truncation = steps.max(axis=0) + problem.rounding * errors[-1]
    return StationaryErrors(
        smoothed=float(errors[-1][0]),
        filtered=float(errors[-1][1]),
        smoothed_truncation=float(truncation[0]),
        filtered_truncation=float(truncation[1]),
        degree=degree,
        unknowns=_unknowns(problem.dimension, degree),
    )


def _relative_truncation(result: StationaryErrors) -> float:
    """The larger of both, infinite where the degree had no solution."""
    errors = np.array([result.smoothed, result.filtered])
    truncation = np.array([result.smoothed_truncation, result.filtered_truncation])
    if not np.isfinite(truncation).all():
        return math.inf
    return float(max(np.divide(truncation, errors, out=np.zeros(2), where=truncation > 0)))


# --- the loop in white coordinates ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sine:
    """One sine of the loop: its argument is row . (xi_1, xi_2), linear, its slope is slope."""

    row: NDArray[np.float64]
    gain: NDArray[np.float64]
    slope: float


@dataclass(frozen=True, eq=False)
class _Whitened:
    """The loop in the coordinates xi, in which N(0, I) is stationary for its linear part.

    Time is in units of the loop's fastest time constant. The rows read the phase and the errors
    phi - C_f x_hat and phi - C_a x_hat out of xi. The relative error of the covariance is rounding.
    """

    drift: NDArray[np.float64]
    sines: tuple[_Sine, ...]
    phase: NDArray[np.float64]
    filtered: NDArray[np.float64]
    smoothed: NDArray[np.float64]
    phase_decay: float
    phase_variance: float
    delay: float
    rounding: float

    @property
    def dimension(self) -> int:
        return len(self.drift)


def _whitened(loop: Loop) -> _Whitened:
    drift = loop.linearised_drift()
    rate = np.abs(np.linalg.eigvals(drift)).max()
    slopes, S, inverse, rounding = _white_coordinates(loop, rate)

    # The arguments of the sines that are not linear all the same span the first coordinates.
    rows = loop.arguments() @ S
    gains = inverse @ loop.gains() / rate
    remainders = np.linalg.norm(rows, axis=1) ** 3 * np.linalg.norm(gains, axis=0)
    active = remainders > _NEGLIGIBLE
    rotation, arguments = np.linalg.qr(rows[active].T, mode="complete")
    S, inverse = S @ rotation, rotation.T @ inverse
    sines = zip(arguments.T, gains.T[active] @ rotation, slopes[active], strict=True)
    return _Whitened(
        drift=inverse @ (loop.linearised_drift(*slopes) / rate) @ S,
        sines=tuple(_Sine(row[:2], gain, slope) for row, gain, slope in sines),
        phase=S[0],
        filtered=S[0] - loop.filtered @ S[1:],
        smoothed=S[0] - loop.smoothed @ S[1:],
        phase_decay=loop.phase_decay / rate,
        phase_variance=loop.phase_diffusion**2 / (2 * loop.phase_decay),
        delay=loop.delay * rate,
        rounding=rounding,
    )


def _white_coordinates(loop: Loop, rate: float) -> tuple[NDArray, NDArray, NDArray, float]:
    """Return the slopes of statistical linearisation, S with P = S S', a left inverse and rounding.

    Each pass solves for the covariance in the coordinates that were white in the one before: there
    it is well conditioned, whatever the coordinates of the state. What differs from I in the end is
    rounding.
    """
    rows = loop.arguments()
    S, inverse = _balanced_coordinates(loop)

    def variances(slopes: NDArray) -> NDArray:
        nonlocal S, inverse
        S, inverse, _ = _whiter(loop, slopes, rate, S, inverse)
        return ((rows @ S) ** 2).sum(axis=1)

    slopes = linearisation.equivalent_slopes(
        np.ones(2), variances, linearisation.of_sine, tolerance=_SELF_CONSISTENT
    )
    for _ in range(2):
        S, inverse, rounding = _whiter(loop, slopes, rate, S, inverse)
    if rounding > _UNRELIABLE:
        raise ArithmeticError(_ILL_CONDITIONED)
    # Far out of lock there is a fixed point again, because the noise averages the sine to nothing.
    deviation = np.linalg.norm((rows @ S)[rows[:, 1:].any(axis=1)], axis=1).max(initial=0.0)
    if deviation > FARTHEST:
        raise UnstableLoopError(
            "the loop is not in lock: by statistical linearisation the argument of its sine has a "
            f"standard deviation of {deviation:.3g} rad"
        )
    return slopes, S, inverse, rounding


def _balanced_coordinates(loop: Loop) -> tuple[NDArray, NDArray]:
    """Return coordinates S to start from, and their inverse: scaled, and with e for the phase.

    The phase itself may wander far, and the estimate with it.
    """
    S, inverse = np.eye(1 + loop.order), np.eye(1 + loop.order)
    S[0, 1:], inverse[0, 1:] = loop.reference, -loop.reference
    drift = inverse @ loop.linearised_drift() @ S
    scales = matrix_balance(drift, permute=False, separate=True)[1][0]
    return S * scales, inverse / scales[:, None]


def _whiter(
    loop: Loop, slopes: NDArray, rate: float, S: NDArray, inverse: NDArray
) -> tuple[NDArray, NDArray, float]:
    """Return S and its left inverse with P = S S', and how far from I was P in the coordinates S.

    What does not move has no coordinate any more. A triangular factor, unlike one of eigenvectors,
    does not mix coordinates of different rates.
    """
    drift = loop.linearised_drift(*slopes) / rate
    check_stationary(rate * np.linalg.eigvals(drift))
    noise = inverse @ loop.noise_gains() / math.sqrt(rate)
    try:
        factor = stationary_root(inverse @ drift @ S, noise)
    except UnstableLoopError:  # the eigenvalues are stable
        raise ArithmeticError(_ILL_CONDITIONED) from None
    deviations = np.linalg.norm(factor, axis=1)
    deviations[deviations == 0.0] = 1.0
    triangle, order = qr((factor / deviations[:, None]).T, mode="r", pivoting=True)
    rank = np.count_nonzero(np.abs(triangle.diagonal()) > _DEGENERATE)
    root = np.empty((len(factor), rank))
    root[order] = triangle[:rank].T
    moving = (inverse / deviations[:, None])[order[:rank]]
    return (
        S * deviations @ root,
        solve_triangular(triangle[:rank, :rank].T, moving, lower=True),
        np.abs(factor @ factor.T - np.eye(len(factor))).max(initial=0.0),
    )


# --- one degree -----------------------------------------------------------------------------------


def _errors(problem: _Whitened, degree: int) -> NDArray[np.float64]:
    """Mean square errors, smoothed and filtered, infinite where the moments are of no law."""
    basis = _Basis(problem.dimension, degree)
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


def _generator(problem: _Whitened, basis: "_Basis") -> sparse.csr_array:
    """The matrix of L."""
    linear = basis.lowering.T @ sparse.kron(problem.drift.T, basis.identity) @ basis.lowering
    terms = (_remainder(sine, basis) @ basis.derivative(sine.gain) for sine in problem.sines)
    generator = sum(terms, start=linear).tocsr()
    size = np.abs(generator.data)
    generator.data[size < _ROUNDING * size.max()] = 0.0  # they would only fill the factors
    generator.eliminate_zeros()
    return generator


def _remainder(sine: _Sine, basis: "_Basis") -> sparse.csr_array:
    """The matrix of multiplication with sin(v) - slope v, v = row . (xi_1, xi_2)."""
    sines = [_one_axis(np.sin, factor, basis.degree) for factor in sine.row]
    cosines = [_one_axis(np.cos, factor, basis.degree) for factor in sine.row]
    if len(sine.row) == 1 or not sine.row[1]:
        product = basis.multiplication(sines[:1])
    else:
        product = basis.multiplication([sines[0], cosines[1]])
        product = product + basis.multiplication([cosines[0], sines[1]])
    linear = sum(factor * x for factor, x in zip(sine.row, basis.coordinates, strict=False))
    return product - sine.slope * linear


def _one_axis(function, factor: float, degree: int) -> NDArray[np.float64]:
    """Matrix of multiplication with function(factor x) between h_0 ... h_degree of one variable.

    The eigenvectors of the matrix of x, in a larger basis, are Gauss-Hermite quadrature.
    """
    nodes = 2 * degree + 40
    x, vectors = eigh_tridiagonal(np.zeros(nodes), np.sqrt(np.arange(1.0, nodes)))
    vectors = vectors[: degree + 1]
    matrix = vectors * function(factor * x) @ vectors.T
    matrix[np.abs(matrix) < 10 * _ROUNDING * np.abs(matrix).max()] = 0.0
    return matrix


def _stationary_moments(generator: sparse.csr_array) -> NDArray[np.float64]:
    """Solve m L = 0, m_0 = 1, over the polynomials of even degree."""
    matrix = generator[1:, 1:].T.tocsc()
    right = -generator[[0], 1:].toarray()[0]
    moments = splu(matrix).solve(right)
    residual = np.abs(matrix @ moments - right).max()
    if not residual <= _RESIDUAL_TOLERANCE * max(1.0, np.abs(moments).max()):
        raise ArithmeticError(f"the moments were solved for to {residual:.2g} only")
    return np.array([1.0, *moments])


def _change(problem: _Whitened, generator: sparse.csr_array) -> NDArray[np.float64]:
    """(e^{L delay} - 1) (phi - C_a x_hat) in the polynomials of odd degree."""
    error = np.zeros(generator.shape[0])
    error[: problem.dimension] = problem.smoothed
    slowest = -np.linalg.eigvals(problem.drift).real.max()
    if slowest * problem.delay > FORGOTTEN:
        return -error
    return expm_multiply(generator * problem.delay, error) - error


# --- the polynomials ------------------------------------------------------------------------------


class _Basis:
    r"""Hermite polynomials of d variables up to a total degree, and operators between them.

    In graded order, the degree-one polynomials as their variables. With the tails :math:`s_k =
    \alpha_k + \dots + \alpha_d` the position of :math:`h_\alpha` is :math:`\sum_k\binom{s_k + d -
    k}{d - k + 1}`.

    Parameters
    ----------
    dimension, degree : int

    Attributes
    ----------
    even, odd : arrays of int
        Positions of the polynomials of even and odd degree.
    lowering : (d K, K) sparse array
        The derivatives a_1 ... a_d one above the other.
    coordinates : list of (K, K) sparse arrays
        Multiplications with xi_1 ... xi_d.
    """

    def __init__(self, dimension: int, degree: int):
        self.dimension, self.degree = dimension, degree
        indices = np.zeros((1, 0), int)
        for _ in range(dimension):
            room = 1 + degree - indices.sum(axis=1)
            first = np.cumsum(room) - room
            new = np.arange(room.sum()) - np.repeat(first, room)
            indices = np.column_stack([np.repeat(indices, room, axis=0), new])
        d, s = dimension - np.arange(dimension)[:, None], np.arange(degree + 1)
        self._table = comb(s + d - 1, d, exact=False).round().astype(int)
        self.indices = indices[np.argsort(self._positions(indices))]

        self.degrees = self.indices.sum(axis=1)
        self.even, self.odd = (np.flatnonzero(self.degrees % 2 == k) for k in (0, 1))
        self.identity = sparse.eye_array(len(indices))
        lowering = [self._lowering(axis) for axis in range(dimension)]
        self.lowering = sparse.vstack(lowering, format="csr")
        self.coordinates = [a + a.T for a in lowering]

    def _positions(self, indices: NDArray[np.int_]) -> NDArray[np.int_]:
        tails = np.cumsum(indices[:, ::-1], axis=1)[:, ::-1]
        return self._table[np.arange(self.dimension), tails].sum(axis=1)

    def _lowering(self, axis: int) -> sparse.csr_array:
        columns = np.flatnonzero(self.indices[:, axis])
        lower = self.indices[columns]
        values = np.sqrt(lower[:, axis])
        lower[:, axis] -= 1
        return self._array(values, self._positions(lower), columns)

    def _array(self, values, rows, columns) -> sparse.csr_array:
        size = len(self.indices)
        return sparse.csr_array((values, (rows, columns)), shape=(size, size))

    def derivative(self, direction: NDArray[np.float64]) -> sparse.csr_array:
        """The derivative along a direction."""
        return sparse.kron(direction[None, :], self.identity, format="csr") @ self.lowering

    def multiplication(self, factors: list[NDArray[np.float64]]) -> sparse.csr_array:
        """Multiplication with f_1(xi_1) f_2(xi_2) ..., from the matrices of one variable.

        Exact between the polynomials, which a product of two truncated matrices is not.
        """
        bands = (
            [s for s in range(-self.degree, self.degree + 1) if f.diagonal(-s).any()]
            for f in factors
        )
        axes = slice(len(factors))
        rows, columns, values = [], [], []
        for shifts in itertools.product(*bands):
            room = self.degrees + sum(shifts) <= self.degree
            inside = np.flatnonzero(room & (self.indices[:, axes] + shifts >= 0).all(axis=1))
            start = self.indices[inside]
            moved = start.copy()
            moved[:, axes] += shifts
            entries = (f[moved[:, k], start[:, k]] for k, f in enumerate(factors))
            rows.append(self._positions(moved))
            columns.append(inside)
            values.append(math.prod(entries))
        return self._array(*(np.concatenate(part) for part in (values, rows, columns)))
