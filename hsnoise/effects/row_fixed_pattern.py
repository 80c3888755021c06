"""Fixed pattern of rows: an additive offset of each row, the same in all frames."""

from __future__ import annotations

from typing import ClassVar

import jax

from hsnoise._types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class RowFixedPattern(AbstractEffect):
    """Offset of each row, Normal(0, sigma^2) in e-, the same in all frames and exposures of a sensor.

    Each row has its own select and reset lines.

    In dark frames: horizontal streaks that stay when frames are averaged.

    Reference: EMVA Standard 1288, release 4.0, 2021 (DSNU of rows).
    """

    name: ClassVar[str] = "row_fixed_pattern"
    stage: ClassVar[Stage] = Stage.READ
    sigma: Scalar = param("e-", low=0, doc="standard deviation over rows")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        _, rows, _ = signal.shape
        pattern = jax.random.normal(capture.fixed_key(self.name), (1, rows, 1), signal.dtype)
        return signal + self.sigma * pattern
