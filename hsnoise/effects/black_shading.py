"""A black level that bends over the columns or rows."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class BlackShading(AbstractEffect):
    """Offset in DN that decays exponentially from the first or last column (row), the same in all frames.

    The output amplifier and the reference of the converter settle while a row is read, and warm up while a frame is
    read, so the black level drifts. The mean of the drift is zero and its rms is `amplitude`; a `length` of several
    frames makes it a straight line.

    In dark frames: one side is brighter or darker than the other, equally in all frames and exposures, including bias
    frames.

    Attributes:
        axis: "column" if it changes over the columns, "row" if over the rows.
        start: "first" or "last": the column (row) where it is steepest.
        above: whether it lies above the mean there; otherwise below.

    Reference: EMVA Standard 1288, release 4.0, 2021 (nonuniformity of low spatial frequency).
    """

    name: ClassVar[str] = "black_shading"
    stage: ClassVar[Stage] = Stage.BLACK
    measurable: ClassVar[bool] = True
    least_frames: ClassVar[int] = 2
    amplitude: Scalar = param("DN", low=0, amplitude=True, doc="rms over the columns (rows)")
    length: Scalar = param("1", low=0.003, doc="where it has fallen by e, in widths (heights) of the frame")
    axis: str = eqx.field(static=True, default="column")
    start: str = eqx.field(static=True, default="first")
    above: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        for field, known in (("axis", ("row", "column")), ("start", ("first", "last")), ("above", (True, False))):
            if getattr(self, field) not in known:
                raise ValueError(
                    f"black_shading.{field}: expected {known[0]!r} or {known[1]!r}, got {getattr(self, field)!r}."
                )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        over_columns = self.axis == "column"
        lines = capture.sensor_shape[1 if over_columns else 0]
        distance = jnp.arange(lines, dtype=signal.dtype) / max(lines - 1, 1)
        fallen = -jnp.expm1(-distance / self.length)  # exact for lengths of many frames, too
        shape = jnp.mean(fallen) - fallen
        shape = self.amplitude * shape / jnp.sqrt(jnp.mean(shape**2) + 1e-30)
        shape = (shape if self.above else -shape)[:: 1 if self.start == "first" else -1]
        here = shape[capture.columns if over_columns else capture.rows]
        return signal + (here[None, None] if over_columns else here[None, :, None])

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # A fifth of the read noise, where the capture bends; how fast is read off to a factor of two.
        axis, start, above, length = facts.places.shading

        def make(size: float, rng: np.random.Generator) -> BlackShading:
            rms_dn = 0.2 * size * facts.read_noise_e * float(facts.gain.mean())
            return cls(rms_dn, length * np.exp(rng.uniform(-0.7, 0.7)), axis, start, above)

        return make
