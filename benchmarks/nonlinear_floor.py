r"""The least errors that are possible in the paper's loop with its sine, by Bayes' rule on a grid.

A filter keeps the density of the phase, given all measurements, at the points of a grid, and its
mean steers the loop's local oscillator. With a step h the measurement, over twice the amplitude, is

.. math::

    z_k = \sin(\varphi_k - m_k) + \frac{g_k}{2\alpha\sqrt h},

where :math:`m_k` is the mean of :math:`\varphi_k` given :math:`z_1, \dots, z_{k-1}`, and
:math:`\varphi` is an exact Ornstein-Uhlenbeck sequence. The smoothed estimate is the mean of
:math:`\varphi_{k-L}` given :math:`z_1,\dots,z_k`: the density of then times the likelihood of what
was measured since, which a recursion backwards over the lag finds. Sums over the grid are exact to
seven digits.

In the loop without the sine the same noise goes through a Kalman filter and smoother, whose errors
are known: they are control variates. What the sine adds to the errors of the loop without it is
extrapolated from two steps to none, and added to the exact errors without a step.

The loop is steered by the filter's mean; no estimator of a loop that is steered so is better. Run
as ``python -m benchmarks.nonlinear_floor``; it writes ``data/nonlinear_floor.json``.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from robsmooth._support import files
from robsmooth._support.progress import progress_bar
from robsmooth.estimators import baselines
from robsmooth.homodyne import PAPER, HomodyneParameters
from robsmooth.paper.published import DELAY, NONLINEAR_FLOOR, data_folder
from robsmooth.workbench import provenance

Array = NDArray[np.float64]
OUTPUTS = ("smoothed", "filtered")
LAGS = (31, 62)  # steps in the delay
SEED = 2013
SECONDS = 600.0
_RUNS, _SAMPLES = 16, 200  # loops of a round, and samples of each, a delay apart
_WARM = 20  # delays before the first sample
_SPACING = 1.5  # points of the grid in a standard deviation of what a step adds to the phase
_BAND = 6.5  # of these standard deviations: further a step does not go
_REACH = 5.5  # of the grid, in standard deviations of the phase
_START = 0.3  # rad, the standard deviation of the first phase: in lock
_NEGLIGIBLE = 1e-14  # of the largest density


@dataclass(frozen=True)
class SampledLoop:
    """The loop with `lag` steps in the delay (s); without its sine where it is `linear`."""

    parameters: HomodyneParameters
    delay: float
    lag: int
    linear: bool = False

    @property
    def step(self) -> float:
        """Return the time step, s."""
        return self.delay / self.lag

    @property
    def decay(self) -> float:
        """Return the factor of a step on the phase."""
        return float(np.exp(-self.parameters.lam * self.step))

    @property
    def diffusion(self) -> float:
        """Return the variance that a step adds to the phase, rad^2."""
        return self.parameters.kappa * (1.0 - self.decay**2) / (2.0 * self.parameters.lam)

    @property
    def noise(self) -> float:
        """Return the variance of a measurement, rad^2."""
        return 1.0 / (4.0 * self.parameters.alpha**2 * self.step)

    @cached_property
    def grid(self) -> Array:
        """Return the phases at which densities are kept, rad."""
        reach = _REACH * np.sqrt(self.parameters.kappa / (2.0 * self.parameters.lam))
        spacing = np.sqrt(self.diffusion) / _SPACING
        half = int(np.ceil(reach / spacing))
        return np.arange(-half, half + 1) * spacing

    @cached_property
    def transition(self) -> tuple[NDArray[np.int64], Array]:
        """Return the density of the next phase (a row) given the last, where it is not negligible.

        Each row has its first column; the spacing of the grid is a factor.
        """
        width = 2 * int(np.ceil(_BAND * _SPACING)) + 1
        nearest = np.searchsorted(self.grid, self.grid / self.decay)
        first = np.clip(nearest - width // 2, 0, self.grid.size - width)
        last = self.grid[first[:, None] + np.arange(width)]
        moved = (self.grid[:, None] - self.decay * last) / np.sqrt(self.diffusion)
        return first, np.exp(-(moved**2) / 2.0) / (np.sqrt(2.0 * np.pi) * _SPACING)

    @cached_property
    def kalman(self) -> tuple[float, float, float, Array]:
        """Return error, gain and innovation's variance of the linear loop's filter, and weights.

        The weights are those of the innovations since, oldest first, in the smoothed estimate.
        """
        predicted = self.diffusion
        for _ in range(100 * self.lag):
            filtered = predicted * self.noise / (predicted + self.noise)
            predicted = self.decay**2 * filtered + self.diffusion
        innovation = predicted + self.noise
        error, gain = predicted * self.noise / innovation, predicted / innovation
        ages = np.arange(self.lag)
        weights = error * self.decay * (self.decay * (1.0 - gain)) ** ages / innovation
        return error, gain, innovation, weights

    @property
    def linear_errors(self) -> Array:
        """Return the smoothed and the filtered mean square error of the linear loop, rad^2."""
        error, _, innovation, weights = self.kalman
        return np.array([error - innovation * (weights**2).sum(), error])

    def errors(self, runs: int, samples: int, seed: Sequence[int]) -> Array:
        """Simulate loops in lock; return (4, runs, samples) errors, rad.

        The smoothed and the filtered one by Bayes' rule, and those of the Kalman smoother and
        filter in the loop without the sine, with the same noise.
        """
        random = np.random.default_rng(seed)
        _, gain, _, weights = self.kalman
        constants = self.decay, np.sqrt(self.diffusion), self.noise, gain
        found = np.empty((runs, _WARM + samples, 4))
        for path in found:
            _simulate(random, self.grid, *self.transition, weights, constants, self.linear, path)
        return np.moveaxis(found[:, _WARM:], -1, 0)


@njit(fastmath=True)
def _simulate(random, grid, first, transition, weights, constants, linear, path):
    """Simulate a loop; write the errors at the end of each delay to a row of `path`."""
    decay, spread, noise, gain = constants
    lag, size = weights.size, grid.size
    sines, cosines = np.sin(grid), np.cos(grid)
    likelihood, innovations = np.empty((lag, size)), np.empty(lag)
    ends = np.empty((lag + 1, 2), np.int64)  # of where the density is not negligible
    density = np.exp(-(grid**2) / (2.0 * _START**2))
    predicted = np.empty(size)
    phase, estimate, ends[lag] = _START * random.standard_normal(), 0.0, (0, size)
    for row in range(len(path)):
        then, past, past_estimate = density.copy(), phase, estimate
        ends[0] = ends[lag]
        for k in range(lag):
            phase = decay * phase + spread * random.standard_normal()
            shot = np.sqrt(noise) * random.standard_normal()
            low, high = _propagate(first, transition, density, ends[k], predicted)
            m = _mean(predicted, grid, low, high)
            z = shot + (phase - m if linear else np.sin(phase - m))
            sine, cosine = np.sin(m), np.cos(m)
            for i in range(low, high):
                seen = grid[i] - m if linear else sines[i] * cosine - cosines[i] * sine
                likelihood[k, i] = np.exp(-((z - seen) ** 2) / (2.0 * noise))
                density[i] = predicted[i] * likelihood[k, i]
            ends[k + 1] = _trim(density, low, high)
            innovations[k] = phase + shot - decay * estimate
            estimate = decay * estimate + gain * innovations[k]
        path[row, 0] = _smoothed(first, transition, likelihood, ends, then, grid) - past
        path[row, 1] = _mean(density, grid, ends[lag, 0], ends[lag, 1]) - phase
        path[row, 2] = past_estimate + weights @ innovations - past
        path[row, 3] = estimate - phase


@njit(fastmath=True)
def _propagate(first, transition, density, ends, predicted):
    """Write the density a step later; return where it begins and ends."""
    size, width = transition.shape
    low, high = ends[0], ends[1]
    begin, end = max(low - width, 0), min(high + width, size)
    for i in range(begin, end):
        total = 0.0
        for j in range(max(low - first[i], 0), min(high - first[i], width)):
            total += transition[i, j] * density[first[i] + j]
        predicted[i] = total
    return begin, end


@njit(fastmath=True)
def _trim(density, low, high):
    """Scale a density to a largest value of one; return where it is not negligible."""
    density[low:high] /= density[low:high].max()
    while density[low] < _NEGLIGIBLE:
        low += 1
    while density[high - 1] < _NEGLIGIBLE:
        high -= 1
    return low, high


@njit(fastmath=True)
def _mean(density, grid, low, high):
    return (density[low:high] * grid[low:high]).sum() / density[low:high].sum()


@njit(fastmath=True)
def _smoothed(first, transition, likelihood, ends, then, grid):
    """Return the mean of a density given what is likely since."""
    since, before = np.ones(grid.size), np.empty(grid.size)
    for k in range(len(likelihood) - 1, -1, -1):
        low, high = ends[k, 0], ends[k, 1]
        before[low:high] = 0.0
        for i in range(ends[k + 1, 0], ends[k + 1, 1]):
            value = since[i] * likelihood[k, i]
            for j in range(max(low - first[i], 0), min(high - first[i], transition.shape[1])):
                before[first[i] + j] += transition[i, j] * value
        since[low:high] = before[low:high] / before[low:high].max()
    low, high = ends[0, 0], ends[0, 1]
    return _mean(then * since, grid, low, high)


def with_control(squares: Array, expected: Array) -> tuple[Array, Array]:
    """Return means and standard errors of the first two rows of (4, N) mean squares of runs.

    The others have the expected values: they take off what chance has in common with the first.
    """
    controls = np.column_stack([np.ones(squares.shape[1]), (squares[2:] - expected[:, None]).T])
    coefficients, *_ = np.linalg.lstsq(controls, squares[:2].T, rcond=None)
    residuals = squares[:2] - (controls @ coefficients).T
    free = squares.shape[1] - len(coefficients)
    errors = np.sqrt((residuals**2).sum(axis=1) / free / squares.shape[1])
    return coefficients[0], errors


def measure(seconds: float) -> dict:
    """Simulate for some seconds, each loop at least three rounds; return what was found."""
    loops = [SampledLoop(PAPER, DELAY, lag) for lag in LAGS]
    squares: list[list[Array]] = [[] for _ in loops]
    started, bar = time.perf_counter(), progress_bar(total=round(seconds), unit="s")
    while len(squares[0]) < 3 or time.perf_counter() - started < seconds:
        for loop, of_loop in zip(loops, squares, strict=True):
            errors = loop.errors(_RUNS, _SAMPLES, (SEED, loop.lag, len(of_loop)))
            of_loop.append((errors**2).mean(axis=2))
        bar.update(min(round(time.perf_counter() - started), bar.total) - bar.n)
    bar.close()
    found = [np.concatenate(of_loop, axis=1) for of_loop in squares]
    system = PAPER.uncertain_system()
    exact = [baselines.optimal_fixed_lag_error(system, delay)[0, 0] for delay in (DELAY, 0.0)]
    return summary(loops, found, np.array(exact))


def summary(loops: Sequence[SampledLoop], squares: Sequence[Array], exact: Array) -> dict:
    """Return the errors at both steps and without a step, from (4, N) mean squares of runs."""
    steps, means, deviations = [], [], []
    for loop, of_loop in zip(loops, squares, strict=True):
        mean, deviation = with_control(of_loop, loop.linear_errors)
        means.append(mean - loop.linear_errors)
        deviations.append(deviation)
        runs, grid = of_loop.shape[1], {"points": loop.grid.size, "reach": loop.grid[-1]}
        record = {"step": loop.step, "grid": grid, "runs": runs, "samples": runs * _SAMPLES}
        steps.append(record | _by_output(mean, deviation))
    (coarse, fine), (coarse_deviation, fine_deviation) = means, deviations
    mean = exact + 2.0 * fine - coarse
    return _by_output(mean, np.hypot(2.0 * fine_deviation, coarse_deviation)) | {"steps": steps}


def _by_output(means: Array, deviations: Array) -> dict[str, dict[str, float]]:
    rows = zip(OUTPUTS, means, deviations, strict=True)
    return {name: {"mean_square": mean, "standard_error": error} for name, mean, error in rows}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the floor."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.nonlinear_floor")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="to simulate (%(default)g)")
    options = parser.parse_args(arguments)
    if not 0.0 < options.seconds < np.inf:
        parser.error(f"--seconds must be a number above zero, got {options.seconds:g}")
    started, revision = time.perf_counter(), provenance.revision()
    found = measure(options.seconds)
    command = f"python -m benchmarks.nonlinear_floor --seconds {options.seconds:g}"
    about = provenance.collect(seed=SEED, started=started, command=command)
    about["revision"] = revision  # what ran, whatever was edited meanwhile
    files.write_json(data_folder() / NONLINEAR_FLOOR, {"unit": "rad^2", **found, "about": about})
    for name in OUTPUTS:
        print(
            f"{name}: {found[name]['mean_square']:.6f} ± {found[name]['standard_error']:.6f} rad²"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
