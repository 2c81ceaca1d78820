"""The worst constant uncertainty of an estimator, against the bound of its design.

Admissible here is what satisfies the constraints at every moment or every frequency: blocks of norm
at most one for the uncertainties, and for each nonlinearity a slope within its Lipschitz constant,
the same for its copy. A projected gradient search finds the worst of them, from several starts. The
projection cuts the singular values of the blocks, relative to their gain, at one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, expm_frechet, solve_continuous_lyapunov

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import table_of_values
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, guarantee, open_loop

Evaluation = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

_MARGINAL = 1e-12  # a loop whose slowest mode decays by less, relative to the fastest, is unstable
_ITERATIONS = 200
_LONGEST_STEP, _SHORTEST_STEP = 1e3, 1e-9  # relative to the unit ball
_CHANGE = 1e-13  # a step whose gain or loss is less, relatively, changes nothing
_STEPS_WITHOUT_GAIN = 3  # in a row: then the search is over


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
    guarantee : float or None
        Twice the bound V of the design, where that is for this error.

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

    def __post_init__(self):
        frozen(self.Delta)

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
    starts : int
        Number of corners of the admissible set to start from, besides its centre.
    seed : int
        Of the corners.

    Returns
    -------
    WorstCase
        With an infinite mean square where an admissible uncertainty makes the loop unstable.

    Raises
    ------
    ValueError, TypeError
        For an argument that is not as described.

    See Also
    --------
    worst_dynamic_case : The worst uncertainty at every frequency.
    analysis_bound : A bound for every admissible uncertainty, constant or not.

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

    return WorstCase(
        Delta=Delta[best],
        mean_square=mean_square(Delta[best]),
        nominal=mean_square(np.zeros_like(Delta[best])),
        guarantee=guarantee(smoother, output),
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
    """Return what a projected gradient search reaches from each of the given Delta, and where.

    `evaluate` returns values, and gradients with respect to Delta, of those Delta whose indices it
    is given too. A value that is infinite ends the search.
    """
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
