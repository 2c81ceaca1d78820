r"""The steps of a simulation: their length, and the response of a linear system over one.

For :math:`dz = (Az + Bu)\,dt`, with `u` linear in time from :math:`u_0` to :math:`u_1`,

.. math::

    z(h) = e^{Ah}z(0) + K_1u_0 + K_2(u_1 - u_0), \qquad
    K_1 = \int_0^h e^{As}\,ds\,B = h\varphi_1(Ah)B, \qquad
    K_2 = \frac1h\int_0^h\!\!\int_0^s e^{Ar}\,dr\,ds\,B = h\varphi_2(Ah)B .
"""

import math
import warnings

import numpy as np
from scipy.linalg import expm, matrix_balance

from robsmooth._support.errors import LongStepWarning
from robsmooth._support.validation import Matrix

_RESIDUAL_TOLERANCE = 1e-10  # of the phi functions
MOST_STEPS, MOST_IN_DELAY = 10**9, 10**6  # of a path, and of what is in memory of it
MULTIPLE_TOLERANCE = 1e-6  # how far delay / step may be from a whole number


def warn_of_long_step(
    step: float, response_time: float, longest: float, fine: float, stacklevel: int
) -> None:
    """Warn where a step (s) is more than `longest` response times (s); `fine` is one to suggest."""
    ratio = step / response_time
    if ratio > longest * (1 + MULTIPLE_TOLERANCE):
        message = (
            f"the step, {step:.4g} s, is {ratio:.3g} times the loop's response time, "
            f"{response_time:.4g} s: above {longest:g} times, the results depend on the step; "
            f"{fine:.8g} s is fine"
        )
        warnings.warn(message, LongStepWarning, stacklevel=stacklevel + 1)


def dividing_step(delay: float, longest: float, duration: float) -> float:
    """Return the largest step up to `longest`, and to the duration, that divides the delay."""
    step = min(longest, duration)
    return delay / math.ceil(delay / step - 1e-9) if delay > 0 else step


def steps_in(duration: float, step: float, before: float = 0.0) -> int:
    """Return the steps of a duration; a ValueError says that there are none, or too many."""
    if not (whole := before + duration) / step <= MOST_STEPS:
        path = f"a path of {whole:.3g} s with its warm-up: more runs average as well as longer ones"
        raise ValueError(f"step must be at least {whole / MOST_STEPS:.3g} s for {path}")
    steps = round(duration / step)
    if steps < 1:
        raise ValueError(f"duration must be at least one step, {step:g} s, got {duration:g}")
    return steps


def whole_steps(delay: float, step: float) -> int:
    """Return delay / step; a ValueError says that it is not whole, and which steps would do."""
    ratio = delay / step
    if not ratio <= MOST_IN_DELAY:
        least = delay / MOST_IN_DELAY
        raise ValueError(f"step must be at least {least:g} s, as for a delay so long")
    nearest = round(ratio)
    if abs(ratio - nearest) <= MULTIPLE_TOLERANCE and (nearest > 0 or delay == 0):
        return nearest
    fewer = max(1, math.floor(ratio))
    raise ValueError(
        f"step must divide the smoother's delay, {delay:g} s, into whole steps, got {step:g} "
        f"({ratio:.6g} steps): the nearest that do are {delay / fewer:.12g} ({fewer} steps) and "
        f"{delay / (fewer + 1):.12g} ({fewer + 1} steps)"
    )


def responses(A: Matrix, B: Matrix, step: float) -> tuple[Matrix, Matrix, Matrix]:
    r"""Return e^{A step}, K_1 and K_2; an ArithmeticError says that the step is too long.

    :math:`\varphi_0 = e^A` and :math:`\varphi_{j+1} = A^{-1}(\varphi_j - 1/j!)` are blocks of one
    exponential, which needs no inverse of A.
    """
    n = len(A)
    balanced, (scale, _) = matrix_balance(step * A, permute=False, separate=True)
    block = np.eye(3 * n, k=n)
    block[:n, :n] = balanced
    with np.errstate(all="ignore"):  # the residual of an overflow is NaN
        phi = expm(block)[:n].reshape(n, 3, n).swapaxes(0, 1)
        residuals = balanced @ phi[1:] - phi[:2] + np.eye(n)
        size = 1.0 + np.linalg.norm(balanced) * np.linalg.norm(phi[1:], axis=(1, 2))
        residual = (np.linalg.norm(residuals, axis=(1, 2)) / size).max()
    if not residual <= _RESIDUAL_TOLERANCE:
        raise ArithmeticError(
            f"the matrix exponential over one step has a relative residual of {residual:.2g}: the "
            "step is too long for an unstable estimator"
        )
    phi_0, phi_1, phi_2 = scale[:, None] * phi / scale
    return phi_0, step * phi_1 @ B, step * phi_2 @ B
