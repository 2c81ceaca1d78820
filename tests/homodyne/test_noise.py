"""The noise of the Monte Carlo, against its definition and against the normal distribution."""

import math

import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, norm

from robsmooth._numerics.vectors import LANES, load, store
from robsmooth.simulation import noise
from robsmooth.simulation.noise import BLOCK
from tests.helpers.loops import SIGMAS, assert_within, gaussians


@pytest.fixture(scope="module")
def draws():
    """Noise of BLOCK paths, 5 million numbers: (steps, 2, paths)."""
    return gaussians(7, 0, 20_000).astype(float)


def splitmix64(z):
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return z ^ (z >> 31)


def test_noise_is_box_muller_of_xoshiro128_plus():
    golden, seed, steps = 0x9E3779B97F4A7C15, 2**64 - 3, 50
    draws = gaussians(seed, 1000, steps)
    for path in (0, 1, 31):
        z = splitmix64((splitmix64((seed + golden) % 2**64) + (1000 + path) * golden) % 2**64)
        words = [splitmix64((z + k * golden) % 2**64) for k in (1, 2)]
        s = [part for word in words for part in (word >> 32, word % 2**32)]
        for step in range(steps):
            outputs = []
            for _ in range(2):
                outputs.append((s[0] + s[3]) % 2**32)
                t = (s[1] << 9) % 2**32
                s[2] ^= s[0]
                s[3] ^= s[1]
                s[1] ^= s[2]
                s[0] ^= s[3]
                s[2] ^= t
                s[3] = (s[3] << 11) % 2**32 | s[3] >> 21
            a, b = outputs
            radius = math.sqrt(-2 * math.log(((a >> 1) + 0.5) / 2**31))
            signed = (b << 1) % 2**32
            angle = (signed - 2**32 if signed >= 2**31 else signed) * math.pi / 2**32
            sign = -1 if b >> 31 else 1
            expected = [sign * radius * math.cos(angle), radius * math.sin(angle)]
            assert_allclose(draws[step, :, path], expected, atol=2e-6)


def test_gaussians_have_the_moments_of_a_normal_distribution(draws):
    for values in (draws[:, 0], draws[:, 1]):
        n = values.size
        assert_within(values.mean(), 0, math.sqrt(1 / n))
        assert_within((values**2).mean(), 1, math.sqrt(2 / n))
        assert_within((values**3).mean(), 0, math.sqrt(15 / n))
        assert_within((values**4).mean(), 3, math.sqrt(96 / n))


def test_gaussians_fill_bins_of_equal_probability_equally(draws):
    bins = 1000
    for values in (draws[:, 0], draws[:, 1]):
        counts = np.histogram(norm.cdf(values), bins, (0, 1))[0]
        statistic = ((counts - values.size / bins) ** 2).sum() / (values.size / bins)
        assert statistic < chi2.isf(2 * norm.sf(SIGMAS), bins - 1)


@pytest.mark.parametrize("threshold", [2, 3, 4, 5])
def test_gaussians_have_the_tails_of_a_normal_distribution(draws, threshold):
    probability = norm.sf(threshold)
    for side in (draws > threshold, draws < -threshold):
        expected = draws.size * probability
        assert_within(side.sum(), expected, math.sqrt(expected * (1 - probability)))


@pytest.mark.parametrize("power", [1, 2])
def test_gaussians_are_uncorrelated_across_draws_steps_and_paths(draws, power):
    values = draws if power == 1 else (draws**2 - 1) / math.sqrt(2)  # squares show dependence too
    steps, _, paths = values.shape
    correlations = [(values[:, 0] * values[:, 1]).mean()]
    for lag in (1, 2, 3, 10, 64):
        correlations += [
            (values[lag:, a] * values[:-lag, b]).mean() for a in (0, 1) for b in (0, 1)
        ]
    assert_within(correlations, 0, 1.01 / math.sqrt(steps * paths))
    for draw in (0, 1):
        between_paths = values[:, draw].T @ values[:, draw] / steps
        between_paths = between_paths[np.triu_indices(paths, 1)]
        # 2016 pairs: the threshold of the largest is that of one pair at 6 standard errors.
        assert np.abs(between_paths).max() < 6 / math.sqrt(steps)
        assert_within(between_paths.mean(), 0, 1 / math.sqrt(steps * len(between_paths)))


def test_noise_differs_between_seeds_and_between_paths():
    streams = [gaussians(seed, path, 4) for seed in (0, 1, 2**64 - 1) for path in (0, BLOCK, 2**40)]
    assert len(np.unique(np.concatenate(streams, axis=2), axis=2).T) == len(streams) * BLOCK


def test_noise_of_a_path_does_not_depend_on_its_place_in_a_block():
    assert_array_equal(gaussians(3, 5, 20)[:, :, 0], gaussians(3, 0, 20)[:, :, 5])


def each(function, x):
    """A function of vectors, of each number."""
    whole = np.resize(x, -(-x.size // LANES) * LANES)
    return on_vectors(function, whole, (whole[0],))[: x.size]


@njit
def on_vectors(function, x, kind):
    y = np.empty_like(x)
    for start in range(0, x.size, LANES):
        (vector,) = load(x, start, kind)
        store(y, start, (function(vector),))
    return y


@njit
def sine_of(x):
    return noise.sine(x)


def test_polynomials_agree_with_numpy():
    u = np.concatenate([np.geomspace(2.0**-32, 1, 20_001), 1 - np.arange(1, 99) * 2.0**-24])
    v = (2.0**31 * u).astype(np.float32)
    expected = -2 * np.log(v.astype(float) / 2**31)
    assert_allclose(each(noise.minus_two_log, v), expected, rtol=3e-7, atol=0)
    assert each(noise.minus_two_log, np.full(1, 2**31, np.float32))[0] == 0

    angle = np.linspace(-1, 1, 20_001).astype(np.float32)
    exact = angle.astype(float) * np.pi / 2
    assert_allclose(each(noise.sin_quarter, angle), np.sin(exact), rtol=0, atol=1.5e-7)
    assert_allclose(each(noise.cos_quarter, angle), np.cos(exact), rtol=0, atol=1.5e-7)


def test_sine_agrees_with_numpy_over_many_turns():
    x = np.linspace(-40, 40, 100_003)
    assert_allclose(each(sine_of, x), np.sin(x), rtol=0, atol=2e-11)
    narrow = x.astype(np.float32)
    assert_allclose(each(sine_of, narrow), np.sin(narrow.astype(float)), rtol=0, atol=1.5e-6)
    assert np.isnan(each(sine_of, np.array([np.inf, np.nan]))).all()
