"""Tables of the model and of the designs."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from robsmooth import homodyne
from robsmooth._numerics.riccati import RiccatiError
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import Table
from robsmooth.analysis.covariance import delta_sweep, error_covariance
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother, design_equations, design_smoother
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.systems.augmented import AugmentedSystem


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
    names = ("A_c", "B_c", "C_c", "V at the printed tau, lambda")
    A_c, B_c, C_c, bound = (published.printed(name) for name in names)
    rows.append(("printed", A_c[0, 0], B_c[0, 1], C_c[0, 0], C_c[1, 0], bound))
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
