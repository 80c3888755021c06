"""Laws of the dark electrons that are not alike in all pixels and frames: hot pixels, glow, drift, cosmic rays."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma

from hsnoise.effects import (
    ADC,
    AmplifierGlow,
    CosmicRays,
    DarkCurrent,
    DarkCurrentDrift,
    DarkCurrentInstability,
    DarkCurrentNonuniformity,
    Gain,
    HotPixels,
    ReadNoise,
    ShotNoise,
)
from hsnoise.effects._base import Capture
from hsnoise.model import NoiseModel, sample_dark

KEY = jax.random.key(31)
P_VALUE = 1e-5


def darks(effect, frames, shape, exposure_s=0.5):
    model = NoiseModel([effect], cfa="mono", shutter="rolling", exposure_s=0.05)
    drawn = np.asarray(sample_dark(KEY, frames, shape, model, exposure_s=exposure_s))
    assert np.array_equal(drawn, np.round(drawn)) and drawn.min() >= 0
    return drawn


def poisson_z(drawn, mean):
    """Sum and chi-square of counts against independent Poisson counts of these means, both as standard normals."""
    mean = np.broadcast_to(mean, drawn.shape)
    squares = np.where(mean > 0, (drawn - mean) ** 2 / np.maximum(mean, 1e-300), 1)
    spread = np.sqrt(np.sum(np.where(mean > 0, 2 + 1 / np.maximum(mean, 1e-300), 0)))
    return (drawn - mean).sum() / np.sqrt(mean.sum()), (squares - 1).sum() / spread


def factors(spread, skew, shape=(400, 500)):
    effect = DarkCurrentNonuniformity(spread, skew)
    capture = Capture(jnp.asarray(0.05), shape, "mono", "rolling", KEY)
    return effect.dark_current_scale(capture, (1, *shape), key=KEY)


@pytest.mark.parametrize(
    ("spread", "skew", "law"),
    [
        (0.3, 0.0, stats.lognorm(0.3, scale=np.exp(-(0.3**2) / 2))),
        (0.3, -0.3, stats.gamma(0.3**-2, scale=0.3**2)),
        (0.02, -0.02, stats.gamma(0.02**-2, scale=0.02**2)),
        (0.5, -1.0, stats.weibull_min(2, scale=1 / gamma(1.5))),
        (1.0, -1.0, stats.expon()),
        (0.2, 1.0, stats.invweibull(5, scale=1 / gamma(0.8))),
    ],
    ids=["log-normal", "gamma", "narrow gamma", "Weibull", "exponential", "Frechet"],
)
def test_dark_currents_have_the_laws_that_their_skews_promise(spread, skew, law):
    drawn = np.asarray(factors(spread, skew), float)
    assert stats.kstest(drawn.ravel(), law.cdf).pvalue > P_VALUE
    assert abs(drawn.mean() - 1) < 5 * drawn.std() / np.sqrt(drawn.size)


def test_dark_currents_without_a_mean_are_refused():
    with pytest.raises(ValueError, match=r"dark_current_nonuniformity\.skew: expected spread \* skew below 1"):
        DarkCurrentNonuniformity(0.8, 1.5)


@pytest.mark.parametrize("skew", [-1.5, -0.3, 0.05, 1.0])
def test_dark_currents_have_derivatives(skew):
    with jax.enable_x64(True):
        spread, by = jnp.asarray(0.2), 1e-5
        slope = jax.jvp(lambda of: factors(of, skew, (8, 8)), (spread,), (jnp.asarray(1.0),))[1]
        apart = (factors(spread + by, skew, (8, 8)) - factors(spread - by, skew, (8, 8))) / (2 * by)
        np.testing.assert_allclose(slope, apart, rtol=1e-3, atol=1e-4)


def test_hot_pixels_are_few_exponential_and_poisson():
    drawn = darks(HotPixels(0.05, 4e4), 20, (80, 80))
    means = drawn.mean(0)
    hot = means > 0
    # A hot pixel without an electron in all frames: one in 4e5.
    assert abs(hot.mean() - 0.05) < 5 * np.sqrt(0.05 * 0.95 / hot.size)
    assert stats.kstest(means[hot] / 2e4, "expon").pvalue > P_VALUE
    ratio = drawn.var(0, ddof=1)[hot] / means[hot]
    assert abs(ratio.mean() - 1) < 5 * np.sqrt(2 / 19 / hot.sum())
    longer = darks(HotPixels(0.05, 4e4), 20, (80, 80), exposure_s=1.0).mean(0)
    np.testing.assert_array_equal(longer > 0, hot)
    np.testing.assert_allclose(longer.sum() / means.sum(), 2, atol=0.01)
    bias = darks(HotPixels(0.05, 4e4, 2e3), 20, (80, 80), exposure_s=0.0).mean(0)
    np.testing.assert_array_equal(bias > 0, hot & (bias > 0))
    assert abs(bias.sum() - longer.sum() / 20) < 5 * np.sqrt(bias.sum() / 20)  # the same strengths, 1/20 of the charge
    assert np.corrcoef(bias[hot], longer[hot])[0, 1] > 0.99


@pytest.mark.parametrize("rate", [40.0, 4e3])
def test_dark_currents_of_pixels_are_log_normal_about_their_rate(rate):
    frames, shape, spread = 60, (60, 80), 0.5
    effects = [ShotNoise(), DarkCurrent(rate), DarkCurrentNonuniformity(spread)]
    model = NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.5)
    short, long = (np.asarray(sample_dark(KEY, frames, shape, model, exposure_s=t, sensor_key=KEY)) for t in (0.5, 1))
    expected = rate * 0.5
    relative = np.exp(spread**2) - 1
    mean, n = short.mean(0), short[0].size
    # Of the mean over pixels: their own spread, which is large against shot noise.
    assert abs(mean.mean() / expected - 1) < 5 * np.sqrt((relative + 1 / (frames * expected)) / n)
    assert abs(np.corrcoef(mean.ravel(), long.mean(0).ravel())[0, 1]) > 0.9
    assert abs((short.var(0, ddof=1) / mean).mean() - 1) < 5 * np.sqrt(2 / (frames - 1) / n)
    if rate > 1e3:  # shot noise of the mean over frames is 0.3 %
        assert stats.kstest((np.log(mean / expected) + spread**2 / 2).ravel() / spread, "norm").pvalue > P_VALUE


def test_dark_currents_of_pixels_are_the_same_with_read_noise_drawn_in_one():
    effects = [ShotNoise(), DarkCurrent(4e3), DarkCurrentNonuniformity(0.5)]
    models = [
        NoiseModel(some, cfa="mono", shutter="rolling", exposure_s=1.0)
        for some in (effects, [*effects, ReadNoise(2.0)])
    ]
    electrons, read = (np.asarray(sample_dark(KEY, 4, (50, 50), model, sensor_key=KEY)) for model in models)
    assert abs((read - electrons).std() - 2.0) < 5 * 2.0 / np.sqrt(2e4)


@pytest.mark.parametrize("corner", [None, (0.0, 0.0), (0.0, 1.0), (0.5, 0.25)])
def test_glow_falls_exponentially_from_its_spot(corner):
    rows, columns, frames = 31, 41, 50
    drawn = darks(AmplifierGlow(60.0, 0.3, *(corner or ())), frames, (rows, columns))
    spot = corner or (1.0, 1.0)
    i, j = np.mgrid[:rows, :columns]
    distance = np.hypot(i - spot[0] * (rows - 1), j - spot[1] * (columns - 1)) / np.hypot(rows - 1, columns - 1)
    expected = 60.0 * 0.5 * np.exp(-distance / 0.3)
    assert np.max(np.abs(poisson_z(drawn, expected))) < 5
    z = (drawn.mean(0) - expected) * np.sqrt(frames / expected)
    assert stats.chi2.sf(np.sum(z**2), z.size) > P_VALUE


def test_drift_grows_from_frame_to_frame():
    drawn = darks(DarkCurrentDrift(1.5), 6, (100, 100))
    assert np.all(drawn[0] == 0)
    for f in range(1, 6):
        assert np.max(np.abs(poisson_z(drawn[f], 1.5 * 0.5 * f))) < 5


def test_instability_scales_the_dark_current_of_whole_frames():
    frames, exposure_s, spread, rate = 400, 0.5, 0.2, 4000.0
    effects = [ShotNoise(), DarkCurrent(rate), DarkCurrentInstability(spread), Gain(1.0), ADC()]
    camera = NoiseModel(effects, cfa="mono", shutter="global", exposure_s=exposure_s)
    drawn = np.asarray(sample_dark(jax.random.key(3), frames, (32, 48), camera, exposure_s=exposure_s), float)
    factor = drawn.mean((1, 2)) / (rate * exposure_s)
    assert abs(factor.mean() - 1) < 4 * spread / np.sqrt(frames)
    assert stats.kstest(np.log(factor) / spread + spread / 2, "norm").pvalue > P_VALUE
    assert abs(drawn.var((1, 2)) / drawn.mean((1, 2)) - 1).mean() < 0.05  # within a frame, shot noise alone
    again = np.asarray(sample_dark(jax.random.key(3), frames, (32, 48), camera, exposure_s=0.0))
    assert np.all(again == 0)


def test_cosmic_rays_are_rare_new_and_exponential():
    frames, shape, per_pixel = 40, (100, 100), 2000e-6 * 0.5
    drawn = darks(CosmicRays(2000.0, 900.0), frames, shape)
    hit = drawn > 0
    # One in 1800 hits rounds to no electron.
    assert abs(hit.sum() - per_pixel * hit.size) < 5 * np.sqrt(per_pixel * hit.size)
    charge = drawn[hit] + np.random.default_rng(0).uniform(-0.5, 0.5, hit.sum())
    assert stats.kstest(charge / 900, "expon").pvalue > P_VALUE
    assert hit.sum(0).max() <= 3  # one pixel of a thousand such captures is hit four times
    counts = hit.sum((1, 2))
    assert stats.chi2.sf(np.sum((counts - counts.mean()) ** 2) / counts.mean(), frames - 1) > P_VALUE
    assert np.all(darks(CosmicRays(2000.0, 900.0), 2, shape, exposure_s=0.0) == 0)
    at_readout = (darks(CosmicRays(0.0, 900.0, 1000.0), frames, shape, exposure_s=0.0) > 0).sum()
    assert abs(at_readout - per_pixel * hit.size) < 5 * np.sqrt(per_pixel * hit.size)


@pytest.mark.parametrize("fraction", [0.003, 0.3, 1.0])
def test_hot_pixels_are_the_same_in_pieces_of_any_size(fraction, monkeypatch):
    drawn = []
    for pieces in (1, 8, 1000):
        monkeypatch.setattr("hsnoise.effects.hot_pixels.PIECES", pieces)
        effect = HotPixels(fraction, 40.0, 3.0, 0.8, 0.5)
        capture = Capture(jnp.float32(0.5), (60, 70), "mono", "rolling", jax.random.key(3))
        drawn.append(np.asarray(effect.sample(jnp.zeros((5, 60, 70), jnp.float32), capture, key=KEY)))
    np.testing.assert_array_equal(drawn[0], drawn[1])
    np.testing.assert_array_equal(drawn[0], drawn[2])
    share = (drawn[0] > 0).any(0).mean()
    assert 0.6 * fraction - 0.002 < share <= fraction + 4 * np.sqrt(fraction / 4200)


def test_glow_has_a_finite_derivative_in_its_spot():
    effect = AmplifierGlow(60.0, 0.3)
    model = NoiseModel([effect], cfa="mono", shutter="rolling", exposure_s=0.05)
    gradient = jax.grad(lambda m: jnp.sum(sample_dark(KEY, 1, (5, 5), m)))(model)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))
