r"""The class of uncertain nonlinear systems of Section II.

.. math::

    dx &= \Bigl[A x + \sum_{i=1}^g \bar B_{1i}\,\mu_i + \sum_{s=1}^k B_{1s}\,\xi_s\Bigr] dt
          + B_1\,dW, & w &= C_0 x,\\
    dy &= \Bigl[C_2 x + \sum_{i=1}^g \bar D_{21,i}\,\mu_i + \sum_{s=1}^k D_{21,s}\,\xi_s\Bigr] dt
          + D_{21}\,dW, & \zeta_s &= C_{1,s} x,\quad \nu_i = \bar C_{1,i} x,

with :math:`\mu_i = \psi_i(\nu_i)`, each :math:`\psi_i` Lipschitz with constant :math:`\beta_i` and
zero at zero, and each :math:`\xi_s` bounded by :math:`\zeta_s` in the mean-square sense of the
paper's integral quadratic constraint.

A detector may be steered by an estimate, as in homodyne detection by the phase of the local
oscillator. Its nonlinearity then acts on what is left, :math:`\mu_i = \psi_i(\nu_i - r_i)`, with
the *reference* :math:`r_i` an estimate of :math:`\nu_i`. What the detector takes off, the known
:math:`r_i`, has been added to the linear part of the measurement again, as in Section IV-A.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import notation, validation
from robsmooth._support.validation import Matrix
from robsmooth.systems.statespace import Blocks, check_continuous

if TYPE_CHECKING:
    import control

_ROUNDING = 1e-12
REFERENCES = ("filtered", "smoothed")
_CHANNELS = 4  # of more uncertainties or nonlinearities, the first ones and dots are shown


@dataclass(frozen=True, eq=False, init=False)
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

    def __init__(self, B: ArrayLike, C: ArrayLike, D: ArrayLike) -> None:
        _set(self, **_channel("Uncertainty", B, C, D))

    def __repr__(self) -> str:
        return f"Uncertainty({_matrices(self)})"

    def _repr_latex_(self) -> str:
        B, C, D = map(notation.matrix, (self.B, self.C, self.D))
        return rf"$$B_1 = {B},\quad C_1 = {C},\quad D_{{21}} = {D}$$"


@dataclass(frozen=True, eq=False, init=False)
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
        :math:`\psi_i` itself, vectorised over arrays or compiled by numba, for scalars too. The
        design needs only the Lipschitz constant.
    reference : {None, "filtered", "smoothed"}
        The estimate that the detector is steered by: the nonlinearity acts on :math:`\nu_i - r_i`,
        and the copy on :math:`\tilde\nu_i - r_i`, with :math:`r_i` the filtered or the smoothed
        estimate of :math:`\nu_i`. None: there is no reference. The loop is simulated so by
        `simulate`; designs and their guarantees do not use it.

    Raises
    ------
    ValueError, TypeError
        For a matrix that is not 2-D, real and finite, a constant that is not positive, a function
        that is not callable, not vectorised or not zero at zero, or another reference.
    """

    B: Matrix
    C: Matrix
    D: Matrix
    lipschitz: float
    function: Callable[[Any], Any] | None = None
    reference: str | None = None

    def __init__(
        self,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike,
        lipschitz: float,
        function: Callable[[Any], Any] | None = None,
        reference: str | None = None,
    ) -> None:
        matrices = _channel("Nonlinearity", B, C, D)
        lipschitz = validation.positive("Nonlinearity lipschitz", lipschitz)
        if function is not None:
            _check_function("Nonlinearity function", function)
        if reference is not None:
            validation.choice("Nonlinearity reference", reference, REFERENCES)
        _set(self, **matrices, lipschitz=lipschitz, function=function, reference=reference)

    def __repr__(self) -> str:
        function = getattr(self.function, "__name__", type(self.function).__name__)
        given = "" if self.function is None else f", function={function}"
        given += "" if self.reference is None else f", reference={self.reference!r}"
        return f"Nonlinearity({_matrices(self)}, lipschitz={self.lipschitz:.5g}{given})"

    def _repr_latex_(self) -> str:
        B, C, D = map(notation.matrix, (self.B, self.C, self.D))
        return (
            rf"$$\bar B_1 = {B},\quad \bar C_1 = {C},\quad \bar D_{{21}} = {D},\quad "
            rf"\beta = {notation.number(self.lipschitz)}$$"
        )


@dataclass(frozen=True, eq=False, init=False)
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

    def __init__(
        self,
        A: ArrayLike,
        B1: ArrayLike,
        C0: ArrayLike,
        C2: ArrayLike,
        D21: ArrayLike,
        uncertainties: Iterable[Uncertainty] = (),
        nonlinearities: Iterable[Nonlinearity] = (),
    ) -> None:
        A = validation.matrix("A", A, (None, None))
        n = A.shape[0]
        if n == 0 or A.shape[1] != n:
            raise ValueError(f"A must be square and not empty, got shape {A.shape}")
        B1 = validation.matrix("B1", B1, (n, None))
        C0 = validation.matrix("C0", C0, (None, n))
        C2 = validation.matrix("C2", C2, (None, n))
        for name, value in (("C0", C0), ("C2", C2)):
            if value.shape[0] == 0:
                raise ValueError(f"{name} must have at least one row, got shape {value.shape}")
        D21 = validation.matrix("D21", D21, (C2.shape[0], B1.shape[1]))
        _set(self, A=A, B1=B1, C0=C0, C2=C2, D21=D21)

        uncertainties = _members("uncertainties", uncertainties, Uncertainty)
        nonlinearities = _members("nonlinearities", nonlinearities, Nonlinearity)
        _set(self, uncertainties=uncertainties, nonlinearities=nonlinearities)
        for s, channel in enumerate(uncertainties):
            width = channel.B.shape[1]
            _check_channel(f"uncertainties[{s}]", channel, self, inputs=width, outputs=None)
        for i, channel in enumerate(nonlinearities):
            _check_channel(f"nonlinearities[{i}]", channel, self, inputs=1, outputs=1)

    @classmethod
    def from_plant(
        cls,
        plant: "control.StateSpace",
        process_noise: ArrayLike,
        measurement_noise: ArrayLike,
        *,
        outputs: ArrayLike | None = None,
        process_uncertainty: ArrayLike | None = None,
        measurement_uncertainty: ArrayLike | None = None,
        uncertainties: Iterable[Uncertainty] = (),
        nonlinearities: Iterable[Nonlinearity] = (),
    ) -> "UncertainSystem":
        r"""Make the system of a python-control plant and its noises, as ``control.lqe`` has them.

        With plant matrices A, B, C, D, and noises of intensity Q at its inputs and R at its
        outputs,

        .. math::

            dx &= Ax\,dt + BQ^{1/2}(\xi_0\,dt + dW_0), \\
            dy &= Cx\,dt + DQ^{1/2}(\xi_0\,dt + dW_0) + R^{1/2}(\xi_1\,dt + dW_1).

        The two uncertainties are those that Assumption 1 wants: they enter where the noises do.

        Parameters
        ----------
        plant : control.StateSpace
            In continuous time, with the noise as its p inputs and the l measurements as its
            outputs.
        process_noise : float or (p, p) array
            Q, the intensity (two-sided spectral density) of the noise; a float is that of each
            input.
        measurement_noise : float or (l, l) array
            R, likewise.
        outputs : (m, n) array, optional
            :math:`C_0`, what to estimate of the state. Default: C, the measurements without noise.
        process_uncertainty, measurement_uncertainty : (h, n) arrays, optional
            :math:`C_{1,0}` and :math:`C_{1,1}`: :math:`\xi_0` and :math:`\xi_1` are no larger than
            these times x. Default: zero, no uncertainty.
        uncertainties, nonlinearities : sequences
            Further channels.

        Returns
        -------
        UncertainSystem

        Raises
        ------
        ValueError, TypeError
            For a plant in discrete time, a static gain or another kind of object, a noise
            intensity that is not a covariance, and whatever the class itself refuses.
        """
        check_continuous("plant", plant)
        process = _noise_factor("process_noise", process_noise, plant.ninputs)
        measurement = _noise_factor("measurement_noise", measurement_noise, plant.noutputs)
        B, D = plant.B @ process, plant.D @ process
        no_B = np.zeros((plant.nstates, plant.noutputs))
        none = np.zeros((1, plant.nstates))
        channels = (
            Uncertainty(B, none if process_uncertainty is None else process_uncertainty, D),
            Uncertainty(
                no_B,
                none if measurement_uncertainty is None else measurement_uncertainty,
                measurement,
            ),
        )
        return cls(
            A=plant.A,
            B1=np.hstack([B, no_B]),
            C0=plant.C if outputs is None else outputs,
            C2=plant.C,
            D21=np.hstack([D, measurement]),
            uncertainties=(*channels, *_members("uncertainties", uncertainties, Uncertainty)),
            nonlinearities=nonlinearities,
        )

    @classmethod
    def from_statespace(
        cls,
        sys: "control.StateSpace",
        lipschitz: ArrayLike = (),
        functions: Sequence[Callable[[Any], Any] | None] | None = None,
        references: Sequence[str | None] | None = None,
    ) -> "UncertainSystem":
        """Read a system from a python-control object whose signals are named as `to_statespace`'s.

        Parameters
        ----------
        sys : control.StateSpace
            In continuous time. Inputs: unit white noises ``W[0]``, ..., uncertainties ``xi_0[0]``,
            ... of each channel, nonlinearities ``mu[0]``, ... Outputs: ``w``, ``y``, ``zeta_0``,
            ... and ``nu`` likewise, in any order. Only y may have feedthrough.
        lipschitz : (g,) sequence
            The nonlinearities' constants, which a linear system does not hold.
        functions : (g,) sequence of callables or None, optional
            The nonlinearities themselves.
        references : (g,) sequence of str or None, optional
            Their references, as in `Nonlinearity`.

        Returns
        -------
        UncertainSystem

        Raises
        ------
        ValueError, TypeError
            For signals of other names or that do not match, other feedthrough, and whatever the
            class itself refuses. `from_plant` is for a plant that is not so named.
        """
        blocks = Blocks.of("sys", sys)
        k = _check_signals(blocks)
        mu, nu = blocks.into_state("mu"), blocks.from_state("nu")
        constants = validation.array("lipschitz", lipschitz, ndim=1)
        functions = [None] * len(constants) if functions is None else functions
        references = [None] * len(constants) if references is None else references
        validation.instance("functions", functions, Sequence)
        validation.instance("references", references, Sequence)
        for name, given in (
            ("sys's output 'nu'", nu),
            ("lipschitz", constants),
            ("functions", functions),
            ("references", references),
        ):
            if len(given) != mu.shape[1]:
                raise ValueError(
                    f"{name} must have as many entries as sys's input 'mu', {mu.shape[1]}, "
                    f"got {len(given)}"
                )
        return cls(
            A=blocks.A,
            B1=blocks.into_state("W"),
            C0=blocks.from_state("w"),
            C2=blocks.from_state("y"),
            D21=blocks.direct("y", "W"),
            uncertainties=[
                Uncertainty(
                    blocks.into_state(f"xi_{s}"),
                    blocks.from_state(f"zeta_{s}"),
                    blocks.direct("y", f"xi_{s}"),
                )
                for s in range(k)
            ],
            nonlinearities=[
                Nonlinearity(mu[:, [i]], nu[[i]], blocks.direct("y", "mu")[:, [i]], *of_function)
                for i, of_function in enumerate(zip(constants, functions, references, strict=True))
            ],
        )

    def to_statespace(
        self,
        inputs: str | Iterable[str] | None = None,
        outputs: str | Iterable[str] | None = None,
    ) -> "control.StateSpace":
        """Return the linear part as a python-control object, with its channels open.

        Its signals have the components ``W[0]``, ``W[1]``, ...: python-control's ``interconnect``
        joins it with an estimator's object by their names, and ``sys["y[0]", "W[1]"]`` is a part.

        Parameters
        ----------
        inputs : str or sequence of str, optional
            Which to keep, of the white noises ``W`` (of unit intensity), the uncertainties
            ``xi_0``, ``xi_1``, ... and the nonlinearities' values ``mu``. Default: all.
        outputs : str or sequence of str, optional
            Which to keep, of ``w`` (to estimate), ``y`` (the measurement dy/dt), the uncertainties'
            bounds ``zeta_0``, ... and the nonlinearities' arguments ``nu``. Default: all.

        Returns
        -------
        control.StateSpace
        """
        return self.blocks.select(inputs, outputs).to_control()

    @property
    def blocks(self) -> Blocks:
        """The linear part by its named signals, as `to_statespace` lists them."""
        n, l = self.n, self.l  # noqa: E741
        mu = np.hstack([np.zeros((n, 0)), *(c.B for c in self.nonlinearities)])
        nu = np.vstack([np.zeros((0, n)), *(c.C for c in self.nonlinearities)])
        mu_to_y = np.hstack([np.zeros((l, 0)), *(c.D for c in self.nonlinearities)])
        channels = list(enumerate(self.uncertainties))
        return Blocks(
            self.A,
            inputs={"W": self.B1, **{f"xi_{s}": c.B for s, c in channels}, "mu": mu},
            outputs={
                "w": self.C0,
                "y": self.C2,
                **{f"zeta_{s}": c.C for s, c in channels},
                "nu": nu,
            },
            feedthrough={
                ("y", "W"): self.D21,
                **{("y", f"xi_{s}"): c.D for s, c in channels},
                ("y", "mu"): mu_to_y,
            },
        )

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

    def _repr_latex_(self) -> str:
        """Return the equations of the class with this system's numbers."""
        mu = [(c, rf"\mu_{{{i}}}") for i, c in enumerate(self.nonlinearities, 1)]
        xi = [(c, rf"\xi_{{{s}}}") for s, c in enumerate(self.uncertainties, 1)]
        shown = mu[:_CHANNELS] + xi[:_CHANNELS]
        dots = r"\cdots" if max(len(mu), len(xi)) > _CHANNELS else ""

        def equation(left: str, of_state: Matrix, channel: str, noise: Matrix) -> str:
            inputs = [notation.product(getattr(c, channel), symbol) for c, symbol in shown]
            drift = notation.total([notation.product(of_state, "x"), *inputs, dots])
            drift = rf"\left[{drift}\right]dt" if drift != "0" else ""
            return f"{left} &= {notation.total([drift, notation.product(noise, 'dW')])}"

        def of_x(C: Matrix) -> str:
            return notation.product(C, "x") or "0"

        lines = [
            equation("dx", self.A, "B", self.B1) + r"\qquad(t\text{ in s})",
            equation("dy", self.C2, "D", self.D21),
            f"w &= {of_x(self.C0)}",
        ]
        for i, (c, symbol) in enumerate(mu[:_CHANNELS], 1):
            nu, argument, estimate = rf"\nu_{{{i}}}", rf"\nu_{{{i}}}", ""
            if c.reference is not None:
                argument = rf"{nu} - r_{{{i}}}"
                estimate = rf",\quad r_{{{i}}}\text{{ the {c.reference} estimate of }}{nu}"
            lines.append(
                rf"{symbol} &= \psi_{{{i}}}({argument}),\quad {nu} = {of_x(c.C)},\quad "
                rf"\beta_{{{i}}} = {notation.number(c.lipschitz)}{estimate}"
            )
        for s, (c, symbol) in enumerate(xi[:_CHANNELS], 1):
            zeta = rf"\zeta_{{{s}}}"
            lines.append(
                rf"\lVert{symbol}\rVert &\le \lVert{zeta}\rVert,\quad {zeta} = {of_x(c.C)}"
            )
        return "$$\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}$$"


def _set(frozen: object, **values: object) -> None:
    """Set the fields of a frozen dataclass, as only its constructor may."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


def _channel(name: str, B: ArrayLike, C: ArrayLike, D: ArrayLike) -> dict[str, Matrix]:
    """Return the matrices of a channel by their names, each checked."""
    given = {"B": B, "C": C, "D": D}
    return {
        letter: validation.matrix(f"{name} {letter}", value, (None, None))
        for letter, value in given.items()
    }


def _matrices(channel: Uncertainty | Nonlinearity) -> str:
    return ", ".join(f"{name}={notation.array(getattr(channel, name))}" for name in "BCD")


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


def _check_function(name: str, function: Callable) -> None:
    """Check that a nonlinearity can be called as the library does, and is zero at zero."""
    if not callable(function):
        raise TypeError(f"{name} must be callable, got {function!r}")
    # a scalar function that numba has compiled is called from compiled loops
    scalar = hasattr(function, "py_func") and _takes_scalars(function)
    at = 0.0 if scalar else np.zeros(2)
    try:
        values = np.asarray(function(at))
    except Exception as error:
        cause = str(error).partition("\n")[0]
        raise ValueError(
            f"{name} must be vectorised: an array of shape (2,) gave {type(error).__name__}: "
            f"{cause}; NumPy's functions are (np.sin, not math.sin), and numpy.vectorize makes "
            "any function so"
        ) from error
    if values.shape != np.shape(at):
        raise ValueError(
            f"{name} must be vectorised: an argument of shape {np.shape(at)} gave shape "
            f"{values.shape}"
        )
    at_zero = np.ravel(values)[0]
    if not at_zero == 0.0:
        raise ValueError(
            f"{name} must be zero at zero, got {at_zero}: "
            "move the constant into the measurement or the state"
        )


def _takes_scalars(function: Callable) -> bool:
    try:
        function(0.0)
    except Exception:
        return False
    return True


def _noise_factor(name: str, intensity: ArrayLike, size: int) -> Matrix:
    """Return the symmetric square root of a noise's intensity."""
    if np.ndim(intensity) == 0:
        return np.sqrt(validation.real(name, intensity, low=0.0)) * np.eye(size)
    intensity = validation.matrix(name, intensity, (size, size))
    if (np.diag(intensity) < 0.0).any():
        raise ValueError(f"{name} must not be negative on its diagonal")
    deviation = np.sqrt(np.diag(intensity))
    unit = np.where(deviation > 0.0, deviation, 1.0)
    correlation = intensity / np.outer(unit, unit)  # signals may have very different units
    if np.abs(correlation - correlation.T).max(initial=0.0) > _ROUNDING:
        raise ValueError(f"{name} must be symmetric")
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if eigenvalues.min(initial=0.0) < -_ROUNDING:
        raise ValueError(
            f"{name} must be nonnegative definite, got one whose correlation matrix has the "
            f"eigenvalue {eigenvalues.min():.3g}"
        )
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T
    return unit[:, None] * root


def _check_signals(blocks: Blocks) -> int:
    """Check that a system's signals are those of the class; return its number of uncertainties."""
    found = set()
    for kind, signals, known, channel in (
        ("input", blocks.inputs, ("W", "mu"), "xi"),
        ("output", blocks.outputs, ("w", "y", "nu"), "zeta"),
    ):
        for name in signals:
            of_channel = re.fullmatch(rf"{channel}_(\d+)", name)
            if of_channel:
                found.add(int(of_channel[1]))
            elif name not in known:
                raise ValueError(
                    f"sys's {kind} {name!r} must be one of {', '.join(known)}, {channel}_0, "
                    f"{channel}_1, ...; for a plant that is not so named there is from_plant"
                )
    for name in ("w", "y"):
        if name not in blocks.outputs:
            raise ValueError(f"sys must have an output {name!r}, got {', '.join(blocks.outputs)}")
    missing = set(range(len(found))) - found
    if missing:
        raise ValueError(
            f"sys must have its uncertainties numbered from 0, got xi_{max(found)} or "
            f"zeta_{max(found)} without xi_{min(missing)} and zeta_{min(missing)}"
        )
    for (output, name), D in blocks.feedthrough.items():
        if output != "y" and D.any():
            raise ValueError(f"sys must have feedthrough to 'y' only, got {name!r} to {output!r}")
    return len(found)


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
