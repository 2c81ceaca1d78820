"""The base of an estimator in samples: it calls the compiled loop and keeps its memory."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from robsmooth.estimators.copies import Functions
from robsmooth.estimators.sample_loop import Floats, Memory, Reading, Sampled, advance, step

_UNINTERRUPTED, _OF_A_SAMPLE = 10**9, 20_000  # multiplications: between two looks at an interrupt


class Engine:
    """An estimator in samples: `step` is the fast way for most, a subclass's `take` is for all."""

    states: int
    memory: Memory
    _even: Sampled  # matrices of a sample of length dt
    _reading: Reading  # of the smoothed estimate
    _row: tuple[Floats, Floats, Floats]  # room for a sample: measurements, inputs and references

    def __init__(self, functions: Functions, arguments: Floats, shift: Floats) -> None:
        self._functions, self._arguments = functions, np.ascontiguousarray(arguments)
        self._usual = -shift  # references of zero
        self._bound: Any = None

    @property
    def state(self) -> Floats:
        """The state now."""
        return self.memory.states[-1, : self.states]

    def copied(self) -> Memory:
        """Return a copy of the memory."""
        return Memory(*(each.copy() for each in self.memory))

    def step(self, y: Floats, reference: Floats | None) -> Floats | None:
        """Take a usual sample and return its estimate; return None for one that `take` must do."""
        if self._bound is None or self._bound[0] is not self.memory:
            self._bound = self._bind()
        _, take_one, row, known, estimate = self._bound
        row[:] = y
        if self._usual.size:
            known[:] = self._usual if reference is None else reference
        return estimate[0, 0].copy() if take_one() else None

    def _bind(self) -> tuple[Any, ...]:
        """Return the memory, a call of `step` on it, and the arrays that this reads and writes."""
        y, inputs, reference = self._row
        estimate = np.empty((1, 1, len(self._reading.readout)))
        constants = self._functions.addresses, self._arguments, *self._even[:2]
        reading = *self._reading[:3], *self._reading.within
        bound = partial(step, *constants, *self.memory[:9], *reading, *self._row, estimate)
        return self.memory, bound, y if y.size else inputs, reference, estimate

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_bound": None}  # addresses of functions are those of a process

    def _advance(self, sampled: Sampled, kinds: Any, memory: Memory, *of: Any) -> None:
        """Take samples into a memory; where this raises an ArithmeticError, drop the memory."""
        reading, (y, *_), (_, spread, _) = of
        size, back = len(sampled.model[0]), len(memory.states) * bool(reading.lags.any())
        cost = size**2 * (size + back) * (size if len(spread) else 1)
        try:
            given = self._functions.addresses, self._arguments, sampled, kinds, memory, *of
            with self._functions:
                finite = in_parts(partial(advance, *given), len(y), cost)
        except np.linalg.LinAlgError:
            finite = False
        what = "the estimate, or with too few samples for a mode that grows its covariance,"
        self._functions.check(finite, what)


def in_parts(take: Callable[[int, int], bool], rows: int, cost: int) -> bool:
    """Take rows of a cost in multiplications, and look at interrupts; return whether all is finite.

    `take` is called with the first row of a part, and the one after its last.
    """
    most = 1 + _UNINTERRUPTED // (_OF_A_SAMPLE + cost)
    return all(take(first, min(first + most, rows)) for first in range(0, rows, most))
