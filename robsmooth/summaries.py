"""The tables of the notebooks."""

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import brentq

from robsmooth import homodyne, published
from robsmooth.augmented import AugmentedSystem
from robsmooth.covariance import (
    StatisticalLinearisation,
    delta_sweep,
    error_covariance,
    statistical_linearisation,
)
from robsmooth.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth.estimator import Estimator
from robsmooth.galerkin import FARTHEST, stationary_errors
from robsmooth.homodyne import HomodyneParameters
from robsmooth.montecarlo import LossOfLockWarning, MeanSquare, MonteCarloResult, monte_carlo
from robsmooth.riccati import RiccatiError
from robsmooth.smoother import RobustSmoother, design_equations, design_smoother
from robsmooth.study import Study
from robsmooth.tables import Table


def parameters(values: HomodyneParameters) -> Table:
    """Return Table I."""
    rows = [
        (r"$\lambda$", f"{values.lam:g}", "rad/s", "decay rate of the phase"),
        (r"$\kappa$", f"{values.kappa:g}", "rad²/s", "diffusion of the phase"),
        (r"$\alpha$", f"{values.alpha:g}", "s^-1/2", "amplitude of the beam"),
        (r"$\beta$", f"{values.beta:g}", "", "slope of the tangent of the sine"),
        (r"$\gamma$", f"{values.gamma:g}", "", "half width of the sector"),
    ]
    caption = (
        "Table I of the paper, with the units that the equations need; it prints rad/s for kappa "
        "and 1/s for alpha."
    )
    return Table(("symbol", "value", "unit", "what it is"), rows, caption)


def sector_ranges(values: HomodyneParameters, variance: float) -> Table:
    """Return how far each reading of the sector holds, and for what share of the time."""
    wide, narrow = values.sector_slope, values.lower_slope
    readings = [
        (f"sin e between {wide:.1f} e and e, as gamma = (1 - m)/2 says", values.sector_range(wide)),
        (f"sin e between {narrow:.1f} e and e, as the design uses", values.sector_range()),
        (f"sin e - e Lipschitz with constant {values.gamma:g}", values.lipschitz_range),
    ]
    rows = []
    for text, reach in readings:
        inside = homodyne.fraction_inside(reach, variance)
        rows.append((text, reach, f"{100 * inside:.5f}%", f"{1 - inside:.1e}"))
    return Table(
        columns=("what is assumed", "holds up to (rad)", "time inside", "time outside"),
        rows=rows,
        caption=(
            "How far each assumption on the sine holds, and how long the loop is within it, for a "
            f"Gaussian error of variance {variance:.4f} rad²."
        ),
    )


def sign_readings(plant: AugmentedSystem, tau: float, multipliers: Sequence[float]) -> Table:
    """Return the leading gains for each reading of the X equation's quadratic term."""
    equations = design_equations(plant, tau, multipliers)
    Y = equations.solve_Y().X
    rows = []
    for text, sign in (("+, as written", 1.0), ("-, flipped", -1.0), ("left out", 0.0)):
        try:
            X = equations.solve_X(quadratic_sign=sign).X
        except RiccatiError:
            rows.append((text, "no real solution", None, None, None, None))
            continue
        A_c, B_c, C_c, bound = equations.gains(X, Y)
        rows.append((text, A_c[0, 0], B_c[0, 1], C_c[0, 0], C_c[1, 0], bound))
    A_c, B_c, C_c = (published.printed(name) for name in ("A_c", "B_c", "C_c"))
    rows.append(("printed", A_c[0, 0], B_c[0, 1], C_c[0, 0], C_c[1, 0], 0.15))
    return Table(
        columns=("sign", "$A_c[0,0]$", "$B_c[0,1]$", "$C_c[0,0]$", "$C_c[1,0]$", "$V$"),
        rows=rows,
        caption="The gains at the printed tau and lambda for each reading of the X equation.",
        digits=5,
    )


def approach_to_infimum(
    plant: AugmentedSystem, best: RobustSmoother, fractions: Iterable[float]
) -> Table:
    """Return how bound and gains settle as the multipliers of mu and its copy go to zero."""
    rows = []
    for fraction in fractions:
        multipliers = [1.0, 0.5 - fraction / 2, fraction, fraction]
        tau = best.tau
        try:
            design = design_smoother(plant, tau, multipliers)
        except InfeasibleDesignError as error:
            rows.append((f"{fraction:.0e}", None, None, None, error.condition))
            continue
        rows.append(
            (
                f"{fraction:.0e}",
                design.bound,
                float(design.B_c[0, 0]),
                float(np.linalg.norm(design.X, 2)),
                "",
            )
        )
    return Table(
        columns=(
            r"$\lambda_3 = \lambda_4$",
            "$V$",
            "$B_c[0,0]$",
            r"$\lVert X\rVert$",
            "refused because",
        ),
        rows=rows,
        caption=(
            "Towards the edge: the bound falls and X vanishes as the multipliers of the "
            f"nonlinearity and its copy do. Over all the infimum is {best.bound_infimum:.5f}."
        ),
        digits=6,
    )


def designs(compared: Mapping[str, Estimator]) -> Table:
    """Return the design table: bound, tau, lambda and poles."""
    rows = []
    for name, design in compared.items():
        robust = isinstance(design, RobustSmoother)
        weights = ", ".join(f"{value:.4g}" for value in design.multipliers) if robust else None
        poles = ", ".join(f"{pole:.3g}" for pole in design.poles if pole.imag >= 0.0)
        rows.append(
            (
                name,
                design.bound if robust else None,
                f"{design.tau:.4g}" if robust else None,
                weights,
                poles.replace("+0j", ""),
            )
        )
    return Table(
        columns=("design", "$V$ (rad²)", r"$\tau$ (rad² s)", r"$\lambda$", "poles (1/s)"),
        rows=rows,
        caption=(
            "The designs compared. V bounds half the filtered error covariance with the fictitious "
            "noise of the copies; of a pair of complex poles one is shown."
        ),
    )


def covariances(compared: Mapping[str, Estimator]) -> Table:
    """Return nominal and worst error covariances, with the copies' fictitious noise and without."""
    rows = []
    for name, design in compared.items():
        for output in ("filtered", "smoothed") if design.plant.delay > 0.0 else ("filtered",):
            errors = [
                float(delta_sweep(design, [slope], output, noise)[0, 0, 0])
                for noise in (True, False)
                for slope in (0.0, -1.0)
            ]
            rows.append((f"{name}, {output}", *errors))
    with_noise = [f"$\\Delta_2={slope}$, paper's formula" for slope in ("0", "-1")]
    without = [f"$\\Delta_2={slope}$, no copy noise" for slope in ("0", "-1")]
    return Table(
        columns=("error", *with_noise, *without),
        rows=rows,
        caption=(
            "Error covariances (rad²) of the designs, with the fictitious noise of the copies, as "
            "in the paper's formula, and without it, as in a real loop."
        ),
    )


def copy_noise(plants: Mapping[float, RobustSmoother]) -> Table:
    """Return bounds against the intensity J_21 that the design assumes for the copies."""
    rows = []
    for intensity, design in plants.items():
        delta = design.plant.structured_delta()
        rows.append(
            (
                f"{intensity:g}",
                design.bound_infimum or design.bound,
                float(error_covariance(design, delta, "filtered")[0, 0]),
                float(error_covariance(design, delta, "filtered", copy_noise=False)[0, 0]),
            )
        )
    return Table(
        columns=("$J_{21}$", "least $V$", "filtered, with copy noise", "filtered, without"),
        rows=rows,
        caption=(
            "What the fictitious noise costs: least bound and nominal filtered error covariance "
            "(rad²) against the intensity that the design assumes for it."
        ),
    )


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


def study(found: Study, lag: float) -> Table:
    """Return the best lag for each sector and noise, and what it and a given one save."""
    ratio = found.ratio
    near = int(np.argmin(np.abs(np.log(np.array(found.lags) / lag))))
    rows = []
    for i, gamma in enumerate(found.gammas):
        for j, noise in enumerate(found.noises):
            if (gamma, noise) in found.failures or np.isnan(ratio[i, j]).all():
                rows.append((f"{gamma:g}", f"{noise:.3g}", *[None] * 6, "no design"))
                continue
            k, m = np.unravel_index(np.nanargmin(ratio[i, j]), ratio.shape[2:])
            at = (i, j, k, m)
            rows.append(
                (
                    f"{gamma:g}",
                    f"{noise:.3g}",
                    float(found.quantities["filtered"][at]),
                    float(found.quantities["smoothed"][at]),
                    float(1e6 * found.lags[m]),
                    str(found.orders[k]),
                    f"{100 * (1 - ratio[at]):.0f}%",
                    f"{100 * (1 - ratio[i, j, :, near].min()):.0f}%",
                    f"{np.nanmax(found.quantities['slip_rate'][i, j]):.2g}",
                )
            )
    return Table(
        columns=(
            r"$\gamma$",
            "shot noise",
            "filtered (rad²)",
            "smoothed (rad²)",
            "best lag (µs)",
            "order",
            "saved",
            f"saved at {1e6 * found.lags[near]:.2g} µs",
            "slips (1/s)",
        ),
        rows=rows,
        caption=(
            "The best lag and order of those studied for each sector and noise, and what smoothing "
            "saves there of the filtered error in the nonlinear loop."
        ),
        digits=3,
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
            "The factor on one number of the loop at which each printed error (0.0605 and 0.1031 "
            "rad²) is predicted, and what is predicted at the mean of the two factors; in "
            f"brackets, how far off, in standard errors of a simulation of {runs:.0f} runs."
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
