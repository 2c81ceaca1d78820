"""The tables of the notebooks."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from inspect import signature
from typing import Any

from scipy.optimize import brentq

from robsmooth._numerics.riccati import RiccatiError
from robsmooth._support.notation import matrix as matrix
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne import HomodyneParameters, fraction_inside
from robsmooth.homodyne.loop import homodyne_loop, linearised, statistical_linearisation
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.paper import published
from robsmooth.simulation.statistics import MeanSquare

Records = Iterator[dict[str, Any]]  # the cells of a row, by column
Results = Mapping[Any, Any]  # a MonteCarloResult for each case
ErrorsByMethod = dict[str, dict[str, MeanSquare]]  # by the name of an error, then by method


def _table(digits: int = 4) -> Callable[[Callable[..., Records]], Callable[..., Table]]:
    """Make a function return a table of its records; its docstring is the format of the caption."""

    def decorate(records: Callable[..., Records]) -> Callable[..., Table]:
        @wraps(records)
        def table(*args: Any) -> Table:
            given = signature(records).bind(*args).arguments
            caption = " ".join(records.__doc__.split()).format_map(given)
            return Table.of_records(records(*args), caption, digits)

        return table

    return decorate


def _estimate(found: MeanSquare, form: str = ".5f", error_form: str | None = None) -> str:
    value, error = found.mean_square, found.standard_error
    return "none" if math.isnan(value) else f"{value:{form}} ± {error:{error_form or form}}"


def _numbers(values: Iterable[complex], digits: int = 4) -> str:
    """Return numbers in a row, one of each conjugate pair."""
    upper = (value for value in values if value.imag >= 0.0)
    return ", ".join(f"{value:.{digits}g}" for value in upper).replace("+0j", "")


@_table()
def sector_ranges(values: HomodyneParameters, variance: float) -> Records:
    """How far each assumption on the sine holds, and how long the loop is within it, for a
    Gaussian error of variance {variance:.4f} rad².
    """
    wide, narrow = values.sector_slope, values.lower_slope
    readings = {
        f"sin e between {wide:.1f} e and e, as gamma = (1 - m)/2 says": values.sector_range(wide),
        f"sin e between {narrow:.1f} e and e, as the design uses": values.sector_range(),
        f"sin e - e Lipschitz with constant {values.gamma:g}": values.lipschitz_range,
    }
    for text, reach in readings.items():
        inside = fraction_inside(reach, variance)
        record = {"what is assumed": text, "holds up to (rad)": reach}
        yield record | {"time inside": f"{inside:.5%}", "time outside": f"{1 - inside:.1e}"}


@_table(digits=5)
def sign_readings(tau: float, multipliers: Sequence[float]) -> Records:
    """The gains at the printed tau and lambda for each reading of the X equation."""

    def record(text: str, A_c: Matrix, B_c: Matrix, C_c: Matrix, bound: float) -> dict[str, Any]:
        gains = {"$A_c[0,0]$": A_c[0, 0], "$B_c[0,1]$": B_c[0, 1], "$C_c[0,0]$": C_c[0, 0]}
        return {"sign": text} | gains | {"$C_c[1,0]$": C_c[1, 0], "$V$": bound}

    for text, sign in {"+, as written": 1.0, "-, flipped": -1.0, "left out": 0.0}.items():
        try:
            design, bound = published.signed_design(tau, multipliers, sign)
            yield record(text, design.A_c, design.B_c, design.C_c, bound)
        except RiccatiError:
            yield {"sign": text, "$A_c[0,0]$": "no real solution"}
    names = ("A_c", "B_c", "C_c", "V at the printed tau, lambda")
    yield record("printed", *map(published.printed, names))


@_table()
def designs(compared: Mapping[str, Estimator]) -> Records:
    """The designs compared. V bounds half the filtered error covariance with the fictitious noise
    of the copies; of a pair of complex poles one is shown.
    """
    for name, design in compared.items():
        record = {"design": name}
        if isinstance(design, RobustSmoother):
            record |= {"$V$ (rad²)": design.bound, r"$\tau$ (rad² s)": f"{design.tau:.4g}"}
            record[r"$\lambda$"] = _numbers(design.multipliers)
        yield record | {"poles (1/s)": _numbers(design.poles, digits=3)}


@_table()
def simulations(results: Results, caption: str) -> Records:
    """{caption}"""
    for name, found in results.items():
        record = {"case": name, "filtered (rad²)": _estimate(found.filtered)}
        record["smoothed (rad²)"] = _estimate(found.smoothed) if found.provenance["delay"] else None
        record |= {"runs": found.runs, "cycle slips": found.slips}
        yield record | {"in how many runs": found.slipped_paths}


def predicted_errors(
    compared: Mapping[str, Estimator], paper: Results, ergodic: Results, of: HomodyneParameters
) -> ErrorsByMethod:
    """Return the errors by each method; the standard error of moments is their truncation."""
    found = {}
    for name, design in compared.items():
        moments, approximate = stationary_errors(of, design), statistical_linearisation(of, design)
        for output in ("filtered", "smoothed") if design.plant.delay > 0.0 else ("filtered",):
            truncation = getattr(moments, f"{output}_truncation")
            literal = {"paper's protocol": getattr(paper[name], output)} if name in paper else {}
            found[f"{name}, {output}"] = literal | {
                "ergodic": getattr(ergodic[name], output),
                "moments": MeanSquare(getattr(moments, output), truncation),
                "statistical linearisation": MeanSquare(getattr(approximate, output), 0.0),
            }
    return found


@_table()
def errors_by_method(found: ErrorsByMethod) -> Records:
    """Three routes, one number: simulation (± one standard error), moments without sampling (±
    estimated truncation), and statistical linearisation.
    """
    for error, methods in found.items():
        moments, literal = methods["moments"], methods.get("paper's protocol")
        linearised = methods["statistical linearisation"].mean_square
        yield {
            "error": error,
            "paper's protocol (rad²)": literal and _estimate(literal),
            "ergodic protocol (rad²)": _estimate(methods["ergodic"], ".6f"),
            "Hermite-Galerkin moments (rad²)": _estimate(moments, ".8f", ".0e"),
            "statistical linearisation (rad²)": f"{linearised:.6f}",
            "its error": f"{linearised / moments.mean_square - 1:+.2%}",
        }


@_table()
def noise_sweep(found: Results) -> Records:
    """The filtered error of the printed smoother as the phase noise grows."""
    for factor, simulated in found.items():
        yield {
            "phase noise": f"{factor:g}",
            "all runs (rad²)": _estimate(simulated.filtered, ".4f"),
            "runs in lock (rad²)": _estimate(simulated.filtered_in_lock, ".4f"),
            "slips": simulated.slips,
            "runs that slipped": f"{simulated.slipped_paths} of {simulated.runs}",
            "slips (1/s)": f"{simulated.slip_rate:.3g}",
        }


def change_needed(smoother: Estimator, ngcf: Estimator, values: HomodyneParameters) -> Table:
    """Return the changes of single numbers of the loop that predict the printed errors."""
    smoothed = published.printed("error covariance, smoother")
    filtered, runs = published.printed("error covariance, NGCF"), published.printed("runs")
    changes = ("power of the shot noise", "power of the phase noise", "detector gain")
    cases = {"smoother": (smoother, "smoothed", smoothed), "NGCF": (ngcf, "filtered", filtered)}

    def excess(factor: float, change: str, design: Estimator, output: str, target: float) -> float:
        shot, phase, gain = (factor if change == each else 1.0 for each in changes)
        loop = homodyne_loop(replace(values, kappa=phase * values.kappa), design, shot_noise=shot)
        return getattr(linearised(replace(loop, gains=gain * loop.gains)), output) - target

    records = []
    for change in changes:
        factors = {
            f"factor for the {name}": brentq(excess, 0.7, 2.0, (change, *case), xtol=1e-10)
            for name, case in cases.items()
        }
        record = {"changed": change} | factors
        for name, case in cases.items():
            off = excess(sum(factors.values()) / 2, change, *case)
            # the standard error of a mean of `runs` squared Gaussian errors
            distance = off / (case[-1] * math.sqrt(2 / runs))
            record[f"{name} at the mean factor"] = f"{case[-1] + off:.4f} ({distance:+.1f})"
        records.append(record)
    caption = (
        f"The factor on one number of the loop at which each printed error ({smoothed:g} and "
        f"{filtered:g} rad²) is predicted, and what is predicted at the mean of the two factors; "
        f"in brackets, how far off, in standard errors of a simulation of {runs:.0f} runs."
    )
    return Table.of_records(records, caption)
