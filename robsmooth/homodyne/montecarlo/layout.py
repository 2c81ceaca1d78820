"""Where the numbers of a kernel lie in its flat arrays.

All that a step writes lies in one flat array, the state, and all that it reads in two more, the
coefficients and the noise: the compiler must check at run time that arrays do not overlap, and with
more of them it would not vectorise.

- *Coefficients* follow each other in the order of the fields of their class, which holds the
  arrays, and also the index at which each begins.
- *State* and *results* are rows of `BLOCK` numbers, one for each path of a block.

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
    push: NDArray  # (n,), of the exact step by T
    sine_slope: NDArray  # (), rho_s
    copy_slope: NDArray  # (), rho_c
    reference_of_sine: NDArray  # (), r h b_s
    reference_of_copy: NDArray  # (), r h b_c
    copy_of_sine: NDArray  # (), c h b_s
    copy_of_copy: NDArray  # (), c h b_c
    quarter_turn: NDArray  # ()
    start: NDArray  # (1 + n, 1 + n), a root of the stationary covariance of the control


class SplittingState(NamedTuple):
    """The indices of the rows of `robsmooth.homodyne.montecarlo.splitting`; `end` is the size."""

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
    v = n * n  # where the vectors begin
    s = v + 4 * n  # and the scalars
    return EulerCoefficients(0, v, v + n, v + 2 * n, v + 3 * n, s, s + 1, s + 2)


@register_jitable
def splitting_indices(n, m):
    """Return the indices of the coefficients."""
    root = (1 + n) * (1 + n)
    v = root + (1 + n) * m
    s = v + 7 * n
    vectors = (v, v + n, v + 2 * n, v + 3 * n, v + 4 * n, v + 5 * n, v + 6 * n)
    rest = (s, s + 1, s + 2, s + 3, s + 4, s + 5, s + 6, s + 7)
    return SplittingCoefficients(0, root, *vectors, *rest)


@register_jitable
def splitting_rows(n):
    """Return the indices of the rows of the state."""
    kick = (1 + 2 * n) * BLOCK
    first, after = (kick, kick + BLOCK, kick + 2 * BLOCK), kick + 3 * BLOCK
    last = (after, after + BLOCK, after + 2 * BLOCK, after + 3 * BLOCK)
    return SplittingState(0, BLOCK, (1 + n) * BLOCK, *first, *last)


def draws_of_splitting(n: int) -> int:
    """Return m: Gaussians a step, one for each state, in pairs."""
    return DRAWS * -(-(1 + n) // DRAWS)


def flat(coefficients: EulerCoefficients | SplittingCoefficients, real: type) -> NDArray:
    """Return the coefficients in one array, in a kernel's precision."""
    return np.concatenate([np.ravel(part) for part in coefficients]).astype(real)
