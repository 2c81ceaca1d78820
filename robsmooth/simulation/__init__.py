"""Simulation of any uncertain system with its nonlinearities in the loop with its estimator.

`monte_carlo` is faster, for the paper's example, Section IV.

**How long a step may be.** The scheme is exact for a linear loop, and of second order for a
nonlinear one. The unit of a step is the loop's response time, in which the nonlinearities'
arguments change or act on each other. The relative bias of a mean square is

=============  ===============================  ==================================
step           constraints hold                 constraints fail 1/7 of the time
=============  ===============================  ==================================
1/5 (default)  below 0.1%                       -2% to -4%
1/4            below 0.15%                      -7%
1              below 0.5%                       -44%
=============  ===============================  ==================================

The first column has scalar loops with a sine or tanh and the pendulum of notebook 06, the second
its mirror. The standard error of a default run is 0.3% to 2%. A step above 1/4 gives a warning.
"""
