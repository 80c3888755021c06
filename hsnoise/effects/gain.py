"""System gain."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._types import Frames, PerChannel, RandomKey, Scalar, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class Gain(AbstractEffect):
    """System gain K of each channel: electrons to DN.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "gain"
    stage: ClassVar[Stage] = Stage.GAIN
    value: PerChannel = param("DN/e-", low=0, per_channel=True, doc="system gain")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal * capture.per_pixel(self.value)

    def mean(self, cfa: str, dtype: jnp.dtype) -> Scalar:
        """Gain of the pixels on average, DN/e-."""
        tile = cfa_tile(cfa)
        values = jax.lax.convert_element_type(jnp.broadcast_to(self.value, tile.max() + 1), dtype)
        return jnp.mean(values[tile.ravel()])
