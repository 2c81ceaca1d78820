r"""The steps of many paths at once: a second-order exponential integrator.

With :math:`\rho_0 = \rho(t, Lz)`, and exactly but for the course of :math:`\rho` over a step,

.. math::

    z^* = e^{F_\Delta h}z + K_1\rho_0 + \eta,\qquad
    z \leftarrow z^* + K_2\,[\rho(t + h, Lz^*) - \rho_0],\qquad F_\Delta = F + G\Delta L .

That is Heun's scheme for additive noise (P. E. Kloeden and E. Platen, "Numerical Solution of
Stochastic Differential Equations", Springer, 1992, Section 15.1) in the exponential form of
`robsmooth.estimators.discrete`: of weak order two in `h`, and exact in distribution where the loop
is linear.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.random import SFC64, Generator, SeedSequence
from numpy.typing import NDArray
from scipy.linalg import block_diag

from robsmooth._numerics.lyapunov import noise_root
from robsmooth._numerics.steps import responses
from robsmooth.simulation.loop import NonlinearLoop

CHUNK = 64  # steps for which noise is drawn ahead, and between two looks for divergence
GROWTH = 1e6  # of an output, from the first chunk on: divergence
_LARGEST = 1e290  # of an output that is zero in the first chunk: it may grow without overflow


class ExponentialIntegrator:
    """The scheme of the module's docstring for one loop and step.

    Where `measured`, y is integrated along with the state, and read out.
    """

    def __init__(self, loop: NonlinearLoop, step: float, measured: bool = False):
        N = loop.order
        size = len(loop.drift) if measured else N
        F = np.hstack([loop.linear_drift[:size], np.zeros((size, size - N))])
        self.loop, self.step = loop, step
        self.transition, self.first, self.second = responses(F, loop.inputs[:size], step)
        self.transition[:, N:] = 0.0  # the integral of y begins anew with each step
        self.noise = noise_root(F, loop.noise[:size], step)
        # w, its two estimates, zeta-tilde, the reference in it, and the mean of dy/dt
        of_state = np.vstack([loop.readout, loop.arguments, loop.reference])
        self.readout = block_diag(of_state, np.eye(size - N) / step)
        self._arguments = slice(len(loop.readout), len(loop.readout) + len(loop.arguments))

    def advance(self, time: float, z: NDArray, zeta: NDArray, noise: NDArray) -> NDArray:
        """Return the states (., paths) a step after `time`; `zeta` is zeta-tilde at `time`."""
        z = self.transition @ z + noise
        if not self.loop.functions:
            return z
        rho = self.loop.remainder(time, zeta)
        z += self.first @ rho
        predicted = self.readout[self._arguments] @ z
        z += self.second @ (self.loop.remainder(time + self.step, predicted) - rho)
        return z

    def records(
        self, seed: int, paths: Sequence[int], before: int, steps: int
    ) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Take `before` steps to time zero, and `steps` more, from a stationary start.

        Yields how many steps from time zero the first of some is, and what `readout` gives after
        each, (at most CHUNK, rows of `readout`, paths). A path that diverges is a RuntimeError.
        """
        N, measured = self.loop.order, len(self.transition) - self.loop.order
        of_state = [_generator(seed, path, 0) for path in paths]
        of_measurement = [_generator(seed, path, 1) for path in paths if measured]
        z = np.zeros((N + measured, len(paths)))
        root = self.loop.stationary_root
        z[:N] = root @ _normals(of_state, 1, N)[0, : root.shape[1]]
        zeta = self.readout[self._arguments] @ z
        limit = None
        for start in range(-before, steps, CHUNK):
            count = min(CHUNK, steps - start)
            normals = _normals(of_state, count, N)
            if measured:
                normals = np.hstack([normals, _normals(of_measurement, count, measured)])
            noise = self.noise @ normals
            records = np.empty((count, len(self.readout), len(paths)))
            with np.errstate(over="ignore", invalid="ignore"):
                for k in range(count):
                    z = self.advance((start + k) * self.step, z, zeta, noise[k])
                    np.matmul(self.readout, z, out=records[k])
                    zeta = records[k, self._arguments]
            size = np.abs(records)
            if limit is None:
                largest = size.max(axis=(0, 2), where=np.isfinite(size), initial=0.0)[:, None]
                limit = np.where(largest > 0.0, GROWTH * largest, _LARGEST)
            grown = limit * math.exp(self.loop.growth_rate * self.step * (before + start + count))
            if not (size <= grown).all():  # nor is it with a NaN
                step, _, column = np.argwhere(~(size <= grown))[0]
                raise RuntimeError(
                    f"path {paths[column]} of seed {seed} diverges: by "
                    f"{(start + step + 1) * self.step:.4g} s an output is not a number or beyond "
                    f"{GROWTH:g} times its size at the start; the loop is not stable, or the step, "
                    f"{self.step:.4g} s, too long for it"
                )
            yield start + 1, records


def _generator(seed: int, path: int, stream: int) -> Generator:
    return Generator(SFC64(SeedSequence(seed, spawn_key=(path, stream))))


def _normals(generators: Sequence[Generator], count: int, width: int) -> NDArray[np.float64]:
    """Draw (count, width, paths): each path's numbers are in the order of time."""
    drawn = np.empty((len(generators), count, width))
    for generator, part in zip(generators, drawn, strict=True):
        generator.standard_normal(out=part)
    return np.ascontiguousarray(np.moveaxis(drawn, 0, 2))
