"""The designs' errors in the nonlinear loop: simulated, and predicted without sampling."""

from collections.abc import Mapping
from dataclasses import replace

from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import homodyne_loop, linearised, statistical_linearisation
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters

CHANGES = ("power of the shot noise", "power of the phase noise", "detector gain")
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
        approximate = statistical_linearisation(values, design)
        outputs = ("filtered", "smoothed") if design.plant.delay > 0.0 else ("filtered",)
        for output in outputs:
            truncation = getattr(moments, f"{output}_truncation")
            found[f"{name}, {output}"] = {
                "paper's protocol": getattr(published[name], output),
                "ergodic": getattr(ergodic[name], output),
                "moments": MeanSquare(getattr(moments, output), truncation),
                "statistical linearisation": MeanSquare(getattr(approximate, output), 0.0),
            }
    return found


def predicted(
    design: Estimator, output: str, change: str, factor: float, values: HomodyneParameters
) -> float:
    """Predict an error of a design in a loop with one number multiplied, one of CHANGES."""
    shot, phase, gain = (factor if change == each else 1.0 for each in CHANGES)
    loop = homodyne_loop(replace(values, kappa=phase * values.kappa), design, shot_noise=shot)
    return getattr(linearised(replace(loop, gains=gain * loop.gains)), output)
