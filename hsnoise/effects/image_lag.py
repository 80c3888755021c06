"""A frame keeps part of the previous one."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class ImageLag(AbstractEffect):
    """Frame f holds (1 - fraction) of its own electrons and `fraction` of those of frame f - 1.

    The transfer gate does not empty the photodiode, and the rest is read with the next frame. Before the first frame
    the sensor is assumed to have seen the same scene, so the first frame does not change.

    In dark frames: consecutive frames are correlated pixel by pixel, in proportion to the shot noise. Moving light
    leaves trails.

    Reference: Fossum, Hondongwa, "A review of the pinned photodiode for CCD and CMOS image sensors", IEEE J. Electron
    Devices Soc. 2, 2014.
    """

    name: ClassVar[str] = "image_lag"
    stage: ClassVar[Stage] = Stage.COUPLING
    in_series: ClassVar[bool] = True
    least_frames: ClassVar[int] = 2
    fraction: Scalar = param(
        "1", low=0, high=1, amplitude=True, doc="part of the electrons that stays for the next frame"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        previous = jnp.concatenate([signal[:1], signal[:-1]])
        return signal + self.fraction * (previous - signal)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.shows_signal:
            return None
        # Correlations of consecutive frames are measured to some thousandths. Half is the mean of two frames.
        return lambda size, rng: cls(min(0.03 * size, 0.5))
