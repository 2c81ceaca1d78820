"""What takes the samples of a record: the compiled loop over them, and its memory."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robsmooth.estimators.copies import Functions
from robsmooth.estimators.sample_loop import Memory, Reading, Sampled, advance, step

Floats = NDArray[np.float64]


class Engine:
    """An estimator in samples, most of which are alike."""

    states: int
    memory: Memory
    _even: Sampled  # what most samples are like ...
    _reading: Reading  # ... and what is read after them
    _row: tuple[Floats, Floats, Floats]  # room for one: its measurements, inputs and references

    def __init__(self, functions: Functions, arguments: Floats, shift: Floats) -> None:
        self._functions, self._arguments = functions, np.ascontiguousarray(arguments)
        self._usual = -shift  # the references of a sample that has none of its own
        self._bound: Any = None

    @property
    def state(self) -> Floats:
        """The state now."""
        return self.memory.states[-1, : self.states]

    def copied(self) -> Memory:
        """Return a copy of the memory."""
        return Memory(*(each.copy() for each in self.memory))

    def step(self, y: Floats, reference: Floats | None) -> Floats | None:
        """Take a sample as most are; return None where it is not taken, and `take` has to."""
        if self._bound is None or self._bound[0] is not self.memory:
            self._bound = self._bind()
        _, take_one, row, known, estimate = self._bound
        row[:] = y
        if self._usual.size:
            known[:] = self._usual if reference is None else reference
        return estimate[0, 0].copy() if take_one() else None

    def _bind(self) -> tuple[Any, ...]:
        """Return a memory, what takes a sample into it, and room for that and the estimate."""
        y, inputs, reference = self._row
        estimate = np.empty((1, 1, len(self._reading.readout)))
        constants = self._functions.addresses, self._arguments, *self._even[:2]
        reading = *self._reading[:3], *self._reading.within
        bound = partial(step, *constants, *self.memory[:9], *reading, *self._row, estimate)
        return self.memory, bound, y if y.size else inputs, reference, estimate

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_bound": None}  # addresses of functions are those of a process

    def _advance(self, sampled: Sampled, kinds: Any, memory: Memory, *of: Any) -> None:
        """Take samples into a memory; an ArithmeticError says that it is of no use any more."""
        try:
            addresses = self._functions.addresses
            finite = advance(addresses, self._arguments, sampled, kinds, memory, *of)
        except np.linalg.LinAlgError:
            finite = False
        what = "the estimate, or with too few samples for a mode that grows its covariance,"
        self._functions.check(finite, what)
