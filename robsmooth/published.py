r"""What the paper prints, and whether it reproduces.

The printed values are data, in ``data/published.toml``; this module recomputes each and gives a
verdict. It is also the home of the paper's slip of sign: the printed gains follow from the printed
:math:`\tau` and :math:`\lambda` only with the quadratic term of the X equation negated, as a
standard Riccati solver has it. The library's core knows nothing of that.

A value agrees with a printed one when rounding it, or cutting it off, at the printed digits gives
what is printed (the paper does both). What follows from the printed :math:`\tau` and
:math:`\lambda` agrees when it does so for some values that round to the printed ones.
"""

import itertools
import json
import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from robsmooth import baselines, homodyne, validation
from robsmooth.augmented import AugmentedSystem, augment
from robsmooth.blas import one_thread
from robsmooth.bound import VANISHING, minimize_bound
from robsmooth.covariance import delta_sweep, statistical_linearisation
from robsmooth.delay import DelayModel
from robsmooth.errors import InfeasibleDesignError
from robsmooth.estimator import Estimator
from robsmooth.smoother import RobustSmoother, design_equations, design_smoother
from robsmooth.validation import Matrix

REPRODUCED = "reproduced"
WITH_FLIPPED_SIGN = "reproduced with the sign flipped"
NOT_REPRODUCED = "not reproduced"
NOT_CHECKABLE = "not checkable"

DELAY = 3.1e-6  # s
ORDER = 2

_INPUT = "an input of the paper, not a result"
_ZERO = 1e-9  # relative to the largest entry of its matrix, a computed value below this is zero


@dataclass(frozen=True)
class Verdict:
    """One printed number or statement, and whether it reproduces.

    Attributes
    ----------
    name : str
        What it is, e.g. ``"A_c[0, 1]"`` (row and column from zero).
    place : str
        Where it stands in the paper.
    printed : str
        As printed.
    value : float or str or None
        Recomputed, in the printed unit; words for a statement; None where nothing can be computed.
    relative_difference : float or None
        (value - printed)/|printed|, where that makes sense.
    verdict : str
        One of "reproduced", "reproduced with the sign flipped", "not reproduced", "not checkable".
    reason : str
        Why, as far as known, where it does not simply reproduce.
    """

    name: str
    place: str
    printed: str
    value: float | str | None
    relative_difference: float | None
    verdict: str
    reason: str


def data_folder() -> Path:
    """Return the folder of the published values and results: data/, or the wheel's copy of it."""
    package = Path(__file__).parent
    packed = package / "_data"
    return packed if packed.is_dir() else package.parent / "data"


@cache
def published() -> dict:
    """Return the content of published.toml.

    Raises
    ------
    ValueError
        Where the file is missing, is not TOML or lacks a field, which the message names.
    """
    return read_published(data_folder() / "published.toml")


def read_published(path: Path) -> dict:
    """Read and check a file of published values (`published` reads the project's own)."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from None
    fields = {
        "quantity": ("id", "place", "kind", "printed"),
        "statement": ("id", "place", "kind", "text"),
    }
    for section, required in fields.items():
        entries = content.get(section)
        if not isinstance(entries, list) or not entries:
            raise ValueError(f"{path.name} has no [[{section}]]")
        for entry in entries:
            for field in required:
                if field not in entry:
                    name = entry.get("id", "without id")
                    raise ValueError(f"{path.name}: [[{section}]] {name} lacks {field!r}")
    for entry in content["quantity"]:
        for index, text in _entries(entry["printed"]):
            try:
                float(text)
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path.name}: {entry['id']}{index} must be a number in quotes, got {text!r}"
                ) from None
    return content


def printed(name: str) -> float | Matrix:
    """Return a printed quantity as a number or array, e.g. ``printed("A_c")``."""
    quantities = {entry["id"]: entry["printed"] for entry in published()["quantity"]}
    if name not in quantities:
        raise KeyError(f"the paper prints no {name!r}; it has {', '.join(quantities)}")
    value = np.array(quantities[name], dtype=float)
    return float(value) if value.ndim == 0 else value


def printed_multipliers() -> np.ndarray:
    """Return the printed lambda_1 ... lambda_4."""
    return np.array([printed(f"lambda_{i}") for i in (1, 2, 3, 4)])


# --- designs --------------------------------------------------------------------------------


@cache
def paper_plant() -> AugmentedSystem:
    """Return the example's augmented system in the paper's coordinates of the delay model.

    The second-order Pade model with its states scaled by powers of two, which gives the entries
    2048 = 2^11 and 1.048e6 = 2^20 of the printed A_p.
    """
    damping, stiffness = 6.0 / DELAY, 12.0 / DELAY**2
    drive, chain = 2.0**11, 2.0**20
    model = DelayModel(
        F=np.array([[-damping, -stiffness / chain], [chain, 0.0]]),
        G=np.array([[drive], [0.0]]),
        H=np.array([[-2.0 * damping / drive, 0.0]]),
        J=np.eye(1),
        delay=DELAY,
        order=ORDER,
    )
    return AugmentedSystem(homodyne.PAPER.uncertain_system(), model, np.eye(1))


@cache
def printed_estimator() -> Estimator:
    """Return the estimator with the very digits that the paper prints.

    The paper prints no read-out of the smoothed estimate; it is C_a.
    """
    plant, C_c = paper_plant(), printed("C_c")
    return Estimator(
        plant=plant,
        A_c=printed("A_c"),
        B_c=printed("B_c"),
        C_c=C_c,
        C_a=plant.C_a,
        C_f=C_c[:1],
    )


def flipped_design(tau: float, multipliers: np.ndarray) -> tuple[Estimator, float]:
    """Return estimator and V with the quadratic term of the X equation negated."""
    plant = paper_plant()
    equations = design_equations(plant, tau, multipliers)
    X, Y = equations.solve_X(quadratic_sign=-1.0), equations.solve_Y()
    A_c, B_c, C_c, bound = equations.gains(X.X, Y.X)
    estimator = Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=C_c[:1])
    return estimator, bound


@cache
def recomputed_estimator() -> Estimator:
    """Return the estimator of the printed tau and lambda, with the sign flipped: "as printed"."""
    return flipped_design(printed("tau"), printed_multipliers())[0]


@cache
def corrected_smoother() -> RobustSmoother:
    """Return the design with the least bound, the sign as the theory has it: "corrected"."""
    return minimize_bound(augment(homodyne.PAPER.uncertain_system(), DELAY, ORDER))


@cache
def ngcf() -> RobustSmoother:
    """Return the nonlinear guaranteed cost filter of the example."""
    return baselines.ngcf(homodyne.PAPER.uncertain_system())


@cache
def kalman_filter() -> Estimator:
    """Return the example's Kalman-Bucy filter, for which the adaptive loop runs the copies."""
    return baselines.kalman_bucy(homodyne.PAPER.uncertain_system(), copies=True)


def designs() -> dict[str, Estimator]:
    """Return the designs compared throughout, by the names that figures and tables use."""
    return {
        "smoother, as printed": recomputed_estimator(),
        "smoother, corrected": corrected_smoother(),
        "NGCF": ngcf(),
        "Kalman-Bucy": kalman_filter(),
    }


def x_discriminant(tau: float, multipliers: np.ndarray) -> float:
    """Return the discriminant of the example's X equation, relative to its linear term squared.

    For the example it is a quadratic, kappa/(tau lambda_1) X^2 - 2 lambda X + q = 0; below zero
    there is no real solution.
    """
    equations = design_equations(paper_plant(), tau, multipliers)
    linear = 2.0 * homodyne.PAPER.lam
    return float(1.0 - 4.0 * equations.worst_noise[0, 0] / tau * equations.Q_X[0, 0] / linear**2)


# --- verdicts -------------------------------------------------------------------------------


KINDS = ("input", "model", "optimum", "design", "sweep", "simulation")


@one_thread
def verdicts(data_dir: Path | str | None = None, kinds: Sequence[str] = KINDS) -> list[Verdict]:
    """Recompute every number that the paper prints and judge it.

    Parameters
    ----------
    data_dir : path, optional
        Folder with the Monte Carlo results, monte_carlo.json; by default the project's own data/,
        which `make figures` writes.
    kinds : sequence of str
        Which quantities and statements to judge, as data/published.toml sorts them; all by default.

    Returns
    -------
    list of Verdict
        In the order of the paper; a matrix gives one for each entry.

    Raises
    ------
    ValueError
        Where a data file is missing or corrupt.
    """
    for kind in kinds:
        validation.choice("kinds", kind, KINDS)
    simulation = None
    if "simulation" in kinds:
        simulation = MonteCarloTable.read(Path(data_dir) if data_dir else data_folder())
    values = _Values(simulation)
    checks = _statements(simulation)
    found = []
    for entry in published()["quantity"]:
        if entry["kind"] in kinds:
            found.extend(values.judge(entry))
    for statement in published()["statement"]:
        if statement["kind"] in kinds:
            holds, value, reason = checks[statement["id"]]()
            found.append(
                Verdict(
                    name=statement["id"],
                    place=statement["place"],
                    printed=statement["text"],
                    value=value,
                    relative_difference=None,
                    verdict=REPRODUCED if holds else NOT_REPRODUCED,
                    reason=reason,
                )
            )
    return found


@dataclass(frozen=True)
class MonteCarloTable:
    """The Monte Carlo results that notebook 04 writes, by design and output.

    Attributes
    ----------
    cases : dict
        From the name of the case to its "smoothed" and "filtered" results, each with
        "mean_square" and "standard_error".
    """

    cases: dict[str, dict[str, dict[str, float]]]

    NAME = "monte_carlo.json"

    @classmethod
    def read(cls, folder: Path) -> "MonteCarloTable":
        """Read monte_carlo.json; ValueError where it is missing or corrupt."""
        path = folder / cls.NAME
        try:
            cases = json.loads(path.read_text(encoding="utf-8"))["cases"]
            for case in cases.values():
                for output in ("smoothed", "filtered"):
                    for field in ("mean_square", "standard_error"):
                        if not math.isfinite(case[output][field]):
                            raise ValueError(f"{field} is not finite")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path.name} in {folder.name}/ cannot be used ({type(error).__name__}: {error}); "
                "make figures ONLY=04 writes it anew"
            ) from None
        return cls(cases)

    def mean_square(self, design: str, output: str) -> float:
        """Return the mean square error of a case, rad^2."""
        return self.cases[design][output]["mean_square"]

    def text(self, design: str, output: str) -> str:
        """Return mean square and standard error in words."""
        case = self.cases[design][output]
        return f"{case['mean_square']:.5f} ± {case['standard_error']:.5f}"


class _Values:
    """The recomputed value of every printed quantity, each kind computed when first asked for."""

    def __init__(self, simulation: MonteCarloTable | None):
        self._simulation = simulation

    @cached_property
    def model(self) -> dict[str, float | Matrix]:
        plant = paper_plant()
        system = plant.system
        noise = plant.D21_bar @ plant.D21_bar.T
        return {
            "A_p": plant.A_p,
            "B_p1": plant.B_p1[:, : system.q],
            "B_p1,1": plant.B1_tilde[:, :1],
            "Bbar_p1,1": plant.B1_tilde[:, 1:2],
            "C_p0": plant.C_p0,
            "C_p1,1": plant.C1_tilde[:1],
            "Cbar_p1,1": plant.C1_tilde[1:2],
            "C_p2": plant.C2_tilde[:1],
            "B1_tilde": plant.B1_tilde,
            "C1_tilde": plant.C1_tilde,
            "D12_tilde": plant.D12_tilde,
            "C2_tilde": plant.C2_tilde,
            "D21_tilde": plant.D21_tilde,
            "D21_bar": plant.D21_bar,
            "h": sum(u.C.shape[0] for u in system.uncertainties),
            "r": sum(u.B.shape[1] for u in system.uncertainties),
            "p": plant.C1_tilde.shape[0],
            "k_tilde": len(plant.M_i),
            "g": system.g,
            "k": system.k,
            "J": plant.J,
            "largest d_0": float(np.linalg.eigvalsh(noise).min()),
        }

    @cached_property
    def optimum(self) -> dict[str, float | Matrix]:
        best = corrected_smoother()
        attained = best.bound_infimum is None
        limit = best.multipliers * (attained | (best.multipliers > 10 * VANISHING))
        return {
            "least V": best.bound if attained else best.bound_infimum,
            "tau": best.tau,
            **{f"lambda_{i + 1}": float(limit[i]) for i in range(4)},
        }

    @cached_property
    def design(self) -> dict[str, float | Matrix]:
        return self._design_at(printed("tau"), printed_multipliers())

    @cached_property
    def simulation(self) -> dict[str, float | Matrix]:
        simulated = self._simulation
        return {
            "error covariance, smoother": simulated.mean_square("smoother, as printed", "smoothed"),
            "error covariance, NGCF": simulated.mean_square("NGCF", "filtered"),
        }

    @cached_property
    def _design_range(self) -> dict[str, tuple[Matrix, Matrix]]:
        """Return the least and largest values over all tau and lambda that print the same."""
        boxed = [self._design_at(*corner) for corner in _rounding_box()]
        stacks = {name: np.array([values[name] for values in boxed]) for name in boxed[0]}
        return {name: (stack.min(axis=0), stack.max(axis=0)) for name, stack in stacks.items()}

    @staticmethod
    def _design_at(tau: float, multipliers: np.ndarray) -> dict[str, float | Matrix]:
        estimator, bound = flipped_design(tau, multipliers)
        return {
            "A_c": estimator.A_c,
            "B_c": estimator.B_c,
            "C_c": estimator.C_c,
            "V at the printed tau, lambda": bound,
        }

    def judge(self, entry: dict) -> Iterator[Verdict]:
        """Yield the verdict on a quantity, one for each entry of a matrix."""
        name, kind = entry["id"], entry["kind"]
        for index, text in _entries(entry["printed"]):
            label = name + (f"[{index[0]}, {index[1]}]" if index else "")
            unit = f" {entry['unit']}" if "unit" in entry else ""
            common = {"name": label, "place": entry["place"], "printed": text + unit}
            if kind == "input":
                yield Verdict(
                    **common,
                    value=None,
                    relative_difference=None,
                    verdict=NOT_CHECKABLE,
                    reason=_INPUT,
                )
                continue
            whole = np.asarray(getattr(self, kind)[name], dtype=float)
            value = float(whole[index])
            ends = self._design_range[name] if kind == "design" else (whole, whole)
            low, high = (np.asarray(end)[index] for end in ends)
            zero = _ZERO * np.abs(whole).max()
            agrees = _agrees(text, float(low), float(high), zero)
            value = 0.0 if abs(value) < zero else value  # rounding noise would differ by machine
            number = float(text)
            yield Verdict(
                **common,
                value=value,
                relative_difference=(value - number) / abs(number) if number else None,
                verdict=self._outcome(kind, agrees),
                reason="" if agrees else entry["why"],
            )

    @staticmethod
    def _outcome(kind: str, agrees: bool) -> str:
        if not agrees:
            return NOT_REPRODUCED
        return WITH_FLIPPED_SIGN if kind == "design" else REPRODUCED


def _entries(value: str | list) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield index and text of a number or of each entry of a matrix."""
    if isinstance(value, list):
        for i, row in enumerate(value):
            for j, text in enumerate(row):
                yield (i, j), text
    else:
        yield (), value


def _last_digit(text: str) -> float:
    """Return the worth of the last printed digit: 0.01 for "1.13", 1e-8 for "1.13e-6"."""
    mantissa, _, exponent = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals)


def _agrees(text: str, low: float, high: float, zero: float) -> bool:
    """Tell whether some value in [low, high] is printed as `text`, rounded or cut off."""
    number = float(text)
    if number == 0.0:
        return low <= zero and high >= -zero
    if number < 0.0:
        number, low, high = -number, -high, -low
    unit = _last_digit(text)
    tiny = 1e-9 * number
    return high >= number - unit / 2 - tiny and low < number + unit


def _rounding_box() -> list[tuple[float, np.ndarray]]:
    """Return the printed tau and lambda and the corners of what rounds to them."""
    names = ("tau", "lambda_1", "lambda_2", "lambda_3", "lambda_4")
    texts = {entry["id"]: entry["printed"] for entry in published()["quantity"]}
    half = np.array([_last_digit(texts[name]) / 2 for name in names])
    middle = np.array([printed(name) for name in names])
    corners = [middle + half * np.array(signs) for signs in itertools.product((-1, 1), repeat=5)]
    return [(corner[0], corner[1:]) for corner in (middle, *corners)]


Check = Callable[[], tuple[bool, str, str]]


def _statements(simulation: MonteCarloTable | None) -> dict[str, Check]:
    """Return the check of each statement: whether it holds, our value in words, and why."""
    parameters, plant = homodyne.PAPER, paper_plant()
    slopes = np.linspace(-1.0, 0.0, 21)

    @cache
    def sweep(name: str, output: str) -> np.ndarray:
        return delta_sweep(designs()[name], slopes, output)[:, 0, 0]

    def smoothing_improves():
        system = parameters.uncertain_system()
        filtered = baselines.optimal_fixed_lag_error(system, 0.0)[0, 0]
        smoothed = baselines.optimal_fixed_lag_error(system, DELAY)[0, 0]
        return smoothed < filtered, f"{filtered:.5f} -> {smoothed:.5f} at the lag of 3.1 us", ""

    def robust_against_kalman():
        robust, kalman = (simulation.cases[name]["filtered"] for name in ("NGCF", "Kalman-Bucy"))
        difference = robust["mean_square"] - kalman["mean_square"]
        noise = math.hypot(robust["standard_error"], kalman["standard_error"])
        better = difference < -3.0 * noise
        percent = 100 * difference / kalman["mean_square"]
        value = f"the NGCF's error differs by {percent:+.2f}% from the Kalman-Bucy filter's"
        reason = (
            ""
            if better
            else "the paper cites other work for this; in this example the two filters have all "
            "but the same gain, and the difference is within three standard errors of ours"
        )
        return better, value, reason

    def sector():
        slope, reach = parameters.sector_slope, parameters.sector_range()
        loop = statistical_linearisation(ngcf(), parameters.equivalent_slope)
        inside = homodyne.fraction_inside(reach, loop.filtered)
        return (
            False,
            f"m = {slope:g}; lower slope in the design {parameters.lower_slope:g}",
            "gamma = (1 - m)/2 is for a sector around its middle slope (1 + m)/2 = 0.6, but the "
            f"design has beta = 1, so that its sector is [0.6, 1.4]; it holds for errors up to "
            f"{reach:.3f} rad, beyond which the loop is {1 - inside:.0e} of the time",
        )

    def scaled():
        error = np.linspace(1e-3, parameters.sector_range(), 500)
        ratio = np.abs(parameters.remainder(error) / error).max()
        return (
            False,
            f"|f/gamma| <= {ratio / parameters.gamma:.3g} |mu|; "
            f"|f gamma| <= {ratio * parameters.gamma:.3g} |mu|",
            "must be f/gamma: only then is gamma f~/beta = f/beta, and f~ in the unit sector",
        )

    def inverse():
        rng = np.random.default_rng(0)
        worst = 0.0
        for _ in range(20):
            l1, l2, l3, l4 = multipliers = rng.uniform(0.01, 1.0, 4)
            det = l3 * l4 + l2 * (l3 + l4)
            formula = [
                [1 / l1, 0, 0],
                [0, (l2 + l4) / det, l2 / det],
                [0, l2 / det, (l2 + l3) / det],
            ]
            worst = max(worst, np.abs(plant.M(multipliers) @ formula - np.eye(3)).max())
        return worst < 1e-12, f"M M^-1 = I to {worst:.0e}", ""

    def constraints():
        rng = np.random.default_rng(0)
        same = True
        for multipliers in rng.uniform(0.0, 1.0, (500, 4)):
            l1, l2, l3, l4 = multipliers
            a, b = 1 - l2 - l3, 1 - l2 - l4
            theirs = l1 <= 1 and a >= 0 and b >= 0 and a * b >= l2**2
            gap = np.eye(3) - plant.J.T @ plant.M(multipliers) @ plant.J
            same &= theirs == bool(np.linalg.eigvalsh(gap).min() >= 0.0)
        return bool(same), "equivalent to M^-1 >= J J' at 500 random lambda", ""

    def satisfies():
        gap = np.eye(3) - plant.J.T @ plant.M(printed_multipliers()) @ plant.J
        smallest = np.linalg.eigvalsh(gap).min()
        return bool(smallest >= 0), f"I - J'MJ >= {smallest:.3g} I", ""

    def assumption_3():
        try:
            design_smoother(plant, printed("tau"), printed_multipliers())
        except InfeasibleDesignError as error:
            never = all(_infeasible(*corner) for corner in _rounding_box())
            reason = "no real solution for any rounding of the printed digits" if never else ""
            return False, error.condition + " fails", reason
        return True, "all conditions hold", ""

    def grows():
        rising = all(
            (np.diff(sweep(name, output)) < 0.0).all()
            for name, output in (("NGCF", "filtered"), ("smoother, as printed", "smoothed"))
        )
        return rising, "both fall from Delta_2 = -1 to 0", ""

    def below():
        ratio = sweep("smoother, as printed", "smoothed") / sweep("NGCF", "filtered")
        value = f"{100 * (1 - ratio.max()):.0f}% to {100 * (1 - ratio.min()):.0f}% below"
        return bool((ratio < 1).all()), value, ""

    def sensitive():
        rises = {}
        for name, output in (("NGCF", "filtered"), ("smoother, as printed", "smoothed")):
            worst, nominal = sweep(name, output)[[0, -1]]
            rises[name] = worst - nominal, worst / nominal - 1.0
        (ngcf_rise, ngcf_share), (rise, share) = rises.values()
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

    def percent():
        smoother = simulation.mean_square("smoother, as printed", "smoothed")
        filtered = simulation.mean_square("NGCF", "filtered")
        return (
            False,
            f"the printed 0.1031 is {100 * (0.1031 / 0.0605 - 1):.0f}% larger than 0.0605; ours: "
            f"{100 * (filtered / smoother - 1):.0f}% larger",
            "41% is by how much the smoother's is smaller: printed "
            f"{100 * (1 - 0.0605 / 0.1031):.1f}%, ours {100 * (1 - smoother / filtered):.1f}%",
        )

    def significant():
        smoother = simulation.mean_square("smoother, as printed", "smoothed")
        filtered = simulation.mean_square("NGCF", "filtered")
        return smoother < filtered, f"{100 * (1 - smoother / filtered):.1f}% below the NGCF's", ""

    return {
        "smoothing improves the Kalman-Bucy filter": smoothing_improves,
        "robust filter against Kalman filter": robust_against_kalman,
        "sector": sector,
        "scaled nonlinearity": scaled,
        "inverse of M": inverse,
        "constraints on lambda": constraints,
        "printed lambda satisfies the constraints": satisfies,
        "Assumption 3 at the printed design": assumption_3,
        "error grows with the uncertainty": grows,
        "smoother much below NGCF": below,
        "less sensitive": sensitive,
        "41%": percent,
        "significant improvement": significant,
    }


def _infeasible(tau: float, multipliers: np.ndarray) -> bool:
    try:
        design_smoother(paper_plant(), tau, multipliers)
    except InfeasibleDesignError:
        return True
    return False
