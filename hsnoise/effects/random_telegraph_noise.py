"""Random telegraph noise: a few pixels jump between two levels."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class RandomTelegraphNoise(AbstractEffect):
    """A fraction of the pixels, the same in all frames, reads `amplitude` more electrons in its high state.

    A trap in the oxide of the pixel's source follower catches and frees a single carrier. Every pixel has a trap with
    probability `fraction`; its state is new in each frame (traps are faster than the frame rate) and high with
    probability `duty`. The low level is the pixel's ordinary level, so its mean rises by amplitude * duty.

    In dark frames: histograms of single pixels over time have two peaks; the distribution over pixels of the variance
    over time has a long tail, the same in all exposures.

    Reference: Wang, Rao, Mierop, Theuwissen, "Random telegraph signal in CMOS image sensor pixels", IEDM 2006.
    """

    name: ClassVar[str] = "random_telegraph_noise"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    fraction: Scalar = param("1", low=0, high=1, doc="fraction of pixels that jump")
    amplitude: Scalar = param("e-", low=0, amplitude=True, doc="distance of the two levels")
    duty: Scalar = param("1", low=0, high=1, default=0.5, doc="probability of the high level")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where = jax.random.uniform(capture.fixed_key(self.name), (1, *signal.shape[1:]), signal.dtype)
        high = jax.random.uniform(key, signal.shape, signal.dtype) < self.duty
        return signal + jnp.where((where < self.fraction) & high, self.amplitude, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Two pixels in a hundred, with jumps beyond the read noise: smaller ones show no two peaks.
        read = facts.read_noise_e
        return lambda size, rng: cls(0.02 * size, rng.uniform(2.5, 6.0) * read, rng.uniform(0.15, 0.85))

    def components(self, capture: Capture) -> dict[str, float]:
        square = capture.offset_variance(self.amplitude**2)
        fraction, duty = float(self.fraction), float(self.duty)
        static = fraction * (1 - fraction) * duty**2 * square
        return {"pixel": static, "temporal": fraction * duty * (1 - duty) * square}
