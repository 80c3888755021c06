"""Offset of each pixel, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class DarkSignalNonuniformity(AbstractEffect):
    """Offset of each pixel, Normal(0, sigma^2) in e-, the same in all frames and exposures of a sensor.

    Thresholds of the pixels' transistors differ. A pattern that grows with exposure is `dark_current_nonuniformity`
    or `hot_pixels`.

    In dark frames: a grain that stays when frames are averaged, equally strong in all exposures.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: EMVA Standard 1288, release 4.0, 2021 (DSNU).
    """

    name: ClassVar[str] = "dark_signal_nonuniformity"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over pixels")
    after_gain: bool = eqx.field(static=True, default=False)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        pattern = jax.random.normal(capture.fixed_key(self.name), (1, *signal.shape[1:]), signal.dtype)
        return signal + capture.offset(self.sigma * pattern, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A third of the read noise: a pixel has only its few frames to show it.
        return lambda size, rng: cls(0.35 * size * facts.read_noise_e, either_side(rng))

    def components(self, capture: Capture) -> dict[str, float]:
        return {"pixel": capture.offset_variance(self.sigma**2, self.after_gain)}
