"""Tables of the nonlinear loop, by simulation and without."""

import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from scipy.optimize import brentq

from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.tables import Table
from robsmooth.analysis.covariance import StatisticalLinearisation, statistical_linearisation
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.moments import FARTHEST, stationary_errors
from robsmooth.homodyne.montecarlo import (
    LossOfLockWarning,
    MeanSquare,
    MonteCarloResult,
    monte_carlo,
)
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published


def simulations(results: Mapping[str, MonteCarloResult], caption: str) -> Table:
    """Return mean squares with standard errors, one case a row."""
    rows = []
    for name, result in results.items():
        smooths = result.provenance["delay"] > 0.0
        rows.append(
            (
                name,
                _interval(result.filtered),
                _interval(result.smoothed) if smooths else None,
                result.runs,
                result.slips,
                result.slipped_paths,
            )
        )
    columns = (
        "case",
        "filtered (rad²)",
        "smoothed (rad²)",
        "runs",
        "cycle slips",
        "in how many runs",
    )
    return Table(columns, rows, caption)


@dataclass(frozen=True)
class Routes:
    """One error of a design, by every route there is to it; rad^2."""

    error: str
    published: MeanSquare
    ergodic: MeanSquare
    moments: float
    truncation: float
    linearised: float


def routes(
    compared: Mapping[str, Estimator],
    published_protocol: Mapping[str, MonteCarloResult],
    ergodic: Mapping[str, MonteCarloResult],
    values: HomodyneParameters,
) -> list[Routes]:
    """Return the errors by simulation, by their moments and by statistical linearisation."""
    found = []
    for name, design in compared.items():
        moments = stationary_errors(values, design)
        linearised = statistical_linearisation(design, values.equivalent_slope)
        for output in ("filtered", "smoothed")[: 2 if design.plant.delay > 0.0 else 1]:
            found.append(
                Routes(
                    f"{name}, {output}",
                    getattr(published_protocol[name], output),
                    getattr(ergodic[name], output),
                    getattr(moments, output),
                    getattr(moments, f"{output}_truncation"),
                    getattr(linearised, output),
                )
            )
    return found


def routes_table(found: Iterable[Routes]) -> Table:
    """Return the table of the routes."""
    rows = [
        (
            route.error,
            _interval(route.published),
            _interval(route.ergodic, 6),
            f"{route.moments:.8f} ± {route.truncation:.0e}",
            f"{route.linearised:.6f}",
            f"{100 * (route.linearised / route.moments - 1):+.2f}%",
        )
        for route in found
    ]
    return Table(
        columns=(
            "error",
            "paper's protocol (rad²)",
            "ergodic protocol (rad²)",
            "Hermite-Galerkin moments (rad²)",
            "statistical linearisation (rad²)",
            "its error",
        ),
        rows=rows,
        caption=(
            "Three routes, one number: simulation (± one standard error), moments without sampling "
            "(± estimated truncation), and statistical linearisation."
        ),
    )


@dataclass(frozen=True)
class NoisySimulation:
    """A design in the loop with a multiple of the phase noise."""

    factor: float
    simulated: MonteCarloResult
    moments: float
    linearised: float


def noise_sweep(
    design: Estimator, values: HomodyneParameters, factors: Iterable[float], **arguments
) -> list[NoisySimulation]:
    """Simulate a design with ever more phase noise, and predict its filtered error.

    A prediction is not a number where its method says that the loop does not stay in lock.
    """
    found = []
    for factor in factors:
        noisier = replace(values, kappa=factor * values.kappa)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LossOfLockWarning)  # the slips are what is shown
            simulated = monte_carlo(noisier, design, **arguments)
        try:
            moments = stationary_errors(noisier, design).filtered
        except (UnstableLoopError, ArithmeticError):
            moments = math.nan
        try:
            linearised = _predict(design, "power of the phase noise", factor, values).filtered
        except UnstableLoopError:
            linearised = math.nan
        if linearised > FARTHEST**2:  # of a loop whose sine has no mean slope any more
            linearised = math.nan
        found.append(NoisySimulation(factor, simulated, moments, linearised))
    return found


def noise_table(found: Iterable[NoisySimulation]) -> Table:
    """Return the table of a noise sweep."""
    rows = [
        (
            f"{case.factor:g}",
            _interval(case.simulated.filtered, 4),
            _interval(case.simulated.filtered_in_lock, 4),
            case.simulated.slips,
            f"{case.simulated.slipped_paths} of {case.simulated.runs}",
            f"{case.simulated.slip_rate:.3g}",
            _number(case.moments),
            _number(case.linearised),
        )
        for case in found
    ]
    return Table(
        columns=(
            "phase noise",
            "all runs (rad²)",
            "runs in lock (rad²)",
            "slips",
            "runs that slipped",
            "slips (1/s)",
            "moments (rad²)",
            "statistical linearisation (rad²)",
        ),
        rows=rows,
        caption=(
            "The filtered error of the printed smoother as the phase noise grows. Predictions are "
            "for a loop in lock, and are left out where their method finds no such loop."
        ),
    )


def change_needed(smoother: Estimator, ngcf: Estimator, values: HomodyneParameters) -> Table:
    """Return how far one number of the loop must change for the printed errors to be predicted.

    Statistical linearisation predicts; the estimators stay as they are.
    """
    targets = (
        (smoother, "smoothed", published.printed("error covariance, smoother")),
        (ngcf, "filtered", published.printed("error covariance, NGCF")),
    )
    runs = published.printed("runs")
    both = " and ".join(f"{target:g}" for _, _, target in targets)
    rows = []
    for change in _CHANGES:
        factors = [_factor_for(*target, change, values) for target in targets]
        middle = sum(factors) / 2
        row: list = [change, *factors]
        for design, output, target in targets:
            error = getattr(_predict(design, change, middle, values), output)
            # the standard error of a mean of squares of Gaussian errors
            distance = (error - target) / (target * math.sqrt(2 / runs))
            row.append(f"{error:.4f} ({distance:+.1f})")
        rows.append(row)
    return Table(
        columns=(
            "changed",
            "factor for the smoother",
            "factor for the NGCF",
            "smoother at the mean factor",
            "NGCF at the mean factor",
        ),
        rows=rows,
        caption=(
            f"The factor on one number of the loop at which each printed error ({both} rad²) is "
            "predicted, and what is predicted at the mean of the two factors; in brackets, how "
            f"far off, in standard errors of a simulation of {runs:.0f} runs."
        ),
    )


_CHANGES = {"power of the shot noise": "D21", "power of the phase noise": "B1", "detector gain": ""}


def _predict(
    design: Estimator, change: str, factor: float, values: HomodyneParameters
) -> StatisticalLinearisation:
    """Predict the errors of a design in a loop with one number multiplied."""
    noise = _CHANGES[change]
    if not noise:
        slope = partial(values.equivalent_slope, gain=factor)
        return statistical_linearisation(design, slope)
    system = design.plant.system
    noisier = replace(system, **{noise: math.sqrt(factor) * getattr(system, noise)})
    elsewhere = replace(design, plant=replace(design.plant, system=noisier))
    return statistical_linearisation(elsewhere, values.equivalent_slope)


def _factor_for(
    design: Estimator, output: str, target: float, change: str, values: HomodyneParameters
) -> float:
    def excess(factor: float) -> float:
        return getattr(_predict(design, change, factor, values), output) - target

    return float(brentq(excess, 0.7, 2.0, xtol=1e-10))


def _interval(error: MeanSquare, digits: int = 5) -> str:
    if math.isnan(error.mean_square):
        return "none"
    return f"{error.mean_square:.{digits}f} ± {error.standard_error:.{digits}f}"


def _number(value: float) -> str:
    return "none" if math.isnan(value) else f"{value:.4f}"
