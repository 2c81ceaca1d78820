"""State-space systems with named signals: the way to python-control's objects and back.

A signal is a vector with a name. Its components are called ``name[0]``, ``name[1]``, ... there, so
that python-control connects signals of the same name by itself, and finds a whole signal by its
name and a single component as in ``sys["y[0]", "W[1]"]``.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from robsmooth._support.extras import extra
from robsmooth._support.validation import Matrix

if TYPE_CHECKING:  # it takes half a second to import, and only these functions need it
    import control

Signals = Mapping[str, Matrix]


@dataclass(frozen=True, eq=False)
class Blocks:
    r"""A linear system by its signals: :math:`\dot x = Ax + \sum_i B_i u_i`, outputs alike."""

    A: Matrix  # (n, n), 1/s
    inputs: Signals  # (n, .), how each input signal drives the state
    outputs: Signals  # (., n), how each output signal reads the state
    feedthrough: Mapping[tuple[str, str], Matrix] = field(default_factory=dict)
    # by (output, input); zero where left out

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
        return self.inputs.get(signal, np.zeros((len(self.A), 0)))

    def from_state(self, signal: str) -> Matrix:
        """(., n) how an output reads the state; without rows where there is no such output."""
        return self.outputs.get(signal, np.zeros((0, len(self.A))))

    def direct(self, output: str, signal: str) -> Matrix:
        """How an input feeds through to an output."""
        shape = self.from_state(output).shape[0], self.into_state(signal).shape[1]
        return self.feedthrough.get((output, signal), np.zeros(shape))

    def select(
        self, inputs: str | Iterable[str] | None, outputs: str | Iterable[str] | None
    ) -> "Blocks":
        """Return the system with some of its signals, in the order given; None keeps all."""
        chosen = _chosen("inputs", inputs, self.inputs)
        return replace(self, inputs=chosen, outputs=_chosen("outputs", outputs, self.outputs))

    def to_control(self) -> "control.StateSpace":
        """Return the system as a python-control object."""
        with extra("control", "to_statespace"):
            import control

        n = len(self.A)
        B = np.hstack([np.zeros((n, 0)), *self.inputs.values()])
        C = np.vstack([np.zeros((0, n)), *self.outputs.values()])
        rows = [
            np.hstack([np.zeros((len(read), 0)), *(self.direct(name, u) for u in self.inputs)])
            for name, read in self.outputs.items()
        ]
        return control.StateSpace(
            self.A.copy(),
            B,
            C,
            np.vstack([np.zeros((0, B.shape[1])), *rows]),
            0,
            inputs=[f"{u}[{i}]" for u, drive in self.inputs.items() for i in range(drive.shape[1])],
            outputs=[f"{y}[{i}]" for y, read in self.outputs.items() for i in range(len(read))],
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


def _signals(name: str, labels: Sequence[str]) -> dict[str, list[int]]:
    """Return where the components of each signal stand, in their order."""
    found: dict[str, list[tuple[int, int]]] = {}
    for position, label in enumerate(labels):
        signal, index = re.fullmatch(r"(?s)(.*?)(?:\[(\d+)\])?", label).groups("0")
        found.setdefault(signal, []).append((int(index), position))
    for signal, components in found.items():
        components.sort()
        indices = [index for index, _ in components]
        if indices != list(range(len(indices))):
            raise ValueError(
                f"{name} {signal!r} must have its components numbered '{signal}[0]', "
                f"'{signal}[1]', ..., each once, got the numbers {indices}"
            )
    return {signal: [at for _, at in components] for signal, components in found.items()}


def _chosen(name: str, wanted: str | Iterable[str] | None, signals: Signals) -> Signals:
    if wanted is None:
        return signals
    several = isinstance(wanted, Iterable) and not isinstance(wanted, str)
    wanted = list(wanted) if several else [wanted]
    for signal in wanted:
        if not isinstance(signal, str) or signal not in signals:
            raise ValueError(f"{name} must be among {', '.join(signals)}, got {signal!r}")
    return {signal: signals[signal] for signal in wanted}
