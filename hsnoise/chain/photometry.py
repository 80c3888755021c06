"""From illuminance to photoelectrons (equation 9 of Wang et al., ICCV 2019)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from hsnoise._core.types import is_traced

GREY = 0.2  # mean linear light of ordinary pictures, as a fraction of white
PLANCK_J_S = 6.62607015e-34  # exact in the SI since 2019, like the speed of light
LIGHT_SPEED_M_PER_S = 299_792_458.0
LUMINOUS_EFFICACY_LM_PER_W = 683.0  # at 555 nm, where the eye is most sensitive
WAVELENGTH_M = 555e-9
PHOTON_ENERGY_J = PLANCK_J_S * LIGHT_SPEED_M_PER_S / WAVELENGTH_M


def photoelectrons_from_illuminance(
    illuminance_lux: ArrayLike,
    *,
    exposure_s: ArrayLike,
    quantum_efficiency: ArrayLike,
    pixel_area_m2: ArrayLike | None = None,
    pixel_pitch_m: ArrayLike | None = None,
) -> ArrayLike:
    """Mean photoelectrons per pixel, e-: I * A * t * eta / (683 lm/W * h c / 555 nm).

    All light is assumed to be at 555 nm. Arguments are numbers or arrays that broadcast with each other.

    Args:
        illuminance_lux: illuminance on the sensor (not on the scene), lux.
        exposure_s: exposure, s.
        quantum_efficiency: electrons per photon, above 0, at most 1.
        pixel_area_m2: light-collecting area of a pixel, m^2; or instead
        pixel_pitch_m: pitch of square pixels, m.

    Raises:
        ValueError: unless exactly one of area and pitch is given, and all are finite and not negative.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019, eq. 9.
    """
    if (pixel_area_m2 is None) == (pixel_pitch_m is None):
        raise ValueError("pixel_area_m2, pixel_pitch_m: expected exactly one of the two.")
    _check_within("illuminance_lux", illuminance_lux)
    if pixel_area_m2 is None:
        _check_within("pixel_pitch_m", pixel_pitch_m)
        area_m2 = pixel_pitch_m**2
    else:
        _check_within("pixel_area_m2", pixel_area_m2)
        area_m2 = pixel_area_m2
    _check_within("exposure_s", exposure_s)
    _check_within("quantum_efficiency", quantum_efficiency, high=1.0)
    electrons_per_lux_m2_s = quantum_efficiency / (LUMINOUS_EFFICACY_LM_PER_W * PHOTON_ENERGY_J)
    return illuminance_lux * area_m2 * exposure_s * electrons_per_lux_m2_s


def scale_to_photoelectrons(image: ArrayLike, mean_e: ArrayLike) -> Array:
    """Scale a linear image or a whole clip so that its average is `mean_e` photoelectrons.

    Args:
        image: intensities of any scale >= 0, linear in light (undo a display's gamma first), any shape.
        mean_e: average over all of `image`, e-, a scalar.

    Raises:
        ValueError: if `image` or `mean_e` is negative or not finite, or `image` is black everywhere.
    """
    _check_within("image", image)
    _check_within("mean_e", mean_e)
    image = jnp.asarray(image, float)
    mean = image.mean()
    if not is_traced(mean) and not mean > 0:
        raise ValueError("image: expected some light, got zeros (or no pixels).")
    return image * (mean_e / mean)


def _check_within(name: str, value: ArrayLike, high: float = np.inf) -> None:
    if is_traced(value):
        return
    value = np.asarray(value)
    if not np.all(np.isfinite(value) & (value >= 0) & (value <= high)):
        raise ValueError(f"{name}: expected finite values in [0, {high}], got {value}.")


def linear_from_display(values: ArrayLike) -> Array:
    """Linear light, 0 to 1, of display values 0 to 1 (sRGB, IEC 61966-2-1); linear below 0, too."""
    values = jnp.asarray(values, float)
    return jnp.where(values <= 0.04045, values / 12.92, ((jnp.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def display_from_linear(light: ArrayLike) -> Array:
    """Display values (sRGB, IEC 61966-2-1) of linear light, the inverse of `linear_from_display`."""
    light = jnp.asarray(light, float)
    low = 0.0031308
    return jnp.where(light <= low, 12.92 * light, 1.055 * jnp.maximum(light, low) ** (1 / 2.4) - 0.055)


def light_of_frames(frames: ArrayLike, channels: int) -> Array:
    """Linear light [..., row, column, channel] (1 is white) of display values (uint8) [..., row, column, 3].

    channels: 3, or 1 for grey.
    """
    light = linear_from_display(jnp.asarray(frames, float) / 255)
    return light if channels == 3 else light.mean(-1, keepdims=True)


def frames_of_display(values: ArrayLike) -> np.ndarray:
    """Display values as 8-bit pixels, clipped to 0 to 255."""
    return (np.clip(np.asarray(values), 0, 1) * 255).round().astype(np.uint8)
