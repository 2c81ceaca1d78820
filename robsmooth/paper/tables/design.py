"""Tables of the model and of the designs."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from robsmooth import homodyne
from robsmooth._numerics.riccati import RiccatiError
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix
from robsmooth.analysis.covariance import delta_sweep, error_covariance
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother, design_equations, design_smoother
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.paper.predictions import outputs
from robsmooth.paper.tables import cells
from robsmooth.systems.augmented import AugmentedSystem


def sector_ranges(values: HomodyneParameters, variance: float) -> Table:
    """Return how far each reading of the sector holds, and for what share of the time."""
    wide, narrow = values.sector_slope, values.lower_slope
    readings = {
        f"sin e between {wide:.1f} e and e, as gamma = (1 - m)/2 says": values.sector_range(wide),
        f"sin e between {narrow:.1f} e and e, as the design uses": values.sector_range(),
        f"sin e - e Lipschitz with constant {values.gamma:g}": values.lipschitz_range,
    }
    inside = {text: homodyne.fraction_inside(reach, variance) for text, reach in readings.items()}
    records = [
        {
            "what is assumed": text,
            "holds up to (rad)": reach,
            "time inside": f"{inside[text]:.5%}",
            "time outside": f"{1 - inside[text]:.1e}",
        }
        for text, reach in readings.items()
    ]
    return Table.of_records(
        records,
        "How far each assumption on the sine holds, and how long the loop is within it, for a "
        f"Gaussian error of variance {variance:.4f} rad².",
    )


def sign_readings(plant: AugmentedSystem, tau: float, multipliers: Sequence[float]) -> Table:
    """Return the leading gains for each reading of the X equation's quadratic term."""
    equations = design_equations(plant, tau, multipliers)
    Y = equations.solve_Y().X

    def leading(A_c: Matrix, B_c: Matrix, C_c: Matrix, bound: float) -> dict[str, float]:
        return {
            "$A_c[0,0]$": A_c[0, 0],
            "$B_c[0,1]$": B_c[0, 1],
            "$C_c[0,0]$": C_c[0, 0],
            "$C_c[1,0]$": C_c[1, 0],
            "$V$": bound,
        }

    records = []
    for text, sign in {"+, as written": 1.0, "-, flipped": -1.0, "left out": 0.0}.items():
        try:
            *matrices, bound, _ = equations.gains(equations.solve_X(quadratic_sign=sign).X, Y)
            gains = leading(*matrices, bound)
        except RiccatiError:
            gains = {"$A_c[0,0]$": "no real solution"}
        records.append({"sign": text} | gains)
    names = ("A_c", "B_c", "C_c", "V at the printed tau, lambda")
    records.append({"sign": "printed"} | leading(*map(published.printed, names)))
    return Table.of_records(
        records,
        "The gains at the printed tau and lambda for each reading of the X equation.",
        digits=5,
    )


def approach_to_infimum(best: RobustSmoother, vanishing: Iterable[float]) -> Table:
    """Return how bound and gains settle as the multipliers of mu and its copy go to zero."""
    records = []
    for value in vanishing:
        record = {r"$\lambda_3 = \lambda_4$": f"{value:.0e}"}
        records.append(record)
        multipliers = published.boundary_multipliers(value)
        try:
            design = design_smoother(best.plant, best.tau, multipliers, best.cost)
        except InfeasibleDesignError as error:
            record["refused because"] = error.condition
            continue
        record |= {
            "$V$": design.bound,
            "$B_c[0,0]$": float(design.B_c[0, 0]),
            r"$\lVert X\rVert$": float(np.linalg.norm(design.X, 2)),
            "refused because": "",
        }
    return Table.of_records(
        records,
        "Towards the edge: the bound falls and X vanishes as the multipliers of the "
        f"nonlinearity and its copy do. Over all the infimum is {best.bound_infimum:.5f}.",
        digits=6,
    )


def designs(compared: Mapping[str, Estimator]) -> Table:
    """Return the design table: bound, tau, lambda and poles."""
    records = []
    for name, design in compared.items():
        robust = isinstance(design, RobustSmoother)
        records.append(
            {
                "design": name,
                "$V$ (rad²)": design.bound if robust else None,
                r"$\tau$ (rad² s)": f"{design.tau:.4g}" if robust else None,
                r"$\lambda$": cells.numbers(design.multipliers) if robust else None,
                "poles (1/s)": cells.poles(design.poles, digits=3),
            }
        )
    return Table.of_records(
        records,
        "The designs compared. V bounds half the filtered error covariance with the fictitious "
        "noise of the copies; of a pair of complex poles one is shown.",
    )


def covariances(compared: Mapping[str, Estimator]) -> Table:
    """Return nominal and worst error covariances, with the copies' fictitious noise and without."""
    loops = {"paper's formula": "theory", "no copy noise": "real"}
    records = [
        {"error": f"{name}, {output}"}
        | {
            rf"$\Delta_2={slope:g}$, {loop}": float(
                delta_sweep(design, [slope], output, kind)[0, 0, 0]
            )
            for loop, kind in loops.items()
            for slope in (0.0, -1.0)
        }
        for name, design in compared.items()
        for output in outputs(design)
    ]
    return Table.of_records(
        records,
        "Error covariances (rad²) of the designs, with the fictitious noise of the copies, as "
        "in the paper's formula, and without it, as in a real loop.",
    )


def copy_noise(designs: Mapping[float, RobustSmoother]) -> Table:
    """Return bounds against the intensity J_21 that the design assumes for the copies."""

    def filtered(design: RobustSmoother, loop: str) -> float:
        nominal = design.plant.structured_delta()
        return float(error_covariance(design, nominal, "filtered", loop=loop)[0, 0])

    records = [
        {
            "$J_{21}$": f"{intensity:g}",
            "least $V$": design.bound_infimum or design.bound,
            "filtered, with copy noise": filtered(design, "theory"),
            "filtered, without": filtered(design, "real"),
        }
        for intensity, design in designs.items()
    ]
    return Table.of_records(
        records,
        "What the fictitious noise costs: least bound and nominal filtered error covariance "
        "(rad²) against the intensity that the design assumes for it.",
    )
