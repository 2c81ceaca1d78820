"""Monte Carlo simulation of the nonlinear loop (Section IV-E).

**How long a step may be.** The unit of a step is the loop's response time, in which its sines
respond to themselves: 2.2 us with the paper's values. With these, the relative bias of the mean
square errors is, against `stationary_errors`,

========================  ========  ==========  ==============
protocol and step         filtered  smoothed    taken
========================  ========  ==========  ==============
"paper", 1/200 (default)  +0.23%    -0.03%      in silence
"paper", 1/40             +1.3%     below 1.3%  in silence
"paper", 1/5              +11%      +250%       with a warning
"ergodic", 1/5 (default)  +0.003%   +0.005%     in silence
"ergodic", 1/4            +0.004%   +0.007%     in silence
"ergodic", 1              +0.08%    +0.2%       with a warning
"ergodic", 10             +16%      less        with a warning
========================  ========  ==========  ==============

The smoothed column has the worst of the Kalman-Bucy filter, the paper's designs and those of
`minimize_bound` with orders 0 to 4. The standard errors of a default run are 0.65% ("paper") and
0.015% ("ergodic"), of which the bias is at most a third. The paper's protocol refuses steps with
which the Euler-Maruyama scheme is unstable: from 2 without a lag, and from 0.26 for a lag of 3.1 us
and a delay model of order 4.

The ergodic protocol has too few slips: with ten times the paper's diffusion their rate is 11% too
low with the default step, 15% with 1/4 and 43% with 1/2.
"""

from robsmooth.homodyne.montecarlo.run import LossOfLockWarning, MonteCarloResult, monte_carlo
from robsmooth.simulation.statistics import MeanSquare

__all__ = ["LossOfLockWarning", "MeanSquare", "MonteCarloResult", "monte_carlo"]
