"""Noise of rows, columns, frames and neighbouring pixels with measured power spectra."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.coloured import coloured_normal
from hsnoise._core.types import Frames, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import measured

AXES = ("row", "column", "frame", "pixel")


def bins_of(power: jax.Array | np.ndarray, n: int) -> jax.Array:
    """Mean power of the n periodogram bins of a series of length n: the mean of `power` [frequency] over each bin.

    Means, not single values: a line keeps its variance, however wide the bins.
    """
    bins = len(power)
    if bins == 1:
        return jnp.broadcast_to(jnp.asarray(power), n)
    edges = np.clip((np.arange(bins + 1) - 0.5) / (2 * (bins - 1)), 0, 0.5)
    up_to = jnp.concatenate([jnp.zeros(1, jnp.asarray(power).dtype), jnp.cumsum(power * np.diff(edges))])
    frequency = np.abs(np.fft.fftfreq(n))
    low, high = (np.clip(frequency + side / (2 * n), 0, 0.5) for side in (-1, 1))
    return (jnp.interp(high, edges, up_to) - jnp.interp(low, edges, up_to)) / (high - low)


def _rms(power: np.ndarray) -> float:
    """Standard deviation, DN, of a series of this spectrum."""
    return float(np.sqrt(np.trapezoid(power) / (len(power) - 1))) if len(power) > 1 else float(np.sqrt(power[0]))


def _spectrum(of: str):
    return measured("DN^2", ("frequency",), low=0, summary=_rms, summary_unit="DN", doc=f"power spectrum of {of}")


class MeasuredSpectrum(AbstractEffect):
    """Normal series in DN with power spectra of any shape, new in each frame, the same for all colours.

    Each spectrum is given at equally spaced frequencies from 0 to 0.5 cycles per pixel (or frame): the mean power of
    the periodogram |FFT|^2 / n, so that white noise has its variance at every frequency. Series of other lengths take
    the same spectrum, averaged over their bins.

    Attributes:
        row: one offset for each row of a frame; column: one for each column.
        frame: one for each frame; a single number is white.
        pixel: one for each pixel, series along the rows: noise of neighbours that is correlated.

    Reference: Percival and Walden, *Spectral Analysis for Univariate Time Series*, Cambridge 2020, section 7.
    """

    name: ClassVar[str] = "measured_spectrum"
    stage: ClassVar[Stage] = Stage.BLACK
    measurable: ClassVar[bool] = True
    row: jax.Array | None = _spectrum("the offsets of rows")
    column: jax.Array | None = _spectrum("the offsets of columns")
    frame: jax.Array | None = _spectrum("the offsets of frames")
    pixel: jax.Array | None = _spectrum("the noise of pixels along rows")

    @property
    def in_series(self) -> bool:  # type: ignore[override]
        """Whether frames depend on each other: only coloured noise of frames does."""
        return self.frame is not None and len(self.frame) > 1

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        frames, rows, columns = signal.shape
        shapes = {"row": (frames, rows, 1), "column": (frames, columns, 1), "frame": (1, frames, 1)}
        shapes["pixel"] = (frames * rows, columns, 1)
        into = {"row": (frames, rows, 1), "column": (frames, 1, columns), "frame": (frames, 1, 1)}
        for own, axis in zip(jax.random.split(key, len(AXES)), AXES, strict=True):
            power = getattr(self, axis)
            if power is not None:
                shape = shapes[axis]
                series = coloured_normal(own, shape, bins_of(power, shape[1]), signal.dtype)
                signal = signal + series.reshape(into.get(axis, signal.shape))
        return signal

    def components(self, capture: Capture) -> dict[str, float]:
        found = dict.fromkeys(("row_x_frame", "column_x_frame", "frame", "temporal"), 0.0)
        for power, axis, own, whole in (
            (self.row, 0, "row_x_frame", "frame"),
            (self.column, 1, "column_x_frame", "frame"),
            (self.pixel, 1, "temporal", "row_x_frame"),
        ):
            bins = np.zeros(1) if power is None else np.asarray(bins_of(power, capture.shape[axis]))
            if bins.any():
                shares = capture.spread_of_lines(axis, bins / bins.mean())
                found[own] += shares[0] * float(bins.mean())
                found[whole] += shares[1] * float(bins.mean())
        if self.frame is not None:
            found["frame"] += _rms(np.asarray(self.frame)) ** 2
        return found
