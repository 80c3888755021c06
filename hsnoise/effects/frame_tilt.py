"""Tilt of the black level along a frame, new in each frame."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, either_side
from hsnoise.effects._parameters import param


class FrameTilt(AbstractEffect):
    """Offset slope * x of each row (column), e-, whose slope, Normal(0, sigma^2), is new in each frame.

    x runs from -1/2 in the first row (column) of the sensor to 1/2 in the last, so the slope is what the offset gains
    over the sensor, and an offset of the frame as a whole stays a matter of `frame_offset`. Supplies, references and
    the temperature of the output amplifier drift while a frame is read; what drifts more slowly than that is, to first
    order, a line over the rows. Over columns it is the droop within a line, where it differs from frame to frame. Its
    variance over the lines of n is sigma^2 (n + 1) / (n - 1) / 12.

    In dark frames: one side is brighter than the other, now this one and now that, and nothing is left of it when many
    frames are averaged; equally strong in all colours and exposures. A ramp that stays is `black_shading`. `row_noise`
    (`column_noise`) with an exponent of about 2 comes near, but wanders and has no one shape.

    Attributes:
        axis: "row" for a line over the rows, "column" for one over the columns.
        after_gain: whether it arises after the gain: alike in DN in all colours, and free of the row gain. Its
            electrons are then DN over the mean gain of the pixels.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """

    name: ClassVar[str] = "frame_tilt"
    stage: ClassVar[Stage] = Stage.READ
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation of the slope over frames")
    axis: str = eqx.field(static=True, default="row")
    after_gain: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.axis not in ("row", "column"):
            raise ValueError(f"frame_tilt.axis: expected 'row' or 'column', got {self.axis!r}.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        slope = self.sigma * jax.random.normal(key, (len(signal), 1, 1), signal.dtype)
        x = jnp.asarray(self._along(capture), signal.dtype)
        x = x[None, :, None] if self.axis == "row" else x[None, None]
        return signal + capture.offset(slope * x, self.after_gain)

    def _along(self, capture: Capture) -> np.ndarray | jax.Array:
        """x of the frames' rows or columns: -1/2 to 1/2 over those of the sensor, 0 if it has one only."""
        lines, last = (
            (capture.rows, capture.sensor_shape[0] - 1)
            if self.axis == "row"
            else (capture.columns, capture.sensor_shape[1] - 1)
        )
        return (lines - last / 2) / max(last, 1)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # An rms of an eighth of the read noise, as of `frame_offset`: all pixels of a frame show it, in few frames.
        def make(size: float, rng: np.random.Generator) -> FrameTilt:
            axis = str(rng.choice(["row", "column"]))
            return cls(0.42 * size * facts.read_noise_e, axis, either_side(rng))

        return make

    def components(self, capture: Capture) -> dict[str, float]:
        x, colours = np.asarray(self._along(capture)), len(cfa_tile(capture.cfa))
        variance = capture.offset_variance(self.sigma**2, self.after_gain)
        # The lines of one colour have a mean of their own, which is an offset of the frame.
        between = float(np.mean([x[first::colours].var(ddof=1) for first in range(colours)])) * variance
        whole = float(np.square(x).mean()) * variance
        return {"row_x_frame" if self.axis == "row" else "column_x_frame": between, "frame": whole - between}
