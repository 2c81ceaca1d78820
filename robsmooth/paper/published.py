"""The numbers that the paper prints, the designs that follow, and the results in data/."""

import itertools
import json
import time
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from robsmooth import homodyne
from robsmooth._numerics.riccati import solve_riccati
from robsmooth._support import files, validation
from robsmooth._support.validation import Matrix
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother, design_equations
from robsmooth.simulation.statistics import MeanSquare
from robsmooth.systems.augmented import AugmentedSystem, augment
from robsmooth.systems.delay import DelayModel
from robsmooth.workbench import provenance

DELAY = 3.1e-6  # s
ORDER = 2
RESULTS = "monte_carlo.json"  # which notebook 04 writes
# By Bayes' rule, in a loop that the filter steers; benchmarks/nonlinear_floor.py writes it.
NONLINEAR_FLOOR = "nonlinear_floor.json"
LITERAL = ("smoother, as printed", "NGCF")  # designs with verdicts, by the paper's protocol
AVERAGED = ("NGCF, time averages", "Kalman-Bucy, time averages")  # with one by the ergodic protocol
SimulatedErrors = Mapping[str, Mapping[str, MeanSquare]]  # by design, "smoothed" or "filtered"
LAMBDA = ("lambda_1", "lambda_2", "lambda_3", "lambda_4")


def data_folder() -> Path:
    """Return the folder data/ of the project, or the wheel's copy of it."""
    packed = provenance.ROOT / "robsmooth/_data"
    return packed if packed.is_dir() else provenance.ROOT / "data"


@cache
def published() -> dict:
    """Return the content of published.toml."""
    return tomllib.loads((data_folder() / "published.toml").read_text(encoding="utf-8"))


def printed_text(name: str) -> str | list:
    """Return the printed digits of a quantity, such as "tau"; of a matrix, in a list of rows."""
    quantities = {entry["id"]: entry["printed"] for entry in published()["quantity"]}
    if name not in quantities:
        raise KeyError(f"the paper prints no {name!r}; it has {', '.join(quantities)}")
    return quantities[name]


def printed(name: str) -> float | Matrix:
    """Return a printed quantity, such as "A_c", as a number or array."""
    value = np.array(printed_text(name), dtype=float)
    return float(value) if value.ndim == 0 else value


def stated(name: str, field: str) -> str:
    """Return the printed digits of a number in a statement."""
    return next(each[field] for each in published()["statement"] if each["id"] == name)


def printed_multipliers() -> np.ndarray:
    """Return the printed lambda_1 ... lambda_4."""
    return np.array([printed(name) for name in LAMBDA])


def last_digit(text: str) -> float:
    """Return the unit of the last printed digit: 0.01 for "1.13", 1e-8 for "1.13e-6"."""
    return 10.0 ** Decimal(text).as_tuple().exponent


def agrees(text: str, low: float, high: float, zero: float = 0.0) -> bool:
    """Tell whether a value in [low, high], rounded or cut off, prints as `text`."""
    number = float(text)
    if number == 0.0:
        return low <= zero and high >= -zero
    if number < 0.0:
        number, low, high = -number, -high, -low
    unit, rounding = last_digit(text), 1e-9 * number
    return high >= number - unit / 2 - rounding and low < number + unit


def rounding_box() -> list[tuple[float, np.ndarray]]:
    """Return the printed tau and lambda, and the corners of the box that rounds to them."""
    half = np.array([last_digit(printed_text(name)) / 2 for name in ("tau", *LAMBDA)])
    middle = np.array([printed("tau"), *printed_multipliers()])
    corners = [middle + half * signs for signs in itertools.product((-1, 1), repeat=5)]
    return [(corner[0], corner[1:]) for corner in (middle, *corners)]


@cache
def paper_plant() -> AugmentedSystem:
    """Return the example's plant in the paper's coordinates of the delay model."""
    damping, stiffness = 6.0 / DELAY, 12.0 / DELAY**2
    drive, chain = 2.0**11, 2.0**20  # the states are scaled: 2048 and 1.048e6 in the printed A_p
    F = np.array([[-damping, -stiffness / chain], [chain, 0.0]])
    G, H = np.array([[drive], [0.0]]), np.array([[-2.0 * damping / drive, 0.0]])
    model = DelayModel(F, G, H, np.eye(1), delay=DELAY, order=ORDER)
    plant = augment(homodyne.PAPER.uncertain_system(), model.delay, model.order)
    return replace(plant, delay_model=model)


def signed_design(tau: float, multipliers: Matrix, sign: float = -1.0) -> tuple[Estimator, float]:
    """Return the estimator and V; `sign` multiplies the quadratic term of the X equation."""
    plant = paper_plant()
    equations = design_equations(plant, tau, multipliers)
    X = solve_riccati(*equations.equation_X(quadratic_sign=sign))
    A_c, B_c, C_c, bound, _ = equations.gains(X.X, solve_riccati(*equations.equation_Y).X)
    # the paper prints no C_a; the plant's reads out the smoothed estimate
    return Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=C_c[:1]), bound


@cache
def recomputed_estimator() -> Estimator:
    """Return the design "as printed": of the printed tau and lambda, with the sign flipped."""
    return signed_design(printed("tau"), printed_multipliers())[0]


@cache
def corrected_smoother() -> RobustSmoother:
    """Return the design "corrected": with the theory's sign and the least bound."""
    return minimize_bound(augment(homodyne.PAPER.uncertain_system(), DELAY, ORDER), "filtered")


@cache
def designs() -> Mapping[str, Estimator]:
    """Return the designs by their names in figures and tables."""
    system = homodyne.PAPER.uncertain_system()
    found = {"smoother, as printed": recomputed_estimator()}
    found |= {"smoother, corrected": corrected_smoother(), "NGCF": baselines.ngcf(system)}
    found["Kalman-Bucy"] = baselines.kalman_bucy(system, copies=True)  # for the adaptive loop
    return MappingProxyType(found)


def read_simulation(folder: Path) -> SimulatedErrors:
    """Return the mean square errors in a folder; ValueError where they are missing or corrupt."""
    try:
        cases = json.loads((folder / RESULTS).read_text(encoding="utf-8"))["cases"]
        outputs, names = ("smoothed", "filtered"), (*LITERAL, *AVERAGED)
        return {name: {each: _error(cases[name][each]) for each in outputs} for name in names}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{RESULTS} in {folder.name}/ cannot be used ({type(error).__name__}: {error}); "
            "make figures ONLY=04 writes it anew"
        ) from None


def _error(stored: Mapping[str, float]) -> MeanSquare:
    fields = ("mean_square", "standard_error")
    return MeanSquare(*(validation.real(name, stored[name], low=0.0) for name in fields))


def write_simulation(data: Path | str, results: Mapping[str, Any], seed: int) -> None:
    """Write `MonteCarloResult`s without their run times to a folder, and their provenance."""
    path, cases = Path(data) / RESULTS, {name: case.to_dict() for name, case in results.items()}
    for case in cases.values():
        del case["wall_time"], case["provenance"]
    files.write_json(path, {"cases": cases})
    times = {name: round(result.wall_time, 3) for name, result in results.items()}
    started = time.perf_counter() - sum(times.values())
    provenance.write(path, seed=seed, started=started, wall_time_seconds=times)
