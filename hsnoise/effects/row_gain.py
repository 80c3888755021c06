"""Dynamic streak noise: the gain of each row fluctuates from frame to frame."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.coloured import coloured_normal, row_gain_power
from hsnoise._core.types import Frames, PerChannel, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import param


class RowGain(AbstractEffect):
    """Gain max(beta, 0) of each row, one series beta[frame, row, channel] of mean 1 per colour and frame.

    A series runs over all sensor rows; each colour uses its own rows. With a rolling shutter it is a stationary
    periodic Gaussian process whose independent periodogram bins k = 0 ... rows/2 (cycles per frame) have a mean power
    of sigma^2 times

        (1 - white_share) c_k + white_share,   c_k proportional to k^-exponent, c_0 = 0, of mean 1 over the rows:

    coloured noise without a DC term, so that its mean over the rows of a frame is 1, whatever the exponent; and a share
    of white noise, which has one (the paper's beta is a mixture of 1/f and white noise). The variance is sigma^2. With
    a global shutter, and with a white share of 1, rows are independent Normal(1, sigma^2). A fit moves the white share
    only where the model that it is given has one between 0 and 1.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019.
    """

    name: ClassVar[str] = "row_gain"
    stage: ClassVar[Stage] = Stage.GAIN
    in_likelihood: ClassVar[bool] = True
    sigma: PerChannel = param(
        "1", low=0, per_channel=True, amplitude=True, doc="standard deviation of the gain over rows"
    )
    exponent: Scalar = param("1", doc="power falls as row frequency to minus this: 0 white, 1 is 1/f")
    white_share: Scalar = param(
        "1", low=0, high=1, default=0.0, held="at bounds", doc="share of the variance that is white; fits hold 0 and 1"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, _ = signal.shape
        white_share = jnp.where(capture.shutter == "global", 1.0, self.white_share)
        power = row_gain_power(rows, self.exponent, white_share)
        series = coloured_normal(key, (frames, rows, len(capture.channels)), power, signal.dtype)
        # The clip stands between product and sum: no program may merge them, each rounds alike.
        beta = 1 + jnp.maximum(self.sigma[None, None] * series, -1)
        return signal * capture.per_row(beta)
