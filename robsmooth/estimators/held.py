r"""An estimator as it is in continuous time, with each sample held over its interval.

With `y` held at its mean, an estimator

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

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robsmooth.estimators import sample_loop
from robsmooth.estimators.copies import Functions
from robsmooth.estimators.sample_loop import Record, Samples, Steps, steps_of

_KEPT = 1000  # kinds of samples whose matrices are kept
Floats = NDArray[np.float64]


class HeldEstimator:
    """The equations of an estimator in steps of dt."""

    samples_back = 0  # its delay is a part of it
    usual: Floats  # the references of a sample that has none of its own

    def __init__(self, estimator: Any, dt: float, running: list[int], functions: Functions) -> None:
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
        self._functions = functions
        self._functions, self._step = functions, None
        self._kept: dict[bytes, Steps] = {}
        self._present = np.append(np.zeros(system.l), dt)  # a sample with all measurements
        self._steps(self._present)

    def start(self, state: Floats | None, covariance: None) -> None:
        """Begin a record with a state, zero by default."""
        self.memory = np.zeros(self.states) if state is None else state.copy()
        self._next = self.memory.copy()

    @property
    def state(self) -> Floats:
        """The estimator's state now."""
        return self.memory

    def copied(self) -> Floats:
        """Return a copy of the memory."""
        return self.memory.copy()

    def estimate(self, output: str) -> Floats:
        """Return an estimate now."""
        return self._outputs[output] @ self.memory

    def step(self, y: Floats) -> Floats | None:
        """Take a sample as most are; return None where it is not taken, and `take` has to."""
        if self._step is None:
            self._step = self._bind()
        take_one, row, estimate = self._step
        row[:] = y
        if not take_one(self.memory, self._next, estimate):
            return None
        self.memory, self._next = self._next, self.memory
        return estimate[0].copy()

    def _bind(self) -> tuple[partial[bool], Floats, Floats]:
        """Return what takes a sample, and where that and the estimate stand."""
        y, reference = np.zeros((1, self._estimator.plant.system.l)), self.usual[None].copy()
        row = Record(y, reference, np.array([0, 1]), np.zeros(1, dtype=np.intp))
        of_model = *self._steps(self._present), self._C_nu, self._outputs["smoothed"]
        bound = partial(sample_loop.step, self._sizes, self._functions.addresses, *of_model, *row)
        return bound, y, np.empty((1, len(self._outputs["smoothed"])))

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_step": None}  # addresses of functions are those of a process

    def take(
        self, given: Samples, output: str, _lags: Sequence[int] | None, _spread: bool
    ) -> tuple[Floats, Floats]:
        """Take samples; return the estimates, (rows, 1, m), and no deviations."""
        readout, state = self._outputs[output], self.memory.copy()
        result = np.empty((len(given.y), len(readout)))
        steps, record = self._recorded(given)
        functions = self._functions.addresses
        finite = sample_loop.advance(
            self._sizes, functions, steps, self._C_nu, readout, record, state, result
        )
        self._functions.check(finite, "the estimator's state")
        self.memory = state
        return result[:, None], result[:0, None]

    def _recorded(self, given: Samples) -> tuple[Steps, Record]:
        """Return the samples in segments that have the same matrices, and these."""
        missing, lengths = np.isnan(given.y), given.intervals
        if not missing.any() and (lengths is None or not len(lengths)):
            different, starts, patterns = [self._present], np.array([0, len(missing)]), [0]
        else:
            lengths = np.full(len(missing), self._dt) if lengths is None else lengths
            kinds = np.column_stack([missing, lengths])
            changes = 1 + np.flatnonzero((kinds[1:] != kinds[:-1]).any(axis=1))
            starts = np.array([0, *changes, len(missing)])
            different, patterns = np.unique(kinds[starts[:-1]], axis=0, return_inverse=True)
        steps = Steps(*map(np.concatenate, zip(*map(self._steps, different), strict=True)))
        y = np.where(missing, 0.0, given.y)
        return steps, Record(y, given.reference, starts, np.asarray(patterns))

    def _steps(self, kind: Floats) -> Steps:
        """Return the matrices of a sample, for which channels are missing in it and its length."""
        key = kind.tobytes()
        if key not in self._kept:
            if len(self._kept) >= _KEPT:
                self._kept.clear()
            missing, length = kind[:-1].astype(bool), kind[-1]
            self._kept[key] = steps_of(self._estimator, self._running, length, missing)
        return self._kept[key]
