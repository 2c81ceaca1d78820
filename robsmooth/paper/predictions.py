"""The designs' errors in the nonlinear loop: simulated, and predicted without sampling."""

import math
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from robsmooth._support.errors import UnstableLoopError
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne import montecarlo
from robsmooth.homodyne.loop import homodyne_loop, linearised, statistical_linearisation
from robsmooth.homodyne.moments import LARGEST_DEVIATION, stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters

CHANGES = ("power of the shot noise", "power of the phase noise", "detector gain")
Designs = Mapping[str, Estimator]
Results = Mapping[str, MonteCarloResult]
ErrorsByMethod = Mapping[str, Mapping[str, MeanSquare]]  # by the name of an error, and the method


def outputs(design: Estimator) -> tuple[str, ...]:
    """Return the estimates that a design gives."""
    return ("filtered", "smoothed") if design.plant.delay > 0.0 else ("filtered",)


def errors_by_method(
    compared: Designs, published: Results, ergodic: Results, values: HomodyneParameters
) -> ErrorsByMethod:
    """Return the errors by each method, where the standard error of moments is their truncation."""
    found = {}
    for name, design in compared.items():
        moments = stationary_errors(values, design)
        approximate = statistical_linearisation(values, design)
        for output in outputs(design):
            truncation = getattr(moments, f"{output}_truncation")
            found[f"{name}, {output}"] = {
                "paper's protocol": getattr(published[name], output),
                "ergodic": getattr(ergodic[name], output),
                "moments": MeanSquare(getattr(moments, output), truncation),
                "statistical linearisation": MeanSquare(getattr(approximate, output), 0.0),
            }
    return found


def noise_sweep(
    design: Estimator, values: HomodyneParameters, factors: Iterable[float], **arguments
) -> list[dict[str, Any]]:
    """Simulate a design with ever more phase noise, and predict its filtered error in lock."""
    found = []
    for factor in factors:
        noisier = replace(values, kappa=factor * values.kappa)
        # the slips are what is shown
        with warnings.catch_warnings(action="ignore", category=montecarlo.LossOfLockWarning):
            simulated = montecarlo.monte_carlo(noisier, design, **arguments)
        moments = approximate = math.nan
        with suppress(UnstableLoopError, ArithmeticError):
            moments = stationary_errors(noisier, design).filtered
        with suppress(UnstableLoopError):
            approximate = statistical_linearisation(noisier, design).filtered
        if approximate > LARGEST_DEVIATION**2:  # of a loop whose sine has no mean slope any more
            approximate = math.nan
        errors = {"moments": moments, "statistical linearisation": approximate}
        found.append({"factor": factor, "simulated": simulated} | errors)
    return found


def predicted(
    design: Estimator, output: str, change: str, factor: float, values: HomodyneParameters
) -> float:
    """Predict an error of a design in a loop with one number multiplied, one of CHANGES."""
    shot, phase, gain = (factor if change == each else 1.0 for each in CHANGES)
    loop = homodyne_loop(replace(values, kappa=phase * values.kappa), design, shot_noise=shot)
    return getattr(linearised(replace(loop, gains=gain * loop.gains)), output)
