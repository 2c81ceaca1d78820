"""Tables of what the paper leaves open."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import Table
from robsmooth.analysis.constraints import AnalysisBound
from robsmooth.analysis.lag import choose_lag
from robsmooth.analysis.worst_case import WorstCase
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne.comparison import Compared
from robsmooth.homodyne.study import Study
from robsmooth.paper.tables import cells
from robsmooth.systems.system import UncertainSystem


def study(found: Study, lag: float) -> Table:
    """Return the best lag for each sector and noise, and what it and a given one save."""
    near = int(np.argmin(np.abs(np.log(np.array(found.lags) / lag))))
    records = []
    for (i, gamma), (j, noise) in product(enumerate(found.gammas), enumerate(found.noises)):
        record = {r"$\gamma$": f"{gamma:g}", "shot noise": f"{noise:.3g}"}
        records.append(record)
        ratio = found.ratio[i, j]
        if np.isnan(ratio).all():
            failed = (gamma, noise) in found.failures
            record["slips (1/s)"] = "no design" if failed else "no lock"
            continue
        k, m = np.unravel_index(np.nanargmin(ratio), ratio.shape)
        here = {name: values[i, j] for name, values in found.quantities.items()}
        at_lag = np.fmin.reduce(ratio[:, near])  # of the orders that have a ratio
        record |= {
            "filtered (rad²)": float(here["filtered"][k, m]),
            "smoothed (rad²)": float(here["smoothed"][k, m]),
            "best lag (µs)": float(1e6 * found.lags[m]),
            "order": str(found.orders[k]),
            "saved": f"{1 - ratio[k, m]:.0%}",
            f"saved at {1e6 * found.lags[near]:.2g} µs": cells.number(1 - at_lag, ".0%"),
            "slips (1/s)": f"{np.nanmax(here['slip_rate']):.2g}",
        }
    return Table.of_records(
        records,
        "The best lag and order of those studied for each sector and noise, and what smoothing "
        "saves there of the filtered error in the nonlinear loop.",
        digits=3,
    )


def side_by_side(compared: Mapping[str, Compared], slopes: Sequence[float]) -> Table:
    """Return the errors of the estimators, from no uncertainty to the worst, and with the sine."""
    records = [
        {
            "estimator": name,
            **{rf"$\Delta_2 = {s:g}$": error for s, error in zip(slopes, case.at, strict=True)},
            "worst constant": case.worst.mean_square,
            "worst allowed": case.allowed.mean_square,
            "$2V$": case.promised,
            "with the sine": cells.estimate(case.simulated, ".4f"),
            "without sampling": case.exact,
            "slips": case.slips,
        }
        for name, case in compared.items()
    ]
    return Table.of_records(
        records,
        "Mean square errors (rad²) side by side: under constant uncertainties, the worst that "
        "the constraints allow, and in the loop with its sine, simulated with the same noise for "
        "all (± one standard error) and from the moments. $2V$ is what the design promises of the "
        "error that its cost is for, in a loop whose copies have noise.",
    )


def optima(designs: Mapping[str, RobustSmoother]) -> Table:
    """Return the least bounds of the example, where they are, and what the estimators gain there.

    Parameters
    ----------
    designs : mapping
        From what each design is for to the design with the least bound.
    """
    records = []
    for name, design in designs.items():
        least = design.limit or design
        records.append(
            {
                "cost": name,
                "infimum of $V$ (rad²)": float(least.bound),
                "attained": "no" if design.limit else "yes",
                r"$\tau$ (rad² µs)": float(1e6 * least.tau),
                r"$\lambda$": f"({cells.numbers(least.multipliers)})",
                "poles (1/µs)": cells.poles(least.poles / 1e6, digits=4),
            }
        )
    return Table.of_records(
        records,
        "The true optimum: the infimum of the bound over all multipliers, where it is, and the "
        "estimator in the limit; of a pair of complex poles one is shown.",
        digits=6,
    )


def gains(estimators: Mapping[str, Estimator]) -> Table:
    """Return the leading entries of the estimators' matrices, which are those of the phase."""
    records = [
        {
            "estimator": name,
            "$A_c[0,0]$ (1/s)": float(estimator.A_c[0, 0]),
            "$B_c[0,0]$ (1/s)": float(estimator.B_c[0, 0]),
            "$B_c[0,1]$": float(estimator.B_c[0, 1]),
            "$C_c[0,0]$": float(estimator.C_c[0, 0]),
            "$C_c[1,0]$": float(estimator.C_c[1, 0]),
        }
        for name, estimator in estimators.items()
    ]
    return Table.of_records(
        records,
        "The gains of the phase: its own drift, what the measurement and the copy drive it "
        "with, and what $\\hat w$ and the copy's argument take of it.",
        digits=6,
    )


def tightness(
    found: Mapping[str, tuple[WorstCase, AnalysisBound, WorstCase, AnalysisBound]],
) -> Table:
    """Return what designs promise against the worst that there is.

    Parameters
    ----------
    found : mapping
        From the name of each design to its worst constant case and the worst that the constraints
        allow, for the error that its bound is for in a loop whose copies have noise, then both for
        the same error in one whose copies have none.
    """
    records = [
        {
            "design": name,
            "$2V$": constant.guarantee,
            "worst allowed": allowed.mean_square,
            "worst constant": constant.mean_square,
            "nominal": constant.nominal,
            "share of $2V$": f"{allowed.mean_square / constant.guarantee:.0%}",
            "worst allowed, real loop": allowed_real.mean_square,
            "worst constant, real loop": constant_real.mean_square,
            "share of $2V$, real loop": f"{allowed_real.mean_square / constant.guarantee:.0%}",
        }
        for name, (constant, allowed, constant_real, allowed_real) in found.items()
    ]
    return Table.of_records(
        records,
        "How tight the guarantee is (rad²): twice the bound against the worst error that "
        "the constraints allow, which some input attains, against the worst constant "
        "uncertainty, and against none; in the loop of the theory, whose copies have noise, "
        "and in a real one.",
    )


def lag_choices(system: UncertainSystem, designs: Sequence[str], shares: Sequence[float]) -> Table:
    """Return the lag and order that take each design to each share of the possible gain."""
    records = []
    for design, share in product(designs, shares):
        record = {"design": design, "share of the gain": f"{100 * share:g}%"}
        records.append(record)
        try:
            choice = choose_lag(system, fraction=share, design=design)
        except InfeasibleDesignError:
            continue
        record |= {
            "lag (µs)": 1e6 * choice.lag,
            "order": str(choice.order),
            "error (rad²)": choice.error,
            "shortest with an exact delay (µs)": 1e6 * choice.shortest,
        }
    return Table.of_records(
        records,
        "The shortest lag, and the lowest order for it, that take a design to a share of what "
        "smoothing could gain; empty where no order does.",
        digits=3,
    )
