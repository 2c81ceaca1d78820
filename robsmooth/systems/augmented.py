r"""The augmented and compact system of Section III, (eqNsystem) and (eqCsystem).

All channels are stacked: k uncertainties, g nonlinearities, g copies in the estimator. `W` has the
system's q noises, then the g fictitious ones of the copies, of intensity :math:`J_{21}`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, block_diag, expm, solve_sylvester

from robsmooth._numerics.modes import modes, natural_units, rates
from robsmooth._support import validation
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Frozen, Matrix, frozen
from robsmooth.systems.delay import DelayModel, pade_delay
from robsmooth.systems.system import UncertainSystem

_MISFIT = 1e-9  # largest of Assumption 1, relative to each row's size
_STANDING = 1e-6  # of the fastest mode's rate: a slower mode counts as one that does not decay
_ROUNDING = 1e-12
_CORRELATED = 1e-12  # an eigenvalue of a noise's correlation matrix up to this counts as zero


@dataclass(frozen=True, eq=False)
class AugmentedSystem(Frozen):
    r"""The system with its delay model, in the paper's compact form.

    Attributes
    ----------
    system : UncertainSystem
    delay_model : DelayModel
    J_21 : (g, g) array, intensity of the fictitious noise of the copies
    growth : (m, n) array
        The delay model's misfit for modes that do not decay, as a read-out of the system's state.
    taken_off : (n + l, g) array
        What is subtracted from state and measurement, times the copies' outputs; zero by `augment`.
    delay, order, n : float and ints
        The delay of the outputs, s, the order of its model, and the number of states, with its own.
    input_sizes, output_sizes : tuples of int
        Widths of the channels in xi-tilde, r_1 ... r_k, then 2 g ones; heights in zeta-tilde.
    A_p, B_p1 : (n, n) and (n, q + g) arrays
        Drift of the augmented state, 1/s, and its noise, with zero columns for that of the copies.
    C_p0, C_a : (m, n) arrays
        The output w, and the delayed one, :math:`w_a = [J_a C_0,\ H_a] x_p` plus the growth.
    B1_tilde, C1_tilde, D12_tilde : (n, r + 2g), (h + 2g, n) and (h + 2g, m + g) arrays
        Channel inputs into the state; channel outputs from the state and from the estimator.
    C2_tilde, D21_tilde, D21_bar : (l + g, n), (l + g, r + 2g) and (l + g, q + g) arrays
        State, channel inputs and noise in the extended measurement: y, then the copies' outputs.
    M_i, N_i : tuples of k + 3g arrays, the constraints' matrices of channel inputs and outputs

    Examples
    --------
    >>> rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2).A_p.shape
    (3, 3)
    """

    system: UncertainSystem
    delay_model: DelayModel
    J_21: Matrix
    growth: Matrix
    taken_off: Matrix
    delay: float = field(init=False)
    order: int = field(init=False)
    n: int = field(init=False)
    input_sizes: tuple[int, ...] = field(init=False)
    output_sizes: tuple[int, ...] = field(init=False)
    A_p: Matrix = field(init=False)
    B_p1: Matrix = field(init=False)
    C_p0: Matrix = field(init=False)
    C_a: Matrix = field(init=False)
    B1_tilde: Matrix = field(init=False)
    C1_tilde: Matrix = field(init=False)
    D12_tilde: Matrix = field(init=False)
    C2_tilde: Matrix = field(init=False)
    D21_tilde: Matrix = field(init=False)
    D21_bar: Matrix = field(init=False)
    M_i: tuple[Matrix, ...] = field(init=False)
    N_i: tuple[Matrix, ...] = field(init=False)

    def __post_init__(self) -> None:
        validation.instance("system", self.system, UncertainSystem)
        validation.instance("delay_model", self.delay_model, DelayModel)
        system, model, g = self.system, self.delay_model, self.system.g
        shapes = {"J_21": (g, g), "growth": (system.m, system.n)}
        for name, shape in (shapes | {"taken_off": (system.n + system.l, g)}).items():
            vars(self)[name] = validation.matrix(name, getattr(self, name), shape)
        n, ones = system.n + len(model.F), (1,) * (2 * g)
        input_sizes = (*(u.B.shape[1] for u in system.uncertainties), *ones)
        output_sizes = (*(u.C.shape[0] for u in system.uncertainties), *ones)
        B, C, D = system.stacked((*system.uncertainties, *system.nonlinearities))
        h = len(C) + g
        B = np.hstack([B, -self.taken_off[: system.n]])
        D21_tilde = block_diag(D, np.eye(g))
        D21_tilde[: system.l, D.shape[1] :] = -self.taken_off[system.n :]
        A_p = block_diag(system.A, model.F)
        A_p[system.n :, : system.n] = model.G @ system.C0
        vars(self).update(delay=model.delay, order=model.order, n=n)
        vars(self).update(input_sizes=input_sizes, output_sizes=output_sizes)
        vars(self).update(
            A_p=A_p,
            B_p1=padded(system.B1, n, system.q + g),
            C_p0=padded(system.C0, system.m, n),
            C_a=np.hstack([model.J @ system.C0 + self.growth, model.H]),
            B1_tilde=padded(B, n, B.shape[1]),
            C1_tilde=padded(C, h, n),
            D12_tilde=block_diag(np.zeros((h - g, system.m)), np.eye(g)),
            C2_tilde=padded(system.C2, system.l + g, n),
            D21_tilde=D21_tilde,
            D21_bar=block_diag(system.D21, self.J_21),
            M_i=_constraints(input_sizes, [1.0] * g),
            N_i=_constraints(output_sizes, [c.lipschitz for c in system.nonlinearities]),
        )
        super().__post_init__()

    def M(self, multipliers: ArrayLike) -> Matrix:
        """Return M(lambda), the sum of lambda_i M_i."""
        multipliers = validation.matrix("multipliers", multipliers, [len(self.M_i)])
        return sum(map(np.multiply, multipliers, self.M_i), np.zeros([sum(self.input_sizes)] * 2))

    @cached_property
    def J(self) -> Matrix:
        """(r + 2g, q + g) solution of Assumption 1: [B_p1; D21_bar] = [B1_tilde; D21_tilde] J."""
        channels = np.vstack([self.B1_tilde, self.D21_tilde])
        noise = np.vstack([self.B_p1, self.D21_bar])
        size = np.abs(np.hstack([channels, noise])).max(axis=1, initial=0.0)[:, None]
        size[size == 0.0] = 1.0
        J = np.linalg.lstsq(channels / size, noise / size, rcond=None)[0]
        misfit = np.abs((channels @ J - noise) / size).max(axis=0)
        if misfit.max(initial=0.0) > _MISFIT:
            worst = int(misfit.argmax())
            raise InfeasibleDesignError(
                "Assumption 1",
                f"noise {worst} of {self.system.q} does not enter through the uncertainty channels "
                f"(relative misfit {misfit[worst]:.2g}); declare a channel for it with "
                f"Uncertainty(B=B1[:, [{worst}]], C=..., D=D21[:, [{worst}]]), with C zero if it "
                "carries no uncertainty, or make the system with UncertainSystem.from_plant",
            )
        return frozen(J)

    @cached_property
    def known(self) -> tuple[Matrix, Matrix]:
        """(n, g) and (l, g) arrays, how the copies' outputs enter state and y as known inputs."""
        l, g = self.system.l, self.system.g  # noqa: E741 - the paper's letter
        r = self.B1_tilde.shape[1]
        both = np.eye(r)[:, r - 2 * g : r - g] + np.eye(r)[:, r - g :]
        return frozen(self.B1_tilde @ both), frozen(self.D21_tilde[:l] @ both)

    def structured_delta(
        self,
        uncertainties: Sequence[ArrayLike] | Matrix = (),
        nonlinearities: Sequence[float] | Matrix = (),
    ) -> Matrix:
        """Return the (r + 2g, h + 2g) block-diagonal Delta, xi-tilde = Delta zeta-tilde.

        Parameters
        ----------
        uncertainties : sequence of k floats or (r_s, h_s) arrays, optional
            The blocks; a float is on the diagonal of its block. Default: zeros.
        nonlinearities : sequence of g floats, optional
            The slopes of the nonlinearities and their copies. Default: zeros.

        Examples
        --------
        >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
        >>> plant.structured_delta(nonlinearities=[-0.5]).diagonal()
        array([ 0. , -0.5, -0.5])
        """
        k, g = self.system.k, self.system.g
        sizes = list(zip(self.input_sizes, self.output_sizes, strict=True))
        blocks = _blocks("uncertainties", uncertainties, sizes[:k])
        slopes = _blocks("nonlinearities", nonlinearities, sizes[k : k + g])
        return block_diag(np.zeros((0, 0)), *blocks, *slopes, *slopes)

    def __repr__(self) -> str:
        model = f"delay={self.delay:g} s, order={self.order}, n={self.n} states"
        return f"AugmentedSystem({self.system!r}, {model})"


def augment(
    system: UncertainSystem, delay: float, order: int, *, J_21: ArrayLike = 1.0
) -> AugmentedSystem:
    """Join a system with the model of the delay of its outputs (Section III).

    `minimize_bound` and `baselines.fixed_lag_smoother` design robust and classical smoothers.

    Parameters
    ----------
    system : UncertainSystem, every row of its C0 is delayed
    delay : float, of the smoothed estimate, at least zero, s
    order : int, that of the Pade approximation, at least zero; order 0 has no delay states
    J_21 : float or (g, g) array
        Intensity of the fictitious noise of the copies, positive definite; the paper has 1.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> plant.delay, plant.order, plant.n
    (3.1e-06, 2, 3)
    """
    validation.instance("system", system, UncertainSystem)
    if validation.is_single(J_21):
        J_21 = validation.positive("J_21", J_21) * np.eye(system.g)
    J_21 = validation.matrix("J_21", J_21, (system.g, system.g))
    if system.g and not np.linalg.eigvalsh((J_21 + J_21.T) / 2).min() > 0.0:
        raise ValueError("J_21 must be positive definite")
    model = pade_delay(delay, order, system.m)
    none = np.zeros((system.n + system.l, system.g))
    return AugmentedSystem(system, model, J_21, _growth(system, model), none)


def _growth(system: UncertainSystem, model: DelayModel) -> Matrix:
    r"""Return the model's misfit for delayed modes that do not decay, (m, n).

    Where x = V z with dz = A_z z dt, the delayed output is :math:`C_0 V e^{-A_z\delta} z` plus
    noise. The model's state becomes S z with :math:`S A_z = F_a S + G_a C_0 V`. For integrators
    its output is the delayed one.
    """
    slowest, fastest = rates(system.A)
    if slowest > _STANDING * fastest:  # all modes decay
        return np.zeros_like(system.C0)
    try:
        found = modes(system.A, natural_units(system.A, system.B1), _STANDING * fastest)
    except LinAlgError:  # integrators whose poles rounding has separated: delayed exactly
        return np.zeros_like(system.C0)
    w = system.C0 @ found.V
    lacking = w @ expm(-model.delay * found.A) - model.J @ w
    if len(model.F):
        lacking -= model.H @ solve_sylvester(model.F, -found.A, -model.G @ w)
    lacking[np.abs(lacking) <= _ROUNDING * np.abs(w).max(initial=0.0)] = 0.0
    return lacking @ found.W


def check_is_plant(plant: AugmentedSystem) -> None:
    """Check the type of a plant."""
    hint = "; augment(system, delay, order) makes one"
    validation.instance("plant", plant, AugmentedSystem, hint)


def undelayed(plant: AugmentedSystem) -> AugmentedSystem:
    """Return the plant without its delay model, which the filtered error does not see."""
    none = np.zeros_like(plant.growth)
    return replace(plant, delay_model=pade_delay(0.0, 0, plant.system.m), growth=none)


def check_noise(condition: str, D: Matrix) -> None:
    """Check D D' > 0, in a form free of units: every measurement has a noise of its own."""
    intensity = D @ D.T
    size = np.sqrt(np.diag(intensity))
    if (size == 0.0).any():
        detail = f"measurement {int(np.argmin(size))} has no noise; give its row of D21 a noise"
        raise InfeasibleDesignError(condition, f"{detail} of its own, however small")
    smallest = np.linalg.eigvalsh(intensity / np.outer(size, size)).min()
    if not smallest > _CORRELATED:
        eigenvalue = f"the smallest eigenvalue of the noise's correlation matrix is {smallest:.2g}"
        detail = f"some combination of the measurements has no noise: {eigenvalue}"
        raise InfeasibleDesignError(condition, detail)


def padded(matrix: Matrix, rows: int, columns: int) -> Matrix:
    """Return a matrix with zeros below and to its right."""
    result = np.zeros((rows, columns))
    result[: len(matrix), : matrix.shape[1]] = matrix
    return result


def _constraints(sizes: Sequence[int], bounds: Sequence[float]) -> tuple[Matrix, ...]:
    """Return the matrices of (eqIQC1) to (eqIQC4), with one bound for each nonlinearity."""
    g, k = len(bounds), len(sizes) - 2 * len(bounds)
    rows = np.split(np.eye(sum(sizes)), np.cumsum(sizes, dtype=int))[:-1]
    own = [bound * row for bound, row in zip(bounds, rows[k : k + g], strict=True)]
    copies = [bound * row for bound, row in zip(bounds, rows[k + g :], strict=True)]
    differences = [row - copy for row, copy in zip(own, copies, strict=True)]
    return tuple(F.T @ F for F in (*rows[:k], *differences, *own, *copies))


def _blocks(name: str, given: Sequence, sizes: Sequence[tuple[int, int]]) -> list[Matrix]:
    """Return the blocks of a Delta, zeros by default."""
    given = validation.sequence(name, given, f"length {len(sizes)}") or [0.0] * len(sizes)
    values = validation.sequence(name, given, count=len(sizes))
    return [
        validation.real(f"{name}[{i}]", value) * np.eye(*size)
        if validation.is_single(value)
        else validation.matrix(f"{name}[{i}]", value, size)
        for i, (value, size) in enumerate(zip(values, sizes, strict=True))
    ]
