"""Monte Carlo simulation of the nonlinear loop (Section IV-E).

The unit of a step is the loop's response time, in which its sines respond to themselves: 2.2 us
with the paper's values. `docs/source/simulation.md` has the bias of the steps.
"""

from robsmooth.homodyne.montecarlo.run import LossOfLockWarning, MonteCarloResult, monte_carlo
from robsmooth.simulation.statistics import MeanSquare

__all__ = ["LossOfLockWarning", "MeanSquare", "MonteCarloResult", "monte_carlo"]
