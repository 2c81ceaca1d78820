"""Simulation of any uncertain system with its nonlinearities in the loop with its estimator.

`docs/source/simulation.md` has the scheme, and the bias of its steps. `monte_carlo` is faster, for
the paper's example, Section IV.
"""
