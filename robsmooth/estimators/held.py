r"""An estimator as it is in continuous time, with each sample held over its interval.

With `y` held at
its mean, an estimator

.. math::

    \dot{\hat x} = A\hat x + B_y\,y + B_\mu\,\psi(\tilde\nu - r), \qquad \tilde\nu = C_\nu\hat x,

is linear but for the copies, where `r` is the reference. The linear part is taken exactly, whatever
`dt`, and the copies' part by the exponential Runge-Kutta method of second order ETD2RK (S. M. Cox
and P. C. Matthews, J. Comput. Phys. 176(2), 2002),

.. math::

    a &= \varphi_0\hat x_k + \varphi_1 h\,[B_y y_k + B_\mu\,\mu(\hat x_k)], \\
    \hat x_{k+1} &= a + \varphi_2 h\,B_\mu\,[\mu(a) - \mu(\hat x_k)], \qquad
    \mu(x) = \psi(C_\nu x - r_k), \quad \varphi_j = \varphi_j(Ah),

which keeps every equilibrium. The copies' slope at zero is not moved into `A`: what is left could
have twice the Lipschitz constant, and that this is small is why long steps are stable. In the
example, at a `dt` of a third of the loop's time constant, the method's error is a thousandth of the
estimate's.

Where measurements are missing, their place is taken by what the estimator expects of them,
:math:`(C_2\hat x)_i + (\bar D_{21}\,\tilde\mu)_i`, all along the interval and not held: their
innovation is zero. This changes `A` and :math:`B_\mu`, so that every set of missing channels has
matrices of its own. In a long gap the estimates go back to the prior, zero.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robsmooth.estimators import sample_loop
from robsmooth.estimators.sample_loop import Record, Steps

Floats = NDArray[np.float64]


class HeldEstimator:
    """The equations of an estimator in steps of dt."""

    samples_back = 0  # its delay is a part of it

    def __init__(
        self,
        estimator: Any,
        dt: float,
        running: list[int],
        functions: Sequence[Callable[[Any], Any]],
        compiled: bool,
    ) -> None:
        system, self.states = estimator.plant.system, len(estimator.A_c)
        if system.p:
            raise ValueError(
                "a system with known inputs is for an exact smoother, of a classical or a tuned "
                "design without delay='model': this one runs a model of its delay; a design of "
                "the system without B2 and D22 takes no inputs"
            )
        self._estimator, self._dt, self._running = estimator, dt, running
        self._C_nu = np.ascontiguousarray(estimator.C_c[system.m :][running])
        self._outputs = {"smoothed": estimator.C_a.copy(), "filtered": estimator.C_f.copy()}
        self._sizes = sample_loop.sizes_of(self.states, system.l, system.m, len(running))
        self._advance = sample_loop.sample_loop(tuple(functions), compiled)
        self._patterns: dict[bytes, int] = {}  # of missing channels, to a row of the steps
        self._steps: Steps | None = None
        self._pattern(np.zeros(system.l, dtype=bool))

    def start(self, state: Floats | None, covariance: None) -> None:
        """Begin a record with a state, zero by default."""
        self.memory = np.zeros(self.states) if state is None else state.copy()

    @property
    def state(self) -> Floats:
        """The estimator's state now."""
        return self.memory

    def estimate(self, output: str) -> Floats:
        """Return an estimate now."""
        return self._outputs[output] @ self.memory

    def take(
        self,
        y: Floats,
        reference: Floats,
        _inputs: None,
        output: str,
        lags: Sequence[int],
        spread: bool,
    ) -> tuple[Floats, Floats]:
        """Take samples; return the estimates, (rows, 1, m), and no deviations."""
        readout, record = self._outputs[output], self._record(y, reference)
        state, result = self.memory.copy(), np.empty((len(y), len(readout)))
        self._advance(self._sizes, self._steps, self._C_nu, readout, record, state, result)
        if not np.isfinite(state).all():
            raise ArithmeticError("the estimator's state left the range of floating-point numbers")
        self.memory = state
        return result[:, None], result[:0, None]

    def _record(self, y: NDArray[np.float64], reference: NDArray[np.float64]) -> Record:
        """Return the samples, in segments with the same measurements missing."""
        if np.isfinite(y).all():
            return Record(y, reference, np.array([0, len(y)]), np.zeros(1, dtype=np.intp))
        missing = np.isnan(y)
        changes = 1 + np.flatnonzero((missing[1:] != missing[:-1]).any(axis=1))
        starts = np.array([0, *changes, len(y)])
        patterns = np.array([self._pattern(row) for row in missing[starts[:-1]]])
        return Record(np.where(missing, 0.0, y), reference, starts, patterns)

    def _pattern(self, missing: NDArray[np.bool_]) -> int:
        """Return the index of the matrices for these missing channels; make them where needed."""
        key = missing.tobytes()
        if key not in self._patterns:
            steps = sample_loop.steps_of(self._estimator, self._running, self._dt, missing)
            if self._steps is not None:
                steps = Steps(*map(np.concatenate, zip(self._steps, steps, strict=True)))
            self._patterns[key], self._steps = len(self._patterns), steps
        return self._patterns[key]
