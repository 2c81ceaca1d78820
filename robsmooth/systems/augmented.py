r"""The augmented and compact system of Section III.

The delay model joins the system, :math:`x_p = [x; x_a]`, and all channels are stacked as in
(eqCsystem), in the order: k uncertainties, g nonlinearities, g copies in the estimator.

.. math::

    dx_p &= [A_p x_p + \tilde B_1 \tilde\xi]\,dt + B_{p1}\,dW, & w &= C_{p0} x_p,\quad
        w_a = C_a x_p,\\
    d\tilde y &= [\tilde C_2 x_p + \tilde D_{21}\tilde\xi]\,dt + \bar D_{21}\,dW, &
        \tilde\zeta &= \tilde C_1 x_p + \tilde D_{12}\tilde u,

with :math:`\tilde y = [y; \tilde\mu]` and :math:`\tilde u = [\hat w; \tilde\nu]`. The noise `W` has
the system's q components, then g fictitious ones that the theory adds to the copies through
:math:`J_{21}`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from robsmooth._support import notation, validation
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import table_of_values
from robsmooth._support.validation import Matrix, frozen
from robsmooth.systems.delay import DelayModel, pade_delay
from robsmooth.systems.statespace import Blocks
from robsmooth.systems.system import UncertainSystem

if TYPE_CHECKING:
    import control

_J_RESIDUAL = 1e-9  # largest misfit of Assumption 1, relative to each row's size


def _matrix(build: Callable[["AugmentedSystem"], Matrix]) -> "cached_property[Matrix]":
    """Make a method a property that is computed once and read-only."""
    return cached_property(wraps(build)(lambda self: frozen(build(self))))


@dataclass(frozen=True, eq=False)
class AugmentedSystem:
    """The system with its delay model, in the paper's compact form.

    Made by `augment`. All matrices are derived from the three things that define it.

    Attributes
    ----------
    system : UncertainSystem
    delay_model : DelayModel
    J_21 : (g, g) array
        Intensity of the fictitious noise of the copies.
    """

    system: UncertainSystem
    delay_model: DelayModel
    J_21: Matrix

    @property
    def delay(self) -> float:
        """The lag, in seconds."""
        return self.delay_model.delay

    @property
    def order(self) -> int:
        """The order of the delay model."""
        return self.delay_model.order

    @property
    def n(self) -> int:
        """Number of states, those of the delay model included."""
        return self.system.n + self.delay_model.F.shape[0]

    @property
    def input_sizes(self) -> tuple[int, ...]:
        """Widths of the channels in xi-tilde: r_1 ... r_k, then 2 g ones."""
        return (*(u.B.shape[1] for u in self.system.uncertainties), *(1,) * (2 * self.system.g))

    @property
    def output_sizes(self) -> tuple[int, ...]:
        """Heights of the channels in zeta-tilde: h_1 ... h_k, then 2 g ones."""
        return (*(u.C.shape[0] for u in self.system.uncertainties), *(1,) * (2 * self.system.g))

    @_matrix
    def A_p(self) -> Matrix:
        """(n, n) drift of the augmented state, 1/s."""
        model, system = self.delay_model, self.system
        upper = np.zeros((system.n, model.F.shape[0]))
        return np.block([[system.A, upper], [model.G @ system.C0, model.F]])

    @_matrix
    def B_p1(self) -> Matrix:
        """(n, q + g) noise intensity, with zero columns for the noise of the copies."""
        return self._state_rows(np.hstack([self.system.B1, self._no_columns(self.system.g)]))

    @_matrix
    def C_p0(self) -> Matrix:
        """(m, n) the undelayed output w."""
        return self._state_columns(self.system.C0)

    @_matrix
    def C_a(self) -> Matrix:
        """(m, n) the delayed output w_a = [J_a C_0, H_a] x_p."""
        return np.hstack([self.delay_model.J @ self.system.C0, self.delay_model.H])

    @_matrix
    def B1_tilde(self) -> Matrix:
        """(n, r + 2g) channel inputs into the state."""
        system = self.system
        blocks = [c.B for c in (*system.uncertainties, *system.nonlinearities)]
        return self._state_rows(np.hstack([*blocks, self._no_columns(system.g)]))

    @_matrix
    def C1_tilde(self) -> Matrix:
        """(h + 2g, n) channel outputs from the state."""
        system = self.system
        blocks = [c.C for c in (*system.uncertainties, *system.nonlinearities)]
        return self._state_columns(np.vstack([*blocks, np.zeros((system.g, system.n))]))

    @_matrix
    def D12_tilde(self) -> Matrix:
        """(h + 2g, m + g) channel outputs from the estimator: the copies' arguments."""
        g, m = self.system.g, self.system.m
        rows = sum(self.output_sizes)
        result = np.zeros((rows, m + g))
        result[rows - g :, m:] = np.eye(g)
        return result

    @_matrix
    def C2_tilde(self) -> Matrix:
        """(l + g, n) the measurement, then zero rows: the copies' outputs carry no state."""
        return self._state_columns(
            np.vstack([self.system.C2, np.zeros((self.system.g, self.system.n))])
        )

    @_matrix
    def D21_tilde(self) -> Matrix:
        """(l + g, r + 2g) channel inputs into the extended measurement."""
        system = self.system
        blocks = [c.D for c in (*system.uncertainties, *system.nonlinearities)]
        return block_diag(np.hstack([np.zeros((system.l, 0)), *blocks]), np.eye(system.g))

    @_matrix
    def D21_bar(self) -> Matrix:
        """(l + g, q + g) noise of the extended measurement: D_21, then J_21 for the copies."""
        return block_diag(self.system.D21, self.J_21)

    @cached_property
    def M_i(self) -> tuple[Matrix, ...]:
        """The k + 3g matrices of the quadratic constraints on the channel inputs."""
        return self._constraint_matrices(self.input_sizes, weighted=False)

    @cached_property
    def N_i(self) -> tuple[Matrix, ...]:
        """The k + 3g matrices of the quadratic constraints on the channel outputs."""
        return self._constraint_matrices(self.output_sizes, weighted=True)

    def M(self, multipliers: ArrayLike) -> Matrix:
        """Return M(lambda), the sum of lambda_i M_i."""
        return _combination(multipliers, self.M_i, sum(self.input_sizes))

    def N(self, multipliers: ArrayLike) -> Matrix:
        """Return N(lambda), the sum of lambda_i N_i."""
        return _combination(multipliers, self.N_i, sum(self.output_sizes))

    @_matrix
    def J(self) -> Matrix:
        """(r + 2g, q + g) solution of Assumption 1: [B_p1; D21_bar] = [B1_tilde; D21_tilde] J.

        Raises
        ------
        InfeasibleDesignError
            Where a noise does not enter through the uncertainty channels.
        """
        channels = np.vstack([self.B1_tilde, self.D21_tilde])
        noise = np.vstack([self.B_p1, self.D21_bar])
        size = np.maximum(
            np.abs(channels).max(axis=1, initial=0.0), np.abs(noise).max(axis=1, initial=0.0)
        )
        size[size == 0.0] = 1.0
        channels, noise = channels / size[:, None], noise / size[:, None]
        J = np.linalg.lstsq(channels, noise, rcond=None)[0]
        misfit = np.abs(channels @ J - noise).max(axis=0)
        if misfit.max(initial=0.0) > _J_RESIDUAL:
            worst = int(misfit.argmax())
            raise InfeasibleDesignError(
                "Assumption 1",
                f"noise {worst} of {self.system.q} does not enter through the uncertainty channels "
                f"(relative misfit {misfit[worst]:.2g}); declare a channel for it with "
                f"Uncertainty(B=B1[:, [{worst}]], C=..., D=D21[:, [{worst}]]), with C zero if it "
                "carries no uncertainty, or make the system with UncertainSystem.from_plant",
            )
        return J

    def structured_delta(
        self,
        uncertainties: Sequence[ArrayLike] | Matrix = (),
        nonlinearities: Sequence[float] | Matrix = (),
    ) -> Matrix:
        """Return the block-diagonal Delta with xi-tilde = Delta zeta-tilde, as in Section IV-C.

        Parameters
        ----------
        uncertainties : sequence of k floats or (r_s, h_s) arrays
            The uncertainties; a float stands for itself on the diagonal of its block. Left out:
            zero.
        nonlinearities : sequence of g floats
            The slopes of the nonlinearities. The copies get the same. Left out: zero.

        Returns
        -------
        (r + 2g, h + 2g) array

        Raises
        ------
        ValueError, TypeError
            For another number of entries, or one that is no number or block of its channel's size.
        """
        uncertain = _entries("uncertainties", uncertainties, self.system.k)
        slopes = _entries("nonlinearities", nonlinearities, self.system.g)
        blocks = []
        for (name, value), rows, columns in zip(
            (*uncertain, *slopes, *slopes), self.input_sizes, self.output_sizes, strict=True
        ):
            if isinstance(value, list | tuple) or np.ndim(value) > 0:
                blocks.append(validation.matrix(name, value, (rows, columns)))
            else:
                blocks.append(validation.real(name, value) * np.eye(rows, columns))
        return block_diag(np.zeros((0, 0)), *blocks)

    def to_statespace(self) -> "control.StateSpace":
        """Return the linear part as a python-control object, with its channels open.

        The signals are those of `UncertainSystem.to_statespace`, and the output ``w_a`` of the
        delay model.

        Returns
        -------
        control.StateSpace
        """
        part = self.system.blocks
        inputs = {name: self._state_rows(B) for name, B in part.inputs.items()}
        outputs = {name: self._state_columns(C) for name, C in part.outputs.items()}
        outputs["w_a"] = self.C_a
        return Blocks(self.A_p, inputs, outputs, part.feedthrough).to_control()

    def __repr__(self) -> str:
        return (
            f"AugmentedSystem({self.system!r}, delay={self.delay:g} s, order={self.order}, "
            f"n={self.n} states)"
        )

    def _repr_html_(self) -> str:
        matrices = [
            ("$A_p$ (1/s)", self.A_p),
            (r"$\tilde B_1$", self.B1_tilde),
            ("$B_{p1}$", self.B_p1),
            ("$C_{p0}$", self.C_p0),
            ("$C_a$", self.C_a),
            (r"$\tilde C_1$", self.C1_tilde),
            (r"$\tilde C_2$", self.C2_tilde),
            (r"$\tilde D_{21}$", self.D21_tilde),
            (r"$\bar D_{21}$", self.D21_bar),
        ]
        rows = [(name, f"${notation.matrix(value)}$") for name, value in matrices]
        caption = (
            f"Augmented system: {self.n} states, of which {self.n - self.system.n} model the delay "
            f"of ${notation.number(self.delay)}$ s with order {self.order}."
        )
        return table_of_values(rows, caption).html()

    def _no_columns(self, count: int) -> Matrix:
        return np.zeros((self.system.n, count))

    def _state_rows(self, upper: Matrix) -> Matrix:
        """Return a matrix into x as one into x_p: nothing drives the delay model but w."""
        return np.vstack([upper, np.zeros((self.n - self.system.n, upper.shape[1]))])

    def _state_columns(self, left: Matrix) -> Matrix:
        """Return a matrix from x as one from x_p."""
        return np.hstack([left, np.zeros((left.shape[0], self.n - self.system.n))])

    def _constraint_matrices(self, sizes: tuple[int, ...], weighted: bool) -> tuple[Matrix, ...]:
        """Return the M_i (or, weighted by the squared Lipschitz constants, the N_i).

        In the order of (eqIQC1), (eqIQC2), (eqIQC3), (eqIQC4): the uncertainties, then for every
        nonlinearity the difference to its copy, then the nonlinearities, then the copies.
        """
        system = self.system
        ends = np.cumsum((0, *sizes))
        total, k, g = int(ends[-1]), system.k, system.g
        factors = []
        for s in range(k):
            factors.append(np.eye(total)[ends[s] : ends[s + 1]])
        weights = [c.lipschitz if weighted else 1.0 for c in system.nonlinearities]
        plant = [weights[i] * np.eye(total)[[ends[k + i]]] for i in range(g)]
        copies = [weights[i] * np.eye(total)[[ends[k + g + i]]] for i in range(g)]
        factors += [plant[i] - copies[i] for i in range(g)] + plant + copies
        return tuple(frozen(factor.T @ factor) for factor in factors)


def augment(
    system: UncertainSystem, delay: float, order: int, *, J_21: ArrayLike = 1.0
) -> AugmentedSystem:
    """Join a system with the model of the delay of its outputs (Section III).

    Parameters
    ----------
    system : UncertainSystem
        Every row of its C0 is delayed.
    delay : float
        The smoother's lag in seconds, at least zero.
    order : int
        Pade order of the delay model, at least zero; order 0 has no delay states.
    J_21 : float or (g, g) array
        Intensity of the fictitious noise that the theory adds to the copies of the nonlinearities,
        positive definite; the paper's example has the identity.

    Returns
    -------
    AugmentedSystem

    Raises
    ------
    InfeasibleDesignError
        Where a noise does not enter through the uncertainty channels (Assumption 1).
    ValueError, TypeError
        For a bad delay, order or J_21.
    """
    plant = compact(system, delay, order, J_21=J_21)
    _ = plant.J  # Assumption 1 is checked here, once, for everything built on the plant
    return plant


def compact(
    system: UncertainSystem, delay: float, order: int, *, J_21: ArrayLike = 1.0
) -> AugmentedSystem:
    """Do as `augment`, for a system that need not satisfy Assumption 1.

    Estimators of other theories, a Kalman filter say, live on such a plant.
    """
    validation.instance("system", system, UncertainSystem)
    if np.ndim(J_21) == 0:
        J_21 = validation.positive("J_21", J_21) * np.eye(system.g)
    J_21 = validation.matrix("J_21", J_21, (system.g, system.g))
    if system.g and not np.linalg.eigvalsh((J_21 + J_21.T) / 2).min() > 0.0:
        raise ValueError("J_21 must be positive definite")
    return AugmentedSystem(system, pade_delay(delay, order, system.m), J_21)


def check_noise(condition: str, D: Matrix) -> None:
    """Check D D' > 0 in a form free of units: no measurement without noise of its own.

    Raises
    ------
    InfeasibleDesignError
        Of the given condition.
    """
    intensity = D @ D.T
    size = np.sqrt(np.diag(intensity))
    if (size == 0.0).any():
        raise InfeasibleDesignError(
            condition,
            f"measurement {int(np.argmin(size))} has no noise; give its row of D21 "
            "a noise of its own, however small",
        )
    smallest = np.linalg.eigvalsh(intensity / np.outer(size, size)).min()
    if not smallest > 1e-12:
        raise InfeasibleDesignError(
            condition,
            "some combination of the measurements has no noise: the smallest eigenvalue of the "
            f"noise's correlation matrix is {smallest:.2g}",
        )


def _combination(weights: Sequence[float], matrices: Sequence[Matrix], size: int) -> Matrix:
    if len(weights) != len(matrices):
        raise ValueError(f"multipliers must have {len(matrices)} entries, got {len(weights)}")
    return sum(
        (w * matrix for w, matrix in zip(weights, matrices, strict=True)), np.zeros((size, size))
    )


def _entries(name: str, given: Sequence, count: int) -> list[tuple[str, float | Matrix]]:
    """Return what is given for each of `count` channels, with a name; zero where it is left out."""
    try:
        values = list(given) or [0.0] * count
    except TypeError:
        raise TypeError(f"{name} must be a sequence of length {count}, got {given!r}") from None
    if len(values) != count:
        raise ValueError(f"{name} must have {count} entries, got {len(values)}")
    return [(f"{name}[{index}]", value) for index, value in enumerate(values)]
