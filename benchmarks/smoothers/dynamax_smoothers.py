"""dynamax: its Kalman filter with a delay line, and its smoother, compiled by JAX, in float64.

It adds 1e-9 to the diagonal of a matrix before it solves with it.
"""

import numpy as np

from benchmarks.problem import Unavailable
from benchmarks.smoothers.problem import FIXED_LAG, WHOLE, Run, Sampled, Smoother


def compiled(model: Sampled, inference: str, means: str) -> Run:
    """Return a function of its module for this model; another length of record compiles anew."""
    try:
        import jax
        from dynamax import linear_gaussian_ssm as dynamax
    except ImportError:
        raise Unavailable("dynamax is not installed") from None
    jax.config.update("jax_enable_x64", True)
    n, array = len(model.F), jax.numpy.asarray
    nothing = array(np.zeros((n, 0))), array(np.zeros((1, 0)))  # of inputs
    parameters = dynamax.ParamsLGSSM(
        dynamax.ParamsLGSSMInitial(array(np.zeros(n)), array(model.stationary)),
        dynamax.ParamsLGSSMDynamics(array(model.F), array(np.zeros(n)), nothing[0], array(model.Q)),
        dynamax.ParamsLGSSMEmissions(
            array(model.h), array(np.zeros(1)), nothing[1], array(model.R)
        ),
    )

    @jax.jit
    def estimates(y):
        return getattr(getattr(dynamax, inference)(parameters, y), means) @ model.c[0]

    return lambda y: np.asarray(estimates(y))


def with_delay_line(model: Sampled) -> Run:
    """Return the filter of the system with a delay line."""
    return compiled(model.with_delay_line(), "lgssm_filter", "filtered_means")


def whole_record(model: Sampled) -> Run:
    """Return the filter and the backward pass over the whole record."""
    return compiled(model, "lgssm_smoother", "smoothed_means")


SMOOTHERS = (
    Smoother("dynamax, lgssm_filter, delay line", FIXED_LAG, with_delay_line),
    Smoother("dynamax, lgssm_smoother", WHOLE, whole_record),
)
