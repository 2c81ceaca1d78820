"""Simulation of any uncertain system in the loop with its estimator, nonlinearities and all.

`loop` joins the two into one equation, `integrator` takes the steps, and `simulate` makes errors,
sample paths and a check of the theory's constraints of them, in the classes of `results`.

A detector may be steered by an estimate, its *reference* (`Nonlinearity`). That of the paper's
example is: ``simulate(estimator)`` closes the loop of Section IV for it, of which `monte_carlo` is
a faster simulation.
"""
