"""Flicker of the black level from frame to frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class FrameOffset(AbstractEffect):
    """Offset of a whole frame, Normal(0, sigma^2) in e-, independent between frames.

    The reference of the black level is sampled once a frame, or the black clamp averages too few pixels.

    In dark frames: frame means scatter by more than the pixels' noise explains, equally in all colours.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "frame_offset"
    stage: ClassVar[Stage] = Stage.READ
    least_frames: ClassVar[int] = 2
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over frames")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        offset = self.sigma * jax.random.normal(key, (len(signal), 1, 1), signal.dtype)
        return signal + capture.offset(offset, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # An eighth of the read noise: a frame has many pixels, but there are few frames.
        return lambda size, rng: cls(0.12 * size * facts.read_noise_e, either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        return {"frame": capture.offset_variance(self.sigma**2, self.after_gain)}
