r"""The Kalman filter and smoother of `sample_loop` for a record, without a model of the delay.

A sample is the mean of :math:`dy/dt` over its interval, or :math:`C_2x + D\mu + D_{22}u + v` at the
instant of its end. For any length, `v` has the variance of the noise of a mean over ``dt``.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from robsmooth._numerics import lyapunov, modes
from robsmooth._numerics.steps import MULTIPLE_TOLERANCE, responses
from robsmooth._support.blas import one_thread
from robsmooth.estimators import sample_loop
from robsmooth.estimators.copies import Functions
from robsmooth.estimators.engine import Engine, Floats
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.estimators.sample_loop import Memory, Reading, Sampled, Samples, Within
from robsmooth.systems.system import UncertainSystem

_STANDING = 1e-13  # of the fastest mode's rate: a mode that decays slower counts as constant
_APART = 1e-7  # of that rate: modes that decay faster are separated from the constant ones
_MOST_NUMBERS = 1e8  # in the ring of a delay


class ExactFilter(Engine):
    """The classical filter and smoother of an estimator's nominal system, in steps of dt."""

    def __init__(
        self,
        estimator: Any,
        dt: float,
        running: list[int],
        functions: Functions,
        shift: Floats,
        instants: bool,
    ) -> None:
        self._dt, self._delay = dt, estimator.plant.delay
        self._model = _SampledModel(estimator, dt, running, instants)
        super().__init__(functions, self._model.arguments, shift)
        y, reference, inputs, _ = self._model.nothing(1)
        self._row = y, inputs, reference
        self.states, self._C0 = self._model.n, np.array(estimator.nominal[0].C0, order="C")
        self._even = self._model.sampled([dt])
        ratio = self._delay / dt
        self.samples_back = math.ceil(ratio - MULTIPLE_TOLERANCE)
        part = (self.samples_back - ratio) * dt
        self._check_ring(self.samples_back, "dt")
        self._reading = self._of([self.samples_back], [(dt, part)])
        self._prior, self._unknown, self._stationary = _before(estimator.nominal[1], bool(running))

    def _check_ring(self, ring: int, name: str) -> None:
        if ring * self.states**2 > _MOST_NUMBERS:
            advice = "take a longer dt, delay='model', or a part of the record"
            raise ValueError(f"{name} makes {ring} samples, too many to keep: {advice}")

    def _of(self, lags: Any, parts: Any) -> Reading:
        """Return the reading at a lag for each row; a part is (length, time) within its sample."""
        lags = np.asarray(lags).reshape(-1, 1)
        parts = np.asarray(parts).reshape(-1, 2)
        inside = parts[:, 1] > MULTIPLE_TOLERANCE * self._dt
        different, which = np.unique(parts[inside], axis=0, return_inverse=True)
        times = np.full(lags.shape, -1)
        times[inside, 0] = which.ravel()
        return Reading(self._C0, lags, times, self._model.within(different))

    def _at(self, lags: Sequence[int]) -> Reading:
        """Return the reading at the beginnings of samples, with the same lags for all rows."""
        lags = np.array(lags, dtype=np.int64).reshape(1, -1)
        return Reading(self._C0, lags, np.full_like(lags, -1), self._reading.within)

    def start(self, state: Floats | None, covariance: Floats | None) -> None:
        """Begin a record with a mean and a covariance, by default those of the model."""
        self._begin = state, covariance
        self.memory = self._fresh(self.samples_back)
        if self._stationary and state is None and covariance is None:
            # estimates at times before the record, too
            self.take(self._model.nothing(self.samples_back + 1), "filtered", False)

    def _fresh(self, ring: int) -> Memory:
        state, covariance = self._begin
        n, l = self.states, self._model.l  # noqa: E741 - the paper's letter
        unknown = self._unknown if covariance is None else self._unknown[:, :0]
        memory = sample_loop.empty_memory(n, l, self._even.model.shape[2] - n, ring, unknown)
        memory.states[-1, :n] = 0.0 if state is None else state
        memory.covariances[-1] = self._prior if covariance is None else covariance
        return memory

    def take(self, given: Samples, output: str, spread: bool) -> tuple[Floats, Floats]:
        """Return estimates and, where `spread`, deviations, (rows, m)."""
        result = np.empty((len(given.y), 1, len(self._C0)))
        deviations = np.empty_like(result) if spread else result[:0]
        memory, reading = self.copied(), self._reading if output == "smoothed" else self._at([0])
        memory.counts[3] |= given.intervals is not None
        if memory.counts[3]:
            if given.intervals is None:
                given = given._replace(intervals=np.full(len(given.y), self._dt))
            memory, delayed = self._delayed(memory, given.intervals)
            reading = delayed if output == "smoothed" else reading
        self._run(memory, reading, given, (result, deviations, given.y[:0]))
        self.memory = memory
        return result[:, 0], deviations[:, 0]

    def two_sided(self, given: Samples) -> tuple[Floats, Floats]:
        """Return the estimates and deviations that use the whole record."""
        rows, m = len(given.y), len(self._C0)
        self._check_ring(rows, "y")
        memory, reading = self._fresh(rows), self._at(range(rows))
        none = np.empty((rows, 0, m))
        self._run(memory, self._at([]), given, (none, none[:0], given.y[:0]))
        result, deviations = np.empty((2, rows, m))
        sample_loop.read(memory, reading, 0, result)
        sample_loop.spread_of(memory, reading, 0, deviations)
        return result[::-1], deviations[::-1]

    def innovations(self, given: Samples) -> Floats:
        """Return the normalised innovations of a whole record."""
        result, none = np.empty_like(given.y), np.empty((len(given.y), 0, len(self._C0)))
        self._run(self._fresh(0), self._at([]), given, (none, none[:0], result))
        return result

    def _run(
        self, memory: Memory, reading: Reading, given: Samples, results: tuple[Floats, ...]
    ) -> None:
        sampled, kinds = self._even, np.empty(0, dtype=np.int64)
        if given.intervals is not None:
            lengths, kinds = np.unique(given.intervals, return_inverse=True)
            sampled = self._model.sampled(lengths)
        samples = given.y, given.inputs, given.reference
        self._advance(sampled, kinds, memory, reading, samples, results)

    def _delayed(self, memory: Memory, lengths: Floats) -> tuple[Memory, Reading]:
        """Return a memory that is long enough, and the reading a delay before samples' ends."""
        before = memory.intervals[_slots(memory, len(memory.states) - 1)]
        times = np.cumsum(np.concatenate([[0.0], before, lengths]))
        ends = np.arange(len(times) - max(len(lengths), 1), len(times))
        wanted = times[ends] - self._delay
        close = MULTIPLE_TOLERANCE * self._dt
        begins = np.minimum(np.searchsorted(times, wanted + close, side="right") - 1, ends)
        known = begins >= 0
        lags = np.where(known, ends - begins, sample_loop.NEVER)
        parts = np.zeros((len(ends), 2))
        inside = known & (lags > 0)
        parts[inside, 0] = (times[1:] - times[:-1])[begins[inside]]
        parts[inside, 1] = (wanted - times[begins])[inside]
        ring = int(lags.max(initial=self.samples_back, where=known))
        self._check_ring(ring, "dt")
        return _grown(memory, ring), self._of(lags, parts)

    def estimate(self, output: str) -> Floats:
        """Return the estimate after the last sample."""
        memory, reading = self.memory, self._reading if output == "smoothed" else self._at([0])
        if memory.counts[3] and output == "smoothed":
            memory, reading = self._delayed(memory, np.empty(0))
        result = np.empty((1, len(self._C0)))
        sample_loop.read(memory, reading, 0, result)
        return result[0]


class _SampledModel:
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
        root = self._readout(self._gain, length) @ lyapunov.noise_root(gain, self._noise, length)
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
        root = lyapunov.noise_root(gain, self._noise, time)
        at_end = self._readout(self._gain, length) @ expm((length - time) * gain) @ root
        model = np.hstack([step, self._drive(held, time / length * ramp)])
        return model, expm(time * self._gain.A), root[:n] @ np.vstack([root[:n], at_end]).T


def _slots(memory: Memory, ring: int) -> NDArray[np.int64]:
    """Return the rows of a ring that hold the memory's samples, from the oldest."""
    taken, kept = memory.counts[0], min(memory.counts[0], len(memory.states) - 1)
    return np.arange(taken - kept, taken) % max(ring, 1)


def _grown(memory: Memory, ring: int) -> Memory:
    """Return the memory with a ring of at least this length."""
    length = len(memory.states) - 1
    if ring <= length:
        return memory
    rings = [np.zeros((ring + 1, *old.shape[1:]), dtype=old.dtype) for old in memory[:7]]
    for new, old in zip(rings, memory, strict=False):
        new[_slots(memory, ring)], new[-1] = old[_slots(memory, length)], old[-1]
    memory.counts[1] = min(memory.counts[1], length)  # the new ring has no more
    return Memory(*rings, *memory[7:])


@one_thread
def _before(system: UncertainSystem, in_lock: bool) -> tuple[Floats, Floats, bool]:
    """Return the covariance of the first state, unknown modes, and whether it is stationary.

    A filter with copies begins in lock, with its own covariance: their outputs depend on the state.
    """
    A, B = system.A, system.B1
    slowest, fastest = modes.rates(A)
    if slowest > _STANDING * fastest:
        return lyapunov.covariances(A, B).stationary, np.zeros((len(A), 0)), True
    V = W = np.eye(len(A))
    rest = np.zeros_like(A)
    for found in modes.separations(A, B):
        if modes.rates(found.A_rest)[0] > _APART * fastest:
            V, W, below = found.V, found.W, found.W_rest
            inner = lyapunov.covariances(found.A_rest, below @ B).stationary
            rest = found.V_rest @ inner @ found.V_rest.T
    P, _ = kalman_gain(system)
    unknown = V * np.sqrt(np.diag(W @ P @ W.T))  # in units of the filter's deviations
    if in_lock:
        return rest + unknown @ unknown.T, unknown[:, :0], False
    return rest, unknown, False
