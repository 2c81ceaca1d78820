"""The flat arrays of the kernels: each part of a step lies where its index says."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import layout
from robsmooth.homodyne.montecarlo.noise import BLOCK
from robsmooth.homodyne.montecarlo.schemes import euler_coefficients, splitting_coefficients
from tests.helpers.loops import PARAMETERS, kalman_filter, printed_smoother

each_order = pytest.mark.parametrize(
    "estimator", [kalman_filter(), printed_smoother()], ids=["1", "3"]
)


@each_order
def test_coefficients_lie_where_their_indices_say(estimator):
    loop = homodyne_loop(PARAMETERS, estimator)
    n, m = loop.order, layout.draws_of_splitting(loop.order)
    splitting = splitting_coefficients(loop, 1e-7, (0.9, 0.8))
    assert splitting.root.shape == (1 + n, m)
    for coefficients, indices in (
        (euler_coefficients(loop, 1e-7), layout.euler_indices(n)),
        (splitting, layout.splitting_indices(n, m)),
    ):
        flat = layout.flat(coefficients, np.float64)
        for part, index in zip(coefficients, indices, strict=True):
            assert_array_equal(flat[index : index + np.size(part)], np.ravel(part))
        assert index + np.size(part) == flat.size


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_rows_of_a_state_follow_each_other_and_a_block_wide(n):
    rows = layout.splitting_rows(n)
    counts = {"control": n, "difference": n}
    widths = [BLOCK * counts.get(name, 1) for name in rows._fields[:-1]]
    assert_array_equal(np.diff(rows), widths)
    assert rows.phase == 0
