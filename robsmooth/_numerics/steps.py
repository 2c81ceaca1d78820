"""Durations and delays in whole steps."""

import math

MULTIPLE_TOLERANCE = 1e-6  # how far delay / step may be from a whole number


def dividing_step(delay: float, longest: float, duration: float) -> float:
    """Return the largest step up to `longest`, and to the duration, that divides the delay."""
    step = min(longest, duration)
    if delay > 0:
        step = delay / math.ceil(delay / step - 1e-9)
    return step


def steps_in(duration: float, step: float) -> int:
    """Return the number of steps of a duration, rounded; refuse none at all."""
    steps = round(duration / step)
    if steps < 1:
        raise ValueError(f"duration must be at least one step, {step:g} s, got {duration:g}")
    return steps


def whole_steps(delay: float, step: float) -> int:
    """Return delay / step where it is a whole number; else say which steps would do."""
    ratio = delay / step
    nearest = round(ratio)
    if abs(ratio - nearest) <= MULTIPLE_TOLERANCE and (nearest > 0 or delay == 0):
        return nearest
    fewer = max(1, math.floor(ratio))
    raise ValueError(
        f"step must divide the smoother's delay, {delay:g} s, into whole steps, got {step:g} "
        f"({ratio:.6g} steps): the nearest that do are {delay / fewer:.12g} ({fewer} steps) and "
        f"{delay / (fewer + 1):.12g} ({fewer + 1} steps)"
    )
