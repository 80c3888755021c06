"""Dark current that swings from frame to frame."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class DarkCurrentInstability(AbstractEffect):
    """The dark current of each frame is that of all pixels times its own factor: log-normal, with mean 1.

    The temperature of the sensor swings about its set point, and dark current doubles about every 6 to 8 degrees: a
    tenth of a degree is one per cent of it. Frames are independent, as if they were longer than the swings; a sensor
    that keeps warming up has `dark_current_drift`.

    In dark frames: frame means scatter in proportion to exposure, and in bias frames not at all; those of a
    `frame_offset` scatter by the same in both.

    Reference: Widenhorn et al., "Temperature dependence of dark current in a CCD", Proc. SPIE 4669, 2002.
    """

    name: ClassVar[str] = "dark_current_instability"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    adds: ClassVar[bool] = True
    least_frames: ClassVar[int] = 2
    spread: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of ln dark current over frames")

    def dark_current_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames:
        z = jax.random.normal(key, (shape[0], 1, 1))
        return jnp.exp(self.spread * z - self.spread**2 / 2)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the dark current applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not (facts.exposures_differ and facts.shows_dark_current):
            return None
        # An eighth of the read noise in the longest exposure, as of offsets: a frame has many pixels.
        swing = 0.12 * facts.read_noise_e / facts.dark_e
        return lambda size, rng: cls(min(swing * size, 1.0))
