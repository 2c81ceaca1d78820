r"""The limit of designs in which multipliers vanish until M(lambda) is singular.

Where both multipliers of a nonlinearity and of its copy go to zero, and only that of their
difference stays, the bound may fall all the way, and no design attains its infimum. The limit is a
design all the same, and computed here as such, without a small number: with
:math:`\lambda(\varepsilon) = \lambda + \varepsilon\rho`, at :math:`\varepsilon = 0`.

Channels whose weight vanishes (`robsmooth.estimators.equations`) have noise without bound:

- In the X equation it is left out. With b the channels' inputs into the state, divided by the
  roots of the weights' rates, the solution :math:`X_0` must satisfy :math:`X_0b = 0`, else the
  bound grows without limit: no output of the remaining uncertainty may depend on these inputs. Next
  to the limit :math:`X = X_0 + \varepsilon x + \dots`, with x the stabilising solution of

  .. math:: x\hat A + \hat A'x + \tfrac1\tau xbb'x + \tau C_1'\dot\Lambda_XC_1 = 0,\qquad
      \hat A = A_p + \tfrac1\tau B\Lambda_X^{-1}B'X_0,

  and the bound gains :math:`\tfrac12\operatorname{tr}(b'xb)`, which depends on the ratios of the
  rates :math:`\rho`. Where no such channel enters the state, it is zero.
- In the Y equation, all that is known of such channels is what the measurement says, in which they
  appear as d. With any L, :math:`L'd = I`, they become a *known input* :math:`BL'y`. The rest of
  the measurement, :math:`N'y` with N a basis of :math:`N'd = 0`, serves a design of the ordinary
  kind, for the system :math:`A_p - BL'C_2,\ N'C_2` with the other channels.

For a nonlinearity and its copy only the X equation's weight vanishes, and the share a of the copy
is one. This is the *nonlinear observer*: it takes the copy's output for the nonlinearity's, and is
robust against their difference alone.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._numerics.riccati import solve_riccati
from robsmooth._support.blas import one_thread
from robsmooth.estimators.conditions import ASSUMPTION_X, certified_solution, singular
from robsmooth.estimators.smoother import RobustSmoother, design_equations, solve_design
from robsmooth.systems.augmented import AugmentedSystem


@one_thread
def limiting_smoother(
    plant: AugmentedSystem,
    tau: float,
    multipliers: ArrayLike,
    cost: str = "filtered",
    *,
    rates: ArrayLike | None = None,
) -> RobustSmoother:
    r"""Design the smoother in the limit where the zeros among the multipliers are approached.

    It is the limit of `design_smoother` at :math:`\lambda + \varepsilon\rho` as
    :math:`\varepsilon \to 0`, gains and bound. Its guarantee is the limit of theirs: a stable
    loop's error is a continuous function of the gains.

    Parameters
    ----------
    plant, tau, multipliers, cost
        As in `design_smoother`, with zeros for the multipliers that vanish. Where M(lambda) is
        positive all the same, the design is that of `design_smoother`.
    rates : (k + 3g,) sequence, optional
        :math:`\rho \ge 0`, how fast the zeros are approached, relative to each other; by default
        all that make M(lambda) singular as fast. They matter where two or more nonlinearities that
        enter the state vanish.

    Returns
    -------
    RobustSmoother
        X is the limit of X, and the certificate "x" that of its derivative.

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2 or 3 or the constraint (eqcons) fails in the limit, or the bound grows
        without limit towards it.

    See Also
    --------
    minimize_bound, design_smoother : the search for tau and lambda; a design.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> limit = rs.limiting_smoother(plant, tau=1.1e-6, multipliers=[1.0, 0.5, 0.0, 0.0])
    >>> round(limit.mean_square_bound, 4)
    0.2433
    """
    equations = design_equations(plant, tau, multipliers, cost, limit=True, rates=rates)
    design = solve_design(plant, equations, cost)
    if not singular(plant, equations.multipliers).any():
        return design
    A, Q, S = equations.equation_of_slope(design.X)
    x = certified_solution(f"{ASSUMPTION_X} in the limit", lambda: solve_riccati(A, Q, S))
    return replace(
        design,
        bound=design.bound - 0.5 * equations.tau * float(np.trace(S @ x.X)),
        certificates={**design.certificates, "x": x},
    )
