"""What is certified of any estimator, by the error for which a minimax smoother is certified."""

import numpy as np

import robsmooth as rs


def against_the_model(estimator, output="smoothed"):
    """The estimator with that error: against the delay model's output, or the filtered one."""
    plant = estimator.plant
    estimate = estimator.C_a if output == "smoothed" else estimator.C_f
    C_c = np.vstack([estimate, estimator.C_c[plant.system.m :]])
    parts = {name: getattr(estimator, name) for name in ("A_c", "B_c", "C_a", "C_f")}
    return rs.MinimaxSmoother(
        plant=plant, C_c=C_c, certified=np.nan, multipliers=np.zeros(0), cost=output,
        route="none", **parts,
    )  # fmt: skip


def certified(estimator, output="smoothed"):
    """The least certified error: infinity where there is none."""
    return rs.analysis_bound(against_the_model(estimator, output), loop="real").mean_square
