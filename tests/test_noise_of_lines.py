"""Read noise that differs between rows or columns, measured by fits that follow each pixel."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.effects import (
    ADC,
    AmplifierGlow,
    BlackLevel,
    ColumnNoise,
    DarkCurrent,
    DarkSignalNonuniformity,
    Gain,
    ReadNoise,
    ReadNoiseNonuniformity,
    ShotNoise,
)

SHAPE, FRAMES = (160, 192), 6


def fitted(*effects, exposure_s=1e-4):
    sensor = (ShotNoise(), ReadNoise(5.0), DarkSignalNonuniformity(4.0), Gain(0.4), BlackLevel(200.0), ADC(4095))
    model = hsnoise.NoiseModel((*sensor, *effects), cfa="mono", shutter="rolling", exposure_s=1e-4)
    counts = hsnoise.sample_dark(jax.random.key(3), FRAMES, SHAPE, model, exposure_s=exposure_s, sensor_key=5)
    return hsnoise.fit(hsnoise.FrameStack(np.asarray(counts), exposure_s), pixels="differ")


@pytest.mark.parametrize(
    "spreads",
    [
        pytest.param({"row_spread": 0.08}, marks=pytest.mark.slow),
        pytest.param({"column_spread": 0.05}, marks=pytest.mark.slow),
        {"spread": 0.3, "row_spread": 0.1, "column_spread": 0.06},
    ],
    ids=["rows", "columns", "all"],
)
def test_lines_and_pixels_are_told_apart(spreads):
    """With noise of two counts, whose variances are nearly whole numbers."""
    fit = fitted(ReadNoiseNonuniformity(**{"spread": 0.0, **spreads}))
    for name, truth in {"spread": 0.0, "row_spread": 0.0, "column_spread": 0.0, **spreads}.items():
        value, error, _ = fit.table[f"read_noise_nonuniformity.{name}"]
        n = {"row_spread": SHAPE[0], "column_spread": SHAPE[1]}.get(name, np.inf)  # lines of this sensor scatter
        if truth > 0:
            assert abs(value - truth) < 4 * np.hypot(error, truth / np.sqrt(2 * n)) < 0.06
        else:
            assert value < 0.06
    assert abs(fit.in_dn("read_noise")["read_noise.sigma"][0] - 2.0) < 0.03


@pytest.mark.slow
def test_noise_that_is_alike_has_no_spread():
    assert "read_noise_nonuniformity" not in fitted().added


def test_shot_noise_of_a_glow_is_no_read_noise():
    """Rows near the edge that glows have more noise, from more dark signal."""
    assert "read_noise_nonuniformity" not in fitted(DarkCurrent(50.0), AmplifierGlow(200.0, 0.3), exposure_s=1.0).added


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_columns_that_resemble_their_neighbours(exponent):
    fit = fitted(ColumnNoise(2.0, exponent))
    value, error, _ = fit.table["column_noise.exponent"]
    if exponent == 0:
        assert value == 0 and error == 0
    else:
        assert abs(value - exponent) < max(4 * error, 0.3)
    sigma, of_sigma, unit = fit.shown["column_noise.sigma"]
    assert unit == "DN" and abs(sigma - 0.8) < 4 * of_sigma < 0.8
    assert "black_shading" not in fit.added
