"""Glow of an amplifier, found by fits that follow each pixel; frames by NumPy alone."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise

SHAPE, EXPOSURES_S, GAIN = (160, 300), (0.001, 60.0, 300.0), 1.1
DIAGONAL = np.hypot(SHAPE[0] - 1, SHAPE[1] - 1)


def fitted(rate, rng):
    """A fit of darks of a sensor with those mean dark currents, e-/s."""
    read = 1.8 * np.exp(0.1 * rng.standard_normal(SHAPE))
    darks = [
        GAIN * (rng.poisson(rate * t, (8, *SHAPE)) + read * rng.standard_normal((8, *SHAPE))) + 100 for t in EXPOSURES_S
    ]
    return hsnoise.fit(np.round(darks).clip(0, 65535).astype(np.uint16), exposure_s=EXPOSURES_S)


@pytest.mark.parametrize("power", [1.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_a_glow_has_its_place_size_and_shape_and_is_no_dark_current(power, rng):
    """It had been 28 % of hot pixels, and `compare` said 160000."""
    row, column, scale, peak = 0.2, 0.9, 0.15, 0.5
    down = (np.arange(SHAPE[0]) - row * (SHAPE[0] - 1))[:, None]
    right = np.arange(SHAPE[1]) - column * (SHAPE[1] - 1)
    glow = peak * np.exp(-((np.hypot(down, right) / DIAGONAL / scale) ** power))
    dark = 0.05 * rng.lognormal(0, 0.6, SHAPE)
    hot = (rng.random(SHAPE) < 0.004) * rng.exponential(5.0, SHAPE)
    fit = fitted(dark + hot + glow, rng)
    table = fit.table
    truths = {"rate": peak, "scale": scale, "row": row, "column": column, "power": power, "aspect": 1.0}
    for name, truth in truths.items():
        value, error, _ = table[f"amplifier_glow.{name}"]
        assert abs(value - truth) < max(5 * error, 0.05 * truth), name
    assert table["dark_current.rate"][0] == pytest.approx(dark.mean(), rel=0.07)
    assert table["dark_current_nonuniformity.spread"][0] == pytest.approx(0.6, rel=0.07)
    assert table["hot_pixels.fraction"][0] == pytest.approx(0.004, rel=0.3)
    assert abs(table["gain"][0] - GAIN) < 4 * table["gain"][1]
    assert not fit.grave  # frames are drawn for the middle of the sensor, where there is less of the glow


@pytest.mark.parametrize("kind", ["gradient", "nothing", pytest.param("two levels", marks=pytest.mark.slow)])
def test_dark_current_that_is_larger_on_one_side_is_no_glow(kind, rng):
    """It multiplies what pixels have; a glow adds the same to all of them."""
    across = np.linspace(0, 1, SHAPE[1])
    factor = {"gradient": 0.5 + 2 * across**2, "nothing": 1 + 0 * across, "two levels": 1.0 + (across > 0.5)}[kind]
    assert "amplifier_glow" not in fitted(0.2 * factor * rng.lognormal(0, 0.4, SHAPE), rng).added
