"""The statements in the paper's prose that numbers can check, one function each.

Each function computes a verdict from what the statement claims: whether it holds, our value in
words, and why, where that needs words.
"""

import math
from collections.abc import Callable
from functools import cache, partial

import numpy as np

from robsmooth import homodyne
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.analysis.covariance import delta_sweep, statistical_linearisation
from robsmooth.estimators import baselines
from robsmooth.estimators.smoother import design_smoother
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.paper.published import agrees, paper_plant, printed, printed_multipliers, stated
from robsmooth.paper.results import MonteCarloTable
from robsmooth.systems.augmented import AugmentedSystem

Finding = tuple[bool, str, str]
Check = Callable[[], Finding]
Sweep = Callable[[str, str], np.ndarray]

_EQUAL = 1e-9  # relative: two numbers that rounding alone keeps apart


def checks(simulation: MonteCarloTable | None) -> dict[str, Check]:
    """Return the check of each statement: whether it holds, our value in words, and why."""
    parameters, plant = homodyne.PAPER, paper_plant()
    slopes = np.linspace(-1.0, 0.0, 21)

    @cache
    def sweep(name: str, output: str) -> np.ndarray:
        return delta_sweep(published.designs()[name], slopes, output)[:, 0, 0]

    return {
        "smoothing improves the Kalman-Bucy filter": partial(
            smoothing_improves, parameters, published.DELAY
        ),
        "robust filter against Kalman filter": partial(robust_against_kalman, simulation),
        "sector": partial(sector, parameters),
        "scaled nonlinearity": partial(scaled_nonlinearity, parameters),
        "inverse of M": partial(inverse_of_M, plant),
        "constraints on lambda": partial(constraints, plant),
        "printed lambda satisfies the constraints": partial(satisfies, plant),
        "Assumption 3 at the printed design": partial(assumption_3, plant),
        "error grows with the uncertainty": partial(grows, sweep),
        "smoother much below NGCF": partial(below, sweep),
        "less sensitive": partial(less_sensitive, sweep),
        "41%": partial(percent, simulation),
        "significant improvement": partial(significant, simulation),
    }


# --- the model and the design ---------------------------------------------------------------


def smoothing_improves(parameters: HomodyneParameters, lag: float) -> Finding:
    """Compare the optimal errors without a lag and with one."""
    system = parameters.uncertain_system()
    filtered, smoothed = (
        float(baselines.optimal_fixed_lag_error(system, delay)[0, 0]) for delay in (0.0, lag)
    )
    value = f"{filtered:.5f} -> {smoothed:.5f} at the lag of {1e6 * lag:g} us"
    return smoothed < filtered, value, ""


def sector(parameters: HomodyneParameters) -> Finding:
    """Test the remainder against gamma wherever the sine is in the sector [m, 1].

    The printed gamma = (1 - m)/2 gives m.
    """
    m, gamma, beta = parameters.sector_slope, parameters.gamma, parameters.beta
    error = np.linspace(0.0, np.pi, 5001)[1:]
    error = error[np.sin(error) >= m * error]
    ratio = float(np.abs(parameters.remainder(error) / error).max())
    value = (
        f"m = {m:.3g}; where sin(mu_1)/mu_1 is in [m, 1], |f| is up to {ratio:.3g} |mu_1|, and "
        f"gamma is {gamma:g}"
    )
    if ratio <= gamma * (1.0 + _EQUAL):
        return True, value, ""
    loop = statistical_linearisation(
        baselines.ngcf(parameters.uncertain_system()), parameters.equivalent_slope
    )
    reach = parameters.sector_range()
    outside = 1.0 - homodyne.fraction_inside(reach, loop.filtered)
    reason = (
        f"gamma = (1 - m)/2 is for a sector around its middle slope (1 + m)/2 = {(1 + m) / 2:.3g}, "
        f"but the design has beta = {beta:g}, so that its sector is [{beta - gamma:.3g}, "
        f"{beta + gamma:.3g}]; |f| <= gamma |mu_1| holds for errors up to {reach:.3f} rad, beyond "
        f"which the loop is {outside:.0e} of the time"
    )
    return False, value, reason


def scaled_nonlinearity(parameters: HomodyneParameters) -> Finding:
    """Test with which power of gamma f~ = f gamma^power gives gamma f~ = f, in the unit sector."""
    gamma = parameters.gamma
    error = np.linspace(0.0, parameters.sector_range(), 501)[1:]
    ratio = float(np.abs(parameters.remainder(error) / error).max())

    def fits(power: float) -> bool:
        recovered = gamma * gamma**power
        return abs(recovered - 1.0) <= _EQUAL and ratio * gamma**power <= 1.0 + _EQUAL

    power = float(stated("scaled nonlinearity", "power_of_gamma"))
    value = (
        f"gamma f~ = {gamma * gamma**power:.3g} f, and |f~| <= {ratio * gamma**power:.3g} |mu_1|"
    )
    if fits(power):
        return True, value, ""
    readings = {-1.0: "f/gamma", 0.0: "f", 1.0: "f gamma"}
    right = " and ".join(text for power, text in readings.items() if fits(power)) or "none"
    reason = (
        f"of {', '.join(readings.values())} as f~, {right} alone has gamma f~/beta = f/beta, as "
        "the measurement needs, and is in the unit sector"
    )
    return False, value, reason


def inverse_of_M(plant: AugmentedSystem) -> Finding:
    """Multiply M by the printed formula of its inverse."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(20):
        l1, l2, l3, l4 = multipliers = rng.uniform(0.01, 1.0, 4)
        det = l3 * l4 + l2 * (l3 + l4)
        formula = [
            [1 / l1, 0, 0],
            [0, (l2 + l4) / det, l2 / det],
            [0, l2 / det, (l2 + l3) / det],
        ]
        errors.append(np.abs(plant.M(multipliers) @ formula - np.eye(3)).max())
    worst = float(max(errors))
    return worst < 1e-12, f"M M^-1 = I to {worst:.0e}", ""


def constraints(plant: AugmentedSystem) -> Finding:
    """Compare the printed inequalities with M^-1 >= J J'."""
    rng = np.random.default_rng(0)
    tried = rng.uniform(0.0, 1.0, (500, 4))
    same = 0
    for multipliers in tried:
        l1, l2, l3, l4 = multipliers
        a, b = 1 - l2 - l3, 1 - l2 - l4
        theirs = bool(l1 <= 1 and a >= 0 and b >= 0 and a * b >= l2**2)
        same += theirs == (_slack(plant, multipliers) >= 0.0)
    value = f"they say the same as M^-1 >= J J' at {same} of {len(tried)} random lambda"
    return same == len(tried), value, ""


def satisfies(plant: AugmentedSystem) -> Finding:
    """Test the constraint at the printed lambda."""
    slack = _slack(plant, printed_multipliers())
    return slack >= 0.0, f"I - J'MJ >= {slack:.3g} I", ""


def assumption_3(plant: AugmentedSystem) -> Finding:
    """Design the smoother with the printed tau and lambda, and with all that round to them."""
    refusals = [_refusal(plant, *corner) for corner in published.rounding_box()]
    if not refusals[0]:
        return True, "all conditions hold", ""
    refused = sum(map(bool, refusals))
    reason = (
        f"no design at {refused} of {len(refusals)} tau and lambda: the printed ones, and the "
        "corners of what rounds to them"
    )
    return False, f"{refusals[0]} fails", reason


def _slack(plant: AugmentedSystem, multipliers: np.ndarray) -> float:
    """Return the least eigenvalue of I - J'MJ."""
    gap = np.eye(plant.J.shape[1]) - plant.J.T @ plant.M(multipliers) @ plant.J
    return float(np.linalg.eigvalsh(gap).min())


def _refusal(plant: AugmentedSystem, tau: float, multipliers: np.ndarray) -> str:
    """Return the condition that fails; empty where there is a design."""
    try:
        design_smoother(plant, tau, multipliers)
    except InfeasibleDesignError as error:
        return error.condition
    return ""


# --- the linear sweep -----------------------------------------------------------------------


def grows(sweep: Sweep) -> Finding:
    """Test that both errors rise at each step from Delta_2 = 0 to -1."""
    values, rising = [], True
    for name, output in _SWEPT.items():
        errors = sweep(name, output)[::-1]
        rising &= bool((np.diff(errors) > 0.0).all())
        values.append(f"the {_SHORT[name]}'s from {errors[0]:.3f} to {errors[-1]:.3f} rad^2")
    return rising, f"from Delta_2 = 0 to -1 {' and '.join(values)}", ""


def below(sweep: Sweep) -> Finding:
    """Test that the smoother's error is the smaller one at each Delta_2."""
    smoothed, filtered = (sweep(name, output) for name, output in _SWEPT.items())
    share = 100 * (1 - smoothed / filtered)
    return bool((share > 0).all()), f"{share.min():.0f}% to {share.max():.0f}% below", ""


def less_sensitive(sweep: Sweep) -> Finding:
    """Compare the rises of the errors from Delta_2 = 0 to -1, also relative to their values."""
    rises = {}
    for name, output in _SWEPT.items():
        worst, nominal = sweep(name, output)[[0, -1]]
        rises[name] = worst - nominal, worst / nominal - 1.0
    (rise, share), (ngcf_rise, ngcf_share) = rises.values()
    value = (
        f"from Delta_2 = 0 to -1 the smoother's rises by {rise:.3f} rad^2 "
        f"({100 * share:.0f}%), the NGCF's by {ngcf_rise:.3f} rad^2 ({100 * ngcf_share:.0f}%)"
    )
    if rise < ngcf_rise and share < ngcf_share:
        return True, value, ""
    if rise < ngcf_rise:
        return (
            True,
            value,
            "in absolute terms only: relative to its value the smoother's rises more",
        )
    return False, value, "the smoother's rises more"


_SWEPT = {"smoother, as printed": "smoothed", "NGCF": "filtered"}
_SHORT = {"smoother, as printed": "smoother", "NGCF": "NGCF"}


# --- the nonlinear simulation ---------------------------------------------------------------


def robust_against_kalman(simulation: MonteCarloTable) -> Finding:
    """Test that the NGCF's error is below the Kalman-Bucy filter's by three standard errors."""
    robust, kalman = (simulation.cases[name]["filtered"] for name in ("NGCF", "Kalman-Bucy"))
    difference = robust["mean_square"] - kalman["mean_square"]
    noise = math.hypot(robust["standard_error"], kalman["standard_error"])
    share = 100 * difference / kalman["mean_square"]
    value = f"the NGCF's error differs by {share:+.2f}% from the Kalman-Bucy filter's"
    if difference < -3.0 * noise:
        return True, value, ""
    size = "within three standard errors of ours" if difference <= 3.0 * noise else "the other way"
    reason = (
        "the paper cites other work for this; in this example the two filters have all but the "
        f"same gain, and the difference is {size}"
    )
    return False, value, reason


def percent(simulation: MonteCarloTable) -> Finding:
    """Compare the printed percentage with how much larger than the smoother's the NGCF's is."""
    text = stated("41%", "percent")
    smoother, filtered = _simulated(simulation)
    printed_smoother, printed_filtered = (
        printed(f"error covariance, {name}") for name in ("smoother", "NGCF")
    )
    larger, printed_larger = (
        100 * (large / small - 1)
        for large, small in ((filtered, smoother), (printed_filtered, printed_smoother))
    )
    value = (
        f"the printed {printed_filtered:g} is {printed_larger:.0f}% larger than "
        f"{printed_smoother:g}; ours: {larger:.0f}% larger"
    )
    if agrees(text, larger, larger):
        return True, value, ""
    smaller, printed_smaller = (
        100 * (1 - small / large)
        for large, small in ((filtered, smoother), (printed_filtered, printed_smoother))
    )
    is_it = "is" if agrees(text, smaller, smaller) else "is not even"
    reason = (
        f"{text}% {is_it} by how much the smoother's is smaller: printed {printed_smaller:.1f}%, "
        f"ours {smaller:.1f}%"
    )
    return False, value, reason


def significant(simulation: MonteCarloTable) -> Finding:
    """Test that the smoother's error is below the NGCF's."""
    smoother, filtered = _simulated(simulation)
    return smoother < filtered, f"{100 * (1 - smoother / filtered):.1f}% below the NGCF's", ""


def _simulated(simulation: MonteCarloTable) -> tuple[float, float]:
    """Return the smoother's error and the NGCF's."""
    return (
        simulation.mean_square("smoother, as printed", "smoothed"),
        simulation.mean_square("NGCF", "filtered"),
    )
