"""What shapes the read noise: its rms stays sigma, its tails and its map over pixels change; telegraph noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise._core.gamma import LARGEST_LOGIT, log_quantiles
from hsnoise.effects import (
    CorrelatedReadNoise,
    HeavyTailedReadNoise,
    RandomTelegraphNoise,
    ReadNoise,
    ReadNoiseNonuniformity,
    ShotNoise,
)
from hsnoise.model import NoiseModel, sample, sample_dark

KEY = jax.random.key(37)
P_VALUE = 1e-5


def darks(frames, shape, *effects):
    model = NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.05)
    return np.asarray(sample_dark(KEY, frames, shape, model))


@pytest.mark.parametrize("dof", [2.5, 5.0, 30.0])
def test_heavy_tails_are_students_t_of_the_same_sigma(dof):
    drawn = darks(1, (300, 300), ReadNoise(3.0), HeavyTailedReadNoise(dof)).ravel()
    t = drawn / 3.0 * np.sqrt(dof / (dof - 2))
    assert stats.kstest(t, stats.t(dof).cdf).pvalue > P_VALUE
    assert stats.kstest(drawn / 3.0, "norm").pvalue < P_VALUE or dof == 30
    if dof > 4:
        squares = drawn**2
        assert abs(squares.mean() - 9) < 5 * squares.std() / np.sqrt(squares.size)


@pytest.mark.parametrize("dof", [2.05, 2.5, 3.0, 5.0, 20.0, 500.0, 1e4, 1e6])
def test_quantiles_of_the_variance_are_those_of_chi_square(dof):
    table = np.asarray(log_quantiles(jnp.float32(dof / 2)), float)
    logit = np.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, len(table))
    below, above = stats.gamma.ppf(1 / (1 + np.exp(-logit)), dof / 2), stats.gamma.isf(1 / (1 + np.exp(logit)), dof / 2)
    wanted = np.log(np.where(logit < 0, below, above) / (dof / 2))
    np.testing.assert_allclose(table, wanted, rtol=0, atol=3e-4 / np.sqrt(dof / 2))
    assert np.isfinite(jax.grad(lambda a: log_quantiles(a).sum())(jnp.float32(dof / 2)))


def test_heavy_tails_are_independent_of_pixel_and_frame():
    drawn = darks(100, (30, 30), HeavyTailedReadNoise(6.0), ReadNoise(3.0))
    log_size = np.log(np.abs(drawn))
    size = log_size - log_size.mean()
    for product in (size[1:] * size[:-1], size[:, 1:] * size[:, :-1], size[:, :, 1:] * size[:, :, :-1]):
        assert abs(product.mean()) < 5 * product.std() / np.sqrt(product.size)


@pytest.mark.slow
def test_many_degrees_of_freedom_are_a_gaussian():
    plain = darks(2, (20, 20), ReadNoise(3.0))
    np.testing.assert_allclose(darks(2, (20, 20), HeavyTailedReadNoise(3e7), ReadNoise(3.0)), plain, rtol=1e-3)


def test_nonuniform_read_noise_is_log_normal_over_pixels_of_the_same_rms():
    frames, spread = 2000, 0.4
    drawn = darks(frames, (40, 40), ReadNoiseNonuniformity(spread), ReadNoise(3.0))
    variance = np.mean(drawn**2, 0)
    log_sigma = np.log(variance).ravel() / 2
    # The variance of frames draws scatters by 2 / frames: that of ln sigma by 1 / (2 frames), small beside spread^2.
    z = (log_sigma - np.log(3.0) + spread**2) / np.sqrt(spread**2 + 1 / (2 * frames))
    assert stats.kstest(z, "norm").pvalue > P_VALUE
    assert abs(variance.mean() - 9) < 5 * variance.std() / np.sqrt(variance.size)
    one = drawn / np.sqrt(variance)
    assert abs(np.mean(one**4) - 3 * frames / (frames + 2)) < 5 * np.sqrt(96 / one.size)


def test_a_tail_of_noisy_pixels_is_exponential_and_leaves_the_rms():
    frames, tail = 2000, 0.2
    drawn = darks(frames, (60, 60), ReadNoiseNonuniformity(0.0, tail=tail), ReadNoise(3.0))
    variance = np.mean(drawn**2, 0).ravel()
    above = np.log(variance) / 2 - np.log(3.0 * np.sqrt(1 - 2 * tail))
    # The chance of 2000 frames moves a logarithm by 0.016, which shows at the sharp edge alone.
    assert stats.kstest(above[above > 0.1] - 0.1, "expon", args=(0, tail)).pvalue > P_VALUE
    assert abs(variance.mean() - 9) < 5 * variance.std() / np.sqrt(variance.size)


def correlations(drawn, lags):
    """Correlation of pixels so far apart in their row [lag], and its error by chance."""
    found = [np.mean(drawn[:, :, lag:] * drawn[:, :, : drawn.shape[2] - lag]) for lag in lags]
    return np.array(found) / np.mean(drawn**2), 1 / np.sqrt(drawn.size)


@pytest.mark.parametrize(("frequency", "memory"), [(0.5, 0.3), (0.0, 0.8), (0.23, 0.9)])
def test_correlated_read_noise_has_the_stated_correlations_and_the_same_rms(frequency, memory):
    drawn = darks(8, (100, 500), ReadNoise(3.0), CorrelatedReadNoise(0.4, frequency, memory))
    lags = np.arange(1, 6)
    found, chance = correlations(drawn, lags)
    stated = 0.4 * memory**lags * np.cos(2 * np.pi * frequency * lags)
    assert np.all(np.abs(found - stated) < 5 * chance), found - stated
    assert abs(np.mean(drawn**2) / 9 - 1) < 5 * np.sqrt(2 / drawn.size * (1 + 2 * np.sum(stated**2)))
    down = np.mean(drawn[:, 1:] * drawn[:, :-1]) / 9
    assert abs(down) < 5 * chance * np.sqrt(1 + 2 * np.sum(stated**2))


def test_noise_that_outlasts_the_row_keeps_its_rms():
    drawn = darks(200, (50, 6), ReadNoise(3.0), CorrelatedReadNoise(1.0, 0.1, 0.99))
    each = np.mean(drawn**2, 2) / 9  # rows are independent
    assert abs(each.mean() - 1) < 5 * each.std() / np.sqrt(each.size)


@pytest.mark.parametrize("light", [0.0, 60.0])
def test_shot_noise_is_not_correlated_with_the_read_noise_of_its_neighbours(light):
    model = NoiseModel(
        [ShotNoise(), ReadNoise(3.0), CorrelatedReadNoise(0.6, 0.5, 0.5)],
        cfa="mono",
        shutter="rolling",
        exposure_s=0.05,
    )
    drawn = np.asarray(sample(KEY, np.full((6, 80, 400), light), model)) - light
    found, chance = correlations(drawn, [1])
    assert abs(found[0] + 0.3 * 9 / (9 + light)) < 5 * chance


def test_two_shapes_multiply():
    drawn = darks(1, (300, 300), ReadNoiseNonuniformity(0.3), HeavyTailedReadNoise(20.0), ReadNoise(3.0)).ravel()
    fourth = 3 * np.exp(4 * 0.3**2) * (18 / 16)
    x = drawn / 3
    assert abs(np.mean(x**2) - 1) < 5 * np.std(x**2) / np.sqrt(x.size)
    assert abs(np.mean(x**4) - fourth) < 5 * np.std(x**4) / np.sqrt(x.size)


def test_shapes_leave_the_signal_alone_without_read_noise():
    assert np.all(darks(1, (8, 8), ReadNoiseNonuniformity(0.3), HeavyTailedReadNoise(5.0)) == 0)


def test_telegraph_pixels_jump_between_two_levels():
    frames, shape, fraction, duty = 200, (100, 100), 0.1, 0.3
    drawn = darks(frames, shape, RandomTelegraphNoise(fraction, 7.0, duty))
    assert set(np.unique(drawn)) == {0.0, 7.0}
    jumps = drawn.max(0) > 0
    assert abs(jumps.mean() - fraction) < 5 * np.sqrt(fraction * (1 - fraction) / jumps.size)
    states = drawn[:, jumps] / 7.0
    assert abs(states.mean() - duty) < 5 * np.sqrt(duty * (1 - duty) / states.size)
    assert abs(np.mean((states[1:] - duty) * (states[:-1] - duty))) < 5 * duty * (1 - duty) / np.sqrt(states.size)
    # Over pixels the number of high frames is binomial.
    high = states.sum(0)
    assert abs(high.var() / (frames * duty * (1 - duty)) - 1) < 5 * np.sqrt(2 / high.size)


def test_amplitudes_of_traps_are_exponential_at_a_spread_of_one():
    drawn = darks(2, (300, 300), RandomTelegraphNoise(1.0, 7.0, 1.0, 1.0))
    assert np.all(drawn[0] == drawn[1])  # always high: what is left is the map of amplitudes
    sizes = drawn[0].ravel()
    assert abs(sizes.mean() - 7.0) < 5 * 7.0 / np.sqrt(sizes.size)
    for limit in (3.0, 7.0, 20.0):
        share = np.exp(-limit / 7.0)
        assert abs(np.mean(sizes > limit) - share) < 5 * np.sqrt(share * (1 - share) / sizes.size)


@pytest.mark.parametrize("spread", [0.3, 0.8])
def test_the_mean_amplitude_does_not_depend_on_its_spread(spread):
    sizes = darks(1, (300, 300), RandomTelegraphNoise(1.0, 7.0, 1.0, spread)).ravel()
    assert abs(sizes.mean() - 7.0) < 5 * sizes.std() / np.sqrt(sizes.size)


def test_two_samples_that_are_subtracted_have_three_levels_and_leave_the_mean():
    frames, duty = 400, 0.2
    effect = RandomTelegraphNoise(0.5, 7.0, duty, double_sampling=True)
    drawn = darks(frames, (60, 60), effect)
    assert set(np.unique(drawn)) == {-7.0, 0.0, 7.0}
    states = drawn[:, drawn.max(0) > 0] / 7.0
    for level, share in ((1.0, duty * (1 - duty)), (-1.0, duty * (1 - duty))):
        assert abs(np.mean(states == level) - share) < 5 * np.sqrt(share * (1 - share) / states.size)
    assert abs(drawn.mean(0)).max() < 7.0 * 6 * np.sqrt(2 * duty * (1 - duty) / frames)


def test_a_setting_that_is_no_truth_value_is_refused():
    with pytest.raises(ValueError, match=r"double_sampling: expected True or False, got 'yes'"):
        RandomTelegraphNoise(0.1, 7.0, double_sampling="yes")
