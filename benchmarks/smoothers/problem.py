"""The example in samples, as every Kalman smoother gets it.

A sample is the mean of dy/dt over its interval. So the state holds the system's state at the
interval's end and the mean of the measured signal, and the noise of a sample is white.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, solve_discrete_lyapunov

from robsmooth.systems.system import UncertainSystem

Run = Callable[[NDArray], NDArray]  # from a record (N, 1), from its start, to estimates (N,)
FIXED_LAG, WHOLE = "at a fixed lag", "with the whole record"


@dataclass(frozen=True, eq=False)
class Sampled:
    r"""A stable system of one measurement in samples, with white noises u and v.

    .. math:: z_{k+1} = F z_k + u_k, \qquad y_k = h z_k + v_k, \qquad w_k = c z_k

    Attributes
    ----------
    F, Q : (n, n) arrays
        Q is the covariance of u.
    h, c : (1, n) arrays
    R : (1, 1) array
        The variance of v.
    lag : int
        In samples.
    """

    F: NDArray
    h: NDArray
    c: NDArray
    Q: NDArray
    R: NDArray
    lag: int

    @cached_property
    def stationary(self) -> NDArray:
        """The covariance of the state before the first sample, and of every state without one."""
        return solve_discrete_lyapunov(self.F, self.Q)

    def with_delay_line(self) -> "Sampled":
        """Return the system that keeps `lag` former outputs, and whose output is the oldest.

        Its filter is the fixed-lag smoother of this system.
        """
        n, lag = len(self.F), self.lag
        F = block_diag(self.F, np.eye(lag, k=-1))
        F[n, :n] = self.c[0]
        return replace(
            self,
            F=F,
            Q=np.pad(self.Q, (0, lag)),
            h=np.pad(self.h, ((0, 0), (0, lag))),
            c=np.eye(1, n + lag, n + lag - 1),
        )


def sampled(system: UncertainSystem, dt: float, lag: int) -> Sampled:
    """Return the nominal part of a stable system of one measurement and one output."""
    if (system.B1 @ system.D21.T).any():
        raise ValueError("the noises of the state and of the measurement must be independent")
    n = system.n
    with_mean = np.pad(np.vstack([system.A, system.C2 / dt]), ((0, 0), (0, 1)))
    noise = np.pad(system.B1 @ system.B1.T, (0, 1))
    # C. F. Van Loan, "Computing integrals involving the matrix exponential", 1978
    both = expm(dt * np.block([[-with_mean, noise], [np.zeros_like(noise), with_mean.T]]))
    step = both[n + 1 :, n + 1 :].T
    return Sampled(
        F=np.pad(step[:, :n], ((0, 0), (0, 1))),  # the mean starts anew with each interval
        Q=step @ both[: n + 1, n + 1 :],
        h=np.eye(1, n + 1, n),
        c=np.pad(system.C0, ((0, 0), (0, 1))),
        R=system.D21 @ system.D21.T / dt,
        lag=lag,
    )


@dataclass(frozen=True)
class Smoother:
    """Another package's way to smooth a record.

    Attributes
    ----------
    name : str
    uses : str
        `FIXED_LAG`, or `WHOLE`: all estimates use the whole record.
    prepare : callable
        From a Sampled to a Run; raises `Unavailable` where the package is not installed.
    differs : str, optional
        Why its estimates are not those of robsmooth.
    """

    name: str
    uses: str
    prepare: Callable[[Sampled], Run]
    differs: str = ""
