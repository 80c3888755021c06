"""Analogue-to-digital converter."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Counts, Frames, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import LARGEST_UINT32, check_white_level


class ADC(AbstractEffect):
    """Counts: rounded to the nearest integer, clipped at 0 and at the white level if there is one.

    Counts are uint16 when `white_level_dn` is at most 65535, else uint32: nothing wraps around.

    Attributes:
        white_level_dn: largest count, DN; None for no upper limit.
    """

    name: ClassVar[str] = "adc"
    stage: ClassVar[Stage] = Stage.DIGITAL
    in_likelihood: ClassVar[bool] = True
    white_level_dn: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_white_level("adc.white_level_dn", self.white_level_dn)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Counts:
        white = self.white_level_dn
        high = LARGEST_UINT32 if white is None else white
        dtype = jnp.uint16 if high <= np.iinfo(np.uint16).max else jnp.uint32
        counts = capture.rounded(jnp.clip(signal, 0, high))
        return counts if capture.differentiable else counts.astype(dtype)
