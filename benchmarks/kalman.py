"""How many samples a second Kalman smoothers take: robsmooth's beside those of other packages.

All smooth the example with its exact delay, from a stationary start, and are compared with
robsmooth's estimates. Run as
``python -m benchmarks.alone kalman``.
"""

from collections.abc import Callable

from benchmarks.throughput import DT, FULL, QUICK, Effort, raced

AGREEMENT = 1e-6  # of the largest estimate: dynamax regularises, by 1e-9 of a unit


def ours(system, delay: float) -> dict[str, Callable]:
    """Return robsmooth's own smoother, at a fixed lag and with the whole record."""
    from benchmarks.smoothers.problem import FIXED_LAG, WHOLE
    from robsmooth.estimators import baselines

    exact = baselines.fixed_lag_smoother(system, delay, 2).discretize(DT)

    def fixed_lag(y):
        exact.reset()
        return exact.run(y)

    def whole_record(y):
        exact.reset()
        return exact.two_sided(y)[0]

    return {FIXED_LAG: fixed_lag, WHOLE: whole_record}


def kalman(effort: Effort, smoothers) -> dict:
    """Measure both kinds of smoothing, each among its own."""
    from benchmarks.problem import Unavailable
    from benchmarks.smoothers.problem import sampled
    from robsmooth import homodyne
    from robsmooth.paper.published import DELAY

    system = homodyne.PAPER.uncertain_system()
    model = sampled(system, DT, round(DELAY / DT))
    found, skipped = {}, {}
    for uses, own in ours(system, DELAY).items():
        name = f"robsmooth, {uses}"
        runs, differs = {name: own}, {}
        for smoother in smoothers:
            if smoother.uses == uses:
                try:
                    runs[smoother.name] = smoother.prepare(model)
                    differs[smoother.name] = smoother.differs
                except Unavailable as reason:
                    skipped[smoother.name] = str(reason)
        measured = raced(runs, name, effort, AGREEMENT)
        for each, row in measured.items():
            row["differs"] = differs.get(each, "")
            row["agrees"] |= bool(row["differs"])  # it is said why it does not
        found[uses] = measured
    return {"rounds": effort.rounds, "uses": found, "skipped": skipped}


def measure(quick: bool, peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all, of the packages so named."""
    from benchmarks.smoothers import SMOOTHERS

    parts = peers.split(",")
    chosen = [each for each in SMOOTHERS if any(part in each.name for part in parts)]
    return kalman(QUICK if quick else FULL, chosen)
