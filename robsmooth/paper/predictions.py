"""The designs' errors in the nonlinear loop: simulated, and predicted without sampling."""

from collections.abc import Mapping

from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import statistical_linearisation
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters

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
