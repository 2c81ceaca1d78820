"""State-space systems with named signals: the way to python-control's objects and back.

A signal is a vector with a name. Its components are called ``name[0]``, ``name[1]``, ... there, so
that python-control connects signals of the same name by itself, and finds a whole signal by its
name and a single component as in ``sys["y[0]", "W[1]"]``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from robsmooth._support.extras import extra
from robsmooth._support.validation import Matrix

if TYPE_CHECKING:  # it takes half a second to import, and only these functions need it
    import control


@dataclass(frozen=True, eq=False)
class Blocks:
    r"""A linear system by its signals: :math:`\dot x = Ax + \sum_i B_i u_i`, outputs alike.

    Attributes
    ----------
    A : (n, n) array
        Drift, 1/s.
    inputs : mapping of str to (n, .) arrays
        How each input signal drives the state.
    outputs : mapping of str to (., n) arrays
        How each output signal reads the state.
    feedthrough : mapping of (str, str) to arrays
        From an input to an output, by (output, input); zero where left out.
    """

    A: Matrix
    inputs: Mapping[str, Matrix]
    outputs: Mapping[str, Matrix]
    feedthrough: Mapping[tuple[str, str], Matrix] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, sys: "control.StateSpace") -> "Blocks":
        """Take a continuous-time system apart by its labels; `name` is what errors call it."""
        check_continuous(name, sys)
        inputs = _signals(f"{name}'s input", sys.input_labels)
        outputs = _signals(f"{name}'s output", sys.output_labels)
        return cls(
            A=sys.A,
            inputs={signal: sys.B[:, at] for signal, at in inputs.items()},
            outputs={signal: sys.C[at] for signal, at in outputs.items()},
            feedthrough={
                (output, signal): sys.D[np.ix_(rows, columns)]
                for output, rows in outputs.items()
                for signal, columns in inputs.items()
            },
        )

    def into_state(self, signal: str) -> Matrix:
        """(n, .) how an input drives the state; without columns where there is no such input."""
        return self.inputs.get(signal, np.zeros((self.A.shape[0], 0)))

    def from_state(self, signal: str) -> Matrix:
        """(., n) how an output reads the state; without rows where there is no such output."""
        return self.outputs.get(signal, np.zeros((0, self.A.shape[0])))

    def direct(self, output: str, signal: str) -> Matrix:
        """How an input feeds through to an output."""
        shape = self.from_state(output).shape[0], self.into_state(signal).shape[1]
        return self.feedthrough.get((output, signal), np.zeros(shape))

    def select(
        self, inputs: str | Iterable[str] | None, outputs: str | Iterable[str] | None
    ) -> "Blocks":
        """Return the system with some of its signals, in the order given; None keeps all."""
        return Blocks(
            self.A,
            _chosen("inputs", inputs, self.inputs),
            _chosen("outputs", outputs, self.outputs),
            self.feedthrough,
        )

    def to_control(self) -> "control.StateSpace":
        """Return the system as a python-control object."""
        with extra("control", "to_statespace"):
            import control

        n = self.A.shape[0]
        B = np.hstack([np.zeros((n, 0)), *self.inputs.values()])
        C = np.vstack([np.zeros((0, n)), *self.outputs.values()])
        D = np.zeros((C.shape[0], B.shape[1]))
        rows, columns = _places(self.outputs, axis=0), _places(self.inputs, axis=1)
        for output, signal in product(rows, columns):
            D[rows[output], columns[signal]] = self.direct(output, signal)
        return control.StateSpace(
            self.A.copy(),
            B,
            C,
            D,
            0,
            inputs=_labels(columns),
            outputs=_labels(rows),
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


def _places(signals: Mapping[str, Matrix], axis: int) -> dict[str, slice]:
    """Return where each signal stands among all components."""
    ends = np.cumsum([0, *(block.shape[axis] for block in signals.values())]).tolist()
    return {name: slice(*ends[i : i + 2]) for i, name in enumerate(signals)}


def _labels(places: Mapping[str, slice]) -> list[str]:
    return [f"{name}[{i}]" for name, at in places.items() for i in range(at.stop - at.start)]


def _signals(name: str, labels: Sequence[str]) -> dict[str, list[int]]:
    """Return where the components of each signal stand, in their order."""
    found: dict[str, dict[int, int]] = {}
    for position, label in enumerate(labels):
        parts = re.fullmatch(r"(.+)\[(\d+)\]", label)
        signal, index = (parts[1], int(parts[2])) if parts else (label, 0)
        positions = found.setdefault(signal, {})
        if index in positions:
            raise ValueError(f"{name} {signal!r} has its component {index} twice")
        positions[index] = position
    for signal, positions in found.items():
        missing = set(range(len(positions))) - set(positions)
        if missing:
            raise ValueError(
                f"{name} {signal!r} has {len(positions)} component(s), "
                f"but none is called '{signal}[{min(missing)}]'"
            )
    return {
        signal: [positions[i] for i in range(len(positions))] for signal, positions in found.items()
    }


def _chosen(
    name: str, wanted: str | Iterable[str] | None, signals: Mapping[str, Matrix]
) -> Mapping[str, Matrix]:
    if wanted is None:
        return signals
    several = isinstance(wanted, Iterable) and not isinstance(wanted, str)
    wanted = list(wanted) if several else [wanted]
    for signal in wanted:
        if not isinstance(signal, str) or signal not in signals:
            raise ValueError(f"{name} must be among {', '.join(signals)}, got {signal!r}")
    return {signal: signals[signal] for signal in wanted}
