r"""An estimator's equations in continuous time, with each sample held over its interval.

.. math::

    \dot{\hat x} = A\hat x + B_y\,y + B_\mu\,\psi(\tilde\nu - r), \qquad \tilde\nu = C_\nu\hat x .

The linear part is exact for any `dt`. The copies' part is the exponential Runge-Kutta method of
second order ETD2RK (`docs/source/records.md`). For a missing measurement the estimator takes
:math:`(C_2\hat x)_i + (\bar D_{21}\,\tilde\mu)_i`: its innovation is zero, and every set of missing
channels has matrices of its own.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import responses
from robsmooth._support.blas import one_thread
from robsmooth.estimators.copies import Functions
from robsmooth.estimators.engine import Engine, Floats, in_parts
from robsmooth.estimators.sample_loop import Reading, Sampled, Samples, Within, empty_memory, hold

_KEPT = 1000  # matrices, at most
_NO_WITHIN = Within(*np.empty((3, 0, 0, 0)))


class HeldEstimator(Engine):
    """The equations of an estimator in steps of dt; for the compiled loop, y are known inputs."""

    def __init__(
        self, estimator: Any, dt: float, running: list[int], functions: Functions, shift: Floats
    ) -> None:
        system, self.states = estimator.plant.system, len(estimator.A_c)
        if system.p:
            rule = "an exact smoother, of a classical or a tuned design without delay='model'"
            advice = "design this one for the system without B2 and D22"
            raise ValueError(f"a system with known inputs is for {rule}; {advice}")
        super().__init__(functions, estimator.C_c[system.m :][running], shift)
        self._row = np.empty((1, 0)), np.empty((1, system.l)), np.empty((1, len(running)))
        self._estimator, self._dt, self._running = estimator, dt, running
        now = np.zeros((1, 1), dtype=np.int64)
        outputs = {"smoothed": estimator.C_a.copy(), "filtered": estimator.C_f.copy()}
        self._readings = {name: Reading(C, now, now - 1, _NO_WITHIN) for name, C in outputs.items()}
        self._reading, self._kept = self._readings["smoothed"], dict[bytes, Floats]()
        self._even = self._sampled([np.append(np.zeros(system.l), dt)])
        self._transposed = self._even.model[0].T.copy()
        self._sizes = tuple((0.0,) * count for count in (self.states, system.l, system.m))

    def start(self, state: Floats | None, covariance: None) -> None:
        """Begin a record with a state, zero by default."""
        drives = self._even.model.shape[2] - self.states
        self.memory = empty_memory(self.states, 0, drives, 0, np.empty((self.states, 0)))
        self.memory.states[-1, : self.states] = 0.0 if state is None else state
        self.memory.counts[1] = 1  # no covariance changes

    def estimate(self, output: str) -> Floats:
        """Return an estimate now."""
        return self._readings[output].readout @ self.state

    def _bind(self) -> tuple[Any, ...]:
        if self._running:
            return super()._bind()
        _, y, reference = self._row
        estimate = np.empty((1, 1, len(self._reading.readout)))
        of_state = self.memory.states[-1, : self.states], self._reading.readout
        take_one = partial(hold, self._sizes, self._transposed, y, *of_state, estimate)
        return self.memory, take_one, y, reference, estimate

    def take(self, given: Samples, output: str, _spread: bool) -> tuple[Floats, Floats]:
        """Return the estimates after samples, (rows, m), and no deviations."""
        missing, lengths, memory = np.isnan(given.y), given.intervals, self.copied()
        memory.counts[3] |= lengths is not None
        reading, kinds = self._readings[output], np.empty(0, dtype=np.int64)
        result, sampled = np.empty((len(missing), 1, len(reading.readout))), self._even
        if missing.any() or lengths is not None:
            lengths = np.full(len(missing), self._dt) if lengths is None else lengths
            every = np.column_stack([missing, lengths])
            different, kinds = np.unique(every, axis=0, return_inverse=True)
            sampled = self._sampled(different)
        if sampled is self._even and not self._running:
            state = memory.states[-1, : self.states]

            def take(first: int, last: int) -> bool:
                part = given.y[first:last], state, reading.readout, result[first:last]
                return hold(self._sizes, self._transposed, *part)

            self._functions.check(in_parts(take, len(missing), self.states**2), "the estimate")
        else:
            samples = given.y[:, :0], np.where(missing, 0.0, given.y), given.reference
            results = result, result[:0], given.y[:0]
            self._advance(sampled, kinds, memory, reading, samples, results)
        self.memory = memory
        return result[:, 0], result[:0, 0]

    def _sampled(self, kinds: Iterable[Floats]) -> Sampled:
        """Return the matrices for kinds of samples: missing channels, then the length, s."""
        models = np.array([self.model(kind[:-1].astype(bool), kind[-1]) for kind in kinds])
        none = np.empty((len(models), 0, 0))
        return Sampled(np.zeros(len(models)), models, none, none)

    @one_thread
    def model(self, missing: NDArray[np.bool_], length: float) -> Floats:
        """Return the columns of the state, the copies' values and changes, and y, in a sample."""
        key = missing.tobytes() + np.float64(length).tobytes()
        if key in self._kept:
            return self._kept[key]
        estimator, system, g = self._estimator, self._estimator.plant.system, len(self._running)
        B_y, B_mu = np.hsplit(estimator.B_c, [system.l])
        _, _, D = system.stacked(system.nonlinearities)
        gain = B_y * missing
        inputs = np.hstack([(B_mu + gain @ D)[:, self._running], B_y * ~missing])
        A = estimator.A_c.copy()
        A[:, : estimator.plant.n] += gain @ estimator.plant.C2_tilde[: system.l]
        transition, held, ramp = responses(A, inputs, length)
        if len(self._kept) >= _KEPT:
            self._kept.clear()
        self._kept[key] = np.hstack([transition, held[:, :g], ramp[:, :g], held[:, g:]])
        return self._kept[key]
