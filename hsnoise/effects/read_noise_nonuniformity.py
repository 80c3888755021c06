"""Read noise that differs between pixels."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from hsnoise._core.poisson import normal_of_pixels, uniform_of_pixels
from hsnoise._core.types import Frames, PixelMap, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

MOST_TAIL = 0.45  # from 0.5 on the rms is infinite


class ReadNoiseNonuniformity(AbstractEffect):
    """Every pixel has its own read-noise sigma, the same in all frames, with an unchanged rms over pixels.

    Source followers differ in their flicker noise. The factor exp(spread z - spread^2 + tail E) (1 - 2 tail)^(1/2) with
    z normal and E exponential has mean square 1, so the sigma of the read noise stays its rms over pixels. Without a
    tail it is log-normal; in scientific CMOS sensors the noisiest few percent lie far above that, and make much of the
    rms. Whole rows and columns may differ likewise: rows by the pixels that share a source follower, columns by their
    amplifiers and converters.

    In dark frames: variance over time differs between pixels by more than chance, equally in all exposures; the
    histogram of all pixels has heavy tails.

    Reference: Janesick, Andrews, Elliott, "Fundamental performance differences between CMOS and CCD imagers",
    Proc. SPIE 6276, 2006; Huang et al., "Video-rate nanoscopy using sCMOS camera-specific single-molecule localization
    algorithms", Nature Methods 10, 2013 (variances of single pixels).
    """

    name: ClassVar[str] = "read_noise_nonuniformity"
    stage: ClassVar[Stage] = Stage.READ
    measurable: ClassVar[bool] = True
    spread: Scalar = param("1", low=0, amplitude=True, doc="standard deviation of ln sigma over pixels")
    row_spread: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="the same over whole rows; simulated fits hold 0"
    )
    column_spread: Scalar = param(
        "1", low=0, default=0.0, held="at bounds", doc="the same over whole columns; simulated fits hold 0"
    )
    tail: Scalar = param(
        "1",
        low=0,
        high=MOST_TAIL,
        default=0.0,
        held="at bounds",
        amplitude=True,
        doc="mean of an exponential part of ln sigma over pixels; simulated fits hold 0",
    )

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap:
        _, rows, columns = shape
        spreads = {"": (self.spread, rows, columns), ".rows": (self.row_spread, rows, 1)}
        spreads[".columns"] = (self.column_spread, 1, columns)
        logarithm = jnp.zeros((1, 1, 1))
        for part, (spread, *of) in spreads.items():
            z = normal_of_pixels(capture.fixed_key(self.name + part), (1, *of))
            logarithm = logarithm + spread * z - spread**2
        tail = -jnp.log(uniform_of_pixels(capture.fixed_key(self.name + ".tail"), (1, rows, columns)))
        return jnp.exp(logarithm + self.tail * tail) * jnp.sqrt(1 - 2 * self.tail)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal unchanged: the effect that draws the read noise applies the scale."""
        return signal

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        # Sigmas that differ by a third, as the sample sigmas of five frames do by chance.
        return lambda size, rng: cls(0.3 * size)
