"""The designs' errors in the nonlinear loop: simulated, and predicted without sampling."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from robsmooth.analysis.statistical_linearisation import statistical_linearisation
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters

# What of the loop is multiplied, and the matrix of the system that has the root of its power.
CHANGES = {"power of the shot noise": "D21", "power of the phase noise": "B1"}
CHANGES |= {"detector gain": None}
Designs = Mapping[str, Estimator]
Results = Mapping[str, MonteCarloResult]
ErrorsByMethod = Mapping[str, Mapping[str, MeanSquare]]  # by the name of an error, and the method


def errors_by_method(
    compared: Designs, published: Results, ergodic: Results, values: HomodyneParameters
) -> ErrorsByMethod:
    """Return the errors by each method, where the standard error of moments is their truncation."""
    found = {}
    for name, design in compared.items():
        moments = stationary_errors(values, design)
        linearised = statistical_linearisation(design, values.equivalent_slope)
        outputs = ("filtered", "smoothed") if design.plant.delay > 0.0 else ("filtered",)
        for output in outputs:
            truncation = getattr(moments, f"{output}_truncation")
            found[f"{name}, {output}"] = {
                "paper's protocol": getattr(published[name], output),
                "ergodic": getattr(ergodic[name], output),
                "moments": MeanSquare(getattr(moments, output), truncation),
                "statistical linearisation": MeanSquare(getattr(linearised, output), 0.0),
            }
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
