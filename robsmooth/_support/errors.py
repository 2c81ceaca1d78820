"""The errors and the warning that a user may want to catch."""


class InfeasibleDesignError(ValueError):
    """There is no such design: a condition of the theory fails.

    Attributes
    ----------
    condition : str, the one that fails, as the paper names it, e.g. ``"Assumption 3.2"``
    """

    def __init__(self, condition: str, detail: str, verb: str = "fails") -> None:
        super().__init__(condition, detail, verb)
        self.condition = condition
        self.detail = detail

    def __str__(self) -> str:
        return "{0} {2}: {1}".format(*self.args)


class UnstableLoopError(ValueError):
    """A closed loop is not asymptotically stable: it has no stationary covariance."""


class CoarseDelayWarning(RuntimeWarning):
    """The delay's model is too coarse: the smoothed estimate is worse than the filtered one."""


class LongStepWarning(RuntimeWarning):
    """The step is long: a simulation depends on it, or samples are longer than a delay."""
