"""Tables of what the paper leaves open."""

from collections.abc import Mapping, Sequence

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
from robsmooth.systems.system import UncertainSystem


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


def side_by_side(compared: Mapping[str, Compared], slopes: Sequence[float]) -> Table:
    """Return the errors of the estimators, from no uncertainty to the worst, and with the sine."""
    rows = []
    for name, case in compared.items():
        simulated = case.simulated
        rows.append(
            (
                name,
                *case.at,
                case.worst.mean_square,
                case.allowed.mean_square,
                case.promised,
                f"{simulated.mean_square:.4f} ± {simulated.standard_error:.4f}",
                case.exact,
                case.slips,
            )
        )
    return Table(
        columns=(
            "estimator",
            *(rf"$\Delta_2 = {slope:g}$" for slope in slopes),
            "worst constant",
            "worst allowed",
            "$2V$",
            "with the sine",
            "without sampling",
            "slips",
        ),
        rows=rows,
        caption=(
            "Mean square errors (rad²) side by side: under constant uncertainties, the worst that "
            "the constraints allow, and in the loop with its sine, simulated with the "
            "same noise for all (± one standard error) and from the moments. $2V$ is what the "
            "design promises of the error that its cost is for, in a loop whose copies have noise."
        ),
    )


def optima(designs: Mapping[str, RobustSmoother]) -> Table:
    """Return the least bounds of the example, where they are, and what the estimators gain there.

    Parameters
    ----------
    designs : mapping
        From what each design is for to the design with the least bound.
    """
    rows = []
    for name, design in designs.items():
        limit = design.limit or design
        weights = ", ".join(f"{value:.4g}" for value in limit.multipliers)
        poles = ", ".join(f"{pole:.4g}" for pole in limit.poles / 1e6 if pole.imag >= 0.0)
        rows.append(
            (
                name,
                float(limit.bound),
                "no" if design.limit else "yes",
                float(1e6 * limit.tau),
                f"({weights})",
                poles.replace("+0j", ""),
            )
        )
    return Table(
        columns=(
            "cost",
            "infimum of $V$ (rad²)",
            "attained",
            r"$\tau$ (rad² µs)",
            r"$\lambda$",
            "poles (1/µs)",
        ),
        rows=rows,
        caption=(
            "The true optimum: the infimum of the bound over all multipliers, where it is, and the "
            "estimator in the limit; of a pair of complex poles one is shown."
        ),
        digits=6,
    )


def gains(estimators: Mapping[str, Estimator]) -> Table:
    """Return the leading entries of the estimators' matrices, which are those of the phase."""
    return Table(
        columns=(
            "estimator",
            "$A_c[0,0]$ (1/s)",
            "$B_c[0,0]$ (1/s)",
            "$B_c[0,1]$",
            "$C_c[0,0]$",
            "$C_c[1,0]$",
        ),
        rows=[
            (
                name,
                *(float(entry) for entry in (e.A_c[0, 0], *e.B_c[0], *e.C_c[:, 0])),
            )
            for name, e in estimators.items()
        ],
        caption=(
            "The gains of the phase: its own drift, what the measurement and the copy drive it "
            "with, and what $\\hat w$ and the copy's argument take of it."
        ),
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
    rows = []
    for name, (constant, allowed, constant_real, allowed_real) in found.items():
        rows.append(
            (
                name,
                constant.guarantee,
                allowed.mean_square,
                constant.mean_square,
                constant.nominal,
                f"{100 * allowed.mean_square / constant.guarantee:.0f}%",
                allowed_real.mean_square,
                constant_real.mean_square,
                f"{100 * allowed_real.mean_square / constant.guarantee:.0f}%",
            )
        )
    return Table(
        columns=(
            "design",
            "$2V$",
            "worst allowed",
            "worst constant",
            "nominal",
            "share of $2V$",
            "worst allowed, real loop",
            "worst constant, real loop",
            "share of $2V$, real loop",
        ),
        rows=rows,
        caption=(
            "How tight the guarantee is (rad²): twice the bound against the worst error that "
            "the constraints allow, which some input attains, against the worst constant "
            "uncertainty, and against none; in the loop of the theory, whose copies have noise, "
            "and in a real one."
        ),
    )


def lag_choices(system: UncertainSystem, designs: Sequence[str], shares: Sequence[float]) -> Table:
    """Return the lag and order that take each design to each share of the possible gain."""
    rows = []
    for name in designs:
        for share in shares:
            rows.append((name, f"{100 * share:g}%", *_lag_choice(system, name, share)))
    return Table(
        columns=(
            "design",
            "share of the gain",
            "lag (µs)",
            "order",
            "error (rad²)",
            "shortest with an exact delay (µs)",
        ),
        rows=rows,
        caption=(
            "The shortest lag, and the lowest order for it, that take a design to a share of what "
            "smoothing could gain; empty where no order does."
        ),
        digits=3,
    )


def _lag_choice(
    system: UncertainSystem, design: str, share: float
) -> tuple[float | None, str | None, float | None, float | None]:
    try:
        choice = choose_lag(system, fraction=share, design=design)
    except InfeasibleDesignError:
        return None, None, None, None
    return 1e6 * choice.lag, str(choice.order), choice.error, 1e6 * choice.shortest
