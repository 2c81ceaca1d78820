r"""Natural units, in which a plant's time constants, states, noises and outputs are of order one.

With the time :math:`t = Tt'`, the states :math:`x = sx'` and the measurement's noise as units,

.. math:: dy = [C_2 x + D\xi]\,dt + D_{21}\,dW

keeps its form with :math:`W = \sqrt T W'` and :math:`\xi = \xi'/\sqrt T`. A design is made in
natural units and then brought back, so that it does not depend on the units of its problem.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from robsmooth._numerics.lyapunov import covariances
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.delay import pade_delay
from robsmooth.systems.system import UncertainSystem


@dataclass(frozen=True, eq=False)
class Units:
    """The natural units of a plant: of time (s), states (n,), measurements (l,) and of w."""

    time: float
    x: Matrix
    y: Matrix
    w: float

    @classmethod
    def of(cls, system: UncertainSystem) -> "Units":
        """Return the units in which a stable system is of order one."""
        time = 1.0 / np.abs(np.linalg.eigvals(system.A)).max()
        noise = system.B1
        for _ in range(2):  # of the noise, then of the uncertainties that it excites, too
            covariance = covariances(system.A, noise).stationary
            sizes = [np.sqrt(np.trace(u.C @ covariance @ u.C.T)) for u in system.uncertainties]
            driven = [u.B * size for u, size in zip(system.uncertainties, sizes, strict=True)]
            noise = np.hstack([system.B1, *(np.sqrt(time) * B for B in driven)])
        variances = np.diag(covariance)
        x = np.sqrt(np.where(variances > 0.0, variances, 1.0))
        w = np.linalg.norm(system.C0 * x)
        return cls(
            time=time,
            x=x,
            y=np.linalg.norm(system.D21, axis=1),
            w=float(w) or 1.0,
        )

    def plant(self, plant: AugmentedSystem) -> AugmentedSystem:
        """Return a plant in these units; its nonlinearities are without functions."""
        old, x, y, root = plant.system, self.x[:, None], self.y[:, None], np.sqrt(self.time)

        def channel(c: Uncertainty | Nonlinearity) -> dict[str, Matrix]:
            return {"B": root * c.B / x, "C": root * c.C * self.x, "D": c.D / y}

        system = UncertainSystem(
            A=self.time * old.A / x * self.x,
            B1=root * old.B1 / x,
            C0=old.C0 * self.x / self.w,
            C2=root * old.C2 / y * self.x,
            D21=old.D21 / y,
            uncertainties=[Uncertainty(**channel(u)) for u in old.uncertainties],
            nonlinearities=[
                Nonlinearity(**channel(c), lipschitz=c.lipschitz) for c in old.nonlinearities
            ],
        )
        model = pade_delay(plant.delay / self.time, plant.order, old.m)
        return AugmentedSystem(system, model, plant.J_21)

    def restored(self, estimator: Estimator, plant: AugmentedSystem) -> dict[str, Any]:
        """Return the fields of an estimator of `plant`, made for the plant in these units.

        Its first n states estimate the plant's, and so do the next, if there are more.
        """
        m, g, root = plant.system.m, plant.system.g, np.sqrt(self.time)
        inputs = np.concatenate([self.y, np.ones(g)]) * root
        outputs = np.concatenate([np.full(m, self.w), np.full(g, 1.0 / root)])[:, None]
        each = np.concatenate([self.x, np.full(plant.n - plant.system.n, self.w)])
        x = np.concatenate([each, each])[: len(estimator.A_c)]
        return {
            "plant": plant,
            "A_c": x[:, None] * estimator.A_c / x / self.time,
            "B_c": x[:, None] * estimator.B_c / inputs,
            "C_c": outputs * estimator.C_c / x,
            "C_a": self.w * estimator.C_a / x,
            "C_f": self.w * estimator.C_f / x,
        }
