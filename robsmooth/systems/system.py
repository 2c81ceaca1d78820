r"""The class of uncertain nonlinear systems of Section II, (eqsystem) to (eqIQC1).

An estimate, the *reference* :math:`r_i`, may be fed back to a detector, as in homodyne detection
the phase of the local oscillator: :math:`\mu_i = \psi_i(\nu_i - r_i)`. The known :math:`r_i` is
added to the linear part of the measurement, as in Section IV-A.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import notation, validation
from robsmooth._support.extras import extra
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.systems.channels import Channel, Nonlinearity, Uncertainty, centred, fitting

if TYPE_CHECKING:  # they take half a second to import, and few functions need them
    import control
    from scipy import signal

_SHOWN = 4  # uncertainties, and nonlinearities; dots stand for the others
_ASYMMETRY = 1e-12  # of a correlation matrix, and how far below zero its eigenvalues may be


@dataclass(frozen=True, eq=False, init=False)
class UncertainSystem(Frozen):
    r"""The uncertain nonlinear system of Section II. The next step is to `augment` it.

    Attributes
    ----------
    A : (n, n) array, drift, 1/s; here and in messages, s is the unit of time that you choose
    B1 : (n, q) array, process noise intensity; `W` are independent standard Wiener processes
    C0 : (m, n) array, the outputs to estimate, w = C0 x
    C2 : (l, n) array
        The measurement, :math:`dy = C_2 x\,dt + \dots`
    D21 : (l, q) array, measurement noise intensity
    uncertainties : sequence of `Uncertainty`
        The k channels :math:`(B_{1s}, C_{1,s}, D_{21,s})`.
    nonlinearities : sequence of `Nonlinearity`
        The g channels :math:`(\bar B_{1i}, \bar C_{1,i}, \bar D_{21,i}, L_i)`, centred.
    B2, D22 : (n, p) and (l, p) arrays, optional
        Of known inputs u: :math:`B_2u` adds to the drift, :math:`D_{22}u` to the measurement.
    n, m, l, q, p, k, g : int
        The numbers of states, outputs to estimate, measurements, noises, known inputs,
        uncertainties and nonlinearities; not arguments.

    Examples
    --------
    A sensor's gain is known to 5%:

    >>> gain = rs.Uncertainty(B=[[0.0]], C=[[0.05]], D=[[1.0]])
    >>> A, B1, C0, C2, D21 = [[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]]
    >>> rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties=[gain]).k
    1
    """

    A: Matrix
    B1: Matrix
    C0: Matrix
    C2: Matrix
    D21: Matrix
    uncertainties: tuple[Uncertainty, ...]
    nonlinearities: tuple[Nonlinearity, ...]
    B2: Matrix
    D22: Matrix
    n: int = field(init=False)
    m: int = field(init=False)
    l: int = field(init=False)  # noqa: E741 - the paper's letter
    q: int = field(init=False)
    p: int = field(init=False)
    k: int = field(init=False)
    g: int = field(init=False)

    def __init__(
        self,
        A: ArrayLike,
        B1: ArrayLike,
        C0: ArrayLike,
        C2: ArrayLike,
        D21: ArrayLike,
        uncertainties: Iterable[Uncertainty] = (),
        nonlinearities: Iterable[Nonlinearity] = (),
        B2: ArrayLike | None = None,
        D22: ArrayLike | None = None,
    ) -> None:
        A = validation.matrix("A", A, (None, None))
        n = A.shape[0]
        if n == 0 or A.shape[1] != n:
            raise ValueError(f"A must be square and not empty, got shape {A.shape}")
        B1 = validation.matrix("B1", B1, (n, None))
        C0 = validation.matrix("C0", C0, (None, n))
        C2 = validation.matrix("C2", C2, (None, n))
        for name, value in (("C0", C0), ("C2", C2)):
            if len(value) == 0:
                raise ValueError(f"{name} must have at least one row, got shape {value.shape}")
        D21 = validation.matrix("D21", D21, (len(C2), B1.shape[1]))
        uncertainties = fitting("uncertainties", uncertainties, Uncertainty, n, len(C2))
        nonlinearities = fitting("nonlinearities", nonlinearities, Nonlinearity, n, len(C2))
        A, C2, nonlinearities = centred(A, C2, nonlinearities)
        if D22 is not None:
            D22 = validation.matrix("D22", D22, (len(C2), None))
        B2 = np.zeros((n, 0 if D22 is None else D22.shape[1])) if B2 is None else B2
        B2 = validation.matrix("B2", B2, (n, None))
        D22 = np.zeros((len(C2), B2.shape[1])) if D22 is None else D22
        D22 = validation.matrix("D22", D22, (len(C2), B2.shape[1]))
        vars(self).update(A=A, B1=B1, C0=C0, C2=C2, D21=D21, B2=B2, D22=D22)
        vars(self).update(uncertainties=uncertainties, nonlinearities=nonlinearities)
        vars(self).update(n=n, m=len(C0), l=len(C2), q=B1.shape[1], p=B2.shape[1])
        vars(self).update(k=len(uncertainties), g=len(nonlinearities))

    @classmethod
    def from_plant(
        cls,
        plant: "control.StateSpace | control.TransferFunction | signal.lti",
        process_noise: ArrayLike,
        measurement_noise: ArrayLike,
        *,
        outputs: ArrayLike | None = None,
        process_uncertainty: ArrayLike | None = None,
        measurement_uncertainty: ArrayLike | None = None,
        gain_uncertainty: ArrayLike | None = None,
    ) -> "UncertainSystem":
        r"""Make the system of another library's plant and its noises, as ``control.lqe`` has them.

        With the plant's matrices and noises of intensity Q at its inputs and R at its outputs,

        .. math::

            dx &= Ax\,dt + BQ^{1/2}(\xi_0\,dt + dW_0), \\
            dy &= (1 + \delta)Cx\,dt + DQ^{1/2}(\xi_0\,dt + dW_0) + R^{1/2}(\xi_1\,dt + dW_1).

        `dataclasses.replace` adds further channels.

        Parameters
        ----------
        plant : control.StateSpace or TransferFunction, scipy.signal.lti
            In continuous time: p inputs are noises, l outputs are measurements.
        process_noise, measurement_noise : float, or (p, p) and (l, l) arrays
            Q and R, intensities (two-sided spectral densities); a float is that of each signal.
        outputs : (m, n) array, optional
            :math:`C_0`, for a state-space plant. Default: C, the measurements without noise.
        process_uncertainty, measurement_uncertainty : (h, n) arrays, optional
            :math:`C_{1,0}` and :math:`C_{1,1}`, for a state-space plant: :math:`\xi_0` and
            :math:`\xi_1` are no larger than these times x. Default: zero, no uncertainty.
        gain_uncertainty : float or (l,) array, optional
            The largest size of :math:`\delta`, for each measurement: 0.2 where gains are known to
            20%. It adds a channel for each. Default: none.

        Raises
        ------
        ValueError, TypeError
            For another kind of plant, an intensity that is no covariance, and as the class.

        Examples
        --------
        >>> import control
        >>> plant = control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
        >>> rs.UncertainSystem.from_plant(plant, process_noise=1.0, measurement_noise=0.01).D21
        array([[0. , 0.1]])

        A transfer function, and a sensor whose gain is known to 20%:

        >>> plant = control.tf([1.0], [1.0, 0.2, 1.0])
        >>> rs.UncertainSystem.from_plant(plant, 1.0, 0.01, gain_uncertainty=0.2).k
        3
        """
        A, B, C, D, own = in_state_space(plant)
        if not (own or outputs is process_uncertainty is measurement_uncertainty is None):
            where = "outputs, process_uncertainty or measurement_uncertainty is given"
            what = f"a {type(plant).__name__} has none, where {where}: control.ss(...)"
            raise TypeError(f"plant must have states, {what}")
        n, l = len(A), len(C)  # noqa: E741 - the paper's letter
        process = covariance_root("process_noise", process_noise, B.shape[1])
        measurement = covariance_root("measurement_noise", measurement_noise, l)
        B, D = B @ process, D @ process
        no_B, none = np.zeros((n, l)), np.zeros((1, n))
        C_0 = none if process_uncertainty is None else process_uncertainty
        C_1 = none if measurement_uncertainty is None else measurement_uncertainty
        channels = [Uncertainty(B, C_0, D), Uncertainty(no_B, C_1, measurement)]
        if gain_uncertainty is not None:
            single = validation.is_single(gain_uncertainty)
            each = [gain_uncertainty] * l if single else gain_uncertainty
            (sizes,) = validation.matrix("gain_uncertainty", [each], (1, l))
            gains = zip(sizes[:, None] * C, np.eye(l), strict=True)
            channels += [Uncertainty(no_B[:, :1], c[None], d[:, None]) for c, d in gains]
        return cls(
            A=A,
            B1=np.hstack([B, no_B]),
            C0=C if outputs is None else outputs,
            C2=C,
            D21=np.hstack([D, measurement]),
            uncertainties=channels,
        )

    def to_statespace(self) -> "control.StateSpace":
        """Return the linear part as a python-control object, with its channels open.

        Inputs: the white noises ``W[0]``, ... of unit intensity, the uncertainties ``xi_0[0]``, ...
        and the nonlinearities' values ``mu[0]``, ... Outputs: ``w[0]``, ... to estimate, the
        measurement dy/dt ``y[0]``, ..., the uncertainties' bounds ``zeta_0[0]``, ... and the
        nonlinearities' arguments ``nu[0]``, ...

        Examples
        --------
        >>> rs.homodyne.PAPER.uncertain_system().to_statespace().input_labels
        ['W[0]', 'W[1]', 'xi_0[0]', 'mu[0]']
        """
        channels = [("W", "w", self.B1, self.C0, self.D21)]
        for s, c in enumerate(self.uncertainties):
            channels.append((f"xi_{s}", f"zeta_{s}", c.B, c.C, c.D))
        channels.append(("mu", "nu", *self.stacked(self.nonlinearities)))
        inputs = {name: B for name, _, B, _, _ in channels}
        outputs = {"w": self.C0, "y": self.C2} | {name: C for _, name, _, C, _ in channels}
        feedthrough = {("y", name): D for name, _, _, _, D in channels}
        return state_space(self.A, inputs, outputs, feedthrough)

    def stacked(self, channels: Sequence[Channel]) -> tuple[Matrix, Matrix, Matrix]:
        """Return B, C and D of some of the system's channels side by side."""
        return (
            np.hstack([np.zeros((self.n, 0)), *(channel.B for channel in channels)]),
            np.vstack([np.zeros((0, self.n)), *(channel.C for channel in channels)]),
            np.hstack([np.zeros((self.l, 0)), *(channel.D for channel in channels)]),
        )

    def __repr__(self) -> str:
        return (
            f"UncertainSystem(n={self.n} states, m={self.m} outputs, l={self.l} measurements, "
            f"q={self.q} noises, k={self.k} uncertainties, g={self.g} nonlinearities)"
        )

    def _repr_latex_(self) -> str:
        """Return the equations (eqsystem) with this system's numbers."""
        mu = [(c, rf"\mu_{{{i}}}") for i, c in enumerate(self.nonlinearities[:_SHOWN], 1)]
        xi = [(c, rf"\xi_{{{s}}}") for s, c in enumerate(self.uncertainties[:_SHOWN], 1)]
        dots = r"\cdots" if max(self.k, self.g) > _SHOWN else ""

        def of_x(C: Matrix) -> str:
            return notation.product(C, "x") or "0"

        def equation(left: str, of_state: Matrix, channel: str, noise: Matrix) -> str:
            inputs = [notation.product(getattr(c, channel), symbol) for c, symbol in mu + xi]
            drift = notation.total([notation.product(of_state, "x"), *inputs, dots])
            drift = rf"\left[{drift}\right]dt" if drift != "0" else ""
            return f"{left} &= {notation.total([drift, notation.product(noise, 'dW')])}"

        lines = [
            equation("dx", self.A, "B", self.B1) + r"\qquad(t\text{ in s})",
            equation("dy", self.C2, "D", self.D21),
            f"w &= {of_x(self.C0)}",
        ]
        for i, (c, symbol) in enumerate(mu, 1):
            nu, argument, estimate = rf"\nu_{{{i}}}", rf"\nu_{{{i}}}", ""
            if c.reference is not None:
                argument = rf"{nu} - r_{{{i}}}"
                estimate = rf",\quad r_{{{i}}}\text{{ the {c.reference} estimate of }}{nu}"
            lines.append(
                rf"{symbol} &= \psi_{{{i}}}({argument}),\quad {nu} = {of_x(c.C)},\quad "
                rf"L_{{{i}}} = {notation.number(c.lipschitz)}{estimate}"
            )
        for c, symbol in xi:
            zeta = symbol.replace("xi", "zeta")
            bound = rf"\lVert{symbol}\rVert &\le \lVert{zeta}\rVert"
            lines.append(rf"{bound},\quad {zeta} = {of_x(c.C)}")
        return "$$\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}$$"


def covariance_root(name: str, intensity: ArrayLike, size: int) -> Matrix:
    """Return the symmetric square root of a covariance, or of a noise's intensity."""
    if validation.is_single(intensity):
        return np.sqrt(validation.real(name, intensity, low=0.0)) * np.eye(size)
    intensity = validation.matrix(name, intensity, (size, size))
    unit = np.sqrt(np.abs(np.diag(intensity)))
    unit[unit == 0.0] = 1.0
    correlation = intensity / np.outer(unit, unit)  # free of the signals' units
    if np.abs(correlation - correlation.T).max(initial=0.0) > _ASYMMETRY:
        raise ValueError(f"{name} must be symmetric")
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if eigenvalues.min(initial=0.0) < -_ASYMMETRY:
        got = f"one whose correlation matrix has the eigenvalue {eigenvalues.min():.3g}"
        raise ValueError(f"{name} must be nonnegative definite, got {got}")
    return unit[:, None] * (vectors * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T)


def state_space(
    A: Matrix,
    inputs: Mapping[str, Matrix],
    outputs: Mapping[str, Matrix],
    feedthrough: Mapping[tuple[str, str], Matrix],
    dt: float = 0.0,
) -> "control.StateSpace":
    """Return a python-control object with signals by name: inputs (n, .) and outputs (., n).

    Component i of a signal is ``name[i]``. The feedthrough is by (output, input), by default zero.
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
        dt,
        inputs=[f"{u}[{i}]" for u, B in inputs.items() for i in range(B.shape[1])],
        outputs=[f"{y}[{i}]" for y, C in outputs.items() for i in range(len(C))],
        remove_useless_states=False,
    )


def in_state_space(plant: Any) -> tuple[Matrix, Matrix, Matrix, Matrix, bool]:
    """Return A, B, C and D of a plant in continuous time, and whether it has states of its own."""
    from scipy import signal

    if isinstance(plant, signal.lti | signal.dlti):
        own, discrete = isinstance(plant, signal.StateSpace), isinstance(plant, signal.dlti)
    else:
        with extra("control", "a python-control system"):
            import control as library
        if not isinstance(plant, library.StateSpace | library.TransferFunction):
            kinds = "a state-space system or transfer function of python-control or scipy.signal"
            raise TypeError(f"plant must be {kinds}, got {type(plant).__name__}")
        own, discrete = isinstance(plant, library.StateSpace), plant.isdtime(strict=True)
    if discrete:
        how = "d2c of MATLAB, or scipy.linalg.logm([[A, B], [0, I]]) / dt = [[., .], [0, 0]]"
        raise ValueError(f"plant must be in continuous time, got steps of dt={plant.dt!r}: {how}")
    if own:
        matrices = plant.A, plant.B, plant.C, plant.D
    elif isinstance(plant, signal.ZerosPolesGain) and np.size(plant.gain) == 1:
        matrices = companion_form(*signal.zpk2tf(plant.zeros, plant.poles, plant.gain))
    elif isinstance(plant, signal.TransferFunction):
        matrices = companion_form(plant.num, plant.den)
    elif not isinstance(plant, signal.lti) and plant.issiso():
        matrices = companion_form(plant.num[0][0], plant.den[0][0])
    else:
        raise TypeError("plant must be control.ss(...) where it has several inputs or outputs")
    if len(matrices[0]) == 0:
        raise ValueError("plant must have a state, got a static gain")
    return *matrices, own


def companion_form(numerator: ArrayLike, denominator: ArrayLike) -> tuple[Matrix, ...]:
    """Return A, B, C and D of proper transfer functions with one denominator, in any units.

    The conversions of the libraries take numerators below 1e-14 for zero.
    """
    b = validation.array("numerator of plant", np.atleast_2d(numerator), 2)
    a = validation.array("denominator of plant", denominator, 1)
    n, missing = len(a) - 1, len(a) - b.shape[1]
    if missing < 0:
        raise ValueError("plant must be proper, got a numerator of higher order")
    b, a = np.pad(b, ((0, 0), (missing, 0))) / a[0], a / a[0]
    A = np.vstack([-a[1:], np.eye(n)[:-1]])
    return A[:n], np.eye(n, 1), b[:, 1:] - b[:, :1] * a[1:], b[:, :1]
