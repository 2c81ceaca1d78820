r"""A classical design's nominal system in samples of any length, exactly.

A sample is the mean of :math:`dy/dt` over its interval, or :math:`C_2x + D\mu + D_{22}u + v` at the
instant of its end. For any length, `v` has the variance of the noise of a mean over ``dt``.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.linalg import expm

from robsmooth._numerics.lyapunov import noise_root
from robsmooth._numerics.steps import responses
from robsmooth._support.blas import one_thread
from robsmooth.estimators.sample_loop import Floats, Sampled, Samples, Within


class SampledModel:
    """The nominal system of an estimator: the model that predicts, and the one for the gain."""

    def __init__(self, estimator: Any, dt: float, running: list[int], instants: bool) -> None:
        system, self.dt, self._instants = estimator.plant.system, dt, instants
        self._model, self._gain = estimator.nominal
        self.n, self.l, self.g = system.n, system.l, len(running)
        B, C, D = system.stacked(system.nonlinearities)
        self.arguments = np.ascontiguousarray(C[running])
        self._into = np.hstack([B[:, running], system.B2])
        self._direct = np.hstack([D[:, running], system.D22])
        self._noise = np.vstack([self._gain.B1, self._gain.D21])
        # A, with rows that integrate the measurement; for instants, its noise alone
        self._whole = [
            np.pad(np.vstack([each.A, (not instants) * each.C2]), ((0, 0), (0, self.l)))
            for each in estimator.nominal
        ]

    def _readout(self, system: Any, length: float) -> Floats:
        """Return rows for the state and the sample, of the state and the integral."""
        over = math.sqrt(length * self.dt) if self._instants else length
        sample = np.hstack([self._instants * system.C2, np.eye(self.l) / over])
        return np.vstack([np.eye(self.n, self.n + self.l), sample])

    def nothing(self, rows: int) -> Samples:
        """Return missing samples, with references and inputs of zero."""
        inputs = np.zeros((rows, self._into.shape[1] - self.g))
        return Samples(np.full((rows, self.l), np.nan), np.zeros((rows, self.g)), inputs, None)

    @one_thread
    def sampled(self, lengths: Iterable[float]) -> Sampled:
        """Return the system in samples of these lengths, s."""
        found = [self._sampled(length) for length in lengths]
        return Sampled(*map(np.array, zip(*found, strict=True)))

    def _sampled(self, length: float) -> tuple[Any, ...]:
        model, gain = self._whole
        direct, instants = self._direct, self._instants
        into = np.vstack([self._into, np.zeros_like(direct) if instants else direct])
        step, held, ramp = responses(model, into, length)
        end = self._readout(self._model, length)
        driven = end @ self._drive(held, ramp)
        driven[self.n :] += instants * self._drive(direct, direct)
        root = self._readout(self._gain, length) @ noise_root(gain, self._noise, length)
        through = self._readout(self._gain, length) @ expm(length * gain)[:, : self.n]
        return length, np.hstack([end @ step[:, : self.n], driven]), through, root @ root.T

    def _drive(self, held: Floats, ramp: Floats) -> Floats:
        """Return the columns of the copies' values, their changes and the inputs."""
        return np.hstack([held[:, : self.g], ramp[:, : self.g], held[:, self.g :]])

    @one_thread
    def within(self, parts: Iterable[tuple[float, float]]) -> Within:
        """Return the system at times within samples, for pairs of length and time, s."""
        found = [self._within(length, time) for length, time in parts]
        n, d = self.n, self.g + self._into.shape[1]
        if not found:
            return Within(*(np.empty((0, n, size)) for size in (n + d, n, 2 * n + self.l)))
        return Within(*map(np.array, zip(*found, strict=True)))

    def _within(self, length: float, time: float) -> tuple[Floats, ...]:
        n, gain = self.n, self._whole[1]
        step, held, ramp = responses(self._model.A, self._into, time)
        root = noise_root(gain, self._noise, time)
        at_end = self._readout(self._gain, length) @ expm((length - time) * gain) @ root
        model = np.hstack([step, self._drive(held, time / length * ramp)])
        noise = root[:n] @ np.vstack([root[:n], at_end]).T
        return model, expm(time * self._gain.A), noise
