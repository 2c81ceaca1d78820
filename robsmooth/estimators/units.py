r"""Natural units, in which a plant's time constants, states, noises and outputs are of order one.

With the time :math:`t = Tt'`, the states :math:`x = sx'` and the measurement's noise as units, the
equations keep their form with :math:`W = \sqrt T W'` and :math:`\xi = \xi'/\sqrt T`. A design is
made in natural units, so that it does not depend on the units of its problem.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import null_space, orth

from robsmooth._numerics.lyapunov import covariances, deviations
from robsmooth._support import validation
from robsmooth._support.validation import Matrix
from robsmooth.estimators.conditions import COSTS
from robsmooth.estimators.drift import Drift
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import matrices
from robsmooth.systems.augmented import AugmentedSystem, check_is_plant, check_noise, undelayed
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.delay import pade_delay
from robsmooth.systems.system import UncertainSystem

_LEAST_SEEN = 1e-4  # singular value of the read-outs, relative to the largest
_ROUNDING = 1e-9  # of a row, relative to others


class Units(NamedTuple):
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
        for _ in range(2):  # with the noise, then also with the uncertainties that it excites
            covariance = covariances(system.A, noise).stationary
            sizes = [np.sqrt(np.trace(u.C @ covariance @ u.C.T)) for u in system.uncertainties]
            driven = [u.B * size for u, size in zip(system.uncertainties, sizes, strict=True)]
            noise = np.hstack([system.B1, *(np.sqrt(time) * B for B in driven)])
        x = deviations(covariance)
        w = np.linalg.norm(system.C0 * x)
        return cls(time, x, np.linalg.norm(system.D21, axis=1), float(w) or 1.0)

    def back(self) -> "Units":
        """Return the units that lead back."""
        return Units(1.0 / self.time, 1.0 / self.x, 1.0 / self.y, 1.0 / self.w)

    def system(self, old: UncertainSystem) -> UncertainSystem:
        """Return a system in these units; its nonlinearities are without functions."""
        x, y, root = self.x[:, None], self.y[:, None], np.sqrt(self.time)

        def channel(c: Uncertainty | Nonlinearity) -> dict[str, Matrix]:
            return {"B": root * c.B / x, "C": root * c.C * self.x, "D": c.D / y}

        return UncertainSystem(
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

    def plant(self, plant: AugmentedSystem) -> AugmentedSystem:
        """Return a plant in these units."""
        old, x, y, root = plant.system, self.x[:, None], self.y[:, None], np.sqrt(self.time)
        system, model = self.system(old), pade_delay(plant.delay / self.time, plant.order, old.m)
        growth = plant.growth * self.x / self.w
        taken_off = np.vstack([plant.taken_off[: old.n] * root / x, plant.taken_off[old.n :] / y])
        return AugmentedSystem(system, model, plant.J_21, growth, taken_off)

    def restored(self, estimator: Estimator, plant: AugmentedSystem) -> dict[str, Any]:
        """Return the fields of an estimator of `plant`, made for the plant in these units.

        The first n states estimate the plant's, and so do the next n, if there are more.
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


class Natural(NamedTuple):
    """A design problem in natural units, in which a filter has no delay model."""

    units: Units
    plant: AugmentedSystem  # in these units; stable, by an observer where the original drifts
    whole: AugmentedSystem  # in these units, with its drift
    original: AugmentedSystem
    output: str  # "smoothed" or "filtered"
    drift: Drift

    @classmethod
    def of(cls, plant: AugmentedSystem, output: str) -> "Natural":
        """Return the problem of a plant; an InfeasibleDesignError where it has no design."""
        check_is_plant(plant)
        validation.choice("output", output, COSTS)
        check_noise("A measurement's noise", plant.system.D21)
        drift = Drift.of(plant)
        units = Units.of(drift.plant.system)
        both = units.plant(drift.plant), units.plant(plant)
        both = map(undelayed, both) if output == "filtered" else both
        return cls(units, *both, plant, output, drift)

    def restored(self, estimator: Estimator) -> dict[str, Any]:
        """Return the fields, for the original plant, of an estimator of `plant` or of the `whole`.

        Its first n states estimate the plant's. The delay model is appended to a filter.
        """
        of_whole = estimator.plant is not self.plant
        original = self.original if of_whole else self.drift.plant
        plant, m = self.units.plant(original), self.original.system.m
        model, n = plant.delay_model, estimator.plant.n
        A_c, B_c, C_c, C_a = (getattr(estimator, name) for name in ("A_c", "B_c", "C_c", "C_a"))
        none = np.zeros((m, len(A_c) - n))
        C_f = np.hstack([plant.C_p0, none])
        if self.output == "filtered":
            own, delayed = len(A_c), len(model.F)
            A_c = np.block([[A_c, np.zeros((own, delayed))], [model.G @ C_a, model.F]])
            B_c, C_c = np.pad(B_c, ((0, delayed), (0, 0))), np.pad(C_c, ((0, 0), (0, delayed)))
            order = np.r_[:n, own : own + delayed, n:own]
            A_c, B_c, C_c = A_c[np.ix_(order, order)], B_c[order], C_c[:, order]
            C_a, C_f = np.hstack([plant.C_a, none]), C_c[:m]
        estimator = Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=C_a, C_f=C_f)
        fields = self.units.restored(estimator, self.original)
        return fields if of_whole else self.drift.restored(self.original, fields)


def in_plant_states(estimator: Estimator) -> Estimator:
    """Return the same estimator in coordinates whose first n states estimate the plant's.

    Then C_2 and C_p0 times these are nominal estimates of the measurement to come and of w. The
    other directions are chosen for well conditioned coordinates. States beyond 2n, the effect of
    the copies' outputs on the plant's state, add to the first n.
    """
    plant, n = estimator.plant, estimator.plant.n
    A, B, _, _ = matrices(estimator, "real")
    covariance, own = covariances(A, B).stationary, slice(n, 2 * n)
    estimate = np.linalg.lstsq(covariance[own, own], covariance[own, :n], rcond=None)[0].T
    rows = orth(np.vstack([plant.C2_tilde[: plant.system.l], plant.C_p0]).T, rcond=_ROUNDING).T
    U, sizes, V = np.linalg.svd(rows @ estimate, full_matrices=False)
    size = sizes.max(initial=0.0) or 1.0
    known = U * np.maximum(sizes, _LEAST_SEEN * size) @ V
    to_plant = rows.T @ known + size * null_space(rows) @ null_space(known).T
    more = len(A) - 2 * n
    to_plant = np.block([[to_plant, np.eye(n, more)], [np.zeros((more, n)), np.eye(more)]])
    return estimator.in_coordinates(to_plant, np.linalg.inv(to_plant))
