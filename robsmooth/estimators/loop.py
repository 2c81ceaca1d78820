r"""The loop of plant and estimator without its uncertainty.

.. math::

    dX = [\mathbf A X + B_\xi\tilde\xi]\,dt + \mathbf B\,dW, \qquad \tilde\zeta = C_\zeta X,
    \qquad e(t) = C_w X(t - \delta) - C_s X(t),

with :math:`X = [x_p; \hat x]` as in (eqclosed): :math:`\tilde\xi = \Delta\tilde\zeta` closes it. A
detector may subtract a *reference* `r`, read out of the estimator's state, from the arguments of
nonlinearities and copies (`robsmooth.Nonlinearity`): :math:`\tilde\zeta = C_\zeta X - r`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, expm

from robsmooth._numerics.lyapunov import covariances, deviations, noise_root
from robsmooth._numerics.modes import is_stable, natural_units, rates, separations
from robsmooth._support import validation
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem, padded
from robsmooth.systems.channels import REFERENCES
from robsmooth.systems.system import UncertainSystem

OUTPUTS = ("smoothed", "filtered", "guaranteed")
LOOPS = ("theory", "real")  # the design's fictitious noise drives the copies, or none
Reference = str | ArrayLike | None
_COMBINATION_TOLERANCE = 1e-9  # of a row that is a combination of others, relative


@dataclass(frozen=True)
class Block:
    """A block of Delta, times `gain`; a nonlinearity and its copy have the same in two places."""

    places: tuple[tuple[slice, slice], ...]  # rows and columns in Delta
    gain: float  # the Lipschitz constant of a nonlinearity, 1 for an uncertainty
    shape: tuple[int, int]  # the block's rows and columns


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """The loop without its uncertainty, by the equations of the module."""

    A: Matrix  # (N, N) drift with Delta = 0, 1/s
    B: Matrix  # (N, q + g) noise intensity
    inputs: Matrix  # (N, r + 2g) where xi-tilde enters
    outputs: Matrix  # (h + 2g, N) zeta-tilde
    truth: Matrix  # (m, N) C_w: the error is truth X(t - delay) - estimate X(t)
    estimate: Matrix  # (m, N) C_s
    delay: float  # s
    blocks: tuple[Block, ...]  # those of Delta that have an effect

    def assemble(self, blocks: Sequence[Matrix]) -> Matrix:
        """Return Delta, (r + 2g, h + 2g), from its blocks."""
        Delta = np.zeros((self.inputs.shape[1], len(self.outputs)))
        for block, value in zip(self.blocks, blocks, strict=True):
            for rows, columns in block.places:
                Delta[rows, columns] = block.gain * value
        return Delta


def which_loop(loop: str, copy_noise: bool | None = None) -> str:
    """Return "theory" for True, "real" for False, in `copy_noise` or in its place; or the loop."""
    if copy_noise is not None:
        loop = validation.boolean("copy_noise", copy_noise)
    if isinstance(loop, bool | np.bool_):
        return "theory" if loop else "real"
    return validation.choice("loop", loop, LOOPS)


def matrices(
    estimator: Estimator, loop: str, reference: Reference = None
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, inputs and outputs of `OpenLoop`, with a reference subtracted."""
    validation.choice("loop", loop, LOOPS)
    plant, gain = estimator.plant, estimator.B_c
    noise = plant.D21_bar if loop == "theory" else padded(plant.system.D21, *plant.D21_bar.shape)
    none = np.zeros((plant.n, len(estimator.A_c)))
    copies = plant.D12_tilde @ estimator.C_c - reference_outputs(estimator, reference)
    return (
        np.block([[plant.A_p, none], [gain @ plant.C2_tilde, estimator.A_c]]),
        np.vstack([plant.B_p1, gain @ noise]),
        np.vstack([plant.B1_tilde, gain @ plant.D21_tilde]),
        np.hstack([plant.C1_tilde, copies]),
    )


def reference_outputs(estimator: Estimator, reference: Reference) -> Matrix:
    """Return the rows that read the reference out of the estimator's state, (h + 2g, n_c).

    Each nonlinearity has its own ("system"), an estimate of its argument ("filtered", "smoothed"),
    a row of a (g, n_c) matrix, or zero (None). A copy that runs has the same.
    """
    system = estimator.plant.system
    rows = np.zeros((system.g, len(estimator.A_c)))
    if isinstance(reference, str):
        validation.choice("reference", reference, ("system", *REFERENCES))
        read_outs = {"filtered": estimator.C_f, "smoothed": estimator.C_a}
        for i, nonlinearity in enumerate(system.nonlinearities):
            name = nonlinearity.reference if reference == "system" else reference
            if name is not None:
                rows[i] = _argument_weights(system, i) @ read_outs[name]
    elif reference is not None:
        rows = validation.matrix("reference", reference, rows.shape)
    none = np.zeros((len(estimator.plant.C1_tilde) - 2 * system.g, rows.shape[1]))
    return np.vstack([none, rows, rows * estimator.B_c[:, system.l :].any(axis=0)[:, None]])


def _argument_weights(system: UncertainSystem, index: int) -> Matrix:
    """Return the (m,) weights of w in the argument of a nonlinearity, in any units of x and w."""
    C, target = system.C0, system.nonlinearities[index].C[0]
    states = np.maximum(np.abs(C).max(axis=0), np.abs(target))
    states[states == 0.0] = 1.0
    outputs = np.linalg.norm(C / states, axis=1)
    outputs[outputs == 0.0] = 1.0
    scaled, target = C / states / outputs[:, None], target / states
    weights = np.linalg.lstsq(scaled.T, target, rcond=None)[0]
    if np.abs(weights @ scaled - target).max() > _COMBINATION_TOLERANCE * np.abs(target).max():
        raise ValueError(
            "reference must be None or a (g, n_c) matrix, which reads it out of the estimator's "
            f"state: there is no estimate of the argument of nonlinearities[{index}], whose C is "
            "no combination of the rows of C0"
        )
    return weights / outputs


def error_rows(smoother: Estimator, output: str) -> tuple[Matrix, Matrix, float]:
    """Return truth, estimate and delay of `OpenLoop`, for an error."""
    validation.choice("output", output, OUTPUTS)
    plant = smoother.plant
    truth, estimate, delay = plant.C_p0, smoother.C_a, plant.delay
    if output != "smoothed":
        estimate, delay = smoother.C_f, 0.0
    if output == "guaranteed":
        if smoother.cost is None:
            got = f"{type(smoother).__name__}; 'smoothed' and 'filtered' are for any estimator"
            rule = "a RobustSmoother or MinimaxSmoother"
            raise ValueError(f"output 'guaranteed' is for {rule}, got {got}")
        truth = plant.C_p0 if smoother.cost == "filtered" else plant.C_a
        estimate = smoother.C_c[: plant.system.m]
    return *np.vsplit(block_diag(truth, estimate), 2), delay


def open_loop(smoother: Estimator, output: str, loop: str) -> OpenLoop:
    """Return the loop without its uncertainty, for the arguments of `error_covariance`."""
    validation.instance("smoother", smoother, Estimator)
    truth, estimate, delay = error_rows(smoother, output)
    A, B, inputs, outputs = matrices(smoother, loop)
    blocks = tuple(
        block
        for block in blocks_of(smoother.plant)
        if any(inputs[:, rows].any() and outputs[columns].any() for rows, columns in block.places)
    )
    return OpenLoop(A, B, inputs, outputs, truth, estimate, delay, blocks)


def scaled(loop: OpenLoop) -> tuple[OpenLoop, Matrix]:
    """Return a loop in natural units, with the same errors and Delta, and the units of X."""
    poles = np.linalg.eigvals(loop.A)
    time = 1.0 / (np.abs(poles).max(initial=0.0) or 1.0)
    if is_stable(poles):
        x = deviations(covariances(loop.A, loop.B).stationary)
    else:
        x = natural_units(loop.A, loop.B)
    new = {"A": time * loop.A / x[:, None] * x, "B": np.sqrt(time) * loop.B / x[:, None]}
    new |= {"inputs": time * loop.inputs / x[:, None], "delay": loop.delay / time}
    new |= {name: getattr(loop, name) * x for name in ("outputs", "truth", "estimate")}
    return replace(loop, **new), x


@np.errstate(over="ignore", invalid="ignore")  # of an unstable loop
def drifting_error(
    A: Matrix, B: Matrix, truth: Matrix, estimate: Matrix, delay: float
) -> tuple[Matrix, Matrix]:
    """Return the covariance of truth X(t - delay) - estimate X(t), and its estimated rounding.

    The loop has modes that hardly decay. An UnstableLoopError says that the error shows them.
    """
    for found in separations(A, B):
        V, W = np.hstack([found.V, found.V_rest]), np.vstack([found.W, found.W_rest])
        drift, rest = block_diag(found.A, found.A_rest), slice(len(found.A), None)
        past, since = (truth - estimate) @ V, np.zeros((len(truth), 0))
        if delay > 0.0:
            past = truth @ V - estimate @ V @ expm(delay * drift)
            since = estimate @ V @ noise_root(drift, W @ B, delay)
        unseen = not found.seen_by(truth, truth - past @ W).any()
        if unseen or is_stable(np.linalg.eigvals(A)):
            left = rest if unseen else slice(None)
            found = covariances(drift[left, left], (W @ B)[left])
            past = past[:, left]
            return past @ found.stationary @ past.T + since @ since.T, past @ found.error @ past.T
    why = f"the loop is not stable, it has an eigenvalue with real part {-rates(A)[0]:.4g} 1/s"
    raise UnstableLoopError(f"the error has no stationary covariance: {why}")


def drifting_output(name: str, A: Matrix) -> str:
    """Return the message about a channel whose output shows modes dz = A z dt without decay."""
    rate = np.linalg.eigvals(A).real.max()
    return (
        f"the output C x of {name} grows without bound, because it holds a mode with an "
        f"eigenvalue of real part {rate:.4g} 1/s, so that the uncertainty has no limit either; "
        "give the mode a decay, or the channel an output of stable states"
    )


def blocks_of(plant: AugmentedSystem) -> list[Block]:
    """Return the blocks of Delta: the k uncertainties, then the g nonlinearities."""
    shapes = list(zip(plant.input_sizes, plant.output_sizes, strict=True))
    ends = zip(shapes, np.cumsum(shapes, axis=0), strict=True)
    places = [(slice(i - r, i), slice(j - h, j)) for (r, h), (i, j) in ends]
    k, g = plant.system.k, plant.system.g
    blocks = [Block((places[s],), 1.0, shapes[s]) for s in range(k)]
    for i, channel in enumerate(plant.system.nonlinearities, start=k):
        blocks.append(Block((places[i], places[i + g]), channel.lipschitz, (1, 1)))
    return blocks
