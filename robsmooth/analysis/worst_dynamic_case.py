r"""The worst uncertainty at every frequency.

A :math:`\Delta(j\omega)` may be different at every frequency. The mean square error

.. math:: \frac{1}{2\pi}\int \max_{\Delta} \lVert T_e(j\omega; \Delta)\rVert_F^2\,d\omega

takes the worst at each, and is above that of every linear time-invariant uncertainty. (The norm is
subharmonic in :math:`\Delta`, so that the worst lies on the boundary: slopes become phases.) But
what is worst at every frequency need not be causal. It then knows the noise to come, which the
theory's uncertainties do not, and no theorem has it below a design's bound. The exact worst case of
causal uncertainties is in `robsmooth.analysis.constraints`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.worst_case import (
    WorstCase,
    initial_deltas,
    projected_gradient,
    worst_case,
)
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, open_loop

_BEYOND = 1e4  # times the slowest and the fastest mode: how far the frequencies go
_POINTS = 200  # frequencies to begin with
_DOUBLINGS = 6
_QUADRATURE_TOLERANCE = 1e-4  # relative


@dataclass(frozen=True, eq=False)
class WorstDynamicCase:
    r"""The worst uncertainty at every frequency, as `worst_dynamic_case` finds it.

    Attributes
    ----------
    mean_square : float
        No linear time-invariant uncertainty has a larger mean square error (in the squared unit of
        w), as far as the search at each frequency found the worst.
    constant : WorstCase
        The worst constant uncertainty.
    frequencies : (F,) array
        Angular frequencies, rad/s, evenly spaced in their logarithm.
    Delta : (F, r + 2g, h + 2g) array
        The worst uncertainty, complex.
    spectra : (3, F) array
        :math:`\lVert T_e\rVert_F^2` without uncertainty, under the worst constant one and under
        `Delta`, in the squared unit of w times seconds. The integral over positive frequencies,
        divided by pi, is the mean square error.

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

    def __post_init__(self):
        for value in (self.frequencies, self.Delta, self.spectra):
            frozen(value)

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
    smoother, output, loop
        As in `error_covariance`.
    starts : int
        Number of random corners to start from at every frequency, besides the worst constant
        uncertainty and the worst at the neighbouring frequencies.
    seed : int
        Of the corners.

    Returns
    -------
    WorstDynamicCase

    Raises
    ------
    UnstableLoopError
        Where no multipliers prove the loop stable under all uncertainties: the maximum could be
        infinite.
    ArithmeticError
        Where the integral does not converge, or without uncertainty and under the worst constant
        one does not agree with the Lyapunov equation.
    ValueError, TypeError
        For an argument that is not as described.

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
    omega = _frequencies(opened)
    corners = np.concatenate([constant.Delta[None], initial_deltas(opened, starts, seed, complex)])
    Delta = np.broadcast_to(corners, (len(omega), *corners.shape))
    before = np.inf
    for _ in range(_DOUBLINGS):
        spectra, Delta = _spectra(opened, omega, constant.Delta, Delta)
        nominal, fixed, worst = (_integral(omega, spectrum) for spectrum in spectra)
        known = (constant.nominal, constant.mean_square, before)
        if np.allclose((nominal, fixed, worst), known, rtol=_QUADRATURE_TOLERANCE, atol=0.0):
            return WorstDynamicCase(worst, constant, omega, Delta, spectra)
        before, omega = worst, np.geomspace(omega[0], omega[-1], 2 * len(omega) - 1)
        Delta = np.repeat(Delta, 2, axis=0)[:-1, None]  # between two frequencies: as at the lower
    raise ArithmeticError(
        f"the integrals over {len(omega)} frequencies, {nominal:.6g} without uncertainty, "
        f"{fixed:.6g} under the worst constant one and {worst:.6g} under the worst at each, are "
        f"not close enough to {known[0]:.6g}, {known[1]:.6g} and, with half as many, {known[2]:.6g}"
    )


def _frequencies(loop: OpenLoop) -> np.ndarray:
    """Return frequencies around all modes of the nominal loop, beyond which spectra are powers."""
    modes = np.abs(np.linalg.eigvals(loop.A))
    return np.geomspace(modes.min() / _BEYOND, modes.max() * _BEYOND, _POINTS)


def _integral(omega: np.ndarray, spectrum: np.ndarray) -> float:
    """Return the integral over all frequencies, divided by 2 pi.

    A spectrum is constant below the given frequencies, and falls with their square above.
    """
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
