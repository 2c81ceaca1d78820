"""How fast it is: against others, against what is aimed at, and as work grows.

`race` has the Monte Carlo's `peers`, all on the same `problem`; `throughput` runs an estimator over
records, `kalman` does beside other packages' `smoothers`, `latency` takes one sample at a time, and
`from_files` reads and writes files. `riccati` designs filters, `growth` fits exponents. All these
have one core, by `alone`. `scales`, `targets`, `guarantees` and `processes` have all cores.
`aims` judges, `history` compares with former runs, `tables` and `report` tell and draw.
``python -m benchmarks`` runs it all; `robsmooth bench` does the same.
"""
