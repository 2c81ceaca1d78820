r"""The class of uncertain nonlinear systems of Section II.

.. math::

    dx &= \Bigl[A x + \sum_{i=1}^g \bar B_{1i}\,\mu_i + \sum_{s=1}^k B_{1s}\,\xi_s\Bigr] dt
          + B_1\,dW, & w &= C_0 x,\\
    dy &= \Bigl[C_2 x + \sum_{i=1}^g \bar D_{21,i}\,\mu_i + \sum_{s=1}^k D_{21,s}\,\xi_s\Bigr] dt
          + D_{21}\,dW, & \zeta_s &= C_{1,s} x,\quad \nu_i = \bar C_{1,i} x,

with :math:`\mu_i = \psi_i(\nu_i)`, each :math:`\psi_i` Lipschitz with constant :math:`\beta_i` and
zero at zero, and each :math:`\xi_s` bounded by :math:`\zeta_s` in the mean-square sense of the
paper's integral quadratic constraint.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from robsmooth import validation
from robsmooth.validation import Matrix


@dataclass(frozen=True, eq=False)
class Uncertainty:
    r"""One uncertainty channel: :math:`\xi_s` is no larger than :math:`\zeta_s` in the mean square.

    A noise channel that carries no uncertainty is declared with ``C`` zero: the theory wants every
    noise to enter where an uncertainty enters (Assumption 1).

    Parameters
    ----------
    B : (n, r_s) array
        :math:`B_{1s}`, how the uncertainty input drives the state, per second.
    C : (h_s, n) array
        :math:`C_{1,s}`, the uncertainty output :math:`\zeta_s = C x`.
    D : (l, r_s) array
        :math:`D_{21,s}`, how the uncertainty input enters the measurement rate.

    Raises
    ------
    ValueError, TypeError
        For a matrix that is not 2-D, real and finite.
    """

    B: Matrix
    C: Matrix
    D: Matrix

    def __post_init__(self):
        for name in ("B", "C", "D"):
            value = validation.matrix(f"Uncertainty {name}", getattr(self, name), (None, None))
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class Nonlinearity:
    r"""One scalar nonlinearity :math:`\mu_i = \psi_i(\nu_i)`, of which the estimator runs a copy.

    Parameters
    ----------
    B : (n, 1) array
        :math:`\bar B_{1i}`, how it drives the state.
    C : (1, n) array
        :math:`\bar C_{1,i}`, its argument :math:`\nu_i = C x`.
    D : (l, 1) array
        :math:`\bar D_{21,i}`, how it enters the measurement rate.
    lipschitz : float
        :math:`\beta_i > 0`, with :math:`|\psi_i(a) - \psi_i(b)| \le \beta_i |a - b|`.
    function : callable, optional
        :math:`\psi_i` itself, vectorised over arrays. The design needs only the Lipschitz constant.

    Raises
    ------
    ValueError, TypeError
        For a matrix that is not 2-D, real and finite, a constant that is not positive, or a
        function that is not callable or not zero at zero.
    """

    B: Matrix
    C: Matrix
    D: Matrix
    lipschitz: float
    function: Callable | None = None

    def __post_init__(self):
        for name in ("B", "C", "D"):
            value = validation.matrix(f"Nonlinearity {name}", getattr(self, name), (None, None))
            object.__setattr__(self, name, value)
        lipschitz = validation.positive("Nonlinearity lipschitz", self.lipschitz)
        object.__setattr__(self, "lipschitz", lipschitz)
        if self.function is None:
            return
        if not callable(self.function):
            raise TypeError(f"Nonlinearity function must be callable, got {self.function!r}")
        values = np.asarray(self.function(np.zeros(1)))
        if values.shape != (1,):
            raise ValueError(
                "Nonlinearity function must be vectorised: an array of shape (1,) gave shape "
                f"{values.shape}"
            )
        at_zero = float(values[0])
        if at_zero != 0.0:
            raise ValueError(
                f"Nonlinearity function must be zero at zero, got {at_zero!r}: "
                "move the constant into the measurement or the state"
            )


@dataclass(frozen=True, eq=False)
class UncertainSystem:
    r"""The uncertain nonlinear system of Section II (the module docstring has its equations).

    Parameters
    ----------
    A : (n, n) array
        Drift, 1/s.
    B1 : (n, q) array
        Process noise intensity; the entries of `W` are independent standard Wiener processes.
    C0 : (m, n) array
        The outputs to estimate, :math:`w = C_0 x`.
    C2 : (l, n) array
        The measurement, :math:`dy = C_2 x\,dt + \dots`
    D21 : (l, q) array
        Measurement noise intensity.
    uncertainties : sequence of `Uncertainty`
        The k channels :math:`(B_{1s}, C_{1,s}, D_{21,s})`.
    nonlinearities : sequence of `Nonlinearity`
        The g channels :math:`(\bar B_{1i}, \bar C_{1,i}, \bar D_{21,i}, \beta_i)`.

    Raises
    ------
    ValueError, TypeError
        For any matrix that is not 2-D, real, finite and of the shape above.
    """

    A: Matrix
    B1: Matrix
    C0: Matrix
    C2: Matrix
    D21: Matrix
    uncertainties: tuple[Uncertainty, ...] = ()
    nonlinearities: tuple[Nonlinearity, ...] = ()

    def __post_init__(self):
        A = validation.matrix("A", self.A, (None, None))
        n = A.shape[0]
        if n == 0 or A.shape[1] != n:
            raise ValueError(f"A must be square and not empty, got shape {A.shape}")
        B1 = validation.matrix("B1", self.B1, (n, None))
        C0 = validation.matrix("C0", self.C0, (None, n))
        C2 = validation.matrix("C2", self.C2, (None, n))
        for name, value in (("C0", C0), ("C2", C2)):
            if value.shape[0] == 0:
                raise ValueError(f"{name} must have at least one row, got shape {value.shape}")
        D21 = validation.matrix("D21", self.D21, (C2.shape[0], B1.shape[1]))
        for name, value in (("A", A), ("B1", B1), ("C0", C0), ("C2", C2), ("D21", D21)):
            object.__setattr__(self, name, value)

        uncertainties = _members("uncertainties", self.uncertainties, Uncertainty)
        nonlinearities = _members("nonlinearities", self.nonlinearities, Nonlinearity)
        object.__setattr__(self, "uncertainties", uncertainties)
        object.__setattr__(self, "nonlinearities", nonlinearities)
        for s, channel in enumerate(uncertainties):
            width = channel.B.shape[1]
            _check_channel(f"uncertainties[{s}]", channel, self, inputs=width, outputs=None)
        for i, channel in enumerate(nonlinearities):
            _check_channel(f"nonlinearities[{i}]", channel, self, inputs=1, outputs=1)

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def m(self) -> int:
        """Number of outputs to estimate."""
        return self.C0.shape[0]

    @property
    def l(self) -> int:  # noqa: E743 - the paper's letter
        """Number of measurements."""
        return self.C2.shape[0]

    @property
    def q(self) -> int:
        """Number of noises."""
        return self.B1.shape[1]

    @property
    def k(self) -> int:
        """Number of uncertainties."""
        return len(self.uncertainties)

    @property
    def g(self) -> int:
        """Number of nonlinearities."""
        return len(self.nonlinearities)

    def __repr__(self) -> str:
        return (
            f"UncertainSystem(n={self.n} states, m={self.m} outputs, l={self.l} measurements, "
            f"q={self.q} noises, k={self.k} uncertainties, g={self.g} nonlinearities)"
        )


def _members(name: str, values: Iterable, kind: type) -> tuple:
    if isinstance(values, kind):
        raise TypeError(f"{name} must be a sequence of {kind.__name__}, got a single one")
    try:
        members = tuple(values)
    except TypeError:
        raise TypeError(f"{name} must be a sequence of {kind.__name__}, got {values!r}") from None
    for index, member in enumerate(members):
        validation.instance(f"{name}[{index}]", member, kind)
    return members


def _check_channel(
    name: str,
    channel: Uncertainty | Nonlinearity,
    system: UncertainSystem,
    inputs: int,
    outputs: int | None,
) -> None:
    """Check the channel's shapes against the system's."""
    validation.matrix(f"{name}.B", channel.B, (system.n, inputs))
    validation.matrix(f"{name}.C", channel.C, (outputs, system.n))
    validation.matrix(f"{name}.D", channel.D, (system.l, inputs))
