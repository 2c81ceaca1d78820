"""Monte Carlo simulation of the nonlinear loop (Section IV-E).

`noise` draws the noise, `schemes` has the coefficients of a step, `kernels` takes the steps,
`protocols` says what is collected, and `run` puts them together.
"""

from robsmooth.montecarlo.protocols import MeanSquare
from robsmooth.montecarlo.run import MonteCarloResult, monte_carlo

__all__ = ["MeanSquare", "MonteCarloResult", "monte_carlo"]
