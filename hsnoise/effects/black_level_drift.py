"""A black level that depends on the exposure."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class BlackLevelDrift(AbstractEffect):
    """Offset rate * exposure in DN, the same in all pixels and frames of an exposure.

    Many cameras subtract the mean signal of shielded pixels (optical black). That takes off the mean of the dark
    current and leaves its shot noise and its differences from pixel to pixel: the rate is then minus gain times dark
    current, or less, if shielded pixels are warmer. A pedestal that follows the temperature drifts, too.

    In dark frames: the mean rises by less than the variance of pixels says, or falls, while hot pixels grow. Bias
    frames do not show it. EMVA 1288 takes the dark current of such cameras from the variance alone.

    Reference: EMVA Standard 1288, release 4.0, 2021 (dark current compensation).
    """

    name: ClassVar[str] = "black_level_drift"
    stage: ClassVar[Stage] = Stage.BLACK
    measurable: ClassVar[bool] = True
    rate: Scalar = param("DN/s", amplitude=True, doc="change of the black level for each second of exposure")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal + self.rate * capture.exposure_s

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.exposures_differ:
            return None
        # A third of the read noise in the longest exposure, up or down: means of frames are known far better.
        span = 0.3 * facts.read_noise_e * float(facts.gain.mean()) / facts.longest_s
        return lambda size, rng: cls(span * size * float(np.sign(rng.uniform(-1, 1))))
