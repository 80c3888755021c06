"""Electron multiplication: the gain register of an EMCCD, and what it adds to the noise."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.gamma import gamma
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param

MOST_READ_NOISE_E = 2.5  # beyond which the tail of single electrons does not show; registers are there to be far below


class ElectronMultiplication(AbstractEffect):
    """n electrons that a gain register multiplies by M read (1 - e) n + Gamma(e n), with the excess e = 1 - 1/M.

    In its hundreds of stages an electron becomes a random number of electrons: geometric, and exponential if the mean M
    is large, so that n become Gamma(n, M). Referred to the input, the mean is n and the variance e n. Both are exact
    here for any M, and so is the least value, n/M; e = 0 is n, e = 1 the limit Gamma(n). Shot noise gains the excess
    noise factor F^2 = 1 + e = 2 - 1/M; 536 stages instead of infinitely many take 1 % from it at M = 300.

    The whole model is referred to the input: `gain` is that of the camera with multiplication, DN for each electron
    that enters the register (M times the gain without), and `read_noise` is the effective one (1/M of that without).
    The effect acts on whole electrons, after all of them are collected, and before read noise. Clock-induced charge is
    Poisson in each pixel and frame, whatever the exposure; all of it is taken to pass the whole register.

    In dark frames: a tail towards bright pixels, because single electrons, of dark current or of the clocks, scatter
    exponentially. The variance alone shows no more than a gain F^2 times as large, in darks and flats alike; only the
    shape of the distribution separates the two: the third moment is 3/2 of what such a gain makes of Poisson numbers.
    Fits that follow each pixel measure it where single electrons stand out of the read noise.

    References: Robbins, Hadwen, "The noise performance of electron multiplying charge-coupled devices", IEEE Trans.
    Electron Devices 50, 2003; Basden, Haniff, Mackay, "Photon counting strategies with low-light-level CCDs", MNRAS
    345, 2003; Hirsch et al., "A stochastic model for electron multiplication charge-coupled devices", PLoS ONE 8, 2013.
    """

    name: ClassVar[str] = "electron_multiplication"
    stage: ClassVar[Stage] = Stage.MULTIPLICATION
    excess: Scalar = param(
        "1",
        low=0,
        high=1,
        held="at bounds",
        amplitude=True,
        doc="excess noise factor F^2 minus 1, 1 - 1/M; fits hold 0 and 1",
    )
    clock_induced: Scalar = param(
        "e-",
        low=0,
        default=0.0,
        held="at bounds",
        amplitude=True,
        doc="mean electrons that clocks add to each pixel whatever the exposure",
    )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        clocks, register = jax.random.split(key)
        entering = signal + draw_poisson(clocks, self.clock_induced, signal.shape)
        shape = self.excess * entering
        some = shape > 0
        drawn = gamma(register, jnp.where(some, shape, 1))
        return entering - jnp.where(some, shape - drawn, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        if facts.read_noise_e > MOST_READ_NOISE_E or facts.pixels_followed:  # such fits look for a register
            return None

        def make(size: float, rng: np.random.Generator) -> ElectronMultiplication:
            # Registers work near the limit, but the gain of a fit without one has absorbed most of the excess.
            return cls(min(size, 1.0), rng.uniform(0, 0.1 * size))

        return make
