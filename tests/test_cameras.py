"""Cameras hold the paper's table, and sample what it says."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from hsnoise.effects import Gain
from hsnoise.model import sample_dark
from hsnoise.simulation.cameras import canon_5d3, grasshopper3

TABLE_2 = {  # of the paper: row-gain variance, gain, dark current, read-noise variance
    canon_5d3: ((0.197, 0.039, 0.013), (1.53, 1.23, 1.31), 51.7, 12.5, 1.0, "rolling", 0.05),
    grasshopper3: ((0.0081, 0.0069, 0.026), (3.54, 3.11, 3.95), 118.0, 5.43, 0.0, "global", 0.03),
}
each_camera = pytest.mark.parametrize("camera", TABLE_2, ids=lambda camera: camera.__name__)


@each_camera
def test_parameters_are_those_of_the_paper(camera):
    variance, gain, rate, read_variance, exponent, shutter, exposure_s = TABLE_2[camera]
    model = camera()
    np.testing.assert_allclose(model["row_gain"].sigma ** 2, variance, rtol=1e-12)
    np.testing.assert_allclose(model["gain"].value, gain, rtol=1e-12)
    np.testing.assert_allclose(model["read_noise"].sigma ** 2, read_variance, rtol=1e-12)
    assert (model["dark_current"].rate, model["row_gain"].exponent) == (rate, exponent)
    assert (model.cfa, model.shutter, model.exposure_s) == ("RGGB", shutter, exposure_s)
    np.testing.assert_array_equal(model["black_level"].value, 0)
    assert model["adc"].white_level_dn is None


@each_camera
def test_keywords_vary_the_camera(camera):
    model = camera(black_level_dn=[64, 65, 66], white_level_dn=4095, cfa="GBRG", shutter="global", exposure_s=0.1)
    np.testing.assert_array_equal(model["black_level"].value, [64, 65, 66])
    assert (model["adc"].white_level_dn, model.cfa, model.exposure_s) == (4095, "GBRG", 0.1)
    assert (model.shutter, model["row_gain"].exponent) == ("global", 0)


def test_dark_frames_have_the_mean_and_spread_of_the_table():
    # The black level keeps clear of clipping; red has 16 rows of 16 pixels.
    frames, rows, columns = 200, 32, 32
    dark = np.asarray(sample_dark(jax.random.key(1), frames, (rows, columns), grasshopper3(black_level_dn=100)))
    red = dark[:, ::2, ::2].astype(float)
    gain, beta, read, mean_e = 3.54, 0.0081, 5.43, 118 * 0.03
    row_means = red.mean(2).ravel()
    row_variance = gain**2 * (beta * mean_e**2 + (1 + beta) * (mean_e + read) / red.shape[2])
    assert abs(row_means.mean() - 100 - gain * mean_e) < 5 * np.sqrt(row_variance / row_means.size)
    within = red.var(axis=2, ddof=1).ravel()
    expected = gain**2 * (1 + beta) * (mean_e + read) + 1 / 12  # rounding adds its 1/12
    assert abs(within.mean() - expected) < 5 * within.std() / np.sqrt(within.size)


def test_an_effect_of_the_same_class_takes_the_place_of_the_old_one():
    changed = canon_5d3().add(Gain(1.0))
    assert changed.names == canon_5d3().names
    assert set(np.asarray(changed["gain"].value)) == {1.0}
