r"""Plant and estimator as one nonlinear equation.

With :math:`z = [x; \hat x_p]` and the paper's channels, uncertainties, nonlinearities and copies,

.. math::

    dz &= [Fz + G\tilde\xi]\,dt + B\,dW, \qquad \tilde\zeta = Lz - Rz, \qquad
    \tilde\xi = \Delta\tilde\zeta + \rho(t, \tilde\zeta), \\
    F &= \begin{bmatrix} A & 0\\ B_yC_2 & A_c\end{bmatrix},\quad
    G = \begin{bmatrix} B_{1s} & \bar B_{1i} & 0\\ B_yD_{21,s} & B_y\bar D_{21,i} & B_\mu
        \end{bmatrix},\quad
    L = \begin{bmatrix} C_{1,s} & 0\\ \bar C_{1,i} & 0\\ 0 & \tilde C_{c,\nu}\end{bmatrix},

where :math:`\tilde B_c = [B_y\ B_\mu]`. Below them are the rows of the measurement y, on which
nothing depends. In :math:`R` are the references, rows of the estimator's state: a nonlinearity acts
on :math:`\nu_i - r_i`, and its copy on :math:`\tilde\nu_i - r_i`. The homodyne loop of
`robsmooth.homodyne.loop` is this equation with one reference, :math:`2\alpha\gamma` times the phase
of the local oscillator.

:math:`\Delta` holds the constant uncertainties and, for each nonlinearity and each copy, the slope
that is statistically equivalent to it in the loop (`robsmooth._numerics.linearisation`). What is
left, and uncertainties that are functions, are in :math:`\rho`. Any slopes describe the same loop,
but the nearer the linear loop, the better the start and the smaller the error of a step.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from robsmooth._numerics import linearisation
from robsmooth._numerics.lyapunov import stationary_root
from robsmooth._support import validation
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import Reference, matrices, reference_outputs
from robsmooth.systems.augmented import AugmentedSystem

_SLOPE_TOLERANCE = 1e-6  # relative to the Lipschitz constant
_ZERO_DEVIATION = 1e-9  # a deviation below this, relative to its terms, is rounding
_DRAWS = 64  # of the state, at which functions are compared with their slopes


class Function(NamedTuple):
    """Part of xi-tilde that is a function: of the rows `outputs` of zeta-tilde, to rows `inputs`.

    It takes the time and (len(outputs), paths), and gives (len(inputs), paths); each output makes
    its own input where it is elementwise.
    """

    inputs: list[int]
    outputs: list[int]
    function: Callable[[float, NDArray], NDArray]
    elementwise: bool


@dataclass(frozen=True, eq=False)
class NonlinearLoop:
    """The equation of the module's docstring.

    Attributes
    ----------
    drift, inputs, noise : arrays of N + l rows
        F, G and B, and the rows of y below them.
    arguments : (h + 2g, N) array
        L - R.
    reference : (h + 2g, N) array
        R.
    readout : (3m, N) array
        Rows of w, of its filtered estimate, and of its smoothed estimate.
    delta : (r + 2g, h + 2g) array
        Delta.
    functions : tuple of Function
    lipschitz : (h + 2g,) array
        What bounds the input that an output makes: a Lipschitz constant, or one.
    """

    drift: Matrix
    inputs: Matrix
    noise: Matrix
    arguments: Matrix
    reference: Matrix
    readout: Matrix
    delta: Matrix
    functions: tuple[Function, ...]
    lipschitz: Matrix

    @property
    def order(self) -> int:
        """N, the number of states of plant and estimator."""
        return self.drift.shape[1]

    @cached_property
    def linear_drift(self) -> Matrix:
        """F + G Delta L, and the rows of y below, 1/s."""
        return self.drift + self.inputs @ self.delta @ self.arguments

    @cached_property
    def slowest_rate(self) -> float:
        """Decay rate of the slowest mode of the linear loop, 1/s; not positive if unstable."""
        return float(-np.linalg.eigvals(self.linear_drift[: self.order]).real.max())

    @cached_property
    def stationary_root(self) -> Matrix:
        """A root of the stationary covariance of the linear loop, which must be stable."""
        return stationary_root(self.linear_drift[: self.order], self.noise[: self.order])

    def argument_rate(self) -> float:
        """How fast the arguments of the functions move and act on each other, 1/s.

        The largest of the root mean square drift of an argument over its size, and of the gain from
        one argument, through its function, to the drift of another. Without functions the first, of
        the outputs. It belongs to the stationary loop: the `response_time` of the homodyne loop,
        which belongs to the response to an impulse, is another, if of the same size.
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

    @cached_property
    def is_linear(self) -> bool:
        """Whether all functions are the slopes that stand in for them, where the loop is at all."""
        draws = np.random.default_rng(0).standard_normal((self.order, _DRAWS))
        arguments = self.arguments @ self.stationary_root @ draws
        replaced = np.abs(self._slopes_of_functions) @ np.abs(arguments)
        with np.errstate(all="ignore"):  # what is not a number is not linear
            left = np.abs(self.remainder(0.0, arguments))
        return bool((left <= _ZERO_DEVIATION * replaced).all())

    def remainder(self, time: float, arguments: NDArray) -> NDArray:
        """Return rho, (r + 2g, paths), of zeta-tilde, (h + 2g, paths)."""
        result = -self._slopes_of_functions @ arguments
        for part in self.functions:
            result[part.inputs] += part.function(time, arguments[part.outputs])
        return result

    @cached_property
    def _slopes_of_functions(self) -> Matrix:
        """Return the part of Delta that stands in for functions."""
        result = np.zeros_like(self.delta)
        for part in self.functions:
            result[part.inputs] = self.delta[part.inputs]
        return result


def nonlinear_loop(
    smoother: Estimator,
    uncertainties: Sequence[ArrayLike | Callable[[float, Matrix], ArrayLike]] = (),
    loop: str = "real",
    reference: Reference = "system",
) -> NonlinearLoop:
    """Join a plant and its estimator; see `simulate` for the arguments.

    Raises
    ------
    UnstableLoopError
        Where the loop is not stable without its nonlinearities.
    ValueError, TypeError
        For a bad argument, or a nonlinearity without a function.
    """
    validation.instance("smoother", smoother, Estimator)
    plant, system = smoother.plant, smoother.plant.system
    constants, functions = _uncertainties(plant, uncertainties)
    drift, noise, inputs, outputs = matrices(smoother, loop, reference)
    functions += _nonlinearities(smoother, outputs)

    n, measurements, g = system.n, system.l, system.g
    kept = np.r_[:n, plant.n : len(drift)]  # nothing depends on the model of the delay
    measured = np.pad(plant.C2_tilde[:measurements], ((0, 0), (0, len(smoother.A_c))))
    no_x = np.zeros((len(outputs), n))
    bounds = [c.lipschitz for c in system.nonlinearities]
    joined = NonlinearLoop(
        drift=np.vstack([drift[kept], measured])[:, kept],
        inputs=np.vstack([inputs[kept], plant.D21_tilde[:measurements]]),
        noise=np.vstack([noise[kept], plant.D21_bar[:measurements]]),
        arguments=outputs[:, kept],
        reference=np.hstack([no_x, reference_outputs(smoother, reference)]),
        readout=block_diag(system.C0, np.vstack([smoother.C_f, smoother.C_a])),
        delta=plant.structured_delta(constants),
        functions=tuple(functions),
        lipschitz=np.array([1.0] * (sum(plant.output_sizes) - 2 * g) + 2 * bounds),
    )
    if not joined.slowest_rate > 0.0:
        raise UnstableLoopError(
            "the loop is not stable without its nonlinearities: its slowest mode has the decay "
            f"rate {joined.slowest_rate:.3g} 1/s; put their slopes at zero into A and C2"
        )
    return _linearised(joined)


def _linearised(loop: NonlinearLoop) -> NonlinearLoop:
    """Return the loop with the statistically equivalent slopes, as far as they are found.

    They are iterated from slopes of zero; where that leads to a linear loop that is not stable,
    they are the last ones before.
    """
    pairs = [
        (part.function, row, column)
        for part in loop.functions
        if part.elementwise
        for row, column in zip(part.inputs, part.outputs, strict=True)
    ]
    functions = [lambda v, part=part: part(0.0, v[None])[0] for part, _, _ in pairs]
    places = [row for _, row, _ in pairs], [column for _, _, column in pairs]

    def variances(slopes: NDArray) -> NDArray:
        nonlocal loop
        delta = loop.delta.copy()
        delta[places] = slopes
        following = replace(loop, delta=delta)
        if not following.slowest_rate > 0.0:
            raise UnstableLoopError("the statistically linearised loop is not stable")
        loop = following
        deviations = np.linalg.norm(loop.arguments[places[1]] @ loop.stationary_root, axis=1)
        return deviations**2

    def slopes(variances: NDArray) -> NDArray:
        each = zip(functions, variances, strict=True)
        return np.array([linearisation.of_function(psi, variance) for psi, variance in each])

    with suppress(UnstableLoopError):
        found = linearisation.equivalent_slopes(
            np.zeros(len(pairs)),
            variances,
            slopes,
            tolerance=_SLOPE_TOLERANCE,
            unit=loop.lipschitz[places[1]],
        )
        variances(found)
    return loop


# --- the functions --------------------------------------------------------------------------------


def _uncertainties(plant: AugmentedSystem, given: Sequence) -> tuple[list, list[Function]]:
    """Split the uncertainties into constants, zero where they are functions, and functions."""
    if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
        raise TypeError(
            f"uncertainties must be a sequence of numbers, matrices or functions, got {given!r}"
        )
    if len(given) not in (0, plant.system.k):
        raise ValueError(f"uncertainties must have {plant.system.k} entries, got {len(given)}")
    constants, functions = [], []
    channels = zip(given, _ranges(plant.input_sizes), _ranges(plant.output_sizes), strict=False)
    for s, (value, inputs, outputs) in enumerate(channels):
        name = f"uncertainties[{s}]"
        if callable(value):
            _check_uncertainty(name, value, inputs, outputs)
            functions.append(Function(inputs, outputs, value, elementwise=False))
            constants.append(0.0)
            continue
        if np.ndim(value) == 0:
            block = validation.real(name, value) * np.eye(len(inputs), len(outputs))
        else:
            block = validation.matrix(name, value, (len(inputs), len(outputs)))
        norm = np.linalg.norm(block, 2)
        if norm > 1.0 + 1e-12:
            raise ValueError(
                f"{name} must have norm at most 1 to be admissible, got {norm:.6g}; a function "
                "(t, zeta) -> xi is simulated all the same"
            )
        constants.append(block)
    return constants, functions


def _check_uncertainty(
    name: str, function: Callable, inputs: list[int], outputs: list[int]
) -> None:
    """Check an uncertainty's function by the shape that it gives."""
    shape = np.shape(function(0.0, np.zeros((len(outputs), 2))))
    if shape != (len(inputs), 2):
        raise ValueError(
            f"{name} must map (t, zeta) with zeta of shape ({len(outputs)}, paths) to shape "
            f"({len(inputs)}, paths), got {shape} for 2 paths"
        )


def _nonlinearities(smoother: Estimator, arguments: Matrix) -> list[Function]:
    """Return the functions of the nonlinearities, and of those copies that have any effect."""
    plant, system = smoother.plant, smoother.plant.system
    inputs, outputs = sum(plant.input_sizes), sum(plant.output_sizes)
    g, functions = system.g, []
    for i, nonlinearity in enumerate(system.nonlinearities):
        if nonlinearity.function is None:
            raise ValueError(
                f"nonlinearities[{i}] has no function: a design does without, but a simulation "
                "needs Nonlinearity(..., function=psi)"
            )
        copied = arguments[outputs - g + i].any() and smoother.B_c[:, system.l + i].any()
        back = [2 * g - i, g - i] if copied else [2 * g - i]  # rows from the end
        functions.append(
            Function(
                [inputs - row for row in back],
                [outputs - row for row in back],
                _elementwise(nonlinearity.function),
                elementwise=True,
            )
        )
    return functions


def _elementwise(function: Callable) -> Callable[[float, NDArray], NDArray]:
    """Return psi as a `Function` has it; numba's functions of a number are compiled for arrays."""
    if hasattr(function, "py_func"):
        try:
            function(np.zeros(2))
        except Exception:  # a typing error, or a branch on an array
            function = numba.vectorize(function.py_func)
    return lambda _, values: function(values.ravel()).reshape(values.shape)


def _ranges(sizes: Sequence[int]) -> list[list[int]]:
    ends = np.cumsum((0, *sizes))
    return [list(range(start, end)) for start, end in pairwise(ends)]
