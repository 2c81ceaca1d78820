"""An estimator in discrete time, for a record: an `ExactFilter` or else a `HeldEstimator`."""

import warnings
from collections.abc import Callable, Iterable
from copy import deepcopy
from os import PathLike
from threading import RLock
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._support import validation
from robsmooth._support.errors import LongStepWarning
from robsmooth.estimators.copies import Functions, running_copies, running_functions
from robsmooth.estimators.exact import ExactFilter
from robsmooth.estimators.exports import Exports
from robsmooth.estimators.held import HeldEstimator
from robsmooth.estimators.sample_loop import Floats, Samples
from robsmooth.systems.system import covariance_root

Pair = tuple[Floats, Floats]
OUTPUTS = ("smoothed", "filtered")
_FLOAT, _PLAIN = np.dtype(float), (float, list, np.ndarray)  # of the samples of `step`'s short way
SHORTEST = 1e-6  # interval, times dt
_ROWS = 4096  # of samples with their own intervals, whose matrices are in memory at a time


class DiscreteSmoother(Exports):
    r"""An estimator that takes the samples of a record, one by one or many at a time.

    Made by ``estimator.discretize(dt)``; `smooth_record` smooths from file to file. Sample k,
    counted from zero since the last `reset`, is the mean of :math:`dy/dt` over the interval from
    ``k * dt`` to ``(k + 1) * dt``. Its row of the output is the estimate at the interval's end: of
    w at ``(k + 1) * dt``, less the delay where it is smoothed.

    The state is kept between calls: a record in pieces gives the same rows, to the last bit, as in
    one. A call that fails leaves the state as it was.

    Attributes
    ----------
    dt, delay : float, s, the length of a sample's interval, and the delay (also ``lag``)
    exact : bool, whether the smoother is that of a nominal system, with an exact delay
    instants : bool, whether a sample is taken at its interval's end, and is no mean
    l, m, g, p : int, numbers of measurements, outputs, nonlinearities and known inputs
    compiled : bool
        Whether only compiled code runs (unless NUMBA_DISABLE_JIT is set): else 100 times slower.
    samples : int, taken since the last `reset`

    Examples
    --------
    >>> smoother = rs.baselines.fixed_lag_smoother(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    >>> discrete = smoother.discretize(dt=1e-6)
    >>> discrete.run([[0.2], [np.nan], [0.1]]).shape, discrete.times(1).round(9)  # one is missing
    ((3, 1), array([-1.e-07]))
    """

    def __init__(
        self,
        estimator: Any,  # an Estimator, which imports this module
        dt: float,
        functions: Iterable[Callable[[Any], Any] | None] | None = None,
        delay: str | None = None,
        mean: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: str = "means",
    ) -> None:
        if not hasattr(estimator, "discretize"):
            raise TypeError(f"estimator must be an Estimator, got {type(estimator).__name__}")
        self.dt: float = validation.positive("dt", dt)
        self.delay: float = estimator.plant.delay
        self.lag: float = self.delay
        if 0.0 < self.delay < self.dt / 2:
            what = f"dt={self.dt:g} s is more than twice the delay of {self.delay:g} s"
            warnings.warn(f"{what}: give both in one unit", LongStepWarning, stacklevel=3)
        system = estimator.plant.system
        self.l, self.m, self.g, self.p = system.l, system.m, system.g, system.p
        if delay is not None:
            validation.choice("delay", delay, ("exact", "model"))
        if delay == "exact" and estimator.nominal is None:
            what = "this one is a filter of the plant with its delay model: delay='model'"
            rule = "classical and tuned designs, which have a nominal system"
            raise ValueError(f"delay 'exact' is for {rule}; {what}")
        self.exact: bool = estimator.nominal is not None and delay != "model"
        mean = np.zeros(system.n) if mean is None else mean
        self._mean = validation.matrix("mean", mean, [system.n])
        offset = validation.matrix("offset", [0.0] * self.l if offset is None else offset, [self.l])
        validation.choice("samples", samples, ("means", "instants"))
        self.instants: bool = samples == "instants"
        self.estimator, self.functions = estimator, functions
        how = {"dt": self.dt, "delay": "exact" if self.exact else "model", "samples": samples}
        self.made_with = how | {"mean": self._mean.tolist(), "offset": offset.tolist()}
        self._offset = offset + system.C2 @ self._mean
        self._w = system.C0 @ self._mean
        self._running = running_copies(estimator)
        arguments = [c.C @ self._mean for c in system.nonlinearities]
        self._shift = np.array(arguments).reshape(-1)[self._running]
        run = Functions(running_functions(system.nonlinearities, functions, self._running))
        self.compiled: bool = run.compiled
        given = estimator, self.dt, self._running, run, self._shift
        self._engine: ExactFilter | HeldEstimator
        self._engine = ExactFilter(*given, self.instants) if self.exact else HeldEstimator(*given)
        if self.instants:
            self._exact("samples='instants'")
        self._moved = bool(self._mean.any() or self._offset.any())
        self._lock = RLock()
        self.reset()

    def __repr__(self) -> str:
        how = "compiled" if self.compiled else "not compiled"
        kind = "exact delay" if self.exact else "delay model"
        return (
            f"DiscreteSmoother(dt={self.dt:g} s, delay={self.delay:g} s, {kind}, "
            f"{self._engine.states} states, {self.l} measurements, {self.m} outputs, "
            f"{len(self._running)} copies, {how}, {self.samples} samples taken)"
        )

    @property
    def state(self) -> Floats:
        """A copy of the state: an exact filter's estimate of the system's, or the estimator's."""
        return self._engine.state + (self._mean if self.exact else 0.0)

    @property
    def smoothed(self) -> Floats:
        """The smoothed estimate now, (m,): of w one delay back."""
        return self._engine.estimate("smoothed") + self._w

    @property
    def filtered(self) -> Floats:
        """The filtered estimate now, (m,): of w now."""
        return self._engine.estimate("filtered") + self._w

    def times(self, rows: int, output: str = "smoothed") -> Floats:
        """Return the (rows,) times of the last estimates of an `output`, s since `reset`."""
        rows = validation.integer("rows", rows, low=0)
        if self._engine.memory.counts[3]:
            raise ValueError("rows had intervals of their own: their ends are np.cumsum(intervals)")
        if rows > self.samples:
            raise ValueError(f"rows must be at most the {self.samples} samples taken, got {rows}")
        delay = self.delay if validation.choice("output", output, OUTPUTS) == "smoothed" else 0.0
        return np.arange(self.samples - rows + 1, self.samples + 1) * self.dt - delay

    def reset(
        self,
        state: ArrayLike | None = None,
        samples: int = 0,
        *,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Begin a new record.

        Parameters
        ----------
        state : (n,) array, optional
            Of the system's mean for an exact smoother, else of the estimator; default: the model's.
        samples : int, those before, where a record is continued
        covariance : (n, n) array, optional
            Of the system's state, for an exact smoother. By default that of the model, where modes
            that do not decay are unknown: estimates are NaN until the samples determine them. With
            copies the default is the filter's own covariance, in lock.
        """
        samples = validation.integer("samples", samples, low=0)
        n = self._engine.states
        if covariance is not None:
            self._exact("covariance")
            root = covariance_root("covariance", covariance, n)
            covariance = root @ root.T
        if state is not None:
            state = validation.matrix("state", state, [n]) - (self._mean if self.exact else 0.0)
        with self._lock:
            self._engine.start(state, covariance)
            self.samples: int = samples

    def step(
        self,
        y: ArrayLike,
        *,
        reference: ArrayLike | None = None,
        inputs: ArrayLike | None = None,
        interval: float | None = None,
    ) -> Floats:
        """Take one sample; return the smoothed estimate (m,) at its end (`filtered` has the other).

        Parameters
        ----------
        y, reference, inputs : (l,), (g,) and (p,) arrays, a row of those of `run`; y may be a float
        interval : float, optional, the length of the sample's interval, s; `dt` by default
        """
        row, known = _plain(y, self.l), _plain(reference, self.g)
        is_plain = row is not None and (reference is None or known is not None)
        if is_plain and interval is None and not self.p:
            row = row - self._offset if self._moved else row
            if known is not None:
                known = known[self._running] - self._shift
            with self._lock:
                found = self._engine.step(row, known)
                if found is not None:
                    self.samples += 1
                    return found + self._w if self._moved else found
        of = {"y": y, "reference": reference, "inputs": inputs}
        sample, *beside = (
            None if each is None else np.atleast_1d(validation.numbers_of(name, each))[None]
            for name, each in of.items()
        )
        if sample.ndim != 2 or (np.ndim(y) == 0 and self.l > 1):
            raise ValueError(f"y must have shape ({self.l},), got shape {np.shape(y)}")
        given = self._given(sample, *beside, None if interval is None else [interval])
        return self._take(given, "smoothed", False)[0][0]

    @overload
    def run(self, y: ArrayLike, *, return_std: Literal[False] = False, **of: Any) -> Floats: ...
    @overload
    def run(self, y: ArrayLike, *, return_std: Literal[True], **of: Any) -> Pair: ...
    def run(
        self,
        y: ArrayLike,
        *,
        reference: ArrayLike | None = None,
        output: str = "smoothed",
        inputs: ArrayLike | None = None,
        intervals: ArrayLike | None = None,
        return_std: bool = False,
    ) -> Floats | Pair:
        r"""Take the samples of a record, or of a piece of it.

        Parameters
        ----------
        y : (N, l) array, or (N,) where l is one
            Row by row the mean of dy/dt over an interval; NaN, or masked, where it is missing.
        reference : (N, g) array, optional
            Nonlinearities act on :math:`\nu - r`, and copies on :math:`\tilde\nu - r`, with r
            constant over each interval; zero by default. In homodyne detection it is
            :math:`2\alpha\gamma` times the phase of the local oscillator. `SamplePaths` has it.
        output : {"smoothed", "filtered"}, which estimates to return
        inputs : (N, p) array, optional, the means of the system's known inputs over the intervals
        intervals : (N,) array, optional
            The lengths of the rows' intervals, s, where they are not `dt`; rounded to 1e-9 dt.
        return_std : bool
            Whether to return the errors' standard deviations, too: those of the nominal system, by
            an exact smoother. They are larger in a gap, and at both ends of a record.

        Returns
        -------
        (N, m) array
            Estimates at the ends of the intervals; `times` has the times that they belong to. An
            exact smoother has NaN where model and samples do not determine them: before the start
            of a record of a system that drifts, or whose state at the start is given, and where an
            unstable mode has grown through a long gap.
        (N, m) array, their standard deviations, with `return_std`

        Raises
        ------
        ArithmeticError
            Where the state exceeds the range of floats.
        """
        if validation.boolean("return_std", return_std):
            self._exact("return_std")
        validation.choice("output", output, OUTPUTS)
        found, spread = self._take(self._given(y, reference, inputs, intervals), output, return_std)
        return (found, spread) if return_std else found

    def two_sided(self, y: ArrayLike, **beside: ArrayLike | None) -> Pair:
        """Return the estimates that use a whole record: fixed-interval smoothing.

        The record is given as to `run`, and begins as `reset` set it. `samples` and `state` stay.

        Returns
        -------
        (N, m) array, estimates of w at the ends of the intervals
        (N, m) array, the standard deviations of their errors
        """
        found, spread = self._exact("two_sided").two_sided(self._given(y, **beside))
        return found + self._w, spread

    def innovations(self, y: ArrayLike, **beside: ArrayLike | None) -> Floats:
        """Return the (N, l) normalised innovations of a record: white, of variance one.

        An innovation is a sample less its prediction, NaN where that is missing. Those of one
        sample are made uncorrelated, and are divided by their standard deviations. The record is
        given as to `run`. `robsmooth.check_record` tests them against the model.
        """
        return self._exact("innovations").innovations(self._given(y, **beside))

    def _exact(self, name: str) -> ExactFilter:
        if isinstance(self._engine, ExactFilter):
            return self._engine
        rule = "an exact smoother, of a classical or a tuned design without delay='model'"
        advice = "take choice.candidates['classical'].estimator"
        raise ValueError(f"{name} is for {rule}: this one runs a model of its delay; {advice}")

    def _take(self, given: Samples, output: str, spread: bool) -> Pair:
        rows = len(given.y) if given.intervals is None else _ROWS
        with self._lock:
            before = self._engine.memory
            try:
                parts = (
                    Samples(*(None if each is None else each[i : i + rows] for each in given))
                    for i in range(0, len(given.y) or 1, rows or 1)
                )
                found = [self._engine.take(part, output, spread) for part in parts]
            except BaseException:
                self._engine.memory = before
                raise
            self.samples += len(given.y)
        estimates, deviations = map(np.concatenate, zip(*found, strict=True))
        estimates += self._w
        return estimates, deviations

    def _given(
        self, y: Any, reference: Any = None, inputs: Any = None, intervals: Any = None
    ) -> Samples:
        """Return a record as checked samples, with references, inputs and intervals."""
        y = checked("y", y, self.l)
        refuse("y must be finite, or nan where it is missing", y, np.isinf(y))
        reference = self._beside("reference", reference, self.g, len(y))
        if inputs is None and self.p:
            raise ValueError(f"inputs must be given: the system has {self.p}; zeros where none act")
        inputs = self._beside("inputs", inputs, self.p, len(y))
        reference = np.ascontiguousarray(reference[:, self._running] - self._shift)
        if intervals is not None and len(y):
            intervals = validation.array("intervals", intervals, ndim=1) / self.dt
            if len(intervals) != len(y) or not (intervals > SHORTEST).all():
                rule = f"the lengths of {len(y)} intervals, positive and not below {SHORTEST:g} dt"
                raise ValueError(f"intervals must be {rule}: rows in order of times have such")
            intervals = np.round(intervals, 9) * self.dt
        y = y - self._offset if self._moved else y
        return Samples(y, reference, inputs, intervals if len(y) else None)

    def _beside(self, name: str, given: ArrayLike | None, columns: int, rows: int) -> Floats:
        """Return the checked reference or inputs of a record, zero by default."""
        if given is None:
            return np.zeros((rows, columns))
        result = checked(name, given, columns)
        if len(result) != rows:
            raise ValueError(f"{name} must have {rows} rows, as y, got {len(result)}")
        refuse(f"{name} must be finite", result, ~np.isfinite(result))
        return result

    def _checkpoint(self) -> tuple[Any, int]:
        """Return the state for `_restore`."""
        with self._lock:
            return self._engine.copied(), self.samples

    def _restore(self, checkpoint: tuple[Any, int]) -> None:
        self._engine.memory, self.samples = checkpoint

    def __copy__(self) -> "DiscreteSmoother":
        return deepcopy(self)  # with a state of its own

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=RLock())


def _plain(given: Any, size: int) -> Floats | None:
    """Return a sample as an array if it is a float, a list or an array of `size` floats."""
    plain = type(given) in _PLAIN and (type(given) is not list or {*map(type, given)} == {float})
    row = np.asarray(given) if plain else None
    usual = row is not None and row.dtype is _FLOAT and row.size == size and row.ndim < 2
    return row.reshape(-1) if usual else None


def checked(name: str, given: ArrayLike, columns: int) -> Floats:
    """Return `given` as an (N, columns) array of floats; (N,) is one column."""
    if isinstance(given, str | PathLike):
        what = f"no file: pandas.read_csv reads {validation.shown(given)}"
        raise TypeError(f"{name} must be an array of numbers and {what}")
    result = validation.numbers_of(name, given)
    if result.size == 0 and result.ndim == 1:
        result = result.reshape(0, columns)
    if result.ndim == 1 and columns == 1:
        result = result[:, None]
    if result.ndim != 2 or result.shape[1] != columns:
        transposed = result.ndim == 2 and len(result) == columns
        hint = f"; {name}.T has it, a row for each sample" if transposed else ""
        raise ValueError(f"{name} must have shape (N, {columns}), got {result.shape}{hint}")
    return np.require(result, dtype=float, requirements=["C", "W"])


def refuse(rule: str, values: Floats, wrong: NDArray[np.bool_]) -> None:
    """Raise a ValueError that names the first wrong entry."""
    if wrong.any():
        row, column = divmod(int(wrong.argmax()), wrong.shape[1])
        raise ValueError(f"{rule}, got {values[row, column]} at row {row}, column {column}")
