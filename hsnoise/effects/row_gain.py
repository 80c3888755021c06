"""Dynamic streak noise: the gain of each row fluctuates from frame to frame."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._types import Frames, PerChannel, RandomKey, Scalar
from hsnoise.effects._base import GAIN_DC_UNTIL, AbstractEffect, Capture, Stage, coloured_normal, param


class RowGain(AbstractEffect):
    """Gain max(beta, 0) of each row, one series beta[frame, row, channel] of mean 1 per colour and frame.

    A series runs over all sensor rows; a colour uses the rows it has. It is a stationary periodic Gaussian
    process with independent periodogram bins of mean power proportional to k^-exponent, k = 1 ... rows/2
    cycles per frame, scaled so that its variance over rows is sigma^2 on average over frames; it has no DC
    term. With exponent 0, and with a global shutter whatever the exponent, rows are independent
    Normal(1, sigma^2) instead, DC included; the DC term fades out until an exponent of 0.3.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019.
    """

    name: ClassVar[str] = "row_gain"
    stage: ClassVar[Stage] = Stage.GAIN
    sigma: PerChannel = param("1", low=0, per_channel=True, doc="standard deviation of the gain over rows")
    exponent: Scalar = param("1", doc="power falls as row frequency to minus this: 0 white, 1 is 1/f")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, _ = signal.shape
        exponent = jnp.where(capture.shutter == "global", 0, self.exponent)
        series = coloured_normal(
            key, (frames, rows, len(capture.channels)), exponent, signal.dtype, dc_until=GAIN_DC_UNTIL
        )
        # The clip stands between product and sum: no program may merge them, each rounds alike.
        beta = 1 + jnp.maximum(self.sigma[None, None] * series, -1)
        return signal * capture.per_row(beta)
