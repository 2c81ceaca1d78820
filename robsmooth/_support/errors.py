"""The errors and the warning that a user may want to catch."""

from typing import Self


class InfeasibleDesignError(ValueError):
    """A design that the theory does not allow: one of its conditions fails.

    Attributes
    ----------
    condition : str
        The condition that fails, as the paper names it, e.g. ``"Assumption 3.2"``.
    """

    def __init__(self, condition: str, detail: str, verb: str = "fails") -> None:
        super().__init__(f"{condition} {verb}: {detail}")
        self.condition = condition
        self.detail = detail
        self.verb = verb

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, str]]:
        return type(self), (self.condition, self.detail, self.verb)


class UnstableLoopError(ValueError):
    """A closed loop without a stationary covariance: it is not asymptotically stable."""


class CoarseDelayWarning(RuntimeWarning):
    """The delay's model is too coarse: the smoothed estimate is worse than the filtered one.

    Examples
    --------
    >>> import warnings
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.001]])
    >>> with warnings.catch_warnings(record=True) as given:
    ...     warnings.simplefilter("always")
    ...     choice = rs.best_smoother(rs.augment(system, delay=0.5, order=2))
    >>> given[0].category.__name__
    'CoarseDelayWarning'
    """


class LongStepWarning(RuntimeWarning):
    """The step is long for the loop: the results of the simulation depend on it.

    Examples
    --------
    >>> import warnings
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> with warnings.catch_warnings(record=True) as given:
    ...     warnings.simplefilter("always")
    ...     result = rs.monte_carlo(rs.homodyne.PAPER, kalman, runs=64, step=2e-6)
    >>> given[0].category.__name__
    'LongStepWarning'
    """
