"""The channels of an uncertain system: where uncertainties and nonlinearities act on it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import notation, validation
from robsmooth._support.validation import Frozen, Matrix, frozen, shown
from robsmooth.systems.functions import Combination, Function, check_function, compiled, name_of

REFERENCES = ("filtered", "smoothed")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Channel(Frozen):
    """The matrices of an uncertainty or a nonlinearity."""

    B: Matrix
    C: Matrix
    D: Matrix

    def __init__(self, B: ArrayLike, C: ArrayLike, D: ArrayLike) -> None:
        kind = type(self).__name__
        for letter, value in (("B", B), ("C", C), ("D", D)):
            vars(self)[letter] = validation.matrix(f"{kind} {letter}", value, (None, None))

    def __repr__(self) -> str:
        matrices = (f"{name}={notation.array(getattr(self, name))}" for name in "BCD")
        return f"{type(self).__name__}({', '.join(matrices)})"


class Uncertainty(Channel):
    r"""One uncertainty channel: :math:`\xi_s` is no larger than :math:`\zeta_s` in the mean square.

    Every noise must enter where an uncertainty does (Assumption 1): where there is none, C is zero.

    Parameters
    ----------
    B : (n, r_s) array
        :math:`B_{1s}`, how the uncertainty input drives the state, per second.
    C : (h_s, n) array
        :math:`C_{1,s}`, the uncertainty output :math:`\zeta_s = C x`.
    D : (l, r_s) array
        :math:`D_{21,s}`, how the uncertainty input enters the measurement rate.

    Examples
    --------
    A rate of decay that is known to 10%, in a system of one state:

    >>> rs.Uncertainty(B=[[1.0]], C=[[0.1]], D=[[0.0]])
    Uncertainty(B=[[1]], C=[[0.1]], D=[[0]])
    """


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Nonlinearity(Channel):
    r"""One scalar nonlinearity :math:`\mu_i = \psi_i(\nu_i)`; the estimator runs a copy of it.

    Parameters
    ----------
    B : (n, 1) array
        :math:`\bar B_{1i}`, how it drives the state.
    C : (1, n) array
        :math:`\bar C_{1,i}`, its argument :math:`\nu_i = C x`.
    D : (l, 1) array
        :math:`\bar D_{21,i}`, how it enters the measurement rate.
    lipschitz : float, optional
        :math:`L_i > 0`, with :math:`|\psi_i(a) - \psi_i(b)| \le L_i |a - b|`. Either this
        or `sector` is given; a sector sets it to the larger size of its ends.
    function : callable, optional
        :math:`\psi_i`, zero at zero, vectorised or compiled by numba. A design needs none.
    reference : {None, "filtered", "smoothed"}
        The estimate :math:`r_i` of :math:`\nu_i` fed back to the detector: the nonlinearity acts on
        :math:`\nu_i - r_i`, the copy on :math:`\tilde\nu_i - r_i`. Designs do not use it.
    sector : (float, float), optional
        The least and the largest slope :math:`(\psi_i(a) - \psi_i(b))/(a - b)`. `UncertainSystem`
        moves their mean to A and C2, and keeps the rest of the function. With a reference and a B
        that is not zero the mean must be zero. `robsmooth.sector` finds them.

    Examples
    --------
    A sensor that saturates, :math:`dy = \tanh(x)\,dt + \dots`:

    >>> rs.Nonlinearity(B=[[0.0]], C=[[1.0]], D=[[1.0]], lipschitz=1.0, function=np.tanh)
    Nonlinearity(B=[[0]], C=[[1]], D=[[1]], lipschitz=1, function=tanh)
    """

    lipschitz: float
    function: Function | None = None
    reference: str | None = None
    sector: tuple[float, float] | None = None

    def __init__(
        self,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike,
        lipschitz: float | None = None,
        function: Function | None = None,
        reference: str | None = None,
        *,
        sector: tuple[float, float] | None = None,
    ) -> None:
        super().__init__(B, C, D)
        if sector is not None:
            slopes = validation.array("Nonlinearity sector", sector, ndim=1).tolist()
            if len(slopes) != 2 or not slopes[0] < slopes[1]:
                rule = "two slopes, the least and the largest"
                raise ValueError(f"Nonlinearity sector must be {rule}, got {shown(sector)}")
            sector = tuple(slopes)
            if lipschitz is not None and not np.array_equal(lipschitz, max(map(abs, sector))):
                raise TypeError("Nonlinearity must have a lipschitz or a sector, got both")
            lipschitz = max(map(abs, sector))
        lipschitz = validation.positive("Nonlinearity lipschitz", lipschitz)
        if function is not None:
            check_function("Nonlinearity function", function)
        if reference is not None:
            validation.choice("Nonlinearity reference", reference, REFERENCES)
            if sector is not None and sum(sector) != 0.0 and self.B.any():
                raise ValueError(
                    f"Nonlinearity sector must be around zero, got {sector}, where B is not zero "
                    "and there is a reference, which would drive the state: give lipschitz instead"
                )
        own = {"lipschitz": lipschitz, "function": function}
        vars(self).update(own, reference=reference, sector=sector)

    def __repr__(self) -> str:
        slopes = f"lipschitz={self.lipschitz:.5g}"
        slopes += "" if self.sector is None else ", sector=({:.5g}, {:.5g})".format(*self.sector)
        function = getattr(self.function, "__name__", name_of(self.function))
        given = "" if self.function is None else f", function={function}"
        given += "" if self.reference is None else f", reference={self.reference!r}"
        return f"{super().__repr__()[:-1]}, {slopes}{given})"


def centred(
    A: Matrix, C2: Matrix, channels: Iterable[Nonlinearity]
) -> tuple[Matrix, Matrix, tuple[Nonlinearity, ...]]:
    """Move the mean slope of each sector into drift and measurement; return all three."""
    kept = []
    for channel in channels:
        if channel.sector is not None:
            lower, upper = channel.sector
            slope, function = (lower + upper) / 2, channel.function
            if slope:
                A, C2 = map(frozen, with_feedback(A, C2, channel, slope * channel.C))
                if function is not None:
                    function = compiled(Combination(function, slope=slope))
            half = (upper - lower) / 2
            channel = replace(channel, lipschitz=half, function=function, sector=None)
        kept.append(channel)
    return A, C2, tuple(kept)


def with_feedback(A: Matrix, C2: Matrix, channel: Channel, rows: Matrix) -> tuple[Matrix, Matrix]:
    """Return drift and measurement where the input of a channel is `rows` times the state."""
    return A + channel.B @ rows, C2 + channel.D @ rows


def fitting(
    name: str, values: Iterable, kind: type[Channel], states: int, measurements: int
) -> tuple[Channel, ...]:
    """Return channels of one kind, their shapes checked against the system's."""
    channels = tuple(validation.sequence(name, values, of=kind.__name__))
    for index, channel in enumerate(channels):
        validation.instance(f"{name}[{index}]", channel, kind)
        inputs, outputs = (1, 1) if kind is Nonlinearity else (channel.B.shape[1], None)
        shapes = {"B": (states, inputs), "C": (outputs, states), "D": (measurements, inputs)}
        for letter, shape in shapes.items():
            validation.matrix(f"{name}[{index}].{letter}", getattr(channel, letter), shape)
    return channels
