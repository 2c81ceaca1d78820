"""Loops and estimators for the tests of the simulation, and how their numbers are compared.

Seeds are fixed, so these tests cannot fail by chance. Had the seeds been free, a correct program
would fail a comparison at `SIGMAS` = 4.5 standard errors once in 150 000 times.
"""

import json
from contextlib import contextmanager
from dataclasses import replace

import numba
import numpy as np
from scipy.linalg import solve_continuous_are

from robsmooth import Estimator, UncertainSystem, Uncertainty, augment
from robsmooth.homodyne import PAPER
from robsmooth.simulation import noise
from robsmooth.simulation.noise import BLOCK

SIGMAS = 4.5


@contextmanager
def threads_of_kernels(count):
    """Have kernels use so many threads; None changes nothing."""
    before = numba.get_num_threads()
    numba.set_num_threads(count or before)
    try:
        yield
    finally:
        numba.set_num_threads(before)


PARAMETERS = PAPER
QUIET = 1e-4  # noise power at which the loop is linear: sin e differs from e by a relative 1e-6


def quiet(parameters):
    return with_parameters(kappa=QUIET * parameters.kappa)


def with_parameters(**values):
    return replace(PARAMETERS, **values)


def for_the_loop(delay, A_c, B_c, C_c, C_a):
    """An estimator of the phase, of any order, with a copy or without."""
    system = PARAMETERS.uncertain_system()
    if len(C_c) == 1:
        system = replace(system, nonlinearities=())
    matrices = {"A_c": A_c, "B_c": B_c, "C_c": C_c, "C_a": C_a, "C_f": C_c[:1].copy()}
    return Estimator(plant=augment(system, delay, order=0), **matrices)


def printed_smoother(delay=3.1e-6):
    """The estimator printed in Section IV-B, in the paper's coordinates of the delay model."""
    return for_the_loop(
        delay,
        A_c=np.array(
            [[-4.58e5, -0.09, -7.14], [1.93e3, -1.93e6, -1.19e6], [-550.1, 1.0486e6, -0.01]]
        ),
        B_c=np.array([[4.45e5, -190.97], [120.98, -0.052], [545.41, -0.233]]),
        C_c=np.array([[1.02, 4.21e-7, 3.23e-5], [944.68, 3.9e-4, 0.0299]]),
        C_a=np.array([[1.0, -(12 / 3.1e-6) / 2048, 0.0]]),
    )


def kalman_filter(parameters=PARAMETERS, delay=0.0):
    """The Kalman filter of the linearised loop: one state, no copy of the nonlinearity."""
    intensity = (2 * parameters.alpha * parameters.beta) ** -2
    P = solve_continuous_are([[-parameters.lam]], [[1.0]], [[parameters.kappa]], [[intensity]])
    gain = P / intensity
    return for_the_loop(delay, -parameters.lam - gain, gain, np.ones((1, 1)), np.ones((1, 1)))


def gaussians(seed, first_path, steps):
    """The noise of BLOCK paths: (steps, 2, BLOCK)."""
    generator = np.empty(noise.WORDS * BLOCK, np.uint32)
    noise.seed_paths(np.uint64(seed), np.uint64(first_path), generator)
    draws = np.empty(steps * noise.DRAWS * BLOCK, np.float32)
    noise.fill_gaussians(generator, steps, draws)
    return draws.reshape(steps, noise.DRAWS, BLOCK)


def blocks_of(simulation):
    """The number of blocks that its paths take."""
    return -(-simulation.runs // BLOCK)


def same_numbers(result):
    """All of a result that must not change, to the last bit, as a text."""
    numbers = result.to_dict()
    del numbers["wall_time"]
    return json.dumps(numbers, sort_keys=True)


def assert_within(values, expected, standard_error):
    assert np.all(np.abs(np.asarray(values) - expected) <= SIGMAS * standard_error), (
        values,
        expected,
        standard_error,
    )


def two_channels(state=0.0, measurement=0.0, C2=1.0, **more):
    """dx = (-x + xi_1) dt + dW_1, dy = (C2 x + xi_2) dt + dW_2, without nonlinearities of its own.

    The first uncertainty is at most state |x|, the second measurement |x|.
    """
    return UncertainSystem(
        A=[[-1.0]],
        B1=[[1.0, 0.0]],
        C0=[[1.0]],
        C2=[[C2]],
        D21=[[0.0, 1.0]],
        uncertainties=[
            Uncertainty(B=[[1.0]], C=[[state]], D=[[0.0]]),
            Uncertainty(B=[[0.0]], C=[[measurement]], D=[[1.0]]),
        ],
        **more,
    )


def looking_at_nothing(uncertainty):
    """dx = (-x + xi) dt + dW, |xi| <= uncertainty |x|, and an estimate of zero."""
    zeros = {name: np.zeros((1, 1)) for name in ("B_c", "C_c", "C_a", "C_f")}
    plant = augment(two_channels(uncertainty), 0.0, 0)
    return Estimator(plant=plant, A_c=np.array([[-1.0]]), **zeros)
