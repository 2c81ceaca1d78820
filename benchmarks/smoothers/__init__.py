"""Other packages that smooth a record, each in a module that looks for its package when prepared.

They know systems in discrete time, so all get the same one, of `problem`. A fixed lag is had from
the filter of the system that keeps its former outputs, in a delay line, where a package has no
smoother for it.
"""

from benchmarks.smoothers import (
    dynamax_smoothers,
    filterpy_smoothers,
    statsmodels_smoothers,
    stonesoup_smoothers,
)
from benchmarks.smoothers.problem import Smoother

SMOOTHERS: tuple[Smoother, ...] = (
    *statsmodels_smoothers.SMOOTHERS,
    *dynamax_smoothers.SMOOTHERS,
    *filterpy_smoothers.SMOOTHERS,
    *stonesoup_smoothers.SMOOTHERS,
)
