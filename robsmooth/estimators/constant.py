"""The mean square error under a constant uncertainty, its slopes, and its maximum.

An uncertainty has a block of norm at most one. A nonlinearity and its copy have the same slope,
within the Lipschitz constant. A projected gradient search from several starts finds the worst.
"""

import math
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from scipy.linalg import expm

from robsmooth._numerics.modes import hardly_decays, is_stable
from robsmooth._numerics.schur import SchurForm
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.descent import Slopes
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, drifting_error, open_loop, scaled

_ITERATIONS = 200
_LONGEST_STEP, _SHORTEST_STEP = 1e3, 1e-9  # relative to the unit ball
_ROUGH = 1e-5  # of the error, relative: three steps that gain less end the search from a start
_FINE = 1e-13  # the same from the best end: less is rounding
_DIFFERENCE = 1e-6
_STEEP = 1e100  # stands for an infinite slope
_STEPS_WITHOUT_GAIN = 3  # in a row: then the search ends


def mean_square(loop: OpenLoop, Delta: Matrix) -> float:
    """Return the mean square error, or infinity where it has no limit."""
    A = loop.A + loop.inputs @ Delta @ loop.outputs
    form = SchurForm(A)
    if hardly_decays(form.poles):
        with suppress(UnstableLoopError):
            error, _ = drifting_error(A, loop.B, loop.truth, loop.estimate, loop.delay)
            return float(np.trace(error))
        if not is_stable(form.poles):
            return math.inf
    return _error(loop, form.lyapunov(loop.B @ loop.B.T), expm(loop.delay * A))


def slopes(loop: OpenLoop, Delta: Matrix) -> tuple[float, Slopes]:
    """Return the error and its slopes, or raise an ArithmeticError for an unstable loop."""
    A = loop.A + loop.inputs @ Delta @ loop.outputs
    form = SchurForm(A)
    if not is_stable(form.poles):
        raise ArithmeticError("the loop is not stable")
    P = form.lyapunov(loop.B @ loop.B.T)
    truth, estimate, delay, N = loop.truth, loop.estimate, loop.delay, len(A)
    # the exponential of this matrix has the derivative of that of A' in its corner
    both = np.block([[A.T, estimate.T @ truth @ P], [np.zeros_like(A), A.T]])
    both = expm(delay * both)
    through, derivative = both[:N, :N].T, both[:N, N:]
    mixed = truth.T @ estimate @ through
    weight = truth.T @ truth + estimate.T @ estimate - mixed - mixed.T
    S = form.lyapunov(weight, transposed=True)
    drift = 2.0 * (S @ P - derivative)
    return _error(loop, P, through), Slopes(
        A=drift,
        B=2.0 * S @ loop.B,
        inputs=drift @ (Delta @ loop.outputs).T,
        outputs=(loop.inputs @ Delta).T @ drift,
        estimate=2.0 * (estimate @ P - truth @ P @ through.T),
    )


def worst_delta(loop: OpenLoop, starts: int) -> tuple[float, Matrix]:
    """Return the largest error of a rough search from each start and a fine one, and its Delta."""
    largest, worst = -math.inf, None
    for start in _starts(loop, starts):
        value, blocks = _ascent(loop, start, _ROUGH)
        if value > largest:
            largest, worst = value, blocks
        if math.isinf(value):
            break
    largest, worst = _ascent(loop, worst, _FINE)
    return largest, loop.assemble(worst)


def worst_constant(estimator: Estimator, output: str, starts: int) -> tuple[float, Matrix]:
    """Return `worst_delta` of an estimator in the real loop."""
    return worst_delta(scaled(open_loop(estimator, output, "real"))[0], starts)


def cut_at_one(block: Matrix) -> Matrix:
    """Return the nearest block of norm at most one, with its singular values cut."""
    U, scales, V = np.linalg.svd(block, full_matrices=False)
    return U * np.minimum(scales, 1.0) @ V


def _error(loop: OpenLoop, P: Matrix, through: Matrix) -> float:
    """Return the error for the covariance of X and X's transition over the delay."""
    cross = np.trace(loop.estimate @ through @ P @ loop.truth.T)
    squares = (np.trace(rows @ P @ rows.T) for rows in (loop.truth, loop.estimate))
    return float(sum(squares) - 2.0 * cross)


def _starts(loop: OpenLoop, count: int) -> Iterator[list[Matrix]]:
    """Yield zero, then up to `count` random corners with their negatives, fewer of few entries."""
    rng = np.random.default_rng(0)
    yield [np.zeros(block.shape) for block in loop.blocks]
    entries = sum(block.shape[0] * block.shape[1] for block in loop.blocks)
    for _ in range((min(count, 2**entries) + 1) // 2):
        drawn = [np.linalg.svd(rng.standard_normal(b.shape), False) for b in loop.blocks]
        corner = [U @ V for U, _, V in drawn]
        yield corner
        yield [-block for block in corner]


def _slopes_in_blocks(loop: OpenLoop, blocks: list[Matrix]) -> list[Matrix]:
    """Return the gradients of the error with respect to the blocks; of a drift by differences."""
    Delta = loop.assemble(blocks)
    if not hardly_decays(np.linalg.eigvals(loop.A + loop.inputs @ Delta @ loop.outputs)):
        whole = loop.inputs.T @ slopes(loop, Delta)[1].A @ loop.outputs.T
        return [block.gain * sum(whole[place] for place in block.places) for block in loop.blocks]
    result = [np.zeros(block.shape) for block in blocks]
    for block, gradient in zip(blocks, result, strict=True):
        for entry in np.ndindex(block.shape):
            middle, ends = block[entry], []
            for change in (_DIFFERENCE, -_DIFFERENCE):
                block[entry] = middle + change
                ends.append(mean_square(loop, loop.assemble(blocks)))
            block[entry] = middle
            slope = (ends[0] - ends[1]) / (2.0 * _DIFFERENCE)
            gradient[entry] = np.nan_to_num(slope, posinf=_STEEP, neginf=-_STEEP)
    return result


def _ascent(loop: OpenLoop, blocks: list[Matrix], least: float) -> tuple[float, list[Matrix]]:
    """Return the error that a projected gradient search reaches, and its blocks."""
    value, step, without_gain = mean_square(loop, loop.assemble(blocks)), 1.0, 0
    moved = True
    for _ in range(_ITERATIONS if blocks else 0):
        if math.isinf(value) or step < _SHORTEST_STEP or without_gain == _STEPS_WITHOUT_GAIN:
            break
        if moved:
            gradients = _slopes_in_blocks(loop, blocks)
        trial = [
            cut_at_one(block + step * gradient / (np.linalg.norm(gradient) or 1.0))
            for block, gradient in zip(blocks, gradients, strict=True)
        ]
        found = mean_square(loop, loop.assemble(trial))
        moved = found >= (1.0 - _FINE) * value
        if not moved:
            step /= 4.0
            continue
        without_gain = 0 if found > (1.0 + least) * value else without_gain + 1
        value, blocks, step = found, trial, min(3.0 * step, _LONGEST_STEP)
    return value, blocks
