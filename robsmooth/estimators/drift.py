r"""Plants that drift: an observer of the drift, and a design for the rest.

An observer with the gain :math:`L_0` estimates the modes :math:`x_0 = Vz_0` that hardly decay and
that no uncertainty sees. The rest :math:`x - x_0` is a stable plant with the measurement
:math:`dy' = dy - (C_2x_0 + \bar D\tilde\mu)\,dt`. Observer and estimator of this rest make the
plant's estimator. What the observer has of the copies' outputs is subtracted.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, null_space

from robsmooth._numerics.modes import Modes, modes, natural_units, reaches
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.estimators.loop import drifting_output
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.system import UncertainSystem

_SLOW = 1e-3  # of the filter's fastest rate: the observer takes modes that decay by less
_MORE = 3.0  # measurement noise for the observer: the best one would leave nothing to estimate
_STANDING = 1e-13  # of that rate: a mode that decays by less does not decay
_UNSEEN = 1e-9  # of an output's size: less is rounding


class Drift(NamedTuple):
    """The observer of a plant's modes that hardly decay, and the rest."""

    plant: AugmentedSystem  # of the rest: stable
    V: Matrix  # (n, d) the modes, in the system's state
    W: Matrix  # (d, n) with W V = I
    gain: Matrix  # (n, l) L_0
    kept: np.ndarray  # (k + 3g,) which constraints hold for the rest

    @classmethod
    def of(cls, plant: AugmentedSystem) -> "Drift":
        """Return the observer of a plant; an InfeasibleDesignError says why there is none."""
        system, k, g = plant.system, plant.system.k, plant.system.g
        if not reaches(system.A, system.B1, system.C0):
            detail = "no noise in B1 drives C0 x, so that the error of the estimate zero vanishes"
            raise InfeasibleDesignError("A process noise", detail)
        _, gain = kalman_gain(system)
        rate = np.abs(np.linalg.eigvals(system.A - gain @ system.C2)).max()
        found = modes(system.A, natural_units(system.A, system.B1), _SLOW * rate)
        rest = _unseen(found, system, rate)
        V, W = found.V @ rest, rest.T @ found.W
        gain, taken_off = np.zeros((system.n, system.l)), plant.taken_off
        if V.size:
            noise = np.hstack([W @ system.B1, np.zeros((V.shape[1], system.q))])
            more = np.hstack([system.D21, _MORE * system.D21])
            parts = W @ system.A @ V, noise, system.C0 @ V, system.C2 @ V, more
            gain = V @ kalman_gain(UncertainSystem(*parts))[1]
            B, _, D = system.stacked(system.nonlinearities)
            taken_off = np.vstack([V @ W @ B - gain @ D, D])
        kept = np.ones(k + 3 * g, dtype=bool)
        for i, channel in enumerate(system.nonlinearities, start=k):
            kept[[i + g, i + 2 * g]] = not found._replace(V=V).seen_by(channel.C).any()
        left = {
            kind: [replace(c, B=c.B - gain @ c.D) for c in getattr(system, kind)]
            for kind in ("uncertainties", "nonlinearities")
        }
        A, B1 = system.A - gain @ system.C2, system.B1 - gain @ system.D21
        system = replace(system, A=A, B1=B1, **left)
        return cls(replace(plant, system=system, taken_off=taken_off), V, W, gain, kept)

    def restored(self, plant: AugmentedSystem, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of the plant's estimator, from those of one of the rest.

        Its first n states still estimate the plant's. The last are the observer's.
        """
        if not self.V.size:
            return fields
        m, l, delays = plant.system.m, plant.system.l, plant.n - plant.system.n  # noqa: E741
        basis = block_diag(self.V, np.eye(delays))
        gain = np.vstack([self.W @ self.gain, np.zeros((delays, l))])
        A_c, (B_y, B_mu) = fields["A_c"], np.hsplit(fields["B_c"], [l])
        B, D = plant.known
        into = block_diag(self.W, np.eye(delays))
        copies = into @ B - gain @ D
        own, measured = len(A_c), plant.C2_tilde[:l] @ basis
        observer = into @ plant.A_p @ basis - gain @ measured
        w = plant.C_p0 if np.array_equal(fields["C_c"][:m], fields["C_f"]) else plant.C_a
        arguments = plant.C1_tilde[-2 * plant.system.g :][: plant.system.g]
        reads = {"C_c": np.vstack([w, arguments]), "C_a": plant.C_a, "C_f": plant.C_p0}
        whole = Estimator(
            plant=plant,
            A_c=np.block([[A_c, -B_y @ measured], [np.zeros((len(gain), own)), observer]]),
            B_c=np.block([[B_y, B_mu - B_y @ D], [gain, copies]]),
            **{name: np.hstack([fields[name], rows @ basis]) for name, rows in reads.items()},
        )
        to = np.eye(own + len(gain))
        to[: plant.n, own:] = basis
        whole = whole.in_coordinates(to, 2.0 * np.eye(len(to)) - to)
        return {name: getattr(whole, name) for name in fields}


def _unseen(found: Modes, system: UncertainSystem, rate: float) -> Matrix:
    """Return the combinations of the modes that no uncertainty sees; the others must decay."""
    rest = np.eye(len(found.A))
    for s, channel in enumerate(system.uncertainties):
        rows = channel.C @ found.V / (np.linalg.norm(channel.C * found.units) or 1.0)
        size = np.linalg.norm(found.A, 2) or 1.0
        powers = (np.linalg.matrix_power(found.A / size, i) for i in range(max(len(found.A), 1)))
        seen = np.vstack([rows @ power for power in powers])
        unseen = null_space(np.where(np.abs(seen) > _UNSEEN, seen, 0.0))
        sees = null_space(unseen.T)
        drift = sees.T @ found.A @ sees
        if drift.size and np.linalg.eigvals(drift).real.max() >= -_STANDING * rate:
            detail = drifting_output(f"uncertainties[{s}]", drift)
            raise InfeasibleDesignError("A bounded uncertainty", detail)
        rest = rest @ null_space((np.eye(len(rest)) - unseen @ unseen.T) @ rest)
    return rest
