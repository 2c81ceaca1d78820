"""Linear systems to python-control, and from python-control and scipy.signal."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support.extras import extra
from robsmooth._support.validation import Matrix

if TYPE_CHECKING:
    import control


def state_space(
    A: Matrix,
    inputs: Mapping[str, Matrix],
    outputs: Mapping[str, Matrix],
    feedthrough: Mapping[tuple[str, str], Matrix],
) -> "control.StateSpace":
    """Return a python-control object with signals by name: inputs (n, .) and outputs (., n).

    Component i of a signal is called ``name[i]`` there: python-control connects by name. The
    feedthrough is by (output, input), zero if left out.
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


def state_space_matrices(plant: Any) -> tuple[Matrix, Matrix, Matrix, Matrix, bool]:
    """Return A, B, C and D of a plant in continuous time, and whether its states are given.

    The libraries' own conversions take numerators below 1e-14, in whatever units, for zero.
    """
    from scipy import signal

    if isinstance(plant, signal.lti | signal.dlti):
        own, discrete = isinstance(plant, signal.StateSpace), isinstance(plant, signal.dlti)
    else:
        with extra("control", "a python-control system"):
            import control
        if not isinstance(plant, control.StateSpace | control.TransferFunction):
            kinds = "a state-space system or transfer function of python-control or scipy.signal"
            raise TypeError(f"plant must be {kinds}, got {type(plant).__name__}")
        own, discrete = isinstance(plant, control.StateSpace), plant.isdtime(strict=True)
    if discrete:
        raise ValueError(
            f"plant must be in continuous time, got one in steps of dt={plant.dt!r}; d2c of MATLAB "
            "or Octave converts it, and for inputs that are held over a step so does "
            "scipy.linalg.logm([[A, B], [0, I]]) / dt, which is [[A, B], [0, 0]] of the new one"
        )
    if own:
        A, B, C, D = plant.A, plant.B, plant.C, plant.D
    elif isinstance(plant, signal.ZerosPolesGain):
        A, B, C, D = companion_form(*signal.zpk2tf(plant.zeros, plant.poles, plant.gain))
    elif isinstance(plant, signal.lti):
        A, B, C, D = companion_form(plant.num, plant.den)
    elif plant.issiso():
        A, B, C, D = companion_form(plant.num[0][0], plant.den[0][0])
    else:
        raise TypeError("plant must be a state-space system where it has several inputs or outputs")
    if len(A) == 0:
        raise ValueError("plant must have a state, got a static gain")
    return A, B, C, D, own


def companion_form(numerator: ArrayLike, denominator: ArrayLike) -> tuple[Matrix, ...]:
    """Return A, B, C and D of transfer functions with one denominator, by their coefficients."""
    b, a = np.atleast_2d(numerator), np.asarray(denominator, dtype=float)
    n, missing = len(a) - 1, len(a) - b.shape[1]
    if missing < 0:
        raise ValueError("plant must be proper, got a numerator of higher order than the other")
    b, a = np.pad(b, ((0, 0), (missing, 0))) / a[0], a / a[0]
    A = np.vstack([-a[1:], np.eye(n - 1, n)]) if n else np.zeros((0, 0))
    return A, np.eye(n, 1), b[:, 1:] - b[:, :1] * a[1:], b[:, :1]
