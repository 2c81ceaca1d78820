r"""The worst uncertainty of an estimator: constant, or another at every frequency.

Admissible here is what satisfies the constraints at every moment or every frequency: blocks of norm
at most one for the uncertainties, and for each nonlinearity a slope within its Lipschitz constant,
the same for its copy. A projected gradient search, from several starts, finds the worst of them.

A :math:`\Delta(j\omega)` may be different at every frequency. The mean square error

.. math:: \frac{1}{2\pi}\int \max_{\Delta} \lVert T_e(j\omega; \Delta)\rVert_F^2\,d\omega

takes the worst at each, and is above that of every linear time-invariant uncertainty. What is worst
at every frequency need not be causal. It then knows the noise to come, which the theory's
uncertainties do not, and no theorem has it below a design's bound. The exact worst case of causal
uncertainties is in `robsmooth.analysis.constraints`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.linalg import expm, expm_frechet, solve_continuous_lyapunov

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.tables import Table, table_of_values
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, guarantee, open_loop

# Maps Delta and their indices to values and their gradients.
Evaluation = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

_MARGINAL = 1e-12  # a loop whose slowest mode decays by less, relative to the fastest, is unstable
_ITERATIONS = 200
_LONGEST_STEP, _SHORTEST_STEP = 1e3, 1e-9  # relative to the unit ball
_CHANGE = 1e-13  # a step whose gain or loss is less, relatively, changes nothing
_STEPS_WITHOUT_GAIN = 3  # in a row: then the search is over
_BEYOND = 1e4  # times the slowest and the fastest mode: how far the frequencies go
_POINTS = 200  # frequencies to begin with
_DOUBLINGS = 6
_QUADRATURE_TOLERANCE = 1e-4  # relative


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The worst constant uncertainty, as `worst_case` finds it.

    Attributes
    ----------
    Delta : (r + 2g, h + 2g) array
        The uncertainty; channels without an effect have zero blocks.
    mean_square, nominal : float
        The mean square error under it and without uncertainty, in the squared unit of w; infinity
        where the loop is not stable.
    guarantee : float or None, twice the bound V of the design, where that is for this error

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.worst_case(ngcf, "filtered").tightness, 3)
    0.844
    """

    Delta: Matrix
    mean_square: float
    nominal: float
    guarantee: float | None

    @property
    def tightness(self) -> float | None:
        """The mean square error relative to the guarantee; None without one."""
        return None if self.guarantee is None else self.mean_square / self.guarantee

    def __repr__(self) -> str:
        proven = ""
        if self.guarantee is not None:
            proven = f", guarantee={self.guarantee:.5g}, tightness={self.tightness:.3f}"
        return f"WorstCase(mean_square={self.mean_square:.5g}, nominal={self.nominal:.5g}{proven})"

    def _repr_html_(self) -> str:
        rows = [
            ("nominal", self.nominal),
            ("worst constant uncertainty", self.mean_square),
            ("guarantee, $2V$", self.guarantee),
            ("worst relative to the guarantee", self.tightness),
            (r"$\Delta$ of the worst", f"${notation.matrix(self.Delta)}$"),
        ]
        caption = "Mean square errors, in the squared unit of $w$, and the worst uncertainty."
        return table_of_values(rows, caption, digits=5).html()


@one_thread
def worst_case(
    smoother: Estimator,
    output: str = "smoothed",
    loop: str = "theory",
    *,
    starts: int = 16,
    seed: int = 0,
) -> WorstCase:
    """Search for the constant admissible uncertainty with the largest mean square error.

    Parameters
    ----------
    smoother, output, loop
        As in `error_covariance`.
    starts : int, number of corners of the admissible set to start from, besides its centre
    seed : int, of the corners

    Returns
    -------
    WorstCase
        With an infinite mean square where an admissible uncertainty makes the loop unstable.

    See Also
    --------
    worst_dynamic_case, analysis_bound : the worst at every frequency; a bound for all.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> rs.worst_case(ngcf, "filtered")
    WorstCase(mean_square=0.2053, nominal=0.12483, guarantee=0.24335, tightness=0.844)
    """
    opened = open_loop(smoother, output, loop)
    starts = validation.integer("starts", starts, low=1)
    seed = validation.integer("seed", seed, low=0)
    entries = sum(rows * columns for rows, columns in (block.shape for block in opened.blocks))
    starting = initial_deltas(opened, min(starts, 2**entries), seed, float)
    values, Delta = projected_gradient(opened, starting, lambda Delta, _: _errors(opened, Delta))
    best = int(values.argmax())

    def mean_square(Delta: Matrix) -> float:
        if not np.isfinite(mean_square_and_gradient(opened, Delta)[0]):
            return np.inf
        return float(np.trace(error_covariance(smoother, Delta, output, loop)))

    worst, nominal = mean_square(Delta[best]), mean_square(np.zeros_like(Delta[best]))
    return WorstCase(frozen(Delta[best]), worst, nominal, guarantee(smoother, output, loop))


@dataclass(frozen=True, eq=False)
class WorstDynamicCase:
    r"""The worst uncertainty at every frequency, as `worst_dynamic_case` finds it.

    Attributes
    ----------
    mean_square : float
        No linear time-invariant uncertainty has a larger mean square error (in the squared unit of
        w), as far as the search at each frequency found the worst.
    constant : WorstCase, the worst constant uncertainty
    frequencies : (F,) array, rad/s, evenly spaced in their logarithm
    Delta : (F, r + 2g, h + 2g) array, complex, the worst uncertainty
    spectra : (3, F) array
        :math:`\lVert T_e\rVert_F^2` without uncertainty, under the worst constant one and under
        `Delta`, s (unit of w)^2: pi times the mean square error is its integral.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system(), copies=True)
    >>> found = rs.worst_dynamic_case(kalman, "filtered", starts=1)
    >>> round(found.mean_square / found.constant.mean_square, 2)
    1.16
    """

    mean_square: float
    constant: WorstCase
    frequencies: NDArray[np.float64]
    Delta: NDArray[np.complex128]
    spectra: NDArray[np.float64]

    def __repr__(self) -> str:
        return f"WorstDynamicCase(mean_square={self.mean_square:.5g}, constant={self.constant})"

    def _repr_html_(self) -> str:
        low, high = (notation.number(end, 3) for end in self.frequencies[[0, -1]])
        rows = [
            ("none", self.constant.nominal),
            ("worst constant", self.constant.mean_square),
            ("worst at every frequency", self.mean_square),
        ]
        caption = (
            f"Mean square errors, in the squared unit of $w$, from {len(self.frequencies)} "
            f"frequencies between ${low}$ and ${high}$ rad/s."
        )
        return Table(("uncertainty", "mean square error"), rows, caption, digits=5).html()


@one_thread
def worst_dynamic_case(
    smoother: Estimator,
    output: str = "smoothed",
    loop: str = "theory",
    *,
    starts: int = 8,
    seed: int = 0,
) -> WorstDynamicCase:
    """Find the worst uncertainty at every frequency, and the integral of the error's spectrum.

    Parameters
    ----------
    smoother, output, loop, starts, seed
        As in `worst_case`: corners for every frequency, besides the worst constant uncertainty and
        the worst at the neighbouring frequencies.

    Returns
    -------
    WorstDynamicCase

    Raises
    ------
    UnstableLoopError
        Where no multipliers prove the loop stable, so that the maximum could be infinite.
    ArithmeticError
        Where the integral does not converge, or disagrees with the Lyapunov equation where the
        uncertainty is constant.

    See Also
    --------
    worst_case, analysis_bound : the worst constant uncertainty, and that of the constraints.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.worst_dynamic_case(ngcf, "filtered", starts=2).mean_square, 4)
    0.2382
    """
    opened = open_loop(smoother, output, loop)
    starts = validation.integer("starts", starts, low=1)
    constant = worst_case(smoother, output, loop, seed=seed)
    fraction = analysis_bound(smoother, output, loop).fraction
    if fraction < 1.0:
        raise UnstableLoopError(
            "no multipliers prove the loop stable under every uncertainty; they do with the "
            f"uncertainty outputs scaled by {fraction:.3g}"
        )
    modes = np.abs(np.linalg.eigvals(opened.A))
    omega = np.geomspace(modes.min() / _BEYOND, modes.max() * _BEYOND, _POINTS)
    corners = np.concatenate([constant.Delta[None], initial_deltas(opened, starts, seed, complex)])
    Delta = np.broadcast_to(corners, (len(omega), *corners.shape))
    before = np.inf
    for _ in range(_DOUBLINGS):
        spectra, Delta = _spectra(opened, omega, constant.Delta, Delta)
        nominal, fixed, worst = (_integral(omega, spectrum) for spectrum in spectra)
        known = (constant.nominal, constant.mean_square, before)
        if np.allclose((nominal, fixed, worst), known, rtol=_QUADRATURE_TOLERANCE, atol=0.0):
            return WorstDynamicCase(worst, constant, *map(frozen, (omega, Delta, spectra)))
        before, omega = worst, np.geomspace(omega[0], omega[-1], 2 * len(omega) - 1)
        Delta = np.repeat(Delta, 2, axis=0)[:-1, None]  # between two frequencies: as at the lower
    raise ArithmeticError(
        f"the integrals over {len(omega)} frequencies, {nominal:.6g} without uncertainty, "
        f"{fixed:.6g} under the worst constant one and {worst:.6g} under the worst at each, are "
        f"not close enough to {known[0]:.6g}, {known[1]:.6g} and, with half as many, {known[2]:.6g}"
    )


def _errors(loop: OpenLoop, Delta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean square errors and their gradients for constant uncertainties."""
    values, gradients = zip(*(mean_square_and_gradient(loop, each) for each in Delta), strict=True)
    return np.array(values), np.array(gradients)


def mean_square_and_gradient(loop: OpenLoop, Delta: Matrix) -> tuple[float, Matrix]:
    """Return the mean square error and its gradient by the adjoint Lyapunov equation."""
    A = loop.A + loop.inputs @ Delta @ loop.outputs
    poles = np.linalg.eigvals(A)
    if not poles.real.max() < -_MARGINAL * np.abs(poles).max():
        return np.inf, np.zeros_like(Delta)
    P = solve_continuous_lyapunov(A, -loop.B @ loop.B.T)
    truth, estimate, delay = loop.truth, loop.estimate, loop.delay
    estimate_after_lag = estimate @ expm(delay * A)  # its mean, given the state now
    cross = estimate_after_lag @ P @ truth.T
    value = np.trace(truth @ P @ truth.T - 2 * cross + estimate @ P @ estimate.T)
    mixed = truth.T @ estimate_after_lag
    weight = truth.T @ truth + estimate.T @ estimate - mixed - mixed.T
    gradient = 2 * solve_continuous_lyapunov(A.T, -weight) @ P
    if delay > 0.0:
        through = expm_frechet(delay * A.T, estimate.T @ truth @ P, compute_expm=False)
        gradient -= 2 * delay * through
    return float(value), loop.inputs.T @ gradient @ loop.outputs.T


def _integral(omega: np.ndarray, spectrum: np.ndarray) -> float:
    """Return the integral over all frequencies, divided by 2 pi."""
    # a spectrum is constant below the given frequencies, and falls with their square above
    inside = trapezoid(omega * spectrum, np.log(omega))
    return float((omega[0] * spectrum[0] + inside + omega[-1] * spectrum[-1]) / np.pi)


def _spectra(
    loop: OpenLoop, omega: np.ndarray, constant: Matrix, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal, constant and worst spectrum, and the worst Delta at every frequency."""
    s, noises = 1j * omega[:, None, None], [loop.B.shape[1]]
    driven = np.hstack([loop.B, loop.inputs]).astype(complex)
    states = np.linalg.solve(s * np.eye(len(loop.A)) - loop.A, driven[None])
    error = (loop.truth * np.exp(-s * loop.delay) - loop.estimate) @ states
    error_W, error_xi = np.split(error, noises, axis=-1)
    zeta_W, zeta_xi = np.split(loop.outputs @ states, noises, axis=-1)

    def evaluate(Delta: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return |T_e|^2 and its gradient at the frequencies with the given numbers."""
        loops = np.linalg.inv(np.eye(Delta.shape[-1]) - zeta_xi[where] @ Delta)
        signal = loops @ zeta_W[where]  # zeta under this Delta
        through = error_xi[where] @ (np.eye(Delta.shape[-2]) + Delta @ loops @ zeta_xi[where])
        T = error_W[where] + error_xi[where] @ Delta @ signal
        gradient = through.conj().mT @ T @ signal.conj().mT
        return (np.abs(T) ** 2).sum(axis=(1, 2)), gradient

    everywhere = np.arange(len(omega))

    def search(starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the best that is reached at each frequency from its starts."""
        each = starts.shape[1]
        values, found = projected_gradient(
            loop, np.concatenate(starts), lambda Delta, index: evaluate(Delta, index // each)
        )
        values = values.reshape(-1, each)
        best = values.argmax(axis=1)
        return values[everywhere, best], found.reshape(starts.shape)[everywhere, best]

    _, Delta = search(starts)
    worst, Delta = search(np.stack([np.roll(Delta, by, axis=0) for by in (0, 1, -1)], axis=1))
    fixed = [np.broadcast_to(D, Delta.shape) for D in (np.zeros_like(constant), constant)]
    return np.array([*(evaluate(D, everywhere)[0] for D in fixed), worst]), Delta


def initial_deltas(loop: OpenLoop, count: int, seed: int, kind: type) -> np.ndarray:
    """Return Delta zero, then random corners and their negatives, at least `count` of these."""
    rng = np.random.default_rng(seed)
    half = (count + 1) // 2
    blocks = []
    for block in loop.blocks:
        drawn = rng.standard_normal((half, *block.shape))
        if kind is complex:
            drawn = drawn + 1j * rng.standard_normal(drawn.shape)
        U, _, V = np.linalg.svd(drawn, full_matrices=False)
        corner = U @ V
        blocks.append(np.concatenate([np.zeros_like(corner[:1]), corner, -corner]))
    return loop.assemble(blocks, (1 + 2 * half,)).astype(kind)


def projected_gradient(
    loop: OpenLoop, Delta: np.ndarray, evaluate: Evaluation
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the search reaches from each Delta, and where; an infinite value ends it."""
    index = np.arange(len(Delta))
    values, gradients = evaluate(Delta, index)
    Delta, steps, without_gain = Delta.copy(), np.ones(len(Delta)), np.zeros(len(Delta), int)
    for _ in range(_ITERATIONS):
        live = index[(without_gain < _STEPS_WITHOUT_GAIN) & (steps > _SHORTEST_STEP)]
        if not live.size or np.isinf(values).any():
            break
        trial = _projected_step(loop, Delta[live], gradients[live], steps[live])
        found, slopes = evaluate(trial, live)
        gained = found - values[live] > _CHANGE * values[live]
        better = found - values[live] >= -_CHANGE * values[live]
        without_gain[live] = np.where(better & ~gained, without_gain[live] + 1, 0)
        steps[live] = np.where(better, np.minimum(3 * steps[live], _LONGEST_STEP), steps[live] / 4)
        moved = live[better]
        Delta[moved], values[moved] = trial[better], found[better]
        gradients[moved] = slopes[better]
    return values, Delta


def _projected_step(
    loop: OpenLoop, Delta: np.ndarray, gradients: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """Step along the gradient, each block by itself, and cut singular values at one."""
    blocks = []
    for value, gradient in zip(loop.disassemble(Delta), loop.in_blocks(gradients), strict=True):
        size = np.linalg.norm(gradient, axis=(-2, -1), keepdims=True)
        size[size == 0.0] = 1.0
        beyond = value + steps[:, None, None] * gradient / size
        U, scales, V = np.linalg.svd(beyond, full_matrices=False)
        blocks.append(U * np.minimum(scales, 1.0)[:, None, :] @ V)
    return loop.assemble(blocks, (len(Delta),))
