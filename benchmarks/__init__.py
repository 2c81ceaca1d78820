"""How fast the Monte Carlo and the smoothing of records are: against others, and as work grows.

`problem` is what everybody simulates, `peers` has the other ways, `race` measures them all on one
core, `scales` measures robsmooth alone on all cores, `throughput` runs a smoother over records, and
`report` tells and draws the results.
``python -m benchmarks`` runs it all; `robsmooth bench` does the same.
"""
