"""Simulation of any uncertain system in the loop with its estimator, nonlinearities and all.

`monte_carlo` is a faster simulation of the paper's example, Section IV.

**How long a step may be.** The scheme is exact for a linear loop, and of the second order in the
step for a nonlinear one. In units of the loop's response time, in which the nonlinearities'
arguments change or act on each other, the relative bias of a mean square is

=============  ===============================  ==================================
step           where the theory's constraints   where they fail for a seventh of
               hold                             the time
=============  ===============================  ==================================
1/5 (default)  below 0.1%                       -2% to -4%
1/4            below 0.15%                      -7%
1              below 0.5%                       -44%
=============  ===============================  ==================================

The first are scalar loops with a sine or tanh and the pendulum of notebook 06, the others its
mirror. The standard error of a default run is 0.3% to 2%. A step above 1/4 gives a warning.
"""
