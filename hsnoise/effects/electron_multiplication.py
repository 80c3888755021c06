"""Electron multiplication: the gain register of an EMCCD, and what it adds to the noise."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage, draw_poisson
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import param


class ElectronMultiplication(AbstractEffect):
    """n electrons read (1 - e) n + Gamma(e n) at the input of the register, e = 1 - 1/M at a multiplication of M.

    On its way through hundreds of stages an electron becomes a random number of them, geometric with mean M if the
    stages are many: exponential where M is large, and then n electrons become Gamma(n, M). Referred to the input, that
    has mean n and variance e n. (1 - e) n + Gamma(e n), divided by scale 1, has the same for any M, and the same least
    value n/M; e = 1 is Gamma(n), e = 0 is n. Shot noise gains the excess noise factor F^2 = 1 + e = 2 - 1/M; the finite
    number of stages takes away 1 % (536 stages, M = 300).

    The whole model is referred to the input: `gain` is that of the system with multiplication, DN for each electron
    that enters the register (M times the gain without), and `read_noise` is the effective one (1/M of that without).
    It acts after all electrons are collected and before read noise.

    Clock-induced charge, electrons that the clocks set free before or in the register, is Poisson in each pixel and
    frame whatever the exposure; all of it is taken to pass the whole register.

    In dark frames: the few electrons of long exposures, and of bias frames, scatter exponentially: a tail on one side
    of the histogram. The variance alone shows no more than a gain F^2 times as large, in darks and flats alike; what
    separates the two is the third moment of dark electrons, 3/2 of what such a gain makes of a Poisson number.

    References: Robbins, Hadwen, "The noise performance of electron multiplying charge-coupled devices", IEEE Trans.
    Electron Devices 50, 2003; Basden, Haniff, Mackay, "Photon counting strategies with low-light-level CCDs", MNRAS
    345, 2003; Hirsch et al., "A stochastic model for electron multiplication charge-coupled devices", PLoS ONE 8, 2013.
    """

    name: ClassVar[str] = "electron_multiplication"
    stage: ClassVar[Stage] = Stage.MULTIPLICATION
    excess: Scalar = param(
        "1", low=0, high=1, amplitude=True, doc="excess noise factor F^2 minus 1: 1 - 1/M at multiplication M"
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
        drawn = jax.random.gamma(register, jnp.where(some, shape, 1), signal.shape, signal.dtype)
        return entering - jnp.where(some, shape - drawn, 0)

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker:
        def make(size: float, rng: np.random.Generator) -> ElectronMultiplication:
            # Registers are run at multiplications of ten or more; weak or strong is what clocks add.
            return cls(min(size, 1.0), 0.1 * size * rng.uniform(0, 1))

        return make
