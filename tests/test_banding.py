"""Bands that move from frame to frame: their frequency and amplitude in a fit, and what does not pass for them."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.statistics.pixels.banding import banding_of

FRAMES, LINES, NOISE_DN = 12, 300, 0.5


def noise(seed=1):
    return NOISE_DN * np.random.default_rng(seed).standard_normal((FRAMES, LINES))


def bands(frequency, amplitude, shape, seed=2):
    """A sinusoid over the last axis whose phase is new in each frame."""
    phase = 2 * np.pi * np.random.default_rng(seed).random((shape[0], 1))
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(shape[1]) + phase)


@pytest.mark.parametrize("frequency", [0.0347, 0.1713, 1 / 3, 0.4871])
def test_frequency_and_amplitude_are_found(frequency):
    found = banding_of(noise() + bands(frequency, 2.0, (FRAMES, LINES)))
    assert abs(found.frequency - frequency) < 0.1 / LINES
    assert abs(found.variance_dn2 - 2.0) < 4 * found.error_dn2 and found.error_dn2 < 0.2


def wandering(seed=1):
    """Noise whose power falls with the square of the frequency."""
    return np.cumsum(noise(seed), 1)


@pytest.mark.parametrize(
    "means",
    [
        noise(),
        wandering(),
        noise() + bands(0.1, 2.0, (1, LINES)),  # the same in all frames
        noise() + bands(0.1, 0.2, (FRAMES, LINES)),  # a small part of what rows share
        noise() + bands(1.5 / LINES, 2.0, (FRAMES, LINES)),  # a drift
        (noise() + bands(0.1, 2.0, (FRAMES, LINES)))[:2],
    ],
    ids=["white", "red", "static", "weak", "slow", "two frames"],
)
def test_what_is_no_band(means):
    assert banding_of(means) is None


@pytest.mark.parametrize(("axis", "other"), [("row", "row_noise"), ("column", "column_noise")])
def test_a_fit_measures_it_in_place_of_noise_of_rows_or_columns(axis, other):
    rng = np.random.default_rng(4)
    shape = (160, 200)
    lines = bands(0.121, 1.5, (FRAMES, shape[0 if axis == "row" else 1]))
    wave = lines[:, :, None] if axis == "row" else lines[:, None, :]
    frames = 500 + 4.0 * rng.standard_normal((FRAMES, *shape)) + wave + 2.0 * rng.standard_normal((FRAMES, 1, 1))
    result = hsnoise.fit(np.rint(frames).astype(np.uint16), exposure_s=[0.0])
    assert "periodic_banding" in result.added and other not in result.added
    banding = result.params["periodic_banding"]
    assert banding.axis == axis and abs(float(banding.frequency) - 0.121) < 1e-3
    # Without a gain, electrons are counts.
    assert abs(float(banding.amplitude) - 1.5) < 0.1
