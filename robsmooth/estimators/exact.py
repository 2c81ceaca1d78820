r"""A Kalman filter and smoother of a record in discrete time, without a model of the delay.

The nominal system of a classical design, classical or tuned, is sampled exactly, with the mean of
:math:`dy/dt` over an interval as its measurement. The filter is the time-varying one: it begins
with what is known at the start, and what is missing makes it uncertain. The smoothed estimate is
that of fixed-lag smoothing of the innovations (`robsmooth.estimators.exact_loop`), exact for any
delay: one that is no whole number of samples adds the state within a sample to the model. A robust
design has no innovations of its own to smooth. It is a filter of the plant with its delay model,
and runs as such (`robsmooth.estimators.discrete`).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from robsmooth._numerics.lyapunov import covariances, noise_root
from robsmooth._numerics.modes import rates, separations
from robsmooth._numerics.steps import MULTIPLE_TOLERANCE, responses
from robsmooth._support.blas import one_thread
from robsmooth.estimators.exact_loop import (
    Memory,
    Sampled,
    advance,
    advance_linear,
    read,
    spread_of,
)
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.estimators.sample_loop import Interpreted, compiled_copies
from robsmooth.systems.delay import pade_delay

_STANDING = 1e-13  # of the fastest mode's rate: a mode that decays by less does not
_APART = 1e-7  # of that rate: what decays by more is apart from those that do not
_MOST_NUMBERS = 2e8  # in the ring of a delay
Floats = NDArray[np.float64]


class ExactFilter:
    """The classical filter and smoother of an estimator's nominal system, in steps of dt."""

    def __init__(
        self,
        estimator: Any,
        dt: float,
        running: list[int],
        functions: Sequence[Callable[[Any], Any]],
        compiled: bool,
    ) -> None:
        self._system, self._running = estimator.plant.system, running
        self._model, self._gain = estimator.nominal
        ratio = estimator.plant.delay / dt
        self.samples_back, self._part = round(ratio), 0.0
        if abs(ratio - self.samples_back) > MULTIPLE_TOLERANCE:
            self.samples_back = int(ratio)
            self._part = dt * (1.0 - (ratio - self.samples_back))  # of a sample, from its beginning
        self.states = self._model.n
        self._sampled, self._inputs = self._in_samples(dt)
        more = len(self._sampled.Phi) - self.states
        now = np.pad(self._model.C0, ((0, 0), (0, more)))
        self._outputs = {"filtered": now, "smoothed": np.roll(now, more, axis=1)}
        if self.samples_back * self._sampled.Phi.size > _MOST_NUMBERS:
            raise ValueError(
                f"dt makes {self.samples_back} samples of the delay, too many to keep: take "
                "delay='model', or a longer dt"
            )
        self._prior, self._unknown, self._stationary = self._before(in_lock=bool(functions))
        self._copies, self._compiled = None, compiled
        if functions:
            self._copies = compiled_copies(tuple(functions))
            if not compiled:
                self._copies = Interpreted(functions)

    @one_thread
    def _in_samples(self, dt: float) -> tuple[Sampled, tuple[Floats, Floats]]:
        """Return the system in samples, and what inputs held over one do to state and y."""
        model, gain, system, part = self._model, self._gain, self._system, self._part
        n, states = model.n, slice(model.n)
        B, C_nu, D = (
            each[:, self._running] if i != 1 else each[self._running]
            for i, each in enumerate(system.stacked(system.nonlinearities))
        )
        driven = np.hstack([np.vstack([B, D]), np.vstack([system.B2, system.D22])])
        whole = {
            each: np.block([[each.A, np.zeros((n, model.l))], [each.C2, np.zeros((model.l,) * 2)]])
            for each in (model, gain)
        }
        units = np.concatenate([np.ones(n), np.full(model.l, 1.0 / dt)])[:, None]
        step, held, ramp = (units * each for each in responses(whole[model], driven, dt))
        noise = np.vstack([gain.B1, gain.D21])
        root = units * noise_root(whole[gain], noise, dt)
        first = units * expm(dt * whole[gain])
        Phi, H = first[states, states], first[n:, states]
        of_model = step[states, states]
        into, change = held[states], ramp[states]
        root_x = root[states]
        if part:  # the state within a sample, too
            early = noise_root(whole[gain], noise, part)
            late = expm((dt - part) * whole[gain]) @ early
            rest = noise_root(whole[gain], noise, dt - part)
            root = units * np.hstack([late, rest])
            root_x = np.vstack([root[states], np.hstack([early[states], 0.0 * early[states]])])
            zero = np.zeros((n, n))
            Phi = np.block([[Phi, zero], [expm(part * gain.A), zero]])
            H = np.hstack([H, np.zeros_like(H)])
            within, held_within, ramp_within = responses(model.A, driven[:n], part)
            of_model = np.block([[of_model, zero], [within, zero]])
            into = np.vstack([into, held_within])
            change = np.vstack([change, part / dt * ramp_within])
        root_y, g, more = root[n:], len(self._running), len(Phi) - n
        sampled = Sampled(
            transition=of_model,
            measurement=np.pad(step[n:, states], ((0, 0), (0, more))),
            copies=np.array([into[:, :g], change[:, :g]]),
            of_copies=np.array([held[n:, :g], ramp[n:, :g]]),
            arguments=np.pad(C_nu, ((0, 0), (0, more))),
            Phi=Phi,
            H=H,
            Q=root_x @ root_x.T,
            S=root_x @ root_y.T,
            R=root_y @ root_y.T,
        )
        inputs = into[:, g:], held[n:, g:]
        return Sampled(*map(np.ascontiguousarray, sampled)), inputs

    def start(self, state: Floats | None, covariance: Floats | None) -> None:
        """Begin a record: with what is known of the state, or with nothing but its model."""
        self._begin = state, covariance
        self.memory = self._fresh(self.samples_back)
        if self._stationary and state is None and covariance is None:
            # times before the record are estimated, too
            rows, l = self.samples_back + 1, self._model.l  # noqa: E741 - the paper's letter
            nothing = np.full((rows, l), np.nan), np.zeros((rows, len(self._running))), None
            self.take(*nothing, "filtered", [0], False)

    def _fresh(self, ring: int) -> Memory:
        state, covariance = self._begin
        n, l = len(self._sampled.Phi), self._model.l  # noqa: E741
        P, x = np.zeros((n, n)), np.zeros(n)
        P[: self.states, : self.states] = self._prior if covariance is None else covariance
        x[: self.states] = 0.0 if state is None else state
        unknown = self._unknown if covariance is None else self._unknown[:, :0]
        d = unknown.shape[1]
        return Memory(
            x=x,
            P=P,
            gain=np.zeros((n, l)),
            white=np.zeros((l, l)),
            seen=np.zeros((l, n)),
            closed=np.zeros((n, n)),
            pattern=np.zeros(l, dtype=bool),
            counts=np.array([0, 0, -1 if d else 0]),
            unknown=np.vstack([unknown, np.zeros((n - self.states, d))]),
            information=np.zeros((d, d)),
            score=np.zeros(d),
            states=np.zeros((ring, n)),
            covariances=np.zeros((ring, n, n)),
            errors=np.zeros((ring, n)),
            sights=np.zeros((ring, l, n)),
            transitions=np.zeros((ring, n, n)),
            lost=np.zeros(ring, dtype=bool),
        )

    def take(
        self,
        y: Floats,
        reference: Floats,
        inputs: Floats | None,
        output: str,
        lags: Sequence[int],
        spread: bool,
    ) -> tuple[Floats, Floats]:
        """Take samples; return estimates and deviations, (rows, lags, m), the latter if wanted."""
        result = np.empty((len(y), len(lags), self._model.m))
        deviations = np.empty_like(result) if spread else result[:0]
        memory = Memory(*(each.copy() for each in self.memory))
        self._run(memory, output, lags, (y, reference, inputs), result, deviations, y[:0])
        self.memory = memory
        return result, deviations

    def whole(
        self, y: Floats, reference: Floats, inputs: Floats | None
    ) -> tuple[Floats, Floats, Floats]:
        """Return two-sided estimates, deviations and normalised innovations of a whole record."""
        memory, readout, lags = self._fresh(len(y)), self._outputs["filtered"], np.arange(len(y))
        result, normalised = np.empty((len(y), len(readout))), np.empty_like(y)
        none, deviations = np.empty((len(y), 0, len(readout))), np.zeros_like(result)
        self._run(memory, "filtered", [], (y, reference, inputs), none, none[:0], normalised)
        read(memory, readout, lags, 0, result)
        spread_of(memory, readout, lags, 0, deviations)
        return result[::-1], deviations[::-1], normalised

    def _run(
        self,
        memory: Memory,
        output: str,
        lags: Sequence[int],
        samples: tuple[Floats, Floats, Floats | None],
        *results: Floats,
    ) -> None:
        y, reference, inputs = samples
        known, drive = np.zeros_like(y), np.zeros((len(y), len(memory.x)))
        if inputs is not None:
            drive += inputs @ self._inputs[0].T
            known += inputs @ self._inputs[1].T
        how = self._outputs[output], np.array(lags, dtype=int), self._within(output)
        run = advance_linear
        if self._copies is not None:
            run = partial(
                advance if self._compiled else getattr(advance, "py_func", advance), self._copies
            )
        try:
            run(self._sampled, memory, *how, (y, known, drive, reference), *results)
        except np.linalg.LinAlgError:
            memory.P[:] = np.inf
        if not np.isfinite(memory.x).all():
            raise ArithmeticError("the estimator's state left the range of floating-point numbers")
        if not np.isfinite(memory.P).all():
            raise ArithmeticError(
                "the covariance of the error left the range of floating-point numbers: with too "
                "few samples, what is known of a mode that grows is lost"
            )

    def _within(self, output: str) -> int:
        return int(output == "smoothed" and self._part > 0.0)

    @property
    def state(self) -> Floats:
        """The estimate of the system's state now."""
        return self.memory.x[: self.states]

    def estimate(self, output: str) -> Floats:
        """Return an estimate now, as the last sample left it."""
        lag = self.samples_back if output == "smoothed" else 0
        result = np.empty((1, self._model.m))
        read(self.memory, self._outputs[output], np.array([lag]), self._within(output), result)
        return result[0]

    def _before(self, in_lock: bool) -> tuple[Floats, Floats, bool]:
        """Return what is known before any sample.

        That is the covariance of the state, the modes that are not known at all, in units of the
        filter's deviations, and whether the covariance is stationary. A filter that runs copies is
        in lock: it begins with its own covariance, for what copies do depends on the estimate.
        """
        A, B = self._gain.A, self._gain.B1
        slowest, fastest = rates(A)
        if slowest > _STANDING * fastest:
            return covariances(A, B).stationary, np.zeros((len(A), 0)), True
        V = W = np.eye(len(A))
        rest = np.zeros_like(A)
        for found in separations(A, B):
            if rates(found.A_rest)[0] > _APART * fastest:
                V, W, below = found.V, found.W, found.W_rest
                inner = covariances(found.A_rest, below @ B).stationary
                rest = found.V_rest @ inner @ found.V_rest.T
        P, _ = kalman_gain(self._gain, pade_delay(0.0, 0, self._model.m))
        unknown = V * np.sqrt(np.diag(W @ P @ W.T))
        if in_lock:
            return rest + unknown @ unknown.T, unknown[:, :0], False
        return rest, unknown, False
