r"""The example of Section IV: adaptive homodyne estimation of a varying optical phase.

The phase is (eqdphi), the photocurrent (eqIt). With :math:`e = \phi-\hat\phi` and
:math:`\sin e = \beta e + f(e)` the measurement is (eqyt), with :math:`|f(e)| \le \gamma|e|`.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from robsmooth._support import validation
from robsmooth._support.tables import Table
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.functions import Combination
from robsmooth.systems.system import UncertainSystem


@dataclass(frozen=True)
class HomodyneParameters:
    r"""The parameters of Table I; `PAPER` has the values printed there.

    Attributes
    ----------
    lam, kappa : float
        :math:`\lambda_\phi \ge 0, \kappa > 0`, decay (rad/s) and diffusion (rad^2/s) of the phase.
    alpha : float, positive, amplitude of the coherent beam, s^(-1/2)
    beta, gamma : float, positive and in (0, 1), tangent of the sine and half width of the sector

    Examples
    --------
    >>> rs.homodyne.PAPER.uncertain_system().A
    array([[-9140.]])
    """

    lam: float
    kappa: float
    alpha: float
    beta: float
    gamma: float

    def __post_init__(self) -> None:
        vars(self)["lam"] = validation.real("lam", self.lam, low=0.0)
        for name in ("kappa", "alpha", "beta"):
            vars(self)[name] = validation.positive(name, getattr(self, name))
        vars(self)["gamma"] = validation.real("gamma", self.gamma, low=0, high=1, without=[0, 1])

    def uncertain_system(self) -> UncertainSystem:
        r"""Return the example in the form of Section II, as (eqsystem1).

        It has an uncertainty with zero output, for the process noise (:math:`\Delta_1 = 0`), and a
        nonlinearity: `channel` of :math:`\nu = 2\alpha\gamma\phi` less its filtered estimate.
        """
        drive, gain = math.sqrt(self.kappa), 1.0 / (2.0 * self.alpha * self.beta)
        B1, D21 = [[drive, 0.0]], [[0.0, gain]]
        process = Uncertainty(B=[[drive]], C=[[0.0]], D=[[0.0]])
        C = [[2.0 * self.alpha * self.gamma]]
        sine = Nonlinearity([[0.0]], C, [[gain]], 1.0, self.channel, "filtered")
        return UncertainSystem([[-self.lam]], B1, [[1.0]], [[1.0]], D21, (process,), (sine,))

    def table(self) -> Table:
        """Return Table I."""
        rows = [
            (r"$\lambda_\phi$", f"{self.lam:g}", "rad/s", "decay rate of the phase"),
            (r"$\kappa$", f"{self.kappa:g}", "rad²/s", "diffusion of the phase"),
            (r"$\alpha$", f"{self.alpha:g}", "s^-1/2", "amplitude of the beam"),
            (r"$\beta$", f"{self.beta:g}", "", "slope of the tangent of the sine"),
            (r"$\gamma$", f"{self.gamma:g}", "", "half width of the sector"),
        ]
        units = "the units that the equations need; it prints rad/s for kappa and 1/s for alpha"
        columns = ("symbol", "value", "unit", "what it is")
        return Table(columns, rows, f"Table I of the paper, with {units}.")

    def _repr_html_(self) -> str:
        return self.table().html()

    def remainder(self, error: ArrayLike) -> NDArray[np.float64]:
        r"""Return :math:`f(e) = \sin e - \beta e` at errors in rad."""
        error = validation.numbers_of("error", error)
        return np.sin(error) - self.beta * error

    @property
    def channel(self) -> Combination:
        r"""The function :math:`\psi(\nu) = 2\alpha f(\nu/2\alpha\gamma)`."""
        argument, value = 1.0 / (2.0 * self.alpha * self.gamma), 2.0 * self.alpha
        name = "HomodyneParameters.channel"
        return Combination(np.sin, argument, value, self.beta / self.gamma, name)

    @property
    def sector_slope(self) -> float:
        r"""The slope m of the sector's lower edge by the paper's gamma = (1 - m)/2."""
        return 1.0 - 2.0 * self.gamma

    @property
    def lower_slope(self) -> float:
        r"""The lower edge that the design uses, :math:`\beta - \gamma`: Delta_2 = -1."""
        return self.beta - self.gamma

    def sector_range(self, slope: float | None = None) -> float:
        r"""Return the largest error (rad, at most pi) with sin e from slope e to (beta + gamma) e.

        With the default slope, `lower_slope`, the sector is :math:`|f(e)| \le \gamma|e|`.
        """
        slope = self.lower_slope if slope is None else validation.real("slope", slope)
        if not slope < 1.0 <= self.beta + self.gamma:  # fails at zero already
            return 0.0
        if slope <= math.sin(math.pi) / math.pi:  # zero but for rounding
            return math.pi
        return float(brentq(lambda e: math.sin(e) / e - slope, 1e-9, math.pi))

    @property
    def lipschitz_range(self) -> float:
        """The largest error (rad) up to which f is Lipschitz: ``|cos e - beta| <= gamma``."""
        if abs(1.0 - self.beta) > self.gamma:
            return 0.0
        return math.acos(max(self.lower_slope, -1.0))

    def with_gain(self, gain: float) -> "HomodyneParameters":
        r"""Return the parameters for a detector that sees :math:`c\sin e`, noise unchanged."""
        gain = validation.positive("gain", gain)
        return replace(self, alpha=gain * self.alpha, beta=self.beta / gain)


PAPER = HomodyneParameters(lam=9.14e3, kappa=4e4, alpha=1162.0, beta=1.0, gamma=0.4)
"""The values of Table I, with the sector that Section IV takes; see `HomodyneParameters`."""
