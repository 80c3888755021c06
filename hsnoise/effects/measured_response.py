"""The response of the sensor, measured: which count stands where a straight line would put another."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import measured


def _largest(excess: np.ndarray) -> float:
    return float(np.abs(excess).max())


class MeasuredResponse(AbstractEffect):
    """A level of x DN reads x + excess(x): a monotone curve, straight between its knots.

    Below the first knot and above the last the excess is that of the knot, so the response is straight there; an
    excess of 0 leaves the level as it is. It acts on DN with the black level, before rounding and clipping. A bend that
    a formula describes is `nonlinearity`.

    Attributes:
        level: levels of the knots, DN, rising.
        excess: what is added there, DN.

    Reference: EMVA Standard 1288, release 4.0, 2021 (linearity).
    """

    name: ClassVar[str] = "measured_response"
    stage: ClassVar[Stage] = Stage.BLACK
    measurable: ClassVar[bool] = True
    level: jax.Array = measured(
        "DN", ("knot",), summary=np.max, summary_unit="DN", optional=False, doc="level of the knots; in tables the last"
    )
    excess: jax.Array = measured(
        "DN",
        ("knot",),
        summary=_largest,
        summary_unit="DN",
        optional=False,
        doc="what is added at the knots; in tables the largest",
    )

    def check_arrays(self) -> None:
        level, excess = np.asarray(self.level, float), np.asarray(self.excess, float)
        if level.shape != excess.shape:
            raise ValueError(
                f"measured_response: expected as many excesses as levels, got {excess.size}, {level.size}."
            )
        if np.any(np.diff(level) <= 0):
            raise ValueError("measured_response.level: expected levels that rise.")
        if np.any(np.diff(level + excess) < 0):
            raise ValueError("measured_response.excess: expected a response that does not fall.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        return signal + jnp.interp(signal, self.level, self.excess)

    def before(self, reading: np.ndarray) -> np.ndarray:
        """The levels, DN, that read `reading`."""
        level, excess = np.asarray(self.level, float), np.asarray(self.excess, float)
        return reading - np.interp(reading, level + excess, excess)
