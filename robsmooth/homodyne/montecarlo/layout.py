"""Where the numbers of a kernel lie in its flat arrays.

All that a step writes lies in one flat array, the state, and all that it reads in two more, the
coefficients and the noise: the compiler must check at run time that arrays do not overlap, and with
more of them it would not vectorise.

- *Coefficients* follow each other in the order of the fields of `EulerCoefficients` and
  `SplittingCoefficients`. The classes hold the arrays, and also the index at which each begins.
- *State* and *results* are rows of `BLOCK` numbers, one for each path of a block. `SplittingState`
  holds the index at which each row, or the first of several, begins. The state of the
  Euler-Maruyama scheme is the phase and the n rows of the estimator.

The functions that return indices run in the kernels, too. The order n of the estimator is known
when a kernel is compiled, so there they are constants.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from robsmooth.homodyne.montecarlo.noise import BLOCK, DRAWS


class EulerCoefficients(NamedTuple):
    """Of a step of `robsmooth.homodyne.montecarlo.euler`."""

    increments: NDArray  # (n, n), F
    reference: NDArray  # (n,), r
    copy: NDArray  # (n,), c
    sine_gain: NDArray  # (n,), b_s
    copy_gain: NDArray  # (n,), b_c
    noise: NDArray  # (), w
    decay: NDArray  # (), a
    diffusion: NDArray  # (), q


class SplittingCoefficients(NamedTuple):
    """Of a step of `robsmooth.homodyne.montecarlo.splitting`, with m Gaussians a step."""

    transition: NDArray  # (1 + n, 1 + n), Phi
    root: NDArray  # (1 + n, m), of the covariance of eta
    sine_gain: NDArray  # (n,), h b_s
    copy_gain: NDArray  # (n,), h b_c
    reference: NDArray  # (n,), r
    copy: NDArray  # (n,), c
    sine_response: NDArray  # (n,), h b_s after the transition
    copy_response: NDArray  # (n,), h b_c after the transition
    sine_slope: NDArray  # (), rho_s
    copy_slope: NDArray  # (), rho_c
    reference_of_sine: NDArray  # (), r h b_s
    reference_of_copy: NDArray  # (), r h b_c
    copy_of_sine: NDArray  # (), c h b_s
    copy_of_copy: NDArray  # (), c h b_c
    quarter_turn: NDArray  # ()
    push: NDArray  # (n,), of the exact step by T


class SplittingState(NamedTuple):
    """Of a block in `robsmooth.homodyne.montecarlo.splitting`; `end` is the size."""

    phase: int
    control: int  # n rows, y
    difference: int  # n rows, d
    sine_first: int  # terms of the kick, of first and of second order, along h b_s
    sine_second: int
    copy_first: int  # and along h b_c
    copy_second: int
    delayed: int  # the phase a delay ago
    turns: int  # T
    end: int


@register_jitable
def euler_indices(n):
    """Return the indices of the coefficients."""
    vectors = n * n
    scalars = vectors + 4 * n
    return EulerCoefficients(
        0,
        vectors,
        vectors + n,
        vectors + 2 * n,
        vectors + 3 * n,
        scalars,
        scalars + 1,
        scalars + 2,
    )


@register_jitable
def splitting_indices(n, m):
    """Return the indices of the coefficients."""
    root = (1 + n) * (1 + n)
    vectors = root + (1 + n) * m
    scalars = vectors + 6 * n
    return SplittingCoefficients(
        0,
        root,
        vectors,
        vectors + n,
        vectors + 2 * n,
        vectors + 3 * n,
        vectors + 4 * n,
        vectors + 5 * n,
        scalars,
        scalars + 1,
        scalars + 2,
        scalars + 3,
        scalars + 4,
        scalars + 5,
        scalars + 6,
        scalars + 7,
    )


@register_jitable
def splitting_rows(n):
    """Return the indices of the rows of the state."""
    kick = (1 + 2 * n) * BLOCK
    return SplittingState(
        0,
        BLOCK,
        (1 + n) * BLOCK,
        kick,
        kick + BLOCK,
        kick + 2 * BLOCK,
        kick + 3 * BLOCK,
        kick + 4 * BLOCK,
        kick + 5 * BLOCK,
        kick + 6 * BLOCK,
    )


def euler_state_size(n: int) -> int:
    """Return the size of the state of a block."""
    return (1 + n) * BLOCK


def draws_of_splitting(n: int) -> int:
    """Return m: Gaussians a step, one for each state, in pairs."""
    return DRAWS * -(-(1 + n) // DRAWS)


def flat(coefficients: EulerCoefficients | SplittingCoefficients, real: type) -> NDArray:
    """Return the coefficients in one array, in a kernel's precision."""
    return np.concatenate([np.ravel(part) for part in coefficients]).astype(real)
