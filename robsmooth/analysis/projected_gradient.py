"""Projected gradient search over the admissible uncertainties, from many starts at once.

An uncertainty is admissible here where its blocks have norm at most one, relative to their gain.
The projection onto these cuts singular values at one.
"""

from collections.abc import Callable

import numpy as np

from robsmooth.estimators.loop import OpenLoop

Evaluation = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

_ITERATIONS = 200
_LONGEST_STEP, _SHORTEST_STEP = 1e3, 1e-9  # relative to the unit ball
_CHANGE = 1e-13  # a step whose gain or loss is less, relatively, changes nothing
_STEPS_WITHOUT_GAIN = 3  # in a row: then the search is over


def initial_deltas(loop: OpenLoop, count: int, seed: int, kind: type) -> np.ndarray:
    """Return Delta zero, then random corners and their negatives, at least `count` of these."""
    rng = np.random.default_rng(seed)
    half = (count + 1) // 2
    blocks = []
    for block in loop.blocks:
        drawn = rng.standard_normal((half, *block.shape))
        if kind is complex:
            drawn = drawn + 1j * rng.standard_normal(drawn.shape)
        U, _, V = np.linalg.svd(drawn, full_matrices=False)
        corner = U @ V
        blocks.append(np.concatenate([np.zeros_like(corner[:1]), corner, -corner]))
    return loop.assemble(blocks, (1 + 2 * half,)).astype(kind)


def projected_gradient(
    loop: OpenLoop, Delta: np.ndarray, evaluate: Evaluation
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a projected gradient search reaches from each of the given Delta, and where.

    `evaluate` returns values, and gradients with respect to Delta, of those Delta whose indices it
    is given too. A value that is infinite ends the search.
    """
    index = np.arange(len(Delta))
    values, gradients = evaluate(Delta, index)
    Delta, steps, without_gain = Delta.copy(), np.ones(len(Delta)), np.zeros(len(Delta), int)
    for _ in range(_ITERATIONS):
        live = index[(without_gain < _STEPS_WITHOUT_GAIN) & (steps > _SHORTEST_STEP)]
        if not live.size or np.isinf(values).any():
            break
        trial = _projected_step(loop, Delta[live], gradients[live], steps[live])
        found, slopes = evaluate(trial, live)
        gained = found - values[live] > _CHANGE * values[live]
        better = found - values[live] >= -_CHANGE * values[live]
        without_gain[live] = np.where(better & ~gained, without_gain[live] + 1, 0)
        steps[live] = np.where(better, np.minimum(3 * steps[live], _LONGEST_STEP), steps[live] / 4)
        moved = live[better]
        Delta[moved], values[moved] = trial[better], found[better]
        gradients[moved] = slopes[better]
    return values, Delta


def _projected_step(
    loop: OpenLoop, Delta: np.ndarray, gradients: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """Step along the gradient, each block by itself, and cut singular values at one."""
    blocks = []
    for value, gradient in zip(loop.disassemble(Delta), loop.in_blocks(gradients), strict=True):
        size = np.linalg.norm(gradient, axis=(-2, -1), keepdims=True)
        size[size == 0.0] = 1.0
        beyond = value + steps[:, None, None] * gradient / size
        U, scales, V = np.linalg.svd(beyond, full_matrices=False)
        blocks.append(U * np.minimum(scales, 1.0)[:, None, :] @ V)
    return loop.assemble(blocks, (len(Delta),))
