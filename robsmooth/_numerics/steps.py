"""How long the steps of a simulation are, and durations and delays in whole ones."""

import math
import warnings

from robsmooth._support.errors import LongStepWarning

MULTIPLE_TOLERANCE = 1e-6  # how far delay / step may be from a whole number


def warn_of_long_step(
    step: float, response_time: float, longest: float, fine: float, stacklevel: int
) -> None:
    """Warn where a step (s) is more than `longest` response times (s); `fine` is one to suggest."""
    ratio = step / response_time
    if ratio > longest * (1 + MULTIPLE_TOLERANCE):
        message = (
            f"the step, {step:.4g} s, is {ratio:.3g} times the loop's response time, "
            f"{response_time:.4g} s: above {longest:g} times, the results depend on the step; "
            f"{fine:.8g} s is fine"
        )
        warnings.warn(message, LongStepWarning, stacklevel=stacklevel + 1)


def dividing_step(delay: float, longest: float, duration: float) -> float:
    """Return the largest step up to `longest`, and to the duration, that divides the delay."""
    step = min(longest, duration)
    return delay / math.ceil(delay / step - 1e-9) if delay > 0 else step


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
