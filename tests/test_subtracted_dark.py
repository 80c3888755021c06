"""Cameras that subtract their mean dark signal, pixels all different: gain, read noise and what is subtracted."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise._core.conclusion import Light

EXPOSURE_S, SHAPE, FRAMES = (0.0, 5.0, 20.0), (200, 300), 8
GAIN, READ_E, DARK_E_PER_S = 2.0, 3.0, 2.0


def subtracting(share, seed=3):
    """Darks of a camera that subtracts this share of the mean dark signal."""
    rng = np.random.default_rng(seed)
    rate = DARK_E_PER_S * np.exp(0.5 * rng.standard_normal(SHAPE) - 0.125)

    def frames(t):
        electrons = rng.poisson(rate * t, (FRAMES, *SHAPE)) + READ_E * rng.standard_normal((FRAMES, *SHAPE))
        return np.rint(500 + GAIN * (electrons - share * DARK_E_PER_S * t)).astype(np.uint16)

    return hsnoise.FrameStack([frames(t) for t in EXPOSURE_S], EXPOSURE_S)


@pytest.mark.parametrize("share", [1.1, pytest.param(0.6, marks=pytest.mark.slow)])
def test_numbers_are_those_of_the_sensor(share):
    result = hsnoise.fit(subtracting(share))
    truth = {"gain": GAIN, "read_noise.sigma": READ_E, "dark_current.rate": DARK_E_PER_S}
    truth["black_clamp.rate"] = share * GAIN * DARK_E_PER_S
    for name, true in truth.items():
        value, error, _ = result.table[name]
        assert abs(value - true) < 4 * error and error < 0.05 * abs(true), (name, value, error)
    assert result.conclusion.light != Light.RED
    assert any("black_clamp" in doubt for doubt in result.doubts) == (share > 1)
    assert hsnoise.compare(result, subtracting(share), draws=8).error < 3


def test_a_camera_that_subtracts_nothing_has_no_clamp():
    assert "black_clamp" not in hsnoise.fit(subtracting(0.0)).added
