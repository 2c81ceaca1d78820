"""How fast the Monte Carlo is: against other ways to write it, and as the work grows.

`problem` is what everybody simulates, `peers` has the other ways, `race` measures them all on one
core, `scales` measures robsmooth alone on all cores, and `report` tells and draws the results.
``python -m benchmarks`` runs it all; `robsmooth bench` does the same.
"""
