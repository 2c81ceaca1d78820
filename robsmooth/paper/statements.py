"""The statements in the paper's prose that numbers can check, a function for each."""

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag

from robsmooth import homodyne
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.conditions import multiplier_level
from robsmooth.estimators.smoother import design_smoother
from robsmooth.homodyne.loop import statistical_linearisation
from robsmooth.paper import published
from robsmooth.systems.augmented import AugmentedSystem, augment

Finding = tuple[bool, str, str]  # whether it holds, our value in words, and why or ""

_COMPARED = (("smoother, as printed", "smoothed"), ("NGCF", "filtered"))  # designs and outputs
_EQUAL = 1e-9  # relative difference of equal numbers, from rounding


def checks(simulation: published.SimulatedErrors | None) -> dict[str, Callable[[], Finding]]:
    """Return the check of each statement, by its id."""
    plant = published.paper_plant()
    return {
        "smoothing improves the Kalman-Bucy filter": smoothing_improves,
        "robust filter against Kalman filter": lambda: robust_against_kalman(simulation),
        "bound on the smoothed error": bounds_the_smoothed,
        "sector": sector,
        "scaled nonlinearity": scaled_nonlinearity,
        "inverse of M": lambda: inverse_of_M(plant),
        "constraints on lambda": lambda: constraints(plant),
        "printed lambda satisfies the constraints": lambda: satisfies(plant),
        "Assumption 3 at the printed design": lambda: assumption_3(plant),
        "error grows with the uncertainty": lambda: grows(*swept_errors()),
        "smoother much below NGCF": lambda: below(*swept_errors()),
        "less sensitive": lambda: less_sensitive(*swept_errors()),
        "41%": lambda: percent(*simulated_errors(simulation)),
        "significant improvement": lambda: significant(*simulated_errors(simulation)),
    }


def simulated_errors(simulation: published.SimulatedErrors) -> list[float]:
    """Return the simulated errors of the smoother and of the NGCF."""
    return [simulation[name][output].mean_square for name, output in _COMPARED]


def swept_errors() -> list[np.ndarray]:
    """Return the errors of the smoother and of the NGCF at slopes Delta_2 from 0 to -1."""
    slopes, designs = np.linspace(0.0, -1.0, 21), published.designs()
    return [delta_sweep(designs[name], slopes, output)[:, 0, 0] for name, output in _COMPARED]


def smoothing_improves(lag: float = published.DELAY) -> Finding:
    """Compare the optimal errors without and with a delay, in seconds."""
    system = homodyne.PAPER.uncertain_system()
    filtered = baselines.optimal_fixed_lag_error(system, 0.0).item()
    smoothed = baselines.optimal_fixed_lag_error(system, lag).item()
    value = f"{filtered:.5f} -> {smoothed:.5f} at the delay of {1e6 * lag:g} us"
    return smoothed < filtered, value, ""


def bounds_the_smoothed(cost: str = "filtered") -> Finding:
    """Test whether the least V changes with the delay, as a bound on the smoothed error must."""
    system, delays = homodyne.PAPER.uncertain_system(), [(published.DELAY, published.ORDER), (0, 0)]
    bounds = [minimize_bound(augment(system, *each), cost, starts=1).bound for each in delays]
    value = "the least V is {:.4f} rad^2 with the delay, {:.4f} rad^2 without one".format(*bounds)
    if not math.isclose(*bounds, rel_tol=_EQUAL):
        return True, value, ""
    return False, value, "V bounds half the filtered error: R and Gamma have C_p0, not C_a"


def sector(parameters: homodyne.HomodyneParameters = homodyne.PAPER) -> Finding:
    """Test |f| <= gamma |mu_1| with gamma = (1 - m)/2 where the sine is in the sector [m, 1]."""
    m, gamma, beta = parameters.sector_slope, parameters.gamma, parameters.beta
    error = np.linspace(0.0, np.pi, 5001)[1:]
    error = error[np.sin(error) >= m * error]
    ratio = np.abs(parameters.remainder(error) / error).max()
    value = f"m = {m:.3g}; where sin(mu_1)/mu_1 is in [m, 1], "
    value += f"|f| is up to {ratio:.3g} |mu_1|, and gamma is {gamma:g}"
    if ratio <= gamma * (1.0 + _EQUAL):
        return True, value, ""
    ngcf, reach = baselines.ngcf(parameters.uncertain_system()), parameters.sector_range()
    variance = statistical_linearisation(parameters, ngcf).filtered
    outside = math.erfc(reach / math.sqrt(2.0 * variance))  # of a Gaussian error
    reason = (
        f"gamma = (1 - m)/2 is for a sector around its middle slope (1 + m)/2 = {(1 + m) / 2:.3g}, "
        f"but the design has beta = {beta:g}, so that its sector is [{beta - gamma:.3g}, "
        f"{beta + gamma:.3g}]; |f| <= gamma |mu_1| holds for errors up to {reach:.3f} rad, beyond "
        f"which the loop is {outside:.0e} of the time"
    )
    return False, value, reason


def scaled_nonlinearity() -> Finding:
    """Test which f~ = f gamma^power has gamma f~ = f and is in the unit sector."""
    gamma = homodyne.PAPER.gamma
    error = np.linspace(0.0, homodyne.PAPER.sector_range(), 501)[1:]
    ratio = np.abs(homodyne.PAPER.remainder(error) / error).max()

    readings = {-1: "f/gamma", 0: "f", 1: "f gamma"}
    recovered = {power: gamma * gamma**power for power in readings}
    reach = {power: ratio * gamma**power for power in readings}
    fit = [p for p in readings if abs(recovered[p] - 1) <= _EQUAL and reach[p] <= 1 + _EQUAL]
    stated = int(published.stated("scaled nonlinearity", "power_of_gamma"))
    value = f"gamma f~ = {recovered[stated]:.3g} f, and |f~| <= {reach[stated]:.3g} |mu_1|"
    if stated in fit:
        return True, value, ""
    right = " and ".join(readings[power] for power in fit) or "none"
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
    same = sum(theirs == [multiplier_level(plant, multipliers) <= 1.0 for multipliers in tried])
    value = f"they say the same as M^-1 >= J J' at {same} of {len(tried)} random lambda"
    return bool(same == len(tried)), value, ""


def satisfies(plant: AugmentedSystem) -> Finding:
    """Test the constraint at the printed lambda."""
    slack = 1.0 - multiplier_level(plant, published.printed_multipliers())
    return slack >= 0.0, f"I - J'MJ >= {slack:.3g} I", ""


def assumption_3(plant: AugmentedSystem) -> Finding:
    """Design the smoother with the printed tau and lambda, and with values that round to them."""
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


def grows(smoothed: np.ndarray, filtered: np.ndarray) -> Finding:
    """Test that both errors rise at each step from Delta_2 = 0 to -1."""
    errors = {"smoother": smoothed, "NGCF": filtered}
    rising = all((np.diff(values) > 0.0).all() for values in errors.values())
    rises = [f"the {name}'s from {e[0]:.3f} to {e[-1]:.3f} rad^2" for name, e in errors.items()]
    return rising, f"from Delta_2 = 0 to -1 {' and '.join(rises)}", ""


def below(smoothed: np.ndarray, filtered: np.ndarray) -> Finding:
    """Test that the smoother's error is the smaller one at each Delta_2."""
    share = 1 - smoothed / filtered
    return bool((share > 0).all()), f"{share.min():.0%} to {share.max():.0%} below", ""


def less_sensitive(smoothed: np.ndarray, filtered: np.ndarray) -> Finding:
    """Compare the rises of the errors from Delta_2 = 0 to -1, absolute and relative."""
    rise, ngcf_rise = (error[-1] - error[0] for error in (smoothed, filtered))
    share, ngcf_share = rise / smoothed[0], ngcf_rise / filtered[0]
    value = f"from Delta_2 = 0 to -1 the smoother's rises by {rise:.3f} rad^2 ({share:.0%}), "
    value += f"the NGCF's by {ngcf_rise:.3f} rad^2 ({ngcf_share:.0%})"
    if rise >= ngcf_rise:
        return False, value, "the smoother's rises more"
    absolute = "in absolute terms only: relative to its value the smoother's rises more"
    return True, value, absolute if share >= ngcf_share else ""


def robust_against_kalman(simulation: published.SimulatedErrors) -> Finding:
    """Test that the NGCF's error is below the Kalman-Bucy filter's by three standard errors."""
    robust, kalman = (simulation[name]["filtered"] for name in published.AVERAGED)
    difference = robust.mean_square - kalman.mean_square
    noise = math.hypot(robust.standard_error, kalman.standard_error)
    share = difference / kalman.mean_square
    value = f"the NGCF's error differs by {share:+.2%} from the Kalman-Bucy filter's"
    if difference < -3.0 * noise:
        return True, value, ""
    size = "within three standard errors of ours" if difference <= 3.0 * noise else "the other way"
    reason = "the paper cites other work for this; in this example the two filters have all but the"
    return False, value, f"{reason} same gain, and the difference is {size}"


def percent(smoothed: float, filtered: float) -> Finding:
    """Compare the printed percentage with the excess of the NGCF's error over the smoother's."""
    text = published.stated("41%", "percent")
    theirs, ngcf = (published.printed(f"error covariance, {name}") for name in ("smoother", "NGCF"))
    larger, smaller = 100 * (filtered / smoothed - 1), 100 * (1 - smoothed / filtered)
    value = f"the printed {ngcf:g} is {100 * (ngcf / theirs - 1):.0f}% larger than {theirs:g}; "
    value += f"ours: {larger:.0f}% larger"
    if published.agrees(text, larger, larger):
        return True, value, ""
    is_it = "is" if published.agrees(text, smaller, smaller) else "is not even"
    both = f"printed {100 * (1 - theirs / ngcf):.1f}%, ours {smaller:.1f}%"
    return False, value, f"{text}% {is_it} by how much the smoother's is smaller: {both}"


def significant(smoothed: float, filtered: float) -> Finding:
    """Test that the smoother's error is below the NGCF's."""
    return smoothed < filtered, f"{1 - smoothed / filtered:.1%} below the NGCF's", ""
