"""Photoelectrons from illuminance."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import constants

from hsnoise.chain.photometry import photoelectrons_from_illuminance, scale_to_photoelectrons


def test_equation_9_by_hand():
    # 1 lux over 1 m^2 and 1 s is 1/683 J at 555 nm, and a photon of 555 nm has h c / 555 nm.
    photons = 1 / 683 / (constants.h * constants.c / 555e-9)
    one = photoelectrons_from_illuminance(1.0, pixel_area_m2=1.0, exposure_s=1.0, quantum_efficiency=1.0)
    np.testing.assert_allclose(one, photons, rtol=1e-14)
    assert 4.0e15 < one < 4.2e15


def test_area_is_the_square_of_the_pitch_and_arguments_multiply():
    canon = photoelectrons_from_illuminance(0.1, pixel_pitch_m=6.25e-6, exposure_s=0.05, quantum_efficiency=0.5)
    one = photoelectrons_from_illuminance(1.0, pixel_area_m2=1.0, exposure_s=1.0, quantum_efficiency=1.0)
    np.testing.assert_allclose(canon, one * 0.1 * 6.25e-6**2 * 0.05 * 0.5, rtol=1e-14)


def test_arrays_broadcast_and_trace():
    lux = np.array([0.05, 0.1, 0.2])

    def electrons(lux):
        return photoelectrons_from_illuminance(lux, pixel_pitch_m=5e-6, exposure_s=0.05, quantum_efficiency=0.5)

    np.testing.assert_allclose(electrons(lux), electrons(1.0) * lux, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(electrons)(lux), electrons(lux), rtol=1e-14)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"illuminance_lux": -0.1}, "illuminance_lux: expected"),
        ({"exposure_s": np.nan}, "exposure_s: expected"),
        ({"quantum_efficiency": 1.1}, "quantum_efficiency: expected"),
        ({"pixel_area_m2": -1.0}, "pixel_area_m2: expected"),
        ({"pixel_area_m2": None}, "exactly one"),
        ({"pixel_pitch_m": 1e-6}, "exactly one"),
        ({"pixel_area_m2": None, "pixel_pitch_m": -1e-6}, "pixel_pitch_m: expected"),
    ],
)
def test_wrong_input_is_named(wrong, message):
    right = {"illuminance_lux": 0.1, "pixel_area_m2": 1e-11, "exposure_s": 0.05, "quantum_efficiency": 0.5}
    with pytest.raises(ValueError, match=message):
        photoelectrons_from_illuminance(**{**right, **wrong})


def test_an_image_is_scaled_to_its_mean():
    image = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    scaled = np.asarray(scale_to_photoelectrons(image, 3.0))
    np.testing.assert_allclose(scaled.mean(), 3.0, rtol=1e-14)
    np.testing.assert_allclose(scaled, image * (3.0 / 11.5), rtol=1e-14)


@pytest.mark.parametrize(
    ("image", "mean_e", "message"),
    [
        (-np.ones((2, 2)), 1.0, "image"),
        (np.zeros((2, 2)), 1.0, "some light"),
        (np.ones((2, 2)), np.inf, "mean_e"),
    ],
)
def test_images_without_a_scale_are_refused(image, mean_e, message):
    with pytest.raises(ValueError, match=message):
        scale_to_photoelectrons(image, mean_e)
