"""Gain fluctuations of a row that are common to its colours."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.coloured import coloured_normal, row_gain_power
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class SharedRowGain(AbstractEffect):
    """Gain max(1 + sigma x, 0) of each row, one series x[frame, row] for all colours.

    The reference voltage of the converters fluctuates while a row is read, whatever its colours. The series runs over
    all sensor rows with power k^-exponent (no DC term, as in `row_gain`); with a global shutter it is white,
    as in the paper.

    In dark frames: streaks as of `row_gain`, but correlated between the colours of a row.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019 (which takes colours as independent).
    """

    name: ClassVar[str] = "shared_row_gain"
    stage: ClassVar[Stage] = Stage.GAIN
    sigma: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of the common gain over rows")
    exponent: Scalar = param("1", default=1.0, doc="power falls as row frequency to minus this: 0 white, 1 is 1/f")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, _ = signal.shape
        white_share = 1.0 if capture.shutter == "global" else None
        power = row_gain_power(rows, self.exponent, white_share)
        series = coloured_normal(key, (frames, rows, 1), power, signal.dtype)
        # The clip stands between product and sum, as in row_gain.
        return signal * (1 + jnp.maximum(self.sigma * series, -1))

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if facts.cfa == "mono" and "row_gain" in facts.effects:  # of one colour, it is the same
            return None
        # A tenth, as the paper's cameras have for each colour.
        exponents = [0.0] if facts.shutter == "global" else [0.0, 1.0]
        return lambda size, rng: cls(0.1 * size, rng.choice(exponents))
