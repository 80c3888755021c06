"""Dynamic streak noise: the gain of each row fluctuates from frame to frame."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from hsnoise._types import Frames, PerChannel, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, param


class RowGain(AbstractEffect):
    """Gain max(beta, 0) of each row, one series beta[frame, row, channel] of mean 1 per colour and frame.

    A series runs over all sensor rows; a colour uses the rows it has. It is a stationary periodic Gaussian
    process with independent periodogram bins of mean power proportional to k^-exponent, k = 1 ... rows/2
    cycles per frame, scaled so that its variance over rows is sigma^2 on average over frames; it has no DC
    term. With exponent 0, and with a global shutter whatever the exponent, rows are independent
    Normal(1, sigma^2) instead, DC included.

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
        white = jax.random.normal(key, (frames, rows, len(capture.channels)), signal.dtype)
        coloured = jnp.fft.irfft(
            jnp.fft.rfft(white, axis=1) * _row_filter(rows, exponent)[None, :, None], n=rows, axis=1
        )
        beta = 1 + self.sigma[None, None] * coloured
        return signal * capture.per_row(jnp.maximum(beta, 0))


def _row_filter(rows: int, exponent: Scalar) -> jax.Array:
    """Amplitudes at k = 0 ... rows//2 that turn white rows into coloured ones of the same variance."""
    # Amplitudes, not powers: the square root of a zero power at DC would have a NaN gradient.
    k = jnp.minimum(jnp.arange(rows), rows - jnp.arange(rows))
    coloured = jnp.maximum(k, 1).astype(exponent.dtype) ** (-exponent / 2)
    amplitude = jnp.where(k > 0, coloured, jnp.where(exponent == 0, 1, 0))
    mean_power = jnp.mean(amplitude**2)
    # A single row has only the DC term, so a coloured series over it is 0.
    return amplitude[: rows // 2 + 1] / jnp.sqrt(jnp.where(mean_power > 0, mean_power, 1))
