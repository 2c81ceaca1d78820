"""The statements in the paper's prose that numbers can check, one function each."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from robsmooth import homodyne
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.analysis.statistical_linearisation import statistical_linearisation
from robsmooth.estimators import baselines
from robsmooth.estimators.smoother import design_smoother
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.paper.published import (
    SimulatedErrors,
    agrees,
    paper_plant,
    printed,
    printed_multipliers,
    stated,
)
from robsmooth.systems.augmented import AugmentedSystem

Finding = tuple[bool, str, str]  # whether it holds, our value in words, and why, if need be
Check = Callable[[], Finding]
Sweep = Callable[[str, str], np.ndarray]

# The errors that the paper compares, by the names that it has for them: design and output.
_COMPARED = {"smoother": ("smoother, as printed", "smoothed"), "NGCF": ("NGCF", "filtered")}
_EQUAL = 1e-9  # relative: two numbers that rounding alone keeps apart


def checks(simulation: SimulatedErrors | None) -> dict[str, Check]:
    """Return the check of each statement."""
    parameters, plant, lag = homodyne.PAPER, paper_plant(), published.DELAY

    def sweep(name: str, output: str) -> np.ndarray:
        slopes = np.linspace(-1.0, 0.0, 21)
        return delta_sweep(published.designs()[name], slopes, output)[:, 0, 0]

    return {
        "smoothing improves the Kalman-Bucy filter": partial(smoothing_improves, parameters, lag),
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


def smoothing_improves(parameters: HomodyneParameters, lag: float) -> Finding:
    """Compare the optimal errors without a lag and with one."""
    system = parameters.uncertain_system()
    filtered = baselines.optimal_fixed_lag_error(system, 0.0).item()
    smoothed = baselines.optimal_fixed_lag_error(system, lag).item()
    value = f"{filtered:.5f} -> {smoothed:.5f} at the lag of {1e6 * lag:g} us"
    return smoothed < filtered, value, ""


def sector(parameters: HomodyneParameters) -> Finding:
    """Test the remainder against gamma = (1 - m)/2 wherever the sine is in the sector [m, 1]."""
    m, gamma, beta = parameters.sector_slope, parameters.gamma, parameters.beta
    error = np.linspace(0.0, np.pi, 5001)[1:]
    error = error[np.sin(error) >= m * error]
    ratio = np.abs(parameters.remainder(error) / error).max()
    value = f"m = {m:.3g}; where sin(mu_1)/mu_1 is in [m, 1], "
    value += f"|f| is up to {ratio:.3g} |mu_1|, and gamma is {gamma:g}"
    if ratio <= gamma * (1.0 + _EQUAL):
        return True, value, ""
    ngcf, reach = baselines.ngcf(parameters.uncertain_system()), parameters.sector_range()
    variance = statistical_linearisation(ngcf, parameters.equivalent_slope).filtered
    outside = 1.0 - homodyne.fraction_inside(reach, variance)
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
    ratio = np.abs(parameters.remainder(error) / error).max()

    def fits(power: float) -> bool:
        scale = gamma**power
        return abs(gamma * scale - 1.0) <= _EQUAL and ratio * scale <= 1.0 + _EQUAL

    power = float(stated("scaled nonlinearity", "power_of_gamma"))
    recovered, reach = gamma * gamma**power, ratio * gamma**power
    value = f"gamma f~ = {recovered:.3g} f, and |f~| <= {reach:.3g} |mu_1|"
    if fits(power):
        return True, value, ""
    readings = {-1.0: "f/gamma", 0.0: "f", 1.0: "f gamma"}
    right = " and ".join(text for power, text in readings.items() if fits(power)) or "none"
    needed = "alone has gamma f~/beta = f/beta, as the measurement needs, and is in the unit sector"
    return False, value, f"of {', '.join(readings.values())} as f~, {right} {needed}"


def inverse_of_M(plant: AugmentedSystem) -> Finding:
    """Multiply M by the printed formula of its inverse."""
    worst = 0.0
    for multipliers in np.random.default_rng(0).uniform(0.01, 1.0, (20, 4)):
        l1, l2, l3, l4 = multipliers
        det = l3 * l4 + l2 * (l3 + l4)
        lower = np.array([[l2 + l4, l2], [l2, l2 + l3]]) / det
        error = plant.M(multipliers) @ block_diag(1 / l1, lower) - np.eye(3)
        worst = max(worst, float(np.abs(error).max()))
    return worst < 1e-12, f"M M^-1 = I to {worst:.0e}", ""


def constraints(plant: AugmentedSystem) -> Finding:
    """Compare the printed inequalities with M^-1 >= J J'."""
    tried = np.random.default_rng(0).uniform(0.0, 1.0, (500, 4))
    l1, l2, l3, l4 = tried.T
    a, b = 1 - l2 - l3, 1 - l2 - l4
    theirs = (l1 <= 1) & (a >= 0) & (b >= 0) & (a * b >= l2**2)
    same = sum(theirs == [_slack(plant, multipliers) >= 0.0 for multipliers in tried])
    value = f"they say the same as M^-1 >= J J' at {same} of {len(tried)} random lambda"
    return bool(same == len(tried)), value, ""


def satisfies(plant: AugmentedSystem) -> Finding:
    """Test the constraint at the printed lambda."""
    slack = _slack(plant, printed_multipliers())
    return slack >= 0.0, f"I - J'MJ >= {slack:.3g} I", ""


def assumption_3(plant: AugmentedSystem) -> Finding:
    """Design the smoother with the printed tau and lambda, and with all that round to them."""
    tried, refusals = published.rounding_box(), {}
    for number, (tau, multipliers) in enumerate(tried):
        try:
            design_smoother(plant, tau, multipliers)
        except InfeasibleDesignError as error:
            refusals[number] = error.condition
    if 0 not in refusals:
        return True, "all conditions hold", ""
    where = "the printed ones, and the corners of what rounds to them"
    reason = f"no design at {len(refusals)} of {len(tried)} tau and lambda: {where}"
    return False, f"{refusals[0]} fails", reason


def _slack(plant: AugmentedSystem, multipliers: np.ndarray) -> float:
    """Return the least eigenvalue of I - J'MJ."""
    gap = np.eye(plant.J.shape[1]) - plant.J.T @ plant.M(multipliers) @ plant.J
    return float(np.linalg.eigvalsh(gap).min())


def grows(sweep: Sweep) -> Finding:
    """Test that both errors rise at each step from Delta_2 = 0 to -1."""
    errors = {name: sweep(*error)[::-1] for name, error in _COMPARED.items()}
    rising = all((np.diff(values) > 0.0).all() for values in errors.values())
    rises = [f"the {name}'s from {e[0]:.3f} to {e[-1]:.3f} rad^2" for name, e in errors.items()]
    return rising, f"from Delta_2 = 0 to -1 {' and '.join(rises)}", ""


def below(sweep: Sweep) -> Finding:
    """Test that the smoother's error is the smaller one at each Delta_2."""
    smoothed, filtered = (sweep(*error) for error in _COMPARED.values())
    share = 1 - smoothed / filtered
    return bool((share > 0).all()), f"{share.min():.0%} to {share.max():.0%} below", ""


def less_sensitive(sweep: Sweep) -> Finding:
    """Compare the rises of the errors from Delta_2 = 0 to -1, also relative to their values."""
    ends = [sweep(*error)[[0, -1]] for error in _COMPARED.values()]
    rise, ngcf_rise = (worst - nominal for worst, nominal in ends)
    share, ngcf_share = (worst / nominal - 1.0 for worst, nominal in ends)
    value = f"from Delta_2 = 0 to -1 the smoother's rises by {rise:.3f} rad^2 ({share:.0%}), "
    value += f"the NGCF's by {ngcf_rise:.3f} rad^2 ({ngcf_share:.0%})"
    if rise >= ngcf_rise:
        return False, value, "the smoother's rises more"
    absolute = "in absolute terms only: relative to its value the smoother's rises more"
    return True, value, absolute if share >= ngcf_share else ""


def robust_against_kalman(simulation: SimulatedErrors) -> Finding:
    """Test that the NGCF's error is below the Kalman-Bucy filter's by three standard errors."""
    robust, kalman = (simulation[name]["filtered"] for name in ("NGCF", "Kalman-Bucy"))
    difference = robust.mean_square - kalman.mean_square
    noise = math.hypot(robust.standard_error, kalman.standard_error)
    share = difference / kalman.mean_square
    value = f"the NGCF's error differs by {share:+.2%} from the Kalman-Bucy filter's"
    if difference < -3.0 * noise:
        return True, value, ""
    size = "within three standard errors of ours" if difference <= 3.0 * noise else "the other way"
    reason = "the paper cites other work for this; in this example the two filters have all but the"
    return False, value, f"{reason} same gain, and the difference is {size}"


def percent(simulation: SimulatedErrors) -> Finding:
    """Compare the printed percentage with how much larger than the smoother's the NGCF's is."""
    text = stated("41%", "percent")
    theirs = [printed(f"error covariance, {name}") for name in _COMPARED]
    both = (theirs, simulated_errors(simulation))
    printed_larger, larger = (100 * (filtered / smoothed - 1) for smoothed, filtered in both)
    printed_smaller, smaller = (100 * (1 - smoothed / filtered) for smoothed, filtered in both)
    value = f"the printed {theirs[1]:g} is {printed_larger:.0f}% larger than {theirs[0]:g}; "
    value += f"ours: {larger:.0f}% larger"
    if agrees(text, larger, larger):
        return True, value, ""
    is_it = "is" if agrees(text, smaller, smaller) else "is not even"
    both = f"printed {printed_smaller:.1f}%, ours {smaller:.1f}%"
    return False, value, f"{text}% {is_it} by how much the smoother's is smaller: {both}"


def significant(simulation: SimulatedErrors) -> Finding:
    """Test that the smoother's error is below the NGCF's."""
    smoothed, filtered = simulated_errors(simulation)
    return smoothed < filtered, f"{1 - smoothed / filtered:.1%} below the NGCF's", ""


def simulated_errors(simulation: SimulatedErrors) -> list[float]:
    """Return the simulated errors that the paper compares: the smoother's and the NGCF's."""
    return [simulation[name][output].mean_square for name, output in _COMPARED.values()]
