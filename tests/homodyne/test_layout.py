"""The flat arrays of the kernels: each part of a step lies where its index says."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import euler, splitting
from tests.helpers.loops import PARAMETERS, kalman_filter, printed_smoother

each_order = pytest.mark.parametrize(
    "estimator", [kalman_filter(), printed_smoother()], ids=["1", "3"]
)


@each_order
def test_coefficients_lie_where_their_indices_say(estimator):
    loop = homodyne_loop(PARAMETERS, estimator)
    of_splitting = splitting.coefficients_of(loop, 1e-7, (0.9, 0.8))
    n = len(loop.drift) - 1
    m = of_splitting.control.shape[1] - 1 - n
    assert m in (1 + n, 2 + n) and m % 2 == 0
    for coefficients, indices in (
        (euler.coefficients_of(loop, 1e-7), euler.indices(n)),
        (of_splitting, splitting.indices(n, m)),
    ):
        flat = np.concatenate([np.ravel(part) for part in coefficients])
        for part, index in zip(coefficients, indices, strict=True):
            assert_array_equal(flat[index : index + np.size(part)], np.ravel(part))
        assert index + np.size(part) == flat.size
