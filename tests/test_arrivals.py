"""Electrons and read noise in one step: which effects are merged, and derivatives through what is drawn."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hsnoise
from hsnoise import effects as fx
from hsnoise.chain.arrivals import merged, slopes
from hsnoise.model import NoiseModel, sample, sample_dark

KEY = jax.random.key(11)
SHAPE = (2, 200, 200)


def model_of(*effects, cfa="mono"):
    return NoiseModel(effects, cfa=cfa, shutter="global", exposure_s=0.1)


BASE = (fx.ShotNoise(), fx.DarkCurrent(40.0), fx.ReadNoise(2.0), fx.Gain(1.5), fx.BlackLevel(16.0), fx.ADC(4095))


@pytest.mark.parametrize(
    ("more", "names"),
    [
        ((), ["arrivals", "gain", "black_level", "adc"]),
        ((fx.HotPixels(0.1, 100.0),), ["arrivals", "hot_pixels", "gain", "black_level", "adc"]),
        ((fx.Crosstalk(0.02),), ["arrivals", "crosstalk", "read_noise", "gain", "black_level", "adc"]),
        (
            (fx.ElectronMultiplication(0.9),),
            ["arrivals", "electron_multiplication", "read_noise", "gain", "black_level", "adc"],
        ),
        ((fx.RowNoise(1.0),), ["arrivals", "row_noise", "gain", "black_level", "adc"]),
        (
            (fx.PhotoResponseNonuniformity(0.1),),
            ["photo_response_nonuniformity", "arrivals", "gain", "black_level", "adc"],
        ),
    ],
)
def test_what_is_merged(more, names):
    assert [effect.name for effect in merged(model_of(*BASE, *more).effects, "any")] == names


@pytest.mark.parametrize(
    "more",
    [
        fx.HotPixels(0.0, 100.0),
        fx.Crosstalk(0.0),
        fx.ElectronMultiplication(0.0),
        fx.RowNoise(0.0),
        fx.PhotoResponseNonuniformity(0.0),
    ],
)
def test_one_effect_more_leaves_the_draws(more):
    plain, added = (sample_dark(KEY, 2, (64, 64), model_of(*effects)) for effects in (BASE, (*BASE, more)))
    assert np.mean(np.asarray(plain) != np.asarray(added)) < 1e-3  # but for rounding


@pytest.mark.parametrize("level", [0.0, 3.0, 40.0])
def test_light_alike_for_all_pixels_is_as_any_other(level):
    even, varied = np.full(SHAPE, level, np.float32), np.full(SHAPE, level, np.float32)
    varied[-1, -1, -1] = 90.0  # neither a number for all, nor all of one regime
    one, other = (np.asarray(sample(KEY, clean, model_of(*BASE))).ravel()[:-1] for clean in (even, varied))
    np.testing.assert_array_equal(one, other)


def distribution(x, mean, sigma):
    k = np.arange(max(0, int(mean - 12 * np.sqrt(mean) - 5)), int(mean + 12 * np.sqrt(mean) + 40))
    return (stats.poisson.pmf(k, mean) * stats.norm.cdf((x - k) / sigma)).sum()


@pytest.mark.parametrize(
    ("mean", "sigma"),
    [(1e-3, 1.0), (0.3, 0.6), (3.0, 3.5), (12.0, 2.0), (19.5, 0.5), (500.0, 3.0), (1e5, 3.0), (2.0, 20.0)],
)
def test_slopes_are_those_at_a_fixed_distribution_function(mean, sigma):
    deviation, jitted = np.sqrt(mean + sigma**2), jax.jit(slopes)
    for x in mean + deviation * np.array([-2.5, -1.0, 0.1, 1.2, 3.0]):
        found = [float(v) for v in jitted(jnp.asarray(x), jnp.asarray(mean), jnp.asarray(sigma))]
        h = 1e-4 * deviation
        density = (distribution(x + h, mean, sigma) - distribution(x - h, mean, sigma)) / (2 * h)
        d, s = 1e-4 * mean, 1e-4 * sigma
        by_mean = (distribution(x, mean + d, sigma) - distribution(x, mean - d, sigma)) / (2 * d)
        by_sigma = (distribution(x, mean, sigma + s) - distribution(x, mean, sigma - s)) / (2 * s)
        np.testing.assert_allclose(found, [-by_mean / density, -by_sigma / density], rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("mean", [0.0, 0.5, 7.0, 30.0, 2e4, 1e5])
def test_slopes_in_single_precision_are_those_in_double(mean):
    x = mean + np.sqrt(mean + 9.0) * np.linspace(-4, 4, 33)
    jitted = jax.jit(slopes)
    single = jitted(*(jnp.asarray(v, jnp.float32) for v in (x, mean, 3.0)))
    with jax.enable_x64(True):
        double = jitted(*(jnp.asarray(v, jnp.float64) for v in (np.asarray(x, np.float32), mean, 3.0)))
    np.testing.assert_allclose(single, double, rtol=1e-2, atol=1e-2)
    assert all(np.isfinite(v).all() for v in single)


@pytest.mark.slow
def test_without_read_noise_there_is_no_derivative_and_no_nan():
    by_mean, by_sigma = slopes(jnp.array([0.0, 3.0]), jnp.array([0.0, 2.0]), jnp.asarray(0.0))
    assert not np.any(by_mean) and not np.any(by_sigma)


def gradient_and_error(function, at, n=12):
    """Mean and standard error over keys of d mean(function) / d at."""
    of = jax.jit(jax.grad(lambda at, key: function(at, key)))
    found = np.array([of(at, jax.random.fold_in(KEY, i)) for i in range(n)], np.float64)
    return found.mean(0), found.std(0, ddof=1) / np.sqrt(n)


SQUARES = {  # of x = gain (Poisson(light + rate t) + sigma z) + black: parameter, value, d E[x^2]
    "gain": (1.5, lambda m, v, g, t: 2 * (g * (m**2 + v) + 16.0 * m)),
    "rate": (40.0, lambda m, v, g, t: t * (2 * g * (g * m + 16.0) + g**2)),
    "sigma": (2.0, lambda m, v, g, t: 2 * g**2 * 2.0),
    "light": (3.0, lambda m, v, g, t: 2 * g * (g * m + 16.0) + g**2),
}


SOME = ["rate", "gain", "sigma", "light"]


@pytest.mark.slow
@pytest.mark.parametrize("name", SQUARES)
def test_gradient_of_an_expectation_is_that_of_its_closed_form(name):
    value, closed = SQUARES[name]

    def mean_square(at, key):
        gain, rate, sigma, light = (at if name == n else SQUARES[n][0] for n in SQUARES)
        model = model_of(fx.ShotNoise(), fx.DarkCurrent(rate), fx.ReadNoise(sigma), fx.Gain(gain), fx.BlackLevel(16.0))
        drawn = sample(key, jnp.full(SHAPE, light), model)
        return jnp.mean(drawn**2)

    found, error = gradient_and_error(mean_square, jnp.asarray(value))
    mean, variance = 3.0 + 4.0, 3.0 + 4.0 + 4.0
    assert abs(found - closed(mean, variance, 1.5, 0.1)) < 4 * error
    assert error < 0.01 * abs(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_gradient_through_rounding_and_clipping(name):
    """Against finite differences of the exact expectation of counts clipped at 0 and 12."""
    start = {"gain": 1.5, "rate": 20.0, "sigma": 2.0, "light": 1.0}

    def expected(values):
        mean, k = values["light"] + values["rate"] * 0.1, np.arange(80)
        edges = np.arange(12) + 0.5  # E[count] = sum of P(count > c)
        above = stats.norm.sf((edges[:, None] / values["gain"] - k) / values["sigma"])
        return (stats.poisson.pmf(k, mean) * above).sum()

    def mean_count(at, key):
        v = start | {name: at}
        model = model_of(
            fx.ShotNoise(), fx.DarkCurrent(v["rate"]), fx.ReadNoise(v["sigma"]), fx.Gain(v["gain"]), fx.ADC(12)
        )
        return jnp.mean(sample(key, jnp.full(SHAPE, v["light"]), model, differentiable=True))

    found, error = gradient_and_error(mean_count, jnp.asarray(start[name]))
    h = 1e-4 * start[name]
    closed = (expected(start | {name: start[name] + h}) - expected(start | {name: start[name] - h})) / (2 * h)
    # Rounding is passed straight through, which is exact for noise of more than half a count.
    assert abs(found - closed) < 4 * error + 2e-3 * abs(closed)


@pytest.mark.slow
def test_row_gain_and_added_effects_have_gradients():
    def spread(sigmas, key):
        model = hsnoise.cameras.grasshopper3().with_value("row_gain", "sigma", sigmas[0] * jnp.ones(3))
        model = model.add(fx.RowNoise(sigmas[1])).add(fx.HotPixels(0.01, 50.0)).remove("adc")
        drawn = sample(key, jnp.full((8, 64, 64), 20.0), model)
        rows = drawn[:, ::2, ::2].mean(2)
        return jnp.mean((rows - rows.mean(1, keepdims=True)) ** 2)

    found, error = gradient_and_error(spread, jnp.array([0.1, 1.0]))
    gain, mean = 3.54, 20 + 118 * 0.03 + 0.5 * 0.03
    # Variance of rows = gain^2 (row gain^2 (mean^2 + noise of a row's mean) + row noise^2 + ...), over 31 of 32 rows
    assert abs(found[0] - 2 * 0.1 * gain**2 * mean**2 * 31 / 32) < 5 * error[0] + 0.05 * found[0]
    assert found[1] > 0 and abs(found[1] - 2 * 1.0 * gain**2 * 31 / 32) < 5 * error[1] + 0.05 * found[1]


@pytest.mark.slow
def test_differentiable_counts_are_the_same_counts():
    model = hsnoise.cameras.canon_5d3(black_level_dn=8).add(fx.MissingCodes(2.3))
    plain = sample_dark(KEY, 2, (32, 32), model)
    floats = sample(KEY, np.zeros((2, 32, 32)), model, differentiable=True)
    np.testing.assert_allclose(floats, np.asarray(plain, float), atol=1e-5)
