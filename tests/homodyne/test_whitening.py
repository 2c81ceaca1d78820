"""The loop in white coordinates: its rows and its drift have the loop's own moments."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robsmooth.homodyne import PAPER
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.moments import whitened
from tests.helpers.printed import printed_estimator


@pytest.mark.parametrize("shot_noise", [0.1, 1.0])
def test_rows_have_the_variances_of_the_linear_loop(shot_noise):
    loop = homodyne_loop(PAPER, printed_estimator(), shot_noise=shot_noise)
    white = whitened(loop)
    P = loop.covariance(*loop.equivalent_slopes())
    for row, reader in (
        (white.phase, [1.0, *np.zeros(len(loop.drift) - 1)]),
        (white.filtered, [1.0, *-loop.readout[0]]),
        (white.smoothed, [1.0, *-loop.readout[1]]),
    ):
        assert row @ row == pytest.approx(reader @ P @ np.array(reader), rel=1e-9)
    assert white.rounding < 1e-10


def test_drift_keeps_the_covariance_i_and_the_rates_of_the_loop():
    loop = homodyne_loop(PAPER, printed_estimator())
    white = whitened(loop)
    loss = np.linalg.eigvalsh(white.drift + white.drift.T)  # minus the noise, of two sources
    assert loss[:2].max() < -1e-4
    assert_allclose(loss[2:], 0.0, atol=1e-9)
    drift = loop.linearised_drift(*loop.equivalent_slopes())
    scale = white.delay / loop.delay
    assert_allclose(
        np.sort_complex(scale * np.linalg.eigvals(white.drift)),
        np.sort_complex(np.linalg.eigvals(drift)),
        rtol=1e-8,
    )
