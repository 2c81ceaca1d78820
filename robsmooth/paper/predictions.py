"""The designs' errors in the nonlinear loop: simulated, and predicted without sampling."""

import math
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from robsmooth._support.errors import UnstableLoopError
from robsmooth.analysis.statistical_linearisation import statistical_linearisation
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne import montecarlo
from robsmooth.homodyne.moments import LARGEST_DEVIATION, stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters

# What of the loop is multiplied, and the matrix of the system that has the root of its power.
CHANGES = {"power of the shot noise": "D21", "power of the phase noise": "B1"}
CHANGES |= {"detector gain": None}
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
        linearised = statistical_linearisation(design, values.equivalent_slope)
        for output in outputs(design):
            truncation = getattr(moments, f"{output}_truncation")
            found[f"{name}, {output}"] = {
                "paper's protocol": getattr(published[name], output),
                "ergodic": getattr(ergodic[name], output),
                "moments": MeanSquare(getattr(moments, output), truncation),
                "statistical linearisation": MeanSquare(getattr(linearised, output), 0.0),
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
        moments = linearised = math.nan
        with suppress(UnstableLoopError, ArithmeticError):
            moments = stationary_errors(noisier, design).filtered
        with suppress(UnstableLoopError):
            linearised = predicted(design, "filtered", "power of the phase noise", factor, values)
        if linearised > LARGEST_DEVIATION**2:  # of a loop whose sine has no mean slope any more
            linearised = math.nan
        errors = {"moments": moments, "statistical linearisation": linearised}
        found.append({"factor": factor, "simulated": simulated} | errors)
    return found


def predicted(
    design: Estimator, output: str, change: str, factor: float, values: HomodyneParameters
) -> float:
    """Predict an error of a design in a loop with one number multiplied, a key of CHANGES."""
    name, slope, plant = CHANGES[change], values.equivalent_slope, design.plant
    if name is None:
        slope = partial(slope, gain=factor)
    else:
        noise = {name: math.sqrt(factor) * getattr(plant.system, name)}
        design = replace(design, plant=replace(plant, system=replace(plant.system, **noise)))
    return getattr(statistical_linearisation(design, slope), output)
