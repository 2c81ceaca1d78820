r"""An estimator in discrete time, for a measured record.

A record has a row for each interval of `dt`: the mean of :math:`dy/dt` over it. With `y` held at
its mean, an estimator

.. math::

    \dot{\hat x} = A\hat x + B_y\,y + B_\mu\,\psi(\tilde\nu - r), \qquad \tilde\nu = C_\nu\hat x,

is linear but for the copies, where `r` is the reference. The linear part is taken exactly, whatever
`dt`, and the copies' part by the exponential Runge-Kutta method of second order ETD2RK (S. M. Cox
and P. C. Matthews, J. Comput. Phys. 176(2), 2002),

.. math::

    a &= \varphi_0\hat x_k + \varphi_1 h\,[B_y y_k + B_\mu\,\mu(\hat x_k)], \\
    \hat x_{k+1} &= a + \varphi_2 h\,B_\mu\,[\mu(a) - \mu(\hat x_k)], \qquad
    \mu(x) = \psi(C_\nu x - r_k), \quad \varphi_j = \varphi_j(Ah),

which keeps every equilibrium. The copies' slope at zero is not moved into `A`: what is left could
have twice the Lipschitz constant, and that this is small is why long steps are stable. In the
example, at a `dt` of a third of the loop's time constant, the method's error is a thousandth of the
estimate's.

Where measurements are missing, their place is taken by what the estimator expects of them,
:math:`(C_2\hat x)_i + (\bar D_{21}\,\tilde\mu)_i`, all along the interval and not held: their
innovation is zero. This changes `A` and :math:`B_\mu`, so that every set of missing channels has
matrices of its own. In a long gap the estimates go back to the prior, zero.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._support import validation
from robsmooth.estimators import sample_loop
from robsmooth.estimators.sample_loop import Record, Steps

OUTPUTS = ("smoothed", "filtered")


class DiscreteSmoother:
    r"""An estimator that is fed the samples of a record, one by one or many at a time.

    Made by ``estimator.discretize(dt)``. Sample k, from zero since the start or the last `reset`,
    is the mean of :math:`dy/dt` over the interval from ``k * dt`` to ``(k + 1) * dt``. Its row of
    the output is the estimate at the interval's end, the smoothed one of w at
    ``(k + 1) * dt - delay``.

    The state is kept between calls: a record in pieces gives the same rows, to the last bit, as in
    one. A call that fails leaves the state as it was.

    Attributes
    ----------
    dt, delay : float
        Length of a sample's interval, and the delay of the smoothed estimate (also ``lag``), s.
    l, m, g : int, numbers of measurements, outputs and nonlinearities
    compiled : bool
        Whether samples are taken by compiled code: where the estimator runs no copies, or numba
        has compiled all functions for scalars, unless NUMBA_DISABLE_JIT is set. Others are slower
        by a factor of a hundred and more.
    samples : int, taken since the start or the last `reset`

    See Also
    --------
    smooth_record : smooths a record from file to file.

    Examples
    --------
    >>> import numpy as np
    >>> import robsmooth as rs
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
    ) -> None:
        self.dt: float = validation.positive("dt", dt)
        self.delay: float = estimator.plant.delay
        self.lag: float = self.delay
        system = estimator.plant.system
        self.l, self.m, self.g = system.l, system.m, system.g
        self._estimator, self._running = estimator, sample_loop.running_copies(estimator)
        self._C_nu = np.ascontiguousarray(estimator.C_c[system.m :][self._running])
        self._outputs = {"smoothed": estimator.C_a.copy(), "filtered": estimator.C_f.copy()}
        self._sizes = sample_loop.sizes_of(len(estimator.A_c), self.l, self.m, len(self._running))
        run = sample_loop.running_functions(system.nonlinearities, functions, self._running)
        self.compiled: bool = (
            all(map(sample_loop.takes_numbers, run)) and not numba.config.DISABLE_JIT
        )
        self._advance = sample_loop.sample_loop(run, self.compiled)
        self._patterns: dict[bytes, int] = {}  # of missing channels, to a row of the steps
        self._steps: Steps | None = None
        self._pattern(np.zeros(self.l, dtype=bool))
        self.reset()

    def __repr__(self) -> str:
        how = "compiled" if self.compiled else "not compiled"
        return (
            f"DiscreteSmoother(dt={self.dt:g} s, delay={self.delay:g} s, "
            f"{len(self._state)} states, {self.l} measurements, {self.m} outputs, "
            f"{len(self._running)} copies, {how}, {self.samples} samples taken)"
        )

    @property
    def state(self) -> NDArray[np.float64]:
        """The estimator's state now, (n_c,); a copy."""
        return self._state.copy()

    @property
    def smoothed(self) -> NDArray[np.float64]:
        """The smoothed estimate now, (m,): of w one delay back."""
        return self._outputs["smoothed"] @ self._state

    @property
    def filtered(self) -> NDArray[np.float64]:
        """The filtered estimate now, (m,): of w now."""
        return self._outputs["filtered"] @ self._state

    def times(self, rows: int, output: str = "smoothed") -> NDArray[np.float64]:
        """Return the times to which the last `rows` estimates belong.

        Parameters
        ----------
        rows : int, at most `samples`
        output : {"smoothed", "filtered"}

        Returns
        -------
        (rows,) array, s from the start or the last `reset`
        """
        rows = validation.integer("rows", rows, low=0)
        if rows > self.samples:
            raise ValueError(f"rows must be at most the {self.samples} samples taken, got {rows}")
        delay = self.delay if validation.choice("output", output, OUTPUTS) == "smoothed" else 0.0
        return np.arange(self.samples - rows + 1, self.samples + 1) * self.dt - delay

    def reset(self, state: ArrayLike | None = None, samples: int = 0) -> None:
        """Begin a new record.

        Parameters
        ----------
        state : (n_c,) array, to begin with; zero by default
        samples : int, those before, where a record is gone on with
        """
        samples = validation.integer("samples", samples, low=0)
        states = len(self._estimator.A_c)
        state = validation.array("state", np.zeros(states) if state is None else state, ndim=1)
        if state.size != states:
            raise ValueError(f"state must have {states} entries, got {state.size}")
        self._state = state.copy()
        self.samples: int = samples

    def step(self, y: ArrayLike, *, reference: ArrayLike | None = None) -> NDArray[np.float64]:
        """Take one sample.

        Parameters
        ----------
        y, reference : (l,) and (g,) arrays, a row of those of `run`

        Returns
        -------
        (m,) array, the smoothed estimate at the interval's end; `filtered` has the other
        """
        y = np.asarray(y)
        if y.ndim != 1:
            raise ValueError(f"y must have shape ({self.l},), got shape {y.shape}")
        if reference is not None:
            reference = np.asarray(reference)[None]
        return self.run(y[None], reference=reference)[0]

    def run(
        self, y: ArrayLike, *, reference: ArrayLike | None = None, output: str = "smoothed"
    ) -> NDArray[np.float64]:
        r"""Take the samples of a record, or of a piece of it.

        Parameters
        ----------
        y : (N, l) array
            Row by row the mean of dy/dt over an interval; NaN where a measurement is missing.
        reference : (N, g) array, optional
            What a detector takes off the nonlinearities' arguments, which act on :math:`\nu - r`,
            and the copies on :math:`\tilde\nu - r`, with `r` held over each interval. In homodyne
            detection that is :math:`2\alpha\gamma` times the phase of the local oscillator.
            `SamplePaths` has it beside y. Zero by default, whatever `simulate` takes by this name.
        output : {"smoothed", "filtered"}, which estimates to return

        Returns
        -------
        (N, m) array
            Estimates at the ends of the intervals; `times` has the times that they belong to.

        Raises
        ------
        ArithmeticError
            Where the state leaves the range of floats.
        """
        readout = self._outputs[validation.choice("output", output, OUTPUTS)]
        y = _checked("y", y, self.l)
        record = self._record(y, self._reference(reference, len(y)))
        state, result = self._state.copy(), np.empty((len(y), len(readout)))
        self._advance(self._sizes, self._steps, self._C_nu, readout, record, state, result)
        if not np.isfinite(state).all():
            raise ArithmeticError("the estimator's state left the range of floating-point numbers")
        self._state = state
        self.samples += len(y)
        return result

    def _reference(self, given: ArrayLike | None, rows: int) -> NDArray[np.float64]:
        """Return the reference of the copies that run."""
        if given is None:
            return np.zeros((rows, len(self._running)))
        reference = _checked("reference", given, self.g)
        if len(reference) != rows:
            raise ValueError(f"reference must have {rows} rows, as y, got {len(reference)}")
        _refuse("reference must be finite", reference, ~np.isfinite(reference))
        return np.ascontiguousarray(reference[:, self._running])

    def _record(self, y: NDArray[np.float64], reference: NDArray[np.float64]) -> Record:
        """Return the samples, in segments with the same measurements missing."""
        if np.isfinite(y).all():
            return Record(y, reference, np.array([0, len(y)]), np.zeros(1, dtype=np.intp))
        _refuse("y must be finite, or nan where it is missing", y, np.isinf(y))
        missing = np.isnan(y)
        changes = 1 + np.flatnonzero((missing[1:] != missing[:-1]).any(axis=1))
        starts = np.array([0, *changes, len(y)])
        patterns = np.array([self._pattern(row) for row in missing[starts[:-1]]])
        return Record(np.where(missing, 0.0, y), reference, starts, patterns)

    def _pattern(self, missing: NDArray[np.bool_]) -> int:
        """Return the index of the matrices for these missing channels; make them where needed."""
        key = missing.tobytes()
        if key not in self._patterns:
            steps = sample_loop.steps_of(self._estimator, self._running, self.dt, missing)
            if self._steps is not None:
                steps = Steps(*map(np.concatenate, zip(self._steps, steps, strict=True)))
            self._patterns[key], self._steps = len(self._patterns), steps
        return self._patterns[key]


def _checked(name: str, given: ArrayLike, columns: int) -> NDArray[np.float64]:
    """Return `given` as an (N, columns) array of floats."""
    try:
        result = np.asarray(given)
    except ValueError:
        raise ValueError(f"{name} must be a rectangular array of numbers") from None
    if result.dtype.kind not in "iuf" and result.size:
        raise TypeError(f"{name} must be an array of real numbers, got entries of {result.dtype}")
    if result.ndim != 2 or result.shape[1] != columns:
        hint = f"; {name}[:, None] has it" if result.ndim == 1 and columns == 1 else ""
        raise ValueError(f"{name} must have shape (N, {columns}), got {result.shape}{hint}")
    return np.require(result, dtype=float, requirements=["C", "W"])


def _refuse(rule: str, values: NDArray[np.float64], wrong: NDArray[np.bool_]) -> None:
    """Raise a ValueError that names the first entry that is wrong, if one is."""
    if wrong.any():
        row, column = divmod(int(wrong.argmax()), wrong.shape[1])
        raise ValueError(f"{rule}, got {values[row, column]} at row {row}, column {column}")
