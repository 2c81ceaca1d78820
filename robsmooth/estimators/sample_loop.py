r"""What an estimator does in one sample of a record, and the loop over samples.

The loop is compiled by numba where all functions of the nonlinearities are, or no copy runs; else
Python goes from sample to sample.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import njit
from numba.extending import is_jitted
from numpy.typing import NDArray

from robsmooth._numerics.steps import responses
from robsmooth._support.blas import one_thread
from robsmooth._support.kernels import kept
from robsmooth.systems.channels import Nonlinearity

_Vectorized = type(numba.vectorize(lambda value: value))


class Steps(NamedTuple):
    """The transposed matrices of a step, for each pattern of missing channels."""

    transition: NDArray[np.float64]  # (patterns, n, n), phi_0
    measurement: NDArray[np.float64]  # (patterns, l, n), phi_1 h B_y
    copies: NDArray[np.float64]  # (patterns, copies, n), phi_1 h B_mu
    correction: NDArray[np.float64]  # (patterns, copies, n), phi_2 h B_mu


class Record(NamedTuple):
    """The samples of a record, with zeros for what is missing."""

    y: NDArray[np.float64]  # (N, l)
    reference: NDArray[np.float64]  # (N, copies)
    starts: NDArray[np.intp]  # segment s has the samples from starts[s] to starts[s + 1] ...
    patterns: NDArray[np.intp]  # ... and the matrices of patterns[s]


def running_copies(estimator: Any) -> list[int]:
    """Return which copies are run: those with an argument and a gain."""
    system = estimator.plant.system
    inputs, arguments = estimator.B_c[:, system.l :], estimator.C_c[system.m :]
    return [i for i in range(system.g) if inputs[:, i].any() and arguments[i].any()]


@one_thread
def steps_of(estimator: Any, running: list[int], dt: float, missing: NDArray[np.bool_]) -> Steps:
    """Return the matrices of a step; C_2 x_hat + D mu is in the place of what is missing."""
    system = estimator.plant.system
    B_y, B_mu = np.hsplit(estimator.B_c, [system.l])
    _, _, D = system.stacked(system.nonlinearities)
    gain = B_y * missing
    inputs = np.hstack([B_y * ~missing, (B_mu + gain @ D)[:, running]])
    A = estimator.A_c.copy()
    A[:, : estimator.plant.n] += gain @ estimator.plant.C2_tilde[: system.l]
    transition, held, ramp = responses(A, inputs, dt)
    copies = slice(system.l, None)
    matrices = (transition, held[:, : system.l], held[:, copies], ramp[:, copies])
    return Steps(*(np.ascontiguousarray(matrix.T)[None] for matrix in matrices))


def running_functions(
    nonlinearities: Sequence[Nonlinearity],
    given: Iterable[Callable[[Any], Any] | None] | None,
    running: Sequence[int],
) -> tuple[Callable[[Any], Any], ...]:
    """Return the functions of the copies that run, with those given instead of the plant's."""
    if callable(given):
        raise TypeError("functions must be a sequence of callables, got a single one")
    given = [None] * len(nonlinearities) if given is None else list(given)
    if len(given) != len(nonlinearities):
        raise ValueError(
            f"functions must have {len(nonlinearities)} entries, one for each nonlinearity, got "
            f"{len(given)}"
        )
    pairs = zip(nonlinearities, given, strict=True)
    functions = [
        own.function if f is None else replace(own, function=f).function for own, f in pairs
    ]
    for i in running:
        if functions[i] is None:
            raise ValueError(
                f"nonlinearities[{i}] must have a function, because the estimator runs a copy of "
                "it: give Nonlinearity(..., function=psi), or discretize(dt, functions=[psi])"
            )
    return tuple(functions[i] for i in running)


def takes_numbers(function: Callable) -> bool:
    """Tell whether compiled code can call this function with a number."""
    if not (is_jitted(function) or isinstance(function, _Vectorized)):
        return False
    try:
        return np.ndim(function(0.0)) == 0
    except Exception:  # it is for arrays only
        return False


@lru_cache(maxsize=64)
def compiled_copies(functions: tuple[Callable, ...]) -> Callable:
    """Return what writes the values of all functions: the same one for the same functions."""
    if not functions:
        return _no_copies
    others, function, index = compiled_copies(functions[:-1]), functions[-1], len(functions) - 1

    @njit
    def copies(arguments, values):
        others(arguments, values)
        values[index] = function(arguments[index])

    return copies


@njit
def _no_copies(arguments, values):
    pass


def sample_loop(functions: tuple[Callable[[Any], Any], ...], compiled: bool) -> Callable:
    """Return the loop over samples, a function of what follows `copies` in `_advance`."""
    if compiled:
        return partial(_advance, compiled_copies(functions)) if functions else _advance_linear
    return partial(_interpret, Interpreted(functions))


class Interpreted:
    """Functions that are not compiled, called as compiled ones are."""

    def __init__(self, functions: Iterable[Callable[[Any], Any]]) -> None:
        self._functions = [f if takes_numbers(f) else partial(_value, f) for f in functions]

    def __call__(self, arguments: Any, values: Any) -> None:  # noqa: D102
        for i, function in enumerate(self._functions):
            values[i] = function(arguments[i])


def _value(function: Callable, argument: float) -> float:
    """Return the value of a function of arrays at a number."""
    return np.asarray(function(np.array([argument])))[0]


def sizes_of(*counts: int) -> tuple[tuple[float, ...], ...]:
    """Return tuples of these lengths, which the compiler knows, unlike those of arrays."""
    return tuple((0.0,) * count for count in counts)


@njit
def _advance(copies, sizes, steps, C_nu, readout, record, state, result):
    """Take all samples of a `Record`, and write `state` and `result`."""
    states, measurements, outputs, g = len(sizes[0]), len(sizes[1]), len(sizes[2]), len(sizes[3])
    x = np.empty((2, states))  # now, and at the end of the sample
    arguments, mu, mu_end = np.empty(g), np.empty(g), np.empty(g)
    x[0] = state
    for segment in range(len(record.patterns)):
        p = record.patterns[segment]
        for k in range(record.starts[segment], record.starts[segment + 1]):
            for i in range(states):
                x[1, i] = 0.0
            for j in range(measurements):
                for i in range(states):
                    x[1, i] += steps.measurement[p, j, i] * record.y[k, j]
            for j in range(states):
                for i in range(states):
                    x[1, i] += steps.transition[p, j, i] * x[0, j]
            if copies is not None:
                _subtract(C_nu, x, 0, record.reference, k, arguments)
                copies(arguments, mu)
                for j in range(g):
                    for i in range(states):
                        x[1, i] += steps.copies[p, j, i] * mu[j]
                _subtract(C_nu, x, 1, record.reference, k, arguments)
                copies(arguments, mu_end)
                for j in range(g):
                    for i in range(states):
                        x[1, i] += steps.correction[p, j, i] * (mu_end[j] - mu[j])
            for i in range(states):
                x[0, i] = x[1, i]
            for i in range(outputs):
                estimate = 0.0
                for j in range(states):
                    estimate += readout[i, j] * x[0, j]
                result[k, i] = estimate
    for i in range(states):
        state[i] = x[0, i]


@njit
def _subtract(C_nu, x, row, reference, k, arguments):
    """Write the copies' arguments at one of the two states."""
    for i in range(len(arguments)):
        arguments[i] = -reference[k, i]
        for j in range(x.shape[1]):
            arguments[i] += C_nu[i, j] * x[row, j]


@kept()
def _advance_linear(sizes, steps, C_nu, readout, record, state, result):
    """Do as `_advance` for an estimator without copies; it need not be compiled anew."""
    _advance(None, sizes, steps, C_nu, readout, record, state, result)


def _interpret(copies, *others):
    """Do as `_advance` with functions that are not compiled; this can be pickled by its name."""
    getattr(_advance, "py_func", _advance)(copies, *others)
