"""A test of a measured record against the model of a smoother."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2, norm

from robsmooth._support import plots, validation
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators.discrete import DiscreteSmoother

_LEVEL = 0.01  # false-alarm rate of the three tests together
_LAGS = 20  # samples, the longest lag of the correlations
_PAIRS = 50  # of samples, the fewest for a correlation, times the number of measurements


@dataclass(frozen=True, eq=False)
class RecordCheck(Frozen):
    r"""The normalised innovations of a record, and their tests: see `check_record`.

    Attributes
    ----------
    innovations : (N, l) array, by the model white, of mean zero and variance one; NaN where missing
    mean_square : float, of the normalised innovations, by the model 1
        Above 1 the record has more noise, or moves more, than the model says.
    correlations : (lags, l, l) array
        Entry (d, i, j) is that of measurement i with measurement j, d + 1 samples before, in
        standard deviations: by the model standard normal. NaN where pairs of samples are too few.
    p_mean, p_mean_square, p_white : float
        p-values of the innovations' mean, mean square and correlations: the probability that a
        record of the model is at least as far off. NaN where the record is too short.
    dt : float, s
    """

    innovations: Matrix
    mean_square: float
    correlations: Matrix
    p_mean: float
    p_mean_square: float
    p_white: float
    dt: float

    @property
    def sentence(self) -> str:
        """The result in words; its false-alarm rate is 1%."""
        found = []
        if self.p_mean < _LEVEL / 3.0:
            found.append("have a mean that is not zero (an offset, or a known input left out)")
        if self.p_mean_square < _LEVEL / 3.0:
            found.append(f"are {self.mean_square**0.5:.3g} times as large as the model says")
        if self.p_white < _LEVEL / 3.0:
            found.append("are correlated in time (a rate, a gain or a state is wrong)")
        if not found:
            return "The record agrees with the model."
        return f"The record does not agree with the model: its innovations {' and '.join(found)}."

    def __repr__(self) -> str:
        p = f"p_mean={self.p_mean:.2g}, p_mean_square={self.p_mean_square:.2g}"
        return f"RecordCheck(mean_square={self.mean_square:.4g}, {p}, p_white={self.p_white:.2g})"

    def plot(self, ax: "tuple[plots.Axes, ...] | None" = None) -> "tuple[plots.Axes, ...]":
        """Draw mean squares along the record, and correlations, into two axes, new by default."""
        along, between = plots.axes_or_new(ax, 1, 2, figsize=(7.0, 3.0))
        squares = np.array_split(self.innovations**2, min(50, len(self.innovations)))
        counts = np.array([np.isfinite(part).sum() for part in squares], dtype=float)
        counts[counts == 0.0] = np.nan
        means = np.array([np.nansum(part) for part in squares]) / counts
        time = self.dt * np.cumsum([len(part) for part in squares])
        within = {"color": "0.85", "label": "99% of the points of the model"}
        low, high = chi2.interval(1.0 - _LEVEL, counts) / counts
        along.fill_between(time, low, high, step="pre", **within)
        along.plot(time, means, "k.")
        along.set(xlabel="time (s)", ylabel="innovations squared", title="mean squares (model: 1)")
        lags = np.arange(1, 1 + len(self.correlations))
        between.axhspan(*norm.interval(1.0 - _LEVEL), **within)
        pairs = [f"y[{i}] with y[{j}] before" for i, j in np.ndindex(self.correlations.shape[1:])]
        look = {"label": pairs, "linestyle": "none", "color": "k"}
        between.set_prop_cycle(marker=[*".x+^svod*12"])
        between.plot(lags, self.correlations.reshape(len(lags), -1), **look)
        between.set(xlabel="lag (samples)", ylabel="in standard deviations", title="correlations")
        if ax is None:
            shown = between.get_legend_handles_labels()
            between.figure.legend(*shown, loc="outside lower center", ncols=3)
        return along, between


def check_record(
    smoother: DiscreteSmoother,
    y: ArrayLike,
    *,
    reference: ArrayLike | None = None,
    inputs: ArrayLike | None = None,
) -> RecordCheck:
    """Compare a record with the model that a smoother is made for, by its innovations.

    The innovations of a record of the model are white noise of known size. Three tests are of their
    mean, their mean square and their correlations in time.

    Parameters
    ----------
    smoother : DiscreteSmoother
        Of a classical or a tuned design, made by ``estimator.discretize(dt)``. Its state stays. The
        noises of a tuned design's model are not the plant's.
    y, reference, inputs : arrays, the record, as ``DiscreteSmoother.run`` takes it

    Raises
    ------
    ValueError
        For a smoother with a delay model, which has no innovations, and for a record too short.

    Examples
    --------
    A record with twice the noise that the model has:

    >>> system = rs.UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]])
    >>> smoother = rs.baselines.kalman_bucy(system).discretize(dt=0.01)
    >>> y = 2.0 * np.random.default_rng(0).standard_normal((5000, 1))
    >>> rs.check_record(smoother, y).sentence[:56]
    'The record does not agree with the model: its innovation'
    """
    validation.instance("smoother", smoother, DiscreteSmoother)
    z = smoother.innovations(y, reference=reference, inputs=inputs)
    seen = np.isfinite(z)
    values, count = np.where(seen, z, 0.0), seen.sum(axis=0)
    if len(z) <= _LAGS or not count.all():
        rule = f"y must have more than {_LAGS} rows and samples of each measurement"
        raise ValueError(f"{rule}, got {len(z)} rows with {count.tolist()} samples")
    total = (values**2).sum()
    correlations = np.array([_correlations(values, seen, d) for d in range(1, _LAGS + 1)])
    squared, known = np.nansum(correlations**2), np.isfinite(correlations).sum()
    return RecordCheck(
        innovations=z,
        mean_square=float(total / count.sum()),
        correlations=correlations,
        p_mean=float(chi2.sf((values.sum(axis=0) ** 2 / count).sum(), z.shape[1])),
        p_mean_square=float(2.0 * min(chi2.cdf(total, count.sum()), chi2.sf(total, count.sum()))),
        p_white=float(chi2.sf(squared, known)) if known else math.nan,
        dt=smoother.dt,
    )


def _correlations(values: Matrix, seen: NDArray[np.bool_], lag: int) -> Matrix:
    """Return the correlations at a lag, NaN where pairs are too few."""
    pairs = seen[lag:].T.astype(float) @ seen[:-lag]
    size = np.sqrt((values**2).sum(axis=0) / seen.sum(axis=0))
    enough = np.where((pairs < _PAIRS * values.shape[1]) | (5 * lag > len(values)), np.nan, pairs)
    with np.errstate(invalid="ignore", divide="ignore"):
        return values[lag:].T @ values[:-lag] / np.outer(size, size) / np.sqrt(enough)
