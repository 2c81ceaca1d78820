"""State-space systems with named signals: the way to python-control's objects.

A signal is a vector with a name. Its components are called ``name[0]``, ``name[1]``, ... there:
python-control connects them by name, and finds parts as in ``sys["y[0]", "W[1]"]``.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from robsmooth._support.extras import extra
from robsmooth._support.validation import Matrix

if TYPE_CHECKING:  # it takes half a second to import, and only these functions need it
    import control

Signals = Mapping[str, Matrix]
Feedthrough = Mapping[tuple[str, str], Matrix]


def state_space(
    A: Matrix, inputs: Signals, outputs: Signals, feedthrough: Feedthrough
) -> "control.StateSpace":
    """Return a python-control object: inputs (n, .) and outputs (., n) are by name.

    Feedthrough is by (output, input), zero if left out.
    """
    with extra("control", "to_statespace"):
        import control

    D = [
        [feedthrough.get((y, u), np.zeros((len(C), B.shape[1]))) for u, B in inputs.items()]
        for y, C in outputs.items()
    ]
    return control.StateSpace(
        A.copy(),
        np.hstack(list(inputs.values())),
        np.vstack(list(outputs.values())),
        np.block(D),
        0,
        inputs=[f"{u}[{i}]" for u, B in inputs.items() for i in range(B.shape[1])],
        outputs=[f"{y}[{i}]" for y, C in outputs.items() for i in range(len(C))],
        remove_useless_states=False,
    )


def check_continuous(name: str, sys: "control.StateSpace") -> None:
    """Check that `sys` is a state-space system in continuous time, with a state."""
    with extra("control", "a python-control system"):
        import control

    if not isinstance(sys, control.StateSpace):
        hint = "; control.ss(...) makes it one" if isinstance(sys, control.TransferFunction) else ""
        raise TypeError(f"{name} must be a control.StateSpace, got {type(sys).__name__}{hint}")
    if sys.isdtime(strict=True):
        raise ValueError(f"{name} must be in continuous time, got one in steps of dt={sys.dt!r}")
    if sys.nstates == 0:
        raise ValueError(f"{name} must have a state, got a static gain")
