"""Glow of the output amplifier: dark current that rises toward a corner."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class AmplifierGlow(AbstractEffect):
    """Extra electrons, Poisson(rate * exposure * exp(-(d / scale)^power)), at distance d from the glowing spot.

    Transistors in saturation emit infrared light that the neighbouring pixels see. Distances are in units of the
    frame's diagonal, those along the rows divided by `aspect`; the spot lies anywhere in the frame, by default in the
    corner of the last row and column. Fits leave it at an edge if it lies there, as amplifiers lie beyond: a spot a
    little inside is hard to tell from another shape.

    In dark frames: a smooth brightening toward a corner or edge that grows in proportion to exposure, with its shot
    noise.

    Reference: Janesick, *Scientific Charge-Coupled Devices*, SPIE 2001 (luminescence).
    """

    name: ClassVar[str] = "amplifier_glow"
    stage: ClassVar[Stage] = Stage.ELECTRONS
    measurable: ClassVar[bool] = True
    adds: ClassVar[bool] = True
    rate: Scalar = param(
        "e-/s", low=0, amplitude=True, doc="electrons of a pixel in a second where the glow is brightest"
    )
    scale: Scalar = param("1", low=0.01, doc="distance over which the glow falls by e, in diagonals of the frame")
    row: Scalar = param(
        "1", low=0, high=1, default=1.0, held="at bounds", doc="row of the brightest spot: 0 the first, 1 the last"
    )
    column: Scalar = param(
        "1", low=0, high=1, default=1.0, held="at bounds", doc="column of the brightest spot: 0 the first, 1 the last"
    )
    aspect: Scalar = param("1", low=0.1, high=10, default=1.0, doc="width of the glow over its height")
    power: Scalar = param(
        "1", low=0.3, high=4, default=1.0, held=True, doc="how it fades: 1 exponentially, 2 as a normal curve; held"
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        last_row, last_column = (n - 1 for n in capture.sensor_shape)
        down = jnp.asarray(capture.rows, signal.dtype) - self.row * last_row
        right = (jnp.asarray(capture.columns, signal.dtype) - self.column * last_column) / self.aspect
        squared = (down[:, None] ** 2 + right[None] ** 2) / max(last_row**2 + last_column**2, 1)
        # The small term keeps the derivative finite in the spot itself.
        distance = jnp.sqrt(squared + 1e-12)
        mean = self.rate * capture.exposure_s * jnp.exp(-((distance / self.scale) ** self.power))
        return signal + draw_poisson(key, mean[None], signal.shape)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if not facts.has_exposure:
            return None
        row, column = facts.places.glow

        def make(size: float, rng: np.random.Generator) -> AmplifierGlow:
            # Nearly as bright in its corner as the noise of a pixel, over a sixth to half of the frame, wide or high.
            peak = 0.8 * size * max(facts.read_noise_e, np.sqrt(facts.dark_e))
            return cls(peak / facts.longest_s, rng.uniform(0.15, 0.5), row, column, rng.choice([0.7, 1.0, 1.5]))

        return make
