r"""What every estimator here has in common: the form of (eqcontrol).

The copies are :math:`\tilde\mu_i = \psi_i(\tilde\nu_i)`. A linear filter has zero gains for them.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._support import validation
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.systems.augmented import AugmentedSystem, check_is_plant
from robsmooth.systems.system import UncertainSystem, state_space

if TYPE_CHECKING:
    import control

    from robsmooth.estimators.discrete import DiscreteSmoother


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimator(Frozen):
    """An estimator of a plant's output, filtered and one delay back.

    Attributes
    ----------
    plant : AugmentedSystem
    A_c : (n_c, n_c) array, drift, 1/s
    B_c : (n_c, l + g) array, gains: columns for y, then for the copies' outputs mu-tilde
    C_c : (m + g, n_c) array, outputs: rows of w-hat, then of the copies' arguments nu-tilde
    C_a, C_f : (m, n_c) arrays
        The read-outs of the smoothed estimate of w one delay back and of the filtered one of w now;
        the latter is w-hat unless the cost is on the smoothed error.
    cost : {None, "filtered", "smoothed"}, the error that has a guarantee
    nominal : pair of UncertainSystem or None
        Of a classical design: its model, and the system that its gain is optimal for.

    Examples
    --------
    >>> rs.baselines.fixed_lag_smoother(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    Estimator(3 states, 1 measurements, 1 outputs, 1 copies, delay=3.1e-06 s, order=2)
    """

    plant: AugmentedSystem
    A_c: Matrix
    B_c: Matrix
    C_c: Matrix
    C_a: Matrix
    C_f: Matrix
    cost: str | None = None
    # Not an argument: with other matrices the estimator is no longer the nominal system's.
    nominal: tuple[UncertainSystem, UncertainSystem] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        check_is_plant(self.plant)
        system, n = self.plant.system, len(validation.array("A_c", self.A_c, ndim=2))
        shapes = {"A_c": (n, n), "B_c": (n, system.l + system.g), "C_c": (system.m + system.g, n)}
        for name, shape in (shapes | dict.fromkeys(("C_a", "C_f"), (system.m, n))).items():
            vars(self)[name] = validation.matrix(name, getattr(self, name), shape)
        super().__post_init__()

    @property
    def mean_square_bound(self) -> float | None:
        """The guarantee, if any."""
        return None

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A_c, 1/s, the slowest first."""
        poles = np.linalg.eigvals(self.A_c)
        return poles[np.lexsort((poles.imag, -poles.real))]

    def to_statespace(self, slopes: ArrayLike | None = None) -> "control.StateSpace":
        """Return the estimator as a python-control object.

        Inputs: the measurement dy/dt ``y[0]``, ..., and the copies' outputs ``mu_copy[0]``, ...
        Outputs: ``smoothed``, ``filtered``, and the copies' arguments ``nu_copy``.

        Parameters
        ----------
        slopes : (g,) sequence of floats, optional
            Slopes to close the copies with, in place of ``mu_copy``. Zeros are nominal.

        Examples
        --------
        >>> smoother = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
        >>> smoother.to_statespace().input_labels
        ['y[0]', 'mu_copy[0]']
        """
        system = self.plant.system
        gain, copies = np.hsplit(self.B_c, [system.l])
        A, nu = self.A_c, self.C_c[system.m :]
        inputs = {"y": gain}
        if slopes is None:
            inputs["mu_copy"] = copies
        else:
            A = A + copies * validation.matrix("slopes", slopes, [system.g]) @ nu
        read_outs = {"smoothed": self.C_a, "filtered": self.C_f, "nu_copy": nu}
        return state_space(A, inputs, read_outs, {})

    def discretize(
        self,
        dt: float,
        functions: Iterable[Callable[[Any], Any] | None] | None = None,
        *,
        delay: str | None = None,
        mean: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: str = "means",
    ) -> "DiscreteSmoother":
        """Return the estimator in discrete time, for a measured record.

        Parameters
        ----------
        dt : float, length of a sample's interval, s; above twice the delay a LongStepWarning
        functions : sequence of g callables, optional
            The nonlinearities' functions, instead of those of the plant; None keeps the plant's.
            One that numba cannot compile runs in Python, a hundred times as slowly.
        delay : {"exact", "model"}, optional
            "exact" runs the smoother of the nominal system in discrete time, without a delay model;
            "model" the estimator's own equations, which are faster. By default "exact" where there
            is a nominal system: for the classical and the tuned designs.
        mean, offset : (n,) and (l,) arrays, optional
            The mean of the system's state, due to an effect that is not modelled, and a constant
            that is added to the measurements. Zero by default.
        samples : {"means", "instants"}
            A sample is the mean of dy/dt over its interval. Or, for exact delays, it is taken at
            the interval's end, and only its noise, of variance :math:`D_{21}D_{21}'/dt`, is a mean.

        Raises
        ------
        ArithmeticError
            Where the estimator is unstable and dt is too long for it.

        Examples
        --------
        >>> smoother = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
        >>> smoother.discretize(dt=1e-7).run([[0.2], [0.1]]).shape
        (2, 1)
        """
        from robsmooth.estimators.discrete import DiscreteSmoother  # numba takes long to import

        return DiscreteSmoother(self, dt, functions, delay, mean, offset, samples)

    def of_nominal(self, model: UncertainSystem, gain: UncertainSystem) -> Self:
        """Return the same estimator with the nominal systems of its model and of its gain."""
        result = replace(self)
        vars(result).update(nominal=(model, gain))
        return result

    def in_coordinates(self, to: Matrix, back: Matrix) -> Self:
        """Return the same estimator with the states `to` times x_hat; `back` is the inverse."""
        reads = {name: getattr(self, name) @ back for name in ("C_c", "C_a", "C_f")}
        return replace(self, A_c=to @ self.A_c @ back, B_c=to @ self.B_c, **reads)

    @property
    def _figures(self) -> str:
        """The figures of the repr, without the delay."""
        l, m, g = self.plant.system.l, self.plant.system.m, self.plant.system.g  # noqa: E741
        return f"{len(self.A_c)} states, {l} measurements, {m} outputs, {g} copies"

    def __repr__(self) -> str:
        model = f"delay={self.plant.delay:g} s, order={self.plant.order}"
        return f"{type(self).__name__}({self._figures}, {model})"
