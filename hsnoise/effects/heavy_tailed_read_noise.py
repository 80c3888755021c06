"""Read noise with heavier tails than a Gaussian."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class HeavyTailedReadNoise(AbstractEffect):
    """Read noise follows Student's t with `dof` degrees of freedom, its standard deviation unchanged.

    Noise of transistors whose traps switch is no longer normal. Student's t is a normal variable whose variance is
    new in each pixel and frame: its factor is sqrt((dof - 2) / chi2(dof)), of mean square 1. The excess kurtosis is
    6 / (dof - 4) for dof > 4. The larger dof, the closer to a Gaussian.

    In dark frames: more far outliers, both ways, anywhere and anew in each frame.

    Reference: Wei, Fu, Zheng, Yang, "Physics-based noise modeling for extreme low-light photography", IEEE TPAMI 2021
    (long-tailed read noise).
    """

    name: ClassVar[str] = "heavy_tailed_read_noise"
    stage: ClassVar[Stage] = Stage.READ
    dof: Scalar = param("1", low=2.05, doc="degrees of freedom of Student's t; infinite is normal")

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames:
        # Logarithms: a gamma variable of small shape underflows. chi2(dof) is twice a gamma variable of dof / 2.
        log_gamma = jax.random.loggamma(key, self.dof / 2, shape)
        return jnp.exp((jnp.log(self.dof / 2 - 1) - log_gamma) / 2)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the read noise applies the scale."""
        return signal
