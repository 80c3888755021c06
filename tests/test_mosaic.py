"""Colour frames and the mosaic of a sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from hsnoise._core.types import BAYER_CFAS, cfa_tile
from hsnoise.chain.photometry import display_from_linear, linear_from_display
from hsnoise.effects import BlackLevel, DarkCurrent, Gain
from hsnoise.enhance.mosaic import electrons_of, mosaic

LIGHT = np.random.default_rng(0).uniform(0, 5, (2, 4, 6, 3)).astype(np.float32)


@pytest.mark.parametrize("cfa", BAYER_CFAS)
def test_each_sensor_pixel_sees_its_colour(cfa):
    cells = np.asarray(mosaic(LIGHT, cfa))
    assert cells.shape == (2, 8, 12)
    for (row, column), channel in np.ndenumerate(cfa_tile(cfa)):
        np.testing.assert_array_equal(cells[:, row::2, column::2], LIGHT[..., channel])


@pytest.mark.parametrize("cfa", [*BAYER_CFAS, "mono"])
def test_counts_without_noise_come_back_as_electrons(cfa):
    light = LIGHT if cfa != "mono" else LIGHT[..., :1]
    gain = (1.5, 1.2, 1.3) if cfa != "mono" else 2.0
    camera = hsnoise.NoiseModel(
        [DarkCurrent(51.7), Gain(gain), BlackLevel(64.0)], cfa=cfa, shutter="global", exposure_s=0.05
    )
    gain = np.tile(np.ravel(gain)[cfa_tile(cfa)], (4, 6))
    counts = (np.asarray(mosaic(light, cfa)) + 51.7 * 0.05) * gain + 64
    np.testing.assert_allclose(electrons_of(counts, camera), light, atol=2e-4)


def test_noisy_frames_have_the_light_as_their_mean():
    camera = hsnoise.cameras.grasshopper3(black_level_dn=200)
    light = np.broadcast_to(np.float32([3.0, 8.0, 5.0]), (6, 40, 50, 3))
    found = electrons_of(hsnoise.sample(jax.random.key(0), mosaic(light, camera.cfa), camera), camera)
    np.testing.assert_allclose(found.mean((0, 1, 2)), [3, 8, 5], atol=0.15)


def test_a_fitted_camera_is_taken_without_a_warning(recwarn):
    with jax.enable_x64(True):  # as a fit makes it
        camera = hsnoise.cameras.canon_5d3(black_level_dn=200.0)
    assert camera["gain"].value.dtype == np.float64
    assert electrons_of(np.full((2, 4, 6), 300, np.uint16), camera).dtype == np.float32
    assert not recwarn.list


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="light: expected"):
        mosaic(LIGHT[..., :2], "RGGB")
    with pytest.raises(ValueError, match="cfa: expected"):
        mosaic(LIGHT, "RGBG")
    with pytest.raises(ValueError, match="counts: expected even"):
        electrons_of(np.zeros((5, 6)), hsnoise.cameras.canon_5d3())


def test_display_curve_is_undone_and_is_that_of_srgb():
    values = np.linspace(-0.2, 1.0, 200)
    np.testing.assert_allclose(display_from_linear(linear_from_display(values)), values, atol=1e-6)
    assert float(linear_from_display(0.5)) == pytest.approx(0.21404, abs=1e-5)
    slopes = jax.vmap(jax.grad(display_from_linear))(jnp.array([-0.1, 0.0, 0.001, 0.5]))
    assert np.isfinite(slopes).all()
