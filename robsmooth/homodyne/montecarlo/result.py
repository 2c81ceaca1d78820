"""What a Monte Carlo returns, and the warning that it may give."""

import math
from dataclasses import dataclass, field
from typing import Any

from robsmooth._support.tables import Table
from robsmooth.simulation.statistics import MeanSquare


class LossOfLockWarning(RuntimeWarning):
    """Some of the paths slipped: their errors depend on the duration; see `in_lock` for the others.

    Examples
    --------
    >>> import warnings
    >>> import robsmooth as rs
    >>> warnings.simplefilter("ignore", rs.LossOfLockWarning)
    """


@dataclass(frozen=True)
class MonteCarloResult:
    """Mean square errors of the filter and the smoother in the nonlinear loop.

    Attributes
    ----------
    smoothed, filtered : MeanSquare
        Over all paths, rad^2; with the error of whole turns of a path that has slipped.
    smoothed_in_lock, filtered_in_lock : MeanSquare
        The same over the paths that never slipped, without control variates.
    slips, slipped_paths : int
        How many times a path has gone over to the next point, a turn away, where the loop locks;
        and how many paths have.
    runs, path_steps : int
        Independent paths, and the steps of all of them, the warm-up included.
    wall_time : float
        s, with the compilation, where there was one.
    protocol, seed, precision : str, int, str
        As asked for.
    duration, warm_up, step : float
        Of a path, in whole steps; before sampling began; of the scheme; s.
    provenance : dict
        Everything else that the numbers depend on, in a JSON form.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> result = rs.monte_carlo(rs.homodyne.PAPER, kalman, runs=64)
    >>> low, high = result.filtered.interval(0.95)
    >>> low < result.filtered.mean_square < high
    True
    """

    smoothed: MeanSquare
    filtered: MeanSquare
    smoothed_in_lock: MeanSquare
    filtered_in_lock: MeanSquare
    slips: int
    slipped_paths: int
    runs: int
    path_steps: int
    wall_time: float
    protocol: str
    duration: float
    warm_up: float
    step: float
    seed: int
    precision: str
    provenance: dict[str, Any] = field(repr=False)

    def in_lock(self) -> tuple[MeanSquare, MeanSquare]:
        """Return the filtered and the smoothed error of the paths that never slipped.

        Where none slipped, these are the errors over all paths, with control variates.
        """
        if self.slips:
            return self.filtered_in_lock, self.smoothed_in_lock
        return self.filtered, self.smoothed

    @property
    def slip_rate(self) -> float:
        """Cycle slips a second of a path, 1/s."""
        return self.slips / (self.path_steps * self.step)

    def to_dict(self) -> dict[str, Any]:
        """All fields as a dict that the json module writes; a number that is none becomes None."""
        result = dict(vars(self))
        for name, value in result.items():
            if isinstance(value, MeanSquare):
                numbers = vars(value).items()
                result[name] = {key: x if math.isfinite(x) else None for key, x in numbers}
        return result

    def __repr__(self) -> str:
        slips = self._slips
        if self.slips:
            slips += (
                f", without which smoothed {self.smoothed_in_lock}, filtered "
                f"{self.filtered_in_lock}"
            )
        return (
            f"MonteCarloResult(smoothed {self.smoothed} rad^2, filtered {self.filtered} rad^2, "
            f"{slips}; {self._setting})"
        )

    def _repr_html_(self) -> str:
        errors = {"smoothed": self.smoothed, "filtered": self.filtered}
        if self.slips:
            errors["smoothed, paths in lock"] = self.smoothed_in_lock
            errors["filtered, paths in lock"] = self.filtered_in_lock
        rows = [(name, error._repr_latex_()) for name, error in errors.items()]
        caption = f"The nonlinear loop, {self._slips}; {self._setting}."
        return Table(("estimate", "mean square error (rad²)"), rows, caption).html()

    @property
    def _slips(self) -> str:
        if not self.slips:
            return "no slips"
        return f"{self.slips} slips in {self.slipped_paths} of {self.runs} paths"

    @property
    def _setting(self) -> str:
        return (
            f"{self.protocol}: {self.runs} runs of {self.duration:.4g} s, step {self.step:.4g} s, "
            f"seed {self.seed}, {self.precision}; {self.path_steps:.3g} path-steps in "
            f"{self.wall_time:.2g} s"
        )
