"""The protocol of training and scoring: light of a scene, units of the network's input, brightness in scores.

Light: a clip is scaled so that the average of its linear light is E[N_e] photoelectrons, which equation 9 of Wang et
al., ICCV 2019, gives for an illuminance. Input: electrons divided by one number that belongs to the camera. Scores:
an output is compared with the truth at the brightness that suits it best.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.optimize import minimize_scalar

from hsnoise.chain.photometry import (
    GREY,
    display_from_linear,
    linear_from_display,
    photoelectrons_from_illuminance,
)

PROTOCOL = "clips average E[N_e], input in units of the camera"  # kept with the weights
MOST_FACTOR = 64.0  # by which brightness is scaled
FACTOR_TOLERANCE = 1e-3  # of its logarithm: less than 0.001 dB


@dataclass(frozen=True)
class Optics:
    """A camera's exposure and optics, which turn a scene's light into electrons, and its range in the paper (lux)."""

    exposure_s: float
    f_number: float
    pixel_pitch_m: float
    quantum_efficiency: float
    lux: tuple[float, float]

    @property
    def factors(self) -> dict[str, float]:
        """What equation 9 needs besides illuminance, area and energy of a photon to give the electrons of a frame.

        exposure, s; quantum efficiency, electrons per photon; lens: the share of light that reaches the sensor,
        1 / (4 N^2) at f-number N, for a distant surface that scatters all light evenly.
        """
        return {
            "exposure": self.exposure_s,
            "quantum efficiency": self.quantum_efficiency,
            "lens": 1 / (4 * self.f_number**2),
        }

    def mean_e(self, lux: ArrayLike) -> ArrayLike:
        """E[N_e], the photoelectrons of the average pixel of a scene in `lux`, e-: equation 9 with all `factors`."""
        return photoelectrons_from_illuminance(
            lux * self.factors["lens"],
            exposure_s=self.exposure_s,
            quantum_efficiency=self.quantum_efficiency,
            pixel_pitch_m=self.pixel_pitch_m,
        )

    def corrections(self, lux: float) -> dict[str, tuple[float, float, float]]:
        """E[N_e] in `lux` without and with each of `factors`, all others in place, and the ratio; last all of them.

        Without the lens this is equation 9 for light that falls on the sensor itself.
        """
        right, factors = float(self.mean_e(lux)), self.factors
        return {name: (right / f, right, f) for name, f in (factors | {"all": prod(factors.values())}).items()}


# Exposure, f-number and illuminance: Wang et al., ICCV 2019. Pitch and quantum efficiency: data sheets.
OPTICS = {
    "canon_5d3": Optics(0.05, 5.6, 6.25e-6, 0.49, (0.05, 0.2)),
    "grasshopper3": Optics(0.03, 1.8, 3.45e-6, 0.60, (0.01, 0.03)),
}


def middle_of(light: tuple[float, float]) -> float:
    """The geometric middle of a range of light, in its unit."""
    return (light[0] * light[1]) ** 0.5


def unit_of(mean_e: tuple[float, float]) -> float:
    """The electrons, e-, by which a network's input is divided, for scenes that average `mean_e`, low and high.

    In the middle of the range and in a clip of ordinary brightness it is the photoelectrons of white. It is a constant
    of the camera, because the light of a scene and the white of a clip are what a user does not know.
    """
    return middle_of(mean_e) / GREY


@jax.jit
def _error(log_factor: jax.Array, light: jax.Array, clean: jax.Array) -> jax.Array:
    return jnp.mean((jnp.clip(display_from_linear(jnp.exp(log_factor) * light), 0, 1) - clean) ** 2)


def scaled_to(found: ArrayLike, clean: ArrayLike) -> np.ndarray:
    """Display values, 0 to 1, of a video whose light is scaled to the brightness of the truth, by one factor.

    The paper scales its input and its rivals likewise before PSNR and SSIM. The factor acts on linear light, because a
    change of illuminance or exposure does, and it is the one with the least squared error of display values, clipped
    to 0 to 1. So no method loses by it, whatever its output. The ratio of means, another choice, would keep the bias
    of noise that black has clipped, and could make a smooth output worse than it is.

    Args:
        found, clean: display values of the output and of the truth, 0 to 1, of the same shape. `found` may exceed 1.

    Raises:
        ValueError: shapes that differ.

    Reference: Wang et al., ICCV 2019.
    """
    found, clean = np.asarray(found, np.float32), np.asarray(clean, np.float32)
    if found.shape != clean.shape:
        raise ValueError(f"found: expected the shape of the truth, {clean.shape}, got {found.shape}")
    light, most = linear_from_display(found), float(np.log(MOST_FACTOR))
    best = minimize_scalar(
        lambda log_factor: float(_error(log_factor, light, clean)),
        bounds=(-most, most),
        method="bounded",
        options={"xatol": FACTOR_TOLERANCE},
    )
    return np.clip(np.asarray(display_from_linear(np.float32(np.exp(best.x)) * light)), 0, 1)
