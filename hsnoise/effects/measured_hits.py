"""Single counts far off: a chance for each pixel and frame, and measured amplitudes."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.poisson import pixel_words, uniform_of_bits
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import measured, param


class MeasuredHits(AbstractEffect):
    """A pixel reads an amplitude more, in single frames, with probability min(chance + rate * exposure, 1).

    What strikes from outside, such as cosmic rays, grows with exposure; what happens at readout does not. Amplitudes
    follow quantiles at equally spaced probabilities, from 0 to 1, and are linear between them.

    Attributes:
        amplitude: the quantiles, e-, of either sign.

    Reference: Groom, "Cosmic rays and other nonsense in astronomical CCD imagers", Experimental Astronomy 14, 2002.
    """

    name: ClassVar[str] = "measured_hits"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    chance: Scalar = param("1", low=0, high=1, amplitude=True, doc="probability of a hit whatever the exposure")
    rate: Scalar = param("1/s", low=0, amplitude=True, doc="hits of a pixel in a second")
    amplitude: jax.Array = measured(
        "e-",
        ("knot",),
        summary=np.median,
        summary_unit="e-",
        optional=False,
        doc="quantiles of the amplitude; in tables the median",
    )

    def check_arrays(self) -> None:
        if len(self.amplitude) < 2 or np.any(np.diff(self.amplitude) < 0):
            raise ValueError("measured_hits.amplitude: expected two quantiles or more that do not fall.")

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        where, place = (uniform_of_bits(word).astype(signal.dtype) for word in pixel_words(key, signal.shape))
        probability = jnp.minimum(self.chance + self.rate * capture.exposure_s, 1)
        amplitude = jnp.interp(place, jnp.linspace(0, 1, len(self.amplitude), dtype=signal.dtype), self.amplitude)
        return signal + jnp.where(where <= probability, amplitude, 0)

    def components(self, capture: Capture) -> dict[str, float]:
        probability = min(float(self.chance + self.rate * capture.exposure_s), 1.0)
        low, high = np.asarray(self.amplitude, float)[:-1], np.asarray(self.amplitude, float)[1:]
        mean, square = np.mean((low + high) / 2), np.mean((low**2 + low * high + high**2) / 3)
        return {"temporal": capture.offset_variance(float(probability * square - (probability * mean) ** 2))}
