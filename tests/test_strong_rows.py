"""Rows that vary far more than pixels: the gain is that of the pixels all the same, and nothing is subtracted."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise._core.conclusion import Light

SHAPE, EXPOSURE_S, FRAMES = (160, 192), (0.01, 1.0, 4.0), 8
GAIN, READ_E, DARK_E_PER_S = 2.0, 2.5, 4.0


def walk(rng):
    """One over f: few rows are independent."""
    white = np.fft.rfft(rng.standard_normal(SHAPE[0]))
    frequency = np.fft.rfftfreq(SHAPE[0])
    frequency[0] = 1 / SHAPE[0]
    rows = np.fft.irfft(white * frequency**-0.9, SHAPE[0])
    return rows / rows.std()


def band(rng):
    """Square waves, which a model has as a sinusoid and row noise."""
    return 1.4 * np.sign(np.sin(2 * np.pi * (0.0321 * np.arange(SHAPE[0]) + rng.random())))


def white(rng):
    return rng.standard_normal(SHAPE[0])


def capture(rows, sigma_dn, spread, seed=0):
    """Darks of pixels whose logarithmic dark currents have this spread, with rows that vary by `sigma_dn`."""
    rng = np.random.default_rng(seed)
    rate = DARK_E_PER_S * np.exp(spread * rng.standard_normal(SHAPE) - spread**2 / 2)
    offsets = 300 + 6 * (spread > 0) * rng.standard_normal(SHAPE)

    def frame(t):
        electrons = rng.poisson(rate * t) + READ_E * rng.standard_normal(SHAPE)
        return GAIN * electrons + offsets + sigma_dn * rows(rng)[:, None]

    counts = [[frame(t) for _ in range(FRAMES)] for t in EXPOSURE_S]
    return hsnoise.FrameStack(list(np.rint(counts).astype(np.uint16)), EXPOSURE_S, shutter="rolling")


@pytest.mark.parametrize(
    ("rows", "sigma_dn", "seed"),
    [
        (white, 25.0, 0),
        pytest.param(white, 8.0, 1, marks=pytest.mark.slow),
        pytest.param(walk, 25.0, 3, marks=pytest.mark.slow),
        pytest.param(walk, 8.0, 0, marks=pytest.mark.slow),
        pytest.param(band, 11.0, 2, marks=pytest.mark.slow),
        pytest.param(band, 11.0, 3, marks=pytest.mark.slow),
    ],
)
def test_the_gain_is_that_of_the_pixels(rows, sigma_dn, seed):
    """Levels hold the rows' noise of their few frames: the gain was 30 % low, and the rest passed for a clamp."""
    found = hsnoise.fit(capture(rows, sigma_dn, 0.6, seed))
    for name, truth in {"gain": GAIN, "read_noise.sigma": READ_E, "dark_current.rate": DARK_E_PER_S}.items():
        value, error, _ = found.table[name]
        assert abs(value - truth) < 4 * error and error < 0.05 * truth, (name, value, error)
    assert found.conclusion.light == Light.GREEN and not {"black_clamp", "black_shading"} & set(found.added)


def test_column_noise_is_no_part_of_the_read_noise():
    """What the subtracted offsets add to a pixel was taken with the columns in it: read noise came out 9 % low."""
    turned = capture(white, 15.0, 0.6)
    found = hsnoise.fit(hsnoise.FrameStack([c.swapaxes(1, 2) for c in turned.counts], EXPOSURE_S, shutter="global"))
    value, error, _ = found.table["read_noise.sigma"]
    assert "column_noise" in found.added and abs(value - READ_E) < 4 * error and error < 0.02 * READ_E


@pytest.mark.parametrize("rows", [white, pytest.param(walk, marks=pytest.mark.slow)])
def test_pixels_that_are_alike_are_followed_too(rows):
    """A likelihood would explain such rows by a row gain, after minutes."""
    found = hsnoise.fit(capture(rows, 25.0, 0.0))
    assert found.method == "transfer" and "row_noise" in found.added
    value, error, _ = found.table["read_noise.sigma"]
    assert np.isnan(value) or abs(value - READ_E) < 4 * error
