"""Laws of what changes the signal: couplings, gains, the bend of the response, the clamp, missing codes."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

from hsnoise.effects import (
    ADC,
    AdcNonuniformity,
    BlackClamp,
    BlackLevel,
    Crosstalk,
    DarkCurrent,
    Gain,
    ImageLag,
    MissingCodes,
    Nonlinearity,
    OddEvenPattern,
    PhotoResponseNonuniformity,
    ReadNoise,
    ReadoutBandwidth,
    ReadoutOvershoot,
    SharedRowGain,
    ShotNoise,
    Stage,
)
from hsnoise.model import NoiseModel, sample

KEY = jax.random.key(41)
P_VALUE = 1e-5
COUPLINGS = [Crosstalk(0.05), ReadoutBandwidth(0.2), ReadoutOvershoot(0.2), ImageLag(0.2)]


def draw(clean, *effects, cfa="mono", shutter="rolling", **keywords):
    model = NoiseModel(effects, cfa=cfa, shutter=shutter, exposure_s=0.5)
    return np.asarray(sample(KEY, np.asarray(clean, float), model, **keywords))


# Couplings


def point(shape=(3, 5, 5), at=(1, 2, 2)):
    clean = np.zeros(shape)
    clean[at] = 100.0
    return clean


@pytest.mark.parametrize(
    ("effect", "cfa", "expected"),
    [
        (Crosstalk(0.05), "mono", {(1, 2, 2): 80, (1, 1, 2): 5, (1, 3, 2): 5, (1, 2, 1): 5, (1, 2, 3): 5}),
        (Crosstalk(0.05), "RGGB", {(1, 2, 2): 80, (1, 1, 2): 5, (1, 3, 2): 5, (1, 2, 1): 5, (1, 2, 3): 5}),
        (ReadoutBandwidth(0.2), "mono", {(1, 2, 2): 80, (1, 2, 3): 20}),
        (ReadoutBandwidth(0.2), "RGGB", {(1, 2, 2): 80, (1, 2, 3): 20}),
        (ReadoutOvershoot(0.2), "mono", {(1, 2, 2): 120, (1, 2, 3): -20}),
        (ReadoutOvershoot(0.2), "RGGB", {(1, 2, 2): 120, (1, 2, 3): -20}),
        (ImageLag(0.2), "mono", {(1, 2, 2): 80, (2, 2, 2): 20}),
    ],
)
def test_a_point_spreads_to_the_right_neighbours(effect, cfa, expected):
    shape = (3, 6, 6)
    truth = np.zeros(shape)
    for index, value in expected.items():
        truth[index] = value
    np.testing.assert_allclose(draw(point(shape), effect, cfa=cfa), truth, atol=1e-12)


@pytest.mark.parametrize("effect", COUPLINGS, ids=lambda effect: effect.name)
def test_couplings_keep_a_uniform_signal(effect):
    np.testing.assert_allclose(draw(np.full((2, 4, 4), 7.0), effect), 7.0, rtol=1e-12)


def test_crosstalk_loses_no_electrons():
    for at in [(1, 0, 0), (1, 0, 2), (1, 4, 4)]:
        assert draw(point(at=at), Crosstalk(0.05)).sum() == pytest.approx(100, rel=1e-12)


def test_first_frame_and_first_column_have_no_past():
    clean = np.random.default_rng(0).uniform(0, 50, (3, 5, 5))
    np.testing.assert_allclose(draw(clean, ImageLag(0.2))[0], clean[0], rtol=1e-12)
    for along_row in (ReadoutBandwidth(0.2), ReadoutOvershoot(0.2)):
        np.testing.assert_allclose(draw(clean, along_row)[:, :, 0], clean[:, :, 0], rtol=1e-12)


# Shot noise is shared by all; read noise by the readout chain only.
@pytest.mark.parametrize("effect", COUPLINGS, ids=lambda effect: effect.name)
def test_couplings_act_on_the_right_noise(effect):
    # Variance that is kept, and covariance with the next pixel or frame.
    kept, lag = {
        "crosstalk": (0.8**2 + 4 * 0.05**2, 2 * 0.8 * 0.05),
        "readout_bandwidth": (0.8**2 + 0.2**2, 0.8 * 0.2),
        "readout_overshoot": (1.2**2 + 0.2**2, -1.2 * 0.2),
        "image_lag": (0.8**2 + 0.2**2, 0.8 * 0.2),
    }[effect.name]
    shape = (40, 60, 60)
    shot = draw(np.full(shape, 9.0), ShotNoise(), effect)[1:, :, 1:] - 9.0
    read = draw(np.zeros(shape), ReadNoise(3.0), effect)[1:, :, 1:]
    inner = shot[:, 1:-1, :-1]
    assert abs(np.mean(inner**2) / 9 - kept) < 5 * np.std(inner**2) / 9 / np.sqrt(inner.size / 4)
    factor = kept if effect.stage == Stage.READOUT else 1
    assert abs(np.mean(read**2) / 9 - factor) < 5 * np.std(read**2) / 9 / np.sqrt(read.size / 4)
    pair = shot[1:] * shot[:-1] if effect.name == "image_lag" else shot[:, 1:-1, 1:] * shot[:, 1:-1, :-1]
    assert abs(pair.mean() / 9 - lag) < 5 * pair.std() / 9 / np.sqrt(pair.size / 4)


# Gains


def test_photo_response_multiplies_the_light_and_not_the_dark():
    drawn = draw(np.full((1, 100, 100), 20.0), PhotoResponseNonuniformity(0.1))
    assert stats.kstest((drawn / 20 - 1).ravel() / 0.1, "norm").pvalue > P_VALUE
    clipped = draw(np.full((1, 100, 100), 20.0), PhotoResponseNonuniformity(1.0))
    assert abs(np.mean(clipped == 0) - stats.norm.cdf(-1)) < 5 * np.sqrt(0.16 * 0.84 / clipped.size)
    assert clipped.min() == 0
    dark = [DarkCurrent(20.0), ReadNoise(2.0)]
    zeros = np.zeros((1, 8, 8))
    np.testing.assert_array_equal(draw(zeros, *dark, PhotoResponseNonuniformity(0.1)), draw(zeros, *dark))
    # Shot noise follows the pixel's own mean.
    frames = draw(np.full((50, 30, 30), 20.0), ShotNoise(), PhotoResponseNonuniformity(0.3))
    ratio = frames.var(0, ddof=1) / frames.mean(0)
    assert abs(ratio.mean() - 1) < 5 * ratio.std() / 30


def test_shared_row_gain_is_one_series_for_all_colours():
    drawn = draw(np.ones((100, 64, 6)), SharedRowGain(0.1, 0.0), cfa="RGGB")
    np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[:, :, :1], drawn.shape))
    z = (drawn[:, :, 0] - 1) / 0.1
    assert stats.kstest(z.ravel(), "norm").pvalue > P_VALUE
    assert draw(np.ones((50, 64, 2)), SharedRowGain(1.0, 0.0)).min() == 0


@pytest.mark.parametrize("shutter", ["rolling", "global"])
def test_shared_row_gain_is_coloured_in_a_rolling_shutter(shutter):
    frames, n = 400, 64
    x = (draw(np.ones((frames, n, 2)), SharedRowGain(0.05, 1.0), shutter=shutter)[:, :, 0] - 1) / 0.05
    k = np.minimum(np.arange(n), n - np.arange(n))
    weight = np.ones(n) if shutter == "global" else np.where(k > 0, 1 / np.maximum(k, 1), 0)
    relative = np.abs(np.fft.rfft(x) / n)[:, 1 : n // 2] ** 2 / (weight / weight.sum())[1 : n // 2]
    assert stats.kstest(relative.ravel(), "expon").pvalue > P_VALUE


@pytest.mark.parametrize(("cfa", "chain"), [("mono", [0, 1, 0, 1, 0, 1, 0, 1]), ("GBRG", [0, 0, 1, 1, 0, 0, 1, 1])])
def test_two_chains_take_turns(cfa, chain):
    half = np.array(chain) - 0.5
    drawn = draw(np.full((2, 4, 8), 50.0), OddEvenPattern(3.0, 0.02), cfa=cfa)
    np.testing.assert_allclose(drawn, np.broadcast_to(50 * (1 + 0.02 * half) + 3.0 * half, (2, 4, 8)), rtol=1e-12)
    read = draw(np.zeros((2, 4, 8)), ReadNoise(2.0), cfa=cfa)
    both = draw(np.zeros((2, 4, 8)), ReadNoise(2.0), OddEvenPattern(0.0, 0.02), cfa=cfa)
    np.testing.assert_allclose(both, read * (1 + 0.02 * half)[None, None], rtol=1e-6)


@pytest.mark.parametrize("curvature", [1e-3, -1e-3])
def test_response_bends_above_zero_before_the_gain(curvature):
    clean = np.array([[[0.0, 1.0, 10.0, 100.0]]])
    bent = draw(clean, Gain(2.0), Nonlinearity(curvature))
    np.testing.assert_allclose(bent, 2.0 * (clean - curvature * clean**2), rtol=1e-12)
    read = draw(np.zeros((1, 30, 30)), ReadNoise(20.0))
    expected = np.where(read > 0, read - curvature * read**2, read)
    np.testing.assert_allclose(draw(np.zeros((1, 30, 30)), ReadNoise(20.0), Nonlinearity(curvature)), expected)


def test_a_bent_response_never_turns_back():
    drawn = draw(np.linspace(0, 5000, 24).reshape(1, 1, 24), Nonlinearity(1e-3)).ravel()
    assert np.all(np.diff(drawn) >= 0)
    assert drawn[-1] == pytest.approx(250)


# Counts


def test_the_clamp_takes_the_mean_and_leaves_the_variance():
    dark = [DarkCurrent(100.0), ReadNoise(2.0), Gain([1.5, 1.2, 1.3]), BlackLevel(64.0)]
    clamp = BlackClamp([150.0, 120.0, 130.0])
    for exposure_s in (0.1, 0.5):
        plain = draw(np.zeros((2, 60, 60)), *dark, cfa="RGGB", exposure_s=exposure_s)
        clamped = draw(np.zeros((2, 60, 60)), *dark, clamp, cfa="RGGB", exposure_s=exposure_s)
        gain = np.tile([[1.5, 1.2], [1.2, 1.3]], (30, 30))[None]
        expected = np.broadcast_to(gain * 100 * exposure_s, plain.shape)
        np.testing.assert_allclose(plain - clamped, expected, rtol=1e-9)
        standard = np.sqrt(np.mean(gain**2) * (100 * exposure_s + 4) / clamped.size)
        assert abs(clamped.mean() - 64) < 5 * standard


@pytest.mark.parametrize("period", [2, 3, 16])
def test_codes_are_unequally_wide(period):
    """A ramp through the converter dwells on each code as long as the code is wide."""
    effect, steps = AdcNonuniformity(0.2, period), 200
    ramp = np.arange(120 * period * steps).reshape(1, 120, -1) / steps + 100 * period - 0.5 + 0.5 / steps

    def widths(sensor):
        model = NoiseModel([ADC(), effect], cfa="mono", shutter="rolling", exposure_s=1.0)
        assert model.names == ("adc_nonuniformity", "adc")
        counts = np.asarray(sample(KEY, ramp, model, sensor_key=jax.random.key(sensor)))
        assert abs(counts.astype(float).mean() - ramp.mean()) < 1 / steps
        inside = counts[(counts >= 101 * period) & (counts < 219 * period)]
        found = np.bincount(inside)[101 * period :].reshape(-1, period) / steps
        np.testing.assert_allclose(found, np.broadcast_to(found[:1], found.shape), atol=2 / steps)
        return found.mean(0)

    found = np.array([widths(sensor) for sensor in range(40)])
    np.testing.assert_allclose(found.mean(1), 1, atol=1 / steps)
    rms = np.sqrt(np.square(found - 1).mean())
    assert abs(rms / 0.2 - 1) < 5 / np.sqrt(2 * 40 * (period - 1))
    np.testing.assert_array_equal(widths(3), found[3])


@pytest.mark.parametrize("period", [1, 2.0, True, 10**6])
def test_impossible_periods_are_refused(period):
    with pytest.raises(ValueError, match=r"adc_nonuniformity.period: expected a whole number from 2 to 65536"):
        AdcNonuniformity(0.1, period)


def test_digital_gain_leaves_gaps_and_the_mean():
    model = [ReadNoise(40.0), BlackLevel(500.0), ADC(4095)]
    plain = draw(np.zeros((4, 200, 200)), *model)
    drawn = draw(np.zeros((4, 200, 200)), *model, MissingCodes(1.6))
    assert drawn.dtype == np.uint16
    codes = np.unique(drawn)
    assert set(codes) <= set(np.round(1.6 * np.arange(2000)))
    middle = np.arange(450, 550)
    assert np.isin(middle, codes).mean() == pytest.approx(1 / 1.6, abs=0.02)
    difference = drawn.astype(float) - plain
    assert abs(difference).max() <= 1.6 / 2 + 0.5
    assert abs(difference.mean()) < 0.02


@pytest.mark.parametrize(
    ("white", "adc", "expected"),
    [(4095, 4095, 4095), (None, 65535, 65535), (None, 4095, 4096), (None, None, 2**32 - 256)],
)
def test_digital_gain_stops_at_the_white_level(white, adc, expected):
    drawn = draw(np.full((1, 2, 2), 1e12), ADC(adc), MissingCodes(4.0, white))
    np.testing.assert_array_equal(drawn, expected)


def test_effects_act_in_their_stages():
    effects = [MissingCodes(2.0), BlackClamp(1.0), Nonlinearity(1e-4), ReadoutBandwidth(0.1), Crosstalk(0.1)]
    model = NoiseModel([ADC(), *effects, Gain(1.0), ReadNoise(1.0)], cfa="mono", shutter="rolling", exposure_s=1.0)
    in_electrons = ("crosstalk", "read_noise", "nonlinearity", "readout_bandwidth", "gain")
    assert model.names == (*in_electrons, "black_clamp", "adc", "missing_codes")
