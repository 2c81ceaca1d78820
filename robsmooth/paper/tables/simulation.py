"""Tables of the nonlinear loop, by simulation and without."""

import math
from collections.abc import Iterable, Mapping

from robsmooth._support.tables import Table
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.montecarlo import MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import predictions, published
from robsmooth.paper.predictions import ErrorsByMethod, NoisySimulation
from robsmooth.paper.tables import cells


def simulations(results: Mapping[str, MonteCarloResult], caption: str) -> Table:
    """Return mean squares with standard errors, one case a row."""
    records = []
    for name, result in results.items():
        smooths = result.provenance["delay"] > 0.0
        records.append(
            {
                "case": name,
                "filtered (rad²)": cells.estimate(result.filtered),
                "smoothed (rad²)": cells.estimate(result.smoothed) if smooths else None,
                "runs": result.runs,
                "cycle slips": result.slips,
                "in how many runs": result.slipped_paths,
            }
        )
    return Table.of_records(records, caption)


def errors_by_method(found: ErrorsByMethod) -> Table:
    """Return the errors by simulation, by their moments and by statistical linearisation."""
    records = []
    for error, methods in found.items():
        moments = methods["moments"]
        linearised = methods["statistical linearisation"].mean_square
        records.append(
            {
                "error": error,
                "paper's protocol (rad²)": cells.estimate(methods["paper's protocol"]),
                "ergodic protocol (rad²)": cells.estimate(methods["ergodic"], ".6f"),
                "Hermite-Galerkin moments (rad²)": cells.estimate(moments, ".8f", ".0e"),
                "statistical linearisation (rad²)": f"{linearised:.6f}",
                "its error": f"{linearised / moments.mean_square - 1:+.2%}",
            }
        )
    return Table.of_records(
        records,
        "Three routes, one number: simulation (± one standard error), moments without sampling "
        "(± estimated truncation), and statistical linearisation.",
    )


def noise_sweep(found: Iterable[NoisySimulation]) -> Table:
    """Return the filtered errors and the slips of a noise sweep."""
    records = [
        {
            "phase noise": f"{case.factor:g}",
            "all runs (rad²)": cells.estimate(case.simulated.filtered, ".4f"),
            "runs in lock (rad²)": cells.estimate(case.simulated.filtered_in_lock, ".4f"),
            "slips": case.simulated.slips,
            "runs that slipped": f"{case.simulated.slipped_paths} of {case.simulated.runs}",
            "slips (1/s)": f"{case.simulated.slip_rate:.3g}",
            "moments (rad²)": cells.number(case.moments),
            "statistical linearisation (rad²)": cells.number(case.linearised),
        }
        for case in found
    ]
    return Table.of_records(
        records,
        "The filtered error of the printed smoother as the phase noise grows. Predictions are "
        "for a loop in lock, and are left out where their method finds no such loop.",
    )


def change_needed(smoother: Estimator, ngcf: Estimator, values: HomodyneParameters) -> Table:
    """Return how far one number of the loop must change for the printed errors to be predicted.

    Statistical linearisation predicts; the estimators stay as they are.
    """
    cases = {"smoother": (smoother, "smoothed"), "NGCF": (ngcf, "filtered")}
    targets = {name: published.printed(f"error covariance, {name}") for name in cases}
    runs = published.printed("runs")
    records = []
    for change in predictions.CHANGES:
        factors = {
            f"factor for the {name}": predictions.factor_for(*case, targets[name], change, values)
            for name, case in cases.items()
        }
        middle = sum(factors.values()) / 2
        record = {"changed": change} | factors
        for name, (design, output) in cases.items():
            error = getattr(predictions.predicted(design, change, middle, values), output)
            # the standard error of a mean of squares of Gaussian errors
            distance = (error - targets[name]) / (targets[name] * math.sqrt(2 / runs))
            record[f"{name} at the mean factor"] = f"{error:.4f} ({distance:+.1f})"
        records.append(record)
    both = " and ".join(f"{target:g}" for target in targets.values())
    return Table.of_records(
        records,
        f"The factor on one number of the loop at which each printed error ({both} rad²) is "
        "predicted, and what is predicted at the mean of the two factors; in brackets, how "
        f"far off, in standard errors of a simulation of {runs:.0f} runs.",
    )
