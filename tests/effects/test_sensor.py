"""What belongs to the sensor stays: fixed patterns over frames, exposures and calls; neutral values change nothing."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from hsnoise.effects import (
    ADC,
    AdcNonuniformity,
    AmplifierGlow,
    BlackClamp,
    BlackLevel,
    BlackShading,
    BrighterFatter,
    ColumnFixedPattern,
    ColumnNoise,
    CorrelatedReadNoise,
    CosmicRays,
    Crosstalk,
    DarkCurrentDrift,
    DarkCurrentInstability,
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    ElectronMultiplication,
    FrameOffset,
    FrameSettling,
    FrameTilt,
    Gain,
    HotPixels,
    ImageLag,
    Interference,
    MeasuredDistribution,
    MeasuredHits,
    MeasuredMap,
    MeasuredResponse,
    MeasuredSpectrum,
    MissingCodes,
    Nonlinearity,
    OddEvenPattern,
    PeriodicBanding,
    PhotoResponseNonuniformity,
    RandomTelegraphNoise,
    ReadNoise,
    ReadNoiseNonuniformity,
    ReadoutBandwidth,
    ReadoutOvershoot,
    RowBankNoise,
    RowFixedPattern,
    RowGroupNoise,
    RowNoise,
    SharedRowGain,
    TapGains,
    TapOffsets,
)
from hsnoise.model import NoiseModel, sample, sample_dark

KEY, OTHER = jax.random.key(23), jax.random.key(24)
SENSOR, OTHER_SENSOR = jax.random.key(25), jax.random.key(26)

# Fixed patterns, and how a stack [frame, row, column] shows where they are.
PATTERNS = [
    (RowFixedPattern(2.0), lambda x: x[0]),
    (ColumnFixedPattern(2.0), lambda x: x[0]),
    (DarkSignalNonuniformity(2.0), lambda x: x[0]),
    (TapOffsets(2.0), lambda x: x[0]),
    (TapGains(0.2, row_taps=2), lambda x: x[0]),
    (PhotoResponseNonuniformity(0.1), lambda x: x[0]),
    (HotPixels(0.1, 1e5), lambda x: x.min(0) > 50),
    (RandomTelegraphNoise(0.1, 5.0, 0.5), lambda x: x.max(0) > x.min(0)),
]


def mono(*effects):
    return NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=1.0)


@pytest.mark.parametrize(("effect", "pattern"), PATTERNS, ids=lambda x: getattr(x, "name", ""))
def test_the_same_sensor_has_the_same_pattern(effect, pattern):
    clean, model = np.full((40, 16, 16), 10.0), mono(effect)

    def drawn(key, exposure_s=1.0, sensor_key=None):
        return pattern(np.asarray(sample(key, clean, model, exposure_s=exposure_s, sensor_key=sensor_key)))

    here = drawn(KEY, sensor_key=SENSOR)
    assert len(np.unique(here)) > 1
    np.testing.assert_array_equal(drawn(OTHER, 1.5, SENSOR), here)
    assert not np.array_equal(drawn(KEY, sensor_key=OTHER_SENSOR), here)
    assert not np.array_equal(drawn(KEY), drawn(OTHER))


def test_a_map_of_read_noise_stays_but_its_noise_does_not():
    model = mono(ReadNoise(1.0), ReadNoiseNonuniformity(1.0))

    def log_rms(x):
        return np.log(np.asarray(x).std(0)).ravel()

    one, two = (sample_dark(key, 100, (20, 20), model, sensor_key=SENSOR) for key in (KEY, OTHER))
    other = sample_dark(KEY, 100, (20, 20), model, sensor_key=OTHER_SENSOR)
    assert np.corrcoef(log_rms(one), log_rms(two))[0, 1] > 0.9
    assert abs(np.corrcoef(log_rms(one), log_rms(other))[0, 1]) < 5 / 20
    assert abs(np.mean(np.asarray(one * two))) < 5 * np.std(np.asarray(one * two)) / np.sqrt(one.size)


def test_dark_frames_take_a_sensor_key():
    model = mono(DarkSignalNonuniformity(2.0))
    np.testing.assert_array_equal(
        sample_dark(KEY, 2, (8, 8), model, sensor_key=SENSOR),
        sample(OTHER, np.zeros((2, 8, 8)), model, sensor_key=SENSOR),
    )


def test_patterns_of_two_effects_are_independent():
    drawn = np.asarray(sample_dark(KEY, 1, (64, 64), mono(DarkSignalNonuniformity(1.0)), sensor_key=SENSOR))
    ones = np.ones((1, 64, 64))
    light = np.asarray(sample(KEY, ones, mono(PhotoResponseNonuniformity(0.1)), sensor_key=SENSOR)) - 1
    assert abs(np.corrcoef(drawn.ravel(), light.ravel())[0, 1]) < 5 / 64


NEUTRAL = [
    SharedRowGain(0.0, 1.0),
    RowNoise(0.0, 1.0),
    RowBankNoise(0.0, 1.0, 0.4),
    RowGroupNoise(0.0, 0.4),
    ColumnNoise(0.0, 1.0),
    RowFixedPattern(0.0),
    ColumnFixedPattern(0.0),
    FrameOffset(0.0),
    FrameTilt(0.0),
    FrameSettling(0.0, 3.0),
    DarkSignalNonuniformity(0.0),
    PhotoResponseNonuniformity(0.0),
    HotPixels(0.0, 1e5),
    AmplifierGlow(0.0, 0.3),
    DarkCurrentDrift(0.0),
    DarkCurrentInstability(0.0),
    DarkCurrentNonuniformity(0.0),
    RandomTelegraphNoise(0.0, 50.0),
    ReadNoiseNonuniformity(0.0),
    CorrelatedReadNoise(0.0, 0.5, 0.3),
    PeriodicBanding(0.0, 0.1),
    Interference(0.0, 0.1, 0.2),
    Crosstalk(0.0),
    BrighterFatter(0.0),
    ReadoutBandwidth(0.0),
    ReadoutOvershoot(0.0),
    ImageLag(0.0),
    OddEvenPattern(0.0, 0.0),
    TapOffsets(0.0),
    TapGains(0.0),
    BlackShading(0.0, 0.4),
    AdcNonuniformity(0.0, 8),
    MissingCodes(1.0),
    CosmicRays(0.0, 1e4),
    ElectronMultiplication(0.0),
    BlackClamp(0.0),
    Nonlinearity(0.0),
    MeasuredMap(),
    MeasuredSpectrum(),
    MeasuredDistribution(0.0, [-5.94, -2.97, 2.97, 5.94]),
    MeasuredHits(0.0, 0.0, [50.0, 60.0]),
    MeasuredResponse([0.0, 10.0], [0.0, 0.0]),
]


@pytest.mark.parametrize("effect", NEUTRAL, ids=lambda effect: effect.name)
def test_neutral_values_change_nothing(effect):
    model = NoiseModel(
        [ReadNoise(30.0), Gain(1.7), BlackLevel(64.0), ADC()], cfa="RGGB", shutter="rolling", exposure_s=1.0
    )
    clean = np.linspace(0, 1e5, 3 * 64).reshape(3, 8, 8)
    np.testing.assert_array_equal(sample(KEY, clean, model.add(effect)), sample(KEY, clean, model))
