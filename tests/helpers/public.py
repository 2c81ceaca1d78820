"""The public classes and functions: what the package, `baselines` and `homodyne` hand out."""

import inspect

import robsmooth
from robsmooth import baselines, homodyne

PUBLIC = {
    name: member
    for module in (robsmooth, baselines, homodyne)
    for name, member in inspect.getmembers(module)
    if (inspect.isclass(member) or inspect.isfunction(member))
    and not name.startswith("_")
    and member.__module__.startswith("robsmooth" if module is robsmooth else module.__name__)
} | {"tuned_fixed_lag_smoother": baselines.tuned_fixed_lag_smoother}  # made in a module of its own
