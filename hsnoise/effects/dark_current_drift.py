"""Dark current that rises in the course of the capture."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class DarkCurrentDrift(AbstractEffect):
    """Extra dark electrons, Poisson(slope * exposure * f), in frame f = 0, 1, ...

    The sensor warms up while it records, and dark current doubles about every 6 to 8 degrees. To first order the rate
    grows in proportion to the number of frames since the start of each exposure series. Only warming is modelled:
    a falling dark current could require a negative number of electrons.

    In dark frames: the frame mean and its shot noise rise from frame to frame, in proportion to exposure.

    Reference: Widenhorn et al., "Temperature dependence of dark current in a CCD", Proc. SPIE 4669, 2002.
    """

    name: ClassVar[str] = "dark_current_drift"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    adds: ClassVar[bool] = True
    in_series: ClassVar[bool] = True
    least_frames: ClassVar[int] = 2
    slope: Scalar = param(
        "e-/s/frame", low=0, amplitude=True, doc="growth of the dark current from one frame to the next"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frame = jnp.arange(len(signal), dtype=signal.dtype)[:, None, None]
        mean = self.slope * capture.exposure_s * frame
        return signal + draw_poisson(key, mean, signal.shape)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.has_exposure:
            return None
        # Half of the read noise between the first and the last frame: means of frames are known far better.
        span_s = facts.longest_s * facts.frames
        return lambda size, rng: cls(0.5 * size * facts.read_noise_e / span_s)
