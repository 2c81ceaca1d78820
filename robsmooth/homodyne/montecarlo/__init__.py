"""Monte Carlo simulation of the nonlinear loop (Section IV-E).

`noise` draws the noise, `schemes` has the coefficients of a step, `layout` where they lie in a
kernel's arrays, `euler` and `splitting` take the steps, `protocols` says what is simulated, `run`
carries it out, and `result` is what it returns.
"""

from robsmooth.homodyne.montecarlo.result import LossOfLockWarning, MonteCarloResult
from robsmooth.homodyne.montecarlo.run import monte_carlo
from robsmooth.simulation.statistics import MeanSquare

__all__ = ["LossOfLockWarning", "MeanSquare", "MonteCarloResult", "monte_carlo"]
