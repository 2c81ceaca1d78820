"""Plant and estimator as one nonlinear equation, and its steps: Heun's, in exponential form.

`docs/source/simulation.md` has the equation with the letters of the code. Delta has the constant
uncertainties and the statistically equivalent slopes of the nonlinearities, rho has the rest.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, expm

from robsmooth._numerics import linearisation, lyapunov, modes
from robsmooth._numerics.steps import responses
from robsmooth._support import validation
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import blocks_of, matrices, reference_outputs
from robsmooth.simulation import kernel
from robsmooth.simulation.kernel import Function
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.functions import on_arrays

Uncertainties = Sequence[ArrayLike | Callable[[float, Matrix], ArrayLike]]

_SLOPE_TOLERANCE = 1e-6  # relative to the Lipschitz constant
_SLOW = 1e-5  # of the fastest mode's rate: a slower mode hardly decays
_ZERO_DEVIATION = 1e-9  # relative to its terms: a smaller deviation is rounding


@dataclass(frozen=True, eq=False)
class NonlinearLoop:
    """The equation in the module's docstring."""

    drift: Matrix  # (N + l, N): F and the rows of y below it
    inputs: Matrix  # (N + l, r + 2g): G, the same
    noise: Matrix  # (N + l, q + g): B, the same
    arguments: Matrix  # (h + 2g, N): L - R
    reference: Matrix  # (h + 2g, N): R
    readout: Matrix  # (3m, N): rows of w, of its filtered and of its smoothed estimate
    delta: Matrix  # (r + 2g, h + 2g): Delta
    functions: tuple[Function, ...]
    lipschitz: Matrix  # (h + 2g,): a nonlinearity's constant, or one for an uncertainty
    delay: float = 0.0  # s

    @property
    def order(self) -> int:
        """N, the number of states of plant and estimator."""
        return self.drift.shape[1]

    @cached_property
    def linear_drift(self) -> Matrix:
        """F + G Delta L, and the rows of y below, 1/s."""
        return self.drift + self.inputs @ self.delta @ self.arguments

    @cached_property
    def _modes(self) -> modes.Modes | None:
        """The linear loop's modes that hardly decay and are not in the errors, or None."""
        A, B = self.linear_drift[: self.order], self.noise[: self.order]
        if not modes.hardly_decays(np.linalg.eigvals(A), _SLOW):
            return None
        w, filtered, smoothed = np.split(self.readout, 3)
        with np.errstate(over="ignore", invalid="ignore"):  # of an unstable loop
            estimates = np.vstack([filtered, smoothed @ expm(self.delay * A)])
        for found in modes.separations(A, B):
            if not found.seen_by(np.vstack([w, w]), estimates).any():
                return found
        return None

    @cached_property
    def slowest_rate(self) -> float:
        """Decay rate of the slowest mode of the errors, 1/s; not positive if they are unstable."""
        A = self.linear_drift[: self.order] if self._modes is None else self._modes.A_rest
        return modes.rates(A)[0]

    @cached_property
    def growth_rate(self) -> float:
        """Rate at which the system grows while its errors do not, 1/s, or zero."""
        return 0.0 if self._modes is None else max(0.0, -modes.rates(self._modes.A)[0])

    @cached_property
    def stationary_root(self) -> Matrix:
        """A root of the stationary covariance of the linear loop, with zero for drifting modes."""
        A, B = self.linear_drift[: self.order], self.noise[: self.order]
        found = self._modes
        if found is None:
            return lyapunov.stationary_root(A, B)
        return found.V_rest @ lyapunov.stationary_root(found.A_rest, found.W_rest @ B)

    def argument_rate(self) -> float:
        """Rate at which the functions' arguments, or outputs if there are none, move, 1/s.

        It is the largest root mean square drift of an argument over its size, or gain from one
        argument through its function to the drift of another.
        """
        root, N = self.stationary_root, self.order
        size = np.linalg.norm(self.arguments @ root, axis=1)
        used = [row for part in self.functions for row in part.outputs]
        rows = self.arguments[used] if used else self.readout
        speeds = [np.linalg.norm(rows @ self.linear_drift[:N] @ root, axis=1)]
        for part in self.functions:
            response = self.lipschitz[part.outputs] * size[part.outputs]
            if not part.elementwise:
                response = np.linalg.norm(response)
            speeds.append((np.abs(rows @ self.inputs[:N, part.inputs]) * response).max(axis=1))
        own = np.linalg.norm(rows @ root, axis=1)
        moving = own > _ZERO_DEVIATION * np.linalg.norm(np.abs(rows) @ np.abs(root), axis=1)
        rates = np.max(speeds, axis=0)[moving] / own[moving]
        return float(rates.max(initial=0.0)) or self.slowest_rate


def nonlinear_loop(smoother: Estimator, uncertainties: Uncertainties = ()) -> NonlinearLoop:
    """Return the loop of a plant and its estimator; see `simulate` for the arguments."""
    validation.instance("smoother", smoother, Estimator)
    plant, system = smoother.plant, smoother.plant.system
    delta, functions = _uncertainties(plant, uncertainties)
    drift, noise, inputs, outputs = matrices(smoother, "real", "system")
    functions += _nonlinearities(smoother, outputs)

    n, measurements, g = system.n, system.l, system.g
    kept = np.r_[:n, plant.n : len(drift)]  # without the model of the delay
    measured = np.pad(plant.C2_tilde[:measurements], ((0, 0), (0, len(smoother.A_c))))
    bounds = [c.lipschitz for c in system.nonlinearities]
    joined = NonlinearLoop(
        drift=np.vstack([drift[kept], measured])[:, kept],
        inputs=np.vstack([inputs[kept], plant.D21_tilde[:measurements]]),
        noise=np.vstack([noise[kept], plant.D21_bar[:measurements]]),
        arguments=outputs[:, kept],
        reference=np.pad(reference_outputs(smoother, "system"), ((0, 0), (n, 0))),
        readout=block_diag(system.C0, np.vstack([smoother.C_f, smoother.C_a])),
        delta=delta,
        functions=tuple(functions),
        lipschitz=np.array([1.0] * (sum(plant.output_sizes) - 2 * g) + 2 * bounds),
        delay=plant.delay,
    )
    if not joined.slowest_rate > 0.0:
        why = f"its slowest mode has the decay rate {joined.slowest_rate:.3g} 1/s"
        what = f"{why}; put their slopes at zero into A and C2"
        raise UnstableLoopError(f"the loop is not stable without its nonlinearities: {what}")
    return _linearised(joined)


def _linearised(loop: NonlinearLoop) -> NonlinearLoop:
    """Return the loop with the equivalent slopes, iterated from zero while it is stable."""
    parts = [part for part in loop.functions if part.elementwise]
    rows = [row for part in parts for row in part.inputs]
    columns = [column for part in parts for column in part.outputs]
    functions = [on_arrays(part.function) for part in parts for _ in part.inputs]

    def variances(slopes: NDArray) -> NDArray:
        nonlocal loop
        delta = loop.delta.copy()
        delta[rows, columns] = slopes
        following = replace(loop, delta=delta)
        if not following.slowest_rate > 0.0:
            raise UnstableLoopError("the statistically linearised loop is not stable")
        loop = following
        return np.linalg.norm(loop.arguments[columns] @ loop.stationary_root, axis=1) ** 2

    def slopes(variances: NDArray) -> NDArray:
        each = zip(functions, variances, strict=True)
        return np.array([linearisation.of_function(psi, variance) for psi, variance in each])

    how = {"tolerance": _SLOPE_TOLERANCE, "unit": loop.lipschitz[columns]}
    with suppress(UnstableLoopError):
        variances(linearisation.equivalent_slopes(np.zeros(len(rows)), variances, slopes, **how))
    return loop


def _uncertainties(plant: AugmentedSystem, given: Uncertainties) -> tuple[Matrix, list[Function]]:
    """Return the Delta of the constant uncertainties, and the functions of the others."""
    values = validation.sequence("uncertainties", given, f"length {plant.system.k}")
    constants = [0.0 if callable(value) else value for value in values]
    delta, functions = plant.structured_delta(constants), []
    for s, (value, block) in enumerate(zip(values, blocks_of(plant), strict=False)):
        inputs, outputs = (np.r_[each].tolist() for each in block.places[0])
        if callable(value):
            rule = f"zeta of shape ({len(outputs)}, paths) to shape ({len(inputs)}, paths)"
            rule = f"uncertainties[{s}] must map (t, zeta) with {rule}, got"
            try:
                shape = np.shape(value(0.0, np.zeros((len(outputs), 2))))
            except Exception as error:
                what = f"{type(error).__name__}: {validation.line(error)}"
                raise ValueError(f"{rule} {what}") from error
            if shape != (len(inputs), 2):
                raise ValueError(f"{rule} {shape} for 2 paths")
            functions.append(Function(inputs, outputs, value, elementwise=False))
        norm = np.linalg.norm(delta[np.ix_(inputs, outputs)], 2)
        if norm > 1.0 + 1e-12:
            got = f"got {norm:.6g}; a function (t, zeta) -> xi may have any"
            raise ValueError(f"uncertainties[{s}] must have norm at most 1 to be admissible, {got}")
    return delta, functions


def _nonlinearities(smoother: Estimator, arguments: Matrix) -> list[Function]:
    """Return the functions of the nonlinearities, and of the copies that have an effect."""
    plant, system, functions = smoother.plant, smoother.plant.system, []
    g = system.g
    r, h = sum(plant.input_sizes) - 2 * g, sum(plant.output_sizes) - 2 * g
    for i, nonlinearity in enumerate(system.nonlinearities):
        if nonlinearity.function is None:
            what = "a design does without, but a simulation needs Nonlinearity(..., function=psi)"
            raise ValueError(f"nonlinearities[{i}] has no function: {what}")
        copied = arguments[h + g + i].any() and smoother.B_c[:, system.l + i].any()
        places = [i, g + i] if copied else [i]
        inputs, outputs = [r + j for j in places], [h + j for j in places]
        functions.append(Function(inputs, outputs, nonlinearity.function, elementwise=True))
    return functions


class Steps:
    """The scheme in the module's docstring for one loop and step; `measured`: with y."""

    def __init__(self, loop: NonlinearLoop, step: float, measured: bool = False):
        N = loop.order
        size = len(loop.drift) if measured else N
        F = np.hstack([loop.linear_drift[:size], np.zeros((size, size - N))])
        driven = [row for part in loop.functions for row in part.inputs]
        columns = [row for part in loop.functions for row in part.outputs]
        transition, first, second = responses(F, loop.inputs[:size, driven], step)
        transition[:, N:] = 0.0  # the integral of y begins at zero in each step
        # w, its two estimates, zeta-tilde, the reference in it, and the mean of dy/dt
        signals = np.vstack([loop.readout, loop.arguments, loop.reference])
        signals = block_diag(signals, np.eye(size - N) / step)
        self.loop, self.step = loop, step
        self.noise = lyapunov.noise_root(F, loop.noise[:size], step)
        arguments = np.pad(loop.arguments[columns], ((0, 0), (0, size - N)))
        slopes, outputs = -loop.delta[np.ix_(driven, columns)], signals[: len(loop.readout)]
        parts = transition, first, second, *np.split(self.noise, [N], axis=1)
        parts += arguments, slopes, outputs, signals
        self.scheme = kernel.Scheme(*map(np.ascontiguousarray, parts))
        self.driven = np.array(driven, np.int64)
        ends = np.cumsum([len(part.outputs) for part in loop.functions], dtype=int)
        given = zip(loop.functions, ends, strict=True)
        self._parts = [(part, slice(end - len(part.outputs), end)) for part, end in given]

    def advance(self, time: float, z: NDArray, noise: NDArray) -> NDArray:
        """Return the states, (., paths), a step after `time`, as the kernel does."""
        rho = self._remainder(time, z)
        z = self.scheme.transition @ z + self.scheme.first @ rho + noise
        return z + self.scheme.second @ (self._remainder(time + self.step, z) - rho)

    def _remainder(self, time: float, z: NDArray) -> NDArray:
        arguments = self.scheme.arguments @ z
        values = [part.values(time, arguments[place]) for part, place in self._parts]
        return self.scheme.linear @ arguments + np.vstack([arguments[:0], *values])
