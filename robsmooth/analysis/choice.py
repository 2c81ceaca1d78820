"""Which smoother to use: all candidates, judged by the same three errors."""

import math
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from robsmooth._support import tables, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import CoarseDelayWarning, InfeasibleDesignError, UnstableLoopError
from robsmooth._support.progress import progress_bar
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.covariance import error_covariance, worst_case
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.conditions import COSTS
from robsmooth.estimators.constant_minimax import constant_minimax_smoother
from robsmooth.estimators.drift import Drift
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.minimax import minimax_smoother
from robsmooth.systems.augmented import AugmentedSystem, check_is_plant

_ERRORS = {"admissible": "certified", "constant": "worst_constant"}
_WORSE = 1.01  # times the filtered error
WORTHWHILE = 0.01  # the least gain, of the classical error, for which another design is chosen
_CLASSICAL = "classical"


@dataclass(frozen=True)
class Judgement(validation.Frozen):
    """The three errors by which every estimator is judged, as `judge` finds them.

    Attributes
    ----------
    nominal, worst_constant, certified : float
        Mean square errors in a real loop, in the squared unit of w: without uncertainty, under the
        worst constant one, and the least upper bound under all admissible ones. Infinity where the
        error grows without bound, or no bound is found.
    """

    nominal: float
    worst_constant: float
    certified: float

    def __repr__(self) -> str:
        errors = ", ".join(f"{name}={error:.5g}" for name, error in vars(self).items())
        return f"Judgement({errors})"


@one_thread
def judge(estimator: Estimator, output: str = "smoothed") -> Judgement:
    """Return the nominal, the worst constant and the certified worst error of an estimator.

    Parameters
    ----------
    estimator : Estimator
    output : {"smoothed", "filtered"}, the estimate to judge; w is delayed exactly

    Examples
    --------
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.judge(ngcf, "filtered").certified, 4)
    0.1388
    """
    validation.instance("estimator", estimator, Estimator)
    validation.choice("output", output, COSTS)
    constant = worst_case(estimator, output, loop="real")
    if constant.mean_square == 0.0:  # nothing drives w, whatever the uncertainty
        return Judgement(0.0, 0.0, 0.0)
    certified = math.inf
    with suppress(UnstableLoopError, ArithmeticError):  # it grows, or the delay is too long
        certified = analysis_bound(estimator, output, loop="real").mean_square
    return Judgement(constant.nominal, constant.mean_square, certified)


@dataclass(frozen=True, eq=False)
class Candidate(validation.Frozen):
    """An estimator that `best_smoother` compares; None, and the reason, where it was refused."""

    estimator: Estimator | None = None
    judgement: Judgement = Judgement(math.inf, math.inf, math.inf)
    refused: str = ""

    def error(self, against: str) -> float:
        """Return the error to minimise."""
        return getattr(self.judgement, _ERRORS[against])


@dataclass(frozen=True, eq=False)
class Choice(validation.Frozen):
    """The best smoother of a plant, and all candidates: see `best_smoother`.

    Attributes
    ----------
    estimator : Estimator, the best; the classical one where no other is better by more than 1%
    name : str, the key of the best in `candidates`
    candidates : dict of str to `Candidate`
        Each with its `estimator` and `judgement`; `refused` says why there is no estimator.
    against, output : str, as given
    coarse : str, why the classical smoother's filter is better than it is, or empty
    """

    estimator: Estimator
    name: str
    candidates: Mapping[str, Candidate]
    against: str
    output: str
    coarse: str = ""

    @property
    def table(self) -> tables.Table:
        """Every candidate with its nominal, worst constant and certified worst error."""
        rows = []
        for name, each in self.candidates.items():
            errors = vars(each.judgement).values() if each.estimator else (None,) * 3
            refused = f"refused: {each.refused.partition(':')[0]}" if each.refused else ""
            rows.append((name, *errors, refused or ("best" if name == self.name else "")))
        columns = ("smoother", "nominal", "worst constant", "certified worst", "")
        caption = f"Mean square errors of the {self.output} estimate, in the squared unit of $w$."
        return tables.Table(columns, rows, f"{caption} {self.sentence}")

    def to_frame(self) -> "tables.DataFrame":
        """Return the candidates, their errors and why some were refused as a pandas data frame."""
        judged = [vars(c.judgement) | {"refused": c.refused} for c in self.candidates.values()]
        columns = {name: [each[name] for each in judged] for name in judged[0]}
        return tables.data_frame({"smoother": self.candidates}, columns)

    @property
    def sentence(self) -> str:
        """What robustness buys, in one sentence."""
        kind = {"admissible": "certified worst", "constant": "worst constant"}[self.against]
        found = [self.candidates[name] for name in (self.name, _CLASSICAL)]
        best, classical = (each.error(self.against) for each in found)
        if self.name == _CLASSICAL and self.coarse:
            return f"Do not smooth with this delay: {self.coarse}."
        if self.name == _CLASSICAL:
            return f"The classical smoother is as good, with a {kind} error of {best:.4g}: use it."
        if math.isinf(classical):
            return f"Use the {self.name} smoother: only designs for the uncertainty are safe here."
        left, nominal = best / classical, found[0].judgement.nominal / found[1].judgement.nominal
        # of the gain, in logarithms, less than half is there without uncertainty, too
        what = "Robustness" if left < nominal**2 else "A closer fit to the delay"
        digits = max(2, math.ceil(-math.log10(left)))  # a small rest is not rounded to zero
        gain = f"{100.0 * (1.0 - left):.{digits}g}%"
        fall = f"from {classical:.4g} (classical) to {best:.4g} ({self.name})"
        return f"{what} buys {gain} here: the {kind} error falls {fall}."

    def __repr__(self) -> str:
        found = self.candidates[self.name].judgement
        return f"Choice({self.name!r}, against={self.against!r}, {found})"

    def _repr_html_(self) -> str:
        return self.table.html()


@one_thread
def best_smoother(
    plant: AugmentedSystem,
    against: str = "admissible",
    output: str = "smoothed",
    *,
    progress: bool = False,
) -> Choice:
    """Design all smoothers for a plant, judge them, and choose the best.

    Parameters
    ----------
    plant : AugmentedSystem, made by `augment`
    against : {"admissible", "constant"}
        The error to minimise: the certified worst, under every admissible uncertainty (it may vary
        in time and depend on the past), or the worst under constant ones (unknown parameters).
    output : {"smoothed", "filtered"}, the estimate to judge
    progress : bool, whether to show a bar

    Raises
    ------
    InfeasibleDesignError
        Where no estimator has a finite error, and as in `minimax_smoother`.

    Warns
    -----
    CoarseDelayWarning
        Where the classical smoother's nominal error is above that of its filter.

    Examples
    --------
    A sensor's gain is known to 5%, the decay rate of its signal to 10%:

    >>> decay = rs.Uncertainty(B=[[1.0]], C=[[0.1]], D=[[0.0]])
    >>> gain = rs.Uncertainty(B=[[0.0]], C=[[0.05]], D=[[1.0]])
    >>> A, B1, C0, C2, D21 = [[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]]
    >>> system = rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties=[decay, gain])
    >>> print(rs.best_smoother(rs.augment(system, delay=0.2, order=4)).sentence)
    The classical smoother is as good, with a certified worst error of 0.05974: use it.
    """
    check_is_plant(plant)
    validation.choice("against", against, tuple(_ERRORS))
    validation.choice("output", output, COSTS)
    validation.boolean("progress", progress)
    Drift.of(plant)  # raises where there is no estimator
    candidates, failures = {}, {}
    designs = _designs(plant, against, output).items()
    for name, make in progress_bar(designs, unit="design", shown=progress):
        try:
            estimator = make()
            candidates[name] = Candidate(estimator, judge(estimator, output))
        except InfeasibleDesignError as error:
            failures[name] = error
            candidates[name] = Candidate(refused=str(error))
    errors = {name: each.error(against) for name, each in candidates.items()}
    best = min(errors, key=errors.__getitem__)
    if math.isinf(errors[best]):
        none = InfeasibleDesignError("A finite error", "is the delay too long?", "is not found")
        raise failures.get("minimax" if against == "admissible" else "constant minimax", none)
    if errors[_CLASSICAL] <= (1.0 + WORTHWHILE) * errors[best]:
        best = _CLASSICAL
    smoothed, classical = candidates[_CLASSICAL].judgement.nominal, candidates[_CLASSICAL].estimator
    coarse = ""
    if output == "smoothed" and math.isfinite(smoothed):
        Delta = classical.plant.structured_delta()
        filtered = float(error_covariance(classical, Delta, "filtered", "real").trace())
        if smoothed > _WORSE * filtered:  # the delay model errs
            coarse = (
                f"the smoothed error, {smoothed:.4g}, is above the filtered one, {filtered:.4g}: "
                f"the delay's model of order {plant.order} is too coarse; take a higher order or a "
                "shorter delay (in discrete time the classical smoother needs no model)"
            )
            warnings.warn(coarse, CoarseDelayWarning, stacklevel=3)
    return Choice(candidates[best].estimator, best, candidates, against, output, coarse)


def _designs(plant: AugmentedSystem, against: str, output: str) -> dict[str, partial[Estimator]]:
    """Return a function for each candidate that designs it, the classical smoother first."""
    classical = baselines.fixed_lag_smoother, plant.system, plant.delay, plant.order
    designs = {
        _CLASSICAL: partial(*classical, copies=plant.system.g > 0),
        "tuned": partial(baselines.tuned_fixed_lag_smoother, plant, against, output),
        "minimax": partial(minimax_smoother, plant, output),
        "constant minimax": partial(constant_minimax_smoother, plant, output),
    }
    for cost in COSTS if plant.delay > 0.0 else COSTS[:1]:
        designs[f"paper's V, {cost}"] = partial(minimize_bound, plant, cost)
    return designs
