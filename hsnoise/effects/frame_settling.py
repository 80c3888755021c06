"""A black level that settles over the first frames of a run."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class FrameSettling(AbstractEffect):
    """Offset amplitude * exp(-f / frames) + slow * exp(-f / slow_frames), e-, in frame f = 0, 1, ... of each exposure.

    When a run of frames begins, amplifiers warm up and the black reference finds its level. The course is the same in
    every run, and whatever the exposure: `frame_offset` is new in each frame, and `dark_current_drift` grows with
    exposure and brings shot noise. A time constant of many frames makes it a straight line. Often one or two frames
    are far off and the rest creeps, for which there is the second decay. A fit measures both where bias frames, or
    darks of two exposures, show one course; in a single run, a level that wanders slowly may look the same.

    In dark frames: frame means fall (or rise) towards a level, equally in all colours and exposures; the noise of
    pixels stays.

    Attributes:
        after_gain: whether it arises after the gain: equal in DN in all colours, and independent of the row gain.
            Its electrons are then DN divided by the mean gain of the pixels.

    Reference: Janesick, *Scientific Charge-Coupled Devices*, SPIE 2001 (stability of the offset).
    """

    name: ClassVar[str] = "frame_settling"
    stage: ClassVar[Stage] = Stage.READ
    in_series: ClassVar[bool] = True
    least_frames: ClassVar[int] = 3
    amplitude: Scalar = param("e-", amplitude=True, doc="offset of the first frame")
    frames: Scalar = param("frame", low=0.1, doc="frames in which it falls by a factor of e")
    after_gain: bool = eqx.field(static=True, default=False)
    slow: Scalar = param("e-", default=0.0, held=True, doc="the same of a slower decay; simulated fits leave it")
    slow_frames: Scalar = param("frame", low=0.1, default=100.0, held=True, doc="time constant of that")

    def course(self, frames: int) -> Frames:
        """Offset of each frame of a run [frame], e-."""
        frame = jnp.arange(frames, dtype=self.amplitude.dtype)
        return self.amplitude * jnp.exp(-frame / self.frames) + self.slow * jnp.exp(-frame / self.slow_frames)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        offset = self.course(len(signal)).astype(signal.dtype)[:, None, None]
        return signal + capture.offset(offset, self.after_gain)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        slowest = max(0.5 * facts.frames, 1.5)

        def make(size: float, rng: np.random.Generator) -> FrameSettling:
            # A third of the read noise in the first frame, whose mean is known far better; the capture shows the sign.
            frames = np.exp(rng.uniform(0, np.log(slowest)))
            return cls(0.3 * size * facts.read_noise_e * facts.places.settling, frames, either_side(rng))

        return make
