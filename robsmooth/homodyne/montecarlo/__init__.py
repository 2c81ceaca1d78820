"""Monte Carlo simulation of the nonlinear loop (Section IV-E).

`noise` draws the noise, `schemes` has the coefficients of a step, `euler` and `splitting` take the
steps, `protocols` says what is simulated, `statistics` what is made of it, and `run` carries it
out.
"""

from robsmooth.homodyne.montecarlo.run import LossOfLockWarning, MonteCarloResult, monte_carlo
from robsmooth.simulation.statistics import MeanSquare

__all__ = ["LossOfLockWarning", "MeanSquare", "MonteCarloResult", "monte_carlo"]
