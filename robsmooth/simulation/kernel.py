r"""The compiled steps of any loop: the scheme of `robsmooth.simulation.loop`, for many paths.

One compilation serves every loop: the sizes of its matrices are known when it runs, and functions
are called by their addresses. What numba or NumPy has compiled runs without Python; other functions
are called back, with arrays. A block of paths has its own memory and sums, so results do not depend
on the number of threads.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from robsmooth._numerics.vectors import BLOCK, LANES, fma, load, store
from robsmooth._support.kernels import kept
from robsmooth._support.validation import Matrix
from robsmooth.estimators.copies import CalledFunctions, call_at, is_compiled, of_rows
from robsmooth.simulation import noise
from robsmooth.simulation.noise import DRAWS, SOURCES, WORDS, sine
from robsmooth.systems.functions import Combination, on_arrays

CHUNK = 16  # steps for which noise is drawn ahead, and between two checks
GROWTH = 1e6  # of an output over its size at the start: divergence
LARGEST = 1e290  # of an output that is zero at the start
NUMBER = (0.0,)  # of the type that sums have
TOLERANCE = 1e-6  # relative, for rounding where a constraint holds with equality


class Scheme(NamedTuple):
    """Matrices of a step; z has S rows, the integral of y included if it is measured."""

    transition: Matrix  # (S, S)
    first: Matrix  # (S, f), K_1 of the functions' values
    second: Matrix  # (S, f), K_2 of the same
    of_state: Matrix  # (S, N), the states' columns of a root of the noise's covariance
    of_measurement: Matrix  # (S, S - N), the other columns
    arguments: Matrix  # (c, S), rows of L - R, function by function
    linear: Matrix  # (f, c), what Delta has of the functions, with a minus
    outputs: Matrix  # (3m, S), w and its filtered and smoothed estimates
    signals: Matrix  # (rows, S), all that is recorded or checked


class Calls(NamedTuple):
    """The functions: function i has the arguments and values up to `ends[i]`."""

    addresses: NDArray[np.intp]  # (p,)
    ends: NDArray[np.int64]  # (p, 2)


class Checks(NamedTuple):
    """Delta, the rows of xi-tilde that functions give, and the K constraints' quadratic forms."""

    delta: Matrix
    driven: NDArray[np.int64]
    used: Matrix  # (K, ., .), M_i
    allowed: Matrix  # (K, ., .), N_i


class Memory(NamedTuple):
    """What is kept of N blocks from one call to the next."""

    generators: NDArray[np.uint32]  # (N, 2, WORDS BLOCK), of the state's noise, the measurement's
    states: Matrix  # (N, S, BLOCK)
    past: Matrix  # (N, lag + 1, m, BLOCK), w in the last steps, a ring
    sizes: Matrix  # (N, rows), the largest signals of the start
    averages: Matrix  # (N, 2 + 3K, BLOCK), sums until the end
    diverged: NDArray[np.int64]  # (N, 2), path and step of the first divergence, or -1


def empty_memory(scheme: Scheme, blocks: int, lag: int, constraints: int) -> Memory:
    """Return the memory of blocks that have not begun."""
    (m, S), rows = scheme.outputs.shape, len(scheme.signals)
    return Memory(
        generators=np.empty((blocks, 2, WORDS * BLOCK), np.uint32),
        states=np.zeros((blocks, S, BLOCK)),
        past=np.zeros((blocks, lag + 1, m // 3, BLOCK)),
        sizes=np.zeros((blocks, rows)),
        averages=np.zeros((blocks, 2 + 3 * constraints, BLOCK)),
        diverged=np.full((blocks, 2), -1),
    )


@njit(forceinline=True)
def add_product(matrix, x, given, out, start=0):
    """Write to the rows of `out` those given and a matrix times those of x, from `start` on."""
    for i in range(matrix.shape[0]):
        for path in range(0, BLOCK, LANES):
            (total,) = load(given, i * BLOCK + path, NUMBER)
            for j in range(matrix.shape[1]):
                (number,) = load(x, start + j * BLOCK + path, NUMBER)
                total = fma(matrix[i, j], number, total)
            store(out, i * BLOCK + path, (total,))


@njit
def add_rows(x, y, out):
    """Write the sum of two arrays; NumPy's operators take seconds to compile for their errors."""
    for i in range(len(out)):
        for path in range(BLOCK):
            out[i, path] = x[i, path] + y[i, path]


@njit(forceinline=True)
def find_remainder(time, rows, linear, addresses, ends, zeros, z, arguments, values):
    """Write the functions' arguments in z, and their values less what is linear."""
    add_product(rows, z, zeros, arguments)
    call_blocks(time, addresses, ends, arguments, values)
    add_product(linear, arguments, values, values)


@njit(forceinline=True)
def call_blocks(time, addresses, ends, arguments, values):
    """Write the functions' values. A slice in place of a pointer would count references."""
    given, found = arguments.ctypes.data, values.ctypes.data
    for i in range(addresses.size):
        begin, begin_values = (ends[i - 1, 0], ends[i - 1, 1]) if i else (0, 0)
        size, row = BLOCK * (ends[i, 0] - begin), 8 * BLOCK
        call_at(addresses[i], time, given + row * begin, found + row * begin_values, size)


@njit
def add_errors(outputs, past, slot, counted, sums):
    """Keep w; if counted, add the squared errors of the filtered and the smoothed estimate."""
    slots, m, paths = past.shape
    for i in range(m):
        for path in range(paths):
            past[slot, i, path] = outputs[i, path]
            filtered = outputs[i, path] - outputs[m + i, path]
            smoothed = past[(slot + 1) % slots, i, path] - outputs[2 * m + i, path]
            sums[0, path] += filtered * filtered if counted else 0.0
            sums[1, path] += smoothed * smoothed if counted else 0.0


@njit
def add_energies(forms, x, out):
    """Add x' form x of each path, for each form, to the rows of `out`."""
    for k in range(len(forms)):
        for i in range(len(x)):
            for j in range(len(x)):
                entry = forms[k, i, j]
                if entry != 0.0:
                    for path in range(x.shape[1]):
                        out[k, path] += entry * x[i, path] * x[j, path]


@njit
def check_constraints(checks, zeta, subtracted, values, sums):
    """Add xi' M_i xi, zeta' N_i zeta, and whether the former is larger, to the sums.

    The second has the reference `subtracted` added to zeta again; the third compares without.
    """
    K, paths = len(checks.used), zeta.shape[1]
    xi, used = np.zeros((len(checks.delta), paths)), np.zeros((K, paths))
    left = np.zeros_like(used)
    add_product(checks.delta, zeta, xi, xi)
    for i in range(len(checks.driven)):
        row = xi[checks.driven[i] : checks.driven[i] + 1]
        add_rows(row, values[i : i + 1], row)
    add_energies(checks.used, xi, used)
    add_energies(checks.allowed, zeta, left)
    add_rows(zeta, subtracted, zeta)
    add_energies(checks.allowed, zeta, sums[K : 2 * K])
    for k in range(K):
        for path in range(paths):
            sums[k, path] += used[k, path]
            sums[2 * K + k, path] += used[k, path] > (1.0 + TOLERANCE) * left[k, path]


@njit
def find_divergence(signals, sizes, beginning, growth):
    """Return the first path with a signal that is not a number or too large, or -1."""
    found = -1
    for i in range(signals.shape[0]):
        limit = growth * (GROWTH * sizes[i] if sizes[i] > 0.0 else LARGEST)
        for path in range(signals.shape[1]):
            size = abs(signals[i, path])
            if beginning and size < np.inf:
                sizes[i] = max(sizes[i], size)
            elif not size <= limit and (found < 0 or path < found):
                found = path
    return found


@njit
def rows_of(count):
    """Return rows of zeros."""
    return noise.aligned(count * BLOCK, np.float64).reshape(count, BLOCK)


@njit
def draw(generator, size, count, normals):
    """Draw `size` normal variables a step for `count` steps: (count, at least size, BLOCK)."""
    pairs = (size + DRAWS - 1) // DRAWS
    noise.fill_gaussians(generator, count * pairs, normals)
    return normals[: count * pairs * DRAWS * BLOCK].reshape(count, pairs * DRAWS, BLOCK)


@njit
def advance_block(scheme, calls, checks, memory, run, path, start, count, records):
    """Take steps of the block from `path` on; before step zero nothing is averaged."""
    # out of the tuples once: each time it counts a reference
    generators, states, past, sizes, averages, diverged = memory
    step, growth_rate, lag, before, _ = run
    transition, K_1, K_2, of_state, of_measurement, rows, linear, reads, signals_of = scheme
    (addresses, ends), minus_K_2 = calls, -K_2
    (S, N), f, m = of_state.shape, K_1.shape[1], past.shape[1]
    z, new, outputs, signals = rows_of(S), rows_of(S), rows_of(3 * m), rows_of(len(signals_of))
    arguments, values, later = rows_of(len(rows)), rows_of(f), rows_of(f)
    zeros = rows_of(max(S, len(rows), len(signals_of)))
    add_rows(states, zeros, z)
    a = checks.delta.shape[1]
    space = np.empty((2, CHUNK * (S + DRAWS) * BLOCK), np.float32)
    find_remainder(start * step, rows, linear, addresses, ends, zeros, z, arguments, values)
    for first in range(start, start + count, CHUNK):
        steps = min(CHUNK, start + count - first)
        of_z = draw(generators[0], N, steps, space[0])
        of_y = draw(generators[1], S - N, steps, space[1])
        for k in range(steps):
            now = first + k + 1  # the end of the step
            add_product(of_state, of_z, zeros, new, k * of_z.shape[1] * BLOCK)
            add_product(of_measurement, of_y, new, new, k * of_y.shape[1] * BLOCK)
            add_product(transition, z, new, new)
            add_product(K_1, values, new, new)
            find_remainder(now * step, rows, linear, addresses, ends, zeros, new, arguments, later)
            add_product(K_2, later, new, z)
            add_product(minus_K_2, values, z, z)
            find_remainder(now * step, rows, linear, addresses, ends, zeros, z, arguments, values)
            add_product(reads, z, zeros, outputs)
            add_errors(outputs, past, (before + now) % (lag + 1), now > 0, averages)
            if records.size:
                add_product(signals_of, z, zeros, records[now - start - 1])
        add_product(signals_of, z, zeros, signals)
        growth = np.exp(growth_rate * step * (before + now))
        found = find_divergence(signals[:, : run[4] - path], sizes, first == -before, growth)
        if found >= 0:
            diverged[0], diverged[1] = path + found, now
            return
        if now > 0:
            zeta, subtracted = signals[3 * m : 3 * m + a], signals[3 * m + a : 3 * m + 2 * a]
            check_constraints(checks, zeta, subtracted, values, averages[2:])
    add_rows(z, zeros, states)


@kept(parallel=True, nogil=True)
def advance_blocks(
    scheme, calls, checks, memory, run, root, seed, first, start, count, records, code=SOURCES
):
    """Take `count` steps of consecutive blocks from step `start` on; at the first step they begin.

    `run` has the step, the rate of growth, the steps of the lag and before step zero, and the
    number of paths that count; `root` is one of the covariance at the start. `records`, (blocks,
    count, rows, BLOCK) or (1, 0, 0, 0), takes the signals after each step.
    """
    generators, states, past, sizes, averages, diverged = memory
    for index in prange(len(states)):
        b = np.int64(index)  # an index is unsigned
        mine = Memory(generators[b], states[b], past[b], sizes[b], averages[b], diverged[b])
        path = (first + b) * BLOCK
        if start == -run[3]:
            begin_block(mine, root, seed, path)
        if mine.diverged[0] < 0:
            record = records[b if records.size else 0]
            advance_block(scheme, calls, checks, mine, run, path, start, count, record)


@njit
def begin_block(memory, root, seed, path):
    """Start the generators, and the states from their stationary covariance."""
    noise.seed_paths(seed, np.uint64(path), memory.generators[0])
    noise.seed_paths(noise.mix(seed), np.uint64(path), memory.generators[1])
    normals = np.empty((root.shape[1] + DRAWS) * BLOCK, np.float32)
    drawn = draw(memory.generators[0], root.shape[1], 1, normals)
    add_product(root, drawn, memory.states, memory.states)


class Function(NamedTuple):
    """Part of xi-tilde that is a function."""

    inputs: list[int]  # rows of xi-tilde
    outputs: list[int]  # rows of zeta-tilde
    function: Callable  # of a number, or of t and (outputs, paths), which gives (inputs, paths)
    elementwise: bool  # whether it is of a number: an input depends on one output

    def values(self, time: float, arguments: NDArray) -> NDArray:
        """Return its values, (inputs, paths), of arguments, (outputs, paths)."""
        if self.elementwise:
            return on_arrays(self.function)(arguments.ravel()).reshape(arguments.shape)
        return self.function(time, arguments)


@lru_cache(maxsize=64)
def with_fast_sine(function: Callable) -> Callable:
    """Return a function with the vectorised sine of `noise`, to 2e-11, in the place of NumPy's."""
    if isinstance(function, Combination):
        return replace(function, function=with_fast_sine(function.function))
    return numba.njit(lambda value: sine(value)) if function is np.sin else function


def called(functions: Sequence[Function]) -> tuple[CalledFunctions, Calls]:
    """Return the functions of a loop for compiled code."""
    parts = []
    for each in functions:
        ready = each.elementwise and is_compiled(each.function)
        code = of_rows(with_fast_sine(each.function)) if ready else None
        parts.append((code, each.values, len(each.outputs), len(each.inputs)))
    sizes = np.reshape([part[2:] for part in parts], (-1, 2))
    kept = CalledFunctions(parts)
    return kept, Calls(kept.addresses, np.cumsum(sizes, axis=0, dtype=np.int64))
